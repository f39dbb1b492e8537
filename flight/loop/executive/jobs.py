"""Jobs outside the control loop: workers, results, the runner's interface, and the runner in lock-step.

The control thread submits a job and later collects the finished result; it never waits. There are two
runners: `LockStepRunner` in simulated time, and `worker_processes.ProcessRunner` in real time. In lock-step a
result arrives after the worker's modelled latency of simulated time. The job itself runs at once, in
`submit`, so that a flight is bit for bit the same on a busy machine.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any, Literal, Protocol

from hal.interfaces.wires import Clock

Outcome = Literal["done", "failed", "timed-out", "died"]


@dataclass(frozen=True, slots=True)
class Worker:
    """One kind of job: a function of one argument at the top level of a module.

    Attributes:
        name: short name for telemetry.
        function: runs in a process of its own in real time, so its argument must pickle, and its result be of
            plain values, arrays of numbers, and dataclasses and enumerations of modules that the control
            process has imported.
        latency_ns: delay of a result in lock-step simulation.
        timeout_ns: in real time, a job that runs for longer is killed.
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
    """What happened to a worker: its process ended, runs again, or died too often and rests."""

    DIED = "died"
    READY = "ready"
    SPENT = "spent"


@dataclass(frozen=True, slots=True)
class WorkerNews:
    """A change in a worker's life, and its circumstances."""

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
        """Return the changes in the workers' lives since the last call. Never waits."""

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

    def __init__(
        self, clock: Clock, workers: Sequence[Worker], stopwatch: Callable[[], int] = time.perf_counter_ns
    ) -> None:
        self._clock = clock
        self._workers = {worker.name: worker for worker in workers}
        self._stopwatch = stopwatch
        self._pending: dict[str, JobResult] = {}
        self.borrowed_ns = 0

    def submit(self, worker: str, argument: Any) -> bool:
        """Run the job and keep its result until its latency has passed."""
        if worker in self._pending:
            return False
        spec = self._workers[worker]
        now_ns = self._clock.now_ns()
        begun = self._stopwatch()
        outcome: Outcome = "done"
        value, error = None, ""
        try:
            value = spec.function(argument)
        except Exception as failure:  # noqa: BLE001 - containment boundary: the worker runner
            outcome, error = "failed", f"{type(failure).__name__}: {failure}"
        spent_ns = self._stopwatch() - begun
        self.borrowed_ns += spent_ns
        self._pending[worker] = JobResult(
            worker, outcome, value, error, now_ns, now_ns + spec.latency_ns, spent_ns
        )
        return True

    def collect(self) -> list[JobResult]:
        """Return the results whose latency has passed."""
        now_ns = self._clock.now_ns()
        ready = [result for result in self._pending.values() if result.delivered_ns <= now_ns]
        for result in ready:
            del self._pending[result.worker]
        return ready

    def news(self) -> list[WorkerNews]:
        """Return nothing: there are no processes that could die."""
        return []

    def close(self) -> None:
        """Discard pending results."""
        self._pending.clear()
