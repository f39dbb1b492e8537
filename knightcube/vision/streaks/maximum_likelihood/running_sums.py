"""The frame's light summed along circles about the axis of rotation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from knightcube.astro.arrays import FloatArray
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks.maximum_likelihood.exposed_frame import Float32Array
from knightcube.vision.streaks.maximum_likelihood.polar_grid import PolarGrid, sampled

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
