"""Faults of the coils and of the bridges that drive them."""

from __future__ import annotations

from sim_hal.faults.bench import Bench, Lift
from sim_hal.faults.kinds import Begin, FaultKind, Parameter, Parameters
from sim_hal.worlds.coil_circuit import Condition

_OHM = Parameter(5.0, 0.1, 1000.0, "ohm")
_COIL = (
    (Condition.OPEN, "open", "broken wire: no current"),
    (Condition.SHORTED, "shorted", "the bridge drives `ohm`, the coil carries no current"),
    (Condition.REVERSED, "reversed", "reversed polarity"),
)
_BRIDGE = (
    (Condition.A_HIGH, "a-high", "the output of input A stays high"),
    (Condition.A_LOW, "a-low", "the output of input A stays low"),
    (Condition.B_HIGH, "b-high", "the output of input B stays high"),
    (Condition.B_LOW, "b-low", "the output of input B stays low"),
)


def _broken(axis: int, condition: Condition) -> Begin:
    def begin(bench: Bench, given: Parameters) -> Lift:
        circuit = bench.hardware.circuit
        circuit.become(axis, condition, given.get("ohm", 0.0))
        return lambda: circuit.become(axis, Condition.SOUND)

    return begin


def _kinds() -> tuple[FaultKind, ...]:
    found = []
    for axis, letter in enumerate("xyz"):
        for condition, kind, meaning in _COIL:
            given = {"ohm": _OHM} if condition is Condition.SHORTED else {}
            found.append(FaultKind(f"coil-{letter}", kind, meaning, _broken(axis, condition), given))
        for condition, kind, meaning in _BRIDGE:
            found.append(FaultKind(f"bridge-{letter}", kind, meaning, _broken(axis, condition)))
    return tuple(found)


COILS = _kinds()
