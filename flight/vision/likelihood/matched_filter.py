"""Faint streaks, once the motion is known: all stars turn by one angle about one axis.

The frame's 3 x 3 sums are sampled on circles about the axis; there every streak is straight and equally long,
and a running sum of that length is its matched filter. Peaks of the responses are stars; the heights of all
together, whose responses overlap, are solved for.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from flight.arrays import FloatArray, IntArray
from flight.pinhole import Pinhole
from flight.vision.likelihood.exposed_frame import ExposedFrame, Float32Array
from flight.vision.likelihood.motion import Motion, paths
from flight.vision.likelihood.polar_grid import ACROSS, PolarGrid, RunningSums, polar_grid, running_sums
from flight.vision.likelihood.responses import (
    FARTHEST,
    LEAST_SEEN,
    profile,
    shared,
    sharp_peaks,
    standing_peaks,
)
from flight.vision.segmentation import box_sum

# Samples are rounded to this part of their noise.
_ROUNDING = 30.0
# The first for what stands out sharply.
_PASSES = 3
_RIDGE = 0.01
_TINY = 1e-6
# Shorter streaks, px, are no lines that a filter could follow.
_LEAST_LENGTH = 6.0
# The part of a streak's light that falls in the three pixels across.
_CAPTURED = 0.83
# Noise of a sum of samples over a pixel's and the root of their number: nine pixels each, which overlap.
_SAMPLE_NOISE = 3.1


@dataclass(frozen=True, slots=True, eq=False)
class FaintStars:
    """Streaks found: stars (n, 2) px at mid-exposure, light and significance (n,)."""

    stars: FloatArray
    light: FloatArray
    significance: FloatArray


def find_faint(
    frame: ExposedFrame,
    modelled: tuple[IntArray, Float32Array],
    pinhole: Pinhole,
    motion: Motion,
    sigmas: float,
    most: int,
) -> FaintStars:
    """Return the `most` strongest streaks along `motion` in the frame less `modelled`: pixels (m,), light."""
    middle = paths(pinhole, motion, np.array([pinhole.centre]), np.zeros(1)).velocity
    reach = float(np.linalg.norm(motion.turn)) * float(np.sin(pinhole.half_diagonal)) * pinhole.focal_length
    if max(float(np.hypot(*middle[0])), reach) < _LEAST_LENGTH:
        return FaintStars(np.empty((0, 2)), np.empty(0), np.empty(0))
    grid = polar_grid(pinhole, motion)
    usual = _SAMPLE_NOISE * float(np.sqrt(np.median(frame.floor[::97])))
    sums = box_sum(_left_over(frame, modelled))
    held = running_sums(sums, pinhole, grid, usual / _ROUNDING)
    # The noise for every number of samples; too few tell nothing.
    noise = usual * np.sqrt(np.arange(max(round(grid.length), 1) + 1.0))
    noise[: math.ceil(LEAST_SEEN * grid.length)] = np.inf
    row, column, height = _cleaned(held, noise, grid, sigmas, most)
    significance = _significance(held, noise, grid, row, column, height)
    order = np.argsort(-significance, kind="stable")
    row, column, height, significance = row[order], column[order], height[order], significance[order]
    stars = grid.pixels(pinhole, row, column - grid.off_centre)
    seen = np.isfinite(stars).all(axis=1)
    travelled = grid.angle * np.interp(row, np.arange(len(grid.speed)), grid.speed)
    light = height / (3.0 * _CAPTURED * grid.length) * travelled
    return FaintStars(stars[seen], light[seen], significance[seen])


def _left_over(frame: ExposedFrame, modelled: tuple[IntArray, Float32Array]) -> Float32Array:
    """Return the frame (rows, columns) less `modelled` light; pixels that tell nothing are zero."""
    left = frame.signal.copy()
    pixels, light = modelled
    floor = frame.floor[pixels]
    # Where a bright star was taken out, what is left is mostly its own noise.
    share = floor / (floor + np.maximum(light, np.float32(0.0)) * np.float32(1.0 / frame.gain))
    left[pixels] = (left[pixels] - light) * share
    left[np.flatnonzero(frame.bad)] = 0.0
    return left.reshape(frame.shape)


def _cleaned(
    held: RunningSums, noise: FloatArray, grid: PolarGrid, sigmas: float, most: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return rows, columns (between samples) and heights of the stars whose responses add up to those `held`.

    Passes find the peaks that rise above what is left, solve the heights of all found together (their
    responses overlap), and take them out. `noise` is by count of samples. What does not exceed it at first
    never will: all passes look at few places.
    """
    flat = held.light.reshape(-1)
    place = np.flatnonzero(flat > sigmas * noise.min())
    deviation = noise[held.count.reshape(-1)[place]] * held.excess[place // held.light.shape[1]]
    high = flat[place] > sigmas * deviation
    place, deviation = place[high], deviation[high]
    left = flat[place].astype(np.float64)
    significance = np.zeros(held.light.shape, dtype=np.float32)
    row, column, height = (np.empty(0) for _ in range(3))
    for turn in range(_PASSES):
        if turn == 0:
            new_row, new_column = sharp_peaks(held, place, deviation, grid)
        else:
            significance.reshape(-1)[place] = left / deviation
            high = left > sigmas * deviation
            new_row, new_column = standing_peaks(significance, held.span, place[high], grid, sigmas)
        room = most - len(row)
        if not len(new_row) or room <= 0:
            continue
        row, column = np.append(row, new_row[:room]), np.append(column, new_column[:room])
        height = _heights(held, row, column, grid)
        kept = _significance(held, noise, grid, row, column, height) > sigmas
        row, column, height = row[kept], column[kept], height[kept]
        left = flat[place] - _given(held, place, grid, row, column, height)
    return row, column, height


def _significance(
    held: RunningSums,
    noise: FloatArray,
    grid: PolarGrid,
    row: FloatArray,
    column: FloatArray,
    height: FloatArray,
) -> FloatArray:
    """Return how many deviations of the noise what is seen of stars (k,) makes."""
    middle = np.rint(row).astype(int)
    seen = shared(column, column, held.span[middle], grid.length)
    own = noise[held.count[middle, _wrapped(column, held.light)]] * held.excess[middle]
    return np.asarray(height * seen / own)


def _wrapped(column: FloatArray, response: Float32Array) -> IntArray:
    return np.asarray(np.rint(column).astype(int) % response.shape[1])


def _given(
    held: RunningSums,
    place: IntArray,
    grid: PolarGrid,
    row: FloatArray,
    column: FloatArray,
    height: FloatArray,
) -> FloatArray:
    """Return what stars (k,) of `height` put at the flat places (p,), ascending."""
    columns = held.light.shape[1]
    first = np.searchsorted(place, (row.astype(int) - FARTHEST + 1) * columns)
    count = np.searchsorted(place, (row.astype(int) + FARTHEST + 1) * columns) - first
    star = np.repeat(np.arange(len(row)), count)
    which = np.arange(len(star)) + np.repeat(first - np.cumsum(count) + count, count)
    at_row, at_column = np.divmod(place[which], columns)
    near = np.flatnonzero(np.abs(at_column - column[star]) < grid.length)
    star, which, at_row, at_column = star[near], which[near], at_row[near], at_column[near]
    common = shared(at_column, column[star], held.span[at_row], grid.length)
    across = profile((at_row - row[star]) * ACROSS)
    return np.asarray(np.bincount(which, height[star] * common * across, len(place)), dtype=float)


def _heights(held: RunningSums, row: FloatArray, column: FloatArray, grid: PolarGrid) -> FloatArray:
    """Return the heights (k,) whose overlapping responses best give what is `held` at the stars' places."""
    middle = np.rint(row).astype(int)
    one, other = np.nonzero(
        (np.abs(column[:, None] - column) < grid.length) & (np.abs(row[:, None] - row) < FARTHEST)
    )
    overlap = np.zeros((len(row), len(row)))
    span = held.span[middle]
    common = np.stack(
        [np.maximum(span[one, 0], span[other, 0]), np.minimum(span[one, 1], span[other, 1])], axis=-1
    )
    overlap[one, other] = shared(column[one], column[other], common, grid.length)
    overlap[one, other] *= profile((row[one] - row[other]) * ACROSS)
    # A ridge, for stars that almost coincide; the scale it takes from all others is given back.
    overlap[np.diag_indices(len(row))] *= 1.0 + _RIDGE
    overlap[np.diag_indices(len(row))] += _TINY
    seen = held.light[middle, _wrapped(column, held.light)]
    return np.asarray(np.linalg.solve(overlap, (1.0 + _RIDGE) * seen))
