"""An artificial ephemeris of a circular polar orbit with a dipole field and a fixed Sun."""

from __future__ import annotations

import numpy as np

from knightcube.astro.earth.ephemeris import Ephemeris
from knightcube.astro.earth.figure import GRAVITATIONAL_PARAMETER

JULIAN_DATE = 2_461_367.5
RADIUS = 6_878_000.0
RATE = np.sqrt(GRAVITATIONAL_PARAMETER / RADIUS**3)
STRENGTH = 2.6e-5
"""Field (T) of the dipole at its equator at the height of the orbit."""


def circular(duration: float, step: float = 10.0) -> Ephemeris:
    """Return a polar orbit from the equator, with a dipole field along the pole and the Sun on +x."""
    times = np.arange(0.0, duration + step, step)
    angle = RATE * times
    zero = np.zeros_like(angle)
    up = np.stack([np.cos(angle), zero, np.sin(angle)], axis=1)
    ahead = np.stack([-np.sin(angle), zero, np.cos(angle)], axis=1)
    pole = np.array([0.0, 0.0, 1.0])
    field = STRENGTH * (pole - 3.0 * up[:, 2:] * up)
    sun = np.tile([1.496e11, 0.0, 0.0], (len(times), 1))
    return Ephemeris(JULIAN_DATE, times, RADIUS * up, RADIUS * RATE * ahead, field, sun, np.ones(len(times)))
