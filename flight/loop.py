"""The flight application once its devices are open: builds the rooms, lays the rate groups, runs, ends.

It knows devices only by their Protocols; `flight.app` opens them and closes them again.
"""

from __future__ import annotations

import time
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from flight import __version__, composition, events
from flight.commands.channel import Channel
from flight.control.choice import controller_of
from flight.events import EventLog
from flight.executive.executive import Executive
from flight.executive.jobs import JobRunner, Worker
from flight.executive.rate_group import Cycle, RateGroup
from flight.guidance import job as plan_job
from flight.guidance.guidance import AcceptanceRules, Guidance
from flight.health.facts import Facts
from flight.health.progress import GroupsAndWorkers, WorkerWatch
from flight.health.resources import ClockWatch, ResourceMonitor, ResourceReader
from flight.health.streams import Streams, streams_of
from flight.modes.machine import ModeMachine
from flight.plant import SingleAxisPlant
from flight.settings import Config
from flight.startracker import frame_job
from flight.state.keeper import StateKeeper
from flight.state.learning import learned_of
from flight.tasks import imaging as imaging_task
from flight.tasks import planning as planning_task
from flight.tasks.coil_drive import CoilDrive
from flight.tasks.commanding import Commanding
from flight.tasks.control_cycle import ControlCycle, Rooms
from flight.tasks.health_watch import HealthRooms, HealthWatch
from flight.tasks.housekeeping import Housekeeping, Watched
from flight.tasks.imaging import Imaging
from flight.tasks.mode_control import ModeControl
from flight.tasks.navigation import Navigation
from flight.tasks.performance import CONTROL, PerformanceObserver
from flight.tasks.planning import Planning, Strategy
from flight.tasks.steering import Steering
from flight.tasks.targets import TargetSequence
from flight.telemetry.definitions import RUN
from flight.telemetry.recorder import Recorder
from hal.interfaces.devices import FrameSource, InertialUnit, PowerMonitor, TorqueCoils
from hal.interfaces.wires import Clock

SECOND_NS = composition.SECOND_NS
HEALTH_PERIOD_NS = SECOND_NS // 4
COMMAND_PERIOD_NS = SECOND_NS // 10


@dataclass(frozen=True, slots=True)
class Devices:
    """The open devices; a monitor and a camera are not everywhere fitted."""

    unit: InertialUnit
    coils: TorqueCoils
    power: PowerMonitor | None
    camera: FrameSource | None


@dataclass(frozen=True, slots=True)
class RunLabel:
    """What the first packet of a run says of it."""

    config_text: str
    seed: int
    simulated: bool
    realtime: bool


@dataclass(frozen=True, slots=True)
class Progress:
    """What a person watching wants to see."""

    mission_time: float
    duration: float
    target_q2: float
    q2: float | None
    rate: float | None
    current: float
    state: str
    slips: int
    events: int


def plant_of(config: Config) -> SingleAxisPlant:
    """Return the plant that the configuration believes in."""
    believed = config.plant
    return SingleAxisPlant(
        inertia=believed.inertia,
        torque_constant=believed.coil_turns * believed.coil_area * believed.field,
        resistance=config.coils.resistance[0],
        current_limit=min(
            config.coils.current_limit, config.coils.supply_voltage / config.coils.resistance[0]
        ),
        stiffness=believed.thread_stiffness,
        damping=believed.thread_damping,
    )


def workers(config: Config, planner_latency_ns: int = 0, vision_latency_ns: int = 0) -> list[Worker]:
    """Return the workers that a configuration needs; latencies hold in lock-step simulation only."""
    planner_timeout_ns = round(config.executive.planner_timeout * SECOND_NS)
    vision_timeout_ns = round(config.executive.vision_timeout * SECOND_NS)
    made = [Worker(planning_task.WORKER, plan_job.run, planner_latency_ns, planner_timeout_ns)]
    if config.camera is not None:
        made.append(Worker(imaging_task.WORKER, frame_job.run, vision_latency_ns, vision_timeout_ns))
    return made


def _nothing() -> None:
    """Feed no watchdog, beat for no guardian."""


class FlightLoop:
    """One flight: from the release at mission time zero to the end of the configured duration."""

    def __init__(
        self,
        config: Config,
        clock: Clock,
        devices: Devices,
        jobs: JobRunner,
        recorder: Recorder,
        log_error: Callable[[], str],
        *,
        feed: Callable[[], None] = _nothing,
        beat: Callable[[], None] = _nothing,
        keeper: StateKeeper | None = None,
        board: ResourceReader | None = None,
        channels: Sequence[Channel] = (),
    ) -> None:
        """Take open devices and logs.

        `feed` is called about four times a second while every rate group and worker makes progress: the
        watchdog's food. `beat` is called at the end of each control cycle that ran well: the guardian's
        heartbeat. `keeper` remembers earlier boots; `board` looks at processor, memory, disk and warmth;
        `channels` are where commands come from.
        """
        self._config = config
        self._beat = beat
        self._board = board
        self._keeper = keeper
        self._clock = clock
        self._devices = devices
        self._recorder = recorder
        self._duration_ns = round(config.duration * SECOND_NS)
        self._events = EventLog(recorder.event)
        self._facts = Facts(self._events)
        self._streams = Streams(streams_of(config))
        self._progress: Callable[[Progress], None] | None = None
        self._stop_reason = ""
        plant = plant_of(config)
        self._navigation = Navigation(
            devices.unit,
            composition.attitude_filter(config, plant),
            composition.navigation_settings(config, plant),
            recorder,
            self._events,
            self._facts,
            self._streams,
        )
        planning = composition.planning_settings(config)
        guidance = Guidance(
            plant,
            AcceptanceRules(late_after=config.guidance.late_after),
            arrives=planning.strategy is not Strategy.RECEDING,
        )
        self._drive = CoilDrive(
            devices.coils,
            composition.coil_watch(config, plant),
            composition.dipole_per_ampere(config),
            np.full(3, config.coils.current_limit),
            self._facts,
            self._events,
            devices.power,
        )
        self._steering = self._steering_of(plant, guidance)
        self._planning = Planning(plant, planning, guidance, jobs, recorder, self._events)
        self._imaging = self._imaging_of(plant, jobs)
        self._modes = ModeControl(
            config.modes,
            ModeMachine(),
            guidance,
            self._steering,
            self._drive,
            self._facts,
            recorder,
            self._events,
            (config.detumble.low_rate, config.detumble.low_for),
            self.stop,
        )
        self._events.react_by(self._modes.react)
        self._observer = PerformanceObserver(clock, devices.coils, recorder, self._events)
        self._control = self._control_of(jobs)
        self._housekeeping = self._housekeeping_of(log_error)
        self._commanding = Commanding(
            self._modes,
            self._facts,
            self._drive,
            config.commands.timeline,
            channels,
            recorder,
            self._events,
        )
        self._commanded = bool(channels or config.commands.timeline)
        self._groups = self._rate_groups()
        self._health = self._health_of(feed)
        # Jobs done on the spot, in lock-step, are no part of a cycle's execution time.
        self._executive = Executive(
            clock, self._groups, self._observer, lambda: time.perf_counter_ns() - jobs.borrowed_ns
        )

    @property
    def restart(self) -> str:
        """Why the process should be started again after this flight; empty when it should not."""
        return self._modes.restart

    def stop(self, reason: str) -> None:
        """End the flight after the running cycle. Safe from a signal handler."""
        self._stop_reason = reason
        self._executive.stop()

    def watch(self, progress: Callable[[Progress], None]) -> None:
        """Have `progress` called once a second of mission time."""
        self._progress = progress

    def run(self, epoch_ns: int, label: RunLabel) -> str:
        """Fly from `epoch_ns` on; return why it ended. The coils are at zero when this returns or raises."""
        self._recorder.epoch_ns = epoch_ns
        self._navigation.begin(epoch_ns)
        if self._imaging is not None:
            self._imaging.begin(epoch_ns)
        self._streams.begin(epoch_ns)
        self._record_run(epoch_ns, label)
        self._modes.begin(epoch_ns, self._keeper.record.unclean_recent if self._keeper else 0)
        self._events.tell(events.STARTED, epoch_ns, f"{self._config.name}, {self._config.duration:g} s")
        self._begin_health(epoch_ns)
        try:
            self._executive.run(epoch_ns, epoch_ns + self._duration_ns)
        finally:
            self._devices.coils.off()
            self._health.close()
            now_ns = self._clock.now_ns()
            reason = self._stop_reason or "the configured duration is over"
            self._events.flush(now_ns)
            self._events.tell(events.STOPPED, now_ns, reason)
            self._tell_performance(now_ns)
        return reason

    def _rate_groups(self) -> list[RateGroup]:
        """Lay the groups in order of importance; the loop's own grid decides what runs when."""
        config = self._config
        control_ns = round(SECOND_NS / config.executive.control_rate_hz)
        replan_ns = round(config.guidance.replan_period * SECOND_NS)
        groups = [
            RateGroup(CONTROL, control_ns, self._run_control),
            RateGroup("planning", replan_ns, self._planning.replan),
        ]
        if self._imaging is not None and config.camera is not None:
            groups.append(RateGroup("camera", round(config.camera.period * SECOND_NS), self._imaging.trigger))
        if self._commanded:
            groups.append(RateGroup("commands", COMMAND_PERIOD_NS, self._commanding.run))
        groups.append(RateGroup("health", HEALTH_PERIOD_NS, self._watch_health))
        groups.append(RateGroup("housekeeping", SECOND_NS, self._keep_house))
        return groups

    def _steering_of(self, plant: SingleAxisPlant, guidance: Guidance) -> Steering:
        config = self._config
        period = 1.0 / config.executive.control_rate_hz
        return Steering(
            guidance,
            controller_of(config.control, plant, period, config.identification),
            composition.detumbler(config, plant),
            self._navigation,
            self._devices.coils,
            self._drive,
            self._facts,
        )

    def _imaging_of(self, plant: SingleAxisPlant, jobs: JobRunner) -> Imaging | None:
        camera, source = self._config.camera, self._devices.camera
        if camera is None or source is None:
            return None
        settings = composition.imaging_settings(camera, self._unrest(plant))
        return Imaging(
            source,
            settings,
            self._navigation,
            jobs,
            self._recorder,
            self._events,
            self._facts,
            self._streams,
        )

    def _control_of(self, jobs: JobRunner) -> ControlCycle:
        rooms = Rooms(
            self._navigation,
            self._modes,
            self._steering,
            self._planning,
            self._imaging,
            self._devices.coils,
            self._drive,
            jobs,
        )
        targets = TargetSequence([(step.at, step.q2, step.rate) for step in self._config.steps])
        return ControlCycle(rooms, targets, self._recorder, self._events, self._observer, self._streams)

    def _housekeeping_of(self, log_error: Callable[[], str]) -> Housekeeping:
        watched = Watched(
            self._navigation,
            self._steering,
            self._planning,
            self._imaging,
            self._devices.coils,
            self._devices.power,
            log_error,
        )
        return Housekeeping(watched, self._recorder, self._events, self._facts)

    def _health_of(self, feed: Callable[[], None]) -> HealthWatch:
        config = self._config
        rooms = HealthRooms(
            self._modes,
            self._streams,
            self._facts,
            self._drive,
            self._devices.power,
            self._groups[0],
            GroupsAndWorkers(self._groups, self._worker_watches()),
        )
        clock_watch = ClockWatch(self._clock, config.health.clock_step)
        monitor = ResourceMonitor(config.health)
        return HealthWatch(rooms, monitor, clock_watch, self._recorder, self._events, feed)

    def _worker_watches(self) -> list[WorkerWatch]:
        """Return the workers with twice the time after which the runner kills them."""
        executive = self._config.executive
        busy = [("planner", self._planning.busy_since_ns, executive.planner_timeout)]
        if self._imaging is not None:
            busy.append(("vision", self._imaging.busy_since_ns, executive.vision_timeout))
        return [WorkerWatch(name, since, round(2.0 * limit * SECOND_NS)) for name, since, limit in busy]

    def _begin_health(self, epoch_ns: int) -> None:
        self._health.begin(epoch_ns)
        if self._board is not None:
            period_ns = round(self._config.health.look_period * SECOND_NS)
            self._health.read_resources(self._clock, self._board, period_ns)

    def _unrest(self, plant: SingleAxisPlant) -> float:
        """Return the density of the angular acceleration that the coils' uncertain current makes."""
        noise = plant.torque_constant / plant.inertia * self._config.estimation.current_noise
        return noise**2 / self._config.executive.control_rate_hz

    def _run_control(self, cycle: Cycle) -> None:
        self._control.run(cycle)
        self._beat()

    def _watch_health(self, cycle: Cycle) -> None:
        self._health.run(cycle)

    def _keep_house(self, cycle: Cycle) -> None:
        self._housekeeping.run(cycle)
        self._keep_state(cycle.start_ns)
        self._tell_performance(cycle.start_ns)
        if self._progress is not None:
            estimate, target = self._control.estimate, self._control.target
            self._progress(
                Progress(
                    (cycle.start_ns - self._recorder.epoch_ns) * 1e-9,
                    self._config.duration,
                    target.q2 if target else 0.0,
                    estimate.q2 if estimate else None,
                    estimate.rate if estimate else None,
                    float(self._steering.command[0]),
                    self._steering.state.name.lower(),
                    sum(group.slips for group in self._groups),
                    self._events.count,
                )
            )

    def _keep_state(self, now_ns: int) -> None:
        """Note what is to outlive the process, and tell what became of it; touches no disk."""
        if self._keeper is None:
            return
        for kind, text in self._keeper.notices():
            self._events.tell(kind, now_ns, text)
        estimate = self._navigation.attitude(now_ns)
        self._keeper.note(self._modes.mode.label, learned_of(estimate) if estimate else None)

    def _tell_performance(self, now_ns: int) -> None:
        for group in self._groups:
            self._observer.group(group, now_ns)

    def _record_run(self, epoch_ns: int, label: RunLabel) -> None:
        coils = self._config.coils
        self._recorder.record(
            RUN,
            epoch_ns,
            config_name=self._config.name,
            config_crc=zlib.crc32(label.config_text.encode()),
            software=__version__,
            seed=label.seed,
            utc_ns=self._clock.utc_ns() - (self._clock.now_ns() - epoch_ns),
            simulated=int(label.simulated),
            realtime=int(label.realtime),
            control_period_ns=self._groups[0].period_ns,
            duration=self._config.duration,
            coil_resistance=list(coils.resistance),
            supply_voltage=coils.supply_voltage,
            current_limit=coils.current_limit,
        )
