"""Builds body, settings, workers and tasks of the loop from the configuration."""

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
from flight.loop.body import PLANNER, BodyKind, FlightBody
from flight.loop.commanding import CommandTask, OnboardParameters
from flight.loop.control_cycle import LoopTasks
from flight.loop.executive import JobRunner, Worker
from flight.loop.facts import EventLog, Facts, Services, Streams, streams_of
from flight.loop.flight_loop import FlightLoop, Supervisors, nothing
from flight.loop.health import (
    HealthWatch,
    Housekeeping,
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
from flight.schema.document import ConfigError
from flight.schema.sections import CONTROL_RATE_HZ, Config
from hal.interfaces.wires import SECOND_NS, Clock
from knightcube.gnc.tracker import TrackSettings
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
    """Return the kind of body that the configuration names. Raises ConfigError."""
    place = BODIES.get(config.body, config.body)
    module, colon, name = place.partition(":")
    if not (module and colon and name):
        known = ", ".join(BODIES)
        raise ConfigError("body", f"is {config.body!r}: name one of {known}, or `module:object`")
    try:
        kind = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise ConfigError("body", f"is {config.body!r}, which cannot be loaded: {error}") from error
    if not isinstance(kind, BodyKind):
        raise ConfigError("body", f"is {config.body!r}: this object is not a BodyKind of flight.loop.body")
    return kind


def imaging_settings(camera: Camera, body: FlightBody, frames: Path | None) -> ImagingSettings:
    """Return the settings of imaging. Frames are stored in the folder `frames`."""
    model, (least, most) = camera_model(camera), camera.streak_exposure or (camera.exposure, camera.exposure)
    kept = KeptFrames(frames, camera.keep_frames) if frames is not None and camera.keep_frames else None
    return ImagingSettings(
        camera=model,
        exposures=Exposures(camera.exposure, least, most, model.focal_length),
        # The difference allows for a trigger that comes late while the next trigger is on time.
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
    """Return the times of the horizon cameras; all cameras use those of the most frequent camera."""
    fine_ns = round(min(camera.fine_period for camera in cameras) * SECOND_NS)
    period_ns = min(round(min(camera.period for camera in cameras) * SECOND_NS), fine_ns)
    return HorizonCameraSettings(
        [round(camera.exposure * SECOND_NS) for camera in cameras],
        period_ns - SECOND_NS // 2,  # the task runs once a second, possibly late
        fine_ns - SECOND_NS // 2,
        min(2 * SECOND_NS, period_ns),
        max(round(max(camera.max_age for camera in cameras) * SECOND_NS), 2 * fine_ns),
    )


def _tracker(camera: Camera) -> TrackerSettings | None:
    """Return the settings of the star tracker, or None without a star tracker."""
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
    # The camera is known: no mirror is in its light path, and its focal length is configured.
    identification = IdentificationSettings(mirror=False, hint_error=1.0)
    accuracy = camera.accuracy
    lens = CameraKnowledge(accuracy.focal_length, accuracy.centre, accuracy.distortion)
    solve = SolveSettings(detection=detection, identification=identification, velocity=velocity, lens=lens)
    return TrackerSettings(solve, scale, index)


def _saturation(camera: Camera) -> float:
    return camera.saturation or float(2**camera.bits - 1)


def _estimator(camera: Camera, body: FlightBody) -> LikelihoodSettings | StreakEstimator:
    """Return the estimator of rates from streaks that the camera section selects.

    Raises ConfigError if the body does not have the selected estimator.
    """
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


@dataclass(frozen=True, slots=True)
class Opened:
    """The open devices, workers and logs of a flight.

    Attributes:
        log_error: function that returns why the flight log fails, or an empty text while it works.
        channels: channels on which commands arrive.
        feed: function that triggers the watchdog, called about four times a second.
        frames: folder in which frames are stored.
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
    """Return the flight loop of a configuration. Raises ConfigError for an unknown body."""
    events = EventLog(opened.recorder.event)
    services = Services(
        opened.clock, opened.jobs, opened.recorder, events, Facts(events), Streams(streams_of(config))
    )
    learned: Mapping[str, Learned] = supervisors.keeper.learned if supervisors.keeper else {}
    body = body_kind(config).make(config, services, learned)
    loop: FlightLoop

    def stop(reason: str) -> None:
        loop.stop(reason)

    tasks = _tasks(config, opened, services, body, supervisors.keeper, stop)
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
    devices, planner = opened.devices, body.control.planner
    ages = NavigationSettings(
        round(config.inertial_unit.max_age * SECOND_NS),
        round(config.estimation.coast * SECOND_NS),
        round(SECOND_NS / CONTROL_RATE_HZ),
    )
    navigation = Navigation(devices.unit, body.estimation, ages, services)
    imaging = _imaging(config, opened, navigation, body, services)
    horizon_cameras = None
    if config.wide_cameras and devices.horizon_cameras and body.estimation.horizon_cameras is not None:
        times = horizon_camera_settings(config.wide_cameras)
        use = body.estimation.horizon_cameras
        horizon_cameras = HorizonCameraTask(devices.horizon_cameras, use, times, services)
    limits = np.full(3, config.coils.current_limit)
    coils = CoilDriveSettings(body.control.dipole_per_ampere, limits, body.control.free_axis)
    drive = CoilDrive(devices.coils, devices.power, body.estimation.coil_monitor, coils, services)
    steering = Steering(body, drive, services)
    low_rate, low_for = config.detumble.low_rate, config.detumble.low_for
    modes = ModeControl(ModeSettings(config.modes, low_rate, low_for, stop), body, steering, services)
    # A worker is considered stalled after twice the time limit at which the job runner kills it.
    busy = [(PLANNER, planner.busy_since_ns, config.executive.planner_timeout)]
    if imaging is not None:
        busy.append((imaging_task.WORKER, imaging.busy_since_ns, config.executive.vision_timeout))
    if horizon_cameras is not None:
        busy.append((horizon_task.WORKER, horizon_cameras.busy_since_ns, config.executive.vision_timeout))
    watches = [WorkerWatch(name, since, round(2.0 * limit * SECOND_NS)) for name, since, limit in busy]
    health = HealthWatch(modes, drive, devices.power, watches, config.health, opened.feed, services)
    housekeeping = Housekeeping(
        navigation, planner, imaging, devices.coils, devices.power, opened.log_error, services
    )
    commanding = None
    if opened.channels or config.commands.timeline:
        table = OnboardParameters(config, (modes.adopt, drive.adopt), health.adopt, keeper, services)
        commanding = CommandTask(modes, drive, table, config.commands.timeline, opened.channels, services)
    return LoopTasks(
        navigation=navigation,
        imaging=imaging,
        positioning=_positioning(config, devices, body, services),
        sun=_sun(config, devices, body, services),
        horizon_cameras=horizon_cameras,
        modes=modes,
        steering=steering,
        drive=drive,
        observer=PerformanceObserver(devices.coils, services),
        health=health,
        housekeeping=housekeeping,
        commanding=commanding,
    )


def _positioning(
    config: Config, devices: Devices, body: FlightBody, services: Services
) -> Positioning | None:
    if config.gps is None or devices.gps is None:
        return None
    max_age_ns = round(config.gps.max_age * SECOND_NS)
    return Positioning(devices.gps, body.estimation.accept_fix, max_age_ns, services)


def _sun(config: Config, devices: Devices, body: FlightBody, services: Services) -> SunSensing | None:
    if config.solar_strings is None or devices.strings is None:
        return None
    max_age_ns = round(config.solar_strings.max_age * SECOND_NS)
    return SunSensing(devices.strings, body.estimation.accept_sun, max_age_ns, services)


def _imaging(
    config: Config, opened: Opened, navigation: Navigation, body: FlightBody, services: Services
) -> Imaging | None:
    camera, source = config.camera, opened.devices.camera
    if camera is None or source is None:
        return None
    objects, section = None, camera.objects
    if section is not None:
        tracks = TrackSettings(needed=section.needed, within=section.within, coast=section.coast)
        objects = ObjectTracks(tracks, body, services)
    settings = imaging_settings(camera, body, opened.frames)
    return Imaging(source, settings, navigation, body.view, services, objects)
