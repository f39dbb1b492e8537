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
LIMIT_GAIN = 1.4
"""Mean reach of three coils over the limit of one, in a body that turns; were all saturated, 1.5."""
STEEP = 12.0
FLAT = 0.02
FINENESS = 60
"""The horizon is found within a sixtieth."""


@dataclass(frozen=True, slots=True, eq=False)
class MomentumPlan:
    """A plan: `costate` (3,) A m^2/T, inertial axes, and the `horizon`, s, at whose end the body stands.

    The costate's dipole has the limit's length in the mean over the plan.
    """

    costate: FloatArray
    horizon: float


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
    effect *= LIMIT_GAIN * limit
    size = math.sqrt(float(momentum @ momentum))
    if size <= rest:
        return MomentumPlan(np.zeros(3), 0.0)
    short, long = 2, len(field)
    costate, _ = _costate(momentum, field, effect, rest, momentum / size)
    while long - short > 1 and times[long - 1] - times[short - 1] > times[short - 1] / FINENESS:
        middle = (short + long) // 2
        found, lacks = _costate(momentum, field[:middle], effect[:middle], rest, costate)
        if lacks:
            short = middle
        else:
            costate, long = found, middle
    across = np.cross(field[:long], costate)
    mean = float(np.sqrt(np.einsum("ni,ni->n", across, across)) @ spans[:long] / spans[:long].sum())
    return MomentumPlan(costate * (limit / mean), float(times[long - 1] + spans[long - 1]))


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


def _costate(
    momentum: FloatArray, field: FloatArray, effect: FloatArray, rest: float, guess: FloatArray
) -> tuple[FloatArray, bool]:
    y = guess
    for _ in range(ITERATIONS):
        across = np.cross(field, y)
        size = np.sqrt(np.einsum("ni,ni->n", across, across))
        weight = 1.0 / np.maximum(size, FLAT * float(size.max()))
        matrix = np.tensordot(weight, effect, 1) + rest * np.eye(3)
        y = np.linalg.solve(matrix, momentum)
        y = y / math.sqrt(float(y @ y))
    across = np.cross(field, y)
    size = np.sqrt(np.einsum("ni,ni->n", across, across))
    weight = 1.0 / np.maximum(size, FLAT * float(size.max()))
    matrix = np.tensordot(weight, effect, 1) + rest * np.eye(3)
    return y, float(momentum @ y) > float(y @ matrix @ y)
