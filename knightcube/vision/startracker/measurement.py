"""Positions and fluxes of stars, from a fit of the point spread function (PSF) or a centroid in a window.

`first_look` fits each star alone with a free width, and `frame_spread` derives the PSF and the noise of the
frame from these fits. `measure` fits each star with the PSF of the frame, or computes a centroid in a window
after subtraction of the mean of the window's border (Michalski, eq. (12) to (21)). A window with the side
length a (px) ends at column x_start + a - 1. In Michalski, eq. (14) and (15), the window ends one pixel
later, which contradicts eq. (16e), where the border has 4 (a - 1) pixels. Michalski, eq. (20), repeats x_CM
instead of y_CM, and is corrected here (errata).

Three other centroid methods start from the centre of mass and weight the pixels. `weighted` weights each
pixel with its own counts (Michalski, reference [22]; most CubeSat star trackers use this method). `iterative`
uses a Gaussian weight that follows the centroid (Stone 1989, Astronomical Journal 97, 1227, and the windowed
positions of SExtractor). `gaussian` fits a parabola to the logarithm of the counts. Each centroid method also
returns the derivatives of the centroid with respect to the pixels, from which the variance of the centroid is
computed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.compiled import compiled_form_of
from knightcube.vision.frame import are_hot
from knightcube.vision.startracker.psf_fit import (
    FLUX,
    WIDTH,
    NoiseModel,
    Pairs,
    PsfFit,
    StarTargets,
    StarWindows,
    fit,
    light,
    measure_noise,
    neighbour_light,
    neighbours,
)
from knightcube.vision.startracker.survey import DetectionSettings, Method

FIRST_WIDTH = 1.0
_HALF_OF_FIRST = 4
LEAST_HALF, MOST_HALF = 3, 9
REACH = 2.7
"""Half-width of a star's window (PSF standard deviations), limited to `LEAST_HALF` to `MOST_HALF` px."""
_FIRST_NOISE = NoiseModel(0.0, 0.1)
# Assumed mismatch between PSF and Gaussian in the second fit, as a fraction of the star's counts.
# A mismatch as large as in the first fit would give weight only to the wings of bright stars.
_NEXT_MISMATCH = 0.02
# Mismatch between PSF and Gaussian that is assumed if no star determines it.
_UNKNOWN_MISMATCH = 0.02
_MOST_OF_CELL = 4
# Minimum number of stars for which the measured width of the PSF replaces a given width.
_MANY = 8
_LEAST_LONE = 3
# Minimum counts of a hot pixel above the sky, in standard deviations of a pixel's noise.
_LEAST_HOT = 10.0
# Minimum distance (px) between two stars whose windows in the first fit do not overlap.
_APART = 2 * _HALF_OF_FIRST + 1


@dataclass(frozen=True, slots=True, eq=False)
class Shapes:
    """The first fits of n stars, each with a free `width` (n,), px, of its Gaussian, and the fitted windows.

    The standard deviation of each width is `error` (n,), px. The mask `hot` (n,) marks hot pixels.
    """

    width: FloatArray
    error: FloatArray
    hot: BoolArray
    fitted: PsfFit
    windows: StarWindows


@dataclass(frozen=True, slots=True)
class FrameSpread:
    """The standard deviation of the PSF of one frame, px, and the noise model of the stars' pixels."""

    psf_sigma: float
    noise: NoiseModel

    @property
    def half(self) -> int:
        """The half-width of the window in which a star is fitted, px."""
        return int(np.clip(np.ceil(REACH * self.psf_sigma), LEAST_HALF, MOST_HALF))


def first_look(targets: StarTargets, gain: float | None = None) -> Shapes:
    """Return the first fits of stars, before the PSF is known; `gain` is in electrons per count, if known."""
    windows = targets.windows(_HALF_OF_FIRST)
    offset, flux = start(windows)
    width = np.full(len(windows), FIRST_WIDTH)
    fitted = fit(windows, offset, flux, width, _FIRST_NOISE, free_width=True, steps=4)
    width, error = fitted.width, np.sqrt(np.maximum(fitted.covariance[:, WIDTH, WIDTH], 0.0))
    if gain is not None:
        noise = NoiseModel(1.0 / gain, _NEXT_MISMATCH)
        fitted = fit(windows, fitted.offset, fitted.flux, width, noise, free_width=True, steps=1)
    # The errors of the widths include the mismatch between PSF and Gaussian in the first noise model.
    return Shapes(width, error, single_pixels(windows), fitted, windows)


def frame_spread(shapes: Shapes, plain: BoolArray, settings: DetectionSettings) -> FrameSpread:
    """Return the width of the PSF and the noise model of a frame, from the stars selected by `plain` (n,).

    A gain in the settings is used unchanged. The width in the settings is used unless at least eight stars
    determine the width. If no star is usable, the width is 1 px unless given, and the photon noise is 0
    unless the gain is given.
    """
    fitted = shapes.fitted
    certain = fitted.flux > 8.0 * np.sqrt(fitted.covariance[:, FLUX, FLUX])
    inside = np.all(np.abs(fitted.offset) < 1.5, axis=1)
    lone = ~crowded(shapes.windows.middle)
    plain = plain & lone if np.count_nonzero(plain & lone) >= _LEAST_LONE else plain
    telling = np.flatnonzero(plain & ~shapes.hot & certain & inside & (shapes.error < 0.2 * shapes.width))
    given = settings.psf_sigma
    if not len(telling):
        return FrameSpread(
            given or FIRST_WIDTH, NoiseModel(1.0 / settings.gain if settings.gain else 0.0, _UNKNOWN_MISMATCH)
        )
    telling, share = _evenly_spread(shapes.windows.middle, telling)
    width, error = shapes.width[telling], shapes.error[telling]
    psf_sigma = given or 0.0
    if given is None or len(telling) >= _MANY:
        psf_sigma = _weighted_median(width, share / ((error / width) ** 2 + 0.1**2))
    alike = telling[np.abs(width - psf_sigma) < np.maximum(3.0 * error, 0.25 * psf_sigma)]
    part, windows = fitted.select(alike), shapes.windows.select(alike)
    noise = _noise_of(part, windows, settings)
    # If the PSF is given, the second fit is omitted, which halves the time for a tracking frame.
    for _ in range(0 if given else 2):
        part = fit(windows, part.offset, part.flux, part.width, noise, free_width=True, steps=2)
        noise = _noise_of(part, windows, settings)
        if len(alike):
            error = np.sqrt(part.covariance[:, WIDTH, WIDTH])
            psf_sigma = _weighted_median(part.width, 1.0 / ((error / part.width) ** 2 + 0.02**2))
    return FrameSpread(psf_sigma, noise)


def _noise_of(fitted: PsfFit, windows: StarWindows, settings: DetectionSettings) -> NoiseModel:
    return measure_noise(
        fitted.residual, fitted.variance, fitted.leverage, fitted.model, windows.noise, settings.gain
    )


def start(windows: StarWindows) -> tuple[FloatArray, FloatArray]:
    """Return initial offsets (n, 2), px, and fluxes (n,), counts, from the middle 3 x 3 pixels."""
    return _starts(windows.light, windows.noise)


def _starts_numpy(light: FloatArray, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
    """See `start`; the windows have the counts `light` (n, k, k) and the noise (n,)."""
    h = light.shape[1] // 2
    core = np.maximum(light[:, h - 1 : h + 2, h - 1 : h + 2], 0.0)
    whole = np.maximum(core.sum(axis=(1, 2)), 1e-12)
    x = (core[:, :, 2] - core[:, :, 0]).sum(axis=1) / whole
    y = (core[:, 2] - core[:, 0]).sum(axis=1) / whole
    # The 3 x 3 pixels contain three quarters of the flux of a star of 1 px standard deviation.
    flux = np.maximum(whole / 0.75, noise)
    return np.clip(np.stack([x, y], axis=-1), -0.6, 0.6), flux


@compiled_form_of(_starts_numpy)
def _starts(light: FloatArray, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
    """See `_starts_numpy`."""
    h, offset, flux = light.shape[1] // 2, np.empty((len(light), 2)), np.empty(len(light))
    for star in range(len(light)):
        whole, x, y = 0.0, 0.0, 0.0
        for row in range(-1, 2):
            for column in range(-1, 2):
                counts = max(light[star, h + row, h + column], 0.0)
                whole, x, y = whole + counts, x + column * counts, y + row * counts
        whole = max(whole, 1e-12)
        offset[star, 0] = min(max(x / whole, -0.6), 0.6)
        offset[star, 1] = min(max(y / whole, -0.6), 0.6)
        flux[star] = max(whole / 0.75, noise[star])
    return offset, flux


def single_pixels(windows: StarWindows) -> BoolArray:
    """Return which windows (n,) show a hot pixel: one or two bright pixels with dark neighbours."""
    h = windows.half
    core = windows.light[:, h - 1 : h + 2, h - 1 : h + 2].reshape(len(windows), 9)
    hot = are_hot(np.ascontiguousarray(core.T), windows.noise)
    return np.asarray(hot & (core.max(axis=1) > _LEAST_HOT * windows.noise))


def crowded(middle: IntArray) -> BoolArray:
    """Return which stars (n,) have another star in their window of the first fit."""
    return _crowded(np.ascontiguousarray(middle))


def _crowded_numpy(middle: IntArray) -> BoolArray:
    """See `crowded`."""
    x, y = middle.T
    near = (np.abs(x[:, None] - x) < _APART) & (np.abs(y[:, None] - y) < _APART)
    return np.asarray(np.count_nonzero(near, axis=1) > 1)


@compiled_form_of(_crowded_numpy)
def _crowded(middle: IntArray) -> BoolArray:
    """See `crowded`."""
    found = np.zeros(len(middle), dtype=np.bool_)
    for one in range(len(middle)):
        for other in range(one):
            across, down = middle[one, 0] - middle[other, 0], middle[one, 1] - middle[other, 1]
            near = (abs(across) < _APART) & (abs(down) < _APART)
            found[one] |= near
            found[other] |= near
    return found


def _evenly_spread(middle: IntArray, chosen: IntArray) -> tuple[IntArray, FloatArray]:
    """Return at most four `chosen` stars in each of 16 parts of the frame, and their weights.

    Each part has the same total weight. Stars are in all parts of the frame, but foreground
    sources, such as the leaves of a tree, are in one part.
    """
    return _spread_evenly(np.ascontiguousarray(middle), chosen)


def _spread_evenly_numpy(middle: IntArray, chosen: IntArray) -> tuple[IntArray, FloatArray]:
    """See `_evenly_spread`."""
    place = middle[chosen] - middle.min(axis=0)
    column, row = (place * 4 // (np.ptp(middle, axis=0) + 1)).T
    cell = row * 4 + column
    rank = np.count_nonzero(np.tril(cell[:, None] == cell, -1), axis=1)
    first = rank < _MOST_OF_CELL
    count = np.bincount(cell[first], minlength=16)
    return chosen[first], 1.0 / count[cell[first]]


@compiled_form_of(_spread_evenly_numpy)
def _spread_evenly(middle: IntArray, chosen: IntArray) -> tuple[IntArray, FloatArray]:
    """See `_evenly_spread`."""
    left, top, right, bottom = middle[0, 0], middle[0, 1], middle[0, 0], middle[0, 1]
    for star in range(len(middle)):
        left, right = min(left, middle[star, 0]), max(right, middle[star, 0])
        top, bottom = min(top, middle[star, 1]), max(bottom, middle[star, 1])
    count, cell = np.zeros(16, dtype=np.int64), np.empty(len(chosen), dtype=np.int64)
    first, kept = np.empty(len(chosen), dtype=np.int64), 0
    for star in chosen:
        column = (middle[star, 0] - left) * 4 // (right - left + 1)
        own = (middle[star, 1] - top) * 4 // (bottom - top + 1) * 4 + column
        if count[own] < _MOST_OF_CELL:
            first[kept], cell[kept] = star, own
            count[own] += 1
            kept += 1
    return first[:kept].copy(), 1.0 / count[cell[:kept]]


def _weighted_median(values: FloatArray, weights: FloatArray) -> float:
    order = np.argsort(values)
    whole = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(whole, 0.5 * whole[-1])])


Centroid = tuple[FloatArray, FloatArray]
"""Type of centroids (n, 2), px, relative to the window's middle, and derivatives (n, 2, m, m), px/count."""

_ROUNDS = 12
_STANDS_OUT = 3.0
"""Minimum counts of a pixel whose logarithm is fitted, in standard deviations of its noise."""
_LEAST = 6
"""Minimum number of pixels for the fit of a parabola with four unknowns."""
_INSIDE = 1.5
"""Maximum distance (px) of the vertex of the parabola from the centre of mass."""


def weighted(clean: FloatArray, _: FloatArray, start: Centroid, __: float) -> Centroid:
    """Return the centroids (n, 2) of the squared counts in windows `clean` (n, m, m)."""
    light = np.maximum(clean, 0.0)
    total = np.maximum(np.sum(light * light, axis=(1, 2)), 1e-30)
    places, slopes = [], []
    for step in _steps(clean):
        place = np.sum(light * light * step, axis=(1, 2)) / total
        places.append(place)
        slopes.append(2.0 * light * (step - place[:, None, None]) / total[:, None, None])
    return np.stack(places, axis=1), np.stack(slopes, axis=1)


def iterative(clean: FloatArray, _: FloatArray, start: Centroid, psf_sigma: float) -> Centroid:
    """Return centroids with a Gaussian weight that is centred on the previous centroid in each iteration.

    The iteration starts from the centre of mass `start`.
    """
    steps = np.stack([np.broadcast_to(step, clean.shape[1:]) for step in _steps(clean)])
    place, reach = start[0].copy(), (clean.shape[1] - 1) / 2.0
    for _round in range(_ROUNDS + 1):
        off = steps - place[:, :, None, None]
        window = np.exp(-0.5 * np.sum(off * off, axis=1) / psf_sigma**2)
        seen = (window * clean)[:, None]
        # The variable `gain` is minus the derivative of the moment with respect to the weight's position.
        # For a star with the same width as the weight, `gain` is half of the weighted sum of counts.
        gain = np.sum(seen * (1.0 - off * off / psf_sigma**2), axis=(2, 3))
        half = 0.5 * np.sum(seen, axis=(2, 3))
        gain = np.maximum(gain, np.maximum(0.5 * half, 1e-30))
        if _round == _ROUNDS:
            break
        place = np.clip(place + np.sum(seen * off, axis=(2, 3)) / gain, -reach, reach)
    return place, window[:, None] * off / gain[:, :, None, None]


def gaussian(clean: FloatArray, variance: FloatArray, start: Centroid, _: float) -> Centroid:
    """Return the vertices of parabolas fitted to the logarithm of the counts.

    If too few pixels exceed the noise, or if the vertex is far from the initial centroid of the star, the
    initial centroid is returned.
    """
    x, y = (np.broadcast_to(step, clean.shape) for step in _steps(clean))
    used: BoolArray = clean > _STANDS_OUT * np.sqrt(variance)
    light = np.where(used, clean, 1.0)
    weight = np.where(used, light * light / variance, 0.0)
    columns = np.stack([np.ones_like(x), x, y, -(x * x + y * y)], axis=1).reshape(len(clean), 4, -1)
    weighed = columns * weight.reshape(len(clean), 1, -1)
    normal = weighed @ columns.transpose(0, 2, 1) + 1e-12 * np.eye(4)
    # The array `moved` contains the derivatives of the four unknowns with respect to ln(counts).
    moved = np.linalg.solve(normal, weighed)
    found = np.sum(moved * np.log(light).reshape(len(clean), 1, -1), axis=2)
    bend = np.where(found[:, 3] > 0.0, found[:, 3], np.inf)
    place = found[:, 1:3] / (2.0 * bend[:, None])
    by_log = (moved[:, 1:3] - 2.0 * place[:, :, None] * moved[:, 3:]) / (2.0 * bend[:, None, None])
    slopes = by_log.reshape(len(clean), 2, *clean.shape[1:]) / light[:, None]
    sound = (np.count_nonzero(used, axis=(1, 2)) >= _LEAST) & np.isfinite(bend)
    sound &= np.all(np.abs(place - start[0]) < _INSIDE, axis=1)
    return np.where(sound[:, None], place, start[0]), np.where(sound[:, None, None, None], slopes, start[1])


METHODS: dict[str, Callable[[FloatArray, FloatArray, Centroid, float], Centroid]] = {
    "weighted": weighted,
    "gaussian": gaussian,
    "iterative": iterative,
}


def _steps(clean: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the pixel positions along x (1, m) and y (m, 1) relative to the middle of the window, px."""
    half = clean.shape[1] // 2
    step = np.arange(-half, half + 1, dtype=float)
    return step[None, :], step[:, None]


_PHASES = np.linspace(-0.45, 0.45, 10)
_FAINTEST = 1e-3
"""Noise of a pixel in the simulation of the systematic error, as a fraction of the star's flux."""


@dataclass(frozen=True, slots=True, eq=False)
class WindowCentroids:
    """Centroids of n stars in their windows.

    Attributes:
        offset: centroids relative to the middle pixel of the window (n, 2), px, limited to the window.
        flux: sum of the counts inside the border of the window, above the sky (n,).
        sky: mean of the border of the window (n,), counts per pixel.
        variance: variance of the centroid along one axis (n,), px^2, due to noise and the finite window.
        flux_variance: variance of the flux (n,), counts^2.
    """

    offset: FloatArray
    flux: FloatArray
    sky: FloatArray
    variance: FloatArray
    flux_variance: FloatArray


def centre_of_mass(
    windows: StarWindows, noise: NoiseModel, psf_sigma: float, method: Method = "window"
) -> WindowCentroids:
    """Return the centroids in windows, computed by one of `METHODS` or as centres of mass.

    The centre of mass follows Michalski, eq. (12) to (20). Pixels outside the frame count as zero.
    """
    half = windows.half
    offset, flux, sky = _moments(windows.light)
    inner = windows.light[:, 1:-1, 1:-1]
    variance = noise.variance(inner - sky[:, None, None], windows.noise)
    offset, slopes = _places(windows.light, variance, psf_sigma, method)
    both = 0.5 * np.sum(variance[:, None] * slopes**2, axis=(1, 2, 3))
    # The sky level is the mean over the border of the window, and its noise causes noise of the centroid.
    border = windows.noise**2 / (8.0 * half)
    area = float(inner[0].size) if len(inner) else 1.0
    both += 0.5 * np.sum(slopes.sum(axis=(2, 3)) ** 2, axis=1) * border
    return WindowCentroids(
        offset,
        flux,
        sky,
        both + _cut_off(half, psf_sigma, method) ** 2,
        np.sum(variance, axis=(1, 2)) + area**2 * border,
    )


def _places(window: FloatArray, variance: FloatArray, psf_sigma: float, method: Method) -> Centroid:
    """Return centroids, and their derivatives with respect to the pixels inside the border of the window."""
    offset, flux, sky = _moments(window)
    clean = window[:, 1:-1, 1:-1] - sky[:, None, None]
    half = window.shape[1] // 2
    step = np.arange(1 - half, half)
    whole = np.maximum(flux, 1e-30)[:, None, None]
    across = np.broadcast_to((step - offset[:, :1])[:, None, :], clean.shape) / whole
    down = np.broadcast_to((step - offset[:, 1:])[:, :, None], clean.shape) / whole
    plain = offset, np.stack([across, down], axis=1)
    return METHODS[method](clean, variance, plain, psf_sigma) if method in METHODS else plain


def _moments(window: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    half = window.shape[1] // 2
    rim = window[:, 0].sum(axis=1) + window[:, -1].sum(axis=1)
    rim = rim + window[:, 1:-1, 0].sum(axis=1) + window[:, 1:-1, -1].sum(axis=1)
    sky = rim / (4.0 * (window.shape[1] - 1))
    clean = window[:, 1:-1, 1:-1] - sky[:, None, None]
    flux = clean.sum(axis=(1, 2))
    step = np.arange(1 - half, half)
    whole = np.where(flux > 0.0, flux, np.inf)
    x, y = clean.sum(axis=1) @ step / whole, clean.sum(axis=2) @ step / whole
    return np.clip(np.stack([x, y], axis=-1), 1 - half, half - 1), flux, sky


def _cut_off(half: int, psf_sigma: float, method: Method) -> float:
    """Return the rms systematic error (px) of a centroid method over positions along one axis of a pixel."""
    place = np.stack([_PHASES, np.zeros_like(_PHASES)], axis=-1)
    stars = light(place, np.full(len(_PHASES), psf_sigma), half)
    places, _ = _places(stars, np.full_like(stars[:, 1:-1, 1:-1], _FAINTEST**2), psf_sigma, method)
    return float(np.sqrt(np.mean((places[:, 0] - _PHASES) ** 2)))


_BLEND_ROUNDS = 5
_STEPS, _STEPS_SATURATED = 3, 12
# Minimum standard deviation (px) of a position, because pixels differ and the PSF is not Gaussian.
_FLOOR = 0.002


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredStars:
    """The measurements of n stars.

    Attributes:
        points: positions (x, y) of the stars (n, 2), px.
        covariance: covariances of the positions (n, 2, 2), px^2.
        flux, flux_sigma: flux and its standard deviation (n,), counts.
        sky: residual sky level at each star (n,), counts per pixel.
        blended: mask of the stars that overlap with the image of another star (n,).
    """

    points: FloatArray
    covariance: FloatArray
    flux: FloatArray
    flux_sigma: FloatArray
    sky: FloatArray
    blended: BoolArray


def measure(
    targets: StarTargets, shapes: Shapes, spread: FrameSpread, settings: DetectionSettings
) -> MeasuredStars:
    """Return the stars measured by the method in the settings; saturated stars are always fitted."""
    parts = [(targets.core == 0.0, False), (targets.core > 0.0, True)]
    count = len(targets)
    out = MeasuredStars(
        np.zeros((count, 2)),
        np.zeros((count, 2, 2)),
        np.zeros(count),
        np.ones(count),
        np.zeros(count),
        np.zeros(count, dtype=bool),
    )
    for chosen, saturated in parts:
        if not chosen.any():
            continue
        if chosen.all():
            some, before = targets, shapes.fitted
        else:
            some, before = targets.select(chosen), shapes.fitted.select(np.flatnonzero(chosen))
        if saturated:
            widest = float(some.core.max(initial=0.0)) + REACH * spread.psf_sigma + 1.0
            half = int(np.clip(np.ceil(widest), LEAST_HALF, 2 * MOST_HALF))
            part = _fitted(some, before, spread, half, free_width=True)
        elif settings.method != "psf":
            part = _centred(some, spread, settings)
        else:
            part = _fitted(some, before, spread, spread.half, free_width=False)
        for name in MeasuredStars.__slots__:
            getattr(out, name)[chosen] = getattr(part, name)
    return out


def _fitted(
    targets: StarTargets, before: PsfFit, spread: FrameSpread, half: int, free_width: bool
) -> MeasuredStars:
    windows = targets.windows(half)
    offset, flux = start(windows)
    if free_width:
        # At the edge of the saturated disc, the star's profile equals the saturation level.
        steep = np.minimum(0.5 * (targets.core / spread.psf_sigma) ** 2, 12.0)
        flux = 2.0 * np.pi * spread.psf_sigma**2 * (targets.ceiling - targets.level) * np.exp(steep)
    else:
        known = (np.abs(before.offset) < 1.0).all(axis=1) & (before.flux > 0.5 * flux)
        offset = np.where(known[:, None], before.offset, offset)
        flux = np.where(known, before.flux, flux)
    width = np.full(len(targets), spread.psf_sigma)
    found = fit(
        windows, offset, flux, width, spread.noise, free_width, _STEPS_SATURATED if free_width else _STEPS
    )
    pairs = neighbours(targets.middle + found.offset, found.flux, spread.psf_sigma, half)
    blended = pairs.overlap > 0.0
    if len(pairs.first):
        found = _shared(windows, targets.middle, found, start(windows), pairs, spread.noise, free_width)
    freedom = np.maximum(found.used - found.covariance.shape[1], 1)
    excess = found.chi2 / freedom
    excess = np.where(excess > 1.0 + 3.0 * np.sqrt(2.0 / freedom), excess, 1.0) * targets.correlation**2
    # The pixels must determine the parameters of several stars, so that overlap increases the covariance.
    excess = excess / (1.0 - pairs.overlap) ** 2
    covariance = found.covariance[:, :2, :2] * excess[:, None, None] + _FLOOR**2 * np.eye(2)
    flux_sigma = _flux_sigma(found, windows, spread.noise) * targets.correlation
    return MeasuredStars(
        targets.middle + found.offset, covariance, found.flux, flux_sigma, found.sky, np.asarray(blended)
    )


def _shared(
    windows: StarWindows,
    middle: IntArray,
    found: PsfFit,
    begin: tuple[FloatArray, FloatArray],
    pairs: Pairs,
    noise: NoiseModel,
    free_width: bool,
) -> PsfFit:
    """Return the fits after each blended star is fitted again with the light of its neighbours subtracted.

    The fits start from the offsets (n, 2), px, and fluxes (n,), counts, in `begin`, because the position from
    a fit of two stars as one is a poor initial value.
    """
    some = np.unique(pairs.first)
    own = windows.select(some)
    offset, flux, width = found.offset.copy(), found.flux.copy(), found.width
    offset[some], flux[some] = begin[0][some], begin[1][some]
    part = found.select(some)
    for _ in range(_BLEND_ROUNDS):
        foreign = neighbour_light(pairs, windows, middle, offset, flux, width)[some]
        part = fit(own.without(foreign), offset[some], flux[some], width[some], noise, free_width, 2)
        offset[some], flux[some] = part.offset, part.flux
    return found.replaced(some, part)


def _flux_sigma(found: PsfFit, windows: StarWindows, noise: NoiseModel) -> FloatArray:
    """Return the standard deviations (n,) of the fluxes, counts, due to sky noise and photon noise only."""
    good = np.ascontiguousarray(windows.good)
    return _flux_errors(found.model, good, np.ascontiguousarray(found.flux), windows.noise, noise.photon)


def _flux_errors_numpy(
    model: FloatArray, good: BoolArray, flux: FloatArray, noise: FloatArray, photon: float
) -> FloatArray:
    """Return the standard deviations (n,) of the fluxes (n,) for modelled counts (n, k, k), counts."""
    counts = np.where(flux > 0.0, flux, np.inf)[:, None, None]
    seen = np.where(good, model / counts, 0.0)
    counted = NoiseModel(photon).variance(model, noise)
    return np.asarray(np.sum(seen * seen / counted, axis=(1, 2)) + 1e-30) ** -0.5


@compiled_form_of(_flux_errors_numpy)
def _flux_errors(
    model: FloatArray, good: BoolArray, flux: FloatArray, noise: FloatArray, photon: float
) -> FloatArray:
    """See `_flux_errors_numpy`."""
    out, size = np.empty(len(flux)), model.shape[1]
    for star in range(len(flux)):
        total, floor = 0.0, noise[star] ** 2
        for row in range(size):
            for column in range(size):
                counts = model[star, row, column]
                if good[star, row, column]:
                    total += counts * counts / (floor + photon * max(counts, 0.0))
        total = total / flux[star] ** 2 if flux[star] > 0.0 else 0.0
        out[star] = 1.0 / math.sqrt(total + 1e-30)
    return out


def _centred(targets: StarTargets, spread: FrameSpread, settings: DetectionSettings) -> MeasuredStars:
    half = settings.window // 2
    windows = targets.windows(half)
    # The window is centred on the brightest pixel, as in Michalski (text before eq. (12)).
    core = windows.light[:, half - 1 : half + 2, half - 1 : half + 2].reshape(len(windows), 9)
    row, column = np.divmod(core.argmax(axis=1), 3)
    limits = np.array(targets.pixels.shape)[::-1] - 1
    middle = np.clip(targets.middle + np.stack([column, row], axis=-1) - 1, 0, limits)
    windows = targets.windows(half, middle)
    found = centre_of_mass(windows, spread.noise, spread.psf_sigma, settings.method)
    covariance = (found.variance * targets.correlation**2 + _FLOOR**2)[:, None, None] * np.eye(2)
    flux_sigma = np.sqrt(found.flux_variance) * targets.correlation
    pairs = neighbours(middle + found.offset, found.flux, spread.psf_sigma, half)
    blended = pairs.overlap > 0.0
    return MeasuredStars(
        middle + found.offset, covariance, found.flux, flux_sigma, found.sky, np.asarray(blended)
    )
