"""Tests of the memory that a worker process still holds after a job, and of the modules that it imports."""

from __future__ import annotations

import ctypes
import os
import sys
import time
from contextlib import closing
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from flight.loop.executive import ProcessRunner, Worker
from hal.buses.system import SystemClock
from tests.support import process_watch
from tests.support.process_watch import MIB

_kept: list[npt.NDArray[np.float64]] = []


def fill_and_free(_: Any) -> tuple[int, float]:
    """Allocate 48 MiB in blocks and free all except the last block, so that the heap cannot shrink.

    Returns the process identifier, and the memory (bytes) that the process holds afterwards.
    """
    pieces = [np.ones(8192) for _ in range(768)]
    _kept.append(pieces.pop())
    del pieces
    return os.getpid(), process_watch.look({"me": os.getpid()}).memory["me"]


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "malloc_trim"), reason="this libc has no malloc_trim")
def test_a_worker_frees_the_memory_of_a_job_after_its_result_is_sent() -> None:
    with closing(
        ProcessRunner(SystemClock(), [Worker("filler", fill_and_free, 0, 20_000_000_000)])
    ) as runner:
        deadline = time.monotonic() + 300.0
        assert runner.submit("filler", None)
        while not (results := runner.collect()) and time.monotonic() < deadline:
            time.sleep(0.005)
        process, held = results[0].value
        rest = held
        while rest > held - 40 * MIB and time.monotonic() < deadline:
            time.sleep(0.01)
            rest = process_watch.look({"filler": process}).memory["filler"]
    assert rest <= held - 40 * MIB


def heavy_parts(_: Any) -> list[str]:
    """Import scipy; return the modules of numpy that scipy imported although no job uses them."""
    import scipy.linalg  # noqa: F401, PLC0415 - in the worker's process

    return [name for name in ("numpy.f2py", "numpy.ma", "numpy.testing") if name in sys.modules]


def test_a_worker_holds_no_parts_of_numpy_that_no_job_uses() -> None:
    with closing(ProcessRunner(SystemClock(), [Worker("lean", heavy_parts, 0, 20_000_000_000)])) as runner:
        deadline = time.monotonic() + 300.0
        assert runner.submit("lean", None)
        while not (results := runner.collect()) and time.monotonic() < deadline:
            time.sleep(0.005)
    assert results[0].value is not None
    assert list(results[0].value) == []
