"""Puts the faults of a flight on the time line of the emulated devices."""

from __future__ import annotations

from collections.abc import Sequence

from flight.errors import UsageError
from sim_hal.faults.bench import Bench, Lift
from sim_hal.faults.grammar import ScheduledFault, schedule
from sim_hal.faults.kinds import Where
from sim_hal.settings import FaultEntry


def scheduled(entries: Sequence[FaultEntry], realtime: bool) -> tuple[ScheduledFault, ...]:
    """Read the faults of a section for this kind of simulation. Raises UsageError for what makes no sense."""
    faults = schedule(entries)
    for fault in faults:
        if fault.kind.where is Where.REALTIME and not realtime:
            raise UsageError(f"fault {str(fault)!r}: makes sense in real time only: add --realtime")
        if fault.kind.where is Where.COMMAND_LINE:
            raise UsageError(f"fault {str(fault)!r}: give it with --fault; a file cannot corrupt itself")
    return faults


def put(faults: Sequence[ScheduledFault], bench: Bench, epoch_ns: int) -> None:
    """Have each fault begin and end at its time after `epoch_ns`."""
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
        # What mends it is known only once it has begun.
        timeline.at(begin_ns + round(fault.span * 1e9), lambda: lifts.pop()())  # noqa: PLW0108 - see above
