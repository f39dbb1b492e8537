"""The flight loop: starts the tasks, runs the rate groups until the flight ends, and switches the coils off.

The package `flight.app` opens and closes the devices, and assembles the tasks.
"""

from __future__ import annotations

import math
import time
import zlib
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from flight import __version__
from flight.link import events
from flight.link.events import STEERING, EventKind, Mode, Severity
from flight.link.telemetry.definitions import ATTITUDE, COIL_CURRENTS, RUN
from flight.loop import imaging as imaging_task
from flight.loop.body import PLANNER, ControlOutput, FlightBody, Steered, SteeringState, Target
from flight.loop.commanding import CommandTask
from flight.loop.executive import Cycle, CyclicExecutive, JobResult, RateGroup
from flight.loop.facts import CLOCK_OFF_NS, COILS_BROKEN, Services
from flight.loop.health import (
    CONTROL,
    HealthWatch,
    Housekeeping,
    PerformanceObserver,
    ResourceReader,
    Shedding,
)
from flight.loop.imaging import Imaging
from flight.loop.modes import ModeControl
from flight.loop.navigation import (
    HORIZON_WORKER,
    CoilKnowledge,
    CurrentValidity,
    HorizonCameraTask,
    Navigation,
    Positioning,
    SunSensing,
)
from flight.loop.state import StateKeeper
from flight.loop.steering import CoilDrive, Steering
from flight.schema.sections import CONTROL_RATE_HZ, Config
from hal.interfaces.devices import COIL_NAMES, MOST_COILS, CoilState, ImuReading
from hal.interfaces.wires import SECOND_NS
from knightcube.astro.arrays import FloatArray
from knightcube.compiled import compilation_ns
from knightcube.gnc.estimation.estimate import ATTITUDE as ATTITUDE_ERROR
from knightcube.gnc.estimation.estimate import RATE, Estimate

if TYPE_CHECKING:  # only flights with a section `power` load this module
    from flight.loop.power import PowerTask


ATTITUDE_EVERY = 4
"""Number of control cycles from one attitude packet to the next."""
_NAN3 = np.full(3, np.nan)
_NAN4 = np.full(4, np.nan)


@dataclass(frozen=True, slots=True)
class LoopTasks:
    """The tasks of the loop, in the order of the data flow.

    A task is None if its device or command channel is not configured.
    """

    navigation: Navigation
    imaging: Imaging | None
    positioning: Positioning | None
    sun: SunSensing | None
    horizon_cameras: HorizonCameraTask | None
    modes: ModeControl
    steering: Steering
    drive: CoilDrive
    observer: PerformanceObserver
    health: HealthWatch
    housekeeping: Housekeeping
    commanding: CommandTask | None
    power: PowerTask | None
    shedding: Shedding


@dataclass(slots=True, eq=False)
class _CycleRecord:
    """Inputs and results of a control cycle, filled in step by step.

    Attributes:
        coils: coil command that the PWM chip holds at the start of the cycle.
        validity: whether the coil currents are known.
        readings: readings of the inertial unit since the last cycle, oldest first.
        estimate: present state estimate, measured or propagated by the model, or None before the filter
            starts.
        measured: the state estimate if it is recent enough for steering, otherwise None.
    """

    cycle: Cycle
    coils: CoilState
    validity: CurrentValidity
    readings: Sequence[ImuReading]
    estimate: Estimate | None = None
    mode: Mode = Mode.BOOT
    measured: Estimate | None = None

    @property
    def now_ns(self) -> int:
        """Start time (ns) of the cycle."""
        return self.cycle.start_ns


class ControlCycle:
    """The task of the control rate group: sample, estimate, check, decide, steer, publish."""

    def __init__(self, tasks: LoopTasks, body: FlightBody, services: Services) -> None:
        self._tasks, self._body, self._jobs = tasks, body, services.jobs
        self._recorder, self._streams = services.recorder, services.streams
        self._knowledge = CoilKnowledge()
        self._ever_started = self._had_estimate = self._was_measured = False
        self._target: Target | None = None
        self._results: deque[JobResult] = deque()

    def run(self, cycle: Cycle) -> ControlOutput:
        """Run one cycle."""
        record = self._sample(cycle)
        self._estimate(record)
        self._check(record)
        self._decide(record)
        self._accept_results(record)
        steered = self._steer(record)
        return self._publish(record, steered)

    def _sample(self, cycle: Cycle) -> _CycleRecord:
        """Read the inertial unit and the coil command in force, and pass both to navigation."""
        tasks, now_ns = self._tasks, cycle.start_ns
        # The coil driver's thread may have sent the last command late.
        coils = tasks.drive.state()
        validity = self._knowledge.look(coils, now_ns, suspected=tasks.drive.is_suspect)
        tasks.navigation.correct_coils(tasks.drive.correction, tasks.drive.available)
        tasks.navigation.commanded(coils, tasks.drive.effective(coils), validity)
        readings = tasks.navigation.update(now_ns)
        if not coils.error:
            self._streams.note("coils", now_ns)
        return _CycleRecord(cycle, coils, validity, readings)

    def _estimate(self, record: _CycleRecord) -> None:
        """Propagate the state estimate to the present."""
        record.estimate = self._tasks.navigation.estimate(record.now_ns)

    def _check(self, record: _CycleRecord) -> None:
        """Check the coils by supply current and motion, and check the star camera."""
        known = record.validity.since_last_look
        self._tasks.drive.look(record.coils, record.readings, record.now_ns, known=known)
        if self._tasks.imaging is not None:
            self._tasks.imaging.serve(record.now_ns)

    def _decide(self, record: _CycleRecord) -> None:
        """Determine mode and target, and request a path for a new target or a new estimate."""
        tasks, control, now_ns, estimate = self._tasks, self._body.control, record.now_ns, record.estimate
        overdue = None
        if estimate is not None and self._target is not None:
            overdue = control.targets.error_when_due(estimate, self._target, now_ns)
        speed, accurate = tasks.navigation.speed, tasks.navigation.is_accurate(estimate)
        rate = speed if record.readings and math.isfinite(speed) else None
        record.mode = tasks.modes.step(estimate, rate, overdue, not record.coils.error, now_ns, accurate)
        target = tasks.modes.target(now_ns - self._recorder.epoch_ns)
        if target is not self._target:
            self._target = target
            if target is not None:
                self._body.view.announce(target, now_ns)
                control.planner.aim(target, now_ns)
        measured = tasks.navigation.is_measured(estimate, now_ns)
        if estimate is not None and not self._had_estimate:
            control.planner.request(now_ns)
        elif measured and not self._was_measured:
            control.planner.resume(now_ns)
        self._had_estimate = estimate is not None
        self._ever_started = self._ever_started or self._had_estimate
        self._was_measured = measured

    def _accept_results(self, record: _CycleRecord) -> None:
        """Pass the workers' results to their tasks, and update the estimate if cameras changed it."""
        tasks, now_ns = self._tasks, record.now_ns
        # If a task raises an exception, the next cycle accepts the remaining results.
        self._results.extend(self._jobs.collect())
        while self._results:
            result = self._results.popleft()
            tasks.observer.job(result, now_ns)
            if result.worker == PLANNER:
                self._body.control.planner.finish(result, now_ns)
                continue
            if result.worker == imaging_task.WORKER and tasks.imaging is not None:
                tasks.imaging.finish(result, now_ns)
            elif result.worker == HORIZON_WORKER and tasks.horizon_cameras is not None:
                tasks.horizon_cameras.finish(result, now_ns)
            self._estimate(record)
        record.measured = record.estimate if self._was_measured else None

    def _steer(self, record: _CycleRecord) -> Steered:
        """Command the coils by the control law of the mode, and return the result."""
        steering, modes, now_ns = self._tasks.steering, self._tasks.modes, record.now_ns
        if record.mode in STEERING:
            return steering.run(record.measured, now_ns, self._ever_started)
        current = self._tasks.navigation.is_current(now_ns)
        if modes.detumbles:
            return steering.detumble(record.readings, current, now_ns)
        if modes.acquires_sun:
            return steering.acquire_sun(record.readings, current, now_ns)
        return steering.rest(now_ns)

    def _publish(self, record: _CycleRecord, steered: Steered) -> ControlOutput:
        """Submit a requested plan to the planner worker, and record the cycle."""
        mode, estimate, target, now_ns = record.mode, record.estimate, self._target, record.now_ns
        output = ControlOutput(record.cycle, mode, estimate, target, steered, self._tasks.drive.state())
        if mode in STEERING and target is not None:
            self._body.control.planner.serve(record.measured, target, now_ns)
        self._body.view.record_cycle(output)
        if record.cycle.slot % ATTITUDE_EVERY:
            return output
        if len(steered.currents) > 3:
            command, written = (_padded(currents) for currents in (steered.currents, output.written.current))
            self._recorder.record(COIL_CURRENTS, now_ns, command=command, written=written)
        reference = steered.reference
        self._recorder.record(
            ATTITUDE,
            now_ns,
            mode=int(mode),
            quaternion=(_NAN4 if estimate is None else estimate.quaternion).tolist(),
            rate=(_NAN3 if estimate is None else estimate.rate).tolist(),
            angle_sigma=_sigmas(estimate, ATTITUDE_ERROR),
            rate_sigma=_sigmas(estimate, RATE),
            wanted=(_NAN4 if reference is None else reference.quaternion).tolist(),
            wanted_rate=(_NAN3 if reference is None else reference.body_rate).tolist(),
            target=(_NAN4 if target is None else target.law.quaternion(now_ns)).tolist(),
            dipole=steered.dipole.tolist(),
        )
        return output


def _padded(currents: FloatArray) -> list[float]:
    """Return the currents (n,), A, of the coils, followed by NaN for coils that are not fitted."""
    return [*currents.tolist(), *[math.nan] * (MOST_COILS - len(currents))]


def _sigmas(estimate: Estimate | None, part: slice) -> list[float]:
    if estimate is None:
        return _NAN3.tolist()
    return [math.sqrt(max(value, 0.0)) for value in estimate.covariance.diagonal()[part].tolist()]


@dataclass(frozen=True, slots=True)
class RunLabel:
    """Properties of a run that are recorded in its first packet."""

    config_text: str
    seed: int
    simulated: bool
    realtime: bool


@dataclass(frozen=True, slots=True)
class FlightProgress:
    """Progress of a flight: times (s), coil currents (n,), A, and a text about target and attitude.

    The number `slips` counts skipped control cycles, as in the packet `health`.
    """

    mission_time: float
    duration: float
    attitude: str
    currents: tuple[float, ...]
    state: str
    slips: int
    events: int


@dataclass(frozen=True, slots=True)
class FlightEnding:
    """State of a flight at the end of its loop.

    Attributes:
        mission_time: mission time (s) at the end.
        cycles: number of completed control cycles.
        mode: label of the mode.
        alarms: names of the monitored conditions that are active at the end.
        faults: number of events of severity fault, by kind, including events that the throttle held back.
        warnings: number of events of severity warning, by kind, including events that the throttle held back.
        causes: text of the first event of each kind of fault and warning, and text with which each alarm
            began, by the name of the event or alarm.
        coils_left_out: axes of the coils that were excluded because they are broken.
        coils_at_zero: whether the last command that the PWM chip acknowledged was zero current.
        coil_error: why the last write to the PWM chip failed; empty if it succeeded.
        power: state of charge and energies of the battery; empty if there is no section `power`.
    """

    mission_time: float = 0.0
    cycles: int = 0
    mode: str = "boot"
    alarms: tuple[str, ...] = ()
    faults: Mapping[str, int] = field(default_factory=dict)
    warnings: Mapping[str, int] = field(default_factory=dict)
    causes: Mapping[str, str] = field(default_factory=dict)
    coils_left_out: tuple[str, ...] = ()
    coils_at_zero: bool = False
    coil_error: str = "the flight did not begin"
    power: str = ""


HEALTH_PERIOD_NS = SECOND_NS // 4
COMMAND_PERIOD_NS = HORIZON_PERIOD_NS = SECOND_NS // 10
LABEL_PERIOD_NS = 60 * SECOND_NS
"""Period (ns) of the repetitions of the run packet after the UTC of the run was corrected."""


def nothing() -> None:
    """Do nothing, because a lock-step simulation has neither guardian nor watchdog."""


@dataclass(frozen=True, slots=True)
class Supervisors:
    """Services that supervise the control loop.

    Attributes:
        beat: function that sends the guardian's heartbeat; called after each control cycle without an error.
        keeper: keeper of the state for the next boot, or None if no state is stored.
        board: reader of processor load, memory, free disk space and temperature, or None in a lock-step
            simulation.
    """

    beat: Callable[[], None] = nothing
    keeper: StateKeeper | None = None
    board: ResourceReader | None = None


class FlightLoop:
    """One flight, from the release of the body at mission time zero to the end of the configured duration."""

    def __init__(
        self, config: Config, body: FlightBody, tasks: LoopTasks, services: Services, supervisors: Supervisors
    ) -> None:
        self._config, self._body, self._tasks, self._services = config, body, tasks, services
        self._supervisors = supervisors
        self._stop_reason = ""
        self._ended_ns = 0
        self._label: RunLabel | None = None
        self._labelled_ns = self._zero_utc_ns = 0
        self._is_corrected = False  # whether the UTC of the run was corrected
        self._show: Callable[[FlightProgress], None] | None = None
        self._notes: list[tuple[EventKind, str]] = [
            (events.LEARNED_REFUSED, problem) for problem in body.estimation.learned_problems
        ]
        self._control = ControlCycle(tasks, body, services)
        self._output: ControlOutput | None = None
        self._groups = self._rate_groups()
        tasks.health.watch(self._groups)
        # Execution times exclude the jobs, which this thread also executes in a lock-step simulation.
        jobs = services.jobs
        self._executive = CyclicExecutive(
            services.clock,
            self._groups,
            tasks.observer,
            lambda: time.perf_counter_ns() - jobs.borrowed_ns - compilation_ns(),
        )

    @property
    def restart(self) -> str:
        """Why the process must be restarted after this flight; empty if no restart is needed."""
        return self._tasks.modes.restart

    def stop(self, reason: str) -> None:
        """End the flight after the current cycle. A signal handler may call this method."""
        self._stop_reason = reason
        self._executive.stop()

    def note(self, kind: EventKind, text: str) -> None:
        """Store an event that occurred before the flight; it is reported when the flight starts."""
        self._notes.append((kind, text))

    def watch(self, progress: Callable[[FlightProgress], None]) -> None:
        """Call `progress` once per second of mission time."""
        self._show = progress

    def run(self, epoch_ns: int, label: RunLabel) -> str:
        """Fly from `epoch_ns` on, and return why the flight ended. The coils are off even after an error."""
        services = self._services
        self._begin(epoch_ns, label)
        try:
            self._executive.run(epoch_ns, epoch_ns + round(self._config.duration * SECOND_NS))
        finally:
            self._tasks.drive.off()
            self._tasks.health.close()
            now_ns = services.clock.now_ns()
            self._ended_ns = max(now_ns - epoch_ns, 0)
            reason = self._stop_reason or "the configured duration is over"
            self._tasks.housekeeping.report_lost(now_ns)
            if self._tasks.commanding is not None:
                self._tasks.commanding.end(now_ns, restarts=bool(self.restart))
            services.events.flush(now_ns)
            services.events.report(events.STOPPED, now_ns, reason)
            self._record_performance(now_ns)
        return reason

    def ending(self) -> FlightEnding:
        """Return the state of the flight; after `run`, this is the state at its end."""
        facts, coils = self._services.facts, self._tasks.housekeeping.coils()
        counts: dict[Severity, dict[str, int]] = {Severity.FAULT: {}, Severity.WARNING: {}}
        causes: dict[str, str] = {}
        for kind, count in self._services.events.counts.items():
            counts.setdefault(kind.severity, {})[kind.name] = count
            if kind.severity is not Severity.INFORMATION:
                causes[kind.name] = self._services.events.first_texts[kind]
        causes |= {fact.name: facts.cause(fact) for fact in facts.held()}
        return FlightEnding(
            mission_time=self._ended_ns * 1e-9,
            cycles=self._groups[0].completed,
            mode=self._tasks.modes.mode.label,
            alarms=tuple(fact.name for fact in facts.held()),
            faults=counts[Severity.FAULT],
            warnings=counts[Severity.WARNING],
            causes=causes,
            coils_left_out=tuple(
                name for name, fact in zip(COIL_NAMES, COILS_BROKEN, strict=True) if facts.holds(fact)
            ),
            coils_at_zero=not coils.error and not coils.current.any(),
            coil_error=coils.error,
            power=self._tasks.power.summary() if self._tasks.power is not None else "",
        )

    def _begin(self, epoch_ns: int, label: RunLabel) -> None:
        """Start all tasks at mission time zero, and record the properties of the run."""
        config, services, tasks, supervisors = self._config, self._services, self._tasks, self._supervisors
        services.recorder.epoch_ns = epoch_ns
        tasks.navigation.begin(epoch_ns)
        if tasks.imaging is not None:
            tasks.imaging.begin(epoch_ns)
        for sensing in (tasks.positioning, tasks.sun, tasks.horizon_cameras, tasks.power):
            if sensing is not None:
                sensing.begin(epoch_ns)
        if tasks.commanding is not None:
            tasks.commanding.begin(epoch_ns)
        services.streams.begin(epoch_ns)
        self._label = label
        self._record_label(epoch_ns)
        tasks.modes.begin(epoch_ns, supervisors.keeper.record.unclean_recent if supervisors.keeper else 0)
        services.events.report(events.STARTED, epoch_ns, f"{config.name}, {config.duration:g} s")
        for kind, text in self._notes:
            services.events.report(kind, epoch_ns, text)
        tasks.health.begin(epoch_ns)
        if supervisors.board is not None:
            tasks.health.read_resources(supervisors.board, round(config.health.look_period * SECOND_NS))

    def _record_label(self, now_ns: int) -> None:
        """Record the properties of the run, with the best known UTC at mission time zero."""
        config, label, coils = self._config, self._label, self._config.coils
        assert label is not None
        self._labelled_ns, self._zero_utc_ns = now_ns, self._utc_at_zero()
        self._services.recorder.record(
            RUN,
            now_ns,
            config_name=config.name,
            config_crc=zlib.crc32(label.config_text.encode()),
            software=__version__,
            seed=label.seed,
            utc_ns=self._zero_utc_ns,
            simulated=int(label.simulated),
            realtime=int(label.realtime),
            control_period_ns=self._groups[0].period_ns,
            duration=config.duration,
            coil_resistance=[
                math.nan if k in coils.absent else ohm for k, ohm in enumerate(coils.resistance[:3])
            ],
            supply_voltage=coils.supply_voltage,
            current_limit=max(coils.limits),
        )

    def _utc_at_zero(self) -> int:
        """Return the best known UTC at mission time zero, ns since 1970."""
        clock = self._services.clock
        return clock.utc_ns() - (clock.now_ns() - self._services.recorder.epoch_ns)

    def _correct_label(self, now_ns: int) -> None:
        """Record the properties of the run again after a step of the UTC clock, and then once a minute.

        Because of the repetitions, a link process that starts later receives the corrected UTC.
        """
        changed = abs(self._utc_at_zero() - self._zero_utc_ns) > CLOCK_OFF_NS
        self._is_corrected = self._is_corrected or changed
        if changed or (self._is_corrected and now_ns - self._labelled_ns >= LABEL_PERIOD_NS):
            self._record_label(now_ns)

    def _rate_groups(self) -> list[RateGroup]:
        """Return the rate groups in order of importance, with the control group first."""
        config, tasks = self._config, self._tasks
        camera, replan_period = config.camera, config.replan_period()
        control_ns = round(SECOND_NS / CONTROL_RATE_HZ)
        groups = [RateGroup(CONTROL, control_ns, self._run_control)]
        if replan_period is not None:
            groups.append(RateGroup("planning", round(replan_period * SECOND_NS), self._replan))
        if camera is not None and tasks.imaging is not None:
            groups.append(RateGroup("camera", round(camera.period * SECOND_NS), tasks.imaging.trigger))
        if tasks.commanding is not None:
            groups.append(RateGroup("commands", COMMAND_PERIOD_NS, tasks.commanding.run))
        if self._has_fast_cameras():
            groups.append(RateGroup("horizon", HORIZON_PERIOD_NS, self._run_horizon_cameras))
        groups.append(RateGroup("health", HEALTH_PERIOD_NS, tasks.health.run))
        groups.append(RateGroup("housekeeping", SECOND_NS, self._keep_house))
        return groups

    def _has_fast_cameras(self) -> bool:
        """Return whether the horizon cameras take frames more often than once in two seconds."""
        return any(min(camera.period, camera.fine_period) < 2.0 for camera in self._config.wide_cameras)

    def _replan(self, cycle: Cycle) -> None:
        if self._tasks.shedding.makes_plan(cycle.slot):
            self._body.control.planner.replan(cycle)

    def _run_horizon_cameras(self, cycle: Cycle) -> None:
        if self._tasks.horizon_cameras is not None:
            self._tasks.horizon_cameras.run(cycle.start_ns)

    def _run_control(self, cycle: Cycle) -> None:
        self._output = self._control.run(cycle)
        self._supervisors.beat()

    def _keep_house(self, cycle: Cycle) -> None:
        now_ns, output, tasks = cycle.start_ns, self._output, self._tasks
        state = output.steered.state if output is not None else SteeringState.OFF
        for sensing in (tasks.positioning, tasks.sun, tasks.power):
            if sensing is not None:
                sensing.run(now_ns)
        if not self._has_fast_cameras():
            self._run_horizon_cameras(cycle)
        tasks.shedding.run(self._groups[0].slips, now_ns)
        tasks.housekeeping.run(cycle, state)
        self._correct_label(now_ns)
        self._keep_state(now_ns)
        self._record_performance(now_ns)
        if self._show is None:
            return
        progress = FlightProgress(
            (now_ns - self._services.recorder.epoch_ns) * 1e-9,
            self._config.duration,
            self._body.view.progress(output),
            tuple(output.steered.currents.tolist()) if output is not None else (),
            state.name.lower(),
            self._groups[0].slips,
            self._services.events.count,
        )
        self._show(progress)

    def _keep_state(self, now_ns: int) -> None:
        """Pass the state for the next boot to the keeper, and report the keeper's events.

        This method does not access the disk.
        """
        keeper = self._supervisors.keeper
        if keeper is None:
            return
        for kind, text in keeper.notices():
            self._services.events.report(kind, now_ns, text)
        estimate = self._tasks.navigation.estimate(now_ns)
        learned = dict(self._body.estimation.learned(estimate)) if estimate else {}
        if self._tasks.imaging is not None:
            learned |= self._tasks.imaging.learned()
        keeper.note(self._tasks.modes.mode.label, learned or None)

    def _record_performance(self, now_ns: int) -> None:
        for group in self._groups:
            self._tasks.observer.group(group, now_ns)
