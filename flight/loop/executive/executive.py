"""The executive: runs rate groups on an injected clock, in order of their due times, one at a time.

Groups are given in order of importance: among those due at the same time the first runs first. Long jobs run
in workers (`flight.loop.executive.jobs`), never here. The executive's task runner is one of the named
containment boundaries: an exception of a task is reported and the loop goes on.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Protocol

from flight.loop.executive.rate_group import Cycle, RateGroup
from hal.interfaces.wires import Clock


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
