"""The planner of three-axis slews with magnetic coils alone, for minimum energy, minimum time or a time cost.

Coils cause only torques normal to the magnetic field, so a path is planned together with the dipole moments.
The whole motion is discretised by collocation and solved by an interior point method (`slew_program`), from
several initial guesses (`slew_search`). The path is then corrected until a Runge-Kutta integration of the
motion reaches the end of the path. The collocation error on 24 intervals is a few thousandths of a degree.
To correct a path, the motion is integrated in small steps from the first node of each interval. The
differences between the integrated states and the states at the next nodes are removed with one factored
Newton matrix (multiple shooting with the chord method). The energy of a slew is the heat produced in the
coils, J. The planner is deterministic and has no side effects.

The function `plan_order` plans a slew in orbit between two pointing targets, with a start inside a given time
window. The energy of a slew depends on the direction of the field during the slew, and varies by a factor of
up to ten along an orbit. Slews with several start times are therefore planned on a coarse grid, and the best
slew is planned again on the fine grid.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from enum import StrEnum
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from knightcube.astro.arrays import (
    FloatArray,
    brief,
    check_numbers,
    check_type,
    finite_array,
    real_number,
    unit_vector,
)
from knightcube.astro.earth.ephemeris import Ephemeris, predict
from knightcube.astro.earth.geomagnetism import check_year
from knightcube.astro.earth.orbit_knowledge import TwoLineElements, elements_of
from knightcube.astro.earth.orientation import julian_epoch
from knightcube.astro.earth.sun import DAY, julian_date
from knightcube.astro.inertia import inertia_problem
from knightcube.astro.quaternion import attitude_matrix
from knightcube.errors import ArgumentError, PlanningError, UsageError
from knightcube.gnc.guidance.attitude_law import (
    DIFFERENCE,
    MINIMUM_SINE,
    Attitudes,
    BodyAxes,
    directions_of,
    law_of,
    references,
)
from knightcube.gnc.guidance.pointing_target import Goal, PointingTarget
from knightcube.gnc.guidance.slew_model import (
    HORIZON_RANGE,
    NODES,
    NODES_RANGE,
    AttitudeEnd,
    BoresightEnd,
    End,
    EndLaw,
    EnvironmentAt,
    SlewCraft,
    SlewDynamics,
    SlewPath,
    SlewTask,
    along,
    blocking_cone,
    check,
    cones,
    heat_matrix,
)
from knightcube.gnc.guidance.slew_program import Iterate, SlewProgram, Trajectory
from knightcube.gnc.guidance.slew_search import GRIDS, GRIDS_WITH_CONES, SlewSearch, SolvedPath

STRETCH = 3.0
"""Default of the longest duration to which `plan_slew` extends a slew, as a multiple of the requested
duration."""
_STEPS, _LONGEST_STEP = 4, 16.0
"""Smallest number of Runge-Kutta steps per collocation interval, and longest step, s. The number is even.
Gravity gradient amplifies errors of the integration by a factor of ten in about 20 minutes."""
_ROUNDS, _CLOSED, _LOST = 6, 1e-7, 1e-4
"""Largest number of corrections of a path, error at the nodes (half angle, rad) below which the corrections
end, and largest error with which the path is accepted after the corrections."""


def closed(
    craft: SlewCraft, unit: float, along: EnvironmentAt, program: SlewProgram, point: Iterate
) -> Trajectory:
    """Return the trajectory, near an iterate `point`, that agrees with the integrated motion at all nodes.

    The unit of dipoles is `unit` A m^2, and the function `along` returns the environment at given times.
    Raises PlanningError if the Newton matrix is singular or the corrections do not converge.
    """
    equations, at = program.equations, point.at
    layout, count, scale = equations.layout, equations.count, equations.scale
    twice = 2 * max(_STEPS, 2 * math.ceil(scale / (2.0 * _LONGEST_STEP * count)))
    around = along(np.linspace(0.0, scale, twice * count + 1))
    motion = SlewDynamics(craft, scale, unit, around)
    motions = [motion.part(slice(k, twice * count + k, twice)) for k in range(twice + 1)]
    factors = program.factors(point)
    middles, ends = _integrated(motions, at, 1.0 / count)
    for _ in range(_ROUNDS):
        missed = np.zeros(layout.size)
        missed[layout.equations[:, 7:]] = at.states[2::2] - ends
        missed[layout.start], missed[layout.end] = equations.ends_missed(at)
        if float(np.abs(missed).max()) < _CLOSED:
            break
        change = factors.solve(-missed)
        at = Trajectory(at.states + change[layout.states], at.dipoles + change[layout.dipoles])
        middles, ends = _integrated(motions, at, 1.0 / count)
    if not float(np.abs(missed).max()) < _LOST:
        raise PlanningError("the corrections of the path do not converge")
    states = at.states.copy()
    states[1::2] = middles
    return Trajectory(states, at.dipoles)


def _integrated(motions: list[SlewDynamics], at: Trajectory, length: float) -> tuple[FloatArray, FloatArray]:
    """Return the integrated states (k, 7) in the middle and at the end of k intervals.

    The equations of motion `motions` are given at the ends and middles of all steps within the intervals.
    """
    twice = len(motions) - 1
    x, h = at.states[:-1:2], 2.0 * length / twice
    slope = (at.dipoles[1:] - at.dipoles[:-1]) / twice
    middle = x
    for k in range(0, twice, 2):
        m = [at.dipoles[:-1] + (k + part) * slope for part in range(3)]
        first = motions[k].flow(x, m[0])
        second = motions[k + 1].flow(x + 0.5 * h * first, m[1])
        third = motions[k + 1].flow(x + 0.5 * h * second, m[1])
        last = motions[k + 2].flow(x + h * third, m[2])
        x = x + h / 6.0 * (first + 2.0 * second + 2.0 * third + last)
        if 2 * (k + 2) == twice:
            middle = x
    return middle, x


_DENSE = 16
"""Number of checks of the cones between a node and the next midpoint of a path."""
_ROOM = math.radians(0.005)
"""Minimum angle (rad) between camera axis and exclusion cone at the checked times. Between two checked times,
the camera axis approaches a cone by less than this angle, and therefore does not enter the cone."""

_RESERVE = 0.3
"""Fraction of the upper bound described in `_margins` that is added to the margin. With a larger fraction,
fewer paths must be corrected, but paths keep a larger distance from the cones and need more heat."""

_OVER = 1.001
"""Largest ratio of the dipole to the dipole limit along an accepted path, after the correction."""
_ASTRAY = 1.05
"""Assumed ratio of the dipole to the dipole limit for a path whose integration fails."""

_ENDS = 9
"""Number of durations for which the end of a failed slew is checked, to name a cone in the error message."""


_LONGEST_INTERVAL = 250.0
"""Longest collocation interval (s) with which paths are found in a low orbit."""
_HOPELESS = 10.0
"""Ratio of the required dipole to the dipole limit above which no other start time is tried. Along an orbit,
the energy varies by a factor of up to ten, and the dipole by a factor of about three."""


class SlewStatus(StrEnum):
    """Whether the requested duration was kept (OPTIMAL) or extended (STRETCHED)."""

    OPTIMAL = "optimal"
    STRETCHED = "stretched"


@dataclass(frozen=True, slots=True, eq=False)
class SlewPlan:
    """A planned slew path with energy, peak dipole and clearances.

    Attributes:
        path: planned path.
        status: whether the requested duration was kept or extended.
        horizon_asked, horizon: requested and planned duration, s.
        energy: heat of the coils during the slew, J.
        peak: largest ratio of a component of the dipole moment to the dipole limit.
        clearance: smallest angle between camera axis and each of the task's exclusion cones, rad.
        steps: total number of Newton steps of the search.
    """

    path: SlewPath
    status: SlewStatus
    horizon_asked: float
    horizon: float
    energy: float
    peak: float
    clearance: tuple[float, ...]
    steps: int

    def __repr__(self) -> str:
        """Return status, duration, heat and largest dipole moment as one line of text."""
        return (
            f"<SlewPlan {self.status}: {self.horizon:g} s, heat {1e3 * self.energy:.4g} mJ, "
            f"peak dipole {100.0 * self.peak:.3g} % of the limit>"
        )


def plan_task(task: SlewTask, near: SlewPath | None = None) -> SlewPlan:
    """Return the best plan found for a slew task. Raises PlanningError with the reason if no path is found.

    If `near`, the path of a similar task with the same duration, is given, the search starts from this path.
    """
    check(task)
    tried, least = 0, math.inf
    if near is not None:
        plan = plan_near(task, near)
        if plan is not None:
            return plan
    for coarse, budget in GRIDS_WITH_CONES if task.cones else GRIDS:
        search = SlewSearch(task, coarse, budget)
        plan = _first(task, search, search.paths())
        if plan is not None:
            return plan
        tried, least = tried + search.tried, min(least, search.least)
    error = PlanningError(refusal(task, tried, least))
    error.is_hopeless = _HOPELESS < _excess(task, least) < math.inf
    raise error


def plan_near(task: SlewTask, near: SlewPath) -> SlewPlan | None:
    """Return the plan found from the path `near` of a similar task, or None if the search fails.

    The only initial guess is `near`, with the duration of the task. Raises PlanningError for invalid values.
    """
    check(task)
    search = SlewSearch(task, *GRIDS[0])
    near = near.since(0.0, task.nodes)
    search.solver.extra = _margins(task, near)
    found = search.solver.again(near)
    return None if found is None else _first(task, search, iter([found]))


def _first(task: SlewTask, search: SlewSearch, paths: Iterator[SolvedPath]) -> SlewPlan | None:
    """Return the plan of the first path that satisfies limits and cones after integration, or None."""
    for path in paths:
        found: SolvedPath | None = path
        while found is not None:
            plan = integrated(task, search, found)
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


def _margins(task: SlewTask, path: SlewPath) -> FloatArray:
    """Return the angles (cones, 2 nodes), rad, by which cones must be widened at the points of similar paths.

    Between two points, the camera axis may be closer to a cone than at both points. The upper bound of this
    difference is the deviation, half-way between the points, of the clearance from the mean of its values at
    both points. The result is the required angle plus a margin, which is the difference on `path` plus the
    fraction `_RESERVE` of the upper bound, but at most the upper bound.
    """
    clear = _clearances(task, path)
    ends, middles = clear[:, ::_DENSE], clear[:, _DENSE // 2 :: _DENSE]
    least = clear[:, 1:].reshape(len(clear), 2 * task.nodes, _DENSE).min(axis=2)
    nearer = np.maximum(np.minimum(ends[:, :-1], ends[:, 1:]) - least, 0.0)
    bent = np.maximum(0.5 * (ends[:, :-1] + ends[:, 1:]) - middles, 0.0)
    wider: FloatArray = np.minimum(nearer + _RESERVE * bent, bent) + _required(clear)
    wider[:, :-1] = np.maximum(wider[:, :-1], wider[:, 1:])
    wider[:, -1] = 0.0
    return wider


def is_within_limits(task: SlewTask, plan: SlewPlan) -> bool:
    """Return whether an integrated plan satisfies the dipole limit and stays outside the exclusion cones."""
    return plan.peak <= _OVER and not _depths(task, plan.path).any()


def refusal(task: SlewTask, tried: int, least: float = math.inf) -> str:
    """Return the error message, with possible remedies, for a task for which no path was found.

    The argument `least` is the smallest ratio of peak dipole to dipole limit among the paths that were found
    without the dipole limit (`SlewSearch.least`).
    """
    text = f"no slew within the dipole limit{' and outside the cones' * bool(task.cones)} was found"
    text += f" over {task.horizon:g} to {task.longest:g} s, from {tried} guesses"
    ends = np.linspace(task.horizon, task.longest, _ENDS)
    found = [(end, cone) for end in ends.tolist() if (cone := blocking_cone(task, end)) is not None]
    if found:
        first, cone = found[0]
        share = "one" if len(found) == 1 else "all" if len(found) == _ENDS else "many"
        text += f"; {share} of these, from {first:.0f} s on, end in the exclusion cone of the {cone.name}"
        if share == "all":
            return f"{text}: choose another goal or time, or a smaller cone"
    if 1.0 < _excess(task, least) < math.inf:
        return (
            f"{text}: without the limit, a slew of {task.horizon:g} s needs {least:.3g} times the dipole "
            "limit: check that inertia is in kg m^2 and the dipole limit in A m^2, or allow a longer time"
        )
    if task.horizon > _LONGEST_INTERVAL * task.nodes:
        return (
            f"{text}: in intervals of {task.horizon / task.nodes:.0f} s, the field rotates too far: give at "
            f"least {math.ceil(task.horizon / _LONGEST_INTERVAL)} nodes, or a shorter duration"
        )
    return f"{text}: allow a longer time or another start"


def _excess(task: SlewTask, least: float) -> float:
    """Return the ratio of the peak dipole to the dipole limit for the longest duration.

    The argument `least` is this ratio for the requested duration. The dipole of a slew is about inversely
    proportional to the squared duration.
    """
    return least * (task.horizon / task.longest) ** 2


def integrated(task: SlewTask, search: SlewSearch, found: SolvedPath) -> SlewPlan | None:
    """Return the plan that follows a path, or None if the integration of the motion along the path fails."""
    equations, scale = found.equations, found.equations.scale
    with np.errstate(over="ignore", invalid="ignore"):  # a diverging integration may overflow
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
    kept = task.time_cost is not None or path.horizon <= task.horizon * (1.0 + 1e-6)
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


@functools.lru_cache(maxsize=1)
def _clearances(task: SlewTask, path: SlewPath) -> FloatArray:
    """Return the angles (cones, n), rad, from each cone to the camera axis at n closely spaced times.

    The times cover the path. An angle is negative if the camera axis lies inside the cone. The newest result
    is kept, because a plan and its check need the same angles.
    """
    dense = np.linspace(0.0, path.horizon, 2 * _DENSE * task.nodes + 1)
    shown = path.references(dense).quaternion
    return np.array([cone.clearance(shown, dense) for cone in task.cones]).reshape(-1, len(dense))


def _depths(task: SlewTask, path: SlewPath) -> FloatArray:
    """Return the largest violation (cones, 2 nodes), rad, of each cone's margin between neighbouring points.

    The required margin is `_ROOM`, or the angle between cone and camera axis at the start or at the end of
    the path, if this angle is smaller.
    """
    clear = _clearances(task, path)
    inside = np.maximum(_required(clear) - clear, 0.0)
    return np.asarray(inside[:, 1:].reshape(len(inside), 2 * task.nodes, _DENSE).max(axis=2))


def _required(clear: FloatArray) -> FloatArray:
    """Return the required angle (cones, 1), rad, from each cone, for clearances (cones, n) along a path."""
    return np.clip(np.minimum(clear[:, :1], clear[:, -1:]), 0.0, _ROOM)


LEAD = 2.0 * DIFFERENCE
"""Time (s) by which the ephemeris must begin before the earliest start of a slew and end after the latest
end, because rates are computed by central differences."""
WINDOW_RANGE = (0.0, 2e4)
"""Shortest and longest permitted time window (s) in which a slew may begin."""
_BEGINS = 12
"""Number of equal intervals between the start times that are compared in a window."""
_COARSE = 12
"""Number of collocation intervals of the coarse plans that serve to compare start times."""
_NO_ROLL: FloatArray = np.array([0.0, 0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True, eq=False)
class SlewOrder:
    """A slew in orbit from one pointing target to another.

    Attributes:
        craft: model of the satellite, in body axes.
        axes: body axis that points to the targets, and body axis from which a roll is measured.
        camera: body axis (3,) that stays outside the exclusion cones.
        start: pointing target that is held until the slew begins, with a roll of zero if its roll is free.
        goal: pointing target at the end; if its roll is free, only the direction is an end condition.
        horizon, longest: requested and longest permitted duration of the slew, s.
        window: length of the time interval in which the slew may begin, s.
        time_cost: weight of the slew duration in the cost, W (see `SlewTask`).
        angles: half angles of the exclusion cones of `sun`, `earth` and `moon`, rad.
        nodes: number of collocation intervals.
    """

    craft: SlewCraft
    axes: BodyAxes
    camera: FloatArray
    start: PointingTarget
    goal: PointingTarget
    horizon: float
    longest: float
    window: float = 0.0
    time_cost: float | None = None
    angles: dict[str, float] = field(default_factory=dict)
    nodes: int = NODES

    @property
    def held(self) -> PointingTarget:
        """The start target of the slew, with a roll of zero if the roll is free."""
        is_free = self.start.goal is not Goal.INERTIAL and self.start.roll is None
        return replace(self.start, roll=0.0) if is_free else self.start


@dataclass(frozen=True, slots=True, eq=False)
class OrderedSlew:
    """A planned slew in orbit.

    Attributes:
        order: requested slew.
        task: planning task for the chosen start time.
        plan: planned path of the slew.
        begin: start of the slew, in s after the start of the ephemeris. In results of `knightcube.plan_slew`,
            `begin` is measured from the argument `time`.
        compared: number of start times for which a plan was attempted.
    """

    order: SlewOrder
    task: SlewTask
    plan: SlewPlan
    begin: float
    compared: int

    def __repr__(self) -> str:
        """Return the start time and the plan as one line of text."""
        return f"<OrderedSlew: begins at {self.begin:g} s, {self.plan!r}>"


def plan_order(order: SlewOrder, ephemeris: Ephemeris, first: float) -> OrderedSlew:
    """Return the best slew that begins in the time window of `order`.

    The window opens `first` s after the start of the ephemeris. The ephemeris must begin at least `LEAD` s
    before `first`, and end at least `LEAD` s after the end of the longest slew. Raises PlanningError with the
    last reason if no slew is found, and UsageError for a window out of range. If a slew needs many times the
    dipole limit, no other start is tried.
    """
    _check_window(order.window)
    begins = first + order.window * np.linspace(0.0, 1.0, _BEGINS + 1 if order.window else 1)
    coarse = replace(order, nodes=min(order.nodes, _COARSE))
    compared: list[tuple[tuple[float, float], float]] = []
    failed: PlanningError | None = None
    for begin in begins if order.window else ():
        try:
            plan = plan_task(task_at(coarse, ephemeris, float(begin)))
        except PlanningError as error:
            if error.is_hopeless:
                raise
            failed = error
        else:
            # Plans of the requested duration rank before extended plans. Extended plans rank by their
            # duration, and plans of the same duration by their cost.
            if order.time_cost is None:
                value = (plan.horizon if plan.status is SlewStatus.STRETCHED else 0.0, plan.energy)
            elif math.isinf(order.time_cost):
                value = (0.0, plan.horizon)
            else:
                value = (0.0, plan.energy + order.time_cost * plan.horizon)
            compared.append((value, float(begin)))
    # If the window has zero length or no coarse slew was found, the first start time is used.
    for begin in [begin for _, begin in sorted(compared)] or [first]:
        task = task_at(order, ephemeris, begin)
        try:
            return OrderedSlew(order, task, plan_task(task), begin, len(begins))
        except PlanningError as error:
            failed = error
    assert failed is not None
    raise failed


def task_at(order: SlewOrder, ephemeris: Ephemeris, begin: float) -> SlewTask:
    """Return the planning task of a slew that begins `begin` s after the start of the ephemeris."""
    quaternion, rate = _motion(law_of(order.held, order.axes, _NO_ROLL, ephemeris, begin), ephemeris, begin)
    return SlewTask(
        order.craft,
        along(ephemeris, begin),
        quaternion,
        rate,
        end_law(order.goal, order.axes, ephemeris, begin),
        order.horizon,
        order.longest,
        order.time_cost,
        cones(ephemeris, begin, order.camera, **order.angles),
        order.nodes,
    )


def end_law(goal: PointingTarget, axes: BodyAxes, ephemeris: Ephemeris, begin: float) -> EndLaw:
    """Return the end conditions as a function of the duration, for slews that begin at the time `begin`.

    The time `begin` is in s after the start of the ephemeris.
    """
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
    """Return the attitude (4,) and the body rate (3,), rad/s, commanded by an attitude law at a time, s."""
    found = references(law, ephemeris, np.array([time]))
    return found.quaternion[0], found.rate[0]


def _craft(inertia: ArrayLike, dipole_limit: ArrayLike, heat: ArrayLike) -> SlewCraft:
    """Return the model of the satellite. Raises ArgumentError or PlanningError for impossible values."""
    tensor = heat_matrix(finite_array("inertia", inertia, (3, 3), (3,)))
    problem = inertia_problem(tensor)
    if problem:
        raise ArgumentError("inertia", problem)
    weights = finite_array("heat", heat, (3, 3), (3,))
    if not np.allclose(weights, weights.T, rtol=1e-6, atol=0.0):
        raise ArgumentError("heat", f"{weights.tolist()}: must be symmetric, or give its diagonal (3,)")
    if np.linalg.eigvalsh(heat_matrix(weights)).min() <= 0.0:
        raise PlanningError(f"heat is {weights.tolist()}: the heating power of every dipole must be positive")
    return SlewCraft(tensor, finite_array("dipole_limit", dipole_limit, (3,)), weights)


def body_axes(pointing_axis: ArrayLike, across_axis: ArrayLike) -> BodyAxes:
    """Return the body axes of the pointing targets. Raises ArgumentError if the axes are parallel."""
    axes = BodyAxes(unit_vector("pointing_axis", pointing_axis), unit_vector("across_axis", across_axis))
    if float(np.linalg.norm(np.cross(axes.pointing, axes.across))) < MINIMUM_SINE:
        raise ArgumentError(
            "across_axis",
            f"{axes.across.tolist()}: must not be parallel to pointing_axis, because it defines the roll",
        )
    return axes


def _cone_angles(cones: Mapping[Literal["sun", "earth", "moon"], float] | None) -> dict[str, float]:
    """Return the angles (rad) of the exclusion cones by name. Raises ArgumentError for another type."""
    given = {} if cones is None else cones
    check_type("cones", given, Mapping)
    return {str(name): angle for name, angle in given.items()}


def _check_order(order: SlewOrder) -> None:
    """Raise UsageError or PlanningError, with the name of the argument of `plan_slew`, for invalid values."""
    check_target("start", order.start)
    check_target("goal", order.goal)
    for name, angle in order.angles.items():
        if name not in ("sun", "earth", "moon"):
            raise ArgumentError("cones", f"unknown exclusion cone {brief(name)}: give sun, earth or moon")
        if not 0.0 <= real_number(angle) < math.pi:
            raise ArgumentError(
                f"cones[{name!r}]",
                f"{brief(angle)} rad: must be 0 to below pi; math.radians converts degrees",
            )
    low, high = HORIZON_RANGE
    if not low <= order.horizon <= order.longest <= high:
        raise PlanningError(
            f"duration is {order.horizon} s, longest {order.longest} s: must satisfy {low:g} <= duration <= "
            f"longest <= {high:g} s"
        )
    if not (isinstance(order.nodes, (int, np.integer)) and NODES_RANGE[0] <= order.nodes <= NODES_RANGE[1]):
        raise PlanningError(
            f"nodes is {brief(order.nodes)}: must be an integer from {NODES_RANGE[0]} to {NODES_RANGE[1]}"
        )
    _check_window(order.window)


def check_target(name: str, target: PointingTarget) -> None:
    """Raise ArgumentError unless the argument `name` is a target with a predictable direction."""
    if not isinstance(target, PointingTarget):
        raise ArgumentError(name, f"{brief(target)}: give a PointingTarget, as PointingTarget(Goal.SUN)")
    if target.goal is Goal.OBJECT:
        raise ArgumentError(name, "the direction of an object is known only in flight: give another goal")


def _check_window(window: float) -> None:
    """Raise UsageError for a time window (s) out of range."""
    low, high = WINDOW_RANGE
    if not low <= window <= high:
        raise UsageError(f"the window is {window:g} s: must be {low:g} to {high:g} s")


def _ephemeris(elements: tuple[str, str], time: datetime, duration: float) -> Ephemeris:
    """Return the ephemeris for slews that begin at `time` and end at most `duration` s later.

    The ephemeris begins `LEAD` s before `time`, and ends at least `LEAD` s after the last slew. Raises the
    errors of `known_orbit`.
    """
    begin = timedelta(seconds=LEAD)
    return predict(known_orbit(elements, time, duration).at(julian_date(time - begin)), duration + 3.0 * LEAD)


def known_orbit(elements: tuple[str, str], time: datetime, duration: float) -> TwoLineElements:
    """Return the orbit of two-line elements, which is known from `time` until `duration` s later.

    Raises UsageError for invalid elements, OrbitError if the epoch of the elements is too far from these
    times, and GeomagneticError outside the years of the magnetic field model.
    """
    dates, orbit = julian_date(time) + np.array([0.0, duration / DAY]), elements_of(elements)
    for year in julian_epoch(dates).tolist():
        check_year(year)
    for date in dates.tolist():
        orbit.known_at(date)
    return orbit


def plan_slew(
    *,
    inertia: ArrayLike,
    dipole_limit: ArrayLike,
    heat: ArrayLike,
    elements: tuple[str, str],
    time: datetime,
    start: PointingTarget,
    goal: PointingTarget,
    duration: float,
    longest: float | None = None,
    window: float = 0.0,
    time_cost: float | None = None,
    pointing_axis: ArrayLike = (0.0, 0.0, 1.0),
    across_axis: ArrayLike = (1.0, 0.0, 0.0),
    camera_axis: ArrayLike | None = None,
    cones: Mapping[Literal["sun", "earth", "moon"], float] | None = None,
    nodes: int = NODES,
) -> OrderedSlew:
    """Return the best slew of a satellite in orbit with torque coils alone, from one target to another.

    Coils cause no torque along the magnetic field, so path and dipole moments are planned together. Path and
    dipole moments are discretised by collocation and optimised with an interior point method from several
    initial guesses. The model includes the rotating magnetic field, the gravity gradient and the gyroscopic
    torque. The orbit is predicted by SGP4. A plan takes about a second.

    In the result, `plan.path` contains attitude, rate and dipole at the times `plan.path.times`, s after the
    start of the slew. The dipole is linear between these times. The energy `plan.energy` is the heat of the
    coils, J. The slew starts `begin` s after `time`.

    Args:
        inertia: symmetric inertia tensor (3, 3) in body axes, kg m^2, or the principal moments (3,).
        dipole_limit: dipole limits (3,) of the coils along the body axes, A m^2.
        heat: heating power of the coils per squared dipole moment (3, 3), W/(A m^2)^2, or its diagonal (3,).
        elements: two lines of the two-line element set of the orbit, with an epoch near `time`.
        time: datetime of the start of the slew or of the window, in UTC or with a time zone.
        start: pointing target that is held until the slew begins, with a roll of zero if its roll is free.
        goal: pointing target at the end; if its roll is free, only the direction is an end condition.
        duration: requested duration of the slew, s.
        longest: longest duration to which the slew may be extended if no slew of `duration` is found, s. The
            default is three times `duration`, but at most 20,000 s.
        window: length of the time interval, s, from which the start time of the best slew is chosen.
        time_cost: weight of the slew duration in the cost, W. If `time_cost` is given, the slew minimises
            energy plus `time_cost` times the duration. If the time cost is infinite, the shortest slew is
            planned; if it is None, the duration is not optimised.
        pointing_axis: body axis (3,) that points to the targets. This vector and the next two vectors may
            have any length.
        across_axis: body axis (3,) from which a roll is measured; its component along `pointing_axis` is
            ignored.
        camera_axis: body axis (3,) that stays outside the cones, or None for `pointing_axis`.
        cones: half angles of the exclusion cones of Sun and Moon, and angle from the Earth's limb, rad.
        nodes: number of collocation intervals, 8 to 96.

    Raises:
        UsageError: if an argument is invalid; the message gives the argument, its value and the remedy.
        PlanningError: if no slew is found, or if a duration or limit is out of range.
        OrbitError: if `time` is too far from the epoch of the elements (see `propagate_elements`).
        GeomagneticError: if the slew is outside the years 2025 to 2030 of the magnetic field model.
    """
    optional = {"longest": longest, "time_cost": time_cost}
    given = {name: value for name, value in optional.items() if value is not None}
    check_numbers(duration=duration, window=window, **given)
    axes = body_axes(pointing_axis, across_axis)
    order = SlewOrder(
        _craft(inertia, dipole_limit, heat),
        axes,
        axes.pointing if camera_axis is None else unit_vector("camera_axis", camera_axis),
        start,
        goal,
        duration,
        min(STRETCH * duration, HORIZON_RANGE[1]) if longest is None else longest,
        window,
        time_cost,
        _cone_angles(cones),
        nodes,
    )
    _check_order(order)
    made = plan_order(order, _ephemeris(elements, time, window + order.longest), LEAD)
    return replace(made, begin=made.begin - LEAD)
