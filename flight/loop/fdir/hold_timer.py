"""How long something has been so without a break."""

from __future__ import annotations


class Dwell:
    """Tells when a condition has held for long enough."""

    def __init__(self, seconds: float) -> None:
        self._needed_ns = round(seconds * 1e9)
        self._since_ns: int | None = None

    def update(self, holds: bool, now_ns: int) -> bool:
        """State whether it holds now; tell whether it has for as long as is needed."""
        if not holds:
            self._since_ns = None
            return False
        if self._since_ns is None:
            self._since_ns = now_ns
        return now_ns - self._since_ns >= self._needed_ns

    def reset(self) -> None:
        """Begin anew."""
        self._since_ns = None
