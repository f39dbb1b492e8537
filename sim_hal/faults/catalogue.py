"""All faults by name."""

from __future__ import annotations

from sim_hal.faults.circuit import COILS
from sim_hal.faults.imaging import CAMERA
from sim_hal.faults.kinds import FaultKind, Where
from sim_hal.faults.machine import MACHINE
from sim_hal.faults.parts import BUS, MONITOR, PWM
from sim_hal.faults.serial import IMU

CATALOGUE: dict[str, FaultKind] = {
    kind.name: kind for kind in (*IMU, *PWM, *MONITOR, *BUS, *COILS, *CAMERA, *MACHINE)
}


def listing() -> str:
    """Return every fault with its parameters and meaning, a line each."""
    lines = []
    for kind in CATALOGUE.values():
        given = ", ".join(f"{name}={value:g}" for name, value in kind.parameters.items())
        name = f"{kind.name} ({given})" if given else kind.name
        only = "" if kind.where is Where.BOTH else f"; {kind.where.value}"
        lines.append(f"  {name:44} {kind.meaning}{only}")
    return "\n".join(lines)
