"""The planner of three-axis slews by virtual motion camouflage, solved with NLopt.

The planner applies the method of Sease 2013, eqs. (5.8) to (5.15), to the three modified Rodrigues parameters
of the attitude, relative to the middle of an initial guess. Each parameter is x = r + v (p - r), with the
initial guess p (the prey path of virtual motion camouflage), a constant reference point r, and path control
parameters v on N Legendre-Gauss-Lobatto nodes. Attitude and rate are given at both ends, so N - 4 path
control parameters per axis are free.

The torque that a path needs is computed by inverse dynamics. Coils cause no torque along the magnetic field,
so an equality constraint sets the component of the needed torque along the field to zero on all nodes. Of all
dipole moments that cause the needed torque, the dipole moment of least heat is used, and the cost is the
heat. The dipole limits and the exclusion cones are imposed at those quadrature points at which the previous
solution violated one of them. When the dipole limit is reached, the planner does not reduce the largest
component by adding a dipole moment along the field.

The initial guesses are the smooth rotation about the eigenaxis and the guesses of `slew_search`. The module
`slew_plan` corrects and integrates a solution like a path found by collocation. The optimiser of the
collocation is not used. Modified Rodrigues parameters are described by Schaub and Junkins, Analytical
Mechanics of Space Systems, chapter 3.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import nlopt
import numpy as np
from numpy.typing import NDArray

from knightcube.astro.arrays import BoolArray, FloatArray, tangent_basis
from knightcube.astro.quaternion import (
    attitude_matrix,
    conjugate,
    from_rotation_vector,
    multiply,
    normalise,
    to_rotation_vector,
)
from knightcube.errors import PlanningError
from knightcube.gnc.guidance.slew_model import (
    AttitudeEnd,
    ConeConstraints,
    End,
    HermiteCubic,
    SlewDynamics,
    SlewPath,
    SlewTask,
    blocking_cone,
    check,
    cross,
    heat_matrix,
    shown,
)
from knightcube.gnc.guidance.slew_plan import SlewPlan, integrated, is_within_limits, refusal
from knightcube.gnc.guidance.slew_program import SlewLimits, SlewProgram, Trajectory
from knightcube.gnc.guidance.slew_search import (
    GRIDS,
    LAST_BARRIER,
    LONGER,
    SlewSearch,
    SlewSolver,
    SolvedPath,
    guesses,
)
from knightcube.gnc.guidance.vmc_program import CONVERGED, SOLVER_STOPS, SamplePoints, discretisation

Numbers = NDArray[Any]
"""Real or complex array."""

NODES = 28
"""Number of nodes of a path."""
_REFERENCE = 2.0
"""Reference point r of each modified Rodrigues parameter, which exceeds the parameters of all initial
guesses."""
_TRIED = 3
"""Number of guesses of `slew_search` that serve as initial guesses for one duration."""
_AXES = np.arange(3)
_STEP = 1e-30
"""Imaginary step of derivatives by the complex-step method, which has no cancellation."""
_NEAR, _LOST, _EASED = 0.9, 1.1, 4
"""The limit of the dipole is imposed at points where the dipole exceeds the first value times the usable
limit. A path is abandoned if, after integration, its dipole exceeds the second value times the limit. The
third value is the largest number of integrations; the usable limit is reduced after each of them."""
_BESIDE = math.radians(0.1)
"""Angle (rad) by which exclusion cones are widened, because cones are not imposed between quadrature
points."""
_HOPELESS = 1.5
"""Largest excess over a limit of a path from which a path within the limits is sought."""
_EXCHANGES, _EVALUATIONS = 6, 150
"""Largest number of updates of the imposed limits, and of evaluations of the heat per run of NLopt."""
_TOLERANCE, _MET, _KEPT = 1e-6, 1e-6, 1e-5
"""Relative tolerance of the minimised heat of the coils (first value), tolerance of the scaled constraints
(second value), and largest accepted excess over a limit (third value)."""


def plan_task(task: SlewTask, near: SlewPath | None = None) -> SlewPlan:
    """Return the plan of least heat found for a slew task by virtual motion camouflage.

    If `near`, the path of a similar task with the same duration, is given, it is the first initial guess, and
    a plan found from this guess is returned immediately. Raises PlanningError with the reason if no path is
    found. Tasks with a time cost also raise PlanningError, because the planner does not optimise the
    duration.
    """
    plan = None if near is None else plan_near(task, near)
    if plan is not None:
        return plan
    _check(task)
    tried = 0
    for longer in LONGER:
        horizon = min(longer * task.horizon, task.longest)
        if blocking_cone(task, horizon) is None:
            preys = list(prey_paths(task, horizon))
            tried += len(preys)
            found = [plan for prey in preys if (plan := _planned(task, horizon, prey)) is not None]
            if found:
                return min(found, key=lambda plan: plan.energy)
        if horizon == task.longest:
            break
    raise PlanningError(f"virtual motion camouflage: {refusal(task, tried)}")


def plan_near(task: SlewTask, near: SlewPath) -> SlewPlan | None:
    """Return the plan found from the initial guess `near`, which has the duration of the task, or None.

    Raises PlanningError for invalid values and for a task with a time cost.
    """
    _check(task)
    return _planned(task, near.horizon, np.concatenate([near.quaternion, near.horizon * near.rate], axis=1))


def _check(task: SlewTask) -> None:
    check(task)
    if task.time_cost is not None:
        raise PlanningError(
            "virtual motion camouflage plans slews of a given duration: plan a slew with a time cost by "
            "collocation"
        )


def prey_paths(task: SlewTask, horizon: float) -> Iterator[FloatArray]:
    """Yield initial guesses as states (n, 7) at equal time steps, with rates in units of 1/`horizon`."""
    solver = SlewSolver(task)
    equations = solver.equations(horizon, GRIDS[0][0])
    found = guesses(equations, task.craft, solver.kept(equations))[:_TRIED]
    share = np.linspace(0.0, 1.0, 4 * NODES + 1)[:, None]
    last = _end_attitude(equations.end, task.quaternion)
    whole = to_rotation_vector(multiply(last, conjugate(task.quaternion)))
    smooth = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
    turned = multiply(from_rotation_vector(smooth * whole), np.broadcast_to(task.quaternion, (len(share), 4)))
    yield np.concatenate([turned, 30.0 * (share * (1.0 - share)) ** 2 * whole], axis=1)
    yield from (guess.states for guess in found)


def _end_attitude(end: End, near: FloatArray) -> FloatArray:
    """Return the attitude (4,) at the end, which is the closest to `near` if the roll is free."""
    if isinstance(end, AttitudeEnd):
        return end.quaternion
    seen = shown(near[None], end.direction[None])[0]
    # Quaternion of the shortest rotation from the attitude `near` to an attitude at which the boresight
    # points along the direction.
    half = np.append(np.cross(end.axis, seen), 1.0 + float(seen @ end.axis))
    if float(np.linalg.norm(half)) < 1e-6:  # opposite directions
        half = np.append(tangent_basis(end.axis)[0], 0.0)
    return multiply(normalise(half), near)


def _planned(task: SlewTask, horizon: float, prey: FloatArray) -> SlewPlan | None:
    """Return the integrated plan within all limits that is found from an initial guess (n, 7), or None."""
    try:
        program = VmcProgram(task, horizon, prey)
        parameters = program.solved(np.zeros(program.size))
        for _ in range(_EASED):
            plan = None if parameters is None else _integrated(task, program, parameters)
            if parameters is None or plan is None:
                return None
            if is_within_limits(task, plan):
                return plan
            if not 1.0 < plan.peak < _LOST:
                return None
            program.share /= plan.peak
            parameters = program.solved(parameters)
    except np.linalg.LinAlgError:
        pass
    return None


def _integrated(task: SlewTask, program: VmcProgram, parameters: FloatArray) -> SlewPlan | None:
    """Return the plan of a path after correction and integration on the grid of the task, or None."""
    search = SlewSearch(task, *GRIDS[0])
    equations = search.solver.equations(program.scale, task.nodes)
    states, dipoles = program.trajectory(parameters, np.linspace(0.0, 1.0, 2 * task.nodes + 1))
    collocated = SlewProgram(equations, SlewLimits(equations, None, search.solver.kept(equations)))
    point = collocated.begin(Trajectory(states, dipoles[::2]), None, LAST_BARRIER)
    plan = integrated(task, search, SolvedPath(collocated, point))
    if plan is None:
        return None
    return replace(plan, energy=plan.path.heat(task.craft.weights), steps=program.evaluations)


def mrp_motion(x: Numbers) -> tuple[Numbers, Numbers, Numbers]:
    """Return attitudes (n, 4), rates (n, 3) and accelerations (n, 3) of a motion in Rodrigues parameters.

    The argument (3, n, 3) contains modified Rodrigues parameters and their first and second time derivatives.
    """
    p, v, a = x
    square, slope = np.sum(p * p, axis=1, keepdims=True), np.sum(p * v, axis=1, keepdims=True)
    bend, whole = np.sum(v * v + p * a, axis=1, keepdims=True), 1.0 + square
    first = (1.0 - square) * v - 2.0 * cross(p, v) + 2.0 * slope * p
    second = (1.0 - square) * a - 2.0 * cross(p, a) + 2.0 * bend * p
    q = np.concatenate([2.0 * p, 1.0 - square], axis=1) / whole
    return q, 4.0 * first / whole**2, 4.0 * second / whole**2 - 16.0 * slope * first / whole**3


def mrp_slopes(p: FloatArray, rate: FloatArray) -> FloatArray:
    """Return the time derivatives (n, 3) of modified Rodrigues parameters (n, 3) for body rates (n, 3)."""
    square, along = np.sum(p * p, axis=1, keepdims=True), np.sum(p * rate, axis=1, keepdims=True)
    return np.asarray(0.25 * ((1.0 - square) * rate + 2.0 * cross(p, rate) + 2.0 * along * p))


class ObservedPaths:
    """A family of paths at n points: dipole moments, torques along the field, and distances from cones."""

    def __init__(
        self,
        task: SlewTask,
        scale: float,
        middle: FloatArray,
        margin: FloatArray,
        samples: SamplePoints,
        nodes: FloatArray,
        basis: FloatArray,
    ) -> None:
        """Set up the paths `nodes` (N, 3) + `basis` (N, 3, k) y for evaluation at the points of `samples`.

        The unit of time is `scale` s, and cones are widened by `margin` (cones, 1) rad.
        """
        times, unit = 0.5 * scale * (samples.points + 1.0), float(np.mean(task.craft.limit))
        around = task.along(times)
        self._motion = SlewDynamics(task.craft, scale, unit, around)
        self._field = scale**2 * unit * around.field
        self._craft, self._middle = task.craft, middle
        self._weights = heat_matrix(task.craft.weights)
        self._cones = ConeConstraints(task.cones, margin, times)
        matrices = np.array([1.0, 2.0, 4.0])[:, None, None] * samples.matrices
        self._still = np.einsum("knj,ja->kna", matrices, nodes)
        self._basis = np.einsum("knj,jap->kanp", matrices, basis)
        self._last: tuple[bytes, FloatArray, FloatArray] | None = None

    def motion(self, y: FloatArray) -> FloatArray:
        """Return Rodrigues parameters and two time derivatives (3, n, 3) for path parameters y (k,)."""
        return np.asarray(self._still + (self._basis @ y).transpose(0, 2, 1))

    def values(self, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return values (n, 4 + cones) of a path, and their derivatives (n, 4 + cones, k) with respect to y.

        The columns are the three dipole components, the needed torque along the field divided by the field
        strength, and a measure of the distance from each exclusion cone, which is positive outside the cone.
        """
        key = y.tobytes()
        if self._last is None or self._last[0] != key:
            x = self.motion(y)
            q, w, _ = self.turned(x)
            at, none = np.concatenate([q, w], axis=1), np.zeros_like(w)
            drift, by_state = self._motion.flow(at, none)[:, 4:], self._motion.slopes(at, none)[:, 4:, :7]
            count = len(w)
            moved = np.tile(x, (1, 9, 1)) + 0.0j
            by_input = moved.reshape(3, 3, 3, count, 3)
            by_input[_AXES[:, None], _AXES[:, None], _AXES, :, _AXES] += 1j * _STEP
            shift = np.concatenate(self.turned(moved)[:2], axis=1).imag.reshape(9, count, 7, 1)
            drifted = drift + 1j * (by_state @ shift)[..., 0]
            slopes = self._needed(moved, drifted.reshape(-1, 3)).imag.reshape(9, count, -1) / _STEP
            basis = self._basis.transpose(2, 0, 1, 3).reshape(count, 9, -1)
            self._last = key, self._needed(x, drift), slopes.transpose(1, 2, 0) @ basis
        return self._last[1], self._last[2]

    def turned(self, x: Numbers) -> tuple[Numbers, Numbers, Numbers]:
        """Return attitudes (n, 4), ICRS to body, rates and accelerations (n, 3) for a motion (3, n, 3)."""
        q, w, a = mrp_motion(x)
        return multiply(q, np.broadcast_to(self._middle, q.shape)), w, a

    def _needed(self, x: Numbers, drift: Numbers) -> Numbers:
        """Return the values (m n, 4 + cones) of m paths (3, m n, 3) at the n points.

        The angular accelerations without coil currents are `drift` (m n, 3).
        """
        q, _, acceleration = self.turned(x)
        count = len(self._field)
        b = shown(q, np.tile(self._field, (len(q) // count, 1)))
        torque = (acceleration - drift) @ self._craft.inertia
        square = np.sum(b * b, axis=1, keepdims=True)
        least, heavy = cross(b, torque) / square, b @ self._weights
        share = np.sum(heavy * least, axis=1, keepdims=True) / np.sum(heavy * b, axis=1, keepdims=True)
        along = np.sum(torque * b, axis=1, keepdims=True) / square
        cones = self._cones.values(q.reshape(-1, 1, count, 4)).transpose(0, 2, 1).reshape(len(q), -1)
        return np.concatenate([least - share * b, along, cones], axis=1)


class VmcProgram:
    """The nonlinear program of a slew of `scale` s. The attribute `evaluations` counts cost evaluations."""

    def __init__(self, task: SlewTask, scale: float, prey: FloatArray, count: int = NODES) -> None:
        """Set up a family of paths on `count` nodes about the initial guess `prey`, given as states (n, 7).

        The task defines the attitudes and rates at both ends of the paths. The parameters are whitened: at
        the initial guess, the Hessian of the heat is close to the unit matrix.
        """
        end = task.end(scale)
        q = prey[:, :4] * np.sign(prey[0, :4] @ task.quaternion)
        last = _end_attitude(end, q[-1])
        q[0], q[-1] = task.quaternion, last * np.sign(last @ q[-1])
        self._middle = normalise(q[0] + q[-1]) if q[0] @ q[-1] > -0.5 else q[len(q) // 2]
        relative = multiply(q, np.broadcast_to(conjugate(self._middle), q.shape))
        p = relative[:, :3] / (1.0 + relative[:, 3:])
        rates = scale * np.array([task.rate, attitude_matrix(last) @ end.rate])
        grid = discretisation(count)
        curve = HermiteCubic(np.linspace(0.0, 1.0, len(p)), p, mrp_slopes(p, prey[:, 4:]))
        nodes, ends = curve(0.5 * (grid.rule.nodes + 1.0)), 2.0 * grid.rule.differentiation[[0, -1]]
        missed = mrp_slopes(p[[0, -1]], rates) - ends @ nodes
        nodes[[1, -2]] += np.linalg.solve(ends[:, [1, -2]], missed)
        basis = np.zeros((count, 3, 3, count - 4))
        for axis in range(3):
            basis[:, axis, axis] = grid.free * (nodes[2:-2, axis] - _REFERENCE)
        self._task, self.scale, self._nodes, self._grid = task, scale, nodes, grid
        self.share, self.evaluations = 1.0, 0
        self._basis = basis.reshape(count, 3, -1)
        clear = [[float(cone.clearance(q[[0, -1]], np.array([0.0, scale])).min())] for cone in task.cones]
        self._margin = np.clip(np.array(clear).reshape(-1, 1), 0.0, _BESIDE)
        self._unit = float(np.mean(task.craft.limit))
        self._heat = heat_matrix(task.craft.weights) * self._unit**2 * scale
        self._quadrature = 0.5 * grid.cost_weights
        # The parameters are transformed so that the whitened cost has a unit Hessian.
        _, slopes = self._observed(self._grid.cost).values(np.zeros(self.size))
        root = np.zeros((4, 4))
        root[:3, :3], root[3, 3] = np.linalg.cholesky(self._heat), self._along
        each = np.sqrt(2.0 * self._quadrature)[:, None, None] * (root.T @ slopes[:, :4])
        self._basis = self._basis @ np.linalg.inv(np.linalg.qr(each.reshape(-1, self.size), mode="r"))
        self._cost = self._observed(grid.cost)
        self._equal = self._observed(SamplePoints.at(grid.rule, grid.rule.nodes))

    @property
    def size(self) -> int:
        """The number of free path parameters, 3 (N - 4)."""
        return int(self._basis.shape[2])

    def _observed(self, samples: SamplePoints) -> ObservedPaths:
        parts = self._task, self.scale, self._middle, self._margin, samples
        return ObservedPaths(*parts, self._nodes, self._basis)

    @property
    def _along(self) -> float:
        """The square root of the mean heat per squared dipole, which weights the torque along the field."""
        return math.sqrt(float(np.trace(self._heat)) / 3.0)

    def trajectory(self, y: FloatArray, share: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return states (n, 7) and dipoles (n, 3) at fractions (n,) of the duration for parameters y (k,)."""
        paths = self._observed(SamplePoints.at(self._grid.rule, 2.0 * share - 1.0))
        q, w, _ = paths.turned(paths.motion(y))
        return np.concatenate([q, w], axis=1), paths.values(y)[0][:, :3]

    def heat(self, y: FloatArray) -> tuple[float, FloatArray]:
        """Return the heat (J) of a path and the gradient (k,) of the heat."""
        values, slopes = self._cost.values(y)
        pull = self._quadrature[:, None] * (values[:, :3] @ self._heat)
        heat = float(np.sum(pull * values[:, :3]))
        return heat, 2.0 * np.tensordot(pull, slopes[:, :3], 2)

    def along_field(self, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the scaled torques along the field (N,) needed at the nodes, and their gradients (N, k)."""
        values, slopes = self._equal.values(y)
        factor = self._along / math.sqrt(len(values))
        return factor * values[:, 3], factor * slopes[:, 3]

    def excess(self, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return excesses (n, 6 + cones) over the limits at n points, and the gradients (n, 6 + cones, k).

        An excess over the dipole limit is divided by the usable limit, which is the fraction `share` of the
        dipole limit.
        """
        values, slopes = self._cost.values(y)
        limit = self.share * self._task.craft.limit / self._unit
        ratio, by = values[:, :3] / limit, slopes[:, :3] / limit[:, None]
        excess = np.concatenate([ratio - 1.0, -ratio - 1.0, -values[:, 4:]], axis=1)
        return excess, np.concatenate([by, -by, -slopes[:, 4:]], axis=1)

    def solved(self, start: FloatArray) -> FloatArray | None:
        """Return the parameters (k,) of the path of least heat within all limits, or None.

        The search starts from the parameters `start` (k,).
        """
        y: FloatArray | None = start
        imposed = np.zeros((len(self._quadrature), 6 + len(self._task.cones)), dtype=bool)
        for _ in range(_EXCHANGES):
            y = None if y is None else self._minimised(y, imposed)
            if y is None:
                return None
            excess, _ = self.excess(y)
            worst = float(excess.max())
            if worst <= _KEPT or worst > _HOPELESS:
                return y if worst <= _KEPT else None
            imposed |= excess > 0.0
            imposed[:, :6] |= excess[:, :6] > _NEAR - 1.0
        return None

    def _minimised(self, start: FloatArray, imposed: BoolArray) -> FloatArray | None:
        """Return the optimum of one run of SLSQP under the imposed limits, or None if the run fails."""
        solver, last = nlopt.opt(nlopt.LD_SLSQP, self.size), start

        def objective(y: FloatArray, gradient: FloatArray) -> float:
            nonlocal last
            last = y.copy()
            self.evaluations += 1
            heat, by = self.heat(y)
            gradient[:] = by if gradient.size else gradient
            return heat

        def along(result: FloatArray, y: FloatArray, gradient: FloatArray) -> None:
            result[:], by = self.along_field(y)
            gradient[:] = by if gradient.size else gradient

        def limits(result: FloatArray, y: FloatArray, gradient: FloatArray) -> None:
            excess, by = self.excess(y)
            result[:] = excess[imposed]
            gradient[:] = by[imposed] if gradient.size else gradient

        solver.set_min_objective(objective)
        solver.set_ftol_rel(_TOLERANCE)
        solver.set_maxeval(_EVALUATIONS)
        solver.add_equality_mconstraint(along, np.full(len(self._nodes), _MET))
        if imposed.any():
            solver.add_inequality_mconstraint(limits, np.full(int(imposed.sum()), _MET))
        try:
            found = np.asarray(solver.optimize(start))
        except SOLVER_STOPS:  # near an optimum, rounding errors limit the progress
            found = last
        else:
            if solver.last_optimize_result() not in CONVERGED:
                return None
        missed = float(np.abs(self.along_field(found)[0]).max())
        return found if missed <= 100.0 * _MET * max(1.0, math.sqrt(self.heat(found)[0])) else None
