"""The frame on circles about the axis of rotation: there every streak is straight and equally long."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks.maximum_likelihood.exposed_frame import Float32Array
from knightcube.vision.streaks.maximum_likelihood.motion import Motion

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
