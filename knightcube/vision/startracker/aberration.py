"""Stellar aberration: a moving camera sees stars displaced towards its direction of motion, by up to 20.8".

Special relativity's exact formula (Green, Spherical Astronomy, 1985, 8.3; the same in the Explanatory
Supplement, 7.2.3), as cheap as its first order.
"""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.sun import SPEED_OF_LIGHT


def apparent(direction: FloatArray, velocity: FloatArray) -> FloatArray:
    """Return where stars at `direction` (n, 3), unit vectors, appear to a camera at `velocity` (3,) m/s.

    The velocity is with respect to the solar system's barycentre, in the axes of the directions. Raises
    ValueError unless it is finite and below the speed of light.
    """
    beta = np.asarray(velocity, dtype=float) / SPEED_OF_LIGHT
    square = float(beta @ beta)
    if not square < 1.0:
        raise ValueError(f"velocity = {velocity!r} m/s: give a finite one below the speed of light")
    slowed = np.sqrt(1.0 - square)
    along = (direction @ beta)[:, None]
    shifted = slowed * direction + beta + along / (1.0 + slowed) * beta
    return np.asarray(shifted / (1.0 + along))
