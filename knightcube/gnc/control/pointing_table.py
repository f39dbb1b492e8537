"""The table of the pointing law: the best motion over the revolution ahead, and gains along it.

The motion is found by multiple shooting, from linear-quadratic steps. Each step is shortened until it
improves a merit function, the cost plus the weighted defects (Nocedal & Wright 2006, Numerical Optimization,
algorithm 18.3). In contrast to the sweeps of `pointing_path`, the intermediate motions need not be feasible:
the state to which the equations of motion propagate each instant is compared with the next instant, and the
next step removes the defects (Bock & Plitt 1984, IFAC 9th World Congress). Errors therefore do not grow along
a revolution. This matters, because coils make no torque about the field, and the body may rotate far about
its pointing axis. A step takes 0.07 ms per instant. The motion is propagated by the midpoint rule, and the
derivatives are those of the discrete step. If a body rotates by degrees in a step, derivatives of the
continuous motion would end at motions that no step improves.

If no such motion is found, or the coils do not suffice for it, the table contains the best path of
`pointing_path`. After the end of this path the body follows the law; a sweep over a revolution of preview
gives the cost of an error at the end.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from knightcube.astro.arrays import FloatArray, cross_matrices
from knightcube.astro.earth.disturbance import AIR, LIGHT, Pressures, shapes
from knightcube.astro.quaternion import (
    attitude_matrix,
    conjugate,
    from_rotation_vector,
    multiply,
    to_rotation_vector,
)
from knightcube.errors import UsageError
from knightcube.gnc.control.pointing_path import (
    CostToGo,
    LinearErrorModel,
    MotionGains,
    PathConditions,
    PathCriterion,
    PlannedMotion,
    SweepCost,
    acceleration_slopes,
    best_path,
    error_jacobians,
    errors,
    linearised,
    sweep,
)
from knightcube.gnc.guidance.three_axes.attitude_law import AttitudeReferences
from knightcube.gnc.guidance.three_axes.slew_model import SlewPath

_TURN, _RATE, _DIPOLE, _TORQUE = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
_EYE: FloatArray = np.eye(3)


def midpoint_step(expected: PathConditions, motion: PlannedMotion) -> tuple[FloatArray, FloatArray]:
    """Return the attitudes (n, 4) and rates (n, 3) rad/s at the end of the steps."""
    step, count = expected.step, len(motion.control)
    half, middle = _halfway(expected, motion)
    there = multiply(from_rotation_vector(step * middle), motion.quaternion[:count])
    return there, motion.rate[:count] + step * expected.accelerations(half, middle, motion.control)


def defects(expected: PathConditions, motion: PlannedMotion) -> FloatArray:
    """Return the defects (n, 6): rotation and rate at the end of each step relative to the next instant."""
    there, speed = midpoint_step(expected, motion)
    turn = to_rotation_vector(multiply(there, conjugate(motion.quaternion[1:])))
    return np.concatenate([turn, speed - motion.rate[1:]], axis=1)


def derivative(expected: PathConditions, motion: PlannedMotion) -> LinearErrorModel:
    """Return the derivatives of the state after each step by the state before it, dipole and torque."""
    step, count = expected.step, len(motion.control)
    q, w, dipole = motion.quaternion[:count], motion.rate[:count], motion.control
    half, middle = _halfway(expected, motion)
    inverse, around = expected.inverse, (expected.inertia, expected.field[:count], expected.position[:count])
    pressed = expected.pressed(count)
    first, shown, _ = acceleration_slopes(q, w, *around, dipole, pressed)
    second, seen, _ = acceleration_slopes(half, middle, *around, dipole, pressed)

    initial = np.concatenate([first, _pushes(inverse, shown)], axis=2)
    rate = 0.5 * step * initial
    rate[:, :, _RATE] += _EYE
    turn = np.zeros((count, 3, 12))
    turn[:, :, _TURN] = attitude_matrix(from_rotation_vector(0.5 * step * w))
    turn[:, :, _RATE] = 0.5 * step * _rotation_jacobian(0.5 * step * w)
    change = np.empty((count, 6, 12))
    change[:, 3:] = step * (second[:, :, :3] @ turn + second[:, :, 3:] @ rate)
    change[:, 3:, 6:] += step * _pushes(inverse, seen)
    change[:, 3:, _RATE] += _EYE
    change[:, :3] = step * _rotation_jacobian(step * middle) @ rate
    change[:, :3, _TURN] += attitude_matrix(from_rotation_vector(step * middle))
    return LinearErrorModel(
        change[:, :, :6], change[:, :, _DIPOLE], change[:, :, _TORQUE], np.zeros((count, 3)), shown
    )


def _halfway(expected: PathConditions, motion: PlannedMotion) -> tuple[FloatArray, FloatArray]:
    """Return attitudes (n, 4) and rates (n, 3) in the middle of the steps."""
    step, count = expected.step, len(motion.control)
    q, w = motion.quaternion[:count], motion.rate[:count]
    middle = w + 0.5 * step * expected.accelerations(q, w, motion.control)
    return multiply(from_rotation_vector(0.5 * step * w), q), middle


def _pushes(inverse: FloatArray, shown: FloatArray) -> FloatArray:
    """Return the derivatives (n, 3, 6) of accelerations by dipole and torque in a field (n, 3), body axes."""
    return np.concatenate(
        [-inverse @ cross_matrices(shown), np.broadcast_to(inverse, (len(shown), 3, 3))], axis=2
    )


def _rotation_jacobian(vector: FloatArray) -> FloatArray:
    """Return the derivatives (n, 3, 3) of rotations by their rotation vectors (n, 3).

    They are the left Jacobian of the rotation group, for scalar-last quaternions that rotate inertial into
    body axes.
    """
    angle = np.linalg.norm(vector, axis=1)[:, None, None]
    safe = np.where(angle < 1e-2, 1.0, angle)
    one = np.where(angle < 1e-2, 0.5, (1.0 - np.cos(safe)) / safe**2)
    two = np.where(angle < 1e-2, 1.0 / 6.0, (safe - np.sin(safe)) / safe**3)
    across = cross_matrices(vector)
    return np.asarray(_EYE - one * across + two * across @ across)


STEPS = 40
"""Maximum number of steps of multiple shooting."""
FARTHEST = math.radians(30.0)
"""Largest rotation (rad) by a step at any instant; a longer step is scaled as a whole."""
HALVES = 6
"""Largest number of halvings of a step."""
DEARER = 1.2
"""Weight of the defects in the merit, as a multiple of the largest sensitivity of the cost to a defect."""
DONE = math.radians(0.05)
"""Largest rotation (rad) by a step after which the iteration ends. It also ends if a step improves the merit
by less than the fraction SAVED."""
SAVED = 1e-4
ENOUGH = 0.01
"""Largest weighted defects of an acceptable motion, relative to its cost plus one."""


@dataclass(frozen=True, slots=True, eq=False)
class _ShootingStep:
    """A full step of multiple shooting.

    Attributes:
        change: (n + 1, 6) change of rotation and rate.
        control: (n, 3) change of the dipole.
        gains: gains about the motion.
        linear: linear model about the motion.
        rotated: largest rotation by the step at any instant, rad.
        sensitivity: (6,) largest derivative of the cost by a defect at any instant.
    """

    change: FloatArray
    control: FloatArray
    gains: MotionGains
    linear: LinearErrorModel
    rotated: float
    sensitivity: FloatArray


def best_course(
    expected: PathConditions, initial: AttitudeReferences, state: FloatArray, dipole: float, fastest: float
) -> tuple[PlannedMotion, MotionGains] | None:
    """Return the best motion over all instants of `expected` from the start of `initial`, and its gains.

    `initial` (n + 1,) leads into the law and covers the part that will be flown; `state` (6, 6) and `dipole`
    are the costs of a step (`step_costs`). None if no motion is found within `STEPS`, if it needs more dipole
    than available, or if it rotates faster than `fastest` rad/s in the part that will be flown.
    """
    count, first = len(expected.field) - 1, len(initial.times)
    quaternion = np.concatenate([initial.quaternion, expected.wanted.quaternion[first:]])
    rate = np.concatenate([initial.rate, expected.wanted.rate[first:]])
    motion = PlannedMotion(quaternion, rate, np.zeros((count, 3)))
    criterion = _Merit(expected, state, dipole)
    for _ in range(STEPS):
        step = _direction(criterion, motion)
        if not step.rotated < math.inf:
            return None
        criterion.dear = np.maximum(criterion.dear, DEARER * step.sensitivity)
        before = sum(criterion.merit(motion))
        better = _better(criterion, motion, step, before)
        motion = motion if better is None else better
        cost, defect = criterion.merit(motion)
        kept = defect <= ENOUGH * (1.0 + cost)
        if better is None or (
            kept and (step.rotated < DONE or before - cost - defect < SAVED * (1.0 + before))
        ):
            break
    strongest = float(np.abs(motion.control).max())
    speed = float(np.linalg.norm(motion.rate[:first], axis=1).max())
    return (motion, step.gains) if kept and strongest <= expected.limit and speed <= fastest else None


@dataclass(eq=False)
class _Merit:
    """The merit function of a motion.

    `state` (6, 6) and `dipole` weight the errors and the dipole of a step, and `dear` (6,) the defects.
    """

    expected: PathConditions
    state: FloatArray
    dipole: float
    dear: FloatArray = field(default_factory=lambda: np.zeros(6))

    def merit(self, motion: PlannedMotion) -> tuple[float, float]:
        """Return the cost of a motion, and the weighted defects."""
        deviation = errors(self.expected.wanted, motion)
        squares = float(np.einsum("ni,ij,nj->", deviation, self.state, deviation))
        squares += self.dipole * float(np.sum(motion.control**2))
        return 0.5 * squares, float(self.dear @ np.abs(defects(self.expected, motion)).sum(axis=0))


def _direction(criterion: _Merit, motion: PlannedMotion) -> _ShootingStep:
    """Return the full linear-quadratic step from a motion, and the gains about it."""
    expected, state, dipole = criterion.expected, criterion.state, criterion.dipole
    count, wanted, sizes = len(motion.control), expected.wanted, expected.sizes
    shown = attitude_matrix(motion.quaternion[:count])
    linear = derivative(expected, motion)
    affine = np.zeros((count, 6, 1 + len(sizes)))
    affine[:, :, 0] = defects(expected, motion)
    affine[:, :, 1:] = linear.by_torque @ shapes(expected.pressures.until(count), shown)
    rotated, deviation = error_jacobians(wanted, motion), errors(wanted, motion)
    back = np.swapaxes(rotated, 1, 2)
    states, slopes = back @ state @ rotated, np.einsum("nij,nj->ni", back @ state, deviation)
    state_slope, control_slope = np.zeros(affine.shape), np.zeros((count, 3, affine.shape[2]))
    state_slope[:, :, 0], control_slope[:, :, 0] = slopes[:-1], dipole * motion.control
    end = np.zeros((6, affine.shape[2]))
    end[:, 0] = slopes[-1]
    cost = SweepCost(states[:-1], np.full((count, 3), dipole), state_slope, control_slope)
    gain, steady, _ = sweep(linear, affine, cost, CostToGo(states[-1], end))
    change, control = np.zeros((count + 1, 6)), np.empty((count, 3))
    for k in range(count):
        control[k] = -(gain[k] @ change[k] + steady[k, :, 0])
        change[k + 1] = linear.transition[k] @ change[k] + linear.by_control[k] @ control[k] + affine[k, :, 0]
    turns = np.linalg.norm(change[:, :3], axis=1)
    own = np.einsum("nij,nj->ni", states, change) + slopes
    sensitivity, most = own[-1], np.abs(own[-1])
    for k in range(count - 1, 0, -1):
        sensitivity = linear.transition[k].T @ sensitivity + own[k]
        most = np.maximum(most, np.abs(sensitivity))
    return _ShootingStep(change, control, MotionGains(gain, steady), linear, float(turns.max()), most)


def _better(
    criterion: _Merit, motion: PlannedMotion, step: _ShootingStep, before: float
) -> PlannedMotion | None:
    """Return the motion after the largest fraction of a step that improves the merit; None if none does."""
    share = min(1.0, FARTHEST / max(step.rotated, DONE))
    for _ in range(HALVES):
        moved = _moved(motion, share * step.change, share * step.control)
        if sum(criterion.merit(moved)) < before:
            return moved
        closed = _closed(criterion.expected, moved, step)
        if sum(criterion.merit(closed)) < before:
            return closed
        share *= 0.5
    return None


def _closed(expected: PathConditions, moved: PlannedMotion, step: _ShootingStep) -> PlannedMotion:
    """Return a motion with smaller defects: a second-order correction after a step."""
    defect, gain = defects(expected, moved), step.gains.gain
    change, control = np.zeros((len(gain) + 1, 6)), np.empty((len(gain), 3))
    transition, push = step.linear.transition, step.linear.by_control
    for k in range(len(gain)):
        control[k] = -gain[k] @ change[k]
        change[k + 1] = transition[k] @ change[k] + push[k] @ control[k] + defect[k]
    return _moved(moved, change, control)


def _moved(motion: PlannedMotion, change: FloatArray, control: FloatArray) -> PlannedMotion:
    """Return a motion changed by (n + 1, 6) in rotation and rate and by (n, 3) in its dipole."""
    rotated = multiply(from_rotation_vector(change[:, :3]), motion.quaternion)
    return PlannedMotion(rotated, motion.rate + change[:, 3:], motion.control + control)


LEAST_PART = 1.0 / 3.0
"""Minimum fraction of a table that may be flown alone; the previous table is kept if the flyable part is
shorter."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PointingWeights:
    """Weights of the errors. Each attribute is the value of an error that has a cost of one.

    Attributes:
        turn: rad, rotation error about each axis.
        rate: rad/s, rate error of each axis.
        dipole: A m^2, dipole of each axis.
        fastest: rad/s, rate above which the cost increases steeply, while the body approaches the law
            (`pointing_path.EXCESS`).
        roll: rad, rotation error about the unit vector `axis` (3,), if this rotation has a smaller weight
            than others.
    """

    turn: float
    rate: float
    dipole: float
    fastest: float = math.inf
    roll: float | None = None
    axis: FloatArray | None = None


@dataclass(frozen=True, slots=True, eq=False)
class PointingTable:
    """A path and gains at n equally spaced instants.

    Attributes:
        path: planned motion of the body, n + 1 instants.
        wanted: motion that the attitude law commands, n + 1 instants.
        dipole: (n, 3) A m^2, feedforward dipole of the path, held until the next instant.
        gain: (n, 3, 6) feedback gains K, in A m^2 per rad and per rad/s.
        torque_part: (n, 3, sizes) A m^2/(N m), change of the dipole per change of the disturbance sizes from
            `sizes`.
        sizes: (sizes,) N m, sizes of the disturbance torques with which the path was planned.
        slew: the slew that the path begins with, if any; its times count from the start of the path.
    """

    path: AttitudeReferences
    wanted: AttitudeReferences
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
        """Return the part before the body reaches `fastest` rad/s, None if it is shorter than `LEAST_PART`.

        A slew is flown as a whole or not at all.
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
class PointingPreview:
    """The commanded motion and the predicted environment at the m instants of path and preview.

    Attributes:
        wanted: the law.
        initial: a motion (n + 1,) from the body's attitude and rate into the law; it need not be feasible
            with coils.
        field, position: (m, 3) T and m, ICRS.
        pressures: (m,) pressures of air and sunlight.
        sizes: (9,) N m, present estimates of the disturbance sizes.
    """

    wanted: AttitudeReferences
    initial: AttitudeReferences
    field: FloatArray
    position: FloatArray
    pressures: Pressures
    sizes: FloatArray


def pointing_table(
    ahead: PointingPreview, inertia: FloatArray, limit: float, weights: PointingWeights
) -> PointingTable:
    """Return the table from the start of `ahead.initial` to its end.

    `inertia` (3, 3) is in kg m^2, and `limit` is the dipole limit of each coil in A m^2. The preview should
    last a revolution. Raises UsageError for times that are not equally spaced.
    """
    steps = np.diff(ahead.wanted.times)
    count = len(ahead.initial.times) - 1
    if count < 2 or len(steps) <= count or not np.allclose(steps, steps[0], rtol=1e-6):
        raise UsageError(
            "a pointing table needs three or more equally spaced times and a preview beyond them"
        )
    dt = float(steps[0])
    state, dipole = step_costs(weights, dt)
    shape = shapes(ahead.pressures, attitude_matrix(ahead.wanted.quaternion))
    inverse = np.asarray(np.linalg.inv(inertia))
    whole = PathConditions(
        ahead.wanted, ahead.field, ahead.position, ahead.pressures, ahead.sizes, inertia, inverse, limit
    )
    course = best_course(whole, ahead.initial, state, dipole, weights.fastest)
    if course is None:
        beyond = _beyond(ahead, count, inertia, state, dipole, shape)
        criterion = PathCriterion(state, dipole, beyond, shape, weights.fastest)
        course = best_path(whole.until(count + 1), ahead.initial, criterion)
    motion, gains = course
    path = motion.references(ahead.wanted.times[: len(motion.rate)]).until(count + 1)
    wanted = ahead.wanted.until(count + 1)
    gain, torque_part = gains.gain[:count, :3], gains.steady[:count, :3, 1:]
    return PointingTable(path, wanted, motion.control[:count, :3], gain, torque_part, ahead.sizes)


def step_costs(weights: PointingWeights, dt: float) -> tuple[FloatArray, float]:
    """Return the weights of a step of `dt` s: (6, 6) of rotation and rate errors, and one of the dipole."""
    state = dt * np.diag(np.repeat([weights.turn**-2.0, weights.rate**-2.0], 3))
    if weights.roll is not None and weights.axis is not None:
        state[:3, :3] -= dt * (weights.turn**-2.0 - weights.roll**-2.0) * np.outer(weights.axis, weights.axis)
    return state, dt * weights.dipole**-2.0


def _beyond(
    ahead: PointingPreview,
    begin: int,
    inertia: FloatArray,
    state: FloatArray,
    dipole: float,
    shape: FloatArray,
) -> CostToGo:
    """Return the cost-to-go of following the law from instant `begin` on.

    Column 0 is for the expected torques.
    """
    air, light = ahead.pressures.air[begin:], ahead.pressures.light[begin:]
    pressed = [(ahead.sizes[AIR], air), (ahead.sizes[LIGHT], light)]
    field, position = ahead.field[begin:], ahead.position[begin:]
    law = linearised(ahead.wanted.since(begin), inertia, field, position, pressed=pressed)
    by_size = law.by_torque @ shape[begin:]
    own = by_size @ ahead.sizes - np.einsum("nij,nj->ni", law.by_torque, law.missing)
    affine = np.concatenate([own[:, :, None], by_size], axis=2)
    nothing = np.zeros(affine.shape)
    states = np.broadcast_to(state, (len(affine), 6, 6))
    cost = SweepCost(states, np.full((len(affine), 3), dipole), nothing, nothing[:, :3])
    return sweep(law, affine, cost, CostToGo(state, nothing[0]))[2]
