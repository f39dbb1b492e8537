"""The search for the path of a slew, from guesses on a coarse grid to a path on a fine grid.

An initial guess is a curve of the angular momentum over time. Coils cause no torque along the magnetic field,
so the derivative of the inertial angular momentum is always normal to the field. The condition that the
torque is normal to the field is linear, so every momentum curve that reaches the end is the sum of a fixed
curve and weighted modes. The attitude follows from the momentum by integration. A least-squares fit of about
a dozen mode amplitudes finds momentum curves that end at the target, stay outside the cones and cause little
heat. The fit of the mode amplitudes is started simultaneously from many random amplitudes. Gravity gradient
and other disturbance torques are neglected in the initial guesses. The random starts of the fit are the same
in every call.

Without the dipole limit, most guesses converge in a dozen Newton steps to a path outside the exclusion cones
(a relaxed path). The heat of a relaxed path is a lower bound of the heat of a path within the dipole limit.
If the constraint violations of a guess are large after some steps, the guess is deferred, because most such
guesses never converge. If no path of the requested duration is found, a longer slew is shortened in steps.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import attitude_matrix, conjugate, multiply, to_rotation_vector
from knightcube.gnc.guidance.slew_model import (
    HORIZON_RANGE,
    MINIMUM_TIME,
    BoresightEnd,
    ConeConstraints,
    HermiteCubic,
    SlewCraft,
    SlewPath,
    SlewTask,
    blocking_cone,
    cross,
    heat_matrix,
    shown,
)
from knightcube.gnc.guidance.slew_program import (
    FIRST_BARRIER,
    Iterate,
    NewtonRun,
    SlewLimits,
    SlewProgram,
    Trajectory,
    Transcription,
)

WALK_BARRIER, LAST_BARRIER = 1e-5, 1e-8
"""Final barrier parameter of paths used only as warm starts (first value), and of paths for the slew (second
value)."""
MET, _FLOWN_MET = 1e-2, 3e-3
"""Constraint violation below which an iterate that is not yet optimal is accepted as a warm start (first
value), and as a path for the slew (second value). Early acceptance saves computing time, because many runs
converge slowly. The final integration of the path removes the remaining violations."""
_STEPS_FREE = 25
"""Maximum number of Newton steps for a path without the dipole limit."""
_LOOKS = (12, 1.2), (8, 0.2), (40, 0.0)
"""Stages of an iteration with all limits: the number of Newton steps of each stage, and the constraint
violation above which the iteration is abandoned after the stage. After the first stage, half of the
iterations that would fail are abandoned, and one in twenty of the iterations that would succeed."""


@dataclass(frozen=True, slots=True, eq=False)
class SolvedPath:
    """A path that satisfies the collocation equations of a slew."""

    program: SlewProgram
    point: Iterate

    @property
    def equations(self) -> Transcription:
        """The collocation equations of the path."""
        return self.program.equations

    @property
    def at(self) -> Trajectory:
        """The trajectory."""
        return self.point.at

    @property
    def horizon(self) -> float:
        """The duration of the path, s."""
        return self.equations.scale


class SlewSolver:
    """A solver that computes paths of one slew task. The unit of dipoles is `unit` A m^2.

    The angles `extra` (cones, 2 nodes), rad, widen the cones at the points of the fine grid. Paths use at
    most the fraction `share` of the dipole limit. The counter `steps` is the number of Newton steps, and
    `work` is the number of Newton steps multiplied by the number of intervals.
    """

    def __init__(self, task: SlewTask) -> None:
        self._task = task
        self.unit = float(np.mean(task.craft.limit))
        self._limit = task.craft.limit / self.unit
        weights = heat_matrix(task.craft.weights)
        self._full = weights / float(self._limit @ weights @ self._limit)
        self.extra = np.zeros((len(task.cones), 2 * task.nodes))
        self.share = 1.0
        self.steps = self.work = 0

    def energy(self, found: SolvedPath) -> float:
        """Return the heat of a path, J."""
        equations = found.equations
        power = float(heat_matrix(self._task.craft.weights)[0, 0] * self.unit**2)
        return equations.cost(found.at) * equations.scale * power / float(equations.weights[0, 0])

    def peak(self, found: SolvedPath) -> float:
        """Return the largest ratio of a dipole component along a path to the dipole limit."""
        return float((np.abs(found.at.dipoles) / self._limit).max())

    def is_kept(self, found: SolvedPath) -> bool:
        """Return whether a path planned without the dipole limit satisfies the dipole limit and the cones."""
        kept = self.kept(found.equations).values(found.at.states[1:, :4])
        return self.peak(found) <= 1.0 and bool(np.all(kept >= 0.0))

    def equations(self, scale: float, count: int) -> Transcription:
        """Return the collocation equations of a slew of `scale` s on `count` intervals."""
        task = self._task
        start = np.concatenate([task.quaternion, scale * task.rate])
        return Transcription(task.craft, self.unit, task.along, start, task.end, count, scale, self._full)

    def free(self, equations: Transcription, guess: Trajectory) -> SolvedPath | None:
        """Return the fully converged path without the dipole limit from an initial guess, or None."""
        return self.found(self.descent(equations, guess, LAST_BARRIER), _STEPS_FREE)

    def descent(self, equations: Transcription, guess: Trajectory, last: float = WALK_BARRIER) -> NewtonRun:
        """Return an iteration that starts at a guess and imposes the cones but not the dipole limit."""
        equations.weights = self._full / max(equations.cost(guess), 1e-9)
        return NewtonRun(
            SlewProgram(equations, SlewLimits(equations, None, self.kept(equations))), guess, last=last
        )

    def limited(self, start: SolvedPath, count: int, time: float, last: float) -> SolvedPath | None:
        """Return a path of `time` s on `count` intervals within all limits, found from `start`, or None."""
        equations = self.equations(time, count)
        at, before = transferred(start, equations), start.equations.weights
        equations.weights = self._full / max(equations.cost(at), 1e-9)
        same = count == start.equations.count
        ratio = float(equations.weights[0, 0] / before[0, 0])
        multipliers = ratio * start.point.multipliers if same else None
        limit = self.share * self._limit
        near = same and time == start.horizon and self.peak(start) < self.share
        if not near and (last == LAST_BARRIER or self.peak(start) > self.share):
            at = Trajectory(at.states, np.clip(at.dipoles, -0.98 * limit, 0.98 * limit))
        return self._converged(equations, at, multipliers, (WALK_BARRIER if near else FIRST_BARRIER, last))

    def again(self, path: SlewPath) -> SolvedPath | None:
        """Return a path within all limits, found from the path of a similar task, or None."""
        equations = self.equations(path.horizon, (len(path.times) - 1) // 2)
        states = np.concatenate([path.quaternion, path.horizon * path.rate], axis=1)
        at = Trajectory(states, path.dipole[::2] / self.unit)
        equations.weights = self._full / max(equations.cost(at), 1e-9)
        return self._converged(equations, at, None, (WALK_BARRIER, LAST_BARRIER))

    def _converged(
        self,
        equations: Transcription,
        at: Trajectory,
        multipliers: FloatArray | None,
        barriers: tuple[float, float],
    ) -> SolvedPath | None:
        """Return a path within all limits, found by reducing the barrier parameter, or None."""
        limits = SlewLimits(equations, self.share * self._limit, self.kept(equations))
        descent = NewtonRun(SlewProgram(equations, limits), at, multipliers, *barriers)
        found = None
        for look, (steps, lack) in enumerate(_LOOKS):
            enough = _FLOWN_MET * (look == len(_LOOKS) - 1)
            if look and barriers[1] == WALK_BARRIER:
                enough = MET
            found = self.found(descent, steps, enough)
            if found is not None or descent.lack >= lack:
                break
        return found

    def found(self, descent: NewtonRun, maximum: int, enough: float = 0.0) -> SolvedPath | None:
        """Return the path found within `maximum` further Newton steps, or None.

        An iterate whose constraint violation is below `enough` is accepted before it is optimal.
        """
        program, before = descent.program, descent.program.steps
        point = descent.run(maximum)
        if point is None and descent.missed < enough:
            point = descent.point
        self.steps += program.steps - before
        self.work += (program.steps - before) * program.equations.count
        if point is None or not program.equations.end.is_met(point.at.states[-1, :4]):
            return None
        return SolvedPath(program, point)

    def kept(self, equations: Transcription) -> ConeConstraints:
        """Return the cone constraints at all collocation nodes and midpoints except the first node."""
        wider = self.extra if self.extra.shape[1] == 2 * equations.count else 0.0
        return ConeConstraints(self._task.cones, np.asarray(wider), equations.times[1:])


def transferred(start: SolvedPath, equations: Transcription) -> Trajectory:
    """Return a path interpolated on the grid of `equations` and scaled to the duration of `equations`.

    The dipoles are multiplied by the squared ratio of the old to the new duration.
    """
    at, own = start.at, start.equations
    dipoles = at.dipoles * (own.scale / equations.scale) ** 2
    if own.count == equations.count:
        return Trajectory(at.states, dipoles)
    share = np.linspace(0.0, 1.0, 2 * own.count + 1)
    states = HermiteCubic(share, at.states, own.motion.flow(at.states, at.all_dipoles()))
    wanted = np.linspace(0.0, 1.0, 2 * equations.count + 1)
    parts = [np.interp(wanted[::2], share[::2], part) for part in dipoles.T]
    return Trajectory(states(wanted), np.stack(parts, axis=1))


_BEGINS, _SPREAD = 24, 0.4
"""Number of random starts of the momentum fit, and standard deviation of the random mode amplitudes."""
_COSINES = 6
"""Number of cosine terms that describe the time dependence of the torque about each axis."""
_ROUNDS = 12
_END, _CONE, _HEAT = 4.0, 2.0, 0.05
"""Weights of the residuals of the momentum fit: error of the end attitude (per rad), depth inside an
exclusion cone (per unit of cosine), and mode amplitudes."""
_ROOM = 0.03
"""Margin between a guess and an exclusion cone, as a difference of cosines."""
_DAMPED = 1.0
_LONGEST_STEP = 4.0
"""Largest change of the mode amplitudes in an iteration of the momentum fit."""
_WEAK, _WEAK_END = 1e-3, 0.03
"""First value: heat of a mode, relative to the largest heat of a mode, below which the mode is discarded.
Second value: singular value, relative to the largest singular value, below which the modes do not control a
component of the end momentum."""
_MISSED, _INSIDE_CONE = 0.1, 0.02
"""End error (rad), and depth inside a cone (as a difference of cosines), above which a guess is tried after
all other guesses."""
_SAME = 0.1
"""Difference of mode amplitudes, as a fraction of the amplitudes, below which two momentum curves count as
equal."""


def guesses(equations: Transcription, craft: SlewCraft, kept: ConeConstraints) -> list[Trajectory]:
    """Return initial guesses for a slew, the most promising guess first.

    The guesses satisfy the end conditions of `equations` and avoid the exclusion cones of `kept`.
    """
    motion, found = equations.motion, []
    for states in _MomentumFit(equations, craft, kept).found():
        # The dipole is the smallest one that produces the required torque across the field.
        still = motion.flow(states, np.zeros((len(states), 3)))
        wanted = np.gradient(states[:, 4:], 1.0 / (len(states) - 1), axis=0) - still[:, 4:]
        field = motion.field(states[:, :4])
        square = np.sum(field * field, axis=1, keepdims=True)
        found.append(Trajectory(states, np.asarray(cross(field, wanted @ craft.inertia) / square)[::2]))
    return found


def _curves(equations: Transcription, craft: SlewCraft) -> tuple[FloatArray, FloatArray]:
    """Return a curve (n, 3) of the angular momentum from start to end, and d modes (d, n, 3) to add to it.

    The momentum is in kg m^2/s and ICRS axes. The modes preserve both ends, and are orthogonal, so that their
    heats are additive. A mode with the amplitude one rotates the body by about half a revolution.
    """
    field, start, end, scale = equations.around.field, equations.start, equations.end, equations.scale
    count = len(field)
    step, strength = scale / (count - 1), np.linalg.norm(field, axis=1)
    field = field / strength[:, None]
    across = np.eye(3) - field[:, :, None] * field[:, None, :]
    in_time = np.cos(np.pi * np.outer(np.arange(_COSINES), np.linspace(0.0, 1.0, count)))
    slopes = np.einsum("nij,mn->mjni", across, in_time).reshape(3 * _COSINES, -1)
    strength = np.repeat(strength / strength.mean(), 3)
    heat, mixed = np.linalg.eigh((slopes / strength**2) @ slopes.T / count)
    used = heat > _WEAK * heat[-1]
    slopes = ((mixed[:, used] / np.sqrt(heat[used])).T @ slopes).reshape(-1, count, 3)
    curves = np.zeros_like(slopes)
    curves[:, 1:] = np.cumsum(0.5 * step * (slopes[:, 1:] + slopes[:, :-1]), axis=1)
    begun = _momentum(craft, start[:4], attitude_matrix(start[:4]).T @ start[4:] / scale)
    wanted = (
        _momentum(craft, start[:4] if isinstance(end, BoresightEnd) else end.quaternion, end.rate) - begun
    )
    left, sizes, right = np.linalg.svd(curves[:, -1].T)
    reached = int((sizes > _WEAK_END * sizes[0]).sum())
    fixed = right[:reached].T @ ((left.T @ wanted)[:reached] / sizes[:reached])
    half_turn = 2.0 * np.pi * float(np.trace(craft.inertia)) / scale**2
    free = half_turn * np.tensordot(right[reached:], curves, 1)
    return begun + np.tensordot(fixed, curves, 1), free


def _momentum(craft: SlewCraft, q: FloatArray, rate: FloatArray) -> FloatArray:
    """Return the angular momentum (3,) of a body with attitude (4,) and rate (3,), rad/s, ICRS axes."""
    turned = attitude_matrix(q)
    return np.asarray(turned.T @ craft.inertia @ turned @ rate)


class _MomentumFit:
    """A Levenberg-Marquardt fit of mode amplitudes of momentum curves, from many random initial guesses."""

    def __init__(self, equations: Transcription, craft: SlewCraft, kept: ConeConstraints) -> None:
        self._base, self._modes = _curves(equations, craft)
        self._start, self._end, self._scale = equations.start, equations.end, equations.scale
        self._kept, self._lighter = kept, np.linalg.inv(craft.inertia)

    def found(self) -> list[FloatArray]:
        """Return the states (n, 7) of each distinct guess, the most promising guess first."""
        sums = self._fitted()
        q, momentum = self._propagated(sums)
        missed, crossed = self._end_errors(q), self._cone_violations(q)
        lost = np.linalg.norm(missed, axis=1) > _MISSED
        lost |= crossed.max(axis=1, initial=0.0) > _INSIDE_CONE + _ROOM
        taken: list[FloatArray] = []
        states = []
        for k in np.lexsort((np.sum(sums**2, axis=1), lost)):
            if all(np.linalg.norm(sums[k] - other) > _SAME * np.linalg.norm(other) for other in taken):
                taken.append(sums[k])
                rate = self._scale * shown(q[k], momentum[k]) @ self._lighter.T
                states.append(np.concatenate([q[k], rate], axis=1))
        return states

    def _fitted(self) -> FloatArray:
        """Return the mode amplitudes (m, d) found by the m least-squares fits."""
        count = len(self._modes)
        sums = _SPREAD * np.random.default_rng(16).normal(size=(_BEGINS, count))
        left = self._residuals(sums)
        damped, small = np.full(_BEGINS, _DAMPED), 1e-4
        for _ in range(_ROUNDS):
            near = (sums[:, None] + small * np.eye(count)).reshape(-1, count)
            slopes = (self._residuals(near).reshape(_BEGINS, count, -1) - left[:, None]) / small
            squares = slopes @ slopes.transpose(0, 2, 1) + damped[:, None, None] * np.eye(count)
            steps = -np.linalg.solve(squares, slopes @ left[:, :, None])[:, :, 0]
            size = np.linalg.norm(steps, axis=1, keepdims=True)
            there = sums + steps * np.minimum(1.0, _LONGEST_STEP / np.maximum(size, 1e-9))
            then = self._residuals(there)
            better = np.sum(then**2, axis=1) < np.sum(left**2, axis=1)
            sums, left = np.where(better[:, None], there, sums), np.where(better[:, None], then, left)
            damped = np.where(better, 0.2 * damped, 5.0 * damped)
        return np.asarray(sums)

    def _residuals(self, sums: FloatArray) -> FloatArray:
        """Return the weighted residuals (m, n) of m fits for mode amplitudes (m, d)."""
        q, _ = self._propagated(sums)
        return np.concatenate(
            [_END * self._end_errors(q), _CONE * self._cone_violations(q), _HEAT * sums], axis=1
        )

    def _end_errors(self, q: FloatArray) -> FloatArray:
        """Return the end errors (m, 3) of paths (m, n, 4): rotation vectors (rad) or boresight errors."""
        end, last = self._end, q[:, -1]
        if isinstance(end, BoresightEnd):
            return shown(last, np.broadcast_to(end.direction, (len(q), 3))) - end.axis
        return to_rotation_vector(multiply(np.broadcast_to(end.quaternion, last.shape), conjugate(last)))

    def _cone_violations(self, q: FloatArray) -> FloatArray:
        """Return the violations (m, cones * n) of the cones by m paths, as differences of cosines."""
        return np.maximum(0.0, _ROOM - self._kept.values(q[:, None, 1:])).reshape(len(q), -1)

    def _propagated(self, sums: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return attitudes (m, n, 4) by the midpoint rule and momenta (m, n, 3) for amplitudes (m, d)."""
        momentum = self._base + np.tensordot(sums, self._modes, 1)
        half = 0.5 * self._scale / (momentum.shape[1] - 1)
        middle = 0.5 * (momentum[:, 1:] + momentum[:, :-1])
        q = np.empty((*momentum.shape[:2], 4))
        q[:, 0] = self._start[:4]
        for k in range(middle.shape[1]):
            before = q[:, k]
            between = _unit(before + half * self._slope(before, momentum[:, k]))
            q[:, k + 1] = _unit(before + 2.0 * half * self._slope(between, middle[:, k]))
        return q, momentum

    def _slope(self, q: FloatArray, momentum: FloatArray) -> FloatArray:
        """Return the time derivatives (m, 4) of quaternions (m, 4) for angular momenta (m, 3)."""
        rate = 0.5 * shown(q, momentum) @ self._lighter.T
        v, s = q[:, :3], q[:, 3:]
        return np.concatenate([cross(v, rate) + s * rate, -np.sum(v * rate, axis=1, keepdims=True)], axis=1)


def _unit(q: FloatArray) -> FloatArray:
    return np.asarray(q / np.sqrt(np.sum(q * q, axis=1, keepdims=True)))


ENOUGH = 3
"""Number of paths without the dipole limit from which the best path is chosen."""
LONGER = 1.0, 1.4, 2.0, 2.8
"""Factors by which the requested duration is multiplied, one after the other, until a path is found."""
_COARSE_STEPS, _FINE_STEPS, _STRETCHED_STEPS = (1.2, 1.02), (1.02, 1.004), (1.02, 1.015)
"""First value: factor by which the first step shortens a slew. The shortening ends when the ratio of the
shortest duration with a path to the longest duration without a path is below the second value. The three
pairs are for the coarse grid, for the fine grid, and for slews without a time cost on the fine grid."""
_CROSSED = 1.3
"""Widening of a cone that a path crosses between two points, divided by the depth of the path inside the
cone."""
_BEYOND = math.radians(0.02)
"""Angle (rad) that is added to the widening of a crossed cone."""
_BETWEEN = 16
"""Number of intervals of an intermediate grid, used if a path from the coarse grid does not converge directly
on the fine grid."""
_LOST, _EASED_STEP = 1.5, 1.03
"""First value: ratio of the dipole to the dipole limit above which an integrated path is abandoned. If the
ratio is smaller, the duration is multiplied by the root of the ratio and by the second value."""
_PEAK = 0.9
"""Ratio of the largest dipole to the dipole limit at the first duration of a continuation."""
_LEAST_COST = 1.1
"""First duration of the continuation of a slew with a time cost, divided by the estimated best duration."""


class HorizonContinuation:
    """Continuation of the paths of a task, with stepwise changes of duration, dipole limit or cones."""

    def __init__(self, task: SlewTask, solver: SlewSolver, budget: float) -> None:
        """Create a continuation that ends when the solver's `work` exceeds `budget`."""
        self._task, self._solver, self._budget = task, solver, budget
        # Coarse paths from which no path on the fine grid was found.
        self._lost: set[tuple[float, float, float]] = set()

    def within(self, start: SolvedPath) -> SolvedPath | None:
        """Return a path within the limits on the fine grid, from a coarse path without the dipole limit."""
        solver, nodes, time = self._solver, self._task.nodes, start.horizon
        if solver.is_kept(start):
            equations = solver.equations(time, nodes)
            fine = solver.free(equations, transferred(start, equations))
            if fine is not None and solver.is_kept(fine):
                return fine
        coarse = self._over(start, time)
        return None if coarse is None else self._finer(coarse, time, LAST_BARRIER)

    def shortened(self, relaxed: list[SolvedPath], shortest: float, time_cost: float) -> SolvedPath | None:
        """Return the best path found by shortening the slew as long as this reduces energy plus time cost.

        The continuation starts from the shortest paths in `relaxed` that satisfy the limit.
        """
        best: SolvedPath | None = None
        for start in sorted(self.distinct(relaxed), key=self._fastest)[:ENOUGH]:
            ways = (self._over(start, time) for time in self._begins(start, shortest, time_cost))
            begun = next(filter(None, ways), None)
            if begun is None:
                continue
            if self._task.cones:
                begun = self._finer(begun, begun.horizon, WALK_BARRIER) or begun
            ended = self._walked(begun, shortest, time_cost, _COARSE_STEPS)
            if best is None or self._value(ended, time_cost) < self._value(best, time_cost):
                best = ended
            if best.horizon <= shortest or self._solver.work > self._budget:
                break
        return None if best is None else self._refined(best, shortest, time_cost)

    def distinct(self, relaxed: list[SolvedPath]) -> list[SolvedPath]:
        """Return the paths `relaxed` without duplicates, sorted by energy."""
        ordered = sorted(relaxed, key=self._solver.energy)
        costs = [(found.horizon, self._solver.energy(found)) for found in ordered]
        return ordered[:1] + [
            found
            for found, (before, cost) in zip(ordered[1:], pairwise(costs), strict=True)
            if not np.allclose(cost, before, rtol=1e-4, atol=0.0)
        ]

    def widened(self, found: SolvedPath, depths: FloatArray) -> SolvedPath | None:
        """Return a path outside widened cones, found from a path that enters cones between points, or None.

        The array `depths` (cones, 2 nodes), rad, contains the largest depth inside each cone between two
        neighbouring points. The cones at the last point of the path are not widened.
        """
        wider = np.where(depths > 0.0, _CROSSED * depths + _BEYOND, 0.0)
        both = wider.copy()
        both[:, :-1] = np.maximum(wider[:, :-1], wider[:, 1:])
        both[:, -1] = 0.0
        self._solver.extra = self._solver.extra + both
        return self._solver.limited(found, found.equations.count, found.horizon, LAST_BARRIER)

    def eased(self, found: SolvedPath, peak: float) -> SolvedPath | None:
        """Return a path with smaller dipoles, found from a path whose dipole reaches `peak` times the limit.

        The new path uses a smaller fraction of the dipole limit. If no path with smaller dipoles exists or
        the duration is free, the new path has a longer duration. Returns None if no path is found.
        """
        task, solver, time = self._task, self._solver, found.horizon
        if peak > _LOST:
            return None
        solver.share /= peak
        if task.time_cost is None and time <= task.horizon * (1.0 + 1e-6):
            eased = solver.limited(found, task.nodes, time, LAST_BARRIER)
            if eased is not None:
                return eased
        time *= _EASED_STEP * math.sqrt(peak)
        if time > task.longest or blocking_cone(task, time) is not None:
            return None
        return solver.limited(found, task.nodes, time, LAST_BARRIER)

    def _refined(self, best: SolvedPath, shortest: float, time_cost: float) -> SolvedPath | None:
        """Return the best path on the fine grid, found by continuation from a path on the coarse grid."""
        times = best.horizon * np.array([1.0, 1.02, 1.1])
        longer = (self._finer(best, float(time), WALK_BARRIER) for time in times)
        fine = next(filter(None, longer), None)
        if fine is None:
            return None
        ratios = _STRETCHED_STEPS if self._task.time_cost is None else _FINE_STEPS
        fine = self._walked(fine, shortest, time_cost, ratios)
        return self._solver.limited(fine, self._task.nodes, fine.horizon, LAST_BARRIER) or fine

    def _finer(self, coarse: SolvedPath, time: float, last: float) -> SolvedPath | None:
        """Return a path of `time` s on the fine grid, found from a path on the coarse grid, or None."""
        nodes, solver = self._task.nodes, self._solver
        key = (coarse.horizon, solver.energy(coarse), time)
        if key in self._lost:
            return None
        fine = solver.limited(coarse, nodes, time, last)
        if fine is None and nodes > _BETWEEN:
            middle = solver.limited(coarse, _BETWEEN, time, WALK_BARRIER)
            fine = None if middle is None else solver.limited(middle, nodes, time, last)
        if fine is None:
            self._lost.add(key)
        return fine

    def _walked(
        self, best: SolvedPath, shortest: float, time_cost: float, ratios: tuple[float, float]
    ) -> SolvedPath:
        """Return the best path found by shortening the slew in steps that become smaller."""
        (first, last), failed = ratios, 0.0
        while best.horizon > max(shortest, last * failed) and self._solver.work < self._budget:
            time = max(best.horizon / first, shortest, math.sqrt(best.horizon * failed))
            further = self._over(best, time)
            if further is not None and self._value(further, time_cost) < self._value(best, time_cost):
                best = further
            else:
                failed = time
        return best

    def _fastest(self, found: SolvedPath) -> float:
        """Return the approximate shortest duration, s, of a path that satisfies the dipole limit."""
        return found.horizon * math.sqrt(self._solver.peak(found) / _PEAK)

    def _begins(self, start: SolvedPath, shortest: float, time_cost: float) -> list[float]:
        """Return the durations, s, at which the continuation of the path `start` may begin, the best first.

        The heat of a slew is about inversely proportional to the third power of its duration T, so the heat
        k / T^3 plus a time cost c T is least at T^4 = 3 k / c. With a time cost, the continuation begins near
        this duration.
        """
        time = max(self._fastest(start), shortest)
        times = [time, start.horizon] if time < start.horizon else [longer * time for longer in LONGER]
        if math.isfinite(time_cost):
            heat = self._solver.energy(start) * start.horizon**3
            cheapest = min(_LEAST_COST * (3.0 * heat / time_cost) ** 0.25, self._task.longest)
            times += [each for each in (cheapest, math.sqrt(cheapest * start.horizon)) if each > time]
            times.sort(key=lambda each: heat / each**3 + time_cost * each)
        if start.horizon == self._task.horizon and self._task.time_cost is None and start.horizon in times:
            times.remove(start.horizon)  # already tried
        task = self._task
        return [each for each in times if each <= task.longest and blocking_cone(task, each) is None]

    def _value(self, found: SolvedPath, time_cost: float) -> float:
        """Return the energy plus time cost of a path, J, or only the duration, s, for a minimum-time slew."""
        return (
            found.horizon if math.isinf(time_cost) else self._solver.energy(found) + time_cost * found.horizon
        )

    def _over(self, start: SolvedPath, time: float) -> SolvedPath | None:
        """Return the minimum-energy path of `time` s within the limits, found from the path `start`."""
        return self._solver.limited(start, start.equations.count, time, WALK_BARRIER)


GRIDS, GRIDS_WITH_CONES = ((10, 5000),), ((12, 3500), (16, 3000))
"""Number of collocation intervals of each successive search, and its budget of work. When the work, measured
in Newton steps times intervals, exceeds the budget, no further guess is tried. A search with a work of 1,000
(in this unit) takes about 0.1 s. Searches with exclusion cones begin with 12 intervals, because on ten
intervals a path around a cone differs too much from the path on the fine grid."""
_WALKS = 1.8
"""Computational effort, as a multiple of the budget of a search, after which the continuation ends with the
best path so far."""
_MAXIMUM_TRIED = 16
"""Largest number of initial guesses that are tried for one duration."""
_LOOK = 8
"""Number of Newton steps from a guess to the first check of the constraint violation."""
_FURTHER, _FURTHER_WITH_CONES = ((17, 1.5),), ((12, 1.0), (20, 0.4))
"""Further stages of the iteration from a guess: the number of Newton steps of each stage, and the upper limit
of the constraint violation at the start of the stage. If the violation is larger, the guess is deferred.
After eight steps, the violation is below 1.5 for four of five successful guesses, and above 1.5 for three of
four unsuccessful guesses (320 guesses, seed 41 of the bench `orbit_slews`)."""
_STEPS_WITHOUT_PATH = 120
"""Number of Newton steps without a path after which the remaining guesses for the same slew duration are
deferred."""
_WIDENED = 4
"""Maximum number of corrections of one path by widening cones or reducing dipoles."""


class SlewSearch:
    """The search for the path of one slew task.

    The attribute `tried` counts the initial guesses. The attribute `least` is the smallest ratio of the peak
    dipole to the dipole limit among the paths of the requested duration that were found without the dipole
    limit, or infinity if no such path was found.
    """

    def __init__(self, task: SlewTask, coarse: int, budget: int) -> None:
        """Create a search that starts on `coarse` intervals and ends when the work exceeds `budget`."""
        self._task, self._budget = task, budget
        self.solver = SlewSolver(task)
        self._walker = HorizonContinuation(task, self.solver, _WALKS * budget)
        self._coarse = min(task.nodes, coarse)
        self._further = _FURTHER_WITH_CONES if task.cones else _FURTHER
        self._widened = 0
        self._known: list[float] = []  # heats (J) of the tried paths without the dipole limit
        self.tried, self.least = 0, math.inf

    def paths(self) -> Iterator[SolvedPath]:
        """Yield paths that satisfy all limits at nodes and midpoints, the best path first."""
        time_cost = self._task.time_cost
        for batches in self._rungs():
            relaxed: list[SolvedPath] = []
            for batch in batches:
                relaxed += batch
                asked = [found for found in batch if found.horizon == self._task.horizon]
                self.least = min([self.least, *map(self.solver.peak, asked)])
                if time_cost is None:
                    yield from self._tried(self._cheapest(batch))
                elif (found := self._walker.shortened(batch, HORIZON_RANGE[0], time_cost)) is not None:
                    yield from self._tried([found])
            if time_cost is not None or not relaxed:
                continue
            if (found := self._walker.shortened(relaxed, self._task.horizon, MINIMUM_TIME)) is not None:
                yield from self._tried([found])

    def widened(self, found: SolvedPath, depths: FloatArray) -> SolvedPath | None:
        """Return a path outside the cones, starting from a path that crosses cones with the given `depths`.

        The array `depths` (cones, 2 nodes) contains the largest depth inside each cone between neighbouring
        points of the path. Returns None if no path is found or the path was corrected too often.
        """
        self._widened += 1
        return self._walker.widened(found, depths) if self._widened <= _WIDENED else None

    def eased(self, found: SolvedPath, peak: float) -> SolvedPath | None:
        """Return a path with smaller dipoles than the path `found`, which reaches `peak` times the limit."""
        self._widened += 1
        return self._walker.eased(found, peak) if self._widened <= _WIDENED else None

    def _tried(self, paths: list[SolvedPath]) -> Iterator[SolvedPath]:
        """Yield the paths. After the trial of each, cones and dipole limit of the solver are reset."""
        for path in paths:
            yield path
            self._widened, self.solver.share = 0, 1.0
            self.solver.extra = np.zeros_like(self.solver.extra)

    def _rungs(self) -> Iterator[Iterator[list[SolvedPath]]]:
        """Yield paths without the dipole limit, first of the requested duration and then of longer durations.

        Paths from deferred initial guesses come last. Longer slews converge more often, because the field
        rotates more during a longer slew.
        """
        deferred: list[NewtonRun] = []
        for longer in LONGER:
            horizon = min(longer * self._task.horizon, self._task.longest)
            if self.solver.work < self._budget and blocking_cone(self._task, horizon) is None:
                yield self._relaxed(horizon, deferred)
            if horizon == self._task.longest:
                break
        yield self._late(deferred)

    def _relaxed(self, horizon: float, deferred: list[NewtonRun]) -> Iterator[list[SolvedPath]]:
        """Yield batches of paths without the dipole limit. Append slowly converging guesses to `deferred`."""
        batch: list[SolvedPath] = []
        solver, patience = self.solver, self.solver.steps + _STEPS_WITHOUT_PATH
        equations = solver.equations(horizon, self._coarse)
        for guess in guesses(equations, self._task.craft, solver.kept(equations))[:_MAXIMUM_TRIED]:
            self.tried += 1
            descent = solver.descent(solver.equations(horizon, self._coarse), guess)
            if solver.steps > patience and not batch:
                deferred.append(descent)
                continue
            found = solver.found(descent, _LOOK)
            for steps, lack in self._further:
                if found is None and descent.lack < lack:
                    found = solver.found(descent, steps, MET)
            if found is not None:
                batch.append(found)
            elif not descent.is_over:
                deferred.append(descent)
            if len(batch) == ENOUGH:
                yield batch
                batch, patience = [], solver.steps + _STEPS_WITHOUT_PATH
        if batch:
            yield batch

    def _late(self, deferred: list[NewtonRun]) -> Iterator[list[SolvedPath]]:
        """Yield paths without the dipole limit from deferred guesses, in order of constraint violation."""
        for descent in sorted(deferred, key=lambda descent: descent.lack):
            if self.solver.work > self._budget:
                break
            found = self.solver.found(descent, self._further[-1][0], MET)
            if found is not None:
                yield [found]

    def _cheapest(self, batch: list[SolvedPath]) -> list[SolvedPath]:
        """Return paths of the requested duration within the limits, the path of least energy first."""
        kept: list[SolvedPath] = []
        energy = self.solver.energy
        for start in self._walker.distinct([start for start in batch if start.horizon <= self._task.horizon]):
            if (kept and energy(start) >= min(map(energy, kept))) or self.solver.work > self._budget:
                break
            if any(math.isclose(energy(start), known, rel_tol=1e-4) for known in self._known):
                continue  # a path of the same energy was tried without success
            self._known.append(energy(start))
            found = self._walker.within(start)
            if found is not None:
                kept.append(found)
        return sorted(kept, key=energy)
