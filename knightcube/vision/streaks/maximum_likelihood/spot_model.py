"""The light of a star that hardly moves: a spot, a streak of a few pixels, or the slow part of a longer one.

Summed over a few instants of the exposure (Gauss-Legendre), each a Gaussian integrated over every pixel:
exact, at rest too, where it is a centroid.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks.maximum_likelihood.motion import Motion, positions, sensitivities
from knightcube.vision.streaks.maximum_likelihood.scene import window_times
from knightcube.vision.streaks.maximum_likelihood.shutter import Shutter

# Gauss-Legendre nodes of a piece of the path: with one a width of the point spread it is exact to 1e-4.
_NODE, _WEIGHT = np.polynomial.legendre.leggauss(10)
_PIECE_WIDTHS = 8.0
# Widths beyond a patch from which light still reaches its pixels.
_BEYOND = 5.5
# Instants at which a path that is slow in places is looked at to divide it.
_SAMPLES = 33
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


def cut_patches(pinhole: Pinhole, middles: FloatArray, half: int) -> Patches:
    """Return the pixels within `half` px, each way, of `middles` (n, 2) px."""
    corner = np.rint(middles).astype(np.int64)[:, :, None] + np.arange(-half, half + 1)
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
    time, weight = _instants(pinhole, motion, shutter, stars, sigma, patches)
    instants = time.shape[1]
    repeated = np.repeat(stars, instants, axis=0)
    place = positions(pinhole, motion, repeated, time.reshape(-1)).reshape(count, instants, 2)
    change = sensitivities(pinhole, motion, repeated, time.reshape(-1)).reshape(count, instants, 2, 8)
    x, dx, sx = _profile(patches.column, place[..., 0], sigma)
    y, dy, sy = _profile(patches.row, place[..., 1], sigma)
    y, dy, sy = (weight[..., None] * part for part in (y, dy, sy))
    down = y.swapaxes(1, 2)
    light = down @ x
    out = np.empty((count, 9, *light.shape[1:]))
    for k in range(8):
        by_x, by_y = change[:, :, 0, k, None], change[:, :, 1, k, None]
        out[:, k] = down @ (by_x * dx) + (by_y * dy).swapaxes(1, 2) @ x
    out[:, 8] = down @ sx + sy.swapaxes(1, 2) @ x
    return light, out


def _instants(
    pinhole: Pinhole, motion: Motion, shutter: Shutter, stars: FloatArray, sigma: float, patches: Patches
) -> tuple[FloatArray, FloatArray]:
    """Return the times (n, m), in exposures, at which stars light their patches, and their weights (n, m)."""
    times = window_times(pinhole, motion, shutter, stars)
    edges = times
    if not motion.constant:
        edges = _pieces(pinhole, motion, stars, times, sigma, patches)
    middle, half = 0.5 * (edges[:, 1:] + edges[:, :-1]), 0.5 * np.diff(edges)
    time = middle[..., None] + half[..., None] * _NODE
    weight = half[..., None] * _WEIGHT
    return time.reshape(len(stars), -1), weight.reshape(len(stars), -1)


def _pieces(
    pinhole: Pinhole, motion: Motion, stars: FloatArray, times: FloatArray, sigma: float, patches: Patches
) -> FloatArray:
    """Return times (n, p + 1) that divide the paths, as far as their light falls on the patches, evenly."""
    n = len(stars)
    sampled = times[:, :1] + np.diff(times) * np.linspace(0.0, 1.0, _SAMPLES)
    there = positions(pinhole, motion, np.repeat(stars, _SAMPLES, axis=0), sampled.reshape(-1))
    there = there.reshape(n, _SAMPLES, 2)
    room = _BEYOND * sigma
    low = np.stack([patches.column[:, 0], patches.row[:, 0]], axis=-1)[:, None] - room
    high = np.stack([patches.column[:, -1], patches.row[:, -1]], axis=-1)[:, None] + room
    near = np.all((there >= low) & (there <= high), axis=2)
    # A sample more on either side; a path that is never near keeps its whole.
    near |= np.pad(near, ((0, 0), (1, 0)))[:, :-1] | np.pad(near, ((0, 0), (0, 1)))[:, 1:]
    near |= ~near.any(axis=1, keepdims=True)
    step = np.hypot(*np.moveaxis(np.diff(there, axis=1), 2, 0)) * (near[:, 1:] & near[:, :-1])
    way = np.concatenate([np.zeros((n, 1)), np.cumsum(step, axis=1)], axis=1)
    count = max(1, math.ceil(float(way[:, -1].max()) / (_PIECE_WIDTHS * sigma)))
    first, last = near.argmax(axis=1), _SAMPLES - 1 - near[:, ::-1].argmax(axis=1)
    share = np.linspace(0.0, 1.0, count + 1)
    out = np.empty((n, count + 1))
    for star in range(n):
        part = slice(first[star], last[star] + 1)
        # Evenly by path, where there is one, and a little by time.
        run = way[star, part] + 1e-6 * np.arange(last[star] + 1 - first[star])
        out[star] = np.interp(run[0] + share * (run[-1] - run[0]), run, sampled[star, part])
    return out


def _profile(pixels: IntArray, place: FloatArray, sigma: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the share (n, m, p) of points (n, m) on pixels (n, p), and its change by place and sigma."""
    right = (pixels[:, None, :] + 0.5 - place[..., None]) / sigma
    left = right - 1.0 / sigma
    bell_right = _BELL * np.exp(-0.5 * right**2)
    bell_left = _BELL * np.exp(-0.5 * left**2)
    share = ndtr(right) - ndtr(left)
    return share, (bell_left - bell_right) / sigma, (left * bell_left - right * bell_right) / sigma
