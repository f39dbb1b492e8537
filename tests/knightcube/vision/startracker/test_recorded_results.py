"""Tests that attitudes and detections of small simulated frames equal the record to five digits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from knightcube.astro.arrays import Image
from knightcube.astro.quaternion import from_rotation_vector, multiply
from knightcube.reference.star_identification import DEFAULT_METHOD, method_of
from knightcube.vision.camera.lens import CameraKnowledge, Pinhole
from knightcube.vision.frame_job import solve_frame
from knightcube.vision.startracker.catalogue_refit import refit_with_catalogue
from knightcube.vision.startracker.detect import detect, measure_near
from knightcube.vision.startracker.image_fit import Unknowns, fit_in_image
from knightcube.vision.startracker.solve import (
    AttitudePrior,
    FrameSolution,
    RatePrior,
    SolveSettings,
    solve_motion,
)
from knightcube.vision.startracker.survey import DetectionSettings, survey
from knightcube.vision.streaks.estimate import estimate_motion
from knightcube.vision.streaks.streak_result import LikelihoodSettings
from sim_hal.star_camera import StarCameraModel
from tests.knightcube.vision.startracker.frames import SkyFrame, sky, sky_frame
from tests.support.recorded_results import check
from tests.support.star_lists import ListKind, draw, draw_random

CAMERA = StarCameraModel(columns=512, rows=512, field_of_view=float(np.radians(16.0)))
EXACT = SolveSettings(uncalibrated_lens=False)


def frame(seed: int, streak_px: float) -> SkyFrame:
    """Return a frame of the real sky."""
    return sky_frame(np.random.default_rng([91, seed]), streak_px, 0.2, CAMERA)


def solved(
    one: SkyFrame,
    settings: SolveSettings = EXACT,
    near: bool = False,
    scale: tuple[float, float] = (1.0, 1.0),
    camera: Pinhole | None = None,
) -> FrameSolution:
    """Return the solution of a frame, with a prior attitude if `near` is true."""
    off = multiply(from_rotation_vector(np.array([2e-4, -3e-4, 1e-4])), one.attitude)
    prior = AttitudePrior(off, 3e-4) if near else None
    rate = RatePrior(one.rate, 1e-5)
    lens = camera or CAMERA.pinhole
    return solve_frame(one.pixels, lens, scale, one.exposure, sky(), settings, prior, rate)


def test_points_that_are_identified_in_the_whole_sky_are_as_recorded() -> None:
    check(__file__, "lost in space", solved(frame(1, 0.0)))


def test_points_near_a_prior_attitude_are_as_recorded() -> None:
    check(__file__, "near", solved(frame(2, 0.0), near=True))


def test_streaks_that_are_identified_in_the_whole_sky_are_as_recorded() -> None:
    check(__file__, "streaks", solved(frame(3, 30.0)))


def test_streaks_near_a_prior_attitude_are_as_recorded() -> None:
    check(__file__, "streaks near", solved(frame(4, 40.0), near=True))


def test_points_through_a_lens_of_unknown_focal_length_are_as_recorded() -> None:
    pinhole = CAMERA.pinhole
    wrong = Pinhole(pinhole.columns, pinhole.rows, 1.012 * pinhole.focal_length)
    check(__file__, "scale", solved(frame(5, 0.0), scale=(0.97, 1.03), camera=wrong))


def test_points_through_an_uncalibrated_lens_are_as_recorded() -> None:
    check(__file__, "uncalibrated", solved(frame(6, 0.0), SolveSettings(), scale=(0.99, 1.01)))


def test_points_with_an_uncertain_lens_and_a_velocity_are_as_recorded() -> None:
    lens = CameraKnowledge(focal_length=1e-3, centre=3.0, distortion=1e-3)
    settings = replace(EXACT, lens=lens, velocity=np.array([1e4, 2e4, -1.5e4]))
    check(__file__, "uncertain lens", solved(frame(7, 0.0), settings, near=True))


def test_a_frame_of_noise_is_as_recorded() -> None:
    noise = np.random.default_rng(3).normal(100.0, 10.0, (256, 256)).astype(np.uint16)
    camera = Pinhole(256, 256, 1000.0)
    check(__file__, "noise", solve_frame(noise, camera, (1.0, 1.0), 0.2, sky(), EXACT, None, None))


def test_the_second_fit_with_catalogue_stars_is_as_recorded() -> None:
    one = frame(8, 60.0)
    likelihood = LikelihoodSettings(saturation=float(CAMERA.highest_count), line_time=0.0)
    settings = SolveSettings(likelihood=likelihood)
    motion = estimate_motion(one.pixels, CAMERA.pinhole, 0.2, likelihood, one.rate, 1e-4)
    first = solve_motion(
        motion, CAMERA.pinhole, (1.0, 1.0), sky(), settings, AttitudePrior(one.attitude, 3e-4)
    )
    check(__file__, "refit", refit_with_catalogue(one.pixels, first, sky(), settings, likelihood))


def test_detections_are_as_recorded() -> None:
    pixels = frame(9, 0.0).pixels
    found = detect(pixels)
    check(__file__, "detected", [found, found.stars()])


def test_detections_by_other_centroids_are_as_recorded() -> None:
    pixels = frame(10, 0.0).pixels[:300, :300]
    check(__file__, "window", detect(pixels, DetectionSettings(method="window", gain=2.0, saturation=3000.0)))


def test_the_survey_of_points_and_of_streaks_is_as_recorded() -> None:
    check(__file__, "survey", [survey(frame(11, streak).pixels) for streak in (0.0, 40.0)])


def test_detections_near_predicted_places_are_as_recorded() -> None:
    one = frame(12, 0.0)
    places = one.stars[:25] + np.random.default_rng(5).normal(0.0, 0.4, (25, 2))
    check(__file__, "measured near", measure_near(one.pixels, places))


def test_the_fit_in_the_image_is_as_recorded() -> None:
    rng = np.random.default_rng(6)
    camera = Pinhole.from_field_of_view(1024, 1024, 0.3)
    points = rng.uniform(50.0, 970.0, (14, 2))
    root = rng.normal(0.0, 1.0, (14, 2, 2))
    covariance = root @ root.transpose(0, 2, 1) + 0.05 * np.eye(2)
    reference = camera.unit_vectors(points + rng.normal(0.0, 0.5, points.shape))
    start = from_rotation_vector(np.array([1e-3, -2e-3, 3e-3]))
    fits = [
        fit_in_image(points, covariance, reference, camera, start, Unknowns(free)) for free in (False, True)
    ]
    check(__file__, "image fit", fits)


def crowded() -> Image:
    """Return a frame with close pairs, a saturated star, hot pixels, a cosmic ray and stray light."""
    rng = np.random.default_rng(14)
    row, column = np.indices((240, 260))
    light = 300.0 + 0.5 * column + 60.0 * np.exp(-((row - 200.0) ** 2 + (column - 40.0) ** 2) / 800.0)
    places = rng.uniform(15.0, 225.0, (30, 2))
    places[1:8] = places[8:15] + rng.uniform(-4.0, 4.0, (7, 2))
    for number, (x, y) in enumerate(places):
        bell = np.exp(-0.5 * ((column - x) ** 2 + (row - y) ** 2) / 1.1**2)
        light += (4e5 if number == 20 else 9e3 / (1.0 + 0.3 * number)) * bell / 7.6
    light[rng.integers(0, 240, 25), rng.integers(0, 260, 25)] += 2500.0
    light[100, 60:110] += 1500.0
    return np.clip(light + rng.normal(0.0, 14.0, light.shape), 0, 4095).astype(np.uint16)


def test_detections_in_a_crowded_frame_are_as_recorded() -> None:
    found = detect(crowded(), DetectionSettings(saturation=4095.0))
    check(__file__, "crowded", [found, found.stars()])


def test_detections_in_a_crowded_frame_without_settings_are_as_recorded() -> None:
    check(__file__, "crowded plain", [survey(crowded()), detect(crowded()).stars()])


def test_stars_near_places_in_a_crowded_frame_are_as_recorded() -> None:
    places = np.random.default_rng(14).uniform(15.0, 225.0, (30, 2))
    trail = np.tile([2.0, 1.0], (30, 1))
    settings = DetectionSettings(saturation=4095.0)
    found = [measure_near(crowded(), places, settings), measure_near(crowded(), places, settings, trail)]
    check(__file__, "crowded near", found)


def test_an_image_of_floating_point_numbers_is_as_recorded() -> None:
    check(__file__, "floating", detect(crowded().astype(np.float64) / 4095.0))


def test_star_lists_are_identified_as_recorded() -> None:
    rng = np.random.default_rng(15)
    kind = ListKind(field_deg=14.0, noise_px=0.2, known_deg=0.1, faintest=6.0, false_stars=3, lost=0.1)
    stars = sky().stars
    lists = [draw(kind, stars, rng), draw(kind, stars, rng), draw_random(kind, 20, rng)]
    check(__file__, "lists", [method_of(DEFAULT_METHOD)(one.field(), sky()) for one in lists])
