"""Processor time scaled to a standard machine, so that time limits hold on slow or busy machines.

Each measurement is divided by the time of short vector additions just before and after the measurement.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

import numpy as np

Result = TypeVar("Result")
_warm: set[str] = set()
"""Names of the calls that this process has already made."""
ORDINARY_PACE_S = 4.5e-4
"""Processor time (s) that `pace_s` returns on the two-core machines for which the limits are stated."""


def pace_s() -> float:
    """Return the processor time (s) of 1,000 additions of short vectors."""
    vector = np.ones(3)
    begun = time.process_time()
    for _ in range(1_000):
        np.add(vector, vector)
    return time.process_time() - begun


def warm_call(name: str, call: Callable[[], Result]) -> tuple[Result, float]:
    """Return the result of `call` and its processor time (s), which excludes the loading of code.

    The first call of a `name` in a process loads modules and compiled functions, so the call is repeated.
    """
    if name not in _warm:
        _warm.add(name)
        call()
    begun = time.process_time()
    result = call()
    return result, time.process_time() - begun


def ordinary_seconds(work: Callable[[], object], runs: int = 3) -> float:
    """Return the smallest processor time (s) of several runs of `work`, scaled to the standard machine."""
    spans = []
    for _ in range(runs):
        before = pace_s()
        begun = time.process_time()
        work()
        spent = time.process_time() - begun
        spans.append(spent / max(1.0, (before + pace_s()) / 2.0 / ORDINARY_PACE_S))
    return min(spans)
