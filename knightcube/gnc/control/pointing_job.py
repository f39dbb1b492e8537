"""The planning job that computes a pointing table (feedforward and feedback gains) for a pointing target.

Field and torques are predicted along the orbit for a revolution and a quarter, because the gains at the end
of the table depend on the following revolution. The pointing table covers a third of a revolution of the
orbit. A passing object is near for only a few minutes, so pointing tables for an object are short, have short
time steps, and are recomputed after each sighting.

From a distant attitude, the body can approach the commanded attitude by a slew of minimum heat. The module
`slew_plan`, or `slew_vmc` on request, plans the slew with the disturbance torques that the attitude filter
estimates. The planned dipole moments of the slew are used as feedforward. During the slew, the remaining slew
is replanned from the newest estimates of motion, body and torques, with the present path as the initial guess
(`rest_table`). The feedback gains are computed by linear-quadratic tracking along the slew and the attitude
law after it, and errors at the end of the slew have the highest cost. The pointing table also contains the
derivatives of the dipole moment with respect to the estimated torques.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from datetime import datetime

import numpy as np
from numpy.typing import ArrayLike

from knightcube.astro.arrays import FloatArray, check_type, finite_array, unit_quaternion
from knightcube.astro.earth.disturbance import SIZES, Pressures, box_areas, pressures, shapes
from knightcube.astro.earth.ephemeris import Ephemeris, predict
from knightcube.astro.earth.orbit_knowledge import OrbitState
from knightcube.astro.earth.sun import julian_date
from knightcube.astro.inertia import checked_inertia
from knightcube.astro.quaternion import (
    angle_between,
    attitude_matrix,
    conjugate,
    from_rotation_vector,
    multiply,
    to_rotation_vector,
)
from knightcube.errors import ArgumentError, PlanningError
from knightcube.gnc.control.pointing_law import PointingLaw
from knightcube.gnc.control.pointing_path import CostToGo, SweepCost, linearised, sweep
from knightcube.gnc.control.pointing_table import (
    PointingPreview,
    PointingTable,
    PointingWeights,
    pointing_table,
    step_costs,
)
from knightcube.gnc.guidance.attitude_law import (
    AttitudeReferences,
    BodyAxes,
    approach,
    following,
    law_of,
    references,
)
from knightcube.gnc.guidance.pointing_target import PointingTarget
from knightcube.gnc.guidance.slew_model import (
    NODES,
    Cone,
    EnvironmentAt,
    SlewCraft,
    SlewPath,
    SlewTask,
    along,
    cones,
    heat_matrix,
)
from knightcube.gnc.guidance.slew_plan import (
    SlewPlan,
    body_axes,
    check_target,
    end_law,
    known_orbit,
    plan_near,
    plan_task,
)

PlanTask = Callable[[SlewTask, SlewPath | None], SlewPlan]
"""Function that plans a task, starting from the path of a similar task if given (`slew_plan.plan_task`)."""
PlanNear = Callable[[SlewTask, SlewPath], SlewPlan | None]
"""Function that plans a task near the path of a similar task, or returns None (`slew_plan.plan_near`)."""

RESERVE = 0.8
"""Fraction of the coils' limit that a planned slew may use; the remainder is for the correction of errors."""
STIFFER = 5.0
"""Factor by which a dipole moment during a slew must be larger to have the same cost as at other times."""
LONGEST = 1_500.0
"""Longest duration of a slew, s. A slew must be shorter than a table, which also includes some time after the
slew."""
FINE = 5
"""Number of steps of a slew table per step of a pointing table, because a slewing body rotates faster."""
TAIL = 300.0
"""Duration (s) after the end of a slew that is included in the computation of the feedback gains."""
END = 2_000.0
"""Weight (s) of errors at the end of a slew: an error at the end has the same cost as an equal error that
lasts for this time. The weight is high because disturbance torques are poorly known before the slew, and the
errors that they cause should be corrected by the end of the slew."""
HOTTER = 1.1
"""Largest accepted ratio of the coil heat of a new plan for the remaining slew to that of the present plan. A
new plan with more heat is rejected, because it would correct a deviation for which the remaining time is too
short."""
FEWEST = 12
"""Smallest number of collocation intervals for the remaining part of a slew."""
_INSIDE = 1e-6
"""Additional reduction (rad) of the half angle of a violated exclusion cone, so that the path is outside the
cone."""
_SLOWER, _MOST_SLOWER, _TRIALS = 1.05, 1.5, 5
"""Extension of a slew that rotates too fast: the duration is multiplied by the first value times the ratio of
the rate to the permitted rate, but at most by the second value. The third value is the largest number of
trials."""


@dataclass(frozen=True, slots=True, eq=False)
class SlewRequest:
    """The parameters of slews to a pointing target.

    Attributes:
        seconds: requested duration of the slew, s; the slew takes longer if this duration is too short.
        heat: heating power of the coils per squared dipole moment (3, 3), W/(A m^2)^2, or its diagonal (3,).
        residual: residual dipole moment (3,) of the satellite, A m^2.
        camera: body axis (3,) of the camera.
        angles: half angles of the camera's exclusion cones for `sun`, `earth` and `moon`, rad.
        limit: mean dipole limit of slews along each body axis (3,), A m^2, or None for the limit of the job.
        planner: `collocation` (`slew_plan`) or `vmc`, virtual motion camouflage (`slew_vmc`).
    """

    seconds: float
    heat: FloatArray
    residual: FloatArray
    camera: FloatArray
    angles: dict[str, float] = field(default_factory=dict)
    limit: FloatArray | None = None
    planner: str = "collocation"

    def planners(self) -> tuple[PlanTask, PlanNear]:
        """Return the functions `plan_task` and `plan_near` of the planner."""
        if self.planner == "vmc":
            from knightcube.gnc.guidance import slew_vmc  # noqa: PLC0415 - loads NLopt

            return slew_vmc.plan_task, slew_vmc.plan_near
        return plan_task, plan_near


@dataclass(frozen=True, slots=True, eq=False)
class SlewStart:
    """The state at the start of a slew.

    Attributes:
        quaternion, rate: attitude (4,) and body rate (3,), rad/s, at the first of `times`.
        times: equally spaced times (m,) of table and preview, s.
        kept: number of time steps in the pointing table.
        inertia: inertia tensor (3, 3) in body axes, kg m^2.
        limit: mean dipole limit (A m^2) along each body axis, one number for all axes or an array (3,).
        sizes: estimated components (9,) of the disturbance torques, N m.
        areas: scaled areas (3,) of the body's faces, on which air and sunlight act.
    """

    quaternion: FloatArray
    rate: FloatArray
    times: FloatArray
    kept: int
    inertia: FloatArray
    limit: float | FloatArray
    sizes: FloatArray
    areas: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class RunningSlew:
    """The present path of a slew, which the body follows while the remaining part is replanned.

    The time `origin_ns` of the planning job is `since` s after the start of the path.
    """

    path: SlewPath
    since: float


def slew(
    begin: SlewStart,
    wish: SlewRequest,
    target: PointingTarget,
    axes: BodyAxes,
    ahead: Ephemeris,
    fastest: float,
) -> SlewPath | None:
    """Return a slew, slower than `fastest` rad/s, to the attitude law of a target, or None if none is found.

    If possible, the slew avoids the exclusion cones that do not contain the camera axis at the start.
    """
    first = float(begin.times[0])
    start = begin.quaternion[None]
    avoided = tuple(
        cone
        for cone in cones(ahead, first, wish.camera, **wish.angles)
        if float(cone.clearance(start, np.zeros(1))[0]) >= 0.0
    )
    task = _task(begin, wish, target, axes, ahead, along(ahead, first), wish.seconds, avoided)
    found = _slow_enough(wish, task, fastest)
    if found is None and task.cones:
        task = replace(task, cones=())
        found = _slow_enough(wish, task, fastest)
    if found is None or not begin.sizes.any():
        return found
    # The areas exposed to air and sunlight depend on the path, so the slew is planned again with new areas.
    pressed = along(ahead, first, begin.areas, found)
    again = replace(task, along=pressed, horizon=found.horizon)
    return _slow_enough(wish, again, fastest, found) or found


def _task(
    begin: SlewStart,
    wish: SlewRequest,
    target: PointingTarget,
    axes: BodyAxes,
    ahead: Ephemeris,
    around: EnvironmentAt,
    seconds: float,
    avoided: tuple[Cone, ...],
) -> SlewTask:
    """Return the planning task of a slew of `seconds` s to the attitude law of a target."""
    limit = begin.limit if wish.limit is None else wish.limit
    craft = SlewCraft(begin.inertia, np.full(3, RESERVE * limit), wish.heat, wish.residual)
    law = end_law(target, axes, ahead, float(begin.times[0]))
    return SlewTask(
        craft.facing(begin.sizes), around, begin.quaternion, begin.rate, law, seconds, LONGEST, cones=avoided
    )


def _slow_enough(
    wish: SlewRequest, task: SlewTask, fastest: float, near: SlewPath | None = None
) -> SlewPath | None:
    """Return a path of a task with body rates below `fastest` rad/s, or None if none is found.

    The duration is increased if necessary. The search starts from `near`, the path of a similar task.
    """
    plan, _ = wish.planners()
    for _ in range(_TRIALS):
        try:
            path = plan(task, near).path
        except PlanningError:
            return None
        speed = float(np.linalg.norm(path.rate, axis=1).max())
        if speed < fastest:
            return path
        longer = path.horizon * min(_SLOWER * speed / fastest, _MOST_SLOWER)
        if longer > LONGEST:
            return None
        task, near = replace(task, horizon=longer), None
    return None


def slew_table(
    begin: SlewStart,
    path: SlewPath,
    residual: FloatArray,
    target: PointingTarget,
    axes: BodyAxes,
    ahead: Ephemeris,
    expected: PointingPreview,
    weights: PointingWeights,
) -> PointingTable:
    """Return the pointing table for a slew and for the attitude law after it.

    The time step of the returned table is a fifth of the time step of `begin.times`.

    The path was planned with the residual dipole moment `residual` (3,), A m^2. The environment is taken from
    `expected`, whose instants are `begin.times`.
    """
    step, first = float(begin.times[1] - begin.times[0]) / FINE, float(begin.times[0])
    law = law_of(target, axes, path.quaternion[-1], ahead, first + path.horizon)
    coarse = math.ceil(path.horizon / (FINE * step))
    lawful = references(law, ahead, begin.times).since(coarse)
    after = PointingPreview(
        lawful,
        lawful.until(begin.kept + 1 - coarse),
        expected.field[coarse:],
        expected.position[coarse:],
        Pressures(expected.pressures.air[coarse:], expected.pressures.light[coarse:]),
        expected.sizes,
    )
    held = pointing_table(after, begin.inertia, begin.limit, weights)
    count = FINE * coarse
    times = np.asarray(first + step * np.arange(FINE * begin.kept + 1), dtype=float)
    wanted = references(law, ahead, times)
    flown = path.references(times[:count] - first)
    # The pointing law subtracts the residual dipole moment in flight, so it is added to the table.
    dipole = path.dipoles(times[:count] + 0.5 * step - first) + residual
    stop = count + round(TAIL / step)
    tracked = _joined(flown, wanted.until(stop + 1))
    gain, torque_part = (part[:count] for part in _tracking(tracked, ahead, dipole, begin, weights))
    dipoles, gains, torque_parts = (
        np.concatenate([slewed, np.repeat(kept, FINE, axis=0)])
        for slewed, kept in ((dipole, held.dipole), (gain, held.gain), (torque_part, held.torque_part))
    )
    whole = _joined(flown, _finer(held.path, times, count))
    return PointingTable(whole, wanted, dipoles, gains, torque_parts, begin.sizes, path)


def _finer(path: AttitudeReferences, times: FloatArray, count: int) -> AttitudeReferences:
    """Interpolate a path at `times` (n,), s; the first `count` instants are copies of the next one."""
    rest = [path.at(float(time)) for time in times[count:]]
    whole = [*[rest[0]] * count, *rest]
    return AttitudeReferences(
        times,
        np.array([part.quaternion for part in whole]),
        np.array([part.rate for part in whole]),
        np.array([part.acceleration for part in whole]),
    )


def _joined(first: AttitudeReferences, then: AttitudeReferences) -> AttitudeReferences:
    """Return the motion `then`, with its first instants replaced by the motion `first`."""
    count = len(first.times)
    return AttitudeReferences(
        then.times,
        np.concatenate([first.quaternion, then.quaternion[count:]]),
        np.concatenate([first.rate, then.rate[count:]]),
        np.concatenate([first.acceleration, then.acceleration[count:]]),
    )


def _tracking(
    tracked: AttitudeReferences,
    ahead: Ephemeris,
    dipole: FloatArray,
    begin: SlewStart,
    weights: PointingWeights,
) -> tuple[FloatArray, FloatArray]:
    """Return tracking gains (n, 3, 6), and dipole moments (n, 3, 9) per unit of each disturbance component.

    The motion `tracked` contains the slew, for which `dipole` is planned, and the motion after the slew.
    """
    count, steps = len(dipole), len(tracked.times) - 1
    times, step = tracked.times[:steps], float(tracked.times[1] - tracked.times[0])
    planned = np.concatenate([dipole, np.zeros((steps - count, 3))])
    linear = linearised(
        tracked.until(steps), begin.inertia, ahead.field_at(times), ahead.position_at(times), planned
    )
    to_body = attitude_matrix(tracked.quaternion[:steps])
    shape = shapes(pressures(ahead, times).facing(begin.areas, to_body), to_body)
    affine = linear.by_torque @ shape
    state, dipole_cost = step_costs(replace(weights, roll=None), step)
    control = np.full((steps, 3), dipole_cost / STIFFER**2)
    nothing, states = np.zeros(affine.shape), np.repeat(state[None], steps, axis=0)
    states[count] *= END / step
    cost = SweepCost(states, control, nothing, nothing[:, :3])
    gain, steady, _ = sweep(linear, affine, cost, CostToGo(state, nothing[0]))
    return gain, steady


def rest_table(job: PointingJob, wish: SlewRequest, running: RunningSlew) -> PointingTable | None:
    """Return the table for the remaining part of a slew, or None if the present plan should be kept.

    The remaining slew is planned from the newest estimate, with the arrival time of the present plan. The new
    path is the optimal path to which the search converges from the present path. The present plan is kept if
    no such path is found, or if the new path rotates too fast or causes more than `HOTTER` times the heat of
    the present path. The table ends `TAIL` s after the end of the slew.
    """
    near = running.path.since(running.since + LEAD, NODES)
    ahead = predict(job.orbit, LEAD + near.horizon + TAIL + 4.0 * STEADY.step)
    quaternion, rate = _propagated(job, running)
    step = STEADY.step / FINE
    count = math.ceil(near.horizon / step)
    times = np.asarray(LEAD + step * np.arange(count + round(TAIL / step) + 1), dtype=float)
    begin = SlewStart(quaternion, rate, times, count, job.inertia, job.limit, job.sizes, job.areas)
    avoided = tuple(
        _narrowed(cone, near, quaternion) for cone in cones(ahead, LEAD, wish.camera, **wish.angles)
    )
    around = along(ahead, LEAD, job.areas, near)
    task = _task(begin, wish, job.target, job.axes, ahead, around, near.horizon, avoided)
    # The rest of a slew needs fewer intervals than the whole slew for the same accuracy.
    nodes = math.ceil(NODES * near.horizon / wish.seconds)
    task = replace(task, longest=near.horizon, nodes=min(max(nodes, FEWEST), NODES))
    _, plan_rest = wish.planners()
    try:
        plan = plan_rest(task, near)
    except PlanningError:
        return None
    if plan is None or plan.horizon != near.horizon or plan.energy > HOTTER * near.heat(wish.heat):
        return None
    path = plan.path
    if float(np.linalg.norm(path.rate, axis=1).max()) >= job.weights.fastest:
        return None
    wanted = references(
        law_of(job.target, job.axes, path.quaternion[-1], ahead, LEAD + path.horizon), ahead, times
    )
    # The pointing law subtracts the residual dipole moment in flight, so it is added to the table.
    dipole = path.dipoles(times[:count] + 0.5 * step - LEAD) + wish.residual
    tracked = _joined(path.references(times[:count] - LEAD), wanted)
    gain, torque_part = _tracking(tracked, ahead, dipole, begin, job.weights)
    dipoles = np.concatenate([dipole, np.zeros((len(gain) - count, 3))])
    return PointingTable(tracked, wanted, dipoles, gain, torque_part, job.sizes, path)


def _propagated(job: PointingJob, running: RunningSlew) -> tuple[FloatArray, FloatArray]:
    """Return attitude (4,) and rate (3,) after `LEAD` s at a constant rate error relative to the path."""
    now, then = running.since, running.since + LEAD
    path = running.path.references(np.array([now, then]))
    error = multiply(job.quaternion, conjugate(path.quaternion[0]))
    missed = job.rate - attitude_matrix(error) @ path.rate[0]
    error = from_rotation_vector(to_rotation_vector(error) + LEAD * missed)
    return multiply(error, path.quaternion[1]), attitude_matrix(error) @ path.rate[1] + missed


def _narrowed(cone: Cone, path: SlewPath, start: FloatArray) -> Cone:
    """Return an exclusion cone, narrowed until a path and an initial attitude `start` (4,) are outside."""
    room = min(
        float(cone.clearance(path.quaternion, path.times).min()),
        float(cone.clearance(start[None], np.zeros(1))[0]),
    )
    return cone if room >= 0.0 else replace(cone, angle=cone.angle + room - _INSIDE)


@dataclass(frozen=True, slots=True)
class TableSpan:
    """Shortest duration of the prediction (`preview`), duration of the table (`kept`), and table step, s."""

    preview: float
    kept: float
    step: float


STEADY, PASSING = TableSpan(7_200.0, 1_800.0, 10.0), TableSpan(120.0, 60.0, 2.0)
"""Spans of tables for targets of unlimited duration (first value) and for a passing object (second value)."""
_COVERED = 1.25
"""Minimum length of the prediction for a target of unlimited duration, in revolutions of the orbit."""
_LONGEST = 10_000.0
"""Longest prediction (s), a revolution and a quarter at an altitude of 2,200 km."""
LEAD = 2.0
"""Time (s) between the estimated state and the start of the table, during which the table is computed."""
FAR = math.radians(15.0)
"""Angle (rad) between attitude and attitude law above which the body slews to the law, if slews are
configured."""
WAY = 4.0
"""Duration of the initial guess of the approach, in time constants of the pointing law. The optimised path
does not depend on the duration of the initial guess."""


@dataclass(frozen=True, slots=True, eq=False)
class ObjectDirection:
    """The direction (3,) of an object, ICRS, `since` s after the time `origin_ns` of the planning job.

    The vector `velocity` (3,), 1/s, is the velocity of the object relative to the satellite, divided by the
    distance. It is zero for a search direction.
    """

    direction: FloatArray
    velocity: FloatArray
    since: float

    @property
    def span(self) -> TableSpan:
        """Durations of the prediction and of the tables for this object."""
        return PASSING if self.velocity.any() else STEADY


@dataclass(frozen=True, slots=True, eq=False)
class PointingJob:
    """A planning job that begins with the given orbit state, attitude (4,) and body rate (3,), rad/s.

    Attributes:
        origin_ns: time at which the orbit state, the attitude and the body rate are valid, ns.
        inertia: inertia tensor (3, 3) in body axes, kg m^2.
        sizes: estimated components (9,) of the disturbance torques, N m.
        limit: mean dipole limit (A m^2) along each body axis, one number for all axes or an array (3,).
        areas: scaled areas (3,) of the body's faces, on which air and sunlight act.
        slew: parameters of slews, or None if the body approaches every attitude law without a slew.
        running: the slew in progress whose remaining part is replanned, or None if a new path is planned.
        sight: the sighted object at which the body points instead of `target`, or None.
    """

    number: int
    origin_ns: int
    orbit: OrbitState
    inertia: FloatArray
    axes: BodyAxes
    weights: PointingWeights
    target: PointingTarget
    quaternion: FloatArray
    rate: FloatArray
    sizes: FloatArray
    limit: float | FloatArray
    areas: FloatArray
    slew: SlewRequest | None = None
    running: RunningSlew | None = None
    sight: ObjectDirection | None = None

    @property
    def span(self) -> TableSpan:
        """The span of the table."""
        return STEADY if self.sight is None else self.sight.span


def prepare() -> None:
    """Import the modules that plan slews, before the first job of the worker process."""
    from scipy.linalg import lapack  # noqa: F401, PLC0415 - the control process does not need scipy


def run(job: PointingJob) -> PointingTable | None:
    """Return the pointing table, whose times are in s after the job's time `origin_ns`.

    The result is None if the remaining part of a slew was replanned, and no plan was better than the present
    plan. The computation takes about one second, two seconds with a slew, and a tenth of a second for the
    remaining part of a slew. Raises KnightCubeError if the magnetic field is unknown, and UsageError if the
    target does not define an attitude.
    """
    if job.running is not None and job.slew is not None:
        return rest_table(job, job.slew, job.running)
    return new_table(job)


def new_table(job: PointingJob) -> PointingTable:
    """Return the pointing table of a new path, which begins with a slew if the target is far (see `run`)."""
    span = job.span
    preview = span.preview
    if span is STEADY:
        preview = min(max(preview, _COVERED * job.orbit.period), _LONGEST)
    ahead = predict(job.orbit, preview + 4.0 * STEADY.step)
    times = np.arange(LEAD, preview, span.step)
    kept = round(span.kept / span.step)
    quaternion = multiply(from_rotation_vector(LEAD * job.rate), job.quaternion)
    sight, axis = job.sight, job.axes.pointing
    if sight is None:
        law = law_of(job.target, job.axes, quaternion, ahead, LEAD)
    else:
        law = following(axis, sight.direction, sight.velocity, sight.since, quaternion).attitudes
    field, wanted = ahead.field_at(times), references(law, ahead, times)
    # The duration of the initial guess is a multiple of the time constant that follows from the weights.
    strength = float(np.mean(np.linalg.norm(field, axis=1)))
    inertia = float(np.linalg.eigvalsh(job.inertia).max())
    square = strength * job.weights.dipole / (inertia * job.weights.turn)
    seconds = min(max(WAY / math.sqrt(square), 10.0 * span.step), span.kept)
    way = approach(law, quaternion, job.rate, LEAD, LEAD + seconds)
    found = PointingPreview(
        wanted,
        references(way, ahead, times[: kept + 1]),
        field,
        ahead.position_at(times),
        pressures(ahead, times).facing(job.areas, attitude_matrix(wanted.quaternion)),
        job.sizes,
    )
    wish = job.slew
    if wish is not None and float(angle_between(quaternion, wanted.quaternion[0])) > FAR:
        begin = SlewStart(quaternion, job.rate, times, kept, job.inertia, job.limit, job.sizes, job.areas)
        path = slew(begin, wish, job.target, job.axes, ahead, job.weights.fastest)
        if path is not None:
            return slew_table(begin, path, wish.residual, job.target, job.axes, ahead, found, job.weights)
    return pointing_table(found, job.inertia, job.limit, job.weights)


def plan_pointing(
    *,
    inertia: ArrayLike,
    dipole_limit: ArrayLike,
    elements: tuple[str, str],
    time: datetime,
    target: PointingTarget,
    quaternion: ArrayLike,
    rate: ArrayLike,
    weights: PointingWeights,
    pointing_axis: ArrayLike = (0.0, 0.0, 1.0),
    across_axis: ArrayLike = (1.0, 0.0, 0.0),
) -> PointingLaw:
    """Return the pointing law of a satellite with torque coils alone, from its motion at `time` to a target.

    The law is a planned path to the target with feedback gains, computed from the magnetic field and the
    gravity gradient that are predicted along the orbit by SGP4. Its times are in s after `time`; its `span`
    begins two seconds after `time`, because a plan takes about a second, and covers half an hour. Plan again
    every few minutes from the newest estimates.

    Args:
        inertia: symmetric inertia tensor (3, 3) in body axes, kg m^2, or the principal moments (3,).
        dipole_limit: dipole limits (3,) of the coils along the body axes, A m^2.
        elements: two lines of the two-line element set of the orbit, with an epoch near `time`.
        time: datetime of the motion, in UTC or with a time zone.
        target: pointing target. If its roll is free, the body keeps its roll angle.
        quaternion: attitude (4,) at `time`, from ICRS into body axes, scalar last.
        rate: body rate (3,) at `time`, rad/s.
        weights: weights of errors and dipole moment, for a 1U CubeSat 0.0175 rad, 1 rad/s and 3e-4 A m^2.
        pointing_axis: body axis (3,), of any length, that points to the target.
        across_axis: body axis (3,), of any length, from which a roll is measured.

    Raises:
        UsageError: if an argument is invalid; the message gives the argument, its value and the remedy.
        OrbitError: if `time` is too far from the epoch of the elements (see `propagate_elements`).
        GeomagneticError: if the path is outside the years 2025 to 2030 of the magnetic field model.
    """
    tensor = checked_inertia("inertia", heat_matrix(finite_array("inertia", inertia, (3, 3), (3,))))
    limit = finite_array("dipole_limit", dipole_limit, (3,))
    if limit.min() <= 0.0:
        raise ArgumentError("dipole_limit", f"{limit.tolist()}: give limits above zero A m^2")
    check_target("target", target)
    check_type("weights", weights, PointingWeights)
    q, w = unit_quaternion("quaternion", quaternion), finite_array("rate", rate, (3,))
    axes, none = body_axes(pointing_axis, across_axis), np.zeros(SIZES)
    orbit = known_orbit(elements, time, _LONGEST).at(julian_date(time))
    areas = box_areas(tensor)
    job = PointingJob(0, 0, orbit, tensor, axes, weights, target, q, w, none, limit, areas)
    return PointingLaw(new_table(job), limit)
