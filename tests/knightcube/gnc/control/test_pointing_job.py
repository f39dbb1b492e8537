"""Tests that a slew under known torques ends at its target, and that the body stays at the target."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.orbit_knowledge import OrbitState
from knightcube.astro.quaternion import angle_between, attitude_matrix, from_rotation_vector, multiply
from knightcube.gnc.control import pointing_job
from knightcube.gnc.control.coil_map import CoilMap, allocate
from knightcube.gnc.control.pointing_job import (
    FINE,
    LEAD,
    PointingJob,
    RunningSlew,
    SlewRequest,
    slew,
)
from knightcube.gnc.control.pointing_law import PointingLaw
from knightcube.gnc.control.pointing_table import PointingTable
from knightcube.gnc.guidance.attitude_law import references
from knightcube.gnc.guidance.slew_model import cones
from tests.knightcube.gnc.control.pointing_cases import (
    INERTIA,
    LAW,
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
    WISH,
    planned,
)


@pytest.fixture(scope="module")
def table() -> PointingTable:
    return planned(SIZE)


def flown(table: PointingTable, sizes: Callable[[float], FloatArray]) -> list[float]:
    """Return the pointing error (deg) after each step of a body under the torques `SIZE` and `RESIDUAL`.

    The function `sizes` returns the estimated torque coefficients at a time (s).
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


def test_the_effect_of_initially_unknown_torques_is_removed_by_the_end(
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


@pytest.mark.parametrize("isolated", range(3))
def test_a_slew_with_an_isolated_coil_is_made_by_the_other_two_within_their_limits(isolated: int) -> None:
    coils = CoilMap(np.eye(3), np.full(3, LIMIT), np.full(3, 5.0))
    usable = np.arange(3) != isolated
    left = coils.working(usable, 0.03)
    wish = replace(WISH, heat=left.heat, limit=left.limits)
    path = slew(BEGIN, wish, NADIR, AXES, ORBIT, np.inf)
    assert path is not None
    law = references(LAW, ORBIT, np.array([TIMES[0] + path.horizon]))
    assert angle_between(path.quaternion[-1], law.quaternion[0]) < 1e-3
    inertial = ORBIT.field_at(TIMES[0] + path.times)
    field = np.einsum("nij,nj->ni", attitude_matrix(path.quaternion), inertial)
    torques = np.cross(path.dipole, field)
    made = [
        allocate(torque, direction, coils.dipoles, np.full(3, LIMIT), usable.astype(float))
        for torque, direction in zip(torques, field, strict=True)
    ]
    currents = np.array([found.currents for found in made])
    assert np.abs(currents).max() < LIMIT
    missed = np.linalg.norm(torques - [found.torque for found in made], axis=1)
    assert missed.sum() < 0.05 * np.linalg.norm(torques, axis=1).sum()
    # The heat of the plan is computed for the remaining coils.
    heat = 5.0 * float((currents**2).sum(axis=1).mean()) * path.horizon
    assert heat < 1.2 * path.heat(left.heat)


def test_both_planners_of_slews_find_paths_of_equal_heat() -> None:
    paths = [
        slew(BEGIN, replace(WISH, planner=planner), NADIR, AXES, ORBIT, np.inf)
        for planner in ("collocation", "vmc")
    ]
    heats = [path.heat(WISH.heat) for path in paths if path is not None]
    assert heats[1] == pytest.approx(heats[0], rel=0.01)


def test_a_body_within_a_cone_slews_out_of_it() -> None:
    q = BEGIN.quaternion
    sun = attitude_matrix(q) @ ORBIT.sun_at(TIMES[:1])[0]
    inside = SlewRequest(700.0, WISH.heat, RESIDUAL, sun, {"sun": 0.3})
    path = slew(BEGIN, inside, NADIR, AXES, ORBIT, np.inf)
    assert path is not None
    shown = attitude_matrix(path.quaternion) @ ORBIT.sun_at(TIMES[:1])[0]
    apart = np.arccos(np.clip(shown @ sun, -1.0, 1.0))
    assert apart[0] < 1e-3
    assert apart[np.argmax(apart > 0.3) :].min() > 0.29, "the camera does not enter the cone again"


def test_a_body_within_one_cone_still_avoids_the_other() -> None:
    """A slew that begins within the cone of the Earth's limb still avoids the cone of the Sun.

    On the direct path, the camera would cross the Sun halfway.
    """
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


def rest_of(table: PointingTable, since: float, q: FloatArray, w: FloatArray) -> PointingTable | None:
    """Return a new plan for the rest of a slew, from an estimate `since` s after the start of the slew."""
    assert table.slew is not None
    ahead = replace(ORBIT, times=ORBIT.times - STEP - since)
    at = np.zeros(1)
    orbit = OrbitState(ahead.julian_date, ahead.position_at(at)[0], ahead.velocity_at(at)[0], 0.0)
    job = PointingJob(1, 0, orbit, INERTIA, AXES, WEIGHTS, NADIR, q, w, SIZE, LIMIT, BEGIN.areas, WISH)
    with patch.object(pointing_job, "predict", lambda *_: ahead):
        return pointing_job.run(replace(job, running=RunningSlew(table.slew, since)))


def test_the_rest_of_a_slew_begins_where_the_body_will_be_and_arrives_at_the_same_time(
    table: PointingTable,
) -> None:
    """The new plan begins at the state after `LEAD` s and ends at the same time as the current path.

    The body is 0.04 deg away from its current path.
    """
    path = table.slew
    assert path is not None
    since = path.horizon / 3.0
    there = path.references(np.array([since, since + LEAD]))
    off = from_rotation_vector(np.radians([0.02, -0.02, 0.03]))
    rest = rest_of(table, since, multiply(off, there.quaternion[0]), attitude_matrix(off) @ there.rate[0])
    assert rest is not None
    assert rest.slew is not None
    begun = multiply(off, there.quaternion[1])
    assert np.degrees(angle_between(rest.path.quaternion[0], begun)) < 1e-3
    np.testing.assert_allclose(rest.path.rate[0], attitude_matrix(off) @ there.rate[1], atol=1e-7)
    assert rest.path.times[0] == LEAD
    assert since + LEAD + rest.slew.horizon == pytest.approx(path.horizon)
    assert np.degrees(angle_between(rest.slew.quaternion[-1], path.quaternion[-1])) < 0.1
    after = rest.path.times[-1] - LEAD - rest.slew.horizon
    assert after == pytest.approx(pointing_job.TAIL, abs=STEP)


def test_on_a_known_body_the_rest_is_the_rest_of_the_running_plan(table: PointingTable) -> None:
    path = table.slew
    assert path is not None
    for share in (0.2, 0.5):
        there = path.references(np.array([share * path.horizon]))
        rest = rest_of(table, share * path.horizon, there.quaternion[0], there.rate[0])
        assert rest is not None
        assert rest.slew is not None
        running = path.since(share * path.horizon + LEAD, 24)
        assert rest.slew.heat(WISH.heat) < 1.005 * running.heat(WISH.heat)
        assert np.abs(rest.slew.dipole[0] - running.dipole[0]).max() < 0.01 * LIMIT, "no jump of the current"


def test_a_rest_that_costs_far_more_heat_is_not_flown(table: PointingTable) -> None:
    """A new plan that needs several times the heat of the current path is not used.

    Near the end of a slew, a correction of 3 deg would need several times the heat.
    """
    assert table.slew is not None
    since = 0.8 * table.slew.horizon
    there = table.slew.references(np.array([since]))
    away = multiply(from_rotation_vector(np.radians([3.0, 0.0, 0.0])), there.quaternion[0])
    assert rest_of(table, since, there.quaternion[0], there.rate[0]) is not None
    assert rest_of(table, since, away, there.rate[0]) is None


def test_a_rest_goes_no_deeper_into_a_cone_than_the_running_path(table: PointingTable) -> None:
    """A new plan goes no deeper into a cone than the current path does.

    The current path was planned without this cone, and crosses the Sun halfway.
    """
    path = table.slew
    assert path is not None
    halfway = path.references(np.array([0.5 * path.horizon])).quaternion[0]
    camera = attitude_matrix(halfway) @ ORBIT.sun_at(np.array([STEP]))[0]
    (sun,) = cones(ORBIT, STEP, camera, sun=0.2)
    narrowed = pointing_job._narrowed(sun, path, path.quaternion[0])
    assert narrowed.angle < 0.01
    assert float(narrowed.clearance(path.quaternion, path.times).min()) >= 0.0
    late = path.since(0.9 * path.horizon, 4)
    beyond = replace(sun, angle=0.01)
    assert pointing_job._narrowed(beyond, late, late.quaternion[0]) is beyond
