"""One flight from release to end: starts the tasks, runs the rate groups, and switches the coils off.

The package `flight.app` opens and closes the devices, and assembles the tasks.
"""

from __future__ import annotations

import math
import time
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from flight import __version__
from flight.link import events
from flight.link.events import EventKind, Severity
from flight.link.telemetry.definitions import RUN
from flight.loop.body import ControlOutput, FlightBody, SteeringState
from flight.loop.control_cycle import ControlCycle, LoopTasks
from flight.loop.executive import Cycle, CyclicExecutive, RateGroup
from flight.loop.facts import CLOCK_OFF_NS, COILS_BROKEN, Services
from flight.loop.health import CONTROL, ResourceReader
from flight.loop.state import StateKeeper
from flight.schema.sections import CONTROL_RATE_HZ, Config
from hal.interfaces.devices import COIL_NAMES
from hal.interfaces.wires import SECOND_NS


@dataclass(frozen=True, slots=True)
class RunLabel:
    """Properties of a run that are recorded in its first packet."""

    config_text: str
    seed: int
    simulated: bool
    realtime: bool


@dataclass(frozen=True, slots=True)
class FlightProgress:
    """Progress of a flight: times (s), coil currents (n,), A, and a text about target and attitude."""

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
        mission_time: s.
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
        power: state of charge and energies of the battery; empty without a section `power`.
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
    """Do nothing, because lock-step simulation has no watchdog."""


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
        self._config = config
        self._body = body
        self._tasks = tasks
        self._services = services
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
        # In a lock-step simulation, this thread also executes the jobs. Their time does not count as
        # execution time of the rate groups.
        jobs = services.jobs
        self._executive = CyclicExecutive(
            services.clock, self._groups, tasks.observer, lambda: time.perf_counter_ns() - jobs.borrowed_ns
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
        """Store an event from before the flight, which is reported when the flight starts."""
        self._notes.append((kind, text))

    def watch(self, progress: Callable[[FlightProgress], None]) -> None:
        """Call `progress` once per second of mission time."""
        self._show = progress

    def run(self, epoch_ns: int, label: RunLabel) -> str:
        """Fly from `epoch_ns` on, and return why the flight ended.

        The coils are off afterwards, even if an error is raised.
        """
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
        return any(camera.period < 2.0 for camera in self._config.wide_cameras)

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
            sum(group.slips for group in self._groups),
            self._services.events.count,
        )
        self._show(progress)

    def _keep_state(self, now_ns: int) -> None:
        """Pass the state for the next boot to the keeper, and report its events, without disk access."""
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
