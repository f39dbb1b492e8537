"""Which pixels a streak falls on: lines of pixels across its path.

A path that runs more along the rows of the frame than across them is cut column by column, any other row by
row; each line holds the pixels about its crossing. Ten lines make a block, over which the motion's
sensitivity is linear. Long turns are divided in time, and where the path comes to run rather along the other
axis, each part keeping the pixels nearest to it. The pixels stay as the fit moves; only their distances from
the path are computed again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks.maximum_likelihood.exposed_frame import Float32Array
from knightcube.vision.streaks.maximum_likelihood.motion import Motion, Paths, paths, positions

LINES = 10
"""Lines in a block."""

STEEPEST = 0.68
"""No path crosses its lines more obliquely: cosine to their normal, a little below that of both diagonals."""

# A part of a path turns by this angle, rad, at most, so that it stays monotonic along its major axis.
_LONGEST_TURN = 1.1
_SAMPLES = 17
# Where a path is divided it runs by so much more along the rows than across them.
_DIAGONAL = 1.03
# Instants of a part at which its path's direction is taken.
_INSTANTS = 7
_SLOWEST = 1e-3
# A line within reach of a part, beyond its end, may be crossed as obliquely as this.
_MOST_BENT = 0.5
# How exactly, px, two parts of a straight path agree on which of them a pixel is nearest to; of a bent one
# less exactly, by this part of the third power of the width over the square of the radius.
_SEAM = 0.003
_ARC = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class Strips:
    """The pixels about the paths of `count` stars: `b` blocks of `LINES` lines of `k` pixels.

    Attributes:
        count: stars.
        star: (b,) which star a block is of, ascending.
        time: (b, LINES) at which the path crosses the line, exposures.
        corner: (b, LINES, 2) column and row of each line's first pixel; step: (b, 2) from pixel to pixel.
        index: (b, LINES, k) into the flat frame; clipped where not `inside`.
        inside: (b, LINES, k) whether the pixel exists and is nearest to this part of the path.
    """

    count: int
    star: IntArray
    time: FloatArray
    corner: IntArray
    step: IntArray
    index: IntArray
    inside: BoolArray

    def rows(self, of: IntArray | slice) -> Float32Array:
        """Return the rows (.., LINES, k) of the pixels of some blocks."""
        along = np.arange(self.index.shape[2]) * self.step[of, 1, None, None]
        return (self.corner[of, :, 1, None] + along).astype(np.float32)


def cut_strips(
    pinhole: Pinhole,
    motion: Motion,
    stars: FloatArray,
    times: FloatArray,
    width: float,
    ending: BoolArray | None = None,
) -> Strips:
    """Return the pixels within `width` px of the paths of stars (n, 2) between `times` (n, 2), exposures.

    `ending` (n, 2): which of the times are ends of the path, beyond which there are pixels too; by default
    all.
    """
    part, low, high, outer = _parts(pinhole, motion, stars, times)
    if ending is not None:
        outer &= ending[part]
    sampled, place = _extended(pinhole, motion, stars[part], (low, high), 1.45 * width + 1.0)
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
        (low, high, outer, len(stars)),
    )


def _extended(
    pinhole: Pinhole, motion: Motion, stars: FloatArray, times: tuple[FloatArray, FloatArray], reach: float
) -> tuple[FloatArray, FloatArray]:
    """Return times (n, s) from `reach` px before the paths to as far beyond, and places (n, s, 2)."""
    low, high = times
    begin = low - reach / _speed(paths(pinhole, motion, stars, low))
    end = high + reach / _speed(paths(pinhole, motion, stars, high))
    sampled = begin[:, None] + (end - begin)[:, None] * np.linspace(0.0, 1.0, _SAMPLES)
    there = positions(pinhole, motion, np.repeat(stars, _SAMPLES, axis=0), sampled.reshape(-1))
    return sampled, there.reshape(-1, _SAMPLES, 2)


@dataclass(frozen=True, slots=True, eq=False)
class _Lines:
    star: IntArray
    part: IntArray
    line: IntArray
    time: FloatArray
    real: BoolArray
    along_rows: BoolArray


def _parts(
    pinhole: Pinhole, motion: Motion, stars: FloatArray, times: FloatArray
) -> tuple[IntArray, FloatArray, FloatArray, BoolArray]:
    """Return the parts' stars, start and end times, and which of those two are ends of the path (.., 2)."""
    turned = float(np.linalg.norm(motion.whole)) + float(np.linalg.norm(motion.growth))
    pieces = max(1, math.ceil(turned * float(np.max(times[:, 1] - times[:, 0], initial=0.0)) / _LONGEST_TURN))
    edges = times[:, :1] + (times[:, 1:] - times[:, :1]) * np.linspace(0.0, 1.0, pieces + 1)
    edges[:, -1] = times[:, 1]  # exactly: a later test compares it
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
    pinhole: Pinhole, motion: Motion, stars: FloatArray, low: FloatArray, high: FloatArray
) -> tuple[IntArray, FloatArray]:
    """Return which parts (n,) to divide, and when: where they run as much along the rows as across them.

    Those that keep to one axis need it not; `stars` (n, 2) and `low` to `high` (n,) are the parts'.
    """
    instants = low[:, None] + (high - low)[:, None] * np.linspace(0.0, 1.0, _INSTANTS)
    path = paths(pinhole, motion, np.repeat(stars, _INSTANTS, axis=0), instants.reshape(-1))
    way = np.abs(path.velocity.reshape(-1, _INSTANTS, 2))
    major = way.sum(axis=1).argmax(axis=1)[:, None]
    steep = np.where(major, way[..., 1], way[..., 0]) < STEEPEST * np.hypot(way[..., 0], way[..., 1])
    divided = np.flatnonzero(steep.any(axis=1))
    # Not just at 45 deg: the seam would be along a diagonal of pixels, of which all might be lost.
    excess = way[divided, :, 0] - _DIAGONAL * way[divided, :, 1]
    which, before = np.nonzero((excess[:, 1:] < 0.0) != (excess[:, :-1] < 0.0))
    first, last = excess[which, before], excess[which, before + 1]
    which = divided[which]
    begin, end = instants[which, before], instants[which, before + 1]
    return which, begin + (end - begin) * first / (first - last)


def _crossings(major: FloatArray, sampled: FloatArray, line: IntArray, owner: IntArray) -> FloatArray:
    """Return roughly when the paths cross `line` (b, LINES); the model corrects the rest."""
    time = np.empty(line.shape)
    bounds = np.searchsorted(owner, np.arange(len(major) + 1))
    for part in range(len(major)):
        here = slice(bounds[part], bounds[part + 1])
        order = 1 if major[part, -1] >= major[part, 0] else -1
        time[here] = np.interp(line[here], major[part, ::order], sampled[part, ::order])
    return time


def _pixels(
    pinhole: Pinhole,
    lines: _Lines,
    path: Paths,
    width: float,
    parts: tuple[FloatArray, FloatArray, BoolArray, int],
) -> Strips:
    """Return the strips of `lines`, whose paths are at `path` (b * LINES)."""
    low, high, outer, count = parts
    shape = lines.line.shape
    along = lines.along_rows[:, None]
    position, velocity = path.position.reshape(*shape, 2), path.velocity.reshape(*shape, 2)
    speed = np.maximum(np.hypot(velocity[..., 0], velocity[..., 1]), _SLOWEST)
    tangent = velocity / speed[..., None]
    bent = path.acceleration.reshape(*shape, 2)
    bend = (bent[..., 1] * tangent[..., 0] - bent[..., 0] * tangent[..., 1]) / speed**2
    crossing = np.where(along, position[..., 1], position[..., 0])
    steep = np.maximum(np.abs(np.where(along, tangent[..., 0], tangent[..., 1])), _MOST_BENT)
    half = math.ceil(float(np.max(np.where(lines.real, width / steep, 0.0), initial=0.0)))
    minor = np.rint(crossing).astype(np.int64) - half
    corner = np.stack([np.where(along, lines.line, minor), np.where(along, minor, lines.line)], axis=-1)
    step = np.where(along, [[0, 1]], [[1, 0]])
    aside, ahead = beside(corner, step, position, tangent, 2 * half + 1)
    # Distances are wanted to a hundredth of a px.
    pace, curved = speed.astype(np.float32), bend.astype(np.float32)
    ahead /= np.maximum(np.float32(1.0) - curved * aside, np.float32(0.5))
    aside -= np.float32(0.5) * curved * ahead * ahead
    foot = np.divide(ahead, pace, out=ahead)
    foot += lines.time.astype(np.float32)
    # Between two parts a pixel may be lost, but none is counted twice.
    seam, room = (_SEAM + _ARC * width**3 * np.square(bend)) / speed, width / speed
    start = low[lines.part, None] + np.where(outer[lines.part, :1], -room, seam)
    stop = high[lines.part, None] - np.where(outer[lines.part, 1:], -room, seam)
    offset = np.arange(2 * half + 1)
    limit = np.where(along, pinhole.rows, pinhole.columns)
    within = np.abs(aside, out=aside) <= np.float32(width)
    within &= foot >= start.astype(np.float32)
    within &= foot < stop.astype(np.float32)
    within &= offset[:, None, None] >= np.where(lines.real, -minor, 2 * half + 1)
    within &= offset[:, None, None] < limit - minor
    return _cropped(lines, count, pinhole.columns, within, corner, step)


def _cropped(
    lines: _Lines, count: int, columns: int, within: BoolArray, corner: IntArray, step: IntArray
) -> Strips:
    """Return the strips with the blocks and pixels that `within` (k, b, LINES) needs."""
    crossed = np.flatnonzero(within.any(axis=(1, 2)))
    used = np.flatnonzero(within.any(axis=(0, 2)))
    begin, end = (int(crossed[0]), int(crossed[-1]) + 1) if len(crossed) else (0, 0)
    inside = np.ascontiguousarray(within[begin:end, used].transpose(1, 2, 0))
    corner, step = corner[used] + begin * step[used, None], step[used]
    first = corner[..., 1] * columns + corner[..., 0]
    next_pixel = (step[:, 1] * columns + step[:, 0])[:, None, None]
    index = first[..., None] + np.arange(end - begin) * next_pixel
    index *= inside
    return Strips(count, lines.star[used], lines.time[used], corner, step, index, inside)


def beside(
    corner: IntArray, step: IntArray, position: FloatArray, tangent: FloatArray, count: int
) -> tuple[Float32Array, Float32Array]:
    """Return how far the pixels of each line (b, l) lie beside their path and ahead on it, (count, b, l) px.

    `corner` and `step` as of `Strips`; `position`, `tangent` (b, l, 2) of the path on the line. Pixels come
    first: values of lines combine with all of them at the speed of long arrays.
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


def _speed(path: Paths) -> FloatArray:
    return np.maximum(np.hypot(path.velocity[:, 0], path.velocity[:, 1]), _SLOWEST)
