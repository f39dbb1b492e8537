"""The brightness of the sunlit limb against tangent height, and its fit to the samples along a scan line.

A line of sight with tangent height h passes the optical depth t(h) = t0 exp(-h/H), t0 = t_v sqrt(2 pi R/H),
with t_v the vertical depth of Rayleigh scattering and H the scale height of the air. Below the surface the
line ends on the ground, at the elevation whose sine is sqrt(-2h/R). Sunlit air has the brightness
1 - exp(-t); the ground, of any brightness, is attenuated by exp(-t). Without blur the brightness falls
fastest where t = 1, at 15.4 km. Refraction is neglected: it lowers the apparent limb by 1 to 2 km, within
`HorizonSettings.limb_height_sigma`.

The profile across an edge is background + a air(h) + g ground(h), where h falls by a known number of metres
per pixel. The position of unit optical depth is fitted together with the three brightnesses. Unlike the
steepest place, it is not shifted inwards by bright ground behind the limb or outwards by thinning haze.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray
from knightcube.astro.earth.figure import SEMI_MAJOR_AXIS

SCALE_HEIGHT = 8000.0
"""Scale height of the lower air (m; US Standard Atmosphere 1976: 8.4 km at the ground, 6.4 km at 15 km)."""
VERTICAL_DEPTH = 0.097
"""Vertical optical depth of the whole air at 550 nm (Bucholtz 1995, Appl. Opt. 34, 2765, Table 3)."""
UNIT_DEPTH_HEIGHT = SCALE_HEIGHT * math.log(
    VERTICAL_DEPTH * math.sqrt(2.0 * math.pi * SEMI_MAJOR_AXIS / SCALE_HEIGHT)
)
"""m, 15.4 km: where the optical depth right through is one."""

_LOWEST, _HIGHEST, _STEP = -320e3, 240e3, 500.0
"""Tangent heights of the table: first, last and step (m)."""
_SHARPEST, _BROADEST, _WIDTHS = 500.0, 50e3, 61
"""Standard deviations of blur in the table (m), spaced evenly in their logarithm, and their number."""


def limb_light(heights: FloatArray, blur: FloatArray) -> FloatArray:
    """Return the light of air and of ground, and both slopes per m, (4, n, k), at tangent heights (n, k) m.

    Seen through Gaussian blurs of (n,) m; sunlit air without end and the ground without air are both 1. The
    nearest blur of the table serves: they are 8 % apart.
    """
    table = _table()
    width = np.log(np.clip(blur, _SHARPEST, _BROADEST) / _SHARPEST) / math.log(_BROADEST / _SHARPEST)
    row = np.rint(width * (_WIDTHS - 1)).astype(int)[:, None]
    place = np.clip((heights - _LOWEST) / _STEP, 0.0, table.shape[2] - 1.001)
    column = place.astype(int)
    part = place - column
    low = table[:, row, column]
    return np.asarray(low + part * (table[:, row, column + 1] - low))


@lru_cache(maxsize=1)
def _table() -> FloatArray:
    """Return air, ground and their slopes (4, widths, heights)."""
    heights = np.arange(_LOWEST, _HIGHEST, _STEP)
    depth = np.where(
        heights >= 0.0,
        math.exp(UNIT_DEPTH_HEIGHT / SCALE_HEIGHT) * np.exp(-np.maximum(heights, 0.0) / SCALE_HEIGHT),
        _slant_depth(np.sqrt(np.maximum(-2.0 * heights / SEMI_MAJOR_AXIS, 0.0))),
    )
    through = np.exp(-depth)
    widths = _SHARPEST * (_BROADEST / _SHARPEST) ** (np.arange(_WIDTHS) / (_WIDTHS - 1))
    air = _blurred(1.0 - through, widths)
    ground = _blurred(np.where(heights < 0.0, through, 0.0), widths)
    return np.stack([air, ground, np.gradient(air, _STEP, axis=1), np.gradient(ground, _STEP, axis=1)])


def _slant_depth(sines: FloatArray) -> FloatArray:
    """Return the optical depth from the ground out at elevations of `sines` (n,), by the trapezium rule."""
    way = np.linspace(0.0, 1200e3, 601)
    above = (
        np.sqrt(SEMI_MAJOR_AXIS**2 + 2.0 * SEMI_MAJOR_AXIS * way * sines[:, None] + way**2) - SEMI_MAJOR_AXIS
    )
    density = np.exp(-above / SCALE_HEIGHT)
    mean = np.mean(0.5 * (density[:, 1:] + density[:, :-1]), axis=1)
    return np.asarray(VERTICAL_DEPTH / SCALE_HEIGHT * way[-1] * mean)


def _blurred(profile: FloatArray, widths: FloatArray) -> FloatArray:
    """Return the profile (m,) through Gaussian blurs (k,) m, (k, m); extended beyond its ends."""
    margin = int(4.0 * _BROADEST / _STEP)
    padded = np.pad(profile, margin, mode="edge")
    frequency = 2.0 * np.pi * np.fft.rfftfreq(len(padded), _STEP)
    spectrum = np.fft.rfft(padded) * np.exp(-0.5 * (widths[:, None] * frequency) ** 2)
    return np.asarray(np.fft.irfft(spectrum, len(padded), axis=1)[:, margin:-margin])


_FIT_STEPS = 2
_OUTSIDE, _INSIDE = -8.0, 4.0
"""Ends of the part of the profile that is fitted, px from the steepest point."""
_FLOOR, _SHARE = 0.02, 0.08
"""Noise of a sample: fractions of the limb's brightness and of the sample's own brightness."""
_FARTHEST = 2.0
"""Largest distance (px) of the fitted limb from the steepest point."""
_LEAST = 7
"""Least number of samples of a fit."""


def fit_profiles(
    profiles: FloatArray, steps: FloatArray, metres: FloatArray, blur: FloatArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return the limb's places (n,) px, their spreads (n,) px, and which are sound (n,).

    `profiles` (n, m) is light at `steps` (n, m) px along each line to the bright side, NaN where there is
    none; `metres` (n,) of tangent height a pixel; `blur` (n,) m. The places are on the scale of `steps`.
    """
    usable = np.isfinite(profiles) & (steps >= _OUTSIDE) & (steps <= _INSIDE)
    light = np.where(usable, profiles, 0.0)
    enough = np.count_nonzero(usable, axis=1) >= _LEAST
    top = np.max(np.where(usable, profiles, -np.inf), axis=1, initial=0.0)
    height = np.maximum(top, 1e-12)[:, None]
    light = light / height
    weights = usable / (_FLOOR + _SHARE * np.clip(light, 0.0, 1.0)) ** 2
    place = np.zeros(len(profiles))
    amounts = np.zeros((len(profiles), 3))
    # Weak priors that keep the equations regular if a profile leaves a parameter open.
    prior = np.diag([1.0, 1.0, 1.0, 0.1])
    of_place = np.zeros((len(profiles), 4, 1))
    of_place[:, 3] = 1.0
    for _ in range(_FIT_STEPS):
        heights = UNIT_DEPTH_HEIGHT - (steps - place[:, None]) * metres[:, None]
        air, ground, air_slope, ground_slope = limb_light(heights, blur)
        if not amounts.any():
            amounts = _amounts(light, weights, air, ground)
        model = amounts[:, :1] + amounts[:, 1:2] * air + amounts[:, 2:] * ground
        shift = (amounts[:, 1:2] * air_slope + amounts[:, 2:] * ground_slope) * metres[:, None]
        columns = np.stack([np.ones_like(air), air, ground, shift], axis=2)
        weighted = columns * weights[:, :, None]
        normal = weighted.transpose(0, 2, 1) @ columns + prior
        slope = weighted.transpose(0, 2, 1) @ (light - model)[:, :, None]
        # With the step the inverse's last column: the place's variance.
        answer = np.linalg.solve(normal, np.concatenate([slope, of_place], axis=2))
        amounts = amounts + answer[:, :3, 0]
        place = place + np.minimum(np.maximum(answer[:, 3, 0], -1.0), 1.0)
    misfit = np.sum(weights * (light - model) ** 2, axis=1) / np.maximum(
        np.count_nonzero(usable, axis=1) - 4, 1
    )
    spread = np.sqrt(answer[:, 3, 1] * np.maximum(misfit, 0.3))
    sound = enough & (np.abs(place) < _FARTHEST) & (amounts[:, 1] > 0.2)
    return place, spread, sound


def _amounts(light: FloatArray, weights: FloatArray, air: FloatArray, ground: FloatArray) -> FloatArray:
    """Return background, air and ground (n, 3) that explain the light best where the limb is now."""
    columns = np.stack([np.ones_like(air), air, ground], axis=2)
    weighted = (columns * weights[:, :, None]).transpose(0, 2, 1)
    return np.asarray(np.linalg.solve(weighted @ columns + np.eye(3), weighted @ light[:, :, None])[:, :, 0])
