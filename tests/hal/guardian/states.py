"""Reads the state of a process, and waits for a state without a timeout that fails on busy machines."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

_PATIENCE_S = 60.0


def state(process: int) -> str:
    """Return the state letter of a process by proc(5), such as T (stopped), or "" if the process is gone."""
    try:
        stat = Path(f"/proc/{process}/stat").read_text(encoding="ascii")
    except (FileNotFoundError, ProcessLookupError):
        return ""
    return stat.rpartition(")")[2].split()[0]


def wait_until(condition: Callable[[], bool]) -> None:
    """Wait until a condition is true. Raises AssertionError if it never becomes true."""
    deadline = time.monotonic() + _PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, "it did not come"
        time.sleep(0.01)
