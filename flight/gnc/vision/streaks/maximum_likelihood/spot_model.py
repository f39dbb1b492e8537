"""The light of a star that hardly moves: a spot, or a streak of a few pixels, however bent.

Summed over a few instants of the exposure (Gauss-Legendre), each a Gaussian integrated over every pixel:
exact, at rest too, where it is a centroid.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from flight.gnc.camera.pinhole import Pinhole
from flight.gnc.math.arrays import BoolArray, FloatArray, IntArray
from flight.gnc.vision.streaks.maximum_likelihood.motion import Motion, positions, sensitivities
from flight.gnc.vision.streaks.maximum_likelihood.shutter import Shutter

INSTANTS = 10
"""Gauss-Legendre nodes: two widths of the point spread between them is still exact to 1e-4."""

_NODE, _WEIGHT = np.polynomial.legendre.leggauss(INSTANTS)
_BELL = 1.0 / math.sqrt(2.0 * math.pi)


@dataclass(frozen=True, slots=True, eq=False)
class Patches:
    """Square patches of pixels about spots.

    Attributes:
        column, row: (n, p) of the pixels.
        index: (n, p, p) into the flat frame; clipped where not `inside`.
        inside: (n, p, p) whether the pixel exists.
    """

    column: IntArray
    row: IntArray
    index: IntArray
    inside: BoolArray


def cut_patches(pinhole: Pinhole, stars: FloatArray, half: int) -> Patches:
    """Return the pixels within `half` px, each way, of stars at pixels (n, 2)."""
    corner = np.rint(stars).astype(np.int64)[:, :, None] + np.arange(-half, half + 1)
    column, row = corner[:, 0], corner[:, 1]
    inside = ((row >= 0) & (row < pinhole.rows))[:, :, None] & ((column >= 0) & (column < pinhole.columns))[
        :, None, :
    ]
    index = np.where(inside, row[:, :, None] * pinhole.columns + column[:, None, :], 0)
    return Patches(column, row, index, inside)


def derivatives(
    pinhole: Pinhole, motion: Motion, shutter: Shutter, stars: FloatArray, sigma: float, patches: Patches
) -> tuple[FloatArray, FloatArray]:
    """Return the light (n, p, p) of stars (n, 2), each of light 1, and (n, 9, p, p) its derivatives.

    By turn (3), growth (3), x, y, and `sigma` px of the point spread.
    """
    count = len(stars)
    if not count:
        return np.empty(patches.index.shape), np.empty((0, 9, *patches.index.shape[1:]))
    delay = shutter.delay(stars[:, 1])
    time = (0.5 * _NODE + delay[:, None]).reshape(-1)
    repeated = np.repeat(stars, INSTANTS, axis=0)
    place = positions(pinhole, motion, repeated, time).reshape(count, INSTANTS, 2)
    change = sensitivities(pinhole, motion, repeated, time).reshape(count, INSTANTS, 2, 8)
    x, dx, sx = _profile(patches.column, place[..., 0], sigma)
    y, dy, sy = _profile(patches.row, place[..., 1], sigma)
    y, dy, sy = (0.5 * _WEIGHT[:, None] * part for part in (y, dy, sy))
    down = y.swapaxes(1, 2)
    light = down @ x
    out = np.empty((count, 9, *light.shape[1:]))
    for k in range(8):
        by_x, by_y = change[:, :, 0, k, None], change[:, :, 1, k, None]
        out[:, k] = down @ (by_x * dx) + (by_y * dy).swapaxes(1, 2) @ x
    out[:, 8] = down @ sx + sy.swapaxes(1, 2) @ x
    return light, out


def _profile(pixels: IntArray, place: FloatArray, sigma: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the share (n, m, p) of points (n, m) on pixels (n, p), and its change by place and sigma."""
    right = (pixels[:, None, :] + 0.5 - place[..., None]) / sigma
    left = right - 1.0 / sigma
    bell_right = _BELL * np.exp(-0.5 * right**2)
    bell_left = _BELL * np.exp(-0.5 * left**2)
    share = ndtr(right) - ndtr(left)
    return share, (bell_left - bell_right) / sigma, (left * bell_left - right * bell_right) / sigma
