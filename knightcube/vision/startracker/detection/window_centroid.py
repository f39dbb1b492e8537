"""The windowed centre of mass with border subtraction: Michalski eq. 12-21, corrected.

The window is a x a pixels about the brightest one. 14 and 15 as printed end it one pixel too far for the
divisor 4 (a - 1) of 16e, which counts the border of a x a pixels: here it ends at x_start + a - 1. (20) is
y_CM with j (errata). The outermost pixels are the border, the centre of mass is taken of those within; other
centroids (`centroids`) begin there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.vision.startracker.detection.centroids import METHODS, Centroid
from knightcube.vision.startracker.detection.noise_model import NoiseModel
from knightcube.vision.startracker.detection.point_spread import light
from knightcube.vision.startracker.detection.settings import Method
from knightcube.vision.startracker.detection.windows import Windows

_PHASES = np.linspace(-0.45, 0.45, 10)
_FAINTEST = 1e-3
"""Noise of a pixel, of the star's light, by which a method without noise still leaves pixels out."""


@dataclass(frozen=True, slots=True, eq=False)
class WindowCentroids:
    """Centres of mass.

    Attributes:
        offset: (n, 2) px from the middle pixel; clipped to the window where the light is noise.
        flux, sky: (n,) counts within the border, and a pixel on the border.
        variance: (n,) px^2 along one axis, of the noise and of the light that the window cuts off.
        flux_variance: (n,) counts^2.
    """

    offset: FloatArray
    flux: FloatArray
    sky: FloatArray
    variance: FloatArray
    flux_variance: FloatArray


def centre_of_mass(
    windows: Windows, noise: NoiseModel, psf_sigma: float, method: Method = "window"
) -> WindowCentroids:
    """Return the centres of mass of `windows` (eq. 12-20); those cut by the edge are of the pixels there.

    Another `method` replaces the place by that of `centroids`.
    """
    half = windows.half
    offset, flux, sky = _moments(windows.light)
    inner = windows.light[:, 1:-1, 1:-1]
    variance = noise.variance(inner - sky[:, None, None], windows.noise)
    offset, slopes = _places(windows.light, variance, psf_sigma, method)
    both = 0.5 * np.sum(variance[:, None] * slopes**2, axis=(1, 2, 3))
    # The border's mean is off by its noise, and pulls the centre of mass towards the window's middle.
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
    """Return the centroids of a method and their slopes by the pixels within the border."""
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
    """Return the rms error in px of window, border and method over a pixel's places, without noise."""
    place = np.stack([_PHASES, np.zeros_like(_PHASES)], axis=-1)
    stars = light(place, np.full(len(_PHASES), psf_sigma), half)
    places, _ = _places(stars, np.full_like(stars[:, 1:-1, 1:-1], _FAINTEST**2), psf_sigma, method)
    return float(np.sqrt(np.mean((places[:, 0] - _PHASES) ** 2)))
