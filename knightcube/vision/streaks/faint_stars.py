"""The frame on circles about the axis of rotation: there every streak is straight and equally long."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.frame import less_boxes
from knightcube.vision.streaks.frame import ExposedFrame, Float32Array
from knightcube.vision.streaks.geometry import Motion, paths

ACROSS = 1.8
"""Spacing of the circles, px."""

# Spacing of the samples along them, px.
_ALONG = 4.0
# Circles worked on at a time, so that they stay in the processor's cache.
_CHUNK = 64
_NEAREST = 0.003
# The detector's border is looked at in steps of this many pixels.
_BORDER_STEP = 8.0


@dataclass(frozen=True, slots=True, eq=False)
class PolarGrid:
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

    @property
    def full(self) -> bool:
        """Whether the circles close."""
        return abs(float(self.azimuth[-1] - self.azimuth[0])) > 2.0 * np.pi - 0.05

    @property
    def off_centre(self) -> float:
        """By how much an even number of samples is not about its middle one."""
        return 0.0 if round(self.length) % 2 else 0.5

    def pixels(self, pinhole: Pinhole, row: FloatArray, column: FloatArray) -> FloatArray:
        """Return the pixels (k, 2) of places (k,) between samples."""
        polar = self.polar[0] + row * (self.polar[1] - self.polar[0])
        azimuth = self.azimuth[0] + column * (self.azimuth[1] - self.azimuth[0])
        local = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)])
        return pinhole.project((self.frame.T @ local).T)


def polar_grid(pinhole: Pinhole, motion: Motion, every: int = 1) -> PolarGrid:
    """Return the circles that cross the detector, one in `every`."""
    angle = float(np.linalg.norm(motion.whole))
    axis = motion.whole / angle
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
    """Yield some circles after others: which, and where they cross the detector; their samples there.

    The samples of `sums`, zero along the border, are in whole `unit`s: whole numbers add up several times
    faster than others, and exactly. Beside them stands which exist. Where circles close, `room` samples
    beside those that cross the detector are on the grid too.
    """
    # Directions over the sine of the polar angle: one part for the azimuth, one for the circle.
    turning = grid.frame[:2].T @ np.stack([np.cos(grid.azimuth), np.sin(grid.azimuth)])
    rising = grid.frame[2][:, None] / np.tan(grid.polar)
    around, aloft = turning.astype(np.float32), rising.astype(np.float32)
    last = np.int32(pinhole.columns - 1), np.int32(pinhole.rows - 1)
    flat = sums.reshape(-1)
    for part, crossing in _crossings(pinhole, grid, room):
        depth = around[2, crossing] + aloft[2, part, None]
        np.maximum(depth, np.float32(1e-3), out=depth)
        np.divide(np.float32(pinhole.focal_length), depth, out=depth)
        places = []
        for axis, limit in ((0, last[0]), (1, last[1])):
            place = around[axis, crossing] + aloft[axis, part, None]
            place *= depth
            # Half a pixel more, and the fraction cut off: rounded.
            place += np.float32(pinhole.centre[axis] + 0.5)
            np.maximum(place, np.float32(0.0), out=place)
            np.minimum(place, np.float32(limit), out=place)
            places.append(place.astype(np.int32))
        column, row = places
        inside = (column > 0) & (column < last[0]) & (row > 0) & (row < last[1])
        index = row * np.int32(pinhole.columns)
        index += column
        samples = flat.take(index)
        samples *= np.float32(1.0 / unit)
        yield part, crossing, np.rint(samples, out=samples), inside


def _crossings(pinhole: Pinhole, grid: PolarGrid, room: int) -> Iterator[tuple[slice, slice]]:
    """Yield circles, some after others, and between which azimuths they cross the detector."""
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
        # The azimuths are about the direction to the field's middle: away from it the field ends first.
        behind = grid.pixels(pinhole, np.array([start]), np.zeros(1))
        if grid.full and pinhole.contains(behind, margin=2.0)[0]:
            yield part, slice(0, count)
        elif near.any():
            beside = margin / max(np.sin(grid.polar[start]), margin) / (grid.azimuth[1] - grid.azimuth[0])
            low, high = column[near].min() - beside, column[near].max() + beside + 1.0
            if grid.full and (low < room or high > count - room):
                low, high = 0.0, count
            yield part, slice(max(int(low), 0), min(int(np.ceil(high)), count))


Int32Array = npt.NDArray[np.int32]

# Pixels to a side of what is summed for a sample.
_BOX = 3.0
# What a sum of samples, in whole units, never exceeds.
_HIGHEST = 2.0**30


@dataclass(frozen=True, slots=True, eq=False)
class RunningSums:
    """Samples summed over a streak's length.

    Attributes:
        light: (r, c) counts; count: (r, c) how many samples exist.
        span: (r, 2) between which columns a circle's samples exist; without bounds where not in one piece.
        excess: (r,) by what factor noise exceeds that of samples which share no pixels.
    """

    light: Float32Array
    count: Int32Array
    span: FloatArray
    excess: FloatArray


def running_sums(sums: Float32Array, pinhole: Pinhole, grid: PolarGrid, unit: float) -> RunningSums:
    """Return the running sums of samples of `sums` within half a streak.

    `sums` is zero along the border, where all that is outside is sampled; it is rounded to `unit` counts.
    """
    width = max(round(grid.length), 1)
    before, after = width // 2, width - width // 2
    rows, columns = len(grid.polar), len(grid.azimuth)
    # Where no circle crosses the detector nothing is ever written: such memory is never fetched.
    response, count = np.zeros((rows, columns), dtype=np.float32), np.zeros((rows, columns), dtype=np.int32)
    span = np.tile([-np.inf, np.inf], (rows, 1))
    unit = max(unit, float(sums.max()) * width / _HIGHEST)
    for part, crossing, samples, inside in sampled(sums, pinhole, grid, width, unit):
        wide = samples.shape[1]
        # Samples, and whether they exist, with room for a streak to either side.
        padded = np.zeros((2, len(samples), wide + 2 * width + 1), dtype=np.int32)
        middle = slice(width + 1, width + 1 + wide)
        padded[0, :, middle] = samples
        padded[1, :, middle] = inside
        if grid.full and wide == columns:
            padded[:, :, : width + 1] = padded[:, :, wide : wide + width + 1]
            padded[:, :, middle.stop :] = padded[:, :, middle.start : middle.start + width]
        total = np.cumsum(padded, axis=2, dtype=np.int32)
        low, high = max(crossing.start - after + 1, 0), min(crossing.stop + before, columns)
        first = low - crossing.start + width - before
        last = first + high - low
        held = total[:, :, first + width : last + width] - total[:, :, first:last]
        np.multiply(held[0], np.float32(unit), out=response[part, low:high], casting="same_kind")
        count[part, low:high] = held[1]
        begin, end = inside.argmax(axis=1), wide - 1 - inside[:, ::-1].argmax(axis=1)
        whole = inside.sum(axis=1) == end - begin + 1
        # An even number of samples is not about its middle one, but half a sample before it.
        edges = np.stack([begin - 0.5, end + 0.5], axis=1) + crossing.start + grid.off_centre
        span[part] = np.where(whole[:, None], edges, span[part])
    return RunningSums(response, count, span, _excess(grid, width))


def totals(sums: Float32Array, pinhole: Pinhole, grid: PolarGrid) -> Float32Array:
    """Return the totals (r, c + 1) of the samples of `sums` before each sample of a circle."""
    out = np.zeros((len(grid.polar), len(grid.azimuth) + 1), dtype=np.float32)
    for part, crossing, samples, _ in sampled(sums, pinhole, grid, 0, 1.0):
        out[part, crossing.start + 1 : crossing.stop + 1] = np.cumsum(samples, axis=1, dtype=np.float64)
        out[part, crossing.stop + 1 :] = out[part, crossing.stop, None]
    return out


def _excess(grid: PolarGrid, width: int) -> FloatArray:
    """Return the noise (r,) of sums of `width` samples of 3 x 3 pixels over that of samples far apart.

    On the slow circles near the axis samples are so close that they are of the same pixels.
    """
    spacing = grid.speed * (grid.azimuth[1] - grid.azimuth[0])
    slow = np.flatnonzero(spacing < _BOX)
    steps = np.arange(1, width)
    common = np.maximum(1.0 - spacing[slow, None] * steps / _BOX, 0.0)
    out = np.ones(len(spacing))
    out[slow] = np.sqrt(1.0 + 2.0 * common @ (1.0 - steps / width))
    return out


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


# Lengths tried differ by this factor, from this many samples on.
_FACTOR = 1.1
_SHORTEST = 5
# One circle in this many suffices.
_SPARSE = 2
# Noise of a sum of samples over a pixel's and the root of their number: nine pixels each, which overlap.
_TOTAL_NOISE = 3.1
_LEAST_SIGMAS = 5.0
# No streak counts more than this many sigmas.
_ENOUGH = 40.0


def frame_angles(frame: ExposedFrame, pinhole: Pinhole, turn: FloatArray, most: int) -> list[float]:
    """Return the `most` likeliest angles, rad, about the axis of `turn` (3,), the likeliest first."""
    # A turn by one radian has the longest steps and the widest circles.
    grid = polar_grid(pinhole, Motion.steady(turn / np.linalg.norm(turn)), _SPARSE)
    step = grid.angle / grid.length
    held = totals(frame.sums, pinhole, grid)
    held *= np.float32(1.0 / (_TOTAL_NOISE * np.sqrt(np.median(frame.floor[::97]))))
    longest = min(len(grid.azimuth) // 2, int(np.pi / step))
    if longest < 2 * _SHORTEST:
        return []
    count = int(np.log(longest / _SHORTEST) / np.log(_FACTOR)) + 1
    widths = np.unique(np.rint(_SHORTEST * _FACTOR ** np.arange(count)).astype(np.int64))
    room = int(sharper_widths(int(widths[-1]), longest)[-1]) // 2
    # Azimuth by azimuth, so that what is compared lies side by side.
    padded = np.pad(np.ascontiguousarray(held.T), ((room, room), (0, 0)), mode="edge")
    score = np.array([_standing_out(padded, room, int(width)) for width in widths])
    before, after = np.append(0.0, score[:-1]), np.append(score[1:], 0.0)
    peak = np.flatnonzero((score > before) & (score >= after))
    peak = peak[np.argsort(-score[peak], kind="stable")][:most]
    return [_sharpened(padded, room, sharper_widths(int(widths[index]), longest)) * step for index in peak]


def _standing_out(padded: Float32Array, room: int, width: int) -> float:
    """Return the squared significance of the boxes of `width` samples that stand out most.

    `padded` (c, r) are the totals by azimuth, with `room` more on either side.
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
    # The highest box of each stretch of a circle, if none beside it is higher.
    best = light.reshape(stretches, width, -1).max(axis=1)
    best *= np.float32(1.0 / np.sqrt(2.0 * width))
    around = np.pad(best, 1)
    highest = best >= _LEAST_SIGMAS
    for down in (0, 1, 2):
        for beside in (0, 1, 2):
            highest &= best >= around[down : down + stretches, beside : beside + best.shape[1]]
    return float(np.sum(np.minimum(best[highest], _ENOUGH) ** 2))


def sharper_widths(width: int, longest: int) -> IntArray:
    """Return the widths within half a step of `width`, none over `longest`."""
    room = max(1, round(0.6 * (_FACTOR - 1.0) * width))
    return np.arange(max(width - room, 2), min(width + room, longest) + 1)


def _sharpened(padded: Float32Array, room: int, widths: IntArray) -> int:
    """Return the best of the widths."""
    score = [_standing_out(padded, room, int(each)) for each in widths]
    return int(widths[int(np.argmax(score))])
