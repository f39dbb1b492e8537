"""Tests that all attributes of estimated motions equal the recorded values to five digits."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from knightcube.vision.camera.lens import CameraKnowledge, Lens
from knightcube.vision.streaks.estimate import estimate_motion, estimate_rate
from knightcube.vision.streaks.geometry import Course
from knightcube.vision.streaks.streak_result import LikelihoodSettings, MotionResult
from sim_hal.star_camera import scatter_hot_pixels
from tests.knightcube.vision.streaks.scenes import CAMERA, SATURATION, Scene, real_sky, taken, turn_of
from tests.support.recorded_results import check

SMALL = replace(CAMERA, columns=400, rows=400)
SETTINGS = LikelihoodSettings(saturation=SATURATION)


def scene(seed: int, theta: float, length: float, exposure: float = 0.2, **camera: Any) -> Scene:
    """Return a frame of 400 x 400 px."""
    return real_sky(seed, theta, length, exposure, replace(SMALL, **camera))


def found(one: Scene, settings: LikelihoodSettings = SETTINGS) -> MotionResult:
    """Return the motion of a frame, with a prior that gives the direction of time."""
    return estimate_motion(one.pixels, one.camera.pinhole, one.exposure, settings, one.rate, 1e-3)


def test_the_motion_about_an_axis_across_the_boresight_is_as_recorded() -> None:
    check(__file__, "across", found(scene(1, 1.5, 40.0)))


def test_the_motion_about_an_oblique_axis_is_as_recorded() -> None:
    check(__file__, "oblique", found(scene(2, 0.7, 60.0)))


def test_the_motion_about_the_boresight_is_as_recorded() -> None:
    check(__file__, "boresight", found(scene(3, 0.05, 50.0)))


def test_the_motion_without_a_prior_is_as_recorded() -> None:
    one = scene(4, 1.2, 30.0)
    check(__file__, "ambiguous", estimate_motion(one.pixels, one.camera.pinhole, 0.2, SETTINGS))


def test_the_motion_of_short_streaks_is_as_recorded() -> None:
    check(__file__, "short", found(scene(5, 0.8, 6.0)))


def test_stars_at_rest_are_as_recorded() -> None:
    check(__file__, "rest", found(scene(6, 1.5, 1e-3)))


def test_the_motion_of_long_streaks_is_as_recorded() -> None:
    check(__file__, "long", found(scene(7, 1.1, 150.0)))


def test_an_accelerated_motion_is_as_recorded() -> None:
    turn = turn_of(1.2, 50.0, 0.4, SMALL)
    one = taken(np.random.default_rng(8), turn, 0.6 * turn, 0.2, SMALL)
    check(__file__, "accelerated", found(one, replace(SETTINGS, rate_model="accelerating")))


def test_a_motion_seen_through_a_rolling_shutter_is_as_recorded() -> None:
    settings = replace(SETTINGS, line_time=1e-4)
    check(__file__, "rolling", found(scene(9, 1.0, 40.0, line_time=1e-4), settings))


def test_a_motion_with_an_uncertain_camera_is_as_recorded() -> None:
    knowledge = CameraKnowledge(focal_length=3e-3, centre=4.0, distortion=2e-3, line_time=1e-5)
    check(__file__, "uncertain", found(scene(10, 1.0, 40.0), replace(SETTINGS, knowledge=knowledge)))


def test_a_frame_of_hot_pixels_and_stray_light_is_as_recorded() -> None:
    camera = scatter_hot_pixels(SMALL, 60, 3000.0, np.random.default_rng(3))
    one = real_sky(11, 0.9, 30.0, 0.5, replace(camera, background_gradient=(0.2, -0.1)))
    check(__file__, "hot", found(one))


def test_a_motion_with_the_course_from_navigation_is_as_recorded() -> None:
    one = scene(12, 1.3, 45.0)
    rates = one.rate * np.linspace(0.8, 1.2, 17)[:, None]
    course = Course.of_rates(rates, 0.2, 1e-4)
    result = estimate_motion(
        one.pixels, one.camera.pinhole, 0.2, SETTINGS, one.rate, 1e-3, prior_course=course
    )
    check(__file__, "course", result)


def test_a_motion_through_a_calibrated_lens_is_as_recorded() -> None:
    one = scene(13, 1.0, 40.0)
    pinhole = one.camera.pinhole
    lens = Lens(400, 400, pinhole.focal_length, (201.0, 198.5), 1e-3, 0.0)
    result = estimate_rate(one.pixels, lens, 0.2, prior_rate=one.rate, prior_sigma=1e-3, settings=SETTINGS)
    check(__file__, "lens", result)


def test_a_crowded_frame_of_faint_stars_is_as_recorded() -> None:
    check(__file__, "faint", found(scene(22, 1.2, 25.0, 1.0)))


def test_a_frame_in_8_bits_is_as_recorded() -> None:
    one = scene(23, 0.9, 50.0, bits=8, gain=16.0, pedestal=20.0)
    check(__file__, "8 bits", found(one, LikelihoodSettings(saturation=255.0, gain=16.0)))


def test_frames_without_a_motion_are_as_recorded() -> None:
    rng = np.random.default_rng(24)
    noise = rng.normal(100.0, 10.0, (300, 300)).astype(np.uint16)
    pinhole = replace(SMALL, columns=300, rows=300).pinhole
    frames = [noise, np.zeros((300, 300), np.uint16), np.full((300, 300), 4095, np.uint16)]
    check(__file__, "no motion", [estimate_motion(frame, pinhole, 0.2, SETTINGS) for frame in frames])
