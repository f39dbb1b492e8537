"""The life cycle of a flight, from the request to the result.

The coils are at zero when the function `fly` returns or raises an exception.

The function `open_flight` opens logs, guardian, devices, workers and channels, in this order. The function
`build_loop` builds body, settings and tasks of the loop from the configuration.
"""

from __future__ import annotations

import fcntl
import gc
import math
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from shutil import rmtree
from typing import IO, TYPE_CHECKING

import numpy as np

from flight.app.devices import (
    NO_INDEX,
    Devices,
    check_settings,
    injected_faults,
    linux_rig,
    open_devices,
    simulated_rig,
)
from flight.app.run import RunRequest, RunResult
from flight.app.service import (
    Chosen,
    EndingSignals,
    FlownConfig,
    FlownRelease,
    SeparationInhibit,
    StartRetry,
    accepted_config,
    renewal_note,
    requested_config,
    retried_start,
    start_guardian,
    supervise,
)
from flight.link import events
from flight.link.commands import Channel, open_udp, open_unix
from flight.link.telemetry.log import (
    DISK_TROUBLE,
    FlightLog,
    Recorder,
    begin_run,
    find_runs,
    open_segment,
)
from flight.loop import imaging as imaging_task
from flight.loop.body import PLANNER, BodyKind, FlightBody, Planner
from flight.loop.commanding import CommandTask, OnboardParameters
from flight.loop.executive import JobResult, JobRunner, LockStepRunner, ProcessRunner, Worker
from flight.loop.facts import EventLog, Facts, FlightClock, Services, Streams, streams_of
from flight.loop.flight_loop import FlightLoop, FlightProgress, LoopTasks, RunLabel, Supervisors, nothing
from flight.loop.health import (
    Board,
    BusyPeriods,
    HealthWatch,
    Housekeeping,
    OverloadSign,
    PerformanceObserver,
    Shedding,
    ShedLevel,
    WorkerWatch,
)
from flight.loop.imaging import Imaging, ImagingSettings, ObjectTracks
from flight.loop.modes import ModeControl
from flight.loop.navigation import (
    HORIZON_WORKER,
    HorizonCameraSettings,
    HorizonCameraTask,
    Navigation,
    NavigationSettings,
    Positioning,
    SunSensing,
)
from flight.loop.state import Learned, StateKeeper, open_state, service_folder, state_folder
from flight.loop.steering import CoilDrive, CoilDriveSettings, Steering
from flight.schema import reader as configuration
from flight.schema.devices import Camera, WideCamera, camera_model, likelihood_settings, stated_accuracy
from flight.schema.document import ConfigError, imported, read_text
from flight.schema.sections import CONTROL_RATE_HZ, Config
from hal.buses.system import SystemClock, worker_cores
from hal.interfaces.wires import SECOND_NS, Clock, Rig
from knightcube import compiled
from knightcube.errors import UsageError, reason_of
from knightcube.gnc.tracker import TrackSettings
from knightcube.vision import frame_job, horizon_camera_job
from knightcube.vision.camera import images
from knightcube.vision.camera.images import KeptFrames
from knightcube.vision.camera.lens import Exposures
from knightcube.vision.frame_job import StreakEstimator, TrackerSettings
from knightcube.vision.lens_knowledge import LensKnowledge
from knightcube.vision.objects.settings import ObjectMeasurementSettings
from knightcube.vision.startracker.index.build import ensure_default_index
from knightcube.vision.startracker.lost_in_space import IdentificationSettings
from knightcube.vision.startracker.solve import SolveSettings
from knightcube.vision.startracker.survey import DetectionSettings
from knightcube.vision.streaks.streak_result import LikelihoodSettings

if TYPE_CHECKING:
    from flight.loop.power import PowerTask


def open_flight(
    config: Config,
    rig: Rig,
    folder: Path,
    stack: ExitStack,
    *,
    patient: bool = False,
    earlier: Sequence[Path] = (),
) -> tuple[FlightLoop, FlightLog]:
    """Open logs, devices and workers. Return the loop, which is ready to run, and the flight log.

    The stack closes everything in the opposite order, with the coils at zero. A `patient` flight waits in
    BOOT for missing devices and for a disk that cannot be written; any other flight raises DeviceError for a
    missing device. The folders `earlier` of earlier runs serve to detect that the stored state is outdated.
    """
    if rig.realtime:
        compiled.use_numpy_forms()
    flight_log = _open_log(folder, "flight", rig, config, stack, patient)
    performance_log = _open_log(folder, "performance", rig, config, stack, patient)
    # The stored state is opened after the devices, so that a boot that waits for a device is not counted.
    # The outer exit stack closes the stored state after the devices.
    after_coils = stack.enter_context(ExitStack())
    guardian = start_guardian(rig, stack)
    devices = open_devices(config, rig, stack, patient)
    tracker = config.camera.star_tracker if config.camera is not None else None
    if tracker is not None and tracker.index is None:
        ensure_default_index()
    elif tracker is not None and not patient and not Path(tracker.index or "").is_file():
        raise ConfigError("camera.star_tracker.index", f"is {tracker.index!r}: {NO_INDEX}")
    jobs = _open_jobs(config, rig, stack, worker_cores() if patient else frozenset())
    recorder = Recorder(flight_log, performance_log)
    feed, beat = nothing, nothing
    if guardian is not None:
        guardian.wait_ready(patient=patient)
        supervision = supervise(guardian, rig.clock, recorder, stack)
        feed, beat = supervision.feed, supervision.beat
    channels = _open_channels(config, stack)
    clock = FlightClock(rig.clock)
    keeper = open_state(config, os.environ, clock, after_coils, [*earlier, folder])
    frames = folder / images.KEPT_FRAMES_FOLDER
    opened = Opened(clock, devices, jobs, recorder, flight_log.error, channels, feed, frames)
    board = Board(folder) if rig.realtime else None
    loop = build_loop(config, opened, Supervisors(beat, keeper, board))
    if not rig.realtime:
        _collect_rarely(stack)
    return loop, flight_log


_YOUNG_OBJECTS = 20_000
"""Number of new objects after which the garbage of a lock-step flight is collected."""


def _collect_rarely(stack: ExitStack) -> None:
    """Exempt all present objects from garbage collection, and collect garbage among new objects rarely.

    Reference counting frees nearly all objects of a flight. The stack restores the collector at the end.
    """
    gc.freeze()
    stack.callback(gc.unfreeze)
    stack.callback(gc.set_threshold, *gc.get_threshold())
    gc.set_threshold(_YOUNG_OBJECTS)


def _open_jobs(config: Config, rig: Rig, stack: ExitStack, cores: Set[int]) -> JobRunner:
    specs = workers(config, *rig.latency)
    made = specs if rig.host is None else rig.host.workers(specs)
    runner: JobRunner = (
        ProcessRunner(rig.clock, made, cores) if rig.realtime else LockStepRunner(rig.clock, made)
    )
    stack.callback(runner.close)
    return runner if rig.host is None else rig.host.jobs(runner, specs, JobResult)


def _open_channels(config: Config, stack: ExitStack) -> list[Channel]:
    """Open the configured command channels."""
    channels: list[Channel] = []
    if config.commands.socket is not None:
        channels.append(open_unix(Path(config.commands.socket)))
    if config.commands.udp is not None:
        channels.append(open_udp(config.commands.udp))
    for channel in channels:
        stack.callback(channel.close)
    return channels


_GRID_NS = 25_000_000


def next_whole_second(clock: Clock) -> int:
    """Return mission time zero in lock-step: the first whole second that is at least 0.5 s in the future."""
    return -(-(clock.now_ns() + SECOND_NS // 2) // SECOND_NS) * SECOND_NS


@dataclass(frozen=True, slots=True)
class _Judged:
    """A valid configuration, read from `chosen`; `merged` is `text` with the files that it extends."""

    request: RunRequest
    chosen: Chosen
    text: str
    merged: str
    config: Config


@dataclass(frozen=True, slots=True)
class _Opened:
    """A flight that is ready to begin."""

    judged: _Judged
    rig: Rig
    loop: FlightLoop
    log: FlightLog


def fly(request: RunRequest, progress: Callable[[FlightProgress], None] | None = None) -> RunResult:
    """Fly a configuration to its end.

    Raises UsageError if the flight cannot begin, and DeviceError for a device that fails. On a flight
    computer, the start is retried until it succeeds. Raises StoppedError if a signal ends these attempts.
    """
    with EndingSignals() as signals, ExitStack() as stack:
        opened = _start(request, signals, stack)
        loop, rig, judged = opened.loop, opened.rig, opened.judged
        if progress is not None:
            loop.watch(progress)
        release = FlownRelease(os.environ)
        if release.note:
            loop.note(events.RELEASE_LEFT, release.note)
        if note := renewal_note(os.environ):
            loop.note(events.RETURNED, note)
        if rig.realtime:
            release.serve(rig.clock, stack)
        simulated = judged.config.simulation is not None
        label = RunLabel(judged.merged, rig.seed, simulated, rig.realtime)
        epoch_ns = next_whole_second(rig.clock)
        if rig.realtime:  # the start of the third slot from now in the 40 Hz grid
            epoch_ns = (rig.clock.now_ns() // _GRID_NS + 3) * _GRID_NS
        rig.release(epoch_ns)
        signals.end(loop)
        reason = loop.run(epoch_ns, label)
        if not loop.restart:
            release.end()
        ending = loop.ending()
        late = None
        with suppress(OSError):  # the emulated devices ended before the flight ended
            late = rig.lateness() if rig.lateness is not None else None
    faults = injected_faults(judged.request, judged.text) if simulated else ()
    folder, error = judged.request.out, opened.log.error()
    return RunResult(folder, reason, signals.received, error, ending, loop.restart, faults, late)


def _start(request: RunRequest, signals: EndingSignals, stack: ExitStack) -> _Opened:
    """Return a flight that is ready to begin; `stack` closes it.

    A flight computer, which has an archive, waits for the end of the separation inhibit and retries.
    """
    judge = partial(_judge, request)
    if request.archive is None:
        return _open(judge(), stack)
    retry = StartRetry(lambda: signals.received)
    stack.callback(retry.close)
    inhibit = SeparationInhibit(SystemClock())

    def open_after_inhibit(judged: _Judged, stack: ExitStack) -> _Opened:
        inhibit.check(state_folder(judged.config, os.environ), judged.config.separation.inhibit)
        return _open(judged, stack)

    opened = retried_start(judge, open_after_inhibit, stack, retry)
    if summary := retry.summary():
        opened.loop.note(events.START_WAITED, summary)
    return opened


def _judge(request: RunRequest) -> _Judged:
    """Read the configuration once, and validate it.

    Raises UnreadConfigError if it cannot be read, and UsageError if it or the request is invalid.
    """
    path = request.config_path
    chosen = accepted_config(path, os.environ) if request.accepted else Chosen(path, read_text(path))
    request = replace(request, config_path=chosen.path)
    text, config = requested_config(request, chosen.text)
    with placing(text, str(chosen.path)):
        check_settings(config)
    return _Judged(request, chosen, text, configuration.merged_text(text, str(chosen.path)), config)


def _open(judged: _Judged, stack: ExitStack) -> _Opened:
    """Open a flight. A run folder that did not exist before is removed if the opening fails."""
    chosen, text, config = judged.chosen, judged.text, judged.config
    stack.enter_context(placing(text, str(chosen.path)))
    new = judged.request.archive is not None or not judged.request.out.exists()
    request, earlier = _begin_folder(judged.request, judged.merged, config, stack, new)
    unflown = stack.enter_context(ExitStack())
    if new:
        unflown.callback(rmtree, request.out, ignore_errors=True)
    rig = _open_rig(request, text, config, stack)
    patient = request.archive is not None
    loop, log = open_flight(config, rig, request.out, stack, patient=patient, earlier=earlier)
    if chosen.problem:
        sys.stderr.write(f"knightcube: {chosen.problem}\n")
        loop.note(events.CONFIG_DAMAGED, chosen.problem)
    elif chosen.accepted and rig.realtime and (folder := service_folder(os.environ)) is not None:
        stack.callback(FlownConfig(judged.merged, folder).serve(rig.clock).stop)
    unflown.pop_all()
    return _Opened(replace(judged, request=request), rig, loop, log)


@contextmanager
def placing(text: str, name: str) -> Iterator[None]:
    """Add file and line to configuration errors."""
    try:
        yield
    except UsageError as error:
        raise configuration.placed(error, text, name) from error


def _open_rig(request: RunRequest, text: str, config: Config, stack: ExitStack) -> Rig:
    """Return the real or simulated hardware of a configuration."""
    if config.simulation is not None:
        return simulated_rig(request, text, config, stack)
    if request.seed is not None:
        raise UsageError("--seed: this configuration has real devices, whose noise has no seed")
    if request.devices is not None:
        raise UsageError("--devices: this configuration has real devices, not simulated devices")
    return linux_rig(config, stack, request.archive is not None)


BODIES = {"testbed": "flight.bodies.testbed.body:TESTBED", "orbit": "flight.bodies.orbit.body:ORBIT"}


def body_kind(config: Config) -> BodyKind:
    """Return the kind of body that the configuration selects. Raises ConfigError for any other object."""
    kind = imported("body", config.body, BODIES, os.environ)
    if not isinstance(kind, BodyKind):
        raise ConfigError("body", f"is {config.body!r}: this object is not a BodyKind of flight.loop.body")
    return kind


def lens_knowledge(
    config: Config, learned: Mapping[str, Learned], problems: list[str]
) -> LensKnowledge | None:
    """Return the star tracker's initial lens parameters, or None if the lens parameters are not estimated.

    The lens parameters `learned` at earlier boots are used unless they contradict the configuration; a
    contradiction is added to `problems`.
    """
    camera = config.camera
    if camera is None or camera.star_tracker is None or not camera.learn_lens:
        return None
    accuracy, scale_error = camera.accuracy, camera.star_tracker.scale_error
    line_time_unknown = accuracy.line_time is None and camera.line_time is None
    stated = (accuracy.focal_length, accuracy.centre, accuracy.distortion, accuracy.line_time, scale_error)
    if not any(stated) and not line_time_unknown:
        return None  # the camera is exact
    known = LensKnowledge.of(
        camera_model(camera),
        stated_accuracy(camera),
        scale_error=scale_error,
        line_time=camera.line_time,
        psf_sigma=camera.psf_sigma,
    )
    if imaging_task.LENS not in learned:
        return known
    values, covariance = learned[imaging_task.LENS].arrays()
    restored = known.restored(values, covariance, config.estimation.changed)
    if restored is None:
        problems.append(f"{imaging_task.LENS} {values.tolist()}: not within 5 sigma of the configuration")
    return restored or known


def imaging_settings(
    camera: Camera, body: FlightBody, frames: Path | None, lens: LensKnowledge | None = None
) -> ImagingSettings:
    """Return the settings of imaging. Frames are stored in the folder `frames`."""
    model, (least, most) = camera_model(camera), camera.streak_exposure or (camera.exposure, camera.exposure)
    kept = KeptFrames(frames, camera.keep_frames) if frames is not None and camera.keep_frames else None
    return ImagingSettings(
        camera=model,
        exposures=Exposures(camera.exposure, least, most, model.focal_length),
        # Half a period is subtracted, so that the trigger after a late trigger is not skipped.
        fine_rest_ns=round(((camera.fine_period or camera.period) - 0.5 * camera.period) * SECOND_NS),
        max_age_ns=round(camera.max_age * SECOND_NS),
        late_ns=round(camera.late_after * SECOND_NS),
        slow_ns=round(camera.vision_slow_after * SECOND_NS),
        max_rate=math.inf if camera.max_rate is None else camera.max_rate,
        mounting=np.array(camera.mounting),
        estimator=_estimator(camera, body),
        tracker=_tracker(camera),
        detection=_detection(camera),
        angular_acceleration_psd=body.estimation.angular_acceleration_psd,
        velocity=body.estimation.velocity,
        objects=None
        if camera.objects is None
        else ObjectMeasurementSettings(faintest=camera.objects.faintest),
        knowledge=body.estimation.knowledge,
        seeks=body.control.follows_objects,
        calm=body.control.exposure_start,
        kept=kept,
        lens=lens,
        # Under overload, enough frames are still taken to measure the attitude.
        most_every=int(camera.max_age // max(camera.period, camera.fine_period or 0.0)),
    )


def horizon_camera_settings(cameras: Sequence[WideCamera]) -> HorizonCameraSettings:
    """Return the timing of the horizon cameras; all cameras use the shortest configured periods."""
    fine_ns = round(min(camera.fine_period for camera in cameras) * SECOND_NS)
    period_ns = min(round(min(camera.period for camera in cameras) * SECOND_NS), fine_ns)
    margin_ns = min(SECOND_NS // 2, period_ns // 10)  # margin for a late start of the task
    return HorizonCameraSettings(
        [round(camera.exposure * SECOND_NS) for camera in cameras],
        period_ns - margin_ns,
        fine_ns - margin_ns,
        min(2 * SECOND_NS, period_ns),
        max(round(max(camera.max_age for camera in cameras) * SECOND_NS), 2 * fine_ns),
    )


def _detection(camera: Camera) -> DetectionSettings:
    return DetectionSettings(psf_sigma=camera.psf_sigma, gain=camera.gain, saturation=_saturation(camera))


def _tracker(camera: Camera) -> TrackerSettings | None:
    """Return the settings of the star tracker, or None if no star tracker is configured."""
    section = camera.star_tracker
    if section is None:
        return None
    detection = _detection(camera)
    spread = 1.0 + section.scale_error
    scale = (1.0 / spread, spread)
    index = Path(section.index) if section.index is not None else None
    velocity = None if section.velocity is None else np.array(section.velocity)
    # Images of a flight camera are not mirrored, and the focal length is configured.
    identification = IdentificationSettings(mirror=False, hint_error=1.0)
    solve = SolveSettings(
        detection=detection, identification=identification, velocity=velocity, lens=stated_accuracy(camera)
    )
    return TrackerSettings(solve, scale, index)


def _saturation(camera: Camera) -> float:
    return camera.saturation or float(2**camera.bits - 1)


def _estimator(camera: Camera, body: FlightBody) -> LikelihoodSettings | StreakEstimator:
    """Return the configured estimator of rates from streaks. Raises ConfigError if the body has none."""
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
        made.append(Worker(HORIZON_WORKER, horizon_camera_job.run, vision_latency_ns, vision_timeout_ns))
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

    clock: FlightClock
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
        config.inertial_unit.has_gyro(),
    )
    navigation = Navigation(devices.unit, body.estimation, ages, services, devices.magnetometer)
    learned = keeper.learned if keeper else {}
    imaging = _imaging(config, opened, navigation, body, services, learned)
    horizon_cameras = None
    if config.wide_cameras and devices.horizon_cameras and body.estimation.horizon_cameras is not None:
        times = horizon_camera_settings(config.wide_cameras)
        use = body.estimation.horizon_cameras
        horizon_cameras = HorizonCameraTask(devices.horizon_cameras, use, times, services)
    limits, resistance = np.array(config.coils.limits), np.array(config.coils.resistance)
    coils = CoilDriveSettings(body.control.dipoles, limits, body.control.free_axis, resistance)
    drive = CoilDrive(devices.coils, devices.power, body.estimation.coil_monitor, coils, services)
    steering = Steering(body, drive, services)
    modes = ModeControl(config.modes, config.detumble, stop, body, steering, services)
    # A worker is considered stalled after twice the time limit at which the job runner kills it.
    busy = [(PLANNER, planner.busy_since_ns, config.executive.planner_timeout)]
    if imaging is not None:
        busy.append((imaging_task.WORKER, imaging.busy_since_ns, config.executive.vision_timeout))
    if horizon_cameras is not None:
        busy.append((HORIZON_WORKER, horizon_cameras.busy_since_ns, config.executive.vision_timeout))
    watches = [WorkerWatch(name, since, round(2.0 * limit * SECOND_NS)) for name, since, limit in busy]
    health = HealthWatch(modes, drive, devices.power, watches, config.health, opened.feed, services)
    housekeeping = Housekeeping(
        navigation, planner, imaging, devices.coils, devices.power, opened.log_error, services
    )
    commanding = None
    if opened.channels or config.commands.timeline:
        table = OnboardParameters(config, (modes.adopt, drive.adopt), health.adopt, keeper, services)
        commanding = CommandTask(modes, drive, table, config.commands.timeline, opened.channels, services)
    observer = PerformanceObserver(devices.coils, services)
    return LoopTasks(
        navigation=navigation,
        imaging=imaging,
        positioning=_positioning(config, devices, body, services),
        sun=_sun(config, devices, body, services),
        horizon_cameras=horizon_cameras,
        modes=modes,
        steering=steering,
        drive=drive,
        observer=observer,
        health=health,
        housekeeping=housekeeping,
        commanding=commanding,
        power=_power(config, devices, drive, imaging, services),
        shedding=_shedding(config, planner, navigation, imaging, observer, services),
    )


def _shedding(
    config: Config,
    planner: Planner,
    navigation: Navigation,
    imaging: Imaging | None,
    observer: PerformanceObserver,
    services: Services,
) -> Shedding:
    """Return the task that reduces less important work under overload."""
    limit = min(max(config.replan_period() or 0.0, 1.0), 0.5 * config.executive.planner_timeout)
    plans = BusyPeriods(planner.busy_since_ns, round(limit * SECOND_NS))
    signs = [
        OverloadSign("control cycles are lost", lambda: observer.lost, 3),
        OverloadSign(f"plans take longer than {limit:g} s", lambda: plans.count, 1),
    ]

    def apply(level: ShedLevel) -> None:
        navigation.thin(not level.every_reading)
        if imaging is not None:
            imaging.reduce(level.search, level.frame_every)

    if imaging is None:
        return Shedding(signs, plans, apply, lambda: (0, 0), services)
    signs.append(OverloadSign("frames are processed too late", lambda: imaging.workload()[1], 2))
    return Shedding(signs, plans, apply, imaging.workload, services)


def _power(
    config: Config, devices: Devices, drive: CoilDrive, imaging: Imaging | None, services: Services
) -> PowerTask | None:
    if config.power is None:
        return None
    from flight.loop.power import PowerTask, Sheddable  # noqa: PLC0415 - only with a power system

    loads = Sheddable(drive.limit, imaging.rest if imaging is not None else lambda _: None)
    return PowerTask(config.power, devices.supply, loads, services)


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
    config: Config,
    opened: Opened,
    navigation: Navigation,
    body: FlightBody,
    services: Services,
    learned: Mapping[str, Learned],
) -> Imaging | None:
    camera, source = config.camera, opened.devices.camera
    if camera is None or source is None:
        return None
    objects, section = None, camera.objects
    if section is not None:
        tracks = TrackSettings(needed=section.needed, within=section.within, coast=section.coast)
        objects = ObjectTracks(tracks, body, services)
    lens = lens_knowledge(config, learned, body.estimation.learned_problems)
    settings = imaging_settings(camera, body, opened.frames, lens)
    return Imaging(source, settings, navigation, body.view, services, objects)


_NEWEST = 4
"""Number of newest runs whose folders are searched for the number of the last boot."""


def _begin_folder(
    request: RunRequest, text: str, config: Config, stack: ExitStack, new: bool
) -> tuple[RunRequest, list[Path]]:
    """Create the folder of the run: `request.out`, or the next run folder of the archive if one is given.

    Return the request with this folder as `out`, and the folders of the newest earlier runs.

    Raises UsageError for a folder that already contains a run, is used by another flight or cannot be
    written. A folder that cannot be written is removed if it is `new`. A flight computer with an archive
    flies despite disk errors, and its logs wait until the disk works.
    """
    earlier: list[Path] = []
    if request.archive is not None:
        earlier = find_runs(request.archive)[-_NEWEST:]
        logs_bytes = (2 if config.simulation is None else 3) * config.telemetry.budget_bytes
        run = begin_run(request.archive, config.telemetry.archive_bytes, logs_bytes)
        request = replace(request, out=run.folder)
    out = request.out
    try:
        if any(out.glob("*.ccsds")):
            raise UsageError(f"{out} already contains a run: give another folder, or remove this one")
        out.mkdir(parents=True, exist_ok=True)
        file = stack.enter_context((out / "config.yaml").open("a", encoding="utf-8"))
        _lock(out, file)
        file.truncate(0)
        file.write(text)
        file.flush()
    except OSError as error:
        if request.archive is not None and error.errno in DISK_TROUBLE:
            return request, earlier
        if new:
            rmtree(out, ignore_errors=True)
        raise UsageError(f"{out}: cannot be written: {reason_of(error)}") from error
    return request, earlier


def _lock(out: Path, file: IO[str]) -> None:
    """Lock the folder of a run by its open file `config.yaml`. Raises UsageError for a folder in use."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise UsageError(f"{out}: another flight uses this folder: give another folder") from error
    except OSError:  # a file system without locks
        return
    if any(out.glob("*.ccsds")):  # a flight that ended since the folder was searched
        raise UsageError(f"{out} already contains a run: give another folder, or remove this one")


def _open_log(
    folder: Path, stem: str, rig: Rig, config: Config, stack: ExitStack, patient: bool
) -> FlightLog:
    """Open a log of the run, which is synchronised to disk once a second in real time."""
    log = FlightLog(
        folder,
        stem,
        clock=rig.clock,
        segment_bytes=config.telemetry.segment_bytes,
        budget_bytes=config.telemetry.budget_bytes,
        sync_period_ns=SECOND_NS if rig.realtime else None,
        patient=patient,
        opener=open_segment if rig.host is None else rig.host.opener(open_segment),
    )
    stack.callback(log.close)
    return log
