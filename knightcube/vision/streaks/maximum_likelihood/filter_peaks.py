"""The response of a running sum along circles to stars, and its peaks.

Along its circle a star's response is a triangle, cut short where the detector ends; beside it, the profile
of its light. From the strongest peak on, each is believed only as far as it exceeds what those before it put
there. Where the light suffices, the second difference along the circle tells apart stars whose triangles
merge.
"""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.vision.streaks.maximum_likelihood.exposed_frame import Float32Array
from knightcube.vision.streaks.maximum_likelihood.polar_grid import ACROSS, PolarGrid
from knightcube.vision.streaks.maximum_likelihood.running_sums import RunningSums

LEAST_SEEN = 0.35
"""A streak needs this part of itself on the detector."""
FARTHEST = 5
"""Circles so far apart share no light."""

# Width of the point spread and the pixel together that the filter supposes, px.
_WIDTH = 1.05
# Samples between a response and its neighbours by which two ends are separated, used for streaks of this many
# samples or more; how much it takes, in sigmas and as a share of the height.
_SHARP_STEP = 3
_SHARP_FROM = 40.0
_SHARP_SIGMAS = 6.0
_SHARP_SHARE = 0.3
# A peak under another's shoulder must hold so much of what is there on its own.
_OWN_SHARE = 0.45
_MOST_PEAKS = 1000
# A summit is no lower than these: rows and columns from it, those first that rule most out.
_NEIGHBOURS = sorted(
    ((down, beside) for down in (-1, 0, 1) for beside in (-2, -1, 0, 1, 2) if (down, beside) != (0, 0)),
    key=lambda step: abs(step[0]) + abs(step[1]),
)

# The response of circles beside a star's own is tabulated in this many steps a px.
_PER_PX = 50.0
_PROFILE = ndtr((np.arange(400) / _PER_PX + 1.5) / _WIDTH) - ndtr((np.arange(400) / _PER_PX - 1.5) / _WIDTH)
_PROFILE /= _PROFILE[0]


def shared(one: FloatArray, other: FloatArray, span: FloatArray, length: float) -> FloatArray:
    """Return the part of a streak of `length` samples about `one` that another has in common with it.

    All arrays alike, `span` (..., 2) with between what columns there are samples at all.
    """
    first = np.maximum(np.maximum(one, other) - 0.5 * length, span[..., 0])
    last = np.minimum(np.minimum(one, other) + 0.5 * length, span[..., 1])
    return np.asarray(np.maximum(last - first, 0.0) / length)


def profile(distance: FloatArray) -> FloatArray:
    """Return the response of circles `distance` px beside a star's own, 1 at the star."""
    index = np.minimum(np.abs(distance) * _PER_PX + 0.5, len(_PROFILE) - 1.0).astype(np.int64)
    return np.asarray(_PROFILE[index])


def sharp_peaks(
    held: RunningSums, place: IntArray, deviation: FloatArray, grid: PolarGrid
) -> tuple[FloatArray, FloatArray]:
    """Return rows and columns of the stars whose both ends stand out.

    The second difference of a response by a few samples is a narrow peak, be there other stars a little
    farther along the circle; it tells of the bright, which have the light for it.
    """
    step = _SHARP_STEP
    if grid.length < _SHARP_FROM:
        return np.empty(0), np.empty(0)
    flat, count = held.light.reshape(-1), held.count.reshape(-1)[place]
    bend = flat.take(place - step, mode="clip")
    bend += flat.take(place + step, mode="clip")
    np.subtract(np.float32(2.0) * flat[place], bend, out=bend)
    bend *= np.float32(grid.length / (2.0 * step))
    # Of the height that a lone star's bend gives; its noise is that of few samples, times the leverage.
    own = flat[place]
    leverage = grid.length / (2.0 * step) * np.sqrt(6.0 * step / np.maximum(count, 1))
    sharply = (bend > _SHARP_SIGMAS * leverage * deviation) & (bend > _SHARP_SHARE * own)
    sharp = np.zeros(held.light.shape, dtype=np.float32)
    sharp.reshape(-1)[place] = bend
    row, column = _summits(sharp, place[sharply])
    return _refined(sharp, row, column, 0), _refined(sharp, row, column, 1)


def standing_peaks(
    significance: Float32Array, span: FloatArray, place: IntArray, grid: PolarGrid, sigmas: float
) -> tuple[FloatArray, FloatArray]:
    """Return rows and columns, between samples, of the peaks, strongest first, that stand on their own.

    Only the flat places (p,) are looked at; all others are lower.
    """
    row, column = _summits(significance, place)
    value = significance[row, column].astype(np.float64)
    kept = _standing(row, column, value, span[row], grid, sigmas)
    row, column = row[kept], column[kept]
    return _refined(significance, row, column, 0), _refined(significance, row, column, 1)


def _summits(values: Float32Array, place: IntArray) -> tuple[IntArray, IntArray]:
    """Return rows and columns of those flat places (p,) that no neighbour exceeds, the highest first."""
    flat, columns = values.reshape(-1), values.shape[1]
    value = flat[place]
    # Past the last column comes the next circle's first: on full circles nearly the neighbour it should be.
    for down, beside in _NEIGHBOURS:
        summit = flat.take(place + (down * columns + beside), mode="wrap") <= value
        place, value = place[summit], value[summit]
    place = place[np.argsort(-value, kind="stable")[:_MOST_PEAKS]]
    row, column = np.divmod(place, columns)
    return row, column


def _standing(
    row: IntArray, column: IntArray, value: FloatArray, span: FloatArray, grid: PolarGrid, sigmas: float
) -> BoolArray:
    """Return which peaks (n,), strongest first, rise above the shoulders of those kept before them."""
    by_row = np.argsort(row, kind="stable")
    first = np.searchsorted(row[by_row], row - FARTHEST + 1)
    count = np.searchsorted(row[by_row], row + FARTHEST) - first
    stronger = np.repeat(np.arange(len(row)), count)
    weaker = by_row[np.arange(len(stronger)) + np.repeat(first - np.cumsum(count) + count, count)]
    # In a crowd there are hundreds of thousands of pairs: most are too far apart to share anything.
    near = np.flatnonzero((stronger < weaker) & (np.abs(column[stronger] - column[weaker]) < grid.length))
    stronger, weaker = stronger[near], weaker[near]
    there = column.astype(np.float64)
    share = shared(there[stronger], there[weaker], span[stronger], grid.length)
    share /= np.maximum(shared(there, there, span, grid.length), LEAST_SEEN)[stronger]
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


def _refined(significance: Float32Array, row: IntArray, column: IntArray, axis: int) -> FloatArray:
    """Return the peaks' places along `axis`, between samples: the vertex of a parabola."""
    place = (row, column)[axis]
    size = significance.shape[axis]
    before, after = np.maximum(place - 1, 0), np.minimum(place + 1, size - 1)
    left = significance[before, column] if axis == 0 else significance[row, before]
    right = significance[after, column] if axis == 0 else significance[row, after]
    bend = left + right - 2.0 * significance[row, column]
    offset = np.where(bend < 0.0, 0.5 * (left - right) / np.where(bend < 0.0, bend, -1.0), 0.0)
    return np.asarray(place + np.clip(offset, -0.5, 0.5))
