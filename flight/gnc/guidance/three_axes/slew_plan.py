"""The planner of slews in three axes with coils alone: least energy, least time, or a price of time.

Only torques across the field exist, so a path is planned together with its dipoles: collocation of the whole
motion (`slew_transcription`), Newton's method with barriers (`slew_program`), from several guesses
(`slew_prey`). Energy is the integral of the coils' heat, J. Pure and deterministic.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from flight.gnc.errors import PlanningError
from flight.gnc.guidance.three_axes.slew_cones import Cone, Kept
from flight.gnc.guidance.three_axes.slew_ends import EndLaw
from flight.gnc.guidance.three_axes.slew_limits import Limits
from flight.gnc.guidance.three_axes.slew_model import Along, Motion, SlewCraft
from flight.gnc.guidance.three_axes.slew_path import SlewPath
from flight.gnc.guidance.three_axes.slew_prey import guesses
from flight.gnc.guidance.three_axes.slew_program import Program
from flight.gnc.guidance.three_axes.slew_transcription import Trajectory, Transcription
from flight.gnc.math.arrays import FloatArray

NODES = 24
"""Intervals of the dipole. The heat is within 0.1 % of that on 48, the least time within 0.6 %."""
NODES_RANGE = (8, 96)
HORIZON_RANGE = (1.0, 2e4)
LEAST_TIME = math.inf
"""A price of time at which only time counts."""
_ENOUGH = 2
"""Solved guesses, of which the cheapest is flown."""
_MOST_TRIED = 8
_LONGER = 1.0, 1.4, 2.0, 2.8
"""Times the asked horizon, for paths without limits."""
_STEPS_FREE = 25
_STEPS_LIMITED = 40
_WALK_BARRIER, _LAST_BARRIER = 1e-5, 1e-8
_FIRST_STEP, _LAST_STEP = 1.2, 1.006
"""Ratios of horizons on the walk to a shorter one."""
_CONE_MARGINS = 0.0, math.radians(0.3), math.radians(2.0)
"""Added to every cone, the next where a path crosses it between the nodes."""
_PEAK = 0.9
"""Of the limit: the dipole of the slew at which the walk begins."""


class SlewStatus(StrEnum):
    """Whether the asked horizon was kept."""

    OPTIMAL = "optimal"
    STRETCHED = "stretched"


@dataclass(frozen=True, slots=True, eq=False)
class SlewTask:
    """What is asked for.

    Attributes:
        craft, along: the model; `along` counts times from the start of the slew.
        quaternion, rate: the start, (4,) ICRS into body and (3,) rad/s, body axes.
        end: the end of a slew of a given duration.
        horizon, longest: s; the horizon is stretched up to `longest` where it does not suffice.
        time_price: W; None keeps the horizon, LEAST_TIME wants the least one.
        cones: kept all the way.
    """

    craft: SlewCraft
    along: Along
    quaternion: FloatArray
    rate: FloatArray
    end: EndLaw
    horizon: float
    longest: float
    time_price: float | None = None
    cones: tuple[Cone, ...] = ()
    nodes: int = NODES


@dataclass(frozen=True, slots=True, eq=False)
class SlewPlan:
    """A path and its properties.

    Attributes:
        horizon_asked, horizon: s.
        energy: J, heat of the coils.
        peak: the largest dipole over its limit.
        clearance: rad, least distance outside each cone, in the order of the task's.
        steps: of Newton's method, over all guesses.
    """

    path: SlewPath
    status: SlewStatus
    horizon_asked: float
    horizon: float
    energy: float
    peak: float
    clearance: tuple[float, ...]
    steps: int


def plan_slew(task: SlewTask) -> SlewPlan:
    """Return the best plan found. Raises PlanningError with the reason when there is none."""
    _check(task)
    for margin in _CONE_MARGINS if task.cones else (0.0,):
        search = _Search(task, margin)
        found = search.within() if task.time_price is None else search.priced(task.time_price)
        if found is None:
            break
        plan = search.plan(found)
        if all(clear >= 0.0 for clear in plan.clearance):
            return plan
    raise PlanningError(
        f"no slew within the dipole's limit{' and outside the cones' * bool(task.cones)} was found over "
        f"{task.horizon:g} to {task.longest:g} s, from {search.tried} guesses"
    )


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """A solved path: its equations, the trajectory, and the equations' multipliers (size,)."""

    equations: Transcription
    at: Trajectory
    price: FloatArray

    @property
    def horizon(self) -> float:
        """The duration, s."""
        return self.equations.scale


class _Search:
    """Guesses, tried in the order of their promise; `scale` s is the horizon they are tried over."""

    def __init__(self, task: SlewTask, margin: float) -> None:
        self._task = task
        self._unit = float(np.mean(task.craft.limit))
        self._limit = task.craft.limit / self._unit
        self._full = task.craft.weights / float(task.craft.weights @ self._limit**2)
        self._kept = Kept(task.cones, margin)
        self.steps = self.tried = 0

    def within(self) -> Found | None:
        """Return the path of least energy over the asked horizon, or over the shortest longer one."""
        relaxed = self._relaxed()
        in_time = [start for start in relaxed if start.horizon <= self._task.horizon]
        for start in in_time:
            if self._is_kept(start):
                return start
        for start in in_time:
            found = self._limited(start, start.equations, _LAST_BARRIER)
            if found is not None:
                return found
        return self._shortened(relaxed, self._task.horizon, LEAST_TIME)

    def priced(self, price: float) -> Found | None:
        """Return the path of least energy plus `price` W times its horizon."""
        return self._shortened(self._relaxed(), HORIZON_RANGE[0], price)

    def _value(self, found: Found, price: float) -> float:
        """Return what a path costs, J; s where time alone counts."""
        return found.horizon if math.isinf(price) else self._energy(found) + price * found.horizon

    def _shortened(self, relaxed: list[Found], least: float, price: float) -> Found | None:
        """Return the best path on a walk to shorter horizons, as long as `price` W makes them cheaper.

        The walk begins where a path without limits just keeps the dipoles', and with the path that needs the
        least time for that.
        """
        best = next(filter(None, (self._at(*begin) for begin in self._begins(relaxed, least))), None)
        if best is None:
            return None
        step = _FIRST_STEP
        while step > _LAST_STEP and best.horizon > least:
            further = self._at(best, max(best.horizon / step, least))
            if further is not None and self._value(further, price) < self._value(best, price):
                best = further
            else:
                step = math.sqrt(step)
        return self._limited(best, best.equations, _LAST_BARRIER) or best

    def _begins(self, relaxed: list[Found], least: float) -> Iterator[tuple[Found, float]]:
        """Yield paths without limits, each with horizons at which a walk may begin, s, the shortest first."""
        for start in sorted(relaxed, key=self._peak):
            time = max(start.horizon * math.sqrt(self._peak(start) / _PEAK), least)
            times = [time, start.horizon] if time < start.horizon else [longer * time for longer in _LONGER]
            yield from ((start, each) for each in times if each <= self._task.longest)

    def _peak(self, found: Found) -> float:
        """Return the largest dipole of a path over its limit."""
        return float((np.abs(found.at.dipoles) / self._limit).max())

    def _at(self, start: Found, time: float) -> Found | None:
        """Return the path of least energy within the limits over `time` s, from one over another horizon."""
        # Slower by the ratio, the same way takes a dipole smaller by its square.
        at = replace(start.at, dipoles=start.at.dipoles * (start.horizon / time) ** 2)
        return self._limited(replace(start, at=at), self._equations(time), _WALK_BARRIER)

    def _energy(self, found: Found) -> float:
        """Return the heat of a path, J."""
        equations = found.equations
        power = float(self._task.craft.weights @ self._task.craft.limit**2)
        return equations.cost(found.at) * equations.scale * power / float(equations.weights @ self._limit**2)

    def _equations(self, scale: float) -> Transcription:
        task = self._task
        start = np.concatenate([task.quaternion, scale * task.rate])
        motion = Motion(task.craft, scale, self._unit)
        return Transcription(motion, task.along, start, task.end, task.nodes, scale, self._full)

    def _relaxed(self) -> list[Found]:
        """Return paths without limits, the cheapest first, over the asked horizon or the next that has any.

        The longer a slew, the more the field turns under way, and the nearer a guess is to a path.
        """
        for longer in _LONGER:
            horizon = min(longer * self._task.horizon, self._task.longest)
            found = self._relaxed_over(horizon)
            if found or horizon == self._task.longest:
                break
        return found

    def _relaxed_over(self, horizon: float) -> list[Found]:
        """Return paths without limits from the most promising guesses, the cheapest first."""
        ranked = sorted(self._guesses(self._equations(horizon)), key=lambda pair: pair[0])
        found: list[Found] = []
        for _, guess in ranked[:_MOST_TRIED]:
            self.tried += 1
            equations = self._equations(horizon)
            equations.weights = self._full / max(equations.cost(guess), 1e-9)
            program = Program(equations, self._free(equations))
            point = program.minimise(guess, most=_STEPS_FREE)
            self.steps += program.steps
            if point is not None and equations.end.is_met(point.at.states[-1, :4]):
                found.append(Found(equations, point.at, point.price))
            if len(found) >= _ENOUGH:
                break
        return sorted(found, key=self._energy)

    def _guesses(self, equations: Transcription) -> list[tuple[float, Trajectory]]:
        """Return guesses, each with a measure of what it lacks."""
        found = []
        made = guesses(equations.motion, self._task.craft, equations.start, equations.end, equations.around)
        for guess in made:
            between, _, _ = equations.remainders(guess)
            found.append((float(np.abs(between[:, 11:]).sum()), guess))
        return found

    def _limited(self, start: Found, equations: Transcription, last: float) -> Found | None:
        """Return the path of least energy within all limits, from one near it."""
        at, before = start.at, start.equations.weights
        equations.weights = self._full
        equations.weights = self._full / max(equations.cost(at), 1e-9)
        price = start.price * float(equations.weights[0] / before[0])
        if last == _LAST_BARRIER or self._peak(start) > 1.0:
            at = replace(at, dipoles=np.clip(at.dipoles, -0.98 * self._limit, 0.98 * self._limit))
        program = Program(equations, Limits(equations, self._limit, self._kept))
        point = program.minimise(at, price, last=last, most=_STEPS_LIMITED)
        self.steps += program.steps
        if point is None or not equations.end.is_met(point.at.states[-1, :4]):
            return None
        return Found(equations, point.at, point.price)

    def _free(self, equations: Transcription) -> Limits:
        return Limits(equations, None, Kept((), 0.0))

    def _is_kept(self, found: Found) -> bool:
        times = found.equations.times[1:]
        return self._peak(found) <= 1.0 and bool(
            np.all(self._kept.values(found.at.states[1:, :4], times) >= 0.0)
        )

    def plan(self, found: Found) -> SlewPlan:
        """Return the plan that flies a path. Raises PlanningError when the path is not finite."""
        task, equations, at, scale = self._task, found.equations, found.at, found.equations.scale
        flow = equations.motion.flow(at.states, at.all_dipoles(), equations.around)
        q = at.states[:, :4] / np.linalg.norm(at.states[:, :4], axis=1, keepdims=True)
        dipole = self._unit * at.all_dipoles()
        path = SlewPath(equations.times, q, at.states[:, 4:] / scale, flow[:, 4:] / scale**2, dipole)
        if not all(np.isfinite(part).all() for part in (path.quaternion, path.rate, path.dipole)):
            raise PlanningError("the optimiser returned a path that is not finite")
        dense = np.linspace(0.0, path.horizon, 16 * task.nodes + 1)
        shown = path.references(dense).quaternion
        kept = task.time_price is not None or path.horizon <= task.horizon * (1.0 + 1e-6)
        return SlewPlan(
            path,
            SlewStatus.OPTIMAL if kept else SlewStatus.STRETCHED,
            task.horizon,
            path.horizon,
            self._energy(found),
            float((np.abs(path.dipole) / task.craft.limit).max()),
            tuple(float(cone.clearance(shown, dense).min()) for cone in task.cones),
            self.steps,
        )


def _check(task: SlewTask) -> None:
    """Raise PlanningError for a task that no path can fulfil."""
    craft = task.craft
    arrays = (
        craft.inertia,
        craft.limit,
        craft.weights,
        craft.residual,
        craft.torque,
        task.quaternion,
        task.rate,
    )
    if not all(np.isfinite(part).all() for part in arrays):
        raise PlanningError("a slew needs a craft and a start that are finite")
    if abs(float(np.linalg.norm(task.quaternion)) - 1.0) > 1e-6:
        raise PlanningError(f"the start {task.quaternion} is no attitude: its length must be 1")
    if not (np.all(craft.limit > 0.0) and np.all(craft.weights > 0.0)):
        raise PlanningError("every coil needs a limit and a weight above zero")
    if np.linalg.eigvalsh(craft.inertia).min() <= 0.0:
        raise PlanningError("the inertia must be positive definite")
    low, high = HORIZON_RANGE
    if not low <= task.horizon <= task.longest <= high:
        raise PlanningError(f"horizon {task.horizon:g} s, longest {task.longest:g} s: {low:g} to {high:g} s")
    if not NODES_RANGE[0] <= task.nodes <= NODES_RANGE[1]:
        raise PlanningError(f"{task.nodes} nodes: {NODES_RANGE[0]} to {NODES_RANGE[1]}")
    if task.time_price is not None and not task.time_price > 0.0:
        raise PlanningError(f"a price of time of {task.time_price} W: it must be positive")
    for cone in task.cones:
        if float(cone.clearance(task.quaternion[None], np.zeros(1))[0]) < 0.0:
            raise PlanningError(f"the start lies within the cone of the {cone.name}")
