"""How often a worker that dies is started: at growing intervals, and within a budget.

The first restart comes at once, the next after half a second, then after twice the interval before. A worker
that lived for a minute has a new budget. After `BUDGET` deaths in a row it rests for ten minutes and has a
new budget then, so that a flight of years gets its worker back once the cause is gone. One worker is thus
started at most `BUDGET` times in 12 minutes, however it fails.
"""

from __future__ import annotations

from hal.interfaces.wires import SECOND_NS

BUDGET = 10
"""Deaths in a row until the worker rests: at the growing intervals, 127.5 s."""
FIRST_NS = SECOND_NS // 2
STEADY_NS = 60 * SECOND_NS
"""A worker that lived for so long has a new budget."""
REST_NS = 600 * SECOND_NS


class Attempts:
    """Counts the deaths of one worker since it last lived long enough."""

    def __init__(self) -> None:
        self.deaths = 0

    def died(self, lived_ns: int) -> int:
        """Count a death after a life of `lived_ns`; return after which time to start again, ns."""
        if lived_ns >= STEADY_NS or self.is_spent:
            self.deaths = 0
        self.deaths += 1
        if self.is_spent:
            return REST_NS
        return 0 if self.deaths == 1 else FIRST_NS << (self.deaths - 2)

    @property
    def is_spent(self) -> bool:
        """Whether the budget is spent: the worker rests."""
        return self.deaths >= BUDGET
