"""The sky background of a frame, its noise, and the pixels of the smoothed frame above it.

The smoothing kernel is [1 2 1] along rows and columns, nearly the matched filter for a star of sigma 0.7 to
1.5 px. The noise of the smoothed frame is measured in the smoothed frame: demosaicing and JPEG correlate
pixels, and a threshold derived from single pixels would pass thousands of peaks. The frame is processed in
bands of rows that fit into the processor cache; no second image of its size is allocated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from knightcube.astro.arrays import BoolArray, FloatArray, Image, IntArray
from knightcube.vision.frame.background import (
    MAD_TO_SIGMA,
    estimate_background,
    interpolation_weights,
    place_among_blocks,
)
from knightcube.vision.frame.regions import find_hot_pixels

Float32Array = npt.NDArray[np.float32]

KERNEL_NORM = 6.0
"""Noise of the smoothed frame for white noise of 1: the root of the sum of squares of the kernel."""
LEAST_SIDE = 16
# Noise (counts) to which a frame of floating-point numbers is scaled.
_FLOATING_NOISE = 16.0
_BAND = 32
_BLOCK, _STRIDE, _SINGLE_STRIDE = 64, 4, 8
_TAIL_PART = 0.97725
# Ratio below which a correlation of pixels is attributed to chance and to the faintest stars.
_CORRELATED = 1.05
# Ratio of the lower tail of the noise to two standard deviations, below which it is clipped at zero counts.
_CUT_OFF = 0.8
# Noise (counts) below which quantisation hides it.
_HIDDEN = 0.5
_ROUNDING = 12.0**-0.5


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """A surface over a frame of `shape`: `values` (down, across) at block centres, bilinear between them."""

    values: FloatArray
    shape: tuple[int, int]

    def at(self, column: npt.ArrayLike, row: npt.ArrayLike) -> FloatArray:
        """Return the values (n,) at pixels `column` (n,), `row` (n,)."""
        top, down = place_among_blocks(np.asarray(row, dtype=float), self.shape[0], self.values.shape[0])
        left, across = place_among_blocks(
            np.asarray(column, dtype=float), self.shape[1], self.values.shape[1]
        )
        bottom = np.minimum(top + 1, self.values.shape[0] - 1)
        right = np.minimum(left + 1, self.values.shape[1] - 1)
        high = self.values[top, left] * (1.0 - across) + self.values[top, right] * across
        low = self.values[bottom, left] * (1.0 - across) + self.values[bottom, right] * across
        return np.asarray(high * (1.0 - down) + low * down)

    def factors(self) -> tuple[Float32Array, Float32Array]:
        """Return (rows, down) and (down, columns), whose product is the whole frame."""
        down, across = (
            interpolation_weights(pixels, blocks)
            for pixels, blocks in zip(self.shape, self.values.shape, strict=True)
        )
        return down.astype(np.float32), (self.values @ across.T).astype(np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class Sky:
    """The sky background of a frame between its stars.

    Attributes:
        level, noise: background and noise of single pixels, counts; the noise includes faint stars.
        pixel_noise: noise of a pixel without a star, counts.
        smooth_level, smooth_noise: background and noise of the smoothed frame (kernel of sum 16), including
            faint stars.
        correlation: noise of a sum of pixels relative to that of independent pixels; 1 or more.
    """

    level: Surface
    noise: Surface
    pixel_noise: Surface
    smooth_level: Surface
    smooth_noise: Surface
    correlation: float


@dataclass(frozen=True, slots=True, eq=False)
class BrightPixels:
    """The pixels (m,) of the smoothed frame above the noise, row by row.

    Attributes:
        index: numbers of the pixels in the flattened frame, increasing.
        smooth: counts of the smoothed frame above its background.
        shape: rows and columns of the frame.
    """

    index: IntArray
    smooth: FloatArray
    shape: tuple[int, int]


def in_counts(pixels: Image) -> tuple[Image, float]:
    """Return `pixels` (rows, columns) scaled to counts, and the size of one count in the original unit.

    Integer frames are returned unchanged. Raises ValueError unless the frame is finite, of real numbers, and
    16 x 16 pixels or larger.
    """
    if pixels.ndim != 2 or min(pixels.shape) < LEAST_SIDE:
        raise ValueError(f"a frame of shape {pixels.shape}: give (rows, columns), {LEAST_SIDE} or more each")
    if pixels.dtype.kind not in "uif":
        raise ValueError(f"a frame of {pixels.dtype}: give integers or floating numbers")
    if pixels.dtype.kind != "f":
        return pixels, 1.0
    if not np.all(np.isfinite(pixels)):
        raise ValueError("a frame with pixels that are not finite")
    sample = pixels[::4, ::4].astype(float)
    spread = MAD_TO_SIGMA * float(np.median(np.abs(sample - np.median(sample))))
    spread = spread or float(sample.std()) or 1.0
    unit = spread / _FLOATING_NOISE
    return (pixels / unit).astype(np.float32), unit


def measure_sky(pixels: Image) -> Sky:
    """Return background and noise of `pixels` (rows, columns), for single pixels and the smoothed frame."""
    shape = (pixels.shape[0], pixels.shape[1])
    single = estimate_background(pixels, _BLOCK, _SINGLE_STRIDE)
    level = Surface(single.level, shape)
    row, column = np.arange(2, shape[0] - 1, _STRIDE), np.arange(2, shape[1] - 1, _STRIDE)
    sample = _smoothed_at(pixels, row, column)
    smooth = estimate_background(sample, _BLOCK // _STRIDE, 1)
    # Rounding to whole counts is noise, even of a sky that is zero everywhere.
    smooth_noise = np.maximum(smooth.noise, KERNEL_NORM * _ROUNDING)
    lone = pixels[2::_STRIDE, 2::_STRIDE].astype(np.float32)
    tail, cut_off = _tails(lone, single.level, single.noise)
    smooth_tail, _ = _tails(sample, smooth.level, smooth_noise)
    noise, smooth_noise_up = single.noise * tail, smooth_noise * smooth_tail
    # Faint stars lengthen the upper tail too, and more so in a sum of pixels, but are no noise of a star's
    # position. Only where the noise is clipped at zero do the tails determine it.
    own, own_smooth = np.where(cut_off, noise, single.noise), np.where(cut_off, smooth_noise_up, smooth_noise)
    return Sky(
        level,
        Surface(noise, shape),
        Surface(own, shape),
        Surface(smooth.level, shape),
        Surface(smooth_noise_up, shape),
        correlation_of(float(np.median(own_smooth)), float(np.median(own))),
    )


def correlation_of(smooth: float, single: float) -> float:
    """Return the noise of a sum of pixels relative to that of independent pixels, 1 or more.

    `smooth` is the noise of the smoothed frame, `single` the noise of single pixels, counts.
    """
    ratio = smooth / (KERNEL_NORM * single)
    return ratio if ratio > _CORRELATED else 1.0


def one_sided(reach: FloatArray, noise: FloatArray) -> BoolArray:
    """Return where a noise (n,) is clipped at zero counts or hidden by quantisation, as a mask (n,).

    `reach` (n,) is the distance from the median to the lower 2.3rd percentile, counts.
    """
    return np.asarray((reach < 2.0 * _CUT_OFF * noise) | (noise < _HIDDEN))


def without_hot_pixels(pixels: Image, most: int) -> Image:
    """Return `pixels` (rows, columns) with hot pixels replaced, if there are more of them than `most`.

    A few hot pixels are kept: they are measured and flagged. The thousands of a damaged sensor would displace
    all stars from the list and raise the noise.
    """
    single = estimate_background(pixels, _BLOCK, _SINGLE_STRIDE)
    signal = pixels - single.map(single.level)
    noise = single.map(single.noise)
    row, column = find_hot_pixels(signal, noise * noise)
    if len(row) <= most:
        return pixels
    repaired = pixels.copy()
    around = [(dr, dc) for dr in (-1, 0, 1) for dc in (-1, 0, 1) if (dr, dc) != (0, 0)]
    beside = np.stack([pixels[row + dr, column + dc] for dr, dc in around])
    repaired[row, column] = np.median(beside, axis=0).astype(pixels.dtype)
    return repaired


def find_bright(pixels: Image, sky: Sky, sigmas: float) -> BrightPixels:
    """Return the pixels of the smoothed frame that exceed its background by `sigmas` times its noise."""
    rows, columns = pixels.shape
    limit = Surface(sky.smooth_level.values + sigmas * sky.smooth_noise.values, (rows, columns))
    down, across = limit.factors()
    across = np.ascontiguousarray(across[:, 1:-1])
    count = min(_BAND, rows - 2)
    band = np.empty((count + 2, columns), dtype=np.float32)
    once, twice = (np.empty((count + 2 - k, columns), dtype=np.float32) for k in (1, 2))
    wide, smooth = (
        np.empty((count, columns - 1), dtype=np.float32),
        np.empty((count, columns - 2), np.float32),
    )
    bound = np.empty_like(smooth)
    places: list[IntArray] = []
    values: list[Float32Array] = []
    for first in [*range(1, rows - 1 - count, count), rows - 1 - count]:
        band[:] = pixels[first - 1 : first + count + 1]
        np.add(band[:-1], band[1:], out=once)
        np.add(once[:-1], once[1:], out=twice)
        np.add(twice[:, :-1], twice[:, 1:], out=wide)
        np.add(wide[:, :-1], wide[:, 1:], out=smooth)
        np.matmul(down[first : first + count], across, out=bound)
        above = np.flatnonzero(smooth > bound)
        row, column = np.divmod(above, columns - 2)
        # The last band may begin before its predecessor's end.
        place = (row + first) * columns + column + 1
        new = slice(0, None) if not places or not len(places[-1]) else place > places[-1][-1]
        places.append(place[new])
        values.append(smooth.reshape(-1)[above][new])
    index = np.concatenate(places)
    row, column = np.divmod(index, columns)
    return BrightPixels(index, np.concatenate(values) - sky.smooth_level.at(column, row), (rows, columns))


def _smoothed_at(pixels: Image, row: IntArray, column: IntArray) -> Float32Array:
    """Return the smoothed frame (r, c) at the evenly spaced rows `row` (r,) and columns `column` (c,)."""
    total = np.zeros((len(row), len(column)), dtype=np.float32)
    for dy in (-1, 0, 1):
        rows = slice(row[0] + dy, row[-1] + dy + 1, _STRIDE)
        for dx in (-1, 0, 1):
            part = pixels[rows, column[0] + dx : column[-1] + dx + 1 : _STRIDE]
            total += np.float32((2 - abs(dy)) * (2 - abs(dx))) * part
    return total


def _tails(sample: Float32Array, level: FloatArray, noise: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return the upper tail of each block's noise relative to a normal distribution, and where it is clipped.

    2.3 % of the pixels of a block should exceed twice its noise, upwards and downwards. A sky that is clipped
    at zero counts has noise on one side only, and its moments underestimate the noise. Each block takes the
    median of the 3 x 3 blocks around it: the texture of a foreground has a long tail, but the sky beside it
    does not, and a few stars hardly change the median. The relative tail is 1 or more.
    """
    from scipy import ndimage  # noqa: PLC0415 - a process that only names the estimators does not need scipy

    (rows, columns), (down, across) = sample.shape, level.shape
    block = np.ix_(np.arange(rows) * down // rows, np.arange(columns) * across // columns)
    relative = (sample - level[block]) / noise[block]
    height, width = rows // down, columns // across
    blocks = relative[: down * height, : across * width].reshape(down, height, across, width)
    values = blocks.transpose(0, 2, 1, 3).reshape(down, across, -1)
    last = values.shape[-1] - 1
    high = min(last, int(_TAIL_PART * values.shape[-1]))
    ordered = np.partition(values, (last - high, high), axis=-1)
    tail = np.maximum(1.0, 0.5 * ordered[..., high])
    reach = ndimage.median_filter(-ordered[..., last - high], size=3, mode="nearest")
    return np.asarray(ndimage.median_filter(tail, size=3, mode="nearest")), one_sided(reach * noise, noise)
