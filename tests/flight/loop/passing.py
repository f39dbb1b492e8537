"""Passes a value through a worker's message, and returns the received value."""

from __future__ import annotations

import functools
import mmap
from typing import Any

from flight.loop.worker import SLAB_BYTES, pack_values, unpack_values


@functools.cache
def slab() -> mmap.mmap:
    """Return the memory that worker and control process share."""
    return mmap.mmap(-1, SLAB_BYTES)


def passed(value: Any) -> Any:
    """Return the value that arrives at the other end."""
    return unpack_values(pack_values(value, slab()), slab())
