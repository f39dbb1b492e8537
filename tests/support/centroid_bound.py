"""Centroid errors of simulated stars, and the Cramer-Rao bound of these errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from knightcube.astro.arrays import FloatArray, Image, IntArray
from knightcube.vision.startracker.detect import Detections, detect
from knightcube.vision.startracker.survey import DetectionSettings, Method
from sim_hal.star_camera import StarCameraModel, render
from tests.sim_hal.star_camera.scenes import at_pixels, still

_EXPOSURE = 0.2


_GRID = 7


_MATCHED = 1.5


@dataclass(frozen=True, slots=True)
class Row:
    """One row of the table of centroid errors, in px along one axis."""

    found: int
    stars: int
    bias: float
    bias_error: float
    ratio: float
    nees: float


def star_places(rng: np.random.Generator, size: int, count: int = 40) -> FloatArray:
    """Return positions (count, 2), px, at least size / 20 apart and from the border."""
    cell = size / _GRID
    chosen = rng.permutation(_GRID * _GRID)[:count]
    corner = np.stack([chosen % _GRID, chosen // _GRID], axis=-1) * cell
    return np.asarray(corner + rng.uniform(0.2 * cell, 0.8 * cell, (count, 2)))


def frame_of(
    camera: StarCameraModel, places: FloatArray, magnitudes: FloatArray, seed: Sequence[int]
) -> Image:
    """Return a frame of stars of `magnitudes` (n,) at `places` (n, 2), px, of a camera at rest."""
    rng = np.random.default_rng(seed)
    return render(camera, at_pixels(camera, places), magnitudes, *still(_EXPOSURE), rng)


def point_bound(camera: StarCameraModel, place: FloatArray, electrons: float) -> FloatArray:
    """Return the Cramer-Rao bound (2, 2), px^2, of a star position with unknown flux, sky and point spread.

    The noise consists of Poisson, read and rounding noise. Pixels whose mean is saturated give no
    information.
    """
    reach = int(np.ceil(6.0 * camera.psf_sigma)) + 1
    middle = np.rint(place)
    pixel = np.arange(-reach, reach + 1)
    shares = []
    for axis in (0, 1):
        edge = (np.append(pixel - 0.5, pixel[-1] + 0.5) + middle[axis] - place[axis]) / camera.psf_sigma
        bell = np.exp(-0.5 * edge**2) / (np.sqrt(2.0 * np.pi) * camera.psf_sigma)
        shares.append((np.diff(ndtr(edge)), -np.diff(bell), -np.diff(edge * bell)))
    (x, dx, wx), (y, dy, wy) = shares
    light = np.outer(y, x)
    derivatives = np.stack(
        [electrons * np.outer(y, dx), electrons * np.outer(dy, x), light, np.ones_like(light),
         electrons * (np.outer(wy, x) + np.outer(y, wx))]
    ).reshape(5, -1)  # fmt: skip
    dark = camera.dark_current * _EXPOSURE
    mean = electrons * light + dark
    variance = mean + camera.read_noise**2 + camera.gain**2 / 12.0
    top = min(camera.full_well, (camera.highest_count - camera.pedestal) * camera.gain)
    good = (mean < top).reshape(-1)
    scaled = derivatives[:, good] / np.sqrt(variance.reshape(-1)[good])
    return np.asarray(np.linalg.inv(scaled @ scaled.T)[:2, :2])


def compare(camera: StarCameraModel, magnitude: float, method: Method, frames: int, seed: int) -> Row:
    """Return the centroid errors of stars of `magnitude` over a number of simulated frames."""
    settings = DetectionSettings(method=method)
    bounds: list[FloatArray] = []
    errors, nees, total = [], [], 0
    electrons = float(np.asarray(camera.electrons(np.array([magnitude]), _EXPOSURE))[0])
    for frame in range(frames):
        places = star_places(np.random.default_rng([seed, frame, 1]), camera.columns)
        pixels = frame_of(camera, places, np.full(len(places), magnitude), [seed, frame, 2])
        found = detect(pixels, settings).stars()
        star, detection = matched(found, places)
        off = found.points[detection] - places[star]
        errors.append(off)
        bounds.extend(point_bound(camera, place, electrons) for place in places[star])
        weighted = np.linalg.solve(found.covariance[detection], off[:, :, None])[:, :, 0]
        nees.append(np.sum(off * weighted, axis=1) / 2.0)
        total += len(places)
    error = np.concatenate(errors)
    least = float(np.sqrt(np.mean([np.trace(bound) / 2.0 for bound in bounds]))) if bounds else np.nan
    rms = float(np.sqrt(np.mean(error**2))) if len(error) else np.nan
    bias = error.mean(axis=0) if len(error) else np.full(2, np.nan)
    return Row(
        len(error), total, float(np.abs(bias).max()), rms / np.sqrt(max(len(error), 1)), rms / least,
        float(np.mean(np.concatenate(nees))),
    )  # fmt: skip


def matched(found: Detections, places: FloatArray) -> tuple[IntArray, IntArray]:
    """Return the indices (k,) of the detected true stars, and the indices (k,) of their detections."""
    if not len(found):
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    apart = np.linalg.norm(places[:, None] - found.points, axis=-1)
    star = np.flatnonzero(apart.min(axis=1) < _MATCHED)
    return star, apart[star].argmin(axis=1)
