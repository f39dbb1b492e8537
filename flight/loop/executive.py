"""The executive, which runs rate groups on a given clock, and job runners, which run jobs outside its thread.

Each rate group has a fixed grid of time slots. The executive runs the groups one at a time, in the order in
which they are due. The cycle of a slot is run if it starts less than half a period late; otherwise the slot
is skipped and counted. Two cycles of a group are therefore never closer than half a period, and missed cycles
are not run later in a burst. The number of run and skipped slots always equals the number of slots elapsed.

Rate groups are listed in order of importance. If several groups are due at the same time, the most important
one runs first. The executive's task runner is one of the documented containment boundaries: an exception in a
task is reported, and the loop continues.

The control thread submits a job and later collects its result; it never waits for a job. In a lock-step
simulation, `LockStepRunner` runs a job at once when it is submitted, and delivers its result after the
modelled latency in simulated time, so that the result of a flight does not depend on the speed of the
machine. In a real-time flight, `flight.loop.worker_processes.ProcessRunner` runs jobs in separate processes.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any, Literal, Protocol

from hal.interfaces.wires import Clock
from knightcube.errors import FlightError

Outcome = Literal["done", "failed", "timed-out", "died"]


@dataclass(frozen=True, slots=True)
class Worker:
    """A worker, which runs one kind of job: a function of one argument at the top level of a module.

    Attributes:
        name: short name of the worker for telemetry.
        function: function of one argument, which runs in a separate process in a real-time flight. The
            argument of the worker's function must be picklable. The result of the worker's function must
            consist of plain values, arrays of numbers, and dataclasses and enumerations from modules that the
            control process has imported.
        latency_ns: time (ns) from a job's submission to its result in a lock-step simulation.
        timeout_ns: longest execution time (ns) of a job in real time, after which the job is killed.
    """

    name: str
    function: Callable[[Any], Any]
    latency_ns: int
    timeout_ns: int


@dataclass(frozen=True, slots=True)
class JobResult:
    """The outcome of a job. The attribute `value` is the function's result if the outcome is "done"."""

    worker: str
    outcome: Outcome
    value: Any
    error: str
    submitted_ns: int
    delivered_ns: int
    execution_ns: int


class WorkerChange(Enum):
    """State change of a worker: its process ended, was restarted, or ended so often that restarts pause."""

    DIED = "died"
    READY = "ready"
    SPENT = "spent"


@dataclass(frozen=True, slots=True)
class WorkerNews:
    """State change of a worker process, with a text on the cause."""

    worker: str
    change: WorkerChange
    text: str


class JobRunner(Protocol):
    """Runs the jobs of several workers, at most one job at a time for each worker."""

    def submit(self, worker: str, argument: Any) -> bool:
        """Submit a job, and return False if the worker is busy or not running. Never waits."""

    def collect(self) -> list[JobResult]:
        """Return the results that have arrived since the last call. Never waits."""

    def news(self) -> list[WorkerNews]:
        """Return the changes of workers since the last call. Never waits."""

    @property
    def borrowed_ns(self) -> int:
        """Time (ns) spent on jobs in the calling thread; zero if jobs run in separate processes."""

    def close(self) -> None:
        """Stop the workers. Safe to call twice."""


class LockStepRunner:
    """Runs jobs in simulated time; implements JobRunner.

    Attributes:
        borrowed_ns: time (ns) spent on jobs in the calling thread.
    """

    def __init__(self, clock: Clock, workers: Sequence[Worker]) -> None:
        self._clock = clock
        self._workers = {worker.name: worker for worker in workers}
        self._pending: dict[str, JobResult] = {}
        self.borrowed_ns = 0

    def submit(self, worker: str, argument: Any) -> bool:
        """Run a job at once, and keep its result until the modelled latency has passed."""
        if worker in self._pending:
            return False
        spec = self._workers[worker]
        now_ns = self._clock.now_ns()
        begun = time.perf_counter_ns()
        outcome: Outcome = "done"
        value, error = None, ""
        try:
            value = spec.function(argument)
        except Exception as failure:  # noqa: BLE001 - containment boundary: the worker runner
            outcome, error = "failed", f"{type(failure).__name__}: {failure}"
        spent_ns = time.perf_counter_ns() - begun
        self.borrowed_ns += spent_ns
        self._pending[worker] = JobResult(
            worker, outcome, value, error, now_ns, now_ns + spec.latency_ns, spent_ns
        )
        return True

    def collect(self) -> list[JobResult]:
        """Return the results whose modelled latency has passed."""
        now_ns = self._clock.now_ns()
        ready = [result for result in self._pending.values() if result.delivered_ns <= now_ns]
        for result in ready:
            del self._pending[result.worker]
        return ready

    def news(self) -> list[WorkerNews]:
        """Return an empty list, because there are no processes that could die."""
        return []

    def close(self) -> None:
        """Discard pending results."""
        self._pending.clear()


@dataclass(frozen=True, slots=True)
class Cycle:
    """A cycle of a rate group: slot number, time (ns) at which it was due, and start time (ns)."""

    slot: int
    due_ns: int
    start_ns: int


Task = Callable[[Cycle], None]


class RateGroup:
    """A periodic task, its period, and the statistics of its cycles."""

    def __init__(self, name: str, period_ns: int, task: Task) -> None:
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
        self._slot = 0
        self._epoch_ns = 0

    def begin(self, epoch_ns: int) -> None:
        """Start the grid of slots, of which slot 0 is due at `epoch_ns`."""
        self._epoch_ns = epoch_ns
        self._slot = 0

    @property
    def due_ns(self) -> int:
        """Time (ns) at which the next slot is due."""
        return self._epoch_ns + self._slot * self.period_ns

    @property
    def mean_execution_ns(self) -> float:
        """Mean execution time (ns) of the task."""
        return self.total_execution_ns / self.cycles if self.cycles else 0.0

    def claim(self, now_ns: int) -> tuple[Cycle | None, int]:
        """Return the cycle to run now, or None if no slot is due, and the number of newly skipped slots."""
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
        """Record the execution time of a cycle and whether its task completed; return whether it overran."""
        self.cycles += 1
        self.completed += completed
        self.total_execution_ns += execution_ns
        self.max_execution_ns = max(self.max_execution_ns, execution_ns)
        overran = execution_ns > self.period_ns
        self.overruns += overran
        return overran


class Observer(Protocol):
    """Receives the executive's reports; its methods must be quick and must not raise exceptions."""

    def ran(self, group: RateGroup, cycle: Cycle, execution_ns: int) -> None:
        """Accept the report of a cycle that has ended."""

    def slipped(self, group: RateGroup, slots: int) -> None:
        """Accept the report of skipped slots."""

    def failed(self, group: RateGroup, error: Exception) -> None:
        """Accept the report of a task that raised an exception, and bring the devices into a safe state."""


class CyclicExecutive:
    """Runs rate groups. The function `stopwatch` returns times (ns) to measure execution times."""

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
        """Let `run` return after the current cycle. A signal handler may call this method."""
        self._stop = True

    def run(self, epoch_ns: int, until_ns: int) -> None:
        """Run all rate groups on the grid that starts at `epoch_ns`, until `until_ns`."""
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
