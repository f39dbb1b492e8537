"""The simulator's Sun: the Astronomical Almanac's low-precision series.

Flight computes the Sun by ERFA's epv00. The simulator keeps its own series: sharing one would test flight
against itself. The simulator also asks for hundreds of dates at once, which cost 1.5 us each here and 230 us
by epv00. An error of 42" moves the entry into the Earth's shadow by 0.2 s.

The series gives the longitude from the equinox of date. Read as J2000 it would be 0.37 deg off by 2026, so
the equinox's drift of 1.3972 deg a century is subtracted; what remains is 42" by 2030. Valid from 1950
to 2050.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.sun import ASTRONOMICAL_UNIT, J2000

_PRECESSION = 1.3972 / 36_525.0
"""deg a day, of the equinox along the ecliptic."""


def position(julian_date: npt.ArrayLike) -> FloatArray:
    """Return the Sun's apparent geocentric position (..., 3), ICRS, in m, at Julian dates (...) TT.

    Astronomical Almanac, "Low-precision formulas for the Sun" (0.01 deg, 1950 to 2050); the longitude made
    J2000's by the drift of the equinox. The obliquity is J2000's; UTC instead of TT moves it by 3".
    """
    days = np.asarray(julian_date, dtype=float) - J2000
    anomaly = np.radians(357.528 + 0.9856003 * days)
    mean_longitude = 280.460 + (0.9856474 - _PRECESSION) * days
    longitude = np.radians(mean_longitude + 1.915 * np.sin(anomaly) + 0.020 * np.sin(2.0 * anomaly))
    distance = 1.00014 - 0.01671 * np.cos(anomaly) - 0.00014 * np.cos(2.0 * anomaly)
    obliquity = np.radians(23.439)
    across = np.sin(longitude)
    unit = np.stack([np.cos(longitude), np.cos(obliquity) * across, np.sin(obliquity) * across], axis=-1)
    return np.asarray(ASTRONOMICAL_UNIT * distance[..., None] * unit)
