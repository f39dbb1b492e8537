"""From a frame to streaks with two endpoints each (Sease chapter 3, corrected by the errata).

Background, hot pixels, regions, cornerness within each region's box, two peaks, sub-pixel ends. The regions
and the image without background are kept in the result, for an estimator that goes back to the pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, Image, IntArray
from knightcube.vision.frame import (
    Background,
    estimate_background,
    positions,
    repair_hot_pixels,
    saturation_level,
)
from knightcube.vision.streaks.corners.detectors import cornerness
from knightcube.vision.streaks.corners.endpoints import find_corners
from knightcube.vision.streaks.corners.segmentation import (
    Regions,
    find_regions,
    threshold_local,
    threshold_mean,
)
from knightcube.vision.streaks.corners.settings import StreakSettings

# Room around a region's box: the window and the derivative reach that far.
_PADDING = 8
# Regions this much shorter than the least length may still be streaks of that length: moments are rough.
_LENGTH_MARGIN = 0.75
# A uniform streak with a point spread of about 1 px has this part of its counts per px of length in its
# middle row.
_PEAK_FRACTION = 0.28


@dataclass(frozen=True, slots=True)
class Streaks:
    """Streaks of one frame, strongest first.

    Attributes:
        endpoints: (n, 2, 2) streak, end, (x, y) in px, as localised: without compensation; the order of ends
            means nothing.
        sigma: (n,) px, expected error of an endpoint.
        flux: (n,) counts.
        candidate: (n,) index of each streak's region among the candidates.
        crowded: the candidates with more than two corners, refused as streaks: index and corners (k, 2) px.
    """

    endpoints: FloatArray
    sigma: FloatArray
    flux: FloatArray
    candidate: IntArray
    crowded: tuple[tuple[int, FloatArray], ...]

    @property
    def lengths(self) -> FloatArray:
        """The distance between the ends (n,), px."""
        return np.asarray(np.linalg.norm(self.endpoints[:, 1] - self.endpoints[:, 0], axis=-1))

    def __len__(self) -> int:
        return self.flux.size


@dataclass(frozen=True, slots=True)
class Segmented:
    """A frame cut into regions.

    Attributes:
        signal: (rows, columns) float32 counts, background removed, hot pixels repaired.
        background: level and noise.
        regions: everything above the threshold.
        candidates: those of the regions that may give endpoints, strongest first.
        hot_pixels: how many were repaired.
    """

    signal: Image
    background: Background
    regions: Regions
    candidates: Regions
    hot_pixels: int


def segment_frame(pixels: Image, settings: StreakSettings) -> Segmented:
    """Return the regions of a frame (rows, columns) and which of them may be streaks."""
    background = estimate_background(pixels)
    noise = background.map(background.noise)
    signal = pixels.astype(np.float32)
    signal -= background.map(background.level)
    hot = repair_hot_pixels(signal, noise)
    local = settings.threshold_sigmas > 0.0
    mask = threshold_local(signal, noise, settings.threshold_sigmas) if local else threshold_mean(pixels)
    regions = find_regions(mask, signal, settings.least_area)
    usable = (
        (regions.length >= _LENGTH_MARGIN * settings.least_length)
        & ~near_border(regions, pixels.shape, settings.border)
        & ~saturated(regions, pixels, saturation_level(pixels, settings.saturation))
    )
    candidates = regions.select(usable)
    strength = candidates.length / expected_sigma(candidates, background, settings)
    strongest = np.argsort(-strength, kind="stable")[: settings.most_streaks]
    return Segmented(signal, background, regions, candidates.select(strongest), hot)


def measure_streaks(segmented: Segmented, settings: StreakSettings) -> Streaks:
    """Return the streaks among the candidates: those whose cornerness has exactly two peaks."""
    sigma = expected_sigma(segmented.candidates, segmented.background, settings)
    found: list[int] = []
    endpoints: list[FloatArray] = []
    crowded: list[tuple[int, FloatArray]] = []
    for index in range(len(segmented.candidates)):
        image, mask, corner = cut_out(segmented, index)
        response = cornerness(image, settings)
        intensity = response if settings.centre_of == "response" else image
        corners = find_corners(
            response, mask, settings.peak_relative, settings.intensity_half_width, intensity
        )
        if len(corners) == 2:
            found.append(index)
            endpoints.append(corners + corner)
        elif len(corners) > 2:
            crowded.append((index, corners + corner))
    stacked = np.array(endpoints).reshape(-1, 2, 2)
    chosen = np.array(found, dtype=np.int64)
    return Streaks(stacked, sigma[chosen], segmented.candidates.flux[chosen], chosen, tuple(crowded))


def expected_sigma(regions: Regions, background: Background, settings: StreakSettings) -> FloatArray:
    """Return the expected error (n,) in px of an endpoint of each region, from its counts and the noise."""
    density = regions.flux / (regions.length + 3.0)
    variance = background.typical_noise**2 + _PEAK_FRACTION * density / settings.gain
    return np.asarray(
        np.hypot(settings.endpoint_floor, settings.endpoint_noise * np.sqrt(variance) / density)
    )


def cut_out(segmented: Segmented, index: int) -> tuple[FloatArray, BoolArray, FloatArray]:
    """Return a candidate's image and mask with room around, other regions blanked, and its corner (x, y)."""
    rows, columns = segmented.signal.shape
    top, bottom, left, right = segmented.candidates.boxes[index]
    top, left = max(top - _PADDING, 0), max(left - _PADDING, 0)
    bottom, right = min(bottom + _PADDING, rows), min(right + _PADDING, columns)
    labels = segmented.candidates.labels[top:bottom, left:right]
    mask = labels == segmented.candidates.label[index]
    image = np.where(mask | (labels == 0), segmented.signal[top:bottom, left:right], 0.0).astype(np.float64)
    return image, mask, np.array([left, top], dtype=float)


def near_border(regions: Regions, shape: tuple[int, ...], border: int) -> BoolArray:
    """Return which regions (n,) come within `border` px of the frame's border: their ends may lie outside."""
    top, bottom, left, right = regions.boxes.T
    return np.asarray(
        (top < border) | (left < border) | (bottom > shape[0] - border) | (right > shape[1] - border)
    )


def saturated(regions: Regions, pixels: Image, saturation: float) -> BoolArray:
    """Return which regions (n,) hold a clipped pixel: their shape is not the point spread's."""
    row, column = positions(pixels >= saturation)
    return np.isin(regions.label, regions.labels[row, column])
