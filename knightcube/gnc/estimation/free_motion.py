"""The motion of a free satellite: Euler's equation with coils and the torques of an orbit, and its flow.

The principal axes may be turned a little from those believed: at a fast spin of a long body the gyroscopic
torque of that turn is the largest that is not known. The other torques have the shapes of
`knightcube.astro.earth.disturbance`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.disturbance import SIZES, Pressures, box_areas, shapes
from knightcube.astro.earth.figure import GRAVITATIONAL_PARAMETER
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector

TURN, RATE, GYRO, DIPOLE, SUNLIT, MAGNET = (slice(3 * k, 3 * k + 3) for k in range(6))
TORQUES = slice(18, 18 + SIZES)
AXES = slice(18 + SIZES, 21 + SIZES)
SLOW = slice(GYRO.start, AXES.stop)
FIELD = slice(21 + SIZES, 24 + SIZES)
STATES = 24 + SIZES
"""Where the parts of the error stand in the covariance of `free_filter`; SLOW are those that are learned."""


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
    """The equations of one inertia, whose principal axes may be turned."""

    def __init__(self, inertia: FloatArray) -> None:
        """`inertia` (3, 3) kg m^2, body axes."""
        self._believed: FloatArray = np.asarray(inertia, dtype=float)
        moments = np.linalg.eigvalsh(self._believed)
        self.largest_difference = float(moments[-1] - moments[0])
        """kg m^2, of the principal moments: what a turn of their axes acts by."""
        self._areas = box_areas(self._believed)
        self._turn: FloatArray = np.zeros(3)
        self._take(self._believed)

    def turn_axes(self, turn: FloatArray) -> None:
        """Turn the principal axes from those believed by a rotation vector (3,) rad, body axes."""
        if np.array_equal(turn, self._turn):
            return
        self._turn = turn.copy()
        back = attitude_matrix(from_rotation_vector(turn))
        self._take(np.asarray(back.T @ self._believed @ back, dtype=float))

    def _take(self, inertia: FloatArray) -> None:
        self.inertia: FloatArray = inertia
        self.inverse: FloatArray = np.asarray(np.linalg.inv(inertia), dtype=float)
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
        """Return the torque (3,) N m, and the flow (6, 33) with what all but rate and axes do to the rate.

        The `dipole` (3,) A m^2 is the coils' and the residual one, `sizes` (9,) N m are of the other torques.
        """
        turned = attitude_matrix(quaternion)
        field, position = turned @ around.field, turned @ around.position
        radius = math.sqrt(float(position @ position))
        up = position / radius
        stiff = self.inertia @ up
        strength = 3.0 * GRAVITATIONAL_PARAMETER / radius**3
        shape = shapes(around.pressures.facing(self._areas, turned[None]), turned[None])[0]
        across, upright = crossed(field), crossed(up)
        torque = -across @ dipole + strength * upright @ stiff + shape @ sizes
        flow = np.zeros((6, STATES))
        stiffness = strength * (upright @ self.inertia - crossed(stiff)) @ upright
        flow[3:6, TURN] = self.inverse @ (crossed(dipole) @ across + stiffness)
        flow[3:6, DIPOLE] = -self.inverse @ across
        flow[3:6, SUNLIT] = around.sunlit * flow[3:6, DIPOLE]
        flow[3:6, TORQUES] = self.inverse @ shape
        flow[3:6, AXES] = strength * self.inverse @ upright @ self._turned(up)
        return torque, flow

    def by_axes(self, rate: FloatArray, acceleration: FloatArray) -> FloatArray:
        """Return the derivative (3, 3) of the acceleration (3,) by a turn of the axes, gravity left out."""
        return np.asarray(-self.inverse @ (crossed(rate) @ self._turned(rate) + self._turned(acceleration)))

    def _turned(self, vector: FloatArray) -> FloatArray:
        """Return the derivative (3, 3) of J v by a small turn d of J: d x J v - J (d x v)."""
        return np.asarray(self.inertia @ crossed(vector) - crossed(self.inertia @ vector))


def crossed(vector: FloatArray) -> FloatArray:
    """Return [v x] (3, 3)."""
    x, y, z = vector.tolist()
    return np.array(((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0)))
