"""Running sums of the pixels on circles about the rotation axis of the camera.

On circles about the rotation axis, all streaks are straight and equally long. The sums of 3 x 3 pixels of the
frame are sampled on a polar grid. The running sum over the length of a streak is the matched filter of a
streak.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from knightcube.astro.arrays import BoolArray, Float32Array, FloatArray, IntArray
from knightcube.compiled import compiled_form_of, loop_helper
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks.geometry import CameraMotion

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
        frame: matrix (3, 3) whose rows are two unit vectors normal to the rotation axis, and the rotation
            axis.
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
    """Return a polar grid with one in `every` of the circles that cross the detector."""
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
    widest = (
        np.pi if inside_field <= half else float(np.arcsin(min(np.sin(half) / np.sin(inside_field), 1.0)))
    )
    widest = min(widest + 0.5 * angle, np.pi)
    azimuth = np.arange(-widest, widest, step)
    return PolarGrid(frame, polar, azimuth, angle / step, angle, np.sin(polar) * pinhole.focal_length)


def sampled(
    sums: Float32Array, pinhole: Pinhole, grid: PolarGrid, room: int, unit: float
) -> Iterator[tuple[slice, slice, Float32Array, BoolArray]]:
    """Yield the polar grid by groups of circles: rows, columns, samples, and a mask of usable samples.

    The samples are values of the 3 x 3 pixel sums `sums`, which must be zero along the border of the frame.
    The samples are rounded to integer multiples of `unit`, so that sums of them are fast and exact. The mask
    excludes samples that are not on the detector. If the circles are complete, a margin of `room` samples is
    included on both sides of the detector.
    """
    turning, rising = _direction_terms(grid)
    view, shape = (pinhole.focal_length, *pinhole.centre), (pinhole.columns, pinhole.rows)
    for part, crossing in _groups(pinhole, grid, room):
        around, aloft = turning[:, crossing], rising[:, part]
        yield part, crossing, *_samples(sums.reshape(-1), around, aloft, view, shape, 1.0 / unit)


def _direction_terms(grid: PolarGrid) -> tuple[Float32Array, Float32Array]:
    """Return terms (3, c) of azimuths and (3, r) of circles, whose sum is the direction of a sample.

    The direction is not a unit vector, but is divided by the sine of its polar angle.
    """
    turning = grid.frame[:2].T @ np.stack([np.cos(grid.azimuth), np.sin(grid.azimuth)])
    rising = grid.frame[2][:, None] / np.tan(grid.polar)
    return turning.astype(np.float32), rising.astype(np.float32)


def _samples(
    flat: Float32Array,
    turning: Float32Array,
    rising: Float32Array,
    view: tuple[float, float, float],
    shape: tuple[int, int],
    per_count: float,
) -> tuple[Float32Array, BoolArray]:
    """Return rounded samples and a mask of those on the detector, (r, c), see `sampled`."""
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
    """Yield groups of circles with the range of azimuths in which they cross the detector."""
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
# Largest cumulative sum of samples that can be represented, in units of the rounding step.
_HIGHEST = 2.0**30
# Number that rounds a sample (float32) to an integer if it is added and then subtracted in double precision.
_ROUND = np.float64(1.5 * 2.0**52)


@dataclass(frozen=True, slots=True, eq=False)
class RunningSums:
    """Running sums of the samples along the circles, over the length of a streak.

    Attributes:
        light: (r, c) counts.
        count: number of samples on the detector in each running sum (r, c).
        span: indices of the first and last column of each circle that lie on the detector (r, 2). If the
            samples of a circle on the detector are not contiguous, the range `span` is from -inf to inf.
        excess: noise of the running sums on each circle, relative to the noise for independent samples (r,).
    """

    light: Float32Array
    count: Int32Array
    span: FloatArray
    excess: FloatArray


def running_sums(sums: Float32Array, pinhole: Pinhole, grid: PolarGrid, unit: float) -> RunningSums:
    """Return the running sums over one streak length, centred on each sample of the polar grid.

    The pixel sums `sums` must be zero along the border of the frame, because samples outside the frame are
    read from the border. The samples are rounded to multiples of `unit` counts.
    """
    width = max(round(grid.length), 1)
    rows, columns = len(grid.polar), len(grid.azimuth)
    # Elements outside the detector are never written, so that the system allocates no memory for them.
    response, count = np.zeros((rows, columns), dtype=np.float32), np.zeros((rows, columns), dtype=np.int32)
    span = np.tile([-np.inf, np.inf], (rows, 1))
    unit = max(unit, float(sums.max()) * width / _HIGHEST)
    parts = np.array([(*_ends(part), *_ends(of)) for part, of in _groups(pinhole, grid, width)])
    view = (float(pinhole.focal_length), *pinhole.centre), (pinhole.columns, pinhole.rows)
    turning, rising = _direction_terms(grid)
    limits = width, grid.full, float(np.float32(1.0 / unit)), float(np.float32(unit))
    _sum_along(response, count, span, sums.reshape(-1), turning, rising, parts.reshape(-1, 4), *view, limits)
    span[np.isfinite(span)] += grid.off_centre
    # On circles near the rotation axis, neighbouring samples have common pixels, so that their noise is
    # correlated.
    spacing = grid.speed * (grid.azimuth[1] - grid.azimuth[0])
    slow = np.flatnonzero(spacing < _BOX)
    steps = np.arange(1, width)
    common = np.maximum(1.0 - spacing[slow, None] * steps / _BOX, 0.0)
    excess = np.ones(len(spacing))
    excess[slow] = np.sqrt(1.0 + 2.0 * common @ (1.0 - steps / width))
    return RunningSums(response, count, span, excess)


def _ends(part: slice) -> tuple[int, int]:
    return part.start, part.stop


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
    view: tuple[float, float, float],
    shape: tuple[int, int],
    limits: _Limits,
) -> None:
    """Compute the running sums `response` and their numbers of samples `count` (r, c), and `span` (r, 2).

    The direction of a sample is the sum of two vectors: one from `turning` (3, c), which depends on the
    azimuth of the sample, and one from `rising` (3, r), which depends on its circle. Each row of the array
    `parts` (g, 4) describes a group of samples by the indices of the first circle, the circle after the last,
    the first azimuth and the azimuth after the last. The tuple `view` contains the focal length and the image
    centre (x, y) of the camera, px, and `shape` contains the numbers of columns and rows.
    """
    width, full, per_count, unit = limits
    before, after, columns = width // 2, width - width // 2, response.shape[1]
    for begin, end, left, right in parts:
        part, crossing = slice(begin, end), slice(left, right)
        samples, inside = _samples(flat, turning[:, crossing], rising[:, part], view, shape, per_count)
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
        # The centre of a running sum of an even number n of samples lies half a sample before the sample with
        # the index n/2.
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
    view: tuple[float, float, float],
    shape: tuple[int, int],
    limits: _Limits,
) -> None:
    """See `_sum_along_numpy`."""
    width, full, per_count, unit = limits
    before, after, columns = width // 2, width - width // 2, response.shape[1]
    total = np.zeros((2, columns + 2 * width + 2), np.int32)
    sample, index = np.empty((2, columns), np.int32), np.empty(columns, np.int32)
    for g in range(len(parts)):
        left, wide = parts[g, 2], parts[g, 3] - parts[g, 2]
        low, high = max(left - after + 1, 0), min(parts[g, 3] + before, columns)
        first = low - left + width - before
        for row in range(parts[g, 0], parts[g, 1]):
            _pixel_indices(index[:wide], turning, left, rising[:, row], view, shape)
            start, stop, seen = wide, -1, 0
            for k in range(wide):
                rounded = np.float32(flat[abs(index[k])] * np.float32(per_count)) + _ROUND - _ROUND
                sample[0, k], sample[1, k] = np.int32(rounded), np.int32(index[k] > 0)
                if index[k] > 0:
                    start, stop, seen = min(start, k), k, seen + 1
            for which in range(2):
                _sum_up(total[which], sample[which], wide, width, full and wide == columns)
            for k in range(high - low):
                response[row, low + k] = (total[0, first + k + width] - total[0, first + k]) * unit
                count[row, low + k] = total[1, first + k + width] - total[1, first + k]
            if seen == 0:
                start, stop = 0, wide - 1
            if seen == stop - start + 1:
                span[row, 0], span[row, 1] = left + start - 0.5, left + stop + 0.5


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
def _pixel_indices(
    index: Int32Array,
    turning: Float32Array,
    left: int,
    rising: Float32Array,
    view: tuple[float, float, float],
    shape: tuple[int, int],
) -> None:
    """Compute the flat pixel index of each sample of a circle, which is negative outside the detector.

    The first sample has the azimuth with the index `left`.
    """
    columns, rows = np.int32(shape[0]), np.int32(shape[1])
    zero, one, half = np.float32(0.0), np.int32(1), np.float32(0.5)
    right, bottom = np.float32(columns - one), np.float32(rows - one)
    x, y = np.float32(view[1] + half), np.float32(view[2] + half)
    focal, nearest = np.float32(view[0]), np.float32(1e-3)
    across, down, deep = rising[0], rising[1], rising[2]
    for k in range(len(index)):
        scale = focal / max(turning[2, left + k] + deep, nearest)
        column = np.int32(min(max((turning[0, left + k] + across) * scale + x, zero), right))
        row = np.int32(min(max((turning[1, left + k] + down) * scale + y, zero), bottom))
        inside = (column > 0) & (column < columns - one) & (row > 0) & (row < rows - one)
        index[k] = row * columns + column if inside else -(row * columns + column)


def cumulative_sums(sums: Float32Array, pinhole: Pinhole, grid: PolarGrid) -> Float32Array:
    """Return the cumulative sums (r, c + 1) of all samples on a circle before each sample."""
    out = np.zeros((len(grid.polar), len(grid.azimuth) + 1), dtype=np.float32)
    for part, crossing, samples, _ in sampled(sums, pinhole, grid, 0, 1.0):
        out[part, crossing.start + 1 : crossing.stop + 1] = np.cumsum(samples, axis=1, dtype=np.float64)
        out[part, crossing.stop + 1 :] = out[part, crossing.stop, None]
    return out
