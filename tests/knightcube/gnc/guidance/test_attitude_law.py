"""Tests of attitude laws: pointing axes, and consistency of rates and accelerations with the attitude."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from knightcube.astro.earth.ephemeris import predict
from knightcube.astro.earth.orbit_knowledge import OrbitError, OrbitState
from knightcube.astro.earth.orientation import celestial_to_terrestrial, geodetic
from knightcube.astro.quaternion import (
    IDENTITY,
    angle_between,
    attitude_matrix,
    from_rotation_vector,
    multiply,
    normalise,
)
from knightcube.errors import UsageError
from knightcube.gnc.guidance.attitude_law import (
    POLE,
    AttitudeLaw,
    BodyAxes,
    Direction,
    approach,
    following,
    free_roll,
    ground,
    inertial,
    law_of,
    nadir,
    orbit_normal,
    passing,
    references,
    sun,
    velocity,
)
from knightcube.gnc.guidance.pointing_target import Goal, PointingTarget
from tests.support.circular_orbits import JULIAN_DATE, RADIUS, RATE, circular

ORBIT = circular(3000.0)
X, Y, Z = np.eye(3)
TIMES = np.arange(100.0, 400.0, 20.0)
NADIR = AttitudeLaw(Z, nadir, X, velocity)


def test_nadir_along_the_flight_turns_once_an_orbit_about_the_pitch_axis() -> None:
    found = references(NADIR.attitudes, ORBIT, TIMES)
    for time, q in zip(TIMES, found.quaternion, strict=True):
        turned = attitude_matrix(q)
        np.testing.assert_allclose(turned @ -ORBIT.position_at(np.array([time]))[0] / RADIUS, Z, atol=1e-9)
        np.testing.assert_allclose(turned @ orbit_normal(ORBIT, np.array([time]))[0], -Y, atol=1e-9)
    np.testing.assert_allclose(found.rate, np.tile([0.0, -RATE, 0.0], (len(TIMES), 1)), atol=1e-9)
    np.testing.assert_allclose(found.acceleration, 0.0, atol=1e-9)


def test_rate_and_acceleration_predict_the_attitude() -> None:
    """Rate and acceleration of a law predict its attitude over a short time.

    A ground target passes at 3 km/s or more, so its rate and acceleration change continuously.
    """
    beneath = celestial_to_terrestrial(JULIAN_DATE) @ ORBIT.position_at(np.array([300.0]))[0]
    longitude, latitude, _ = (float(part) for part in geodetic(beneath))
    law = AttitudeLaw(Z, ground(latitude, longitude), X, velocity)
    found = references(law.attitudes, ORBIT, TIMES)
    step = 2.0
    later = law.attitudes(ORBIT, TIMES + step)
    for k in range(len(TIMES)):
        turn = step * found.rate[k] + 0.5 * step**2 * found.acceleration[k]
        carried = multiply(from_rotation_vector(turn), found.quaternion[k])
        assert angle_between(carried, later[k]) < 3e-5
    assert np.linalg.norm(found.rate, axis=1).max() > 5.0 * RATE
    overhead = law.attitudes(ORBIT, np.array([300.0]))[0]
    down = nadir(ORBIT, np.array([300.0]))[0]
    # In 300 s the Earth's rotation moves the target by 1.3 deg, as seen from an altitude of 500 km.
    assert np.degrees(np.arccos(attitude_matrix(overhead)[2] @ down)) < 20.0


@pytest.mark.parametrize(
    ("first", "second"),
    [(sun, POLE), (inertial(np.array([0.2, -0.5, 1.0])), POLE), (nadir, orbit_normal), (velocity, nadir)],
)
def test_a_free_roll_keeps_the_roll_that_there_is_and_turns_the_shortest_way(
    first: Direction, second: Direction
) -> None:
    start = normalise(np.array([0.3, -0.2, 0.5, 0.7]))
    law = free_roll(Y, first, second, start, ORBIT, 100.0)
    wanted = law.attitudes(ORBIT, np.array([100.0]))[0]
    direction = first(ORBIT, np.array([100.0]))[0]
    np.testing.assert_allclose(attitude_matrix(wanted) @ direction, Y, atol=1e-9)
    away = np.arccos(np.clip(float(attitude_matrix(start)[1] @ direction), -1.0, 1.0))
    assert angle_between(start, wanted) == pytest.approx(away, abs=1e-6)


@pytest.mark.parametrize("aside", [0.0, 0.03])
def test_a_pass_over_a_ground_target_with_a_free_roll_needs_only_the_rate_of_the_direction(
    aside: float,
) -> None:
    """The body rotates about its pointing axis no faster than the Earth's rotation and the pass require.

    If the direction of the ground target passed near the direction from which the roll is measured, a
    constant roll would need a rate many times higher.
    """
    times, rng = np.arange(20.0, 600.0, 1.0), np.random.default_rng(6)
    beneath = celestial_to_terrestrial(JULIAN_DATE) @ ORBIT.position_at(np.array([300.0]))[0]
    longitude, latitude, _ = (float(part) for part in geodetic(beneath))
    target = PointingTarget(Goal.GROUND, (latitude + aside, longitude))
    direction = ground(*target.numbers)(ORBIT, times)
    needed = np.linalg.norm(np.diff(direction, axis=0), axis=1).max()
    for _ in range(20):
        law = law_of(target, BodyAxes(Z, X), normalise(rng.standard_normal(4)), ORBIT, 20.0)
        found = references(law, ORBIT, times)
        np.testing.assert_allclose(attitude_matrix(found.quaternion)[:, 2], direction, atol=1e-9)
        assert np.linalg.norm(found.rate, axis=1).max() < 1.1 * needed


def test_an_approach_starts_with_the_body_s_attitude_and_rate_and_ends_in_the_law() -> None:
    start, rate = normalise(np.array([0.6, 0.1, -0.3, 0.5])), np.array([0.002, -0.003, 0.001])
    way = approach(NADIR.attitudes, start, rate, 100.0, 700.0)
    begin = references(way, ORBIT, np.array([101.0, 700.0, 800.0]))
    carried = multiply(from_rotation_vector(rate), start)
    assert angle_between(begin.quaternion[0], carried) < 1e-4
    np.testing.assert_allclose(begin.rate[0], rate, atol=2e-5)
    np.testing.assert_allclose(references(way, ORBIT, np.array([100.0])).rate[0], rate, atol=2e-5)
    np.testing.assert_allclose(begin.rate[1], [0.0, -RATE, 0.0], atol=1e-6)
    np.testing.assert_allclose(begin.quaternion[2], NADIR.attitudes(ORBIT, np.array([800.0]))[0], atol=1e-12)


def test_parallel_directions_bad_places_and_times_outside_are_refused() -> None:
    with pytest.raises(UsageError, match="parallel"):
        AttitudeLaw(Z, nadir, X, nadir).attitudes(ORBIT, TIMES)
    with pytest.raises(UsageError, match="latitude"):
        ground(2.0, 0.0)
    with pytest.raises(UsageError, match="must be after the start"):
        approach(NADIR.attitudes, IDENTITY, np.zeros(3), 10.0, 10.0)
    with pytest.raises(OrbitError, match="predicted for"):
        NADIR.attitudes(ORBIT, np.array([4000.0]))


def test_a_prediction_follows_its_orbit_between_the_instants() -> None:
    state = OrbitState(JULIAN_DATE, np.array([RADIUS, 0.0, 0.0]), np.array([0.0, 1000.0, 7500.0]), 10.0)
    coarse, fine = predict(state, 100.0), predict(state, 100.0, step=2.5)
    times = np.array([3.0, 47.5, 99.0])
    np.testing.assert_allclose(coarse.position_at(times), fine.position_at(times), atol=0.05)
    np.testing.assert_allclose(coarse.velocity_at(times), fine.velocity_at(times), atol=0.01)
    np.testing.assert_allclose(coarse.field_at(times), fine.field_at(times), atol=1e-8)
    np.testing.assert_allclose(np.linalg.norm(coarse.sun_at(times), axis=1), 1.0)


NAN = math.nan * X
QUATERNION = np.array([0.5, 0.5, 0.5, 0.5])


@pytest.mark.parametrize(
    ("name", "call"),
    [
        ("pointing", lambda: BodyAxes(NAN, X)),
        ("across", lambda: BodyAxes(X, 0.0 * X)),
        ("axis", lambda: AttitudeLaw(0.0 * X, nadir, Z, velocity)),
        ("across", lambda: AttitudeLaw(X, nadir, NAN, velocity)),
        ("vector", lambda: inertial(0.0 * X)),
        ("latitude", lambda: ground(None, 0.3)),  # type: ignore[arg-type]  # wrong on purpose
        ("latitude 0.5, longitude 100", lambda: ground(0.5, 100.0)),
        ("direction", lambda: passing(0.0 * X, X, 0.0)),
        ("velocity", lambda: passing(X, NAN, 0.0)),
        ("since", lambda: passing(X, X, math.nan)),
        ("axis", lambda: following(NAN, X, Z, 0.0, QUATERNION)),
        ("quaternion", lambda: following(Z, X, Z, 0.0, 2.0 * QUATERNION)),
        ("quaternion", lambda: free_roll(Z, nadir, velocity, math.nan * QUATERNION, ORBIT, 1.0)),
        ("quaternion", lambda: approach(NADIR.attitudes, 2.0 * QUATERNION, X, 0.0, 1.0)),
        ("rate", lambda: approach(NADIR.attitudes, QUATERNION, NAN, 0.0, 1.0)),
        ("approach", lambda: approach(NADIR.attitudes, QUATERNION, X, 0.0, math.inf)),
    ],
)
def test_values_without_an_attitude_are_refused_by_name(name: str, call: Callable[[], Any]) -> None:
    with pytest.raises(UsageError, match=f"^(an )?{name}"):
        call()


def test_axes_of_another_length_give_the_same_law() -> None:
    """An attitude matrix of axes with another length would not be a rotation."""
    times = np.array([10.0, 20.0])
    usual, longer = (AttitudeLaw(length * Z, nadir, length * X, velocity) for length in (1.0, 2.0))
    np.testing.assert_array_equal(longer.attitudes(ORBIT, times), usual.attitudes(ORBIT, times))
    np.testing.assert_array_equal(BodyAxes(3.0 * Z, 0.5 * X).pointing, Z)
