"""Faults of the computer: the flight process from outside; workers, wall clock and disk from inside."""

from __future__ import annotations

import os
import signal

from sim_hal.faults.bench import Bench, Lift, no_lift
from sim_hal.faults.kinds import FaultKind, Parameter, Parameters, Where, delay

_STEP = Parameter(3600.0, -3.2e8, 3.2e8, "s")
"""Ten years either way."""


def _killed(bench: Bench, _: Parameters) -> Lift:
    if bench.flight_process is not None:
        os.kill(bench.flight_process, signal.SIGKILL)
    return no_lift


def _stopped(bench: Bench, _: Parameters) -> Lift:
    process = bench.flight_process
    if process is None:
        return no_lift
    os.kill(process, signal.SIGSTOP)
    return lambda: os.kill(process, signal.SIGCONT)


def _worker(device: str) -> tuple[FaultKind, ...]:
    return (
        FaultKind(device, "nan", "all numbers of its result are NaN", None),
        FaultKind(device, "exception", "it raises an exception", None),
        FaultKind(device, "endless", "it never returns", None),
        FaultKind(device, "killed", "its process is killed during a job", None),
        FaultKind(device, "slow", "results arrive later, s", None, {"delay": delay(1.5)}),
    )


MACHINE = (
    *_worker("planner"),
    *_worker("vision"),
    FaultKind(
        "process", "killed", "kill -9 of the flight process", _killed, momentary=True, where=Where.REALTIME
    ),
    FaultKind("process", "stopped", "SIGSTOP of the flight process", _stopped, where=Where.REALTIME),
    FaultKind("clock", "stepped", "the wall clock steps forward, s", None, {"by": _STEP}),
    FaultKind("disk", "full", "the log cannot grow", None),
    FaultKind("disk", "failing", "every write of the log fails", None),
    FaultKind(
        "config",
        "corrupted",
        "one bit flips in each of `bytes` bytes of the file before it is read",
        None,
        {"bytes": Parameter(3.0, 1.0, 10000.0, whole=True)},
        momentary=True,
        where=Where.COMMAND_LINE,
    ),
)
