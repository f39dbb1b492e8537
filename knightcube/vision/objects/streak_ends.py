"""Bright regions of a frame, and the two ends of each region that is a streak (Sease 2013, chapter 3).

A pixel is bright if the sum of the 3 x 3 pixels around it, without background, exceeds a given number of
standard deviations of the sum. The sum of 3 x 3 pixels is nearly the matched filter of a star image one pixel
wide. The Harris response of the structure tensor (cornerness) is computed for each connected region of bright
pixels. A streak has exactly two peaks of the Harris response, and each peak is located by its centre of
intensity. The equations are those of Sease, where eq. (3.5), (3.15), (3.17) and (3.18) are corrected as in
the errata. Images have the shape (rows, columns), and points are (x, y) in px.

The Gaussian kernels displace the peaks of the Harris response along the streak by a constant that depends on
the point spread function. The function `extend` compensates the displacement of measured streak ends by the
corner detector.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from knightcube.astro.arrays import BoolArray, FloatArray, Image, IntArray, select
from knightcube.compiled import compiled_form_of, loop_helper
from knightcube.vision.frame import (
    Background,
    box_sum,
    estimate_background,
    label_pixels,
    moments,
    positions,
    repair_hot_pixels,
    saturation_level,
)
from knightcube.vision.objects.settings import EndpointSettings

# Margin (px) around a region's bounding box, wide enough for the tensor window and the derivative kernel.
_PADDING = 8
# Minimum length of a region that may be a streak, as a fraction of `EndpointSettings.least_length`.
_LENGTH_MARGIN = 0.75
# Fraction of a streak's counts in the pixel row along its centre line, for a PSF of 1 px.
_PEAK_FRACTION = 0.28


@dataclass(frozen=True, slots=True)
class Regions:
    """Connected regions of one frame.

    Attributes:
        labels: label of the region at each pixel (rows, columns), int32; 0 outside all regions.
        label: label of each region (n,), as used in `labels`.
        boxes: bounding boxes of the regions (n, 4): first row, last row + 1, first column, last column + 1.
        area: number of pixels in each region (n,).
        flux: counts above the background in each region (n,).
        length: length of the uniform line with the same second moments as each region (n,), px.
    """

    labels: Image
    label: IntArray
    boxes: IntArray
    area: IntArray
    flux: FloatArray
    length: FloatArray

    def select(self, chosen: BoolArray | IntArray) -> Regions:
        """Return some of the regions, selected by a mask (n,) or by indices (`chosen`)."""
        return select(self, chosen, "labels")

    def __len__(self) -> int:
        return self.label.size


@dataclass(frozen=True, slots=True)
class Segmented:
    """A frame segmented into bright regions.

    Attributes:
        signal: counts above the background with hot pixels repaired (rows, columns), float32.
        background: background level and noise of the frame.
        regions: all regions above the threshold.
        candidates: those regions that may be streaks, strongest first.
        hot_pixels: number of repaired pixels.
    """

    signal: Image
    background: Background
    regions: Regions
    candidates: Regions
    hot_pixels: int


@dataclass(frozen=True, slots=True)
class Streaks:
    """Streaks of one frame, strongest first.

    Attributes:
        endpoints: the two ends (x, y) of each streak in arbitrary order (n, 2, 2), px, not yet corrected by
            `extend`.
        sigma: expected standard deviation of the endpoints of each streak (n,), px.
        flux: flux of each streak (n,), counts.
        candidate: index of each streak's region among the candidate regions (n,).
        crowded: index and corners (k, 2), px, of each candidate region with more than two corners (peaks of
            the cornerness).
    """

    endpoints: FloatArray
    sigma: FloatArray
    flux: FloatArray
    candidate: IntArray
    crowded: tuple[tuple[int, FloatArray], ...]

    @property
    def lengths(self) -> FloatArray:
        """The distances between the two ends of the streaks (n,), px."""
        return np.asarray(np.linalg.norm(self.endpoints[:, 1] - self.endpoints[:, 0], axis=-1))

    def __len__(self) -> int:
        return self.flux.size


def segment_frame(pixels: Image, settings: EndpointSettings) -> Segmented:
    """Return the bright regions of a frame (rows, columns), and those regions that may be streaks."""
    background = estimate_background(pixels)
    noise = background.map(background.noise)
    signal = pixels.astype(np.float32)
    signal -= background.map(background.level)
    hot = repair_hot_pixels(signal, noise)
    local = settings.threshold_sigmas > 0.0
    mask = threshold_local(signal, noise, settings.threshold_sigmas) if local else threshold_mean(pixels)
    regions = find_regions(mask, signal, settings.least_area)
    row, column = positions(pixels >= saturation_level(pixels, settings.saturation))
    saturated = np.isin(regions.label, regions.labels[row, column])
    long = regions.length >= _LENGTH_MARGIN * settings.least_length
    candidates = regions.select(long & ~near_border(regions, pixels.shape, settings.border) & ~saturated)
    strength = candidates.length / expected_sigma(candidates, background, settings)
    strongest = np.argsort(-strength, kind="stable")[: settings.most_streaks]
    return Segmented(signal, background, regions, candidates.select(strongest), hot)


def threshold_local(signal: Image, noise: Image, sigmas: float) -> BoolArray:
    """Return the pixels at which the 3 x 3 sum of `signal` exceeds `sigmas` times the noise of this sum.

    The argument `signal` is the frame without background; The argument `noise` is the standard deviation of
    each pixel, counts.
    """
    return np.asarray(box_sum(signal) > (3.0 * sigmas) * noise)


def threshold_mean(pixels: Image) -> BoolArray:
    """Return which `pixels` exceed the mean of the image, the threshold of Sease for noiseless frames."""
    return np.asarray(pixels > pixels.mean())


def find_regions(mask: BoolArray, signal: Image, least_area: int) -> Regions:
    """Return the 8-connected regions of `mask` with at least `least_area` pixels, and their moments."""
    pixel = np.flatnonzero(mask)
    number, count = label_pixels(pixel, mask.shape[1])
    labels = np.zeros(mask.shape, dtype=np.int32)
    labels.reshape(-1)[pixel] = number + 1
    row, column = np.divmod(pixel, mask.shape[1])
    # Pixels above the image mean may be below the background; their negative counts are set to zero.
    light = np.maximum(signal[row, column], 0.0).astype(np.float64)
    found = moments(number, column, row, light, count)
    area = np.bincount(number, minlength=count)
    slices = ndimage.find_objects(labels)
    boxes = np.array([(s[0].start, s[0].stop, s[1].start, s[1].stop) for s in slices], dtype=np.int64)
    kept = np.flatnonzero(area >= least_area)
    return Regions(
        labels, kept + 1, boxes.reshape(-1, 4)[kept], area[kept], found.flux[kept], found.length[kept]
    )


def near_border(regions: Regions, shape: tuple[int, ...], border: int) -> BoolArray:
    """Return which regions (n,) lie within `border` px of the frame's border, which may truncate streaks."""
    top, bottom, left, right = regions.boxes.T
    return np.asarray(
        (top < border) | (left < border) | (bottom > shape[0] - border) | (right > shape[1] - border)
    )


def expected_sigma(regions: Regions, background: Background, settings: EndpointSettings) -> FloatArray:
    """Return the expected standard deviation of the endpoints of each region (n,), px."""
    density = regions.flux / (regions.length + 3.0)
    variance = background.typical_noise**2 + _PEAK_FRACTION * density / settings.gain
    return np.asarray(
        np.hypot(settings.endpoint_floor, settings.endpoint_noise * np.sqrt(variance) / density)
    )


def measure_streaks(
    segmented: Segmented,
    settings: EndpointSettings,
    cornerness: Callable[[FloatArray, EndpointSettings], FloatArray] | None = None,
) -> Streaks:
    """Return the streaks, which are the candidate regions whose cornerness has exactly two peaks.

    The argument `cornerness` is a function of an image and the settings that returns the response at each
    pixel, used instead of the Harris corner detector.
    """
    respond = harris_cornerness if cornerness is None else cornerness
    sigma = expected_sigma(segmented.candidates, segmented.background, settings)
    found: list[int] = []
    endpoints: list[FloatArray] = []
    crowded: list[tuple[int, FloatArray]] = []
    usual = cornerness is None and settings.centre_of == "response" and settings.smoothing_sigma <= 0.0
    for index in range(len(segmented.candidates)):
        if usual:
            corners = _harris_corners(segmented, index, settings)
        else:
            image, mask, corner = cut_out(segmented, index)
            response = respond(image, settings)
            intensity = response if settings.centre_of == "response" else image
            corners = corner + find_corners(
                response, mask, settings.peak_relative, settings.intensity_half_width, intensity
            )
        if len(corners) == 2:
            found.append(index)
            endpoints.append(corners)
        elif len(corners) > 2:
            crowded.append((index, corners))
    stacked = np.array(endpoints).reshape(-1, 2, 2)
    chosen = np.array(found, dtype=np.int64)
    return Streaks(stacked, sigma[chosen], segmented.candidates.flux[chosen], chosen, tuple(crowded))


def cut_out(segmented: Segmented, index: int) -> tuple[FloatArray, BoolArray, FloatArray]:
    """Return image and mask of a candidate region with a margin, and the frame position of their first pixel.

    In the image, the pixels of other regions are zero.
    """
    candidates = segmented.candidates
    return _cut(segmented.signal, candidates.labels, candidates.boxes[index], int(candidates.label[index]))


def _cut(signal: Image, labels: Image, box: IntArray, label: int) -> tuple[FloatArray, BoolArray, FloatArray]:
    """Return the image, mask and first pixel of the region `label` with a margin, as `cut_out` does."""
    rows, columns = signal.shape
    top, bottom, left, right = box
    top, left = max(top - _PADDING, 0), max(left - _PADDING, 0)
    bottom, right = min(bottom + _PADDING, rows), min(right + _PADDING, columns)
    around = labels[top:bottom, left:right]
    mask = around == label
    image = np.where(mask | (around == 0), signal[top:bottom, left:right], 0.0).astype(np.float64)
    return image, mask, np.array([left, top], dtype=float)


def _harris_corners(segmented: Segmented, index: int, settings: EndpointSettings) -> FloatArray:
    """Return the corners (n, 2), px, of a candidate region by the Harris response of the frame."""
    candidates = segmented.candidates
    derivative, window = (kernel_radius(each) for each in (settings.derivative_sigma, settings.window_sigma))
    return _region_corners(
        segmented.signal,
        candidates.labels,
        candidates.boxes[index],
        int(candidates.label[index]),
        gaussian_kernel(settings.derivative_sigma, derivative),
        gaussian_derivative_kernel(settings.derivative_sigma, derivative),
        gaussian_kernel(settings.window_sigma, window),
        settings.harris_k,
        settings.peak_relative,
        settings.intensity_half_width,
    )


def _region_corners_numpy(
    signal: Image,
    labels: Image,
    box: IntArray,
    label: int,
    smooth: FloatArray,
    slope: FloatArray,
    window: FloatArray,
    k: float,
    relative: float,
    half_width: int,
) -> FloatArray:
    """Return the corners of a region as `_region_corners` does."""
    image, mask, corner = _cut(signal, labels, box, label)
    gx, gy = _separable(image, smooth, slope), _separable(image, slope, smooth)
    tensor = StructureTensor(*(_separable(each, window, window) for each in (gx * gx, gx * gy, gy * gy)))
    response = harris_response(tensor, k)
    return find_corners(response, mask, relative, half_width, response) + corner


@compiled_form_of(_region_corners_numpy)
def _region_corners(
    signal: Image,
    labels: Image,
    box: IntArray,
    label: int,
    smooth: FloatArray,
    slope: FloatArray,
    window: FloatArray,
    k: float,
    relative: float,
    half_width: int,
) -> FloatArray:
    """Return the corners (x, y) of a region (n, 2), px, which are the peaks of its Harris response.

    The response is computed near the pixels of the region only.

    Args:
        signal: counts above the background (rows, columns).
        labels: label of the region at each pixel (rows, columns); 0 outside all regions.
        box: first row, last row + 1, first column and last column + 1 of the region.
        label: label of the region.
        smooth: kernel of the Gaussian that smooths the image for the gradient.
        slope: kernel of the derivative of this Gaussian.
        window: kernel of the window of the structure tensor.
        k: constant of the Harris response.
        relative: minimum response of a corner, relative to the largest response.
        half_width: half-width of the window of the centre of intensity, px.
    """
    top, left = max(box[0] - _PADDING, 0), max(box[2] - _PADDING, 0)
    rows = min(box[1] + _PADDING, signal.shape[0]) - top
    columns = min(box[3] + _PADDING, signal.shape[1]) - left
    own = _spans_of(labels, label, top, left, rows, columns)
    wanted = _widened(own, max(half_width, 1), columns)
    gradients = _widened(wanted, len(window) // 2, columns)
    lit = _widened(gradients, len(smooth) // 2, columns)
    image = _own_light(signal, labels, label, top, left, lit, columns)
    response = _response(image, gradients, wanted, smooth, slope, window, k)
    corners = _peaks(
        response, labels[top : top + rows, left : left + columns], label, own, relative, half_width
    )
    for each in range(len(corners)):
        corners[each, 0] += left
        corners[each, 1] += top
    return corners


@loop_helper
def _spans_of(labels: Image, label: int, top: int, left: int, rows: int, columns: int) -> IntArray:
    """Return the first and last column of a region in each row of a cut-out (rows, 2)."""
    spans = np.empty((rows, 2), dtype=np.int64)
    spans[:, 0], spans[:, 1] = columns, -1
    for row in range(rows):
        for column in range(columns):
            if labels[top + row, left + column] == label:
                spans[row, 0] = min(spans[row, 0], column)
                spans[row, 1] = column
    return spans


@loop_helper
def _widened(spans: IntArray, margin: int, columns: int) -> IntArray:
    """Return the spans (rows, 2) of a region that is wider by `margin` px in all directions."""
    rows = len(spans)
    wide = np.empty((rows, 2), dtype=np.int64)
    for row in range(rows):
        first, last = columns, -1
        for other in range(max(row - margin, 0), min(row + margin + 1, rows)):
            first, last = min(first, spans[other, 0]), max(last, spans[other, 1])
        wide[row, 0] = max(first - margin, 0) if last >= 0 else columns
        wide[row, 1] = min(last + margin, columns - 1) if last >= 0 else -1
    return wide


@loop_helper
def _own_light(
    signal: Image, labels: Image, label: int, top: int, left: int, spans: IntArray, columns: int
) -> FloatArray:
    """Return the light of a region and of no region within spans of columns, in a cut-out (rows, columns)."""
    image = np.zeros((len(spans), columns))
    for row in range(len(spans)):
        for column in range(spans[row, 0], spans[row, 1] + 1):
            here = labels[top + row, left + column]
            if here in (label, 0):
                image[row, column] = signal[top + row, left + column]
    return image


@loop_helper
def _response(
    image: FloatArray,
    gradients: IntArray,
    wanted: IntArray,
    smooth: FloatArray,
    slope: FloatArray,
    window: FloatArray,
    k: float,
) -> FloatArray:
    """Return the Harris response of an image, within the spans `wanted` (rows, 2) only.

    The gradient is computed within the spans `gradients` (rows, 2).
    """
    scratch = np.empty(image.shape)
    xx, yy, xy = np.empty(image.shape), np.empty(image.shape), np.empty(image.shape)
    _correlate(image, gradients, smooth, slope, scratch, xx)
    _correlate(image, gradients, slope, smooth, scratch, yy)
    for row in range(len(image)):
        for column in range(gradients[row, 0], gradients[row, 1] + 1):
            x, y = xx[row, column], yy[row, column]
            xx[row, column], yy[row, column], xy[row, column] = x * x, y * y, x * y
    for product in (xx, yy, xy):
        _correlate(product, wanted, window, window, scratch, product)
    for row in range(len(image)):
        for column in range(wanted[row, 0], wanted[row, 1] + 1):
            a, b, c = xx[row, column], yy[row, column], xy[row, column]
            xx[row, column] = a * b - c * c - k * (a + b) ** 2
    return xx


@loop_helper
def _correlate(
    image: FloatArray,
    spans: IntArray,
    down: FloatArray,
    across: FloatArray,
    scratch: FloatArray,
    out: FloatArray,
) -> None:
    """Set `out` to the correlation of an image with an outer product, within spans of columns (rows, 2).

    The border pixels are repeated beyond the border. The array `out` may be the image.
    """
    rows, columns = image.shape
    high, wide = len(down) // 2, len(across) // 2
    for row in range(rows):
        first, last = max(spans[row, 0] - wide, 0), min(spans[row, 1] + wide, columns - 1)
        for column in range(first, last + 1):
            scratch[row, column] = 0.0
        for tap in range(2 * high + 1):
            other, factor = min(max(row + tap - high, 0), rows - 1), down[tap]
            for column in range(first, last + 1):
                scratch[row, column] += factor * image[other, column]
    for row in range(rows):
        for column in range(spans[row, 0], spans[row, 1] + 1):
            total = 0.0
            if column >= wide and column + wide < columns:
                for tap in range(2 * wide + 1):
                    total += across[tap] * scratch[row, column + tap - wide]
            else:
                for tap in range(2 * wide + 1):
                    total += across[tap] * scratch[row, min(max(column + tap - wide, 0), columns - 1)]
            out[row, column] = total


@loop_helper
def _peaks(
    response: FloatArray, labels: Image, label: int, spans: IntArray, relative: float, half_width: int
) -> FloatArray:
    """Return the centres of intensity (n, 2), px, at the peaks of the response in a region of a cut-out."""
    rows, columns = response.shape
    top, count = 0.0, 0
    for row in range(1, rows - 1):
        for column in range(max(spans[row, 0], 1), min(spans[row, 1], columns - 2) + 1):
            if labels[row, column] == label:
                top = max(top, response[row, column])
    corners = np.empty((len(labels) * labels.shape[1] // 4 + 1, 2))
    for row in range(1, rows - 1):
        for column in range(max(spans[row, 0], 1), min(spans[row, 1], columns - 2) + 1):
            here = response[row, column]
            if labels[row, column] != label or here < relative * top or top <= 0.0:
                continue
            highest = -np.inf
            for dy in range(-1, 2):
                for dx in range(-1, 2):
                    if dx != 0 or dy != 0:
                        highest = max(highest, response[row + dy, column + dx])
            if here > highest:
                _set_centre(response, row, column, half_width, corners[count])
                count += 1
    return corners[:count].copy()


@loop_helper
def _set_centre(image: FloatArray, row: int, column: int, half_width: int, centre: FloatArray) -> None:
    """Set `centre` (2,) to the centre of intensity around a pixel, as `centre_of_intensity` does."""
    rows, columns = image.shape
    n = min(half_width, row, column, columns - 1 - column, rows - 1 - row)
    total, x, y = 0.0, 0.0, 0.0
    for dy in range(-n, n + 1):
        for dx in range(-n, n + 1):
            light = max(image[row + dy, column + dx], 0.0)
            total += light
            x += light * dx
            y += light * dy
    centre[0], centre[1] = column, row
    if total > 0.0:
        centre[0] += x / total
        centre[1] += y / total


class StructureTensor(NamedTuple):
    """The three distinct elements of the symmetric structure tensor at every pixel, each (rows, columns)."""

    xx: FloatArray
    xy: FloatArray
    yy: FloatArray


def harris_cornerness(image: FloatArray, settings: EndpointSettings) -> FloatArray:
    """Return the Harris response of an image (rows, columns), smoothed according to the settings."""
    return harris_response(tensor_of(image, settings), settings.harris_k)


def tensor_of(image: FloatArray, settings: EndpointSettings) -> StructureTensor:
    """Return the structure tensor of an image that is smoothed according to the settings."""
    image = smoothed(image, settings.smoothing_sigma)
    return structure_tensor(image, settings.derivative_sigma, settings.window_sigma)


def structure_tensor(image: Image, derivative_sigma: float, window_sigma: float) -> StructureTensor:
    """Return the structure tensor: gradient products summed under a Gaussian window of `window_sigma` px.

    Source: Sease, eq. (3.5), with the Gaussian window that the printed equation lacks. Without the Gaussian
    window, the structure tensor has rank 1 and one eigenvalue is zero.
    """
    gx, gy = gradient(image, derivative_sigma)
    window = gaussian_kernel(window_sigma, kernel_radius(window_sigma))
    return StructureTensor(*(_separable(product, window, window) for product in (gx * gx, gx * gy, gy * gy)))


def harris_response(tensor: StructureTensor, k: float = 0.15) -> FloatArray:
    """Return the Harris response det(A) - k trace(A)^2 of a structure tensor A (Sease, eq. (3.8))."""
    trace = tensor.xx + tensor.yy
    return np.asarray(tensor.xx * tensor.yy - tensor.xy**2 - k * trace**2)


def gradient(image: Image, sigma: float) -> tuple[FloatArray, FloatArray]:
    """Return the Gaussian derivatives of an image along x and y, counts per px.

    Beyond the border, the border pixels are repeated.
    """
    radius = kernel_radius(sigma)
    smooth, slope = gaussian_kernel(sigma, radius), gaussian_derivative_kernel(sigma, radius)
    return _separable(image, smooth, slope), _separable(image, slope, smooth)


def smoothed(image: Image, sigma: float) -> FloatArray:
    """Return an image smoothed by a Gaussian of `sigma` px, unchanged if `sigma` is 0 (Sease, eq. (3.3))."""
    if sigma <= 0.0:
        return np.asarray(image, dtype=np.float64)
    kernel = gaussian_kernel(sigma, kernel_radius(sigma))
    return _separable(image, kernel / kernel.sum(), kernel / kernel.sum())


def gaussian_kernel(sigma: float, radius: int) -> FloatArray:
    """Return the sampled normal density (2 radius + 1,), one factor of the Gaussian in Sease, eq. (3.3)."""
    x = np.arange(-radius, radius + 1)
    return np.asarray(np.exp(-0.5 * (x / sigma) ** 2) / (np.sqrt(2.0 * np.pi) * sigma))


def gaussian_derivative_kernel(sigma: float, radius: int) -> FloatArray:
    """Return the correlation kernel (2 radius + 1,) of the derivative of an image smoothed by `sigma` px.

    The outer product of the returned kernel and `gaussian_kernel` is the kernel of Sease, eq. (3.4), mirrored
    from convolution to correlation.
    """
    x = np.arange(-radius, radius + 1)
    return np.asarray(x / sigma**2 * gaussian_kernel(sigma, radius))


def kernel_radius(sigma: float) -> int:
    """Return the half-width (px) of a Gaussian kernel: three times `sigma` (px), and at least 1 px."""
    return max(1, int(np.ceil(3.0 * sigma)))


def _separable(image: Image, down: FloatArray, across: FloatArray) -> FloatArray:
    """Return the correlation of `image` with the outer product of `down` (rows) and `across` (columns)."""
    half = ndimage.correlate1d(image, down, axis=0, mode="nearest", output=np.float64)
    return np.asarray(ndimage.correlate1d(half, across, axis=1, mode="nearest"))


def local_maxima(response: FloatArray, mask: BoolArray, relative: float) -> IntArray:
    """Return the pixels (x, y) in `mask` whose response exceeds that of all eight neighbours, (n, 2).

    Pixels at the border of the image, and pixels below `relative` times the largest response in the mask, are
    excluded.
    """
    inner = response[1:-1, 1:-1]
    rows, columns = inner.shape
    allowed = mask[1:-1, 1:-1]
    top = float(inner[allowed].max(initial=0.0))
    if top <= 0.0:
        return np.empty((0, 2), dtype=np.int64)
    y, x = np.nonzero(allowed & (inner >= relative * top))
    steps = [(dy, dx) for dy in (0, 1, 2) for dx in (0, 1, 2) if (dy, dx) != (1, 1)]
    neighbours = np.stack([response[dy : dy + rows, dx : dx + columns][y, x] for dy, dx in steps])
    peak = inner[y, x] > neighbours.max(axis=0)
    return np.stack([x[peak] + 1, y[peak] + 1], axis=-1)


def centre_of_intensity(image: FloatArray, pixel: IntArray, half_width: int) -> FloatArray:
    """Return the intensity-weighted centre (x, y) px of the (2 half_width + 1)^2 pixels around `pixel`.

    Source: Sease, eq. (3.15) and (3.16), with the factor of the coordinate in the sums that the printed
    equation lacks. Pixels with negative intensity have no weight. A window that would extend beyond the image
    border is narrowed on both sides, so that it stays centred on `pixel` (x, y).
    """
    x, y = int(pixel[0]), int(pixel[1])
    rows, columns = image.shape
    n = min(half_width, x, y, columns - 1 - x, rows - 1 - y)
    window = np.maximum(image[y - n : y + n + 1, x - n : x + n + 1], 0.0)
    total = window.sum()
    if total <= 0.0:
        return np.array([x, y], dtype=float)
    i = np.arange(-n, n + 1)
    return np.array([x + window.sum(axis=0) @ i / total, y + window.sum(axis=1) @ i / total])


def find_corners(
    response: FloatArray, mask: BoolArray, relative: float, half_width: int, intensity: FloatArray
) -> FloatArray:
    """Return the corners (x, y) of a region (n, 2), px, which are the peaks of its cornerness (`response`).

    The position of a corner is the centre of intensity of the image `intensity` around the peak, where
    `intensity` is the cornerness or, as in Sease, the frame. If the frame is used, the corners lie up to 2 px
    inside the streak. A streak has two corners; other numbers of corners indicate noise, crossing streaks or
    another object.
    """
    peaks = local_maxima(response, mask, relative)
    return np.array([centre_of_intensity(intensity, peak, half_width) for peak in peaks]).reshape(-1, 2)


def extend(endpoints: FloatArray, outward: FloatArray, bias: float) -> FloatArray:
    """Return streak ends (..., 2), px, moved by `bias` px along the unit vectors `outward` (..., 2)."""
    return np.asarray(endpoints + bias * outward / np.linalg.norm(outward, axis=-1, keepdims=True))


def chord_outward(endpoints: FloatArray) -> FloatArray:
    """Return unit vectors outwards along the chord at both ends of each streak (n, 2, 2)."""
    chord = endpoints[:, 1] - endpoints[:, 0]
    return np.stack([-chord, chord], axis=1)


def centre_of_rotation(endpoints: FloatArray) -> FloatArray:
    """Return the centre of rotation (2,), px: the point nearest to the perpendicular bisectors of streaks.

    Each streak is given by its two ends (n, 2, 2), px. The nearer the rotation axis is to the normal of the
    boresight, the farther away is the centre; for parallel chords the centre is NaN. Source: Sease, eq.
    (3.17) and (3.18) as corrected in the errata.
    """
    chord = endpoints[:, 1] - endpoints[:, 0]
    chord = chord / np.linalg.norm(chord, axis=-1, keepdims=True)
    midpoint = endpoints.mean(axis=1)
    centre, _, rank, _ = np.linalg.lstsq(chord, np.sum(chord * midpoint, axis=-1), rcond=1e-9)
    return np.asarray(centre) if rank == 2 else np.full(2, np.nan)
