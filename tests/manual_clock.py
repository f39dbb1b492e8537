"""A clock that only a test advances, for tests without a simulated world."""

from __future__ import annotations

from sim_hal.clock import SimClock


class ManualClock(SimClock):
    """A SimClock that starts at one second. A test advances it by a given time."""

    def __init__(self, start_ns: int = 1_000_000_000) -> None:
        super().__init__(start_ns=start_ns)

    def advance(self, span_ns: int) -> None:
        """Advance the clock, and run every job that is due."""
        self.sleep_until_ns(self.now_ns() + span_ns)
