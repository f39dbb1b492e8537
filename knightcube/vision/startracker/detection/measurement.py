"""Stars measured with their frame's own point spread and noise, by a fit or by the centre of mass."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.vision.startracker.detection.blending import Pairs, neighbour_light, neighbours
from knightcube.vision.startracker.detection.first_look import (
    LEAST_HALF,
    MOST_HALF,
    REACH,
    FrameSpread,
    Shapes,
    start,
)
from knightcube.vision.startracker.detection.noise_model import NoiseModel
from knightcube.vision.startracker.detection.psf_fit import PsfFit, fit
from knightcube.vision.startracker.detection.settings import DetectionSettings
from knightcube.vision.startracker.detection.targets import Targets
from knightcube.vision.startracker.detection.window_centroid import centre_of_mass
from knightcube.vision.startracker.detection.windows import Windows

_BLEND_ROUNDS = 5
_STEPS, _STEPS_SATURATED = 3, 12
# Least error, px: pixels differ, and no star is exactly a Gaussian.
_FLOOR = 0.002


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """Stars (n,) measured: places px, covariance px^2, flux and its sigma, sky, whether blended."""

    points: FloatArray
    covariance: FloatArray
    flux: FloatArray
    flux_sigma: FloatArray
    sky: FloatArray
    blended: BoolArray


def measure(targets: Targets, shapes: Shapes, spread: FrameSpread, settings: DetectionSettings) -> Measured:
    """Return the stars measured by the settings' method; saturated ones are fitted in any case."""
    parts = [(targets.core == 0.0, False), (targets.core > 0.0, True)]
    count = len(targets)
    out = Measured(
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
        some, before = targets.select(chosen), shapes.fitted.select(np.flatnonzero(chosen))
        if saturated:
            part = _fitted(some, before, spread, _half_of(some, spread), free_width=True)
        elif settings.method != "psf":
            part = _centred(some, spread, settings)
        else:
            part = _fitted(some, before, spread, spread.half, free_width=False)
        for name in Measured.__slots__:
            getattr(out, name)[chosen] = getattr(part, name)
    return out


def _half_of(targets: Targets, spread: FrameSpread) -> int:
    widest = float(targets.core.max(initial=0.0)) + REACH * spread.psf_sigma + 1.0
    return int(np.clip(np.ceil(widest), LEAST_HALF, 2 * MOST_HALF))


def _fitted(targets: Targets, before: PsfFit, spread: FrameSpread, half: int, free_width: bool) -> Measured:
    windows = targets.windows(half)
    offset, flux = start(windows)
    if free_width:
        # At the rim of the saturated disc the light is the ceiling's.
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
    # Neighbours share their pixels' information: the nearer, the less is left to each.
    excess = excess / (1.0 - pairs.overlap) ** 2
    covariance = found.covariance[:, :2, :2] * excess[:, None, None] + _FLOOR**2 * np.eye(2)
    flux_sigma = _flux_sigma(found, windows, spread.noise) * targets.correlation
    return Measured(
        targets.middle + found.offset, covariance, found.flux, flux_sigma, found.sky, np.asarray(blended)
    )


def _shared(
    windows: Windows,
    middle: IntArray,
    found: PsfFit,
    begin: tuple[FloatArray, FloatArray],
    pairs: Pairs,
    noise: NoiseModel,
    free_width: bool,
) -> PsfFit:
    """Return `found` with the stars that have neighbours fitted again, each without the others' light.

    They begin at `begin`, offset (n, 2) and flux (n,): a fit of two stars as one is no start for either.
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


def _flux_sigma(found: PsfFit, windows: Windows, noise: NoiseModel) -> FloatArray:
    """Return the noise (n,) of fluxes, counts: of sky and photons alone, a wrong shape is none."""
    flux = np.where(found.flux > 0.0, found.flux, np.inf)[:, None, None]
    seen = np.where(windows.good, found.model / flux, 0.0)
    counted = NoiseModel(noise.photon).variance(found.model, windows.noise)
    return np.asarray(np.sum(seen * seen / counted, axis=(1, 2)) + 1e-30) ** -0.5


def _centred(targets: Targets, spread: FrameSpread, settings: DetectionSettings) -> Measured:
    half = settings.window // 2
    windows = targets.windows(half)
    # The window stands about the brightest pixel (text before eq. 12), not about the smoothed peak.
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
    return Measured(middle + found.offset, covariance, found.flux, flux_sigma, found.sky, np.asarray(blended))
