"""A rate group: a task on a fixed time grid, with counts of its runs, slips and overruns.

A late cycle re-phases to the grid. A slot is run if it is less than half a period late, otherwise it is
skipped and counted, so two cycles are never closer than half a period: there is no burst of catch-up cycles.
Slots run plus slots skipped always equal the slots elapsed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from knightcube.errors import FlightError


@dataclass(frozen=True, slots=True)
class Cycle:
    """One run of a rate group: its slot on the grid, when it was due and when it began, in ns."""

    slot: int
    due_ns: int
    start_ns: int


Task = Callable[[Cycle], None]


class RateGroup:
    """A task, its period, and their statistics."""

    def __init__(self, name: str, period_ns: int, task: Task, offset_ns: int = 0) -> None:
        if period_ns <= 0:
            raise FlightError(f"rate group {name}: a period of {period_ns} ns is not positive")
        self.name = name
        self.period_ns = period_ns
        self.task = task
        self.cycles = 0
        self.completed = 0
        self.slips = 0
        self.overruns = 0
        self.total_execution_ns = 0
        self.max_execution_ns = 0
        self._offset_ns = offset_ns
        self._slot = 0
        self._epoch_ns = 0

    def begin(self, epoch_ns: int) -> None:
        """Start the grid: slot 0 is due at the epoch plus this group's offset."""
        self._epoch_ns = epoch_ns + self._offset_ns
        self._slot = 0

    @property
    def due_ns(self) -> int:
        """When the next slot is due."""
        return self._epoch_ns + self._slot * self.period_ns

    @property
    def mean_execution_ns(self) -> float:
        """Mean time spent in the task."""
        return self.total_execution_ns / self.cycles if self.cycles else 0.0

    def claim(self, now_ns: int) -> tuple[Cycle | None, int]:
        """Return the cycle to run now (None: none is due), and the slots slipped since the last call."""
        late_ns = now_ns - self.due_ns
        if late_ns < 0:
            return None, 0
        skipped, phase_ns = divmod(late_ns, self.period_ns)
        cycle: Cycle | None = None
        if 2 * phase_ns >= self.period_ns:
            skipped += 1
        else:
            slot = self._slot + skipped
            cycle = Cycle(slot, self._epoch_ns + slot * self.period_ns, now_ns)
        self._slot += skipped + (cycle is not None)
        self.slips += skipped
        return cycle, skipped

    def account(self, execution_ns: int, completed: bool = True) -> bool:
        """Count a cycle, its execution time and whether its task completed; return whether it overran."""
        self.cycles += 1
        self.completed += completed
        self.total_execution_ns += execution_ns
        self.max_execution_ns = max(self.max_execution_ns, execution_ns)
        overran = execution_ns > self.period_ns
        self.overruns += overran
        return overran
