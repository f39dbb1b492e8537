"""Progress of a campaign on standard error: one line on a terminal, else a line every ten seconds."""

from __future__ import annotations

import sys
import time

_PLAIN_S = 10.0
_WIDTH = 30


class Progress:
    """How many cases are done, and how long the rest takes at the pace so far."""

    def __init__(self, total: int, done: int) -> None:
        self._total = total
        self._before = done
        self._done = done
        self._begun = self._written = time.perf_counter()
        self._terminal = sys.stderr.isatty()

    def note(self, line: str) -> None:
        """Write a line of its own."""
        self._write(("\r\x1b[K" if self._terminal else "") + line + "\n")

    def advance(self) -> None:
        """Count one more."""
        self._done += 1
        now = time.perf_counter()
        left = (now - self._begun) / (self._done - self._before) * (self._total - self._done)
        if self._terminal:
            filled = _WIDTH * self._done // self._total
            bar = "#" * filled + "." * (_WIDTH - filled)
            self._write(f"\r\x1b[K[{bar}] {self._done}/{self._total}  {left:.0f} s left")
        elif now - self._written >= _PLAIN_S:
            self._written = now
            self._write(f"{self._done} of {self._total} done, {left:.0f} s left\n")

    def close(self) -> None:
        """Take the line away."""
        if self._terminal:
            self._write("\r\x1b[K")

    @staticmethod
    def _write(text: str) -> None:
        sys.stderr.write(text)
        sys.stderr.flush()
