"""Where the Sun is, as seen from the Earth's centre: the Astronomical Almanac's low-precision series.

The series gives the longitude from the equinox of date. Read as J2000 it would be 0.37 deg off by 2026, so
the equinox's drift of 1.3972 deg a century is taken off; what remains is 42" by 2030. Good from 1950 to 2050.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from flight.gnc.math.arrays import FloatArray

ASTRONOMICAL_UNIT = 149_597_870_700.0
"""m (IAU 2012)."""
SUN_RADIUS = 695_700_000.0
"""m (IAU 2015)."""
J2000 = 2_451_545.0
"""The Julian date of 2000 January 1.5 TT."""
DAY = 86_400.0
"""s."""

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


def earth_velocity(julian_date: float) -> FloatArray:
    """Return the Earth's velocity about the Sun (3,), ICRS, in m/s, at a Julian date TT.

    The slope of `position` over a day, turned round: to 0.1 % of the speed. What it leaves out, the Sun's own
    motion about the barycentre (13 m/s) and a satellite's about the Earth (7.6 km/s), is the user's to add.
    """
    before, after = position(np.array([julian_date - 0.5, julian_date + 0.5]))
    return np.asarray((before - after) / DAY)
