"""Local level and noise of a frame, and whether the frame can be looked at at all.

The thesis thresholds at the image's mean, which passes half of all pixels once there is noise (errata,
chapter 3); level and noise are taken here block by block from clipped moments of a sub-sample, so that
streaks, a slow gradient of stray light and hot pixels hardly move them.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from flight.gnc.math.arrays import BoolArray, FloatArray, Image

# The standard deviation of a normal variable cut at 3 sigma is 0.98658 of the uncut one.
_CLIP = 3.0
_CLIPPED_SIGMA = 0.98658
_MAD_TO_SIGMA = 1.4826
# Rounding to whole counts adds 1/12 count^2; where it hides all other noise it is the noise.
_ROUNDING_VARIANCE = 1.0 / 12.0
# A living sensor differs from one single value in more pixels than this; a dead one may have hot pixels.
_DEAD_FRACTION = 1e-4


class FrameState(Enum):
    """Whether a frame holds a scene: `usable`, or why not."""

    USABLE = "usable"
    BLACK = "black"
    SATURATED = "saturated"


@dataclass(frozen=True, slots=True)
class Background:
    """Level and noise (block rows, block columns) in counts on a regular grid over a frame of `shape`."""

    level: FloatArray
    noise: FloatArray
    shape: tuple[int, int]

    def map(self, grid: FloatArray) -> Image:
        """Return the block values `grid` interpolated bilinearly to every pixel: float32 of `shape`."""
        down = _interpolation(self.shape[0], grid.shape[0])
        across = _interpolation(self.shape[1], grid.shape[1])
        return np.asarray((down @ grid.astype(np.float32)) @ across.T)


def saturation_level(pixels: Image, level: float | None) -> float:
    """Return the count at which pixels clip: `level`, or the top of an unsigned integer type when None."""
    return float(np.iinfo(pixels.dtype).max) if level is None else level


def frame_state(pixels: Image, saturation: float, saturated_fraction: float) -> FrameState:
    """Tell a dead frame (one value everywhere) and an overexposed one from a frame worth processing.

    Saturated: at least `saturated_fraction` of the pixels (rows, columns) stand at `saturation` counts or
    above.
    """
    if np.count_nonzero(at_least(pixels, saturation)) >= saturated_fraction * pixels.size:
        return FrameState.SATURATED
    # Of the frame's own type: to compare whole numbers takes a quarter of the time.
    usual = np.median(pixels[::8, ::8]).astype(pixels.dtype)
    if np.count_nonzero(pixels != usual) <= _DEAD_FRACTION * pixels.size:
        return FrameState.BLACK
    return FrameState.USABLE


def at_least(pixels: Image, level: float) -> BoolArray:
    """Tell which `pixels`, of an unsigned integer type, stand at `level` counts or above."""
    if not np.issubdtype(pixels.dtype, np.integer) or not 0.0 <= level <= np.iinfo(pixels.dtype).max:
        return np.asarray(pixels >= level)
    return np.asarray(pixels >= pixels.dtype.type(np.ceil(level)))


def estimate_background(pixels: Image, block: int = 64, stride: int = 4) -> Background:
    """Return level and noise of `pixels` (rows, columns) in blocks of about `block` x `block` pixels.

    Every `stride`-th pixel each way is looked at: with the defaults 256 a block, so the level is known to
    0.06 and the noise to 0.05 of the noise. A block that a bright object fills takes its neighbours' noise
    (3 x 3 median).
    """
    from scipy import ndimage  # noqa: PLC0415 - a process that only names the estimators need not hold it

    rows, columns = pixels.shape
    down, across = max(1, rows // block), max(1, columns // block)
    height, width = rows // down, columns // across
    sample = pixels[: down * height, : across * width].reshape(down, height, across, width)
    sample = sample[:, stride // 2 :: stride, :, stride // 2 :: stride].transpose(0, 2, 1, 3)
    values = sample.reshape(down, across, -1).astype(np.float64)
    median = np.median(values, axis=-1, keepdims=True)
    spread = _MAD_TO_SIGMA * np.median(np.abs(values - median), axis=-1, keepdims=True)
    # Coarse quantisation can make the median deviation zero: one count is the least clip that keeps both
    # neighbours.
    kept = np.abs(values - median) <= _CLIP * np.maximum(spread, 0.5)
    count = kept.sum(axis=-1)
    level = np.where(kept, values, 0.0).sum(axis=-1) / count
    variance = np.where(kept, (values - level[..., None]) ** 2, 0.0).sum(axis=-1) / count
    noise = np.sqrt(np.maximum(variance / _CLIPPED_SIGMA**2, _ROUNDING_VARIANCE))
    return Background(level, ndimage.median_filter(noise, size=3, mode="nearest"), (rows, columns))


def _interpolation(pixels: int, blocks: int) -> Image:
    """Return the weights (pixels, blocks) that interpolate between block centres, flat beyond the last."""
    width = pixels // blocks
    position = np.clip((np.arange(pixels) - 0.5 * (width - 1)) / width, 0.0, blocks - 1.0)
    left = np.minimum(position.astype(np.int64), max(blocks - 2, 0))
    right = np.minimum(left + 1, blocks - 1)
    fraction = position - left
    weights = np.zeros((pixels, blocks), dtype=np.float32)
    np.add.at(weights, (np.arange(pixels), left), 1.0 - fraction)
    np.add.at(weights, (np.arange(pixels), right), fraction)
    return weights
