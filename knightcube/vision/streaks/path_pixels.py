"""Selection of the pixels near the paths of stars: strips along long streaks, and patches around spots.

A strip consists of parallel lines of pixels across the path of a star. A line of pixels across the path lies
in a column of the frame if the path runs mainly along rows, otherwise in a row. Ten neighbouring lines of
pixels form a block. The path of a star is divided into parts if it is long, and where its direction changes
from mainly along rows to mainly along columns. Each pixel is assigned to the nearest part of a path.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import BoolArray, Float32Array, FloatArray, IntArray
from knightcube.compiled import compiled_form_of
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks.geometry import CameraMotion, PointsAtLines, StarPaths, paths, positions

LINES = 10
"""Number of lines of pixels in one block. Each line crosses the path of the star."""

STEEPEST = 0.68
"""Minimum cosine between a path and the normal of a line of pixels, slightly below the cosine of 45 deg."""

# Largest camera rotation (rad) during one part of a path. Within a part, the column or the row of the star
# must change monotonically.
_LONGEST_ROTATION = 1.1
# Number of instants at which part of a path is evaluated to find where it crosses lines of pixels.
_SAMPLES = 17
# Ratio of a star's speeds along rows and along columns at which its path is divided into parts. If the ratio
# of the speeds were 1, the border between two parts could follow a diagonal of pixels, and all pixels of the
# diagonal would be omitted.
_DIAGONAL = 1.03
# Number of instants at which the direction of part of a path is evaluated.
_INSTANTS = 7
# Lower limit (px per exposure) of a star's speed, which avoids divisions by zero.
_SLOWEST = 1e-3
# Lower limit of the cosine of the angle between a path and the normal of a line of pixels beyond the end of
# the path.
_MOST_BENT = 0.5
# Width (px) of the gap between adjoining parts of a straight path. Pixels in the gap belong to neither part.
_SEAM = 0.003
# Increase of the gap width (px) between parts of a curved path, per cubed strip width and squared curvature.
_ARC = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class Strips:
    """Pixels near the paths of stars: b blocks, each of `LINES` lines of k pixels across the path.

    Attributes:
        star: index of the star of each block of pixels (b,), in ascending order.
        time: time at which the star crosses each line of pixels (b, LINES), relative to mid-exposure, in
            units of the exposure time.
        corner: column and row of the first pixel of each line of pixels, (b, LINES, 2) for b blocks.
        step: step in column and row from one pixel of a line to the next, (b, 2) for b blocks of lines.
        index: flat index in the frame of each of k pixels per line, (b, LINES, k), or 0 for a pixel that is
            not `inside`.
        inside: mask (b, LINES, k) of the pixels in the frame that are nearer to their block's part of the
            path than to other parts.
    """

    star: IntArray
    time: FloatArray
    corner: IntArray
    step: IntArray
    index: IntArray
    inside: BoolArray


def pixel_rows(corner: IntArray, step: IntArray, count: int) -> Float32Array:
    """Return the row indices (b, LINES, count) of the pixels on lines, see `Strips`."""
    return (corner[:, :, 1, None] + np.arange(count) * step[:, 1, None, None]).astype(np.float32)


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
    sampled = begin[:, None] + (end - begin)[:, None] * np.linspace(0.0, 1.0, _SAMPLES)
    place = positions(pinhole, motion, np.repeat(chosen, _SAMPLES, axis=0), sampled.reshape(-1))
    place = place.reshape(-1, _SAMPLES, 2)
    span = np.abs(place[:, -1] - place[:, 0])
    along_rows = span[:, 0] >= span[:, 1]
    major = np.where(along_rows[:, None], place[:, :, 0], place[:, :, 1])
    size = np.where(along_rows, pinhole.columns, pinhole.rows)
    first = np.maximum(np.ceil(major.min(axis=1)), 0).astype(np.int64)
    last = np.minimum(np.floor(major.max(axis=1)), size - 1).astype(np.int64)
    count = np.maximum(last - first + 1, 0)
    blocks = -(-count // LINES)
    owner = np.repeat(np.arange(len(part)), blocks)
    number = np.arange(len(owner)) - np.repeat(np.cumsum(blocks) - blocks, blocks)
    line = first[owner, None] + number[:, None] * LINES + np.arange(LINES)
    real = line <= last[owner, None]
    time = _crossings(major, sampled, line, owner)
    path = paths(pinhole, motion, np.repeat(stars[part[owner]], LINES, axis=0), time.reshape(-1))
    return _pixels(
        pinhole,
        _Lines(part[owner], owner, line, time, real, along_rows[owner]),
        path,
        width,
        (low, high, outer),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Lines:
    """Lines of pixels across star paths, in b blocks that each belong to one part of the path of one star."""

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
    pieces = max(
        1, math.ceil(turned * float(np.max(times[:, 1] - times[:, 0], initial=0.0)) / _LONGEST_ROTATION)
    )
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
    instants = low[:, None] + (high - low)[:, None] * np.linspace(0.0, 1.0, _INSTANTS)
    path = paths(pinhole, motion, np.repeat(stars, _INSTANTS, axis=0), instants.reshape(-1))
    way = np.abs(path.velocity.reshape(-1, _INSTANTS, 2))
    major = way.sum(axis=1).argmax(axis=1)[:, None]
    steep = np.where(major, way[..., 1], way[..., 0]) < STEEPEST * np.hypot(way[..., 0], way[..., 1])
    divided = np.flatnonzero(steep.any(axis=1))
    excess = way[divided, :, 0] - _DIAGONAL * way[divided, :, 1]
    which, before = np.nonzero((excess[:, 1:] < 0.0) != (excess[:, :-1] < 0.0))
    first, last = excess[which, before], excess[which, before + 1]
    which = divided[which]
    begin, end = instants[which, before], instants[which, before + 1]
    return which, begin + (end - begin) * first / (first - last)


def _crossings(major: FloatArray, sampled: FloatArray, line: IntArray, owner: IntArray) -> FloatArray:
    """Return approximate times at which paths cross lines of pixels (`line`, (b, LINES))."""
    falling = major[:, -1] < major[:, 0]
    major = np.where(falling[:, None], major[:, ::-1], major)
    sampled = np.where(falling[:, None], sampled[:, ::-1], sampled)
    within = np.clip(line, major[owner, :1], major[owner, -1:])
    # The coordinates of successive parts are shifted to separate intervals, so that one call interpolates all
    # parts.
    begin = np.arange(len(major)) * (float(np.ptp(major)) + 1.0 if major.size else 1.0)
    at = (within + begin[owner, None]).reshape(-1)
    times = np.interp(at, (major + begin[:, None]).reshape(-1), sampled.reshape(-1)) if len(at) else at
    return np.asarray(times.reshape(line.shape))


def _pixels(
    pinhole: Pinhole,
    lines: _Lines,
    path: StarPaths,
    width: float,
    parts: tuple[FloatArray, FloatArray, BoolArray],
) -> Strips:
    """Return the pixel strips formed by `lines`, which cross the paths at the points `path` (b * LINES)."""
    along, shape = lines.along_rows, lines.line.shape
    points = path.at_lines(shape)
    bounds = (np.ascontiguousarray(parts[0]), np.ascontiguousarray(parts[1]), parts[2])
    size = (pinhole.columns, pinhole.rows)
    corner, half = _first_pixels(points, lines.line, lines.real, along, width)
    within = np.empty((*shape, 2 * half + 1), dtype=np.bool_)
    crossing = lines.line, lines.real, lines.time, lines.part, along
    _select_pixels(within, corner, points, *crossing, bounds, size, float(width))
    # Blocks of lines without any usable pixel are dropped.
    crossed = np.flatnonzero(within.any(axis=(0, 1)))
    used = np.flatnonzero(within.any(axis=(1, 2)))
    begin, end = (int(crossed[0]), int(crossed[-1]) + 1) if len(crossed) else (0, 0)
    inside = np.ascontiguousarray(within[used, :, begin:end])
    step = np.where(along[used, None], [[0, 1]], [[1, 0]])
    corner = corner[used] + begin * step[:, None]
    first = corner[..., 1] * pinhole.columns + corner[..., 0]
    next_pixel = (step[:, 1] * pinhole.columns + step[:, 0])[:, None, None]
    index = first[..., None] + np.arange(end - begin) * next_pixel
    index *= inside
    return Strips(lines.star[used], lines.time[used], corner, step, index, inside)


def _first_pixels(
    points: PointsAtLines, line: IntArray, real: BoolArray, along_rows: BoolArray, width: float
) -> tuple[IntArray, int]:
    """Return the first pixel (b, LINES, 2) of each line, and the number of pixels before the path."""
    along = along_rows[:, None]
    position, velocity, _ = points
    tangent = np.where(along, *velocity) / np.maximum(np.hypot(*velocity), _SLOWEST)
    steep = np.maximum(np.abs(tangent), _MOST_BENT)
    half = math.ceil(float(np.max(np.where(real, width / steep, 0.0), initial=0.0)))
    minor = np.rint(np.where(along, position[1], position[0])).astype(np.int64) - half
    return np.stack([np.where(along, line, minor), np.where(along, minor, line)], axis=-1), half


def _select_pixels_numpy(
    within: BoolArray,
    corner: IntArray,
    points: PointsAtLines,
    line: IntArray,
    real: BoolArray,
    time: FloatArray,
    part: IntArray,
    along_rows: BoolArray,
    bounds: tuple[FloatArray, FloatArray, BoolArray],
    size: tuple[int, int],
    width: float,
) -> None:
    """Compute the mask `within` (b, LINES, k) of pixels that are nearest to the path part of their block.

    The `bounds` of all parts are start time, end time, and a mask (.., 2) of times that are streak ends. The
    other arguments are those of `_Lines`, and `size` contains the numbers of columns and rows of the frame.
    """
    along, (low, high, outer) = along_rows[:, None], bounds
    position, velocity, bent = points
    speed = np.maximum(np.hypot(velocity[0], velocity[1]), _SLOWEST)
    tangent = velocity / speed
    bend = (bent[1] * tangent[0] - bent[0] * tangent[1]) / speed**2
    step = np.where(along, [[0, 1]], [[1, 0]])
    count = within.shape[2]
    aside, ahead = path_distances(
        corner, step, position.transpose(1, 2, 0), tangent.transpose(1, 2, 0), count
    )
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
    minor, limit = np.where(along, corner[..., 1], corner[..., 0]), np.where(along, size[1], size[0])
    chosen = np.abs(aside, out=aside) <= np.float32(width)
    chosen &= foot >= start.astype(np.float32)
    chosen &= foot < stop.astype(np.float32)
    chosen &= offset >= np.where(real, -minor, count)
    chosen &= offset < limit - minor
    within[:] = chosen.transpose(1, 2, 0)


@compiled_form_of(_select_pixels_numpy)
def _select_pixels(
    within: BoolArray,
    corner: IntArray,
    points: PointsAtLines,
    line: IntArray,
    real: BoolArray,
    time: FloatArray,
    part: IntArray,
    along_rows: BoolArray,
    bounds: tuple[FloatArray, FloatArray, BoolArray],
    size: tuple[int, int],
    width: float,
) -> None:
    """See `_select_pixels_numpy`."""
    position, velocity, bent = points
    low, high, outer = bounds
    blocks, lines, count = within.shape
    for b in range(blocks):
        along, p = along_rows[b], part[b]
        limit = size[1] if along else size[0]
        for i in range(lines):
            speed = max(math.sqrt(velocity[0, b, i] ** 2 + velocity[1, b, i] ** 2), _SLOWEST)
            tx, ty = velocity[0, b, i] / speed, velocity[1, b, i] / speed
            bend = (bent[1, b, i] * tx - bent[0, b, i] * ty) / speed**2
            dx, dy = corner[b, i, 0] - position[0, b, i], corner[b, i, 1] - position[1, b, i]
            across, ahead = dy * tx - dx * ty, dx * tx + dy * ty
            by_across, by_ahead = (tx, ty) if along else (-ty, tx)
            seam, room = (_SEAM + _ARC * width**3 * bend * bend) / speed, width / speed
            start = low[p] + (-room if outer[p, 0] else seam) - time[b, i]
            stop = high[p] - (-room if outer[p, 1] else seam) - time[b, i]
            minor = corner[b, i, 1] if along else corner[b, i, 0]
            begin, end = max(0, -minor), min(count, limit - minor)
            if not real[b, i]:
                end = 0
            for k in range(count):
                aside, s = across + k * by_across, ahead + k * by_ahead
                s /= max(1.0 - bend * aside, 0.5)
                aside -= 0.5 * bend * s * s
                near = abs(aside) <= width and start <= s / speed < stop
                within[b, i, k] = near and begin <= k < end


def path_distances(
    corner: IntArray, step: IntArray, position: FloatArray, tangent: FloatArray, count: int
) -> tuple[Float32Array, Float32Array]:
    """Return distances (px) across and along the path of `count` pixels on each of l lines, (count, b, l).

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
    return np.maximum(np.hypot(path.velocity[:, 0], path.velocity[:, 1]), _SLOWEST)


@dataclass(frozen=True, slots=True, eq=False)
class Patches:
    """Square patches of pixels around spots, which are short streaks or slow parts of streaks.

    Attributes:
        column: column indices in the frame of the p pixels along the side of each of n patches (n, p).
        row: row indices in the frame of the p pixels along the side of each of n patches (n, p).
        index: flat index in the frame of each pixel of n square patches (n, p, p), or 0 for a pixel that is
            not `inside`.
        inside: mask of the pixels of n square patches (n, p, p) that are in the frame.
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
