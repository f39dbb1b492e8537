"""The planners of the public interface: a step about one axis, and a slew in three axes with coils alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from knightcube.astro.earth.ephemeris import predict
from knightcube.astro.earth.orbit_knowledge import TwoLineElements
from knightcube.astro.earth.sun import DAY
from knightcube.errors import UsageError
from knightcube.gnc.guidance.one_axis.plant import PathCost, SingleAxisPlant, q2_of
from knightcube.gnc.guidance.one_axis.vmc import MAX_STRETCH, NODES, StepPlan, plan
from knightcube.gnc.guidance.three_axes.attitude_law import BodyAxes
from knightcube.gnc.guidance.three_axes.pointing_target import Goal, PointingTarget
from knightcube.gnc.guidance.three_axes.slew_model import NODES as SLEW_NODES
from knightcube.gnc.guidance.three_axes.slew_model import SlewCraft
from knightcube.gnc.guidance.three_axes.slew_plan import LEAD, OrderedSlew, SlewOrder, plan_order

STRETCH = 3.0
"""Longest slew without `longest`, as a multiple of `duration`."""
_UNIX_EPOCH = 2_440_587.5
"""Julian date of the epoch of Unix time."""


def plan_step(
    plant: SingleAxisPlant,
    *,
    start_angle: float,
    end_angle: float,
    horizon: float,
    start_rate: float = 0.0,
    end_rate: float = 0.0,
    time_cost: float | None = None,
    minimise: Literal["heat", "supply"] = "heat",
    nodes: int = NODES,
    max_stretch: float = MAX_STRETCH,
) -> StepPlan:
    """Return the minimum-energy path of a body about one axis that one torque coil rotates.

    The path is optimised by virtual motion camouflage (Sease 2013, 5.8-5.15) with NLopt's SLSQP, under the
    current limit of the plant and |angle| <= 1.496 rad at every time, beyond which the coil has almost no
    torque. If no path over the horizon keeps the limits, the horizon is stretched to the shortest feasible
    one and the status of the plan is "stretched". A plan takes about 2 ms.

    `plan.path.motion(times)` gives angle, rate and acceleration at times (n,), s after the start, and
    `plant.currents` the coil current for them.

    Args:
        plant: inertia, torque constant, coil and thread.
        start_angle: angle at the start, rad, measured from the direction of the largest torque.
        end_angle: angle at the end, rad.
        horizon: duration, s; with `time_cost` the initial guess of the duration.
        start_rate: body rate at the start, rad/s.
        end_rate: body rate at the end, rad/s.
        time_cost: W; the duration is optimised too, for minimum energy plus `time_cost` times the duration.
            None keeps the horizon.
        minimise: "heat" for the integral of R I^2, "supply" for that of V |I|, the energy taken from a
            chopped supply.
        nodes: number of nodes of the path, 8 to 40.
        max_stretch: largest ratio of the duration to `horizon`.

    Raises:
        PlanningError: if an argument is not finite or out of range, or if no path is found.
    """
    return plan(
        plant,
        q2_of(start_angle),
        start_rate,
        q2_of(end_angle),
        end_rate,
        horizon,
        nodes=nodes,
        max_stretch=max_stretch,
        time_cost=time_cost,
        cost=PathCost(minimise),
    )


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
    nodes: int = SLEW_NODES,
) -> OrderedSlew:
    """Return the best slew of a satellite in orbit with torque coils alone, from one target to another.

    Coils make no torque along the magnetic field, so path and dipoles are planned together, by collocation
    with an interior point method, from several initial guesses. The model contains the rotating field, the
    gravity gradient and the gyroscopic torque. The orbit is predicted by SGP4. A plan takes about a second.

    In the result, `plan.path` has attitude, rate and dipole at its `times`, s after the start of the slew;
    `plan.energy` is the heat of the coils, J. `begin` is the start of the slew, s after `time`.

    Args:
        inertia: (3, 3) kg m^2, body axes.
        dipole_limit: (3,) A m^2 of the coils, along the body axes.
        heat: (3,) W/(A m^2)^2, heat of each coil per square of its dipole.
        elements: the two lines of the orbit's element set.
        time: start of the slew, or of the window; UTC without a time zone.
        start: target that is held until the slew begins; a free roll is taken as zero.
        goal: target at the end; with a free roll only its direction counts.
        duration: duration of the slew, s.
        longest: s to which the slew may be stretched if no slew over `duration` is found; None for three
            times `duration`.
        window: s within which the slew begins, at the time of least energy.
        time_cost: W; the duration is optimised too, for minimum energy plus `time_cost` times the duration;
            infinity gives the shortest slew. None keeps the duration.
        pointing_axis: (3,) unit vector, body axis that points to the targets.
        across_axis: (3,) unit vector normal to it, from which a roll is measured.
        camera_axis: (3,) unit vector, body axis that keeps the exclusion cones; None for `pointing_axis`.
        cones: half angles (rad) of the exclusion cones; of the Earth beyond its limb.
        nodes: number of collocation intervals, 8 to 96.

    Raises:
        UsageError: for elements, targets, cones or a window that are out of range.
        PlanningError: if a value is out of range, or if no slew is found; the message gives the reason.
    """
    unknown = set(cones or {}) - {"sun", "earth", "moon"}
    if unknown:
        raise UsageError(f"unknown exclusion cone {unknown.pop()!r}: give sun, earth or moon")
    if Goal.OBJECT in (start.goal, goal.goal):
        raise UsageError("an object is found in flight: no slew can be planned to it")
    pointing = np.array(pointing_axis, dtype=float)
    satellite = SlewCraft(
        np.array(inertia, dtype=float), np.array(dipole_limit, dtype=float), np.array(heat, dtype=float)
    )
    order = SlewOrder(
        satellite,
        BodyAxes(pointing, np.array(across_axis, dtype=float)),
        pointing if camera_axis is None else np.array(camera_axis, dtype=float),
        start,
        goal,
        duration,
        STRETCH * duration if longest is None else longest,
        window,
        time_cost,
        {str(name): angle for name, angle in (cones or {}).items()},
        nodes,
    )
    instant = time.replace(tzinfo=UTC) if time.tzinfo is None else time
    state = TwoLineElements(*elements).at(_UNIX_EPOCH + (instant.timestamp() - LEAD) / DAY)
    made = plan_order(order, predict(state, window + order.longest + 3.0 * LEAD), LEAD)
    return replace(made, begin=made.begin - LEAD)
