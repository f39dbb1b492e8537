"""Tests of initial guesses of axis and angle, from the bright regions of simulated frames."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.vision.streaks.first_guess import (
    find_axis,
    guess_axis,
    measured_rate_change,
    motion_by_course,
    motions_by_length,
    motions_by_scan,
)
from knightcube.vision.streaks.frame import BrightRegions, ReducedFrame, find_bright_regions, reduce_frame
from knightcube.vision.streaks.geometry import CameraMotion
from tests.knightcube.vision.streaks.scenes import CAMERA, SATURATION, Scene, real_sky, taken, turn_of


def _regions(scene: Scene) -> tuple[ReducedFrame, BrightRegions]:
    frame = reduce_frame(scene.pixels, SATURATION, 1.0)
    return frame, find_bright_regions(frame, 4.5, 48)


@pytest.mark.parametrize(("theta", "length"), [(90.0, 60.0), (50.0, 150.0), (3.0, 150.0)])
def test_regions_give_axis_and_angle(theta: float, length: float) -> None:
    """Bright regions give the axis and the angle of the rotation.

    The orientation of a region is uncertain by about 1 px over its length.
    """
    scene = real_sky(71, np.radians(theta), length, 0.5)
    rotation = scene.rate * scene.exposure
    angle = float(np.linalg.norm(rotation))
    _, regions = _regions(scene)
    guess = find_axis(regions, CAMERA.pinhole)
    assert guess is not None
    assert abs(guess.frame[2] @ rotation) / angle > np.cos(2.0 / length)
    assert guess.frame @ guess.frame.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.count_nonzero(guess.agree) > 0.8 * len(regions)
    best = motions_by_length(guess, regions, CAMERA.pinhole, 12)[0]
    assert float(np.linalg.norm(best.motion.rate)) == pytest.approx(angle, rel=0.03)
    assert best.motion.constant
    assert len(best.stars) == len(best.light) <= 12
    distance = np.linalg.norm(best.stars[:, None] - scene.stars, axis=2).min(axis=1)
    assert np.median(distance) < 2.0


def test_fewer_than_two_long_regions_give_no_axis() -> None:
    frame, _ = _regions(real_sky(72, 1.2, 60.0, 0.5))
    regions = find_bright_regions(frame, 4.5, 1)
    assert len(regions) == 1
    assert guess_axis(regions, CAMERA.pinhole) is None
    assert find_axis(regions, CAMERA.pinhole) is None


def test_a_scan_along_the_circles_gives_the_angle_nearest_to_a_prior_first() -> None:
    scene = real_sky(73, np.radians(70.0), 400.0, 0.5)
    angle = float(np.linalg.norm(scene.rate * scene.exposure))
    frame, regions = _regions(scene)
    guess = find_axis(regions, CAMERA.pinhole)
    assert guess is not None
    found = next(motions_by_scan(guess, frame, CAMERA.pinhole, 12, angle))
    assert float(np.linalg.norm(found.motion.rate)) == pytest.approx(angle, rel=0.02)


@pytest.mark.parametrize("growth", [1.5, -1.5])
def test_the_asymmetry_of_regions_shows_a_change_of_the_rate(growth: float) -> None:
    """The asymmetry of the regions shows whether the rate increases or decreases during the exposure.

    The guessed axis may be opposite to the true axis, so the change has a sign relative to the guessed
    rotation.
    """
    rotation = turn_of(np.radians(70.0), 120.0, 0.4)
    scene = taken(np.random.default_rng(74), rotation, growth * rotation, 0.5)
    _, regions = _regions(scene)
    guess = find_axis(regions, CAMERA.pinhole)
    assert guess is not None
    change = measured_rate_change(guess, regions)
    reverse = np.sign(guess.frame[2] @ rotation)
    assert change * reverse == pytest.approx(growth, abs=0.4)
    best = motions_by_length(guess, regions, CAMERA.pinhole, 12, change)[0]
    assert best.motion.acceleration == pytest.approx(change * best.motion.rate)


def test_a_constant_rate_shows_no_change() -> None:
    _, regions = _regions(real_sky(75, np.radians(70.0), 120.0, 0.5))
    guess = find_axis(regions, CAMERA.pinhole)
    assert guess is not None
    assert measured_rate_change(guess, regions) == 0.0


def test_a_known_motion_selects_the_entire_regions_of_its_length() -> None:
    scene = real_sky(76, np.radians(70.0), 80.0, 0.5)
    _, regions = _regions(scene)
    course = CameraMotion.steady(scene.rate * scene.exposure)
    found = motion_by_course(course, regions, CAMERA.pinhole, 12)
    assert found.motion is course
    assert 4 <= len(found.stars) <= 12
    distance = np.linalg.norm(found.stars[:, None] - scene.stars, axis=2).min(axis=1)
    assert np.median(distance) < 1.0
    longer = motion_by_course(CameraMotion.steady(3.0 * course.rate), regions, CAMERA.pinhole, 12)
    assert len(longer.stars) < len(found.stars)
