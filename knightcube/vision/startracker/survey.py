"""Sky background of a frame, areas of pixels above the noise, and classification as points or streaks.

`survey` smooths the frame, finds the pixels above the noise and joins them into connected areas. The shapes
of the brightest areas distinguish a frame of points from a frame of streaks.

The smoothing kernel is [1 2 1] along rows and columns, which is nearly the matched filter for a star of 0.7
to 1.5 px standard deviation. The threshold is derived from the noise of the smoothed frame. Demosaicing and
JPEG compression correlate the noise of neighbouring pixels. With a threshold derived from the noise of single
pixels, thousands of peaks of the correlated noise would count as stars. The frame is processed in bands of
rows that fit into the processor cache, without a copy of the frame.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from knightcube.astro.arrays import (
    BoolArray,
    Float32Array,
    FloatArray,
    Image,
    IntArray,
    brief,
    median,
)
from knightcube.compiled import compiled_form_of, loop_helper
from knightcube.errors import ArgumentError
from knightcube.vision.background import (
    Background,
    among_blocks,
    estimate_background,
    in_blocks,
    interpolation_weights,
    least_of_neighbours,
    median_of_neighbours,
)
from knightcube.vision.frame import (
    HOT_SIGMAS,
    check_pixels,
    count_of_floats,
    gain_in_counts,
    hot_among,
    label_pixels,
    moments,
    saturation_of_bright,
)

KERNEL_NORM = 6.0
"""Noise of the smoothed frame for white noise of 1 count per pixel: the root sum square of the kernel."""
_BAND = 32
# Number of pixels of a row that are first compared with their limit without branches.
_SEGMENT = 64
_SKY_BLOCK, _STRIDE, _SINGLE_STRIDE = 64, 4, 8
TAIL_PART = 0.97725
"""Fraction of a normal distribution that lies below the mean plus two standard deviations."""
# Noise of a sum of pixels, relative to its value without correlation, below which correlation is neglected.
_CORRELATED = 1.05
# Ratio of the lower noise tail to 2 sigma, below which the noise is considered clipped at zero counts.
_CUT_OFF = 0.8
# Noise (counts) below which quantisation prevents a measurement of the noise.
_HIDDEN = 0.5
_ROUNDING = 12.0**-0.5


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """A quantity given at the centres of blocks of pixels (down, across) and interpolated bilinearly.

    The frame has the rows and columns `shape`.
    """

    values: FloatArray
    shape: tuple[int, int]

    def at(self, column: npt.ArrayLike, row: npt.ArrayLike) -> FloatArray:
        """Return the values (n,) of the surface at n pixels, given by `column` (n,) and `row` (n,)."""
        return among_blocks(self.values, self.shape, column, row)

    def factors(self) -> tuple[Float32Array, Float32Array]:
        """Return two matrices (rows, down) and (down, columns), whose product is the value at every pixel.

        The number of rows of blocks is `down`.
        """
        down, across = (
            interpolation_weights(pixels, blocks)
            for pixels, blocks in zip(self.shape, self.values.shape, strict=True)
        )
        return down.astype(np.float32), (self.values @ across.T).astype(np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class SkyBackground:
    """The sky background of a frame between its stars.

    Attributes:
        level, noise: background and noise of single pixels, counts; the noise includes faint stars.
        pixel_noise: noise of a single pixel without faint stars, counts.
        smooth_level, smooth_noise: background and noise of the smoothed frame (kernel of sum 16), counts; the
            noise includes faint stars.
        correlation: ratio of the noise of a sum of pixels to that of a sum of independent pixels; 1 or more.
    """

    level: Surface
    noise: Surface
    pixel_noise: Surface
    smooth_level: Surface
    smooth_noise: Surface
    correlation: float


@dataclass(frozen=True, slots=True, eq=False)
class BrightPixels:
    """The m pixels of the smoothed frame that are above the noise.

    Attributes:
        index: increasing indices of the pixels in the flattened frame (m,).
        smooth: counts of the smoothed frame above the background (m,).
        shape: rows and columns of the frame.
    """

    index: IntArray
    smooth: FloatArray
    shape: tuple[int, int]


def in_counts(pixels: Image) -> tuple[Image, float]:
    """Return a frame (rows, columns) scaled to counts, and the size of one count in the original unit.

    Integer frames are returned unchanged. Raises ArgumentError unless the pixels are finite real numbers and
    the frame has at least 16 x 16 pixels.
    """
    check_pixels(pixels)
    if pixels.dtype.kind != "f":
        return pixels, 1.0
    unit = count_of_floats(pixels)
    return (pixels / unit).astype(np.float32), unit


def measure_sky(pixels: Image, single: Background | None = None) -> SkyBackground:
    """Return the sky background and noise of a frame (rows, columns), before and after smoothing.

    If the background before smoothing, `single`, is not given, it is measured.
    """
    shape = (pixels.shape[0], pixels.shape[1])
    single = estimate_background(pixels, _SKY_BLOCK, _SINGLE_STRIDE) if single is None else single
    level = Surface(single.level, shape)
    row, column = np.arange(2, shape[0] - 1, _STRIDE), np.arange(2, shape[1] - 1, _STRIDE)
    sample = _smoothed_at(pixels, row, column)
    smooth = estimate_background(sample, _SKY_BLOCK // _STRIDE, 1, stray_light=single.stray_light)
    # Rounding to whole counts causes noise even if all counts of the sky are zero.
    smooth_noise = np.maximum(smooth.noise, KERNEL_NORM * _ROUNDING)
    lone = pixels[2::_STRIDE, 2::_STRIDE]
    tail, cut_off = _tails(lone, single.level, single.noise)
    smooth_tail, _ = _tails(sample, smooth.level, smooth_noise)
    noise, smooth_noise_up = single.noise * tail, smooth_noise * smooth_tail
    # Faint stars widen the upper tail of the noise distribution, but not the noise of star positions.
    # The upper tail increases the noise only if the lower tail is clipped at zero counts.
    own, own_smooth = np.where(cut_off, noise, single.noise), np.where(cut_off, smooth_noise_up, smooth_noise)
    return SkyBackground(
        level,
        Surface(noise, shape),
        Surface(own, shape),
        Surface(smooth.level, shape),
        Surface(smooth_noise_up, shape),
        correlation_of(median(own_smooth), median(own)),
    )


def correlation_of(smooth: float, single: float) -> float:
    """Return the ratio (at least 1) of the noise of a sum of pixels to that of independent pixels.

    `smooth` is the noise of the smoothed frame, counts, and `single` is the noise of single pixels, counts.
    """
    ratio = smooth / (KERNEL_NORM * single)
    return ratio if ratio > _CORRELATED else 1.0


def one_sided(reach: FloatArray, noise: FloatArray) -> BoolArray:
    """Return which noise values (n,) are unreliable because of clipping at zero counts or quantisation.

    `reach` (n,) is the distance from the median to the 2.3rd percentile, counts.
    """
    return np.asarray((reach < 2.0 * _CUT_OFF * noise) | (noise < _HIDDEN))


def without_hot_pixels(pixels: Image, most: int) -> tuple[Image, Background]:
    """Return a frame and its background; if more than `most` pixels are hot, the hot pixels are replaced.

    A few hot pixels are kept: each is measured as a source, which is then flagged. The thousands of hot
    pixels of a damaged sensor would fill the list of sources instead of stars, and would increase the noise.
    """
    background = estimate_background(pixels, _SKY_BLOCK, _SINGLE_STRIDE)
    row, column = hot_pixels_above(pixels, background, most)
    if len(row) <= most:
        return pixels, background
    repaired = pixels.copy()
    around = [(dr, dc) for dr in (-1, 0, 1) for dc in (-1, 0, 1) if (dr, dc) != (0, 0)]
    beside = np.stack([pixels[row + dr, column + dc] for dr, dc in around])
    repaired[row, column] = np.median(beside, axis=0).astype(pixels.dtype)
    return repaired, estimate_background(repaired, _SKY_BLOCK, _SINGLE_STRIDE)


def hot_pixels_above(pixels: Image, background: Background, most: int) -> tuple[IntArray, IntArray]:
    """Return rows and columns of the hot pixels of a frame (rows, columns), as `find_hot_pixels` does.

    Only the pixels that exceed the lowest threshold of the surrounding blocks are tested, so that the
    background is not interpolated at every pixel. The result is empty if at most `most` pixels exceed the
    lowest threshold.
    """
    columns = pixels.shape[1]
    # Level and noise are interpolated between the centres of adjacent blocks.
    limit = background.level + HOT_SIGMAS * background.noise
    lowest = least_of_neighbours(limit)
    if np.issubdtype(pixels.dtype, np.integer):
        # A comparison with an integer threshold is four times as fast as in floating point.
        lowest = np.clip(np.ceil(lowest), np.iinfo(pixels.dtype).min, np.iinfo(pixels.dtype).max)
    lowest = lowest.astype(pixels.dtype)
    row, column = np.divmod(_bright_indices(np.ascontiguousarray(pixels), lowest), columns)
    if len(row) <= most:
        return row[:0], column[:0]
    level, noise = (
        among_blocks(grid, background.shape, column, row) for grid in (background.level, background.noise)
    )
    return hot_among(pixels, row, column, noise, level)


def _bright_indices_numpy(pixels: Image, lowest: Image) -> IntArray:
    """Return the flat indices (m,) of the pixels that reach the threshold `lowest` of their block.

    Rows and columns beyond the last whole block belong to the last blocks.
    """
    (rows, columns), (down, across) = pixels.shape, lowest.shape
    height, owner = rows // down, np.minimum(np.arange(columns) // (columns // across), across - 1)
    found: list[IntArray] = []
    for block in range(down):
        first, last = block * height, rows if block == down - 1 else (block + 1) * height
        found.append(np.flatnonzero(pixels[first:last] >= lowest[block, owner]) + first * columns)
    return np.concatenate(found)


@compiled_form_of(_bright_indices_numpy)
def _bright_indices(pixels: Image, lowest: Image) -> IntArray:
    """See `_bright_indices_numpy`."""
    (rows, columns), (down, across) = pixels.shape, lowest.shape
    found, count = np.empty(rows * columns, dtype=np.int64), 0
    for row in range(rows):
        of_row = lowest[min(row // (rows // down), down - 1)]
        for block in range(across):
            first = block * (columns // across)
            last = columns if block == across - 1 else first + columns // across
            part, limit, some = pixels[row, first:last], of_row[block], False
            # The comparison of all pixels without branches takes a fraction of the time of a search.
            for column in range(len(part)):
                some |= part[column] >= limit
            for column in range(len(part) if some else 0):
                if part[column] >= limit:
                    found[count] = row * columns + first + column
                    count += 1
    return found[:count].copy()


def find_bright(pixels: Image, sky: SkyBackground, sigmas: float) -> BrightPixels:
    """Return the pixels of the smoothed frame that exceed the background by `sigmas` standard deviations."""
    rows, columns = pixels.shape
    limit = sky.smooth_level.values + sigmas * sky.smooth_noise.values
    index, smooth = _smoothed_above(np.ascontiguousarray(pixels), limit)
    row, column = np.divmod(index, columns)
    return BrightPixels(index, smooth - sky.smooth_level.at(column, row), (rows, columns))


def _smoothed_above_numpy(pixels: Image, limit: FloatArray) -> tuple[IntArray, Float32Array]:
    """Return the ascending flat indices (m,) of the pixels whose smoothed counts exceed a limit.

    The second returned array has the smoothed counts (m,). The limits at the centres of blocks of pixels are
    `limit` (down, across).
    """
    rows, columns = pixels.shape
    # The limit of each pixel is the product of a row of `down` and a column of `across`.
    down, across = Surface(limit, (rows, columns)).factors()
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
        # In a band of rows, only a few rows of blocks have weights that are not zero.
        weight = down[first : first + count]
        near = np.flatnonzero(weight.any(axis=0))
        np.matmul(weight[:, near], across[near], out=bound)
        above = np.flatnonzero(smooth > bound)
        row, column = np.divmod(above, columns - 2)
        # The last band of rows may overlap the previous band.
        place = (row + first) * columns + column + 1
        new = slice(0, None) if not places or not len(places[-1]) else place > places[-1][-1]
        places.append(place[new])
        values.append(smooth.reshape(-1)[above][new])
    return np.concatenate(places), np.concatenate(values)


@compiled_form_of(_smoothed_above_numpy)
def _smoothed_above(pixels: Image, limit: FloatArray) -> tuple[IntArray, Float32Array]:
    """See `_smoothed_above_numpy`."""
    (rows, columns), (down, across) = pixels.shape, limit.shape
    index, found, count = np.empty(rows * columns, np.int64), np.empty(rows * columns, np.float32), 0
    twice, smooth = np.empty(columns, dtype=np.float32), np.empty(columns, dtype=np.float32)
    bound, limits = np.empty(columns, dtype=np.float32), np.empty((down, columns), dtype=np.float32)
    for column in range(columns):
        left, share = _before(column, columns, across)
        right = min(left + 1, across - 1)
        for block in range(down):
            limits[block, column] = limit[block, left] * (1.0 - share) + limit[block, right] * share
    for row in range(1, rows - 1):
        first, share = _before(row, rows, down)
        one, other, second = np.float32(1.0 - share), np.float32(share), min(first + 1, down - 1)
        for column in range(columns):
            above, own = np.float32(pixels[row - 1, column]), np.float32(pixels[row, column])
            twice[column] = (above + own) + (own + np.float32(pixels[row + 1, column]))
            bound[column] = one * limits[first, column] + other * limits[second, column]
        for column in range(1, columns - 1):
            smooth[column] = (twice[column - 1] + twice[column]) + (twice[column] + twice[column + 1])
        for start in range(1, columns - 1, _SEGMENT):
            stop, some = min(start + _SEGMENT, columns - 1), False
            part, least = smooth[start:stop], bound[start:stop]
            for k in range(len(part)):
                some |= part[k] > least[k]
            for k in range(len(part) if some else 0):
                if part[k] > least[k]:
                    index[count], found[count] = row * columns + start + k, part[k]
                    count += 1
    return index[:count].copy(), found[:count].copy()


@loop_helper
def _before(pixel: int, pixels: int, blocks: int) -> tuple[int, float]:
    """Return the last block centre before a pixel of a side, and its distance (see `place_among_blocks`)."""
    size = pixels // blocks
    place = min(max((pixel - 0.5 * (size - 1)) / size, 0.0), blocks - 1.0)
    return int(place), place - int(place)


def _smoothed_at_numpy(pixels: Image, row: IntArray, column: IntArray) -> Float32Array:
    """Return the smoothed frame at evenly spaced rows (r,) and columns (c,), as (r, c)."""
    total = np.zeros((len(row), len(column)), dtype=np.float32)
    for dy in (-1, 0, 1):
        rows = slice(row[0] + dy, row[-1] + dy + 1, _STRIDE)
        for dx in (-1, 0, 1):
            part = pixels[rows, column[0] + dx : column[-1] + dx + 1 : _STRIDE]
            total += np.float32((2 - abs(dy)) * (2 - abs(dx))) * part
    return total


@compiled_form_of(_smoothed_at_numpy)
def _smoothed_at(pixels: Image, row: IntArray, column: IntArray) -> Float32Array:
    """See `_smoothed_at_numpy`."""
    out, twice = np.empty((len(row), len(column)), dtype=np.float32), np.empty(pixels.shape[1], np.float32)
    for i in range(len(row)):
        above, own, below = pixels[row[i] - 1], pixels[row[i]], pixels[row[i] + 1]
        for k in range(len(twice)):
            twice[k] = np.float32(above[k]) + np.float32(2.0) * np.float32(own[k]) + np.float32(below[k])
        for j in range(len(column)):
            k = column[j]
            out[i, j] = twice[k - 1] + np.float32(2.0) * twice[k] + twice[k + 1]
    return out


def _tails(sample: Image, level: FloatArray, noise: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return the length of each block's upper noise tail, and a mask of the blocks with clipped noise.

    In a normal distribution, 2.3 % of the pixels of a block exceed the mean by more than two standard
    deviations, and 2.3 % are below the mean by more than two standard deviations. If the sky is clipped at
    zero counts, its moments underestimate the noise. For each block, the median over the 3 x 3 blocks around
    it is used, because a few stars hardly change the median. A textured foreground has a long tail, whereas
    the sky beside it has no long tail. The length of the upper noise tail is relative to that of a normal
    distribution, and is at least 1.
    """
    (rows, columns), (down, across) = sample.shape, level.shape
    last = (rows // down) * (columns // across) - 1
    high = min(last, int(TAIL_PART * (last + 1)))
    # Only 32-bit values are sorted with vector instructions, which have no mispredicted branches.
    ordered = np.sort(in_blocks(sample, down, across).astype(np.float32), axis=-1)
    tail = np.maximum(1.0, 0.5 * (ordered[..., high] - level) / noise)
    reach = median_of_neighbours((level - ordered[..., last - high]) / noise)
    return median_of_neighbours(tail), one_sided(reach * noise, noise)


Method = Literal["psf", "window", "weighted", "gaussian", "iterative"]


CENTROIDS: tuple[Method, ...] = get_args(Method)


PSF_SIGMAS = 0.3, 6.0
"""Range of the standard deviation of the PSF, px, that star detection accepts."""
GAINS, SATURATIONS = (1e-6, 1e6), (1e-6, 1e9)
"""Ranges of the gain, electrons per count, and of the saturation, counts, that star detection accepts."""


def accepted_psf(psf_sigma: float) -> float:
    """Return a measured standard deviation of the PSF, px, limited to the range `PSF_SIGMAS`."""
    return min(max(psf_sigma, PSF_SIGMAS[0]), PSF_SIGMAS[1])


@dataclass(frozen=True, slots=True)
class DetectionSettings:
    """Settings of star detection; the defaults suit an unknown camera.

    Attributes:
        method: `psf` fits the point spread function (PSF), `window` computes the centre of mass (Michalski,
            eq. (12) to (21)), and the other methods weight the pixels of the window (`measurement`).
        threshold_sigmas: minimum height of a peak in the smoothed frame, in standard deviations of its noise.
        most_stars: maximum number of stars, the brightest first. Each sixteenth of the frame's area
            contributes at most three eighths of `most_stars`, or four stars if this is more.
        psf_sigma: standard deviation of the PSF, px. If `psf_sigma` is None, it is measured in the frame,
            which needs several stars. For tracking windows with few stars, `psf_sigma` should be stated.
        gain: electrons per count, or None to measure the gain from the residuals of the stars.
        saturation: counts at which a pixel saturates. If `saturation` is None, the frame saturates at its
            highest count if several pixels have that count, otherwise at the maximum of the integer type.
        window: side length of the centroid window, px, an odd number (a_ROI in Michalski, eq. (12) to (15)).
        search_radius: radius around a predicted position in which `measure_near` searches, px.
    """

    method: Method = "psf"
    threshold_sigmas: float = 5.0
    most_stars: int = 60
    psf_sigma: float | None = None
    gain: float | None = None
    saturation: float | None = None
    window: int = 7
    search_radius: float = 4.0

    def __post_init__(self) -> None:
        if self.method not in CENTROIDS:
            raise ArgumentError("method", f"{brief(self.method)}: give {', '.join(CENTROIDS)}")
        for name, low, high in (
            ("threshold_sigmas", 1.0, 100.0),
            ("most_stars", 1, 10_000),
            ("psf_sigma", *PSF_SIGMAS),
            ("gain", *GAINS),
            ("saturation", *SATURATIONS),
            ("search_radius", 1.0, 50.0),
        ):
            value = getattr(self, name)
            if value is not None and not (
                isinstance(value, int | float | np.number) and low <= value <= high
            ):
                raise ArgumentError(name, f"{brief(value)}: give {low} to {high}")
        if not (
            isinstance(self.window, int | float | np.number)
            and 5 <= self.window <= 31
            and self.window % 2 != 0
        ):
            raise ArgumentError("window", f"{brief(self.window)}: give an odd number of pixels, 5 to 31")

    def in_units_of(self, unit: float, zero: float = 0.0) -> DetectionSettings:
        """Return the settings for a frame from which `zero` was subtracted and that was divided by `unit`."""
        if unit == 1.0 and zero == 0.0:
            return self
        gain, saturation = self.gain, self.saturation
        if gain is not None:
            gain = min(max(gain_in_counts(gain, unit), GAINS[0]), GAINS[1])
        if saturation is not None:
            saturation = min(max((saturation - zero) / unit, SATURATIONS[0]), SATURATIONS[1])
        return replace(self, saturation=saturation, gain=gain)


_BLOCK = 32


class FrameKind(Enum):
    """The kind of a frame: stars are points, stars are streaks, or neither."""

    POINTS = "points"
    STREAKS = "streaks"
    NEITHER = "neither"


@dataclass(frozen=True, slots=True)
class FrameShape:
    """The kind of a frame, and the median length of its streaks, px, which is about 0 for points."""

    kind: FrameKind
    length: float


@dataclass(frozen=True, slots=True, eq=False)
class Areas:
    """The n connected areas of bright pixels of a frame, and their m pixels.

    Attributes:
        row, column: row and column of each pixel (m,).
        owner: index of the area to which each pixel belongs (m,).
        smooth: counts of the smoothed frame above the background at each pixel (m,).
        peak: mask of the pixels that are local maxima of the smoothed frame (m,).
        saturated: mask of the saturated pixels (m,).
        ceiling: counts at which pixels saturate; infinite if unknown.
        pixels: number of pixels of each area (n,).
        flux: sum of the counts above the background of each area (n,).
        centre: centroid of each area (n, 2), px.
        length: length of a uniform line that, blurred by the PSF, has the same second moments as each area
            (n,), px.
        thickness: rms width of each area across its long axis (n,), px.
        direction: angle between the long axis of each area and the rows (n,), rad.
        shape: rows and columns of the frame.
    """

    row: IntArray
    column: IntArray
    owner: IntArray
    smooth: FloatArray
    peak: BoolArray
    saturated: BoolArray
    ceiling: float
    pixels: IntArray
    flux: FloatArray
    centre: FloatArray
    length: FloatArray
    thickness: FloatArray
    direction: FloatArray
    shape: tuple[int, int]

    def __len__(self) -> int:
        return len(self.flux)


def find_areas(pixels: Image, sky: SkyBackground, bright: BrightPixels, saturation: float | None) -> Areas:
    """Return the 8-connected areas of bright pixels, with moments of the counts above the background."""
    owner, count = label_pixels(bright.index, bright.shape[1])
    row, column = np.divmod(bright.index, bright.shape[1])
    counts = pixels[row, column].astype(np.float64)
    light = np.maximum(counts - sky.level.at(column, row), 0.0)
    found = moments(owner, column, row, light, count)
    ceiling = saturation_of_bright(counts, pixels, saturation)
    return Areas(
        row,
        column,
        owner,
        bright.smooth,
        _local_maxima(bright.index, bright.smooth, bright.shape[1]),
        counts >= ceiling,
        ceiling,
        np.bincount(owner, minlength=count),
        found.flux,
        found.centre,
        found.length,
        found.thickness,
        found.direction,
        bright.shape,
    )


def cluttered(areas: Areas, place: IntArray, share: float) -> BoolArray:
    """Return which pixels `place` (p, 2) are in a block of 32 x 32 px with many bright pixels.

    A block has many bright pixels if their fraction exceeds `share`. Grids of blocks that are displaced by
    half a block along rows, along columns, or along both are also tested.
    """
    return _cluttered(areas.row, areas.column, np.ascontiguousarray(place), *areas.shape, share)


def _cluttered_numpy(
    bright_row: IntArray, bright_column: IntArray, place: IntArray, rows: int, columns: int, share: float
) -> BoolArray:
    """See `cluttered`; the bright pixels have the rows and columns (m,)."""
    down, across = rows // _BLOCK + 2, columns // _BLOCK + 2
    found = np.zeros(len(place), dtype=bool)
    for shift_y in (0, _BLOCK // 2):
        for shift_x in (0, _BLOCK // 2):
            block = (bright_row + shift_y) // _BLOCK * across + (bright_column + shift_x) // _BLOCK
            filled = np.bincount(block, minlength=down * across)
            own = (place[:, 1] + shift_y) // _BLOCK * across + (place[:, 0] + shift_x) // _BLOCK
            found |= filled[own] > share * _BLOCK**2
    return found


@compiled_form_of(_cluttered_numpy)
def _cluttered(
    bright_row: IntArray, bright_column: IntArray, place: IntArray, rows: int, columns: int, share: float
) -> BoolArray:
    """See `_cluttered_numpy`."""
    half = _BLOCK // 2
    filled, found = (
        np.zeros((rows // half + 4, columns // half + 4), np.int64),
        np.zeros(len(place), np.bool_),
    )
    for k in range(len(bright_row)):
        filled[bright_row[k] // half, bright_column[k] // half] += 1
    for k in range(len(place)):
        down, across = place[k, 1] // half, place[k, 0] // half
        # In each of the four grids, the block that contains the pixel consists of four half-sized blocks.
        for top in (down - down % 2, down - (down + 1) % 2):
            for left in (across - across % 2, across - (across + 1) % 2):
                bright = 0
                for row in range(max(top, 0), top + 2):
                    for column in range(max(left, 0), left + 2):
                        bright += filled[row, column]
                found[k] |= bright > share * _BLOCK**2
    return found


def _local_maxima_numpy(index: IntArray, smooth: FloatArray, columns: int) -> BoolArray:
    """Return which bright pixels (m,) are local maxima; of equal neighbours, only the last is a maximum.

    The array `index` (m,) contains the increasing indices of the bright pixels in the flattened frame. Pixels
    that are not in `index` are below the noise threshold and never exceed a bright pixel. The outermost
    columns never contain bright pixels, so pixels at opposite borders of the frame are never compared.
    """
    pairs = []
    for step in (1, columns - 1, columns, columns + 1):
        other = np.searchsorted(index, index + step)
        other[other == len(index)] = 0
        lower = np.flatnonzero(index[other] == index + step) if len(index) else other
        pairs.append((lower, other[lower]))
    first, second = (np.concatenate(each) for each in zip(*pairs, strict=True))
    best = np.ones(len(smooth), dtype=bool)
    best[first[smooth[first] <= smooth[second]]] = False
    best[second[smooth[second] < smooth[first]]] = False
    return best


@compiled_form_of(_local_maxima_numpy)
def _local_maxima(index: IntArray, smooth: FloatArray, columns: int) -> BoolArray:
    """See `_local_maxima_numpy`."""
    best = np.ones(len(smooth), dtype=np.bool_)
    for step in (1, columns - 1, columns, columns + 1):
        other = 0
        for k in range(len(index)):
            while other < len(index) and index[other] < index[k] + step:
                other += 1
            if other < len(index) and index[other] == index[k] + step:
                best[k] &= smooth[k] > smooth[other]
                best[other] &= smooth[other] >= smooth[k]
    return best


# Number of the brightest areas by which a frame is classified as points or streaks.
_LOOKED_AT = 20
_LEAST_PIXELS = 4
_SHORTEST_STREAK = 5.0
_SLENDER = 3.5
_LEAST_STREAKS = 4
_STREAKED_PART = 0.4
_ROUND = 3.0
_THICKEST = 6.0
# Median sine of the angle between streaks and image flow, above which they are lines of a foreground.
_CROOKED = 0.12


def is_streak(areas: Areas) -> BoolArray:
    """Return which areas (n,) are long and thin."""
    return np.asarray((areas.length > _SHORTEST_STREAK) & (areas.length > _SLENDER * areas.thickness))


def frame_shape(areas: Areas) -> FrameShape:
    """Return the kind of a frame.

    The kind is STREAKS if at least four, and at least 40 %, of the brightest areas are streaks that follow
    one rotation of the camera.
    """
    chosen = np.argsort(-areas.flux, kind="stable")[: 3 * _LOOKED_AT]
    usable = (areas.pixels[chosen] >= _LEAST_PIXELS) & (areas.thickness[chosen] < _THICKEST)
    chosen = chosen[usable][:_LOOKED_AT]
    streaks = is_streak(areas)[chosen]
    points = areas.length[chosen] < _ROUND * np.maximum(areas.thickness[chosen], 1.0)
    long, short = int(np.count_nonzero(streaks)), int(np.count_nonzero(points & ~streaks))
    if (
        long >= _LEAST_STREAKS
        and long >= _STREAKED_PART * (long + short)
        and share_one_rotation(areas.centre[chosen][streaks], areas.direction[chosen][streaks])
    ):
        return FrameShape(FrameKind.STREAKS, median(areas.length[chosen][streaks]))
    if short:
        return FrameShape(FrameKind.POINTS, median(areas.length[chosen][points & ~streaks]))
    return FrameShape(FrameKind.NEITHER, 0.0)


def share_one_rotation(centre: FloatArray, direction: FloatArray) -> bool:
    """Return whether n lines in the image are parallel to the image flow of one rotation.

    Near the boresight, a rotation displaces the image at (x, y) by t + w (-y, x), with a vector t and a
    number w. If a line in the image is parallel to the flow of a rotation, the component of the flow along
    the line's normal is zero. The best t and w follow from a singular value decomposition.
    """
    middle = centre.mean(axis=0)
    scale = float(np.abs(centre - middle).max()) or 1.0
    x, y = ((centre - middle) / scale).T
    normal = np.stack([-np.sin(direction), np.cos(direction)], axis=-1)
    products = np.column_stack([normal, normal[:, 1] * x - normal[:, 0] * y])
    tx, ty, turn = np.linalg.svd(products)[2][-1]
    flow = np.stack([tx - turn * y, ty + turn * x], axis=-1)
    speed = np.maximum(np.linalg.norm(flow, axis=1), 1e-12)
    return bool(np.median(np.abs(np.sum(flow * normal, axis=1)) / speed) < _CROOKED)


@dataclass(frozen=True, slots=True, eq=False)
class Survey:
    """The sky background of a frame and the areas above the noise.

    Attributes:
        pixels: frame in counts (rows, columns); hot pixels are replaced if there are many.
        unit: brightness of one count in `pixels`, in the unit of the original frame.
        settings: detection settings, converted to counts.
        sky: sky background and noise.
        areas: connected areas above the noise.
    """

    pixels: Image
    unit: float
    settings: DetectionSettings
    sky: SkyBackground
    areas: Areas

    @property
    def shape(self) -> FrameShape:
        """Whether the areas of the frame are points or streaks."""
        return frame_shape(self.areas)


def survey(pixels: Image, settings: DetectionSettings | None = None) -> Survey:
    """Return the sky background of a frame (rows, columns) and its areas above the noise.

    Raises ValueError unless the pixels are finite real numbers and the frame has at least 16 x 16 pixels.
    """
    pixels, unit = in_counts(pixels)
    settings = (settings or DetectionSettings()).in_units_of(unit)
    pixels, background = without_hot_pixels(pixels, settings.most_stars)
    sky = measure_sky(pixels, background)
    bright = find_bright(pixels, sky, settings.threshold_sigmas)
    return Survey(pixels, unit, settings, sky, find_areas(pixels, sky, bright, settings.saturation))
