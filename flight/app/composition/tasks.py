"""Builds the tasks of the loop from the configuration, in the order of the data flow."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flight.app.composition.bodies import body_kind
from flight.app.composition.settings import (
    imaging_settings,
    navigation_settings,
    track_settings,
    wide_settings,
)
from flight.app.composition.workers import worker_watches
from flight.link.commands.channel import Channel
from flight.link.telemetry.recorder import Recorder
from flight.loop.body import Body
from flight.loop.executive.jobs import JobRunner
from flight.loop.fdir.event_log import EventLog
from flight.loop.fdir.facts import Facts
from flight.loop.fdir.streams import Streams, streams_of
from flight.loop.flight_loop import FlightLoop, LoopTasks, Supervisors, nothing
from flight.loop.services import Devices, Services
from flight.loop.state.content import Learned
from flight.loop.state.keeper import StateKeeper
from flight.loop.tasks.coil_drive import CoilDrive, CoilDriveSettings
from flight.loop.tasks.commanding import Commanding, Obeying
from flight.loop.tasks.control_cycle import ControlCycle, CycleTasks
from flight.loop.tasks.health_watch import HealthInputs, HealthWatch
from flight.loop.tasks.housekeeping import Housekeeping, Watched
from flight.loop.tasks.imaging import Imaging
from flight.loop.tasks.mode_control import ModeControl, ModeSettings
from flight.loop.tasks.navigation import Navigation
from flight.loop.tasks.object_tracking import ObjectTracking
from flight.loop.tasks.parameters import Adopters, Parameters
from flight.loop.tasks.performance import PerformanceObserver
from flight.loop.tasks.positioning import Positioning
from flight.loop.tasks.steering import Steering
from flight.loop.tasks.sun_sensing import SunSensing
from flight.loop.tasks.wide_imaging import WideImaging
from flight.schema.sections import Config
from hal.interfaces.wires import SECOND_NS, Clock


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
    body: Body,
    keeper: StateKeeper | None,
    stop: Callable[[str], None],
) -> LoopTasks:
    devices, timeline = opened.devices, config.commands.timeline
    navigation = Navigation(devices.unit, body, navigation_settings(config), services)
    drive = _drive(config, devices, body, services)
    steering = Steering(body, drive, services)
    imaging = _imaging(config, opened, navigation, body, services)
    wide = _wide(config, devices, body, services)
    low_rate, low_for = config.detumble.low_rate, config.detumble.low_for
    modes = ModeControl(ModeSettings(config.modes, low_rate, low_for, stop), body, steering, services)
    observer = PerformanceObserver(devices.coils, services)
    control = ControlCycle(
        CycleTasks(navigation, modes, steering, drive, imaging, wide), body, observer, services
    )
    watches = worker_watches(config.executive, body.planner, imaging, wide)
    health = HealthWatch(
        HealthInputs(modes, drive, devices.power, watches), config.health, opened.feed, services
    )
    watched = Watched(navigation, body.planner, imaging, devices.coils, devices.power, opened.log_error)
    commanded = bool(opened.channels or timeline)
    parameters = Parameters(config, Adopters((modes.adopt, drive.adopt), health.adopt), keeper, services)
    obeying = Obeying(modes, drive, parameters)
    commanding = Commanding(obeying, timeline, opened.channels, services) if commanded else None
    positioning = _positioning(config, devices, body, services)
    sun, house = _sun(config, devices, body, services), Housekeeping(watched, services)
    return LoopTasks(
        navigation, imaging, positioning, sun, wide, modes, control, observer, health, house, commanding
    )


def _drive(config: Config, devices: Devices, body: Body, services: Services) -> CoilDrive:
    limits = np.full(3, config.coils.current_limit)
    settings = CoilDriveSettings(body.dipole_per_ampere, limits, body.free_axis)
    return CoilDrive(devices.coils, devices.power, body.coil_watch, settings, services)


def _positioning(config: Config, devices: Devices, body: Body, services: Services) -> Positioning | None:
    if config.gps is None or devices.gps is None:
        return None
    return Positioning(devices.gps, body.fix, round(config.gps.max_age * SECOND_NS), services)


def _sun(config: Config, devices: Devices, body: Body, services: Services) -> SunSensing | None:
    if config.solar_strings is None or devices.strings is None:
        return None
    return SunSensing(devices.strings, body.sun, round(config.solar_strings.max_age * SECOND_NS), services)


def _wide(config: Config, devices: Devices, body: Body, services: Services) -> WideImaging | None:
    if not config.wide_cameras or not devices.wide or body.wide is None:
        return None
    return WideImaging(devices.wide, body.wide, wide_settings(config.wide_cameras), services)


def _imaging(
    config: Config, opened: Opened, navigation: Navigation, body: Body, services: Services
) -> Imaging | None:
    camera, source = config.camera, opened.devices.camera
    if camera is None or source is None:
        return None
    settings = imaging_settings(camera, body, opened.frames)
    section = camera.objects
    objects = None if section is None else ObjectTracking(track_settings(section), body, services)
    return Imaging(source, settings, navigation, body.view, services, objects)
