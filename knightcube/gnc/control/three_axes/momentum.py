"""The momentum plan: the dipole that stops a body in the least time, with the field predicted ahead.

In inertial axes the angular momentum obeys h' = m x B: the body's inertia and attitude do not enter. By
Pontryagin's principle the dipole of least time has its limit's length L and the direction of -B x y with one
constant vector y. A time T suffices for all but a rest r of the momentum exactly where, for every y,

    h . y <= L integral of |B x y| over T + r |y|,

so T is the least time at which the worst y meets it, and that y is the plan. The worst y has A(y) y along h,
A the integral of L (B^2 I - B B^T) / |B x y| plus r / |y|, and is found by iterating that: least squares,
reweighted. A field that keeps its direction cannot remove the momentum along itself: the plan then makes
momentum across it, which the field's turn carries along. Without a rest the last of what lies along a field
that hardly turns would take all of the time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.directions import cross_product
from knightcube.errors import UsageError

ITERATIONS = 12
LIMIT_GAIN = 1.4
"""Mean reach of three coils over the limit of one, in a body that turns; were all saturated, 1.5."""
STEEP = 12.0
"""Times the mean of |B x y| at which a coil is at its limit: least time takes all at theirs, but noise in B
would switch them where B x y is small."""
FLAT = 0.02
"""Of the largest |B x y|, what the smaller ones count as: the weights stay finite."""
FINENESS = 60
"""The horizon is found within a sixtieth."""


@dataclass(frozen=True, slots=True, eq=False)
class MomentumPlan:
    """A plan: `costate` (3,) A m^2/T, inertial axes, and the `horizon`, s, at whose end the body is at rest.

    The dipole -B x costate has the coils' limit at a small part of its mean over the plan; zero at rest.
    """

    costate: FloatArray
    horizon: float


def momentum_plan(
    momentum: FloatArray, field: FloatArray, times: FloatArray, limit: float, rest: float
) -> MomentumPlan:
    """Return the plan that removes `momentum` (3,) N m s but for `rest` N m s in the least time.

    `field` (n, 3) T is the predicted field at `times` (n,) s from now on, in the momentum's inertial axes;
    `limit` A m^2 is of each coil. When all times do not suffice, the plan removes what it can and its
    horizon is their span.
    Raises UsageError for a field of fewer than three instants.
    """
    if len(field) < 3:
        raise UsageError(f"a momentum plan needs the field at three instants, not {len(field)}")
    size = math.sqrt(float(momentum @ momentum))
    if size <= rest:
        return MomentumPlan(np.zeros(3), 0.0)
    spans = np.diff(times, append=2.0 * times[-1] - times[-2])
    square = np.einsum("ni,ni->n", field, field)
    effect = square[:, None, None] * np.eye(3) - field[:, :, None] * field[:, None, :]
    ahead = _Ahead(field, effect * spans[:, None, None], LIMIT_GAIN * limit, rest)
    short, long = 2, len(field)
    costate = ahead.worst(momentum, long, momentum / size)
    while long - short > 1 and times[long - 1] - times[short - 1] > times[short - 1] / FINENESS:
        middle = (short + long) // 2
        found = ahead.worst(momentum, middle, costate)
        if float(momentum @ found) > float(found @ ahead.matrix(found, middle) @ found):
            short = middle
        else:
            costate, long = found, middle
    mean = float(ahead.across(costate, long) @ spans[:long]) / float(spans[:long].sum())
    return MomentumPlan(costate * (STEEP * limit / mean), float(times[long - 1] + spans[long - 1]))


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
    """Return `fields` (n, 3) turned by the least angle that brings the first to where `field` (3,) points.

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


@dataclass(frozen=True, slots=True, eq=False)
class _Ahead:
    """The field (n, 3) and its `effect` (n, 3, 3) on the momentum; the dipole's reach, and the rest."""

    field: FloatArray
    effect: FloatArray
    reach: float
    rest: float

    def across(self, y: FloatArray, count: int) -> FloatArray:
        """Return |B x y| (count,), nowhere zero."""
        found = np.cross(self.field[:count], y)
        across = np.sqrt(np.einsum("ni,ni->n", found, found))
        strength = math.sqrt(float(self.field[0] @ self.field[0]))
        return np.asarray(np.maximum(across, FLAT * max(float(across.max()), FLAT * strength)))

    def matrix(self, y: FloatArray, count: int) -> FloatArray:
        """Return A(y) (3, 3) of `count` instants and a unit vector."""
        weight = self.reach / self.across(y, count)
        return np.asarray(np.tensordot(weight, self.effect[:count], 1) + self.rest * np.eye(3))

    def worst(self, momentum: FloatArray, count: int, guess: FloatArray) -> FloatArray:
        """Return the unit vector (3,) whose momentum is the hardest to remove in `count` instants."""
        y = guess
        for _ in range(ITERATIONS):
            found = np.linalg.solve(self.matrix(y, count), momentum)
            y = np.asarray(found / math.sqrt(float(found @ found)))
        return y
