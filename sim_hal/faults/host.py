"""Faults inside the flight process: its workers, wall clock and disk, and the configuration file.

The application passes clock, workers and log files through this module only when a simulation requests such
faults. The wrappers apply each fault in its window of mission time, in lock-step and in real time.
"""

from __future__ import annotations

import dataclasses
import errno
import importlib
import os
import signal
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hal.interfaces.wires import Clock, Ticker
from sim_hal.faults.schedule import ScheduledFault, parse, schedule
from sim_hal.settings import Simulation


@dataclass(frozen=True, slots=True)
class Task:
    """A job: its function as MODULE:NAME, its argument, and its fault, empty for none."""

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
    """Return a value with every float replaced by NaN."""
    if isinstance(value, float):
        return float("nan")
    if isinstance(value, np.ndarray) and value.dtype.kind == "f":
        return np.full_like(value, np.nan)
    if isinstance(value, tuple) and type(value) is tuple:
        return tuple(map(without_numbers, value))
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        names = [field.name for field in dataclasses.fields(value) if field.init]
        return dataclasses.replace(value, **{name: without_numbers(getattr(value, name)) for name in names})
    return value


DEVICES = ("planner", "vision", "clock", "disk")


class HostFaults:
    """The faults of one flight process; dormant until `begin`."""

    def __init__(self, faults: Sequence[ScheduledFault], clock: Clock, realtime: bool) -> None:
        self._faults = [fault for fault in faults if fault.kind.device in DEVICES]
        self._clock = clock
        self._realtime = realtime
        self._epoch_ns: int | None = None

    def begin(self, epoch_ns: int) -> None:
        """Set mission time zero."""
        self._epoch_ns = epoch_ns

    def active(self, device: str) -> ScheduledFault | None:
        """Return the fault that a device has now."""
        if self._epoch_ns is None:
            return None
        now = (self._clock.now_ns() - self._epoch_ns) * 1e-9
        for fault in self._faults:
            if fault.kind.device == device and fault.at <= now < fault.end:
                return fault
        return None

    def concerns(self, *devices: str) -> bool:
        """Return whether any of these devices has a fault in this flight."""
        return any(fault.kind.device in devices for fault in self._faults)

    def clock(self) -> Clock:
        """Return the clock of the flight process, with its faults."""
        return _SteppedClock(self._clock, self) if self.concerns("clock") else self._clock

    def opener(self, opener: Callable[[Path], Any]) -> Callable[[Path], Any]:
        """Return an opener of files on a disk that may fail."""
        return (lambda path: _FailingFile(opener, path, self)) if self.concerns("disk") else opener

    def workers(self, specs: Sequence[Any]) -> list[Any]:
        """Return workers whose function may fail."""
        if not self.concerns("planner", "vision"):
            return list(specs)
        return [replace(spec, function=perform) for spec in specs]

    def jobs(self, runner: Any, specs: Sequence[Any], result: Callable[..., Any]) -> Any:
        """Return a runner that passes the faults on to the workers; `result` makes a job's result."""
        return _FaultyRunner(runner, specs, result, self) if self.concerns("planner", "vision") else runner

    @property
    def realtime(self) -> bool:
        """Whether jobs have processes of their own, which can hang and be killed."""
        return self._realtime

    def now_ns(self) -> int:
        """Return the flight's time."""
        return self._clock.now_ns()


def host_faults(section: Simulation, clock: Clock, realtime: bool) -> HostFaults | None:
    """Return the faults inside the flight process, None without any."""
    faults = schedule(section.faults)
    return HostFaults(faults, clock, realtime) if any(f.kind.device in DEVICES for f in faults) else None


def corrupted_by(faults: Sequence[str], text: str, seed: int | None) -> str:
    """Return a configuration's text after any `config: corrupted` among the faults."""
    for fault in map(parse, faults):
        if fault.kind.name == "config: corrupted":
            text = corrupted(text, round(fault.parameters["bytes"]), seed or 1)
    return text


def corrupted(text: str, count: int, seed: int) -> str:
    """Return a file's text with one bit flipped in each of `count` of its bytes."""
    data = bytearray(text.encode())
    rng = np.random.default_rng([seed, count, len(data)])
    for place in rng.choice(len(data), min(count, len(data)), replace=False):
        data[place] ^= 1 << int(rng.integers(8))
    return data.decode("utf-8", errors="replace")


class _SteppedClock:
    """A clock whose UTC label may step; its monotonic time is unchanged."""

    def __init__(self, clock: Clock, faults: HostFaults) -> None:
        self._clock = clock
        self._faults = faults

    def now_ns(self) -> int:
        return self._clock.now_ns()

    def sleep_until_ns(self, deadline_ns: int) -> None:
        self._clock.sleep_until_ns(deadline_ns)

    def ticker(self, name: str, period_ns: int, job: Callable[[], None]) -> Ticker:
        return self._clock.ticker(name, period_ns, job)

    @property
    def tickers(self) -> Sequence[Ticker]:
        return self._clock.tickers

    def utc_ns(self) -> int:
        fault = self._faults.active("clock")
        step = 0 if fault is None else round(fault.parameters["by"] * 1e9)
        return self._clock.utc_ns() + step


_DISK_ERRORS = {"full": errno.ENOSPC, "failing": errno.EIO}


class _FailingFile:
    """A file of the log on a disk that may be full."""

    def __init__(self, opener: Callable[[Path], Any], path: Path, faults: HostFaults) -> None:
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
            code = _DISK_ERRORS[fault.kind.kind]
            raise OSError(code, os.strerror(code))


@dataclass(slots=True)
class _Held:
    """A job that no worker will answer, and the outcome that its runner reports at `due_ns`."""

    due_ns: int
    outcome: str
    error: str
    submitted_ns: int


class _FaultyRunner:
    """A JobRunner that wraps another and adds faults."""

    def __init__(
        self, runner: Any, specs: Sequence[Any], result: Callable[..., Any], faults: HostFaults
    ) -> None:
        self._runner = runner
        self._specs = {spec.name: spec for spec in specs}
        self._result = result
        self._faults = faults
        self._held: dict[str, _Held] = {}
        self._late: list[tuple[int, Any]] = []

    def submit(self, worker: str, argument: Any) -> bool:
        if worker in self._held or any(result.worker == worker for _, result in self._late):
            return False
        fault = self._faults.active(worker)
        kind = "" if fault is None else fault.kind.kind
        delay = 0.0 if fault is None else fault.parameters.get("delay", 0.0)
        spec = self._specs[worker]
        if not self._faults.realtime:
            now_ns = self._faults.now_ns()
            # In lock-step this process runs the jobs itself, so the outcome is modelled.
            if kind == "endless":
                text = f"no result within {spec.timeout_ns * 1e-9:g} s"
                self._held[worker] = _Held(now_ns + spec.timeout_ns, "timed-out", text, now_ns)
                return True
            if kind == "killed":
                text = "the worker's process ended"
                self._held[worker] = _Held(now_ns + spec.latency_ns, "died", text, now_ns)
                return True
        function = f"{spec.function.__module__}:{spec.function.__qualname__}"
        sleeps = delay if self._faults.realtime else 0.0
        done: bool = self._runner.submit(worker, Task(function, argument, kind, sleeps))
        return done

    def collect(self) -> list[Any]:
        now_ns = self._faults.now_ns()
        for result in self._runner.collect():
            fault = self._faults.active(result.worker)
            slow = fault is not None and fault.kind.kind == "slow" and not self._faults.realtime
            delay = fault.parameters["delay"] if slow and fault is not None else 0.0
            self._late.append((now_ns + round(delay * 1e9), result))
        ready = [result for due_ns, result in self._late if due_ns <= now_ns]
        self._late = [(due_ns, result) for due_ns, result in self._late if due_ns > now_ns]
        for worker, held in list(self._held.items()):
            if held.due_ns <= now_ns:
                del self._held[worker]
                spent = now_ns - held.submitted_ns
                ready.append(
                    self._result(worker, held.outcome, None, held.error, held.submitted_ns, now_ns, spent)
                )
        return ready

    def __getattr__(self, name: str) -> Any:
        return getattr(self._runner, name)
