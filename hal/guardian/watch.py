"""When the guardian zeroes the coils: from the start until the first heartbeat, and 0.3 s after the last.

Without heartbeats it repeats zero every 0.1 s, to override a late write of the flight process or the effect
of a brown-out. It stops at once when heartbeats return.
"""

from __future__ import annotations

SILENCE_NS = 300_000_000
"""The longest gap between heartbeats."""

REPEAT_NS = 100_000_000
"""The interval between writes of zero meanwhile."""

FINAL_ZEROS = 3
"""How often zero must be acknowledged after the flight process died, before the guardian ends."""

PATIENCE_NS = 5_000_000_000
"""How long the guardian tries to zero the coils after the flight process died."""


class Watch:
    """Decides when to zero the coils; times are of a monotonic clock."""

    def __init__(self, now_ns: int) -> None:
        self.orphaned = False
        """The flight process died: no heartbeat will come."""
        self.outages = 0
        """How often heartbeats stopped."""
        self._beating = False
        self._due_ns = now_ns
        self._zeroed = 0
        self._last_ns = now_ns

    @property
    def due_ns(self) -> int:
        """When zero is due unless a heartbeat arrives before."""
        return self._due_ns

    def over(self, now_ns: int) -> bool:
        """Return whether the guardian may end: the flight is dead, the coils at zero or out of reach."""
        return self.orphaned and (self._zeroed >= FINAL_ZEROS or now_ns > self._last_ns)

    def beat(self, now_ns: int) -> None:
        """Accept a heartbeat."""
        self._beating = True
        self._due_ns = now_ns + SILENCE_NS

    def orphan(self, now_ns: int) -> None:
        """Note that the flight process ended without a goodbye: zero is due now."""
        self.orphaned = True
        self._zeroed = 0
        self._due_ns = now_ns
        self._last_ns = now_ns + PATIENCE_NS

    def attempt(self, now_ns: int) -> bool:
        """Return whether zero is due now; if so, schedule the next time."""
        if now_ns < self._due_ns:
            return False
        if self._beating:
            self._beating = False
            self.outages += 1
        self._due_ns = now_ns + REPEAT_NS
        return True

    def acknowledged(self) -> None:
        """Note that zero was acknowledged."""
        self._zeroed += 1
