"""Detection of the stars of a frame, in the whole frame or near predicted positions.

`detect` searches a whole frame, measures the local maxima of the areas above the noise, and flags sources
that are not stars. `measure_near` reads only small windows around predicted positions, for tracking.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import IntFlag

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, Image, IntArray, median, select
from knightcube.compiled import compiled_form_of, loop_helper
from knightcube.vision.background import MAD_TO_SIGMA
from knightcube.vision.frame import label_pixels, saturation_level
from knightcube.vision.startracker.measurement import (
    FrameSpread,
    MeasuredStars,
    Shapes,
    first_look,
    frame_spread,
    measure,
)
from knightcube.vision.startracker.psf_fit import StarTargets, StarWindows, cut, smoothed
from knightcube.vision.startracker.survey import (
    KERNEL_NORM,
    TAIL_PART,
    Areas,
    DetectionSettings,
    FrameKind,
    SkyBackground,
    Survey,
    cluttered,
    correlation_of,
    frame_shape,
    in_counts,
    is_streak,
    one_sided,
    survey,
)


class Quality(IntFlag):
    """Quality flags of a source. A saturated, blended or clipped source may be a star."""

    POINT = 0
    SATURATED, BLENDED, CLIPPED = 1, 2, 4
    HOT, EXTENDED, STREAK, CLUTTER = 16, 32, 64, 128


REFUSED = int(Quality.HOT | Quality.EXTENDED | Quality.STREAK | Quality.CLUTTER)


@dataclass(frozen=True, slots=True, eq=False)
class Detections:
    """The n sources detected in one frame, the brightest first.

    Attributes:
        points: positions (x, y) of the sources (n, 2), px.
        sigma: standard deviation of the positions along one axis (n,), px.
        covariance: covariances of the positions (x, y) of the sources (n, 2, 2), px^2.
        flux: counts above the background of each source (n,).
        background: sky background at each source (n,), counts per pixel.
        signal_to_noise: flux of each source divided by its standard deviation (n,).
        width: standard deviation of the Gaussian that best fits each source (n,), px, or NaN if not measured.
        quality: `Quality` flags of each source (n,), int64.
        prediction: index of the prediction near which each source was found (n,); -1 without a prediction.
        psf_sigma: standard deviation of the frame's PSF, px, or NaN if it was neither given nor measured.
    """

    points: FloatArray
    sigma: FloatArray
    covariance: FloatArray
    flux: FloatArray
    background: FloatArray
    signal_to_noise: FloatArray
    width: FloatArray
    quality: IntArray
    prediction: IntArray
    psf_sigma: float

    @classmethod
    def none(cls, psf_sigma: float = np.nan) -> Detections:
        """Return detections without any source."""
        empty, whole = np.zeros(0), np.zeros(0, dtype=np.int64)
        return cls(
            np.zeros((0, 2)), empty, np.zeros((0, 2, 2)), empty, empty, empty, empty, whole, whole, psf_sigma
        )

    @property
    def is_star(self) -> BoolArray:
        """Mask (n,) of the sources that may be stars: not hot, not extended, not streaks and not clutter."""
        return np.asarray((self.quality & REFUSED) == 0)

    def select(self, chosen: BoolArray | IntArray) -> Detections:
        """Return the sources `chosen` by a mask (n,), or by indices (k,) in the order of the indices."""
        return select(self, chosen, "psf_sigma")

    def in_order(self) -> Detections:
        """Return the sources sorted by flux, the brightest first."""
        return self.select(np.argsort(-self.flux, kind="stable"))

    def scaled(self, unit: float) -> Detections:
        """Return the sources with all fluxes and backgrounds multiplied by `unit`."""
        if unit == 1.0:
            return self
        return replace(self, flux=self.flux * unit, background=self.background * unit)

    def stars(self) -> Detections:
        """Return the sources that may be stars."""
        return self.select(self.is_star)

    def __len__(self) -> int:
        return len(self.flux)


# Upper limit of a star's wings at a distance of d px, relative to the peak: share (1 + (d / scale)^2)^-power.
_WING_SCALE, _WING_POWER, _WING_SHARE = 2.0, 2.0, 0.7
_WINGS_END = 60.0
_CELLS = 4
_MOST_COMPARED = 500


@dataclass(frozen=True, slots=True, eq=False)
class Peaks:
    """Local maxima (peaks) of the smoothed frame: column and row (p, 2), and height (p,), counts.

    The highest peak is first. Each peak is in the area with the index `area` (p,). The radius of the
    saturated disc around a peak is `core` (p,), px; 0 if the peak is not saturated.
    """

    place: IntArray
    height: FloatArray
    area: IntArray
    core: FloatArray

    def select(self, chosen: BoolArray | IntArray) -> Peaks:
        """Return the peaks `chosen` by a mask (p,) or by indices."""
        return select(self, chosen)

    def __len__(self) -> int:
        return len(self.height)


def find_peaks(areas: Areas) -> Peaks:
    """Return the local maxima of the bright areas; a saturated disc has a single maximum, at its centre."""
    top = areas.peak
    place = np.stack([areas.column[top], areas.row[top]], axis=-1)
    peaks = Peaks(place, areas.smooth[top], areas.owner[top], np.zeros(len(place)))
    if areas.saturated.any():
        peaks = _with_cores(peaks, areas)
    return peaks.select(np.argsort(-peaks.height, kind="stable"))


def worth_measuring(peaks: Peaks, open_sky: BoolArray, shape: tuple[int, ...], most: int) -> IntArray:
    """Return the indices (k,) of the `peaks` (p,) to measure, the highest first.

    Local maxima that may be part of the wings of a brighter star are excluded. At most `most` peaks in the
    mask `open_sky` (p,) are selected, and at most a quarter of `most` in each sixteenth of the frame's area,
    so that a bright cloud does not exclude the stars beside it. Up to `most` peaks outside the open sky are
    also selected, so that the widths of foreground sources are measured.
    """
    return _worth_measuring(peaks.place, peaks.height, peaks.core, open_sky, shape[0], shape[1], most)


def _worth_measuring_numpy(
    place: IntArray,
    height: FloatArray,
    core: FloatArray,
    open_sky: BoolArray,
    rows: int,
    columns: int,
    most: int,
) -> IntArray:
    """See `worth_measuring`; the arguments are the attributes of the peaks and the shape of the frame."""
    compared = np.sort(
        np.concatenate([np.flatnonzero(part)[:_MOST_COMPARED] for part in (open_sky, ~open_sky)])
    )
    compared = compared[~_on_wings_numpy(place[compared], height[compared], core[compared])]
    parts = (compared[open_sky[compared]], compared[~open_sky[compared]])
    return np.sort(np.concatenate([part[_spread(place[part], (rows, columns), most)] for part in parts]))


def _spread(place: IntArray, shape: tuple[int, int], most: int) -> IntArray:
    """Return the indices of up to `most` peaks, at most a quarter of `most` in each sixteenth of the area."""
    row, column = (place[:, k] * _CELLS // shape[1 - k] for k in (1, 0))
    cell = row * _CELLS + column
    order = np.argsort(cell, kind="stable")
    rank = np.empty(len(place), dtype=np.int64)
    rank[order] = np.arange(len(place)) - np.searchsorted(cell[order], cell[order])
    return np.flatnonzero(rank < max(4, most // 4))[:most]


@compiled_form_of(_worth_measuring_numpy)
def _worth_measuring(
    place: IntArray,
    height: FloatArray,
    core: FloatArray,
    open_sky: BoolArray,
    rows: int,
    columns: int,
    most: int,
) -> IntArray:
    """See `_worth_measuring_numpy`."""
    compared, chosen = np.empty(len(place), dtype=np.int64), np.empty(len(place), dtype=np.int64)
    seen, kept, in_cell = np.zeros(2, np.int64), np.zeros(2, np.int64), np.zeros((2, _CELLS**2), np.int64)
    count, total, limit = 0, 0, max(4, most // 4)
    for peak in range(len(place)):
        side = int(open_sky[peak])
        if seen[side] == _MOST_COMPARED:
            continue
        seen[side] += 1
        # If enough peaks in (or outside) the open sky are selected, the peak there only hides other peaks.
        if kept[side] < most and not _is_hidden(place, height, core, compared[:count], peak):
            row, column = place[peak, 1] * _CELLS // rows, place[peak, 0] * _CELLS // columns
            cell = row * _CELLS + column
            if in_cell[side, cell] < limit:
                in_cell[side, cell] += 1
                kept[side] += 1
                chosen[total] = peak
                total += 1
        compared[count] = peak
        count += 1
        if kept[0] >= most and kept[1] >= most:
            break
    return chosen[:total].copy()


@loop_helper
def _is_hidden(place: IntArray, height: FloatArray, core: FloatArray, higher: IntArray, peak: int) -> bool:
    """Return whether a peak may be a local maximum on the wings of one of the `higher` peaks (k,)."""
    for other in higher:
        across, down = place[peak, 0] - place[other, 0], place[peak, 1] - place[other, 1]
        square = across * across + down * down
        if square < _WINGS_END**2:
            apart = max(math.sqrt(square) - core[other], 0.0)
            wing = _WING_SHARE * (1.0 + (apart / _WING_SCALE) ** 2) ** -_WING_POWER
            if height[peak] < height[other] * wing:
                return True
    return False


def _on_wings_numpy(place: IntArray, height: FloatArray, core: FloatArray) -> BoolArray:
    """Return which peaks (p,), the highest first, may be local maxima on the wings of a brighter star."""
    x, y = place.T
    square = (x[:, None] - x) ** 2 + (y[:, None] - y) ** 2
    # Only peaks closer than 60 px are compared: at 60 px, the wings are a millionth of the peak.
    lower, higher = np.nonzero(np.tri(len(x), k=-1, dtype=bool) & (square < _WINGS_END**2))
    # The wings of a saturated star begin at the edge of its saturated disc.
    apart = np.maximum(np.sqrt(square[lower, higher]) - core[higher], 0.0)
    wing = _WING_SHARE * (1.0 + (apart / _WING_SCALE) ** 2) ** -_WING_POWER
    hidden = height[lower] < height[higher] * wing
    return np.bincount(lower[hidden], minlength=len(x)) > 0


def _with_cores(peaks: Peaks, areas: Areas) -> Peaks:
    """Return the peaks, with a single peak for each saturated disc, at the centre of the disc."""
    row, column = areas.row[areas.saturated], areas.column[areas.saturated]
    owner, count = label_pixels(row * areas.shape[1] + column, areas.shape[1])
    size = np.bincount(owner, minlength=count)
    x, y = np.bincount(owner, column, count) / size, np.bincount(owner, row, count) / size
    radius = np.sqrt(size / np.pi)
    apart = np.hypot(peaks.place[:, 0, None] - x, peaks.place[:, 1, None] - y)
    kept = ~np.any(apart < 2.0 * radius + 2.5, axis=1)
    area = np.zeros(count, dtype=np.int64)
    area[owner] = areas.owner[areas.saturated]
    height = np.zeros(count)
    np.maximum.at(height, owner, areas.smooth[areas.saturated])
    return Peaks(
        np.concatenate([peaks.place[kept], np.rint(np.stack([x, y], axis=-1)).astype(np.int64)]),
        np.concatenate([peaks.height[kept], height * np.maximum(1.0, radius**2)]),
        np.concatenate([peaks.area[kept], area]),
        np.concatenate([peaks.core[kept], radius]),
    )


# Number of measured peaks per requested star, above 1 because some peaks are not stars.
_MEASURED_FOR_ONE = 1.5
# Number of peaks in a long area above which the area is the track of a particle, instead of a row of stars.
_MOST_IN_ROW = 3
_CLUTTERED_SHARE = 0.25
# Noise of a block of pixels, relative to the median noise of the frame, above which it is foreground.
_RESTLESS = 2.5
# Radius (px) of a saturated disc above which it is a planet, the Moon or a lamp instead of a star.
_WIDEST_CORE = 7.0
_SHARPER, _BROADER = 0.55, 1.8
_SURE = 3.0
_LONGER_THAN_COMA = 12.0
# A source is clutter if most sources within this radius (px) do not look like stars.
_ABOUT = 48.0
_ODD_PART, _LEAST_ODD = 0.5, 8
_ODD_WIDTH, _ODD_LENGTH = 1.25, 2.5
_CONFIRMED = 0.5
_FARTHEST = 2.0


def detect(pixels: Image, settings: DetectionSettings | None = None) -> Detections:
    """Return the sources of a frame (rows, columns), the brightest first.

    The method `Detections.stars` of the result returns the sources that may be stars. Raises ValueError
    unless the pixels are finite real numbers and the frame has at least 16 x 16 pixels.
    """
    return measure_areas(survey(pixels, settings))


def measure_areas(seen: Survey) -> Detections:
    """Return the sources in the areas of a survey, the brightest first."""
    pixels, settings, areas = seen.pixels, seen.settings, seen.areas
    peaks = find_peaks(areas)
    if not len(peaks):
        return Detections.none(settings.psf_sigma or np.nan)
    flags = _flags_of_areas(seen.sky, areas, peaks)
    open_sky = (flags & Quality.CLUTTER) == 0
    # Particle tracks, which are long areas with many peaks, must not displace the stars from the selection.
    track = (flags == 0) & is_streak(areas)[peaks.area] & (np.bincount(peaks.area)[peaks.area] > _MOST_IN_ROW)
    most = int(_MEASURED_FOR_ONE * settings.most_stars)
    chosen = worth_measuring(peaks, open_sky & ~track, pixels.shape, most)
    peaks, flags = peaks.select(chosen), flags[chosen]
    column, row = peaks.place.T
    targets = StarTargets(
        pixels,
        peaks.place,
        seen.sky.level.at(column, row),
        seen.sky.pixel_noise.at(column, row),
        areas.ceiling,
        peaks.core,
        np.zeros((len(peaks), 2)),
        seen.sky.correlation,
    )
    shapes = first_look(targets, settings.gain)
    spread = frame_spread(shapes, plain_ones(flags == 0, targets), settings)
    found = measure(targets, shapes, spread, settings)
    quality = flags | quality_of(found, shapes, spread, targets)
    odd = (areas.length[peaks.area] > _ODD_LENGTH * spread.psf_sigma) | looks_odd(quality, shapes, spread)
    quality = quality | Quality.CLUTTER * among_odd(odd, found.points)
    real = confirmed(found, targets, settings) | ((quality & REFUSED) != 0)
    whole = assemble(found, shapes, quality, targets, spread, np.full(len(peaks), -1)).select(real)
    found_all = whole.in_order()
    # Up to `most_stars` stars and up to `most_stars` other sources are kept, the brightest of each kind.
    star = found_all.is_star
    kept = np.where(star, np.cumsum(star), np.cumsum(~star)) <= settings.most_stars
    return found_all.select(kept).scaled(seen.unit)


def quality_of(found: MeasuredStars, shapes: Shapes, spread: FrameSpread, targets: StarTargets) -> IntArray:
    """Return the quality flags (n,) that are derived from the pixels of each source."""
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


def plain_ones(sound: BoolArray, targets: StarTargets) -> BoolArray:
    """Return which of the usable stars `sound` (n,) determine the PSF.

    The PSF is determined by the stars that are not saturated, or by all stars if all are saturated.
    """
    plain = sound & (targets.core == 0.0)
    return plain if plain.any() else sound


def looks_odd(quality: IntArray, shapes: Shapes, spread: FrameSpread) -> BoolArray:
    """Return which sources (n,) do not look like stars: streaks, clutter, and sources wider than the PSF."""
    refused = (quality & REFUSED & ~int(Quality.HOT)) != 0
    return np.asarray(refused | (shapes.width - shapes.error > _ODD_WIDTH * spread.psf_sigma))


def among_odd(odd: BoolArray, points: FloatArray) -> BoolArray:
    """Return which of n sources are mostly surrounded by sources that do not look like stars.

    The sources are at `points` (n, 2), px. The mask `odd` (n,) marks the sources that do not look like stars.
    """
    return _among_odd(odd, np.ascontiguousarray(points))


def _among_odd_numpy(odd: BoolArray, points: FloatArray) -> BoolArray:
    """See `among_odd`."""
    x, y = points.T
    near = (x[:, None] - x) ** 2 + (y[:, None] - y) ** 2 < _ABOUT**2
    strange = np.count_nonzero(near & odd, axis=1)
    return np.asarray((strange >= _LEAST_ODD) & (strange > _ODD_PART * np.count_nonzero(near, axis=1)))


@compiled_form_of(_among_odd_numpy)
def _among_odd(odd: BoolArray, points: FloatArray) -> BoolArray:
    """See `among_odd`."""
    found = np.zeros(len(odd), dtype=np.bool_)
    for one in range(len(odd)):
        near, strange = 0, 0
        for other in range(len(odd)):
            across, down = points[one, 0] - points[other, 0], points[one, 1] - points[other, 1]
            beside = across * across + down * down < _ABOUT**2
            near, strange = near + int(beside), strange + int(beside & odd[other])
        found[one] = strange >= _LEAST_ODD and strange > _ODD_PART * near
    return found


def confirmed(found: MeasuredStars, targets: StarTargets, settings: DetectionSettings) -> BoolArray:
    """Return which sources (n,) are significant, in the frame, and have a known position near their peak."""
    far = np.maximum(_FARTHEST, targets.core)[:, None]
    near = (np.abs(found.points - targets.middle) < far).all(axis=1)
    # The position is unknown if, for instance, all pixels of the source are saturated.
    near &= found.covariance[:, 0, 0] + found.covariance[:, 1, 1] < 2.0 * far[:, 0] ** 2
    limits = np.array(targets.pixels.shape)[::-1] - 0.5
    inside = ((found.points > -0.5) & (found.points < limits)).all(axis=1)
    return np.asarray(
        near & inside & (found.flux > _CONFIRMED * settings.threshold_sigmas * found.flux_sigma)
    )


def assemble(
    found: MeasuredStars,
    shapes: Shapes,
    quality: IntArray,
    targets: StarTargets,
    spread: FrameSpread,
    prediction: IntArray,
) -> Detections:
    """Return the measured sources as `Detections`, in the order of the targets."""
    return Detections(
        found.points,
        np.sqrt(0.5 * (found.covariance[:, 0, 0] + found.covariance[:, 1, 1])),
        found.covariance,
        found.flux,
        targets.level + found.sky,
        found.flux / found.flux_sigma,
        shapes.width,
        quality,
        prediction,
        spread.psf_sigma,
    )


def _flags_of_areas(sky: SkyBackground, areas: Areas, peaks: Peaks) -> IntArray:
    """Return the quality flags STREAK and CLUTTER (p,) of peaks, derived from the bright areas."""
    noise = sky.smooth_noise
    restless = noise.at(*peaks.place.T) > _RESTLESS * median(noise.values)
    clutter = restless | cluttered(areas, peaks.place, _CLUTTERED_SHARE)
    long = is_streak(areas)[peaks.area]
    if long.any() and frame_shape(areas).kind is not FrameKind.STREAKS:
        # A long area may also be a row of stars (several peaks) or a bright star with a tail due to coma.
        long &= np.bincount(peaks.area, minlength=len(areas))[peaks.area] == 1
        long &= (areas.length[peaks.area] > _LONGER_THAN_COMA) & (peaks.core == 0.0)
    return np.asarray(Quality.CLUTTER * clutter | Quality.STREAK * long)


# Width (px) of the border around the search area in which the sky is measured.
_RIM = 5
_ROUNDING = 12.0**-0.5
_SAME_STAR = 1.5


def measure_near(
    pixels: Image,
    predicted: FloatArray,
    settings: DetectionSettings | None = None,
    trail: FloatArray | None = None,
) -> Detections:
    """Return the stars near predicted positions, the brightest first.

    Only windows around the predictions (m, 2), px, are read; predictions outside the frame are ignored. A
    star is detected at a prediction only if a peak within the search radius exceeds the threshold. A peak
    near several predictions is assigned to the nearest prediction. During the exposure, each star moves by
    `trail` (m, 2), px, at most a few pixels. Raises ValueError unless pixels and predictions are finite real
    numbers and the frame has at least 16 x 16 pixels.
    """
    pixels, unit = in_counts(pixels)
    settings = (settings or DetectionSettings()).in_units_of(unit)
    predicted = np.asarray(predicted, dtype=float).reshape(-1, 2)
    if not np.all(np.isfinite(predicted)):
        raise ValueError("a predicted position is not finite")
    limits = np.array(pixels.shape)[::-1] - 0.5
    asked = np.flatnonzero(((predicted > -0.5) & (predicted < limits)).all(axis=1))
    if not len(asked):
        return Detections.none(settings.psf_sigma or np.nan)
    ceiling = saturation_level(pixels, settings.saturation)
    half = int(np.ceil(settings.search_radius)) + _RIM
    whole = np.zeros(len(asked))
    # The search for peaks also uses saturated pixels.
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
    pixels: Image, windows: StarWindows, predicted: FloatArray, ceiling: float, settings: DetectionSettings
) -> tuple[StarTargets, IntArray]:
    """Return the highest peaks above the threshold near predictions, and the predictions' indices (k,)."""
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
    targets = StarTargets(pixels, middle, level, noise, ceiling, core, windows.trail, correlation)
    apart = np.linalg.norm(middle - predicted, axis=1)
    number = np.flatnonzero(bright)
    points, apart = middle[number], apart[number]
    # A peak near several predictions is assigned to the nearest prediction.
    same = np.linalg.norm(points[:, None] - points, axis=-1) < _SAME_STAR
    order = np.arange(len(points))
    better = (apart < apart[:, None]) | ((apart == apart[:, None]) & (order < order[:, None]))
    number = number[~np.any(same & better, axis=1)]
    return targets.select(number), number


def _sky_of(windows: StarWindows, radius: float) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Return background, noise of single pixels, noise of smoothed pixels, all (n,), and noise correlation.

    Background and noise are measured in the borders of the windows around the predicted positions. The noise
    of smoothed pixels, from which the detection threshold is derived, includes faint stars. The noise
    correlation is the ratio of the noise of a sum of pixels to that of a sum of independent pixels.
    """
    step = np.abs(np.arange(-windows.half, windows.half + 1))
    rim = np.maximum(step[:, None], step) > radius + 1.0
    mean, variance = _clipped(np.where(windows.good, windows.light, np.inf)[:, rim])
    # The median noise of all windows is used, because stars or low counts can falsify the noise of a window.
    common = float(np.sqrt(np.median(variance) + _ROUNDING**2))
    light = np.where(windows.good, windows.light - mean[:, None, None], 0.0)
    smooth = smoothed(light)[:, 1:-1, 1:-1][:, rim[1:-1, 1:-1]]
    tail = max(0.5 * _reach(smooth), KERNEL_NORM * common)
    cut_off = one_sided(np.array(_reach(-light[:, rim])), np.array(common))
    spread = tail if cut_off else float(np.sqrt(np.median(_clipped(smooth)[1])))
    noise = np.full(len(windows), common)
    return mean, noise, np.full(len(windows), tail), correlation_of(spread, common)


def _reach(values: FloatArray) -> float:
    """Return the median over the rows of the 97.7th percentile of each row of `values` (n, k)."""
    place = int(TAIL_PART * values.shape[1])
    return float(np.median(np.partition(values, place, axis=1)[:, place]))


def _clipped(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the clipped mean (n,) and variance (n,) of the finite values in each row of `values` (n, k)."""
    level = _median(values)
    apart = np.abs(values - level[:, None])
    kept = apart <= 3.0 * np.maximum(MAD_TO_SIGMA * _median(apart), 0.5)[:, None]
    count = np.maximum(kept.sum(axis=1), 1)
    mean = np.where(kept, values, 0.0).sum(axis=1) / count
    square = np.where(kept, values - mean[:, None], 0.0) ** 2
    return mean, square.sum(axis=1) / count


def _median(values: FloatArray) -> FloatArray:
    """Return the lower median (n,) of the finite values in each row of `values` (n, k)."""
    count = np.maximum(np.isfinite(values).sum(axis=1), 1)
    return np.asarray(np.sort(values, axis=1)[np.arange(len(values)), (count - 1) // 2])
