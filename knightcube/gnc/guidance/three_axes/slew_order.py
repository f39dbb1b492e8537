"""Orders of slews in orbit: from one pointing target to another, begun at the best time of a window.

How much a slew costs depends on where the field points meanwhile, by a factor of ten along an orbit. So
coarse slews are planned from several begins, and the best is planned in full.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.ephemeris import Ephemeris
from knightcube.astro.quaternion import attitude_matrix
from knightcube.errors import PlanningError, UsageError
from knightcube.gnc.guidance.three_axes.attitude_law import DIFFERENCE, Attitudes, references
from knightcube.gnc.guidance.three_axes.pointing_target import Goal, PointingTarget
from knightcube.gnc.guidance.three_axes.slew_ends import Boresight, End, EndLaw, Whole
from knightcube.gnc.guidance.three_axes.slew_model import SlewCraft
from knightcube.gnc.guidance.three_axes.slew_plan import SlewPlan, SlewStatus, plan_slew
from knightcube.gnc.guidance.three_axes.slew_sky import along, cones
from knightcube.gnc.guidance.three_axes.slew_task import NODES, SlewTask
from knightcube.gnc.guidance.three_axes.target_law import BodyAxes, directions_of, law_of

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
            return Boresight(axis, now, np.cross(now, after - before) / (2.0 * DIFFERENCE))

        return aimed
    law = law_of(goal, axes, _NO_ROLL, ephemeris, begin)

    def whole(horizon: float) -> End:
        quaternion, rate = _motion(law, ephemeris, begin + horizon)
        return Whole(quaternion, attitude_matrix(quaternion).T @ rate)

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
