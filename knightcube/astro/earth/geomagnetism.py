"""The geomagnetic field in orbit: the World Magnetic Model of 2025.

NOAA NCEI and British Geological Survey, The US/UK World Magnetic Model for 2025-2030 (2025), degree 12,
through pygeomag. It models the field of the core, without crust, ionosphere and ring current. Its stated
error on the ground is 89 to 141 nT per component. It is valid until 2030.
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


class GeomagneticError(FlightError):
    """Raised for a time or a position outside the model."""


def field_on_ground_axes(year: float, latitude: float, longitude: float, height: float) -> FloatArray:
    """Return the field (3,) T, north, east and down, at geodetic coordinates (rad, m over WGS 84).

    Raises GeomagneticError outside 2025.0..2030.0, for values that are not finite and for invalid latitudes.
    """
    if not FIRST_YEAR <= year <= LAST_YEAR:
        raise GeomagneticError(f"year {year:.2f}: WMM2025 is valid from {FIRST_YEAR:.0f} to {LAST_YEAR:.0f}")
    if not (abs(latitude) <= 0.5 * math.pi and math.isfinite(longitude) and math.isfinite(height)):
        raise GeomagneticError(
            f"invalid position: latitude {latitude}, longitude {longitude} rad, height {height} m"
        )
    # pygeomag takes longitudes in (-180, 180] deg and heights in km.
    east = math.degrees(math.remainder(longitude, 2.0 * math.pi))
    found = _model().calculate(math.degrees(latitude), east, 1e-3 * height, year)
    return NANOTESLA * np.array([found.x, found.y, found.z])


def field(julian_date: float, position: FloatArray) -> FloatArray:
    """Return the field (3,) T, ICRS axes, at a Julian date UTC and a position (3,) m, ICRS.

    Takes 0.2 ms. Raises GeomagneticError outside the model's years.
    """
    to_ground = celestial_to_terrestrial(julian_date)
    longitude, latitude, height = (float(part) for part in geodetic(to_ground @ position))
    north_east_down_field = field_on_ground_axes(
        float(julian_epoch(julian_date)), latitude, longitude, height
    )
    return np.asarray(north_east_down_field @ north_east_down(longitude, latitude) @ to_ground)


@cache
def _model() -> GeoMag:
    # The file is named, because pygeomag's default depends on its release.
    return GeoMag(coefficients_file="wmm/WMM_2025.COF")
