"""UTC for labels of run folders and commands: never an input of control."""

from __future__ import annotations

from datetime import UTC, datetime

from hal.buses.clock import SystemClock


def utc_ns() -> int:
    """Return the machine's UTC, ns since 1970."""
    return SystemClock().utc_ns()


def utc_text() -> str:
    """Return the machine's UTC as text, for names of folders."""
    return f"{datetime.fromtimestamp(utc_ns() * 1e-9, UTC):%Y%m%d-%H%M%S}"
