"""The planner of slews in three axes with coils alone: least energy, least time, or a price of time.

Only torques across the field exist, so a path is planned together with its dipoles: collocation of the whole
motion (`slew_transcription`), Newton's method with barriers (`slew_program`), from several guesses
(`slew_prey`, `slew_search`), closed by an integrator (`slew_closing`). Energy is the integral of the coils'
heat, J. Pure and deterministic.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from flight.gnc.errors import PlanningError
from flight.gnc.guidance.three_axes.slew_closing import closed
from flight.gnc.guidance.three_axes.slew_path import SlewPath
from flight.gnc.guidance.three_axes.slew_search import Search
from flight.gnc.guidance.three_axes.slew_solver import Found
from flight.gnc.guidance.three_axes.slew_task import SlewTask, check


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


def plan_slew(task: SlewTask) -> SlewPlan:
    """Return the best plan found. Raises PlanningError with the reason when there is none."""
    check(task)
    search = Search(task)
    found = search.best()
    while found is not None:
        plan = _plan(task, search, found)
        if all(clear >= 0.0 for clear in plan.clearance):
            return plan
        found = search.widened(found, -min(plan.clearance))
    raise PlanningError(
        f"no slew within the dipole's limit{' and outside the cones' * bool(task.cones)} was found over "
        f"{task.horizon:g} to {task.longest:g} s, from {search.tried} guesses"
    )


def _plan(task: SlewTask, search: Search, found: Found) -> SlewPlan:
    """Return the plan that flies a path. Raises PlanningError when the path is not finite."""
    equations, scale = found.equations, found.equations.scale
    at = closed(task.craft, search.solver.unit, task.along, found.program, found.point)
    flow = equations.motion.flow(at.states, at.all_dipoles())
    q = at.states[:, :4] / np.linalg.norm(at.states[:, :4], axis=1, keepdims=True)
    dipole = search.solver.unit * at.all_dipoles()
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
        search.solver.energy(found),
        float((np.abs(path.dipole) / task.craft.limit).max()),
        tuple(float(cone.clearance(shown, dense).min()) for cone in task.cones),
        search.solver.steps,
    )
