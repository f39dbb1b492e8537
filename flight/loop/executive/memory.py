"""Memory settings of a process that runs for months: large arrays outside the heap, small collections.

glibc raises its threshold as large blocks are freed (mallopt(3)): frames then come from the heap, small
blocks fragment it, and the heap grows. With another libc these functions have no effect on the heap.
"""

from __future__ import annotations

import ctypes
import gc

import numpy as np

LARGE_BYTES = 256 * 1024
"""Blocks of at least this size are mapped separately, and returned to the kernel when freed."""
SPARE_BYTES = 4 * 1024 * 1024
"""Free memory kept at the heap's top, so that cycles do not call the kernel each time."""

_SELDOM = {"char", "core", "ctypeslib", "f2py", "ma", "polynomial", "rec", "strings", "test", "testing"}

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # malloc.h


def settle() -> None:
    """Set the thresholds, exempt all present objects from garbage collection, and stop collecting by itself.

    Call when all is built, and a `Collector` now and then: the flight makes no garbage that only a collection
    finds, but a failure may. Collections then come at a known time, and examine only objects made since, not
    modules and tasks, which would take tens of ms of a control cycle.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, LARGE_BYTES)
        mallopt(_M_TRIM_THRESHOLD, SPARE_BYTES)
    gc.collect()
    gc.freeze()
    gc.disable()


class Collector:
    """Collects the garbage that was made since its last call, and exempts the survivors from later calls.

    Call it every few seconds: windows of measurements hold tens of thousands of objects a minute old or less,
    and looking at all of them takes 2 ms. The first call only exempts the objects of the flight's start.
    """

    def __init__(self) -> None:
        self._begun = False

    def __call__(self) -> None:
        """Collect."""
        if self._begun:
            gc.collect()
        self._begun = True
        gc.freeze()


def give_back() -> None:
    """Return the heap's free memory to the kernel: tens of MB after a frame, in about 2 ms."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def lean_numpy() -> None:
    """Keep scipy from importing parts of numpy that no job uses: 11 MiB and 0.2 s of each process.

    scipy copies all that numpy lists, and so imports its masked arrays, its test support and its reader of
    Fortran (scipy/_lib/array_api_compat). Call before scipy's import; the parts are no longer listed, but
    still there for a module that names them. With another numpy this has no effect.
    """
    np.__all__ = [name for name in np.__all__ if name not in _SELDOM]
    lazy = getattr(np, "__numpy_submodules__", None)
    if isinstance(lazy, set):
        lazy -= _SELDOM
