"""The Earth's gravity constants and its figure as an ellipsoid of revolution."""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import FloatArray

GRAVITATIONAL_PARAMETER = 3.986004418e14
"""m^3/s^2, of the Earth (EGM2008; IERS Conventions 2010, Table 1.1)."""
EARTH_RADIUS = 6_378_136.6
"""m, equatorial (IERS Conventions 2010, Table 1.1)."""
J2 = 1.0826359e-3
"""The Earth's dynamical form factor (IERS Conventions 2010, Table 1.1)."""
SEMI_MAJOR_AXIS = 6_378_137.0
"""m, of the WGS 84 ellipsoid (NGA.STND.0036, Table 3.1)."""
FLATTENING = 1.0 / 298.257223563
"""Of the WGS 84 ellipsoid (NGA.STND.0036, Table 3.1)."""
SEMI_MINOR_AXIS = SEMI_MAJOR_AXIS * (1.0 - FLATTENING)
"""m, of the WGS 84 ellipsoid, along the pole."""


def semi_axes(height: float = 0.0) -> FloatArray:
    """Return the semi-axes (3,) m, pole last, of the ellipsoid `height` m above the WGS 84 one.

    Both axes are longer by the height; at 20 km this differs from the true surface of that height by
    centimetres.
    """
    return np.array([SEMI_MAJOR_AXIS, SEMI_MAJOR_AXIS, SEMI_MINOR_AXIS]) + height
