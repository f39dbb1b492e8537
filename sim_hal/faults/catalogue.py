"""All faults by name, and the faults of the computer: flight process, workers, wall clock, disk."""

from __future__ import annotations

import os
import signal

from sim_hal.faults.bench import Bench, FaultKind, Lift, Parameter, Parameters, Where, delay, no_lift
from sim_hal.faults.bus_faults import BUS, COILS, IMU_UPSET, MONITOR, MONITOR_UPSET, PWM, PWM_UPSET
from sim_hal.faults.sensor_faults import CAMERA, GPS, IMU, MAGNETOMETER, STRINGS, WIDE

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


_ALL = (
    *IMU,
    IMU_UPSET,
    *MAGNETOMETER,
    *PWM,
    PWM_UPSET,
    *MONITOR,
    MONITOR_UPSET,
    *BUS,
    *COILS,
    *CAMERA,
    *GPS,
    *STRINGS,
    *WIDE,
    *MACHINE,
)

CATALOGUE: dict[str, FaultKind] = {kind.name: kind for kind in _ALL}


def listing() -> str:
    """Return every fault with its parameters and meaning, a line each."""
    lines = []
    for kind in CATALOGUE.values():
        given = ", ".join(_written(name, parameter) for name, parameter in kind.parameters.items())
        name = f"{kind.name} ({given})" if given else kind.name
        only = "" if kind.where is Where.BOTH else f"; {kind.where.value}"
        bounds = "".join(f"; {name} {parameter.bounds()}" for name, parameter in kind.parameters.items())
        lines.append(f"  {name:44} {kind.meaning}{bounds}{only}")
    return "\n".join(lines)


def _written(name: str, parameter: Parameter) -> str:
    return f"{name}=drawn" if parameter.default is None else f"{name}={parameter.default:g}"
