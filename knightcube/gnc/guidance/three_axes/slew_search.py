"""The search for the path of a slew: guesses on a coarse grid, then paths within the limits, then refined.

Initial guesses are curves of the angular momentum. Coils make no torque along the field, so the derivative of
the inertial momentum is normal to the field everywhere. This condition is linear: the momenta that reach the
end are a fixed curve plus any sum of modes. The attitude follows from the momentum. A curve that ends in the
target, keeps the cones and needs little heat has about a dozen unknowns and is found by least squares from
many random starts at once. The gravity gradient and other torques are left to the planner. The random starts
are the same in every call.

Without the dipole limit, a path that keeps the cones is found from most guesses in a dozen Newton steps. Its
heat is a lower bound of the heat within the limit. A guess with large constraint violations after some steps
is deferred, because most of these never converge. If the requested horizon does not suffice, or none of its
guesses leads to a path, a longer slew is shortened by continuation.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import attitude_matrix, conjugate, multiply, to_rotation_vector
from knightcube.gnc.guidance.three_axes.slew_model import (
    HermiteCubic,
    SlewCraft,
    SlewDynamics,
    SlewEnvironment,
    SlewPath,
    cross,
    shown,
)
from knightcube.gnc.guidance.three_axes.slew_program import (
    FIRST_BARRIER,
    Iterate,
    NewtonRun,
    SlewLimits,
    SlewProgram,
    Trajectory,
    Transcription,
)
from knightcube.gnc.guidance.three_axes.slew_task import (
    HORIZON_RANGE,
    LEAST_TIME,
    BoresightEnd,
    ConeConstraints,
    End,
    SlewTask,
    in_the_way,
)

WALK_BARRIER, LAST_BARRIER = 1e-5, 1e-8
"""Of a path that others begin from, and of one that is flown."""
MET, _FLOWN_MET = 1e-2, 3e-3
"""Sum of all violations below which a path that others begin from is one, though no optimum yet, and at last
one that is flown: many come to their optimum slowly. What is missed is mended by the closing."""
_STEPS_FREE = 25
"""Newton steps of a path without the dipoles' limit."""
_LOOKS = (12, 1.2), (8, 0.2), (40, 0.0)
"""Newton steps within limits, one after the other, and from which lack on a way is left after them: half of
those that lead nowhere are after the first, one in twenty of the others is."""


@dataclass(frozen=True, slots=True, eq=False)
class SolvedPath:
    """A solved path."""

    program: SlewProgram
    point: Iterate

    @property
    def equations(self) -> Transcription:
        """Its equations."""
        return self.program.equations

    @property
    def at(self) -> Trajectory:
        """The trajectory."""
        return self.point.at

    @property
    def horizon(self) -> float:
        """The duration, s."""
        return self.equations.scale


class SlewSolver:
    """Solves for one task; `unit` A m^2 is that of its dipoles.

    `extra` (cones, 2 nodes) rad is added to its cones at the points of the fine grid; `share` of the dipoles'
    limit is used. `steps` are Newton's so far, `work` those times the intervals.
    """

    def __init__(self, task: SlewTask) -> None:
        self._task = task
        self.unit = float(np.mean(task.craft.limit))
        self._limit = task.craft.limit / self.unit
        self._full = task.craft.weights / float(task.craft.weights @ self._limit**2)
        self.extra = np.zeros((len(task.cones), 2 * task.nodes))
        self.share = 1.0
        self.steps = self.work = 0

    def energy(self, found: SolvedPath) -> float:
        """Return the heat of a path, J."""
        equations = found.equations
        power = float(self._task.craft.weights @ self._task.craft.limit**2)
        return equations.cost(found.at) * equations.scale * power / float(equations.weights @ self._limit**2)

    def peak(self, found: SolvedPath) -> float:
        """Return the largest dipole of a path over its limit."""
        return float((np.abs(found.at.dipoles) / self._limit).max())

    def is_kept(self, found: SolvedPath) -> bool:
        """Return whether a relaxed path keeps it."""
        kept = self.kept(found.equations).values(found.at.states[1:, :4])
        return self.peak(found) <= 1.0 and bool(np.all(kept >= 0.0))

    def equations(self, scale: float, count: int) -> Transcription:
        """Return the equations over `scale` s on `count` intervals."""
        task = self._task
        start = np.concatenate([task.quaternion, scale * task.rate])
        return Transcription(task.craft, self.unit, task.along, start, task.end, count, scale, self._full)

    def free(self, equations: Transcription, guess: Trajectory) -> SolvedPath | None:
        """Return the path that is flown, without the dipoles' limit, from a guess."""
        return self.found(self.descent(equations, guess, LAST_BARRIER), _STEPS_FREE)

    def descent(self, equations: Transcription, guess: Trajectory, last: float = WALK_BARRIER) -> NewtonRun:
        """Return the way from a guess to a path that keeps the cones, without the dipoles' limit."""
        equations.weights = self._full / max(equations.cost(guess), 1e-9)
        return NewtonRun(
            SlewProgram(equations, SlewLimits(equations, None, self.kept(equations))), guess, last=last
        )

    def limited(self, start: SolvedPath, count: int, time: float, last: float) -> SolvedPath | None:
        """Return the path within all limits on `count` intervals over `time` s, from one near it."""
        equations = self.equations(time, count)
        at, before = transferred(start, equations), start.equations.weights
        equations.weights = self._full / max(equations.cost(at), 1e-9)
        same = count == start.equations.count
        price = start.point.price * float(equations.weights[0] / before[0]) if same else None
        limit = self.share * self._limit
        near = same and time == start.horizon and self.peak(start) < self.share
        if not near and (last == LAST_BARRIER or self.peak(start) > self.share):
            at = Trajectory(at.states, np.clip(at.dipoles, -0.98 * limit, 0.98 * limit))
        return self._led(equations, at, price, (WALK_BARRIER if near else FIRST_BARRIER, last))

    def again(self, path: SlewPath) -> SolvedPath | None:
        """Return the path within all limits near one of a task that is nearly the same."""
        equations = self.equations(path.horizon, (len(path.times) - 1) // 2)
        states = np.concatenate([path.quaternion, path.horizon * path.rate], axis=1)
        at = Trajectory(states, path.dipole[::2] / self.unit)
        equations.weights = self._full / max(equations.cost(at), 1e-9)
        return self._led(equations, at, None, (WALK_BARRIER, LAST_BARRIER))

    def _led(
        self,
        equations: Transcription,
        at: Trajectory,
        price: FloatArray | None,
        barriers: tuple[float, float],
    ) -> SolvedPath | None:
        """Return the path within all limits that a trajectory leads to; barriers fall from first to last."""
        limits = SlewLimits(equations, self.share * self._limit, self.kept(equations))
        descent = NewtonRun(SlewProgram(equations, limits), at, price, *barriers)
        found = None
        for look, (steps, lack) in enumerate(_LOOKS):
            enough = _FLOWN_MET * (look == len(_LOOKS) - 1)
            if look and barriers[1] == WALK_BARRIER:
                enough = MET
            found = self.found(descent, steps, enough)
            if found is not None or descent.lack >= lack:
                break
        return found

    def found(self, descent: NewtonRun, most: int, enough: float = 0.0) -> SolvedPath | None:
        """Return the path found within `most` more steps, None without one.

        It need not be an optimum where the violations sum to less than is `enough`.
        """
        program, before = descent.program, descent.program.steps
        point = descent.run(most)
        if point is None and descent.missed < enough:
            point = descent.point
        self.steps += program.steps - before
        self.work += (program.steps - before) * program.equations.count
        if point is None or not program.equations.end.is_met(point.at.states[-1, :4]):
            return None
        return SolvedPath(program, point)

    def kept(self, equations: Transcription) -> ConeConstraints:
        """Return the cones at the points of equations but the first."""
        wider = self.extra if self.extra.shape[1] == 2 * equations.count else 0.0
        return ConeConstraints(self._task.cones, np.asarray(wider), equations.times[1:])


def transferred(start: SolvedPath, equations: Transcription) -> Trajectory:
    """Return a path on the grid and over the horizon of other equations.

    Slower by a ratio, the same way takes dipoles smaller by its square.
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
"""Random begins, and how large: of the torque of half a turn."""
_COSINES = 6
"""Of the torque in time, each along three axes."""
_ROUNDS = 12
_END, _CONE, _HEAT = 4.0, 2.0, 0.05
"""Weights: of a radian that the end misses, of a cone's cosine, and of the torque of half a turn."""
_ROOM = 0.03
"""Of a cone's cosine, that a guess keeps off."""
_DAMPED = 1.0
_LONGEST_STEP = 4.0
"""Torques of half a turn."""
_WEAK, _WEAK_END = 1e-3, 0.03
"""Modes of less heat, and directions of the momentum that are reached less, are left out."""
_MISSED, _INSIDE_CONE = 0.1, 0.02
"""rad off the target, and of a cone's cosine, from which a guess comes after those that miss by less."""
_SAME = 0.1
"""Curves that differ by less of their size are one."""


def guesses(
    motion: SlewDynamics,
    craft: SlewCraft,
    start: FloatArray,
    end: End,
    around: SlewEnvironment,
    kept: ConeConstraints,
    scale: float,
) -> list[Trajectory]:
    """Return guesses from a state (7,) to the end over `scale` s, the promising ones first.

    `around` (2 k + 1) acts, the cones of `kept` are kept.
    """
    curves = _curves(craft, around, start, end, scale)
    fit = _MomentumFit(curves, craft, start, end, kept, scale)
    found = []
    for states in fit.found():
        found.append(Trajectory(states, _dipoles(motion, craft, states)[::2]))
    return found


@dataclass(frozen=True, slots=True, eq=False)
class _MomentumCurves:
    """Momenta at n times, kg m^2/s, ICRS: base (n, 3) and modes (d, n, 3), in torques of half a turn."""

    base: FloatArray
    modes: FloatArray


def _curves(
    craft: SlewCraft, around: SlewEnvironment, start: FloatArray, end: End, scale: float
) -> _MomentumCurves:
    """Return the momenta from the start's to the end's, whose modes take heat independently."""
    count = len(around.field)
    step, strength = scale / (count - 1), np.linalg.norm(around.field, axis=1)
    field = around.field / strength[:, None]
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
    return _MomentumCurves(begun + np.tensordot(fixed, curves, 1), free)


def _momentum(craft: SlewCraft, q: FloatArray, rate: FloatArray) -> FloatArray:
    """Return the momentum (3,) of an attitude (4,) at a rate (3,) rad/s, both vectors ICRS."""
    turned = attitude_matrix(q)
    return np.asarray(turned.T @ craft.inertia @ turned @ rate)


class _MomentumFit:
    """Least squares, by Levenberg and Marquardt, of many sums of the modes at once."""

    def __init__(
        self,
        curves: _MomentumCurves,
        craft: SlewCraft,
        start: FloatArray,
        end: End,
        kept: ConeConstraints,
        scale: float,
    ) -> None:
        self._curves, self._start, self._end, self._kept = curves, start, end, kept
        self._scale, self._lighter = scale, np.linalg.inv(craft.inertia)

    def found(self) -> list[FloatArray]:
        """Return states (n, 7) of the guesses, the promising ones first, each once."""
        sums = self._fitted()
        q, momentum = self._flown(sums)
        missed, crossed = self._missed(q), self._crossed(q)
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
        """Return sums (m, d) that miss least."""
        count = len(self._curves.modes)
        sums = _SPREAD * np.random.default_rng(16).normal(size=(_BEGINS, count))
        left = self._left(sums)
        damped, small = np.full(_BEGINS, _DAMPED), 1e-4
        for _ in range(_ROUNDS):
            near = (sums[:, None] + small * np.eye(count)).reshape(-1, count)
            slopes = (self._left(near).reshape(_BEGINS, count, -1) - left[:, None]) / small
            squares = slopes @ slopes.transpose(0, 2, 1) + damped[:, None, None] * np.eye(count)
            steps = -np.linalg.solve(squares, slopes @ left[:, :, None])[:, :, 0]
            size = np.linalg.norm(steps, axis=1, keepdims=True)
            there = sums + steps * np.minimum(1.0, _LONGEST_STEP / np.maximum(size, 1e-9))
            then = self._left(there)
            better = np.sum(then**2, axis=1) < np.sum(left**2, axis=1)
            sums, left = np.where(better[:, None], there, sums), np.where(better[:, None], then, left)
            damped = np.where(better, 0.2 * damped, 5.0 * damped)
        return np.asarray(sums)

    def _left(self, sums: FloatArray) -> FloatArray:
        """Return what is to be least (m, n) of sums (m, d)."""
        q, _ = self._flown(sums)
        return np.concatenate([_END * self._missed(q), _CONE * self._crossed(q), _HEAT * sums], axis=1)

    def _missed(self, q: FloatArray) -> FloatArray:
        """Return by what (m, 3) rad paths (m, n, 4) miss the end, of a boresight its sine."""
        end, last = self._end, q[:, -1]
        if isinstance(end, BoresightEnd):
            return shown(last, np.broadcast_to(end.direction, (len(q), 3))) - end.axis
        return to_rotation_vector(multiply(np.broadcast_to(end.quaternion, last.shape), conjugate(last)))

    def _crossed(self, q: FloatArray) -> FloatArray:
        """Return how deep (m, cones n) paths lie within the cones, of the cosine."""
        return np.maximum(0.0, _ROOM - self._kept.values(q[:, None, 1:])).reshape(len(q), -1)

    def _flown(self, sums: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the attitudes (m, n, 4) and momenta (m, n, 3) of sums (m, d), by the midpoint rule."""
        momentum = self._curves.base + np.tensordot(sums, self._curves.modes, 1)
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
        """Return q' (m, 4) at attitudes (m, 4) with momenta (m, 3)."""
        rate = 0.5 * shown(q, momentum) @ self._lighter.T
        v, s = q[:, :3], q[:, 3:]
        return np.concatenate([cross(v, rate) + s * rate, -np.sum(v * rate, axis=1, keepdims=True)], axis=1)


def _unit(q: FloatArray) -> FloatArray:
    return np.asarray(q / np.sqrt(np.sum(q * q, axis=1, keepdims=True)))


def _dipoles(motion: SlewDynamics, craft: SlewCraft, states: FloatArray) -> FloatArray:
    """Return the least dipoles (n, 3) for the part of the states' torque that lies across the field."""
    still = motion.flow(states, np.zeros((len(states), 3)))
    wanted = np.gradient(states[:, 4:], 1.0 / (len(states) - 1), axis=0) - still[:, 4:]
    field = motion.field(states[:, :4])
    return np.asarray(cross(field, wanted @ craft.inertia) / np.sum(field * field, axis=1, keepdims=True))


ENOUGH = 3
"""Relaxed paths of which the best is taken."""
LONGER = 1.0, 1.4, 2.0, 2.8
"""Times a horizon that does not suffice."""
_COARSE_STEPS, _FINE_STEPS, _STRETCHED_STEPS = (1.2, 1.02), (1.02, 1.004), (1.02, 1.015)
"""Ratios of horizons on the walk to a shorter one, the first and the last: on the coarse grid, on the fine
one, and there where a slew is only to be stretched."""
_CROSSED = 1.3
"""Times the depth to which a path crosses a cone between the points, the cone is widened there."""
_BEYOND = math.radians(0.02)
"""rad, by which it is widened besides."""
_BETWEEN = 16
"""Intervals of a path from which the fine grid is reached where it is not from the coarse one."""
_LOST, _EASED_STEP = 1.5, 1.03
"""Of the limit, beyond which a path is lost when flown; and how much longer one beyond the limit takes."""
_PEAK = 0.9
"""Of the limit: the dipole of the slew at which the walk begins."""


class HorizonContinuation:
    """Walks of one task."""

    def __init__(self, task: SlewTask, solver: SlewSolver, budget: float) -> None:
        """After a `budget` of work no other step of a walk is begun."""
        self._task, self._solver, self._budget = task, solver, budget
        self._lost: set[tuple[float, float, float]] = set()  # coarse paths that led to no fine one

    def within(self, start: SolvedPath) -> SolvedPath | None:
        """Return the path within the limits, on the fine grid, near a coarse one without."""
        solver, nodes, time = self._solver, self._task.nodes, start.horizon
        if solver.is_kept(start):
            equations = solver.equations(time, nodes)
            fine = solver.free(equations, transferred(start, equations))
            if fine is not None and solver.is_kept(fine):
                return fine
        coarse = self._over(start, time)
        return None if coarse is None else self._finer(coarse, time, LAST_BARRIER)

    def shortened(self, relaxed: list[SolvedPath], least: float, price: float) -> SolvedPath | None:
        """Return the best path on walks to shorter horizons, as long as `price` W makes them cheaper.

        A walk begins where a relaxed path just keeps the dipoles', with the path that needs the least
        time for that.
        """
        best: SolvedPath | None = None
        for start in sorted(self.distinct(relaxed), key=self._fastest)[:ENOUGH]:
            times = self._begins(start, least)
            ways = (self._over(start, time) for time in times)
            begun = next(filter(None, ways), None)
            if begun is None:
                continue
            if self._task.cones:
                begun = self._finer(begun, begun.horizon, WALK_BARRIER) or begun
            ended = self._walked(begun, least, price, _COARSE_STEPS)
            if best is None or self._value(ended, price) < self._value(best, price):
                best = ended
            if best.horizon <= least or self._solver.work > self._budget:
                break
        return None if best is None else self._refined(best, least, price)

    def distinct(self, relaxed: list[SolvedPath]) -> list[SolvedPath]:
        """Return relaxed paths, the cheapest first, each once."""
        ordered = sorted(relaxed, key=self._solver.energy)
        costs = [(found.horizon, self._solver.energy(found)) for found in ordered]
        return ordered[:1] + [
            found
            for found, (before, cost) in zip(ordered[1:], pairwise(costs), strict=True)
            if not np.allclose(cost, before, rtol=1e-4, atol=0.0)
        ]

    def widened(self, found: SolvedPath, depths: FloatArray) -> SolvedPath | None:
        """Return a path near one that crosses cones between the points, None without one.

        `depths` (cones, 2 nodes) rad are those between each two points. The last point stays where it is.
        """
        wider = np.where(depths > 0.0, _CROSSED * depths + _BEYOND, 0.0)
        both = wider.copy()
        both[:, :-1] = np.maximum(wider[:, :-1], wider[:, 1:])
        both[:, -1] = 0.0
        self._solver.extra = self._solver.extra + both
        return self._solver.limited(found, found.equations.count, found.horizon, LAST_BARRIER)

    def eased(self, found: SolvedPath, peak: float) -> SolvedPath | None:
        """Return a path near one whose dipoles take `peak` of their limit when flown, None without one.

        It uses less of the limit, or takes longer where that leads to none or the horizon is not asked.
        """
        task, solver, time = self._task, self._solver, found.horizon
        if peak > _LOST:
            return None
        solver.share /= peak
        if task.time_price is None and time <= task.horizon * (1.0 + 1e-6):
            eased = solver.limited(found, task.nodes, time, LAST_BARRIER)
            if eased is not None:
                return eased
        time *= _EASED_STEP * math.sqrt(peak)
        if time > task.longest or in_the_way(task, time) is not None:
            return None
        return solver.limited(found, task.nodes, time, LAST_BARRIER)

    def _refined(self, best: SolvedPath, least: float, price: float) -> SolvedPath | None:
        """Return the best path on the fine grid, by a walk that begins with a coarse one."""
        times = best.horizon * np.array([1.0, 1.02, 1.1])
        longer = (self._finer(best, float(time), WALK_BARRIER) for time in times)
        fine = next(filter(None, longer), None)
        if fine is None:
            return None
        ratios = _STRETCHED_STEPS if self._task.time_price is None else _FINE_STEPS
        fine = self._walked(fine, least, price, ratios)
        return self._solver.limited(fine, self._task.nodes, fine.horizon, LAST_BARRIER) or fine

    def _finer(self, coarse: SolvedPath, time: float, last: float) -> SolvedPath | None:
        """Return a coarse path on the fine grid, over `time` s."""
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
        self, best: SolvedPath, least: float, price: float, ratios: tuple[float, float]
    ) -> SolvedPath:
        """Return the best path on a walk to shorter horizons, to the last ratio of one without a better."""
        (first, last), failed = ratios, 0.0
        while best.horizon > max(least, last * failed) and self._solver.work < self._budget:
            time = max(best.horizon / first, least, math.sqrt(best.horizon * failed))
            further = self._over(best, time)
            if further is not None and self._value(further, price) < self._value(best, price):
                best = further
            else:
                failed = time
        return best

    def _fastest(self, found: SolvedPath) -> float:
        """Return about which horizon a relaxed path takes for its dipoles to keep theirs, s."""
        return found.horizon * math.sqrt(self._solver.peak(found) / _PEAK)

    def _begins(self, start: SolvedPath, least: float) -> list[float]:
        """Return horizons at which a walk may begin from a relaxed path, s, the shortest first."""
        time = max(self._fastest(start), least)
        times = [time, start.horizon] if time < start.horizon else [longer * time for longer in LONGER]
        if start.horizon == self._task.horizon and self._task.time_price is None and start.horizon in times:
            times.remove(start.horizon)  # it was tried
        task = self._task
        return [each for each in times if each <= task.longest and in_the_way(task, each) is None]

    def _value(self, found: SolvedPath, price: float) -> float:
        """Return what a path costs, J; s where time alone counts."""
        return found.horizon if math.isinf(price) else self._solver.energy(found) + price * found.horizon

    def _over(self, start: SolvedPath, time: float) -> SolvedPath | None:
        """Return the path of least energy within the limits over `time` s, from one over another horizon."""
        return self._solver.limited(start, start.equations.count, time, WALK_BARRIER)


GRIDS, GRIDS_WITH_CONES = ((10, 5000),), ((12, 3500), (16, 3000))
"""Searches, one after the other: intervals, and the work, Newton steps times intervals, after which no other
guess is begun with. A thousand take about a tenth of a second. On ten intervals, what goes round cones is far
from what does on the fine grid."""
_WALKS = 1.8
"""Times the work of a search, after which a walk ends with what it has."""
_MOST_TRIED = 16
"""Guesses over one horizon."""
_LOOK = 8
"""Newton steps of every guess."""
_FURTHER, _FURTHER_WITH_CONES = ((17, 1.5),), ((12, 1.0), (20, 0.4))
"""How many more it is given, one after the other, where its equations lack less in all; else it is put off.
Four of five that lead to a path lack less than 1.5 after eight, three of four that do not lack more (320
guesses, seed 41 of the bench `orbit_slews`)."""
_PATIENCE = 120
"""Newton steps without a path, after which the other guesses over a horizon are put off."""
_WIDENED = 4
"""Times at most that cones are widened, and dipoles eased, for a path."""


class SlewSearch:
    """The search of one task; `tried` guesses."""

    def __init__(self, task: SlewTask, coarse: int, budget: int) -> None:
        """Search on `coarse` intervals; after a `budget` of work nothing else is begun with."""
        self._task, self._budget = task, budget
        self.solver = SlewSolver(task)
        self._walker = HorizonContinuation(task, self.solver, _WALKS * budget)
        self._coarse = min(task.nodes, coarse)
        self._further = _FURTHER_WITH_CONES if task.cones else _FURTHER
        self._widened = 0
        self._known: list[float] = []  # heats, J, of relaxed paths that were looked at
        self.tried = 0

    def paths(self) -> Iterator[SolvedPath]:
        """Yield paths within all limits at the nodes, the best first."""
        price = self._task.time_price
        for batches in self._rungs():
            relaxed: list[SolvedPath] = []
            for batch in batches:
                relaxed += batch
                if price is None:
                    yield from map(self._fresh, self._cheapest(batch))
                elif (found := self._walker.shortened(batch, HORIZON_RANGE[0], price)) is not None:
                    yield self._fresh(found)
            if price is not None or not relaxed:
                continue
            if (found := self._walker.shortened(relaxed, self._task.horizon, LEAST_TIME)) is not None:
                yield self._fresh(found)

    def widened(self, found: SolvedPath, depths: FloatArray) -> SolvedPath | None:
        """Return a path near one that crosses cones by `depths` (cones, 2 nodes) rad between the points.

        None without one.
        """
        self._widened += 1
        return self._walker.widened(found, depths) if self._widened <= _WIDENED else None

    def eased(self, found: SolvedPath, peak: float) -> SolvedPath | None:
        """Return a path near one whose dipoles, flown, take `peak` of their limit; None without one."""
        self._widened += 1
        return self._walker.eased(found, peak) if self._widened <= _WIDENED else None

    def _fresh(self, found: SolvedPath) -> SolvedPath:
        """Return a path whose cones are not widened, within the whole limit."""
        self._widened, self.solver.share = 0, 1.0
        self.solver.extra = np.zeros_like(self.solver.extra)
        return found

    def _rungs(self) -> Iterator[Iterator[list[SolvedPath]]]:
        """Yield relaxed paths over the asked horizon, longer ones, and at last from what was put off.

        The longer a slew, the more the field turns under way, and the nearer a guess is to a path.
        """
        put_off: list[NewtonRun] = []
        for longer in LONGER:
            horizon = min(longer * self._task.horizon, self._task.longest)
            if self.solver.work < self._budget and in_the_way(self._task, horizon) is None:
                yield self._relaxed(horizon, put_off)
            if horizon == self._task.longest:
                break
        yield self._late(put_off)

    def _relaxed(self, horizon: float, put_off: list[NewtonRun]) -> Iterator[list[SolvedPath]]:
        """Yield relaxed paths over a horizon, a few at a time; add to what is put off."""
        batch: list[SolvedPath] = []
        solver, least = self.solver, self.solver.steps + _PATIENCE
        for guess in self._guesses(horizon)[:_MOST_TRIED]:
            self.tried += 1
            descent = solver.descent(solver.equations(horizon, self._coarse), guess)
            if solver.steps > least and not batch:
                put_off.append(descent)
                continue
            found = solver.found(descent, _LOOK)
            for steps, lack in self._further:
                if found is None and descent.lack < lack:
                    found = solver.found(descent, steps, MET)
            if found is not None:
                batch.append(found)
            elif not descent.is_over:
                put_off.append(descent)
            if len(batch) == ENOUGH:
                yield batch
                batch, least = [], solver.steps + _PATIENCE
        if batch:
            yield batch

    def _late(self, put_off: list[NewtonRun]) -> Iterator[list[SolvedPath]]:
        """Yield relaxed paths from guesses that were put off, those that lack least first."""
        for descent in sorted(put_off, key=lambda descent: descent.lack):
            if self.solver.work > self._budget:
                break
            found = self.solver.found(descent, self._further[-1][0], MET)
            if found is not None:
                yield [found]

    def _guesses(self, horizon: float) -> list[Trajectory]:
        """Return guesses over a horizon, the promising ones first."""
        equations, craft = self.solver.equations(horizon, self._coarse), self._task.craft
        kept = self.solver.kept(equations)
        return guesses(
            equations.motion, craft, equations.start, equations.end, equations.around, kept, horizon
        )

    def _cheapest(self, batch: list[SolvedPath]) -> list[SolvedPath]:
        """Return paths within the limits over the asked horizon, the cheapest first."""
        kept: list[SolvedPath] = []
        energy = self.solver.energy
        for start in self._walker.distinct([start for start in batch if start.horizon <= self._task.horizon]):
            if (kept and energy(start) >= min(map(energy, kept))) or self.solver.work > self._budget:
                break
            if any(math.isclose(energy(start), known, rel_tol=1e-4) for known in self._known):
                continue  # it led nowhere before
            self._known.append(energy(start))
            found = self._walker.within(start)
            if found is not None:
                kept.append(found)
        return sorted(kept, key=energy)
