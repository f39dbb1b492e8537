"""Jobs in lock-step simulation: a result arrives after the worker's modelled latency of simulated time.

The job itself runs at once, in `submit`, so a flight is bit for bit the same on a busy machine.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

from flight.loop.executive.jobs import JobResult, Outcome, Worker, WorkerNews
from hal.interfaces.wires import Clock


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
