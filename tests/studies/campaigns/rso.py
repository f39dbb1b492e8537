"""Scenes of an object among stars, and the object search, for the campaign `rso-orbits` and its plots."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ground.campaigns.runner import Result
from knightcube.astro.arrays import FloatArray, Image
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, multiply, normalise
from knightcube.reference.corner_streaks import StreakSettings
from knightcube.vision.objects.detect import ObjectReport, detect
from knightcube.vision.objects.settings import ObjectSettings
from knightcube.vision.streaks.estimate import estimate_motion
from knightcube.vision.streaks.streak_result import LikelihoodSettings
from sim_hal.star_camera import SourceTrack, StarCameraModel, render
from tests.pace import warm_call
from tests.studies.campaigns.statistics import median
from tests.support.scenes import SAMPLES, catalogue

EXPOSURE = 0.5
SLEW_RATE = 0.05
TRACK_RATE = float(np.deg2rad(2.0))
STAR_LIMIT = 8.5
MATCH_PX = 4.0
# Smallest distance (px) of an object from the border, because the thesis also uses only complete streaks.
MARGIN_PX = 20.0
# Slowest and fastest motion (rad/s) of an object among the stars: streaks of 9 to 87 px.
SLOWEST, FASTEST = 0.006, 0.06


@dataclass(frozen=True, slots=True, eq=False)
class Sky:
    """A scene without noise: attitudes (k, 4) at times (k,), s, and the object's directions at these times.

    `rate` (3,) is the camera's rate in rad/s, and `path` (k, 2) the object's path in px.
    """

    rate: FloatArray
    times: FloatArray
    attitudes: FloatArray
    directions: FloatArray
    path: FloatArray

    def frame(self, camera: StarCameraModel, magnitude: float | None, rng: np.random.Generator) -> Image:
        """Return the frame with the object at `magnitude`, or without it."""
        stars, directions = catalogue(STAR_LIMIT)
        tracks = [] if magnitude is None else [SourceTrack(self.times, self.directions, magnitude)]
        return render(camera, directions, stars.magnitude, self.times, self.attitudes, rng, tracks)


@dataclass(frozen=True, slots=True)
class Found:
    """Detections in one report: error (px) of the true object's ends, or None for a missed object.

    `false` counts detections of objects that do not exist.
    """

    error: float | None
    false: int


def draw_sky(camera: StarCameraModel, generator: np.random.Generator, tracked: bool) -> Sky:
    """Return a random pointing and an object that stays in the frame."""
    rate = np.array([0.0, TRACK_RATE if tracked else SLEW_RATE, 0.0])
    times = np.linspace(0.0, EXPOSURE, SAMPLES)
    middle = normalise(generator.normal(size=4))
    since = (times - 0.5 * EXPOSURE)[:, None]
    attitudes = multiply(from_rotation_vector(since * rate), middle)
    pinhole = camera.pinhole
    while True:
        place = pinhole.unit_vectors(generator.uniform(MARGIN_PX, camera.columns - MARGIN_PX, (1, 2)))[0]
        motion = rate if tracked else _motion(generator, place)
        # In the axes of the middle attitude, a camera that rotates by `motion` follows the object.
        among_stars = np.swapaxes(attitude_matrix(from_rotation_vector(since * motion)), 1, 2) @ place
        directions = among_stars @ attitude_matrix(middle)
        seen = (attitude_matrix(attitudes) @ directions[..., None])[..., 0]
        path = pinhole.project(seen)
        if np.all(pinhole.contains(path, -MARGIN_PX)):
            return Sky(rate, times, attitudes, directions, path)


def _motion(generator: np.random.Generator, place: FloatArray) -> FloatArray:
    """Return a rotation (3,), rad/s, normal to `place`; the logarithm of its speed is uniform."""
    speed = np.exp(generator.uniform(np.log(SLOWEST), np.log(FASTEST)))
    axis = np.cross(place, generator.normal(size=3))
    return np.asarray(speed * axis / np.linalg.norm(axis))


def look(pixels: Image, camera: StarCameraModel, rate: FloatArray) -> tuple[ObjectReport | None, float]:
    """Return the report on a frame by the likelihood estimate, and the processor time (s)."""
    return warm_call("rso", lambda: _look(pixels, camera, rate))


def _look(pixels: Image, camera: StarCameraModel, rate: FloatArray) -> ObjectReport | None:
    settings = StreakSettings(saturation=float(camera.highest_count), gain=camera.gain)
    likelihood = LikelihoodSettings(saturation=settings.saturation, gain=settings.gain, line_time=0.0)
    motion = estimate_motion(pixels, camera.pinhole, EXPOSURE, likelihood, rate, 0.0)
    if motion.rate is None:
        return None
    turn = motion.rate * EXPOSURE
    return detect(pixels, camera.pinhole, turn, EXPOSURE, settings, ObjectSettings())


def match(report: ObjectReport | None, truth: FloatArray | None) -> Found:
    """Return the detection of the true object with ends (2, 2), px, and the number of false detections."""
    if report is None:
        return Found(None, 0)
    if truth is None:
        return Found(None, len(report.objects))
    errors = [ends_error(item.endpoints, truth) for item in report.objects]
    hits = [error for error in errors if error < MATCH_PX]
    # A second detection of the same object is false too.
    return Found(min(hits, default=None), len(errors) - min(len(hits), 1))


def ends_error(ends: FloatArray, truth: FloatArray) -> float:
    """Return the larger error of two ends (2, 2), px; a frame does not show which end came first."""
    return float(min(np.linalg.norm(ends - other, axis=1).max() for other in (truth, truth[::-1])))


def by_magnitude(results: Sequence[Result], magnitude: float) -> dict[str, Any]:
    """Return the number of detected objects of a magnitude, and their errors."""
    here = [r for r in results if r["magnitude"] == magnitude]
    errors = [r["error_px"] for r in here if r["error_px"] is not None]
    return {
        "magnitude": magnitude,
        "frames": len(here),
        "found": len(errors),
        "error_px": median(errors),
        "false": sum(r["false"] for r in here),
    }
