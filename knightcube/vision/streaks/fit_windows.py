"""Selection of the fitted pixels: strips of pixels along long streaks, and square patches around spots.

Long streaks are fitted on strips of pixels along their paths, and stars with short or slow paths (spots) on
square patches of pixels. The model of a streak on a strip expands the flux per px to first order around each
block of pixels. The first-order expansion of the flux is not valid if the speed is nearly zero. If the rate
increases from zero or decreases to zero, a square patch of pixels covers the slow part of each streak.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from knightcube.astro.arrays import BoolArray, Float32Array, FloatArray, Image, IntArray
from knightcube.compiled import compiled_form_of, loop_helper
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks.camera_motion import CameraMotion
from knightcube.vision.streaks.frame import ReducedFrame
from knightcube.vision.streaks.geometry import (
    PointsAtLines,
    Shutter,
    StarPaths,
    StreakScene,
    exposure_bounds,
    path_lengths,
    paths,
    positions,
)

LINES = 16
"""Number of lines of pixels in one block, a multiple of the length of the processor's vectors.

Each line crosses the path of the star."""

STEEPEST = 0.68
"""Minimum cosine between a path and the normal of a line of pixels, slightly below the cosine of 45 deg."""

SLOWEST = 1e-3
"""Lower limit (px per exposure) of a star's speed, which avoids divisions by zero."""
# Largest camera rotation (rad) in one part of a path. The column or the row of a star must change
# monotonically along each part.
_LONGEST_ROTATION = 1.1
# Number of instants at which part of a path is sampled to find where it crosses lines of pixels.
_CROSSING_SAMPLES = 17
# Ratio of a star's speeds along rows and columns at which its path is divided.
# With a ratio of 1, a whole diagonal of pixels could lie in the gap between two parts and be omitted.
_DIAGONAL = 1.03
# Number of instants at which the direction of a segment of a path is evaluated.
_DIRECTION_INSTANTS = 7
# Lower limit of the cosine between a path and the normal of the pixel rows (or columns) that it crosses.
_MOST_BENT = 0.5
# Width (px) of the gap between adjoining parts of a straight path. Pixels in the gap belong to neither part.
_SEAM = 0.003
# Increase of this gap on a curved path, as a multiple of (half width of the strip)^3 (curvature)^2.
_ARC = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class Strips:
    """Pixels near the paths of stars: b blocks, each of `LINES` lines of k pixels across the path.

    Attributes:
        star: index of the star of each block of pixels (b,), in ascending order.
        time: time at which the star crosses each line of pixels (b, LINES), in exposure times since
            mid-exposure.
        corner: column and row of the first pixel of each line of pixels (b, LINES, 2).
        step: step in column and row from one pixel of a line to the next (b, 2).
        index: flat index in the frame of each pixel (b, LINES, k), or 0 for a pixel that is not `inside`.
        inside: mask (b, LINES, k) of the pixels in the frame that are nearer to their block's part of the
            path than to other parts.
    """

    star: IntArray
    time: FloatArray
    corner: IntArray
    step: IntArray
    index: IntArray
    inside: BoolArray

    def select(self, blocks: IntArray | slice) -> Strips:
        """Return the strips with only the selected `blocks`."""
        at_lines = self.time[blocks], self.corner[blocks], self.step[blocks]
        return Strips(self.star[blocks], *at_lines, self.index[blocks], self.inside[blocks])


def cut_strips(
    pinhole: Pinhole,
    motion: CameraMotion,
    stars: FloatArray,
    times: FloatArray,
    width: float,
    ending: BoolArray | None = None,
) -> Strips:
    """Return the pixels within `width` px of the paths of `stars` (n, 2), px, between start and end `times`.

    The start and end times (n, 2) are relative to mid-exposure, in units of the exposure time. The mask
    `ending` (n, 2) states which start and end times are ends of a streak. At an end of a streak, pixels
    beyond the end are included. If `ending` is None, all start and end times are ends of a streak.
    """
    part, low, high, outer = _parts(pinhole, motion, stars, times)
    if ending is not None:
        outer &= ending[part]
    # The sampled positions extend by the same distance beyond both ends of each part of a path.
    chosen, reach = stars[part], 1.45 * width + 1.0
    begin = low - reach / _speed(paths(pinhole, motion, chosen, low))
    end = high + reach / _speed(paths(pinhole, motion, chosen, high))
    sampled = begin[:, None] + (end - begin)[:, None] * np.linspace(0.0, 1.0, _CROSSING_SAMPLES)
    place = positions(pinhole, motion, np.repeat(chosen, _CROSSING_SAMPLES, axis=0), sampled.reshape(-1))
    place = place.reshape(-1, _CROSSING_SAMPLES, 2)
    owner, line, time, real, along_rows = _block_lines(place, sampled, (pinhole.columns, pinhole.rows))
    path = paths(pinhole, motion, np.repeat(stars[part[owner]], LINES, axis=0), time.reshape(-1))
    lines = _Lines(part[owner], owner, line, time, real, along_rows)
    field = pinhole.columns, pinhole.rows, float(width)
    bounds = np.ascontiguousarray(low), np.ascontiguousarray(high), outer
    return Strips(*_strip_pixels(path.at_lines(line.shape), lines, bounds, field))


class _Lines(NamedTuple):
    """Lines of pixels across star paths, in b blocks that each belong to one part of the path of one star.

    The line numbers, the times at which the star crosses the lines, and the mask of the lines in the frame
    have the shape (b, LINES).
    """

    star: IntArray
    part: IntArray
    line: IntArray
    time: FloatArray
    real: BoolArray
    along_rows: BoolArray


def _parts(
    pinhole: Pinhole, motion: CameraMotion, stars: FloatArray, times: FloatArray
) -> tuple[IntArray, FloatArray, FloatArray, BoolArray]:
    """Return star, start time and end time of each path part, and a mask (.., 2) of the streak ends."""
    turned = float(np.linalg.norm(motion.rotation)) + float(np.linalg.norm(motion.acceleration))
    longest = float(np.max(times[:, 1] - times[:, 0], initial=0.0))
    pieces = max(1, math.ceil(turned * longest / _LONGEST_ROTATION))
    edges = times[:, :1] + (times[:, 1:] - times[:, :1]) * np.linspace(0.0, 1.0, pieces + 1)
    # The start and end times have no rounding errors, so that streak ends are recognised by equality.
    edges[:, -1] = times[:, 1]
    part = np.repeat(np.arange(len(times)), pieces)
    low, high = edges[:, :-1].reshape(-1), edges[:, 1:].reshape(-1)
    owner, diagonal = _diagonals(pinhole, motion, stars[part], low, high)
    star, edge = np.append(np.repeat(np.arange(len(times)), pieces + 1), part[owner]), edges.reshape(-1)
    edge = np.append(edge, diagonal)
    order = np.lexsort((edge, star))
    star, edge = star[order], edge[order]
    begin = np.flatnonzero(star[1:] == star[:-1])
    part, low, high = star[begin], edge[begin], edge[begin + 1]
    return part, low, high, np.stack([low == times[part, 0], high == times[part, 1]], axis=-1)


def _diagonals(
    pinhole: Pinhole, motion: CameraMotion, stars: FloatArray, low: FloatArray, high: FloatArray
) -> tuple[IntArray, FloatArray]:
    """Return which path parts must be divided, and the times at which the main direction of the path changes.

    Each part is given by its star's position (`stars`, (n, 2), px) and by start and end times `low` and
    `high` (n,).
    """
    instants = low[:, None] + (high - low)[:, None] * np.linspace(0.0, 1.0, _DIRECTION_INSTANTS)
    path = paths(pinhole, motion, np.repeat(stars, _DIRECTION_INSTANTS, axis=0), instants.reshape(-1))
    way = np.abs(path.velocity.reshape(-1, _DIRECTION_INSTANTS, 2))
    major = way.sum(axis=1).argmax(axis=1)[:, None]
    steep = np.where(major, way[..., 1], way[..., 0]) < STEEPEST * np.hypot(way[..., 0], way[..., 1])
    divided = np.flatnonzero(steep.any(axis=1))
    excess = way[divided, :, 0] - _DIAGONAL * way[divided, :, 1]
    which, before = np.nonzero((excess[:, 1:] < 0.0) != (excess[:, :-1] < 0.0))
    first, last = excess[which, before], excess[which, before + 1]
    which = divided[which]
    begin, end = instants[which, before], instants[which, before + 1]
    return which, begin + (end - begin) * first / (first - last)


_BlockLines = tuple[IntArray, IntArray, FloatArray, BoolArray, BoolArray]
"""Attributes `part`, `line`, `time`, `real` and `along_rows` of `_Lines`."""


def _block_lines_numpy(place: FloatArray, sampled: FloatArray, field: tuple[int, int]) -> _BlockLines:
    """Return the rows or columns of pixels that n path segments cross.

    Each segment is given by its positions `place` (n, s, 2) at the s instants `sampled` (n, s).
    The pair `field` contains the numbers of columns and rows of the frame.
    """
    span = np.abs(place[:, -1] - place[:, 0])
    along_rows = span[:, 0] >= span[:, 1]
    major = np.where(along_rows[:, None], place[:, :, 0], place[:, :, 1])
    size = np.where(along_rows, *field)
    first = np.maximum(np.ceil(major.min(axis=1)), 0).astype(np.int64)
    last = np.minimum(np.floor(major.max(axis=1)), size - 1).astype(np.int64)
    count = np.maximum(last - first + 1, 0)
    blocks = -(-count // LINES)
    owner = np.repeat(np.arange(len(place)), blocks)
    number = np.arange(len(owner)) - np.repeat(np.cumsum(blocks) - blocks, blocks)
    line = first[owner, None] + number[:, None] * LINES + np.arange(LINES)
    real = line <= last[owner, None]
    return owner, line, _crossings(major, sampled, line, owner), real, along_rows[owner]


def _crossings(major: FloatArray, sampled: FloatArray, line: IntArray, owner: IntArray) -> FloatArray:
    """Return approximate times at which paths cross lines of pixels (`line`, (b, LINES))."""
    falling = major[:, -1] < major[:, 0]
    major = np.where(falling[:, None], major[:, ::-1], major)
    sampled = np.where(falling[:, None], sampled[:, ::-1], sampled)
    within = np.clip(line, major[owner, :1], major[owner, -1:])
    # The coordinates of each part are shifted beyond those of the previous part, so that one call
    # interpolates all.
    begin = np.arange(len(major)) * (float(np.ptp(major)) + 1.0 if major.size else 1.0)
    at = (within + begin[owner, None]).reshape(-1)
    times = np.interp(at, (major + begin[:, None]).reshape(-1), sampled.reshape(-1)) if len(at) else at
    return np.asarray(times.reshape(line.shape))


@compiled_form_of(_block_lines_numpy)
def _block_lines(place: FloatArray, sampled: FloatArray, field: tuple[int, int]) -> _BlockLines:
    parts, count = sampled.shape
    first, last, blocks = np.empty(parts, np.int64), np.empty(parts, np.int64), 0
    axes = np.empty(parts, np.int64)
    for n in range(parts):
        across, down = abs(place[n, -1, 0] - place[n, 0, 0]), abs(place[n, -1, 1] - place[n, 0, 1])
        axes[n] = 0 if across >= down else 1
        major = place[n, :, axes[n]]
        first[n], last[n] = max(math.ceil(major.min()), 0), min(math.floor(major.max()), field[axes[n]] - 1)
        blocks += max(last[n] - first[n] + LINES, 0) // LINES
    owner, along_rows = np.empty(blocks, np.int64), np.empty(blocks, np.bool_)
    line, real = np.empty((blocks, LINES), np.int64), np.empty((blocks, LINES), np.bool_)
    time, b = np.empty((blocks, LINES)), 0
    for n in range(parts):
        major = place[n, :, axes[n]]
        low, high = min(major[0], major[-1]), max(major[0], major[-1])
        step = 1 if major[-1] >= major[0] else -1
        # The path crosses the line between the samples `at` and `at + step`.
        at = 0 if step > 0 else count - 1
        for begin in range(first[n], last[n] + 1, LINES):
            owner[b], along_rows[b] = n, axes[n] == 0
            for i in range(LINES):
                line[b, i], real[b, i] = begin + i, begin + i <= last[n]
                within = min(max(float(begin + i), low), high)
                while 0 <= at + 2 * step < count and major[at + step] <= within:
                    at += step
                slope = (sampled[n, at + step] - sampled[n, at]) / (major[at + step] - major[at])
                time[b, i] = slope * (within - major[at]) + sampled[n, at]
            b += 1
    return owner, line, time, real, along_rows


_Bounds = tuple[FloatArray, FloatArray, BoolArray]
"""Start time and end time of each part of a path, and a mask (.., 2) of times that are streak ends."""
_Field = tuple[int, int, float]
"""Numbers of columns and rows of the frame, and largest distance (px) of a pixel from the path."""


_StripArrays = tuple[IntArray, FloatArray, IntArray, IntArray, IntArray, BoolArray]
"""Attributes of `Strips`."""


def _strip_pixels_numpy(points: PointsAtLines, lines: _Lines, bounds: _Bounds, field: _Field) -> _StripArrays:
    """Return the attributes of `Strips` for `lines` of pixels that the paths cross at `points`.

    Blocks without selected pixels are omitted. Margins without selected pixels on any line are removed.
    """
    (position, velocity, _), along, (columns, _, width) = points, lines.along_rows[:, None], field
    tangent = np.where(along, *velocity) / np.maximum(np.hypot(*velocity), SLOWEST)
    steep = np.maximum(np.abs(tangent), _MOST_BENT)
    half = math.ceil(float(np.max(np.where(lines.real, width / steep, 0.0), initial=0.0)))
    minor = np.rint(np.where(along, position[1], position[0])).astype(np.int64) - half
    corner = np.stack([np.where(along, lines.line, minor), np.where(along, minor, lines.line)], axis=-1)
    within = _selected_pixels(corner, points, lines, bounds, field, 2 * half + 1)
    crossed = np.flatnonzero(within.any(axis=(0, 1)))
    used = np.flatnonzero(within.any(axis=(1, 2)))
    begin, end = (int(crossed[0]), int(crossed[-1]) + 1) if len(crossed) else (0, 0)
    inside = np.ascontiguousarray(within[used, :, begin:end])
    step = np.where(along, [[0, 1]], [[1, 0]])[used]
    corner = corner[used] + begin * step[:, None]
    first, next_pixel = corner[..., 1] * columns + corner[..., 0], step[:, 1] * columns + step[:, 0]
    index = first[..., None] + np.arange(end - begin) * next_pixel[:, None, None]
    index *= inside
    return lines.star[used], lines.time[used], corner, step, index, inside


def _selected_pixels(
    corner: IntArray, points: PointsAtLines, lines: _Lines, bounds: _Bounds, field: _Field, count: int
) -> BoolArray:
    """Return the mask (b, LINES, count) of pixels that are nearest to the path part of their block."""
    part, time, real, along_rows = lines.part, lines.time, lines.real, lines.along_rows
    along, (low, high, outer), (columns, rows, width) = along_rows[:, None], bounds, field
    position, velocity, bent = points
    speed = np.maximum(np.hypot(velocity[0], velocity[1]), SLOWEST)
    tangent = velocity / speed
    bend = (bent[1] * tangent[0] - bent[0] * tangent[1]) / speed**2
    step = np.where(along, [[0, 1]], [[1, 0]])
    there, way = position.transpose(1, 2, 0), tangent.transpose(1, 2, 0)
    aside, ahead = path_distances(corner, step, there, way, count)
    # An accuracy of 0.01 px suffices for the selection of pixels, so that float32 is used.
    pace, curved = speed.astype(np.float32), bend.astype(np.float32)
    ahead /= np.maximum(np.float32(1.0) - curved * aside, np.float32(0.5))
    aside -= np.float32(0.5) * curved * ahead * ahead
    foot = np.divide(ahead, pace, out=ahead)
    foot += time.astype(np.float32)
    # A pixel between two parts of a path may be omitted, but no pixel is counted twice.
    seam, room = (_SEAM + _ARC * width**3 * np.square(bend)) / speed, width / speed
    start = low[part, None] + np.where(outer[part, :1], -room, seam)
    stop = high[part, None] - np.where(outer[part, 1:], -room, seam)
    offset = np.arange(count)[:, None, None]
    minor, limit = np.where(along, corner[..., 1], corner[..., 0]), np.where(along, rows, columns)
    chosen = np.abs(aside, out=aside) <= np.float32(width)
    chosen &= foot >= start.astype(np.float32)
    chosen &= foot < stop.astype(np.float32)
    chosen &= offset >= np.where(real, -minor, count)
    chosen &= offset < limit - minor
    return chosen.transpose(1, 2, 0)


@compiled_form_of(_strip_pixels_numpy)
def _strip_pixels(points: PointsAtLines, lines: _Lines, bounds: _Bounds, field: _Field) -> _StripArrays:
    position, velocity, bent = points
    (low, high, outer), (columns, rows, width) = bounds, field
    blocks, each = lines.line.shape
    half = _half_width(velocity, lines, width)
    count = 2 * half + 1
    within, minor = np.zeros((blocks, each, count), np.bool_), np.empty((blocks, each), np.int64)
    crossed, used, found = np.zeros(count, np.bool_), np.empty(blocks, np.int64), 0
    near = np.empty(-(-count // _VECTOR) * _VECTOR, np.bool_)
    for b in range(blocks):
        along, p, any_pixel = lines.along_rows[b], lines.part[b], False
        limit = rows if along else columns
        for i in range(each):
            speed = max(math.sqrt(velocity[0, b, i] ** 2 + velocity[1, b, i] ** 2), SLOWEST)
            tx, ty = velocity[0, b, i] / speed, velocity[1, b, i] / speed
            bend = (bent[1, b, i] * tx - bent[0, b, i] * ty) / speed**2
            minor[b, i] = round(position[1, b, i] if along else position[0, b, i]) - half
            column, row = (lines.line[b, i], minor[b, i]) if along else (minor[b, i], lines.line[b, i])
            dx, dy = column - position[0, b, i], row - position[1, b, i]
            seam, room = _SEAM + _ARC * width**3 * bend * bend, -width
            start = (low[p] - lines.time[b, i]) * speed + (room if outer[p, 0] else seam)
            stop = (high[p] - lines.time[b, i]) * speed - (room if outer[p, 1] else seam)
            first, slope = (dy * tx - dx * ty, dx * tx + dy * ty), (tx, ty) if along else (-ty, tx)
            _select_near(near, first, slope, bend, (start, stop, width))
            begin, end = max(0, -minor[b, i]), min(count, limit - minor[b, i])
            for k in range(begin, end if lines.real[b, i] else begin):
                within[b, i, k] = near[k]
                crossed[k] |= near[k]
                any_pixel |= near[k]
        used[found] = b
        found += any_pixel
    chosen = np.flatnonzero(crossed)
    begin, end = (chosen[0], chosen[-1] + 1) if len(chosen) else (0, 0)
    star, time, size = np.empty(found, np.int64), np.empty((found, each)), end - begin
    corner, step = np.empty((found, each, 2), np.int64), np.empty((found, 2), np.int64)
    index, inside = np.zeros((found, each, size), np.int64), np.empty((found, each, size), np.bool_)
    for u in range(found):
        b = used[u]
        along = lines.along_rows[b]
        star[u] = lines.star[b]
        step[u, 0], step[u, 1] = (0, 1) if along else (1, 0)
        for i in range(each):
            column, row = (lines.line[b, i], minor[b, i]) if along else (minor[b, i], lines.line[b, i])
            time[u, i] = lines.time[b, i]
            corner[u, i, 0], corner[u, i, 1] = column + begin * step[u, 0], row + begin * step[u, 1]
            first_pixel = corner[u, i, 1] * columns + corner[u, i, 0]
            for k in range(size):
                place, inside[u, i, k] = first_pixel + k * (columns if along else 1), within[b, i, begin + k]
                index[u, i, k] = place if inside[u, i, k] else 0
    return star, time, corner, step, index, inside


@loop_helper
def _half_width(velocity: FloatArray, lines: _Lines, width: float) -> int:
    """Return the maximum number of pixels of a line within `width` px of the path on one side of the path."""
    steepest = 1.0
    for b in range(len(lines.line)):
        for i in range(lines.line.shape[1]):
            speed = max(math.sqrt(velocity[0, b, i] ** 2 + velocity[1, b, i] ** 2), SLOWEST)
            major = velocity[0, b, i] if lines.along_rows[b] else velocity[1, b, i]
            if lines.real[b, i]:
                steepest = min(steepest, max(abs(major) / speed, _MOST_BENT))
    return math.ceil(width / steepest) if lines.real.any() else 0


# Number of pixels that the processor handles at once.
_VECTOR = 8


@loop_helper
def _select_near(
    near: BoolArray,
    first: tuple[float, float],
    slope: tuple[float, float],
    bend: float,
    limits: tuple[float, float, float],
) -> None:
    """Set `near` (k,) to whether each pixel of a line is within `limits` along and across the path.

    The pair `first` (px) contains the distances of the first pixel across and along the tangent of the path,
    and `slope` their increments from pixel to pixel. The `limits` (px) are the start and the stop along the
    path, and the largest distance across the path.
    """
    across, ahead = np.float32(first[0]), np.float32(first[1])
    by_across, by_ahead = np.float32(slope[0]), np.float32(slope[1])
    start, stop, width = np.float32(limits[0]), np.float32(limits[1]), np.float32(limits[2])
    curved, one, half = np.float32(bend), np.float32(1.0), np.float32(0.5)
    for k in range(len(near)):
        offset = np.float32(np.int32(k))
        aside, s = across + offset * by_across, ahead + offset * by_ahead
        s /= max(one - curved * aside, half)
        aside -= half * curved * s * s
        near[k] = (abs(aside) <= width) & (s >= start) & (s < stop)


def path_distances(
    corner: IntArray, step: IntArray, position: FloatArray, tangent: FloatArray, count: int
) -> tuple[Float32Array, Float32Array]:
    """Return distances (count, b, l), px, across and along the path, of `count` pixels on each of l lines.

    The first pixel of each line (`corner`) and the step to the next pixel (`step`) are those of `Strips`;
    `position` and `tangent` (b, l, 2) are the position and unit tangent at which the path crosses each line
    of pixels. The index of a pixel within its line is the first array axis, so that operations run along
    contiguous memory.
    """
    offset = np.arange(count, dtype=np.float32)[:, None, None]
    dx, dy = corner[..., 0] - position[..., 0], corner[..., 1] - position[..., 1]
    tx, ty = tangent[..., 0], tangent[..., 1]
    by_x, by_y = step[:, :1], step[:, 1:]
    aside = (by_y * tx - by_x * ty).astype(np.float32) * offset
    aside += (dy * tx - dx * ty).astype(np.float32)
    ahead = (by_x * tx + by_y * ty).astype(np.float32) * offset
    ahead += (dx * tx + dy * ty).astype(np.float32)
    return aside, ahead


def _speed(path: StarPaths) -> FloatArray:
    return np.maximum(np.hypot(path.velocity[:, 0], path.velocity[:, 1]), SLOWEST)


@dataclass(frozen=True, slots=True, eq=False)
class Patches:
    """Square patches of pixels around n spots, which are short streaks or slow parts of streaks.

    The arrays `column` (n, p) and `row` (n, p) are the p columns and p rows of each patch. The flat index in
    the frame (n, p, p) is 0 for a pixel that is not `inside` the frame.
    """

    column: IntArray
    row: IntArray
    index: IntArray
    inside: BoolArray


def cut_patches(pinhole: Pinhole, middles: FloatArray, half: int) -> Patches:
    """Return square patches of pixels within `half` px of `middles` (n, 2), px, along rows and columns."""
    corner = np.rint(middles).astype(np.int64)[:, :, None] + np.arange(-half, half + 1)
    column, row = corner[:, 0], corner[:, 1]
    inside = ((row >= 0) & (row < pinhole.rows))[:, :, None] & ((column >= 0) & (column < pinhole.columns))[
        :, None, :
    ]
    index = np.where(inside, row[:, :, None] * pinhole.columns + column[:, None, :], 0)
    return Patches(column, row, index, inside)


# Path length (point-spread widths) below which a star is fitted on a square patch of pixels.
_SPOT_WIDTHS = 8.0
# Number of instants at which the position of a star on its path is evaluated.
_INSTANTS = 9
# Largest relative change of a star's speed over one point-spread width on a strip of pixels.
_STEADY = 0.05
# Minimum length (point-spread widths) of the fast part of a path for a fit on a strip of pixels.
_LEAST_FAST = 4.0
# Number of instants at which the rate is evaluated to find the slow part of a star's path.
_SAMPLES = 129


@dataclass(frozen=True, slots=True, eq=False)
class BlockPixels:
    """The values of the frame at the fitted pixels; the first axis is the index of a block of pixels.

    Attributes:
        slot: index of each pixel in the list of all fitted pixels, in which each shared pixel occurs only
            once. For a pixel outside the frame, `slot` is the total number of fitted pixels.
        inside: mask of the fitted pixels of each block.
        signal: counts of each pixel above the background.
        floor: noise variance of each pixel without a star, counts^2.
        ceiling: counts above the background at which each pixel saturates.
        gain: gain of the camera, electrons per count.
        crowded: flat indices (e,), in the arrays of this class, of the e pixels that several stars share.
        common: index (e,) of each of these pixels in the list of all shared pixels.
    """

    slot: IntArray
    inside: BoolArray
    signal: Float32Array
    floor: Float32Array
    ceiling: Float32Array
    gain: float
    crowded: IntArray
    common: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class StarPixels:
    """Strips of pixels along long streaks, and square patches of pixels around spots.

    Attributes:
        long: index in the scene of each star with a strip (a,). A star that moves slowly on part of its path
            also has a patch for this part.
        spot: index in the scene of each star with a patch (b,).
        strips: pixels of the strips along long streaks.
        patches: pixels of the square patches around spots.
    """

    long: IntArray
    spot: IntArray
    strips: Strips
    patches: Patches


@dataclass(frozen=True, slots=True, eq=False)
class FitWindows(StarPixels):
    """The fitted pixels of all stars, with the values of the frame.

    Attributes:
        pixels: flat indices in the frame of all m fitted pixels (m,), each given once.
        slot: index in the list `pixels` of each pixel of all strips and patches, as a flat array.
        on_strips, on_patches: values of the frame on the strips and on the patches.
        shared: number of pixels that belong to more than one star.
    """

    pixels: IntArray
    slot: IntArray
    on_strips: BlockPixels
    on_patches: BlockPixels
    shared: int

    def total(
        self, images: Float32Array, spots: FloatArray, light: FloatArray, sky: FloatArray
    ) -> Float32Array:
        """Return the sum of the counts of all stars on each fitted pixel, as an array (m + 1,).

        The first of the `images` (b, .., LINES, k) of each block, and the images `spots` (n, p, p), show
        stars of unit flux. The arrays `light` (n,) and `sky` (n,) contain the flux and the sky level of each
        star. The last element of the result is the sum of the counts on pixels outside the frame.
        """
        star = self.long[self.strips.star]
        blocks = images.reshape(*images.shape[:2], math.prod(images.shape[2:])), light[star], sky[star]
        patches = spots.reshape(len(spots), math.prod(spots.shape[1:])), light[self.spot], sky[self.spot]
        return _summed(self.slot, blocks, patches, len(self.pixels) + 1)

    def only(self, on_strips: BoolArray, on_patches: BoolArray) -> FitWindows:
        """Return the fit windows reduced to the pixels selected by the masks `on_strips` and `on_patches`."""
        strips = replace(self.on_strips, inside=on_strips)
        patches = replace(self.on_patches, inside=on_patches)
        return replace(self, on_strips=strips, on_patches=patches)


_Blocks = tuple[Float32Array, FloatArray, FloatArray]
_Spots = tuple[FloatArray, FloatArray, FloatArray]
"""Images of a star of unit flux on each block or patch, and the star's flux and sky level."""


def _summed_numpy(slot: IntArray, blocks: _Blocks, patches: _Spots, count: int) -> Float32Array:
    """Return the sums (count,) of the counts on `blocks` and `patches` that belong to each fitted pixel.

    The array `slot` contains the index of the pixel for each pixel of the blocks, and then of the patches.
    """
    (images, light, sky), (spots, spot_light, spot_sky) = blocks, patches
    streaks = images[:, 0] * light[:, None] + sky[:, None]
    counts = streaks.reshape(-1), (spots * spot_light[:, None] + spot_sky[:, None]).reshape(-1)
    return np.bincount(slot, np.concatenate(counts), count).astype(np.float32)


@compiled_form_of(_summed_numpy)
def _summed(slot: IntArray, blocks: _Blocks, patches: _Spots, count: int) -> Float32Array:
    (images, light, sky), (spots, spot_light, spot_sky) = blocks, patches
    total, size = np.zeros(count), images.shape[2]
    strips = slot[: len(images) * size].reshape(len(images), size)
    for b in range(len(images)):
        for p in range(size):
            total[strips[b, p]] += images[b, 0, p] * light[b] + sky[b]
    squares = slot[len(images) * size :].reshape(spots.shape)
    for n in range(len(spots)):
        for p in range(spots.shape[1]):
            total[squares[n, p]] += spots[n, p] * spot_light[n] + spot_sky[n]
    return total.astype(np.float32)


def _at_pixels_numpy(images: Float32Array, crowded: IntArray) -> tuple[IntArray, IntArray, Float32Array]:
    """See `at_pixels`."""
    _, count, size = images.shape
    block, place = np.divmod(crowded, size)
    first = np.flatnonzero(np.diff(block, prepend=-1))
    place += block * (count * size)
    drawn = np.empty((count - 1, len(place)), dtype=np.float32)
    for image in drawn:
        image[:] = images.reshape(-1).take(place)
        place += size
    return block[first], first, drawn


@compiled_form_of(_at_pixels_numpy)
def at_pixels(images: Float32Array, crowded: IntArray) -> tuple[IntArray, IntArray, Float32Array]:
    """Return the blocks (c,) that contain e given pixels, and the values of images at these pixels.

    The second returned array (c,) contains the index, among the e given pixels, of the first pixel of each
    block. The third array (i, e) contains the values of i images. The array `images` (b, i + 1, p) contains
    i + 1 images on the p pixels of each of b blocks. The last of the i + 1 images contains the residuals and
    is omitted. The array `crowded` (e,) contains the flat indices of the given pixels in an array (b, p), in
    ascending order.
    """
    blocks, count, size = images.shape
    block, begin, found = np.empty(blocks, np.int64), np.empty(blocks, np.int64), 0
    drawn, first = np.empty((count - 1, len(crowded)), dtype=np.float32), 0
    while first < len(crowded):
        b, last = crowded[first] // size, first
        while last < len(crowded) and crowded[last] < (b + 1) * size:
            last += 1
        block[found], begin[found] = b, first
        found += 1
        places = crowded[first:last] - b * size
        for i in range(count - 1):
            image, values = images[b, i], drawn[i, first:last]
            for e in range(len(places)):
                values[e] = image[places[e]]
        first = last
    return block[:found].copy(), begin[:found].copy(), drawn


def window_areas(pinhole: Pinhole, scene: StreakScene, reach: float) -> FloatArray:
    """Return the approximate number of pixels (n,) within `reach` point-spread widths of each star's path.

    The strips of all stars are assumed to be as wide as the strip along the path that is most oblique to rows
    and columns.
    """
    n, room = len(scene.stars), reach * scene.width
    if n == 0:
        return np.empty(0)
    time = np.tile(np.linspace(-0.5, 0.5, _INSTANTS), n)
    there = positions(pinhole, scene.motion, np.repeat(scene.stars, _INSTANTS, axis=0), time)
    seen = pinhole.contains(there).reshape(n, _INSTANTS).mean(axis=1)
    step = np.abs(np.diff(there.reshape(n, _INSTANTS, 2), axis=1))
    lines = step.max(axis=2)
    steep = float(np.min(lines / np.maximum(np.hypot(step[..., 0], step[..., 1]), 1e-9)))
    across = 2.0 * np.floor(room / min(max(steep, STEEPEST), 1.0) + 0.5) + 1.0
    return np.asarray(across * (lines.sum(axis=1) * seen + 2.0 * room))


def cut_windows(
    frame: ReducedFrame, pinhole: Pinhole, shutter: Shutter, scene: StreakScene, reach: float
) -> FitWindows:
    """Return fit windows with all pixels of `frame` within `reach` point-spread widths of the paths."""
    stars = star_pixels(pinhole, shutter, scene, reach)
    strips, patches = stars.strips, stars.patches
    index, inside = strips.index.reshape(-1), strips.inside.reshape(-1)
    if len(patches.index):
        index = np.concatenate([index, patches.index.reshape(-1)])
        inside = np.concatenate([inside, patches.inside.reshape(-1)])
    pixels, slot, crowded, common, shared = _numbered(index, inside, frame.signal.size)
    of_frame = frame.signal, frame.floor, frame.counts, frame.bad
    good, signal, floor, ceiling = _frame_values(index, inside, of_frame, float(frame.top))
    cut, first = strips.index.size, int(np.searchsorted(crowded, strips.index.size))

    def view(shape: tuple[int, ...], begin: int, of: slice) -> BlockPixels:
        part = slice(begin, begin + math.prod(shape))
        ours = slot[part].reshape(shape), good[part].reshape(shape), signal[part].reshape(shape)
        levels = floor[part].reshape(shape), ceiling[part].reshape(shape)
        return BlockPixels(*ours, *levels, frame.gain, crowded[of] - begin, common[of])

    on_strips = view(strips.index.shape, 0, slice(0, first))
    on_patches = view(patches.index.shape, cut, slice(first, len(crowded)))
    of_stars = stars.long, stars.spot, strips, patches
    return FitWindows(*of_stars, pixels, slot, on_strips, on_patches, shared)


_Numbered = tuple[IntArray, IntArray, IntArray, IntArray, int]
"""Attributes `pixels`, `slot` and `shared` of `FitWindows`, with `crowded` and `common` of all pixels."""


def _numbered_numpy(index: IntArray, inside: BoolArray, size: int) -> _Numbered:
    """Return the distinct fitted pixels, the index of each pixel in this list, and the shared pixels.

    The flat indices `index` (p,) of the pixels, in a frame of `size` pixels, contain repeated values if
    windows overlap. For m distinct pixels, the returned index is m for a pixel that is not `inside`.
    """
    named = index[inside][::-1]
    # If a pixel occurs in several windows, `number` keeps the index of the first occurrence.
    order = np.arange(len(named), dtype=np.int32)[::-1]
    number = np.empty(size, dtype=np.int32)
    number[named] = order
    first = number.take(named[::-1])
    own = first == order[::-1]
    pixels = named[::-1][own]
    place = (np.cumsum(own) - 1).take(first)
    slot = np.full(len(index), len(pixels))
    slot[inside] = place
    several = np.bincount(place, minlength=len(pixels)) > 1
    crowded = np.flatnonzero(np.append(several, False).take(slot))
    common = (np.cumsum(several) - 1).take(slot.take(crowded))
    return pixels, slot, crowded, common, int(np.count_nonzero(several))


@compiled_form_of(_numbered_numpy)
def _numbered(index: IntArray, inside: BoolArray, size: int) -> _Numbered:
    # For each pixel, `windows` is 0, 1, 2 (two or more windows), or 3 (a shared pixel that has a number).
    windows, number = np.zeros(size, dtype=np.uint8), np.empty(size, dtype=np.int32)
    for p in range(len(index)):
        windows[index[p]] += inside[p] and windows[index[p]] < 2
    pixels, slot, count = np.empty_like(index), np.empty_like(index), 0
    crowded, common, found = np.empty_like(index), np.empty_like(index), 0
    slot_of, shared = np.empty_like(index), 0
    for p in range(len(index)):
        at = index[p]
        if not inside[p]:
            slot[p] = -1
            continue
        if windows[at] == 1:
            pixels[count], slot[p] = at, count
            count += 1
            continue
        if windows[at] == 2:
            windows[at], number[at] = 3, shared
            pixels[count], slot_of[shared] = at, count
            count, shared = count + 1, shared + 1
        slot[p] = slot_of[number[at]]
        crowded[found], common[found] = p, number[at]
        found += 1
    for p in range(len(index)):
        if slot[p] < 0:
            slot[p] = count
    return pixels[:count].copy(), slot, crowded[:found].copy(), common[:found].copy(), shared


_FrameArrays = tuple[Float32Array, Float32Array, Image, BoolArray]
"""Signal, noise variance (`floor`), raw counts and bad pixels of a `ReducedFrame`."""


def _frame_values_numpy(
    index: IntArray, inside: BoolArray, of_frame: _FrameArrays, top: float
) -> tuple[BoolArray, Float32Array, Float32Array, Float32Array]:
    """Return a mask of the usable pixels, and signal, floor and ceiling of all pixels, see `BlockPixels`."""
    signal, floor, counts, bad = of_frame
    light = signal.take(index)
    # The background (raw counts minus signal) is subtracted from the saturation level.
    ceiling = np.float32(top) - counts.take(index) + light
    return inside & ~bad.take(index), light, floor.take(index), ceiling.astype(np.float32)


@compiled_form_of(_frame_values_numpy)
def _frame_values(
    index: IntArray, inside: BoolArray, of_frame: _FrameArrays, top: float
) -> tuple[BoolArray, Float32Array, Float32Array, Float32Array]:
    size, (signal, floor, counts, bad) = len(index), of_frame
    good, light = np.empty(size, dtype=np.bool_), np.empty(size, dtype=np.float32)
    variance, ceiling = np.empty(size, dtype=np.float32), np.empty(size, dtype=np.float32)
    for p in range(size):
        at = index[p]
        good[p] = inside[p] and not bad[at]
        light[p], variance[p] = signal[at], floor[at]
        ceiling[p] = top - counts[at] + signal[at]
    return good, light, variance, ceiling


def star_pixels(pinhole: Pinhole, shutter: Shutter, scene: StreakScene, reach: float) -> StarPixels:
    """Return all pixels within `reach` point-spread widths of the paths of the stars of `scene`."""
    scene = scene.without_vibration(pinhole)
    room = reach * scene.width
    times = exposure_bounds(pinhole, scene.motion, shutter, scene.stars)
    fast, slow = _divided(pinhole, scene, times)
    whole = path_lengths(pinhole, scene.motion, scene.stars) >= _SPOT_WIDTHS * scene.width
    long = np.flatnonzero(whole & (fast[:, 1] > fast[:, 0]))
    spot = np.flatnonzero(~(whole & (fast[:, 1] > fast[:, 0])) | (slow[:, 1] > slow[:, 0]))
    strips = cut_strips(pinhole, scene.motion, scene.stars[long], fast[long], room, fast[long] == times[long])
    if not len(spot):
        return StarPixels(long, spot, strips, cut_patches(pinhole, np.empty((0, 2)), int(np.ceil(room))))
    # A square patch of pixels covers the slow part of a streak, or the complete path of a spot.
    part = np.where(np.isin(spot, long)[:, None], slow[spot], times[spot])
    sampled = part[:, :1] + np.diff(part) * np.linspace(0.0, 1.0, _INSTANTS)
    stars = np.repeat(scene.stars[spot], _INSTANTS, axis=0)
    there = positions(pinhole, scene.motion, stars, sampled.reshape(-1)).reshape(-1, _INSTANTS, 2)
    low, high = there.min(axis=1), there.max(axis=1)
    half = int(np.ceil(room + 0.5 * float(np.max(high - low))))
    patches = cut_patches(pinhole, 0.5 * (low + high), half)
    strips = _without_patches(strips, long, patches, spot)
    return StarPixels(long, spot, strips, patches)


def _divided(pinhole: Pinhole, scene: StreakScene, times: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return start and end times of the fast part (n, 2) and of the slow part (n, 2) of each star's path.

    The slow part of a path is at the start or the end of the exposure, whichever has the smaller rate. If a
    path has no fast part or no slow part, the start and end times of the missing part are equal.
    """
    motion = scene.motion.smooth
    if motion.constant or not motion.rotation.any():
        return times, np.zeros_like(times)
    time = np.linspace(times.min(), times.max(), _SAMPLES)
    pace, change = motion.relative_rate(time), np.abs(motion.relative_rate(time, 1)).max()
    steady = CameraMotion.steady(motion.rotation)
    velocity = paths(pinhole, steady, scene.stars, np.zeros(len(times))).velocity
    speed = np.maximum(np.hypot(velocity[:, 0], velocity[:, 1]), SLOWEST)
    # A star is slow if its speed changes by more than the fraction `_STEADY` over one point-spread width.
    slow = pace < np.sqrt(change * scene.width / (_STEADY * speed))[:, None]
    fast, rest = times.copy(), times.copy()
    if pace[0] < pace[-1]:
        until = np.where(slow.any(axis=1), time[_SAMPLES - 1 - slow[:, ::-1].argmax(axis=1)], -np.inf)
        divided: FloatArray = np.clip(until, times[:, 0], times[:, 1])
        fast[:, 0] = rest[:, 1] = divided
    else:
        since = np.where(slow.any(axis=1), time[slow.argmax(axis=1)], np.inf)
        divided = np.clip(since, times[:, 0], times[:, 1])
        fast[:, 1] = rest[:, 0] = divided
    way = speed * (motion.progress(fast[:, 1]) - motion.progress(fast[:, 0]))
    fast[way < _LEAST_FAST * scene.width] = 0.0
    return fast, rest


def _without_patches(strips: Strips, long: IntArray, patches: Patches, spot: IntArray) -> Strips:
    """Return `strips` without the pixels in the square patch of the same star."""
    both = np.isin(long, spot)
    if not both.any():
        return strips
    patch = np.searchsorted(spot, long)[strips.star]
    split = np.flatnonzero(both[strips.star])
    patch = patch[split]
    along = np.arange(strips.index.shape[2])[:, None] * strips.step[split, None, None]
    pixel = strips.corner[split, :, None] + along
    theirs = np.stack([patches.column[patch], patches.row[patch]], axis=-1)
    low, high = theirs[:, None, None, 0], theirs[:, None, None, -1]
    inside = strips.inside.copy()
    inside[split] &= ~np.all((pixel >= low) & (pixel <= high), axis=-1)
    return replace(strips, inside=inside)
