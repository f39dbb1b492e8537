"""The path of pointing: how a body gets from where it is into its attitude law, and stays there.

The path is the optimum of one criterion, turn against the law and dipole, over the field and the torques
expected, with the whole motion of the body and the limit of its coils. It is found by iterative
linear-quadratic sweeps (Li & Todorov 2004, ICINCO; Tassa, Erez & Todorov 2012, IROS): each sweeps about the
last motion, and flies what it found. Coils make no torque along the field, so motions that begin far off
would tumble. The first sweeps may have such a torque, at a price that rises until none is left.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.directions import cross_matrices
from knightcube.astro.earth.disturbance import AIR, LIGHT, Pressures, shapes
from knightcube.astro.earth.figure import GRAVITATIONAL_PARAMETER
from knightcube.astro.quaternion import (
    attitude_matrix,
    conjugate,
    from_rotation_vector,
    multiply,
    to_rotation_vector,
)
from knightcube.errors import PlanningError
from knightcube.gnc.control.three_axes.pointing_sweep import Cost, ToGo, linearised, sweep
from knightcube.gnc.guidance.three_axes.attitude_law import References

RISES = (4.0, 2.0, 10.0)
"""Factors from price to price, tried in turn until a path settles: they lead to different optima."""
DEAR, PROHIBITIVE = 1e4, 1e6
"""Prices of a torque along the field as multiples of the same torque across it: the rise's end, the last."""
SETTLED = math.radians(20.0)
"""rad off the law: within this the second half of a settled path stays."""
SWEEPS = 8
"""Largest number of sweeps at a price; the best motion is flown, converged or not."""
SAVED = (0.05, 2e-3)
"""Share of the cost: a sweep that saves less is the last one at its price; and at the last price."""
NEAR = math.radians(10.0)
"""rad off the law: a motion that stays within needs no such torque to begin with."""
EXCESS = 3e-5
"""rad/s beyond the largest rate that cost as much as the turn that costs one."""
SHARES = (1.0, 0.4, 0.15)
"""Of what a sweep found, tried in turn."""
RUN_AWAY = 100.0
"""rad/s: a motion this fast is not followed farther."""


@dataclass(frozen=True, eq=False)
class Expected:
    """What is expected at the n + 1 instants of a path.

    Attributes:
        wanted: the law.
        field, position: (n + 1, 3) T and m, ICRS.
        pressures: shapes of the torques.
        sizes: (9,) N m of the torques.
        inertia, inverse: (3, 3) kg m^2, and its inverse.
        limit: A m^2 of each coil.
    """

    wanted: References
    field: FloatArray
    position: FloatArray
    pressures: Pressures
    sizes: FloatArray
    inertia: FloatArray
    inverse: FloatArray
    limit: float

    @cached_property
    def around(self) -> FloatArray:
        """(n + 1, 4, 3): rows field, position, air and light."""
        around = np.empty((len(self.field), 4, 3))
        around[:, 0], around[:, 1] = self.field, self.position
        around[:, 2], around[:, 3] = self.pressures.air, self.pressures.light
        return around

    @cached_property
    def twice(self) -> FloatArray:
        """(6, 6): the inertia twice, for place and rate at once."""
        found: FloatArray = np.zeros((6, 6))
        found[:3, :3] = found[3:, 3:] = self.inertia
        return found

    def pressed(self, count: int) -> list[tuple[FloatArray, FloatArray]]:
        """Return what makes torques that change with the attitude, `linearised`, at the first instants."""
        air, light = self.pressures.air[:count], self.pressures.light[:count]
        return [(self.sizes[AIR], air), (self.sizes[LIGHT], light)]

    def until(self, count: int) -> Expected:
        """Return what is expected at the first `count` instants."""
        field, position, pressures = self.field[:count], self.position[:count], self.pressures.until(count)
        return replace(
            self, wanted=self.wanted.until(count), field=field, position=position, pressures=pressures
        )

    @property
    def step(self) -> float:
        """The time between instants, s."""
        return float(self.wanted.times[1] - self.wanted.times[0])

    def acceleration(
        self, k: int, quaternion: FloatArray, rate: FloatArray, control: FloatArray
    ) -> FloatArray:
        """Return the acceleration (3,) of an attitude (4,) after instant k under a control (4,)."""
        seen = self.around[k] @ attitude_matrix(quaternion).T
        # Plain floats: several times as fast as arrays of three.
        (bx, by, bz), (px, py, pz), (ax, ay, az), (lx, ly, lz) = seen.tolist()
        mx, my, mz, along = control.tolist()
        wx, wy, wz = rate.tolist()
        gx, gy, gz, hx, hy, hz = (self.twice @ np.concatenate([seen[1], rate])).tolist()
        cx, cy, cz, ux, uy, uz, vx, vy, vz = self.sizes.tolist()
        pull = 3.0 * GRAVITATIONAL_PARAMETER / (px * px + py * py + pz * pz) ** 2.5
        share = along / math.sqrt(bx * bx + by * by + bz * bz)
        torque = (
            cx + share * bx + my * bz - mz * by + pull * (py * gz - pz * gy)
            + uy * az - uz * ay + vy * lz - vz * ly - wy * hz + wz * hy,
            cy + share * by + mz * bx - mx * bz + pull * (pz * gx - px * gz)
            + uz * ax - ux * az + vz * lx - vx * lz - wz * hx + wx * hz,
            cz + share * bz + mx * by - my * bx + pull * (px * gy - py * gx)
            + ux * ay - uy * ax + vx * ly - vy * lx - wx * hy + wy * hx,
        )  # fmt: skip
        return np.asarray(self.inverse @ np.array(torque))

    def accelerations(self, quaternion: FloatArray, rate: FloatArray, dipole: FloatArray) -> FloatArray:
        """Return the accelerations (n, 3) of attitudes (n, 4) after the first n instants under dipoles."""
        count = len(quaternion)
        shown = attitude_matrix(quaternion)
        field = np.einsum("nij,nj->ni", shown, self.field[:count])
        up = np.einsum("nij,nj->ni", shown, self.position[:count])
        pull = 3.0 * GRAVITATIONAL_PARAMETER / np.linalg.norm(up, axis=1) ** 5
        torque = np.cross(dipole, field) + pull[:, None] * np.cross(up, up @ self.inertia.T)
        torque += shapes(self.pressures.until(count), shown) @ self.sizes
        return np.asarray((torque - np.cross(rate, rate @ self.inertia.T)) @ self.inverse.T)


@dataclass(frozen=True, slots=True, eq=False)
class Criterion:
    """What a step costs.

    Attributes:
        state: (6, 6), of turn and rate against the law.
        dipole: of an axis.
        end: the law's cost-to-go after the path; its first column is of the law and the torques expected,
            the others of each size of the torques.
        shape: (n + 1, 3, sizes) of the torques in the law's axes.
        fastest: rad/s; a rate beyond is dear, `EXCESS`.
    """

    state: FloatArray
    dipole: float
    end: ToGo
    shape: FloatArray
    fastest: float


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """A motion: attitudes (n + 1, 4), rates (n + 1, 3) rad/s, and controls (n, 4) held over the steps.

    A control is a dipole, A m^2, body axes, and a torque along the field, N m.
    """

    quaternion: FloatArray
    rate: FloatArray
    control: FloatArray

    def references(self, times: FloatArray) -> References:
        """Return the motion as references at its times (n + 1,) s."""
        rises = np.diff(self.rate, axis=0) / (times[1] - times[0])
        return References(times, self.quaternion, self.rate, np.concatenate([rises, rises[-1:]]))


@dataclass(frozen=True, slots=True, eq=False)
class Gains:
    """Gains K (n, 4, 6) about a motion, and k (n, 4, columns): what betters it, and by each size."""

    gain: FloatArray
    steady: FloatArray


def best_path(expected: Expected, begun: References, criterion: Criterion) -> tuple[Motion, Gains]:
    """Return the path from the begin of `begun` (n + 1,) and its gains; `begun` leads into the law.

    Coils need not manage `begun`. Takes 0.3 ms an instant and sweep. Raises PlanningError where the body
    turns by too much in a step to be followed.
    """
    rest = Motion(begun.quaternion, begun.rate, np.zeros((len(begun.times) - 1, 4)))
    first = _first(expected, rest, _swept(expected, rest, criterion, 1.0, given=True))
    near = float(_counted(expected.wanted, first, criterion).max()) < NEAR
    best, least = first, math.inf
    for rise in RISES:
        motion, price = first, PROHIBITIVE if near else 1.0
        while price < DEAR:
            motion, price = _bettered(expected, motion, criterion, price), price * rise
        motion = _bettered(expected, motion, criterion, PROHIBITIVE)
        cost = _cost(expected, motion, criterion, PROHIBITIVE)
        if cost < least:
            best, least = motion, cost
        later = _counted(expected.wanted, motion, criterion)[len(first.control) // 2 :]
        if near or float(later.max()) < SETTLED:
            break
    return best, _swept(expected, best, criterion, PROHIBITIVE)


def _first(expected: Expected, rest: Motion, gains: Gains) -> Motion:
    """Return the motion that the sweeps begin with: under gains, or without control where those drive it out.

    The torque along the field has no limit, so that far from `rest` the gains may turn the body by several
    revolutions in a step.
    """
    nothing = Gains(np.zeros_like(gains.gain), np.zeros_like(gains.steady))
    for tried in (gains, nothing):
        if (first := fly(expected, rest, tried, 1.0)) is not None:
            return first
    fastest = math.degrees(float(np.linalg.norm(rest.rate[0])))
    raise PlanningError(f"no path: from {fastest:.1f} deg/s on the body turns by too much in a step")


def _bettered(expected: Expected, motion: Motion, criterion: Criterion, price: float) -> Motion:
    """Return the best motion near a flown one at a price of torques along the field."""
    cost = _cost(expected, motion, criterion, price)
    enough = SAVED[price == PROHIBITIVE]
    for _ in range(SWEEPS):
        gains, before = _swept(expected, motion, criterion, price), cost
        for share in SHARES:
            tried = fly(expected, motion, gains, share)
            found = math.inf if tried is None else _cost(expected, tried, criterion, price)
            if tried is not None and found < cost:
                motion, cost = tried, found
                break
        if before - cost < enough * before:
            break
    return motion


def fly(expected: Expected, motion: Motion, gains: Gains, share: float) -> Motion | None:
    """Return the motion from the same begin with a share of the change that was found, and feedback.

    None where it runs away: far from `motion` the torques along the field, which have no limit, drive it out.
    """
    count, step = len(motion.control), expected.step
    quaternion, rate, flown = np.empty((count + 1, 4)), np.empty((count + 1, 3)), np.empty((count, 4))
    quaternion[0], rate[0] = q, w = motion.quaternion[0], motion.rate[0]
    changed = motion.control - share * gains.steady[:, :, 0]
    for k in range(count):
        turn = to_rotation_vector(multiply(q, conjugate(motion.quaternion[k])))
        u = changed[k] - gains.gain[k] @ np.concatenate([turn, w - motion.rate[k]])
        u[:3] = np.clip(u[:3], -expected.limit, expected.limit)
        middle = w + 0.5 * step * expected.acceleration(k, q, w, u)
        if not np.abs([w, middle]).max() < RUN_AWAY:  # nor is what is no number
            return None
        half = multiply(from_rotation_vector(0.5 * step * w), q)
        w = w + step * expected.acceleration(k, half, middle, u)
        q = multiply(from_rotation_vector(step * middle), q)
        quaternion[k + 1], rate[k + 1], flown[k] = q, w, u
    return Motion(quaternion, rate, flown) if np.abs(w).max() < RUN_AWAY else None


def _swept(
    expected: Expected, motion: Motion, criterion: Criterion, price: float, given: bool = False
) -> Gains:
    """Return the gains about a motion; one that is `given` takes torques that its controls do not make."""
    count, state, end = len(motion.control), criterion.state, criterion.end
    first = motion.references(expected.wanted.times).until(count)
    field = expected.field[:count]
    pressed, position = expected.pressed(count), expected.position[:count]
    linear = linearised(first, expected.inertia, field, position, motion.control[:, :3], pressed)
    strength = np.linalg.norm(linear.field, axis=1)
    along = linear.by_torque @ (linear.field / strength[:, None])[:, :, None]
    linear = replace(linear, by_control=np.concatenate([linear.by_control, along], axis=2))
    control = np.full((count, 4), criterion.dipole)
    control[:, 3] *= price / strength**2
    astray, bent = off(expected.wanted, motion), bends(expected.wanted, motion)
    turned = np.swapaxes(bent, 1, 2)
    columns = end.slope.shape[1]
    affine, state_slope = np.zeros((2, count, 6, columns))
    control_slope = np.zeros((count, 4, columns))
    affine[:, :, 1:] = linear.by_torque @ criterion.shape[:count]
    if given:
        missing = criterion.shape[:count] @ expected.sizes - linear.missing
        affine[:, :, 0] = np.einsum("nij,nj->ni", linear.by_torque, missing)
    else:
        state_slope[:, :, 0] = np.einsum("nij,nj->ni", turned[:-1] @ state, astray[:-1])
        control_slope[:, :, 0] = control * motion.control
    states = turned[:-1] @ state @ bent[:-1]
    steep, curved = _haste(motion.rate, criterion.fastest, expected.step)
    state_slope[:, 3:, 0] += steep[:-1]
    states[:, 3:, 3:] += curved[:-1]
    slope, square = turned[-1] @ end.slope, turned[-1] @ end.square @ bent[-1]
    slope[:, 0] += turned[-1] @ end.square @ astray[-1]
    slope[3:, 0] += steep[-1]
    square[3:, 3:] += curved[-1]
    last = ToGo(square, slope)
    cost = Cost(states, control, state_slope, control_slope)
    gain, steady, _ = sweep(linear, affine, cost, last)
    return Gains(gain, steady)


def _cost(expected: Expected, motion: Motion, criterion: Criterion, price: float) -> float:
    """Return what a motion costs, with the cost-to-go after it."""
    astray, end = off(expected.wanted, motion), criterion.end
    strength = np.linalg.norm(expected.field[:-1], axis=1)
    squares = np.einsum("ni,ij,nj->", astray[:-1], criterion.state, astray[:-1])
    squares += criterion.dipole * np.sum(motion.control[:, :3] ** 2)
    squares += criterion.dipole * price * np.sum((motion.control[:, 3] / strength) ** 2)
    excess = np.maximum(np.linalg.norm(motion.rate, axis=1) - criterion.fastest, 0.0)
    squares += expected.step * np.sum((excess / EXCESS) ** 2)
    return float(0.5 * squares + astray[-1] @ (0.5 * end.square @ astray[-1] + end.slope[:, 0]))


def _haste(rate: FloatArray, fastest: float, step: float) -> tuple[FloatArray, FloatArray]:
    """Return slope (n, 3) and curvature (n, 3, 3) of the price of rates (n, 3) beyond the largest."""
    speed = np.maximum(np.linalg.norm(rate, axis=1), 1e-9)
    along = rate / speed[:, None]
    excess, price = np.maximum(speed - fastest, 0.0), step / EXCESS**2
    outer = along[:, :, None] * along[:, None, :]
    curved = (excess > 0.0)[:, None, None] * outer
    curved = curved + (excess / speed)[:, None, None] * (np.eye(3) - outer)
    return price * excess[:, None] * along, price * curved


def off(wanted: References, motion: Motion) -> FloatArray:
    """Return the turn and the rate (n + 1, 6) of a motion against the law."""
    turn = to_rotation_vector(multiply(motion.quaternion, conjugate(wanted.quaternion)))
    return np.concatenate([turn, motion.rate - wanted.rate], axis=1)


def _counted(wanted: References, motion: Motion, criterion: Criterion) -> FloatArray:
    """Return the turn (n + 1,) rad against the law as it counts: one about a cheap axis by its price."""
    turn, price = off(wanted, motion)[:, :3], criterion.state[:3, :3]
    squares = np.einsum("ni,ij,nj->n", turn, price, turn)
    return np.asarray(np.sqrt(squares / np.linalg.eigvalsh(price)[-1]))


def bends(wanted: References, motion: Motion) -> FloatArray:
    """Return how the turn against the law changes with a small turn of the body, (n + 1, 6, 6).

    The inverse of the left Jacobian of the rotation group, with the signs of this house's quaternions.
    """
    turn = to_rotation_vector(multiply(motion.quaternion, conjugate(wanted.quaternion)))
    angle = np.linalg.norm(turn, axis=1)
    safe = np.where(angle < 1e-2, 1.0, angle)
    second = np.where(angle < 1e-2, 1.0 / 12.0, (1.0 - 0.5 * safe / np.tan(0.5 * safe)) / safe**2)
    across = cross_matrices(turn)
    bent = np.broadcast_to(np.eye(6), (len(turn), 6, 6)).copy()
    bent[:, :3, :3] += 0.5 * across + second[:, None, None] * (across @ across)
    return bent
