"""Tests of right ascension, declination and roll, and of aberration."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from knightcube.astro.earth.sun import ASTRONOMICAL_UNIT, DAY, SPEED_OF_LIGHT, earth_from_sun, earth_velocity
from knightcube.astro.quaternion import IDENTITY, angle_between, attitude_matrix
from knightcube.vision.startracker.sky_map import Pointing, _bent, apparent
from sim_hal.worlds.orbit import sun_position
from tests.support.compiled_forms import assert_forms_agree


def test_the_identity_looks_at_the_north_celestial_pole() -> None:
    assert Pointing.of(IDENTITY).declination == pytest.approx(0.5 * np.pi)


def test_north_is_up_at_no_roll_and_east_is_then_on_the_left() -> None:
    matrix = attitude_matrix(Pointing(0.0, 0.0, 0.0).quaternion())
    north, east = matrix @ [0.0, 0.0, 1.0], matrix @ [0.0, 1.0, 0.0]
    np.testing.assert_allclose(north, [0.0, -1.0, 0.0], atol=1e-15)
    np.testing.assert_allclose(east, [-1.0, 0.0, 0.0], atol=1e-15)


def test_at_a_roll_of_90_deg_east_is_up() -> None:
    matrix = attitude_matrix(Pointing(0.0, 0.0, 0.5 * np.pi).quaternion())
    np.testing.assert_allclose(matrix @ [0.0, 1.0, 0.0], [0.0, -1.0, 0.0], atol=1e-15)


@given(st.floats(0.0, 6.28), st.floats(-1.57, 1.57), st.floats(0.0, 6.28))
def test_angles_to_attitude_and_back_is_the_identity(ra: float, dec: float, roll: float) -> None:
    q = Pointing(ra, dec, roll).quaternion()
    assert angle_between(Pointing.of(q).quaternion(), q) < 1e-9


_ARCSECOND = np.radians(1.0 / 3600.0)


def test_a_star_across_the_motion_is_displaced_by_the_constant_of_aberration() -> None:
    """A star normal to the motion is displaced by the constant of aberration.

    The constant is n a / (c sqrt(1 - e^2)), with n a = 29,784.69 m/s and e = 0.01670862 (IAU 1976).
    """
    speed = 29_784.69 / np.sqrt(1.0 - 0.01670862**2)
    seen = apparent(np.array([[0.0, 0.0, 1.0]]), np.array([speed, 0.0, 0.0]))[0]
    assert np.arctan2(seen[0], seen[2]) == pytest.approx(20.49552 * _ARCSECOND, abs=1e-3 * _ARCSECOND)


def test_aberration_keeps_stars_ahead_and_behind_and_unit_lengths() -> None:
    velocity = np.array([0.0, 2.0e5, 0.0])
    seen = apparent(np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [0.6, 0.0, 0.8]]), velocity)
    np.testing.assert_allclose(seen[:2], [[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]], atol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(seen, axis=1), 1.0, atol=1e-15)


def test_the_angle_to_the_apex_follows_the_half_angle_formula() -> None:
    """The angle to the apex is tan(theta'/2) = sqrt((1 - beta)/(1 + beta)) tan(theta/2) (Einstein 1905)."""
    beta = 0.5
    theta = np.array([0.3, 1.0, 2.0, 3.0])
    stars = np.stack([np.sin(theta), np.zeros(4), np.cos(theta)], axis=-1)
    seen = apparent(stars, np.array([0.0, 0.0, beta * SPEED_OF_LIGHT]))
    expected = 2.0 * np.arctan(np.sqrt((1.0 - beta) / (1.0 + beta)) * np.tan(0.5 * theta))
    np.testing.assert_allclose(np.arctan2(seen[:, 0], seen[:, 2]), expected, rtol=1e-12)


def test_an_impossible_velocity_is_refused() -> None:
    with pytest.raises(ValueError, match="below the speed of light"):
        apparent(np.array([[0.0, 0.0, 1.0]]), np.array([np.nan, 0.0, 0.0]))


def test_the_earths_velocity_is_the_published_one() -> None:
    """The Earth's velocity (barycentric, au per day) comes from ERFA's test of epv00.

    The date is MJD 53411.52501161.
    """
    published = np.array([-0.01091874268116823295, -0.01246525461732861538, -0.005404773180966231279])
    found = earth_velocity(2_453_412.02501161) * DAY / ASTRONOMICAL_UNIT
    np.testing.assert_allclose(found, published, atol=1e-11)


def test_the_earths_velocity_is_the_slope_of_the_suns_place_by_another_series() -> None:
    """The Earth's velocity is the derivative of the Sun's position by another series.

    The tolerance is 0.1 % of 30 km/s, plus 16 m/s for the motion of the Sun about the barycentre.
    """
    for date in np.linspace(2_460_700.5, 2_462_400.5, 40):
        before, after = sun_position(np.array([date - 0.5, date + 0.5]))
        assert np.linalg.norm(earth_velocity(date) - (before - after) / DAY) < 46.0


def test_the_earth_is_opposite_the_sun() -> None:
    """On 1992 October 13.0 TD, the Earth is opposite to the Sun (au, J2000) of Meeus, example 26.b."""
    published = np.array([-0.93739691, -0.31316824, -0.13577924])
    place, _ = earth_from_sun(2_448_908.5)
    np.testing.assert_allclose(-place / ASTRONOMICAL_UNIT, published, atol=1e-6)


def test_the_compiled_lens_errors_equal_those_in_numpy() -> None:
    draw = np.random.default_rng(1)
    seen = np.column_stack([draw.uniform(-0.5, 0.5, (50, 2)), np.ones(50)])
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    for k in range(8):
        assert_forms_agree(_bent, seen, 0.1 * np.eye(8)[k])
    assert_forms_agree(_bent, seen, draw.normal(0.0, 0.1, 8))
