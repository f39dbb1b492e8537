"""Disturbance torques on a satellite by air drag, solar radiation pressure, and a constant torque.

The directions of the air flow and of the sunlight follow from the orbit. The magnitudes of all torques are
estimated in flight. The atmosphere rotates with the Earth, and its density in the diurnal bulge is four times
the density at night (Montenbruck & Gill 2000, section 3.5.2: cos^4 of half the angle from an apex 30 deg
behind the Sun). The aerodynamic torque and the solar radiation torque are each the cross product c x d of a
body vector c and a pressure vector d. The body vector c (N m) is constant: the force multiplied by the lever
arm of the centre of pressure. The pressure vector d is the direction of the pressure in body axes, multiplied
by the strength relative to a reference pressure and by the exposed area. The exposed areas are those of a
homogeneous box with the moments of inertia of the body. All other disturbance torques are represented by a
constant torque in body axes.
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
"""Number of torque components (N m): three each of the constant, aerodynamic and solar radiation torque."""
_NIGHT, _DAY = 0.4, 1.6
"""Air density at night (first value) and in the diurnal bulge (second value), relative to the mean."""
_LAG = math.radians(30.0)
"""Angle (rad) by which the diurnal bulge lags behind the Sun."""
_THINNEST = 0.02
"""Minimum squared side length of the box, divided by 12 times the largest moment of inertia per mass."""
_HEIGHT, _SCALE_HEIGHT = EARTH_RADIUS + 500e3, 65e3
"""Geocentric distance (m) of the reference air density (relative density 1), and scale height (m)."""


@dataclass(frozen=True, slots=True, eq=False)
class Pressures:
    """Pressure vectors: directions multiplied by strengths relative to the reference pressures.

    Attributes:
        air: (n, 3) direction of the motion through the air times air density (1 at about 500 km), ICRS axes.
        light: (n, 3) direction to the Sun times visible fraction of the Sun's disc, ICRS axes.
    """

    air: FloatArray
    light: FloatArray

    def until(self, count: int) -> Pressures:
        """Return the pressure vectors at the first `count` times."""
        return Pressures(self.air[:count], self.light[:count])

    def facing(self, areas: FloatArray, to_body: FloatArray) -> Pressures:
        """Return the pressure vectors multiplied by the exposed area of a box with face areas (3,)."""
        found = [
            vector * exposed_area(areas, np.einsum("nij,nj->ni", to_body, vector))
            for vector in (self.air, self.light)
        ]
        return Pressures(*found)


def pressures(ephemeris: Ephemeris, times: FloatArray) -> Pressures:
    """Return the pressure vectors of air and sunlight along an orbit, at times (n,) of the ephemeris, s.

    The strength is relative to the air pressure at about 500 km altitude, or to full sunlight.
    """
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


def mean_density(distance: float) -> float:
    """Return the air density, averaged over day and night, at a geocentric distance (m).

    The density is divided by the density at an altitude of 500 km.
    """
    return math.exp((_HEIGHT - distance) / _SCALE_HEIGHT)


def box_areas(inertia: FloatArray) -> FloatArray:
    """Return the scaled face areas (3,) of a homogeneous box with an inertia tensor (3, 3), kg m^2.

    The principal axes must be close to the body axes. The areas are scaled to a mean projected area of one.
    If no homogeneous box has the given moments of inertia, a flat box is used.
    """
    moments = np.diag(inertia)
    square = np.maximum(0.5 * moments.sum() - moments, _THINNEST * moments.max())  # side^2 mass / 12
    areas = np.sqrt(square.prod() / square)
    return np.asarray(2.0 * areas / areas.sum())


def exposed_area(areas: FloatArray, direction: FloatArray) -> FloatArray:
    """Return the projected areas (n, 1) of a box with face areas (3,) in directions (n, 3) of any length."""
    length = np.linalg.norm(direction, axis=1, keepdims=True)
    return np.asarray((np.abs(direction) @ areas)[:, None] / np.where(length > 0.0, length, 1.0))


def shapes(found: Pressures, to_body: FloatArray) -> FloatArray:
    """Return the derivatives (n, 3, 9) of the torque in body axes with respect to the torque components.

    The pressure vectors `found` are multiplied by the body's exposed area. The attitude matrices `to_body`
    (n, 3, 3) rotate ICRS into body axes.
    """
    torque = np.empty((len(to_body), 3, SIZES))
    torque[:, :, CONSTANT] = np.eye(3)
    # c x d = -[d x] c
    torque[:, :, AIR] = -cross_matrices(np.einsum("nij,nj->ni", to_body, found.air))
    torque[:, :, LIGHT] = -cross_matrices(np.einsum("nij,nj->ni", to_body, found.light))
    return torque
