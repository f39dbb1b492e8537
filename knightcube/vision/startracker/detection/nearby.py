"""Stars about predicted places: for tracking, when the frame need not be searched."""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, Image, IntArray
from knightcube.vision.frame.background import MAD_TO_SIGMA
from knightcube.vision.frame.saturation import saturation_level
from knightcube.vision.startracker.detection.detect import assemble, confirmed, plain_ones, quality_of
from knightcube.vision.startracker.detection.detections import Detections
from knightcube.vision.startracker.detection.first_look import first_look, frame_spread
from knightcube.vision.startracker.detection.measurement import measure
from knightcube.vision.startracker.detection.settings import DetectionSettings
from knightcube.vision.startracker.detection.sky import KERNEL_NORM, correlation_of, in_counts, one_sided
from knightcube.vision.startracker.detection.targets import Targets
from knightcube.vision.startracker.detection.windows import Windows, cut, smoothed

# Room about the search: the sky is taken from the pixels of its rim.
_RIM = 5
_ROUNDING = 12.0**-0.5
_TAIL_PART = 0.97725
_SAME_STAR = 1.5


def measure_near(
    pixels: Image,
    predicted: FloatArray,
    settings: DetectionSettings | None = None,
    trail: FloatArray | None = None,
) -> Detections:
    """Return the stars found near `predicted` (m, 2) px, brightest first; `prediction` says of which.

    `trail` (m, 2) px is by how much each moves over the exposure, a few px at most; None: not at all.

    Only windows about the predictions are read. Nothing is reported where no peak within the settings'
    search radius exceeds the threshold, and one star is given to the nearest prediction only. Raises
    ValueError when `pixels` is no frame of real numbers of 16 x 16 or larger, or a prediction is not finite.
    """
    pixels, unit = in_counts(pixels)
    settings = (settings or DetectionSettings()).in_units_of(unit)
    predicted = np.asarray(predicted, dtype=float).reshape(-1, 2)
    if not np.all(np.isfinite(predicted)):
        raise ValueError("a predicted place that is not finite")
    limits = np.array(pixels.shape)[::-1] - 0.5
    asked = np.flatnonzero(((predicted > -0.5) & (predicted < limits)).all(axis=1))
    if not len(asked):
        return Detections.none(settings.psf_sigma or np.nan)
    ceiling = saturation_level(pixels, settings.saturation)
    half = int(np.ceil(settings.search_radius)) + _RIM
    whole = np.zeros(len(asked))
    # Saturated pixels are light too in the search for the peak.
    path = None if trail is None else trail[asked]
    windows = cut(pixels, np.rint(predicted[asked]).astype(np.int64), half, whole, whole, np.inf, path)
    targets, number = _peaks_near(pixels, windows, predicted[asked], ceiling, settings)
    if not len(targets):
        return Detections.none(settings.psf_sigma or np.nan)
    shapes = first_look(targets, settings.gain)
    spread = frame_spread(shapes, plain_ones(np.ones(len(targets), dtype=bool), targets), settings)
    found = measure(targets, shapes, spread, settings)
    quality = quality_of(found, shapes, spread, targets)
    prediction = asked[number]
    everything = assemble(found, shapes, quality, targets, spread, prediction)
    real = confirmed(found, targets, settings)
    return everything.select(real).in_order().scaled(unit)


def _peaks_near(
    pixels: Image, windows: Windows, predicted: FloatArray, ceiling: float, settings: DetectionSettings
) -> tuple[Targets, IntArray]:
    """Return the highest peaks within the search radius that exceed the threshold, and whose they are."""
    level, noise, tail, correlation = _sky_of(windows, settings.search_radius)
    light = np.where(windows.good, windows.light - level[:, None, None], 0.0)
    smooth = smoothed(light)
    step = np.arange(-windows.half, windows.half + 1)
    off = predicted - windows.middle
    square = (step - off[:, :1])[:, None, :] ** 2 + (step - off[:, 1:])[:, :, None] ** 2
    allowed = windows.good & (square <= (settings.search_radius + 0.5) ** 2)
    smooth = np.where(allowed, smooth, -np.inf).reshape(len(windows), -1)
    best = smooth.argmax(axis=1)
    bright = smooth[np.arange(len(best)), best] > settings.threshold_sigmas * tail
    row, column = np.divmod(best, len(step))
    middle = windows.middle + np.stack([column, row], axis=-1) - windows.half
    saturated = np.count_nonzero(windows.good & (windows.light >= ceiling), axis=(1, 2))
    at_core = pixels[np.clip(middle[:, 1], 0, None), np.clip(middle[:, 0], 0, None)] >= ceiling
    core = np.where(at_core, np.sqrt(saturated / np.pi), 0.0)
    targets = Targets(pixels, middle, level, noise, ceiling, core, windows.trail, correlation)
    apart = np.linalg.norm(middle - predicted, axis=1)
    number = np.flatnonzero(bright)
    number = number[_nearest(middle[number], apart[number])]
    return targets.select(number), number


def _sky_of(windows: Windows, radius: float) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Return the sky's level (n,), its noise (n,) of single pixels and of smoothed ones, and its correlation.

    From the windows' rims. The smoothed noise has the light of faint stars in it, which the threshold of the
    search needs; the correlation is how much more noisy a sum of pixels is than independent ones.
    """
    step = np.abs(np.arange(-windows.half, windows.half + 1))
    rim = np.maximum(step[:, None], step) > radius + 1.0
    mean, variance = _clipped(np.where(windows.good, windows.light, np.inf)[:, rim])
    # Other stars and a rim of few counts widen or narrow single windows: they are taken together.
    common = float(np.sqrt(np.median(variance) + _ROUNDING**2))
    light = np.where(windows.good, windows.light - mean[:, None, None], 0.0)
    smooth = smoothed(light)[:, 1:-1, 1:-1][:, rim[1:-1, 1:-1]]
    tail = max(0.5 * _reach(smooth), KERNEL_NORM * common)
    cut_off = one_sided(np.array(_reach(-light[:, rim])), np.array(common))
    spread = tail if cut_off else float(np.sqrt(np.median(_clipped(smooth)[1])))
    noise = np.full(len(windows), common)
    return mean, noise, np.full(len(windows), tail), correlation_of(spread, common)


def _reach(values: FloatArray) -> float:
    """Return how far 2.3 % of each line of `values` (n, k) reach upwards, of a typical line."""
    place = int(_TAIL_PART * values.shape[1])
    return float(np.median(np.partition(values, place, axis=1)[:, place]))


def _clipped(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return mean and variance (n,) of each line of `values` (n, k), inf for nothing, without its tails."""
    level = _median(values)
    apart = np.abs(values - level[:, None])
    kept = apart <= 3.0 * np.maximum(MAD_TO_SIGMA * _median(apart), 0.5)[:, None]
    count = np.maximum(kept.sum(axis=1), 1)
    mean = np.where(kept, values, 0.0).sum(axis=1) / count
    square = np.where(kept, values - mean[:, None], 0.0) ** 2
    return mean, square.sum(axis=1) / count


def _median(values: FloatArray) -> FloatArray:
    """Return the lower median of each line of `values` (n, k), in which inf stands for nothing."""
    count = np.maximum(np.isfinite(values).sum(axis=1), 1)
    return np.asarray(np.sort(values, axis=1)[np.arange(len(values)), (count - 1) // 2])


def _nearest(points: IntArray, apart: FloatArray) -> BoolArray:
    """Return which (n,) are the nearest to their prediction of all that found the same peak."""
    same = np.linalg.norm(points[:, None] - points, axis=-1) < _SAME_STAR
    order = np.arange(len(points))
    better = (apart < apart[:, None]) | ((apart == apart[:, None]) & (order < order[:, None]))
    return np.asarray(~np.any(same & better, axis=1))
