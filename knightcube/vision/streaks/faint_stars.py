"""Detection of faint star streaks for a known motion on a polar grid about the rotation axis.

The sums of 3 x 3 pixels of the frame are sampled on circles about the rotation axis, where all streaks are
straight and equally long. The matched filter of a streak is a running sum over the length of the streak.
Along a circle, the filter response to a star is a triangle, truncated at the border of the detector. Across
the circles, the filter response is proportional to the brightness profile of the star. Each peak of the
filter response is a star. The heights of overlapping peaks are the solution of a linear system. For bright
stars, the second difference of the response along the circle separates overlapping triangles.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from knightcube.astro.arrays import BoolArray, Float32Array, FloatArray, Image, IntArray
from knightcube.compiled import compiled_form_of, loop_helper
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks.frame import ReducedFrame
from knightcube.vision.streaks.geometry import CameraMotion, paths

Int32Array = npt.NDArray[np.int32]

ACROSS = 1.8
"""Spacing (px) of neighbouring circles of the polar grid."""

# Spacing (px) of the samples along a circle of the polar grid.
_ALONG = 4.0
# Number of circles processed in one step, small enough for their samples to fit into the processor's cache.
_CHUNK = 64
# Smallest angle (rad) between a circle of the polar grid and the rotation axis.
_NEAREST = 0.003
# Spacing (px) of the points that trace the border of the detector.
_BORDER_STEP = 8.0


@dataclass(frozen=True, slots=True, eq=False)
class PolarGrid:
    """A polar grid of c samples on each of r circles about the rotation axis.

    Attributes:
        frame: matrix (3, 3) whose rows are two unit vectors normal to the rotation axis, and the axis.
        polar: angle between each circle and the rotation axis (r,), rad.
        azimuth: azimuth about the rotation axis of each sample on a circle (c,), rad.
        length: length of a streak, as a number of samples along a circle.
        angle: rotation angle over the exposure, rad.
        speed: image displacement per radian of azimuth on each circle (r,), px/rad.
    """

    frame: FloatArray
    polar: FloatArray
    azimuth: FloatArray
    length: float
    angle: float
    speed: FloatArray

    @property
    def full(self) -> bool:
        """Whether the circles of the polar grid are complete, with azimuths from 0 to 2 pi."""
        return abs(float(self.azimuth[-1] - self.azimuth[0])) > 2.0 * np.pi - 0.05

    @property
    def off_centre(self) -> float:
        """Offset (samples) of the centre of a running sum from a sample: 0, or 0.5 for an even sum length."""
        return 0.0 if round(self.length) % 2 else 0.5

    def pixels(self, pinhole: Pinhole, row: FloatArray, column: FloatArray) -> FloatArray:
        """Return the pixel coordinates (k, 2) at fractional rows and columns (k,) of the polar grid."""
        polar = self.polar[0] + row * (self.polar[1] - self.polar[0])
        azimuth = self.azimuth[0] + column * (self.azimuth[1] - self.azimuth[0])
        local = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)])
        return pinhole.project((self.frame.T @ local).T)


def polar_grid(pinhole: Pinhole, motion: CameraMotion, every: int = 1) -> PolarGrid:
    """Return a polar grid with every n-th circle that crosses the detector; n is the argument `every`."""
    angle = float(np.linalg.norm(motion.rotation))
    axis = motion.rotation / angle
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
    spacing = every * ACROSS / pinhole.focal_length
    polar = np.arange(max(inside_field - half, _NEAREST), inside_field + half, spacing)
    fastest = float(np.max(np.sin(polar))) * pinhole.focal_length
    step = min(_ALONG / fastest, angle / 6.0)
    widest = float(np.pi)
    if inside_field > half:
        widest = float(np.arcsin(min(np.sin(half) / np.sin(inside_field), 1.0)))
    widest = min(widest + 0.5 * angle, np.pi)
    azimuth = np.arange(-widest, widest, step)
    return PolarGrid(frame, polar, azimuth, angle / step, angle, np.sin(polar) * pinhole.focal_length)


def _direction_terms(grid: PolarGrid) -> tuple[Float32Array, Float32Array]:
    """Return terms (3, c) of azimuths and (3, r) of circles, whose sum is the direction of a sample.

    The direction is a unit vector divided by the sine of its angle from the rotation axis.
    """
    turning = grid.frame[:2].T @ np.stack([np.cos(grid.azimuth), np.sin(grid.azimuth)])
    rising = grid.frame[2][:, None] / np.tan(grid.polar)
    return turning.astype(np.float32), rising.astype(np.float32)


_Camera = tuple[tuple[float, float, float], tuple[int, int]]
"""Focal length and image centre (x, y) of a camera, px, and its numbers of columns and rows."""


def _camera_of(pinhole: Pinhole) -> _Camera:
    return (float(pinhole.focal_length), *pinhole.centre), (pinhole.columns, pinhole.rows)


def _samples(
    flat: Float32Array, turning: Float32Array, rising: Float32Array, camera: _Camera, per_count: float
) -> tuple[Float32Array, BoolArray]:
    """Return samples (r, c) of the 3 x 3 sums `flat`, and a mask (r, c) of the samples on the detector.

    The samples are rounded to integer multiples of 1/`per_count`, so that their sums are fast and exact. The
    3 x 3 sums must be zero along the border of the frame. The other arguments are described in `_sum_along`.
    """
    view, shape = camera
    last = np.int32(shape[0] - 1), np.int32(shape[1] - 1)
    depth = turning[2] + rising[2, :, None]
    np.maximum(depth, np.float32(1e-3), out=depth)
    np.divide(np.float32(view[0]), depth, out=depth)
    places = []
    for axis, limit in ((0, last[0]), (1, last[1])):
        place = turning[axis] + rising[axis, :, None]
        place *= depth
        # After the addition of 0.5, truncation to an integer rounds to the nearest integer.
        place += np.float32(view[1 + axis] + 0.5)
        np.maximum(place, np.float32(0.0), out=place)
        np.minimum(place, np.float32(limit), out=place)
        places.append(place.astype(np.int32))
    column, row = places
    inside = (column > 0) & (column < last[0]) & (row > 0) & (row < last[1])
    index = row * np.int32(shape[0])
    index += column
    samples = flat.take(index)
    samples *= np.float32(per_count)
    return np.rint(samples, out=samples), inside


def _groups(pinhole: Pinhole, grid: PolarGrid, room: int) -> Iterator[tuple[slice, slice]]:
    """Yield groups of circles with the range of azimuths in which they cross the detector.

    If the circles are complete, a margin of `room` samples is included on both sides of the detector.
    """
    x, y = pinhole.columns - 1.0, pinhole.rows - 1.0
    sides = np.arange(0.0, x, _BORDER_STEP), np.arange(0.0, y, _BORDER_STEP)
    along = np.concatenate([sides[0], np.full_like(sides[1], x), x - sides[0], np.zeros_like(sides[1])])
    down = np.concatenate([np.zeros_like(sides[0]), sides[1], np.full_like(sides[0], y), y - sides[1]])
    local = pinhole.unit_vectors(np.stack([along, down], axis=-1)) @ grid.frame.T
    polar, azimuth = np.arccos(np.clip(local[:, 2], -1.0, 1.0)), np.arctan2(local[:, 1], local[:, 0])
    column = (azimuth - grid.azimuth[0]) / (grid.azimuth[1] - grid.azimuth[0])
    count, margin = len(grid.azimuth), _BORDER_STEP / pinhole.focal_length
    for start in range(0, len(grid.polar), _CHUNK):
        part = slice(start, min(start + _CHUNK, len(grid.polar)))
        near = (polar > grid.polar[start] - margin) & (polar < grid.polar[part.stop - 1] + margin)
        # The azimuth pi is the direction from the rotation axis away from the image centre.
        behind = grid.pixels(pinhole, np.array([start]), np.zeros(1))
        if grid.full and pinhole.contains(behind, margin=2.0)[0]:
            yield part, slice(0, count)
        elif near.any():
            beside = margin / max(np.sin(grid.polar[start]), margin) / (grid.azimuth[1] - grid.azimuth[0])
            low, high = column[near].min() - beside, column[near].max() + beside + 1.0
            if grid.full and (low < room or high > count - room):
                low, high = 0.0, count
            yield part, slice(max(int(low), 0), min(int(np.ceil(high)), count))


# Side (px) of the square of pixels whose sum is one sample of the polar grid.
_BOX = 3.0
# Largest permitted cumulative sum of samples, in units of the rounding step.
_HIGHEST = 2.0**30
# Number that rounds a sample (float32) to an integer if it is added and then subtracted in double precision.
_ROUND = np.float64(1.5 * 2.0**52)


@dataclass(frozen=True, slots=True, eq=False)
class RunningSums:
    """Running sums (r, c) of the samples along the circles, over the length of a streak, in counts.

    Attributes:
        light: the running sums (r, c).
        count: number of samples on the detector in each running sum (r, c).
        span: first and last column of each circle on the detector (r, 2), or -inf and inf if the samples on
            the detector are not contiguous.
        excess: ratio (r,) of the noise of the running sums on each circle to the noise for independent
            samples.
    """

    light: Float32Array
    count: Int32Array
    span: FloatArray
    excess: FloatArray


def running_sums(sums: Float32Array, pinhole: Pinhole, grid: PolarGrid, unit: float) -> RunningSums:
    """Return the running sums over one streak length, centred on each sample of the polar grid.

    The pixel sums `sums` must be zero along the border of the frame. The samples are rounded to multiples of
    `unit` counts.
    """
    width = max(round(grid.length), 1)
    rows, columns = len(grid.polar), len(grid.azimuth)
    # The operating system allocates no memory for elements outside the detector, which are never written.
    response, count = np.zeros((rows, columns), dtype=np.float32), np.zeros((rows, columns), dtype=np.int32)
    span = np.tile([-np.inf, np.inf], (rows, 1))
    unit = max(unit, float(sums.max()) * width / _HIGHEST)
    groups = _groups(pinhole, grid, width)
    parts = np.array([(part.start, part.stop, of.start, of.stop) for part, of in groups])
    turning, rising = _direction_terms(grid)
    limits = width, grid.full, float(np.float32(1.0 / unit)), float(np.float32(unit))
    flat, parts, camera = sums.reshape(-1), parts.reshape(-1, 4), _camera_of(pinhole)
    _sum_along(response, count, span, flat, turning, rising, parts, camera, limits)
    span[np.isfinite(span)] += grid.off_centre
    # Near the rotation axis, neighbouring samples have common pixels, so that their noise is correlated.
    spacing = grid.speed * (grid.azimuth[1] - grid.azimuth[0])
    slow = np.flatnonzero(spacing < _BOX)
    steps = np.arange(1, width)
    common = np.maximum(1.0 - spacing[slow, None] * steps / _BOX, 0.0)
    excess = np.ones(len(spacing))
    excess[slow] = np.sqrt(1.0 + 2.0 * common @ (1.0 - steps / width))
    return RunningSums(response, count, span, excess)


_Limits = tuple[int, bool, float, float]
"""Streak length (samples), whether circles are complete, rounding steps per count, and counts per step."""


def _sum_along_numpy(
    response: Float32Array,
    count: Int32Array,
    span: FloatArray,
    flat: Float32Array,
    turning: Float32Array,
    rising: Float32Array,
    parts: IntArray,
    camera: _Camera,
    limits: _Limits,
) -> None:
    """Compute the running sums `response` and their numbers of samples `count` (r, c), and `span` (r, 2).

    The direction of a sample is the sum of a vector from `turning` (3, c) for its azimuth and a vector from
    `rising` (3, r) for its circle. Each row of `parts` (g, 4) contains the indices of the first circle of a
    group, the circle after the last, the first azimuth and the azimuth after the last.
    """
    width, full, per_count, unit = limits
    before, after, columns = width // 2, width - width // 2, response.shape[1]
    for begin, end, left, right in parts:
        part, crossing = slice(begin, end), slice(left, right)
        samples, inside = _samples(flat, turning[:, crossing], rising[:, part], camera, per_count)
        wide = samples.shape[1]
        # The samples and their mask are padded by one streak length on both sides.
        padded = np.zeros((2, len(samples), wide + 2 * width + 1), dtype=np.int32)
        middle = slice(width + 1, width + 1 + wide)
        padded[0, :, middle] = samples
        padded[1, :, middle] = inside
        if full and wide == columns:
            padded[:, :, : width + 1] = padded[:, :, wide : wide + width + 1]
            padded[:, :, middle.stop :] = padded[:, :, middle.start : middle.start + width]
        total = np.cumsum(padded, axis=2, dtype=np.int32)
        low, high = max(left - after + 1, 0), min(right + before, columns)
        first = low - left + width - before
        last = first + high - low
        held = total[:, :, first + width : last + width] - total[:, :, first:last]
        np.multiply(held[0], np.float32(unit), out=response[part, low:high], casting="same_kind")
        count[part, low:high] = held[1]
        start, stop = inside.argmax(axis=1), wide - 1 - inside[:, ::-1].argmax(axis=1)
        whole = inside.sum(axis=1) == stop - start + 1
        # The centre of a running sum of an even number n of samples lies half a sample before the sample n/2.
        edges = np.stack([start - 0.5, stop + 0.5], axis=1) + left
        span[part] = np.where(whole[:, None], edges, span[part])


@compiled_form_of(_sum_along_numpy)
def _sum_along(
    response: Float32Array,
    count: Int32Array,
    span: FloatArray,
    flat: Float32Array,
    turning: Float32Array,
    rising: Float32Array,
    parts: IntArray,
    camera: _Camera,
    limits: _Limits,
) -> None:
    width, full, per_count, unit = limits
    before, after, columns = width // 2, width - width // 2, response.shape[1]
    total = np.zeros((2, columns + 2 * width + 2), np.int32)
    sample, index = np.empty((2, columns), np.int32), np.empty(columns, np.int32)
    for g in range(len(parts)):
        left, wide = parts[g, 2], parts[g, 3] - parts[g, 2]
        low, high = max(left - after + 1, 0), min(parts[g, 3] + before, columns)
        first, around = low - left + width - before, turning[:, left : left + wide].copy()
        for row in range(parts[g, 0], parts[g, 1]):
            _pixel_indices(index[:wide], around, rising[:, row], camera)
            for k in range(wide):
                rounded = np.float32(flat[abs(index[k])] * np.float32(per_count)) + _ROUND - _ROUND
                sample[0, k], sample[1, k] = np.int32(rounded), np.int32(index[k] > 0)
            for which in range(2):
                _sum_up(total[which], sample[which], wide, width, full and wide == columns)
            _subtract(response[row, low:high], total[0, first:], width, np.float32(unit))
            _subtract(count[row, low:high], total[1, first:], width, np.int32(1))
            start, stop, seen = 0, wide - 1, sample[1, :wide].sum()
            while seen and index[start] <= 0:
                start += 1
            while seen and index[stop] <= 0:
                stop -= 1
            if seen == stop - start + 1:
                span[row, 0], span[row, 1] = left + start - 0.5, left + stop + 0.5


@loop_helper
def _subtract(out: Any, total: Int32Array, width: int, unit: Any) -> None:
    """Set `out` (m,) to the differences between cumulative sums that are `width` samples apart, in `unit`."""
    ahead = total[width:]
    for k in range(len(out)):
        out[k] = (ahead[k] - total[k]) * unit


@loop_helper
def _sum_up(total: Int32Array, sample: Int32Array, wide: int, width: int, around: bool) -> None:
    """Compute cumulative sums of `wide` samples with a margin of `width` samples on both sides.

    The margins repeat the samples of a circle that is complete (`around`), and are zero otherwise.
    """
    held = np.int32(0)
    for k in range(width):
        if around:
            held += sample[wide - width + k]
        total[k + 1] = held
    for k in range(wide):
        held += sample[k]
        total[width + k + 1] = held
    for k in range(width):
        if around:
            held += sample[k]
        total[width + wide + k + 1] = held


@loop_helper
def _pixel_indices(index: Int32Array, turning: Float32Array, rising: Float32Array, camera: _Camera) -> None:
    """Compute the flat pixel index of each sample of a circle, which is negative outside the detector."""
    view, shape = camera
    columns, rows = np.int32(shape[0]), np.int32(shape[1])
    zero, one, half = np.float32(0.0), np.int32(1), np.float32(0.5)
    right, bottom = np.float32(columns - one), np.float32(rows - one)
    x, y = np.float32(view[1] + half), np.float32(view[2] + half)
    focal, nearest = np.float32(view[0]), np.float32(1e-3)
    across, down, deep = rising[0], rising[1], rising[2]
    for k in range(len(index)):
        scale = focal / max(turning[2, k] + deep, nearest)
        column = np.int32(min(max((turning[0, k] + across) * scale + x, zero), right))
        row = np.int32(min(max((turning[1, k] + down) * scale + y, zero), bottom))
        inside = (column > 0) & (column < columns - one) & (row > 0) & (row < rows - one)
        index[k] = row * columns + column if inside else -(row * columns + column)


def cumulative_sums(sums: Float32Array, pinhole: Pinhole, grid: PolarGrid) -> Float32Array:
    """Return the cumulative sums (r, c + 1) of all samples on a circle before each sample."""
    out = np.zeros((len(grid.polar), len(grid.azimuth) + 1), dtype=np.float32)
    turning, rising = _direction_terms(grid)
    for part, crossing in _groups(pinhole, grid, 0):
        around, aloft = turning[:, crossing], rising[:, part]
        samples, _ = _samples(sums.reshape(-1), around, aloft, _camera_of(pinhole), 1.0)
        out[part, crossing.start + 1 : crossing.stop + 1] = np.cumsum(samples, axis=1, dtype=np.float64)
        out[part, crossing.stop + 1 :] = out[part, crossing.stop, None]
    return out


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
# Table of the filter response to a star, as a fraction of its maximum, by distance of a circle from the star.
_PROFILE = ndtr((np.arange(400) / _PER_PX + 1.5) / _WIDTH) - ndtr((np.arange(400) / _PER_PX - 1.5) / _WIDTH)
_PROFILE /= _PROFILE[0]


def overlap_of(one: FloatArray, other: FloatArray, span: FloatArray, length: float) -> FloatArray:
    """Return the overlap of two streaks at the columns `one` and `other` (...), as a fraction of length.

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
    # The second difference is scaled so that it equals the response at an isolated star.
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
    filter response are searched. The argument `span` (r, 2) is the range of columns on the detector, as in
    `RunningSums`.
    """
    row, column = _local_maxima(significance, place)
    value, spans = significance[row, column].astype(np.float64), span[row]
    kept = _unshaded(row, column, value, spans, grid.length, sigmas)
    row, column = row[kept], column[kept]
    return _refined(significance, row, column, 0), _refined(significance, row, column, 1)


def _unshaded_numpy(
    row: IntArray, column: IntArray, value: FloatArray, spans: FloatArray, length: float, sigmas: float
) -> BoolArray:
    """Return a mask (k,) of the peaks, the strongest first, that are not caused by stronger peaks.

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
    out, size = np.empty(len(place), dtype=np.bool_), len(flat)
    margin = columns + 2
    for p in range(len(place)):
        own, highest = place[p], True
        for down in range(-1, 2):
            for beside in range(-2, 3):
                at = own + down * columns + beside
                if own < margin or own >= size - margin:
                    at %= size
                highest &= flat[at] <= flat[own]
        out[p] = highest
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
# Regularisation of the peak heights of nearly coincident stars, as a fraction of the diagonal elements.
_RIDGE = 0.01
# Regularisation added to the diagonal elements of the normal equations for peak heights.
_TINY = 1e-6
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
SAMPLE_NOISE = 3.1
"""Ratio of the noise of a sum of n overlapping 3 x 3 samples to sqrt(n) times the noise of a pixel."""


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
    usual = SAMPLE_NOISE * float(np.sqrt(np.median(frame.floor[::97])))
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
    pixels, light = modelled
    signal, floor = frame.signal[pixels], frame.floor[pixels]
    # Pixels with subtracted stars get a smaller weight, because their residuals are mostly photon noise.
    share = floor / (floor + np.maximum(light, np.float32(0.0)) * np.float32(1.0 / frame.gain))
    left = (signal - light) * share
    left[frame.bad[pixels]] = 0.0
    lost = frame.bad.copy()
    lost[pixels] = False
    unmodelled = np.flatnonzero(lost)
    taken = np.concatenate([signal - left, frame.signal[unmodelled]])
    return less_boxes(frame.sums, frame.shape, np.concatenate([pixels, unmodelled]), taken)


def _less_boxes_numpy(sums: Image, shape: tuple[int, int], pixels: IntArray, taken: Image) -> Image:
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

    The argument `pixels` (m,) contains the flat indices of the changed pixels, each once, and `taken` (m,)
    the counts to subtract. The returned sums are zero at the border of the frame.
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


_Peaks = tuple[FloatArray, FloatArray, FloatArray]
"""Fractional grid rows (k,), fractional grid columns (k,) and heights (k,) of the peaks of k stars."""


def _found_stars(held: RunningSums, noise: FloatArray, grid: PolarGrid, sigmas: float, most: int) -> _Peaks:
    """Return the peaks of the filter response `held`.

    Each pass of the search finds peaks in the residual response, solves for the heights of all stars, and
    subtracts these stars. The array `noise` contains the noise of a running sum, indexed by its number of
    samples. All passes are restricted to the samples with a significant initial response.
    """
    flat = held.light.reshape(-1)
    place, deviation = _high_places(held.light, held.count, noise, held.excess, float(sigmas))
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
        kept = _significance(held, noise, grid, (row, column, height)) > sigmas
        row, column, height = row[kept], column[kept], height[kept]
        responses = np.zeros(len(place))
        stars = row, column, height
        _add_responses(responses, place, held.span, held.light.shape, grid.length, stars)
        left = flat[place] - responses
    return row, column, height


def _high_places_numpy(
    light: Float32Array, count: Int32Array, noise: FloatArray, excess: FloatArray, sigmas: float
) -> tuple[IntArray, FloatArray]:
    """Return the flat indices (p,) of the running sums above `sigmas` times their noise, and this noise (p,).

    The arguments `light`, `count` and `excess` are attributes of `RunningSums`. The array `noise` contains
    the noise of a running sum, indexed by its number of samples.
    """
    flat = light.reshape(-1)
    place = np.flatnonzero(flat > sigmas * noise.min())
    deviation = noise[count.reshape(-1)[place]] * excess[place // light.shape[1]]
    high = flat[place] > sigmas * deviation
    return place[high], deviation[high]


@compiled_form_of(_high_places_numpy)
def _high_places(
    light: Float32Array, count: Int32Array, noise: FloatArray, excess: FloatArray, sigmas: float
) -> tuple[IntArray, FloatArray]:
    rows, columns = light.shape
    place, deviation, found = np.empty(light.size, np.int64), np.empty(light.size), 0
    lowest = sigmas * noise.min()
    for row in range(rows):
        for column in range(columns):
            if light[row, column] > lowest:
                own = noise[count[row, column]] * excess[row]
                place[found], deviation[found] = row * columns + column, own
                found += light[row, column] > sigmas * own
    return place[:found].copy(), deviation[:found].copy()


def _significance(held: RunningSums, noise: FloatArray, grid: PolarGrid, stars: _Peaks) -> FloatArray:
    """Return the significance (k,) of `stars`, in standard deviations."""
    row, column, height = stars
    middle = np.rint(row).astype(int)
    seen = overlap_of(column, column, held.span[middle], grid.length)
    own = noise[held.count[middle, np.rint(column).astype(int) % held.light.shape[1]]] * held.excess[middle]
    return np.asarray(height * seen / own)


def _add_responses_numpy(
    out: FloatArray, place: IntArray, span: FloatArray, shape: tuple[int, int], length: float, stars: _Peaks
) -> None:
    """Add the filter responses of `stars` at the ascending flat indices `place` (p,) to the array `out` (p,).

    The argument `span` (r, 2) is the range of columns on the detector, and `length` is in samples.
    """
    (rows, columns), (row, column, height) = shape, stars
    # On each neighbouring circle, the filter response of a star covers a contiguous range of columns.
    circle = row.astype(np.int64)[:, None] + np.arange(1 - _FARTHEST, _FARTHEST + 1)
    weight = height[:, None] * profile((circle - row[:, None]) * ACROSS)
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
        there, spans = np.repeat(column[star[some]], many), np.repeat(span[circle[some]], many, axis=0)
        common = overlap_of(at, there, spans, length)
        common *= np.repeat(weight[some], many)
        np.add.at(out, which, common)


@compiled_form_of(_add_responses_numpy)
def _add_responses(
    out: FloatArray, place: IntArray, span: FloatArray, shape: tuple[int, int], length: float, stars: _Peaks
) -> None:
    (rows, columns), (row, column, height) = shape, stars
    for star in range(len(row)):
        low = int(max(math.ceil(column[star] - length), 0))
        high = int(min(math.floor(column[star] + length), columns - 1))
        middle = int(row[star])
        for circle in range(max(middle + 1 - _FARTHEST, 0), min(middle + _FARTHEST + 1, rows)):
            aside = int(min(abs(circle - row[star]) * ACROSS * _PER_PX + 0.5, len(_PROFILE) - 1.0))
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
    # The arrays `one` and `other` index all pairs of stars that may overlap, and each star with itself.
    order = np.argsort(row, kind="stable")
    first = np.searchsorted(row[order], row - _FARTHEST, side="right")
    count = np.searchsorted(row[order], row + _FARTHEST) - first
    one = np.repeat(np.arange(len(row)), count)
    other = order[np.arange(len(one)) + np.repeat(first - np.cumsum(count) + count, count)]
    near = np.flatnonzero(np.abs(column[one] - column[other]) < grid.length)
    one, other = one[near], other[near]
    span = held.span[middle]
    first, last = np.maximum(span[one, 0], span[other, 0]), np.minimum(span[one, 1], span[other, 1])
    common = np.stack([first, last], axis=-1)
    overlap = overlap_of(column[one], column[other], common, grid.length)
    overlap = overlap * profile((row[one] - row[other]) * ACROSS)
    # Diagonal and right-hand side get the same factor, so that heights of isolated stars are unbiased.
    overlap[one == other] *= 1.0 + _RIDGE
    overlap[one == other] += _TINY
    seen = held.light[middle, np.rint(column).astype(int) % held.light.shape[1]].astype(np.float64)
    return _solved(one, other, overlap, (1.0 + _RIDGE) * seen)


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
