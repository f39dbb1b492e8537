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

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.orientation import (
    celestial_to_terrestrial,
    geodetic,
    julian_epoch,
    north_east_down,
)
from knightcube.errors import FlightError

FIRST_YEAR, LAST_YEAR = 2025.0, 2030.0
NANOTESLA = 1e-9
EXTRAPOLATION = 2.5e-8
"""Standard deviation of the extrapolated field, T per component and per year outside the model's validity.

Extrapolations of IGRF-14 from 2005, 2010 and 2015 by the variation of the previous five years had errors of
up to 170 nT rms ten years after their validity, at an altitude of 500 km.
"""
LONGEST_EXTRAPOLATION = 20.0
"""Time (years) after which the extrapolated field no longer changes."""


class GeomagneticError(FlightError):
    """Raised for a time or position outside the validity of the field model."""


def check_year(year: float) -> None:
    """Raise GeomagneticError for a decimal year outside the validity of the model."""
    if not FIRST_YEAR <= year <= LAST_YEAR:
        raise GeomagneticError(f"year {year:.2f}: WMM2025 is valid from {FIRST_YEAR:.0f} to {LAST_YEAR:.0f}")


def extrapolation_sigma(julian_date: float) -> float:
    """Return the standard deviation of the field due to extrapolation, T per component."""
    year = float(julian_epoch(julian_date))
    return EXTRAPOLATION * max(FIRST_YEAR - year, year - LAST_YEAR, 0.0)


def field_on_ground_axes(year: float, latitude: float, longitude: float, height: float) -> FloatArray:
    """Return the north, east and down components (3,) of the geomagnetic field, T, at geodetic coordinates.

    The field is extrapolated outside the years 2025.0 to 2030.0. Raises GeomagneticError for an invalid
    position.

    Args:
        year: decimal year.
        latitude: geodetic latitude, rad.
        longitude: longitude, rad.
        height: height above the WGS 84 ellipsoid, m.
    """
    if not (abs(latitude) <= 0.5 * math.pi and math.isfinite(longitude) and math.isfinite(height)):
        raise GeomagneticError(
            f"invalid position: latitude {latitude}, longitude {longitude} rad, height {height} m"
        )
    # pygeomag expects longitudes from -180 to 180 deg and heights in km.
    east = math.degrees(math.remainder(longitude, 2.0 * math.pi))
    year = min(max(year, FIRST_YEAR - LONGEST_EXTRAPOLATION), LAST_YEAR + LONGEST_EXTRAPOLATION)
    found = _model().calculate(
        math.degrees(latitude), east, 1e-3 * height, year, allow_date_outside_lifespan=True
    )
    return NANOTESLA * np.array([found.x, found.y, found.z])


def field(julian_date: float, position: FloatArray) -> FloatArray:
    """Return the geomagnetic field (3,) in ICRS axes, T, at a time and a geocentric position.

    A call takes 0.2 ms. The field is extrapolated outside the years of the model.

    Args:
        julian_date: Julian date UTC.
        position: (3,) geocentric position in ICRS axes, m.
    """
    to_ground = celestial_to_terrestrial(julian_date)
    longitude, latitude, height = (float(part) for part in geodetic(to_ground @ position))
    north_east_down_field = field_on_ground_axes(
        float(julian_epoch(julian_date)), latitude, longitude, height
    )
    return np.asarray(north_east_down_field @ north_east_down(longitude, latitude) @ to_ground)


@cache
def _model() -> GeoMag:
    # The coefficient file is stated explicitly, because the default of pygeomag depends on its version.
    return GeoMag(coefficients_file="wmm/WMM_2025.COF")
