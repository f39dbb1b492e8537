"""Segmentation of a frame into bright regions, and the two ends of each streak (Sease 2013, chapter 3).

A pixel is bright if the sum of the 3 x 3 pixels around it, without background, exceeds a given number of
standard deviations of the sum. The sum of 3 x 3 pixels is nearly the matched filter of a star image one pixel
wide. The Harris response of the structure tensor (cornerness) is computed for each connected region of bright
pixels. A streak has exactly two peaks of the Harris response, and each peak is located by its centre of
intensity. The equations are from Sease, with eq. (3.5), (3.15), (3.17) and (3.18) corrected as in the errata.
Images have the shape (rows, columns), and points are (x, y) in px.

The Gaussian kernels displace the peaks of the Harris response along the streak by a constant that depends on
the point spread function. The function `extend` moves the measured streak ends outward to compensate the
displacement of the peaks.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from knightcube.astro.arrays import BoolArray, FloatArray, Image, IntArray, select
from knightcube.compiled import compiled_form_of, loop_helper
from knightcube.vision.background import Background, estimate_background
from knightcube.vision.frame import (
    at_least,
    box_sum,
    label_pixels,
    moments,
    positions,
    repair_hot_pixels,
    saturation_level,
)
from knightcube.vision.objects.settings import EndpointSettings

# Margin (px) around a region's bounding box that covers the tensor window and the derivative kernel.
_PADDING = 8
# Minimum length of a region that may be a streak, as a fraction of `EndpointSettings.least_length`.
_LENGTH_MARGIN = 0.75
# Fraction of a streak's counts in the single row of pixels along its centre line, for a PSF of 1 px.
_PEAK_FRACTION = 0.28


@dataclass(frozen=True, slots=True)
class Regions:
    """The n connected regions of one frame, with the area (n,), px, and flux (n,), counts, of each region.

    Attributes:
        labels: label of the region at each pixel (rows, columns), int32; 0 outside all regions.
        label: label of each region (n,), as used in `labels`.
        boxes: bounding boxes of the regions (n, 4): first row, last row + 1, first column, last column + 1.
        length: length of the uniform line with the same second moments as each region (n,), px.
    """

    labels: Image
    label: IntArray
    boxes: IntArray
    area: IntArray
    flux: FloatArray
    length: FloatArray

    def select(self, chosen: BoolArray | IntArray) -> Regions:
        """Return the regions `chosen` by a mask (n,) or by indices."""
        return select(self, chosen, "labels")

    def is_significant(self, sigmas: float, background: Background) -> BoolArray:
        """Return the mask (n,) of the regions whose flux is at least `sigmas` times its background noise."""
        return np.asarray(self.flux >= sigmas * background.typical_noise * np.sqrt(self.area))

    def __len__(self) -> int:
        return self.label.size


@dataclass(frozen=True, slots=True)
class Segmented:
    """A frame segmented into bright regions.

    The signal (rows, columns), float32, contains the counts above the background. The number of hot pixels
    repaired in the signal is `hot_pixels`. The candidates are the regions that may be streaks, in descending
    order of the ratio of length to endpoint error.
    """

    signal: Image
    background: Background
    regions: Regions
    candidates: Regions
    hot_pixels: int


@dataclass(frozen=True, slots=True)
class Streaks:
    """Streaks of one frame, in descending order of the ratio of length to endpoint error.

    Attributes:
        endpoints: the two ends (x, y) of each streak in arbitrary order (n, 2, 2), px, before `extend`.
        sigma: expected standard deviation of the endpoints of each streak (n,), px.
        flux: flux of each streak (n,), counts.
        candidate: index of each streak's region among the candidate regions (n,).
        crowded: index and corners (k, 2), px, of each candidate region with more than two corners.
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
    signal, noise = background.subtracted_with_noise(pixels)
    hot = repair_hot_pixels(signal, noise)
    local = settings.threshold_sigmas > 0.0
    mask = threshold_local(signal, noise, settings.threshold_sigmas) if local else threshold_mean(pixels)
    regions = find_regions(mask, signal, settings.least_area)
    row, column = positions(at_least(pixels, saturation_level(pixels, settings.saturation)))
    saturated = np.isin(regions.label, regions.labels[row, column])
    long = regions.length >= _LENGTH_MARGIN * settings.least_length
    candidates = regions.select(long & ~near_border(regions, pixels.shape, settings.border) & ~saturated)
    strength = candidates.length / expected_sigma(candidates, background, settings)
    strongest = np.argsort(-strength, kind="stable")[: settings.most_streaks]
    return Segmented(signal, background, regions, candidates.select(strongest), hot)


def _threshold_local_numpy(signal: Image, noise: Image, sigmas: float) -> BoolArray:
    return np.asarray(box_sum(signal) > (3.0 * sigmas) * noise)


@compiled_form_of(_threshold_local_numpy)
def threshold_local(signal: Image, noise: Image, sigmas: float) -> BoolArray:
    """Return the pixels at which the 3 x 3 sum of `signal` exceeds `sigmas` times the noise of this sum.

    The signal (rows, columns) is without background, and the noise (rows, columns) is the standard deviation
    of each pixel, counts. The result does not include pixels at the border of the frame.
    """
    rows, columns = signal.shape
    limit, down = np.float32(3.0 * sigmas), np.empty_like(signal[0])
    above = np.zeros(signal.shape, dtype=np.bool_)
    for row in range(1, rows - 1):
        for column in range(columns):
            down[column] = signal[row - 1, column] + signal[row, column] + signal[row + 1, column]
        for column in range(1, columns - 1):
            total = down[column - 1] + down[column] + down[column + 1]
            above[row, column] = total > limit * noise[row, column]
    return above


def threshold_mean(pixels: Image) -> BoolArray:
    """Return the mask of `pixels` above the image mean, which is Sease's threshold for noiseless frames."""
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
    boxes = _bounding_boxes(number, row, column, count)
    kept = np.flatnonzero(area >= least_area)
    return Regions(labels, kept + 1, boxes[kept], area[kept], found.flux[kept], found.length[kept])


def _bounding_boxes_numpy(number: IntArray, row: IntArray, column: IntArray, count: int) -> IntArray:
    """Return the bounding boxes (count, 4) of `Regions` from the region and position of each of m pixels."""
    boxes = np.empty((count, 4), dtype=np.int64)
    boxes[:, ::2], boxes[:, 1::2] = np.iinfo(np.int64).max, 0
    for edge, place in ((0, row), (2, column)):
        np.minimum.at(boxes[:, edge], number, place)
        np.maximum.at(boxes[:, edge + 1], number, place + 1)
    return boxes


@compiled_form_of(_bounding_boxes_numpy)
def _bounding_boxes(number: IntArray, row: IntArray, column: IntArray, count: int) -> IntArray:
    boxes = np.empty((count, 4), dtype=np.int64)
    boxes[:, ::2], boxes[:, 1::2] = np.iinfo(np.int64).max, 0
    for p in range(len(number)):
        box = boxes[number[p]]
        box[0], box[1] = min(box[0], row[p]), max(box[1], row[p] + 1)
        box[2], box[3] = min(box[2], column[p]), max(box[3], column[p] + 1)
    return boxes


def _pixels_of_region_numpy(labels: Image, box: IntArray, label: int) -> IntArray:
    top, bottom, left, right = box
    row, column = positions(labels[top:bottom, left:right] == label)
    return np.stack([column + left, row + top], axis=-1)


@compiled_form_of(_pixels_of_region_numpy)
def pixels_of_region(labels: Image, box: IntArray, label: int) -> IntArray:
    """Return the pixels (m, 2), (x, y), of the region with a given `label`, row by row.

    The labels (rows, columns) and the bounding box (4,) are those of `Regions`.
    """
    top, bottom, left, right = box
    count, place = 0, 0
    for row in range(top, bottom):
        for column in range(left, right):
            count += labels[row, column] == label
    pixels = np.empty((count, 2), dtype=np.int64)
    for row in range(top, bottom):
        for column in range(left, right):
            if labels[row, column] == label:
                pixels[place, 0], pixels[place, 1] = column, row
                place += 1
    return pixels


def near_border(regions: Regions, shape: tuple[int, ...], border: int) -> BoolArray:
    """Return which regions (n,) may be truncated: those within `border` px of the frame's border."""
    (rows, columns), (top, bottom, left, right) = shape, regions.boxes.T
    outside = (top < border) | (left < border) | (bottom > rows - border) | (right > columns - border)
    return np.asarray(outside)


def expected_sigma(regions: Regions, background: Background, settings: EndpointSettings) -> FloatArray:
    """Return the expected standard deviation of the position of the endpoints of each region (n,), px."""
    density = regions.flux / (regions.length + 3.0)
    variance = background.typical_noise**2 + _PEAK_FRACTION * density / settings.gain
    noise = settings.endpoint_noise * np.sqrt(variance) / density
    return np.asarray(np.hypot(settings.endpoint_floor, noise))


def measure_streaks(
    segmented: Segmented,
    settings: EndpointSettings,
    cornerness: Callable[[FloatArray, EndpointSettings], FloatArray] | None = None,
) -> Streaks:
    """Return the streaks: the candidate regions whose cornerness has exactly two peaks.

    The function `cornerness`, if given, computes the response at each pixel instead of the Harris detector.
    """
    respond = harris_cornerness if cornerness is None else cornerness
    sigma = expected_sigma(segmented.candidates, segmented.background, settings)
    found: list[int] = []
    endpoints: list[FloatArray] = []
    crowded: list[tuple[int, FloatArray]] = []
    if cornerness is None and settings.centre_of == "response" and settings.smoothing_sigma <= 0.0:
        every = _harris_corners(segmented, settings)
    else:
        regions, every = segmented.candidates, []
        for box, label in zip(regions.boxes, regions.label.tolist(), strict=True):
            image, mask, corner = _cut(segmented.signal, regions.labels, box, label)
            response = respond(image, settings)
            intensity = response if settings.centre_of == "response" else image
            limits = settings.peak_relative, settings.intensity_half_width
            every.append(find_corners(response, mask, *limits, intensity) + corner)
    for index, corners in enumerate(every):
        if len(corners) == 2:
            found.append(index)
            endpoints.append(corners)
        elif len(corners) > 2:
            crowded.append((index, corners))
    stacked = np.array(endpoints).reshape(-1, 2, 2)
    chosen = np.array(found, dtype=np.int64)
    return Streaks(stacked, sigma[chosen], segmented.candidates.flux[chosen], chosen, tuple(crowded))


def _cut(signal: Image, labels: Image, box: IntArray, label: int) -> tuple[FloatArray, BoolArray, FloatArray]:
    """Return image and mask of the region `label` with a margin, and the first pixel's position in the frame.

    Pixels of other regions are set to zero in the returned image.
    """
    rows, columns = signal.shape
    top, bottom, left, right = box
    top, left = max(top - _PADDING, 0), max(left - _PADDING, 0)
    bottom, right = min(bottom + _PADDING, rows), min(right + _PADDING, columns)
    around = labels[top:bottom, left:right]
    mask = around == label
    image = np.where(mask | (around == 0), signal[top:bottom, left:right], 0.0).astype(np.float64)
    return image, mask, np.array([left, top], dtype=float)


def _harris_corners(segmented: Segmented, settings: EndpointSettings) -> list[FloatArray]:
    """Return the corners (n, 2), px, of each candidate region from the Harris response of the frame."""
    candidates = segmented.candidates
    derivative, window = (kernel_radius(each) for each in (settings.derivative_sigma, settings.window_sigma))
    smooth = gaussian_kernel(settings.derivative_sigma, derivative)
    slope = gaussian_derivative_kernel(settings.derivative_sigma, derivative)
    kernels = smooth, slope, gaussian_kernel(settings.window_sigma, window)
    limits = settings.harris_k, settings.peak_relative, settings.intensity_half_width
    regions = candidates.labels, candidates.boxes, candidates.label
    corners, counts = _corners_of_regions(segmented.signal, *regions, kernels, limits)
    return np.split(corners, np.cumsum(counts)[:-1]) if len(counts) else []


_Kernels = tuple[Image, Image, Image]
"""Kernels: Gaussian normal to the gradient, Gaussian derivative, and Gaussian window of the tensor."""
_Limits = tuple[float, float, int]
"""Harris constant k, minimum response of a corner (fraction), half-width of the centre of intensity (px)."""


def _corners_of_regions_numpy(
    signal: Image, labels: Image, boxes: IntArray, label: IntArray, kernels: _Kernels, limits: _Limits
) -> tuple[FloatArray, IntArray]:
    corners, (smooth, slope, window), (k, relative, half_width) = [np.zeros((0, 2))], kernels, limits
    for box, own in zip(boxes, label.tolist(), strict=True):
        image, mask, corner = _cut(signal, labels, box, own)
        gx, gy = _separable(image, smooth, slope), _separable(image, slope, smooth)
        products = gx * gx, gx * gy, gy * gy
        tensor = StructureTensor(*(_separable(each, window, window) for each in products))
        response = harris_response(tensor, k)
        corners.append(find_corners(response, mask, relative, half_width, response) + corner)
    counts = np.array([len(each) for each in corners[1:]], dtype=np.int64)
    return np.concatenate(corners), counts


@compiled_form_of(_corners_of_regions_numpy)
def _corners_of_regions(
    signal: Image, labels: Image, boxes: IntArray, label: IntArray, kernels: _Kernels, limits: _Limits
) -> tuple[FloatArray, IntArray]:
    """Return the positions (m, 2), px, of all corners in n regions, and the number of corners in each, (n,).

    Corners are peaks of the Harris response, which is computed only near the pixels of the regions. The
    argument `signal` (rows, columns) contains the counts above the background. The labels at each pixel, the
    bounding boxes and the labels of the regions are those of `Regions`.
    """
    largest, most, (k, _, half_width) = 0, 0, limits
    # The response is computed in single precision, which takes less time.
    smooth, slope, window = kernels
    single = smooth.astype(np.float32), slope.astype(np.float32), window.astype(np.float32)
    for number in range(len(boxes)):
        height, width = boxes[number, 1] - boxes[number, 0], boxes[number, 3] - boxes[number, 2]
        size = (height + 2 * _PADDING) * (width + 2 * _PADDING)
        largest, most = max(largest, size), most + size // 4
    # Peaks of the response are not adjacent, so that there is less than one peak for every four pixels.
    corners, counts, total = np.empty((most, 2)), np.zeros(len(label), dtype=np.int64), 0
    scratch = np.empty((5, largest), dtype=np.float32)
    for number in range(len(label)):
        box = boxes[number]
        top, bottom = max(box[0] - _PADDING, 0), min(box[1] + _PADDING, signal.shape[0])
        left, right = max(box[2] - _PADDING, 0), min(box[3] + _PADDING, signal.shape[1])
        light, around = signal[top:bottom, left:right], labels[top:bottom, left:right]
        own, spans, margin = label[number], _spans_of(around, label[number]), max(half_width, 1)
        # A streak along columns is transposed, because few long rows take less time than many short ones.
        upright = bottom - top > right - left
        across = _spans_across(around, own, spans) if upright else spans
        light, labelled = (light.T, around.T) if upright else (light, around)
        wanted = _widened(across, margin, light.shape[1])
        response = _response(light, labelled, own, wanted, single, k, scratch)
        if upright:
            found = _peaks(response.T, around, own, spans, limits, corners[total:])
        else:
            found = _peaks(response, around, own, spans, limits, corners[total:])
        for n in range(total, total + found):
            corners[n, 0] += left
            corners[n, 1] += top
        counts[number] = found
        total += found
    return corners[:total].copy(), counts


@loop_helper
def _spans_of(labels: Image, label: int) -> IntArray:
    """Return the first and last column of a region in each row of a cut-out (rows, 2)."""
    rows, columns = labels.shape
    spans = np.empty((rows, 2), dtype=np.int64)
    for row in range(rows):
        first, last = 0, columns - 1
        while first < columns and labels[row, first] != label:
            first += 1
        while last > first and labels[row, last] != label:
            last -= 1
        spans[row, 0], spans[row, 1] = first, last if first < columns else -1
    return spans


@loop_helper
def _spans_across(labels: Image, label: int, spans: IntArray) -> IntArray:
    """Return the first and last row of a region in each column (columns, 2), from its `spans` (rows, 2)."""
    rows, columns = labels.shape
    across = np.empty((columns, 2), dtype=np.int64)
    across[:, 0], across[:, 1] = rows, -1
    for row in range(rows):
        for column in range(max(spans[row, 0], 0), spans[row, 1] + 1):
            if labels[row, column] == label:
                across[column, 0], across[column, 1] = min(across[column, 0], row), row
    return across


@loop_helper
def _widened(spans: IntArray, margin: int, columns: int) -> IntArray:
    """Return the spans (rows, 2) of a region after it is enlarged by `margin` px in all directions."""
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
def _response(
    light: Image,
    labels: Image,
    label: int,
    wanted: IntArray,
    kernels: _Kernels,
    k: float,
    scratch: Image,
) -> FloatArray:
    """Return the Harris response of a region in a cut-out, within the spans `wanted` (rows, 2) only.

    The pixels of other regions are set to zero. The arrays `scratch` (5, m) are used as memory for the images
    of the cut-out.
    """
    (rows, columns), (smooth, slope, window) = light.shape, kernels
    size, shape = rows * columns, (rows, columns)
    image, half = scratch[0, :size].reshape(shape), scratch[1, :size].reshape(shape)
    xx, yy = scratch[2, :size].reshape(shape), scratch[3, :size].reshape(shape)
    xy = scratch[4, :size].reshape(shape)
    gradients = _widened(wanted, len(window) // 2, columns)
    lit = _widened(gradients, len(smooth) // 2, columns)
    for row in range(rows):
        for column in range(lit[row, 0], lit[row, 1] + 1):
            own = labels[row, column] == label or labels[row, column] == 0
            image[row, column] = light[row, column] if own else 0.0
    _correlate(image, gradients, smooth, slope, half, xx)
    _correlate(image, gradients, slope, smooth, half, yy)
    for row in range(rows):
        for column in range(gradients[row, 0], gradients[row, 1] + 1):
            x, y = xx[row, column], yy[row, column]
            xx[row, column], yy[row, column], xy[row, column] = x * x, y * y, x * y
    for product in (xx, yy, xy):
        _correlate(product, wanted, window, window, half, product)
    for row in range(rows):
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
    half: FloatArray,
    out: FloatArray,
) -> None:
    """Set `out` within `spans` to the correlation of an image with the outer product of two kernels.

    The kernels are `down`, along each column, and `across`, along each row. The `spans` (rows, 2) are the
    first and the last column. The image is extended by repeating its border pixels. The arrays `out` and
    `image` may be the same array.
    """
    rows, columns = image.shape
    high, wide = len(down) // 2, len(across) // 2
    for row in range(rows):
        first, stop = max(spans[row, 0] - wide, 0), min(spans[row, 1] + wide + 1, columns)
        if first >= stop:
            continue
        line = half[row, first:stop]
        line[:] = 0.0
        for tap in range(2 * high + 1):
            _add_scaled(image[min(max(row + tap - high, 0), rows - 1), first:stop], down[tap], line)
    for row in range(rows):
        first, stop = spans[row, 0], spans[row, 1] + 1
        if first >= stop:
            continue
        line = out[row, first:stop]
        line[:] = 0.0
        for tap in range(2 * wide + 1):
            step, factor = tap - wide, across[tap]
            # The columns from `low` to `end` do not need pixels beyond the border.
            low, end = min(max(first, -step), stop), max(min(stop, columns - step), first)
            for column in range(first, low):
                out[row, column] += factor * half[row, 0]
            if low < end:
                _add_scaled(half[row, low + step : end + step], factor, out[row, low:end])
            for column in range(max(end, low), stop):
                out[row, column] += factor * half[row, columns - 1]


@loop_helper
def _add_scaled(values: FloatArray, factor: float, total: FloatArray) -> None:
    for k in range(len(total)):
        total[k] += factor * values[k]


@loop_helper
def _peaks(
    response: FloatArray, labels: Image, label: int, spans: IntArray, limits: _Limits, corners: FloatArray
) -> int:
    """Set `corners` to the centres of intensity at the peaks of the response, and return their number."""
    (rows, columns), (_, relative, half_width) = response.shape, limits
    top, count = 0.0, 0
    for row in range(1, rows - 1):
        for column in range(max(spans[row, 0], 1), min(spans[row, 1], columns - 2) + 1):
            if labels[row, column] == label:
                top = max(top, response[row, column])
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
    return count


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

    Source: Sease, eq. (3.5); the printed equation lacks the Gaussian window. Without the Gaussian window, the
    structure tensor has rank 1 and one eigenvalue is zero.
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

    The image is extended by repeating its border pixels.
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
    """Return the correlation kernel (2 radius + 1,) of the derivative of a Gaussian with `sigma` px.

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
    """Return the pixels (n, 2), (x, y), in `mask` with a larger response than all eight neighbours.

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

    Source: Sease, eq. (3.15) and (3.16); the printed sums lack the coordinate as a factor. Pixels with
    negative intensity have no weight. A window that would extend beyond the image border is narrowed on both
    sides, so that it stays centred on `pixel` (x, y).
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
    """Return the corners (n, 2), px, of a region, which are the peaks of its cornerness (`response`).

    The position of a corner is the centre of intensity around the peak, computed in the image `intensity`.
    This image is the cornerness or, as in Sease, the frame. In the frame, the centres lie up to 2 px inside
    the streak. A streak has two corners. A region with fewer or more than two corners shows noise, crossing
    streaks or another source.
    """
    peaks = local_maxima(response, mask, relative)
    return np.array([centre_of_intensity(intensity, peak, half_width) for peak in peaks]).reshape(-1, 2)


def extend(endpoints: FloatArray, outward: FloatArray, bias: float) -> FloatArray:
    """Return streak ends (..., 2), px, moved by `bias` px in the directions `outward` (..., 2).

    An end with the direction zero, such as an end of a point, is not moved.
    """
    length = np.linalg.norm(outward, axis=-1, keepdims=True)
    return np.asarray(endpoints + bias * outward / np.where(length > 0.0, length, 1.0))


def chord_outward(endpoints: FloatArray) -> FloatArray:
    """Return vectors outwards along the chord at both ends of each streak (n, 2, 2), px."""
    chord = endpoints[:, 1] - endpoints[:, 0]
    return np.stack([-chord, chord], axis=1)


def centre_of_rotation(endpoints: FloatArray) -> FloatArray:
    """Return the centre of rotation (2,), px, which is nearest to the perpendicular bisectors of streaks.

    Each streak is given by its two ends (n, 2, 2), px. The centre is far away if the rotation axis is nearly
    normal to the boresight. The result is NaN if the chords are parallel. Source: Sease, eq. (3.17) and
    (3.18) as corrected in the errata.
    """
    chord = endpoints[:, 1] - endpoints[:, 0]
    chord = chord / np.linalg.norm(chord, axis=-1, keepdims=True)
    midpoint = endpoints.mean(axis=1)
    centre, _, rank, _ = np.linalg.lstsq(chord, np.sum(chord * midpoint, axis=-1), rcond=1e-9)
    return np.asarray(centre) if rank == 2 else np.full(2, np.nan)


_ASIDE_PX = 1.0
"""Largest distance (px) of the ends of flashes from their common line."""
_LIT = 0.2
"""Minimum total length of the flashes of an object, as a fraction of the distance from the start of the first
flash to the end of the last."""


def flashes_of_objects(ends: FloatArray) -> list[list[int]]:
    """Return, for each object, the indices of its streaks among `ends` (n, 2, 2), px, in order along a line.

    A tumbling object flashes, so that its streak has gaps. Streaks on a common line that do not overlap, and
    that are long enough compared with the gaps, are flashes of one object.
    """
    groups: list[list[int]] = []
    for index in range(len(ends)):
        for group in groups:
            if (joined := _along_one_line(ends, [*group, index])) is not None:
                group[:] = joined
                break
        else:
            groups.append([index])
    return groups


def _along_one_line(ends: FloatArray, group: list[int]) -> list[int] | None:
    """Return the indices `group` of streaks (n, 2, 2), px, in order of their positions along a common line.

    Returns None if the streaks are not flashes of one object on one line.
    """
    points = ends[group].reshape(-1, 2) - ends[group].reshape(-1, 2).mean(axis=0)
    along, aside = np.linalg.svd(points, full_matrices=False)[2]
    places = np.sort((points @ along).reshape(-1, 2), axis=1)
    order = np.argsort(places[:, 0])
    first, last = places[order, 0], places[order, 1]
    lit = float(np.sum(last - first))
    apart = bool(np.all(first[1:] > last[:-1]))
    if not apart or lit < _LIT * (last[-1] - first[0]) or np.abs(points @ aside).max() > _ASIDE_PX:
        return None
    return [group[k] for k in order]
