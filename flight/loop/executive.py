"""The executive runs rate groups on an injected clock; job runners run jobs outside its thread.

Each rate group has a fixed grid of time slots. Rate groups run in order of their due times, one at a time. A
slot that is less than half a period late is run; a later slot is skipped and counted. Two cycles of a group
are therefore never closer than half a period, and there is no burst of catch-up cycles. The number of slots
run and skipped always equals the number of slots elapsed.

Groups are given in order of importance. Of several groups that are due at the same time, the first one runs
first. The executive's task runner is one of the named containment boundaries: an exception of a task is
reported, and the loop continues.

The control thread submits a job and later collects the finished result; it never waits. In lock-step
simulation `LockStepRunner` runs the job at once, in `submit`, and delivers the result after the worker's
modelled latency of simulated time, so that the result of a flight does not depend on the speed of the
machine. In real time `flight.loop.worker_processes.ProcessRunner` runs jobs in processes.
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
    """One kind of job: a function of one argument at the top level of a module.

    Attributes:
        name: short name for telemetry.
        function: function that runs in a process of its own in real time. Its argument must be picklable. Its
            result must consist of plain values, arrays of numbers, and dataclasses and enumerations of
            modules that the control process has imported.
        latency_ns: delay (ns) of a result in lock-step simulation.
        timeout_ns: longest execution time (ns) of a job in real time; a job that runs longer is killed.
    """

    name: str
    function: Callable[[Any], Any]
    latency_ns: int
    timeout_ns: int


@dataclass(frozen=True, slots=True)
class JobResult:
    """The outcome of a job. `value` is the function's result when the outcome is "done"."""

    worker: str
    outcome: Outcome
    value: Any
    error: str
    submitted_ns: int
    delivered_ns: int
    execution_ns: int


class WorkerChange(Enum):
    """A change of a worker: its process died, was restarted, or died so often that restarts pause."""

    DIED = "died"
    READY = "ready"
    SPENT = "spent"


@dataclass(frozen=True, slots=True)
class WorkerNews:
    """A change of a worker, and its circumstances."""

    worker: str
    change: WorkerChange
    text: str


class JobRunner(Protocol):
    """Runs the jobs of several workers, at most one at a time for each."""

    def submit(self, worker: str, argument: Any) -> bool:
        """Submit a job; return False when that worker is busy or not running. Never waits."""

    def collect(self) -> list[JobResult]:
        """Return the results that have arrived. Never waits."""

    def news(self) -> list[WorkerNews]:
        """Return the changes of the workers since the last call. Never waits."""

    @property
    def borrowed_ns(self) -> int:
        """Time spent on jobs in the calling thread; zero for jobs in processes of their own."""

    def close(self) -> None:
        """Stop the workers. Safe to call twice."""


class LockStepRunner:
    """A JobRunner on simulated time.

    Attributes:
        borrowed_ns: time spent on jobs in the calling thread.
    """

    def __init__(self, clock: Clock, workers: Sequence[Worker]) -> None:
        self._clock = clock
        self._workers = {worker.name: worker for worker in workers}
        self._pending: dict[str, JobResult] = {}
        self.borrowed_ns = 0

    def submit(self, worker: str, argument: Any) -> bool:
        """Run the job and keep its result until its latency has passed."""
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
    """One cycle of a rate group: number of its slot, time at which it was due, and time of its start (ns)."""

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
        """Start the grid, whose slot 0 is due at the epoch."""
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
        """Return the cycle to run now, None if no slot is due, and the number of newly skipped slots."""
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
    """Receives the executive's reports; its methods must be quick and must not raise."""

    def ran(self, group: RateGroup, cycle: Cycle, execution_ns: int) -> None:
        """Report a cycle that ended."""

    def slipped(self, group: RateGroup, slots: int) -> None:
        """Report slots that were skipped."""

    def failed(self, group: RateGroup, error: Exception) -> None:
        """Report that a task raised an exception, and bring the devices to a safe state."""


class CyclicExecutive:
    """Runs rate groups; `stopwatch` measures their execution times, for telemetry only."""

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
        """Let the running cycle end, then return from `run`. A signal handler may call this method."""
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
