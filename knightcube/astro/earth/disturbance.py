"""Shapes of the torques that turn a satellite besides its coils: constant, of the air, of sunlight.

The sizes are unknown and estimated; the shapes follow from the orbit. Air, which turns with the Earth,
presses against the flight through it, four times as hard below the day's bulge as by night (Montenbruck &
Gill 2000, 3.5.2: cos^4 of half the angle from an apex 30 deg behind the Sun); light presses away from the
Sun. Each torque is c x d: c a constant of the body, N m (force by arm of the centre of pressure), d the
direction in body axes by the strength and by the area that is shown to it. The areas are those of the box
that has the body's moments of inertia when its mass is even: a long body meets three times as much air across
as along. What is constant in body axes stands for the rest.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.directions import cross_matrices
from knightcube.astro.earth.ephemeris import Ephemeris
from knightcube.astro.earth.figure import EARTH_RADIUS
from knightcube.astro.earth.orientation import ROTATION_RATE

CONSTANT, AIR, LIGHT = slice(0, 3), slice(3, 6), slice(6, 9)
SIZES = 9
"""N m each: of the constant torque, of the air's and of sunlight's."""
_NIGHT, _DAY = 0.4, 1.6
_LAG = math.radians(30.0)
_THINNEST = 0.02
"""Least square of a box's side, of the largest moment by a twelfth of the mass."""
_HEIGHT, _SCALE_HEIGHT = EARTH_RADIUS + 500e3, 65e3
"""m from the Earth's centre, and m there."""


@dataclass(frozen=True, slots=True, eq=False)
class Pressures:
    """Directions by strength, ICRS: of the flight through the air `air` (n, 3), to the Sun `light` (n, 3)."""

    air: FloatArray
    light: FloatArray

    def until(self, count: int) -> Pressures:
        """Return those of the first `count` instants."""
        return Pressures(self.air[:count], self.light[:count])

    def facing(self, areas: FloatArray, to_body: FloatArray) -> Pressures:
        """Return those on a box of `areas` (3,) at attitudes (n, 3, 3), ICRS into body: by the area shown."""
        found = [
            vector * shown_share(areas, np.einsum("nij,nj->ni", to_body, vector))
            for vector in (self.air, self.light)
        ]
        return Pressures(*found)


def pressures(ephemeris: Ephemeris, times: FloatArray) -> Pressures:
    """Return the shapes at times (n,) s: the air's about one at 500 km, light's one in full sunlight."""
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
    # The air turns with the Earth.
    through = velocity - np.cross([0.0, 0.0, ROTATION_RATE], position)
    flight = through / np.linalg.norm(through, axis=1, keepdims=True)
    return Pressures(density[:, None] * flight, ephemeris.sunlit_at(times)[:, None] * sun)


def box_areas(inertia: FloatArray) -> FloatArray:
    """Return the areas (3,) of an even box's sides, of one in the mean over all directions of view.

    `inertia` (3, 3) kg m^2, its principal axes near the body's. A body that no even box has the moments of is
    taken as a flat one.
    """
    moments = np.diag(inertia)
    square = np.maximum(0.5 * moments.sum() - moments, _THINNEST * moments.max())  # sides, by mass / 12
    areas = np.sqrt(square.prod() / square)
    return np.asarray(2.0 * areas / areas.sum())


def shown_share(areas: FloatArray, direction: FloatArray) -> FloatArray:
    """Return the area (n, 1) that a box of sides (3,) shows to directions (n, 3) of any length, body axes."""
    length = np.linalg.norm(direction, axis=1, keepdims=True)
    return np.asarray((np.abs(direction) @ areas)[:, None] / np.where(length > 0.0, length, 1.0))


def shapes(found: Pressures, to_body: FloatArray) -> FloatArray:
    """Return the torques (n, 3, 9) of one newton metre of each size; `to_body` (n, 3, 3) from ICRS."""
    torque = np.empty((len(to_body), 3, SIZES))
    torque[:, :, CONSTANT] = np.eye(3)
    # c x d = -[d x] c
    torque[:, :, AIR] = -cross_matrices(np.einsum("nij,nj->ni", to_body, found.air))
    torque[:, :, LIGHT] = -cross_matrices(np.einsum("nij,nj->ni", to_body, found.light))
    return torque
