"""Geomagnetic field by the World Magnetic Model 2025 (WMM2025).

The model of degree 12 (NOAA NCEI and British Geological Survey, The US/UK World Magnetic Model for 2025-2030,
2025) is evaluated by pygeomag. WMM2025 describes the field of the Earth's core, without crust, ionosphere and
ring current. The publishers state a model error of 89 to 141 nT per component on the ground. The model is
valid from 2025 to 2030. Outside the years of validity, the field is extrapolated with the constant secular
variation of the model. The function `extrapolation_sigma` returns the additional standard deviation.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from pygeomag import GeoMag
from pygeomag.geomag import GeoMagResult

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.orientation import (
    celestial_to_terrestrial,
    geodetic,
    julian_epoch,
    north_east_down,
)
from knightcube.errors import KnightCubeError

FIRST_YEAR, LAST_YEAR = 2025.0, 2030.0
DEGREE = 12
_NEAR_POLE = 0.5 * math.pi - 1e-6
"""Latitude (rad) above which positions are evaluated one by one, because pygeomag treats poles separately."""
NANOTESLA = 1e-9
EXTRAPOLATION = 2.5e-8
"""Standard deviation of the extrapolated field, T per component and per year outside the model's validity.

When the IGRF-14 fields of 2005, 2010 and 2015 were extrapolated by the variation of the previous five years,
the RMS error at an altitude of 500 km was up to 170 nT ten years after the end of validity.
"""
LONGEST_EXTRAPOLATION = 20.0
"""Time (years) after which the extrapolated field no longer changes."""


class GeomagneticError(KnightCubeError):
    """Error raised for a time or position outside the validity of the magnetic field model.

    The message states the time or the position, and the valid range.
    """


def check_year(year: float) -> None:
    """Raise GeomagneticError for a decimal year outside the validity of the model."""
    if not FIRST_YEAR <= year <= LAST_YEAR:
        # With two digits, a date just outside the range would be rounded to a year within the range.
        digits = 4 if FIRST_YEAR <= round(year, 2) <= LAST_YEAR else 2
        raise GeomagneticError(
            f"year {year:.{digits}f}: WMM2025 is valid from {FIRST_YEAR:.0f} to "
            f"{LAST_YEAR:.0f}, and the magnetic field is known only in these years"
        )


def extrapolation_sigma(julian_date: float) -> float:
    """Return the standard deviation of the field due to extrapolation, T per component."""
    year = float(julian_epoch(julian_date))
    return EXTRAPOLATION * max(FIRST_YEAR - year, year - LAST_YEAR, 0.0)


def field_on_ground_axes(year: float, latitude: float, longitude: float, height: float) -> FloatArray:
    """Return the north, east and down components (3,) of the geomagnetic field, T, at geodetic coordinates.

    Angles are in rad, and the height above the WGS 84 ellipsoid is in m. The field is extrapolated outside
    the decimal years 2025.0 to 2030.0. Raises GeomagneticError for an invalid position.
    """
    if not (abs(latitude) <= 0.5 * math.pi and math.isfinite(longitude) and math.isfinite(height)):
        raise GeomagneticError(
            f"invalid position: latitude {latitude:g}, longitude {longitude:g} rad, height {height:g} m: "
            "give finite values and a latitude of at most pi/2 rad"
        )
    # pygeomag expects longitudes from -180 to 180 deg and heights in km.
    east = math.degrees(math.remainder(longitude, 2.0 * math.pi))
    year = min(max(year, FIRST_YEAR - LONGEST_EXTRAPOLATION), LAST_YEAR + LONGEST_EXTRAPOLATION)
    found = _model().calculate(
        math.degrees(latitude), east, 1e-3 * height, year, allow_date_outside_lifespan=True
    )
    return NANOTESLA * np.array([found.x, found.y, found.z])


def field(julian_date: float, position: FloatArray) -> FloatArray:
    """Return the geomagnetic field (3,) in ICRS axes, T, at a Julian date UTC and a position (3,), ICRS, m.

    A call takes 0.2 ms. The field is extrapolated outside the years of the model.
    """
    to_ground = celestial_to_terrestrial(julian_date)
    longitude, latitude, height = (float(part) for part in geodetic(to_ground @ position))
    north_east_down_field = field_on_ground_axes(
        float(julian_epoch(julian_date)), latitude, longitude, height
    )
    return np.asarray(north_east_down_field @ north_east_down(longitude, latitude) @ to_ground)


def fields(julian_dates: FloatArray, positions: FloatArray) -> FloatArray:
    """Return the fields (n, 3) at n Julian dates UTC and positions (n, 3), equal to the results of `field`.

    The expansion is evaluated for all positions together, which takes 0.03 ms per position for a hundred
    positions.
    """
    to_ground = celestial_to_terrestrial(julian_dates)
    there = np.array([turn @ position for turn, position in zip(to_ground, positions, strict=True)])
    longitude, latitude, height = geodetic(there)
    if not np.abs(latitude).max() < _NEAR_POLE:  # true for NaN, too: `field` then raises an error
        return np.array([field(float(date), at) for date, at in zip(julian_dates, positions, strict=True)])
    parts = zip(
        _expansion(julian_epoch(julian_dates), latitude, longitude, height),
        north_east_down(longitude, latitude),
        to_ground,
        strict=True,
    )
    return np.array([NANOTESLA * np.array(found) @ axes @ turn for found, axes, turn in parts])


def _expansion(
    years: FloatArray, latitude: FloatArray, longitude: FloatArray, height: FloatArray
) -> list[tuple[float, float, float]]:
    """Return the north, east and down components, nT, with the same operations as `GeoMag.calculate`."""
    model = _model()
    assert model.model  # The model is not empty, because its coefficients have been read.
    lowest, highest = FIRST_YEAR - LONGEST_EXTRAPOLATION, LAST_YEAR + LONGEST_EXTRAPOLATION
    since = np.minimum(np.maximum(years, lowest), highest) - model._epoch
    at = [math.radians(math.degrees(angle)) for angle in latitude.tolist()]
    turns = [math.remainder(angle, 2.0 * math.pi) for angle in longitude.tolist()]
    east = [math.radians(math.degrees(angle)) for angle in turns]
    sine, cosine = np.array([math.sin(angle) for angle in at]), np.array([math.cos(angle) for angle in at])
    up = 1e-3 * height
    a2, b2 = 6378.137 * 6378.137, 6356.7523142 * 6356.7523142
    c2, a4, c4 = a2 - b2, a2 * a2, a2 * a2 - b2 * b2
    squares = sine * sine, cosine * cosine
    q = np.sqrt(a2 - c2 * squares[0])
    q1 = up * q
    q2 = ((q1 + a2) / (q1 + b2)) * ((q1 + a2) / (q1 + b2))
    ct = sine / np.sqrt(q2 * squares[1] + squares[0])
    st = np.sqrt(1.0 - ct * ct)
    r = np.sqrt(up * up + 2.0 * q1 + (a4 - c4 * squares[0]) / (q * q))
    ca = (up + np.sqrt(a2 * squares[1] + b2 * squares[0])) / r
    sa = c2 * cosine * sine / (r * np.sqrt(a2 * squares[1] + b2 * squares[0]))
    br, bt, bp = _sums(model, since, st, ct, 6371.2 / r, east)
    along = -bt * ca - br * sa, bp / st, bt * sa - br * ca
    return [_rounded(*(float(part) for part in found)) for found in zip(*along, strict=True)]


def _sums(
    model: GeoMag, since: FloatArray, st: FloatArray, ct: FloatArray, ratio: FloatArray, east: list[float]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the spherical harmonic sums (n,) of the radial, meridional and azimuthal field components.

    The argument `since` contains the years after the epoch of the model, `st` and `ct` the sine and cosine of
    the colatitude, `ratio` the reference radius divided by the distance, and `east` the longitudes, rad.
    """
    sines = [np.zeros(len(east)), np.array([math.sin(angle) for angle in east])]
    cosines = [np.ones(len(east)), np.array([math.cos(angle) for angle in east])]
    for m in range(2, DEGREE + 1):
        sines.append(sines[1] * cosines[m - 1] + cosines[1] * sines[m - 1])
        cosines.append(cosines[1] * cosines[m - 1] - sines[1] * sines[m - 1])
    nothing = np.zeros(len(east))
    legendre, slope = {(0, 0): np.ones(len(east))}, {(0, 0): nothing}
    power, br, bt, bp = ratio * ratio, nothing, nothing, nothing
    for n in range(1, DEGREE + 1):
        power = power * ratio
        for m in range(n + 1):
            if n == m:
                before = legendre[m - 1, n - 1]
                value, tilt = st * before, st * slope[m - 1, n - 1] + ct * before
            else:
                before, k = legendre[m, n - 1], model._k[m][n]
                value = ct * before - k * legendre.get((m, n - 2), nothing)
                tilt = ct * slope[m, n - 1] - st * before - k * slope.get((m, n - 2), nothing)
            legendre[m, n], slope[m, n] = value, tilt
            g = model._c[m][n] + since * model._cd[m][n]
            h = model._c[n][m - 1] + since * model._cd[n][m - 1] if m else nothing
            outward = g * cosines[m] + h * sines[m]
            across = g * sines[m] - h * cosines[m]
            bt = bt - power * outward * tilt
            bp = bp + float(m) * across * (power * value)
            br = br + float(n + 1) * outward * (power * value)
    return br, bt, bp


def _rounded(north: float, east: float, down: float) -> tuple[float, float, float]:
    """Return the components, nT, computed from intensity, declination and inclination as in pygeomag."""
    level = math.sqrt(north * north + east * east)
    result = GeoMagResult(0.0, 0.0, 0.0, 0.0)
    result.f = math.sqrt(level * level + down * down)
    result.d = math.degrees(math.atan2(east, north))
    result.i = math.degrees(math.atan2(down, level))
    result.calculate(raise_in_warning_zone=False)
    return result.x, result.y, result.z


@cache
def _model() -> GeoMag:
    # The coefficient file is stated explicitly, because the default of pygeomag depends on its version.
    return GeoMag(coefficients_file="wmm/WMM_2025.COF")
