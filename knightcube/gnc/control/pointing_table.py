"""The table of the pointing law, with the best motion over the next revolution and feedback gains.

The motion is found by multiple shooting with linear-quadratic steps. Each step is shortened until the step
improves a merit function, the cost plus the weighted defects (Nocedal & Wright 2006, Numerical Optimization,
algorithm 18.3). In contrast to the sweeps of `pointing_path`, the intermediate motions of multiple shooting
need not obey the equations of motion. The defect of a time step is the difference between the propagated
state at the end of the step and the state at the next instant. The defects of all steps converge to zero
during the iterations (Bock & Plitt 1984, IFAC 9th World Congress). Multiple shooting prevents errors from
growing along a revolution of the orbit. If a single motion were propagated over the revolution, errors could
grow, because coils cause no torque about the field and the body may rotate by a large angle about the
pointing axis. An iteration of multiple shooting takes 0.07 ms per instant. The motion is propagated by the
midpoint rule, and the derivatives are the exact derivatives of the midpoint rule. With derivatives of the
continuous motion, the iteration would stall for bodies that rotate by degrees per time step.

If multiple shooting fails or the motion exceeds the limit of the coils, the table contains the best path of
the module `pointing_path` instead. The cost of an error at the end of the path is computed by a backward
Riccati sweep along the attitude law over one more revolution.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from knightcube.astro.arrays import (
    FloatArray,
    brief,
    checked_number,
    cross_matrices,
    real_number,
    unit_vector,
)
from knightcube.astro.earth.disturbance import AIR, LIGHT, Pressures, shapes
from knightcube.astro.quaternion import (
    attitude_matrix,
    conjugate,
    from_rotation_vector,
    multiply,
    to_rotation_vector,
)
from knightcube.errors import ArgumentError, UsageError
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
from knightcube.gnc.guidance.attitude_law import AttitudeReferences
from knightcube.gnc.guidance.slew_model import SlewPath

_TURN, _RATE, _DIPOLE, _TORQUE = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
_EYE: FloatArray = np.eye(3)


def midpoint_step(expected: PathConditions, motion: PlannedMotion) -> tuple[FloatArray, FloatArray]:
    """Return the attitudes (n, 4) and rates (n, 3), rad/s, at the end of each propagated step."""
    step, count = expected.step, len(motion.control)
    half, middle = _halfway(expected, motion)
    there = multiply(from_rotation_vector(step * middle), motion.quaternion[:count])
    return there, motion.rate[:count] + step * expected.accelerations(half, middle, motion.control)


def defects(expected: PathConditions, motion: PlannedMotion) -> FloatArray:
    """Return the defects (n, 6): rotation and rate of the propagated state relative to the next state."""
    there, speed = midpoint_step(expected, motion)
    turn = to_rotation_vector(multiply(there, conjugate(motion.quaternion[1:])))
    return np.concatenate([turn, speed - motion.rate[1:]], axis=1)


def derivative(expected: PathConditions, motion: PlannedMotion) -> LinearErrorModel:
    """Return the derivatives of each step's last state with respect to its first state, dipole and torque."""
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
    """Return the derivatives (n, 3, 6) of angular accelerations with respect to dipole and torque."""
    return np.concatenate(
        [-inverse @ cross_matrices(shown), np.broadcast_to(inverse, (len(shown), 3, 3))], axis=2
    )


def _rotation_jacobian(vector: FloatArray) -> FloatArray:
    """Return the left Jacobians (n, 3, 3) of rotations with respect to the rotation vectors (n, 3)."""
    angle = np.linalg.norm(vector, axis=1)[:, None, None]
    safe = np.where(angle < 1e-2, 1.0, angle)
    one = np.where(angle < 1e-2, 0.5, (1.0 - np.cos(safe)) / safe**2)
    two = np.where(angle < 1e-2, 1.0 / 6.0, (safe - np.sin(safe)) / safe**3)
    across = cross_matrices(vector)
    return np.asarray(_EYE - one * across + two * across @ across)


STEPS = 40
"""Maximum number of iterations of multiple shooting."""
FARTHEST = math.radians(30.0)
"""Largest rotation (rad) by which an iteration changes an attitude; larger changes are scaled down."""
HALVES = 6
"""Largest number of times that a step is halved in the line search."""
DEARER = 1.2
"""Weight of the defects in the merit function, divided by the largest derivative of the cost with respect to
a defect."""
DONE = math.radians(0.05)
"""Multiple shooting ends if an iteration rotates all attitudes by less than this angle (rad). Multiple
shooting also ends if an iteration reduces the merit function by less than the fraction `SAVED`."""
SAVED = 1e-4
ENOUGH = 0.01
"""Largest accepted sum of a motion's weighted defects, divided by one plus the cost of the motion."""


@dataclass(frozen=True, slots=True, eq=False)
class _ShootingStep:
    """A full step of multiple shooting (a linear-quadratic Newton step).

    Attributes:
        change: change (n + 1, 6) of rotation and rate.
        control: change (n, 3) of the dipole moment, A m^2.
        gains: feedback gains for the motion from which the step starts.
        linear: linear error model for the motion from which the step starts.
        rotated: largest rotation of any attitude by the step, rad.
        sensitivity: largest derivative (6,) of the cost with respect to a defect at any instant.
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
    """Return the best motion over all instants from the first state of `initial`, with feedback gains.

    The initial guess `initial` (n + 1,) ends on the attitude law and covers the duration of the table. The
    weights `state` (6, 6) of the errors and `dipole` of the dipole moment are computed by `step_costs`.
    Returns None if no motion is found within `STEPS` iterations or if the motion exceeds the limit of the
    coils. The result is also None if the body rotates faster than `fastest` (rad/s).
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
    strongest = np.abs(motion.control).max(axis=0)
    within = bool((strongest <= expected.limit).all())
    speed = float(np.linalg.norm(motion.rate[:first], axis=1).max())
    return (motion, step.gains) if kept and within and speed <= fastest else None


@dataclass(eq=False)
class _Merit:
    """The merit function for the comparison of motions: the cost plus the weighted defects.

    The weights of a step are `state` (6, 6) for the errors, `dipole` for the dipole moment and `dear` (6,)
    for the defects.
    """

    expected: PathConditions
    state: FloatArray
    dipole: float
    dear: FloatArray = field(default_factory=lambda: np.zeros(6))

    def merit(self, motion: PlannedMotion) -> tuple[float, float]:
        """Return the cost of a motion and the sum of the weighted defects."""
        deviation = errors(self.expected.wanted, motion)
        squares = float(np.einsum("ni,ij,nj->", deviation, self.state, deviation))
        squares += self.dipole * float(np.sum(motion.control**2))
        return 0.5 * squares, float(self.dear @ np.abs(defects(self.expected, motion)).sum(axis=0))


def _direction(criterion: _Merit, motion: PlannedMotion) -> _ShootingStep:
    """Return the full linear-quadratic Newton step from a motion, before any shortening."""
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
    """Return the motion after the largest tried fraction of a step that reduces the merit, or None."""
    share = min(1.0, FARTHEST / max(step.rotated, DONE))
    for _ in range(HALVES):
        moved = _moved(motion, share * step.change, share * step.control)
        if sum(criterion.merit(moved)) < before:
            return moved
        # A second-order correction after the step makes the defects smaller.
        defect, gain = defects(criterion.expected, moved), step.gains.gain
        change, control = np.zeros((len(gain) + 1, 6)), np.empty((len(gain), 3))
        transition, push = step.linear.transition, step.linear.by_control
        for k in range(len(gain)):
            control[k] = -gain[k] @ change[k]
            change[k + 1] = transition[k] @ change[k] + push[k] @ control[k] + defect[k]
        closed = _moved(moved, change, control)
        if sum(criterion.merit(closed)) < before:
            return closed
        share *= 0.5
    return None


def _moved(motion: PlannedMotion, change: FloatArray, control: FloatArray) -> PlannedMotion:
    """Return a motion with rotation and rate changed by `change` and the dipole moment by `control`."""
    rotated = multiply(from_rotation_vector(change[:, :3]), motion.quaternion)
    return PlannedMotion(rotated, motion.rate + change[:, 3:], motion.control + control)


LEAST_PART = 1.0 / 3.0
"""Minimum usable fraction of a new table. A table of which only the beginning is usable is followed if the
usable part is at least this fraction of the table. Otherwise the previous table is kept."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PointingWeights:
    """Weights of errors and dipole moment, each given as the magnitude that has a cost of one.

    Attributes:
        turn: rotation error about one axis, rad.
        rate: rate error about one axis, rad/s.
        dipole: dipole moment along one axis, A m^2.
        fastest: rate above which the cost increases steeply while the body approaches the attitude law (see
            `pointing_path.EXCESS`), rad/s.
        roll: rotation error about the unit vector `axis` (3,), rad, or None if all axes have the same cost.
    """

    turn: float
    rate: float
    dipole: float
    fastest: float = math.inf
    roll: float | None = None
    axis: FloatArray | None = None

    def __post_init__(self) -> None:
        """Raise ArgumentError for a weight that is not positive, and for a missing or impossible axis."""
        for name, unit in (("turn", "rad"), ("rate", "rad/s"), ("dipole", "A m^2")):
            checked_number(name, getattr(self, name), unit)
        if not real_number(self.fastest) > 0.0:
            raise ArgumentError("fastest", f"{brief(self.fastest)}: give a rate above zero, in rad/s")
        if self.axis is not None:
            object.__setattr__(self, "axis", unit_vector("axis", self.axis))
        if self.roll is not None:
            checked_number("roll", self.roll, "rad")
            if self.axis is None:
                raise ArgumentError("axis", "None: give the body axis (3,) about which `roll` is measured")


@dataclass(frozen=True, slots=True, eq=False)
class PointingTable:
    """A planned motion with feedback gains at n equally spaced instants.

    Attributes:
        path: planned motion of the body at n + 1 instants.
        wanted: motion commanded by the attitude law at n + 1 instants.
        dipole: feedforward dipole moment (n, 3), held until the next instant, A m^2.
        gain: feedback gains K (n, 3, 6), in A m^2 per rad and per rad/s.
        torque_part: change of the dipole moment (n, 3, 9) per disturbance torque component, A m^2/(N m).
        sizes: components (9,) of the disturbance torques with which the path was planned, N m.
        slew: slew path at the start of the table, with times from the start of the path, or None.
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
        """The largest body rate along the path, rad/s."""
        return float(np.linalg.norm(self.path.rate, axis=1).max())

    def below(self, fastest: float) -> PointingTable | None:
        """Return the part of the table that ends before the body rate reaches `fastest`, rad/s.

        Returns None if this part is shorter than the fraction `LEAST_PART` of the table.

        A table with a slew is never shortened, so the result is the complete table or None.
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
        wanted: motion commanded by the attitude law.
        initial: initial guess (n + 1,) of the motion from the body's state to the attitude law.
        field, position: magnetic field (T) and position (m), each (m, 3), ICRS.
        pressures: pressure vectors of air and sunlight at the m instants.
        sizes: presently estimated components (9,) of the disturbance torques, N m.
    """

    wanted: AttitudeReferences
    initial: AttitudeReferences
    field: FloatArray
    position: FloatArray
    pressures: Pressures
    sizes: FloatArray


def pointing_table(
    ahead: PointingPreview, inertia: FloatArray, limit: float | FloatArray, weights: PointingWeights
) -> PointingTable:
    """Return the pointing table for the instants of `ahead.initial`.

    The inertia tensor `inertia` (3, 3) is in kg m^2. The dipole `limit` along each body axis, in A m^2, is
    equal for all axes or has shape (3,). The preview after the table should cover one revolution of the
    orbit. Raises UsageError for times that are not equally spaced.
    """
    steps = np.diff(ahead.wanted.times)
    count = len(ahead.initial.times) - 1
    if count < 2 or len(steps) <= count or not np.allclose(steps, steps[0], rtol=1e-6):
        raise UsageError(
            "a pointing table needs at least three equally spaced times, and predictions beyond the last time"
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
    """Return the weights (6, 6) of the errors and the weight of the dipole moment in a step of `dt` s."""
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
    """Return the cost-to-go of following the attitude law from the instant with index `begin` on.

    The first column of the linear part belongs to the attitude law and the expected torques.
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
