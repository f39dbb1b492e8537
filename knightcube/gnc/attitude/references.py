"""The reference directions of Sun and nadir and the field at the satellite's position, in ICRS.

The Sun's direction is from `knightcube.astro.earth.sun` (0.009" by 2030), as seen from the satellite (9" of
parallax) with aberration by its motion (20.5" and 5"): a series with an error of 42" would be visible in a
sensor of 0.02 deg averaged over minutes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth import geomagnetism
from knightcube.astro.earth.orbit_knowledge import OrbitState
from knightcube.astro.earth.orientation import terrestrial_time
from knightcube.astro.earth.sun import SPEED_OF_LIGHT, SUN_RADIUS, earth_from_sun


@dataclass(frozen=True, slots=True, eq=False)
class References:
    """Unit vectors (3,) of Sun and nadir, and the field (3,) T.

    `nadir_sigma` rad per axis follows from the error of position; `sun_radius` rad is the Sun's angular
    radius.
    """

    sun: FloatArray
    nadir: FloatArray
    field: FloatArray
    nadir_sigma: float
    sun_radius: float


def references(state: OrbitState) -> References:
    """Return the references at `state`. Raises GeomagneticError outside the model's years."""
    sun, distance = sun_from(state.julian_date, state.position, state.velocity)
    radius = float(np.linalg.norm(state.position))
    return References(
        sun,
        state.nadir,
        geomagnetism.field(state.julian_date, state.position),
        state.sigma / radius,
        float(np.arcsin(SUN_RADIUS / distance)),
    )


def sun_from(julian_date: float, position: FloatArray, velocity: FloatArray) -> tuple[FloatArray, float]:
    """Return the Sun's apparent direction (3,), ICRS, and its distance in m.

    Seen from `position` (3,) m that moves with `velocity` (3,) m/s about the Earth, at a Julian date UTC.
    """
    earth, earth_velocity = earth_from_sun(float(terrestrial_time(julian_date)))
    towards = -earth - position
    distance = float(np.linalg.norm(towards))
    moving = earth_velocity + velocity
    seen = towards / distance + moving / SPEED_OF_LIGHT
    return np.asarray(seen / np.linalg.norm(seen)), distance
