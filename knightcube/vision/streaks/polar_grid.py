"""Polar grid about the rotation axis, and sums of a frame's pixels along its circles.

The sums of 3 x 3 pixels of the frame are sampled on circles about the rotation axis, where all streaks are
straight and equally long. The matched filter of a streak is a running sum over the length of the streak.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from knightcube.astro.arrays import BoolArray, Float32Array, FloatArray, IntArray, cross_product
from knightcube.compiled import compiled_form_of, loop_helper
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks.camera_motion import CameraMotion

Int32Array = npt.NDArray[np.int32]

ACROSS = 1.8
"""Spacing (px) of neighbouring circles of the polar grid."""
SAMPLE_NOISE = 3.1
"""Ratio of the noise of a sum of n overlapping 3 x 3 samples to sqrt(n) times the noise of a pixel."""

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
        """Whether the circles of the polar grid are complete, so that the azimuths span 2 pi."""
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
        return pinhole.ideal.project((self.frame.T @ local).T)


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
    frame = np.stack([first, cross_product(axis, first), axis])
    half = pinhole.ideal.half_diagonal
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
    3 x 3 sums must be zero along the border of the frame. The other arguments are described in
    `_sum_along_numpy`.
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


@functools.lru_cache(maxsize=4)
def _border(pinhole: Pinhole) -> FloatArray:
    """Return unit vectors (n, 3) from the camera to points on the border of the detector."""
    x, y = pinhole.columns - 1.0, pinhole.rows - 1.0
    sides = np.arange(0.0, x, _BORDER_STEP), np.arange(0.0, y, _BORDER_STEP)
    along = np.concatenate([sides[0], np.full_like(sides[1], x), x - sides[0], np.zeros_like(sides[1])])
    down = np.concatenate([np.zeros_like(sides[0]), sides[1], np.full_like(sides[0], y), y - sides[1]])
    return pinhole.ideal.unit_vectors(np.stack([along, down], axis=-1))


def _groups(pinhole: Pinhole, grid: PolarGrid, room: int) -> IntArray:
    """Return groups of circles with the range of azimuths in which they cross the detector.

    Each row (4,) of the result contains four indices of a group: first circle, last circle + 1, first azimuth
    and last azimuth + 1. If the circles are complete, a group that crosses the detector within `room` samples
    of the azimuth pi includes all azimuths.
    """
    local = _border(pinhole) @ grid.frame.T
    polar, azimuth = np.arccos(np.clip(local[:, 2], -1.0, 1.0)), np.arctan2(local[:, 1], local[:, 0])
    count, margin = len(grid.azimuth), _BORDER_STEP / pinhole.focal_length
    step = grid.azimuth[1] - grid.azimuth[0]
    column = (azimuth - grid.azimuth[0]) / step
    start = np.arange(0, len(grid.polar), _CHUNK)
    stop = np.minimum(start + _CHUNK, len(grid.polar))
    near = (polar > grid.polar[start, None] - margin) & (polar < grid.polar[stop - 1, None] + margin)
    beside = margin / np.maximum(np.sin(grid.polar[start]), margin) / step
    low = np.where(near, column, np.inf).min(axis=1) - beside
    high = np.where(near, column, -np.inf).max(axis=1) + beside + 1.0
    crosses = near.any(axis=1)
    if grid.full:
        # The azimuth pi is the direction from the rotation axis away from the image centre.
        behind = grid.pixels(pinhole, start.astype(float), np.zeros(len(start)))
        whole = pinhole.contains(behind, margin=2.0) | (crosses & ((low < room) | (high > count - room)))
        low, high, crosses = np.where(whole, 0.0, low), np.where(whole, count, high), crosses | whole
    limits = np.clip(np.stack([np.floor(low), np.ceil(high)]), 0, count).astype(np.int64)
    return np.asarray(np.stack([start, stop, *limits], axis=1)[crosses])


# Side (px) of the square of pixels whose sum is one sample of the polar grid.
_BOX = 3.0
# Largest permitted running sum of samples, in units of the rounding step.
_HIGHEST = 2.0**30
# Number whose addition and subtraction in double precision rounds a sample (float32) to an integer.
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
    parts = _groups(pinhole, grid, width)
    turning, rising = _direction_terms(grid)
    limits = width, grid.full, float(np.float32(1.0 / unit)), float(np.float32(unit))
    flat, camera = sums.reshape(-1), _camera_of(pinhole)
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
    `rising` (3, r) for its circle. The rows of `parts` (g, 4) are those of `_groups`.
    """
    width, full, per_count, unit = limits
    before, after, columns = width // 2, width - width // 2, response.shape[1]
    for begin, end, left, right in parts:
        part, crossing = slice(begin, end), slice(left, right)
        samples, inside = _samples(flat, turning[:, crossing], rising[:, part], camera, per_count)
        np.minimum(samples, np.float32(_HIGHEST / width), out=samples)
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
    """See `_sum_along_numpy`."""
    (width, full, per_count, unit), columns = limits, response.shape[1]
    before, after = width // 2, width - width // 2
    scale, most = np.float32(per_count), np.float32(_HIGHEST / width)
    total = np.zeros((2, columns + 2 * width + 2), np.int32)
    sample, index = np.empty((2, columns), np.int32), np.empty(columns, np.int32)
    for g in range(len(parts)):
        left, wide = parts[g, 2], parts[g, 3] - parts[g, 2]
        around, closed = turning[:, left : left + wide].copy(), full and wide == columns
        for row in range(parts[g, 0], parts[g, 1]):
            _pixel_indices(index[:wide], around, rising[:, row], camera)
            start, stop, seen = _range_on_detector(index[:wide])
            whole = 0 < seen == stop - start
            if whole:
                span[row, 0], span[row, 1] = left + start - 0.5, left + stop - 0.5
            if closed or not whole:
                start, stop = 0, wide
            many, first = stop - start, left + start
            low, high = max(first - after + 1, 0), min(first + many + before, columns)
            begin = low - before - first
            for k in range(many):
                at = index[start + k]
                rounded = min(flat[abs(at)] * scale, most) + _ROUND - _ROUND
                sample[0, k], sample[1, k] = np.int32(rounded), np.int32(at > 0)
            _sum_up(total[0], sample[0, :many], width, closed)
            _subtract(response[row, low:high], total[0, begin + width :], width, np.float32(unit))
            if closed or not whole:
                _sum_up(total[1], sample[1, :many], width, closed)
                _subtract(count[row, low:high], total[1, begin + width :], width, np.int32(1))
            else:
                _count_samples(count[row, low:high], begin, width, many)


@loop_helper
def _range_on_detector(index: Int32Array) -> tuple[int, int, int]:
    """Return first index and last index + 1 of the samples on the detector, and their number."""
    seen = np.int32(0)
    for k in range(len(index)):
        seen += np.int32(index[k] > 0)
    start, stop = 0, len(index)
    while seen and index[start] <= 0:
        start += 1
    while seen and index[stop - 1] <= 0:
        stop -= 1
    return start, stop, int(seen)


@loop_helper
def _count_samples(out: Int32Array, begin: int, width: int, many: int) -> None:
    """Set `out` (m,) to the number of samples in each of m windows of `width` samples.

    The window k starts at the index `begin` + k, and the samples have the indices 0 to `many` - 1.
    """
    first, size, end = np.int32(begin), np.int32(width), np.int32(many)
    for k in range(len(out)):
        place = first + np.int32(k)
        out[k] = min(place + size, end) - max(place, np.int32(0))


@loop_helper
def _subtract(out: Any, total: Int32Array, width: int, unit: Any) -> None:
    """Set `out` (m,) to `unit` times the differences of cumulative sums that are `width` samples apart."""
    ahead = total[width:]
    for k in range(len(out)):
        out[k] = (ahead[k] - total[k]) * unit


@loop_helper
def _sum_up(total: Int32Array, sample: Int32Array, width: int, closed: bool) -> None:
    """Compute cumulative sums of samples (k,) with a margin of `width` samples on both sides.

    The margins repeat the samples of a circle that is complete (`closed`), and are zero otherwise.
    """
    held, many = np.int32(0), len(sample)
    total[: width + 1] = 0
    for k in range(width if closed else 0):
        held += sample[many - width + k]
        total[k + 1] = held
    for k in range(many):
        held += sample[k]
        total[width + k + 1] = held
    total[width + many + 1 : 2 * width + many + 1] = held
    for k in range(width if closed else 0):
        held += sample[k]
        total[width + many + k + 1] = held


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
    """Return, for each of r circles, the sums (r, c + 1) of its first 0, 1, ..., c samples."""
    out = np.zeros((len(grid.polar), len(grid.azimuth) + 1), dtype=np.float32)
    turning, rising = _direction_terms(grid)
    for begin, end, left, right in _groups(pinhole, grid, 0):
        part, crossing = slice(begin, end), slice(left, right)
        around, aloft = turning[:, crossing], rising[:, part]
        samples, _ = _samples(sums.reshape(-1), around, aloft, _camera_of(pinhole), 1.0)
        out[part, left + 1 : right + 1] = np.cumsum(samples, axis=1, dtype=np.float64)
        out[part, right + 1 :] = out[part, right, None]
    return out
