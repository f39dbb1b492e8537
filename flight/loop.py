"""The flight application once its devices are open: builds the rooms, lays the rate groups, runs, ends.

It knows devices only by their Protocols; `flight.app` opens them and closes them again.
"""

from __future__ import annotations

import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from flight import __version__, events
from flight.camera import camera_model
from flight.control.choice import controller_of
from flight.estimation.attitude_filter import AttitudeFilter, FilterSettings
from flight.estimation.rigid_body import Parameters, RigidBody
from flight.events import EventLog
from flight.executive.executive import Executive
from flight.executive.jobs import JobRunner, Worker
from flight.executive.rate_group import Cycle, RateGroup
from flight.guidance import job as plan_job
from flight.guidance.guidance import AcceptanceRules, Guidance
from flight.guidance.vmc import NODES
from flight.plant import SingleAxisPlant
from flight.settings import Camera, Config
from flight.startracker import frame_job
from flight.startracker.detection import DetectionSettings
from flight.startracker.frame_job import TrackerSettings
from flight.startracker.solve import SolveSettings
from flight.tasks import imaging as imaging_task
from flight.tasks import planning as planning_task
from flight.tasks.control_cycle import ControlCycle, Rooms
from flight.tasks.housekeeping import Housekeeping, Watched
from flight.tasks.imaging import Imaging, ImagingSettings
from flight.tasks.navigation import Navigation, NavigationSettings
from flight.tasks.performance import CONTROL, PerformanceObserver
from flight.tasks.planning import Planning, PlanningSettings, Strategy
from flight.tasks.steering import Steering
from flight.tasks.targets import TargetSequence
from flight.telemetry.definitions import RUN
from flight.telemetry.recorder import Recorder
from flight.vision.likelihood.settings import LikelihoodSettings
from flight.vision.settings import StreakSettings
from hal.interfaces.devices import FrameSource, InertialUnit, PowerMonitor, TorqueCoils
from hal.interfaces.wires import Clock

SECOND_NS = 1_000_000_000


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
    ) -> None:
        self._config = config
        self._clock = clock
        self._devices = devices
        self._recorder = recorder
        self._duration_ns = round(config.duration * SECOND_NS)
        self._events = EventLog(recorder.event)
        self._progress: Callable[[Progress], None] | None = None
        plant = plant_of(config)
        self._navigation = _navigation(config, plant, devices.unit, recorder, self._events)
        planning_settings = _planning_settings(config)
        guidance = Guidance(
            plant,
            AcceptanceRules(late_after=config.guidance.late_after),
            arrives=planning_settings.strategy is not Strategy.RECEDING,
        )
        period = 1.0 / config.executive.control_rate_hz
        controller = controller_of(config.control, plant, period, config.identification)
        self._steering = Steering(guidance, controller, devices.coils, self._events)
        self._planning = Planning(plant, planning_settings, guidance, jobs, recorder, self._events)
        self._imaging = (
            Imaging(
                devices.camera,
                _imaging_settings(config.camera, self._unrest(plant)),
                self._navigation,
                jobs,
                recorder,
                self._events,
            )
            if config.camera is not None and devices.camera is not None
            else None
        )
        observer = PerformanceObserver(clock, devices.coils, recorder, self._events)
        self._observer = observer
        rooms = Rooms(self._navigation, self._steering, self._planning, self._imaging, devices.coils, jobs)
        targets = TargetSequence([(step.at, step.q2, step.rate) for step in config.steps])
        self._control = ControlCycle(rooms, targets, recorder, self._events, observer)
        self._housekeeping = Housekeeping(
            Watched(
                self._navigation,
                self._steering,
                self._planning,
                self._imaging,
                devices.coils,
                devices.power,
                log_error,
            ),
            recorder,
            self._events,
        )
        self._groups = self._rate_groups()
        # Jobs done on the spot, in lock-step, are no part of a cycle's execution time.
        self._executive = Executive(
            clock, self._groups, observer, lambda: time.perf_counter_ns() - jobs.borrowed_ns
        )
        self._stop_reason = ""

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
        self._record_run(epoch_ns, label)
        self._events.tell(events.STARTED, epoch_ns, f"{self._config.name}, {self._config.duration:g} s")
        try:
            self._executive.run(epoch_ns, epoch_ns + self._duration_ns)
        finally:
            self._devices.coils.off()
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
            RateGroup(CONTROL, control_ns, self._control.run),
            RateGroup("planning", replan_ns, self._planning.replan),
        ]
        if self._imaging is not None and config.camera is not None:
            groups.append(RateGroup("camera", round(config.camera.period * SECOND_NS), self._imaging.trigger))
        groups.append(RateGroup("housekeeping", SECOND_NS, self._keep_house))
        return groups

    def _unrest(self, plant: SingleAxisPlant) -> float:
        """Return the density of the angular acceleration that the coils' uncertain current makes."""
        noise = plant.torque_constant / plant.inertia * self._config.estimation.current_noise
        return noise**2 / self._config.executive.control_rate_hz

    def _keep_house(self, cycle: Cycle) -> None:
        self._housekeeping.run(cycle)
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


def _navigation(
    config: Config, plant: SingleAxisPlant, unit: InertialUnit, recorder: Recorder, event_log: EventLog
) -> Navigation:
    section, believed = config.estimation, config.plant
    body = RigidBody(
        np.eye(3) * plant.inertia,
        believed.coil_turns * believed.coil_area,
        np.array([0.0, 0.0, -believed.field]),
        suspended=True,
        stiffness=plant.stiffness,
        damping=plant.damping,
    )
    filter_ = AttitudeFilter(
        body,
        FilterSettings(
            current_noise=section.current_noise,
            control_period=1.0 / config.executive.control_rate_hz,
            disturbance_walk=section.disturbance_walk,
            bias_start=section.bias_start,
            torsion_start=section.torsion_start,
            damping_start=section.damping_start,
            gain_start=section.gain_start,
            latency_start=section.latency_start,
            latency_walk=section.latency_walk,
            gate_sigma=section.gate_sigma,
            history_ns=round(section.history * SECOND_NS),
        ),
    )
    settings = NavigationSettings(
        config.inertial_unit.angle_noise,
        config.inertial_unit.rate_noise,
        round(config.inertial_unit.max_age * SECOND_NS),
        round(section.coast * SECOND_NS),
        Parameters(plant.stiffness / plant.inertia, plant.damping / plant.inertia),
    )
    return Navigation(unit, filter_, settings, recorder, event_log)


def _planning_settings(config: Config) -> PlanningSettings:
    section = config.guidance
    return PlanningSettings(
        horizon=section.horizon,
        max_horizon=section.max_horizon,
        late_after_ns=round(section.late_after * SECOND_NS),
        nodes=section.nodes or NODES,
        strategy=Strategy(section.strategy),
        time_price=section.time_price,
        current_share=section.current_share,
    )


def _imaging_settings(camera: Camera, unrest: float) -> ImagingSettings:
    return ImagingSettings(
        camera=camera_model(camera),
        exposure_ns=round(camera.exposure * SECOND_NS),
        max_age_ns=round(camera.max_age * SECOND_NS),
        mounting=np.array(camera.mounting),
        estimator=_estimator(camera),
        tracker=_tracker(camera),
        unrest=unrest,
    )


def _tracker(camera: Camera) -> TrackerSettings | None:
    """Return what the star tracker must know of the configured camera, None where it is not wanted."""
    section = camera.star_tracker
    if section is None:
        return None
    detection = DetectionSettings(
        psf_sigma=camera.psf_sigma, gain=camera.gain, saturation=_saturation(camera)
    )
    spread = 1.0 + section.scale_error
    scale = (1.0 / spread, spread)
    index = Path(section.index) if section.index is not None else None
    velocity = None if section.velocity is None else np.array(section.velocity)
    return TrackerSettings(SolveSettings(detection=detection, velocity=velocity), scale, index)


def _saturation(camera: Camera) -> float:
    return camera.saturation or float(2**camera.bits - 1)


def _estimator(camera: Camera) -> StreakSettings | LikelihoodSettings:
    """Return the settings of the estimator that the configuration chose, for its camera."""
    saturation = _saturation(camera)
    if camera.estimator == "likelihood":
        return LikelihoodSettings(
            gain=camera.gain, saturation=saturation, psf_sigma=camera.psf_sigma, line_time=camera.line_time
        )
    settings = StreakSettings.of(camera.estimator, saturation=saturation, gain=camera.gain)
    return settings if camera.endpoint_bias is None else replace(settings, endpoint_bias=camera.endpoint_bias)
