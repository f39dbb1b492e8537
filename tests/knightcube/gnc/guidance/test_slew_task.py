"""Tests of the parts of a slew task: paths, exclusion cones, end conditions, limits, and orbit laws."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import erfa
import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.figure import EARTH_RADIUS
from knightcube.astro.earth.orientation import terrestrial_time
from knightcube.astro.quaternion import angle_between, from_rotation_vector, multiply, normalise
from knightcube.errors import PlanningError
from knightcube.gnc.guidance.attitude_law import (
    AttitudeReferences,
    BodyAxes,
    following,
    law_of,
    passing,
    references,
)
from knightcube.gnc.guidance.pointing_target import Goal, PointingTarget
from knightcube.gnc.guidance.slew_model import (
    AttitudeEnd,
    BoresightEnd,
    Cone,
    ConeConstraints,
    EndConditions,
    SlewPath,
    blocking_cone,
    check,
    cones,
)
from tests.support.circular_orbits import RADIUS, circular
from tests.support.recorded_slews import matrix
from tests.support.small_slews import END_RATE, START, TARGET, small_slew

ORBIT = circular(3000.0)
X, Y, Z = np.eye(3)
SPIN = np.array([0.01, -0.02, 0.015])


def spinning(count: int = 9, horizon: float = 80.0) -> SlewPath:
    """Return the path of a body that rotates steadily, with dipoles that increase linearly."""
    times = np.linspace(0.0, horizon, count)
    attitude = multiply(from_rotation_vector(times[:, None] * SPIN), np.tile(START, (count, 1)))
    rates = np.tile(SPIN, (count, 1))
    dipoles = times[:, None] * np.array([1e-3, -2e-3, 3e-3])
    return SlewPath(times, attitude, rates, np.zeros((count, 3)), dipoles)


def test_a_path_is_interpolated_and_at_rest_outside_its_times() -> None:
    path = spinning()
    assert path.horizon == 80.0
    found = path.references(np.array([-1.0, 0.0, 33.3, 80.0, 81.0]))
    for k, time in enumerate((0.0, 0.0, 33.3, 80.0, 80.0)):
        assert angle_between(found.quaternion[k], multiply(from_rotation_vector(time * SPIN), START)) < 1e-5
    np.testing.assert_allclose(found.rate[1:4], np.tile(SPIN, (3, 1)), atol=1e-12)
    np.testing.assert_array_equal(found.rate[[0, 4]], 0.0)
    np.testing.assert_allclose(found.acceleration, 0.0, atol=1e-12)
    dipoles = path.dipoles(np.array([-0.1, 0.0, 33.3, 80.0, 80.1]))
    np.testing.assert_allclose(dipoles[:, 0], [0.0, 0.0, 0.0333, 0.08, 0.0])
    np.testing.assert_allclose(dipoles[2], 33.3 * np.array([1e-3, -2e-3, 3e-3]))


def test_the_heat_of_a_path_with_linear_dipoles_is_the_integral() -> None:
    weights = np.array([2.0, 3.0, 5.0])
    square = 2.0 * 1e-6 + 3.0 * 4e-6 + 5.0 * 9e-6
    assert spinning().heat(weights) == pytest.approx(square * 80.0**3 / 3.0)


def test_the_rest_of_a_path_begins_at_its_time() -> None:
    path = spinning()
    rest = path.since(30.0, 5)
    assert len(rest.times) == 11
    assert rest.times[0] == 0.0
    assert rest.horizon == pytest.approx(50.0)
    assert angle_between(rest.quaternion[0], multiply(from_rotation_vector(30.0 * SPIN), START)) < 1e-5
    assert angle_between(rest.quaternion[-1], path.quaternion[-1]) < 1e-9
    np.testing.assert_allclose(rest.dipole[0], 30.0 * np.array([1e-3, -2e-3, 3e-3]))
    np.testing.assert_allclose(rest.dipole[-1], path.dipole[-1])
    np.testing.assert_allclose(rest.rate, np.tile(SPIN, (11, 1)), atol=1e-9)


def test_the_clearance_of_a_cone_is_the_angle_beyond_its_half_angle() -> None:
    sun = normalise(np.array([0.3, 0.5, -0.8]))
    cone = Cone("Sun", Y, lambda times: np.tile(sun, (len(times), 1)), 0.4)
    q = np.array([START, TARGET])
    angles = np.array([math.acos(float(Y @ matrix(one) @ sun)) for one in q])
    np.testing.assert_allclose(cone.clearance(q, np.zeros(2)), angles - 0.4)
    np.testing.assert_allclose(cone.clearance(3.0 * q, np.zeros(2)), angles - 0.4)
    constraints = ConeConstraints((cone,), np.array([[0.0, 0.1]]), np.array([0.0, 1.0]))
    expected = np.cos([0.4, 0.5]) - np.cos(angles)
    np.testing.assert_allclose(constraints.values(q), [expected])
    step = 1e-6
    for k in range(4):
        shift = step * np.eye(4)[k]
        slope = (constraints.values(q + shift) - constraints.values(q - shift)) / (2.0 * step)
        np.testing.assert_allclose(constraints.slopes(q)[:, :, k], slope, atol=1e-8)
    assert constraints.count == 1


@pytest.mark.parametrize(
    "end", [AttitudeEnd(TARGET, END_RATE), BoresightEnd(Z, matrix(TARGET).T @ Z, END_RATE)]
)
def test_the_end_is_missed_by_the_error_of_attitude_and_rate(end: Any) -> None:
    """A small rotation from the end causes an error of half of its angle, or for a boresight of its sine."""
    scale = 100.0
    conditions = EndConditions(end, scale)
    whole = isinstance(end, AttitudeEnd)
    assert conditions.count == (6 if whole else 5)
    state = np.concatenate([TARGET, scale * matrix(TARGET) @ END_RATE])
    np.testing.assert_allclose(conditions.miss(state), 0.0, atol=1e-12)
    assert end.is_met(TARGET)
    turn = np.array([0.01, -0.02, 0.0])
    turned = np.concatenate([multiply(from_rotation_vector(turn), TARGET), state[4:]])
    missed = conditions.miss(turned)[:-3]
    size = 0.5 * np.linalg.norm(turn) if whole else np.linalg.norm(turn)
    assert np.linalg.norm(missed) == pytest.approx(size, rel=1e-3)
    roll = np.concatenate([multiply(from_rotation_vector(0.3 * Z), TARGET), state[4:]])
    assert np.linalg.norm(conditions.miss(roll)[:-3]) == pytest.approx(
        math.sin(0.15) if whole else 0.0, abs=1e-9
    )
    faster = state + np.concatenate([np.zeros(4), [0.1, 0.2, 0.3]])
    np.testing.assert_allclose(conditions.miss(faster)[-3:], [0.1, 0.2, 0.3])
    slopes, step, pull = conditions.slope(turned), 1e-6, np.arange(1.0, conditions.count + 1.0)
    for k in range(7):
        shift = step * np.eye(7)[k]
        rise = (conditions.miss(turned + shift) - conditions.miss(turned - shift)) / (2.0 * step)
        np.testing.assert_allclose(slopes[:, k], rise, atol=1e-7)
        if k < 4:
            bend = pull @ (conditions.slope(turned + shift) - conditions.slope(turned - shift)) / (2.0 * step)
            np.testing.assert_allclose(conditions.curvature(pull)[:, k], bend[:4], atol=1e-6)


def test_the_opposite_boresight_is_not_the_end() -> None:
    end = BoresightEnd(Z, -matrix(TARGET).T @ Z, np.zeros(3))
    np.testing.assert_allclose(EndConditions(end, 1.0).miss(np.append(TARGET, np.zeros(3))), 0.0, atol=1e-12)
    assert not end.is_met(TARGET)


def test_cones_of_an_orbit_point_to_sun_earth_and_moon_with_their_angles() -> None:
    sun, earth, moon = cones(ORBIT, 100.0, Y, sun=0.4, earth=0.2, moon=0.1)
    assert [cone.name for cone in (sun, earth, moon)] == ["Sun", "Earth", "Moon"]
    times = np.array([0.0, 50.0])
    np.testing.assert_allclose(sun.direction(times), np.tile(X, (2, 1)), atol=1e-4)
    down = -ORBIT.position_at(100.0 + times) / RADIUS
    np.testing.assert_allclose(earth.direction(times), down, atol=1e-9)
    for cone, angle in ((sun, 0.4), (earth, math.asin(EARTH_RADIUS / RADIUS) + 0.2), (moon, 0.1)):
        np.testing.assert_allclose(cone.half_angles(times), angle)
    towards = moon.direction(times)
    np.testing.assert_allclose(np.linalg.norm(towards, axis=1), 1.0)
    # From low orbits in opposite positions, the Moon has a parallax of about 2 deg.
    assert 1e-6 < np.linalg.norm(towards[1] - towards[0]) < 0.04
    assert abs(towards[0][2]) < math.sin(math.radians(29.0)), "the Moon is near the ecliptic"
    (only,) = cones(ORBIT, 0.0, Z, earth=0.0)
    assert only.axis is Z


def test_the_cone_of_the_earth_follows_the_limb_along_an_eccentric_orbit() -> None:
    """A satellite that approaches from 20,000 km to 500 km sees the Earth's limb grow from 14 to 68 deg."""
    times = np.linspace(0.0, 3000.0, 301)
    distance = EARTH_RADIUS + np.linspace(20e6, 500e3, 301)
    approaching = replace(ORBIT, times=times, position=distance[:, None] * X, velocity=np.zeros((301, 3)))
    (earth,) = cones(approaching, 0.0, X, earth=0.1)
    at = np.array([0.0, 1000.0, 2900.0])
    towards_space = 0.2
    limb = np.arcsin(EARTH_RADIUS / distance[[0, 100, 290]])
    turned = np.tile(from_rotation_vector(towards_space * Z), (3, 1))
    np.testing.assert_allclose(earth.clearance(turned, at), math.pi - towards_space - limb - 0.1, atol=1e-3)
    constraints = ConeConstraints((earth,), np.zeros(1), at)
    expected = np.cos(limb + 0.1) + math.cos(towards_space)
    np.testing.assert_allclose(constraints.values(turned), [expected], atol=1e-3)


def test_the_cone_of_the_moon_follows_the_moon_during_a_long_slew() -> None:
    """The Moon moves by 3 deg in six hours; the error of its direction is below 0.1 deg."""
    long = replace(
        ORBIT, times=np.array([0.0, 21_600.0]), position=np.zeros((2, 3)), velocity=np.zeros((2, 3))
    )
    (moon,) = cones(long, 0.0, X, moon=0.1)
    start, end = moon.direction(np.array([0.0, 21_600.0]))
    date = float(terrestrial_time(ORBIT.julian_date + 0.25))
    expected = normalise(np.asarray(erfa.moon98(date, 0.0)["p"]))
    assert math.acos(float(end @ expected)) < math.radians(0.1)
    assert math.acos(float(start @ end)) > math.radians(2.5)


def cone_about(q: FloatArray, angle: float) -> Cone:
    """Return a cone about the direction of the body axis x at an attitude."""
    towards = matrix(q).T @ X
    return Cone("Moon", X, lambda times: np.tile(towards, (len(times), 1)), angle)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"quaternion": START * (1.0 + 2e-6)}, "must have length 1"),
        ({"rate": np.array([0.0, np.inf, 0.0])}, "must be finite"),
        ({"limit": np.array([0.1, 0.0, 0.1])}, "all must be above zero"),
        ({"weights": np.array([1.0, 0.0, 1.0])}, "heating power of every dipole moment"),
        ({"weights": np.array([[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]])}, "heating power"),
        ({"inertia": np.diag([1.0, -1.0, 1.0])}, "positive definite"),
        ({"horizon": 0.99}, "horizon 0.99 s, longest 720 s: must satisfy 1 <="),
        ({"longest": 20_001.0}, "longest 20001 s"),
        ({"horizon": 721.0}, "must satisfy"),
        ({"nodes": 7}, "nodes is 7: must be 8 to 96"),
        ({"nodes": 97}, "nodes is 97"),
        ({"time_cost": 0.0}, "must be positive"),
        ({"time_cost": math.nan}, "must be positive"),
        (
            {"cones": (cone_about(START, 0.1),)},
            "the start lies 5.7 deg inside the exclusion cone of the Moon",
        ),
    ],
)
def test_a_task_of_wrong_values_is_refused(changes: dict[str, Any], message: str) -> None:
    task = small_slew()
    craft = {name: value for name, value in changes.items() if name in {"limit", "weights", "inertia"}}
    others = {name: value for name, value in changes.items() if name not in craft}
    check(task)
    with pytest.raises(PlanningError, match=message):
        check(replace(task, craft=replace(task.craft, **craft), **others))


@pytest.mark.parametrize("changes", [{"horizon": 1.0}, {"longest": 20_000.0}, {"nodes": 8}, {"nodes": 96}])
def test_values_at_the_limits_are_accepted(changes: dict[str, Any]) -> None:
    check(small_slew(**changes))


@pytest.mark.parametrize(("deep", "refused"), [(0.085, False), (0.089, True)])
def test_an_end_at_rest_deep_inside_a_cone_is_refused(deep: float, refused: bool) -> None:
    """An end more than 5 deg (0.0873 rad) inside a cone cannot be reached, unless the cone moves away."""
    still = AttitudeEnd(TARGET, np.zeros(3))
    task = small_slew(cones=(cone_about(TARGET, deep),), end=lambda _: still)
    moving = replace(task, end=lambda _: AttitudeEnd(TARGET, np.array([0.0, 2e-4, 0.0])))
    free = replace(task, end=lambda _: BoresightEnd(X, matrix(TARGET).T @ X, np.zeros(3)))
    check(moving)
    check(free)
    if refused:
        with pytest.raises(PlanningError, match="the end lies inside the exclusion cone of the Moon"):
            check(task)
    else:
        check(task)
    leaving = replace(task.cones[0], radius=lambda times: -1e-5 * times)
    check(replace(task, cones=(leaving,)))
    found = blocking_cone(task, 240.0)
    assert found is not None
    assert found.name == "Moon"
    # The camera's axis is the pointing axis, so the roll does not move it.
    assert blocking_cone(free, 240.0) is found
    (cone,) = free.cones
    for axis, blocked in ((np.array([0.0, 1.0, 0.0]), False), (np.array([1.0, 0.01, 0.0]), True)):
        beside = replace(free, cones=(replace(cone, axis=axis / np.linalg.norm(axis)),))
        assert (blocking_cone(beside, 240.0) is not None) is blocked
    assert blocking_cone(small_slew(cones=(cone_about(START, 0.1),)), 240.0) is None


def steady() -> AttitudeReferences:
    """Return references of a steady rotation every 10 s from 100 s on."""
    times = np.arange(100.0, 141.0, 10.0)
    attitude = multiply(from_rotation_vector((times - 100.0)[:, None] * SPIN), np.tile(START, (5, 1)))
    accelerations = times[:, None] * np.array([1e-6, 0.0, 0.0])
    return AttitudeReferences(times, attitude, np.tile(SPIN, (5, 1)), accelerations)


@pytest.mark.parametrize(
    ("time", "index", "share"),
    [(99.0, 0, 0.0), (100.0, 0, 0.0), (104.0, 0, 0.4), (127.5, 2, 0.75), (140.0, 3, 1.0), (150.0, 3, 1.0)],
)
def test_a_time_lies_in_an_interval_of_the_references(time: float, index: int, share: float) -> None:
    k, fraction = steady().position(time)
    assert k == index
    assert fraction == pytest.approx(share)
    found = steady().at(time)
    since = min(max(time, 100.0), 140.0) - 100.0
    expected = multiply(from_rotation_vector(since * SPIN), START)
    assert angle_between(found.quaternion, expected) < 2e-3, "the acceleration is for the nearest instant"
    np.testing.assert_allclose(found.rate, SPIN)
    np.testing.assert_allclose(found.acceleration, [1e-6 * (100.0 + since), 0.0, 0.0])


def test_references_are_cut_before_and_after() -> None:
    np.testing.assert_array_equal(steady().until(2).times, [100.0, 110.0])
    later = steady().since(3)
    np.testing.assert_array_equal(later.times, [130.0, 140.0])
    np.testing.assert_array_equal(later.quaternion, steady().quaternion[3:])
    np.testing.assert_array_equal(later.rate, steady().rate[3:])
    np.testing.assert_array_equal(later.acceleration, steady().acceleration[3:])


@pytest.mark.parametrize("roll", [0.0, 0.7])
@pytest.mark.parametrize(
    ("goal", "first", "second"),
    [
        (Goal.NADIR, "down", "ahead"),
        (Goal.VELOCITY, "ahead", "down"),
        (Goal.SUN, "sun", "pole"),
    ],
)
def test_a_target_points_its_axis_and_rolls_about_it(
    goal: Goal, first: str, second: str, roll: float
) -> None:
    times = np.array([500.0])
    position, velocity = ORBIT.position_at(times)[0], ORBIT.velocity_at(times)[0]
    directions = {
        "down": -normalise(position),
        "ahead": normalise(velocity),
        "sun": ORBIT.sun_at(times)[0],
        "pole": Z,
    }
    axes = BodyAxes(Y, Z)
    law = law_of(PointingTarget(goal, roll=roll), axes, START, ORBIT, 500.0)
    turned = matrix(law(ORBIT, times)[0])
    along, other = directions[first], directions[second]
    np.testing.assert_allclose(turned @ along, Y, atol=1e-9)
    rest = normalise(other - (other @ along) * along)
    # A body that is rotated by +roll about its axis sees a fixed direction rotated by -roll.
    across = math.cos(roll) * Z - math.sin(roll) * np.cross(Y, Z)
    np.testing.assert_allclose(turned @ rest, across, atol=1e-9)


def test_an_inertial_target_is_its_quaternion() -> None:
    target = PointingTarget(Goal.INERTIAL, tuple(TARGET.tolist()))
    found = law_of(target, BodyAxes(Y, Z), START, ORBIT, 0.0)(ORBIT, np.array([1.0, 2.0]))
    np.testing.assert_allclose(found, np.tile(TARGET, (2, 1)))


def test_an_object_is_followed_without_rotation_about_the_boresight() -> None:
    towards, velocity = normalise(np.array([0.2, 0.3, 0.9])), np.array([0.01, -0.004, 0.002])
    times = np.array([10.0, 15.0])
    seen = passing(towards, velocity, 10.0)(ORBIT, times)
    np.testing.assert_allclose(seen[0], towards)
    np.testing.assert_allclose(seen[1], normalise(towards + 5.0 * velocity))
    law = following(Y, towards, velocity, 10.0, START)
    found = references(law.attitudes, ORBIT, times)
    for q, one, rate in zip(found.quaternion, seen, found.rate, strict=True):
        np.testing.assert_allclose(matrix(q) @ one, Y, atol=1e-9)
        assert abs(rate[1]) < 1e-7
    away = math.acos(float(matrix(START)[1] @ towards))
    assert angle_between(START, found.quaternion[0]) == pytest.approx(away, abs=1e-6)
    resting = following(Y, towards, np.zeros(3), 10.0, START).attitudes(ORBIT, times)
    assert angle_between(START, resting[0]) == pytest.approx(away, abs=1e-6)
    np.testing.assert_allclose(resting[0], resting[1])
