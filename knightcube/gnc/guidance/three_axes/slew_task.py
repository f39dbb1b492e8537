"""What a slew's planner is asked for, and which tasks it refuses at once."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.errors import PlanningError
from knightcube.gnc.guidance.three_axes.slew_cones import Cone
from knightcube.gnc.guidance.three_axes.slew_ends import EndLaw, Whole
from knightcube.gnc.guidance.three_axes.slew_model import Along, SlewCraft

NODES = 24
"""Intervals of the dipole. The heat is within 0.1 % of that on 48, the least time within 0.6 %."""
NODES_RANGE = (8, 96)
HORIZON_RANGE = (1.0, 2e4)
_DEEP, _STILL = math.radians(5.0), 1e-4
"""rad within a cone, and rad/s of a target at rest among the stars."""
LEAST_TIME = math.inf
"""A price of time at which only time counts."""


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


def check(task: SlewTask) -> None:
    """Raise PlanningError for a task that no path can fulfil."""
    craft = task.craft
    arrays = (
        craft.inertia,
        craft.limit,
        craft.weights,
        craft.residual,
        craft.torque,
        craft.air,
        craft.light,
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
    end = task.end(task.horizon)
    for cone in task.cones:
        inside = -math.degrees(float(cone.clearance(task.quaternion[None], np.zeros(1))[0]))
        if inside > 0.0:
            raise PlanningError(f"the start lies within the cone of the {cone.name}, by {inside:.1f} deg")
        # The cones move by some degrees over a slew: deep inside, no other horizon helps.
        if isinstance(end, Whole) and _is_deep_inside(end, cone, task.horizon):
            raise PlanningError(f"the end lies within the cone of the {cone.name}")


def in_the_way(task: SlewTask, horizon: float) -> Cone | None:
    """Return a cone within which a slew over `horizon` s would end, by its whole attitude; None without."""
    end = task.end(horizon)
    if not isinstance(end, Whole):
        return None
    shown, time = end.quaternion[None], np.array([horizon])
    return next((cone for cone in task.cones if float(cone.clearance(shown, time)[0]) < 0.0), None)


def _is_deep_inside(end: Whole, cone: Cone, time: float) -> bool:
    """Return whether an end at rest lies far within a cone."""
    inside = float(cone.clearance(end.quaternion[None], np.array([time]))[0])
    return inside < -_DEEP and float(np.abs(end.rate).max()) < _STILL
