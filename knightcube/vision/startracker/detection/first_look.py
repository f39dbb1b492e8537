"""The first look at a frame's stars: each one's own shape, and so the frame's point spread and noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.vision.frame.hot_pixels import are_hot
from knightcube.vision.startracker.detection.noise_model import NoiseModel, measure_noise
from knightcube.vision.startracker.detection.psf_fit import FLUX, WIDTH, PsfFit, fit
from knightcube.vision.startracker.detection.settings import DetectionSettings
from knightcube.vision.startracker.detection.targets import Targets
from knightcube.vision.startracker.detection.windows import Windows

FIRST_WIDTH = 1.0
_HALF_OF_FIRST = 4
LEAST_HALF, MOST_HALF = 3, 9
REACH = 2.7
"""Half a window, in sigmas of the point spread, and its least and greatest, px."""
_FIRST_NOISE = NoiseModel(0.0, 0.1)
# Of a shape that is nearly found: under the first noise bright stars are fitted by their wings alone, which
# leaves as much of their cores as if the shape were wrong.
_NEXT_MISMATCH = 0.02
# Of the shape, where no star shows it.
_UNKNOWN_MISMATCH = 0.02
_MOST_OF_CELL = 4
# Stars that show the width themselves, so that a given one is not needed.
_MANY = 8
_LEAST_LONE = 3
# Of a pixel's noise: fainter ones are not called hot.
_LEAST_HOT = 10.0
# Two windows of the first look that do not touch.
_APART = 2 * _HALF_OF_FIRST + 1


@dataclass(frozen=True, slots=True, eq=False)
class Shapes:
    """Each star fitted alone: its width (n,) px, its error (n,) px, whether it is hot (n,)."""

    width: FloatArray
    error: FloatArray
    hot: BoolArray
    fitted: PsfFit
    windows: Windows


@dataclass(frozen=True, slots=True)
class FrameSpread:
    """The point spread of one frame's stars and the noise of their pixels."""

    psf_sigma: float
    noise: NoiseModel

    @property
    def half(self) -> int:
        """Half the window that holds a star, px."""
        return int(np.clip(np.ceil(REACH * self.psf_sigma), LEAST_HALF, MOST_HALF))


def first_look(targets: Targets, gain: float | None = None) -> Shapes:
    """Return the shapes of stars whose point spread is not known yet; `gain` electrons a count if known."""
    windows = targets.windows(_HALF_OF_FIRST)
    offset, flux = start(windows)
    width = np.full(len(windows), FIRST_WIDTH)
    fitted = fit(windows, offset, flux, width, _FIRST_NOISE, free_width=True, steps=4)
    width, error = fitted.width, np.sqrt(np.maximum(fitted.covariance[:, WIDTH, WIDTH], 0.0))
    if gain is not None:
        noise = NoiseModel(1.0 / gain, _NEXT_MISMATCH)
        fitted = fit(windows, fitted.offset, fitted.flux, width, noise, free_width=True, steps=1)
    # Widths are judged by the first noise, which forgives an unlike shape.
    return Shapes(width, error, single_pixels(windows), fitted, windows)


def frame_spread(shapes: Shapes, plain: BoolArray, settings: DetectionSettings) -> FrameSpread:
    """Return the point spread and noise that the stars `plain` (n,), the brightest first, show.

    Settings that are given are kept, but for a width of which many stars show their own. Without a usable
    star the width is 1 px and no photon noise is known.
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
    # A given point spread needs no second look, which is half of a tracking frame's time.
    for _ in range(0 if given else 2):
        part = fit(windows, part.offset, part.flux, part.width, noise, free_width=True, steps=2)
        noise = _noise_of(part, windows, settings)
        if len(alike):
            error = np.sqrt(part.covariance[:, WIDTH, WIDTH])
            psf_sigma = _weighted_median(part.width, 1.0 / ((error / part.width) ** 2 + 0.02**2))
    return FrameSpread(psf_sigma, noise)


def _noise_of(fitted: PsfFit, windows: Windows, settings: DetectionSettings) -> NoiseModel:
    return measure_noise(
        fitted.residual, fitted.variance, fitted.leverage, fitted.model, windows.noise, settings.gain
    )


def start(windows: Windows) -> tuple[FloatArray, FloatArray]:
    """Return offset (n, 2) px and flux (n,) to begin with, from the middle 3 x 3 pixels."""
    h = windows.half
    core = np.maximum(windows.light[:, h - 1 : h + 2, h - 1 : h + 2], 0.0)
    whole = np.maximum(core.sum(axis=(1, 2)), 1e-12)
    x = (core[:, :, 2] - core[:, :, 0]).sum(axis=1) / whole
    y = (core[:, 2] - core[:, 0]).sum(axis=1) / whole
    # Three quarters of the light of a star of sigma 1 px; more pixels would hold neighbours' too.
    flux = np.maximum(whole / 0.75, windows.noise)
    return np.clip(np.stack([x, y], axis=-1), -0.6, 0.6), flux


def single_pixels(windows: Windows) -> BoolArray:
    """Return which windows (n,) hold one or two bright pixels with dark neighbours, which no optics make."""
    h = windows.half
    core = windows.light[:, h - 1 : h + 2, h - 1 : h + 2].reshape(len(windows), 9)
    return np.asarray(are_hot(core.T, windows.noise) & (core.max(axis=1) > _LEAST_HOT * windows.noise))


def crowded(middle: IntArray) -> BoolArray:
    """Return which targets (n,) have another in their window of the first look."""
    apart = np.abs(middle[:, None] - middle).max(axis=-1)
    np.fill_diagonal(apart, _APART)
    return np.asarray(apart.min(axis=1) < _APART)


def _evenly_spread(middle: IntArray, chosen: IntArray) -> tuple[IntArray, FloatArray]:
    """Return the first four of `chosen` in each sixteenth of what they cover, and weights (k,).

    Each sixteenth weighs the same: stars are everywhere, a tree's leaves in a corner.
    """
    place = middle[chosen] - middle.min(axis=0)
    column, row = (place * 4 // (np.ptp(middle, axis=0) + 1)).T
    cell = row * 4 + column
    rank = np.array([np.count_nonzero(cell[:k] == cell[k]) for k in range(len(cell))])
    first = rank < _MOST_OF_CELL
    count = np.bincount(cell[first], minlength=16)
    return chosen[first], 1.0 / count[cell[first]]


def _weighted_median(values: FloatArray, weights: FloatArray) -> float:
    order = np.argsort(values)
    whole = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(whole, 0.5 * whole[-1])])
