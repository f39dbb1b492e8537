"""Photographs of the sky with known centres, and the star tracker's results for them."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from knightcube.astro.arrays import FloatArray, Image
from knightcube.astro.quaternion import attitude_matrix, conjugate, multiply, to_rotation_vector
from knightcube.vision.camera.images import read_image
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.frame_job import solve_frame
from knightcube.vision.startracker.sky_map import Pointing
from knightcube.vision.startracker.solve import AttitudePrior, FrameSolution, RatePrior, SolveSettings
from tests.knightcube.vision.startracker.frames import NARROW, SkyFrame, sky

PHOTOGRAPHS = Path(__file__).parents[3] / "shared" / "data" / "sky"


# Standard deviation (rad) of the prior attitude in tracking; it corresponds to 1.5 px.
_PRIOR_SIGMA = 3e-4


FIELD_SHARE = 0.05


_LOWEST_DEG, _HIGHEST_DEG = 10.0, 30.0


NARROW_DEG, _NARROW_KNOWN_DEG = 12.0, 0.1


ARCSECONDS = math.degrees(1.0) * 3600.0


@dataclass(frozen=True)
class Photograph:
    """Result for one photograph. Errors (arcsec) and times (ms) are NaN without a solution."""

    name: str
    known: bool
    solved: bool
    arcsec: float
    stars: int
    ms: float
    size: str = ""


def reduced(pixels: Image, columns: int, rows: int) -> Image:
    """Return an image of integers reduced to (rows, columns) by the mean over each larger pixel."""
    down, across = _areas(pixels.shape[0], rows), _areas(pixels.shape[1], columns)
    return np.rint(down @ pixels.astype(np.float64) @ across.T).astype(pixels.dtype)


def _areas(many: int, few: int) -> FloatArray:
    """Return the contributions (few, many) of `many` pixels along an axis to `few` larger pixels."""
    edges, step = np.arange(many, dtype=np.float64), many / few
    begin = step * np.arange(few)[:, None]
    overlap = np.minimum(edges + 1.0, begin + step) - np.maximum(edges, begin)
    return np.asarray(np.maximum(overlap, 0.0) / step)


def believed(pixels: Image, fov_deg: float, low: float, high: float) -> tuple[Pinhole, tuple[float, float]]:
    """Return a camera with a field of `fov_deg`, and its scales for fields from `low` to `high` (deg)."""
    middle = math.tan(0.5 * math.radians(fov_deg))
    rows, columns = pixels.shape
    scale = tuple(math.tan(0.5 * math.radians(angle)) / middle for angle in (low, high))
    return Pinhole(columns, rows, 0.5 * columns / middle), (scale[0], scale[1])


def photograph(
    folder: Path, name: str, truth: dict[str, float], known: bool, size: tuple[int, int] | None = None
) -> Photograph:
    """Return the star tracker's result for one photograph, which is first reduced if `size` is given."""
    pixels = read_image(folder / name)
    pixels = pixels if size is None else reduced(pixels, *size)
    shown = f"{pixels.shape[1]} x {pixels.shape[0]}"
    fov = truth["fov"]
    low, high = (
        (fov * (1.0 - FIELD_SHARE), fov * (1.0 + FIELD_SHARE)) if known else (_LOWEST_DEG, _HIGHEST_DEG)
    )
    camera, scale = believed(pixels, fov if known else 17.0, low, high)
    begin = time.process_time()
    found = solve_frame(pixels, camera, scale, 1.0, sky(), SolveSettings())
    ms = 1e3 * (time.process_time() - begin)
    if found.fix is None:
        return Photograph(name, known, False, math.nan, 0, ms, shown)
    pointing = Pointing.of(found.fix.quaternion)
    place = direction(pointing.right_ascension, pointing.declination)
    off = angle_arcsec(place, centre_of(truth))
    return Photograph(name, known, True, off, len(found.matched), ms, shown)


def centre_of(truth: dict[str, float]) -> FloatArray:
    """Return the direction (3,) of the centre of a photograph."""
    return direction(math.radians(truth["ra"]), math.radians(truth["dec"]))


def direction(right_ascension: float, declination: float) -> FloatArray:
    """Return the unit vector (3,) of a right ascension and declination."""
    cosine = math.cos(declination)
    return np.array(
        [cosine * math.cos(right_ascension), cosine * math.sin(right_ascension), math.sin(declination)]
    )


def angle_arcsec(one: FloatArray, other: FloatArray) -> float:
    """Return the angle (arcsec) between two unit vectors (3,)."""
    return ARCSECONDS * math.atan2(float(np.linalg.norm(np.cross(one, other))), float(one @ other))


@dataclass(frozen=True)
class Solved:
    """Result of one simulated frame: errors of attitude and rate, with their bounds, and times.

    Attributes:
        across: error (arcsec) of the boresight; NaN for a refusal.
        across_bound: lower bound (arcsec) of the rms error of the boresight.
        nees: squared error of the attitude over its covariance, per degree of freedom.
        rate, rate_bound: error and bound (%) of the rate's magnitude; NaN without a rate.
    """

    across: float
    across_bound: float
    nees: float
    rate: float
    rate_bound: float
    ms: float
    tracking_ms: float


def solved(scene: SkyFrame, length: float) -> Solved:
    """Return the star tracker's result for a simulated frame, both lost in space and with a prior."""
    low, high = NARROW_DEG - _NARROW_KNOWN_DEG, NARROW_DEG + _NARROW_KNOWN_DEG
    camera, scale = believed(scene.pixels, NARROW_DEG, low, high)
    rate_prior, settings = RatePrior(scene.rate, 1e-6), SolveSettings(uncalibrated_lens=False)
    prior = AttitudePrior(scene.attitude, _PRIOR_SIGMA)
    exposure = scene.exposure
    begin = time.process_time()
    found = solve_frame(scene.pixels, camera, scale, exposure, sky(), settings, None, rate_prior)
    middle = time.process_time()
    solve_frame(scene.pixels, NARROW.pinhole, (1.0, 1.0), exposure, sky(), settings, prior, rate_prior)
    tracked = time.process_time()
    bound = ARCSECONDS * math.sqrt(float(np.trace(scene.attitude_bound()[:2, :2])))
    across, nees, rate, rate_bound = math.nan, math.nan, math.nan, math.nan
    if found.fix is not None:
        boresights = (attitude_matrix(q)[2] for q in (found.fix.quaternion, scene.attitude))
        across, nees = angle_arcsec(*boresights), _nees(found, scene.attitude)
    if length and found.fix is not None and found.motion is not None and found.motion.rate is not None:
        speed = float(np.linalg.norm(scene.rate))
        rate = 100.0 * (float(np.linalg.norm(found.motion.rate)) / speed - 1.0)
        rate_bound = 100.0 * scene.rate_bound() / speed
    return Solved(across, bound, nees, rate, rate_bound, 1e3 * (middle - begin), 1e3 * (tracked - middle))


def _nees(found: FrameSolution, truth: FloatArray) -> float:
    assert found.fix is not None
    error = to_rotation_vector(multiply(found.fix.quaternion, conjugate(truth)))
    return float(error @ np.linalg.solve(found.fix.covariance, error)) / 3.0


RIGHT_ARCSEC = 60.0
