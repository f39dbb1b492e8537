"""A slew flown by the pointing law ends in its target and stays there, under torques known ahead."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.disturbance import pressures
from knightcube.astro.quaternion import angle_between, attitude_matrix
from knightcube.gnc.control import pointing_job
from knightcube.gnc.control.pointing_job import (
    FINE,
    SlewRequest,
    slew,
    slew_table,
)
from knightcube.gnc.control.pointing_law import PointingLaw
from knightcube.gnc.control.pointing_table import PointingPreview, PointingTable
from tests.knightcube.gnc.control.pointing_cases import (
    LIMIT,
    ORBIT,
    RESIDUAL,
    SIZE,
    STEP,
    WEIGHTS,
    pushed,
)
from tests.knightcube.gnc.control.pointing_requests import (
    AXES,
    BEGIN,
    NADIR,
    TIMES,
    WANTED,
    WISH,
)


def planned(sizes: FloatArray) -> PointingTable:
    """Plan with torques of these sizes (9,) N m."""
    begin = replace(BEGIN, sizes=sizes)
    path = slew(begin, WISH, NADIR, AXES, ORBIT, np.inf)
    assert path is not None
    field, position = ORBIT.field_at(TIMES), ORBIT.position_at(TIMES)
    expected = PointingPreview(WANTED, WANTED, field, position, pressures(ORBIT, TIMES), sizes)
    return slew_table(begin, path, RESIDUAL, NADIR, AXES, ORBIT, expected, WEIGHTS)


@pytest.fixture(scope="module")
def table() -> PointingTable:
    return planned(SIZE)


def flown(table: PointingTable, sizes: Callable[[float], FloatArray]) -> list[float]:
    """Return how far off the law, deg, a body under `SIZE` and `RESIDUAL` is after each step.

    `sizes` gives what is estimated of the torques at a time, s.
    """
    law, step = PointingLaw(table, LIMIT), STEP / FINE
    q, w = BEGIN.quaternion, BEGIN.rate
    off = []
    for time in table.path.times[:-1].tolist():
        at = np.array([time])
        field = attitude_matrix(q) @ ORBIT.field_at(at)[0]
        dipole = law.command(time, q, w, field, RESIDUAL, sizes(time)).dipole
        for part in range(2):
            at = np.array([time + 0.5 * step * part])
            q, w = pushed(q, w, attitude_matrix(q), at, dipole + RESIDUAL, 0.5 * step)
        off.append(float(np.degrees(angle_between(q, law.wanted(time + step).quaternion))))
    return off


def test_flown_under_torques_and_a_dipole_it_ends_in_its_target_and_stays(table: PointingTable) -> None:
    assert table.slew is not None
    off = flown(table, lambda _: SIZE)
    arrived = round(table.slew.horizon * FINE / STEP)
    assert off[0] > 50.0
    assert off[arrived] < 0.3
    assert max(off[arrived : arrived + 30]) < 1.0


def test_what_torques_not_known_at_the_begin_have_done_is_led_back_by_the_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    believed, ends = -9.0 * SIZE, []
    for end in (pointing_job.END, STEP / FINE):
        monkeypatch.setattr(pointing_job, "END", end)
        table = planned(believed)
        assert table.slew is not None
        learned = 0.35 * table.slew.horizon
        off = flown(table, lambda time, at=learned: SIZE if time > at else believed)  # type: ignore[misc]
        ends.append(off[round(table.slew.horizon * FINE / STEP) - 1])
    assert ends[0] < 2.0, "deg: the field of this orbit turns least"
    assert ends[0] < 0.65 * ends[1], "where the end is as dear as any other time"


def test_path_and_gains_go_on_after_the_slew_without_a_jump(table: PointingTable) -> None:
    steps = np.degrees(angle_between(table.path.quaternion[1:], table.path.quaternion[:-1]))
    assert steps.max() < 2.5
    assert len(table.gain) == len(table.dipole) == len(table.path.times) - 1 == FINE * BEGIN.kept
    assert table.slew is not None
    count = round(table.slew.horizon / (STEP / FINE))
    np.testing.assert_allclose(table.path.rate[count - 1], table.path.rate[count], atol=1e-4)


def test_a_body_that_would_turn_too_fast_slews_for_longer() -> None:
    free = slew(BEGIN, WISH, NADIR, AXES, ORBIT, np.inf)
    assert free is not None
    limit = 0.8 * float(np.linalg.norm(free.rate, axis=1).max())
    slow = slew(BEGIN, WISH, NADIR, AXES, ORBIT, limit)
    assert slow is not None
    assert slow.horizon > free.horizon
    assert float(np.linalg.norm(slow.rate, axis=1).max()) < limit


def test_a_body_within_a_cone_slews_out_of_it() -> None:
    q = BEGIN.quaternion
    sun = attitude_matrix(q) @ ORBIT.sun_at(TIMES[:1])[0]
    inside = SlewRequest(700.0, WISH.heat, RESIDUAL, sun, {"sun": 0.3})
    assert slew(BEGIN, inside, NADIR, AXES, ORBIT, np.inf) is not None


def test_a_body_within_one_cone_still_avoids_the_other() -> None:
    """The camera would cross the Sun halfway, and starts near the limb of the Earth."""
    free = slew(BEGIN, WISH, NADIR, AXES, ORBIT, np.inf)
    assert free is not None
    halfway = len(free.quaternion) // 2
    camera = attitude_matrix(free.quaternion[halfway]) @ ORBIT.sun_at(TIMES[:1])[0]
    angle = 0.2
    request = SlewRequest(700.0, WISH.heat, RESIDUAL, camera, {"sun": angle, "earth": 1.8})
    found = slew(BEGIN, request, NADIR, AXES, ORBIT, np.inf)
    assert found is not None
    for path, crosses in ((free, True), (found, False)):
        shown = attitude_matrix(path.quaternion) @ ORBIT.sun_at(TIMES[:1])[0]
        nearest = float(np.arccos(np.clip(shown @ camera, -1.0, 1.0)).min())
        assert (nearest < 0.9 * angle) == crosses
