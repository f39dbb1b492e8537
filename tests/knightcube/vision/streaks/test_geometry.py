"""Tests of star paths on the detector against rotations about the boresight and numerical derivatives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.vision.camera.lens import DistortedPinhole, Pinhole
from knightcube.vision.streaks import geometry
from knightcube.vision.streaks.camera_motion import CameraMotion, Vibration
from knightcube.vision.streaks.geometry import (
    Course,
    Shutter,
    azimuth_differences,
    complete_streaks,
    exposure_bounds,
    image_flow,
    mid_exposure_positions,
    near_streaks,
    path_lengths,
    paths,
    polar_angles,
    positions,
    sensitivities,
)
from tests.support.compiled_forms import assert_forms_agree

_LENS = DistortedPinhole(1024, 1024, 2903.0, (3.0, -2.0), 0.002, 0.01)
_STRONG_LENS = DistortedPinhole(
    1024, 1024, 2903.0, (3.0, -2.0), 0.002, -0.1, 0.03, tangential=(0.02, -0.03), shape=(0.02, 0.01)
)
_MOTION = CameraMotion(np.array([0.03, 0.05, 0.1]), np.array([0.003, -0.002, 0.01]))
_RNG = np.random.default_rng(1)
_STARS, _TIME = _RNG.uniform(50.0, 970.0, (20, 2)), _RNG.uniform(-0.5, 0.5, 20)


def test_distortion_moves_corner_and_centre_and_is_inverted() -> None:
    corner = np.array([[0.0, 0.0]])
    lens = DistortedPinhole(1024, 1024, 2903.0, (0.0, 0.0), 0.0, 0.01)
    assert lens.distorted(corner)[0] == pytest.approx([-5.115, -5.115])
    assert _LENS.distorted(np.array([_LENS.centre]))[0] == pytest.approx([514.5, 509.5])
    assert _LENS.undistorted(_LENS.distorted(_STARS)) == pytest.approx(_STARS, abs=1e-6)


def test_a_star_is_identified_by_its_distorted_pixel() -> None:
    assert positions(_LENS, _MOTION, _STARS, np.zeros(20)) == pytest.approx(_STARS, abs=1e-6)


@pytest.mark.parametrize("lens", [_LENS, _STRONG_LENS])
def test_velocity_and_acceleration_are_derivatives_of_the_position(lens: DistortedPinhole) -> None:
    step = 1e-4
    drawn = paths(lens, _MOTION, _STARS, _TIME)
    before, after = (paths(lens, _MOTION, _STARS, _TIME + way * step) for way in (-1.0, 1.0))
    assert drawn.position == pytest.approx(positions(lens, _MOTION, _STARS, _TIME))
    velocity = (after.position - before.position) / (2.0 * step)
    acceleration = (after.velocity - before.velocity) / (2.0 * step)
    assert drawn.velocity == pytest.approx(velocity, abs=1e-3)
    assert drawn.acceleration == pytest.approx(acceleration, abs=1e-3)


@pytest.mark.parametrize("parameter", range(8))
def test_sensitivities_are_derivatives_of_the_position(parameter: int) -> None:
    """The sensitivities are the derivatives of a star's position.

    The derivative with respect to the acceleration has a second-order error of less than 0.1 %.
    """
    change = np.zeros(8)
    change[parameter] = 1e-5 if parameter < 6 else 1e-2

    def moved(way: float) -> FloatArray:
        by = way * change
        motion = replace(_MOTION, rate=_MOTION.rate + by[:3], acceleration=_MOTION.acceleration + by[3:6])
        return positions(_LENS, motion, _STARS + by[6:], _TIME)

    expected = (moved(1.0) - moved(-1.0)) / (2.0 * change[parameter])
    found = sensitivities(_LENS, _MOTION, _STARS, _TIME)[:, :, parameter]
    assert found == pytest.approx(expected, abs=1e-3 * float(np.abs(expected).max()))


@pytest.mark.parametrize("higher", [np.zeros((0, 3)), np.array([[0.02, -0.01, 0.03], [0.01, 0.05, -0.04]])])
@pytest.mark.parametrize("acceleration", [np.zeros(3), np.array([0.03, -0.2, 0.1])])
@pytest.mark.parametrize("rate", [np.zeros(3), np.array([0.03, 0.05, 0.1]), np.array([-0.4, 0.7, 0.5])])
def test_the_compiled_paths_equal_those_in_numpy(
    rate: FloatArray, acceleration: FloatArray, higher: FloatArray
) -> None:
    time = np.append(_TIME[1:], 0.0)
    arguments = (2903.0, 511.5, 411.5), (rate, acceleration, higher), _STARS, time
    assert_forms_agree(geometry._ideal_positions, *arguments)
    assert_forms_agree(geometry._ideal_paths, *arguments)
    for growing in (False, True):
        assert_forms_agree(geometry._ideal_sensitivities, *arguments, growing)


def _stars_on_circles(time: FloatArray, angle: FloatArray, stars: FloatArray) -> FloatArray:
    """Return the positions of stars after the camera has rotated by `angle` (m,) about its boresight."""
    x, y = (stars - _CENTRE).T
    sine, cosine = np.sin(angle), np.cos(angle)
    return np.asarray(np.stack([x * cosine + y * sine, y * cosine - x * sine], axis=1) + _CENTRE)


_PINHOLE = Pinhole(1024, 824, 2903.0)
_CENTRE = np.array([511.5, 411.5])
_SHAKING = Vibration(
    np.array([1.5, 4.0]),
    np.array([[0.0, 0.0, 0.02], [0.0, 0.0, -0.01]]),
    np.array([[0.0, 0.0, 0.005], [0.0, 0.0, 0.03]]),
)


@pytest.mark.parametrize("vibration", [Vibration(), _SHAKING])
def test_stars_move_on_circles_about_the_boresight(vibration: Vibration) -> None:
    """A rotation about the boresight moves stars on circles, by the sum of all terms of the rotation angle.

    The velocity and the acceleration are numerical derivatives of the position on the circle.
    """
    motion = CameraMotion(
        np.array([0.0, 0.0, 0.5]),
        np.array([0.0, 0.0, -0.3]),
        np.array([[0.0, 0.0, 0.8], [0.0, 0.0, -0.6]]),
        vibration,
    )

    def angle(t: FloatArray) -> FloatArray:
        total = 0.5 * t - 0.15 * t**2 + 0.8 * t**3 - 0.6 * t**4
        for f, (*_, s), (*_, c) in zip(vibration.frequency, vibration.sine, vibration.cosine, strict=True):
            total = total + s * np.sin(2.0 * np.pi * f * t) + c * (np.cos(2.0 * np.pi * f * t) - 1.0)
        return total

    def on_circle(t: FloatArray) -> FloatArray:
        return _stars_on_circles(t, angle(t), _STARS)

    step = 1e-4
    drawn = paths(_PINHOLE, motion, _STARS, _TIME)
    before, here, after = (on_circle(_TIME + way * step) for way in (-1.0, 0.0, 1.0))
    assert drawn.position == pytest.approx(here, abs=1e-6)
    assert positions(_PINHOLE, motion, _STARS, _TIME) == pytest.approx(here, abs=1e-6)
    assert drawn.velocity == pytest.approx((after - before) / (2.0 * step), abs=1e-2)
    assert drawn.acceleration == pytest.approx((after - 2.0 * here + before) / step**2, rel=1e-3, abs=1.0)
    changed = sensitivities(_PINHOLE, motion, _STARS, _TIME)
    turned = (_stars_on_circles(_TIME, angle(_TIME) + way, _STARS) for way in (1e-6, -1e-6))
    by_angle = np.subtract(*turned) / 2e-6
    assert changed[:, :, 2] == pytest.approx(by_angle * _TIME[:, None], abs=1e-2)
    assert changed[:, :, 5] == pytest.approx(0.5 * by_angle * _TIME[:, None] ** 2, rel=0.03, abs=1.0)
    sine, cosine = np.sin(angle(_TIME)), np.cos(angle(_TIME))
    assert changed[:, :, 6] == pytest.approx(np.stack([cosine, -sine], axis=1))
    assert changed[:, :, 7] == pytest.approx(np.stack([sine, cosine], axis=1))
    assert not sensitivities(_PINHOLE, motion, _STARS, _TIME, growing=False)[:, :, 3:6].any()


def test_a_vibration_has_the_derivatives_of_its_rotation() -> None:
    shaking = Vibration(np.array([0.7]), np.array([[0.3, 0.0, 0.1]]), np.array([[0.4, 0.2, 0.0]]))
    time, step = np.array([-0.31, 0.0, 0.12, 0.44]), 1e-5
    known = [
        0.3 * np.sin(1.4 * np.pi * time) + 0.4 * (np.cos(1.4 * np.pi * time) - 1.0),
        0.2 * (np.cos(1.4 * np.pi * time) - 1.0),
        0.1 * np.sin(1.4 * np.pi * time),
    ]
    assert shaking.rotation(time) == pytest.approx(np.stack(known))
    for order in (1, 2):
        ahead, behind = (shaking.rotation(time + way * step, order - 1) for way in (1.0, -1.0))
        assert shaking.rotation(time, order) == pytest.approx((ahead - behind) / (2.0 * step), abs=1e-6)
    assert shaking.reversed().rotation(time) == pytest.approx(shaking.rotation(-time))
    assert shaking.amplitude == pytest.approx([np.sqrt(0.3**2 + 0.1**2 + 0.4**2 + 0.2**2)])
    more = shaking.with_frequency(2.5)
    assert more.frequency == pytest.approx([0.7, 2.5])
    assert more.sine == pytest.approx(np.array([[0.3, 0.0, 0.1], [0.0, 0.0, 0.0]]))
    assert more.cosine == pytest.approx(np.array([[0.4, 0.2, 0.0], [0.0, 0.0, 0.0]]))
    assert shaking.exists
    assert not Vibration().exists


_HIGHER = np.array([[0.02, -0.01, 0.03], [0.01, 0.05, -0.04]])


def test_the_rotation_of_an_exposure_follows_from_the_terms_of_the_motion() -> None:
    """Odd terms rotate the camera from start to end; even terms move the attitude halfway between them."""
    motion = CameraMotion(np.array([0.3, 0.1, -0.2]), np.array([0.4, -0.2, 0.8]), _HIGHER)
    assert motion.rotation == pytest.approx([0.305, 0.0975, -0.1925])
    assert motion.halfway == pytest.approx([0.05 + 0.000625, -0.025 + 0.003125, 0.1 - 0.0025])
    assert motion.progress(np.array([-0.5, 0.5])) @ [-1.0, 1.0] == pytest.approx(1.0)
    time, step = np.array([-0.4, 0.1, 0.35]), 1e-5
    slope = (motion.progress(time + step) - motion.progress(time - step)) / (2.0 * step)
    assert motion.relative_rate(time) == pytest.approx(slope)
    bend = (motion.relative_rate(time + step) - motion.relative_rate(time - step)) / (2.0 * step)
    assert motion.relative_rate(time, 1) == pytest.approx(bend)
    ends = motion.relative_rate(np.array([-0.5, 0.5]))
    assert motion.relative_acceleration == pytest.approx(ends[1] - ends[0])
    made = CameraMotion.between(np.array([0.1, 0.2, 0.3]), motion.acceleration, _HIGHER)
    assert made.rotation == pytest.approx([0.1, 0.2, 0.3])
    assert np.array_equal(made.acceleration, motion.acceleration)
    assert motion.scaled_to(np.array([0.5, 0.2, -0.1])).rotation == pytest.approx([0.5, 0.2, -0.1])
    assert motion.scaled_to(np.array([-0.5, -0.2, 0.1])).rotation == pytest.approx([0.5, 0.2, -0.1])
    assert CameraMotion.steady(np.zeros(3)).relative_acceleration == 0.0
    assert CameraMotion.steady(np.ones(3)).relative_rate(time) == pytest.approx(np.ones(3))


def test_a_reversed_motion_visits_the_same_positions_in_reverse_order() -> None:
    shaking = replace(_SHAKING, sine=_SHAKING.sine + 0.01, cosine=_SHAKING.cosine - 0.02)
    motion = CameraMotion(np.array([0.3, 0.1, -0.2]), np.array([0.2, -0.1, 0.1]), _HIGHER, shaking)
    assert motion.directed(motion.rotation) is motion
    back = motion.directed(-motion.rotation)
    assert back.rotation == pytest.approx(-motion.rotation)
    assert positions(_PINHOLE, back, _STARS, -_TIME) == pytest.approx(
        positions(_PINHOLE, motion, _STARS, _TIME), abs=1e-6
    )
    assert not motion.smooth.vibration.exists
    assert motion.smooth.rate is motion.rate
    steady, rising = CameraMotion.steady(motion.rate), CameraMotion(motion.rate, motion.acceleration)
    assert (steady.constant, steady.accelerates) == (True, False)
    assert (rising.constant, rising.accelerates) == (False, True)
    assert (replace(steady, vibration=shaking).constant, replace(steady, vibration=shaking).accelerates) == (
        False,
        False,
    )
    assert replace(steady, higher_terms=_HIGHER).accelerates


def test_the_image_flow_is_the_velocity_at_a_rate() -> None:
    for camera in (_PINHOLE, _LENS, _STRONG_LENS):
        flow = image_flow(camera, _STARS)
        for axis in np.eye(3):
            ahead, behind = (
                positions(camera, CameraMotion.steady(axis), camera_points, np.full(20, t))
                for camera_points, t in ((_STARS, 1e-6), (_STARS, -1e-6))
            )
            velocity = (ahead - behind) / 2e-6
            assert flow @ axis == pytest.approx(velocity, rel=1e-5, abs=1e-3)


def test_a_binned_lens_has_the_same_distortion() -> None:
    small = _LENS.binned(256, 256, 4)
    binned = (_STARS + 0.5) / 4.0 - 0.5
    # The corners of the two detectors differ by 0.4 px, which changes the cubic distortion by 0.6 %.
    assert small.distorted(binned) == pytest.approx((_LENS.distorted(_STARS) + 0.5) / 4.0 - 0.5, abs=0.01)
    assert (small.columns, small.rows, small.focal_length) == (256, 256, 2903.0 / 4.0)


def test_rows_are_exposed_later_with_their_distance_from_the_middle_row() -> None:
    shutter = Shutter(2e-3, 100.0)
    assert shutter.delay(np.array([100.0, 150.0, 60.0])) == pytest.approx([0.0, 0.1, -0.08])
    assert shutter.delay(np.array([1.0], dtype=np.float32)).dtype == np.float32


def test_a_streak_is_complete_if_both_ends_are_far_enough_inside_the_detector() -> None:
    shutter, stars = Shutter(3e-4, 411.5), np.array([[500.0, 300.0], [100.0, 400.0], [1018.0, 400.0]])
    first, last = (
        positions(_PINHOLE, _MOTION, stars, time)
        for time in exposure_bounds(_PINHOLE, _MOTION, shutter, stars).T
    )
    assert complete_streaks(_PINHOLE, _MOTION, shutter, stars).tolist() == [True, True, False]
    # The left border of the detector is at -0.5 px.
    inside = min(first[1, 0], last[1, 0]) + 0.5
    for margin, complete in ((inside - 0.01, True), (inside + 0.01, False)):
        found = complete_streaks(_PINHOLE, _MOTION, shutter, stars, margin)
        assert found.tolist() == [True, complete, False]


def test_a_star_is_exposed_while_its_row_is_exposed() -> None:
    """A star's exposure starts and ends with that of the row in which the star is at that time.

    A star below or above the detector has the times of the nearest row.
    """
    shutter = Shutter(3e-4, 411.5)
    stars = np.array([[500.0, 300.0], [200.0, 700.0], [800.0, 5000.0], [800.0, -900.0]])
    bounds = exposure_bounds(_PINHOLE, _MOTION, shutter, stars)
    for end, nominal in enumerate((-0.5, 0.5)):
        row = positions(_PINHOLE, _MOTION, stars, bounds[:, end])[:, 1]
        expected = nominal + (np.clip(row, 0.0, 823.0) - 411.5) * 3e-4
        assert bounds[:, end] == pytest.approx(expected, abs=1e-6)
    assert exposure_bounds(_PINHOLE, _MOTION, Shutter(), stars) == pytest.approx(
        np.tile([-0.5, 0.5], (4, 1)), abs=0.0
    )


def test_the_position_at_mid_exposure_follows_from_the_middle_of_the_streak() -> None:
    """The middle of a streak is at half the angle between its ends, and at the time of its row."""
    growing = CameraMotion(np.array([0.0, 0.0, 0.3]), np.array([0.0, 0.0, 0.4]))
    halfway = np.full(20, 0.4 / 8.0)  # the mean of the angles -0.1 and 0.2 rad at start and end
    middles = _stars_on_circles(_TIME, halfway, _STARS)
    assert mid_exposure_positions(_PINHOLE, growing, Shutter(), middles) == pytest.approx(_STARS, abs=1e-6)
    steady, shutter = CameraMotion.steady(np.array([0.02, 0.01, 0.3])), Shutter(2e-4, 300.0)
    time = np.zeros(20)
    for _ in range(20):
        time = 2e-4 * (positions(_PINHOLE, steady, _STARS, time)[:, 1] - 300.0)
    seen = positions(_PINHOLE, steady, _STARS, time)
    assert np.abs(seen - _STARS).max() > 1.0
    assert mid_exposure_positions(_PINHOLE, steady, shutter, seen) == pytest.approx(_STARS, abs=1e-6)
    assert len(mid_exposure_positions(_PINHOLE, steady, shutter, np.zeros((0, 2)))) == 0


def test_a_path_about_the_boresight_is_an_arc() -> None:
    motion = CameraMotion(np.array([0.0, 0.0, 0.6]), np.array([0.0, 0.0, 0.5]))
    radius = np.hypot(*(_STARS - _CENTRE).T)
    assert path_lengths(_PINHOLE, motion, _STARS) == pytest.approx(0.6 * radius, rel=2e-3)


def test_stars_have_polar_coordinates_about_the_rotation_axis() -> None:
    offset = _STARS - _CENTRE
    for sign in (1.0, -1.0):
        motion = CameraMotion.steady(np.array([0.0, 0.0, 0.2 * sign]))
        polar, azimuth = polar_angles(_PINHOLE, motion, _STARS)
        angle = np.arctan(np.hypot(*offset.T) / 2903.0)
        assert polar == pytest.approx(angle if sign > 0.0 else np.pi - angle)
        turned = np.arctan2(offset[:, 1], offset[:, 0])
        apart = np.abs(np.exp(1j * turned[:, None]) - np.exp(1j * turned))
        assert np.abs(np.exp(1j * azimuth[:, None]) - np.exp(1j * azimuth)) == pytest.approx(apart, abs=1e-9)
        about = np.exp(1j * sign * (azimuth[1:] - azimuth[:-1]))
        assert about == pytest.approx(np.exp(1j * (turned[1:] - turned[:-1])))
    tilted = polar_angles(_PINHOLE, CameraMotion.steady(np.array([3.0, 0.0, 4.0])), _CENTRE[None])[0]
    assert tilted == pytest.approx([np.arctan2(3.0, 4.0)])


def test_azimuths_differ_by_at_most_half_a_turn() -> None:
    found = azimuth_differences(np.array([[3.0], [-1.0]]), np.array([-3.0, 0.5, 3.0]))
    expected = np.array([[2.0 * np.pi - 6.0, 2.5, 0.0], [2.0, 1.5, 2.0 * np.pi - 4.0]])
    assert found == pytest.approx(expected)


@pytest.mark.parametrize(
    ("radius", "angle", "near"),
    [
        (200.0, 0.49, True),
        (200.0, -0.49, True),
        (200.0, 0.51, False),
        (200.0, -0.51, False),
        (218.0, 0.3, True),
        (222.0, 0.3, False),
        (182.0, 0.3, True),
        (178.0, 0.3, False),
    ],
)
def test_streaks_are_near_if_their_arcs_pass_within_the_distance(
    radius: float, angle: float, near: bool
) -> None:
    """Two arcs of 0.4 rad are near if the gap along the arc or across it is less than 20 px.

    At a radius of 200 px, 20 px along the arc are 0.1 rad.
    """
    motion = CameraMotion.steady(np.array([0.0, 0.0, 0.4]))
    one = _CENTRE + np.array([[200.0, 0.0], [-10.0, 0.0]])
    other = _CENTRE + radius * np.array([[np.cos(angle), np.sin(angle)]])
    assert near_streaks(_PINHOLE, motion, other, one, 20.0).tolist() == [near]


def test_a_course_has_the_mean_rates_and_their_linear_change() -> None:
    time = np.linspace(-0.5, 0.5, 21)[:, None]
    first, slope = np.array([0.3, -0.1, 0.2]), np.array([0.05, 0.4, -0.1])
    course = Course.of_rates(first + slope * time, 0.2, 0.003)
    assert course.terms[0] == pytest.approx(0.2 * first)
    assert course.terms[1] == pytest.approx(0.1 * slope)
    assert np.abs(course.terms[2:]).max() < 1e-9
    assert course.sigma == pytest.approx(0.2 * 0.003)
    ripple = np.where(np.arange(21)[:, None] % 2 == 0, 0.03, -0.03) * np.array([1.0, 0.0, 0.0])
    # A polynomial with seven coefficients follows a little of the ripple.
    rough = Course.of_rates(first + slope * time + ripple, 0.2, 0.04)
    assert rough.sigma == pytest.approx(0.2 * 0.05, rel=0.1)
    assert course.covariance(0.2) == pytest.approx(np.eye(3) * (geometry._COURSE_SHARE * 0.003) ** 2)


@pytest.mark.parametrize(
    ("share", "sigma", "used"), [(1.05, 0.98, True), (0.95, 0.98, False), (1.05, 1.02, False)]
)
def test_a_course_is_used_if_it_is_certain_and_not_uniform(share: float, sigma: float, used: bool) -> None:
    """A predicted rotation is used if it moves stars non-uniformly and if its error in the image is small.

    For a constant acceleration g, the departure g t^2/2 varies by g/8 within the exposure.
    """
    focal = 1000.0
    growth = 8.0 * share * geometry._UNEVEN / focal
    terms = np.array([[0.1, 0.0, 0.0], [0.5 * growth, 0.0, 0.0], [0.0, 0.0, 0.0]])
    motion = Course(terms, sigma * geometry._MOST_VAGUE / focal).motion(focal)
    assert (motion is not None) == used
    if motion is not None:
        assert motion.rate == pytest.approx([0.1, 0.0, 0.0])
        assert motion.acceleration == pytest.approx([growth, 0.0, 0.0])
        assert motion.higher_terms.shape == (1, 3)
