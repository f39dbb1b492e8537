"""The linear-quadratic sweep under a field and torques that are known ahead.

The errors x are the small turn and the rate error of the body against a motion, in the motion's axes. With
the field b(t) expected in these axes,

    turn' = rate - w_r x turn,    J rate' = ([J w_r x] - [w_r x] J) rate + G turn + m x b - f,

where G is the gravity gradient's stiffness and f the torque that the motion takes and nothing else
provides. Riccati's equation is swept backwards with its affine part s, cost-to-go x^T S x / 2 + s^T x
(Psiaki 2001, J. Guid. Control Dyn. 24(2), with the preview added). The dipole is m = -(K x + k), held over
a step. Each affine part has columns of its own: k is linear in them. There may be controls beside the dipole.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.directions import cross_matrices
from knightcube.astro.earth.figure import GRAVITATIONAL_PARAMETER
from knightcube.astro.quaternion import attitude_matrix
from knightcube.gnc.guidance.three_axes.attitude_law import References

_EYE3: FloatArray = np.eye(3)
_EYE6: FloatArray = np.eye(6)


@dataclass(frozen=True, slots=True, eq=False)
class Linear:
    """The motion of the errors over n steps.

    Attributes:
        transition: (n, 6, 6).
        by_control: (n, 6, controls), of `linearised` by A m^2 of each coil.
        by_torque: (n, 6, 3), by N m.
        missing: (n, 3) N m, f: the torque that the motion takes besides gravity's.
        field: (n, 3) T in the motion's axes.
    """

    transition: FloatArray
    by_control: FloatArray
    by_torque: FloatArray
    missing: FloatArray
    field: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Cost:
    """The cost of n steps: x^T state x / 2 + state_slope^T x + control u^2 / 2 + control_slope^T u.

    Attributes:
        state: (n, 6, 6).
        control: (n, controls).
        state_slope, control_slope: (n, 6, columns) and (n, controls, columns).
    """

    state: FloatArray
    control: FloatArray
    state_slope: FloatArray
    control_slope: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class ToGo:
    """The cost-to-go: `square` (6, 6) S and `slope` (6, columns) s."""

    square: FloatArray
    slope: FloatArray


def linearised(
    references: References,
    inertia: FloatArray,
    field: FloatArray,
    position: FloatArray,
    dipole: FloatArray | None = None,
    pressed: Sequence[tuple[FloatArray, FloatArray]] = (),
) -> Linear:
    """Return the motion of the errors about references; `field` (n, 3) T, `position` (n, 3) m, ICRS.

    `dipole` (n, 3) A m^2 is held in body axes meanwhile: an error turns the field that it acts on. Likewise
    of each `pressed`: a constant (3,) of the body, N m, and the direction (n, 3) ICRS, with which it makes a
    torque.
    """
    rate, inverse = references.rate, np.linalg.inv(inertia)
    slopes, shown, up = acceleration_slopes(
        references.quaternion, rate, inertia, field, position, dipole, pressed
    )
    flow = np.zeros((len(rate), 6, 6))
    flow[:, :3, :3], flow[:, :3, 3:], flow[:, 3:] = -cross_matrices(rate), _EYE3, slopes
    dt = float(references.times[1] - references.times[0])
    transition, pushed = _discrete(flow, dt)
    by_torque = pushed @ inverse
    momentum = rate @ inertia.T
    missing = references.acceleration @ inertia.T + np.cross(rate, momentum) - _gradient(inertia, up)[0]
    return Linear(transition, -by_torque @ cross_matrices(shown), by_torque, missing, shown)


def acceleration_slopes(
    quaternion: FloatArray,
    rate: FloatArray,
    inertia: FloatArray,
    field: FloatArray,
    position: FloatArray,
    dipole: FloatArray | None = None,
    pressed: Sequence[tuple[FloatArray, FloatArray]] = (),
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return how the accelerations change with turn and rate (n, 3, 6), and field and place in body axes.

    Of attitudes (n, 4) and rates (n, 3) rad/s; the rest as in `linearised`.
    """
    turned, inverse = attitude_matrix(quaternion), np.linalg.inv(inertia)
    shown, up = (np.einsum("nij,nj->ni", turned, vectors) for vectors in (field, position))
    slopes = np.empty((len(rate), 3, 6))
    by_turn = _gradient(inertia, up)[1]
    if dipole is not None:
        by_turn = by_turn + cross_matrices(dipole) @ cross_matrices(shown)
    for constant, direction in pressed:
        met = cross_matrices(np.einsum("nij,nj->ni", turned, direction))
        by_turn = by_turn + cross_matrices(constant[None]) @ met
    slopes[:, :, :3] = inverse @ by_turn
    slopes[:, :, 3:] = inverse @ (cross_matrices(rate @ inertia.T) - cross_matrices(rate) @ inertia)
    return slopes, shown, up


def sweep(linear: Linear, affine: FloatArray, cost: Cost, end: ToGo) -> tuple[FloatArray, FloatArray, ToGo]:
    """Return K (n, controls, 6), k (n, controls, columns) and the cost-to-go at the begin.

    `affine` (n, 6, columns) is what the errors are moved by; `end` is the cost-to-go after the steps. Takes
    0.1 ms a step.
    """
    (count, controls), columns = cost.control.shape, affine.shape[2]
    gain, steady = np.empty((count, controls, 6)), np.empty((count, controls, columns))
    square, slope = end.square, end.slope
    for k in range(count - 1, -1, -1):
        push, drive = linear.by_control[k], linear.transition[k]
        pushed = square @ push
        spread = push.T @ pushed
        spread.reshape(-1)[:: controls + 1] += cost.control[k]
        ahead = slope + square @ affine[k]
        sides = np.concatenate([pushed.T @ drive, push.T @ ahead + cost.control_slope[k]], axis=1)
        found = np.linalg.solve(spread, sides)
        gain[k], steady[k] = found[:, :6], found[:, 6:]
        slope = drive.T @ ahead - sides[:, :6].T @ found[:, 6:] + cost.state_slope[k]
        square = drive.T @ square @ drive - sides[:, :6].T @ found[:, :6] + cost.state[k]
        square = 0.5 * (square + square.T)
    return gain, steady, ToGo(square, slope)


def _gradient(inertia: FloatArray, up: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return gravity's torque (n, 3) and how it changes with the turn (n, 3, 3); `up` (n, 3) m, body axes."""
    radius = np.linalg.norm(up, axis=1)
    down = -up / radius[:, None]
    strength = 3.0 * GRAVITATIONAL_PARAMETER / radius**3
    stiff = down @ inertia.T
    crossed = cross_matrices(down)
    stiffness = strength[:, None, None] * ((crossed @ inertia - cross_matrices(stiff)) @ crossed)
    return strength[:, None] * np.cross(down, stiff), stiffness


def _discrete(flow: FloatArray, dt: float) -> tuple[FloatArray, FloatArray]:
    """Return exp(F dt) (n, 6, 6) and its integral's rate columns (n, 6, 3), to the third order."""
    first = flow * dt
    second = first @ first
    transition = _EYE6 + first + 0.5 * second + first @ second / 6.0
    integral = dt * (_EYE6 + 0.5 * first + second / 6.0)
    return transition, integral[:, :, 3:]
