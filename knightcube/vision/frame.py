"""Properties of a frame that the methods for points and for streaks share.

Background. Level and noise are clipped moments of a sub-sample of each block of pixels, so that streaks, a
slow gradient of stray light and hot pixels hardly change them. The thesis thresholds at the mean of the
image, which half of all pixels exceed once there is noise (errata, chapter 3). The sum over 3 x 3 pixels is
nearly the matched filter of a star that is one pixel wide.

Hot pixels are bright pixels with dark neighbours, which no optics could produce: a star's image wider than
sigma 0.5 px gives the four neighbours of its brightest pixel at least 15 % of the light of that pixel.
Methods that need an image without gaps replace hot pixels, and only certain ones. A fit to pixels excludes
hot pixels instead, which does no harm if one of them was part of a star.

A frame without a scene is dead (one value everywhere) or overexposed. The step between counts is 257 if 8-bit
counts were written as 16 bits, and 16 if 12-bit counts were.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, Image, IntArray

_CLIP, _CLIPPED_SIGMA = 3.0, 0.98658
"""Clipping limit (sigmas), and the standard deviation of a normal variable clipped there."""
MAD_TO_SIGMA = 1.4826
"""Ratio of the standard deviation of a normal variable to its median absolute deviation."""
_ROUNDING_VARIANCE = 1.0 / 12.0
"""Variance (count^2) due to rounding to whole counts: the least noise."""


@dataclass(frozen=True, slots=True)
class Background:
    """Level and noise of blocks of pixels, counts, on a regular grid over a frame of `shape`."""

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

    Every `stride`-th pixel of every `stride`-th row is used: 256 per block with the defaults, which give the
    level to 0.06 and the noise to 0.05 of the noise. A block that a bright object fills gets the noise of its
    neighbours (3 x 3 median).
    """
    from scipy import ndimage  # noqa: PLC0415 - a process that only names the estimators does not need scipy

    rows, columns = pixels.shape
    down, across = max(1, rows // block), max(1, columns // block)
    height, width = rows // down, columns // across
    sample = pixels[: down * height, : across * width].reshape(down, height, across, width)
    sample = sample[:, stride // 2 :: stride, :, stride // 2 :: stride].transpose(0, 2, 1, 3)
    values = sample.reshape(down, across, -1).astype(np.float64)
    median = np.median(values, axis=-1, keepdims=True)
    spread = MAD_TO_SIGMA * np.median(np.abs(values - median), axis=-1, keepdims=True)
    # Coarse quantisation can make the median deviation zero. A limit of 1.5 counts keeps both neighbours.
    kept = np.abs(values - median) <= _CLIP * np.maximum(spread, 0.5)
    count = kept.sum(axis=-1)
    level = np.where(kept, values, 0.0).sum(axis=-1) / count
    variance = np.where(kept, (values - level[..., None]) ** 2, 0.0).sum(axis=-1) / count
    noise = np.sqrt(np.maximum(variance / _CLIPPED_SIGMA**2, _ROUNDING_VARIANCE))
    return Background(level, ndimage.median_filter(noise, size=3, mode="nearest"), (rows, columns))


def place_among_blocks(pixel: FloatArray, pixels: int, blocks: int) -> tuple[IntArray, FloatArray]:
    """Return the block (n,) with the last centre before `pixel` (n,), and the fraction (n,) towards the next.

    A side of `pixels` is divided into equal `blocks`. Positions beyond the outermost centres are moved there.
    """
    width = pixels // blocks
    place = np.clip((pixel - 0.5 * (width - 1)) / width, 0.0, blocks - 1.0)
    first = place.astype(np.int64)
    return first, place - first


def interpolation_weights(pixels: int, blocks: int) -> FloatArray:
    """Return the weights (pixels, blocks) of linear interpolation between block centres, constant beyond."""
    first, share = place_among_blocks(np.arange(pixels, dtype=float), pixels, blocks)
    weights = np.zeros((pixels, blocks))
    weights[np.arange(pixels), first] += 1.0 - share
    weights[np.arange(pixels), np.minimum(first + 1, blocks - 1)] += share
    return weights


_STRETCH = 32_768
"""Number of pixels that are summed at once: they fit into the cache of the processor."""


def box_sum(image: Image) -> Image:
    """Return the sums over 3 x 3 pixels around each pixel (rows, columns); the outermost are zero."""
    columns, flat = image.shape[1], np.ascontiguousarray(image).reshape(-1)
    total = np.empty(image.shape, dtype=image.dtype)
    sums = total.reshape(-1)
    # Successive rows run into each other, which affects the outermost pixels only.
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
    """Return flat `sums` over 3 x 3 pixels of a frame of `shape` after light is subtracted from the frame.

    `pixels` (m,) are the flat numbers of different pixels, and `taken` (m,) is the light subtracted there.
    """
    out, (rows, columns) = sums.copy(), shape
    for down in (-columns, 0, columns):
        for beside in (-1, 0, 1):
            # Sums that cross the edge of the frame belong to outermost pixels, which are zero.
            out[np.clip(pixels + (down + beside), 0, out.size - 1)] -= taken
    framed = out.reshape(rows, columns)
    framed[[0, -1]] = 0
    framed[:, [0, -1]] = 0
    return out


@dataclass(frozen=True, slots=True, eq=False)
class Moments:
    """The light of n regions.

    Attributes:
        flux: light (n,), counts.
        centre: centre of light (n, 2), x and y, px.
        length: length of the uniform line with the second moments of the region (n,), px; about 0 if round.
        thickness: rms width across the line (n,), px.
        direction: angle from the rows to the line (n,), rad.
    """

    flux: FloatArray
    centre: FloatArray
    length: FloatArray
    thickness: FloatArray
    direction: FloatArray


def positions(mask: BoolArray) -> tuple[IntArray, IntArray]:
    """Return rows and columns of the true pixels of a mask, faster than `nonzero` if they are few."""
    row, column = np.divmod(np.flatnonzero(mask), mask.shape[1])
    return row, column


def label_pixels(pixel: IntArray, columns: int) -> tuple[IntArray, int]:
    """Return the region number (m,) of each flat `pixel` (m,), ascending, and the number of regions.

    Regions are 8-connected and numbered in the order of their first pixels. Runs of pixels along rows are
    connected, because there are many times fewer of them than pixels. Each run points to a lower one of its
    group, over fewer and fewer links (Shiloach and Vishkin 1982). scipy.sparse would need 12 MiB more.
    """
    # One empty column is added, so that no run continues in the next row.
    pixel, columns = pixel + pixel // columns, columns + 1
    first = np.flatnonzero(np.diff(pixel, prepend=-2) > 1)
    length = np.diff(first, append=len(pixel))
    start, stop = pixel[first], pixel[first] + length
    # A run touches each run of the next row that lies between one column before it and one column after it.
    low = np.searchsorted(stop, start + columns)
    count = np.searchsorted(start, stop + columns, side="right") - low
    one = np.repeat(np.arange(len(first)), count)
    other = np.arange(len(one)) + np.repeat(low - np.cumsum(count) + count, count)
    root = np.arange(len(first))
    while True:
        least = np.minimum(root[one], root[other])
        apart = np.flatnonzero(root[one] != root[other])
        if not len(apart):
            break
        for ends in (one, other):
            np.minimum.at(root, root[ends[apart]], least[apart])
        while np.any((nearer := root[root]) != root):
            root = nearer
    is_first = root == np.arange(len(first))
    number = (np.cumsum(is_first) - 1)[root]
    return np.repeat(number, length), int(np.count_nonzero(is_first))


def moments(owner: IntArray, column: IntArray, row: IntArray, light: FloatArray, count: int) -> Moments:
    """Return the moments of `count` regions of pixels (m,), each with the number of its region and its light.

    The moments of a region without light are zero.
    """
    flux = np.bincount(owner, light, count).astype(np.float64)
    whole = np.where(flux > 0.0, flux, np.inf)
    x, y = np.bincount(owner, light * column, count) / whole, np.bincount(owner, light * row, count) / whole
    dx, dy = column - x[owner], row - y[owner]
    xx = np.bincount(owner, light * dx * dx, count) / whole
    yy = np.bincount(owner, light * dy * dy, count) / whole
    xy = np.bincount(owner, light * dx * dy, count) / whole
    # The point spread increases both principal moments by the same amount.
    # The difference of the moments is therefore that of a line of length L, L^2/12.
    spread = np.hypot(xx - yy, 2.0 * xy)
    return Moments(
        flux,
        np.stack([x, y], axis=-1),
        np.sqrt(12.0 * spread),
        np.sqrt(np.maximum(0.5 * (xx + yy - spread), 0.0)),
        0.5 * np.arctan2(2.0 * xy, xx - yy),
    )


def line_of(centre: FloatArray, covariance: FloatArray, least_length: float) -> FloatArray:
    """Return the ends (2, 2), px, of the uniform line around `centre` (2,) with given second moments.

    Both ends are the centre if the line is not longer than `least_length` px. The moments (2, 2) are in px^2.
    """
    (across, along), axes = np.linalg.eigh(covariance)
    length = float(np.sqrt(12.0 * max(along - across, 0.0)))
    half = 0.5 * length * axes[:, 1] if length > least_length else np.zeros(2)
    return np.stack([centre - half, centre + half])


_SHARPNESS, _NOISE, _MOST = 0.15, 3.0, 0.3
"""Limit of the neighbours of a hot pixel: a fraction of its light plus standard deviations of the noise, at
most another fraction, which the neighbours of a faint star reach."""
_PAIR, _PAIR_NOISE = 20.0, 1.0
"""Least brightness of two adjacent hot pixels, and the noise in the limit of the third brightest pixel, in
standard deviations."""
_REPAIR_SIGMAS, _HOT_SIGMAS = 10.0, 8.0
"""Least brightness of a hot pixel that is replaced, and of one that is excluded, in standard deviations."""
_AROUND = tuple((dr, dc) for dr in (-1, 0, 1) for dc in (-1, 0, 1) if (dr, dc) != (0, 0))


def repair_hot_pixels(signal: Image, noise: Image) -> int:
    """Replace the hot pixels of `signal` (rows, columns) by the median of their neighbours; return how many.

    Only pixels well above their `noise` (rows, columns) are examined.
    """
    row, column = positions(signal > _REPAIR_SIGMAS * noise)
    row, column, around = _hot(signal, row, column, noise[row, column])
    signal[row, column] = np.median(around, axis=0)
    return len(row)


def find_hot_pixels(signal: Image, variance: Image) -> tuple[IntArray, IntArray]:
    """Return rows and columns of the hot pixels of `signal` that stand well above their noise.

    `variance` (rows, columns) is the squared noise.
    """
    row, column = positions(signal > np.float32(_HOT_SIGMAS * np.sqrt(variance.min())))
    noise = np.sqrt(variance[row, column])
    bright = signal[row, column] > _HOT_SIGMAS * noise
    row, column, _ = _hot(signal, row[bright], column[bright], noise[bright])
    return row, column


def are_hot(light: FloatArray, noise: FloatArray) -> BoolArray:
    """Return which windows (n,) of nine pixels hold nothing but one or two hot pixels.

    `light` (9, n) are the pixels, and `noise` (n,) is the noise of a pixel.
    """
    third, second, highest = np.partition(light, (6, 7, 8), axis=0)[6:]
    alone = second < np.minimum(_SHARPNESS * highest + _NOISE * noise, _MOST * highest)
    pair = (highest > _PAIR * noise) & (third < _SHARPNESS * highest + _PAIR_NOISE * noise)
    return np.asarray(alone | pair)


def _hot(
    signal: Image, row: IntArray, column: IntArray, noise: FloatArray
) -> tuple[IntArray, IntArray, FloatArray]:
    """Return rows and columns of the hot ones of pixels (m,), and the eight pixels (8, k) around each."""
    inside = (row > 0) & (row < signal.shape[0] - 1) & (column > 0) & (column < signal.shape[1] - 1)
    row, column, noise = row[inside], column[inside], noise[inside]
    around = np.stack([signal[row + dr, column + dc] for dr, dc in _AROUND])
    own = signal[row, column]
    # Each of two adjacent hot pixels is examined; a pixel with two brighter neighbours is not hot.
    hot = are_hot(np.concatenate([around, own[None]]), noise) & (np.count_nonzero(around > own, axis=0) <= 1)
    return row[hot], column[hot], around[:, hot]


_DEAD_FRACTION = 1e-4
"""Fraction of pixels that differ from one value in a dead frame, due to hot pixels."""
_PLATEAU = 6
"""Least number of pixels with the highest count that show where the converter saturates, in a frame of
streaks."""
_LEAST_PLATEAU, _PILED_UP, _PLATEAU_REACH = 4, 2.0, 0.02
"""Least number of such pixels in a frame of points, their least ratio to the number of pixels just below, and
the range of these, as a fraction of the range of counts."""


class FrameState(Enum):
    """Whether a frame holds a scene, or why not."""

    USABLE = "usable"
    BLACK = "black"
    SATURATED = "saturated"


def frame_state(pixels: Image, saturation: float, saturated_fraction: float) -> FrameState:
    """Return whether a frame (rows, columns) is usable, dead (one value everywhere) or overexposed.

    It is overexposed if at least `saturated_fraction` of its pixels reach `saturation` counts.
    """
    if np.count_nonzero(at_least(pixels, saturation)) >= saturated_fraction * pixels.size:
        return FrameState.SATURATED
    # A comparison in the frame's own type takes a quarter of the time.
    usual = np.median(pixels[::8, ::8]).astype(pixels.dtype)
    if np.count_nonzero(pixels != usual) <= _DEAD_FRACTION * pixels.size:
        return FrameState.BLACK
    return FrameState.USABLE


def saturation_level(pixels: Image, given: float | None) -> float:
    """Return the count at which pixels saturate: `given`, the integer type's maximum, or infinity."""
    if given is not None:
        return given
    return float(np.iinfo(pixels.dtype).max) if pixels.dtype.kind in "ui" else np.inf


def saturation_count(pixels: Image) -> float:
    """Return the count at which pixels saturate: the highest if several pixels share it, else the type's.

    This serves frames of streaks, whose bright stars spread over many pixels.
    """
    highest = pixels.max()
    # A frame of one value everywhere is dead, unless the value is the maximum of its type.
    if pixels.min() < highest and np.count_nonzero(pixels == highest) >= _PLATEAU:
        return float(highest)
    return saturation_level(pixels, None)


def saturation_of_bright(counts: FloatArray, pixels: Image, given: float | None) -> float:
    """Return the count at which pixels saturate: `given`, a plateau of bright `counts` (m,), or the maximum.

    This serves frames of points from any camera. The highest counts of a dim frame are noise, of which the
    highest is the rarest; a plateau holds more pixels than the counts just below it.
    """
    top = saturation_level(pixels, given)
    highest = counts.max(initial=-np.inf)
    if given is not None or highest >= top or not len(counts):
        return top
    at_top = int(np.count_nonzero(counts == highest))
    step = max(1.0, _PLATEAU_REACH * float(highest - np.median(counts)))
    below = int(np.count_nonzero(counts >= highest - step)) - at_top
    flat = at_top >= _LEAST_PLATEAU and at_top > _PILED_UP * below
    return float(highest) if flat else top


def at_least(pixels: Image, level: float) -> BoolArray:
    """Return which `pixels` reach `level` counts; integers are compared in their own type."""
    if not np.issubdtype(pixels.dtype, np.integer) or not 0.0 <= level <= np.iinfo(pixels.dtype).max:
        return np.asarray(pixels >= level)
    return np.asarray(pixels >= pixels.dtype.type(np.ceil(level)))


_STRIDE = 16
"""Distance of the pixels from which the step is estimated."""
_MOST_BETWEEN = 0.01
"""Largest fraction of repaired pixels, whose counts may lie between the steps."""


def in_steps(pixels: Image) -> tuple[Image, int, int]:
    """Return unsigned `pixels` (rows, columns) in steps of their counts, the step, and the count of step 0.

    Pixels whose counts have no common step are returned unchanged, with 1 and 0.
    """
    values = np.unique(pixels[::_STRIDE, ::_STRIDE]).astype(np.int64)
    step = int(np.gcd.reduce(values - values[0]))
    if step <= 1:
        return pixels, 1, 0
    offset = int(values[0]) % step
    between = np.count_nonzero((pixels.astype(np.int64) - offset) % step)
    if between > _MOST_BETWEEN * pixels.size:
        return pixels, 1, 0
    steps = (pixels.astype(np.int64) - offset + step // 2) // step
    return np.maximum(steps, 0).astype(pixels.dtype), step, offset
