"""Memory of a process that runs for months: arrays of megabytes apart from the heap, nothing looked at twice.

glibc moves its threshold up as large blocks are freed (mallopt(3)): frames then come from the heap, small
blocks settle behind them, and it grows by a frame now and then. Nothing here does anything with another libc.
"""

from __future__ import annotations

import ctypes
import gc

LARGE_BYTES = 256 * 1024
"""Blocks from this size on are mapped each for itself, and given back when they are freed."""
SPARE_BYTES = 4 * 1024 * 1024
"""So much at the heap's top is kept, so that cycles do not ask the kernel again and again."""

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # malloc.h


def settle() -> None:
    """Call once everything is built: what is there now stays, what comes and goes is kept apart from it.

    The collector need not look again at the modules and rooms: its full passes would take tens of ms of a
    control cycle.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, LARGE_BYTES)
        mallopt(_M_TRIM_THRESHOLD, SPARE_BYTES)
    gc.freeze()


def give_back() -> None:
    """Return to the machine what the heap keeps of freed arrays: tens of MB after a frame, in about 2 ms."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
