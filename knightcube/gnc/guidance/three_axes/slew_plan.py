"""The planner of slews in three axes with coils alone: least energy, least time, or a price of time.

Only torques across the field exist, so a path is planned together with its dipoles: collocation of the whole
motion (`slew_transcription`), Newton's method with barriers (`slew_program`), from several guesses
(`slew_prey`, `slew_search`), closed by an integrator (`slew_closing`). Energy is the integral of the coils'
heat, J. Pure and deterministic.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.errors import PlanningError
from knightcube.gnc.guidance.three_axes.slew_closing import closed
from knightcube.gnc.guidance.three_axes.slew_path import SlewPath
from knightcube.gnc.guidance.three_axes.slew_search import GRIDS, GRIDS_WITH_CONES, Search
from knightcube.gnc.guidance.three_axes.slew_solver import Found
from knightcube.gnc.guidance.three_axes.slew_task import SlewTask, check, in_the_way

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
        search = Search(task, *GRIDS[0])
        found = search.solver.again(near)
        plan = None if found is None else _first(task, search, iter([found]))
        if plan is not None:
            return plan
    for coarse, budget in GRIDS_WITH_CONES if task.cones else GRIDS:
        search = Search(task, coarse, budget)
        plan = _first(task, search, search.paths())
        if plan is not None:
            return plan
        tried += search.tried
    raise PlanningError(_refusal(task, tried))


def _first(task: SlewTask, search: Search, paths: Iterator[Found]) -> SlewPlan | None:
    """Return the plan of the first path that keeps limits and cones when flown, too; None without one."""
    for path in paths:
        found: Found | None = path
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


def _plan(task: SlewTask, search: Search, found: Found) -> SlewPlan | None:
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
