"""Stars of a whole frame."""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, Image, IntArray
from knightcube.vision.startracker.detection.areas import Areas, cluttered
from knightcube.vision.startracker.detection.detections import REFUSED, Detections, FrameKind, Quality
from knightcube.vision.startracker.detection.first_look import FrameSpread, Shapes, first_look, frame_spread
from knightcube.vision.startracker.detection.frame_kind import frame_shape, is_streak
from knightcube.vision.startracker.detection.measurement import Measured, measure
from knightcube.vision.startracker.detection.peaks import Peaks, find_peaks, worth_measuring
from knightcube.vision.startracker.detection.settings import DetectionSettings
from knightcube.vision.startracker.detection.sky import Sky
from knightcube.vision.startracker.detection.survey import Survey, survey
from knightcube.vision.startracker.detection.targets import Targets

# This many times the stars wanted are measured: some will prove to be none.
_MEASURED_FOR_ONE = 1.5
_CLUTTERED_SHARE = 0.25
# Where the sky itself seems this many times as noisy as elsewhere it is no sky.
_RESTLESS = 2.5
# A saturated disc wider than this is no star's but a planet's, the Moon's, a lamp's.
_WIDEST_CORE = 7.0
_SHARPER, _BROADER = 0.55, 1.8
_SURE = 3.0
_LONGER_THAN_COMA = 12.0
# Where most of the sources about one have no star's shape, it is a leaf or a lamp, whatever its own.
_ABOUT = 48.0
_ODD_PART, _LEAST_ODD = 0.5, 8
_ODD_WIDTH, _ODD_LENGTH = 1.25, 2.5
_CONFIRMED = 0.5
_FARTHEST = 2.0


def detect(pixels: Image, settings: DetectionSettings | None = None) -> Detections:
    """Return the sources of a frame (rows, columns) of counts, brightest first; `stars()` selects stars.

    Raises ValueError when `pixels` is no finite frame of real numbers, 16 x 16 or larger.
    """
    return measure_areas(survey(pixels, settings))


def measure_areas(seen: Survey) -> Detections:
    """Return the sources of a survey's areas, brightest first."""
    pixels, settings, areas = seen.pixels, seen.settings, seen.areas
    peaks = find_peaks(areas)
    if not len(peaks):
        return Detections.none(settings.psf_sigma or np.nan)
    flags = _flags_of_areas(seen.sky, areas, peaks)
    open_sky = (flags & Quality.CLUTTER) == 0
    chosen = worth_measuring(peaks, open_sky, pixels.shape, int(_MEASURED_FOR_ONE * settings.most_stars))
    peaks, flags = peaks.select(chosen), flags[chosen]
    targets = _targets(pixels, seen.sky, areas, peaks)
    shapes = first_look(targets, settings.gain)
    spread = frame_spread(shapes, plain_ones(flags == 0, targets), settings)
    found = measure(targets, shapes, spread, settings)
    quality = flags | quality_of(found, shapes, spread, targets)
    odd = (areas.length[peaks.area] > _ODD_LENGTH * spread.psf_sigma) | looks_odd(quality, shapes, spread)
    quality = quality | Quality.CLUTTER * among_odd(odd, found.points)
    real = confirmed(found, targets, settings) | ((quality & REFUSED) != 0)
    whole = assemble(found, shapes, quality, targets, spread, np.full(len(peaks), -1)).select(real)
    return _brightest(whole.in_order(), settings.most_stars).scaled(seen.unit)


def quality_of(found: Measured, shapes: Shapes, spread: FrameSpread, targets: Targets) -> IntArray:
    """Return the flags (n,) that stars' own pixels give: saturated, blended, clipped, hot, extended."""
    sure = _SURE * shapes.error
    alone = (targets.core == 0.0) & ~found.blended
    hot = alone & (shapes.hot | (shapes.width + sure < _SHARPER * spread.psf_sigma))
    wide = alone & (shapes.width - sure > _BROADER * spread.psf_sigma)
    wide |= targets.core > _WIDEST_CORE
    limits = np.array(targets.pixels.shape)[::-1] - 0.5
    margin = 2.0 * spread.psf_sigma
    inside = (found.points > margin - 0.5) & (found.points < limits - margin)
    return np.asarray(
        Quality.SATURATED * (targets.core > 0.0)
        | Quality.BLENDED * found.blended
        | Quality.CLIPPED * ~inside.all(axis=1)
        | Quality.HOT * hot
        | Quality.EXTENDED * wide
    )


def plain_ones(sound: BoolArray, targets: Targets) -> BoolArray:
    """Return which of the `sound` (n,) give the point spread: the unsaturated, where there are any."""
    plain = sound & (targets.core == 0.0)
    return plain if plain.any() else sound


def looks_odd(quality: IntArray, shapes: Shapes, spread: FrameSpread) -> BoolArray:
    """Return which sources (n,) look like no star: streaks, clutter, or broader than the point spread."""
    refused = (quality & REFUSED & ~int(Quality.HOT)) != 0
    return np.asarray(refused | (shapes.width - shapes.error > _ODD_WIDTH * spread.psf_sigma))


def among_odd(odd: BoolArray, points: FloatArray) -> BoolArray:
    """Return which sources (n,) at `points` (n, 2) px stand among sources most of which are `odd` (n,)."""
    near = np.sum((points[:, None] - points) ** 2, axis=-1) < _ABOUT**2
    strange = near @ odd.astype(float)
    return np.asarray((strange >= _LEAST_ODD) & (strange > _ODD_PART * near.sum(axis=1)))


def confirmed(found: Measured, targets: Targets, settings: DetectionSettings) -> BoolArray:
    """Return which stars (n,) the measurement confirms: enough light, near its peak, inside the frame."""
    far = np.maximum(_FARTHEST, targets.core)[:, None]
    near = (np.abs(found.points - targets.middle) < far).all(axis=1)
    limits = np.array(targets.pixels.shape)[::-1] - 0.5
    inside = ((found.points > -0.5) & (found.points < limits)).all(axis=1)
    return np.asarray(
        near & inside & (found.flux > _CONFIRMED * settings.threshold_sigmas * found.flux_sigma)
    )


def assemble(
    found: Measured,
    shapes: Shapes,
    quality: IntArray,
    targets: Targets,
    spread: FrameSpread,
    prediction: IntArray,
) -> Detections:
    """Return detections in the targets' order."""
    return Detections(
        found.points,
        np.sqrt(0.5 * np.trace(found.covariance, axis1=1, axis2=2)),
        found.covariance,
        found.flux,
        targets.level + found.sky,
        found.flux / found.flux_sigma,
        shapes.width,
        quality,
        prediction,
        spread.psf_sigma,
    )


def _targets(pixels: Image, sky: Sky, areas: Areas, peaks: Peaks) -> Targets:
    column, row = peaks.place.T
    level, noise = sky.level.at(column, row), sky.pixel_noise.at(column, row)
    still = np.zeros((len(peaks.place), 2))
    return Targets(pixels, peaks.place, level, noise, areas.ceiling, peaks.core, still, sky.correlation)


def _flags_of_areas(sky: Sky, areas: Areas, peaks: Peaks) -> IntArray:
    """Return the flags (p,) that the areas give: streak and clutter."""
    noise = sky.smooth_noise
    restless = noise.at(*peaks.place.T) > _RESTLESS * np.median(noise.values)
    clutter = restless | cluttered(areas, peaks.place, _CLUTTERED_SHARE)
    long = is_streak(areas)[peaks.area]
    if frame_shape(areas).kind is not FrameKind.STREAKS:
        # Stars in a row are long too, but show their peaks; a bright one in a corner has a tail.
        long &= np.bincount(peaks.area, minlength=len(areas))[peaks.area] == 1
        long &= (areas.length[peaks.area] > _LONGER_THAN_COMA) & (peaks.core == 0.0)
    return np.asarray(Quality.CLUTTER * clutter | Quality.STREAK * long)


def _brightest(found: Detections, most: int) -> Detections:
    """Return the brightest `most` stars and as many of the refused."""
    star = found.is_star
    kept = np.where(star, np.cumsum(star), np.cumsum(~star)) <= most
    return found.select(kept)
