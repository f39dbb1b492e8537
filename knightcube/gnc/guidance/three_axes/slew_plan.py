"""The planner of three-axis slews with coils alone: minimum energy, minimum time, or a time cost.

Only torques normal to the field exist, so a path is planned together with its dipoles: collocation of the
whole motion and an interior point method (`slew_program`), from several initial guesses (`slew_search`). The
path found is then corrected until an integrator reaches the same end. Collocation on 24 intervals solves the
motion to some thousandths of a degree. Each interval is integrated in small steps from its first node, and
its miss of the next node is removed with the factors of the last Newton step: multiple shooting by a chord
method. Energy is the integral of the coils' heat, J. The planner is pure and deterministic.

`plan_order` plans a slew in orbit from one pointing target to another that starts within a window. The energy
of a slew depends on the direction of the field during the slew, by a factor of ten along an orbit. Coarse
slews are therefore planned from several start times, and the best one is planned in full.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.ephemeris import Ephemeris
from knightcube.astro.quaternion import attitude_matrix
from knightcube.errors import PlanningError, UsageError
from knightcube.gnc.guidance.three_axes.attitude_law import (
    DIFFERENCE,
    Attitudes,
    BodyAxes,
    directions_of,
    law_of,
    references,
)
from knightcube.gnc.guidance.three_axes.pointing_target import Goal, PointingTarget
from knightcube.gnc.guidance.three_axes.slew_model import EnvironmentAt, SlewCraft, SlewDynamics, SlewPath
from knightcube.gnc.guidance.three_axes.slew_program import Iterate, SlewProgram, Trajectory
from knightcube.gnc.guidance.three_axes.slew_search import GRIDS, GRIDS_WITH_CONES, SlewSearch, SolvedPath
from knightcube.gnc.guidance.three_axes.slew_task import (
    NODES,
    AttitudeEnd,
    BoresightEnd,
    End,
    EndLaw,
    SlewTask,
    along,
    check,
    cones,
    in_the_way,
)

_STEPS = 4
"""Runge-Kutta steps of an interval, an even number."""
_ROUNDS, _CLOSED, _LOST = 6, 1e-7, 1e-4
"""At most; what is missed at a node when it is closed, and when it cannot be: rad, half an angle."""


def closed(
    craft: SlewCraft, unit: float, along: EnvironmentAt, program: SlewProgram, point: Iterate
) -> Trajectory:
    """Return the trajectory near a solved `point` whose dipoles, integrated, lead through its states.

    `unit` A m^2 is that of the dipoles, `along` gives the surroundings. Raises PlanningError where the
    equations at the point are singular, or do not lead there.
    """
    equations, at = program.equations, point.at
    place, count, scale = equations.layout, equations.count, equations.scale
    around = along(np.linspace(0.0, scale, 2 * _STEPS * count + 1))
    firsts = 2 * _STEPS * np.arange(count)
    motions = [SlewDynamics(craft, scale, unit, around.part(firsts + k)) for k in range(2 * _STEPS + 1)]
    factors = program.factors(point)
    middles, ends = _integrated(motions, at, 1.0 / count)
    for _ in range(_ROUNDS):
        missed = np.zeros(place.size)
        missed[place.equations[:, 7:]] = at.states[2::2] - ends
        missed[place.start], missed[place.end] = equations.ends_missed(at)
        if float(np.abs(missed).max()) < _CLOSED:
            break
        change = factors.solve(-missed)
        at = Trajectory(at.states + change[place.states], at.dipoles + change[place.dipoles])
        middles, ends = _integrated(motions, at, 1.0 / count)
    if not float(np.abs(missed).max()) < _LOST:
        raise PlanningError("what the path misses grows as it is mended")
    states = at.states.copy()
    states[1::2] = middles
    return Trajectory(states, at.dipoles)


def _integrated(motions: list[SlewDynamics], at: Trajectory, length: float) -> tuple[FloatArray, FloatArray]:
    """Return the states (k, 7) in the middle and at the end of each interval, integrated from its begin."""
    x, h = at.states[:-1:2], length / _STEPS
    slope = (at.dipoles[1:] - at.dipoles[:-1]) / (2 * _STEPS)
    middle = x
    for k in range(0, 2 * _STEPS, 2):
        m = [at.dipoles[:-1] + (k + part) * slope for part in range(3)]
        first = motions[k].flow(x, m[0])
        second = motions[k + 1].flow(x + 0.5 * h * first, m[1])
        third = motions[k + 1].flow(x + 0.5 * h * second, m[1])
        last = motions[k + 2].flow(x + h * third, m[2])
        x = x + h / 6.0 * (first + 2.0 * second + 2.0 * third + last)
        if k + 2 == _STEPS:
            middle = x
    return middle, x


_DENSE = 16
"""Places between two of a path's nodes and midpoints where cones are looked at."""
_ROOM = math.radians(0.005)
"""rad, that a path keeps off a cone at those places: between them it comes nearer by less."""

_OVER = 1.001
"""Of the dipoles' limit, that the closing of a path may lead to."""
_ASTRAY = 1.05
"""By how much a path that no integrator leads along is eased."""

_ENDS = 9
"""Horizons of a refused slew, at whose ends cones are looked for."""


class SlewStatus(StrEnum):
    """Whether the asked horizon was kept."""

    OPTIMAL = "optimal"
    STRETCHED = "stretched"


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


def plan_slew(task: SlewTask, near: SlewPath | None = None) -> SlewPlan:
    """Return the best plan found. Raises PlanningError with the reason when there is none.

    `near` is the path of a task that is nearly the same, over the same horizon: the plan near it is taken.
    """
    check(task)
    tried = 0
    if near is not None:
        search = SlewSearch(task, *GRIDS[0])
        found = search.solver.again(near)
        plan = None if found is None else _first(task, search, iter([found]))
        if plan is not None:
            return plan
    for coarse, budget in GRIDS_WITH_CONES if task.cones else GRIDS:
        search = SlewSearch(task, coarse, budget)
        plan = _first(task, search, search.paths())
        if plan is not None:
            return plan
        tried += search.tried
    raise PlanningError(_refusal(task, tried))


def _first(task: SlewTask, search: SlewSearch, paths: Iterator[SolvedPath]) -> SlewPlan | None:
    """Return the plan of the first path that keeps limits and cones when flown, too; None without one."""
    for path in paths:
        found: SolvedPath | None = path
        while found is not None:
            plan = _plan(task, search, found)
            if plan is None:
                found = search.eased(found, _ASTRAY)
                continue
            depths = _depths(task, plan.path)
            if plan.peak > _OVER:
                found = search.eased(found, plan.peak)
            elif depths.any():
                found = search.widened(found, depths)
            else:
                return plan
    return None


def _refusal(task: SlewTask, tried: int) -> str:
    """Return why a task is refused, and what may help."""
    text = f"no slew within the dipole's limit{' and outside the cones' * bool(task.cones)} was found"
    text += f" over {task.horizon:g} to {task.longest:g} s, from {tried} guesses"
    ends = np.linspace(task.horizon, task.longest, _ENDS)
    found = [(end, cone) for end in ends.tolist() if (cone := in_the_way(task, end)) is not None]
    if found:
        first, cone = found[0]
        share = "one" if len(found) == 1 else "all" if len(found) == _ENDS else "many"
        text += f", and of these {share} from {first:.0f} s on end within the cone of the {cone.name}"
    return f"{text}: a longer time or another begin may do"


def _plan(task: SlewTask, search: SlewSearch, found: SolvedPath) -> SlewPlan | None:
    """Return the plan that flies a path; None where an integrator does not lead along it."""
    equations, scale = found.equations, found.equations.scale
    with np.errstate(over="ignore", invalid="ignore"):  # where an integrator is led astray
        try:
            at = closed(task.craft, search.solver.unit, task.along, found.program, found.point)
        except PlanningError:
            return None
        flow = equations.motion.flow(at.states, at.all_dipoles())
        q = at.states[:, :4] / np.linalg.norm(at.states[:, :4], axis=1, keepdims=True)
        dipole = search.solver.unit * at.all_dipoles()
        path = SlewPath(equations.times, q, at.states[:, 4:] / scale, flow[:, 4:] / scale**2, dipole)
    parts = (path.quaternion, path.rate, path.acceleration, path.dipole)
    if not all(np.isfinite(part).all() for part in parts):
        return None
    clear = _clearances(task, path)
    kept = task.time_price is not None or path.horizon <= task.horizon * (1.0 + 1e-6)
    return SlewPlan(
        path,
        SlewStatus.OPTIMAL if kept else SlewStatus.STRETCHED,
        task.horizon,
        path.horizon,
        search.solver.energy(found),
        float((np.abs(path.dipole) / task.craft.limit).max()),
        tuple(clear.min(axis=1).tolist()),
        search.solver.steps,
    )


def _clearances(task: SlewTask, path: SlewPath) -> FloatArray:
    """Return how far outside each cone (cones, n) rad a path is, `_DENSE` times between two points."""
    dense = np.linspace(0.0, path.horizon, 2 * _DENSE * task.nodes + 1)
    shown = path.references(dense).quaternion
    return np.array([cone.clearance(shown, dense) for cone in task.cones]).reshape(-1, len(dense))


def _depths(task: SlewTask, path: SlewPath) -> FloatArray:
    """Return how far from clear of each cone (cones, 2 nodes) rad a path is between each two points.

    Clear is `_ROOM` off the cone, or as near as begin or end are to it.
    """
    clear = _clearances(task, path)
    room = np.clip(np.minimum(clear[:, :1], clear[:, -1:]), 0.0, _ROOM)
    inside = np.maximum(room - clear, 0.0)
    return np.asarray(inside[:, 1:].reshape(len(inside), 2 * task.nodes, _DENSE).max(axis=2))


LEAD = 2.0 * DIFFERENCE
"""s of prediction that are needed before the first begin and after the last end: rates are differences."""
WINDOW_RANGE = (0.0, 2e4)
"""s."""
_BEGINS = 12
"""Parts of a window between which slews are begun."""
_COARSE = 12
"""Intervals of the slews that begins are compared by."""
_NO_ROLL: FloatArray = np.array([0.0, 0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True, eq=False)
class SlewOrder:
    """What is ordered.

    Attributes:
        axes: of pointing, which the targets are meant for; `camera` (3,) is the axis that keeps the cones.
        start: the target that is held until the slew begins; a free roll of it is taken as zero.
        goal: the target to end in; with a free roll only its direction counts.
        horizon, longest: s, of the slew; it begins within `window` s.
        time_price: W, as of `SlewTask`.
        angles: rad, of the cones of `sun`, `earth` and `moon` that are kept.
    """

    craft: SlewCraft
    axes: BodyAxes
    camera: FloatArray
    start: PointingTarget
    goal: PointingTarget
    horizon: float
    longest: float
    window: float = 0.0
    time_price: float | None = None
    angles: dict[str, float] = field(default_factory=dict)
    nodes: int = NODES

    @property
    def held(self) -> PointingTarget:
        """The start with its roll."""
        is_free = self.start.goal is not Goal.INERTIAL and self.start.roll is None
        return replace(self.start, roll=0.0) if is_free else self.start


@dataclass(frozen=True, slots=True, eq=False)
class OrderedSlew:
    """A task and its plan, which begins at `begin` s of the ephemeris; `compared` begins were planned."""

    task: SlewTask
    plan: SlewPlan
    begin: float
    compared: int


def plan_order(order: SlewOrder, ephemeris: Ephemeris, first: float) -> OrderedSlew:
    """Return the best slew that begins from `first` s of the ephemeris on, within the order's window.

    The ephemeris reaches from `LEAD` s before that to `LEAD` s after the longest slew from the window's end.
    Raises PlanningError with the last reason where there is none, UsageError for a window out of range.
    """
    low, high = WINDOW_RANGE
    if not low <= order.window <= high:
        raise UsageError(f"a window of {order.window:g} s: must be {low:g} to {high:g}")
    begins = first + order.window * np.linspace(0.0, 1.0, _BEGINS + 1 if order.window else 1)
    coarse = replace(order, nodes=min(order.nodes, _COARSE))
    compared: list[tuple[tuple[float, float], float]] = []
    failed: PlanningError | None = None
    for begin in begins if order.window else ():
        try:
            plan = plan_slew(task_at(coarse, ephemeris, float(begin)))
        except PlanningError as error:
            failed = error
        else:
            compared.append((_value(plan, order.time_price), float(begin)))
    # Without a window, or where no coarse slew was found, the first begin has the word.
    for begin in [begin for _, begin in sorted(compared)] or [first]:
        task = task_at(order, ephemeris, begin)
        try:
            return OrderedSlew(task, plan_slew(task), begin, len(begins))
        except PlanningError as error:
            failed = error
    assert failed is not None
    raise failed


def task_at(order: SlewOrder, ephemeris: Ephemeris, begin: float) -> SlewTask:
    """Return the task of a slew that begins at a time, s of the ephemeris."""
    quaternion, rate = _motion(law_of(order.held, order.axes, _NO_ROLL, ephemeris, begin), ephemeris, begin)
    return SlewTask(
        order.craft,
        along(ephemeris, begin),
        quaternion,
        rate,
        end_law(order.goal, order.axes, ephemeris, begin),
        order.horizon,
        order.longest,
        order.time_price,
        cones(ephemeris, begin, order.camera, **order.angles),
        order.nodes,
    )


def end_law(goal: PointingTarget, axes: BodyAxes, ephemeris: Ephemeris, begin: float) -> EndLaw:
    """Return where slews to a goal that begin at a time, s of the ephemeris, end after any duration."""
    axis = axes.pointing
    if goal.goal is not Goal.INERTIAL and goal.roll is None:
        direction, _ = directions_of(goal)

        def aimed(horizon: float) -> End:
            times = begin + horizon + np.array([-DIFFERENCE, 0.0, DIFFERENCE])
            before, now, after = direction(ephemeris, times)
            return BoresightEnd(axis, now, np.cross(now, after - before) / (2.0 * DIFFERENCE))

        return aimed
    law = law_of(goal, axes, _NO_ROLL, ephemeris, begin)

    def whole(horizon: float) -> End:
        quaternion, rate = _motion(law, ephemeris, begin + horizon)
        return AttitudeEnd(quaternion, attitude_matrix(quaternion).T @ rate)

    return whole


def _motion(law: Attitudes, ephemeris: Ephemeris, time: float) -> tuple[FloatArray, FloatArray]:
    """Return the attitude (4,) and the rate (3,) rad/s, body axes, of a law."""
    found = references(law, ephemeris, np.array([time]))
    return found.quaternion[0], found.rate[0]


def _value(plan: SlewPlan, price: float | None) -> tuple[float, float]:
    """Return what slews are compared by: how much they are stretched, then what they cost."""
    if price is None:
        late = plan.horizon if plan.status is SlewStatus.STRETCHED else 0.0
        return late, plan.energy
    return 0.0, plan.horizon if math.isinf(price) else plan.energy + price * plan.horizon
