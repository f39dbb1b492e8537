"""Bright regions, hot pixels and saturation of a frame of point stars or streaks.

A hot pixel is a bright pixel with dark neighbours. A point of light cannot cause a bright pixel with dark
neighbours, because the optics spread its light over several pixels. If a star's image has a standard
deviation of more than 0.5 px, the four neighbours of its brightest pixel have at least 15 % of the intensity
of that pixel. Methods that need an image without gaps replace only those hot pixels that are detected with
certainty. Fits of models to pixels exclude all suspected hot pixels. A fit is hardly affected if a pixel of a
star is excluded by mistake.

A frame that shows no scene is dead (all pixels are equal) or overexposed. Counts are multiples of 257 if
8-bit counts were stored as 16 bits, and multiples of 16 if 12-bit counts were stored as 16 bits. Colour
images are converted to grey values, and images of any numeric type to counts.

Bins of pixels (`Bins`) show a wide or defocused star as a single spot.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from knightcube.astro.arrays import (
    BoolArray,
    FloatArray,
    Image,
    IntArray,
    check_type,
    checked_number,
    median,
)
from knightcube.compiled import compiled_form_of, loop_helper
from knightcube.errors import ArgumentError
from knightcube.vision.background import MAD_TO_SIGMA

_STRETCH = 32_768
"""Number of pixels that are summed in one step, small enough for the processor's cache."""
_AT_ONCE = 32
"""Number of pixels that are compared with a threshold in one step."""


def box_sum(image: Image) -> Image:
    """Return the sums over the 3 x 3 pixels around each pixel (rows, columns), with zeros at the border."""
    return _box_sum(np.ascontiguousarray(image))


def _box_sum_numpy(image: Image) -> Image:
    """See `box_sum`; the image is contiguous."""
    columns, flat = image.shape[1], image.reshape(-1)
    total = np.empty(image.shape, dtype=image.dtype)
    sums = total.reshape(-1)
    # Rows adjoin in the flat array, so that the sums at the border are wrong and are set to zero.
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


@compiled_form_of(_box_sum_numpy)
def _box_sum(image: Image) -> Image:
    """See `box_sum`; the image is contiguous."""
    rows, columns = image.shape
    total, down = np.zeros_like(image), np.empty_like(image[0])
    for row in range(1, rows - 1):
        for column in range(columns):
            down[column] = image[row - 1, column] + image[row, column] + image[row + 1, column]
        for column in range(1, columns - 1):
            total[row, column] = down[column - 1] + down[column] + down[column + 1]
    return total


@dataclass(frozen=True, slots=True, eq=False)
class Moments:
    """Brightness moments of n regions.

    Attributes:
        flux: sum of the counts above the background in each region (n,).
        centre: centroid of each region (n, 2), x and y, px.
        length: length (n,), px, of the uniform line that has the same second moments as the region. The
            attribute `length` is about 0 for a round region.
        thickness: rms width of each region across its long axis (n,), px.
        direction: angle from the x axis to the long axis of each region (n,), rad.
    """

    flux: FloatArray
    centre: FloatArray
    length: FloatArray
    thickness: FloatArray
    direction: FloatArray


def positions(mask: BoolArray) -> tuple[IntArray, IntArray]:
    """Return rows and columns of the true pixels of a mask, faster than `nonzero` if few pixels are true."""
    row, column = np.divmod(np.flatnonzero(mask), mask.shape[1])
    return row, column


def _label_pixels_numpy(pixel: IntArray, columns: int) -> tuple[IntArray, int]:
    """Numpy form of `label_pixels`.

    Each run of adjacent pixels is linked to an earlier run of the same region, and the links are shortened
    until all runs of a region share one root (Shiloach and Vishkin 1982). An implementation with scipy.sparse
    would need 12 MiB more memory.
    """
    # An empty column is added, so that no run of pixels continues in the next row.
    pixel, columns = pixel + pixel // columns, columns + 1
    first = np.flatnonzero(np.diff(pixel, prepend=-2) > 1)
    length = np.diff(first, append=len(pixel))
    start, stop = pixel[first], pixel[first] + length
    # A run of pixels touches the runs of the next row from one column before to one column after the run.
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


@compiled_form_of(_label_pixels_numpy)
def label_pixels(pixel: IntArray, columns: int) -> tuple[IntArray, int]:
    """Return the region (m,) of each of the ascending flat indices `pixel` (m,), and the number of regions.

    Regions are 8-connected and numbered in the order of their first pixels. The algorithm connects runs of
    adjacent pixels in a row, because there are far fewer runs than pixels.
    """
    number, root = np.empty(len(pixel), dtype=np.int64), np.empty(len(pixel), dtype=np.int64)
    start, stop = np.empty(len(pixel), dtype=np.int64), np.empty(len(pixel), dtype=np.int64)
    runs, row, end, low = 0, 0, 0, 0
    for k in range(len(pixel)):
        if k == 0 or pixel[k] != pixel[k - 1] + 1 or pixel[k] >= end:
            row = pixel[k] // columns
            end = (row + 1) * columns
            # An empty column is added, so that no run of pixels continues in the next row.
            start[runs], root[runs] = pixel[k] + row, runs
            runs += 1
        number[k], stop[runs - 1] = runs - 1, pixel[k] + row + 1
    for run in range(runs):
        # A run touches the runs of the row above from one column before to one column after the run.
        while stop[low] + columns + 1 < start[run]:
            low += 1
        above = low
        while start[above] + columns + 1 <= stop[run]:
            one, other = _root_of(root, run), _root_of(root, above)
            root[max(one, other)] = min(one, other)
            above += 1
    count = 0
    for run in range(runs):
        # The root of a region is its first run, which already has the number of the region.
        if root[run] == run:
            start[run] = count
            count += 1
        else:
            start[run] = start[_root_of(root, run)]
    for k in range(len(pixel)):
        number[k] = start[number[k]]
    return number, count


@loop_helper
def _root_of(root: IntArray, run: int) -> int:
    """Return the first run of the region that contains `run`, and shorten the links to the first run.

    A run is a sequence of adjacent pixels in one row. The array `root` links each run to an earlier run of
    its region.
    """
    while root[run] != run:
        root[run] = root[root[run]]
        run = root[run]
    return run


def moments(owner: IntArray, column: IntArray, row: IntArray, light: FloatArray, count: int) -> Moments:
    """Return the moments of `count` regions from the region index, the position and the counts of m pixels.

    The moments of a region with zero flux are zero.
    """
    flux, x, y, xx, yy, xy = _moment_sums(owner, column, row, light, count)
    # The point spread function (PSF) increases both principal moments by the same amount.
    # For a uniform line of length L and any round PSF, the difference of the principal moments is L^2/12.
    spread = np.hypot(xx - yy, 2.0 * xy)
    return Moments(
        flux,
        np.stack([x, y], axis=-1),
        np.sqrt(12.0 * spread),
        np.sqrt(np.maximum(0.5 * (xx + yy - spread), 0.0)),
        0.5 * np.arctan2(2.0 * xy, xx - yy),
    )


def _moment_sums_numpy(
    owner: IntArray, column: IntArray, row: IntArray, light: FloatArray, count: int
) -> FloatArray:
    """Return flux, centroid (x, y) and second moments (xx, yy, xy) of regions (6, count); see `moments`."""
    flux = np.bincount(owner, light, count).astype(np.float64)
    whole = np.where(flux > 0.0, flux, np.inf)
    x, y = np.bincount(owner, light * column, count) / whole, np.bincount(owner, light * row, count) / whole
    dx, dy = column - x[owner], row - y[owner]
    xx = np.bincount(owner, light * dx * dx, count) / whole
    yy = np.bincount(owner, light * dy * dy, count) / whole
    return np.stack([flux, x, y, xx, yy, np.bincount(owner, light * dx * dy, count) / whole])


@compiled_form_of(_moment_sums_numpy)
def _moment_sums(
    owner: IntArray, column: IntArray, row: IntArray, light: FloatArray, count: int
) -> FloatArray:
    """See `_moment_sums_numpy`."""
    sums = np.zeros((6, count))
    for p in range(len(owner)):
        own, counts = owner[p], float(light[p])
        sums[0, own] += counts
        sums[1, own] += counts * column[p]
        sums[2, own] += counts * row[p]
    for own in range(count):
        whole = sums[0, own] if sums[0, own] > 0.0 else np.inf
        sums[1, own] /= whole
        sums[2, own] /= whole
    for p in range(len(owner)):
        own, counts = owner[p], float(light[p])
        dx, dy = column[p] - sums[1, own], row[p] - sums[2, own]
        sums[3, own] += counts * dx * dx
        sums[4, own] += counts * dy * dy
        sums[5, own] += counts * dx * dy
    for own in range(count):
        whole = sums[0, own] if sums[0, own] > 0.0 else np.inf
        for k in range(3, 6):
            sums[k, own] /= whole
    return sums


def line_of(centre: FloatArray, covariance: FloatArray, least_length: float) -> FloatArray:
    """Return the ends (2, 2), px, of the uniform line with a given `centre` (2,) and `covariance` (2, 2).

    If the line is not longer than `least_length`, px, both ends are at the centre. The second moments
    `covariance` are in px^2.
    """
    (across, along), axes = np.linalg.eigh(covariance)
    length = float(np.sqrt(12.0 * max(along - across, 0.0)))
    half = 0.5 * length * axes[:, 1] if length > least_length else np.zeros(2)
    return np.stack([centre - half, centre + half])


_SHARPNESS, _NOISE, _MOST = 0.15, 3.0, 0.3
"""Upper limits of the brightness of the eight neighbours of a hot pixel.

Each neighbour of a hot pixel must be darker than `_SHARPNESS` times the brightness of the hot pixel plus
`_NOISE` standard deviations of the noise, and darker than `_MOST` times the brightness of the hot pixel.
"""
_PAIR, _PAIR_NOISE = 20.0, 1.0
"""Thresholds (noise standard deviations) for the recognition of two adjacent hot pixels.

The brighter of the two hot pixels must be brighter than `_PAIR` standard deviations of the noise. The other
seven pixels of the window must be darker than `_SHARPNESS` times the brighter hot pixel plus `_PAIR_NOISE`
standard deviations of the noise.
"""
_REPAIR_SIGMAS, HOT_SIGMAS = 10.0, 8.0
"""Minimum brightness (noise standard deviations) of replaced hot pixels, and of excluded hot pixels."""
_AROUND = tuple((dr, dc) for dr in (-1, 0, 1) for dc in (-1, 0, 1) if (dr, dc) != (0, 0))


def repair_hot_pixels(signal: Image, noise: Image) -> int:
    """Replace hot pixels of `signal` (rows, columns) by their neighbours' median, and return their number.

    Only pixels well above the noise, whose standard deviation is `noise` (rows, columns), are tested.
    """
    row, column = find_hot_pixels(signal, np.square(noise), float(noise.min()) ** 2)
    bright = signal[row, column] > _REPAIR_SIGMAS * noise[row, column]
    row, column = row[bright], column[bright]
    signal[row, column] = np.median([signal[row + dr, column + dc] for dr, dc in _AROUND], axis=0)
    return len(row)


def _find_hot_pixels_numpy(signal: Image, variance: Image, least: float) -> tuple[IntArray, IntArray]:
    """See `find_hot_pixels`."""
    row, column = positions(signal > np.float32(HOT_SIGMAS * np.sqrt(least)))
    return _hot_among_numpy(signal, row, column, np.sqrt(variance[row, column]), np.zeros(len(row)))


@compiled_form_of(_find_hot_pixels_numpy)
def find_hot_pixels(signal: Image, variance: Image, least: float) -> tuple[IntArray, IntArray]:
    """Return rows and columns of the hot pixels of `signal` that are well above the noise.

    The array `variance` (rows, columns) is the noise variance of each pixel, which is at least `least`.
    """
    rows, columns = signal.shape
    found, count = np.empty((2, rows * columns), dtype=np.int64), 0
    lowest = np.float32(HOT_SIGMAS * math.sqrt(least))
    for row in range(1, rows - 1):
        for begin in range(1, columns - 1, _AT_ONCE):
            stop = min(begin + _AT_ONCE, columns - 1)
            if not _any_above(signal[row, begin:stop], lowest):
                continue
            for column in range(begin, stop):
                own = signal[row, column]
                if own > lowest and _is_hot(signal, row, column, math.sqrt(variance[row, column]), 0.0):
                    found[0, count], found[1, count] = row, column
                    count += 1
    return found[0, :count].copy(), found[1, :count].copy()


@loop_helper
def _any_above(values: Image, threshold: np.float32) -> bool:
    """Return whether any of `values` (k,) exceeds the `threshold`, by counting with vector instructions."""
    above = np.int32(0)
    for k in range(len(values)):
        above += np.int32(values[k] > threshold)
    return bool(above > 0)


@loop_helper
def _is_hot(signal: Image, row: int, column: int, noise: float, level: float) -> bool:
    """Return whether one pixel, not at the border of the frame, is hot, by the criteria of `are_hot`."""
    own = float(signal[row, column]) - level
    if own <= HOT_SIGMAS * noise:
        return False
    brighter, highest, second, third = 0, -np.inf, -np.inf, -np.inf
    for r in range(row - 1, row + 2):
        for c in range(column - 1, column + 2):
            value = float(signal[r, c]) - level
            brighter += value > own
            third = max(third, min(second, value))
            second = max(second, min(highest, value))
            highest = max(highest, value)
    alone = second < min(_SHARPNESS * highest + _NOISE * noise, _MOST * highest)
    pair = highest > _PAIR * noise and third < _SHARPNESS * highest + _PAIR_NOISE * noise
    return brighter <= 1 and (alone or pair)


def _are_hot_numpy(light: FloatArray, noise: FloatArray) -> BoolArray:
    """Return whether each of n windows of nine pixels contains one or two hot pixels, but no point of light.

    The columns of `light` (9, n) are the windows, in counts above the background, and `noise` (n,) is the
    standard deviation of the noise of a pixel in each window.
    """
    third, second, highest = np.partition(light, (6, 7, 8), axis=0)[6:]
    alone = second < np.minimum(_SHARPNESS * highest + _NOISE * noise, _MOST * highest)
    pair = (highest > _PAIR * noise) & (third < _SHARPNESS * highest + _PAIR_NOISE * noise)
    return np.asarray(alone | pair)


@compiled_form_of(_are_hot_numpy)
def are_hot(light: FloatArray, noise: FloatArray) -> BoolArray:
    """See `_are_hot_numpy`."""
    found = np.empty(len(noise), dtype=np.bool_)
    for k in range(len(noise)):
        highest, second, third = -np.inf, -np.inf, -np.inf
        for pixel in range(9):
            value = light[pixel, k]
            third = max(third, min(second, value))
            second = max(second, min(highest, value))
            highest = max(highest, value)
        alone = second < min(_SHARPNESS * highest + _NOISE * noise[k], _MOST * highest)
        pair = highest > _PAIR * noise[k] and third < _SHARPNESS * highest + _PAIR_NOISE * noise[k]
        found[k] = alone or pair
    return found


def _hot_among_numpy(
    signal: Image, row: IntArray, column: IntArray, noise: FloatArray, level: FloatArray
) -> tuple[IntArray, IntArray]:
    """Return rows and columns of the hot pixels among m pixels that are well above their `noise` (m,).

    The background `level` (m,) is subtracted from each of the m pixels and from its neighbours.
    """
    inside = (row > 0) & (row < signal.shape[0] - 1) & (column > 0) & (column < signal.shape[1] - 1)
    inside &= signal[row, column] - level > HOT_SIGMAS * noise
    row, column, noise, level = row[inside], column[inside], noise[inside], level[inside]
    around = np.stack([signal[row + dr, column + dc] for dr, dc in _AROUND]) - level
    own = signal[row, column] - level
    # A hot pixel has at most one brighter neighbour, because up to two adjacent pixels can be hot.
    hot = _are_hot_numpy(np.concatenate([around, own[None]]), noise) & (
        np.count_nonzero(around > own, axis=0) <= 1
    )
    return row[hot], column[hot]


@compiled_form_of(_hot_among_numpy)
def hot_among(
    signal: Image, row: IntArray, column: IntArray, noise: FloatArray, level: FloatArray
) -> tuple[IntArray, IntArray]:
    """See `_hot_among_numpy`."""
    found, count = np.empty(len(row), dtype=np.int64), 0
    for k in range(len(row)):
        inside = 0 < row[k] < signal.shape[0] - 1 and 0 < column[k] < signal.shape[1] - 1
        if inside and _is_hot(signal, row[k], column[k], noise[k], level[k]):
            found[count] = k
            count += 1
    return row[found[:count]], column[found[:count]]


_DEAD_FRACTION = 1e-4
"""Largest fraction of pixels, such as hot pixels, that differ from the median in a dead frame."""
_PLATEAU = 6
"""Minimum number of pixels with the highest count in a saturated frame of streaks."""
_LEAST_PLATEAU, _PILED_UP, _PLATEAU_REACH = 4, 2.0, 0.02
"""Limits for the recognition of saturation in a frame of point stars.

In a saturated frame, at least `_LEAST_PLATEAU` pixels have the highest count, and their number is more than
`_PILED_UP` times the number of pixels with slightly smaller counts. Slightly smaller counts are below the
highest count by at most `_PLATEAU_REACH` times the difference between the highest count and the median, or by
at most one count if this is more.
"""


LUMINANCE = np.array([0.299, 0.587, 0.114])
"""Weights of red, green and blue in the luminance (ITU-R BT.601)."""


LEAST_SIDE = 16
"""Minimum number of rows and of columns of an image."""
# Noise (counts) to which an image of floating-point numbers is scaled.
_FLOATING_NOISE = 16.0
# Minimum noise (electrons) of a pixel of any camera, even in the mean of many images.
_LEAST_NOISE = 0.1
# Count above which a float32, the data type of processed frames, cannot represent every integer.
_INEXACT = 1 << 24
# Largest pixel value of an image of floating-point numbers, whose square has single precision.
_MOST_LIGHT = 1e18
# Largest number of counts of an image of floating-point numbers.
_MOST_COUNTS = float(1 << 31)


def grey_image(pixels: npt.ArrayLike) -> Image:
    """Return an image (rows, columns) of grey values from an array of grey or colour pixels.

    A grey image (rows, columns) is returned unchanged, except for its byte order and the precision of its
    floating-point numbers. Colours (rows, columns, 3) in the order red, green and blue, with or without a
    fourth channel of transparency, are converted to luminance (ITU-R BT.601) of the same type; transparency
    is ignored. A third axis of length 1, or of 2 for grey and transparency, is removed. Raises ArgumentError
    for an array of any other shape, for masked pixels, and for pixels that `check_pixels` rejects.
    """
    if isinstance(pixels, (str, Path)):
        raise ArgumentError(
            "image", f"{pixels}: give an array of pixels, such as read_image({str(pixels)!r})"
        )
    if np.ma.is_masked(pixels):
        masked = np.count_nonzero(np.ma.getmaskarray(np.ma.asarray(pixels)))
        raise ArgumentError(
            "image", f"{masked} masked pixels: fill them, such as image.filled(np.ma.median(image))"
        )
    try:
        image = np.asarray(pixels)
    except ValueError as error:
        raise ArgumentError("image", f"{error}: give an array (rows, columns)") from None
    if image.dtype.kind == "f" and image.itemsize not in (4, 8):
        # The noise of a float16 image overflows its type, and compiled code does not support long double.
        image = image.astype(np.float32 if image.itemsize < 4 else np.float64)
    image = image.astype(image.dtype.newbyteorder("="), copy=False)
    if image.ndim == 3 and image.shape[2] in (1, 2):
        image = image[..., 0]
    elif image.ndim == 3 and image.shape[2] in (3, 4):
        check_pixels(image[..., 0])
        image = grey_of_planes(np.moveaxis(image[..., :3], -1, 0))
    elif image.ndim != 2:
        raise ArgumentError(
            "image",
            f"an array of shape {image.shape}: give (rows, columns), or (rows, columns, 3) for colours",
        )
    check_pixels(image)
    return image


def check_pixels(image: Image) -> None:
    """Raise ArgumentError unless an image (rows, columns) has 16 x 16 or more finite real numbers.

    Pixel values above `_MOST_LIGHT` are refused too.
    """
    if image.ndim != 2 or min(image.shape) < LEAST_SIDE:
        raise ArgumentError(
            "image", f"an array of shape {image.shape}: give (rows, columns), {LEAST_SIDE} or more each"
        )
    if image.dtype.kind not in "uif":
        raise ArgumentError("image", f"pixels of {image.dtype}: give integers or floating-point numbers")
    if image.dtype.kind == "f" and not np.all(np.isfinite(image)):
        bad = np.count_nonzero(~np.isfinite(image))
        raise ArgumentError(
            "image", f"{bad} pixels are not finite: replace them, such as by the median of the other pixels"
        )
    if image.dtype.kind == "f" and max(-image.min(), image.max()) > _MOST_LIGHT:
        raise ArgumentError("image", f"pixels from {image.min():g} to {image.max():g}: scale them down")


def count_of_floats(image: Image) -> float:
    """Return the size of a count at which the noise of floating-point pixels is `_FLOATING_NOISE` counts."""
    sample = image[::4, ::4].astype(float)
    spread = MAD_TO_SIGMA * float(np.median(np.abs(sample - np.median(sample))))
    return (spread or float(sample.std()) or 1.0) / _FLOATING_NOISE


EXPOSURES = 1e-6, 1e5
"""Shortest and longest accepted exposure time, s."""


def checked_exposure(exposure: float) -> float:
    """Return an exposure time (s). Raises ArgumentError unless it is a number within `EXPOSURES`."""
    seconds = checked_number("exposure", exposure, "seconds")
    if not EXPOSURES[0] <= seconds <= EXPOSURES[1]:
        raise ArgumentError("exposure", f"{seconds:g}: give {EXPOSURES[0]:g} to {EXPOSURES[1]:g} seconds")
    return seconds


LONGEST_LINE_TIME = 0.01
"""Largest accepted line time of a rolling shutter, s per row."""


def check_detector(settings: Any, kind: type[object]) -> None:
    """Raise ArgumentError if `settings`, of the class `kind`, do not describe a possible detector and lens.

    Gain, saturation and width of the point spread must be positive, and the line time must be short.
    """
    check_type("settings", settings, kind)
    checked_number("settings.gain", settings.gain, "electrons per count")
    checked_number("settings.psf_sigma", settings.psf_sigma, "pixels")
    if settings.saturation is not None and not settings.saturation > 0.0:
        raise ArgumentError("settings.saturation", f"{settings.saturation}: give a positive number of counts")
    line_time = getattr(settings, "line_time", None)
    if line_time is not None and not abs(line_time) <= LONGEST_LINE_TIME:
        raise ArgumentError("settings.line_time", f"{line_time}: give at most {LONGEST_LINE_TIME} s per row")


def gain_in_counts(gain: float, unit: float) -> float:
    """Convert a `gain` from electrons per unit of the pixel values to electrons per count of `raw_counts`.

    If an image was divided by its maximum, a gain of about 1 would mean a noise far below one electron, since
    the pixel values are not counts. In this case, one electron per count is assumed.
    """
    scaled = gain * unit
    return 1.0 if unit != 1.0 and scaled * _FLOATING_NOISE < _LEAST_NOISE else scaled


def raw_counts(image: Image) -> tuple[Image, float, float]:
    """Return an image (rows, columns) as unsigned integers, the unit of a count, and the value of 0 counts.

    A pixel value is the value of 0 counts plus the number of counts times the unit. For whole numbers, the
    unit is 1, and the value of 0 counts is 0 unless a pixel is negative or too large to be exact as a
    float32. Other numbers are rounded to a sixteenth of their noise. Raises ArgumentError if the range of the
    pixels is infinite.
    """
    if image.dtype.kind == "u" and image.itemsize <= 2:
        return image, 1.0, 0.0
    low, high = image.min().item(), image.max().item()
    floating = image.dtype.kind == "f"
    zero = 0 if low >= 0 and high < _INEXACT else low
    if high - zero < _INEXACT and not (floating and np.any(image != np.rint(image))):
        kind = np.uint16 if high - zero <= np.iinfo(np.uint16).max else np.uint32
        # The difference of unsigned integers is exact for every integer type, because it is modular.
        counts = image - zero if floating else image.astype(np.uint64) - np.uint64(zero % (1 << 64))
        return counts.astype(kind), 1.0, float(zero)
    if not math.isfinite(high - low):
        raise ArgumentError(
            "image", f"pixels from {low:g} to {high:g}: their range overflows; scale them down"
        )
    unit = max(count_of_floats(image), (high - low) / _MOST_COUNTS)
    counts = np.rint((image.astype(np.float64) - low) / unit)
    return counts.astype(np.uint32), unit, float(low)


def grey_of_planes(planes: Image) -> Image:
    """Return the luminance (rows, columns) of colour planes (3, rows, columns), in the planes' data type."""
    grey = np.zeros(planes.shape[1:])
    for weight, plane in zip(LUMINANCE, planes, strict=True):
        grey += weight * plane
    return np.asarray((np.rint(grey) if planes.dtype.kind in "iu" else grey).astype(planes.dtype))


class FrameState(Enum):
    """The state of a frame: usable, or the reason why it shows no scene."""

    USABLE = "usable"
    BLACK = "black"
    SATURATED = "saturated"


def frame_state(pixels: Image, saturation: float, saturated_fraction: float) -> FrameState:
    """Return whether a frame (rows, columns) is usable, dead (all pixels are equal) or overexposed.

    A frame is overexposed if at least the fraction `saturated_fraction` of its pixels is saturated.
    """
    if np.count_nonzero(at_least(pixels, saturation)) >= saturated_fraction * pixels.size:
        return FrameState.SATURATED
    some, most = pixels[::8, ::8], _DEAD_FRACTION * pixels.size
    # A comparison in the integer type of the frame is four times as fast as in floating point.
    usual = np.median(some).astype(pixels.dtype)
    # In most frames, more pixels of the sample differ from the median than in a whole dead frame.
    if np.count_nonzero(some != usual) <= most and np.count_nonzero(pixels != usual) <= most:
        return FrameState.BLACK
    return FrameState.USABLE


def saturation_level(pixels: Image, given: float | None) -> float:
    """Return the saturation count: `given`, or the maximum of the integer type, or infinity for floats."""
    if given is not None:
        return given
    return float(np.iinfo(pixels.dtype).max) if pixels.dtype.kind in "ui" else np.inf


def saturation_count(pixels: Image) -> float:
    """Return the saturation count: the highest count if several pixels have it, otherwise the type's maximum.

    The function `saturation_count` is for frames of streaks, in which a bright star covers many pixels.
    """
    highest = pixels.max()
    # A frame with only one value is dead, unless the value is the maximum of its type.
    if _PLATEAU <= np.count_nonzero(pixels == highest) < pixels.size:
        return float(highest)
    return saturation_level(pixels, None)


def saturation_of_bright(counts: FloatArray, pixels: Image, given: float | None) -> float:
    """Return the saturation count of a frame of point stars from any camera.

    The result is `given` if it is not None, otherwise the highest of the `counts` (m,) if it is frequent,
    otherwise the maximum of the pixels' type. In a dim frame, the highest counts are due to noise, and the
    higher a count, the fewer pixels have it. In a saturated frame, the highest count is more frequent than
    the counts just below it.
    """
    top = saturation_level(pixels, given)
    highest = counts.max(initial=-np.inf)
    if given is not None or highest >= top or not len(counts):
        return top
    at_top = int(np.count_nonzero(counts == highest))
    step = max(1.0, _PLATEAU_REACH * float(highest - median(counts)))
    below = int(np.count_nonzero(counts >= highest - step)) - at_top
    flat = at_top >= _LEAST_PLATEAU and at_top > _PILED_UP * below
    return float(highest) if flat else top


def at_least(pixels: Image, level: float) -> BoolArray:
    """Return the mask of the `pixels` with at least `level` counts.

    If the pixels are integers, the level is rounded up to an integer of the same type.
    """
    if not np.issubdtype(pixels.dtype, np.integer) or not 0.0 <= level <= np.iinfo(pixels.dtype).max:
        return np.asarray(pixels >= level)
    return np.asarray(pixels >= pixels.dtype.type(np.ceil(level)))


_STRIDE = 16
"""Distance (px) between the pixels that are sampled to estimate the step between counts."""
_MOST_BETWEEN = 0.01
"""Largest fraction of pixels, such as repaired hot pixels, whose counts are not multiples of the step."""


def in_steps(pixels: Image) -> tuple[Image, int, int]:
    """Return `pixels` (rows, columns) divided by the step between counts, and this step and the offset.

    If the counts have no common step, the pixels are returned unchanged, with the step 1 and the offset 0.
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


@dataclass(frozen=True, slots=True)
class Bins:
    """Bins of `size` x `size` px in an image, in `rows` rows and `columns` columns.

    The first bin begins at the pixel `first` (x, y).
    """

    size: int
    columns: int
    rows: int
    first: tuple[int, int]

    @classmethod
    def centred(cls, shape: tuple[int, ...], size: int) -> Bins | None:
        """Return the bins of an image (rows, columns), with equal margins at opposite sides of the image.

        The optical axis stays in the image centre. Returns None if the image is smaller than a bin, or if
        bins of even `size` would leave unequal margins.
        """
        rows, columns = (_centred_count(length, size) for length in shape)
        down, across = shape[0] - size * rows, shape[1] - size * columns
        if min(rows, columns) < 1 or down % 2 or across % 2:
            return None
        return cls(size, columns, rows, (across // 2, down // 2))

    @property
    def offset(self) -> FloatArray:
        """The position (x, y) of the centre of the first bin, px."""
        return np.array(self.first) + 0.5 * (self.size - 1)

    def blocks(self, image: Image) -> Image:
        """Return the pixels in the bins (rows, size, columns, size)."""
        (x, y), size = self.first, self.size
        inner = image[y : y + self.rows * size, x : x + self.columns * size]
        return inner.reshape(self.rows, size, self.columns, size)

    def sums(self, image: Image) -> Image:
        """Return the binned image (rows, columns), the sums of the pixels in the bins."""
        total: npt.DTypeLike = np.uint32 if image.itemsize <= 2 else np.uint64
        if image.dtype.kind != "u":
            total = np.int64 if image.dtype.kind == "i" else image.dtype
        return np.asarray(self.blocks(image).sum(axis=(1, 3), dtype=total))


def _centred_count(length: int, size: int) -> int:
    """Return the number of bins of `size` px in `length` px; both margins are equal if possible."""
    count = length // size
    return count - 1 if (length - size * count) % 2 and size % 2 else count
