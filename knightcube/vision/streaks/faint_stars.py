"""Detection of faint star streaks for a known motion, and search for the rotation angle, on polar grids.

The sums of 3 x 3 pixels of the frame are sampled on circles about the rotation axis, where all streaks are
straight and equally long. The matched filter of a streak is a running sum over the length of the streak.
Along a circle, the filter response to a star is a triangle, truncated at the border of the detector. Across
the circles, the filter response is proportional to the brightness profile of the star. Each peak of the
filter response is a star. The heights of overlapping peaks are the solution of a linear system. For bright
stars, the second difference of the response along the circle separates overlapping triangles.

If the brightest regions do not determine the rotation angle, all circles are searched. The search of all
circles is needed if streaks are faint and fragmented, or if the border truncates all streaks. The mean of the
pixels in a box along a circle is compared with the mean of the pixels on both sides of the box. The box
length with the largest sum of squared significances is the length of the streaks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from knightcube.astro.arrays import BoolArray, Float32Array, FloatArray, Image, IntArray
from knightcube.compiled import compiled_form_of
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks.frame import ReducedFrame
from knightcube.vision.streaks.geometry import CameraMotion, paths
from knightcube.vision.streaks.polar_grid import (
    ACROSS,
    PolarGrid,
    RunningSums,
    cumulative_sums,
    polar_grid,
    running_sums,
)

# Minimum fraction of a faint star's streak that must lie on the detector.
_LEAST_SEEN = 0.35
# Number of grid circles between two stars from which the profiles of the stars do not overlap.
_FARTHEST = 5
# Standard deviation (px) of a star's profile across the streak, as assumed by the filter.
_WIDTH = 1.05
# Step (samples) of the second difference of the filter response along a circle of the grid.
_SHARP_STEP = 3
# Minimum streak length (samples) for the separation of stars by the second difference.
_SHARP_FROM = 40.0
# Minimum second difference of a star's filter response, in standard deviations of its noise.
_SHARP_SIGMAS = 6.0
# Minimum second difference of a star's filter response, relative to the response.
_SHARP_SHARE = 0.3
# Minimum fraction of the response at a star's peak that must remain after stronger peaks are subtracted.
_OWN_SHARE = 0.45
# Maximum number of peaks in one pass of the search.
_MOST_PEAKS = 1000
# Offsets (rows, columns) to the neighbours with which a local maximum is compared, in ascending order of
# distance.
_NEIGHBOURS = sorted(
    ((down, beside) for down in (-1, 0, 1) for beside in (-2, -1, 0, 1, 2) if (down, beside) != (0, 0)),
    key=lambda step: abs(step[0]) + abs(step[1]),
)

# Number of entries of the table `_PROFILE` per px of distance from the star.
_PER_PX = 50.0
# Filter response to a star, relative to its maximum, as a table by the distance of a circle from the star.
_PROFILE = ndtr((np.arange(400) / _PER_PX + 1.5) / _WIDTH) - ndtr((np.arange(400) / _PER_PX - 1.5) / _WIDTH)
_PROFILE /= _PROFILE[0]


def overlap_of(one: FloatArray, other: FloatArray, span: FloatArray, length: float) -> FloatArray:
    """Return the overlap of two streaks at the columns `one` and `other` (...), relative to their length.

    The argument `span` (..., 2) is the range of columns of a circle that lie on the detector. `length` is in
    samples.
    """
    first = np.maximum(np.maximum(one, other) - 0.5 * length, span[..., 0])
    last = np.minimum(np.minimum(one, other) + 0.5 * length, span[..., 1])
    return np.asarray(np.maximum(last - first, 0.0) / length)


def profile(distance: FloatArray) -> FloatArray:
    """Return the filter response to a star at a `distance` (px) across its circle, relative to the peak."""
    index = np.minimum(np.abs(distance) * _PER_PX + 0.5, len(_PROFILE) - 1.0).astype(np.int64)
    return np.asarray(_PROFILE[index])


def sharp_peaks(
    held: RunningSums, place: IntArray, deviation: FloatArray, grid: PolarGrid
) -> tuple[FloatArray, FloatArray]:
    """Return grid rows and columns of bright stars, found by the second difference of the filter response.

    The peaks of the second difference are narrow, so that stars close to each other on one circle are
    separated. Only the p samples with high filter responses are searched. The arguments `place` (p,) and
    `deviation` (p,) are the flat indices and the noise of these samples.
    """
    step = _SHARP_STEP
    if grid.length < _SHARP_FROM:
        return np.empty(0), np.empty(0)
    flat, count = held.light.reshape(-1), held.count.reshape(-1)[place]
    bend = flat.take(place - step, mode="clip")
    bend += flat.take(place + step, mode="clip")
    np.subtract(np.float32(2.0) * flat[place], bend, out=bend)
    bend *= np.float32(grid.length / (2.0 * step))
    # The second difference, and its noise, are scaled so that the second difference equals the response for
    # an isolated star.
    own = flat[place]
    leverage = grid.length / (2.0 * step) * np.sqrt(6.0 * step / np.maximum(count, 1))
    sharply = (bend > _SHARP_SIGMAS * leverage * deviation) & (bend > _SHARP_SHARE * own)
    sharp = np.zeros(held.light.shape, dtype=np.float32)
    sharp.reshape(-1)[place] = bend
    row, column = _local_maxima(sharp, place[sharply])
    return _refined(sharp, row, column, 0), _refined(sharp, row, column, 1)


def standing_peaks(
    significance: Float32Array, span: FloatArray, place: IntArray, grid: PolarGrid, sigmas: float
) -> tuple[FloatArray, FloatArray]:
    """Return the peaks of stars, the strongest first, as fractional grid rows and columns.

    A peak is omitted if stronger peaks cause most of its response. Only the flat indices `place` (p,) of the
    filter response are searched. The range `span` (r, 2) of columns on the detector is that of `RunningSums`.
    """
    row, column = _local_maxima(significance, place)
    value, spans = significance[row, column].astype(np.float64), span[row]
    kept = _unshaded(row, column, value, spans, grid.length, sigmas, ACROSS)
    row, column = row[kept], column[kept]
    return _refined(significance, row, column, 0), _refined(significance, row, column, 1)


def _unshaded_numpy(
    row: IntArray,
    column: IntArray,
    value: FloatArray,
    spans: FloatArray,
    length: float,
    sigmas: float,
    across: float,
) -> BoolArray:
    """Return a mask (k,) of the peaks, the strongest first, that are not caused by stronger peaks.

    The arguments are grid indices and heights `value` of the peaks, the ranges `spans` (k, 2) of columns on
    the detector, the streak length in samples, the minimum height, and the spacing of the circles, px.
    """
    by_row = np.argsort(row, kind="stable")
    first = np.searchsorted(row[by_row], row - _FARTHEST + 1)
    count = np.searchsorted(row[by_row], row + _FARTHEST) - first
    stronger = np.repeat(np.arange(len(row)), count)
    weaker = by_row[np.arange(len(stronger)) + np.repeat(first - np.cumsum(count) + count, count)]
    # A frame with many stars has hundreds of thousands of pairs of peaks, and most pairs are too far apart to
    # overlap.
    near = np.flatnonzero((stronger < weaker) & (np.abs(column[stronger] - column[weaker]) < length))
    stronger, weaker = stronger[near], weaker[near]
    there = column.astype(np.float64)
    share = overlap_of(there[stronger], there[weaker], spans[stronger], length)
    share /= np.maximum(overlap_of(there, there, spans, length), _LEAST_SEEN)[stronger]
    shading = np.flatnonzero(share > 0.0)
    stronger, weaker = stronger[shading], weaker[shading]
    share = share[shading] * profile((row[stronger] - row[weaker]) * across)
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
    row: IntArray,
    column: IntArray,
    value: FloatArray,
    spans: FloatArray,
    length: float,
    sigmas: float,
    across: float,
) -> BoolArray:
    """See `_unshaded_numpy`."""
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
            aside = int(min(abs(row[k] - row[w]) * across * _PER_PX + 0.5, len(_PROFILE) - 1.0))
            own[w] -= own[k] * share * _PROFILE[aside]
    return kept


def _local_maxima(values: Float32Array, place: IntArray) -> tuple[IntArray, IntArray]:
    """Return grid rows and columns of local maxima among the indices `place` (p,), in descending order."""
    columns = values.shape[1]
    place = place[_summits(values.reshape(-1), place, columns)]
    place = place[np.argsort(-values.reshape(-1)[place], kind="stable")[:_MOST_PEAKS]]
    row, column = np.divmod(place, columns)
    return row, column


def _summits_numpy(flat: Float32Array, place: IntArray, columns: int) -> BoolArray:
    """Return which of the flat indices `place` (p,) are local maxima of a grid with `columns` columns."""
    kept = np.arange(len(place))
    # If the circles are complete, the first column of a circle is a neighbour of the last column.
    for down, beside in _NEIGHBOURS:
        at = place[kept]
        kept = kept[flat.take(at + (down * columns + beside), mode="wrap") <= flat[at]]
    out = np.zeros(len(place), dtype=np.bool_)
    out[kept] = True
    return out


@compiled_form_of(_summits_numpy)
def _summits(flat: Float32Array, place: IntArray, columns: int) -> BoolArray:
    """See `_summits_numpy`."""
    out = np.ones(len(place), dtype=np.bool_)
    for p in range(len(place)):
        value = flat[place[p]]
        for down in range(-1, 2):
            for beside in range(-2, 3):
                if out[p] and flat[(place[p] + down * columns + beside) % len(flat)] > value:
                    out[p] = False
    return out


def _refined(significance: Float32Array, row: IntArray, column: IntArray, axis: int) -> FloatArray:
    """Return the fractional indices of peaks along `axis`, each from a parabola through three values."""
    place = (row, column)[axis]
    size = significance.shape[axis]
    before, after = np.maximum(place - 1, 0), np.minimum(place + 1, size - 1)
    left = significance[before, column] if axis == 0 else significance[row, before]
    right = significance[after, column] if axis == 0 else significance[row, after]
    bend = left + right - 2.0 * significance[row, column]
    offset = np.where(bend < 0.0, 0.5 * (left - right) / np.where(bend < 0.0, bend, -1.0), 0.0)
    return np.asarray(place + np.clip(offset, -0.5, 0.5))


# Ratio of the noise of a sample to the step to which samples are rounded.
_ROUNDING = 30.0
# Number of passes of the search for stars, of which the first uses second differences.
_PASSES = 3
# Relative regularisation of the normal equations for peak heights, for stars that nearly coincide.
_RIDGE = 0.01
# Absolute regularisation of the normal equations for peak heights.
_TINY = 1e-6
# Relative accuracy at which the iteration for the peak heights stops.
_SOLVED = 1e-4
# Maximum number of conjugate-gradient iterations for the peak heights.
_MOST_GRADIENTS = 200
# Number of values of the filter response that are computed in one step, which limits the memory.
_SOME_PLACES = 1 << 16
# Minimum streak length (px) for which the matched filter is used.
_LEAST_LENGTH = 6.0
# Fraction of a star's flux that lies within three pixels across the streak.
_CAPTURED = 0.83
# Ratio of the noise of a sum of n overlapping 3 x 3 samples to sqrt(n) times the noise of a pixel.
_SAMPLE_NOISE = 3.1


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
    reach = (
        float(np.linalg.norm(motion.rotation)) * float(np.sin(pinhole.half_diagonal)) * pinhole.focal_length
    )
    if max(float(np.hypot(*middle[0])), reach) < _LEAST_LENGTH:
        return FaintStars(np.empty((0, 2)), np.empty(0), np.empty(0))
    grid = polar_grid(pinhole, motion)
    usual = _SAMPLE_NOISE * float(np.sqrt(np.median(frame.floor[::97])))
    held = running_sums(_residual_sums(frame, modelled), pinhole, grid, usual / _ROUNDING)
    # The noise of a running sum depends on the number of its samples. Sums of too few samples are excluded.
    noise = usual * np.sqrt(np.arange(max(round(grid.length), 1) + 1.0))
    noise[: math.ceil(_LEAST_SEEN * grid.length)] = np.inf
    row, column, height = _found_stars(held, noise, grid, sigmas, most)
    significance = _significance(held, noise, grid, row, column, height)
    order = np.argsort(-significance, kind="stable")
    row, column, height, significance = row[order], column[order], height[order], significance[order]
    stars = grid.pixels(pinhole, row, column - grid.off_centre)
    seen = np.isfinite(stars).all(axis=1)
    travelled = grid.angle * np.interp(row, np.arange(len(grid.speed)), grid.speed)
    light = height / (3.0 * _CAPTURED * grid.length) * travelled
    return FaintStars(stars[seen], light[seen], significance[seen])


def _residual_sums(frame: ReducedFrame, modelled: tuple[IntArray, Float32Array]) -> Float32Array:
    """Return the 3 x 3 sums (rows * columns,) of the frame without modelled stars and bad pixels."""
    pixels, light = modelled
    signal, floor = frame.signal[pixels], frame.floor[pixels]
    # Pixels from which bright stars were subtracted get a smaller weight, because their residuals are mostly
    # photon noise.
    share = floor / (floor + np.maximum(light, np.float32(0.0)) * np.float32(1.0 / frame.gain))
    left = (signal - light) * share
    left[frame.bad[pixels]] = 0.0
    lost = frame.bad.copy()
    lost[pixels] = False
    unmodelled = np.flatnonzero(lost)
    return less_boxes(
        frame.sums,
        frame.shape,
        np.concatenate([pixels, unmodelled]),
        np.concatenate([signal - left, frame.signal[unmodelled]]),
    )


def _less_boxes_numpy(sums: Image, shape: tuple[int, int], pixels: IntArray, taken: Image) -> Image:
    """See `less_boxes`."""
    out, (rows, columns) = sums.copy(), shape
    for down in (-columns, 0, columns):
        for beside in (-1, 0, 1):
            # Sums that would cross the edge of the frame belong to border pixels, which are set to zero.
            out[np.clip(pixels + (down + beside), 0, out.size - 1)] -= taken
    framed = out.reshape(rows, columns)
    framed[[0, -1]] = 0
    framed[:, [0, -1]] = 0
    return out


@compiled_form_of(_less_boxes_numpy)
def less_boxes(sums: Image, shape: tuple[int, int], pixels: IntArray, taken: Image) -> Image:
    """Return the flattened 3 x 3 `sums` of a frame of `shape` after counts are subtracted from some pixels.

    The indices `pixels` (m,) are those of the changed pixels, each given once, and `taken` (m,) are the
    counts to subtract. The sums of the border pixels are zero.
    """
    out, (rows, columns) = sums.copy(), shape
    for p in range(len(pixels)):
        row, column = pixels[p] // columns, pixels[p] % columns
        for r in range(max(row - 1, 1), min(row + 2, rows - 1)):
            for c in range(max(column - 1, 1), min(column + 2, columns - 1)):
                out[r * columns + c] -= taken[p]
    framed = out.reshape(rows, columns)
    framed[0], framed[rows - 1] = 0.0, 0.0
    framed[:, 0], framed[:, columns - 1] = 0.0, 0.0
    return out


def _found_stars(
    held: RunningSums, noise: FloatArray, grid: PolarGrid, sigmas: float, most: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return fractional grid rows and columns, and heights, of the peaks of the filter response `held`.

    Each pass of the search finds peaks in the residual response, solves for the heights of all stars, and
    subtracts these stars. The array `noise` contains the noise of a running sum, indexed by its number of
    samples. All passes are restricted to the samples with a significant initial response.
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
        left = flat[place] - _responses(held, place, grid, row, column, height)
    return row, column, height


def _significance(
    held: RunningSums,
    noise: FloatArray,
    grid: PolarGrid,
    row: FloatArray,
    column: FloatArray,
    height: FloatArray,
) -> FloatArray:
    """Return the significance (k,) of stars with peak heights `height` (k,), in standard deviations."""
    middle = np.rint(row).astype(int)
    seen = overlap_of(column, column, held.span[middle], grid.length)
    own = noise[held.count[middle, np.rint(column).astype(int) % held.light.shape[1]]] * held.excess[middle]
    return np.asarray(height * seen / own)


def _responses(
    held: RunningSums,
    place: IntArray,
    grid: PolarGrid,
    row: FloatArray,
    column: FloatArray,
    height: FloatArray,
) -> FloatArray:
    """Return the sum of the filter responses of all stars at the ascending flat indices `place` (p,)."""
    out = np.zeros(len(place))
    _add_responses(out, place, held.span, held.light.shape, grid.length, row, column, height, ACROSS)
    return out


def _add_responses_numpy(
    out: FloatArray,
    place: IntArray,
    span: FloatArray,
    shape: tuple[int, int],
    length: float,
    row: FloatArray,
    column: FloatArray,
    height: FloatArray,
    across: float,
) -> None:
    """Add the filter responses of stars at the grid indices `row` and `column` to the array `out` (p,).

    The other arguments are those of `_responses`, the shape of the grid, the streak length in samples, and
    the spacing of the circles, px.
    """
    rows, columns = shape
    # On each neighbouring circle, the filter response of a star covers a contiguous range of columns.
    circle = row.astype(np.int64)[:, None] + np.arange(1 - _FARTHEST, _FARTHEST + 1)
    weight = height[:, None] * profile((circle - row[:, None]) * across)
    weight = np.where((circle >= 0) & (circle < rows), weight, 0.0)
    circle = np.clip(circle, 0, rows - 1)
    low = np.maximum(np.ceil(column - length), 0.0).astype(np.int64)
    high = np.minimum(np.floor(column + length), columns - 1.0).astype(np.int64)
    first = np.searchsorted(place, (circle * columns + low[:, None]).reshape(-1))
    count = np.searchsorted(place, (circle * columns + high[:, None]).reshape(-1), side="right") - first
    reached = np.flatnonzero((count > 0) & (weight.reshape(-1) > 0.0))
    first, count = first[reached], count[reached]
    circle, weight = circle.reshape(-1)[reached], weight.reshape(-1)[reached]
    star = reached // (2 * _FARTHEST)
    # The ranges of columns are processed in groups to limit the memory.
    cuts = np.searchsorted(np.cumsum(count), np.arange(_SOME_PLACES, int(count.sum()), _SOME_PLACES))
    for some in np.split(np.arange(len(reached)), np.unique(cuts)):
        many = count[some]
        which = np.arange(many.sum()) + np.repeat(first[some] - np.cumsum(many) + many, many)
        at = (place[which] - np.repeat(circle[some] * columns, many)).astype(np.float64)
        common = overlap_of(
            at,
            np.repeat(column[star[some]], many),
            np.repeat(span[circle[some]], many, axis=0),
            length,
        )
        common *= np.repeat(weight[some], many)
        np.add.at(out, which, common)


@compiled_form_of(_add_responses_numpy)
def _add_responses(
    out: FloatArray,
    place: IntArray,
    span: FloatArray,
    shape: tuple[int, int],
    length: float,
    row: FloatArray,
    column: FloatArray,
    height: FloatArray,
    across: float,
) -> None:
    """See `_add_responses_numpy`."""
    rows, columns = shape
    for star in range(len(row)):
        low = int(max(math.ceil(column[star] - length), 0))
        high = int(min(math.floor(column[star] + length), columns - 1))
        middle = int(row[star])
        for circle in range(max(middle + 1 - _FARTHEST, 0), min(middle + _FARTHEST + 1, rows)):
            aside = int(min(abs(circle - row[star]) * across * _PER_PX + 0.5, len(_PROFILE) - 1.0))
            weight = height[star] * _PROFILE[aside]
            if weight <= 0.0:
                continue
            begin = np.searchsorted(place, circle * columns + low)
            for p in range(begin, len(place)):
                at = place[p] - circle * columns
                if at > high:
                    break
                first = max(max(at, column[star]) - 0.5 * length, span[circle, 0])
                last = min(min(at, column[star]) + 0.5 * length, span[circle, 1])
                out[p] += weight * max(last - first, 0.0) / length


def _heights(held: RunningSums, row: FloatArray, column: FloatArray, grid: PolarGrid) -> FloatArray:
    """Return peak heights (k,) of stars such that the sum of their responses is the measured response."""
    middle = np.rint(row).astype(int)
    # The arrays `one` and `other` contain the indices of all pairs of stars that may overlap, including pairs
    # of a star with itself.
    order = np.argsort(row, kind="stable")
    first = np.searchsorted(row[order], row - _FARTHEST, side="right")
    count = np.searchsorted(row[order], row + _FARTHEST) - first
    one = np.repeat(np.arange(len(row)), count)
    other = order[np.arange(len(one)) + np.repeat(first - np.cumsum(count) + count, count)]
    near = np.flatnonzero(np.abs(column[one] - column[other]) < grid.length)
    one, other = one[near], other[near]
    span = held.span[middle]
    common = np.stack(
        [np.maximum(span[one, 0], span[other, 0]), np.minimum(span[one, 1], span[other, 1])], axis=-1
    )
    overlap = overlap_of(column[one], column[other], common, grid.length) * profile(
        (row[one] - row[other]) * ACROSS
    )
    # The measured responses `seen` are multiplied by the same factor as the diagonal, so that the
    # regularisation does not change the heights of isolated stars.
    overlap[one == other] *= 1.0 + _RIDGE
    overlap[one == other] += _TINY
    seen = (1.0 + _RIDGE) * held.light[middle, np.rint(column).astype(int) % held.light.shape[1]].astype(
        np.float64
    )
    return _solved(one, other, overlap, seen)


def _solved(one: IntArray, other: IntArray, overlap: FloatArray, right: FloatArray) -> FloatArray:
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


# Ratio of consecutive trial lengths of a box, which is a run of samples along a circle.
_FACTOR = 1.1
# Smallest trial length (samples) of a box, which is a run of samples along a circle.
_SHORTEST = 5
# Factor by which the search for the rotation angle reduces the number of circles.
_SPARSE = 2
# Minimum significance (standard deviations) of the mean of a box relative to the samples on both sides of it,
# for the box to count in the search for the rotation angle.
_LEAST_SIGMAS = 5.0
# Upper limit of the significance (standard deviations) of one box in the sum over all boxes of one length.
_ENOUGH = 40.0


def frame_angles(frame: ReducedFrame, pinhole: Pinhole, rotation: FloatArray, most: int) -> list[float]:
    """Return at most `most` rotation angles (rad) about the axis of `rotation` (3,), most likely first."""
    # The grid is sampled as for a rotation by one radian.
    grid = polar_grid(pinhole, CameraMotion.steady(rotation / np.linalg.norm(rotation)), _SPARSE)
    step = grid.angle / grid.length
    held = cumulative_sums(frame.sums, pinhole, grid)
    held *= np.float32(1.0 / (_SAMPLE_NOISE * np.sqrt(np.median(frame.floor[::97]))))
    longest = min(len(grid.azimuth) // 2, int(np.pi / step))
    if longest < 2 * _SHORTEST:
        return []
    count = int(np.log(longest / _SHORTEST) / np.log(_FACTOR)) + 1
    widths = np.unique(np.rint(_SHORTEST * _FACTOR ** np.arange(count)).astype(np.int64))
    room = int(sharper_widths(int(widths[-1]), longest)[-1]) // 2
    # The azimuth is the first array axis, so that memory is read contiguously.
    padded = np.pad(np.ascontiguousarray(held.T), ((room, room), (0, 0)), mode="edge")
    score = np.array([_box_significance(padded, room, int(width)) for width in widths])
    before, after = np.append(0.0, score[:-1]), np.append(score[1:], 0.0)
    peak = np.flatnonzero((score > before) & (score >= after))
    peak = peak[np.argsort(-score[peak], kind="stable")][:most]
    angles = []
    for index in peak:
        near = sharper_widths(int(widths[index]), longest)
        refined = [_box_significance(padded, room, int(width)) for width in near]
        angles.append(int(near[int(np.argmax(refined))]) * step)
    return angles


def _box_significance(padded: Float32Array, room: int, width: int) -> float:
    """Return the sum of the squared significances of the most significant boxes of `width` samples.

    The array `padded` (c, r) contains the cumulative sums along the azimuth on r circles, with a margin of
    `room` samples at both ends.
    """
    stretches = (len(padded) - 2 * room - width) // width
    outer, inner, behind, beyond = (
        padded[room + offset : room + offset + stretches * width]
        for offset in (-(width // 2), 0, width, width + width // 2)
    )
    light = behind - inner
    light *= np.float32(2.0)
    light -= beyond
    light += outer
    # The circles are divided into intervals of one box length. The most significant box of an interval is
    # counted if no adjacent interval, on the same or a neighbouring circle, has a more significant box.
    best = light.reshape(stretches, width, -1).max(axis=1)
    best *= np.float32(1.0 / np.sqrt(2.0 * width))
    around = np.pad(best, 1)
    highest = best >= _LEAST_SIGMAS
    for down in (0, 1, 2):
        for beside in (0, 1, 2):
            highest &= best >= around[down : down + stretches, beside : beside + best.shape[1]]
    return float(np.sum(np.minimum(best[highest], _ENOUGH) ** 2))


def sharper_widths(width: int, longest: int) -> IntArray:
    """Return the integer box lengths (samples) within half a search step of `width`, up to `longest`."""
    room = max(1, round(0.6 * (_FACTOR - 1.0) * width))
    return np.arange(max(width - room, 2), min(width + room, longest) + 1)
