"""The rooms of the loop, each built from the configuration and told only of those rooms that it needs.

Data goes through them in the order in which they are built: from navigation by guidance and steering to the
coils' drive; modes, commanding and housekeeping look on and say what is wanted.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from flight.app.composition import settings
from flight.bodies.testbed.controllers import controller_of
from flight.bodies.testbed.planning import Planning, Strategy
from flight.bodies.testbed.plant_model import plant_of, unrest_of
from flight.bodies.testbed.steering import Steering
from flight.bodies.testbed.targets import TargetSequence
from flight.gnc.estimation.attitude_filter import AttitudeFilter
from flight.gnc.guidance.one_axis.guidance import AcceptanceRules, Guidance
from flight.gnc.guidance.one_axis.plant import SingleAxisPlant
from flight.link.commands.channel import Channel
from flight.loop.coil_drive import CoilDrive
from flight.loop.commanding import Commanding
from flight.loop.control_cycle import ControlCycle, Rooms
from flight.loop.housekeeping import Housekeeping, Watched
from flight.loop.imaging import Imaging
from flight.loop.modes.control import ModeControl
from flight.loop.modes.machine import ModeMachine
from flight.loop.navigation import Navigation
from flight.loop.performance import PerformanceObserver
from flight.loop.services import Surroundings
from flight.schema.sections import Config


@dataclass(frozen=True, slots=True)
class LoopRooms:
    """The rooms; without a camera there is no imaging."""

    navigation: Navigation
    drive: CoilDrive
    steering: Steering
    planning: Planning
    imaging: Imaging | None
    modes: ModeControl
    observer: PerformanceObserver
    control: ControlCycle
    housekeeping: Housekeeping
    commanding: Commanding


def build_rooms(
    config: Config,
    around: Surroundings,
    channels: Sequence[Channel],
    log_error: Callable[[], str],
    stop: Callable[[str], None],
    filter_: AttitudeFilter,
) -> LoopRooms:
    """Build the rooms of a configuration about its filter.

    `channels` are where commands come from, `log_error` tells what is wrong with the flight log, and `stop`
    ends the flight after the running cycle, for the reason that it is given.
    """
    plant = plant_of(config)
    navigation = _navigation(config, plant, around, filter_)
    planning_settings = settings.planning_settings(config)
    guidance = Guidance(
        plant,
        AcceptanceRules(late_after=config.guidance.late_after),
        arrives=planning_settings.strategy is not Strategy.RECEDING,
    )
    drive = _drive(config, plant, around)
    steering = _steering(config, plant, around, guidance, navigation, drive)
    planning = Planning(plant, planning_settings, guidance, around.jobs, around.recorder, around.events)
    imaging = _imaging(config, plant, around, navigation)
    modes = ModeControl(
        config.modes,
        ModeMachine(),
        guidance,
        steering,
        drive,
        around.facts,
        around.recorder,
        around.events,
        (config.detumble.low_rate, config.detumble.low_for),
        stop,
    )
    around.events.react_by(modes.react)
    observer = PerformanceObserver(around.clock, around.devices.coils, around.recorder, around.events)
    control = ControlCycle(
        Rooms(navigation, modes, steering, planning, imaging, around.devices.coils, drive, around.jobs),
        TargetSequence([(step.at, step.q2, step.rate) for step in config.steps]),
        around.recorder,
        around.events,
        observer,
        around.streams,
    )
    coils, power = around.devices.coils, around.devices.power
    watched = Watched(navigation, steering, planning, imaging, coils, power, log_error)
    housekeeping = Housekeeping(watched, around.recorder, around.events, around.facts)
    timeline = config.commands.timeline
    commanding = Commanding(modes, around.facts, drive, timeline, channels, around.recorder, around.events)
    return LoopRooms(
        navigation, drive, steering, planning, imaging, modes, observer, control, housekeeping, commanding
    )


def _navigation(
    config: Config, plant: SingleAxisPlant, around: Surroundings, filter_: AttitudeFilter
) -> Navigation:
    return Navigation(
        around.devices.unit,
        filter_,
        settings.navigation_settings(config, plant),
        around.recorder,
        around.events,
        around.facts,
        around.streams,
    )


def _drive(config: Config, plant: SingleAxisPlant, around: Surroundings) -> CoilDrive:
    return CoilDrive(
        around.devices.coils,
        settings.coil_watch(config, plant),
        settings.dipole_per_ampere(config),
        np.full(3, config.coils.current_limit),
        around.facts,
        around.events,
        around.devices.power,
    )


def _steering(
    config: Config,
    plant: SingleAxisPlant,
    around: Surroundings,
    guidance: Guidance,
    navigation: Navigation,
    drive: CoilDrive,
) -> Steering:
    period = 1.0 / config.executive.control_rate_hz
    return Steering(
        guidance,
        controller_of(config.control, plant, period, config.identification),
        settings.detumbler(config, plant),
        navigation,
        around.devices.coils,
        drive,
        around.facts,
    )


def _imaging(
    config: Config, plant: SingleAxisPlant, around: Surroundings, navigation: Navigation
) -> Imaging | None:
    camera, source = config.camera, around.devices.camera
    if camera is None or source is None:
        return None
    return Imaging(
        source,
        settings.imaging_settings(camera, unrest_of(config, plant)),
        navigation,
        around.jobs,
        around.recorder,
        around.events,
        around.facts,
        around.streams,
    )
