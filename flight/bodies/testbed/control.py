"""Guidance and control of the testbed: rotation about the thread, targets, requested paths and control laws.

Guidance has three strategies. GOAL plans a step for a goal time when commanded, and again every few seconds
from the newest estimate for the remaining time: each plan is the optimal rest of the step. Near the goal time
the path is flown to its end, which is held; a body displaced from its path gets a new plan. RECEDING is the
strategy of the thesis: each plan reaches the target a whole horizon later (Sease ch. 5, Optimal Path
Planning). STEP makes no plan: the controller tracks the target itself.

The control laws are B-dot detumbling and a controller about the thread. In a Helmholtz cage the field is that
of an orbit, as the flight predicts it. The cage shows the body the field that a satellite on the orbit meets
in its local frame: x along the flight, z down, y against the orbit's normal, which is the axis of the thread.
The rotation about the thread is therefore the pitch of a satellite that looks down, in a field that turns
once a revolution and changes its strength. The cage renders the two components of that field normal to the
thread, `scale` times as strong. The third component makes no torque about the thread.

The field is predicted by WMM along the elements at UTC, on which the cage's control computer and the flight
agree. The coil on body x alone has no torque if the field is parallel to it, so the coils on x and z make the
torque about the thread together, with the least current.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from flight.link import events
from flight.link.telemetry.definitions import MAX_NODES, PLAN
from flight.loop.body import COMMANDED, KEPT, PLANNER, CoilCommand, Target, Tracker
from flight.loop.executive import Cycle, JobResult
from flight.loop.facts import Services
from flight.schema.document import ConfigError
from flight.schema.testbed import Cage, Control, Identification, TestbedConfig
from hal.interfaces.wires import SECOND_NS, Clock
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.ephemeris import Ephemeris, predict
from knightcube.astro.earth.geomagnetism import GeomagneticError, field
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
from knightcube.gnc.estimation.attitude_filter import AttitudeFilter, FilterSettings
from knightcube.gnc.estimation.estimate import NOMINAL, PARAMETERS, Estimate, Parameters, SlowPrior
from knightcube.gnc.estimation.rigid_body import RigidBody
from knightcube.gnc.guidance.one_axis.guidance import PathGuidance
from knightcube.gnc.guidance.one_axis.plant import (
    FARTHEST,
    Q2_LIMIT,
    PathCost,
    PathSample,
    SingleAxisPlant,
    angle_of,
    q2_of,
)
from knightcube.gnc.guidance.one_axis.vmc import PlanJob, PlanStatus, StepPlan
from knightcube.gnc.guidance.three_axes.pointing_target import PointingTarget
from knightcube.reference.control import AdaptiveController, AdaptiveSettings, PidController, PidSettings


def plant_of(config: TestbedConfig) -> SingleAxisPlant:
    """Return the plant model that planner, tracker and filter use."""
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
"""Limits of the estimated coil gain, beyond which the filter has not converged."""


@dataclass(frozen=True, slots=True, eq=False)
class ThreadEstimate:
    """Angle (rad), rate (rad/s) and disturbance (rad/s^2) about the thread, with their covariance (3, 3).

    `measured_ns` is the time of the newest measurement used.
    """

    time_ns: int
    angle: float
    rate: float
    disturbance: float
    covariance: FloatArray
    measured_ns: int

    @property
    def q2(self) -> float:
        """The second quaternion component."""
        return math.sin(0.5 * self.angle)


def about_thread(estimate: Estimate, model: Parameters = NOMINAL) -> ThreadEstimate:
    """Return the rotation about the thread, which is exact for a suspended body.

    The disturbance is the acceleration that a plant with the parameters of `model` does not explain, scaled
    so that the holding current of that plant is the holding current of the body.
    """
    angle, rate = angle_about_axis_y(estimate.quaternion), float(estimate.rate[1])
    torsion, damping, gain = estimate.parameters
    scale = model.gain / min(max(gain, LEAST_GAIN), MOST_GAIN)
    torque = scale * (float(estimate.disturbance[1]) - torsion * angle - damping * rate)
    rows = np.zeros((3, len(estimate.covariance)))
    rows[0, 1] = rows[1, 4] = 1.0
    rows[2, 10] = scale
    rows[2, 1], rows[2, 4] = model.torsion - scale * torsion, model.damping - scale * damping
    rows[2, PARAMETERS] = -scale * angle, -scale * rate, -torque * scale / model.gain
    return ThreadEstimate(
        estimate.time_ns,
        angle,
        rate,
        torque + model.torsion * angle + model.damping * rate,
        rows @ estimate.covariance @ rows.T,
        estimate.measured_ns,
    )


class ThreadReader:
    """Computes the rotation about the thread from an estimate, once for each estimate."""

    def __init__(self, model: Parameters) -> None:
        self._model = model
        self._last: tuple[Estimate, ThreadEstimate] | None = None

    def read(self, estimate: Estimate) -> ThreadEstimate:
        """Return the rotation about the thread."""
        if self._last is None or self._last[0] is not estimate:
            self._last = estimate, about_thread(estimate, self._model)
        return self._last[1]


@dataclass(frozen=True, slots=True)
class ThreadLaw:
    """Reach `q2` at `rate` rad/s and keep that rate; zero holds the attitude."""

    q2: float
    rate: float = 0.0

    @property
    def text(self) -> str:
        """The law as text, for events."""
        return f"q2 {self.q2:+.3f}"

    def quaternion(self, now_ns: int) -> FloatArray:
        """Return the attitude (4,) to be reached, reference into body."""
        return about_axis_y(angle_of(self.q2))


def law_of(target: Target) -> ThreadLaw:
    """Return the law of a target of the testbed."""
    law = target.law
    assert isinstance(law, ThreadLaw), "only the testbed's own targets reach its planner"
    return law


_AGAIN_NS = 1_000_000_000
_MAX_HORIZON = 60.0
"""Longest horizon of a path, s."""


class Strategy(StrEnum):
    """How paths are planned: see the module."""

    GOAL = "goal"
    RECEDING = "receding"
    STEP = "step"


@dataclass(frozen=True, slots=True)
class PlanningSettings:
    """Settings of planning.

    Attributes:
        horizon: s, requested for a new target; an initial guess where time has a price.
        late_after_ns: planning time after which a plan is late.
        nodes: number of nodes of the path.
        strategy: see the module.
        time_price: W, cost of a second of a slew; None for a fixed horizon.
        current_share: fraction of the coil's limit that a plan may use; the rest is the controller's.
        cost: the power whose integral a path minimises.
        least_horizon: s, time to the goal below which there is no new plan.
        displaced: rad, distance from the path above which there is a new plan.
    """

    horizon: float
    late_after_ns: int
    nodes: int
    strategy: Strategy
    time_price: float | None
    current_share: float
    cost: PathCost
    least_horizon: float = 2.0
    displaced: float = 0.05


class Planning:
    """Owns the running job, the request for the next one and the goal time."""

    def __init__(
        self,
        plant: SingleAxisPlant,
        settings: PlanningSettings,
        guidance: PathGuidance,
        reader: ThreadReader,
        services: Services,
    ) -> None:
        self._plant = replace(plant, current_limit=plant.current_limit * settings.current_share)
        self._settings = settings
        self._guidance = guidance
        self._read = reader.read
        self._jobs = services.jobs
        self._recorder = services.recorder
        self._events = services.events
        self._wanted = False
        self._job: PlanJob | None = None
        self._goal_ns: int | None = None
        self._due_ns: int | None = None
        self._asked_ns = 0
        self._count = 0
        self._accepted = 0
        self._refused = 0
        self.flown = 0

    def counts(self) -> tuple[int, int]:
        """Return how many plans were accepted and refused since the start."""
        return self._accepted, self._refused

    def busy_since_ns(self) -> int | None:
        """Return when the worker began its plan (ns); None while it is idle."""
        return None if self._job is None else self._asked_ns

    def aim(self, target: Target, now_ns: int) -> None:
        """Set a new target, and request a plan for it at once; the present path is flown until then."""
        law = law_of(target)
        self._guidance.aim(law.q2, law.rate, now_ns)
        self._goal_ns = self._due_ns = None
        self._wanted = True
        if self._settings.strategy is Strategy.STEP:
            self._guidance.hold(angle_of(law.q2), now_ns)
            self._due_ns = now_ns + round(self._settings.horizon * 1e9)

    def due_angle(self, law: ThreadLaw, now_ns: int) -> float | None:
        """Return the angle due by now, rad; None before the target is due.

        The target is due at the end of the first path to it, whatever is planned later; without plans, a
        horizon after the command.
        """
        if self._due_ns is None or now_ns < self._due_ns:
            return None
        return _moved(law, (now_ns - self._due_ns) * 1e-9)

    def request(self, now_ns: int) -> None:
        """Request a plan, made once there is an estimate and the worker is free."""
        self._wanted = True
        if self._is_near_goal(now_ns):
            self._goal_ns = None

    def resume(self, now_ns: int) -> None:
        """Request the rest of a path after a time without control, unless its end is near."""
        if now_ns - self._asked_ns > _AGAIN_NS and not self._is_near_goal(now_ns):
            self._wanted = True

    def replan(self, cycle: Cycle) -> None:
        """Request the periodic plan: the task of the replanning rate group."""
        if self._job is None:
            self._wanted = self._wanted or not self._is_near_goal(cycle.start_ns)
        elif cycle.start_ns - self._job.origin_ns > self._settings.late_after_ns:
            self._events.report(
                events.PLANNER_BUSY, cycle.start_ns, f"plan {self._job.number} is not finished yet"
            )
            self._wanted = True

    def serve(self, estimate: Estimate | None, target: Target, now_ns: int) -> None:
        """Submit the requested job to the worker."""
        if estimate is None or self._settings.strategy is Strategy.STEP:
            return
        now = self._read(estimate)
        if self._is_displaced(now.angle, now_ns):
            self.request(now_ns)
        if self._is_near_goal(now_ns):
            self._wanted = False  # the goal came near while the worker was busy
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
        horizon = (goal_ns - now_ns) * 1e-9 if goal_ns is not None else settings.horizon
        end_q2 = law.q2
        if towards_goal and law.rate != 0.0 and self._due_ns is not None:
            # A moving target has moved on since it was first due.
            late = horizon - (self._due_ns - now_ns) * 1e-9
            end_q2 = q2_of(_moved(law, max(late, 0.0)))
        if end_q2 != self._guidance.target_q2:
            self._guidance.aim(end_q2, law.rate, now_ns)
        return PlanJob(
            self._count + 1,
            now_ns,
            replace(self._plant, disturbance=estimate.disturbance) if towards_goal else self._plant,
            estimate.q2,
            estimate.rate,
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
        """Return whether too little time is left until the goal for a new plan."""
        if self._settings.strategy is not Strategy.GOAL or self._goal_ns is None:
            return False
        return self._goal_ns - now_ns < self._settings.least_horizon * 1e9

    def _is_displaced(self, angle: float, now_ns: int) -> bool:
        """Return whether the body is off its path, at most once a second, so that the path is useless."""
        sample = self._guidance.sample(now_ns)
        if self._settings.strategy is not Strategy.GOAL or sample is None:
            return False
        return (
            self._goal_ns is not None
            and now_ns - self._asked_ns > _AGAIN_NS
            and abs(math.remainder(angle - sample.angle, 2.0 * math.pi)) > self._settings.displaced
        )

    def finish(self, result: JobResult, now_ns: int) -> None:
        """Offer the worker's plan to guidance, and record whether the plan was accepted."""
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
            plan,
            job.origin_ns,
            now_ns,
            angle_of(job.start_q2),
            job.start_rate,
            job.plant.disturbance,
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
                text = (
                    f"plan {job.number}: {plan.horizon_asked:g} s is too short, flying {plan.horizon:.2f} s"
                )
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
    """Return the angle of a law `since` s after it was due, rad, limited to where the coil has authority."""
    return min(max(angle_of(law.q2) + law.rate * since, -FARTHEST), FARTHEST)


@dataclass(frozen=True, slots=True)
class TimedStep:
    """A step: reach `q2` at `rate` rad/s, from mission time `at` s on."""

    at: float
    q2: float
    rate: float


class ThreadTargets:
    """Implements `flight.loop.body.BodyTargets`."""

    def __init__(
        self, steps: Sequence[TimedStep], reader: ThreadReader, guidance: PathGuidance, planning: Planning
    ) -> None:
        """Take the configured steps in order of time; the first is at 0."""
        self._steps = [Target(i, ThreadLaw(step.q2, step.rate)) for i, step in enumerate(steps)]
        self._times = [round(step.at * 1e9) for step in steps]
        self._read = reader.read
        self._guidance = guidance
        self._planning = planning

    def configured(self, mission_time_ns: int) -> Target:
        """Return the configured target in force at a mission time."""
        return self._steps[max(bisect.bisect_right(self._times, mission_time_ns) - 1, 0)]

    def commanded(self, wanted: float | PointingTarget, number: int) -> Target:
        """Return the target of slew `number` to q2 `wanted`. Raises UsageError beyond the limit."""
        if isinstance(wanted, PointingTarget):
            raise UsageError("the testbed goes to a q2, not to a direction")
        if not abs(wanted) <= Q2_LIMIT:  # NaN compares false
            raise UsageError(f"q2 {wanted} is not within +-{Q2_LIMIT}")
        return Target(COMMANDED + number, ThreadLaw(wanted))

    def hold_here(self, estimate: Estimate, now_ns: int) -> Target:
        """Hold the present angle, within the limit; return it as a target."""
        q2 = min(max(self._read(estimate).q2, -Q2_LIMIT), Q2_LIMIT)
        self._guidance.hold(angle_of(q2), now_ns)
        return Target(KEPT, ThreadLaw(q2))

    def can_hold(self, estimate: Estimate) -> bool:
        """Return whether the coil has authority where the body is."""
        return abs(self._read(estimate).q2) < Q2_LIMIT

    def speed(self, estimate: Estimate) -> float:
        """Return the rate about the thread, rad/s, not negative."""
        return abs(self._read(estimate).rate)

    def error(self, estimate: Estimate, target: Target) -> float:
        """Return the angle between body and target, rad."""
        return self._off(estimate, angle_of(law_of(target).q2))

    def error_when_due(self, estimate: Estimate, target: Target, now_ns: int) -> float | None:
        """Return the angle to the attitude due by now, rad; None before one is due."""
        due = self._planning.due_angle(law_of(target), now_ns)
        return None if due is None else self._off(estimate, due)

    def _off(self, estimate: Estimate, wanted: float) -> float:
        return abs(math.remainder(wanted - self._read(estimate).angle, 2.0 * math.pi))


class BdotLaw:
    """B-dot detumbling; implements `flight.loop.body.WindowedLaw`."""

    def __init__(self, detumbler: Detumbler, dipole_per_ampere: float) -> None:
        """`dipole_per_ampere` is n A of each coil (m^2)."""
        self._detumbler = detumbler
        self._dipole_per_ampere = dipole_per_ampere

    def begin(self, now_ns: int) -> None:
        """Begin with no knowledge of the field."""
        self._detumbler.begin(now_ns)

    def sample(self, time_ns: int, field: FloatArray, rate: FloatArray) -> None:
        """Accept a field (3,) T measured at `time_ns`; the law needs no rate of the gyro."""
        self._detumbler.sample(time_ns, field)

    def command(self, now_ns: int) -> CoilCommand:
        """Return the command now."""
        currents = self._detumbler.current(now_ns)
        return CoilCommand(currents * self._dipole_per_ampere, currents)

    def sent(self, currents: FloatArray) -> None:
        """Do nothing, because B-dot needs no model of the motion."""

    def field(self, now_ns: int) -> FloatArray | None:
        """Return the field (3,) T in body axes now; None before it is known."""
        return self._detumbler.field(now_ns)


def controller_of(
    section: Control,
    plant: SingleAxisPlant,
    period: float,
    identification: Identification,
) -> AngleController:
    """Return the controller of `plant` that `section` selects, for a period (s)."""
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
    """Tracks a path with the coil on body x (Sease 5.4); implements `flight.loop.body.Tracker`."""

    def __init__(self, controller: AngleController, reader: ThreadReader, dipole_per_ampere: float) -> None:
        self._controller = controller
        self._read = reader.read
        self._dipole = dipole_per_ampere

    def command(self, estimate: Estimate, reference: PathSample) -> CoilCommand:
        """Return the command that keeps the body on the reference."""
        now = self._read(estimate)
        wanted = self._controller.command(reference, now.angle, now.rate, now.disturbance)
        currents = np.array([wanted.current, 0.0, 0.0])
        return CoilCommand(self._dipole * currents, currents, wanted.saturated)

    def reset(self) -> None:
        """Discard integrated errors."""
        self._controller.reset()


AHEAD = 20.0
"""Span (s) of one prediction, which takes a millisecond or two."""
_ROUND = 6_000.0, 60.0
"""Span (s) of about one revolution, and step (s), of the search for the weakest field."""
_ACROSS: FloatArray = np.array([1.0, 0.0, 1.0])
"""Mask of the field components that the cage renders."""


class CageField:
    """Predicts the cage's field at any time of the clock."""

    def __init__(self, section: Cage, weakest: float, clock: Clock) -> None:
        """Raise ConfigError for malformed elements, or a field that falls below `weakest` (T)."""
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
                "plant.field",
                f"is {weakest:g}: the cage's field falls to {least:.3g} T, plans may count on no more",
            )

    def at(self, now_ns: int) -> FloatArray:
        """Return the field (3,) T, reference axes, at a time of the clock."""
        near = self._near
        seconds = math.inf if near is None else (self._date(now_ns) - near.julian_date) * DAY
        if near is None or not 0.0 <= seconds <= AHEAD:
            # The prediction begins a second earlier, for late measurements.
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
        """Return the minimum strength (T) of the rendered field over a revolution from now on."""
        least = math.inf
        for seconds in np.arange(0.0, *_ROUND):
            date = self._date(now_ns) + float(seconds) / DAY
            try:
                state = self._elements.at(date)
                there = local_frame(state.position, state.velocity) @ field(date, state.position)
            except (OrbitError, GeomagneticError) as error:
                raise ConfigError("cage.elements", f"give no field at {date:.4f} (UTC): {error}") from error
            least = min(least, self._scale * math.hypot(there[0], there[2]))
        return least


def local_frame(position: FloatArray, velocity: FloatArray) -> FloatArray:
    """Return the matrix (3, 3) into the local frame: x along the flight, y against the normal, z down."""
    down = -position / np.linalg.norm(position)
    across = np.cross(velocity, position)
    across = across / np.linalg.norm(across)
    return np.stack([np.cross(across, down), across, down])


class CageFilter(AttitudeFilter):
    """The testbed's filter, which uses the cage's field at the time of each command."""

    def __init__(
        self, cage: CageField, body: RigidBody, settings: FilterSettings, prior: SlowPrior | None = None
    ) -> None:
        """Start the filter of `body` in the field of `cage`."""
        super().__init__(body, settings, prior)
        self._cage = cage

    def command(
        self, time_ns: int, currents: FloatArray, field: FloatArray | None = None, known: bool = True
    ) -> None:
        """Record the coil currents (3,) A in force from `time_ns` on, with the cage's field at that time."""
        super().command(time_ns, currents, self._cage.at(time_ns) if field is None else field, known)


class CageTracker:
    """Makes the torque of another tracker for coil x with the coils x and z in the cage's field."""

    def __init__(
        self,
        inner: Tracker,
        reader: ThreadReader,
        plant: SingleAxisPlant,
        field: CageField,
        dipole: float,
    ) -> None:
        """`inner` assumes the field of `plant`; `dipole` is n A of each coil, m^2."""
        self._inner = inner
        self._read = reader.read
        self._plant = plant
        self._field = field
        self._dipole = dipole

    def command(self, estimate: Estimate, reference: PathSample) -> CoilCommand:
        """Return the command that makes the torque with the least current."""
        wanted = self._inner.command(estimate, reference)
        angle = self._read(estimate).angle
        torque = self._plant.torque_constant * float(wanted.currents[0]) * math.cos(angle)
        bx, _, bz = (attitude_matrix(about_axis_y(angle)) @ self._field.at(estimate.time_ns)).tolist()
        # The torque about body y is m_z b_x - m_x b_z: most of it from a dipole normal to the field.
        each = torque / (self._dipole * (bx * bx + bz * bz))
        currents = np.array([-each * bz, 0.0, each * bx])
        excess = float(np.abs(currents).max()) / self._plant.current_limit
        if excess > 1.0:
            currents = currents / excess
        return CoilCommand(self._dipole * currents, currents, wanted.saturated or excess > 1.0)

    def reset(self) -> None:
        """Discard integrated errors."""
        self._inner.reset()
