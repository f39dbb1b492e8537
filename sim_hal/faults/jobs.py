"""Applies faults inside a worker, in simulation only."""

from __future__ import annotations

import dataclasses
import importlib
import os
import signal
import time
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True, slots=True)
class Task:
    """A job: its function as MODULE:NAME, its argument, and its fault, empty for none."""

    function: str
    argument: Any
    fault: str = ""
    delay: float = 0.0


def perform(task: Task) -> Any:
    """Run a job with its fault."""
    module, _, name = task.function.partition(":")
    if task.fault == "endless":
        while True:
            pass
    if task.fault == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    if task.fault == "exception":
        raise ArithmeticError("an injected defect of the worker")
    value = getattr(importlib.import_module(module), name)(task.argument)
    if task.fault == "slow":
        time.sleep(task.delay)
    return without_numbers(value) if task.fault == "nan" else value


def without_numbers(value: Any) -> Any:
    """Return a value with every float replaced by NaN."""
    if isinstance(value, float):
        return float("nan")
    if isinstance(value, np.ndarray) and value.dtype.kind == "f":
        return np.full_like(value, np.nan)
    if isinstance(value, tuple) and type(value) is tuple:
        return tuple(map(without_numbers, value))
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        names = [field.name for field in dataclasses.fields(value) if field.init]
        return dataclasses.replace(value, **{name: without_numbers(getattr(value, name)) for name in names})
    return value
