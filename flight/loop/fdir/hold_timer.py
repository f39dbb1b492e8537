"""A timer for how long a condition has held without interruption."""

from __future__ import annotations


class HoldTimer:
    """Detects that a condition has held for a given time."""

    def __init__(self, seconds: float) -> None:
        self._needed_ns = round(seconds * 1e9)
        self._since_ns: int | None = None

    def require(self, seconds: float) -> None:
        """Ask for another time from now on."""
        self._needed_ns = round(seconds * 1e9)

    def update(self, holds: bool, now_ns: int) -> bool:
        """Update whether the condition holds now; return whether the condition has held for long enough."""
        if not holds:
            self._since_ns = None
            return False
        if self._since_ns is None:
            self._since_ns = now_ns
        return now_ns - self._since_ns >= self._needed_ns

    def reset(self) -> None:
        """Start from zero."""
        self._since_ns = None
