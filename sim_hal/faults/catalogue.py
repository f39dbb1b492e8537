"""All faults by name."""

from __future__ import annotations

from sim_hal.faults.circuit import COILS
from sim_hal.faults.imaging import CAMERA
from sim_hal.faults.kinds import FaultKind, Parameter, Where
from sim_hal.faults.machine import MACHINE
from sim_hal.faults.orbit import GPS, STRINGS, WIDE
from sim_hal.faults.parts import BUS, MONITOR, PWM
from sim_hal.faults.serial import IMU, MAGNETOMETER
from sim_hal.faults.upsets import IMU_UPSET, MONITOR_UPSET, PWM_UPSET

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
