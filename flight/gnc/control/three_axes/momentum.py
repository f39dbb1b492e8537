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


def momentum_plan(momentum: FloatArray, field: FloatArray, step: float, limit: float) -> MomentumPlan:
    """Return the plan that removes `momentum` (3,) N m s in the least time.

    `field` (n, 3) T is the predicted field from now on, every `step` s, both in inertial axes; `limit` A m^2
    is of each coil. When n steps do not suffice, the plan removes what it can and its horizon is n steps.
    Raises UsageError for a field of fewer than three instants.
    """
    if len(field) < 3:
        raise UsageError(f"a momentum plan needs the field at three instants, not {len(field)}")
    square = np.einsum("ni,ni->n", field, field)
    effect = (square[:, None, None] * np.eye(3) - field[:, :, None] * field[:, None, :]) * step
    reach = LIMIT_GAIN * limit
    short, long = 2, len(field)
    costate, _ = _cut_plan(momentum, field, effect, reach)
    while long - short > max(1, short // FINENESS):
        middle = (short + long) // 2
        found, missing = _cut_plan(momentum, field[:middle], effect[:middle], reach)
        if missing < MISSING:
            costate, long = found, middle
        else:
            short = middle
    return MomentumPlan(costate, long * step, long <= 3)


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


def turning_field(field: FloatArray, change: FloatArray, step: float, instants: int) -> FloatArray:
    """Return the field (n, 3) T, every `step` s from now on, that turns as it does now.

    `field` (3,) T and its `change` (3,) T/s with respect to the stars; its strength is kept.
    """
    strength = math.sqrt(float(field @ field))
    along = field / strength
    across = change - along * float(along @ change)
    speed = math.sqrt(float(across @ across)) / strength
    if speed == 0.0:
        return np.broadcast_to(field, (instants, 3)).copy()
    angle = (speed * step) * np.arange(instants)[:, None]
    return np.asarray(strength * np.cos(angle) * along + np.sin(angle) * across / speed)


def _cut_plan(
    momentum: FloatArray, field: FloatArray, effect: FloatArray, limit: float
) -> tuple[FloatArray, float]:
    """Return the costate over one horizon, and the share of the momentum that it leaves."""
    weight = np.ones(len(field))
    costate = np.zeros(3)
    for _ in range(ITERATIONS):
        costate = _solved(np.tensordot(weight, effect, 1), momentum)
        wanted = np.cross(field, costate)
        weight = 1.0 / np.maximum(1.0, np.sqrt(np.einsum("ni,ni->n", wanted, wanted)) / limit)
    left = np.tensordot(weight, effect, 1) @ costate - momentum
    size = float(momentum @ momentum)
    return costate, math.sqrt(float(left @ left) / size) if size > 0.0 else 0.0


def _solved(matrix: FloatArray, vector: FloatArray) -> FloatArray:
    """Return the solution; what lies along a field that hardly turns is out of reach and stays finite."""
    least = 1e-6 * float(np.trace(matrix))
    return np.asarray(np.linalg.solve(matrix + least * np.eye(3), vector))
