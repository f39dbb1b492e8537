"""Tests of right ascension, declination and roll, of aberration, and of lens errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.sun import ASTRONOMICAL_UNIT, DAY, SPEED_OF_LIGHT, earth_from_sun, earth_velocity
from knightcube.astro.quaternion import IDENTITY, angle_between, attitude_matrix
from knightcube.vision.camera.lens import EXACT, Pinhole
from knightcube.vision.startracker import sky_map
from knightcube.vision.startracker.sky_map import (
    Pointing,
    ShortTrails,
    SkyMap,
    _bent,
    _unbent,
    apparent,
    bend_slope,
    bent,
    known_bend,
    usual_bend,
)
from sim_hal.worlds.orbit import sun_position
from tests.support.compiled_forms import assert_forms_agree


def test_the_boresight_of_the_identity_is_the_north_celestial_pole() -> None:
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


def test_a_pointing_is_below_a_full_turn_for_a_tiny_negative_angle() -> None:
    found = Pointing.of(Pointing(-1e-16, 0.0, -1e-16).quaternion())
    assert 0.0 <= found.right_ascension < 2.0 * np.pi
    assert 0.0 <= found.roll < 2.0 * np.pi


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
    bend = draw.normal(0.0, 0.03, 8)
    assert _bent.numpy_form(_unbent.numpy_form(seen, bend), bend) == pytest.approx(seen, abs=1e-9)
    assert_forms_agree(_unbent, seen * np.where(np.arange(len(seen)) == 3, -1.0, 1.0)[:, None], bend)


def test_a_direction_far_outside_the_image_has_no_pixel() -> None:
    """A star beside the camera appears nowhere in the image of a lens with a large distortion.

    The inversion of the lens errors diverges for these stars, and can return pixels inside the image.
    """
    camera = Pinhole.from_field_of_view(1024, 768, np.radians(12.0))
    bend = 2.0 * usual_bend(camera) ** -0.5 * np.array([0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0])
    stars = np.random.default_rng(5).normal(size=(20_000, 3))
    stars /= np.linalg.norm(stars, axis=1, keepdims=True)
    inside = camera.contains(SkyMap(camera, IDENTITY, bend).pixels(stars))
    assert inside.any()
    assert stars[inside, 2].min() > np.cos(1.2 * camera.half_diagonal)
    seen = stars[stars[:, 2] > 0.1]
    assert_forms_agree(_unbent, seen[np.isfinite(_unbent.numpy_form(seen, bend)[:, 0])], bend)


_BEND = np.array([0.02, -0.03, 0.004, 0.006, 0.05, -0.03, 0.01, -0.02])


def test_lens_errors_displace_the_tangents_by_the_stated_formula() -> None:
    """The tangents u are displaced by the formula in the docstring of the module.

    The displacement is (u . a) u + |u|^2 b + k |u|^2 u + l |u|^4 u + p (u_x, -u_y) + q (u_y, u_x), to first
    order in the lens errors.
    """
    tangent = np.random.default_rng(3).uniform(-0.3, 0.3, (20, 2))
    seen = np.column_stack([tangent, np.ones(20)])
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    small = 1e-4 * _BEND
    x, y = tangent.T
    square = x**2 + y**2
    radial = small[0] * x + small[1] * y + small[4] * square + small[5] * square**2
    dx = radial * x + square * small[2] + small[6] * x + small[7] * y
    dy = radial * y + square * small[3] - small[6] * y + small[7] * x
    found = bent(seen, small)
    assert np.linalg.norm(found, axis=1) == pytest.approx(np.ones(20))
    assert found[:, :2] / found[:, 2:] - tangent == pytest.approx(
        np.stack([dx, dy], axis=1), rel=1e-3, abs=1e-11
    )
    slope = bend_slope(seen)
    for k in range(8):
        step = 1e-6 * np.eye(8)[k]
        assert slope[:, :, k] == pytest.approx((bent(seen, step) - bent(seen, -step)) / 2e-6, abs=1e-8)
    assert bent(seen, np.zeros(8)) is seen


_CAMERA = Pinhole(800, 600, 1500.0)


def test_prior_lens_errors_have_their_size_at_the_corner() -> None:
    """A lens error of one standard deviation displaces the corner as much as in a typical lens."""
    corner = 500.0 / 1500.0
    sigma = usual_bend(_CAMERA) ** -0.5
    assert len(sigma) == 8
    assert sigma[:2] == pytest.approx([sky_map._TILT * corner] * 2)
    for k, share in ((2, sky_map._DECENTRING), (3, sky_map._DECENTRING)):
        assert sigma[k] * corner**2 / corner == pytest.approx(share)
    assert sigma[4] * corner**2 == pytest.approx(sky_map._DISTORTION[0])
    assert sigma[5] * corner**4 == pytest.approx(sky_map._DISTORTION[1])
    assert sigma[6:] == pytest.approx([sky_map._ASPECT] * 2)


def test_a_calibrated_lens_has_errors_of_its_stated_accuracy() -> None:
    corner = 500.0 / 1500.0
    none = known_bend(_CAMERA, EXACT)
    assert none.shape == (0,)
    sigma = known_bend(_CAMERA, replace(EXACT, centre=3.0, distortion=0.006)) ** -0.5
    assert len(sigma) == 6
    assert sigma[:2] == pytest.approx([3.0 / 1500.0] * 2)
    assert sigma[4] * corner**2 == pytest.approx(0.006)
    assert sigma[5] * corner**4 == pytest.approx(0.002)
    assert sigma[2:4] == pytest.approx([3.0 / 1500.0 * sigma[4]] * 2)
    # An exactly known value is given a small error, so that the equations stay regular.
    centre = known_bend(_CAMERA, replace(EXACT, centre=3.0)) ** -0.5
    assert centre[4] * corner**2 == pytest.approx(sky_map._LEAST_DISTORTION)
    distortion = known_bend(_CAMERA, replace(EXACT, distortion=0.006)) ** -0.5
    assert distortion[0] == pytest.approx(sky_map._LEAST_CENTRE / 1500.0)


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("velocity", [None, np.array([20e3, -15e3, 9e3])])
@pytest.mark.parametrize("bend", [np.zeros(8), 0.3 * _BEND])
def test_pixels_and_directions_are_inverse(
    bend: FloatArray,
    velocity: FloatArray | None,
    mirrored: bool,
) -> None:
    quaternion = np.array([0.3, -0.2, 0.5, 0.79]) / np.linalg.norm([0.3, -0.2, 0.5, 0.79])
    sky = SkyMap(_CAMERA, quaternion, bend, velocity, mirrored)
    points = np.array([[20.0, 30.0], [700.0, 100.0], [399.5, 299.5], [250.0, 580.0]])
    directions = sky.directions(points)
    assert np.linalg.norm(directions, axis=1) == pytest.approx(np.ones(4))
    assert sky.pixels(directions) == pytest.approx(points, abs=1e-3 if velocity is not None else 1e-5)
    exchanged = points * [-1.0, 1.0] + [799.0, 0.0] if mirrored else points
    plain = bent(_CAMERA.unit_vectors(exchanged), bend) @ attitude_matrix(quaternion)
    if velocity is None:
        assert directions == pytest.approx(plain)
    else:
        # The directions are corrected for aberration, and `apparent` applies it again.
        assert apparent(directions, velocity) == pytest.approx(plain, abs=1e-7)
        assert np.linalg.norm(directions - plain, axis=1).max() > 3e-5


def test_short_trails_are_the_displacements_of_stars_during_the_exposure() -> None:
    """A star moves as v' = -omega x v. The delay of a row displaces a star by its motion until the row."""
    turn = np.array([2e-3, -1e-3, 4e-3])
    trails = ShortTrails(turn, 0.0, 0.0)
    points = np.array([[100.0, 450.0], [700.0, 100.0]])
    rays = _CAMERA.unit_vectors(points)

    def at(part: float) -> FloatArray:
        return _CAMERA.project(rays - part * np.cross(turn, rays))

    moved = trails.of(_CAMERA, rays)
    assert moved == pytest.approx(at(0.5) - at(-0.5), rel=1e-4)
    assert np.linalg.norm(moved, axis=1).min() > 1.0
    assert trails.late(_CAMERA, points) == pytest.approx(moved * [[450.0 - 299.5], [100.0 - 299.5]])
    assert not trails.of(_CAMERA, -rays).any()
