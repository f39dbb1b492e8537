"""Tests of the emulated GPS receiver's solution with and without satellites."""

from __future__ import annotations

import math

import numpy as np
import pytest

from hal.interfaces.wires import SECOND_NS
from sim_hal.emulators.gps import GpsErrors
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


@pytest.mark.parametrize("walk_time", [1.0, 4.0])
def test_the_walk_of_the_position_keeps_its_size_and_is_correlated_over_its_time(walk_time: float) -> None:
    errors = GpsErrors(walk=3.0, walk_time=walk_time, noise=0.0, velocity_noise=0.0)
    wandering, exact = bench(errors), bench()
    off = []
    for second in range(1, 501):
        wrong, right = (one.gps._measure(second * SECOND_NS) for one in (wandering, exact))
        off.append((wrong.height - right.height) * 1e-3)  # height error, m
    walk = np.array(off)
    correlation = float(walk[1:] @ walk[:-1] / (walk @ walk))
    assert correlation == pytest.approx(math.exp(-1.0 / walk_time), abs=0.12)
    assert float(np.sqrt(np.mean(walk**2))) == pytest.approx(3.0, rel=0.25)
