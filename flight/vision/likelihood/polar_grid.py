"""The frame on circles about the axis of rotation: there every streak is straight and equally long."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from flight.arrays import BoolArray, FloatArray, IntArray
from flight.pinhole import Pinhole
from flight.vision.likelihood.exposed_frame import Float32Array
from flight.vision.likelihood.motion import Motion

ACROSS = 1.8
"""Spacing of the circles, px."""

# Spacing of the samples along them, px.
_ALONG = 4.0
# Circles worked on at a time, so that they stay in the processor's cache.
_CHUNK = 64
_NEAREST = 0.003
# Pixels to a side of what is summed for a sample.
_BOX = 3.0


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
    """Return the circles that cross the detector, `every` so many of them."""
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


@dataclass(frozen=True, slots=True, eq=False)
class RunningSums:
    """Samples summed over a streak's length.

    Attributes:
        light: (r, c) counts; count: (r, c) how many samples exist.
        span: (r, 2) between which columns a circle's samples exist; without bounds where not in one piece.
        excess: (r,) by what factor noise exceeds that of samples which share no pixels.
    """

    light: Float32Array
    count: IntArray
    span: FloatArray
    excess: FloatArray


def running_sums(sums: Float32Array, pinhole: Pinhole, grid: PolarGrid, unit: float) -> RunningSums:
    """Return the running sums of samples of `sums` within half a streak.

    `sums` is zero along the border, where all that is outside is sampled; it is rounded to `unit` counts.
    """
    width = max(round(grid.length), 1)
    before, after = width // 2, width - width // 2
    shape = len(grid.polar), len(grid.azimuth)
    response, count = np.empty(shape, dtype=np.float32), np.empty(shape, dtype=np.int64)
    span = np.tile([-np.inf, np.inf], (shape[0], 1))
    # Samples, and whether they exist, with room for half a streak to either side.
    padded = np.zeros((2, _CHUNK, shape[1] + width + 1), dtype=np.int64)
    middle = slice(before + 1, before + 1 + shape[1])
    total = np.empty_like(padded)
    for part, samples, inside in _sampled(sums, pinhole, grid, unit):
        rows = len(samples)
        padded[0, :rows, middle] = samples
        padded[1, :rows, middle] = inside
        if grid.full:
            padded[:, :, : before + 1] = padded[:, :, shape[1] : shape[1] + before + 1]
            padded[:, :, middle.stop :] = padded[:, :, before + 1 : before + 1 + after]
        np.cumsum(padded, axis=2, out=total)
        held = total[:, :rows, width : width + shape[1]] - total[:, :rows, : shape[1]]
        np.multiply(held[0], unit, out=response[part], casting="same_kind")
        count[part] = held[1]
        first, last = inside.argmax(axis=1), shape[1] - 1 - inside[:, ::-1].argmax(axis=1)
        whole = inside.sum(axis=1) == last - first + 1
        # An even number of samples is not about its middle one, but half a sample before it.
        edges = np.stack([first - 0.5, last + 0.5], axis=1) + grid.off_centre
        span[part] = np.where(whole[:, None], edges, span[part])
    return RunningSums(response, count, span, _excess(grid, width))


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


def totals(sums: Float32Array, pinhole: Pinhole, grid: PolarGrid) -> Float32Array:
    """Return the totals (r, c + 1) of the samples of `sums` before each sample of a circle."""
    out = np.zeros((len(grid.polar), len(grid.azimuth) + 1), dtype=np.float32)
    for part, samples, _ in _sampled(sums, pinhole, grid, 1.0):
        out[part, 1:] = np.cumsum(samples, axis=1, dtype=np.float64)
    return out


def _sampled(
    sums: Float32Array, pinhole: Pinhole, grid: PolarGrid, unit: float
) -> Iterator[tuple[slice, Float32Array, BoolArray]]:
    """Yield some circles after others: their samples in whole `unit`s, and which exist.

    Whole numbers add up several times faster than others, and exactly.
    """
    # Directions over the sine of the polar angle: one part for the azimuth, one for the circle.
    turning = grid.frame[:2].T @ np.stack([np.cos(grid.azimuth), np.sin(grid.azimuth)])
    rising = grid.frame[2][:, None] / np.tan(grid.polar)
    around, aloft = turning.astype(np.float32), rising.astype(np.float32)
    last = np.float32(pinhole.columns - 1), np.float32(pinhole.rows - 1)
    flat = sums.reshape(-1)
    for start in range(0, len(grid.polar), _CHUNK):
        part = slice(start, start + _CHUNK)
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
        yield part, np.rint(samples, out=samples), inside
