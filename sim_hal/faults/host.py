"""Faults inside the flight process, which affect workers, wall clock, disk and configuration file.

The flight application uses the wrappers in this module (clock, workers, log files) only if a simulation
requests such faults. The wrappers apply each fault during the fault's window of mission time, in lock-step
and in real time.
"""

from __future__ import annotations

import dataclasses
import errno
import importlib
import os
import signal
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from hal.interfaces.wires import Clock
from sim_hal.faults.schedule import ScheduledFault, parse, schedule
from sim_hal.settings import Simulation


@dataclass(frozen=True, slots=True)
class Task:
    """A worker's job: function as MODULE:NAME, argument, and name of the fault (empty if there is none)."""

    function: str
    argument: Any
    fault: str = ""
    delay: float = 0.0


def perform(task: Task) -> Any:
    """Run a job with its fault."""
    module, _, name = task.function.partition(":")
    if task.fault == "endless":
        while True:
            pass
    if task.fault == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    if task.fault == "exception":
        raise ArithmeticError("an injected defect of the worker")
    value = getattr(importlib.import_module(module), name)(task.argument)
    if task.fault == "slow":
        time.sleep(task.delay)
    return without_numbers(value) if task.fault == "nan" else value


def without_numbers(value: Any) -> Any:
    """Return a copy of `value` with every float replaced by NaN."""
    if isinstance(value, float):
        return float("nan")
    if isinstance(value, np.ndarray) and value.dtype.kind == "f":
        return np.full_like(value, np.nan)
    if type(value) is tuple:
        return tuple(map(without_numbers, value))
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        names = [field.name for field in dataclasses.fields(value) if field.init]
        return dataclasses.replace(value, **{name: without_numbers(getattr(value, name)) for name in names})
    return value


DEVICES = ("planner", "vision", "clock", "disk")
"""Names of the devices whose faults occur inside the flight process."""


class ProcessFaults:
    """Faults inside the flight process. In lock-step, a worker that hangs or is killed is only modelled."""

    def __init__(self, faults: Sequence[ScheduledFault], clock: Clock, realtime: bool) -> None:
        self._faults = [fault for fault in faults if fault.kind.device in DEVICES]
        self._clock = clock
        self._epoch_ns: int | None = None
        self.realtime = realtime
        self.now_ns = clock.now_ns

    def begin(self, epoch_ns: int) -> None:
        """Set mission time zero."""
        self._epoch_ns = epoch_ns

    def active(self, device: str) -> ScheduledFault | None:
        """Return the present fault of a device, or None."""
        if self._epoch_ns is None:
            return None
        now = (self.now_ns() - self._epoch_ns) * 1e-9
        for fault in self._faults:
            if fault.kind.device == device and fault.at <= now < fault.end:
                return fault
        return None

    def concerns(self, *devices: str) -> bool:
        """Return whether a fault of any device in `devices` is scheduled for the flight."""
        return any(fault.kind.device in devices for fault in self._faults)

    def clock(self) -> Clock:
        """Return the clock of the flight process, which includes the scheduled faults of the wall clock."""
        return cast("Clock", _SteppedClock(self._clock, self)) if self.concerns("clock") else self._clock

    def opener(self, opener: Callable[[Path], Any]) -> Callable[[Path], Any]:
        """Return a file opener that wraps `opener` and fails like a faulty disk during simulated faults."""
        return (lambda path: _FailingFile(opener, path, self)) if self.concerns("disk") else opener

    def workers(self, specs: Sequence[Any]) -> list[Any]:
        """Return copies of the worker specifications whose functions fail during simulated faults."""
        if not self.concerns("planner", "vision"):
            return list(specs)
        return [dataclasses.replace(spec, function=perform) for spec in specs]

    def jobs(self, runner: Any, specs: Sequence[Any], result: Callable[..., Any]) -> Any:
        """Return a job runner that passes the faults to the workers.

        The function `result` creates a job result.
        """
        return _FaultyRunner(runner, specs, result, self) if self.concerns("planner", "vision") else runner


def host_faults(section: Simulation, clock: Clock, realtime: bool) -> ProcessFaults | None:
    """Return the faults of a section that occur inside the flight process, or None if there are none."""
    faults = ProcessFaults(schedule(section.faults), clock, realtime)
    return faults if faults.concerns(*DEVICES) else None


def corrupted_by(faults: Sequence[str], text: str, seed: int | None) -> str:
    """Return the text of a configuration after applying each fault `config: corrupted` in `faults`."""
    for fault in map(parse, faults):
        if fault.kind.name == "config: corrupted":
            text = corrupted(text, round(fault.parameters["bytes"]), seed or 1)
    return text


def corrupted(text: str, count: int, seed: int) -> str:
    """Return the text of a file with one bit flipped in each of `count` random bytes."""
    data = bytearray(text.encode())
    rng = np.random.default_rng([seed, count, len(data)])
    for index in rng.choice(len(data), min(count, len(data)), replace=False):
        data[index] ^= 1 << int(rng.integers(8))
    return data.decode("utf-8", errors="replace")


class _SteppedClock:
    """A clock whose UTC may jump, while its monotonic time is unchanged."""

    def __init__(self, clock: Clock, faults: ProcessFaults) -> None:
        self._clock, self._faults = clock, faults

    def __getattr__(self, name: str) -> Any:
        return getattr(self._clock, name)

    def utc_ns(self) -> int:
        fault = self._faults.active("clock")
        return self._clock.utc_ns() + (0 if fault is None else round(fault.parameters["by"] * 1e9))


class _FailingFile:
    """A log file on a disk that may be full or failing."""

    def __init__(self, opener: Callable[[Path], Any], path: Path, faults: ProcessFaults) -> None:
        self._faults = faults
        self._check()
        self._file = opener(path)

    def write(self, data: Any) -> Any:
        self._check()
        return self._file.write(data)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)

    def _check(self) -> None:
        fault = self._faults.active("disk")
        if fault is not None:
            code = errno.ENOSPC if fault.kind.kind == "full" else errno.EIO
            raise OSError(code, os.strerror(code))


@dataclass(slots=True)
class _ModelledOutcome:
    """Simulated outcome of a job that does not answer; the job runner reports it at `due_ns`."""

    due_ns: int
    outcome: str
    error: str
    submitted_ns: int


class _FaultyRunner:
    """A JobRunner that wraps another JobRunner and adds faults."""

    def __init__(
        self, runner: Any, specs: Sequence[Any], result: Callable[..., Any], faults: ProcessFaults
    ) -> None:
        self._runner = runner
        self._specs = {spec.name: spec for spec in specs}
        self._result, self._faults = result, faults
        self._modelled: dict[str, _ModelledOutcome] = {}
        self._late: list[tuple[int, Any]] = []

    def submit(self, worker: str, argument: Any) -> bool:
        if worker in self._modelled or any(result.worker == worker for _, result in self._late):
            return False
        fault = self._faults.active(worker)
        kind = "" if fault is None else fault.kind.kind
        spec, now_ns, realtime = self._specs[worker], self._faults.now_ns(), self._faults.realtime
        # In lock-step the flight process runs the jobs itself, so a hung or killed worker is only imitated.
        if kind == "endless" and not realtime:
            text = f"no result within {spec.timeout_ns * 1e-9:g} s"
            self._modelled[worker] = _ModelledOutcome(now_ns + spec.timeout_ns, "timed-out", text, now_ns)
            return True
        if kind == "killed" and not realtime:
            text = "the worker's process ended"
            self._modelled[worker] = _ModelledOutcome(now_ns + spec.latency_ns, "died", text, now_ns)
            return True
        function = f"{spec.function.__module__}:{spec.function.__qualname__}"
        delay = fault.parameters.get("delay", 0.0) if fault is not None and realtime else 0.0
        done: bool = self._runner.submit(worker, Task(function, argument, kind, delay))
        return done

    def collect(self) -> list[Any]:
        now_ns = self._faults.now_ns()
        for result in self._runner.collect():
            fault, delay = self._faults.active(result.worker), 0.0
            if fault is not None and fault.kind.kind == "slow" and not self._faults.realtime:
                delay = fault.parameters["delay"]
            self._late.append((now_ns + round(delay * 1e9), result))
        ready = [result for due_ns, result in self._late if due_ns <= now_ns]
        self._late = [(due_ns, result) for due_ns, result in self._late if due_ns > now_ns]
        for worker, job in list(self._modelled.items()):
            if job.due_ns <= now_ns:
                del self._modelled[worker]
                times = job.submitted_ns, now_ns, now_ns - job.submitted_ns
                ready.append(self._result(worker, job.outcome, None, job.error, *times))
        return ready

    def __getattr__(self, name: str) -> Any:
        return getattr(self._runner, name)
