"""Faint streaks, once the motion is known: all stars turn by one angle about one axis.

The frame's 3 x 3 sums are sampled on circles about the axis; there every streak is straight and equally long,
and a running sum of that length is its matched filter. Peaks of the responses are stars; the heights of all
together, whose responses overlap, are solved for.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray, IntArray
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.frame import less_boxes
from knightcube.vision.streaks.maximum_likelihood.exposed_frame import ExposedFrame, Float32Array
from knightcube.vision.streaks.maximum_likelihood.filter_peaks import (
    FARTHEST,
    LEAST_SEEN,
    profile,
    shared,
    sharp_peaks,
    standing_peaks,
)
from knightcube.vision.streaks.maximum_likelihood.motion import Motion, paths
from knightcube.vision.streaks.maximum_likelihood.polar_grid import ACROSS, PolarGrid, polar_grid
from knightcube.vision.streaks.maximum_likelihood.running_sums import RunningSums, running_sums

# Samples are rounded to this part of their noise.
_ROUNDING = 30.0
# The first for what stands out sharply.
_PASSES = 3
_RIDGE = 0.01
_TINY = 1e-6
# Heights are solved for to this part of them, by this many conjugate gradients at most.
_SOLVED = 1e-4
_MOST_GRADIENTS = 200
# Places that stars reach, worked on at a time.
_SOME_PLACES = 1 << 16
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
    reach = float(np.linalg.norm(motion.whole)) * float(np.sin(pinhole.half_diagonal)) * pinhole.focal_length
    if max(float(np.hypot(*middle[0])), reach) < _LEAST_LENGTH:
        return FaintStars(np.empty((0, 2)), np.empty(0), np.empty(0))
    grid = polar_grid(pinhole, motion)
    usual = _SAMPLE_NOISE * float(np.sqrt(np.median(frame.floor[::97])))
    held = running_sums(_left_over(frame, modelled), pinhole, grid, usual / _ROUNDING)
    # The noise for every number of samples; too few are ignored.
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
    """Return the 3 x 3 sums (rows * columns,) of the frame less `modelled` light and pixels to leave out."""
    pixels, light = modelled
    signal, floor = frame.signal[pixels], frame.floor[pixels]
    # Where a bright star was taken out, what is left is mostly its own noise.
    share = floor / (floor + np.maximum(light, np.float32(0.0)) * np.float32(1.0 / frame.gain))
    left = (signal - light) * share
    left[frame.bad[pixels]] = 0.0
    lost = frame.bad.copy()
    lost[pixels] = False
    untold = np.flatnonzero(lost)
    return less_boxes(
        frame.sums,
        frame.shape,
        np.concatenate([pixels, untold]),
        np.concatenate([signal - left, frame.signal[untold]]),
    )


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
    """Return how many deviations of the noise the visible part of stars (k,) makes."""
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
    """Return the responses of stars (k,) of `height` at the flat places (p,), ascending."""
    rows, columns = held.light.shape
    # On each circle near a star's its response is one stretch of places.
    circle = row.astype(np.int64)[:, None] + np.arange(1 - FARTHEST, FARTHEST + 1)
    weight = height[:, None] * profile((circle - row[:, None]) * ACROSS)
    weight = np.where((circle >= 0) & (circle < rows), weight, 0.0)
    circle = np.clip(circle, 0, rows - 1)
    low = np.maximum(np.ceil(column - grid.length), 0.0).astype(np.int64)
    high = np.minimum(np.floor(column + grid.length), columns - 1.0).astype(np.int64)
    first = np.searchsorted(place, (circle * columns + low[:, None]).reshape(-1))
    count = np.searchsorted(place, (circle * columns + high[:, None]).reshape(-1), side="right") - first
    reached = np.flatnonzero((count > 0) & (weight.reshape(-1) > 0.0))
    first, count = first[reached], count[reached]
    circle, weight = circle.reshape(-1)[reached], weight.reshape(-1)[reached]
    star = reached // (2 * FARTHEST)
    out = np.zeros(len(place))
    # A crowd of stars gives a multiple of the frame: some stretches at a time.
    cuts = np.searchsorted(np.cumsum(count), np.arange(_SOME_PLACES, int(count.sum()), _SOME_PLACES))
    for some in np.split(np.arange(len(reached)), np.unique(cuts)):
        many = count[some]
        which = np.arange(many.sum()) + np.repeat(first[some] - np.cumsum(many) + many, many)
        at = (place[which] - np.repeat(circle[some] * columns, many)).astype(np.float64)
        common = shared(
            at,
            np.repeat(column[star[some]], many),
            np.repeat(held.span[circle[some]], many, axis=0),
            grid.length,
        )
        common *= np.repeat(weight[some], many)
        np.add.at(out, which, common)
    return out


def _heights(held: RunningSums, row: FloatArray, column: FloatArray, grid: PolarGrid) -> FloatArray:
    """Return the heights (k,) whose overlapping responses best give what is `held` at the stars' places."""
    middle = np.rint(row).astype(int)
    one, other = _neighbours(row, column, grid.length)
    span = held.span[middle]
    common = np.stack(
        [np.maximum(span[one, 0], span[other, 0]), np.minimum(span[one, 1], span[other, 1])], axis=-1
    )
    overlap = shared(column[one], column[other], common, grid.length) * profile(
        (row[one] - row[other]) * ACROSS
    )
    # A ridge, for stars that almost coincide; the scale it takes from all others is given back.
    overlap[one == other] *= 1.0 + _RIDGE
    overlap[one == other] += _TINY
    seen = (1.0 + _RIDGE) * held.light[middle, _wrapped(column, held.light)].astype(np.float64)
    return _solved(one, other, overlap, seen)


def _neighbours(row: FloatArray, column: FloatArray, length: float) -> tuple[IntArray, IntArray]:
    """Return the pairs of stars (k,), each with itself among them, whose responses may overlap."""
    order = np.argsort(row, kind="stable")
    first = np.searchsorted(row[order], row - FARTHEST, side="right")
    count = np.searchsorted(row[order], row + FARTHEST) - first
    one = np.repeat(np.arange(len(row)), count)
    other = order[np.arange(len(one)) + np.repeat(first - np.cumsum(count) + count, count)]
    near = np.flatnonzero(np.abs(column[one] - column[other]) < length)
    return one[near], other[near]


def _solved(one: IntArray, other: IntArray, overlap: FloatArray, right: FloatArray) -> FloatArray:
    """Return the solution (k,) of the equations whose elements `overlap` (e,) stand at `one`, `other`.

    Conjugate gradients: each star meets few others.
    """
    k = len(right)
    scale = 1.0 / np.sqrt(overlap[one == other])
    matrix = overlap * scale[one] * scale[other]
    x, residual = np.zeros(k), right * scale
    direction, size = residual, float(residual @ residual)
    enough = _SOLVED**2 * size
    for _ in range(_MOST_GRADIENTS):
        if size <= enough:
            break
        image = np.bincount(one, matrix * direction[other], k)
        length = size / float(direction @ image)
        x = x + length * direction
        residual = residual - length * image
        size, before = float(residual @ residual), size
        direction = residual + size / before * direction
    return np.asarray(x * scale)
