"""The brightness of the sunlit limb at each tangent height, by Rayleigh scattering alone.

A line of sight of tangent height h passes the optical depth t(h) = t0 exp(-h/H), t0 = t_v sqrt(2 pi R/H),
with t_v the vertical depth of Rayleigh scattering and H the air's scale height; lower down it ends on the
ground, at the elevation whose sine is sqrt(-2h/R). Sunlit air shines as 1 - exp(-t); the ground, of whatever
brightness, is seen through it as exp(-t). Unblurred that falls fastest where t = 1, 15.4 km up. No
refraction: it lowers the apparent limb by 1 to 2 km, within the spread that
`HorizonSettings.limb_height_sigma` states.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.figure import SEMI_MAJOR_AXIS

SCALE_HEIGHT = 8000.0
"""m, of the lower air (US Standard Atmosphere 1976: 8.4 km at the ground, 6.4 km at 15 km)."""
VERTICAL_DEPTH = 0.097
"""Of the whole air at 550 nm (Bucholtz 1995, Appl. Opt. 34, 2765, Table 3)."""
UNIT_DEPTH_HEIGHT = SCALE_HEIGHT * math.log(
    VERTICAL_DEPTH * math.sqrt(2.0 * math.pi * SEMI_MAJOR_AXIS / SCALE_HEIGHT)
)
"""m, 15.4 km: where the optical depth right through is one."""

_LOWEST, _HIGHEST, _STEP = -320e3, 240e3, 500.0
"""m, of the table."""
_SHARPEST, _BROADEST, _WIDTHS = 500.0, 50e3, 61
"""m, standard deviations of blur, spaced evenly in their logarithm."""


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
