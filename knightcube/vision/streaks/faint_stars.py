"""Detection of faint star streaks for a known motion on a polar grid about the rotation axis.

The running sums along the circles of the polar grid (`polar_grid.py`) are the response of the matched filter
of a streak. Along a circle, the filter response to a star is a triangle, truncated at the border of the
detector. Across the circles, the filter response is proportional to the brightness profile of the star. Each
peak of the filter response is a star. The heights of overlapping peaks are the solution of a linear system.
For bright stars, the second difference of the response along the circle separates overlapping triangles.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import ndtr

from knightcube.astro.arrays import BoolArray, Float32Array, FloatArray, Image, IntArray
from knightcube.compiled import compiled_form_of, loop_helper
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks.camera_motion import CameraMotion
from knightcube.vision.streaks.frame import ReducedFrame
from knightcube.vision.streaks.geometry import paths
from knightcube.vision.streaks.polar_grid import (
    ACROSS,
    SAMPLE_NOISE,
    Int32Array,
    PolarGrid,
    RunningSums,
    polar_grid,
    running_sums,
)

# Minimum fraction of a faint star's streak that must lie on the detector.
_LEAST_SEEN = 0.35
# Minimum distance (grid circles) at which the profiles of two stars do not overlap.
_FARTHEST = 5
# Standard deviation (px) of a star's profile across the streak, as assumed by the filter.
_WIDTH = 1.05
# Step (samples) of the second difference of the filter response along a circle of the grid.
_SHARP_STEP = 3
# Minimum streak length (samples) for the separation of stars by the second difference.
_SHARP_FROM = 40.0
# Minimum second difference of a star's filter response, in standard deviations of its noise.
_SHARP_SIGMAS = 6.0
# Minimum second difference of a star's filter response, as a fraction of the response.
_SHARP_SHARE = 0.3
# Minimum fraction of the response at a star's peak that must remain after stronger peaks are subtracted.
_OWN_SHARE = 0.45
# Maximum number of peaks in one pass of the search.
_MOST_PEAKS = 1000
# Offsets (rows, columns) to the neighbours of a local maximum, in ascending order of distance.
_NEIGHBOURS = sorted(
    ((down, beside) for down in (-1, 0, 1) for beside in (-2, -1, 0, 1, 2) if (down, beside) != (0, 0)),
    key=lambda step: abs(step[0]) + abs(step[1]),
)

# Number of entries of the table `_PROFILE` per px of distance from the star.
_PER_PX = 50.0
# Table of the filter response to a star, relative to its maximum, on circles at increasing distance.
_PROFILE = ndtr((np.arange(400) / _PER_PX + 1.5) / _WIDTH) - ndtr((np.arange(400) / _PER_PX - 1.5) / _WIDTH)
_PROFILE /= _PROFILE[0]


def overlap_of(one: FloatArray, other: FloatArray, span: FloatArray, length: float) -> FloatArray:
    """Return the overlap of streaks centred at columns `one` and `other` (...), as a fraction of `length`.

    The argument `span` (..., 2) is the range of columns of a circle that lie on the detector. `length` is in
    samples.
    """
    first = np.maximum(np.maximum(one, other) - 0.5 * length, span[..., 0])
    last = np.minimum(np.minimum(one, other) + 0.5 * length, span[..., 1])
    return np.asarray(np.maximum(last - first, 0.0) / length)


def profile(distance: FloatArray) -> FloatArray:
    """Return the filter response to a star at a `distance` (px) across its circle, divided by the peak."""
    index = np.minimum(np.abs(distance) * _PER_PX + 0.5, len(_PROFILE) - 1.0).astype(np.int64)
    return np.asarray(_PROFILE[index])


def sharp_peaks(held: RunningSums, scale: Float32Array, grid: PolarGrid) -> tuple[FloatArray, FloatArray]:
    """Return grid rows and columns of bright stars, found by the second difference of the filter response.

    The peaks of the second difference are narrow, so that stars close to each other on one circle are
    separated. Only the samples with a positive `scale` (r, c), see `_scales`, are searched.
    """
    if grid.length < _SHARP_FROM:
        return np.empty(0), np.empty(0)
    flat = held.light.reshape(-1), held.count.reshape(-1), scale.reshape(-1)
    sharp, high = _second_differences(*flat, grid.length)
    bend = sharp.reshape(scale.shape)
    return _refined(bend, *_local_maxima(bend, high))


def _second_differences_numpy(
    light: Float32Array, count: Int32Array, scale: Float32Array, length: float
) -> tuple[Float32Array, BoolArray]:
    """Return the second differences (m,) of m running sums along the circles, and which are significant.

    A second difference is scaled so that it equals the response at an isolated star, and is zero where
    `scale` (m,) is zero.
    """
    step, factor = _SHARP_STEP, length / (2.0 * _SHARP_STEP)
    bend = np.zeros(len(light), dtype=np.float32)
    bend[step:-step] = 2.0 * light[step:-step] - (light[: -2 * step] + light[2 * step :])
    bend = np.where(scale > 0.0, bend * np.float32(factor), np.float32(0.0))
    least = (_SHARP_SIGMAS * factor) * np.sqrt(6.0 * step / np.maximum(count, 1))
    return bend, (bend * scale > least) & (bend > _SHARP_SHARE * light)


@compiled_form_of(_second_differences_numpy)
def _second_differences(
    light: Float32Array, count: Int32Array, scale: Float32Array, length: float
) -> tuple[Float32Array, BoolArray]:
    """See `_second_differences_numpy`."""
    bend, high = np.zeros(len(light), np.float32), np.zeros(len(light), np.bool_)
    factor, two, share = np.float32(length / (2.0 * _SHARP_STEP)), np.float32(2.0), np.float32(_SHARP_SHARE)
    # The squares are compared, because a square root takes more time.
    least = np.float32((_SHARP_SIGMAS * length / (2.0 * _SHARP_STEP)) ** 2 * 6.0 * _SHARP_STEP)
    for k in range(_SHARP_STEP, len(light) - _SHARP_STEP):
        if scale[k] > 0.0:
            own = (two * light[k] - (light[k - _SHARP_STEP] + light[k + _SHARP_STEP])) * factor
            ratio, samples = own * scale[k], np.float32(max(count[k], 1))
            bend[k] = own
            high[k] = own > share * light[k] and ratio * ratio * samples > least
    return bend, high


def standing_peaks(
    significance: Float32Array, span: FloatArray, length: float, sigmas: float
) -> tuple[FloatArray, FloatArray]:
    """Return the peaks of stars, the strongest first, as fractional grid rows and columns.

    A peak of `significance` (r, c) must exceed `sigmas`. A peak is omitted if stronger peaks cause most of
    its response. The argument `span` (r, 2) is the range of columns on the detector, as in `RunningSums`, and
    `length` is the length of a streak in samples.
    """
    row, column = _local_maxima(significance, significance > np.float32(sigmas))
    value, spans = significance[row, column].astype(np.float64), span[row]
    kept = _unshaded(row, column, value, spans, length, sigmas)
    return _refined(significance, row[kept], column[kept])


def _unshaded_numpy(
    row: IntArray, column: IntArray, value: FloatArray, spans: FloatArray, length: float, sigmas: float
) -> BoolArray:
    """Return a mask (k,) of the peaks that stronger peaks do not cause; the strongest peak comes first.

    The arguments are grid indices and heights `value` of the peaks, the ranges `spans` (k, 2) of columns on
    the detector, the streak length in samples, and the minimum height.
    """
    by_row = np.argsort(row, kind="stable")
    first = np.searchsorted(row[by_row], row - _FARTHEST + 1)
    count = np.searchsorted(row[by_row], row + _FARTHEST) - first
    stronger = np.repeat(np.arange(len(row)), count)
    weaker = by_row[np.arange(len(stronger)) + np.repeat(first - np.cumsum(count) + count, count)]
    # Most of the hundreds of thousands of pairs of peaks in a crowded frame are too far apart to overlap.
    near = np.flatnonzero((stronger < weaker) & (np.abs(column[stronger] - column[weaker]) < length))
    stronger, weaker = stronger[near], weaker[near]
    there = column.astype(np.float64)
    share = overlap_of(there[stronger], there[weaker], spans[stronger], length)
    share /= np.maximum(overlap_of(there, there, spans, length), _LEAST_SEEN)[stronger]
    shading = np.flatnonzero(share > 0.0)
    stronger, weaker = stronger[shading], weaker[shading]
    share = share[shading] * profile((row[stronger] - row[weaker]) * ACROSS)
    begin = np.searchsorted(stronger, np.arange(len(row) + 1))
    own = value.copy()
    kept = np.zeros(len(row), dtype=np.bool_)
    for k in range(len(row)):
        if own[k] < sigmas or own[k] < _OWN_SHARE * value[k]:
            continue
        kept[k] = True
        shaded = slice(begin[k], begin[k + 1])
        own[weaker[shaded]] -= own[k] * share[shaded]
    return kept


@compiled_form_of(_unshaded_numpy)
def _unshaded(
    row: IntArray, column: IntArray, value: FloatArray, spans: FloatArray, length: float, sigmas: float
) -> BoolArray:
    own, kept = value.copy(), np.zeros(len(row), dtype=np.bool_)
    for k in range(len(row)):
        if own[k] < sigmas or own[k] < _OWN_SHARE * value[k]:
            continue
        kept[k] = True
        low, high = spans[k]
        whole = max(min(column[k] + 0.5 * length, high) - max(column[k] - 0.5 * length, low), 0.0) / length
        for w in range(k + 1, len(row)):
            if abs(row[w] - row[k]) >= _FARTHEST or abs(column[w] - column[k]) >= length:
                continue
            first = max(max(column[k], column[w]) - 0.5 * length, low)
            last = min(min(column[k], column[w]) + 0.5 * length, high)
            share = max(last - first, 0.0) / length / max(whole, _LEAST_SEEN)
            aside = int(min(abs(row[k] - row[w]) * ACROSS * _PER_PX + 0.5, len(_PROFILE) - 1.0))
            own[w] -= own[k] * share * _PROFILE[aside]
    return kept


def _local_maxima(values: Float32Array, high: BoolArray) -> tuple[IntArray, IntArray]:
    """Return grid rows and columns of local maxima, the highest first, where the mask `high` is set."""
    flat, columns = values.reshape(-1), values.shape[1]
    place = _summits(flat, high.reshape(-1), columns)
    place = place[np.argsort(-flat[place], kind="stable")[:_MOST_PEAKS]]
    row, column = np.divmod(place, columns)
    return row, column


def _summits_numpy(flat: Float32Array, high: BoolArray, columns: int) -> IntArray:
    """Return the flat indices (p,) of the local maxima of a grid (m,), where the mask `high` (m,) is set.

    The argument `columns` is the number of columns of the grid.
    """
    place = np.flatnonzero(high)
    # If the circles are complete, the first column of a circle is a neighbour of the last column.
    for down, beside in _NEIGHBOURS:
        place = place[flat.take(place + (down * columns + beside), mode="wrap") <= flat[place]]
    return place


@compiled_form_of(_summits_numpy)
def _summits(flat: Float32Array, high: BoolArray, columns: int) -> IntArray:
    """See `_summits_numpy`."""
    place, count, size, margin = np.empty(len(flat), np.int64), 0, len(flat), columns + 2
    for begin in range(0, size, _AT_ONCE):
        stop = min(begin + _AT_ONCE, size)
        if not _any_set(high[begin:stop]):
            continue
        for k in range(begin, stop):
            # Most running sums are lower than a neighbour on their circle.
            if not high[k] or flat[k] < flat[k - 1] or (k + 1 < size and flat[k] < flat[k + 1]):
                continue
            highest = True
            for down in range(-1, 2):
                for beside in range(-2, 3):
                    at = k + down * columns + beside
                    if k < margin or k >= size - margin:
                        at %= size
                    highest &= flat[at] <= flat[k]
            place[count] = k
            count += highest
    return place[:count].copy()


@loop_helper
def _any_set(mask: BoolArray) -> bool:
    """Return whether any element of `mask` (k,) is true.

    An early exit from the loop would prevent vector instructions.
    """
    number = np.int32(0)
    for k in range(len(mask)):
        number += np.int32(mask[k])
    return bool(number > 0)


def _refined_numpy(values: Float32Array, row: IntArray, column: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return fractional grid rows and columns of peaks, each from parabolas through three values."""
    found: list[FloatArray] = []
    for axis, place in enumerate((row, column)):
        before, after = np.maximum(place - 1, 0), np.minimum(place + 1, values.shape[axis] - 1)
        left, right = (values[at, column] if axis == 0 else values[row, at] for at in (before, after))
        bend = left + right - 2.0 * values[row, column]
        offset = np.where(bend < 0.0, 0.5 * (left - right) / np.where(bend < 0.0, bend, -1.0), 0.0)
        found.append(place.astype(np.float64) + np.clip(offset, -0.5, 0.5))
    return np.minimum(found[0], values.shape[0] - 1.0), found[1]


@compiled_form_of(_refined_numpy)
def _refined(values: Float32Array, row: IntArray, column: IntArray) -> tuple[FloatArray, FloatArray]:
    """See `_refined_numpy`."""
    (rows, columns), fine = values.shape, np.empty((2, len(row)))
    for k in range(len(row)):
        r, c = row[k], column[k]
        own = values[r, c]
        below = r + _vertex(values[max(r - 1, 0), c], own, values[min(r + 1, rows - 1), c])
        # Without the limit, the rounded row of a peak on the last circle could lie outside the grid.
        fine[0, k] = min(below, rows - 1.0)
        fine[1, k] = c + _vertex(values[r, max(c - 1, 0)], own, values[r, min(c + 1, columns - 1)])
    return fine[0], fine[1]


@loop_helper
def _vertex(left: float, own: float, right: float) -> float:
    """Return the position of the vertex of the parabola through values at -1, 0 and 1, limited to +-0.5."""
    bend = left + right - 2.0 * own
    return min(max(0.5 * (left - right) / bend, -0.5), 0.5) if bend < 0.0 else 0.0


# Noise of a sample divided by the rounding step of the samples.
_ROUNDING = 30.0
# Number of passes of the search for stars, of which the first uses second differences.
_PASSES = 3
# Regularisation of the peak heights of nearly coincident stars, as a fraction of the diagonal elements.
_RIDGE = 0.01
# Regularisation added to the diagonal elements of the normal equations for peak heights.
_TINY = 1e-6
# Number of running sums that are compared with the threshold in one step.
_AT_ONCE = 32
# Relative residual of the normal equations at which the iteration for the peak heights stops.
_SOLVED = 1e-4
# Maximum number of conjugate-gradient iterations for the peak heights.
_MOST_GRADIENTS = 200
# Number of values of the filter response that are computed in one step, which limits the memory.
_SOME_PLACES = 1 << 16
# Minimum streak length (px) for which the matched filter is used.
_LEAST_LENGTH = 6.0
# Fraction of a star's flux that lies within three pixels across the streak.
_CAPTURED = 0.83


@dataclass(frozen=True, slots=True, eq=False)
class FaintStars:
    """Detected streaks: positions at mid-exposure (n, 2), px, fluxes (n,), counts, and significances (n,)."""

    stars: FloatArray
    light: FloatArray
    significance: FloatArray


def find_faint(
    frame: ReducedFrame,
    modelled: tuple[IntArray, Float32Array],
    pinhole: Pinhole,
    motion: CameraMotion,
    sigmas: float,
    most: int,
) -> FaintStars:
    """Return up to `most` of the most significant streaks along `motion`, after subtracting modelled stars.

    The pair `modelled` contains the flat indices (m,) of m pixels, and the counts (m,) of the modelled stars
    at these pixels.
    """
    middle = paths(pinhole, motion, np.array([pinhole.centre]), np.zeros(1)).velocity
    angle = float(np.linalg.norm(motion.rotation))
    reach = angle * float(np.sin(pinhole.half_diagonal)) * pinhole.focal_length
    if max(float(np.hypot(*middle[0])), reach) < _LEAST_LENGTH:
        return FaintStars(np.empty((0, 2)), np.empty(0), np.empty(0))
    grid = polar_grid(pinhole, motion)
    usual = SAMPLE_NOISE * frame.usual_noise
    held = running_sums(_residual_sums(frame, modelled), pinhole, grid, usual / _ROUNDING)
    # The noise of a running sum depends on the number of its samples. Sums of too few samples are excluded.
    noise = usual * np.sqrt(np.arange(max(round(grid.length), 1) + 1.0))
    noise[: math.ceil(_LEAST_SEEN * grid.length)] = np.inf
    row, column, height = _found_stars(held, noise, grid, sigmas, most)
    significance = _significance(held, noise, grid, (row, column, height))
    order = np.argsort(-significance, kind="stable")
    row, column, height, significance = row[order], column[order], height[order], significance[order]
    stars = grid.pixels(pinhole, row, column - grid.off_centre)
    seen = np.isfinite(stars).all(axis=1)
    travelled = grid.angle * np.interp(row, np.arange(len(grid.speed)), grid.speed)
    light = height / (3.0 * _CAPTURED * grid.length) * travelled
    return FaintStars(stars[seen], light[seen], significance[seen])


def _residual_sums(frame: ReducedFrame, modelled: tuple[IntArray, Float32Array]) -> Float32Array:
    """Return the 3 x 3 sums (rows * columns,) of the frame without modelled stars and bad pixels."""
    good = ~frame.bad[modelled[0]]
    pixels, light = modelled[0][good], modelled[1][good]
    signal, floor = frame.signal[pixels], frame.floor[pixels]
    # Pixels with subtracted stars get a smaller weight, because their residuals are mostly photon noise.
    share = floor / (floor + np.maximum(light, np.float32(0.0)) * np.float32(1.0 / frame.gain))
    bad = np.flatnonzero(frame.bad)
    taken = np.concatenate([signal - (signal - light) * share, frame.signal[bad]])
    return less_boxes(frame.sums, frame.shape, np.concatenate([pixels, bad]), taken)


def _less_boxes_numpy(sums: Image, shape: tuple[int, int], pixels: IntArray, taken: Image) -> Image:
    out, (rows, columns) = sums.copy(), shape
    for down in (-columns, 0, columns):
        for beside in (-1, 0, 1):
            # A neighbour beyond an edge maps to another border pixel; border pixels are set to zero below.
            out[np.clip(pixels + (down + beside), 0, out.size - 1)] -= taken
    framed = out.reshape(rows, columns)
    framed[[0, -1]] = 0
    framed[:, [0, -1]] = 0
    return out


@compiled_form_of(_less_boxes_numpy)
def less_boxes(sums: Image, shape: tuple[int, int], pixels: IntArray, taken: Image) -> Image:
    """Return the flattened 3 x 3 `sums` of a frame of `shape` after counts are subtracted from some pixels.

    The argument `pixels` (m,) contains the flat indices of the changed pixels, each once, and `taken` (m,)
    the counts to subtract. The returned sums are zero at the border of the frame.
    """
    out, (rows, columns) = sums.copy(), shape
    last = len(sums) - columns - 2
    for p in range(len(pixels)):
        at, light = pixels[p], taken[p]
        # A neighbour beyond an edge maps to another border pixel; border pixels are set to zero below.
        if columns < at <= last:
            for middle in (at - columns, at, at + columns):
                out[middle - 1] -= light
                out[middle] -= light
                out[middle + 1] -= light
        else:
            for down in (-columns, 0, columns):
                for beside in range(-1, 2):
                    out[min(max(at + down + beside, 0), len(sums) - 1)] -= light
    framed = out.reshape(rows, columns)
    framed[0], framed[rows - 1] = 0.0, 0.0
    framed[:, 0], framed[:, columns - 1] = 0.0, 0.0
    return out


_Peaks = tuple[FloatArray, FloatArray, FloatArray]
"""Fractional grid rows (k,), fractional grid columns (k,) and heights (k,) of the peaks of k stars."""


def _found_stars(held: RunningSums, noise: FloatArray, grid: PolarGrid, sigmas: float, most: int) -> _Peaks:
    """Return the peaks of the filter response `held`.

    Each pass of the search finds peaks in the residual response, solves for the heights of all stars, and
    subtracts these stars. The array `noise` contains the noise of a running sum, indexed by its number of
    samples. All passes are restricted to the samples with a significant initial response.
    """
    scale = _scales(held.light, held.count, noise, held.excess, float(sigmas))
    row, column, height = (np.empty(0) for _ in range(3))
    for turn in range(_PASSES):
        if turn == 0:
            new_row, new_column = sharp_peaks(held, scale, grid)
        else:
            significance = held.light * scale
            _subtract_responses(significance, scale, held.span, grid.length, (row, column, height))
            new_row, new_column = standing_peaks(significance, held.span, grid.length, sigmas)
        room = most - len(row)
        if not len(new_row) or room <= 0:
            continue
        row, column = np.append(row, new_row[:room]), np.append(column, new_column[:room])
        height = _heights(held, row, column, grid)
        kept = _significance(held, noise, grid, (row, column, height)) > sigmas
        row, column, height = row[kept], column[kept], height[kept]
    return row, column, height


def _scales_numpy(
    light: Float32Array, count: Int32Array, noise: FloatArray, excess: FloatArray, sigmas: float
) -> Float32Array:
    """Return the reciprocal noise (r, c) of the running sums, or 0 for sums below `sigmas` times their noise.

    The arguments `light`, `count` and `excess` are attributes of `RunningSums`. The array `noise` contains
    the noise of a running sum, indexed by its number of samples.
    """
    scale = (1.0 / noise).astype(np.float32)[count] / excess.astype(np.float32)[:, None]
    return np.where(light * scale > np.float32(sigmas), scale, np.float32(0.0))


@compiled_form_of(_scales_numpy)
def _scales(
    light: Float32Array, count: Int32Array, noise: FloatArray, excess: FloatArray, sigmas: float
) -> Float32Array:
    """See `_scales_numpy`."""
    (rows, columns), scale = light.shape, np.zeros_like(light)
    own, lowest = (1.0 / noise).astype(np.float32), np.float32(sigmas * noise.min())
    for row in range(rows):
        aloft = np.float32(excess[row])
        for begin in range(0, columns, _AT_ONCE):
            stop = min(begin + _AT_ONCE, columns)
            # Most groups of running sums contain no significant sum.
            if _any_above(light[row, begin:stop], lowest):
                for column in range(begin, stop):
                    ratio = own[count[row, column]] / aloft
                    scale[row, column] = ratio if light[row, column] * ratio > np.float32(sigmas) else 0.0
    return scale


@loop_helper
def _any_above(values: Float32Array, threshold: np.float32) -> bool:
    """Return whether any of `values` (k,) exceeds the `threshold`.

    An early exit from the loop would prevent vector instructions.
    """
    above = np.int32(0)
    for k in range(len(values)):
        above += np.int32(values[k] > threshold)
    return bool(above > 0)


def _significance(held: RunningSums, noise: FloatArray, grid: PolarGrid, stars: _Peaks) -> FloatArray:
    """Return the significance (k,) of `stars`, in standard deviations."""
    row, column, height = stars
    middle = np.rint(row).astype(int)
    seen = overlap_of(column, column, held.span[middle], grid.length)
    own = noise[held.count[middle, np.rint(column).astype(int) % held.light.shape[1]]] * held.excess[middle]
    return np.asarray(height * seen / own)


def _subtract_responses_numpy(
    significance: Float32Array, scale: Float32Array, span: FloatArray, length: float, stars: _Peaks
) -> None:
    """Subtract the filter responses of `stars`, multiplied by `scale` (r, c), from `significance` (r, c).

    The argument `span` (r, 2) is the range of columns on the detector, and `length` is in samples.
    """
    (rows, columns), (row, column, height) = scale.shape, stars
    # On each neighbouring circle, the filter response of a star covers a contiguous range of columns.
    circle = row.astype(np.int64)[:, None] + np.arange(1 - _FARTHEST, _FARTHEST + 1)
    weight = height[:, None] * profile((circle - row[:, None]) * ACROSS)
    weight = np.where((circle >= 0) & (circle < rows), weight, 0.0).reshape(-1)
    circle = np.clip(circle, 0, rows - 1).reshape(-1)
    low = np.maximum(np.ceil(column - length), 0.0).astype(np.int64)
    high = np.minimum(np.floor(column + length), columns - 1.0).astype(np.int64)
    first = circle * columns + np.repeat(low, 2 * _FARTHEST)
    count = np.where(weight > 0.0, np.repeat(high - low + 1, 2 * _FARTHEST), 0)
    # The ranges of columns are processed in groups to limit the memory.
    cuts = np.searchsorted(np.cumsum(count), np.arange(_SOME_PLACES, int(count.sum()), _SOME_PLACES))
    for some in np.split(np.arange(len(count)), np.unique(cuts)):
        many = count[some]
        which = np.arange(many.sum()) + np.repeat(first[some] - np.cumsum(many) + many, many)
        known = np.flatnonzero(scale.reshape(-1)[which])
        which, near = which[known], np.repeat(some, many)[known]
        star, at = near // (2 * _FARTHEST), which - circle[near] * columns
        common = overlap_of(at, column[star], span[circle[near]], length) * weight[near]
        np.subtract.at(significance.reshape(-1), which, common * scale.reshape(-1)[which])


@compiled_form_of(_subtract_responses_numpy)
def _subtract_responses(
    significance: Float32Array, scale: Float32Array, span: FloatArray, length: float, stars: _Peaks
) -> None:
    """See `_subtract_responses_numpy`."""
    (rows, columns), (row, column, height) = scale.shape, stars
    for star in range(len(row)):
        low = int(max(math.ceil(column[star] - length), 0))
        high = int(min(math.floor(column[star] + length), columns - 1)) + 1
        middle = int(row[star])
        for circle in range(max(middle + 1 - _FARTHEST, 0), min(middle + _FARTHEST + 1, rows)):
            aside = int(min(abs(circle - row[star]) * ACROSS * _PER_PX + 0.5, len(_PROFILE) - 1.0))
            weight = height[star] * _PROFILE[aside] / length
            edges = span[circle, 0] - column[star], span[circle, 1] - column[star]
            out, own = significance[circle, low:high], scale[circle, low:high]
            _subtract_triangle(out, own, low - column[star], length, edges, weight)


@loop_helper
def _subtract_triangle(
    out: Float32Array, scale: Float32Array, begin: float, length: float, edges: Any, weight: float
) -> None:
    """Subtract the response to one star on a circle, multiplied by `scale` (k,), from `out` (k,).

    The positions of the first sample, `begin`, and of the `edges` of the detector are relative to the star.
    """
    half, zero, height = np.float32(0.5 * length), np.float32(0.0), np.float32(weight)
    left, right, first = np.float32(edges[0]), np.float32(edges[1]), np.float32(begin)
    for k in range(len(out)):
        at = first + np.float32(k)
        common = min(min(at, zero) + half, right) - max(max(at, zero) - half, left)
        out[k] -= height * max(common, zero) * scale[k]


def _heights(held: RunningSums, row: FloatArray, column: FloatArray, grid: PolarGrid) -> FloatArray:
    """Return peak heights (k,) for which the sum of responses is the measured response at each star."""
    order, height = np.argsort(row, kind="stable"), np.empty(len(row))
    row, column = row[order], column[order]
    middle = np.rint(row).astype(int)
    one, other, overlap = _overlaps(row, column, held.span[middle], grid.length)
    seen = held.light[middle, np.rint(column).astype(int) % held.light.shape[1]].astype(np.float64)
    height[order] = _solved(one, other, overlap, (1.0 + _RIDGE) * seen)
    return height


def _overlaps_numpy(
    row: FloatArray, column: FloatArray, spans: FloatArray, length: float
) -> tuple[IntArray, IntArray, FloatArray]:
    """Return both indices (e,) of e overlapping pairs of stars, and the response at one due to the other.

    The k stars are in ascending order of `row` (k,), and each star also forms a pair with itself. The
    argument `spans` (k, 2) is the range of columns on the detector at each star, and `length` is in samples.
    """
    first = np.searchsorted(row, row - _FARTHEST, side="right")
    count = np.searchsorted(row, row + _FARTHEST) - first
    one = np.repeat(np.arange(len(row)), count)
    other = np.arange(len(one)) + np.repeat(first - np.cumsum(count) + count, count)
    near = np.flatnonzero(np.abs(column[one] - column[other]) < length)
    one, other = one[near], other[near]
    low, high = np.maximum(spans[one, 0], spans[other, 0]), np.minimum(spans[one, 1], spans[other, 1])
    overlap = overlap_of(column[one], column[other], np.stack([low, high], axis=-1), length)
    overlap = overlap * profile((row[one] - row[other]) * ACROSS)
    # Diagonal and right-hand side get the same factor, so that heights of isolated stars are unbiased.
    overlap[one == other] *= 1.0 + _RIDGE
    overlap[one == other] += _TINY
    return one, other, overlap


@compiled_form_of(_overlaps_numpy)
def _overlaps(
    row: FloatArray, column: FloatArray, spans: FloatArray, length: float
) -> tuple[IntArray, IntArray, FloatArray]:
    """See `_overlaps_numpy`."""
    room, first = 0, np.empty(len(row), np.int64)
    for k in range(len(row)):
        first[k] = 0 if k == 0 else first[k - 1]
        while row[first[k]] <= row[k] - _FARTHEST:
            first[k] += 1
        room += 2 * (k - first[k]) + 1
    one, other, overlap, count = np.empty(room, np.int64), np.empty(room, np.int64), np.empty(room), 0
    for k in range(len(row)):
        for near in range(first[k], len(row)):
            if row[near] >= row[k] + _FARTHEST:
                break
            if abs(column[k] - column[near]) >= length:
                continue
            low, high = max(spans[k, 0], spans[near, 0]), min(spans[k, 1], spans[near, 1])
            begin = max(max(column[k], column[near]) - 0.5 * length, low)
            end = min(min(column[k], column[near]) + 0.5 * length, high)
            aside = int(min(abs(row[k] - row[near]) * ACROSS * _PER_PX + 0.5, len(_PROFILE) - 1.0))
            common = max(end - begin, 0.0) / length * _PROFILE[aside]
            one[count], other[count] = k, near
            overlap[count] = (1.0 + _RIDGE) * common + _TINY if near == k else common
            count += 1
    return one[:count].copy(), other[:count].copy(), overlap[:count].copy()


def _solved_numpy(one: IntArray, other: IntArray, overlap: FloatArray, right: FloatArray) -> FloatArray:
    """Return the solution (k,) of sparse symmetric linear equations by conjugate gradients.

    The e nonzero matrix elements `overlap` (e,) are in the rows `one` (e,) and columns `other` (e,).
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


@compiled_form_of(_solved_numpy)
def _solved(one: IntArray, other: IntArray, overlap: FloatArray, right: FloatArray) -> FloatArray:
    k, scale, matrix, size = len(right), np.ones(len(right)), overlap.copy(), 0.0
    for e in range(len(one)):
        if one[e] == other[e]:
            scale[one[e]] = 1.0 / math.sqrt(overlap[e])
    for e in range(len(one)):
        matrix[e] *= scale[one[e]] * scale[other[e]]
    x, residual, direction = np.zeros(k), right * scale, right * scale
    for i in range(k):
        size += residual[i] * residual[i]
    enough = _SOLVED**2 * size
    for _ in range(_MOST_GRADIENTS):
        if size <= enough:
            break
        image, along, before = np.zeros(k), 0.0, size
        for e in range(len(one)):
            image[one[e]] += matrix[e] * direction[other[e]]
        for i in range(k):
            along += direction[i] * image[i]
        length, size = size / along, 0.0
        for i in range(k):
            x[i] += length * direction[i]
            residual[i] -= length * image[i]
            size += residual[i] * residual[i]
        for i in range(k):
            direction[i] = residual[i] + size / before * direction[i]
    return x * scale
