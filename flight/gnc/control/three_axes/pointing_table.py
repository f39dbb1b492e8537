"""Gains of the pointing law: a linear-quadratic regulator that knows the field and the torques ahead.

The errors x are the small turn and the rate error of the body against a reference, in the reference's axes.
With the field b(t) expected in these axes,

    turn' = rate - w_r x turn,    J rate' = ([J w_r x] - [w_r x] J) rate + G turn + m x b - f,

where G is the gravity gradient's stiffness and f the torque that the reference takes and nothing else
provides: J a_r + w_r x J w_r less gravity gradient and disturbance. The cost is x^T Q x + m^2 R. Coils make
no torque along b, so what f holds along b must be met before or afterwards: Riccati's equation is swept
backwards with its affine part s, cost-to-go x^T S x / 2 + s^T x (Psiaki 2001, J. Guid. Control Dyn. 24(2),
with the preview added). The dipole is m = -(K x + k), held over a step.

k is linear in the disturbance: the table holds k of the reference alone, and k of each of the disturbance's
sizes with the shape expected (`flight.gnc.earth.disturbance`), so that a new estimate of the sizes takes no
new sweep.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flight.gnc.earth.figure import GRAVITATIONAL_PARAMETER
from flight.gnc.errors import UsageError
from flight.gnc.guidance.three_axes.attitude_law import References
from flight.gnc.math.arrays import FloatArray
from flight.gnc.math.directions import cross_matrices
from flight.gnc.math.quaternion import attitude_matrix

_EYE3: FloatArray = np.eye(3)
_EYE6: FloatArray = np.eye(6)


@dataclass(frozen=True, slots=True, kw_only=True)
class PointingWeights:
    """What errors cost: each attribute is the value that costs one.

    Attributes:
        turn: rad, of an axis.
        rate: rad/s, of an axis.
        dipole: A m^2, of an axis.
    """

    turn: float
    rate: float
    dipole: float


@dataclass(frozen=True, slots=True, eq=False)
class PointingTable:
    """References and gains at even instants, times (n,) s.

    Attributes:
        references: the wanted motion.
        gain: (n, 3, 6), K: A m^2 by rad and by rad/s.
        reference_part: (n, 3) A m^2: k of the reference's own torque.
        torque_part: (n, 3, sizes): k by each size of the disturbance.
    """

    references: References
    gain: FloatArray
    reference_part: FloatArray
    torque_part: FloatArray

    def until(self, count: int) -> PointingTable:
        """Return the first `count` instants."""
        return PointingTable(
            self.references.until(count),
            self.gain[:count],
            self.reference_part[:count],
            self.torque_part[:count],
        )


def pointing_table(
    references: References,
    inertia: FloatArray,
    field: FloatArray,
    position: FloatArray,
    disturbance: FloatArray,
    weights: PointingWeights,
) -> PointingTable:
    """Return the table for a reference, with `field` (n, 3) T and `position` (n, 3) m expected, ICRS axes.

    `inertia` (3, 3) kg m^2 and the `disturbance` (n, 3, sizes) N m by its sizes, body axes. The
    gains need about a revolution of preview: those near the end of the times are without it. Takes 0.2 ms an
    instant. Raises UsageError for times that are not even.
    """
    times = references.times
    steps = np.diff(times)
    if len(times) < 3 or not np.allclose(steps, steps[0], rtol=1e-6):
        raise UsageError("a pointing table needs three even times or more")
    turned = np.array([attitude_matrix(q) for q in references.quaternion])
    shown = np.einsum("nij,nj->ni", turned, field)
    flow, torque = _linearised(references, inertia, np.einsum("nij,nj->ni", turned, position))
    inverse = np.linalg.inv(inertia)
    dt = float(steps[0])
    transition, pushed = _discrete(flow, dt)
    by_dipole = -pushed @ (inverse @ cross_matrices(shown))
    # Columns: the reference's torque, and the disturbance's sizes.
    affine = np.concatenate(
        [(-pushed @ (inverse @ torque[:, :, None])), pushed @ (inverse @ disturbance)], axis=2
    )
    state_cost = dt * np.diag(np.repeat([weights.turn**-2.0, weights.rate**-2.0], 3))
    gain, parts = _sweep(transition, by_dipole, affine, state_cost, dt * weights.dipole**-2.0)
    return PointingTable(references, gain, parts[:, :, 0], parts[:, :, 1:])


def _linearised(
    references: References, inertia: FloatArray, position: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the errors' flow (n, 6, 6), and the reference's torque (n, 3); `position` is in its axes."""
    rate = references.rate
    momentum = rate @ inertia.T
    turning = cross_matrices(rate)
    radius = np.linalg.norm(position, axis=1)
    down = -position / radius[:, None]
    strength = 3.0 * GRAVITATIONAL_PARAMETER / radius**3
    stiff = down @ inertia.T
    gradient = strength[:, None] * np.cross(down, stiff)
    crossed = cross_matrices(down)
    stiffness = strength[:, None, None] * ((crossed @ inertia - cross_matrices(stiff)) @ crossed)
    inverse = np.linalg.inv(inertia)
    flow = np.zeros((len(rate), 6, 6))
    flow[:, :3, :3] = -turning
    flow[:, :3, 3:] = _EYE3
    flow[:, 3:, :3] = inverse @ stiffness
    flow[:, 3:, 3:] = inverse @ (cross_matrices(momentum) - turning @ inertia)
    return flow, references.acceleration @ inertia.T + np.cross(rate, momentum) - gradient


def _discrete(flow: FloatArray, dt: float) -> tuple[FloatArray, FloatArray]:
    """Return exp(F dt) (n, 6, 6) and its integral's rate columns (n, 6, 3), to the third order."""
    first = flow * dt
    second = first @ first
    transition = _EYE6 + first + 0.5 * second + first @ second / 6.0
    integral = dt * (_EYE6 + 0.5 * first + second / 6.0)
    return transition, integral[:, :, 3:]


def _sweep(
    transition: FloatArray,
    by_dipole: FloatArray,
    affine: FloatArray,
    state_cost: FloatArray,
    dipole_cost: float,
) -> tuple[FloatArray, FloatArray]:
    """Return K (n, 3, 6) and k (n, 3, columns), swept backwards from the state's cost; the last stay zero."""
    count, parts = len(transition), affine.shape[2]
    gain, steady = np.zeros((count, 3, 6)), np.zeros((count, 3, parts))
    cost, slope = state_cost, np.zeros((6, parts))
    for k in range(count - 2, -1, -1):
        push, drive = by_dipole[k], transition[k]
        pushed = cost @ push
        spread = push.T @ pushed
        spread.reshape(-1)[::4] += dipole_cost
        slope = slope + cost @ affine[k]
        found = np.linalg.solve(spread, np.concatenate([pushed.T @ drive, push.T @ slope], axis=1))
        gain[k], steady[k] = found[:, :6], found[:, 6:]
        closed = drive - push @ gain[k]
        slope = closed.T @ slope
        cost = drive.T @ cost @ closed + state_cost
        cost = 0.5 * (cost + cost.T)
    return gain, steady
