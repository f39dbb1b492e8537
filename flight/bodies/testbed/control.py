"""Guidance and control of the testbed: targets, path planning, and control of the rotation about its thread.

Paths are planned by one of three strategies. The strategy GOAL plans the whole step when a target is set.
Every few seconds, it plans the remaining part again from the newest estimate, so that each new plan is the
optimal continuation of the step. Near the goal time, the last path is followed to its end. After the end of
this path, each plan holds the target for one replanning period. If the body is displaced from its path, a new
path is planned. The strategy RECEDING is described in the thesis: each plan reaches the target one full
planning horizon after the time of planning (Sease, chapter 5, Optimal Path Planning). The strategy STEP makes
no plan: the controller tracks the target itself.

The control laws are B-dot detumbling and a controller of the rotation about the suspension thread. A
Helmholtz cage reproduces the magnetic field along an orbit. The cage produces the field that a satellite
would measure in its local orbital frame. The axis x is along the flight direction, z points down, and y, the
axis of the thread, is opposite to the orbit normal. The rotation about the thread is therefore the pitch of
an Earth-pointing satellite, in a field that rotates once per revolution and varies in strength. The cage
produces only the two field components normal to the thread, multiplied by `scale`. The component along the
thread would cause no torque about the thread.

Both the cage's control computer and the flight software predict the field as a function of UTC, by the World
Magnetic Model along the orbit of the two-line elements. The coil on body x has no torque while the field is
parallel to its axis. The torque about the thread is therefore distributed over the coils on x and z, so that
their current is minimal.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from flight.link import events
from flight.link.telemetry.definitions import MAX_NODES, PLAN
from flight.loop.body import COMMANDED, KEPT, PLANNER, CoilCommand, Target, Tracker
from flight.loop.executive import Cycle, JobResult
from flight.loop.facts import Services
from flight.schema.bodies import Cage, Control, Identification, TestbedConfig
from flight.schema.document import ConfigError
from hal.interfaces.wires import SECOND_NS, Clock
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.ephemeris import Ephemeris, predict
from knightcube.astro.earth.geomagnetism import field
from knightcube.astro.earth.orbit_knowledge import OrbitError, TwoLineElements
from knightcube.astro.earth.sun import DAY, UNIX_EPOCH
from knightcube.astro.quaternion import about_axis_y, angle_about_axis_y, attitude_matrix
from knightcube.errors import UsageError
from knightcube.gnc.control.detumble import Detumbler
from knightcube.gnc.control.one_axis import (
    AngleController,
    ExcitationController,
    ExcitationSettings,
    LqTracker,
)
from knightcube.gnc.estimation.attitude_filter import AttitudeFilter, AttitudeFilterSettings
from knightcube.gnc.estimation.estimate import NOMINAL, PARAMETERS, Estimate, Parameters, SlowPrior
from knightcube.gnc.estimation.rigid_body import RigidBody
from knightcube.gnc.guidance.path_guidance import PathGuidance
from knightcube.gnc.guidance.plant import (
    FARTHEST,
    Q2_LIMIT,
    PathCost,
    PathSample,
    SingleAxisPlant,
    angle_of,
    q2_of,
)
from knightcube.gnc.guidance.pointing_target import PointingTarget
from knightcube.gnc.guidance.vmc import PlanJob, PlanStatus, StepPlan
from knightcube.reference.control import AdaptiveController, AdaptiveSettings, PidController, PidSettings


def plant_of(config: TestbedConfig) -> SingleAxisPlant:
    """Return the plant model that planner, tracker and filter share."""
    section = config.plant
    return SingleAxisPlant(
        inertia=section.inertia,
        torque_constant=section.coil_turns * section.coil_area * section.field,
        resistance=config.coils.resistance[0],
        current_limit=min(
            config.coils.current_limit, config.coils.supply_voltage / config.coils.resistance[0]
        ),
        stiffness=section.thread_stiffness,
        damping=section.thread_damping,
    )


LEAST_GAIN, MOST_GAIN = 0.5, 2.0
"""Limits of the estimated coil gain; outside these limits the filter has not converged."""


class ThreadEstimate(NamedTuple):
    """Angle (rad), rate (rad/s) and disturbance (rad/s^2) about the thread.

    The estimate `whole`, from which these values follow, contains the covariance and `measured_ns`, the time
    of the newest measurement. The disturbance refers to a plant with the parameters `model`, as described at
    `about_thread`.
    """

    time_ns: int
    angle: float
    rate: float
    disturbance: float
    measured_ns: int
    whole: Estimate
    model: Parameters

    @property
    def q2(self) -> float:
        """The second component of the quaternion (q2)."""
        return math.sin(0.5 * self.angle)

    @property
    def angle_sigma(self) -> float:
        """The standard deviation of the angle, rad."""
        return math.sqrt(self.whole.covariance[1, 1])

    @property
    def rate_sigma(self) -> float:
        """The standard deviation of the rate, rad/s."""
        return math.sqrt(self.whole.covariance[4, 4])

    @property
    def covariance(self) -> FloatArray:
        """The covariance (3, 3) of angle, rate and disturbance."""
        model, whole = self.model, self.whole
        torsion, damping, _ = whole.parameters
        scale = _gain_ratio(whole, model)
        torque = self.disturbance - model.torsion * self.angle - model.damping * self.rate
        rows = np.zeros((3, len(whole.covariance)))
        rows[0, 1] = rows[1, 4] = 1.0
        rows[2, 10] = scale
        rows[2, 1], rows[2, 4] = model.torsion - scale * torsion, model.damping - scale * damping
        rows[2, PARAMETERS] = -scale * self.angle, -scale * self.rate, -torque * scale / model.gain
        return np.asarray(rows @ whole.covariance @ rows.T)


def _gain_ratio(estimate: Estimate, model: Parameters) -> float:
    """Return the coil gain of `model`, divided by the estimated gain within its limits."""
    return model.gain / min(max(estimate.parameters.gain, LEAST_GAIN), MOST_GAIN)


def about_thread(estimate: Estimate, model: Parameters = NOMINAL) -> ThreadEstimate:
    """Return the rotation about the thread; it is exact if the body rotates only about the thread.

    The disturbance is the part of the acceleration that a plant with the parameters `model` does not explain.
    It is scaled so that this plant needs the same current as the body to hold an attitude.
    """
    angle, rate = angle_about_axis_y(estimate.quaternion), float(estimate.rate[1])
    torsion, damping, _ = estimate.parameters
    unexplained = float(estimate.disturbance[1]) - torsion * angle - damping * rate
    torque = _gain_ratio(estimate, model) * unexplained
    disturbance = torque + model.torsion * angle + model.damping * rate
    return ThreadEstimate(estimate.time_ns, angle, rate, disturbance, estimate.measured_ns, estimate, model)


class ThreadReader:
    """Computes the rotation about the thread, once for each estimate."""

    def __init__(self, model: Parameters) -> None:
        self._model = model
        self._last: tuple[Estimate, ThreadEstimate] | None = None

    def read(self, estimate: Estimate) -> ThreadEstimate:
        """Return the rotation about the thread according to an estimate."""
        if self._last is None or self._last[0] is not estimate:
            self._last = estimate, about_thread(estimate, self._model)
        return self._last[1]


@dataclass(frozen=True, slots=True)
class ThreadLaw:
    """A target at which the body reaches `q2` with `rate` (rad/s) and then keeps this rate."""

    q2: float
    rate: float = 0.0

    @property
    def text(self) -> str:
        """The target as text for events."""
        return f"q2 {self.q2:+.3f}"

    def quaternion(self, now_ns: int) -> FloatArray:
        """Return the attitude (4,) to be reached, from the reference frame to the body."""
        return about_axis_y(angle_of(self.q2))


def law_of(target: Target) -> ThreadLaw:
    """Return the law (angle as a function of time) of a target, which must be a target of the testbed."""
    law = target.law
    assert isinstance(law, ThreadLaw), "the planner accepts only targets of the testbed"
    return law


_AGAIN_NS = 1_000_000_000
_ARRIVED_NS = 100_000_000
"""Remaining time (ns) to the goal time below which a new plan only holds the target."""
_MAX_HORIZON = 60.0
"""Longest planning horizon (s) of a path."""


class Strategy(StrEnum):
    """Strategies of path planning, which are described at the top of this module."""

    GOAL = "goal"
    RECEDING = "receding"
    STEP = "step"


@dataclass(frozen=True, slots=True)
class PlanningSettings:
    """Settings of planning.

    Attributes:
        horizon: duration (s) requested for a new path; an initial guess if `time_price` is set.
        replan_period: time (s) between two plans, and duration of the paths that hold a reached target.
        late_after_ns: planning time (ns) after which a plan is reported as late.
        nodes: number of interpolation nodes of a path.
        strategy: strategy of path planning, as described at the top of this module.
        time_price: cost (W) of the duration of a slew, or None for a fixed horizon.
        current_share: fraction of the current limit that a plan may use; the controller may use the rest.
        cost: the power whose integral over time a path minimises.
        least_horizon: remaining time (s) to the goal time below which no new plan is made.
        displaced: deviation (rad) from the path above which a new plan is made.
    """

    horizon: float
    replan_period: float
    late_after_ns: int
    nodes: int
    strategy: Strategy
    time_price: float | None
    current_share: float
    cost: PathCost
    least_horizon: float = 2.0
    displaced: float = 0.05


class Planning:
    """Holds the planner's running job, the request for the next job, and the goal time."""

    def __init__(
        self,
        plant: SingleAxisPlant,
        settings: PlanningSettings,
        guidance: PathGuidance,
        reader: ThreadReader,
        services: Services,
    ) -> None:
        self._plant = replace(plant, current_limit=plant.current_limit * settings.current_share)
        self._settings, self._guidance = settings, guidance
        self._read = reader.read
        self._jobs, self._recorder, self._events = services.jobs, services.recorder, services.events
        self._wanted = False
        self._job: PlanJob | None = None
        self._goal_ns: int | None = None
        self._due_ns: int | None = None
        self._asked_ns = self._count = self._accepted = self._refused = self.flown = 0

    def counts(self) -> tuple[int, int]:
        """Return how many plans were accepted, and how many were rejected, since the start."""
        return self._accepted, self._refused

    def busy_since_ns(self) -> int | None:
        """Return the time (ns) at which the worker began its plan, or None while the worker is idle."""
        return None if self._job is None else self._asked_ns

    def aim(self, target: Target, now_ns: int) -> None:
        """Set a target and request a plan for it; the present path is followed until the plan arrives."""
        law = law_of(target)
        self._guidance.aim(law.q2, law.rate, now_ns)
        self._goal_ns = self._due_ns = None
        self._wanted = True
        if self._settings.strategy is Strategy.STEP:
            self._guidance.hold(angle_of(law.q2), now_ns)
            self._due_ns = now_ns + round(self._settings.horizon * 1e9)

    def due_angle(self, law: ThreadLaw, now_ns: int) -> float | None:
        """Return the angle (rad) that the target has at present, or None before the target is due.

        A target is due at the end of the first path to it, even if later paths end at another time. The
        strategy STEP has no plans, so its targets are due one planning horizon after the command.
        """
        if self._due_ns is None or now_ns < self._due_ns:
            return None
        return _moved(law, (now_ns - self._due_ns) * 1e-9)

    def request(self, now_ns: int) -> None:
        """Request a plan, which is made once there is an estimate and the worker is free."""
        self._wanted = True
        if self._is_near_goal(now_ns) or self._has_arrived(now_ns):
            self._goal_ns = None

    def resume(self, now_ns: int) -> None:
        """After a time without control, request a plan for the rest of the path, unless its end is near."""
        if now_ns - self._asked_ns > _AGAIN_NS and not self._is_near_goal(now_ns):
            self._wanted = True

    def replan(self, cycle: Cycle) -> None:
        """Request the periodic plan; called by the replanning rate group."""
        if self._job is None:
            self._wanted = self._wanted or not self._is_near_goal(cycle.start_ns)
        elif cycle.start_ns - self._job.origin_ns > self._settings.late_after_ns:
            self._events.report(
                events.PLANNER_BUSY, cycle.start_ns, f"plan {self._job.number} is not finished yet"
            )
            self._wanted = True

    def serve(self, estimate: Estimate | None, target: Target, now_ns: int) -> None:
        """Submit the requested job to the worker, if it is due."""
        if estimate is None or self._settings.strategy is Strategy.STEP:
            return
        now = self._read(estimate)
        if self._is_displaced(now.angle, now_ns):
            self.request(now_ns)
        if self._is_near_goal(now_ns):
            self._wanted = False  # the goal time came near while the worker was busy
        if not self._wanted or self._job is not None:
            return
        job = self._job_from(now, law_of(target), now_ns)
        if self._jobs.submit(PLANNER, job):
            self._wanted = False
            self._count = job.number
            self._job = job
            self._asked_ns = now_ns

    def _job_from(self, estimate: ThreadEstimate, law: ThreadLaw, now_ns: int) -> PlanJob:
        settings, goal_ns, begun = self._settings, self._goal_ns, self._goal_ns is not None
        towards_goal = settings.strategy is Strategy.GOAL
        start_q2, start_rate, horizon = estimate.q2, estimate.rate, settings.horizon
        if self._has_arrived(now_ns):
            # A plan that starts at the estimated angle would follow disturbances instead of correcting them.
            horizon, held = settings.replan_period, self._guidance.sample(now_ns)
            if held is not None:
                start_q2, start_rate = q2_of(held.angle), held.rate
        elif goal_ns is not None:
            horizon = (goal_ns - now_ns) * 1e-9
        end_q2 = law.q2
        if towards_goal and law.rate != 0.0 and self._due_ns is not None:
            # A target with a rate has moved since it was first due.
            late = horizon - (self._due_ns - now_ns) * 1e-9
            end_q2 = q2_of(_moved(law, max(late, 0.0)))
        if end_q2 != self._guidance.target_q2:
            self._guidance.aim(end_q2, law.rate, now_ns)
        return PlanJob(
            self._count + 1,
            now_ns,
            replace(self._plant, disturbance=estimate.disturbance) if towards_goal else self._plant,
            start_q2,
            start_rate,
            end_q2,
            law.rate,
            horizon,
            _MAX_HORIZON,
            settings.nodes,
            None if begun else settings.time_price,
            self._guidance.remains(now_ns) if begun else None,
            settings.cost,
        )

    def _is_near_goal(self, now_ns: int) -> bool:
        """Return whether the remaining time to the goal is too short for a new plan."""
        if self._settings.strategy is not Strategy.GOAL or self._goal_ns is None:
            return False
        return _ARRIVED_NS < self._goal_ns - now_ns < self._settings.least_horizon * 1e9

    def _has_arrived(self, now_ns: int) -> bool:
        """Return whether the goal time is at most `_ARRIVED_NS` ahead; plans then hold the target."""
        goal_ns = self._goal_ns if self._settings.strategy is Strategy.GOAL else None
        return goal_ns is not None and goal_ns - now_ns <= _ARRIVED_NS

    def _is_displaced(self, angle: float, now_ns: int) -> bool:
        """Return whether the body is too far from its path to follow the path; true at most once a second."""
        sample = self._guidance.sample(now_ns)
        if self._settings.strategy is not Strategy.GOAL or sample is None:
            return False
        return (
            self._goal_ns is not None
            and now_ns - self._asked_ns > _AGAIN_NS
            and abs(math.remainder(angle - sample.angle, 2.0 * math.pi)) > self._settings.displaced
        )

    def finish(self, result: JobResult, now_ns: int) -> None:
        """Offer the worker's plan to guidance, and record whether it was accepted."""
        job, self._job = self._job, None
        if job is None:
            return
        if result.outcome != "done":
            self._refused += 1
            self._events.report(events.PLANNER_FAILED, now_ns, f"{result.outcome}: {result.error}")
            self._record(job, None, result.outcome, False, now_ns)
            return
        plan: StepPlan = result.value
        verdict = self._guidance.offer(
            plan, job.origin_ns, now_ns, angle_of(job.start_q2), job.start_rate, job.plant.disturbance
        )
        reason = verdict.reason
        if reason:
            self._refused += 1
            self._events.report(events.PLAN_REFUSED, now_ns, f"plan {job.number}: {reason}")
        else:
            self._accepted += 1
            self.flown = job.number
            end_ns = job.origin_ns + round(plan.horizon * 1e9)
            self._due_ns = self._due_ns or end_ns
            if self._settings.strategy is Strategy.GOAL:
                self._goal_ns = end_ns
            if plan.status is PlanStatus.STRETCHED:
                asked = f"plan {job.number}: {plan.horizon_asked:g} s is too short"
                text = f"{asked}, the path takes {plan.horizon:.2f} s"
                self._events.report(events.PLAN_STRETCHED, now_ns, text)
        self._record(job, plan, reason or plan.status.value, not reason, now_ns)

    def _record(self, job: PlanJob, plan: StepPlan | None, status: str, accepted: bool, now_ns: int) -> None:
        count = len(plan.node_q2) if plan else 0
        nodes = [float(q2) for q2 in plan.node_q2] if plan else []
        self._recorder.record(
            PLAN,
            now_ns,
            number=job.number,
            accepted=int(accepted),
            status=status,
            origin_ns=job.origin_ns - self._recorder.epoch_ns,
            horizon_asked=job.horizon,
            horizon=plan.horizon if plan else math.nan,
            start_q2=job.start_q2,
            start_rate=job.start_rate,
            target_q2=job.end_q2,
            cost=plan.energy if plan else math.nan,
            peak_current=plan.peak_current if plan else math.nan,
            evaluations=plan.evaluations if plan else 0,
            nodes=count,
            node_q2=nodes + [math.nan] * (MAX_NODES - count),
        )


def _moved(law: ThreadLaw, since: float) -> float:
    """Return a target's angle (rad) `since` seconds after it was due, clipped to the coil's working range."""
    return min(max(angle_of(law.q2) + law.rate * since, -FARTHEST), FARTHEST)


@dataclass(frozen=True, slots=True)
class TimedStep:
    """A configured step, which reaches `q2` at `rate` rad/s and is in force from mission time `at` (s) on."""

    at: float
    q2: float
    rate: float


class ThreadTargets:
    """The configured and commanded targets of the testbed; implements `flight.loop.body.BodyTargets`."""

    def __init__(
        self, steps: Sequence[TimedStep], reader: ThreadReader, guidance: PathGuidance, planning: Planning
    ) -> None:
        """Accept the configured steps in order of time, the first of which is at mission time 0."""
        self._steps = [Target(i, ThreadLaw(step.q2, step.rate)) for i, step in enumerate(steps)]
        self._times = [round(step.at * 1e9) for step in steps]
        self._read = reader.read
        self._guidance, self._planning = guidance, planning

    def configured(self, mission_time_ns: int) -> Target:
        """Return the configured target that is in force at a mission time."""
        return self._steps[max(bisect.bisect_right(self._times, mission_time_ns) - 1, 0)]

    def commanded(self, wanted: float | PointingTarget, number: int) -> Target:
        """Return the target `wanted` of the command with the number `number`.

        Raises UsageError for a pointing goal, or if q2 is too large.
        """
        if isinstance(wanted, PointingTarget):
            raise UsageError("the testbed accepts only a target q2, not a pointing goal")
        if not abs(wanted) <= Q2_LIMIT:  # NaN compares false
            raise UsageError(f"q2 {wanted} is not within +-{Q2_LIMIT}")
        return Target(COMMANDED + number, ThreadLaw(wanted))

    def hold_here(self, estimate: Estimate, now_ns: int) -> Target:
        """Hold the present angle, clipped to the limit, and return it as a target."""
        q2 = min(max(self._read(estimate).q2, -Q2_LIMIT), Q2_LIMIT)
        self._guidance.hold(angle_of(q2), now_ns)
        return Target(KEPT, ThreadLaw(q2))

    def can_hold(self, estimate: Estimate) -> bool:
        """Return whether the coil can produce torque at the body's present angle."""
        return abs(self._read(estimate).q2) < Q2_LIMIT

    def speed(self, estimate: Estimate) -> float:
        """Return the absolute rate about the thread, rad/s."""
        return abs(self._read(estimate).rate)

    def error(self, estimate: Estimate, target: Target) -> float:
        """Return the angle (rad) between body and target."""
        return self._off(estimate, angle_of(law_of(target).q2))

    def error_when_due(self, estimate: Estimate, target: Target, now_ns: int) -> float | None:
        """Return the angle (rad) between body and target at a time, or None before the target is due."""
        due = self._planning.due_angle(law_of(target), now_ns)
        return None if due is None else self._off(estimate, due)

    def _off(self, estimate: Estimate, wanted: float) -> float:
        return abs(math.remainder(wanted - self._read(estimate).angle, 2.0 * math.pi))


class BdotLaw:
    """The B-dot detumbling law of the testbed; implements `flight.loop.body.WindowedLaw`."""

    def __init__(self, detumbler: Detumbler, dipole_per_ampere: float) -> None:
        """`dipole_per_ampere` is the number of turns times the area of each coil (m^2)."""
        self._detumbler, self._dipole_per_ampere = detumbler, dipole_per_ampere

    def begin(self, now_ns: int) -> None:
        """Begin without knowledge of the magnetic field."""
        self._detumbler.begin(now_ns)

    def sample(self, time_ns: int, field: FloatArray, rate: FloatArray) -> None:
        """Accept a field (3,), T, measured at `time_ns`; the gyro's rate is not needed."""
        self._detumbler.sample(time_ns, field)

    def command(self, now_ns: int) -> CoilCommand:
        """Return the present command."""
        currents = self._detumbler.current(now_ns)
        return CoilCommand(currents * self._dipole_per_ampere, currents)

    def sent(self, currents: FloatArray) -> None:
        """Do nothing, because B-dot needs no model of the body's motion."""

    def field(self, now_ns: int) -> FloatArray | None:
        """Return the magnetic field (3,), T, in body axes, or None before it is known."""
        return self._detumbler.field(now_ns)


def controller_of(
    section: Control, plant: SingleAxisPlant, period: float, identification: Identification
) -> AngleController:
    """Return the controller that `section` selects for `plant`, with the control period `period` (s)."""
    if section.tracker == "excitation":
        move = identification
        return ExcitationController(
            plant, period, ExcitationSettings(move.current_share, move.largest_q2, move.swing)
        )
    if section.tracker == "pid":
        free = section.gains
        gains = (
            PidSettings.placed(section.bandwidth)
            if free is None
            else PidSettings(free.proportional, free.integral, free.derivative)
        )
        return PidController(plant, period, gains, section.target_weight)
    if section.tracker == "adaptive":
        settings = AdaptiveSettings(section.bandwidth, section.adaptation, section.reference_bandwidth)
        return AdaptiveController(plant, period, settings)
    return LqTracker(
        plant, section.state_weight, section.control_weight, as_in_thesis=section.tracker == "thesis"
    )


class ThreadTracker:
    """Tracks a path with the coil on body x (Sease thesis, 5.4); implements `flight.loop.body.Tracker`."""

    def __init__(self, controller: AngleController, reader: ThreadReader, dipole_per_ampere: float) -> None:
        self._controller = controller
        self._read = reader.read
        self._dipole = dipole_per_ampere

    def command(self, estimate: Estimate, reference: PathSample) -> CoilCommand:
        """Return the command that keeps the body on the reference motion."""
        now = self._read(estimate)
        wanted = self._controller.command(reference, now.angle, now.rate, now.disturbance)
        currents = np.array([wanted.current, 0.0, 0.0])
        return CoilCommand(self._dipole * currents, currents, wanted.saturated)

    def reset(self) -> None:
        """Discard the controller's integrated errors."""
        self._controller.reset()


AHEAD = 20.0
"""Span (s) of one field prediction, which takes about two milliseconds."""
_ROUND = 6_000.0, 60.0
"""Span (s) and step (s) of the search for the weakest field. The span is about one revolution."""
_ACROSS: FloatArray = np.array([1.0, 0.0, 1.0])
"""Mask of the field components that the cage produces."""


class CageField:
    """Predicts the magnetic field of the Helmholtz cage at any time.

    The host's UTC is read once at the start, so that a later step of the host's UTC does not move the field.
    """

    def __init__(self, section: Cage, weakest: float, clock: Clock) -> None:
        """Raise ConfigError for malformed elements, or if the field falls below `weakest` (T)."""
        try:
            self._elements = TwoLineElements(*section.elements)
        except UsageError as error:
            raise ConfigError("cage.elements", f"are not valid two-line elements: {error}") from error
        self._scale = section.scale
        self._date_zero = UNIX_EPOCH + (clock.utc_ns() - clock.now_ns()) / (DAY * SECOND_NS)
        self._near: Ephemeris | None = None
        self._local: FloatArray = np.zeros((0, 3))
        least = self._weakest(clock.now_ns())
        if least < weakest:
            raise ConfigError(
                "plant.field", f"is {weakest:g}: must not exceed {least:.3g} T, the weakest field of the cage"
            )

    def at(self, now_ns: int) -> FloatArray:
        """Return the magnetic field (3,), T, in reference axes at the time `now_ns` of the host's clock."""
        near = self._near
        seconds = math.inf if near is None else (self._date(now_ns) - near.julian_date) * DAY
        if near is None or not 0.0 <= seconds <= AHEAD:
            # The prediction begins one second before `now_ns`, because measurements may be late.
            state = self._elements.at(self._date(now_ns) - 1.0 / DAY)
            near = self._near = predict(state, AHEAD)
            self._local = np.array(
                [
                    local_frame(*place) @ there
                    for *place, there in zip(near.position, near.velocity, near.field, strict=True)
                ]
            )
            seconds = 1.0
        step = float(near.times[1])
        before = min(int(seconds / step), len(self._local) - 2)
        share = seconds / step - before
        return np.asarray(
            self._scale * _ACROSS * ((1.0 - share) * self._local[before] + share * self._local[before + 1])
        )

    def _date(self, now_ns: int) -> float:
        return self._date_zero + now_ns / (DAY * SECOND_NS)

    def _weakest(self, now_ns: int) -> float:
        """Return the minimum strength (T) of the cage's field over the next revolution."""
        least = math.inf
        for seconds in np.arange(0.0, *_ROUND):
            date = self._date(now_ns) + float(seconds) / DAY
            try:
                state = self._elements.at(date)
                there = local_frame(state.position, state.velocity) @ field(date, state.position)
            except OrbitError as error:
                raise ConfigError(
                    "cage.elements", f"determine no field at {date:.4f} (UTC): {error}"
                ) from error
            least = min(least, self._scale * math.hypot(there[0], there[2]))
        return least


def local_frame(position: FloatArray, velocity: FloatArray) -> FloatArray:
    """Return the rotation matrix (3, 3) to the local orbital frame: x along the flight direction, z down."""
    down = -position / np.linalg.norm(position)
    across = np.cross(velocity, position)
    across = across / np.linalg.norm(across)
    return np.stack([np.cross(across, down), across, down])


class CageFilter(AttitudeFilter):
    """The testbed's filter in a Helmholtz cage, whose field is predicted at the time of each command."""

    def __init__(
        self,
        cage: CageField,
        body: RigidBody,
        settings: AttitudeFilterSettings,
        prior: SlowPrior | None = None,
    ) -> None:
        """Start the filter of `body` in the field of `cage`."""
        super().__init__(body, settings, prior)
        self._cage = cage

    def command(
        self, time_ns: int, currents: FloatArray, field: FloatArray | None = None, known: bool = True
    ) -> None:
        """Record the coil currents (3,), A, and the cage's field, in force from `time_ns` on."""
        super().command(time_ns, currents, self._cage.at(time_ns) if field is None else field, known)


class CageTracker:
    """Converts the torque that another tracker requests from coil x into currents in the coils x and z."""

    def __init__(
        self, inner: Tracker, reader: ThreadReader, plant: SingleAxisPlant, field: CageField, dipole: float
    ) -> None:
        """Use `inner`, which assumes a constant field.

        Each coil has the dipole moment `dipole` (m^2) per ampere.
        """
        self._inner = inner
        self._read = reader.read
        self._plant, self._field, self._dipole = plant, field, dipole

    def command(self, estimate: Estimate, reference: PathSample) -> CoilCommand:
        """Return the command that produces the requested torque with the least current."""
        wanted = self._inner.command(estimate, reference)
        angle = self._read(estimate).angle
        torque = self._plant.torque_constant * float(wanted.currents[0]) * math.cos(angle)
        bx, _, bz = (attitude_matrix(about_axis_y(angle)) @ self._field.at(estimate.time_ns)).tolist()
        # The torque about body y is m_z b_x - m_x b_z, largest for a dipole normal to the field.
        each = torque / (self._dipole * (bx * bx + bz * bz))
        currents = np.array([-each * bz, 0.0, each * bx])
        excess = float(np.abs(currents).max()) / self._plant.current_limit
        if excess > 1.0:
            currents = currents / excess
        return CoilCommand(self._dipole * currents, currents, wanted.saturated or excess > 1.0)

    def reset(self) -> None:
        """Discard the integrated errors of the inner tracker."""
        self._inner.reset()
