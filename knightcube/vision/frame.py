"""Random access to a camera's pixels by whole columns or rows.

The Fuga 15d of Meller et al. is read by address, like a memory (chapter 1); a detector that must be read out
whole implements the same two calls.

Local background level and noise of a frame, and the sums of its light over 3 x 3 pixels.

The thesis thresholds at the image's mean, which half of all pixels exceed once there is noise (errata,
chapter 3). Here level and noise are clipped moments of a sub-sample of each block of pixels, so that streaks,
a slow gradient of stray light and hot pixels hardly change them. The sum over 3 x 3 pixels is nearly the
matched filter of a star that is one pixel wide.

Connected regions of bright pixels, the moments of their light, and hot pixels.

Hot pixels are bright pixels with dark neighbours, which no optics could produce: a star's image wider than
sigma 0.5 px gives the brightest pixel's four neighbours at least 15 % of that pixel's light. Corner
detectors need an image without gaps, and a search for peaks examines a limited number of them. They replace
hot pixels, and only certain ones. A fit to pixels leaves hot pixels out instead, which costs nothing if one
of them was part of a star.

The count at which pixels saturate, the step between counts, and frames without a scene.

A frame without a scene is dead (one value everywhere) or overexposed. The step between counts is 257 where
8-bit counts were written as 16 bits, and 16 where 12-bit counts were.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, Image, IntArray

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


@dataclass(frozen=True, slots=True, eq=False)
class Moments:
    """The light of `n` regions.

    Attributes:
        flux: (n,) counts.
        centre: (n, 2) px, x and y, of light.
        length: (n,) px, of the uniform line with the region's second moments; about 0 for a round one.
        thickness: (n,) px, rms across.
        direction: (n,) rad, from the rows to the line.
    """

    flux: FloatArray
    centre: FloatArray
    length: FloatArray
    thickness: FloatArray
    direction: FloatArray


def positions(mask: BoolArray) -> tuple[IntArray, IntArray]:
    """Return rows and columns of a mask's true pixels: as nonzero, much faster when they are few."""
    row, column = np.divmod(np.flatnonzero(mask), mask.shape[1])
    return row, column


def label_pixels(pixel: IntArray, columns: int) -> tuple[IntArray, int]:
    """Return the region number (m,) of each flat `pixel` (m,), ascending, and the count of regions.

    Regions are 8-connected and numbered in the order of their first pixels. Runs of pixels along rows are
    joined: there are many times fewer of them than pixels.
    """
    # One column more, which is empty: no run goes on in the next row.
    pixel, columns = pixel + pixel // columns, columns + 1
    first = np.flatnonzero(np.diff(pixel, prepend=-2) > 1)
    length = np.diff(first, append=len(pixel))
    start, stop = pixel[first], pixel[first] + length
    # A run touches those of the next row from one column before it to one after.
    low = np.searchsorted(stop, start + columns)
    count = np.searchsorted(start, stop + columns, side="right") - low
    one = np.repeat(np.arange(len(first)), count)
    other = np.arange(len(one)) + np.repeat(low - np.cumsum(count) + count, count)
    number, regions = _joined(one, other, len(first))
    return np.repeat(number, length), regions


def _joined(one: IntArray, other: IntArray, count: int) -> tuple[IntArray, int]:
    """Return the number (count,) of the group of each of `count` items, and how many groups there are.

    Pairs (m,) join them; groups are numbered in the order of their first items. Each item points to a smaller
    one of its group, by shorter and shorter ways (Shiloach and Vishkin 1982). For this alone scipy.sparse
    would take 12 MiB of the vision worker.
    """
    root = np.arange(count)
    while True:
        least = np.minimum(root[one], root[other])
        apart = np.flatnonzero(root[one] != root[other])
        if not len(apart):
            break
        for ends in (one, other):
            np.minimum.at(root, root[ends[apart]], least[apart])
        while np.any((nearer := root[root]) != root):
            root = nearer
    first = root == np.arange(count)
    return (np.cumsum(first) - 1)[root], int(np.count_nonzero(first))


def moments(owner: IntArray, column: IntArray, row: IntArray, light: FloatArray, count: int) -> Moments:
    """Return the moments of `count` regions of pixels (m,), each with its region's number and its `light`.

    A region without light has none: zeros.
    """
    flux = np.bincount(owner, light, count).astype(np.float64)
    whole = np.where(flux > 0.0, flux, np.inf)
    x, y = np.bincount(owner, light * column, count) / whole, np.bincount(owner, light * row, count) / whole
    dx, dy = column - x[owner], row - y[owner]
    xx = np.bincount(owner, light * dx * dx, count) / whole
    yy = np.bincount(owner, light * dy * dy, count) / whole
    xy = np.bincount(owner, light * dx * dy, count) / whole
    # The difference of the principal moments is free of the point spread, which widens both alike; a line of
    # length L has L^2/12.
    spread = np.hypot(xx - yy, 2.0 * xy)
    return Moments(
        flux,
        np.stack([x, y], axis=-1),
        np.sqrt(12.0 * spread),
        np.sqrt(np.maximum(0.5 * (xx + yy - spread), 0.0)),
        0.5 * np.arctan2(2.0 * xy, xx - yy),
    )


def line_of(centre: FloatArray, covariance: FloatArray, least_length: float) -> FloatArray:
    """Return the ends (2, 2) px of the uniform line about `centre` (2,) with second moments (2, 2) px^2.

    Both are the centre where it is not longer than `least_length` px.
    """
    (across, along), axes = np.linalg.eigh(covariance)
    length = float(np.sqrt(12.0 * max(along - across, 0.0)))
    half = 0.5 * length * axes[:, 1] if length > least_length else np.zeros(2)
    return np.stack([centre - half, centre + half])


# Part of a pixel's light that its neighbours would get from a star, and sigmas of their noise on top; never
# more than another part, which a faint star's neighbours reach.
_SHARPNESS, _NOISE, _MOST = 0.15, 3.0, 0.3
# Of two hot pixels side by side only the third brightest is dark: asked of bright ones, with less noise.
_PAIR, _PAIR_NOISE = 20.0, 1.0
_AROUND = tuple((dr, dc) for dr in (-1, 0, 1) for dc in (-1, 0, 1) if (dr, dc) != (0, 0))


def repair_hot_pixels(signal: Image, noise: Image, sigmas: float = 10.0) -> int:
    """Replace the hot pixels of `signal` (rows, columns) by their neighbours' median; return how many.

    `noise` (rows, columns) is of one pixel; only pixels above `sigmas` times it are examined.
    """
    row, column = positions(signal > sigmas * noise)
    row, column, around = _hot(signal, row, column, noise[row, column])
    signal[row, column] = np.median(around, axis=0)
    return len(row)


def find_hot_pixels(signal: Image, variance: Image, sigmas: float = 8.0) -> tuple[IntArray, IntArray]:
    """Return rows and columns of the hot pixels of `signal` that exceed `sigmas` of their noise.

    `variance` (rows, columns) is the noise squared.
    """
    row, column = positions(signal > np.float32(sigmas * np.sqrt(variance.min())))
    noise = np.sqrt(variance[row, column])
    bright = signal[row, column] > sigmas * noise
    row, column, _ = _hot(signal, row[bright], column[bright], noise[bright])
    return row, column


def are_hot(light: FloatArray, noise: FloatArray) -> BoolArray:
    """Return which windows (n,) of nine pixels, `light` (9, n), hold one hot pixel or two, and nothing else.

    `noise` (n,) is of one pixel.
    """
    # The third brightest, the second and the highest.
    third, second, highest = np.partition(light, (6, 7, 8), axis=0)[6:]
    alone = second < np.minimum(_SHARPNESS * highest + _NOISE * noise, _MOST * highest)
    pair = (highest > _PAIR * noise) & (third < _SHARPNESS * highest + _PAIR_NOISE * noise)
    return np.asarray(alone | pair)


def _hot(
    signal: Image, row: IntArray, column: IntArray, noise: FloatArray
) -> tuple[IntArray, IntArray, FloatArray]:
    """Return those of the pixels (m,) that are hot, and the eight pixels (8, k) about each."""
    inside = (row > 0) & (row < signal.shape[0] - 1) & (column > 0) & (column < signal.shape[1] - 1)
    row, column, noise = row[inside], column[inside], noise[inside]
    around = np.stack([signal[row + dr, column + dc] for dr, dc in _AROUND])
    own = signal[row, column]
    # Of two hot pixels side by side each is examined; a third beside them is none of the two.
    hot = are_hot(np.concatenate([around, own[None]]), noise) & (np.count_nonzero(around > own, axis=0) <= 1)
    return row[hot], column[hot], around[:, hot]


# A living sensor differs from one single value in more pixels than this; a dead one may have hot pixels.
_DEAD_FRACTION = 1e-4
# A count that several pixels share, and none exceeds, is where the converter saturates.
_PLATEAU = 6
# The same in a frame of any camera: a count shared by fewer pixels, but by this factor more than stand within
# this part of the range below it.
_LEAST_PLATEAU, _PILED_UP, _PLATEAU_REACH = 4, 2.0, 0.02


class FrameState(Enum):
    """Whether a frame holds a scene: `usable`, or why not."""

    USABLE = "usable"
    BLACK = "black"
    SATURATED = "saturated"


def frame_state(pixels: Image, saturation: float, saturated_fraction: float) -> FrameState:
    """Distinguish a dead frame (one value everywhere) and an overexposed one from a frame worth processing.

    Saturated: at least `saturated_fraction` of the pixels (rows, columns) reach `saturation` counts.
    """
    if np.count_nonzero(at_least(pixels, saturation)) >= saturated_fraction * pixels.size:
        return FrameState.SATURATED
    # Compared in the frame's own type: whole numbers take a quarter of the time.
    usual = np.median(pixels[::8, ::8]).astype(pixels.dtype)
    if np.count_nonzero(pixels != usual) <= _DEAD_FRACTION * pixels.size:
        return FrameState.BLACK
    return FrameState.USABLE


def saturation_level(pixels: Image, given: float | None) -> float:
    """Return the count at which pixels clip: `given`, the integer type's top, or infinity for other types."""
    if given is not None:
        return given
    return float(np.iinfo(pixels.dtype).max) if pixels.dtype.kind in "ui" else np.inf


def saturation_count(pixels: Image) -> float:
    """Return the count at which `pixels` clip: their highest when several share it, else the type's top.

    Serves frames of streaks, whose bright stars spread over many pixels.
    """
    highest = pixels.max()
    # One value everywhere is a dead frame's; a converter's top it is at the type's top only.
    if pixels.min() < highest and np.count_nonzero(pixels == highest) >= _PLATEAU:
        return float(highest)
    return saturation_level(pixels, None)


def saturation_of_bright(counts: FloatArray, pixels: Image, given: float | None) -> float:
    """Return the count at which pixels clip: `given`, a plateau of the bright `counts` (m,), or the top.

    Serves frames of points from any camera. A dim frame's highest counts are noise, where the last one is the
    rarest; a plateau holds more pixels than the counts just below it.
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
    """Return which `pixels`, of an unsigned integer type, reach `level` counts."""
    if not np.issubdtype(pixels.dtype, np.integer) or not 0.0 <= level <= np.iinfo(pixels.dtype).max:
        return np.asarray(pixels >= level)
    return np.asarray(pixels >= pixels.dtype.type(np.ceil(level)))


# Pixels are sampled so sparsely first; repaired ones between the steps are fewer than this part.
_STRIDE = 16
_MOST_BETWEEN = 0.01


def in_steps(pixels: Image) -> tuple[Image, int, int]:
    """Return unsigned `pixels` (rows, columns) in steps of their counts, the step, and the count of step 0.

    Pixels whose counts have no common step come back as they are, with 1 and 0.
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
