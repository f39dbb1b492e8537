"""Models of the disturbance torques on a satellite: a constant one, and those by air and by sunlight.

The direction of each torque follows from the orbit; its size is estimated in flight. The drag of the air,
which rotates with the Earth, is four times as strong below the diurnal bulge as at night (Montenbruck & Gill
2000, 3.5.2: cos^4 of half the angle from an apex 30 deg behind the Sun). Sunlight presses away from the Sun.
Each torque is c x d. c is a constant of the body, N m (force times the lever arm of the centre of pressure).
d is the direction in body axes, times the strength and the exposed area. The areas are those of the
homogeneous box that has the body's moments of inertia: a long body meets three times as much air across as
along. A torque that is constant in body axes represents all other torques.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray, cross_matrices
from knightcube.astro.earth.ephemeris import Ephemeris
from knightcube.astro.earth.figure import EARTH_RADIUS
from knightcube.astro.earth.orientation import ROTATION_RATE

CONSTANT, AIR, LIGHT = slice(0, 3), slice(3, 6), slice(6, 9)
SIZES = 9
"""Number of torque sizes (N m): three each of the constant torque, of air and of sunlight."""
_NIGHT, _DAY = 0.4, 1.6
"""Relative density of the air at night and below the diurnal bulge."""
_LAG = math.radians(30.0)
"""Angle (rad) of the diurnal bulge behind the Sun."""
_THINNEST = 0.02
"""Smallest square of a side of the box, relative to the largest moment over a twelfth of the mass."""
_HEIGHT, _SCALE_HEIGHT = EARTH_RADIUS + 500e3, 65e3
"""Distance (m) from the Earth's centre at which the density is one, and scale height (m) there."""


@dataclass(frozen=True, slots=True, eq=False)
class Pressures:
    """Directions times strengths (n, 3), ICRS: of the motion through the air, and to the Sun (`light`)."""

    air: FloatArray
    light: FloatArray

    def until(self, count: int) -> Pressures:
        """Return the pressures at the first `count` instants."""
        return Pressures(self.air[:count], self.light[:count])

    def facing(self, areas: FloatArray, to_body: FloatArray) -> Pressures:
        """Return the pressures times the area that a box of `areas` (3,) exposes, at attitudes (n, 3, 3)."""
        found = [
            vector * exposed_area(areas, np.einsum("nij,nj->ni", to_body, vector))
            for vector in (self.air, self.light)
        ]
        return Pressures(*found)


def pressures(ephemeris: Ephemeris, times: FloatArray) -> Pressures:
    """Return the pressures at times (n,) s: of air about one at 500 km, of light one in full sunlight."""
    position, velocity = ephemeris.position_at(times), ephemeris.velocity_at(times)
    sun = ephemeris.sun_at(times)
    distance = np.linalg.norm(position, axis=1)
    cosine, sine = math.cos(_LAG), math.sin(_LAG)
    x, y, z = sun.T
    apex = np.stack([cosine * x - sine * y, sine * x + cosine * y, z], axis=-1)
    facing = np.sum(position * apex, axis=1) / distance
    density = (_NIGHT + (_DAY - _NIGHT) * (0.5 + 0.5 * facing) ** 2) * np.exp(
        (_HEIGHT - distance) / _SCALE_HEIGHT
    )
    # The air rotates with the Earth.
    relative = velocity - np.cross([0.0, 0.0, ROTATION_RATE], position)
    motion = relative / np.linalg.norm(relative, axis=1, keepdims=True)
    return Pressures(density[:, None] * motion, ephemeris.sunlit_at(times)[:, None] * sun)


def box_areas(inertia: FloatArray) -> FloatArray:
    """Return the areas (3,) of the faces of a homogeneous box, scaled to a mean projected area of one.

    `inertia` (3, 3) kg m^2 has principal axes near the body's. If no homogeneous box has its moments, the
    box is flat.
    """
    moments = np.diag(inertia)
    square = np.maximum(0.5 * moments.sum() - moments, _THINNEST * moments.max())  # sides, by mass / 12
    areas = np.sqrt(square.prod() / square)
    return np.asarray(2.0 * areas / areas.sum())


def exposed_area(areas: FloatArray, direction: FloatArray) -> FloatArray:
    """Return the projected area (n, 1) of a box of `areas` (3,) along directions (n, 3), body axes."""
    length = np.linalg.norm(direction, axis=1, keepdims=True)
    return np.asarray((np.abs(direction) @ areas)[:, None] / np.where(length > 0.0, length, 1.0))


def shapes(found: Pressures, to_body: FloatArray) -> FloatArray:
    """Return the torques (n, 3, 9) for one newton metre of each size; `to_body` (n, 3, 3) is from ICRS."""
    torque = np.empty((len(to_body), 3, SIZES))
    torque[:, :, CONSTANT] = np.eye(3)
    # c x d = -[d x] c
    torque[:, :, AIR] = -cross_matrices(np.einsum("nij,nj->ni", to_body, found.air))
    torque[:, :, LIGHT] = -cross_matrices(np.einsum("nij,nj->ni", to_body, found.light))
    return torque
