"""The momentum plan: the dipole that stops a body in the least time, with the field predicted ahead.

In inertial axes the angular momentum obeys h' = m x B: the body's inertia and attitude do not enter. By
Pontryagin's principle the dipole of least time has its limit's length and the direction of -B x y with one
constant vector y; with a smooth limit it is m = -B x y, cut at the limit. Over a horizon it removes W y, W
the integral of the weighted B^2 I - B B^T, where the weight of an instant is the share of -B x y that the
limit lets pass. Weight and y follow from each other by iteration; the horizon is the shortest whose plan
removes h. A field that keeps its direction cannot remove the momentum along itself: the plan then waits for
the field to turn, and uses how it turns.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from flight.gnc.errors import UsageError
from flight.gnc.math.arrays import FloatArray
from flight.gnc.math.directions import cross_product

ITERATIONS = 12
MISSING = 0.04
"""A plan may leave this share of the momentum: it is made again long before its end."""
LIMIT_GAIN = 1.4
"""Mean reach of three coils over the limit of one, in a body that turns; were all saturated, 1.5."""
STEEP = 4.0
"""Raises the dipole of a long plan before it is cut: the least time takes coils at their limits."""
FINENESS = 30
"""The horizon is found within a thirtieth."""


@dataclass(frozen=True, slots=True, eq=False)
class MomentumPlan:
    """A plan: `costate` (3,) A m^2/T, inertial axes, and the `horizon`, s, at whose end the body stands.

    `ends`: whether the horizon is the shortest there is, so that the coils need not be at their limits.
    """

    costate: FloatArray
    horizon: float
    ends: bool = False

    @property
    def braking(self) -> FloatArray:
        """The costate (3,) to brake by now."""
        return self.costate if self.ends else STEEP * self.costate


def momentum_plan(
    momentum: FloatArray, field: FloatArray, times: FloatArray, limit: float, rest: float
) -> MomentumPlan:
    """Return the plan that removes `momentum` (3,) N m s but for `rest` N m s in the least time.

    `field` (n, 3) T is the predicted field at `times` (n,) s from now on, both in inertial axes; `limit` A m^2
    is of each coil. When all times do not suffice, the plan removes what it can and its horizon is their span.
    Raises UsageError for a field of fewer than three instants.
    """
    if len(field) < 3:
        raise UsageError(f"a momentum plan needs the field at three instants, not {len(field)}")
    spans = np.diff(times, append=2.0 * times[-1] - times[-2])
    square = np.einsum("ni,ni->n", field, field)
    effect = (square[:, None, None] * np.eye(3) - field[:, :, None] * field[:, None, :]) * spans[:, None, None]
    reach = LIMIT_GAIN * limit
    short, long = 2, len(field)
    costate, _ = _cut_plan(momentum, field, effect, reach, rest)
    while long - short > 1 and times[long - 1] - times[short - 1] > times[short - 1] / FINENESS:
        middle = (short + long) // 2
        found, missing = _cut_plan(momentum, field[:middle], effect[:middle], reach, rest)
        if missing < MISSING:
            costate, long = found, middle
        else:
            short = middle
    return MomentumPlan(costate, float(times[long - 1] + spans[long - 1]), long <= 3)


def braking_dipole(costate: FloatArray, field: FloatArray, limit: float) -> FloatArray:
    """Return the dipole (3,) A m^2 of a plan in a field (3,) T, both in body axes, each coil cut at `limit`.

    Cutting each coil alone takes nothing from the others: each removes momentum by itself.
    """
    return np.clip(-cross_product(field, costate), -limit, limit)


def without_gain(dipole: FloatArray, field: FloatArray, rate: FloatArray, inverse: FloatArray) -> FloatArray:
    """Return the dipole (3,) without the part whose torque makes a body faster.

    `rate` (3,) rad/s, `inverse` (3, 3) of the inertia, body axes. No coil gets more than the largest had.
    """
    grows = cross_product(field, inverse @ rate)  # of |rate|^2 / 2 by A m^2
    gained, square = float(dipole @ grows), float(grows @ grows)
    if gained <= 0.0 or square == 0.0:
        return dipole
    left = dipole - grows * (gained / square)
    largest, before = float(np.abs(left).max()), float(np.abs(dipole).max())
    return left if largest <= before else left * (before / largest)


def turning_field(field: FloatArray, change: FloatArray, times: FloatArray) -> FloatArray:
    """Return the field (n, 3) T at `times` (n,) s from now on, that turns as it does now.

    `field` (3,) T and its `change` (3,) T/s with respect to the stars; its strength is kept.
    """
    strength = math.sqrt(float(field @ field))
    along = field / strength
    across = change - along * float(along @ change)
    speed = math.sqrt(float(across @ across)) / strength
    if speed == 0.0:
        return np.broadcast_to(field, (len(times), 3)).copy()
    angle = speed * times[:, None]
    return np.asarray(strength * np.cos(angle) * along + np.sin(angle) * across / speed)


def turned_to(fields: FloatArray, field: FloatArray) -> FloatArray:
    """Return `fields` (n, 3) turned by the least angle that brings the first to the direction of `field` (3,).

    What is measured now is better known than what is predicted by a coarse attitude.
    """
    first = fields[0] / math.sqrt(float(fields[0] @ fields[0]))
    wanted = field / math.sqrt(float(field @ field))
    middle = first + wanted
    square = float(middle @ middle)
    if square < 1.0:  # by more than 120 deg: no such prediction is worth to be turned
        return fields
    # Two reflections: across the middle, which swaps the two, and back across `wanted`.
    halves = 2.0 * np.outer(middle, middle) / square - np.eye(3)
    back = 2.0 * np.outer(wanted, wanted) - np.eye(3)
    return np.asarray(fields @ (back @ halves).T)


def _cut_plan(
    momentum: FloatArray, field: FloatArray, effect: FloatArray, limit: float, rest: float
) -> tuple[FloatArray, float]:
    """Return the costate over one horizon, and the share of the momentum that it leaves beside the rest.

    What is left lies along the costate, as the plan of least effort to within a rest has it. Without a rest,
    what lies along a field that hardly turns would take all of the effort.
    """
    weight = np.ones(len(field))
    size = math.sqrt(float(momentum @ momentum))
    if size <= rest:
        return np.zeros(3), 0.0
    costate = momentum / float(np.trace(np.sum(effect, axis=0)))
    for _ in range(ITERATIONS):
        length = math.sqrt(float(costate @ costate))
        matrix = np.tensordot(weight, effect, 1)
        least = max(rest / length, 1e-6 * float(np.trace(matrix)))
        costate = np.linalg.solve(matrix + least * np.eye(3), momentum)
        wanted = np.cross(field, costate)
        weight = 1.0 / np.maximum(1.0, np.sqrt(np.einsum("ni,ni->n", wanted, wanted)) / limit)
    left = np.tensordot(weight, effect, 1) @ costate - momentum
    return costate, max(0.0, math.sqrt(float(left @ left)) - rest) / size
