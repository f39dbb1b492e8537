"""The light of a long streak on the pixels about it, and how it changes with every parameter.

About a pixel the path is an arc: s along it, n across it, speed v. The light, per unit of the star's, is

    m = (1/v) g(n) [Phi((s - s0)/w) - Phi((s - s1)/w)] / sqrt(1 - k n),

with g a Gaussian of width w, k the arc's curvature, s0 and s1 where the exposure begins and ends, which a
rolling shutter makes a matter of the pixel's row. The pixel's own square is in w, w^2 = sigma^2 + 1/12, and
its fourth cumulant, -1/120 along each axis, in a correction of the profile across. When a parameter
moves the path by c(t), the light changes by

    dm = c_n n/w^2 m + c_s(t1) e1 - c_s(t0) e0 - (dc_s/ds) m,

where e0 and e1 are the light per px of path at the two ends: seven images serve all parameters, each block of
pixels with its own coefficients. Where c_n changes along the path, the first moment of m about the block
serves.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks.frame import Float32Array
from knightcube.vision.streaks.geometry import (
    Motion,
    Paths,
    Shutter,
    moving,
    paths,
    positions,
    sensitivities,
    window_times,
)

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


# Gauss-Legendre nodes of a piece of the path: with one a width of the point spread it is exact to 1e-4.
_NODE, _WEIGHT = np.polynomial.legendre.leggauss(10)
_PIECE_WIDTHS = 8.0
# Widths beyond a patch from which light still reaches its pixels.
_BEYOND = 5.5
# Instants at which a path that is slow in places is looked at to divide it.
_SPOT_SAMPLES = 33
_SPOT_BELL = 1.0 / math.sqrt(2.0 * math.pi)


@dataclass(frozen=True, slots=True, eq=False)
class Patches:
    """Square patches of pixels about spots.

    Attributes:
        column, row: (n, p) of the pixels.
        index: (n, p, p) into the flat frame; clipped where not `inside`.
        inside: (n, p, p) whether the pixel exists.
    """

    column: IntArray
    row: IntArray
    index: IntArray
    inside: BoolArray


def cut_patches(pinhole: Pinhole, middles: FloatArray, half: int) -> Patches:
    """Return the pixels within `half` px, each way, of `middles` (n, 2) px."""
    corner = np.rint(middles).astype(np.int64)[:, :, None] + np.arange(-half, half + 1)
    column, row = corner[:, 0], corner[:, 1]
    inside = ((row >= 0) & (row < pinhole.rows))[:, :, None] & ((column >= 0) & (column < pinhole.columns))[
        :, None, :
    ]
    index = np.where(inside, row[:, :, None] * pinhole.columns + column[:, None, :], 0)
    return Patches(column, row, index, inside)


def derivatives(
    pinhole: Pinhole, motion: Motion, shutter: Shutter, stars: FloatArray, sigma: float, patches: Patches
) -> tuple[FloatArray, FloatArray]:
    """Return the light (n, p, p) of stars (n, 2), each of light 1, and (n, 9, p, p) its derivatives.

    By turn (3), growth (3), x, y, and `sigma` px of the point spread.
    """
    count = len(stars)
    if not count:
        return np.empty(patches.index.shape), np.empty((0, 9, *patches.index.shape[1:]))
    time, weight = _instants(pinhole, motion, shutter, stars, sigma, patches)
    instants = time.shape[1]
    repeated = np.repeat(stars, instants, axis=0)
    place = positions(pinhole, motion, repeated, time.reshape(-1)).reshape(count, instants, 2)
    change = sensitivities(pinhole, motion, repeated, time.reshape(-1)).reshape(count, instants, 2, 8)
    x, dx, sx = _profile(patches.column, place[..., 0], sigma)
    y, dy, sy = _profile(patches.row, place[..., 1], sigma)
    y, dy, sy = (weight[..., None] * part for part in (y, dy, sy))
    down = y.swapaxes(1, 2)
    light = down @ x
    out = np.empty((count, 9, *light.shape[1:]))
    for k in range(8):
        by_x, by_y = change[:, :, 0, k, None], change[:, :, 1, k, None]
        out[:, k] = down @ (by_x * dx) + (by_y * dy).swapaxes(1, 2) @ x
    out[:, 8] = down @ sx + sy.swapaxes(1, 2) @ x
    return light, out


def _instants(
    pinhole: Pinhole, motion: Motion, shutter: Shutter, stars: FloatArray, sigma: float, patches: Patches
) -> tuple[FloatArray, FloatArray]:
    """Return the times (n, m), in exposures, at which stars light their patches, and their weights (n, m)."""
    times = window_times(pinhole, motion, shutter, stars)
    edges = times
    if not motion.constant:
        edges = _pieces(pinhole, motion, stars, times, sigma, patches)
    middle, half = 0.5 * (edges[:, 1:] + edges[:, :-1]), 0.5 * np.diff(edges)
    time = middle[..., None] + half[..., None] * _NODE
    weight = half[..., None] * _WEIGHT
    return time.reshape(len(stars), -1), weight.reshape(len(stars), -1)


def _pieces(
    pinhole: Pinhole, motion: Motion, stars: FloatArray, times: FloatArray, sigma: float, patches: Patches
) -> FloatArray:
    """Return times (n, p + 1) that divide the paths, as far as their light falls on the patches, evenly."""
    n = len(stars)
    sampled = times[:, :1] + np.diff(times) * np.linspace(0.0, 1.0, _SPOT_SAMPLES)
    there = positions(pinhole, motion, np.repeat(stars, _SPOT_SAMPLES, axis=0), sampled.reshape(-1))
    there = there.reshape(n, _SPOT_SAMPLES, 2)
    room = _BEYOND * sigma
    low = np.stack([patches.column[:, 0], patches.row[:, 0]], axis=-1)[:, None] - room
    high = np.stack([patches.column[:, -1], patches.row[:, -1]], axis=-1)[:, None] + room
    near = np.all((there >= low) & (there <= high), axis=2)
    # A sample more on either side; a path that is never near keeps its whole.
    near |= np.pad(near, ((0, 0), (1, 0)))[:, :-1] | np.pad(near, ((0, 0), (0, 1)))[:, 1:]
    near |= ~near.any(axis=1, keepdims=True)
    step = np.hypot(*np.moveaxis(np.diff(there, axis=1), 2, 0)) * (near[:, 1:] & near[:, :-1])
    way = np.concatenate([np.zeros((n, 1)), np.cumsum(step, axis=1)], axis=1)
    count = max(1, math.ceil(float(way[:, -1].max()) / (_PIECE_WIDTHS * sigma)))
    first, last = near.argmax(axis=1), _SPOT_SAMPLES - 1 - near[:, ::-1].argmax(axis=1)
    share = np.linspace(0.0, 1.0, count + 1)
    out = np.empty((n, count + 1))
    for star in range(n):
        part = slice(first[star], last[star] + 1)
        # Evenly by path, where there is one, and a little by time.
        run = way[star, part] + 1e-6 * np.arange(last[star] + 1 - first[star])
        out[star] = np.interp(run[0] + share * (run[-1] - run[0]), run, sampled[star, part])
    return out


def _profile(pixels: IntArray, place: FloatArray, sigma: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the share (n, m, p) of points (n, m) on pixels (n, p), and its change by place and sigma."""
    right = (pixels[:, None, :] + 0.5 - place[..., None]) / sigma
    left = right - 1.0 / sigma
    bell_right = _SPOT_BELL * np.exp(-0.5 * right**2)
    bell_left = _SPOT_BELL * np.exp(-0.5 * left**2)
    share = ndtr(right) - ndtr(left)
    return share, (bell_left - bell_right) / sigma, (left * bell_left - right * bell_right) / sigma


IMAGES = 7
"""m, (n/w^2) m, its first moment along the path, e0, e1, dm/dw, 1."""

# Blocks are drawn in groups of this many, so that their pixels stay in the processor's cache.
_AT_ONCE = 256
_ENDS = 5.5
"""Widths from an end beyond which its profile is 0 or 1."""
_OBLIQUE = 7.0
"""Widths by which a pixel may lie ahead of where its line crosses the path."""
_STEP = 1e-4
_SLOWEST_LIGHT = 1e-3
_BELL = 1.0 / math.sqrt(2.0 * math.pi)
_KURTOSIS = -1.0 / 120.0


def images(
    pinhole: Pinhole,
    motion: Motion,
    shutter: Shutter,
    stars: FloatArray,
    width: float,
    strips: Strips,
    more: int = 0,
) -> Float32Array:
    """Return the images (b, IMAGES + more, LINES, k) of stars (n, 2), each of light 1, on their strips.

    `width` is w in px; this many `more` images are left for others to fill in.
    """
    shape = strips.time.shape
    path = paths(pinhole, motion, np.repeat(stars[strips.star], LINES, axis=0), strips.time.reshape(-1))
    velocity = path.velocity.reshape(*shape, 2)
    speed = np.maximum(np.hypot(velocity[..., 0], velocity[..., 1]), _SLOWEST_LIGHT)
    position, acceleration = path.position.reshape(*shape, 2), path.acceleration.reshape(*shape, 2)
    lines = position, velocity / speed[..., None], speed, acceleration
    out = np.empty((len(strips.star), IMAGES + more, *strips.index.shape[1:]), dtype=np.float32)
    for first in range(0, len(out), _AT_ONCE):
        part = slice(first, first + _AT_ONCE)
        _draw(out[part], strips, part, tuple(line[part] for line in lines), shutter, width)
    return out


def _draw(
    out: Float32Array,
    strips: Strips,
    part: slice,
    path: tuple[FloatArray, ...],
    shutter: Shutter,
    width: float,
) -> None:
    """Fill in the images of some blocks; `path`: position, tangent, speed and acceleration on their lines."""
    speed, time = path[2], strips.time[part]
    # By how much the speed along the path grows, px per exposure squared.
    gained = np.sum(path[3] * path[1], axis=-1)
    light, aside, s = _endless(strips, part, (*path, gained), out.shape[3], width)
    centre = time[:, LINES // 2 - 1 : LINES // 2 + 1].mean(axis=1, keepdims=True)
    s += ((time - centre) * speed).astype(np.float32)
    out[:, 0] = light.transpose(1, 2, 0)
    across, along = (np.ascontiguousarray(each.transpose(1, 2, 0)) for each in (aside, s))
    _ends(out, along, (time, centre, speed, gained), shutter, strips, part, width)
    light = out[:, 0]
    u = across * across
    u *= np.float32(1.0 / width**3)
    u -= np.float32(1.0 / width)
    u *= light
    out[:, 5] += u
    across *= np.float32(1.0 / width**2)
    np.multiply(across, light, out=out[:, 1])
    # The first moment of the light along the path, and the part that its ends cut off.
    along *= out[:, 1]
    across *= np.float32(width**2)
    across *= out[:, 3] - out[:, 4]
    np.add(along, across, out=out[:, 2])
    out[:, 6] = 1.0


def _endless(
    strips: Strips, part: slice, path: tuple[FloatArray, ...], count: int, width: float
) -> tuple[Float32Array, Float32Array, Float32Array]:
    """Return light of a path without ends, px beside it and px ahead on it, of some blocks' pixels.

    All are (count, b, LINES), `count` pixels a line.
    """
    position, tangent, speed, acceleration, gained = path
    tx, ty = tangent[..., 0], tangent[..., 1]
    bend = (acceleration[..., 1] * tx - acceleration[..., 0] * ty) / speed**2
    aside, ahead = beside(strips.corner[part], strips.step[part], position, tangent, count)
    squeeze = bend.astype(np.float32) * aside
    np.clip(squeeze, np.float32(-0.5), np.float32(0.5), out=squeeze)
    s = ahead / (np.float32(1.0) - squeeze)
    ahead *= (0.5 * bend).astype(np.float32)
    ahead *= s
    aside -= ahead
    u = aside * aside
    u *= np.float32(1.0 / width**2)
    light = np.multiply(u, np.float32(-0.5), out=ahead)
    np.exp(light, out=light)
    # Slower stretches are brighter; inside a bend light is denser.
    light *= np.float32(1.0) + squeeze * (np.float32(0.5) + np.float32(0.375) * squeeze)
    light *= np.float32(1.0) - s * (gained / speed**2).astype(np.float32)
    scale = _BELL / (width * speed)
    # The fourth powers of the tangent's components, whose squares add up to one.
    square = scale * (_KURTOSIS / (24.0 * width**4)) * (1.0 - 2.0 * np.square(tx * ty))
    u = (u - np.float32(6.0)) * u
    u *= square.astype(np.float32)
    u += (scale + 3.0 * square).astype(np.float32)
    light *= u
    return light, aside, s


def _ends(
    out: Float32Array,
    along: Float32Array,
    lines: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    shutter: Shutter,
    strips: Strips,
    part: slice,
    width: float,
) -> None:
    """Cut the light in `out[:, 0]` at both ends of the exposure, and fill in what changes with them.

    `along` (b, LINES, k) px from where the path is at the blocks' middle; `lines`: when it crosses each line
    (b, LINES), when at the middle (b, 1), its speed on each, and by how much that grows.
    """
    out[:, 3:6] = 0.0
    crossing, centre, speed, gained = lines
    rolling = shutter.delay_per_row != 0.0
    delay = shutter.delay(strips.rows(part)[..., [0, -1]]) if rolling else np.zeros(2)
    for end, image in ((-0.5, 3), (0.5, 4)):
        sign = -1.0 if end > 0.0 else 1.0
        closest = sign * (crossing - end) - np.max(sign * delay, axis=-1)
        near = np.flatnonzero((closest * speed < (_ENDS + _OBLIQUE) * width).any(axis=1))
        if not near.size:
            continue
        u = along[near]
        before_end = crossing[near] - end
        u += _wide((centre[near] - end) * speed[near] - 0.5 * gained[near] * before_end**2)
        if rolling:
            # A row-dependent end is a slanted cut of the path: the pixel's window is exact, row by row.
            u -= shutter.delay(strips.rows(near + part.start)) * _wide(speed[near])
        u *= np.float32(sign / width)
        bell = u * u
        bell *= np.float32(-0.5)
        np.exp(bell, out=bell)
        bell *= np.float32(_BELL / width)
        before = out[near, 0]
        bell *= before
        out[near, image] = bell
        out[near, 0] = before * ndtr(u)
        # Light is denser where the star is slower: the end cuts off more of it, or less.
        thinning = gained[near] / speed[near] ** 2
        out[near, 0] -= _wide(sign * width**2 * thinning) * bell
        bell *= u
        out[near, 5] -= bell


def _wide(line: FloatArray) -> Float32Array:
    """Return a number of each line (b, l) for all its pixels."""
    return line[..., None].astype(np.float32)


def coefficients(
    pinhole: Pinhole,
    motion: Motion,
    shutter: Shutter,
    stars: FloatArray,
    strips: Strips,
    growing: bool = True,
) -> FloatArray:
    """Return (b, IMAGES, 8) which makes the images d(light)/d(turn, growth, x, y) of a star of light 1.

    The columns of the growth are zero unless `growing`.
    """
    centre = strips.time[:, LINES // 2 - 1 : LINES // 2 + 1].mean(axis=1)
    of_block = stars[strips.star]
    # Each star has its two ends, or each block, where the shutter's delay differs from row to row.
    delay = np.zeros(len(stars))
    ending, spread = stars, strips.star
    if shutter.delay_per_row != 0.0:
        rows = strips.rows(slice(None))[:, LINES // 2].mean(axis=1).astype(np.float64)
        delay, ending, spread = np.asarray(shutter.delay(rows)), of_block, np.arange(len(centre))
    times = (centre - _STEP, centre + _STEP, delay - 0.5, delay + 0.5)
    shift, side, speed = _moved(
        pinhole,
        motion,
        np.concatenate([of_block, of_block, ending, ending]),
        np.concatenate(times),
        growing,
    )
    cuts = np.cumsum([len(part) for part in times])[:-1]
    shift_a, shift_b, shift_first, shift_last = np.split(shift, cuts)
    side_a, side_b, _, _ = np.split(side, cuts)
    _, fast, fast_first, fast_last = np.split(speed, cuts)
    out = np.zeros((len(centre), IMAGES, 8))
    out[:, 0] = (shift_a - shift_b) / (2.0 * _STEP)
    out[:, 1] = 0.5 * (side_a + side_b)
    out[:, 2] = (side_b - side_a) / (2.0 * _STEP * fast[:, None])
    out[:, 3] = -(shift_first * fast_first[:, None])[spread]
    out[:, 4] = (shift_last * fast_last[:, None])[spread]
    return out


def _moved(
    pinhole: Pinhole, motion: Motion, stars: FloatArray, time: FloatArray, growing: bool
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return how each parameter moves points along the path, in exposures, and across, px; and the speed."""
    change, velocity = moving(pinhole, motion, stars, time, growing)
    speed = np.maximum(np.hypot(velocity[:, 0], velocity[:, 1]), _SLOWEST_LIGHT)
    tx, ty = (velocity / speed[:, None]).T[:, :, None]
    along = change[:, 0] * tx + change[:, 1] * ty
    return along / speed[:, None], change[:, 1] * tx - change[:, 0] * ty, speed
