"""Jobs for worker processes.

The jobs have a separate module, because a worker imports only the module of its job.
"""

from __future__ import annotations

import os
import time
from typing import Any


def double(value: Any) -> Any:
    """Return twice the value."""
    return 2 * value


def fail(value: Any) -> Any:
    """Raise an exception."""
    raise ValueError(f"cannot do {value}")


def hang(_: Any) -> Any:
    """Never return."""
    while True:
        time.sleep(1.0)


def die(_: Any) -> Any:
    """End the process."""
    os._exit(3)


def cores(_: Any) -> list[int]:
    """Return the cores that this process may use."""
    return sorted(os.sched_getaffinity(0))


def function(_: Any) -> Any:
    """Return a function, because a worker cannot send a function as a result."""
    return function
