"""What a person watching a flight wants to see of it, once a second."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from flight.app.composition.tasks import LoopRooms
from flight.loop.executive.rate_group import RateGroup


@dataclass(frozen=True, slots=True)
class Progress:
    """Times in s, rates in rad/s, the current in A; None where there is no estimate."""

    mission_time: float
    duration: float
    target_q2: float
    q2: float | None
    rate: float | None
    current: float
    state: str
    slips: int
    events: int


def progress_of(
    rooms: LoopRooms, groups: Sequence[RateGroup], mission_time: float, duration: float, events: int
) -> Progress:
    """Return how the flight stands at a mission time; `events` were told until now."""
    estimate, target = rooms.control.estimate, rooms.control.target
    return Progress(
        mission_time,
        duration,
        target.q2 if target else 0.0,
        estimate.q2 if estimate else None,
        estimate.rate if estimate else None,
        float(rooms.steering.command[0]),
        rooms.steering.state.name.lower(),
        sum(group.slips for group in groups),
        events,
    )
