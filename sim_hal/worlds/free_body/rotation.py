"""The rotation of a rigid body in its principal axes, by classical Runge-Kutta in plain floats.

Euler's equations and the kinematics of `knightcube.astro.quaternion`, with the torques that turn with the
body within a step evaluated in every stage: a dipole in the field, and the gravity gradient (Wertz 1978,
17.28). At |w| dt = 0.01 a step is true to 1e-13 rad. Plain floats: numpy costs ten times as much for three of
them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

Floats = tuple[float, float, float]
State = tuple[float, float, float, float, float, float, float]
"""Quaternion of the principal axes, scalar last, and rate about them, rad/s."""

Matrix = tuple[float, float, float, float, float, float, float, float, float]

TURN_PER_STEP = 0.01
"""rad: the most that the body turns in one step."""


class Loads(NamedTuple):
    """What acts on the body during a step.

    Attributes:
        dipole: (3,) A m^2, principal axes.
        pull: (3,) the position times sqrt(3 mu / r^5), rad/s, inertial axes.
        torque: (3,) N m, principal axes.
    """

    dipole: Floats
    pull: Floats
    torque: Floats


class Rotation:
    """Steps the rotation of a body with moments of inertia `inertia` (3,) kg m^2."""

    def __init__(self, inertia: Floats) -> None:
        a, b, c = inertia
        self.inertia = inertia
        self._of_rates = ((b - c) / a, (c - a) / b, (a - b) / c)
        self._of_torques = (1.0 / a, 1.0 / b, 1.0 / c)

    def step(self, state: State, dt: float, begin: Floats, end: Floats, loads: Loads) -> State:
        """Return the state after `dt` s; the field goes from `begin` to `end` (3,) T, inertial axes."""
        middle = 0.5 * (begin[0] + end[0]), 0.5 * (begin[1] + end[1]), 0.5 * (begin[2] + end[2])
        half = 0.5 * dt
        first = self._slope(state, begin, loads)
        second = self._slope(_moved(state, first, half), middle, loads)
        third = self._slope(_moved(state, second, half), middle, loads)
        a1, a2, a3, a4, a5, a6, a7 = self._slope(_moved(state, third, dt), end, loads)
        b1, b2, b3, b4, b5, b6, b7 = first
        c1, c2, c3, c4, c5, c6, c7 = second
        d1, d2, d3, d4, d5, d6, d7 = third
        q1, q2, q3, q4, w1, w2, w3 = state
        sixth = dt / 6.0
        q1 += sixth * (a1 + 2.0 * (c1 + d1) + b1)
        q2 += sixth * (a2 + 2.0 * (c2 + d2) + b2)
        q3 += sixth * (a3 + 2.0 * (c3 + d3) + b3)
        q4 += sixth * (a4 + 2.0 * (c4 + d4) + b4)
        w1 += sixth * (a5 + 2.0 * (c5 + d5) + b5)
        w2 += sixth * (a6 + 2.0 * (c6 + d6) + b6)
        w3 += sixth * (a7 + 2.0 * (c7 + d7) + b7)
        unit = 1.0 / math.sqrt(q1 * q1 + q2 * q2 + q3 * q3 + q4 * q4)
        return q1 * unit, q2 * unit, q3 * unit, q4 * unit, w1, w2, w3

    def _slope(self, state: State, field: Floats, loads: Loads) -> State:
        """Return the derivative of the state in `field` (3,) T, inertial axes."""
        q1, q2, q3, q4, w1, w2, w3 = state
        (mx, my, mz), pull, (tx, ty, tz) = loads
        a11, a12, a13, a21, a22, a23, a31, a32, a33 = matrix(q1, q2, q3, q4)
        x, y, z = field
        bx, by, bz = a11 * x + a12 * y + a13 * z, a21 * x + a22 * y + a23 * z, a31 * x + a32 * y + a33 * z
        x, y, z = pull
        gx, gy, gz = a11 * x + a12 * y + a13 * z, a21 * x + a22 * y + a23 * z, a31 * x + a32 * y + a33 * z
        i1, i2, i3 = self._of_torques
        k1, k2, k3 = self._of_rates
        # r x (J r) has the same products and differences of inertia as w x (J w).
        return (
            0.5 * (w3 * q2 - w2 * q3 + w1 * q4),
            0.5 * (w1 * q3 - w3 * q1 + w2 * q4),
            0.5 * (w2 * q1 - w1 * q2 + w3 * q4),
            -0.5 * (w1 * q1 + w2 * q2 + w3 * q3),
            k1 * (w2 * w3 - gy * gz) + i1 * (tx + my * bz - mz * by),
            k2 * (w3 * w1 - gz * gx) + i2 * (ty + mz * bx - mx * bz),
            k3 * (w1 * w2 - gx * gy) + i3 * (tz + mx * by - my * bx),
        )


def _moved(state: State, slope: State, dt: float) -> State:
    """Return `state` moved on by `slope` for `dt` s."""
    q1, q2, q3, q4, w1, w2, w3 = state
    d1, d2, d3, d4, d5, d6, d7 = slope
    return (
        q1 + dt * d1,
        q2 + dt * d2,
        q3 + dt * d3,
        q4 + dt * d4,
        w1 + dt * d5,
        w2 + dt * d6,
        w3 + dt * d7,
    )


def matrix(q1: float, q2: float, q3: float, q4: float) -> Matrix:
    """Return the attitude matrix of a quaternion, row by row (`knightcube.astro.quaternion`, as floats)."""
    r11, r22, r33, r44 = q1 * q1, q2 * q2, q3 * q3, q4 * q4
    r12, r13, r14, r23, r24, r34 = q1 * q2, q1 * q3, q1 * q4, q2 * q3, q2 * q4, q3 * q4
    return (
        r11 - r22 - r33 + r44,
        2.0 * (r12 + r34),
        2.0 * (r13 - r24),
        2.0 * (r12 - r34),
        r22 - r11 - r33 + r44,
        2.0 * (r23 + r14),
        2.0 * (r13 + r24),
        2.0 * (r23 - r14),
        r33 - r11 - r22 + r44,
    )


def turned(turn: Matrix, vector: Floats) -> Floats:
    """Return a vector in the axes that the matrix turns to."""
    a, b, c, d, e, f, g, h, i = turn
    x, y, z = vector
    return a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z


def steps_within(span: float, rate: float, longest: float) -> int:
    """Return how many steps `span` s takes at `rate` rad/s, none longer than `longest` s."""
    return max(1, math.ceil(span / longest - 1e-9), math.ceil(span * rate / TURN_PER_STEP))
