"""Orientation of the Earth: rotations between celestial (ICRS) and terrestrial (ITRS) axes, and time scales.

The precession-nutation model is IAU 2006/2000B, computed by ERFA, with an error of one milliarcsecond. UT1 is
assumed to equal UTC unless the difference is given. The difference between UT1 and UTC is at most 0.9 s, or
13" of Earth rotation. Polar motion (0.3") is neglected. Julian dates are UTC, and TT has been 69.184 s ahead
of UTC since 2017. A Julian date as a double-precision number has a resolution of 40 us, or 0.3 m along a low
orbit.
"""

from __future__ import annotations

import erfa
import numpy as np
import numpy.typing as npt

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.sun import DAY, J2000

TT_MINUS_UTC = 69.184
"""Difference TT - UTC, s: 32.184 s plus 37 leap seconds (IERS Bulletin C 52 and later)."""
ROTATION_RATE = 7.292115e-5
"""Rotation rate of the Earth, rad/s (WGS 84)."""
JULIAN_YEAR = 365.25
"""Length of a Julian year, days."""


def terrestrial_time(julian_date: npt.ArrayLike) -> FloatArray:
    """Return the Julian dates TT (...) for Julian dates UTC (...)."""
    return np.asarray(np.asarray(julian_date, dtype=float) + TT_MINUS_UTC / DAY)


def julian_epoch(julian_date: npt.ArrayLike) -> FloatArray:
    """Return the Julian epochs (...), such as 2026.89, of Julian dates (...)."""
    return np.asarray(2000.0 + (np.asarray(julian_date, dtype=float) - J2000) / JULIAN_YEAR)


def celestial_to_terrestrial(julian_date: npt.ArrayLike, ut1_minus_utc: float = 0.0) -> FloatArray:
    """Return the matrices (..., 3, 3) that rotate vectors from ICRS to ITRS at Julian dates UTC (...)."""
    date = np.asarray(julian_date, dtype=float)
    # ERFA recommends splitting a Julian date into whole days and a fraction.
    whole = np.floor(date)
    day = date - whole
    return np.asarray(
        erfa.c2t00b(whole, day + TT_MINUS_UTC / DAY, whole, day + ut1_minus_utc / DAY, 0.0, 0.0), dtype=float
    )


def mean_equator_to_celestial(julian_date: npt.ArrayLike, ut1_minus_utc: float = 0.0) -> FloatArray:
    """Return the matrices (..., 3, 3) that rotate vectors from TEME, the frame of SGP4, to ICRS.

    The rotation is computed via ITRS, because TEME differs from ITRS only by the IAU 1982 mean sidereal time
    (Vallado, Crawford, Hujsak and Kelso, Revisiting Spacetrack Report #3, AIAA 2006-6753, appendix C).
    """
    date = np.asarray(julian_date, dtype=float)
    whole = np.floor(date)
    sidereal = np.asarray(erfa.gmst82(whole, date - whole + ut1_minus_utc / DAY), dtype=float)
    cosine, sine = np.cos(sidereal), np.sin(sidereal)
    zero, one = np.zeros_like(cosine), np.ones_like(cosine)
    to_itrs = np.stack(
        [
            np.stack([cosine, sine, zero], axis=-1),
            np.stack([-sine, cosine, zero], axis=-1),
            np.stack([zero, zero, one], axis=-1),
        ],
        axis=-2,
    )
    to_ground = celestial_to_terrestrial(date, ut1_minus_utc)
    return np.asarray(np.swapaxes(to_ground, -1, -2) @ to_itrs)


def geodetic(position: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return longitude and geodetic latitude, rad, and height above WGS 84, m, of ITRS positions (..., 3)."""
    longitude, latitude, height = erfa.gc2gd(1, np.asarray(position, dtype=float))
    return np.asarray(longitude), np.asarray(latitude), np.asarray(height)


def north_east_down(longitude: npt.ArrayLike, latitude: npt.ArrayLike) -> FloatArray:
    """Return matrices (..., 3, 3) whose rows are the unit vectors north, east and down in ITRS axes.

    Longitudes and latitudes (...) are in rad. For a geodetic latitude, down is perpendicular to the
    ellipsoid. For a geocentric latitude, down points to the centre of the Earth.
    """
    along, up = np.asarray(longitude, dtype=float), np.asarray(latitude, dtype=float)
    ca, sa, cu, su = np.cos(along), np.sin(along), np.cos(up), np.sin(up)
    rows = [[-su * ca, -su * sa, cu], [-sa, ca, np.zeros_like(ca)], [-cu * ca, -cu * sa, -su]]
    return np.stack([np.stack(np.broadcast_arrays(*row), axis=-1) for row in rows], axis=-2)
