"""When the guardian zeroes the coils: from the start until the first heartbeat, and 0.3 s after the last.

While heartbeats are missing zero is said again every 0.1 s, so that a write of the flight process that was
still under way, or a brown-out that comes after, does not stand. Who hears the heart again lets go at once.
"""

from __future__ import annotations

SILENCE_NS = 300_000_000
"""How long the heart may stand still."""

REPEAT_NS = 100_000_000
"""How often zero is said meanwhile."""

LAST_WORDS = 3
"""How often zero is acknowledged after a death, before the guardian ends too."""

PATIENCE_NS = 5_000_000_000
"""How long a guardian whose flight process is dead tries to reach the coils."""


class Watch:
    """The guardian's judgement; times are of a monotonic clock."""

    def __init__(self, now_ns: int) -> None:
        self.orphaned = False
        """The flight process is gone: no heartbeat will come."""
        self.outages = 0
        """How often a heart that had beaten fell silent."""
        self._beating = False
        self._due_ns = now_ns
        self._said = 0
        self._last_ns = now_ns

    @property
    def due_ns(self) -> int:
        """When zero is to be said, if nothing is heard before."""
        return self._due_ns

    def over(self, now_ns: int) -> bool:
        """Tell whether nothing is left to do: the flight is dead, the coils at zero or out of reach."""
        return self.orphaned and (self._said >= LAST_WORDS or now_ns > self._last_ns)

    def beat(self, now_ns: int) -> None:
        """Hear a heartbeat."""
        self._beating = True
        self._due_ns = now_ns + SILENCE_NS

    def orphan(self, now_ns: int) -> None:
        """Learn that the flight process has ended without a word: zero is due now."""
        self.orphaned = True
        self._said = 0
        self._due_ns = now_ns
        self._last_ns = now_ns + PATIENCE_NS

    def attempt(self, now_ns: int) -> bool:
        """Tell whether zero is to be said now; when it is, the next time is set."""
        if now_ns < self._due_ns:
            return False
        if self._beating:
            self._beating = False
            self.outages += 1
        self._due_ns = now_ns + REPEAT_NS
        return True

    def acknowledged(self) -> None:
        """Note that zero has been said and taken."""
        self._said += 1
