"""Local background level and noise of a frame, and the sums of its light over 3 x 3 pixels.

The thesis thresholds at the image's mean, which half of all pixels exceed once there is noise (errata,
chapter 3). Here level and noise are clipped moments of a sub-sample of each block of pixels, so that streaks,
a slow gradient of stray light and hot pixels hardly change them. The sum over 3 x 3 pixels is nearly the
matched filter of a star that is one pixel wide.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray, Image, IntArray

# The standard deviation of a normal variable cut at 3 sigma is 0.98658 of the uncut one.
_CLIP = 3.0
_CLIPPED_SIGMA = 0.98658
MAD_TO_SIGMA = 1.4826
"""Ratio of the standard deviation of a normal variable to its median absolute deviation."""
# Rounding to whole counts adds 1/12 count^2; where it hides all other noise it is the noise.
_ROUNDING_VARIANCE = 1.0 / 12.0


@dataclass(frozen=True, slots=True)
class Background:
    """Level and noise (block rows, block columns) in counts on a regular grid over a frame of `shape`."""

    level: FloatArray
    noise: FloatArray
    shape: tuple[int, int]

    @property
    def typical_level(self) -> float:
        """The median level, counts."""
        return float(np.median(self.level))

    @property
    def typical_noise(self) -> float:
        """The median noise, counts."""
        return float(np.median(self.noise))

    def map(self, grid: FloatArray) -> Image:
        """Return the block values `grid` interpolated bilinearly to every pixel: float32 of `shape`."""
        down, across = (
            interpolation_weights(pixels, blocks).astype(np.float32)
            for pixels, blocks in zip(self.shape, grid.shape, strict=True)
        )
        return np.asarray((down @ grid.astype(np.float32)) @ across.T)


def estimate_background(pixels: Image, block: int = 64, stride: int = 4) -> Background:
    """Return level and noise of `pixels` (rows, columns) in blocks of about `block` x `block` pixels.

    Every `stride`-th pixel each way is used: with the defaults 256 a block, so the level is known to 0.06 and
    the noise to 0.05 of the noise. A block that a bright object fills takes its neighbours' noise
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
    spread = MAD_TO_SIGMA * np.median(np.abs(values - median), axis=-1, keepdims=True)
    # Coarse quantisation can make the median deviation zero: one count is the least clip that keeps both
    # neighbours.
    kept = np.abs(values - median) <= _CLIP * np.maximum(spread, 0.5)
    count = kept.sum(axis=-1)
    level = np.where(kept, values, 0.0).sum(axis=-1) / count
    variance = np.where(kept, (values - level[..., None]) ** 2, 0.0).sum(axis=-1) / count
    noise = np.sqrt(np.maximum(variance / _CLIPPED_SIGMA**2, _ROUNDING_VARIANCE))
    return Background(level, ndimage.median_filter(noise, size=3, mode="nearest"), (rows, columns))


def place_among_blocks(pixel: FloatArray, pixels: int, blocks: int) -> tuple[IntArray, FloatArray]:
    """Return the block (n,) whose centre is before `pixel` (n,), and the share (n,) of the way to the next.

    A side of `pixels` is divided into equal `blocks`; beyond the outermost centres the place is theirs.
    """
    width = pixels // blocks
    place = np.clip((pixel - 0.5 * (width - 1)) / width, 0.0, blocks - 1.0)
    first = place.astype(np.int64)
    return first, place - first


def interpolation_weights(pixels: int, blocks: int) -> FloatArray:
    """Return the weights (pixels, blocks) that interpolate between block centres, flat beyond the last."""
    first, share = place_among_blocks(np.arange(pixels, dtype=float), pixels, blocks)
    weights = np.zeros((pixels, blocks))
    weights[np.arange(pixels), first] += 1.0 - share
    weights[np.arange(pixels), np.minimum(first + 1, blocks - 1)] += share
    return weights


# Pixels of a frame that are summed at a time.
_STRETCH = 32_768


def box_sum(image: Image) -> Image:
    """Return the sum over 3 x 3 pixels about each pixel of (rows, columns); the outermost are zero."""
    columns, flat = image.shape[1], np.ascontiguousarray(image).reshape(-1)
    total = np.empty(image.shape, dtype=image.dtype)
    sums = total.reshape(-1)
    # Rows run into each other, which only the outermost pixels see. A stretch that stays in the processor's
    # cache takes a third of the time of the whole frame at once.
    for start in range(columns + 1, flat.size - columns - 1, _STRETCH):
        stop = min(start + _STRETCH, flat.size - columns - 1)
        down = flat[start - columns - 1 : stop - columns + 1] + flat[start - 1 : stop + 1]
        down += flat[start + columns - 1 : stop + columns + 1]
        inner = sums[start:stop]
        np.add(down[:-2], down[1:-1], out=inner)
        inner += down[2:]
    total[[0, -1]] = 0
    total[:, [0, -1]] = 0
    return total


def less_boxes(sums: Image, shape: tuple[int, int], pixels: IntArray, taken: Image) -> Image:
    """Return the flat `sums` over 3 x 3 pixels of a frame of `shape` from which light was `taken`.

    `pixels` (m,) are flat, no one twice; `taken` (m,) is their light.
    """
    out, (rows, columns) = sums.copy(), shape
    for down in (-columns, 0, columns):
        for beside in (-1, 0, 1):
            # Sums that run over the frame's edge end on its outermost pixels, which are zero.
            out[np.clip(pixels + (down + beside), 0, out.size - 1)] -= taken
    framed = out.reshape(rows, columns)
    framed[[0, -1]] = 0
    framed[:, [0, -1]] = 0
    return out
