"""Preparation of a frame for the fit: background, noise, unusable pixels, bright regions and PSF width.

If the point spread function (PSF) is several pixels wide, the frame is binned (`Binning`). For a wide PSF, a
fit to a binned frame is as accurate as a fit to the full frame, and takes a fraction of the computing time.
The responses of a colour camera's raw pixels are equalised, and extended sources such as the Earth's limb are
excluded.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from knightcube.astro.arrays import BoolArray, Float32Array, FloatArray, Image, IntArray
from knightcube.compiled import compiled_form_of, loop_helper
from knightcube.vision.background import estimate_background
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.frame import (
    Bins,
    at_least,
    box_sum,
    find_hot_pixels,
    in_steps,
    label_pixels,
    moments,
    saturation_count,
)
from knightcube.vision.streaks.geometry import PIXEL_VARIANCE
from knightcube.vision.streaks.streak_result import LikelihoodSettings, MotionResult

# Step (pixels) at which the noise variance is sampled for the usual noise.
_SPARSE = 97


@dataclass(frozen=True, slots=True, eq=False)
class ReducedFrame:
    """A frame prepared for the fit, as flat arrays of rows * columns pixels, in raw counts.

    Attributes:
        shape: rows, columns.
        signal: counts of each pixel above the background.
        sums: sum of `signal` over the 3 x 3 pixels around each pixel.
        floor: noise variance of each pixel without a star, counts^2.
        counts: raw counts.
        top: smallest raw counts at which a pixel is saturated.
        bad: mask of the saturated and hot pixels, which the fit excludes.
        gain: gain of the camera, electrons per count.
        hot_pixels: number of hot pixels in the frame.
    """

    shape: tuple[int, int]
    signal: Float32Array
    sums: Float32Array
    floor: Float32Array
    counts: Image
    top: float
    bad: BoolArray
    gain: float
    hot_pixels: int

    @property
    def usual_noise(self) -> float:
        """Standard deviation (counts) of the noise of a typical pixel without a star."""
        return float(np.sqrt(np.median(self.floor[::_SPARSE])))


def reduce_frame(pixels: Image, saturation: float | None, gain: float) -> ReducedFrame:
    """Return the frame `pixels` (rows, columns) with its background subtracted and its noise estimated.

    `saturation` is in counts, and `gain` in electrons per count. If `saturation` is None, the saturation
    level is the highest count if several pixels have it, otherwise the maximum of the integer type.
    """
    top = saturation_count(pixels) if saturation is None else saturation
    pixels, step, offset = in_steps(pixels)
    top, gain = (top - offset) / step, gain * step
    background = estimate_background(pixels)
    signal, floor = background.subtracted(pixels)
    bad = at_least(pixels, top)
    hot = find_hot_pixels(signal, floor, float(background.noise.min()) ** 2)
    signal[hot] = 0.0
    bad[hot] = True
    flat = signal.reshape(-1), box_sum(signal).reshape(-1), floor.reshape(-1), pixels.reshape(-1)
    return ReducedFrame((pixels.shape[0], pixels.shape[1]), *flat, top, bad.reshape(-1), gain, len(hot[0]))


# Minimum area (pixels) of a bright region. A single noise peak fills nine pixels of the 3 x 3 sums.
_LEAST_AREA = 12
# Distance (px) by which a bright region extends beyond each end of its streak.
_BORDER = 3


@dataclass(frozen=True, slots=True, eq=False)
class BrightRegions:
    """The n connected regions of bright pixels, in descending order of brightness, and their m pixels.

    Attributes:
        centre: centroid of each region (n, 2), px.
        normal: unit vector in the image perpendicular to each region's long axis (n, 2).
        length: length of the uniform line that has the same second moments as each region (n,), px.
        flux: flux of each region (n,), counts.
        cut: whether each region touches the border of the frame (n,).
        owner, column, row, light: region, position and counts above the background of each pixel (m,).
        lit: fraction of the frame's pixels that exceed the threshold for bright regions.
    """

    centre: FloatArray
    normal: FloatArray
    length: FloatArray
    flux: FloatArray
    cut: BoolArray
    owner: IntArray
    column: IntArray
    row: IntArray
    light: FloatArray
    lit: float

    def __len__(self) -> int:
        return len(self.flux)


def find_bright_regions(frame: ReducedFrame, sigmas: float, most: int) -> BrightRegions:
    """Return up to `most` of the brightest regions with 3 x 3 sums above `sigmas` standard deviations."""
    pixel = _significant(frame.sums, frame.floor, 3.0 * sigmas)
    number, count = label_pixels(pixel, frame.shape[1])
    flux = _fluxes(pixel, number, count, frame.signal)
    chosen = np.argsort(-flux, kind="stable")[:most]
    chosen = chosen[flux[chosen] > 0.0]
    rank = np.full(count, -1)
    rank[chosen] = np.arange(len(chosen))
    owner, column, row, light, cut = _region_pixels(pixel, number, rank, frame.signal, frame.shape)
    found = moments(owner, column, row, light, len(chosen))
    normal = np.stack([-np.sin(found.direction), np.cos(found.direction)], axis=-1)
    shapes, lit = (found.centre, normal, found.length, found.flux), len(pixel) / frame.signal.size
    return BrightRegions(*shapes, cut[: len(chosen)], owner, column, row, light, lit)


def _fluxes_numpy(pixel: IntArray, number: IntArray, count: int, signal: Float32Array) -> FloatArray:
    """Return the counts (count,) of each region, zero for a region that is smaller than `_LEAST_AREA`.

    The other arguments are the flat index and the region of each bright pixel (p,), and the counts of all
    pixels. Pixels with negative counts contribute zero.
    """
    area = np.bincount(number, minlength=count)
    flux = np.bincount(number, np.maximum(signal[pixel], np.float32(0.0)), count)
    return np.where(area < _LEAST_AREA, 0.0, flux)


@compiled_form_of(_fluxes_numpy)
def _fluxes(pixel: IntArray, number: IntArray, count: int, signal: Float32Array) -> FloatArray:
    """See `_fluxes_numpy`."""
    area, flux = np.zeros(count, np.int64), np.zeros(count)
    for p in range(len(pixel)):
        area[number[p]] += 1
        flux[number[p]] += max(float(signal[pixel[p]]), 0.0)
    for region in range(count):
        if area[region] < _LEAST_AREA:
            flux[region] = 0.0
    return flux


_RegionPixels = tuple[IntArray, IntArray, IntArray, FloatArray, BoolArray]
"""Attributes `owner`, `column`, `row` and `light` of `BrightRegions`, and a mask of truncated regions."""


def _region_pixels_numpy(
    pixel: IntArray, number: IntArray, rank: IntArray, signal: Float32Array, shape: tuple[int, int]
) -> _RegionPixels:
    """Return the pixels of the chosen regions, and a mask of the regions truncated by the frame border.

    The arrays `pixel` (p,) and `number` (p,) are the flat index and the region of each bright pixel, and
    `rank` (n,) is the index of each region among the chosen regions, or -1 for any other region.
    """
    rows, columns = shape
    kept = np.flatnonzero(rank[number] >= 0)
    owner, chosen = rank[number[kept]], pixel[kept]
    row, column = np.divmod(chosen, columns)
    edge = (row < _BORDER) | (row >= rows - _BORDER) | (column < _BORDER) | (column >= columns - _BORDER)
    cut = np.bincount(owner, edge.astype(float), len(rank)) > 0.0
    return owner, column, row, np.maximum(signal[chosen], 0.0).astype(np.float64), cut


@compiled_form_of(_region_pixels_numpy)
def _region_pixels(
    pixel: IntArray, number: IntArray, rank: IntArray, signal: Float32Array, shape: tuple[int, int]
) -> _RegionPixels:
    (rows, columns), places, count = shape, np.empty((3, len(pixel)), np.int64), 0
    light, cut = np.empty(len(pixel)), np.zeros(len(rank), np.bool_)
    owner, column, row = places[0], places[1], places[2]
    for p in range(len(pixel)):
        region = rank[number[p]]
        if region >= 0:
            y = pixel[p] // columns
            x = pixel[p] - y * columns
            owner[count], column[count], row[count] = region, x, y
            light[count] = max(float(signal[pixel[p]]), 0.0)
            count += 1
            cut[region] |= min(x, y, columns - 1 - x, rows - 1 - y) < _BORDER
    return owner[:count].copy(), column[:count].copy(), row[:count].copy(), light[:count].copy(), cut


def _significant_numpy(sums: Float32Array, floor: Float32Array, threshold: float) -> IntArray:
    """Return the ascending indices of the pixels whose `sums` exceed `threshold` times their noise.

    The noise of a pixel is the square root of its variance `floor`, counts^2.
    """
    pixel = np.flatnonzero(sums > np.float32(threshold * np.sqrt(floor.min())))
    return np.asarray(pixel[sums[pixel] > np.float32(threshold) * np.sqrt(floor[pixel])])


@compiled_form_of(_significant_numpy)
def _significant(sums: Float32Array, floor: Float32Array, threshold: float) -> IntArray:
    found, count = np.empty(len(sums), dtype=np.int64), 0
    bright = np.zeros(_AT_ONCE, dtype=np.uint8)
    groups = bright.view(np.uint64)
    for begin in range(0, len(sums), _AT_ONCE):
        size = min(_AT_ONCE, len(sums) - begin)
        _mark_bright(bright[:size], sums[begin : begin + size], floor[begin : begin + size], threshold)
        for group in range((size + 7) // 8):
            # Most groups of eight pixels contain no bright pixel.
            if groups[group]:
                # Every index is written, but kept only for a bright pixel, which avoids an unpredictable
                # branch.
                for k in range(8 * group, min(8 * group + 8, size)):
                    found[count] = begin + k
                    count += bright[k] > 0
    return found[:count].copy()


# Number of pixels that are compared with the threshold in one step, a multiple of eight.
_AT_ONCE = 1024


@loop_helper
def _mark_bright(
    bright: npt.NDArray[np.uint8], sums: Float32Array, floor: Float32Array, threshold: float
) -> None:
    """Set `bright` (k,) to 1 for pixels whose `sums` exceed `threshold` times their noise, otherwise to 0."""
    least = np.float32(threshold * threshold)
    for k in range(len(bright)):
        bright[k] = (sums[k] > np.float32(0.0)) & (sums[k] * sums[k] > least * floor[k])


# Minimum mean width (px) of a limb or a reflection, twice the width of the brightest star images.
_BROAD = 25.0
# Lower limit (px) of the length by which a region's area is divided to obtain its mean width.
_LEAST_LENGTH = 40.0
# Side length (px) of a square that fits into the image of a limb or a reflection, but not of a star.
_SOLID = 31
# Margin (px) that is excluded around a limb or a reflection.
_ABOUT = 12


def without_glare(frame: ReducedFrame, regions: BrightRegions) -> ReducedFrame | None:
    """Return `frame` without the pixels of limbs and reflections, or None if there are none.

    A limb or a reflection is a region that contains a square larger than any star. A region of crossing
    streaks is not excluded, because it contains no square larger than a star. A margin around limbs and
    reflections is also excluded, because the background map does not follow steep gradients.
    """
    area = np.bincount(regions.owner, minlength=len(regions))
    broad = area > _BROAD * np.maximum(regions.length, _LEAST_LENGTH)
    if not broad.any():
        return None
    from scipy import ndimage  # noqa: PLC0415 - few frames need it

    def mask(which: BoolArray) -> BoolArray:
        within = which[regions.owner]
        drawn = np.zeros(frame.shape, dtype=np.bool_)
        drawn[regions.row[within], regions.column[within]] = True
        return drawn

    room = ndimage.minimum_filter(mask(broad), _SOLID)
    solid = np.bincount(regions.owner, room[regions.row, regions.column], len(regions)) > 0.0
    if not solid.any():
        return None
    out = ndimage.maximum_filter(mask(solid), 2 * _ABOUT + 1).reshape(-1)
    signal = np.where(out, np.float32(0.0), frame.signal)
    sums = box_sum(signal.reshape(frame.shape)).reshape(-1)
    return replace(frame, signal=signal, sums=sums, bad=frame.bad | out)


# Maximum number of bright regions from which the responses of a colour mosaic are estimated.
_MOST_MOSAIC_REGIONS = 24
# Minimum number of bright regions from which the responses of a colour mosaic are estimated.
_LEAST_MOSAIC_REGIONS = 6
# Minimum relative deviation of a pixel's response from the mean response that indicates a colour mosaic.
_UNEVEN_RESPONSE = 0.06
# Minimum deviation (standard deviations) of a response from the mean that indicates a colour mosaic.
_UNEVEN_SIGMAS = 8.0
# Ratio of the interquartile range of a normal distribution to its standard deviation.
_QUARTILES = 1.35
MEDIAN_ERROR = 1.25
"""Ratio of the standard error of the median of normal values to that of their mean."""


def without_mosaic(frame: ReducedFrame, regions: BrightRegions) -> ReducedFrame | None:
    """Return `frame` with equalised filter responses of a colour mosaic, or None if no mosaic is found.

    The raw pixels of a colour camera lie behind a repeated pattern of 2 x 2 filters. In each bright region,
    about the same flux of starlight reaches the pixels behind each of the four filters. The ratios of the
    counts, summed over the pixels behind each filter, are therefore the relative responses of the filters to
    starlight.

    The fit computes the photon noise of all pixels with the same gain, although the variance of an equalised
    pixel is inversely proportional to its response. In 119 frames with responses from 0.3 to 1, the inexact
    weights did not make the rate inconsistent with its covariance: the mean square error was 0.3 of the
    stated variance.
    """
    count = min(len(regions), _MOST_MOSAIC_REGIONS)
    if count < _LEAST_MOSAIC_REGIONS:
        return None
    light = _filter_sums((regions.owner, regions.column, regions.row, regions.light), count)
    ordered = np.sort(light / np.mean(light, axis=1, keepdims=True), axis=0)
    place = np.arange(1, 4) / 4.0 * (count - 1)
    first = place.astype(np.int64)
    part = (place - first)[:, None]
    low, middle, high = (1.0 - part) * ordered[first] + part * ordered[np.minimum(first + 1, count - 1)]
    off = np.abs(middle - 1.0)
    error = MEDIAN_ERROR * (high - low) / _QUARTILES / np.sqrt(count)
    if not np.any((off > _UNEVEN_RESPONSE) & (off > _UNEVEN_SIGMAS * error)) or np.any(middle <= 0.0):
        return None
    response = np.asarray(middle / middle.mean()).reshape(2, 2)
    rows, columns = frame.shape
    each = np.tile(response, (rows // 2 + 1, columns // 2 + 1))[:rows, :columns].astype(np.float32)
    signal = frame.signal.reshape(frame.shape) / each
    floor = (frame.floor / np.square(each).reshape(-1)).astype(np.float32)
    return replace(frame, signal=signal.reshape(-1), sums=box_sum(signal).reshape(-1), floor=floor)


_OwnedPixels = tuple[IntArray, IntArray, IntArray, FloatArray]
"""Attributes `owner`, `column`, `row` and `light` of `BrightRegions`."""


def _filter_sums_numpy(pixels: _OwnedPixels, count: int) -> FloatArray:
    """Return the counts (count, 4) of the first `count` regions on the pixels behind each of four filters."""
    owner, column, row, light = pixels
    place = 4 * owner + 2 * (row % 2) + column % 2
    sums = np.bincount(place, light, 4 * int(owner.max(initial=count)) + 4).astype(np.float64)
    return sums.reshape(-1, 4)[:count]


@compiled_form_of(_filter_sums_numpy)
def _filter_sums(pixels: _OwnedPixels, count: int) -> FloatArray:
    """See `_filter_sums_numpy`."""
    (owner, column, row, light), found = pixels, np.zeros((count, 4))
    for p in range(len(owner)):
        if owner[p] < count:
            found[owner[p], 2 * (row[p] & 1) + (column[p] & 1)] += light[p]
    return found


# Ratio of the two displacements at which the autocorrelation is measured.
_FARTHER = 3
# Maximum number of bright regions from which the point-spread width is estimated.
_MOST_WIDTH_REGIONS = 12
# Minimum number of bright regions from which the point-spread width is estimated.
_LEAST_WIDTH_REGIONS = 3


def measured_psf_sigma(frame: ReducedFrame, regions: BrightRegions, near: int = 1) -> float | None:
    """Return the standard deviation (px) of the PSF without pixel convolution, or None if unknown.

    The autocorrelation is measured at displacements of `near` px and three times `near` px. Pixel noise
    affects the autocorrelation only at zero displacement.

    The autocorrelation of a streak of Gaussian width w at a displacement d across the streak is proportional
    to exp(-d^2/(4 w^2)). The product of the autocorrelations along columns and along rows is also Gaussian,
    whatever the direction and curvature of the streak. The median of the width over the brightest regions is
    insensitive to blended stars and bright limbs.
    """
    pixels = regions.owner, regions.column, regions.row, regions.light
    count = min(len(regions), _MOST_WIDTH_REGIONS)
    correlation = _autocorrelations(pixels, frame.signal, frame.shape[1], near, count)
    with np.errstate(divide="ignore", invalid="ignore"):
        fallen = np.log(correlation[0] / correlation[1]) + np.log(correlation[2] / correlation[3])
        variance = near**2 * (_FARTHER**2 - 1) / (4.0 * fallen)
    known = variance[np.isfinite(variance) & (variance > 0.0)]
    if len(known) < _LEAST_WIDTH_REGIONS:
        return None
    return float(np.sqrt(max(float(np.median(known)) - PIXEL_VARIANCE, 0.0)))


def _autocorrelations_numpy(
    pixels: _OwnedPixels, signal: Float32Array, columns: int, near: int, count: int
) -> FloatArray:
    """Return the autocorrelations (4, count) of the first `count` regions of a frame with `columns` columns.

    The four displacements are `near` px and `_FARTHER` times `near` px along rows, and the same along
    columns.
    """
    chosen = np.flatnonzero(pixels[0] < count)
    owner, column, row = (values[chosen] for values in pixels[:3])
    light = pixels[3][chosen]
    found = np.empty((4, count))
    for k, distance in enumerate((near, _FARTHER * near, near * columns, _FARTHER * near * columns)):
        beside = signal.take(row * columns + column + distance, mode="clip")
        beside = beside + signal.take(row * columns + column - distance, mode="clip")
        found[k] = np.bincount(owner, light * beside, count)
    return found


@compiled_form_of(_autocorrelations_numpy)
def _autocorrelations(
    pixels: _OwnedPixels, signal: Float32Array, columns: int, near: int, count: int
) -> FloatArray:
    """See `_autocorrelations_numpy`."""
    (owner, column, row, light), found, last = pixels, np.zeros((4, count)), len(signal) - 1
    for p in range(len(owner)):
        if owner[p] < count:
            pixel = row[p] * columns + column[p]
            for k in range(4):
                distance = near * (_FARTHER if k % 2 else 1) * (columns if k > 1 else 1)
                beside = signal[min(pixel + distance, last)] + signal[max(pixel - distance, 0)]
                found[k, owner[p]] += light[p] * beside
    return found


# Minimum standard deviation of the PSF in a binned image, in binned pixels.
_NARROWEST = 1.0


@dataclass(frozen=True, slots=True)
class Binning:
    """Bins of a frame, or None without binning, and the camera `pinhole` of the binned frame."""

    bins: Bins | None
    pinhole: Pinhole

    @classmethod
    def suited(cls, pinhole: Pinhole, psf_sigma: float) -> Binning:
        """Return the binning for the point-spread width `psf_sigma`, px; a small width needs no binning."""
        for size in range(int(psf_sigma / _NARROWEST), 1, -1):
            bins = Bins.centred((pinhole.rows, pinhole.columns), size)
            if bins is not None:
                return cls(bins, pinhole.binned(bins.columns, bins.rows, size))
        return cls(None, pinhole)

    @property
    def size(self) -> int:
        """The side length of a bin, px; 1 without binning."""
        return 1 if self.bins is None else self.bins.size

    def frame(self, pixels: Image, top: float) -> tuple[Image, float]:
        """Return the binned image of `pixels`, and the counts assigned to a saturated bin.

        A bin is saturated if one of its pixels has at least `top` counts.
        """
        if self.bins is None:
            return pixels, top
        cut = self.bins.blocks(pixels)
        # The value of saturated bins is an integer, so that all bins are multiples of one count.
        full = max(int(cut.max()), int(np.ceil(top))) * self.size**2
        sums = cut.sum(axis=(1, 3), dtype=np.uint64)
        sums[at_least(cut, top).any(axis=(1, 3))] = full
        return sums, float(full)

    def in_pixels(self, result: MotionResult) -> MotionResult:
        """Return the `result` of a binned frame with its pixel coordinates converted to the full frame."""
        if self.bins is None:
            return result
        size, square, first = self.size, float(self.size**2), self.bins.offset
        return replace(
            result,
            length=size * result.length,
            endpoints=size * result.endpoints + first,
            stars=size * result.stars + first,
            faint_endpoints=size * result.faint_endpoints + first,
            star_covariance=square * result.star_covariance,
            endpoint_covariance=square * result.endpoint_covariance,
            psf_sigma=size * result.psf_sigma,
            reason=f"{result.reason}, after {size} x {size} binning" if result.reason else "",
        )


# Maximum number of bright regions in a frame.
_MOST_REGIONS = 48
# Minimum measured point-spread width (px) for which a frame is binned.
_WIDE = 2.2
# Minimum ratio of measured to configured point-spread width for which a frame is binned.
_TOO_WIDE = 1.5


# Minimum ratio of measured to configured point-spread width for which a second attempt uses a binned frame.
_BLURRED = 1.2
# Point-spread width (px) that a star has after the binning of the frame for a second attempt.
_SECOND_WIDTH = 2.0


PreparedFrame = tuple[Binning, ReducedFrame, BrightRegions, float]
"""A frame prepared for the fit, its bright regions, and its point-spread width (binned px)."""


def prepare_frames(
    pixels: Image, pinhole: Pinhole, saturation: float, settings: LikelihoodSettings
) -> Iterator[PreparedFrame]:
    """Yield the frame for a first attempt, and a binned frame for a second attempt if the PSF seems blurred.

    The first frame is binned for the configured point-spread width or, if it is much larger, for the measured
    width. The autocorrelation of a ring-shaped PSF decreases faster at small displacements than that of a
    Gaussian of the same width. A large width is therefore measured again, at larger displacements.
    """

    def prepared(sigma: float) -> PreparedFrame:
        return _prepared(pixels, pinhole, saturation, settings, sigma)

    first = binning, frame, regions, _ = prepared(settings.psf_sigma)
    sigma = measured_psf_sigma(frame, regions) if binning.size == 1 else None
    if sigma is not None and sigma > _TOO_WIDE * settings.psf_sigma:
        sigma = max(sigma, measured_psf_sigma(frame, regions, near=2) or 0.0)
        if sigma > _WIDE:
            first = prepared(sigma)
    yield first
    if first[0].size == 1 and sigma is not None and sigma > _BLURRED * settings.psf_sigma:
        yield prepared(_SECOND_WIDTH)


def _prepared(
    pixels: Image, pinhole: Pinhole, saturation: float, settings: LikelihoodSettings, sigma: float
) -> PreparedFrame:
    """Return the frame, binned for a PSF with the standard deviation `sigma`, px."""
    binning = Binning.suited(pinhole, sigma)
    frame = reduce_frame(*binning.frame(pixels, saturation), settings.gain)
    regions = find_bright_regions(frame, settings.threshold_sigmas, _MOST_REGIONS)
    for without in (without_mosaic, without_glare):
        clear = without(frame, regions)
        if clear is not None:
            frame = clear
            regions = find_bright_regions(clear, settings.threshold_sigmas, _MOST_REGIONS)
    return binning, frame, regions, sigma / binning.size
