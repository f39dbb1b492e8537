"""Puts the faults of a flight on the time line of the emulated devices."""

from __future__ import annotations

from collections.abc import Sequence

from flight.schema.sections import Config
from knightcube.errors import UsageError
from sim_hal.faults.bench import Bench, Lift
from sim_hal.faults.grammar import ScheduledFault, schedule
from sim_hal.faults.kinds import Where
from sim_hal.settings import FaultEntry

_SECTIONS = {
    "camera": "camera",
    "vision": "camera",
    "monitor": "power_monitor",
    "gps": "gps",
    "strings": "solar_strings",
    "wide": "wide_cameras",
}
"""The optional configuration section of each device that can be absent."""


def scheduled(entries: Sequence[FaultEntry], realtime: bool) -> tuple[ScheduledFault, ...]:
    """Read a section's faults for this kind of simulation. Raises UsageError for an impossible fault."""
    faults = schedule(entries)
    for fault in faults:
        if fault.kind.where is Where.REALTIME and not realtime:
            raise UsageError(f"fault {str(fault)!r}: makes sense in real time only: add --realtime")
        if fault.kind.where is Where.COMMAND_LINE:
            raise UsageError(f"fault {str(fault)!r}: give it with --fault; a file cannot corrupt itself")
    _check_apart(faults)
    return faults


def check(entries: Sequence[FaultEntry], config: Config, realtime: bool) -> tuple[ScheduledFault, ...]:
    """Read the faults of a flight of `config`. Raises UsageError for a fault without effect."""
    faults = scheduled(entries, realtime)
    for fault in faults:
        if fault.at >= config.duration:
            raise UsageError(
                f"fault {str(fault)!r}: the flight is over after {config.duration:g} s: "
                "begin it earlier, or fly longer (--duration)"
            )
        section = _SECTIONS.get(fault.kind.device)
        if not fitted(fault.kind.device, config):
            cure = f"the configuration needs a `{section}` section" if section else "the body plans no paths"
            raise UsageError(f"fault {str(fault)!r}: no {fault.kind.device} flies here: {cure}")
        if fault.kind.name == "imu: baud" and fault.parameters["rate"] == config.inertial_unit.baud_rate:
            raise UsageError(f"fault {str(fault)!r}: it speaks at this speed already: give another rate")
    return faults


def fitted(device: str, config: Config) -> bool:
    """Return whether a configuration has the device of a fault."""
    if device == "planner":
        return config.replan_period() is not None
    section = _SECTIONS.get(device)
    return section is None or getattr(config, section) not in (None, ())


def _check_apart(faults: Sequence[ScheduledFault]) -> None:
    """Raise UsageError for two faults that would replace each other."""
    alone = [fault for fault in faults if not fault.kind.adds]
    for number, fault in enumerate(alone):
        for other in alone[:number]:
            if fault.kind.thing == other.kind.thing and _meet(fault, other):
                raise UsageError(
                    f"fault {str(fault)!r} would take the place of {str(other)!r}: "
                    "let one end (`for`) before the other begins"
                )


def _meet(fault: ScheduledFault, other: ScheduledFault) -> bool:
    first, second = sorted((fault, other), key=lambda one: one.at)
    return second.at < first.end or second.at == first.at


def put(faults: Sequence[ScheduledFault], bench: Bench, epoch_ns: int) -> None:
    """Schedule the beginning and end of each fault, relative to `epoch_ns`."""
    for fault in faults:
        _put(fault, bench, epoch_ns)


def _put(fault: ScheduledFault, bench: Bench, epoch_ns: int) -> None:
    begin = fault.kind.begin
    if begin is None:
        return
    lifts: list[Lift] = []
    timeline = bench.hardware.faults
    begin_ns = epoch_ns + round(fault.at * 1e9)
    timeline.at(begin_ns, lambda: lifts.append(begin(bench, fault.parameters)))
    if fault.span is not None and not fault.kind.momentary:
        # The function that removes the fault exists only after the fault has begun.
        timeline.at(begin_ns + round(fault.span * 1e9), lambda: lifts.pop()())  # noqa: PLW0108 - see above
