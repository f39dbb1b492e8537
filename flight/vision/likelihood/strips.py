"""Which pixels a streak falls on: lines of pixels across its path.

A path that runs more along the rows of the frame than across them is cut column by column, any other row by
row; each line holds the pixels about its crossing. Ten lines make a block, over which the motion's
sensitivity is linear. Long turns are divided in time, each part keeping the pixels nearest to it. The pixels
stay as the fit moves; only their distances from the path are computed again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from flight.arrays import BoolArray, FloatArray, IntArray
from flight.pinhole import Pinhole
from flight.vision.likelihood.motion import Motion, Paths, paths, positions

LINES = 10
"""Lines in a block."""

# A part of a path turns by no more than this, rad, so that it stays monotonic along its major axis.
_LONGEST_TURN = 0.6
_SAMPLES = 17
_SLOWEST = 1e-3
# How exactly, px, two parts agree on which of them a pixel is nearest to.
_SEAM = 0.03


@dataclass(frozen=True, slots=True, eq=False)
class Strips:
    """The pixels about the paths of `count` stars: `b` blocks of `LINES` lines of `k` pixels.

    Attributes:
        count: stars.
        star: (b,) which star a block is of, ascending.
        time: (b, LINES) at which the path crosses the line, exposures.
        column, row: (b, LINES, 1) or (b, LINES, k) of the pixels, float32.
        index: (b, LINES, k) into the flat frame; clipped where not `inside`.
        inside: (b, LINES, k) whether the pixel exists and is nearest to this part of the path.
    """

    count: int
    star: IntArray
    time: FloatArray
    column: npt.NDArray[np.float32]
    row: npt.NDArray[np.float32]
    index: IntArray
    inside: BoolArray


def cut_strips(
    pinhole: Pinhole, motion: Motion, stars: FloatArray, times: FloatArray, width: float
) -> Strips:
    """Return the pixels within `width` px of the paths of stars (n, 2) between `times` (n, 2), exposures."""
    part, low, high, outer = _parts(motion, times)
    reach = 1.45 * width + 1.0
    begin = low - reach / _speed(paths(pinhole, motion, stars[part], low))
    end = high + reach / _speed(paths(pinhole, motion, stars[part], high))
    sampled = begin[:, None] + (end - begin)[:, None] * np.linspace(0.0, 1.0, _SAMPLES)
    there = positions(pinhole, motion, np.repeat(stars[part], _SAMPLES, axis=0), sampled.reshape(-1))
    place = there.reshape(-1, _SAMPLES, 2)
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


@dataclass(frozen=True, slots=True, eq=False)
class _Lines:
    star: IntArray
    part: IntArray
    line: IntArray
    time: FloatArray
    real: BoolArray
    along_rows: BoolArray


def _parts(motion: Motion, times: FloatArray) -> tuple[IntArray, FloatArray, FloatArray, BoolArray]:
    """Return the parts' stars, start and end times, and which of those two are ends of the path (.., 2)."""
    turned = float(np.linalg.norm(motion.turn)) + float(np.linalg.norm(motion.growth))
    pieces = max(1, math.ceil(turned * float(np.max(times[:, 1] - times[:, 0], initial=0.0)) / _LONGEST_TURN))
    edges = times[:, :1] + (times[:, 1:] - times[:, :1]) * np.linspace(0.0, 1.0, pieces + 1)
    part = np.repeat(np.arange(len(times)), pieces)
    outer = np.zeros((len(times), pieces, 2), dtype=np.bool_)
    outer[:, 0, 0] = outer[:, -1, 1] = True
    return part, edges[:, :-1].reshape(-1), edges[:, 1:].reshape(-1), outer.reshape(-1, 2)


def _crossings(major: FloatArray, sampled: FloatArray, line: IntArray, owner: IntArray) -> FloatArray:
    """Return roughly when the paths cross `line` (b, LINES); the model takes care of what is left."""
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
    crossing = np.where(along, position[..., 1], position[..., 0])
    steep = np.maximum(np.abs(np.where(along, tangent[..., 0], tangent[..., 1])), 0.2)
    half = math.ceil(float(np.max(np.where(lines.real, width / steep, 0.0), initial=0.0)))
    minor = np.rint(crossing).astype(np.int64)[..., None] + np.arange(-half, half + 1)
    wide = along[..., None]
    line = lines.line[..., None]
    limit = np.where(wide, pinhole.rows, pinhole.columns)
    column, row = np.where(wide, line, minor), np.where(wide, minor, line)
    # Distances are wanted to a hundredth of a px.
    here, way, pace = (np.asarray(part, dtype=np.float32) for part in (position, tangent, speed))
    dx, dy = column.astype(np.float32) - here[..., :1], row.astype(np.float32) - here[..., 1:]
    aside = dy * way[..., :1] - dx * way[..., 1:]
    bent = path.acceleration.reshape(*shape, 2).astype(np.float32)
    bend = (bent[..., 1] * way[..., 0] - bent[..., 0] * way[..., 1]) / pace**2
    ahead = (dx * way[..., :1] + dy * way[..., 1:]) / np.maximum(1.0 - bend[..., None] * aside, 0.5)
    foot = lines.time[..., None].astype(np.float32) + ahead / pace[..., None]
    across = np.abs(aside - 0.5 * bend[..., None] * ahead**2)
    room = width / pace[..., None]
    start, stop = low[lines.part][:, None, None], high[lines.part][:, None, None]
    open_start, open_stop = outer[lines.part, 0][:, None, None], outer[lines.part, 1][:, None, None]
    inside = lines.real[..., None] & (minor >= 0) & (minor < limit) & (across <= width)
    # Between two parts a pixel may be lost, but none is counted twice.
    seam = _SEAM / pace[..., None]
    inside &= foot >= start + np.where(open_start, -room, seam)
    inside &= foot < stop - np.where(open_stop, -room, seam)
    used = inside.any(axis=(1, 2))
    index = np.where(inside, row * pinhole.columns + column, 0)
    return Strips(
        count,
        lines.star[used],
        lines.time[used],
        column[used].astype(np.float32),
        row[used].astype(np.float32),
        index[used],
        inside[used],
    )


def _speed(path: Paths) -> FloatArray:
    return np.maximum(np.hypot(path.velocity[:, 0], path.velocity[:, 1]), _SLOWEST)
