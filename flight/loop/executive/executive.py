"""The executive: runs rate groups on an injected clock, in order of their due times, one at a time.

A late cycle re-phases to the grid. A slot is run if it is less than half a period late, otherwise it is
skipped and counted, so two cycles are never closer than half a period: there is no burst of catch-up cycles.
Slots run plus slots skipped always equal the slots elapsed.

Groups are given in order of importance: among groups due at the same time the first runs first. Long jobs run
in workers (`flight.loop.executive.jobs`), never here. The executive's task runner is one of the named
containment boundaries: an exception of a task is reported and the loop goes on.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from hal.interfaces.wires import Clock
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


class Observer(Protocol):
    """Receives the executive's reports; must be quick and must not raise."""

    def ran(self, group: RateGroup, cycle: Cycle, execution_ns: int) -> None:
        """Report a cycle that ended."""

    def slipped(self, group: RateGroup, slots: int) -> None:
        """Report slots that were skipped."""

    def failed(self, group: RateGroup, error: Exception) -> None:
        """Report that a task raised, and bring the devices to a safe state."""


class Executive:
    """The loop. `stopwatch` measures execution times, for telemetry only."""

    def __init__(
        self,
        clock: Clock,
        groups: Sequence[RateGroup],
        observer: Observer,
        stopwatch: Callable[[], int] = time.perf_counter_ns,
    ) -> None:
        self._clock = clock
        self._groups = tuple(groups)
        self._observer = observer
        self._stopwatch = stopwatch
        self._stop = False

    def stop(self) -> None:
        """Let the running cycle end, then return from `run`. Safe from a signal handler."""
        self._stop = True

    def run(self, epoch_ns: int, until_ns: int) -> None:
        """Run every group on the grid that starts at `epoch_ns`, up to but excluding `until_ns`."""
        for group in self._groups:
            group.begin(epoch_ns)
        while not self._stop:
            due_ns = min(group.due_ns for group in self._groups)
            if due_ns >= until_ns:
                self._clock.sleep_until_ns(until_ns)
                return
            self._clock.sleep_until_ns(due_ns)
            for group in self._groups:
                if not self._stop:
                    self._serve(group)

    def _serve(self, group: RateGroup) -> None:
        cycle, slipped = group.claim(self._clock.now_ns())
        if slipped:
            self._observer.slipped(group, slipped)
        if cycle is None:
            return
        begun = self._stopwatch()
        completed = False
        try:
            group.task(cycle)
            completed = True
        except Exception as error:  # noqa: BLE001 - containment boundary: the task runner
            self._observer.failed(group, error)
        execution_ns = self._stopwatch() - begun
        group.account(execution_ns, completed)
        self._observer.ran(group, cycle, execution_ns)
