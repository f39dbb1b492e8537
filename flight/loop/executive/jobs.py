"""Jobs outside the control loop: workers, their results, and the runner's interface.

The control thread submits a job and later collects the finished result; it never waits. There are two
runners: `lockstep.LockStepRunner` in simulated time and `supervisor.ProcessRunner` in real time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Any, Literal, Protocol

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


class Change(Enum):
    """What happened to a worker: its process ended, runs again, or died too often and rests."""

    DIED = "died"
    READY = "ready"
    SPENT = "spent"


@dataclass(frozen=True, slots=True)
class WorkerNews:
    """A change in a worker's life, and its circumstances."""

    worker: str
    change: Change
    text: str


class JobRunner(Protocol):
    """Runs the jobs of several workers, at most one at a time for each."""

    def submit(self, worker: str, argument: Any) -> bool:
        """Submit a job; return False when that worker is busy or not running. Never waits."""

    def collect(self) -> list[JobResult]:
        """Return the results that have arrived. Never waits."""

    def news(self) -> list[WorkerNews]:
        """Return what happened to the workers since the last call. Never waits."""

    @property
    def borrowed_ns(self) -> int:
        """Time spent on jobs in the calling thread; zero for jobs in processes of their own."""

    def close(self) -> None:
        """Stop the workers. Safe to call twice."""
