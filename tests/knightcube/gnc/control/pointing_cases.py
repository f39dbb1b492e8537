"""Satellites, orbits and weights that several tests of the pointing control share."""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.disturbance import pressures, shapes
from knightcube.astro.earth.figure import GRAVITATIONAL_PARAMETER
from knightcube.astro.quaternion import from_rotation_vector, multiply
from knightcube.gnc.control.pointing_table import PointingWeights
from knightcube.gnc.guidance.attitude_law import AttitudeLaw, nadir, velocity
from tests.support.circular_orbits import circular

ORBIT = circular(11_500.0)


INERTIA = np.diag([0.0066, 0.0333, 0.0333])


LIMIT = 0.2


STEP = 10.0


SIZE = np.array([0.0, 0.0, 1e-9, 0.0, -5e-10, 5e-10, 0.0, 0.0, 0.0])


RESIDUAL = np.array([5e-4, -3e-4, 2e-4])


X, Y, Z = np.eye(3)


LAW = AttitudeLaw(Z, nadir, X, velocity).attitudes


WEIGHTS = PointingWeights(turn=0.02, rate=1.0, dipole=0.001)


def pushed(
    q: FloatArray, w: FloatArray, turned: FloatArray, at: FloatArray, dipole: FloatArray, seconds: float
) -> tuple[FloatArray, FloatArray]:
    """Return attitude and rate of a body after `seconds` s of a dipole and all disturbance torques."""
    position = turned @ ORBIT.position_at(at)[0]
    radius = float(np.linalg.norm(position))
    torque = 3.0 * GRAVITATIONAL_PARAMETER / radius**5 * np.cross(position, INERTIA @ position)
    torque += np.cross(dipole, turned @ ORBIT.field_at(at)[0])
    torque += shapes(pressures(ORBIT, at), turned[None])[0] @ SIZE
    w = w + seconds * np.linalg.inv(INERTIA) @ (torque - np.cross(w, INERTIA @ w))
    return multiply(from_rotation_vector(seconds * w), q), w
