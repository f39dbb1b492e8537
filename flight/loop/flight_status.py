"""What a flight reports about itself: its label at the start, its progress, and its state at the end."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field

from flight import __version__
from flight.link.events import EventKind, Severity
from flight.link.telemetry.definitions import RUN
from flight.link.telemetry.log import Recorder
from flight.loop.fdir.facts import COIL_X_BROKEN, COIL_Y_BROKEN, COIL_Z_BROKEN, Facts
from flight.schema.sections import Config
from hal.interfaces.devices import CoilState


@dataclass(frozen=True, slots=True)
class RunLabel:
    """The properties of a run."""

    config_text: str
    seed: int
    simulated: bool
    realtime: bool


def record_run(
    recorder: Recorder, config: Config, label: RunLabel, epoch_ns: int, utc_ns: int, period_ns: int
) -> None:
    """Record the run that begins at `epoch_ns`, UTC `utc_ns`; `period_ns` is the control period."""
    coils = config.coils
    recorder.record(
        RUN,
        epoch_ns,
        config_name=config.name,
        config_crc=zlib.crc32(label.config_text.encode()),
        software=__version__,
        seed=label.seed,
        utc_ns=utc_ns,
        simulated=int(label.simulated),
        realtime=int(label.realtime),
        control_period_ns=period_ns,
        duration=config.duration,
        coil_resistance=list(coils.resistance),
        supply_voltage=coils.supply_voltage,
        current_limit=coils.current_limit,
    )


@dataclass(frozen=True, slots=True)
class FlightProgress:
    """Times in s, currents (3,) in A; `attitude` is the body's text of target and attitude."""

    mission_time: float
    duration: float
    attitude: str
    currents: tuple[float, float, float]
    state: str
    slips: int
    events: int


_BROKEN = {"x": COIL_X_BROKEN, "y": COIL_Y_BROKEN, "z": COIL_Z_BROKEN}


@dataclass(frozen=True, slots=True)
class FlightEnding:
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
) -> FlightEnding:
    """Return the ending of a loop; `counts` are those of its events."""

    def of(severity: Severity) -> dict[str, int]:
        return {kind.name: count for kind, count in counts.items() if kind.severity is severity}

    return FlightEnding(
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
