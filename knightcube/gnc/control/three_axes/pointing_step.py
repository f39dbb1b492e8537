"""A step of a course at all its instants at once: where it leads, and the exact derivative of that.

A step is one of the midpoint rule. The derivative is that of the step itself, not of the motion that the step
stands for: a body that turns by degrees in a step would otherwise be led to motions that no step betters.
"""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.directions import cross_matrices
from knightcube.astro.quaternion import (
    attitude_matrix,
    conjugate,
    from_rotation_vector,
    multiply,
    to_rotation_vector,
)
from knightcube.gnc.control.three_axes.pointing_path import Expected, Motion
from knightcube.gnc.control.three_axes.pointing_sweep import Linear, acceleration_slopes

_TURN, _RATE, _DIPOLE, _TORQUE = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
_EYE: FloatArray = np.eye(3)


def carried(expected: Expected, motion: Motion) -> tuple[FloatArray, FloatArray]:
    """Return the attitudes (n, 4) and rates (n, 3) rad/s to which the steps lead."""
    step, count = expected.step, len(motion.control)
    half, middle = _halfway(expected, motion)
    there = multiply(from_rotation_vector(step * middle), motion.quaternion[:count])
    return there, motion.rate[:count] + step * expected.accelerations(half, middle, motion.control)


def missed(expected: Expected, motion: Motion) -> FloatArray:
    """Return by how much (n, 6) each instant's turn and rate are carried past those of the next instant."""
    there, speed = carried(expected, motion)
    turn = to_rotation_vector(multiply(there, conjugate(motion.quaternion[1:])))
    return np.concatenate([turn, speed - motion.rate[1:]], axis=1)


def derivative(expected: Expected, motion: Motion) -> Linear:
    """Return how the state after each step changes with that before it, dipole and torque."""
    step, count = expected.step, len(motion.control)
    q, w, dipole = motion.quaternion[:count], motion.rate[:count], motion.control
    half, middle = _halfway(expected, motion)
    inverse, around = expected.inverse, (expected.inertia, expected.field[:count], expected.position[:count])
    pressed = expected.pressed(count)
    first, shown, _ = acceleration_slopes(q, w, *around, dipole, pressed)
    second, seen, _ = acceleration_slopes(half, middle, *around, dipole, pressed)

    begun = np.concatenate([first, _pushes(inverse, shown)], axis=2)
    rate = 0.5 * step * begun
    rate[:, :, _RATE] += _EYE
    turn = np.zeros((count, 3, 12))
    turn[:, :, _TURN] = attitude_matrix(from_rotation_vector(0.5 * step * w))
    turn[:, :, _RATE] = 0.5 * step * _turned(0.5 * step * w)
    change = np.empty((count, 6, 12))
    change[:, 3:] = step * (second[:, :, :3] @ turn + second[:, :, 3:] @ rate)
    change[:, 3:, 6:] += step * _pushes(inverse, seen)
    change[:, 3:, _RATE] += _EYE
    change[:, :3] = step * _turned(step * middle) @ rate
    change[:, :3, _TURN] += attitude_matrix(from_rotation_vector(step * middle))
    return Linear(change[:, :, :6], change[:, :, _DIPOLE], change[:, :, _TORQUE], np.zeros((count, 3)), shown)


def _halfway(expected: Expected, motion: Motion) -> tuple[FloatArray, FloatArray]:
    """Return attitudes (n, 4) and rates (n, 3) in the middle of the steps."""
    step, count = expected.step, len(motion.control)
    q, w = motion.quaternion[:count], motion.rate[:count]
    middle = w + 0.5 * step * expected.accelerations(q, w, motion.control)
    return multiply(from_rotation_vector(0.5 * step * w), q), middle


def _pushes(inverse: FloatArray, shown: FloatArray) -> FloatArray:
    """Return how accelerations change with dipole and torque (n, 3, 6) in a field (n, 3) of body axes."""
    return np.concatenate(
        [-inverse @ cross_matrices(shown), np.broadcast_to(inverse, (len(shown), 3, 3))], axis=2
    )


def _turned(vector: FloatArray) -> FloatArray:
    """Return how the turn by a rotation vector (n, 3) changes with the vector (n, 3, 3).

    The left Jacobian of the rotation group, with the signs of this house's quaternions.
    """
    angle = np.linalg.norm(vector, axis=1)[:, None, None]
    safe = np.where(angle < 1e-2, 1.0, angle)
    one = np.where(angle < 1e-2, 0.5, (1.0 - np.cos(safe)) / safe**2)
    two = np.where(angle < 1e-2, 1.0 / 6.0, (safe - np.sin(safe)) / safe**3)
    across = cross_matrices(vector)
    return np.asarray(_EYE - one * across + two * across @ across)
