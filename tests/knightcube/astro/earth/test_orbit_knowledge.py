"""Tests of the satellite's position against published SGP4 states, an integrator, and Earth rotation."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.figure import EARTH_RADIUS
from knightcube.astro.earth.orbit_knowledge import GpsFix, OrbitError, TwoLineElements
from knightcube.astro.earth.orientation import (
    ROTATION_RATE,
    celestial_to_terrestrial,
    geodetic,
    mean_equator_to_celestial,
    north_east_down,
)
from knightcube.errors import ArgumentError, UsageError
from sim_hal.worlds.orbit import KeplerianElements, propagate
from tests.support.orbit_elements import summed

DATE = 2_461_365.8
# Satellite 00005 of the verification set of Vallado et al., AIAA 2006-6753.
FIRST = "1 00005U 58002B   00179.78495062  .00000023  00000-0  28098-4 0  4753"
SECOND = "2 00005  34.2682 348.7242 1859667 331.7664  19.3264 10.82419157413667"


def test_two_line_elements_give_the_published_state() -> None:
    """At the epoch, the elements of satellite 00005 give the TEME state of SGP4-VER's first line."""
    epoch = 2_451_722.5 + 0.78495062
    state = TwoLineElements(FIRST, SECOND).at(epoch)
    to_teme = mean_equator_to_celestial(epoch).T
    np.testing.assert_allclose(
        1e-3 * to_teme @ state.position, (7022.46529266, -1400.08296755, 0.03995155), atol=0.02
    )
    np.testing.assert_allclose(
        1e-3 * to_teme @ state.velocity, (1.893841015, 6.405893759, 4.534807250), atol=2e-5
    )


def test_the_frame_of_sgp4_is_turned_into_the_frame_of_the_stars_as_published() -> None:
    """The conversion from TEME to ICRS agrees with Vallado, Fundamentals of Astrodynamics, Ex. 3-15, to 40 m.

    The date is 2004 April 6, 07:51:28.386009 UTC. UT1 - UTC is -0.4399619 s. The neglected polar motion is 10
    m.
    """
    date = 2_453_101.5 + (7.0 * 3600.0 + 51.0 * 60.0 + 28.386009) / 86_400.0
    teme = 1e3 * np.array([5094.18016210, 6127.64465950, 6380.34453270])
    celestial = 1e3 * np.array([5102.508958, 6123.011401, 6378.136928])
    np.testing.assert_allclose(mean_equator_to_celestial(date, -0.4399619) @ teme, celestial, atol=40.0)
    terrestrial = 1e3 * np.array([-1033.4793830, 7901.2952754, 6380.3565958])
    found = celestial_to_terrestrial(date, -0.4399619) @ celestial
    # In 2004, TT was 64.184 s ahead of UTC, and not 69.184 s as assumed. The difference of 5 s hardly changes
    # precession and nutation.
    np.testing.assert_allclose(found, terrestrial, atol=40.0)


def test_the_ground_turns_once_in_a_sidereal_day() -> None:
    turn = celestial_to_terrestrial(DATE + 10.0 / 86_400.0) @ celestial_to_terrestrial(DATE).T
    rate = np.array([turn[1, 2] - turn[2, 1], turn[2, 0] - turn[0, 2], turn[0, 1] - turn[1, 0]]) / 20.0
    np.testing.assert_allclose(rate, (0.0, 0.0, ROTATION_RATE), atol=1e-9)


def test_many_dates_have_the_results_of_each_alone() -> None:
    dates = DATE + np.array([0.0, 0.3, 100.0])
    for make in (celestial_to_terrestrial, mean_equator_to_celestial):
        for date, found in zip(dates, make(dates), strict=True):
            np.testing.assert_array_equal(make(date), found)


def test_down_is_towards_the_ground() -> None:
    place = np.array([[4e6, 3e6, 5e6]])
    longitude, latitude, height = geodetic(place)
    axes = north_east_down(longitude, latitude)[0]
    _, _, lower = geodetic(place + 1000.0 * axes[2])
    assert float(height[0] - lower[0]) == pytest.approx(1000.0, abs=1e-6)
    assert axes[0] @ (0.0, 0.0, 1.0) > 0.0
    assert np.linalg.det(axes) == pytest.approx(1.0)


def fix_of(state: FloatArray, date: float, **spread: float) -> GpsFix:
    """Return the GPS fix of an inertial state (6,)."""
    turn = celestial_to_terrestrial(date)
    ground = turn @ state[:3]
    return GpsFix(date, ground, turn @ state[3:] - np.cross([0.0, 0.0, ROTATION_RATE], ground), **spread)


def test_a_propagated_fix_agrees_with_another_integrator() -> None:
    """A fix that is propagated for 20 minutes agrees with another integrator to 20 m and 0.02 m/s.

    The other integrator is the Dormand-Prince integrator of sim_hal.
    """
    elements = KeplerianElements(
        semi_major_axis=EARTH_RADIUS + 380e3, eccentricity=0.002, inclination=0.9, ascending_node=1.0
    )
    begin, end = propagate(elements, 1300.0).states_at(np.array([0.0, 1200.0]))
    found = fix_of(begin, DATE).at(DATE + 1200.0 / 86_400.0)
    # A Julian date is resolved to 40 us, which is 0.3 m along the orbit.
    np.testing.assert_allclose(found.position, end[:3], atol=20.0)
    np.testing.assert_allclose(found.velocity, end[3:], atol=0.02)
    assert found.sigma > 100.0
    assert found.nadir @ end[:3] < 0.0


def test_an_old_fix_and_one_within_the_earth_are_refused() -> None:
    state = np.array([6.8e6, 0.0, 0.0, 0.0, 7.6e3, 0.0])
    with pytest.raises(OrbitError, match="the last fix is 2000 s old"):
        fix_of(state, DATE).at(DATE + 2000.0 / 86_400.0)
    with pytest.raises(OrbitError, match="within the Earth"):
        GpsFix(DATE, np.array([1e6, 0.0, 0.0]), np.zeros(3))
    with pytest.raises(OrbitError, match="finite"):
        GpsFix(DATE, np.array([np.nan, 0.0, 0.0]), np.zeros(3))


def test_lines_that_are_not_elements_are_refused() -> None:
    with pytest.raises(UsageError, match="69 columns"):
        TwoLineElements(FIRST[:-3], SECOND)
    with pytest.raises(UsageError, match="checksum 4, the sum of its columns gives 3"):
        TwoLineElements(FIRST[:-1] + "4", SECOND)
    with pytest.raises(UsageError, match="line 2"):
        TwoLineElements(FIRST, FIRST)


@pytest.mark.parametrize("day", ["000.50000000", "367.00000000", "999999999999"])
def test_an_epoch_on_no_day_of_the_year_is_refused(day: str) -> None:
    """An epoch with an impossible day of the year is refused. Steps over 1e12 days would never end."""
    first = FIRST[:20] + day + FIRST[32:]
    high = SECOND[:26] + "7000000" + SECOND[33:52] + " 2.00000000" + SECOND[63:]
    with pytest.raises(UsageError, match="day of the year of the epoch"):
        TwoLineElements(summed(first), summed(high))


def test_a_decayed_orbit_is_reported() -> None:
    """The decay of an orbit is reported. By SGP4, satellite 28872 decays within 50 minutes of its epoch.

    The satellite is part of the verification set.
    """
    first = "1 28872U 05037B   05333.02012661  .25992681  00000-0  24476-3 0  1534"
    second = "2 28872  96.4736 157.9986 0303955 244.0492 110.6523 16.46015938 10708"
    with pytest.raises(OrbitError, match="SGP4"):
        TwoLineElements(first, second).at(2_453_703.5 + 0.02012661 + 2.0)


@pytest.mark.parametrize(
    "change",
    [
        {"position": np.array([7e206, 0.0, 0.0])},
        {"velocity": np.array([0.0, 7e203, 0.0])},
        {"sigma": math.nan},
        {"velocity_sigma": -1.0},
        {"longest_age": math.nan},
    ],
    ids=["position", "velocity", "sigma", "velocity sigma", "age"],
)
def test_a_fix_from_which_no_state_follows_is_refused(change: dict[str, Any]) -> None:
    good: dict[str, Any] = {"position": [7e6, 0.0, 0.0], "velocity": [0.0, 7.5e3, 0.0]}
    assert np.isfinite(GpsFix(2_461_000.5, **good).at(2_461_000.501).position).all()
    with pytest.raises((ArgumentError, OrbitError)):
        GpsFix(2_461_000.5, **{**good, **change})


@pytest.mark.parametrize("date", [math.nan, math.inf, 0.0, 1e300])
def test_elements_refuse_a_date_before_1858_or_after_2999(date: float) -> None:
    with pytest.raises(ArgumentError, match="julian_date"):
        TwoLineElements(FIRST, SECOND).known_at(date)
    with pytest.raises(ArgumentError, match="growth"):
        TwoLineElements(FIRST, SECOND, growth=math.nan)
