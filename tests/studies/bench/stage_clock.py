"""Processor time of the stages of a computation: the functions that its module calls from other modules.

Nothing is named in advance, so that a stage that is added, split or renamed is measured as it is.
"""

from __future__ import annotations

import functools
import inspect
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any

REST = "rest"
WHOLE = "whole"


@contextmanager
def clocked(module: ModuleType, package: str) -> Iterator[dict[str, float]]:
    """Give a dictionary that has, at the end, s by stage: functions of `package` that `module` imported.

    `rest` is what `module` does itself, `whole` the sum. A stage within a stage counts to the outer one.
    """
    spent: dict[str, float] = {}
    within = [0]

    def clock(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(function)
        def timed(*arguments: Any, **named: Any) -> Any:
            within[0] += 1
            begun = time.process_time()
            try:
                return function(*arguments, **named)
            finally:
                within[0] -= 1
                if not within[0]:
                    spent[name] = spent.get(name, 0.0) + time.process_time() - begun

        return timed

    imported = {
        name: value
        for name, value in vars(module).items()
        if inspect.isfunction(value) and value.__module__ != module.__name__
        if value.__module__.startswith(package)
    }
    for name, function in imported.items():
        setattr(module, name, clock(name, function))
    begun = time.process_time()
    try:
        yield spent
    finally:
        whole = time.process_time() - begun
        for name, function in imported.items():
            setattr(module, name, function)
        spent[REST] = max(whole - sum(spent.values()), 0.0)
        spent[WHOLE] = whole
