"""The density of the upper atmosphere: an exponential profile with a bulge that follows the Sun.

Profile: Vallado, Fundamentals of Astrodynamics (4th ed. 2013), Table 8-4. The bulge has its apex 30 deg
behind the Sun in right ascension and falls off as cos^4 of half the angle from it (Montenbruck & Gill 2000,
3.5.2, Harris-Priester); by day four times as dense as by night, as near 500 km at a mean solar activity.
"""

from __future__ import annotations

import math

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.figure import EARTH_RADIUS

_PROFILE = np.array(
    [
        [150e3, 2.070e-9],
        [200e3, 2.789e-10],
        [250e3, 7.248e-11],
        [300e3, 2.418e-11],
        [350e3, 9.518e-12],
        [400e3, 3.725e-12],
        [450e3, 1.585e-12],
        [500e3, 6.967e-13],
        [600e3, 1.454e-13],
        [700e3, 3.614e-14],
        [800e3, 1.170e-14],
        [900e3, 5.245e-15],
        [1000e3, 3.019e-15],
    ]
)
"""Height in m, density in kg/m^3."""
_NIGHT, _DAY = 0.4, 1.6
_MEAN = _NIGHT + (_DAY - _NIGHT) / 3.0
"""Over all sides."""
_LAG = math.radians(30.0)


def log_density(position: FloatArray, sun: FloatArray, day_bulge: float = 1.0) -> FloatArray:
    """Return the logarithm (n,) of the density in kg/m^3 at positions (n, 3) m, the Sun at (n, 3) m, ICRS.

    `day_bulge` is a share of the bulge: zero is its mean on all sides.
    """
    distance = np.linalg.norm(position, axis=-1)
    profile = np.interp(distance - EARTH_RADIUS, _PROFILE[:, 0], np.log(_PROFILE[:, 1]))
    cosine, sine = math.cos(_LAG), math.sin(_LAG)
    x, y = sun[..., 0], sun[..., 1]
    apex = np.stack([cosine * x - sine * y, sine * x + cosine * y, sun[..., 2]], axis=-1)
    facing = np.sum(position * apex, axis=-1) / (distance * np.linalg.norm(apex, axis=-1))
    bulge = _NIGHT + (_DAY - _NIGHT) * (0.5 + 0.5 * facing) ** 2
    return np.asarray(profile + np.log(_MEAN + day_bulge * (bulge - _MEAN)))
