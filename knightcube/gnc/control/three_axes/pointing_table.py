"""The table of the pointing law: a path, and gains along it.

The path is the begin of the best course of the whole revolution (`pointing_course`). Where none is found, or
the coils do not suffice for it, it is the best path (`pointing_path`), beyond whose end the law itself is the
path: a sweep over a revolution of preview gives what an error at the end would cost (`pointing_sweep`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.disturbance import AIR, LIGHT, Pressures, shapes
from knightcube.astro.quaternion import attitude_matrix
from knightcube.errors import UsageError
from knightcube.gnc.control.three_axes.pointing_course import best_course
from knightcube.gnc.control.three_axes.pointing_path import Criterion, Expected, best_path
from knightcube.gnc.control.three_axes.pointing_sweep import Cost, ToGo, linearised, sweep
from knightcube.gnc.guidance.three_axes.attitude_law import References
from knightcube.gnc.guidance.three_axes.slew_path import SlewPath

LEAST_PART = 1.0 / 3.0
"""Of a table: a shorter part that the body can fly is not worth leaving the last table for."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PointingWeights:
    """What errors cost: each attribute is the value that costs one.

    Attributes:
        turn: rad, of an axis.
        rate: rad/s, of an axis.
        dipole: A m^2, of an axis.
        fastest: rad/s, the rate of a body on its way; more is dear (`pointing_path.EXCESS`).
        roll: rad about the unit vector `axis` (3,), where that is cheaper than another turn.
    """

    turn: float
    rate: float
    dipole: float
    fastest: float = math.inf
    roll: float | None = None
    axis: FloatArray | None = None


@dataclass(frozen=True, slots=True, eq=False)
class PointingTable:
    """A path and gains at even instants, n of them.

    Attributes:
        path: the motion that is flown, n + 1 instants.
        wanted: the law, likewise.
        dipole: (n, 3) A m^2 of the path, held until the next instant.
        gain: (n, 3, 6), K: A m^2 by rad and by rad/s.
        torque_part: (n, 3, sizes): A m^2 by each size of the disturbance beyond `sizes`.
        sizes: (sizes,) N m, those that the path expects.
        slew: the slew that the path begins with, where it does; its times count from the path's begin.
    """

    path: References
    wanted: References
    dipole: FloatArray
    gain: FloatArray
    torque_part: FloatArray
    sizes: FloatArray
    slew: SlewPath | None = None

    @property
    def fastest(self) -> float:
        """The largest rate of the path, rad/s."""
        return float(np.linalg.norm(self.path.rate, axis=1).max())

    def below(self, fastest: float) -> PointingTable | None:
        """Return the part before the body turns at `fastest` rad/s; None for one shorter than `LEAST_PART`.

        A slew is flown whole or not at all.
        """
        over = np.flatnonzero(np.linalg.norm(self.path.rate, axis=1) >= fastest)
        if not len(over):
            return self
        count = int(over[0])
        if self.slew is not None or count < max(LEAST_PART * len(self.dipole), 2.0):
            return None
        held = slice(count - 1)
        return replace(
            self,
            path=self.path.until(count),
            wanted=self.wanted.until(count),
            dipole=self.dipole[held],
            gain=self.gain[held],
            torque_part=self.torque_part[held],
        )


@dataclass(frozen=True, slots=True, eq=False)
class Ahead:
    """What is expected along a law, at the instants of its `wanted` (m,): path and preview.

    Attributes:
        begun: a motion (n + 1,) from the body's attitude and rate into the law; the coils need not manage it.
        field, position: (m, 3) T and m, ICRS.
        pressures: shapes of the torques, likewise.
        sizes: (9,) N m, the torques estimated now.
    """

    wanted: References
    begun: References
    field: FloatArray
    position: FloatArray
    pressures: Pressures
    sizes: FloatArray


def pointing_table(
    ahead: Ahead, inertia: FloatArray, limit: float, weights: PointingWeights
) -> PointingTable:
    """Return the table from the begin of `ahead.begun` to its end.

    `inertia` (3, 3) kg m^2; `limit` A m^2 of each coil. The preview beyond should be of a revolution. Raises
    UsageError for times that are not even.
    """
    steps = np.diff(ahead.wanted.times)
    count = len(ahead.begun.times) - 1
    if count < 2 or len(steps) <= count or not np.allclose(steps, steps[0], rtol=1e-6):
        raise UsageError("a pointing table needs even times, three or more, and a preview beyond them")
    dt = float(steps[0])
    state, dipole = prices(weights, dt)
    shape = shapes(ahead.pressures, attitude_matrix(ahead.wanted.quaternion))
    inverse = np.asarray(np.linalg.inv(inertia))
    whole = Expected(
        ahead.wanted, ahead.field, ahead.position, ahead.pressures, ahead.sizes, inertia, inverse, limit
    )
    course = best_course(whole, ahead.begun, state, dipole, weights.fastest)
    if course is None:
        beyond = _beyond(ahead, count, inertia, state, dipole, shape)
        criterion = Criterion(state, dipole, beyond, shape, weights.fastest)
        course = best_path(whole.until(count + 1), ahead.begun, criterion)
    motion, gains = course
    path = motion.references(ahead.wanted.times[: len(motion.rate)]).until(count + 1)
    wanted = ahead.wanted.until(count + 1)
    gain, torque_part = gains.gain[:count, :3], gains.steady[:count, :3, 1:]
    return PointingTable(path, wanted, motion.control[:count, :3], gain, torque_part, ahead.sizes)


def table_along(
    motion: References, field: FloatArray, position: FloatArray, inertia: FloatArray, weights: PointingWeights
) -> PointingTable:
    """Return the table that holds a given motion (n + 1,), its torque known ahead; no other is expected.

    `field` (n + 1, 3) T and `position` (n + 1, 3) m, ICRS; `inertia` (3, 3) kg m^2. The gains near the end
    have less preview.
    """
    count, dt = len(motion.times) - 1, float(motion.times[1] - motion.times[0])
    state, dipole = prices(weights, dt)
    linear = linearised(motion.until(count), inertia, field[:count], position[:count])
    affine = -np.einsum("nij,nj->ni", linear.by_torque, linear.missing)[:, :, None]
    nothing = np.zeros(affine.shape)
    states = np.broadcast_to(state, (count, 6, 6))
    cost = Cost(states, np.full((count, 3), dipole), nothing, nothing[:, :3])
    gain, steady, _ = sweep(linear, affine, cost, ToGo(state, nothing[0]))
    return PointingTable(motion, motion, -steady[:, :, 0], gain, np.zeros((count, 3, 0)), np.zeros(0))


def prices(weights: PointingWeights, dt: float) -> tuple[FloatArray, float]:
    """Return what a step of `dt` s costs: (6, 6) of turn and rate, and of an axis of the dipole."""
    state = dt * np.diag(np.repeat([weights.turn**-2.0, weights.rate**-2.0], 3))
    if weights.roll is not None and weights.axis is not None:
        state[:3, :3] -= dt * (weights.turn**-2.0 - weights.roll**-2.0) * np.outer(weights.axis, weights.axis)
    return state, dt * weights.dipole**-2.0


def _beyond(
    ahead: Ahead, begin: int, inertia: FloatArray, state: FloatArray, dipole: float, shape: FloatArray
) -> ToGo:
    """Return the cost-to-go of the law from instant `begin` on; the first column has the expected torques."""
    air, light = ahead.pressures.air[begin:], ahead.pressures.light[begin:]
    pressed = [(ahead.sizes[AIR], air), (ahead.sizes[LIGHT], light)]
    field, position = ahead.field[begin:], ahead.position[begin:]
    law = linearised(ahead.wanted.since(begin), inertia, field, position, pressed=pressed)
    by_size = law.by_torque @ shape[begin:]
    own = by_size @ ahead.sizes - np.einsum("nij,nj->ni", law.by_torque, law.missing)
    affine = np.concatenate([own[:, :, None], by_size], axis=2)
    nothing = np.zeros(affine.shape)
    states = np.broadcast_to(state, (len(affine), 6, 6))
    cost = Cost(states, np.full((len(affine), 3), dipole), nothing, nothing[:, :3])
    return sweep(law, affine, cost, ToGo(state, nothing[0]))[2]
