"""A satellite in orbit with three coils. `ORBIT` builds it from the configuration.

It detumbles by magnetometer and gyro, acquires its attitude with its coils at rest, and points.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from flight.bodies.orbit.coarse_attitude import CoarseSunFeed, wide_feed_of
from flight.bodies.orbit.control import FieldBrake, PointingTracker, SunAcquisitionBrake, expected_field
from flight.bodies.orbit.environment import OrbitEnvironment
from flight.bodies.orbit.filter import OrbitFeed, OrbitFilter, learned_of, start_from
from flight.bodies.orbit.filter_steps import OrbitFilterSettings
from flight.bodies.orbit.guidance import (
    ObjectAim,
    PlannedCraft,
    PointingPaths,
    PointingPlanner,
    PointingTargets,
    Sensor,
)
from flight.bodies.orbit.view import OrbitView
from flight.bodies.streak_methods import streak_estimator
from flight.link.modes import Mode
from flight.loop.body import Body, BodyControl, BodyEstimation, BodyKind
from flight.loop.fdir.coil_response import ResponseSettings
from flight.loop.fdir.coil_watch import CoilWatch, CoilWatchSettings
from flight.loop.services import Services
from flight.loop.state.content import Learned
from flight.schema.camera_model import camera_model
from flight.schema.errors import ConfigError
from flight.schema.orbit import OrbitConfig, as_orbit
from flight.schema.orbit_devices import SolarStrings as StringsSection
from flight.schema.sections import Config
from hal.interfaces.devices import GpsReading, StringReading
from hal.interfaces.wires import SECOND_NS
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.orbit_knowledge import OrbitState, TwoLineElements
from knightcube.astro.quaternion import attitude_matrix
from knightcube.errors import UsageError
from knightcube.gnc.control.detumble import WindowSchedule
from knightcube.gnc.control.three_axes import pointing_job
from knightcube.gnc.control.three_axes.field_detumbler import FieldDetumbler, FieldDetumblerSettings
from knightcube.gnc.control.three_axes.pointing_job import SlewRequest
from knightcube.gnc.control.three_axes.pointing_table import PointingWeights
from knightcube.gnc.control.three_axes.sun_acquisition import SunAcquisition, SunAcquisitionSettings
from knightcube.gnc.estimation.estimate import Estimate, Knowledge
from knightcube.gnc.estimation.field_rate import FieldRateSettings
from knightcube.gnc.estimation.free_filter import FreeFilterSettings
from knightcube.gnc.guidance.three_axes.attitude_law import BodyAxes
from knightcube.gnc.guidance.three_axes.pointing_target import PointingTarget
from knightcube.gnc.tracking.tracker import Track
from knightcube.vision.solar_cells import SolarStringModel

_BELOW = 0.8
"""Largest rate of a path, as a fraction of the rate at which the body is detumbled; the rest is a margin."""


class SatelliteEstimation(BodyEstimation):
    """The estimate of the satellite, and its orbit."""

    def __init__(self, config: OrbitConfig, services: Services, learned: Mapping[str, Learned]) -> None:
        """Start from the states that an earlier boot learned."""
        self.environment = OrbitEnvironment(_elements(config), services.clock)
        self._services = services
        self.orbit_filter, self.learned_problems = _filter(config, self.environment, learned, _utc(services))
        self.filter = self.orbit_filter
        self.feed = OrbitFeed(self.orbit_filter)
        self.coil_watch = _coil_watch(config)
        self._sun = _sun(config, self.orbit_filter, self.environment)
        self.sun_acquisition = _seeker(config, services)
        if config.wide_cameras:
            self.wide = wide_feed_of(config.wide_cameras, self.orbit_filter, self.environment, self._sun)

    def field(self, estimate: Estimate) -> FloatArray:
        """Return the expected field (3,) T in body axes; zero while the orbit is not known."""
        around = self.environment.at(estimate.time_ns)
        return np.zeros(3) if around is None else attitude_matrix(estimate.quaternion) @ around.field

    def angular_acceleration_psd(self, time_ns: int) -> FloatArray:
        """Return the density (3, 3) rad^2/s^3 of the acceleration's noise then."""
        return self.orbit_filter.acceleration_psd(time_ns)

    def learned(self, estimate: Estimate) -> Mapping[str, Learned]:
        """Return the slow states, with the time to which they refer."""
        return learned_of(self.orbit_filter.slow, _utc(self._services))

    def knowledge(self) -> Knowledge:
        """Return how well the attitude is known."""
        return self.orbit_filter.knowledge

    def orbit(self, time_ns: int) -> OrbitState | None:
        """Return position and velocity, ICRS; None while no orbit is known."""
        return self.environment.state(time_ns)

    def velocity(self, time_ns: int) -> FloatArray | None:
        """Return the velocity (3,) m/s about the Sun, ICRS; None while no orbit is known."""
        return self.environment.velocity(time_ns)

    def accept_fix(self, reading: GpsReading) -> bool:
        """Accept an epoch of the receiver; return whether it is used."""
        return self.environment.fix(reading)

    def accept_sun(self, reading: StringReading) -> str | None:
        """Pass a reading of the solar cells to the estimate, and to the Sun acquisition of SAFE."""
        if self._sun is None or self.sun_acquisition is None:
            return None
        self.sun_acquisition.see(reading)
        return self._sun.accept(reading)


class SatelliteControl(BodyControl):
    """Guidance and control of the satellite."""

    def __init__(self, config: OrbitConfig, estimation: SatelliteEstimation, services: Services) -> None:
        environment, filter_ = estimation.environment, estimation.orbit_filter
        limit = _limit(config)
        self._objects = ObjectAim(_sensor(config), limit, services.events)
        self._pauses = _pauses(config)
        paths = PointingPaths(limit, fastest_rate(config))
        disturbed = _disturbed(filter_)
        self.modes = frozenset(Mode) - {Mode.HOLD, Mode.SLEW, Mode.TESTBED_DEMO}
        self.dipole_per_ampere = config.craft.dipole_per_ampere
        self.free_axis = None
        self.paths = paths
        self.planner = PointingPlanner(
            _planned(config), paths, environment, disturbed, self._objects, services
        )
        self.targets = PointingTargets(_timed(config), paths, config.looks_for_objects())
        self.tracker = _tracker(config, filter_, environment)
        detumbler = _detumbler(config, filter_, environment)
        self.brake = self.field_brake = FieldBrake(detumbler, self.dipole_per_ampere)
        self.sun_acquisition = estimation.sun_acquisition

    def follows_objects(self) -> bool:
        """Return whether an object is searched for or followed."""
        return self._objects.seeks

    def accept_tracks(self, tracks: Sequence[Track], now_ns: int) -> None:
        """Choose the track to follow."""
        self._objects.accept(tracks, now_ns)

    def exposure_start(self, from_ns: int, exposure_ns: int) -> int:
        """Return the first time from `from_ns` on at which an exposure meets no step of the coils."""
        return self._pauses.calm(from_ns, exposure_ns)


def make(config: Config, services: Services, learned: Mapping[str, Learned]) -> Body:
    """Return the satellite of a configuration, with the states that an earlier boot learned."""
    config = as_orbit(config)
    estimation = SatelliteEstimation(config, services, learned)
    control = SatelliteControl(config, estimation, services)
    view = OrbitView(control.field_brake, estimation.orbit_filter, estimation.environment, services)
    return Body(estimation, control, view, streak_estimator(config.camera))


ORBIT = BodyKind(pointing_job.run, make)


def _disturbed(filter_: OrbitFilter) -> Callable[[], tuple[FloatArray, FloatArray]]:
    """Return a function that gives the estimated torque sizes (9,) N m and the residual dipole (3,) A m^2."""
    return lambda: (filter_.torque_sizes, filter_.residual_dipole)


def _limit(config: OrbitConfig) -> float:
    """Return the largest dipole of a coil, A m^2."""
    return config.coils.current_limit * config.craft.dipole_per_ampere


def _pauses(config: OrbitConfig) -> WindowSchedule:
    """Return the windows of pointing: the pauses of detumbling, and longer times to act."""
    settle, measure, act = config.detumble.settle, config.detumble.measure, config.pointing.act
    return WindowSchedule(*(round(seconds * SECOND_NS) for seconds in (settle, measure, act)))


def _tracker(config: OrbitConfig, filter_: OrbitFilter, environment: OrbitEnvironment) -> PointingTracker:
    craft, pauses = config.craft, _pauses(config)
    inertia = np.array(craft.inertia)
    return PointingTracker(filter_, environment, pauses, _limit(config), craft.dipole_per_ampere, inertia)


def _planned(config: OrbitConfig) -> PlannedCraft:
    section = config.pointing
    axes = BodyAxes(np.array(section.axis), np.array(section.across))
    fastest = _BELOW * fastest_rate(config)
    weights = PointingWeights(
        turn=section.turn,
        rate=section.rate,
        dipole=section.dipole,
        fastest=fastest,
        roll=section.roll,
        axis=axes.pointing,
    )
    pauses = _pauses(config)
    limit = _limit(config) * pauses.act_ns / pauses.period_ns
    return PlannedCraft(np.diag(config.craft.inertia), axes, weights, limit, _slew(config))


def _slew(config: OrbitConfig) -> SlewRequest:
    """Return how slews are wanted; without a star camera the pointing axis keeps the cones."""
    section, camera = config.pointing, config.camera
    boresight = section.axis if camera is None else attitude_matrix(np.array(camera.mounting))[2]
    heat = np.array(config.coils.resistance) / config.craft.dipole_per_ampere**2
    return SlewRequest(section.slew, heat, np.zeros(3), np.array(boresight), section.cones.angles())


def _sensor(config: OrbitConfig) -> Sensor | None:
    """Return boresight and field of the star camera, None without one that looks for objects."""
    camera = config.camera
    if camera is None or not config.looks_for_objects():
        return None
    model = camera_model(camera)
    half = math.atan(0.5 * min(camera.columns, camera.rows) / model.focal_length)
    return Sensor(attitude_matrix(np.array(camera.mounting))[2], half)


def fastest_rate(config: OrbitConfig) -> float:
    """Return the rate, rad/s, beyond which the body is braked again or the star camera rests."""
    camera = config.camera.max_rate if config.camera is not None else None
    return config.modes.tumble_rate if camera is None else min(config.modes.tumble_rate, camera)


def _timed(config: OrbitConfig) -> list[tuple[float, PointingTarget]]:
    return [(step.at, step.target()) for step in config.targets]


def filter_settings(config: OrbitConfig) -> FreeFilterSettings:
    """Return the configured noises of the filter's states."""
    section, rate_hz = config.estimation, config.executive.control_rate_hz
    return FreeFilterSettings(
        gyro=(section.bias_start, section.bias_walk),
        coil_noise=section.current_noise * config.craft.dipole_per_ampere / math.sqrt(rate_hz),
        torque=(section.torque_start, section.torque_walk),
        field=section.field_error,
        gate_sigma=section.gate_sigma,
    )


def _utc(services: Services) -> float:
    """Return the host's UTC, s, from which the age of learned states follows."""
    return services.clock.utc_ns() / SECOND_NS


def _filter(
    config: OrbitConfig, environment: OrbitEnvironment, learned: Mapping[str, Learned], utc: float
) -> tuple[OrbitFilter, list[str]]:
    """Return the filter, and why learned states were rejected."""
    craft, section, unit = config.craft, config.estimation, config.inertial_unit
    slow, problems = start_from(learned, filter_settings(config), section.changed, utc)
    settings = OrbitFilterSettings(
        inertia=np.diag(craft.inertia),
        dipole_per_ampere=craft.dipole_per_ampere,
        dipole_limit=config.coils.current_limit * craft.dipole_per_ampere,
        gyro_noise=unit.rate_noise,
        field_noise=section.field_noise,
        unknown_psd=config.detumble.torque_noise**2,
        settle_ns=round(config.detumble.settle * SECOND_NS),
        history_ns=round(section.history * SECOND_NS),
        slow=slow,
        free=filter_settings(config),
    )
    return OrbitFilter(settings, environment.at), problems


def _strings(section: StringsSection) -> SolarStringModel:
    normals = np.array([string.normal for string in section.strings])
    return SolarStringModel(normals, np.array([string.peak for string in section.strings]))


def _sun(config: OrbitConfig, filter_: OrbitFilter, environment: OrbitEnvironment) -> CoarseSunFeed | None:
    section = config.solar_strings
    if section is None:
        return None
    return CoarseSunFeed(_strings(section), round(section.period * SECOND_NS), filter_, environment)


def _seeker(config: OrbitConfig, services: Services) -> SunAcquisitionBrake | None:
    """Return the brake that turns the pointing axis to the Sun in SAFE; None without solar cells."""
    section, craft = config.solar_strings, config.craft
    if section is None:
        return None
    axis = np.array(config.pointing.axis)
    seeking = SunAcquisitionSettings(inertia=np.array(craft.inertia), axis=axis, limit=_limit(config))
    seeker = SunAcquisition(_pauses(config), seeking)
    return SunAcquisitionBrake(seeker, _strings(section), craft.dipole_per_ampere, services.events)


def _elements(config: OrbitConfig) -> TwoLineElements | None:
    """Return the configured two-line elements. Raises ConfigError for malformed lines."""
    if config.elements is None:
        return None
    try:
        return TwoLineElements(*config.elements)
    except UsageError as error:
        raise ConfigError("elements", f"are no two-line elements: {error}") from error


def _detumbler(config: OrbitConfig, filter_: OrbitFilter, environment: OrbitEnvironment) -> FieldDetumbler:
    section, craft = config.detumble, config.craft
    settle_ns, measure_ns, act_ns = (
        round(seconds * SECOND_NS) for seconds in (section.settle, section.measure, section.act)
    )
    settings = FieldRateSettings(
        inertia=np.diag(craft.inertia),
        field_sigma=section.field_noise,
        torque_walk=section.torque_noise,
        gyro_sigma=config.estimation.bias_start,
    )
    braking = FieldDetumblerSettings(
        limit=_limit(config),
        horizon=section.horizon,
        replan=section.replan,
        gentle=section.gentle,
        spin_up=section.spin_up,
        slow=section.low_rate,
    )
    expected = expected_field(filter_, environment, braking.instants)
    return FieldDetumbler(WindowSchedule(settle_ns, measure_ns, act_ns), braking, settings, expected)


def _coil_watch(config: OrbitConfig) -> CoilWatch:
    x, y, z = (config.coils.supply_voltage / resistance for resistance in config.coils.resistance)
    inertia, dipole = np.diag(config.craft.inertia), config.craft.dipole_per_ampere
    settle_ns = round(config.detumble.settle * SECOND_NS)
    # The field is a sixteenth of the testbed's: the same torque takes longer to be measurable.
    response = ResponseSettings(
        inertia,
        dipole,
        config.inertial_unit.rate_noise,
        bin_samples=16,
        bins=40,
        model_error=2.0e-4,
        torsion=1e-6,
        damping=1e-4,
        settle_ns=settle_ns,
    )
    slow = replace(response, bin_samples=80, bins=20, model_error=3.0e-5)
    tumble = config.modes.tumble_rate
    return CoilWatch(CoilWatchSettings((x, y, z), response=response, slow=slow, tumble_rate=tumble))
