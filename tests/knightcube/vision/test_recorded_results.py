"""Tests that Sun directions, solar strings, lens calibration and frame jobs give their recorded results.

The new results must equal the recorded results to five digits.
"""

from __future__ import annotations

import numpy as np

from flight.bodies.streak_methods import CornerEstimator
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, multiply, normalise
from knightcube.reference.corner_streaks import StreakSettings
from knightcube.vision.camera.lens import Lens, Pinhole
from knightcube.vision.frame_job import FrameFound, FrameJob, StreakEstimator, TrackerSettings, run
from knightcube.vision.lens_calibration import calibrate, calibrate_determined, lens_accuracy
from knightcube.vision.lens_knowledge import MatchedFrame
from knightcube.vision.solar_cells import SolarStringModel, coarse_sun
from knightcube.vision.star_tracker import StarTracker
from knightcube.vision.startracker.solve import AttitudePrior, RatePrior, SolveSettings
from knightcube.vision.streaks.streak_result import LikelihoodSettings
from knightcube.vision.sun import find_sun
from sim_hal.earth_camera import render
from sim_hal.star_camera import StarCameraModel
from tests.knightcube.vision.startracker.frames import SkyFrame, sky_frame
from tests.sim_hal.earth_camera.scenes import random_sun_scene
from tests.support.recorded_results import check
from tests.support.sun_frames import CAMERAS

CAMERA = StarCameraModel(columns=512, rows=512, field_of_view=float(np.radians(16.0)))


def frame(seed: int, streak_px: float) -> SkyFrame:
    """Return a frame of the real sky."""
    return sky_frame(np.random.default_rng([92, seed]), streak_px, 0.2, CAMERA)


def found(one: SkyFrame, estimator: LikelihoodSettings | StreakEstimator, near: bool) -> FrameFound:
    """Return the result of a frame's job, with a prior attitude if `near` is true."""
    off = multiply(from_rotation_vector(np.array([2e-4, -1e-4, 1e-4])), one.attitude)
    prior = AttitudePrior(off, 3e-4) if near else None
    tracker = TrackerSettings(SolveSettings(), (1.0, 1.0))
    rate = RatePrior(one.rate, 1e-4)
    return run(FrameJob(one.pixels, CAMERA.pinhole, one.exposure, estimator, tracker, rate, prior, None))


def test_a_job_on_streaks_is_as_recorded() -> None:
    check(__file__, "streaks", found(frame(1, 40.0), LikelihoodSettings(saturation=4095.0), True))


def test_a_job_on_points_is_as_recorded() -> None:
    check(__file__, "points", found(frame(2, 0.0), LikelihoodSettings(saturation=4095.0), False))


def test_a_job_on_short_trails_is_as_recorded() -> None:
    check(__file__, "trails", found(frame(3, 2.0), LikelihoodSettings(saturation=4095.0), True))


def test_a_job_with_the_corner_estimator_is_as_recorded() -> None:
    check(__file__, "corners", found(frame(4, 50.0), CornerEstimator(StreakSettings()), True))


def test_the_star_tracker_is_as_recorded() -> None:
    solution = StarTracker(16.0, 0.2).solve(frame(5, 0.0).pixels)
    check(__file__, "tracker", [solution.frame, solution.stars, solution.covariance, solution.quaternion])


def check_sun(name: str) -> None:
    """Compare the Sun direction in a camera's frame with the recorded direction."""
    model, settings = CAMERAS[name]
    scene = random_sun_scene(np.random.default_rng(21), model)
    pixels = render(model, scene, np.random.default_rng(22))
    check(__file__, f"sun {name}", find_sun(pixels, model.lens, settings))


def test_the_sun_in_a_logarithmic_camera_is_as_recorded() -> None:
    check_sun("logarithmic")


def test_the_sun_in_a_linear_camera_is_as_recorded() -> None:
    check_sun("linear")


def test_the_coarse_sun_of_solar_strings_is_as_recorded() -> None:
    strings = SolarStringModel()
    rng = np.random.default_rng(23)
    results = []
    for number in range(12):
        sun = normalise(rng.standard_normal(3))
        nadir = normalise(rng.standard_normal(3)) if number % 2 else None
        light = np.maximum(strings.normals @ sun, 0.0) + 0.1 * np.maximum(strings.normals @ -sun, 0.0)
        level = (1.0, 0.6, 0.05)[number % 3]
        results.append(coarse_sun(level * strings.peaks * light, strings, nadir))
    check(__file__, "strings", results)


def matched(lens: Lens, count: int, wrong: float) -> list[MatchedFrame]:
    """Return frames of matched stars. The fraction `wrong` of the matches is wrong."""
    rng = np.random.default_rng(24)
    frames = []
    for _ in range(count):
        attitude = normalise(rng.normal(size=4))
        points = rng.uniform(0.0, 1023.0, (20, 2))
        directions = lens.unit_vectors(points) @ attitude_matrix(attitude)
        sigma = 0.1 * rng.uniform(0.5, 2.0, 20)
        exchanged = np.flatnonzero(rng.uniform(size=20) < wrong)
        directions[exchanged] = directions[np.roll(exchanged, 1)]
        frames.append(MatchedFrame(points + sigma[:, None] * rng.normal(size=(20, 2)), sigma, directions))
    return frames


def test_the_calibration_of_a_lens_is_as_recorded() -> None:
    begun = Pinhole.from_field_of_view(1024, 1024, np.radians(20.0))
    lens = Lens(1024, 1024, 1.01 * begun.focal_length, (505.0, 520.0), -0.1, 0.05)
    results = [calibrate(matched(lens, 4, wrong), begun) for wrong in (0.0, 0.1)]
    check(__file__, "calibrated", results)
    check(__file__, "accuracy", lens_accuracy(results[1], results[0], {}))


def test_a_calibration_that_leaves_terms_out_is_as_recorded() -> None:
    begun = Pinhole.from_field_of_view(1024, 1024, np.radians(3.0))
    lens = Lens(1024, 1024, 1.01 * begun.focal_length, (515.0, 510.0))
    check(__file__, "determined", calibrate_determined(matched(lens, 3, 0.0), begun))
