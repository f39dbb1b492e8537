"""Mission time zero: when a flight begins."""

from __future__ import annotations

from hal.interfaces.wires import SECOND_NS, Clock

_GRID_NS = 25_000_000


def next_whole_second(clock: Clock) -> int:
    """Return mission time zero in lock-step: the next whole second at least half a second ahead."""
    return -(-(clock.now_ns() + SECOND_NS // 2) // SECOND_NS) * SECOND_NS


def mission_zero(clock: Clock) -> int:
    """Return mission time zero in real time: the third next slot of the 40 Hz grid."""
    return (clock.now_ns() // _GRID_NS + 3) * _GRID_NS
