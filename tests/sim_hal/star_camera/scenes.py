"""Scenes for the tests of the star camera, and an independent renderer that sums over instants."""

from __future__ import annotations

import numpy as np
from scipy.special import erf

from knightcube.astro import quaternion
from knightcube.astro.arrays import FloatArray
from sim_hal.star_camera import StarCameraModel

POINTING = quaternion.normalise(np.array([0.3, -0.5, 0.7, 0.2]))
"""Arbitrary attitude, which is not aligned with any axis."""


def at_pixels(model: StarCameraModel, points: object, attitude: FloatArray = POINTING) -> FloatArray:
    """Return ICRS directions (n, 3) of stars that appear at the pixels `points` (n, 2) for `attitude`."""
    seen = model.pinhole.unit_vectors(np.atleast_2d(np.asarray(points, dtype=float)))
    return np.asarray(seen @ quaternion.attitude_matrix(attitude))


def turning(rate: object, exposure: float = 1.0, samples: int = 2) -> tuple[FloatArray, FloatArray]:
    """Return times and attitudes of a camera that starts at `POINTING` and rotates at `rate` (3,)."""
    times = np.linspace(0.0, exposure, samples)
    turn = quaternion.from_rotation_vector(times[:, None] * np.asarray(rate, dtype=float))
    return times, quaternion.multiply(turn, POINTING)


def still(exposure: float = 1.0) -> tuple[FloatArray, FloatArray]:
    """Return times and attitudes of a camera that does not move."""
    return turning([0.0, 0.0, 0.0], exposure)


def centroid(image: FloatArray) -> FloatArray:
    """Return the brightness centroid (2,), as (x, y)."""
    rows, columns = np.indices(image.shape)
    return np.asarray(np.array([(columns * image).sum(), (rows * image).sum()]) / image.sum())


def integrated_by_brute_force(
    shape: tuple[int, int], path: FloatArray, electrons: float, sigma: float
) -> FloatArray:
    """Return the pixel-integrated image of a point that stays equally long at each point of `path` (k, 2).

    The function sums the definition of the image in double precision, with scipy's erf. `k` should be some
    thousands.
    """
    scale = sigma * np.sqrt(2.0)
    across = np.arange(shape[1] + 1) - 0.5 - path[:, :1]
    down = np.arange(shape[0] + 1) - 0.5 - path[:, 1:]
    x = 0.5 * np.diff(erf(across / scale), axis=1)
    y = 0.5 * np.diff(erf(down / scale), axis=1)
    return np.asarray(electrons / len(path) * (y.T @ x))
