"""Gravity constants of the Earth and dimensions of the WGS 84 ellipsoid."""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import FloatArray

GRAVITATIONAL_PARAMETER = 3.986004418e14
"""Gravitational parameter of the Earth, m^3/s^2 (EGM2008, in IERS Conventions 2010, Table 1.1)."""
EARTH_RADIUS = 6_378_136.6
"""Equatorial radius of the Earth, m (IERS Conventions 2010, Table 1.1)."""
J2 = 1.0826359e-3
"""Dynamical form factor of the Earth (IERS Conventions 2010, Table 1.1)."""
SEMI_MAJOR_AXIS = 6_378_137.0
"""Semi-major axis of the WGS 84 ellipsoid, m (NGA.STND.0036, Table 3.1)."""
FLATTENING = 1.0 / 298.257223563
"""Flattening of the WGS 84 ellipsoid (NGA.STND.0036, Table 3.1)."""
SEMI_MINOR_AXIS = SEMI_MAJOR_AXIS * (1.0 - FLATTENING)
"""Polar semi-axis of the WGS 84 ellipsoid, m."""


def semi_axes(height: float = 0.0) -> FloatArray:
    """Return the semi-axes (3,), m, of an ellipsoid at a height (m) above WGS 84, the polar semi-axis last.

    The height is added to all semi-axes. At a height of 20 km, this ellipsoid differs from the true surface
    of constant height by centimetres.
    """
    return np.array([SEMI_MAJOR_AXIS, SEMI_MAJOR_AXIS, SEMI_MINOR_AXIS]) + height
