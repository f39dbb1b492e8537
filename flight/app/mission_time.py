"""Mission time zero: when the flight begins on its clock."""

from __future__ import annotations

from hal.interfaces.wires import SECOND_NS, Clock

_GRID_NS = 25_000_000


def next_whole_second(clock: Clock) -> int:
    """Return mission time zero in lock-step: the next whole second that is half a second away."""
    return -(-(clock.now_ns() + SECOND_NS // 2) // SECOND_NS) * SECOND_NS


def mission_zero(clock: Clock) -> int:
    """Return mission time zero in real time: soon, on the grid of 40 Hz."""
    return (clock.now_ns() // _GRID_NS + 3) * _GRID_NS
