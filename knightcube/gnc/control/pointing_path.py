"""The optimal motion of a body from the present attitude to an attitude law, by linear-quadratic sweeps.

The errors x of the body relative to a reference motion are a small rotation and a rate error, both in the
axes of the reference motion. With the predicted field b(t) in the axes of the reference motion, the errors
obey the linear equations

    turn' = rate - w_r x turn,    J rate' = ([J w_r x] - [w_r x] J) rate + G turn + m x b - f.

The matrix G is the stiffness of the gravity gradient, and f is the torque that the reference motion requires
in addition to the modelled torques. Riccati's equation is integrated backwards for the cost-to-go x^T S x / 2
+ s^T x (Psiaki 2001, Journal of Guidance, Control, and Dynamics 24(2)). The affine part s of the cost-to-go,
which anticipates future torques, is an extension of Psiaki's method. The dipole moment m = -(K x + k) is
constant during a step. The affine part of the error model has one column for each source of errors. The
control offset k is linear in the affine part of the error model and has the same columns. A linear-quadratic
sweep also supports controls other than the dipole moment.

The path minimises the squared rotation error relative to the attitude law plus the squared dipole moment, in
the predicted field and torques. The path obeys the full equations of motion and the limit of the coils. The
path is found by iterative linear-quadratic sweeps (Li & Todorov 2004, ICINCO, and Tassa, Erez & Todorov 2012,
IROS). Each sweep linearises the equations of motion about the last motion and simulates the corrected motion.
Because coils cause no torque along the field, the first iterations from a large error would lead to tumbling
motions. The first sweeps therefore allow a torque along the field, at a cost that is increased until this
torque vanishes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from knightcube.astro.arrays import FloatArray, cross_matrices
from knightcube.astro.earth.disturbance import AIR, LIGHT, Pressures, shapes
from knightcube.astro.earth.figure import GRAVITATIONAL_PARAMETER
from knightcube.astro.quaternion import (
    attitude_matrix,
    conjugate,
    from_rotation_vector,
    multiply,
    to_rotation_vector,
)
from knightcube.compiled import compiled_form_of, loop_helper
from knightcube.errors import PlanningError
from knightcube.gnc.guidance.attitude_law import AttitudeReferences

_EYE3: FloatArray = np.eye(3)
_EYE6: FloatArray = np.eye(6)


@dataclass(frozen=True, slots=True, eq=False)
class LinearErrorModel:
    """The linear model of the attitude and rate errors over n steps.

    Attributes:
        transition: transition matrices (n, 6, 6) of the errors.
        by_control: change of the errors (n, 6, controls) per unit of each control, such as A m^2.
        by_torque: change of the errors (n, 6, 3) per N m of torque in each axis.
        missing: torque f (n, 3) that the reference motion needs in addition to the modelled torques, N m.
        field: magnetic field (n, 3) in the axes of the reference motion, T.
    """

    transition: FloatArray
    by_control: FloatArray
    by_torque: FloatArray
    missing: FloatArray
    field: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class SweepCost:
    """The costs of n steps: x^T state x / 2 + state_slope^T x + control u^2 / 2 + control_slope^T u.

    The vector x contains the attitude and rate errors, and u the controls.

    Attributes:
        state: quadratic weights (n, 6, 6) of the errors.
        control: quadratic weights (n, controls) of the controls.
        state_slope, control_slope: linear weights of the errors (n, 6, columns) and of the controls (n,
            controls, columns). Each column of the linear weights belongs to one source of errors.
    """

    state: FloatArray
    control: FloatArray
    state_slope: FloatArray
    control_slope: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class CostToGo:
    """The cost-to-go with a quadratic part `square` (6, 6) and a linear part `slope` (6, columns)."""

    square: FloatArray
    slope: FloatArray


def linearised(
    references: AttitudeReferences,
    inertia: FloatArray,
    field: FloatArray,
    position: FloatArray,
    dipole: FloatArray | None = None,
    pressed: Sequence[tuple[FloatArray, FloatArray]] = (),
) -> LinearErrorModel:
    """Return the linear model of the errors relative to a reference motion.

    The magnetic field (n, 3), T, and the position (n, 3), m, are in ICRS axes. The dipole moment `dipole` (n,
    3), A m^2, is fixed in body axes, so the torque of this dipole depends on the rotation error. Each element
    of `pressed` describes an aerodynamic or solar radiation torque. The torque (N m) is the cross product of
    its first part, a vector (3,) in body axes, and its second part, pressure directions (n, 3) in ICRS axes.
    """
    rate, inverse = references.rate, np.linalg.inv(inertia)
    slopes, shown, up = acceleration_slopes(
        references.quaternion, rate, inertia, field, position, dipole, pressed
    )
    flow = np.zeros((len(rate), 6, 6))
    flow[:, :3, :3], flow[:, :3, 3:], flow[:, 3:] = -cross_matrices(rate), _EYE3, slopes
    dt = float(references.times[1] - references.times[0])
    # Transition matrices exp(F dt) and their integrals are computed to third order in dt.
    first = flow * dt
    second = first @ first
    transition = _EYE6 + first + 0.5 * second + first @ second / 6.0
    integral = dt * (_EYE6 + 0.5 * first + second / 6.0)
    by_torque = integral[:, :, 3:] @ inverse
    momentum = rate @ inertia.T
    missing = references.acceleration @ inertia.T + np.cross(rate, momentum) - _gradient(inertia, up)[0]
    return LinearErrorModel(transition, -by_torque @ cross_matrices(shown), by_torque, missing, shown)


def acceleration_slopes(
    quaternion: FloatArray,
    rate: FloatArray,
    inertia: FloatArray,
    field: FloatArray,
    position: FloatArray,
    dipole: FloatArray | None = None,
    pressed: Sequence[tuple[FloatArray, FloatArray]] = (),
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the derivatives (n, 3, 6) of angular accelerations with respect to rotation and rate.

    The second and third results are the magnetic field and the position (n, 3) in body axes. The motion has
    attitudes (n, 4) and rates (n, 3) rad/s. The remaining arguments are those of the function `linearised`.
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


def sweep(
    linear: LinearErrorModel, affine: FloatArray, cost: SweepCost, end: CostToGo
) -> tuple[FloatArray, FloatArray, CostToGo]:
    """Return the feedback gains K (n, controls, 6), the affine parts k, and the cost-to-go at the start.

    The affine part k of the controls has the shape (n, controls, columns). The affine part of the error model
    is `affine` (n, 6, columns), and `end` is the cost-to-go after the last step.
    """
    # The matrices that multiply the errors, and the affine parts, are concatenated to save operations.
    ahead = np.concatenate([linear.transition, affine], axis=2)
    weights = np.concatenate([cost.state, cost.state_slope], axis=2)
    # numba compiles the function again for arrays that are not contiguous.
    others = linear.by_control, weights, cost.control, cost.control_slope, end.square, end.slope
    feedback, square, slope, is_singular = _riccati(ahead, *map(np.ascontiguousarray, others))
    if is_singular:
        raise np.linalg.LinAlgError("the costs of the controls are singular")
    return feedback[:, :, :6], feedback[:, :, 6:], CostToGo(square, slope)


def _riccati_numpy(
    ahead: FloatArray,
    by_control: FloatArray,
    weights: FloatArray,
    control: FloatArray,
    control_slope: FloatArray,
    square: FloatArray,
    slope: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, bool]:
    """Return feedback matrices, the cost-to-go at the start, and whether the costs are singular.

    For each step, `ahead` (n, 6, 6 + columns) contains the transition matrix and the affine part of the error
    model, and `weights`, of the same shape, contains the quadratic and the linear weights of the errors. The
    feedback matrices have the shape (n, controls, 6 + columns). See `sweep`.
    """
    from scipy.linalg.lapack import dgesv  # noqa: PLC0415 - only the worker that plans needs scipy

    count, controls = control.shape
    feedback = np.empty((count, controls, ahead.shape[2]))
    for k in range(count - 1, -1, -1):
        push, drive = by_control[k], ahead[k, :, :6]
        spread = push.T @ (square @ push)
        spread.reshape(-1)[:: controls + 1] += control[k]
        later = square @ ahead[k]
        later[:, 6:] += slope
        sides = push.T @ later
        sides[:, 6:] += control_slope[k]
        *_, feedback[k], singular = dgesv(spread, sides)  # numpy.linalg.solve is slower for small matrices
        if singular:
            return feedback, square, slope, True
        found = drive.T @ later - sides[:, :6].T @ feedback[k] + weights[k]
        square, slope = 0.5 * (found[:, :6] + found[:, :6].T), found[:, 6:]
    return feedback, square, slope, False


@loop_helper
def _product(one: FloatArray, other: FloatArray, columns: int) -> FloatArray:
    """Return `one[:, :columns].T @ other` (columns, k) for matrices `one` (m, n) and `other` (m, k)."""
    result = np.zeros((columns, other.shape[1]))
    for m in range(len(one)):
        for i in range(columns):
            for j in range(other.shape[1]):
                result[i, j] += one[m, i] * other[m, j]
    return result


@loop_helper
def _add(matrix: FloatArray, other: FloatArray) -> None:
    """Add `other` (n, k) to the last columns of a matrix (n, m)."""
    first = matrix.shape[1] - other.shape[1]
    for i in range(len(other)):
        for j in range(other.shape[1]):
            matrix[i, first + j] += other[i, j]


@loop_helper
def _eliminated(matrix: FloatArray, sides: FloatArray) -> bool:
    """Replace `sides` (n, k) by the solution of linear equations, unless the matrix (n, n) is singular.

    Returns whether the matrix is singular. The matrix is positive definite, so elimination needs no pivots.
    """
    size = len(matrix)
    for pivot in range(size):
        if matrix[pivot, pivot] == 0.0:
            return True
        for row in range(size):
            if row != pivot:
                factor = matrix[row, pivot] / matrix[pivot, pivot]
                for j in range(pivot, size):
                    matrix[row, j] -= factor * matrix[pivot, j]
                for j in range(sides.shape[1]):
                    sides[row, j] -= factor * sides[pivot, j]
    for row in range(size):
        for j in range(sides.shape[1]):
            sides[row, j] /= matrix[row, row]
    return False


@compiled_form_of(_riccati_numpy)
def _riccati(
    ahead: FloatArray,
    by_control: FloatArray,
    weights: FloatArray,
    control: FloatArray,
    control_slope: FloatArray,
    square: FloatArray,
    slope: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, bool]:
    """See `_riccati_numpy`."""
    count, controls = control.shape
    feedback = np.empty((count, controls, ahead.shape[2]))
    square, slope = square.copy(), slope.copy()
    for k in range(count - 1, -1, -1):
        push, gain = by_control[k], feedback[k]
        spread, later = _product(push, _product(square, push, 6), controls), _product(square, ahead[k], 6)
        _add(later, slope)
        sides = _product(push, later, controls)
        _add(sides, control_slope[k])
        for i in range(controls):
            spread[i, i] += control[k, i]
            for j in range(gain.shape[1]):
                gain[i, j] = sides[i, j]
        if _eliminated(spread, gain):
            return feedback, square, slope, True
        found, reduced = _product(ahead[k], later, 6), _product(sides, gain, 6)
        _add(found, weights[k])
        for i in range(6):
            for j in range(gain.shape[1]):
                found[i, j] -= reduced[i, j]
        for i in range(6):
            for j in range(6):
                square[i, j] = 0.5 * (found[i, j] + found[j, i])
            for j in range(slope.shape[1]):
                slope[i, j] = found[i, 6 + j]
    return feedback, square, slope, False


def _gradient(inertia: FloatArray, up: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the gravity gradient torque (n, 3) at `up` (n, 3), m, and its derivatives (n, 3, 3)."""
    radius = np.linalg.norm(up, axis=1)
    down = -up / radius[:, None]
    strength = 3.0 * GRAVITATIONAL_PARAMETER / radius**3
    stiff = down @ inertia.T
    crossed = cross_matrices(down)
    stiffness = strength[:, None, None] * ((crossed @ inertia - cross_matrices(stiff)) @ crossed)
    return strength[:, None] * np.cross(down, stiff), stiffness


RISES = (4.0, 2.0, 10.0)
"""Factors by which the cost of a torque along the field is increased from stage to stage. Each factor is
tried until a path settles on the attitude law, because different factors lead to different optima."""
DEAR, PROHIBITIVE = 1e4, 1e6
"""Ratios of the cost of a torque along the field to the cost of the same torque across the field. The cost of
a torque along the field is increased up to DEAR, and the last sweeps use the cost PROHIBITIVE."""
SETTLED = math.radians(20.0)
"""Largest rotation error (rad) in the second half of a path that counts as settled."""
SWEEPS = 8
"""Largest number of linear-quadratic sweeps before the cost of a torque along the field is increased. After
this number of sweeps, the best motion is used even if the sweeps have not converged."""
SAVED = (0.05, 2e-3)
"""Relative reductions of the total cost by a sweep below which a stage ends. If a sweep improves the total
cost by less than the first value, the next stage begins, with an increased cost of a torque along the field.
In the last stage, which has the cost `PROHIBITIVE`, the second value replaces the first value."""
NEAR = math.radians(10.0)
"""Angle (rad) between the first motion and the attitude law, up to which the linear-quadratic sweeps converge
without an auxiliary torque along the field."""
EXCESS = 3e-5
"""Excess (rad/s) of the body rate over the rate limit that has a cost of one."""
SHARES = (1.0, 0.4, 0.15)
"""Fractions of the change computed by a sweep, in the order in which the line search tries them."""
RUN_AWAY = 100.0
"""Rate (rad/s) above which a diverging motion is not propagated further."""


@dataclass(frozen=True, eq=False)
class PathConditions:
    """The commanded motion and the predicted environment at the n + 1 instants of a path.

    Attributes:
        wanted: motion commanded by the attitude law.
        field, position: magnetic field (T) and position (m), each (n + 1, 3), ICRS.
        pressures: pressure vectors of air and sunlight, to which the torques are proportional.
        sizes: estimated components (9,) of the disturbance torques, N m.
        inertia, inverse: inertia tensor (3, 3) in body axes, kg m^2, and the inverse of this tensor.
        limit: dipole limit (A m^2) along each body axis, one number for all axes or an array (3,).
    """

    wanted: AttitudeReferences
    field: FloatArray
    position: FloatArray
    pressures: Pressures
    sizes: FloatArray
    inertia: FloatArray
    inverse: FloatArray
    limit: float | FloatArray

    @cached_property
    def around(self) -> FloatArray:
        """Field, position, and pressure vectors of air and sunlight as an array (n + 1, 4, 3)."""
        around = np.empty((len(self.field), 4, 3))
        around[:, 0], around[:, 1] = self.field, self.position
        around[:, 2], around[:, 3] = self.pressures.air, self.pressures.light
        return around

    @cached_property
    def twice(self) -> FloatArray:
        """Block-diagonal matrix (6, 6) with the inertia tensor twice, to multiply two vectors at once."""
        found: FloatArray = np.zeros((6, 6))
        found[:3, :3] = found[3:, 3:] = self.inertia
        return found

    def pressed(self, count: int) -> list[tuple[FloatArray, FloatArray]]:
        """Return aerodynamic and solar radiation torques at `count` instants, as needed by `linearised`."""
        air, light = self.pressures.air[:count], self.pressures.light[:count]
        return [(self.sizes[AIR], air), (self.sizes[LIGHT], light)]

    def until(self, count: int) -> PathConditions:
        """Return these conditions at the first `count` instants."""
        field, position, pressures = self.field[:count], self.position[:count], self.pressures.until(count)
        return replace(
            self, wanted=self.wanted.until(count), field=field, position=position, pressures=pressures
        )

    @property
    def step(self) -> float:
        """The time between two instants of the path, s."""
        return float(self.wanted.times[1] - self.wanted.times[0])

    def acceleration(
        self, k: int, quaternion: FloatArray, rate: FloatArray, control: FloatArray
    ) -> FloatArray:
        """Return the angular acceleration (3,) at an attitude (4,) after instant k under a control (4,)."""
        seen = self.around[k] @ attitude_matrix(quaternion).T
        # Python floats are used because they are several times as fast as arrays of three elements.
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
        """Return angular accelerations (n, 3) at attitudes (n, 4) under dipole moments (n, 3) A m^2."""
        count = len(quaternion)
        shown = attitude_matrix(quaternion)
        field = np.einsum("nij,nj->ni", shown, self.field[:count])
        up = np.einsum("nij,nj->ni", shown, self.position[:count])
        pull = 3.0 * GRAVITATIONAL_PARAMETER / np.linalg.norm(up, axis=1) ** 5
        torque = np.cross(dipole, field) + pull[:, None] * np.cross(up, up @ self.inertia.T)
        torque += shapes(self.pressures.until(count), shown) @ self.sizes
        return np.asarray((torque - np.cross(rate, rate @ self.inertia.T)) @ self.inverse.T)


@dataclass(frozen=True, slots=True, eq=False)
class PathCriterion:
    """The terms of the cost of a step of a path.

    Attributes:
        state: weights (6, 6) of rotation and rate errors relative to the attitude law.
        dipole: weight of the squared dipole moment of each axis.
        end: cost-to-go of following the attitude law after the path. The first column of the linear part
            `end.slope` belongs to the attitude law with the expected torques. Each further column belongs to
            a unit of one component of the disturbance torques.
        shape: derivatives (n + 1, 3, 9) of the disturbance torque with respect to its 9 components, in the
            body axes of the commanded attitude.
        fastest: rate above which the cost increases steeply (see `EXCESS`), rad/s.
    """

    state: FloatArray
    dipole: float
    end: CostToGo
    shape: FloatArray
    fastest: float


@dataclass(frozen=True, slots=True, eq=False)
class PlannedMotion:
    """A motion: attitudes (n + 1, 4), rates (n + 1, 3), rad/s, and controls (n, 4) constant in each step.

    A control consists of a dipole moment (A m^2, body axes) and a torque along the field (N m).
    """

    quaternion: FloatArray
    rate: FloatArray
    control: FloatArray

    def references(self, times: FloatArray) -> AttitudeReferences:
        """Return the motion as a reference motion at times (n + 1,), s."""
        rises = np.diff(self.rate, axis=0) / (times[1] - times[0])
        return AttitudeReferences(times, self.quaternion, self.rate, np.concatenate([rises, rises[-1:]]))


@dataclass(frozen=True, slots=True, eq=False)
class MotionGains:
    """Feedback gains K (n, 4, 6) about a motion, and affine parts k (n, 4, columns) of the control law.

    Subtracting the first column of k from the controls of the motion reduces the cost of the motion. Each
    further column of k compensates a unit of one component of the disturbance torques.
    """

    gain: FloatArray
    steady: FloatArray


def best_path(
    expected: PathConditions, initial: AttitudeReferences, criterion: PathCriterion
) -> tuple[PlannedMotion, MotionGains]:
    """Return the best path from the first state of `initial` to the attitude law, with feedback gains.

    The motion `initial` (n + 1,) is an initial guess that ends on the attitude law; the coils need not be
    able to produce it. The computation takes 0.3 ms per instant and sweep. Raises PlanningError if the body
    rotates too fast to be propagated.
    """
    rest = PlannedMotion(initial.quaternion, initial.rate, np.zeros((len(initial.times) - 1, 4)))
    first = _first(expected, rest, _swept(expected, rest, criterion, 1.0, given=True))
    near = float(_counted(expected.wanted, first, criterion).max()) < NEAR
    best, least = first, math.inf
    for rise in RISES:
        motion, multiple = first, PROHIBITIVE if near else 1.0
        while multiple < DEAR:
            motion, multiple = _improved(expected, motion, criterion, multiple), multiple * rise
        motion = _improved(expected, motion, criterion, PROHIBITIVE)
        cost = _cost(expected, motion, criterion, PROHIBITIVE)
        if cost < least:
            best, least = motion, cost
        later = _counted(expected.wanted, motion, criterion)[len(first.control) // 2 :]
        if near or float(later.max()) < SETTLED:
            break
    return best, _swept(expected, best, criterion, PROHIBITIVE)


def _first(expected: PathConditions, rest: PlannedMotion, gains: MotionGains) -> PlannedMotion:
    """Return the initial motion of the first linear-quadratic sweep.

    The motion is propagated with the given gains, or without control if the motion diverges with the gains.
    Far from the motion `rest`, the gains may rotate the body by several revolutions in a step, because the
    torque along the field is not limited.
    """
    nothing = MotionGains(np.zeros_like(gains.gain), np.zeros_like(gains.steady))
    for tried in (gains, nothing):
        if (first := propagate(expected, rest, tried, 1.0)) is not None:
            return first
    fastest = math.degrees(float(np.linalg.norm(rest.rate[0])))
    raise PlanningError(
        f"no path: at {fastest:.1f} deg/s the body rotates too far in one planning step: detumble it first"
    )


def _improved(
    expected: PathConditions, motion: PlannedMotion, criterion: PathCriterion, multiple: float
) -> PlannedMotion:
    """Return the best motion near a feasible motion; `multiple` is the cost of a torque along the field."""
    cost = _cost(expected, motion, criterion, multiple)
    enough = SAVED[multiple == PROHIBITIVE]
    for _ in range(SWEEPS):
        gains, before = _swept(expected, motion, criterion, multiple), cost
        for share in SHARES:
            tried = propagate(expected, motion, gains, share)
            found = math.inf if tried is None else _cost(expected, tried, criterion, multiple)
            if tried is not None and found < cost:
                motion, cost = tried, found
                break
        if before - cost < enough * before:
            break
    return motion


def propagate(
    expected: PathConditions, motion: PlannedMotion, gains: MotionGains, share: float
) -> PlannedMotion | None:
    """Return the motion after applying the feedback gains and a fraction `share` of the computed change.

    Returns None if the motion diverges, due to the unlimited torques along the field far from `motion`.
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
        if not np.abs([w, middle]).max() < RUN_AWAY:  # also true for NaN
            return None
        half = multiply(from_rotation_vector(0.5 * step * w), q)
        w = w + step * expected.acceleration(k, half, middle, u)
        q = multiply(from_rotation_vector(step * middle), q)
        quaternion[k + 1], rate[k + 1], flown[k] = q, w, u
    return PlannedMotion(quaternion, rate, flown) if np.abs(w).max() < RUN_AWAY else None


def _swept(
    expected: PathConditions,
    motion: PlannedMotion,
    criterion: PathCriterion,
    multiple: float,
    given: bool = False,
) -> MotionGains:
    """Return the feedback gains about a motion.

    If `given` is true, the attitudes and rates of the motion need not be consistent with its controls.
    """
    count, state, end = len(motion.control), criterion.state, criterion.end
    first = motion.references(expected.wanted.times).until(count)
    field = expected.field[:count]
    pressed, position = expected.pressed(count), expected.position[:count]
    linear = linearised(first, expected.inertia, field, position, motion.control[:, :3], pressed)
    strength = np.linalg.norm(linear.field, axis=1)
    along = linear.by_torque @ (linear.field / strength[:, None])[:, :, None]
    linear = replace(linear, by_control=np.concatenate([linear.by_control, along], axis=2))
    control = np.full((count, 4), criterion.dipole)
    control[:, 3] *= multiple / strength**2
    deviation, bent = errors(expected.wanted, motion), error_jacobians(expected.wanted, motion)
    turned = np.swapaxes(bent, 1, 2)
    columns = end.slope.shape[1]
    affine, state_slope = np.zeros((2, count, 6, columns))
    control_slope = np.zeros((count, 4, columns))
    affine[:, :, 1:] = linear.by_torque @ criterion.shape[:count]
    if given:
        missing = criterion.shape[:count] @ expected.sizes - linear.missing
        affine[:, :, 0] = np.einsum("nij,nj->ni", linear.by_torque, missing)
    else:
        state_slope[:, :, 0] = np.einsum("nij,nj->ni", turned[:-1] @ state, deviation[:-1])
        control_slope[:, :, 0] = control * motion.control
    states = turned[:-1] @ state @ bent[:-1]
    steep, curved = _haste(motion.rate, criterion.fastest, expected.step)
    state_slope[:, 3:, 0] += steep[:-1]
    states[:, 3:, 3:] += curved[:-1]
    slope, square = turned[-1] @ end.slope, turned[-1] @ end.square @ bent[-1]
    slope[:, 0] += turned[-1] @ end.square @ deviation[-1]
    slope[3:, 0] += steep[-1]
    square[3:, 3:] += curved[-1]
    last = CostToGo(square, slope)
    cost = SweepCost(states, control, state_slope, control_slope)
    gain, steady, _ = sweep(linear, affine, cost, last)
    return MotionGains(gain, steady)


def _cost(
    expected: PathConditions, motion: PlannedMotion, criterion: PathCriterion, multiple: float
) -> float:
    """Return the cost of a motion, including the cost-to-go at the end of the motion."""
    deviation, end = errors(expected.wanted, motion), criterion.end
    strength = np.linalg.norm(expected.field[:-1], axis=1)
    squares = np.einsum("ni,ij,nj->", deviation[:-1], criterion.state, deviation[:-1])
    squares += criterion.dipole * np.sum(motion.control[:, :3] ** 2)
    squares += criterion.dipole * multiple * np.sum((motion.control[:, 3] / strength) ** 2)
    excess = np.maximum(np.linalg.norm(motion.rate, axis=1) - criterion.fastest, 0.0)
    squares += expected.step * np.sum((excess / EXCESS) ** 2)
    return float(0.5 * squares + deviation[-1] @ (0.5 * end.square @ deviation[-1] + end.slope[:, 0]))


def _haste(rate: FloatArray, fastest: float, step: float) -> tuple[FloatArray, FloatArray]:
    """Return gradient (n, 3) and Hessian (n, 3, 3) of the cost of exceeding the rate `fastest`, rad/s."""
    speed = np.maximum(np.linalg.norm(rate, axis=1), 1e-9)
    along = rate / speed[:, None]
    excess, weight = np.maximum(speed - fastest, 0.0), step / EXCESS**2
    outer = along[:, :, None] * along[:, None, :]
    curved = (excess > 0.0)[:, None, None] * outer
    curved = curved + (excess / speed)[:, None, None] * (np.eye(3) - outer)
    return weight * excess[:, None] * along, weight * curved


def errors(wanted: AttitudeReferences, motion: PlannedMotion) -> FloatArray:
    """Return the rotation and rate errors (n + 1, 6) of a motion relative to the attitude law."""
    turn = to_rotation_vector(multiply(motion.quaternion, conjugate(wanted.quaternion)))
    return np.concatenate([turn, motion.rate - wanted.rate], axis=1)


def _counted(wanted: AttitudeReferences, motion: PlannedMotion, criterion: PathCriterion) -> FloatArray:
    """Return the magnitudes (n + 1,), rad, of the weighted rotation errors relative to the attitude law."""
    turn, weights = errors(wanted, motion)[:, :3], criterion.state[:3, :3]
    squares = np.einsum("ni,ij,nj->n", turn, weights, turn)
    return np.asarray(np.sqrt(squares / np.linalg.eigvalsh(weights)[-1]))


def error_jacobians(wanted: AttitudeReferences, motion: PlannedMotion) -> FloatArray:
    """Return the derivatives (n + 1, 6, 6) of rotation and rate errors with respect to attitude and rate.

    The rotation block of the derivatives is the inverse left Jacobian of the rotation group, for scalar-last
    quaternions from inertial into body axes.
    """
    turn = to_rotation_vector(multiply(motion.quaternion, conjugate(wanted.quaternion)))
    angle = np.linalg.norm(turn, axis=1)
    safe = np.where(angle < 1e-2, 1.0, angle)
    second = np.where(angle < 1e-2, 1.0 / 12.0, (1.0 - 0.5 * safe / np.tan(0.5 * safe)) / safe**2)
    across = cross_matrices(turn)
    bent = np.broadcast_to(np.eye(6), (len(turn), 6, 6)).copy()
    bent[:, :3, :3] += 0.5 * across + second[:, None, None] * (across @ across)
    return bent
