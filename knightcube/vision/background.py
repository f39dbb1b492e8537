"""Background level and noise of a frame of point stars or streaks, in blocks of pixels.

The level and noise of the background are clipped moments of some of the pixels in each block of the frame.
Streaks, slow gradients of stray light and hot pixels therefore hardly change the estimated background. Sease,
chapter 3, uses the mean of the image as threshold, but noise lifts half of all pixels above the mean
(errata).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from knightcube.astro.arrays import Float32Array, FloatArray, Image, IntArray
from knightcube.compiled import compiled_form_of, loop_helper

_CLIP, _CLIPPED_SIGMA = 3.0, 0.98658
"""Clipping limit (standard deviations), and standard deviation of a unit normal variable after clipping."""
MAD_TO_SIGMA = 1.4826
"""Ratio of the standard deviation of a normal variable to its median absolute deviation."""
_ROUNDING_VARIANCE = 1.0 / 12.0
"""Variance (count^2) from rounding to whole counts, which is the minimum noise."""


@dataclass(frozen=True)
class Background:
    """Background level and noise (counts) of blocks of pixels on a regular grid over a frame of `shape`.

    If `stray_light` is true, the blocks have half of the usual side length.
    """

    level: FloatArray
    noise: FloatArray
    shape: tuple[int, int]
    stray_light: bool = False

    @functools.cached_property
    def typical_level(self) -> float:
        """The median level, counts."""
        return float(np.median(self.level))

    @functools.cached_property
    def typical_noise(self) -> float:
        """The median noise, counts."""
        return float(np.median(self.noise))

    def map(self, grid: FloatArray) -> Image:
        """Return the block values `grid`, interpolated bilinearly to all pixels of a frame, as float32."""
        return _interpolated(grid, self.shape)

    def subtracted(self, pixels: Image) -> tuple[Image, Image]:
        """Return `pixels` (rows, columns) minus background level, and their noise variances, as float32."""
        return _subtracted(pixels, self.level, np.square(self.noise))

    def subtracted_with_noise(self, pixels: Image) -> tuple[Image, Image]:
        """Return `pixels` (rows, columns) minus background level, and their noise (counts), as float32."""
        return _subtracted(pixels, self.level, self.noise)


def _interpolated(grid: FloatArray, shape: tuple[int, int]) -> Image:
    """Return block values, interpolated bilinearly to all pixels of a frame of `shape`."""
    down, across = (
        interpolation_weights(pixels, blocks).astype(np.float32)
        for pixels, blocks in zip(shape, grid.shape, strict=True)
    )
    return np.asarray((down @ grid.astype(np.float32)) @ across.T)


def _subtracted_numpy(pixels: Image, level: FloatArray, variance: FloatArray) -> tuple[Image, Image]:
    """Return `pixels` minus the level, and the noise variance; both are interpolated from block values."""
    signal = _interpolated(level, (pixels.shape[0], pixels.shape[1]))
    # Arrays are changed in place, because allocating large arrays takes more time than the arithmetic.
    np.subtract(pixels, signal, out=signal)
    return signal, _interpolated(variance, signal.shape)


@compiled_form_of(_subtracted_numpy)
def _subtracted(pixels: Image, level: FloatArray, variance: FloatArray) -> tuple[Image, Image]:
    """See `_subtracted_numpy`."""
    (rows, columns), (down, across) = pixels.shape, level.shape
    signal, floor = np.empty((rows, columns), np.float32), np.empty((rows, columns), np.float32)
    levels, variances = np.empty((down, columns), np.float32), np.empty((down, columns), np.float32)
    for column in range(columns):
        left, right, share = _place(column, columns, across)
        for block in range(down):
            levels[block, column] = (1.0 - share) * level[block, left] + share * level[block, right]
            variances[block, column] = (1.0 - share) * variance[block, left] + share * variance[block, right]
    for row in range(rows):
        top, bottom, share = _place(row, rows, down)
        _fill_row(signal[row], pixels[row], levels[top], levels[bottom], np.float32(share))
        _interpolate(floor[row], variances[top], variances[bottom], np.float32(share))
    return signal, floor


@loop_helper
def _place(pixel: float, pixels: int, blocks: int) -> tuple[int, int, float]:
    """Return the indices of the two blocks around one pixel of a side, and the weight of the second block.

    The side has `pixels` pixels, which are divided into `blocks` blocks of equal length.
    """
    size = pixels // blocks
    place = min(max((pixel - 0.5 * (size - 1)) / size, 0.0), blocks - 1.0)
    return int(place), min(int(place) + 1, blocks - 1), place - int(place)


@loop_helper
def _fill_row(signal: Image, pixels: Image, above: Image, below: Image, share: np.float32) -> None:
    """Write the `pixels` of a row minus their level, interpolated from `above` and `below`, to `signal`."""
    for column in range(len(signal)):
        level = above[column] + share * (below[column] - above[column])
        signal[column] = np.float32(pixels[column]) - level


@loop_helper
def _interpolate(out: Image, above: Image, below: Image, share: np.float32) -> None:
    """Write the values of a row, interpolated between the rows `above` and `below`, to `out`."""
    for column in range(len(out)):
        out[column] = above[column] + share * (below[column] - above[column])


# Fraction of blocks with a smooth, significant change of the level above which a frame has stray light.
_LEAST_UNEVEN = 0.25
# Largest ratio of second to first difference of the levels of neighbouring blocks that counts as smooth.
_SMOOTH = 0.5


def estimate_background(
    pixels: Image, block: int = 64, stride: int = 4, *, stray_light: bool | None = None
) -> Background:
    """Return background level and noise of `pixels` (rows, columns) in blocks of `block` x `block` pixels.

    For speed, only every `stride`-th pixel of every `stride`-th row is used. With the defaults, 256 samples
    per block give the level with an error of 6 % of the noise, and the noise with an error of 5 %. A block
    that is filled by a bright object gets the median noise of the surrounding 3 x 3 blocks.

    Stray light makes the level vary within a block. For a frame with stray light, block size and stride are
    therefore halved, and the moments are computed from the differences between the pixels and the level
    interpolated between the centres of the larger blocks. If `stray_light` is None, stray light is assumed if
    the levels of many neighbouring blocks differ.
    """
    coarse = _of_blocks(pixels, block, stride, None)
    if not (_is_uneven(coarse) if stray_light is None else stray_light):
        return coarse
    return _of_blocks(pixels, max(1, block // 2), max(1, stride // 2), coarse)


def _of_blocks(pixels: Image, block: int, stride: int, coarse: Background | None) -> Background:
    """Return the background in blocks. If `coarse` is given, the moments are relative to this background."""
    rows, columns = pixels.shape
    down, across = max(1, rows // block), max(1, columns // block)
    above = np.zeros((0, 0)) if coarse is None else np.ascontiguousarray(coarse.level)
    values, known = _samples(np.ascontiguousarray(pixels), down, across, stride // 2, stride, above)
    level, variance = _clipped_moments(values)
    noise = np.sqrt(np.maximum(variance / _CLIPPED_SIGMA**2, _ROUNDING_VARIANCE))
    return Background(known + level, median_of_neighbours(noise), (rows, columns), coarse is not None)


def _samples_numpy(
    pixels: Image, down: int, across: int, first: int, stride: int, coarse: FloatArray
) -> tuple[Float32Array, FloatArray]:
    """Return the sampled pixels (down, across, k) of each block, minus the level of larger blocks `coarse`.

    The second returned array (down, across) is the level of the larger blocks, interpolated to the centre of
    each block. If `coarse` is empty, this level is zero. A float32 holds the sum of 16 pixels of 16 bits
    exactly.
    """
    values = in_blocks(pixels, down, across, first, stride).astype(np.float32)
    if not coarse.size:
        return values, np.zeros((down, across))
    (rows, columns), height, width = pixels.shape, pixels.shape[0] // down, pixels.shape[1] // across
    row, column = np.arange(down)[:, None] * height, np.arange(across)[:, None] * width
    sampled = (row + np.arange(first, height, stride), column + np.arange(first, width, stride))
    of_row, of_column = (
        interpolation_weights(side, blocks)[place.ravel()]
        for side, blocks, place in zip(pixels.shape, coarse.shape, sampled, strict=True)
    )
    values -= in_blocks((of_row @ coarse @ of_column.T).astype(np.float32), down, across)
    middle = np.broadcast_arrays(column.T + 0.5 * (width - 1), row + 0.5 * (height - 1))
    return values, among_blocks(coarse, (rows, columns), *middle)


@compiled_form_of(_samples_numpy)
def _samples(
    pixels: Image, down: int, across: int, first: int, stride: int, coarse: FloatArray
) -> tuple[Float32Array, FloatArray]:
    """See `_samples_numpy`."""
    (rows, columns), height, width = pixels.shape, pixels.shape[0] // down, pixels.shape[1] // across
    deep, wide = len(range(first, height, stride)), len(range(first, width, stride))
    values, known = np.empty((down, across, deep * wide), np.float32), np.zeros((down, across))
    for block in range(down):
        for beside in range(across):
            for i in range(deep):
                row = block * height + first + i * stride
                for j in range(wide):
                    values[block, beside, i * wide + j] = pixels[row, beside * width + first + j * stride]
    if coarse.size == 0:
        return values, known
    # All samples of a row of blocks are in the same columns, so that the weights are computed only once.
    left, right = np.empty(across * wide, dtype=np.int64), np.empty(across * wide, dtype=np.int64)
    share, levels, level = np.empty(across * wide), np.empty(coarse.shape[1]), np.empty(across * wide)
    for k in range(across * wide):
        column = (k // wide) * width + first + (k % wide) * stride
        left[k], right[k], share[k] = _place(column, columns, coarse.shape[1])
    for block in range(down):
        _level_of_row(coarse, block * height + 0.5 * (height - 1), rows, levels)
        for beside in range(across):
            before, after, part = _place(beside * width + 0.5 * (width - 1), columns, coarse.shape[1])
            known[block, beside] = levels[before] * (1.0 - part) + levels[after] * part
        for i in range(deep):
            _level_of_row(coarse, block * height + first + i * stride, rows, levels)
            for k in range(across * wide):
                level[k] = levels[left[k]] * (1.0 - share[k]) + levels[right[k]] * share[k]
            for beside in range(across):
                for j in range(wide):
                    values[block, beside, i * wide + j] -= np.float32(level[beside * wide + j])
    return values, known


@loop_helper
def _level_of_row(grid: FloatArray, row: float, rows: int, out: FloatArray) -> None:
    """Write the values of a grid of blocks (down, across), interpolated to one `row` of pixels, to `out`."""
    top, bottom, share = _place(row, rows, len(grid))
    for block in range(len(out)):
        out[block] = grid[top, block] * (1.0 - share) + grid[bottom, block] * share


def in_blocks(pixels: Image, down: int, across: int, first: int = 0, stride: int = 1) -> Image:
    """Return the pixels (rows, columns) of each of `down` x `across` equal blocks, as (down, across, k).

    From each block, every `stride`-th pixel of every `stride`-th row is taken, beginning with row and column
    `first` of the block. The rows and columns beyond the last whole block are not taken.
    """
    height, width = pixels.shape[0] // down, pixels.shape[1] // across
    blocks = pixels[: down * height, : across * width].reshape(down, height, across, width)
    blocks = blocks[:, first::stride, :, first::stride].transpose(0, 2, 1, 3)
    return np.ascontiguousarray(blocks).reshape(down, across, -1)


def median_of_neighbours(grid: FloatArray) -> FloatArray:
    """Return the median of the 3 x 3 values around each value of a grid (down, across).

    A value beyond the border is replaced by the nearest value of the grid. The median of nine values in three
    columns is the median of the largest minimum, the median of the medians and the smallest maximum of the
    columns.
    """
    return _median_of_neighbours(np.ascontiguousarray(grid, dtype=np.float64))


def _median_of_neighbours_numpy(grid: FloatArray) -> FloatArray:
    """See `median_of_neighbours`."""
    wide = np.concatenate([grid[:1], grid, grid[-1:]])
    wide = np.concatenate([wide[:, :1], wide, wide[:, -1:]], axis=1)
    low, middle, high = _sorted_three(wide[:-2], wide[1:-1], wide[2:])
    low = np.maximum(np.maximum(low[:, :-2], low[:, 1:-1]), low[:, 2:])
    high = np.minimum(np.minimum(high[:, :-2], high[:, 1:-1]), high[:, 2:])
    middle = _sorted_three(middle[:, :-2], middle[:, 1:-1], middle[:, 2:])[1]
    return _sorted_three(low, middle, high)[1]


def _sorted_three(
    one: FloatArray, two: FloatArray, three: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the elementwise minimum, median and maximum of three arrays of the same shape."""
    less, more = np.minimum(one, two), np.maximum(one, two)
    return np.minimum(less, three), np.maximum(less, np.minimum(more, three)), np.maximum(more, three)


@compiled_form_of(_median_of_neighbours_numpy)
def _median_of_neighbours(grid: FloatArray) -> FloatArray:
    """See `median_of_neighbours`."""
    (down, across), out = grid.shape, np.empty_like(grid)
    low, middle, high = np.empty(across + 2), np.empty(across + 2), np.empty(across + 2)
    for row in range(down):
        above, own, below = grid[max(row - 1, 0)], grid[row], grid[min(row + 1, down - 1)]
        for column in range(across):
            one, two, three = _three_sorted(above[column], own[column], below[column])
            low[column + 1], middle[column + 1], high[column + 1] = one, two, three
        for values in (low, middle, high):
            values[0], values[across + 1] = values[1], values[across]
        for column in range(across):
            lowest = max(low[column], low[column + 1], low[column + 2])
            highest = min(high[column], high[column + 1], high[column + 2])
            between = _three_sorted(middle[column], middle[column + 1], middle[column + 2])[1]
            out[row, column] = _three_sorted(lowest, between, highest)[1]
    return out


@loop_helper
def _three_sorted(one: float, two: float, three: float) -> tuple[float, float, float]:
    """Return minimum, median and maximum of three numbers."""
    less, more = min(one, two), max(one, two)
    return min(less, three), max(less, min(more, three)), max(more, three)


def least_of_neighbours(grid: FloatArray) -> FloatArray:
    """Return the minimum of the values of a grid (down, across) in the 3 x 3 cells around each cell."""
    least = grid.copy()
    np.minimum(least[1:], grid[:-1], out=least[1:])
    np.minimum(least[:-1], grid[1:], out=least[:-1])
    wide = least.copy()
    np.minimum(wide[:, 1:], least[:, :-1], out=wide[:, 1:])
    np.minimum(wide[:, :-1], least[:, 1:], out=wide[:, :-1])
    return wide


def _is_uneven(background: Background) -> bool:
    """Return whether the level of many blocks changes by more than their noise, and does so smoothly.

    The levels of blocks with bright stars or the limb of a planet change, too, but not smoothly.
    """
    if min(background.level.shape) < 3:
        return False
    return _share_uneven(background.level, background.noise) > _LEAST_UNEVEN


def _share_uneven_numpy(level: FloatArray, noise: FloatArray) -> float:
    """Return the fraction of blocks in which the level (rows, columns) has a smooth slope above the noise."""
    steep = np.zeros(level.shape, dtype=np.bool_)
    for values, floor, found in ((level, noise, steep), (level.T, noise.T, steep.T)):
        slope, bend = 0.5 * (values[2:] - values[:-2]), values[2:] - 2.0 * values[1:-1] + values[:-2]
        found[1:-1] |= (np.abs(slope) > floor[1:-1]) & (np.abs(bend) < _SMOOTH * np.abs(slope))
    return float(np.mean(steep))


@compiled_form_of(_share_uneven_numpy)
def _share_uneven(level: FloatArray, noise: FloatArray) -> float:
    """See `_share_uneven_numpy`."""
    (down, across), count = level.shape, 0
    for row in range(down):
        for column in range(across):
            own, floor, steep = level[row, column], noise[row, column], False
            if 0 < row < down - 1:
                steep |= _changes(level[row - 1, column], own, level[row + 1, column], floor)
            if 0 < column < across - 1:
                steep |= _changes(level[row, column - 1], own, level[row, column + 1], floor)
            count += int(steep)
    return float(count / (down * across))


@loop_helper
def _changes(before: float, own: float, after: float, noise: float) -> bool:
    """Return whether three successive levels change smoothly, and on average by more than the noise."""
    slope = abs(0.5 * (after - before))
    return slope > noise and abs(after - 2.0 * own + before) < _SMOOTH * slope


def _clipped_moments(values: Float32Array) -> tuple[FloatArray, FloatArray]:
    """Return mean and variance (down, across) of the finite values (down, across, k) without outliers.

    Sorting a few hundred values with vector instructions is faster than a partition.
    """
    return _sorted_moments(np.sort(values, axis=-1))


def _sorted_moments_numpy(ordered: Float32Array) -> tuple[FloatArray, FloatArray]:
    """See `_clipped_moments`; the values of each block are in ascending order."""
    median = _median_of_sorted(ordered)
    off = ordered - median
    apart = np.abs(off)
    deviation = _median_of_sorted(np.sort(apart, axis=-1))
    # The clipping limit is at least 1.5 counts, because quantisation can make the median deviation zero.
    kept = apart <= _CLIP * np.maximum(MAD_TO_SIGMA * deviation, 0.5)
    count = np.count_nonzero(kept, axis=-1)
    off *= kept
    mean = off.sum(axis=-1, dtype=np.float64) / count
    return median[..., 0] + mean, np.einsum("ijk,ijk->ij", off, off) / count - mean**2


def _median_of_sorted(ordered: Float32Array) -> Float32Array:
    """Return the medians (down, across, 1) of sorted values (down, across, k)."""
    middle = ordered.shape[-1] // 2
    upper = ordered[..., middle : middle + 1]
    return upper if ordered.shape[-1] % 2 else 0.5 * (upper + ordered[..., middle - 1 : middle])


@compiled_form_of(_sorted_moments_numpy)
def _sorted_moments(ordered: Float32Array) -> tuple[FloatArray, FloatArray]:
    """See `_sorted_moments_numpy`."""
    down, across, many = ordered.shape
    level, variance, half = np.empty((down, across)), np.empty((down, across)), np.float32(0.5)
    for block in range(down):
        for beside in range(across):
            values = ordered[block, beside]
            median = values[many // 2] if many % 2 else half * (values[many // 2] + values[many // 2 - 1])
            # The deviations of sorted values ascend from the median towards both ends.
            deviation = _ranked(values, median, many // 2)
            if many % 2 == 0:
                deviation = half * (deviation + _ranked(values, median, many // 2 - 1))
            limit = np.float32(_CLIP) * max(np.float32(MAD_TO_SIGMA) * deviation, half)
            first, last = 0, many
            while median - values[first] > limit:
                first += 1
            while values[last - 1] - median > limit:
                last -= 1
            count, total, square = last - first, 0.0, 0.0
            for k in range(first, last):
                off = values[k] - median
                total += off
                square += off * off
            mean = total / count
            level[block, beside], variance[block, beside] = median + mean, square / count - mean * mean
    return level, variance


@loop_helper
def _ranked(ordered: Float32Array, middle: np.float32, rank: int) -> np.float32:
    """Return the deviation of the given `rank` (0: smallest) from `middle`, of ascending values (k,)."""
    # The `rank` + 1 smallest deviations belong to the values from `low` to `low` + `rank`.
    low, high = 0, len(ordered) - 1 - rank
    while low < high:
        first = (low + high) // 2
        if middle - ordered[first] > ordered[first + rank + 1] - middle:
            low = first + 1
        else:
            high = first
    return max(middle - ordered[low], ordered[low + rank] - middle)


def place_among_blocks(pixel: FloatArray, pixels: int, blocks: int) -> tuple[IntArray, FloatArray]:
    """Return the index (n,) of the last block centre before each `pixel` (n,), and the distance from it (n,).

    A side of the frame of length `pixels` is divided into `blocks` of equal length. The distance is in
    blocks. A pixel beyond the outermost block centres gets the value of the nearest centre.
    """
    width = pixels // blocks
    place = np.clip((pixel - 0.5 * (width - 1)) / width, 0.0, blocks - 1.0)
    first = place.astype(np.int64)
    return first, place - first


def among_blocks(
    values: FloatArray, shape: tuple[int, int], column: npt.ArrayLike, row: npt.ArrayLike
) -> FloatArray:
    """Return block values (down, across) interpolated bilinearly at n pixels, as an array (n,).

    The frame that is divided into blocks has `shape` (rows, columns). The pixels have the coordinates
    `column` (n,) and `row` (n,). If `column` has several dimensions, the result has the same dimensions.
    """
    x, y = (np.ascontiguousarray(place, dtype=float) for place in (column, row))
    return _among_blocks(np.ascontiguousarray(values), *shape, x.ravel(), y.ravel()).reshape(np.shape(column))


def _among_blocks_numpy(
    values: FloatArray, rows: int, columns: int, column: FloatArray, row: FloatArray
) -> FloatArray:
    """See `among_blocks`; `rows` and `columns` are the shape of the frame."""
    top, down = place_among_blocks(row, rows, values.shape[0])
    left, across = place_among_blocks(column, columns, values.shape[1])
    bottom = np.minimum(top + 1, values.shape[0] - 1)
    right = np.minimum(left + 1, values.shape[1] - 1)
    high = values[top, left] * (1.0 - across) + values[top, right] * across
    low = values[bottom, left] * (1.0 - across) + values[bottom, right] * across
    return np.asarray(high * (1.0 - down) + low * down)


@compiled_form_of(_among_blocks_numpy)
def _among_blocks(
    values: FloatArray, rows: int, columns: int, column: FloatArray, row: FloatArray
) -> FloatArray:
    """See `_among_blocks_numpy`."""
    down, across = values.shape
    height, width, found = rows // down, columns // across, np.empty(len(row))
    for k in range(len(row)):
        y, x = (row[k] - 0.5 * (height - 1)) / height, (column[k] - 0.5 * (width - 1)) / width
        y, x = min(y if y > 0.0 else 0.0, down - 1.0), min(x if x > 0.0 else 0.0, across - 1.0)
        top, left = int(y), int(x)
        bottom, right = min(top + 1, down - 1), min(left + 1, across - 1)
        y, x = y - top, x - left
        high = values[top, left] * (1.0 - x) + values[top, right] * x
        low = values[bottom, left] * (1.0 - x) + values[bottom, right] * x
        found[k] = high * (1.0 - y) + low * y
    return found


def interpolation_weights(pixels: int, blocks: int) -> FloatArray:
    """Return the weights (pixels, blocks) of linear interpolation between block centres along one side."""
    first, share = place_among_blocks(np.arange(pixels, dtype=float), pixels, blocks)
    # The weight of a block centre decreases linearly to zero at the adjacent centres.
    return np.maximum(1.0 - np.abs((first + share)[:, None] - np.arange(blocks)), 0.0)
