"""Frames of a rolling shutter, summed over instants, independent of the estimator's model.

At each instant a star is a Gaussian that is integrated over each pixel of a patch. The light of an instant is
added only to the rows that are exposed at this instant. The method is simple and slow. The pixels have the
noise of the simulator.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from knightcube.astro.arrays import FloatArray, Image, IntArray
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, multiply, normalise
from sim_hal.star_camera import StarCameraModel, image
from tests.support.scenes import catalogue

Turns = Callable[[FloatArray], FloatArray]
"""Function from times (m,), s, to rotations (m, 3), rad, camera frame, both since mid-exposure."""

_LIMIT = 7.0
# Largest step (px) of a star between two instants, and half width of the patch in units of the point spread's
# sigma.
_STEP = 0.25
_REACH = 5.5
_SAMPLES = 65


@dataclass(frozen=True, slots=True, eq=False)
class RowScene:
    """A frame and its stars, brightest first: mid-exposure positions (px), electrons, path lengths (px)."""

    pixels: Image
    stars: FloatArray
    electrons: FloatArray
    lengths: FloatArray


def row_scene(
    camera: StarCameraModel, turns: Turns, exposure: float, generator: np.random.Generator
) -> RowScene:
    """Return a random sky under the motion `turns`.

    The exposure of row r starts at (r - middle) line times - exposure / 2.
    """
    stars, directions = catalogue(_LIMIT)
    middle = normalise(generator.normal(size=4))
    half = 0.5 * (exposure + camera.rows * camera.line_time)
    coarse = np.linspace(-half, half, _SAMPLES)
    electrons = camera.electrons(stars.magnitude, exposure)
    places = _places(camera, directions, multiply(from_rotation_vector(turns(coarse)), middle))
    near = np.flatnonzero(
        camera.pinhole.contains(places.reshape(-1, 2), 10.0).reshape(places.shape[:2]).any(0)
    )
    light = np.zeros((camera.rows, camera.columns))
    for star in near:
        steps = np.linalg.norm(np.diff(places[:, star], axis=0), axis=1)
        count = math.ceil(float(np.nanmax(steps)) * (_SAMPLES - 1) / _STEP) + 20
        times = half * ((2.0 * np.arange(count) + 1.0) / count - 1.0)
        attitudes = multiply(from_rotation_vector(turns(times)), middle)
        path = _places(camera, directions[star : star + 1], attitudes)[:, 0]
        _add(light, camera, path, times, exposure, float(electrons[star]))
    pixels = image.counts(camera, light.astype(np.float32), exposure, generator)
    inside = np.abs(coarse) <= 0.5 * exposure
    seen = (
        camera.pinhole.contains(places[inside][:, near].reshape(-1, 2)).reshape(-1, len(near)).mean(0) > 0.3
    )
    chosen = near[seen][np.argsort(-electrons[near[seen]], kind="stable")]
    path = places[inside][:, chosen]
    lengths = np.linalg.norm(np.diff(path, axis=0), axis=2).sum(axis=0)
    return RowScene(pixels, places[_SAMPLES // 2, chosen], electrons[chosen], lengths)


def _places(camera: StarCameraModel, directions: FloatArray, attitudes: FloatArray) -> FloatArray:
    """Return pixels (m, n, 2) of stars (n, 3) at attitudes (m, 4); NaN behind the camera."""
    seen = directions @ attitude_matrix(attitudes).swapaxes(-1, -2)
    return camera.pinhole.project(seen.reshape(-1, 3)).reshape(*seen.shape[:2], 2)


def _add(
    light: FloatArray,
    camera: StarCameraModel,
    path: FloatArray,
    times: FloatArray,
    exposure: float,
    electrons: float,
) -> None:
    """Add a star of `electrons` to `light`; it is at `path` (m, 2), px, at evenly spaced `times` (m,)."""
    reach = math.ceil(_REACH * camera.psf_sigma) + 1
    kept = camera.pinhole.contains(np.nan_to_num(path, nan=-1e6), float(reach))
    path, step = path[kept], times[1] - times[0]
    corner = np.rint(path).astype(int) - reach
    across, down = (corner[:, k, None] + np.arange(2 * reach + 1) for k in (0, 1))
    x, y = (_shares(pixel, path[:, k], camera.psf_sigma) for k, pixel in ((0, across), (1, down)))
    # Fraction of the interval around each instant that lies within the exposure of each row.
    begin = (down - 0.5 * (camera.rows - 1)) * camera.line_time - 0.5 * exposure
    first = np.maximum(times[kept, None] - 0.5 * step, begin)
    last = np.minimum(times[kept, None] + 0.5 * step, begin + exposure)
    y *= np.clip(last - first, 0.0, None) * (electrons / exposure)
    within = ((across >= 0) & (across < camera.columns))[:, None, :] & ((down >= 0) & (down < camera.rows))[
        :, :, None
    ]
    index = down[:, :, None] * camera.columns + across[:, None, :]
    patches = y[:, :, None] * x[:, None, :]
    light += np.bincount(index[within], patches[within], light.size).reshape(light.shape)


def _shares(pixels: IntArray, place: FloatArray, sigma: float) -> FloatArray:
    """Return the fraction (m, p) of each point at `place` (m,) that falls on each of its `pixels` (m, p)."""
    away = (pixels - place[:, None]) / sigma
    return np.asarray(ndtr(away + 0.5 / sigma) - ndtr(away - 0.5 / sigma))
