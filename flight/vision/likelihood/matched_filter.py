"""Faint streaks, once the motion is known: all stars turn by one angle about one axis.

The frame's 3 x 3 sums are sampled on circles about the axis; there every streak is straight and equally long,
and a running sum of that length is its matched filter. The response to a star is a triangle along its circle:
from the strongest peak on, each is believed only as far as it exceeds what those before it put there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from flight.arrays import BoolArray, FloatArray, Image, IntArray
from flight.pinhole import Pinhole
from flight.vision.likelihood.chains import apart, circles
from flight.vision.likelihood.exposed_frame import ExposedFrame, Float32Array
from flight.vision.likelihood.motion import Motion, paths
from flight.vision.segmentation import box_sum

# Spacing of the circles, px, and of the samples along them.
_ACROSS = 1.8
_ALONG = 4.0
# Samples are rounded to this part of their noise.
_ROUNDING = 30.0
# Circles worked on at a time, so that they stay in the processor's cache.
_CHUNK = 32
# A streak needs this part of itself on the detector.
_LEAST_SEEN = 0.35
# Width of the point spread and the pixel together that the filter supposes, px.
_WIDTH = 1.05
_PASSES = 2
_RIDGE = 0.05
# Shorter streaks, px, are no lines that a filter could follow.
_LEAST_LENGTH = 6.0
# Circles so far apart share no light.
_FARTHEST = 5
# The part of a streak's light that falls in the three pixels across.
_CAPTURED = 0.83
# Noise of a sum of samples over a pixel's and the root of their number: nine pixels each, which overlap.
_SAMPLE_NOISE = 3.1
# A peak under another's shoulder must hold so much of what is there on its own.
_OWN_SHARE = 0.45
_MOST_PEAKS = 1000
# A summit is no lower than these: rows and columns from it, those first that rule most out.
_NEIGHBOURS = sorted(
    ((down, beside) for down in (-1, 0, 1) for beside in (-2, -1, 0, 1, 2) if (down, beside) != (0, 0)),
    key=lambda step: abs(step[0]) + abs(step[1]),
)


# The response of circles beside a star's own, every so many parts of a px.
_PER_PX = 50.0
_PROFILE = ndtr((np.arange(400) / _PER_PX + 1.5) / _WIDTH) - ndtr((np.arange(400) / _PER_PX - 1.5) / _WIDTH)
_PROFILE /= _PROFILE[0]


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
    circles = _circles(pinhole, motion)
    usual = _SAMPLE_NOISE * float(np.sqrt(np.median(frame.floor[::97])))
    sums = box_sum(_left_over(frame, modelled))
    response, count = _filtered(sums, pinhole, circles, usual / _ROUNDING)
    # The noise for every number of samples; too few tell nothing.
    noise = usual * np.sqrt(np.arange(max(round(circles.length), 1) + 1.0))
    noise[: math.ceil(_LEAST_SEEN * circles.length)] = np.inf
    row, column, height = _cleaned(response, count, noise, circles, sigmas, most)
    own = noise[count[np.rint(row).astype(int), _wrapped(column, response)]]
    order = np.argsort(-height / own, kind="stable")
    row, column, height, own = row[order], column[order], height[order], own[order]
    stars = _pixels(pinhole, circles, row, column - _off_centre(circles))
    seen = np.isfinite(stars).all(axis=1)
    travelled = circles.angle * np.interp(row, np.arange(len(circles.speed)), circles.speed)
    light = height / (3.0 * _CAPTURED * circles.length) * travelled
    return FaintStars(stars[seen], light[seen], (height / own)[seen])


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


def close_by(
    pinhole: Pinhole, motion: Motion, stars: FloatArray, others: FloatArray, distance: float
) -> BoolArray:
    """Tell which of `stars` (n, 2) draw streaks within `distance` px of a streak of `others` (m, 2)."""
    polar, azimuth = circles(pinhole, motion, stars)
    other_polar, other_azimuth = circles(pinhole, motion, others)
    beside = np.abs(polar[:, None] - other_polar) * pinhole.focal_length < distance
    room = distance / (pinhole.focal_length * np.maximum(np.sin(other_polar), 1e-3))
    angle = float(np.linalg.norm(motion.turn))
    return np.asarray((beside & (apart(azimuth, other_azimuth) < angle + room)).any(axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class _Circles:
    """Samples (r, c) on circles about the axis.

    `frame` (3, 3) has two axes across and the axis as rows; `polar` (r,) and `azimuth` (c,) rad; `length`
    samples make a streak of `angle` rad; `speed` (r,) px per rad.
    """

    frame: FloatArray
    polar: FloatArray
    azimuth: FloatArray
    length: float
    angle: float
    speed: FloatArray


def _circles(pinhole: Pinhole, motion: Motion) -> _Circles:
    angle = float(np.linalg.norm(motion.turn))
    axis = motion.turn / angle
    middle = np.array([0.0, 0.0, 1.0])
    if axis @ middle < 0.0:
        axis = -axis
    first = middle - (middle @ axis) * axis
    inside_field = float(np.arccos(np.clip(axis[2], -1.0, 1.0)))
    if np.linalg.norm(first) < 1e-6:
        first = np.array([1.0, 0.0, 0.0])
    first = first / np.linalg.norm(first)
    frame = np.stack([first, np.cross(axis, first), axis])
    half = pinhole.half_diagonal
    polar = np.arange(max(inside_field - half, 0.003), inside_field + half, _ACROSS / pinhole.focal_length)
    fastest = float(np.max(np.sin(polar))) * pinhole.focal_length
    step = min(_ALONG / fastest, angle / 6.0)
    widest = (
        np.pi if inside_field <= half else float(np.arcsin(min(np.sin(half) / np.sin(inside_field), 1.0)))
    )
    widest = min(widest + 0.5 * angle, np.pi)
    azimuth = np.arange(-widest, widest, step)
    return _Circles(frame, polar, azimuth, angle / step, angle, np.sin(polar) * pinhole.focal_length)


def _filtered(
    sums: Float32Array, pinhole: Pinhole, circles: _Circles, unit: float
) -> tuple[Float32Array, IntArray]:
    """Return the running sums (r, c) of samples of `sums` within half a streak, and how many samples exist.

    `sums` is zero along the border, where all that is outside is sampled; it is rounded to `unit` counts.
    """
    width = max(round(circles.length), 1)
    before, after = width // 2, width - width // 2
    full = abs(float(circles.azimuth[-1] - circles.azimuth[0])) > 2.0 * np.pi - 0.05
    shape = len(circles.polar), len(circles.azimuth)
    # Directions over the sine of the polar angle: one part for the azimuth, one for the circle.
    turning = circles.frame[:2].T @ np.stack([np.cos(circles.azimuth), np.sin(circles.azimuth)])
    rising = circles.frame[2][:, None] / np.tan(circles.polar)
    around, aloft = turning.astype(np.float32), rising.astype(np.float32)
    last = np.float32(pinhole.columns - 1), np.float32(pinhole.rows - 1)
    response, count = np.empty(shape, dtype=np.float32), np.empty(shape, dtype=np.int64)
    flat = sums.reshape(-1)
    # Samples, and whether they exist, with room for half a streak to either side.
    padded = np.zeros((2, _CHUNK, shape[1] + width + 1), dtype=np.int64)
    middle = slice(before + 1, before + 1 + shape[1])
    total = np.empty_like(padded)
    for start in range(0, shape[0], _CHUNK):
        part = slice(start, start + _CHUNK)
        rows = len(response[part])
        depth = around[2] + aloft[2, part, None]
        np.maximum(depth, np.float32(1e-3), out=depth)
        np.divide(np.float32(pinhole.focal_length), depth, out=depth)
        places = []
        for axis, limit in ((0, last[0]), (1, last[1])):
            place = around[axis] + aloft[axis, part, None]
            place *= depth
            place += np.float32(pinhole.centre[axis])
            np.rint(place, out=place)
            places.append(np.clip(place, np.float32(0.0), limit, out=place))
        column, row = places
        inside = (column > 0.0) & (column < last[0]) & (row > 0.0) & (row < last[1])
        index = row.astype(np.int64)
        index *= pinhole.columns
        index += column.astype(np.int64)
        samples = flat.take(index)
        samples *= np.float32(1.0 / unit)
        # Whole numbers add up several times faster than others, and exactly.
        padded[0, :rows, middle] = np.rint(samples, out=samples)
        padded[1, :rows, middle] = inside
        if full:
            padded[:, :, : before + 1] = padded[:, :, shape[1] : shape[1] + before + 1]
            padded[:, :, middle.stop :] = padded[:, :, before + 1 : before + 1 + after]
        np.cumsum(padded, axis=2, out=total)
        held = total[:, :rows, width : width + shape[1]] - total[:, :rows, : shape[1]]
        np.multiply(held[0], unit, out=response[part], casting="same_kind")
        count[part] = held[1]
    return response, count


def _off_centre(circles: _Circles) -> float:
    """Return by how much an even number of samples is not about its middle one."""
    return 0.0 if round(circles.length) % 2 else 0.5


def _cleaned(
    response: Float32Array, count: Image, noise: FloatArray, circles: _Circles, sigmas: float, most: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return rows, columns (between samples) and heights of the stars whose responses add up to `response`.

    Passes find the peaks that rise above what is left, solve the heights of all found together (their
    responses overlap), and take them out. `noise` is by `count` of samples. What does not exceed it at first
    never will: all passes look at few places.
    """
    flat = response.reshape(-1)
    place = np.flatnonzero(flat > sigmas * noise.min())
    deviation = noise[count.reshape(-1)[place]]
    high = flat[place] > sigmas * deviation
    place, deviation = place[high], deviation[high]
    left = flat[place].astype(np.float64)
    significance = np.zeros(response.shape, dtype=np.float32)
    row, column, height = (np.empty(0) for _ in range(3))
    for last in (False,) * (_PASSES - 1) + (True,):
        significance.reshape(-1)[place] = left / deviation
        new_row, new_column = _peaks(significance, place[left > sigmas * deviation], circles, sigmas)
        room = most - len(row)
        if not len(new_row) or room <= 0:
            break
        row, column = np.append(row, new_row[:room]), np.append(column, new_column[:room])
        height = _heights(response, row, column, circles)
        kept = height > sigmas * noise[count[np.rint(row).astype(int), _wrapped(column, response)]]
        row, column, height = row[kept], column[kept], height[kept]
        if last:
            break
        left = flat[place] - _given(place, response.shape[1], circles, row, column, height)
    return row, column, height


def _wrapped(column: FloatArray, response: Float32Array) -> IntArray:
    return np.asarray(np.rint(column).astype(int) % response.shape[1])


def _given(
    place: IntArray, columns: int, circles: _Circles, row: FloatArray, column: FloatArray, height: FloatArray
) -> FloatArray:
    """Return what stars (k,) of `height` put at the flat places (p,), ascending."""
    first = np.searchsorted(place, (row.astype(int) - _FARTHEST + 1) * columns)
    count = np.searchsorted(place, (row.astype(int) + _FARTHEST + 1) * columns) - first
    star = np.repeat(np.arange(len(row)), count)
    which = np.arange(len(star)) + np.repeat(first - np.cumsum(count) + count, count)
    at_row, at_column = np.divmod(place[which], columns)
    triangle = 1.0 - np.abs(at_column - column[star]) / circles.length
    near = np.flatnonzero(triangle > 0.0)
    star, which = star[near], which[near]
    across = _profile((at_row[near] - row[star]) * _ACROSS)
    return np.asarray(np.bincount(which, height[star] * triangle[near] * across, len(place)), dtype=float)


def _heights(response: Float32Array, row: FloatArray, column: FloatArray, circles: _Circles) -> FloatArray:
    """Return the heights (k,) whose overlapping responses best give `response` at the stars' places."""
    beside = np.abs(column[:, None] - column)
    overlap = np.maximum(1.0 - beside / circles.length, 0.0)
    touching = np.nonzero((overlap > 0.0) & (np.abs(row[:, None] - row) < _FARTHEST))
    across = np.zeros_like(overlap)
    across[touching] = _profile((row[touching[0]] - row[touching[1]]) * _ACROSS)
    overlap *= across
    # A ridge, for stars that almost coincide; the scale it takes from all others is given back.
    overlap[np.diag_indices(len(row))] += _RIDGE
    seen = response[np.rint(row).astype(int), _wrapped(column, response)]
    return np.asarray(np.linalg.solve(overlap, (1.0 + _RIDGE) * seen))


def _profile(distance: FloatArray) -> FloatArray:
    """Return the response of circles `distance` px beside a star's own, 1 at the star."""
    index = np.minimum(np.abs(distance) * _PER_PX + 0.5, len(_PROFILE) - 1.0).astype(np.int64)
    return np.asarray(_PROFILE[index])


def _peaks(
    significance: Float32Array, place: IntArray, circles: _Circles, sigmas: float
) -> tuple[FloatArray, FloatArray]:
    """Return rows and columns, between samples, of the peaks, strongest first, that stand on their own.

    Only the flat places (p,) are looked at; all others are lower.
    """
    flat, columns = significance.reshape(-1), significance.shape[1]
    value = flat[place]
    # Past the last column comes the next circle's first: on full circles nearly the neighbour it should be.
    for down, beside in _NEIGHBOURS:
        summit = flat.take(place + (down * columns + beside), mode="wrap") <= value
        place, value = place[summit], value[summit]
    row, column = np.divmod(place, columns)
    order = np.argsort(-value, kind="stable")[:_MOST_PEAKS]
    row, column, value = row[order], column[order], value[order]
    kept = _standing(row, column, value.astype(np.float64), circles, sigmas)
    row, column = row[kept], column[kept]
    return _refined(significance, row, column, 0), _refined(significance, row, column, 1)


def _standing(
    row: IntArray, column: IntArray, value: FloatArray, circles: _Circles, sigmas: float
) -> BoolArray:
    """Tell which peaks (n,), strongest first, rise above the shoulders of those kept before them."""
    by_row = np.argsort(row, kind="stable")
    first = np.searchsorted(row[by_row], row - _FARTHEST + 1)
    count = np.searchsorted(row[by_row], row + _FARTHEST) - first
    stronger = np.repeat(np.arange(len(row)), count)
    weaker = by_row[np.arange(len(stronger)) + np.repeat(first - np.cumsum(count) + count, count)]
    share = 1.0 - np.abs(column[stronger] - column[weaker]) / circles.length
    shading = np.flatnonzero((stronger < weaker) & (share > 0.0))
    stronger, weaker = stronger[shading], weaker[shading]
    share = share[shading] * _profile((row[stronger] - row[weaker]) * _ACROSS)
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


def _pixels(pinhole: Pinhole, circles: _Circles, row: FloatArray, column: FloatArray) -> FloatArray:
    polar = circles.polar[0] + row * (circles.polar[1] - circles.polar[0])
    azimuth = circles.azimuth[0] + column * (circles.azimuth[1] - circles.azimuth[0])
    local = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)])
    return pinhole.project((circles.frame.T @ local).T)
