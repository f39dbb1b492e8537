"""Tests that a body far from its path is damped and reported once, and that a plan waits until it is slow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flight.bodies.orbit.guidance import PointingPaths
from hal.interfaces.wires import SECOND_NS
from knightcube.gnc.control.pointing_table import PointingTable
from tests.flight.bodies.orbit.guidance_tables import AWAY, NADIR, NEAR, QUICK, STILL
from tests.knightcube.gnc.control.pointing_cases import LIMIT


def test_the_path_is_flown_until_the_body_is_far_off_and_again_with_a_new_plan(table: PointingTable) -> None:
    paths = PointingPaths(LIMIT, 0.1)
    assert not paths.offer(table, NADIR, 0)
    assert paths.led(NEAR, QUICK, SECOND_NS)
    assert not paths.led(AWAY, QUICK, 2 * SECOND_NS)
    assert not paths.led(NEAR, QUICK, 3 * SECOND_NS), "not led back from afar, though it came nearer"
    before = paths.astray.ready
    assert not paths.led(NEAR, STILL, 4 * SECOND_NS)
    assert (before, paths.astray.ready) == (False, True)
    assert not paths.offer(table, NADIR, 5 * SECOND_NS)
    assert paths.led(NEAR, STILL, 6 * SECOND_NS)


def test_a_refused_plan_leaves_the_body_held_still(table: PointingTable) -> None:
    paths = PointingPaths(LIMIT, 0.1)
    paths.offer(table, NADIR, 0)
    paths.led(AWAY, QUICK, SECOND_NS)
    assert paths.offer(replace(table, gain=np.full(table.gain.shape, np.nan)), NADIR, 2 * SECOND_NS)
    assert not paths.led(NEAR, STILL, 3 * SECOND_NS)
