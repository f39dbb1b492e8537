"""The motion of a free satellite: Euler's equation with coils and the torques of an orbit, and its flow.

The gravity gradient is of the believed inertia; the other torques have the shapes of
`flight.gnc.earth.disturbance`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from flight.gnc.earth.disturbance import SIZES, Pressures, shapes
from flight.gnc.earth.figure import GRAVITATIONAL_PARAMETER
from flight.gnc.math.arrays import FloatArray
from flight.gnc.math.quaternion import attitude_matrix

TURN, RATE, GYRO, DIPOLE, SUNLIT, MAGNET = (slice(3 * k, 3 * k + 3) for k in range(6))
TORQUES = slice(18, 18 + SIZES)
STATES = 18 + SIZES
"""Where the parts of the error stand in the covariance of `free_filter`."""


@dataclass(frozen=True, slots=True, eq=False)
class Around:
    """What surrounds the satellite, ICRS.

    `field` (3,) T, `position` (3,) m, the `pressures` of one time, and the share `sunlit` of the Sun's disc.
    """

    field: FloatArray
    position: FloatArray
    pressures: Pressures
    sunlit: float


class FreeMotion:
    """The equations of one inertia."""

    def __init__(self, inertia: FloatArray) -> None:
        """`inertia` (3, 3) kg m^2, body axes."""
        self.inertia = np.asarray(inertia, dtype=float)
        self.inverse: FloatArray = np.linalg.inv(self.inertia)
        self.by_torque: FloatArray = self.inverse @ self.inverse
        """(3, 3), the covariance of the acceleration by a variance of the torque."""

    def acceleration(self, rate: FloatArray, torque: FloatArray) -> FloatArray:
        """Return the angular acceleration (3,) rad/s^2 at a rate (3,) rad/s under a torque (3,) N m."""
        return np.asarray(self.inverse @ (torque - crossed(rate) @ (self.inertia @ rate)))

    def stiffness(self, rate: FloatArray) -> FloatArray:
        """Return the derivative (3, 3) of the acceleration by the rate (3,) rad/s."""
        return np.asarray(self.inverse @ (crossed(self.inertia @ rate) - crossed(rate) @ self.inertia))

    def torque(
        self, quaternion: FloatArray, dipole: FloatArray, sizes: FloatArray, around: Around
    ) -> tuple[FloatArray, FloatArray]:
        """Return the torque (3,) N m, and the flow (6, 27) with what all but the rate do to the rate.

        The `dipole` (3,) A m^2 is the coils' and the residual one, `sizes` (9,) N m are of the other torques.
        """
        turned = attitude_matrix(quaternion)
        field, position = turned @ around.field, turned @ around.position
        radius = math.sqrt(float(position @ position))
        up = position / radius
        stiff = self.inertia @ up
        strength = 3.0 * GRAVITATIONAL_PARAMETER / radius**3
        shape = shapes(around.pressures, turned[None])[0]
        across, upright = crossed(field), crossed(up)
        torque = -across @ dipole + strength * upright @ stiff + shape @ sizes
        flow = np.zeros((6, STATES))
        stiffness = strength * (upright @ self.inertia - crossed(stiff)) @ upright
        flow[3:6, TURN] = self.inverse @ (crossed(dipole) @ across + stiffness)
        flow[3:6, DIPOLE] = -self.inverse @ across
        flow[3:6, SUNLIT] = around.sunlit * flow[3:6, DIPOLE]
        flow[3:6, TORQUES] = self.inverse @ shape
        return torque, flow


def crossed(vector: FloatArray) -> FloatArray:
    """Return [v x] (3, 3)."""
    x, y, z = vector.tolist()
    return np.array(((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0)))
