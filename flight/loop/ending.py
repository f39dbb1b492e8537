"""The state in which a flight ended: what its summary says, of the loop itself and of no log."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from flight.link.events import EventKind, Severity
from flight.loop.fdir.facts import COIL_X_BROKEN, COIL_Y_BROKEN, COIL_Z_BROKEN, Facts
from hal.interfaces.readings import CoilState

_BROKEN = {"x": COIL_X_BROKEN, "y": COIL_Y_BROKEN, "z": COIL_Z_BROKEN}


@dataclass(frozen=True, slots=True)
class Ending:
    """How a flight stood when its loop ended.

    Attributes:
        mission_time: s.
        cycles: control cycles that were run to their end.
        mode: its label.
        alarms: names of the facts that held.
        faults: how often each event of severity fault came, those included that the log's throttle held back.
        warnings: the same of severity warning.
        coils_left_out: axes of coils that are not used any more.
        coils_at_zero: whether the driver's last write, acknowledged by the chip, was zero.
        coil_error: why the last write failed, empty when it did not.
    """

    mission_time: float = 0.0
    cycles: int = 0
    mode: str = "boot"
    alarms: tuple[str, ...] = ()
    faults: Mapping[str, int] = field(default_factory=dict)
    warnings: Mapping[str, int] = field(default_factory=dict)
    coils_left_out: tuple[str, ...] = ()
    coils_at_zero: bool = False
    coil_error: str = "the flight did not begin"


def ending(
    mission_time: float,
    cycles: int,
    mode: str,
    facts: Facts,
    counts: Mapping[EventKind, int],
    coils: CoilState,
) -> Ending:
    """Return the ending of a loop; `counts` are those of its events."""

    def of(severity: Severity) -> dict[str, int]:
        return {kind.name: count for kind, count in counts.items() if kind.severity is severity}

    return Ending(
        mission_time,
        cycles,
        mode,
        tuple(fact.name for fact in facts.held()),
        of(Severity.FAULT),
        of(Severity.WARNING),
        tuple(axis for axis, fact in _BROKEN.items() if facts.holds(fact)),
        not coils.error and not coils.current.any(),
        coils.error,
    )
