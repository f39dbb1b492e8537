"""Passes values through the message format between control process and worker."""

from __future__ import annotations

import functools
import mmap
from typing import Any

from flight.loop.worker import SLAB_BYTES, pack_values, unpack_values


@functools.cache
def slab() -> mmap.mmap:
    """Return shared memory of a worker and the control process."""
    return mmap.mmap(-1, SLAB_BYTES)


def passed(value: Any) -> Any:
    """Return a value after it was packed and unpacked."""
    return unpack_values(pack_values(value, slab()), slab())
