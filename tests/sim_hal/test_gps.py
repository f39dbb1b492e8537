"""The solution of the emulated GPS receiver with and without satellites."""

from __future__ import annotations

from hal.interfaces.wires import SECOND_NS
from tests.hal.gps.bench_line import bench


def test_without_satellites_the_solution_is_zero_and_its_accuracy_unknown() -> None:
    gps = bench()
    gps.fly(2.0)
    found = gps.gps._measure(3 * SECOND_NS)
    assert (found.fix, found.satellites, found.horizontal, found.speed_accuracy) == (3, 11, 1, 1)
    gps.gps.blind = True
    empty = gps.gps._measure(4 * SECOND_NS)
    assert (empty.longitude, empty.latitude, empty.height, empty.velocity) == (0, 0, 0, (0, 0, 0))
    assert (empty.fix, empty.flags, empty.satellites) == (0, 0, 0)
    assert (empty.horizontal, empty.vertical, empty.speed_accuracy) == (2**32 - 1, 2**32 - 1, 20_000)
    assert empty.date[-1] == found.date[-1] + 1, "the clock goes on"
