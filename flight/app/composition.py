"""Builds the body, the settings, the workers and the tasks of the loop from the configuration."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from flight.app.devices import Devices
from flight.link.commands import Channel
from flight.link.telemetry.log import Recorder
from flight.loop import horizon_cameras as horizon_task
from flight.loop import imaging as imaging_task
from flight.loop.body import PLANNER, BodyKind, FlightBody, Planner
from flight.loop.commanding import CommandedTasks, CommandTask, ParameterTable, ParameterUsers
from flight.loop.control_cycle import LoopTasks
from flight.loop.executive import JobRunner, Worker
from flight.loop.facts import EventLog, Facts, Services, Streams, streams_of
from flight.loop.flight_loop import FlightLoop, Supervisors, nothing
from flight.loop.health import (
    HealthInputs,
    HealthWatch,
    Housekeeping,
    HousekeepingInputs,
    PerformanceObserver,
    WorkerWatch,
)
from flight.loop.horizon_cameras import HorizonCameraSettings, HorizonCameraTask
from flight.loop.imaging import Imaging, ImagingSettings, ObjectTracks
from flight.loop.modes import ModeControl, ModeSettings
from flight.loop.navigation import Navigation, NavigationSettings, Positioning, SunSensing
from flight.loop.state import Learned, StateKeeper
from flight.loop.steering import CoilDrive, CoilDriveSettings, Steering
from flight.schema.devices import Camera, WideCamera, camera_model, likelihood_settings
from flight.schema.devices import ObjectTracking as TrackingSection
from flight.schema.document import ConfigError
from flight.schema.sections import CONTROL_RATE_HZ, Config, Executive
from hal.interfaces.wires import SECOND_NS, Clock
from knightcube.gnc.tracking.tracker import TrackSettings
from knightcube.vision import frame_job, horizon_camera_job
from knightcube.vision.camera.images import KeptFrames
from knightcube.vision.camera.lens import CameraKnowledge, Exposures
from knightcube.vision.frame_job import StreakEstimator, TrackerSettings
from knightcube.vision.objects.settings import ObjectMeasurementSettings
from knightcube.vision.startracker.detection import DetectionSettings
from knightcube.vision.startracker.lost_in_space import IdentificationSettings
from knightcube.vision.startracker.solve import SolveSettings
from knightcube.vision.streaks.settings import LikelihoodSettings

BODIES = {"testbed": "flight.bodies.testbed.body:TESTBED", "orbit": "flight.bodies.orbit.body:ORBIT"}


def body_kind(config: Config) -> BodyKind:
    """Return the configured kind of body. Raises ConfigError."""
    place = BODIES.get(config.body, config.body)
    module, colon, name = place.partition(":")
    if not (module and colon and name):
        known = ", ".join(BODIES)
        raise ConfigError("body", f"is {config.body!r}: name one of {known}, or `module:object`")
    try:
        kind = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise ConfigError("body", f"is {config.body!r}, which cannot be had: {error}") from error
    if not isinstance(kind, BodyKind):
        raise ConfigError("body", f"is {config.body!r}: that is no BodyKind of flight.loop.body")
    return kind


def navigation_settings(config: Config) -> NavigationSettings:
    """Return the age limits of the inertial unit's readings."""
    section = config.estimation
    return NavigationSettings(
        round(config.inertial_unit.max_age * SECOND_NS),
        round(section.coast * SECOND_NS),
        round(SECOND_NS / CONTROL_RATE_HZ),
    )


def imaging_settings(camera: Camera, body: FlightBody, frames: Path | None) -> ImagingSettings:
    """Return the settings of imaging; `frames` is the folder of frames that are kept."""
    kept = KeptFrames(frames, camera.keep_frames) if frames is not None and camera.keep_frames else None
    return ImagingSettings(
        camera=camera_model(camera),
        exposures=_exposures(camera),
        # A trigger may come late, and the next on time.
        fine_rest_ns=round(((camera.fine_period or camera.period) - 0.5 * camera.period) * SECOND_NS),
        max_age_ns=round(camera.max_age * SECOND_NS),
        late_ns=round(camera.late_after * SECOND_NS),
        slow_ns=round(camera.vision_slow_after * SECOND_NS),
        max_rate=math.inf if camera.max_rate is None else camera.max_rate,
        mounting=np.array(camera.mounting),
        estimator=_estimator(camera, body),
        tracker=_tracker(camera),
        angular_acceleration_psd=body.estimation.angular_acceleration_psd,
        velocity=body.estimation.velocity,
        objects=None
        if camera.objects is None
        else ObjectMeasurementSettings(faintest=camera.objects.faintest),
        knowledge=body.estimation.knowledge,
        seeks=body.control.follows_objects,
        calm=body.control.exposure_start,
        kept=kept,
    )


def horizon_camera_settings(cameras: Sequence[WideCamera]) -> HorizonCameraSettings:
    """Return the times of the wide cameras, those of the most frequent one for all."""
    fine_ns = round(min(camera.fine_period for camera in cameras) * SECOND_NS)
    period_ns = min(round(min(camera.period for camera in cameras) * SECOND_NS), fine_ns)
    return HorizonCameraSettings(
        [round(camera.exposure * SECOND_NS) for camera in cameras],
        period_ns - SECOND_NS // 2,  # run once a second, which may come late
        fine_ns - SECOND_NS // 2,
        min(2 * SECOND_NS, period_ns),
        max(round(max(camera.max_age for camera in cameras) * SECOND_NS), 2 * fine_ns),
    )


def _exposures(camera: Camera) -> Exposures:
    """Return the exposures of the star camera."""
    least, most = camera.streak_exposure or (camera.exposure, camera.exposure)
    return Exposures(camera.exposure, least, most, camera_model(camera).focal_length)


def track_settings(section: TrackingSection) -> TrackSettings:
    """Return how tracks of objects start, go on and end."""
    return TrackSettings(needed=section.needed, within=section.within, coast=section.coast)


def _tracker(camera: Camera) -> TrackerSettings | None:
    """Return the settings of the star tracker, None without one."""
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
    # The camera is known on board: no mirror is in its path, and its focal length is as good as configured.
    identification = IdentificationSettings(mirror=False, hint_error=1.0)
    accuracy = camera.accuracy
    lens = CameraKnowledge(accuracy.focal_length, accuracy.centre, accuracy.distortion)
    solve = SolveSettings(detection=detection, identification=identification, velocity=velocity, lens=lens)
    return TrackerSettings(solve, scale, index)


def _saturation(camera: Camera) -> float:
    return camera.saturation or float(2**camera.bits - 1)


def _estimator(camera: Camera, body: FlightBody) -> LikelihoodSettings | StreakEstimator:
    """Return the configured estimator of streaks. Raises ConfigError for one that the body does not have."""
    if camera.estimator == "likelihood":
        return replace(likelihood_settings(camera), saturation=_saturation(camera))
    if body.streak_estimator is None:
        raise ConfigError(
            "camera.estimator", f"is {camera.estimator!r}, which this body does not have: use 'likelihood'"
        )
    return body.streak_estimator


def workers(config: Config, planner_latency_ns: int = 0, vision_latency_ns: int = 0) -> list[Worker]:
    """Return the workers that a configuration needs; latencies apply to lock-step simulation only."""
    planner_timeout_ns = round(config.executive.planner_timeout * SECOND_NS)
    vision_timeout_ns = round(config.executive.vision_timeout * SECOND_NS)
    plan = body_kind(config).plan
    made = [] if plan is None else [Worker(PLANNER, plan, planner_latency_ns, planner_timeout_ns)]
    if config.camera is not None:
        made.append(Worker(imaging_task.WORKER, frame_job.run, vision_latency_ns, vision_timeout_ns))
    if config.wide_cameras:
        made.append(Worker(horizon_task.WORKER, horizon_camera_job.run, vision_latency_ns, vision_timeout_ns))
    return made


def worker_watches(
    limits: Executive, planner: Planner, imaging: Imaging | None, wide: HorizonCameraTask | None
) -> list[WorkerWatch]:
    """Return the watch over each worker, with twice the timeout of the runner as its patience."""
    busy = [(PLANNER, planner.busy_since_ns, limits.planner_timeout)]
    if imaging is not None:
        busy.append((imaging_task.WORKER, imaging.busy_since_ns, limits.vision_timeout))
    if wide is not None:
        busy.append((horizon_task.WORKER, wide.busy_since_ns, limits.vision_timeout))
    return [WorkerWatch(name, since, round(2.0 * limit * SECOND_NS)) for name, since, limit in busy]


@dataclass(frozen=True, slots=True)
class Opened:
    """The open devices, workers and logs of a flight.

    Attributes:
        log_error: returns why the flight log fails, empty while it works.
        channels: sources of commands.
        feed: feeds the watchdog, called about four times a second.
        frames: folder of the frames that are kept.
    """

    clock: Clock
    devices: Devices
    jobs: JobRunner
    recorder: Recorder
    log_error: Callable[[], str]
    channels: Sequence[Channel] = ()
    feed: Callable[[], None] = nothing
    frames: Path | None = None


def build_loop(config: Config, opened: Opened, supervisors: Supervisors) -> FlightLoop:
    """Return the loop of a configuration. Raises ConfigError for an unknown body."""
    events = EventLog(opened.recorder.event)
    services = Services(
        opened.clock, opened.jobs, opened.recorder, events, Facts(events), Streams(streams_of(config))
    )
    keeper = supervisors.keeper
    learned: Mapping[str, Learned] = keeper.learned if keeper else {}
    body = body_kind(config).make(config, services, learned)
    loop: FlightLoop

    def stop(reason: str) -> None:
        loop.stop(reason)

    tasks = _tasks(config, opened, services, body, keeper, stop)
    loop = FlightLoop(config, body, tasks, services, supervisors)
    return loop


def _tasks(
    config: Config,
    opened: Opened,
    services: Services,
    body: FlightBody,
    keeper: StateKeeper | None,
    stop: Callable[[str], None],
) -> LoopTasks:
    devices, timeline = opened.devices, config.commands.timeline
    navigation = Navigation(devices.unit, body.estimation, navigation_settings(config), services)
    drive = _drive(config, devices, body, services)
    steering = Steering(body, drive, services)
    imaging = _imaging(config, opened, navigation, body, services)
    wide = _wide(config, devices, body, services)
    low_rate, low_for = config.detumble.low_rate, config.detumble.low_for
    modes = ModeControl(ModeSettings(config.modes, low_rate, low_for, stop), body, steering, services)
    observer = PerformanceObserver(devices.coils, services)
    watches = worker_watches(config.executive, body.control.planner, imaging, wide)
    health = HealthWatch(
        HealthInputs(modes, drive, devices.power, watches), config.health, opened.feed, services
    )
    watched = HousekeepingInputs(
        navigation, body.control.planner, imaging, devices.coils, devices.power, opened.log_error
    )
    commanded = bool(opened.channels or timeline)
    parameters = ParameterTable(
        config, ParameterUsers((modes.adopt, drive.adopt), health.adopt), keeper, services
    )
    obeying = CommandedTasks(modes, drive, parameters)
    commanding = CommandTask(obeying, timeline, opened.channels, services) if commanded else None
    positioning = _positioning(config, devices, body, services)
    sun, house = _sun(config, devices, body, services), Housekeeping(watched, services)
    return LoopTasks(
        navigation,
        imaging,
        positioning,
        sun,
        wide,
        modes,
        steering,
        drive,
        observer,
        health,
        house,
        commanding,
    )


def _drive(config: Config, devices: Devices, body: FlightBody, services: Services) -> CoilDrive:
    limits = np.full(3, config.coils.current_limit)
    settings = CoilDriveSettings(body.control.dipole_per_ampere, limits, body.control.free_axis)
    return CoilDrive(devices.coils, devices.power, body.estimation.coil_monitor, settings, services)


def _positioning(
    config: Config, devices: Devices, body: FlightBody, services: Services
) -> Positioning | None:
    if config.gps is None or devices.gps is None:
        return None
    return Positioning(
        devices.gps, body.estimation.accept_fix, round(config.gps.max_age * SECOND_NS), services
    )


def _sun(config: Config, devices: Devices, body: FlightBody, services: Services) -> SunSensing | None:
    if config.solar_strings is None or devices.strings is None:
        return None
    return SunSensing(
        devices.strings, body.estimation.accept_sun, round(config.solar_strings.max_age * SECOND_NS), services
    )


def _wide(config: Config, devices: Devices, body: FlightBody, services: Services) -> HorizonCameraTask | None:
    if not config.wide_cameras or not devices.wide or body.estimation.wide is None:
        return None
    return HorizonCameraTask(
        devices.wide, body.estimation.wide, horizon_camera_settings(config.wide_cameras), services
    )


def _imaging(
    config: Config, opened: Opened, navigation: Navigation, body: FlightBody, services: Services
) -> Imaging | None:
    camera, source = config.camera, opened.devices.camera
    if camera is None or source is None:
        return None
    settings = imaging_settings(camera, body, opened.frames)
    section = camera.objects
    objects = None if section is None else ObjectTracks(track_settings(section), body, services)
    return Imaging(source, settings, navigation, body.view, services, objects)
