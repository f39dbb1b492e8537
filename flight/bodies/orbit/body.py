"""A satellite in orbit with two to six coils, built from its configuration, with its telemetry.

The satellite detumbles with magnetometer and gyro, acquires its attitude with the coils off, and points.
`ORBIT` builds it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from flight.bodies.orbit.coarse_attitude import CoarseSunFeed, horizon_camera_feed
from flight.bodies.orbit.control import FieldDetumblingLaw, PointingTracker, SunAcquisitionLaw, expected_field
from flight.bodies.orbit.environment import LATEST_WITNESS_NS, EstimatedEnvironment, Witness
from flight.bodies.orbit.filter import (
    BODY,
    COIL_FACTORS,
    OrbitFilter,
    OrbitFilterSettings,
    learned_of,
    start_from,
)
from flight.bodies.orbit.guidance import (
    LearnedBody,
    ObjectAim,
    PlannedCraft,
    PointingPaths,
    PointingPlanner,
    PointingTargets,
    Sensor,
)
from flight.bodies.streak_methods import corner_estimator
from flight.link import events
from flight.link.events import TESTBED, Mode
from flight.link.telemetry.definitions import DESCRIPTION, NAVIGATION, SEPARATE_ATTITUDES, SPIN
from flight.loop import facts
from flight.loop.body import (
    BodyControl,
    BodyEstimation,
    BodyKind,
    ControlOutput,
    FixVerdict,
    FlightBody,
    ReadingAgreement,
    ReadingFeed,
    Target,
)
from flight.loop.coil_monitor import CoilMonitor, CoilMonitorSettings, SelfTestSettings
from flight.loop.coil_response import ResponseSettings
from flight.loop.facts import Services
from flight.loop.state import Learned
from flight.schema.bodies import OrbitConfig, as_orbit
from flight.schema.devices import SolarStringsSection, camera_model
from flight.schema.document import ConfigError
from flight.schema.sections import CONTROL_RATE_HZ, Config
from hal.interfaces.devices import GpsReading, ImuReading, StringReading
from hal.interfaces.wires import SECOND_NS
from knightcube.astro.arrays import BoolArray, FloatArray
from knightcube.astro.attitude.solvers import VectorObservation
from knightcube.astro.earth.disturbance import mean_density
from knightcube.astro.earth.orbit_knowledge import OrbitState, TwoLineElements
from knightcube.astro.quaternion import attitude_matrix
from knightcube.errors import UsageError
from knightcube.gnc.control import pointing_job
from knightcube.gnc.control.detumble import WindowSchedule
from knightcube.gnc.control.field_detumbler import FieldDetumbler, FieldDetumblerSettings
from knightcube.gnc.control.pointing_job import SlewRequest
from knightcube.gnc.control.pointing_table import PointingWeights
from knightcube.gnc.control.sun_acquisition import SunAcquisition, SunAcquisitionSettings
from knightcube.gnc.estimation.error_state import Role
from knightcube.gnc.estimation.estimate import (
    ATTITUDE,
    RATE,
    AttitudeMeasurement,
    Estimate,
    Knowledge,
    MeanRateMeasurement,
)
from knightcube.gnc.estimation.field_rate import FieldRateSettings
from knightcube.gnc.estimation.free_filter import FreeFilterSettings
from knightcube.gnc.estimation.rigid_body import BodyErrors
from knightcube.gnc.guidance.attitude_law import BodyAxes
from knightcube.gnc.tracker import Track
from knightcube.vision.solar_cells import SolarStringModel

SPIN_EVERY = 10
"""Number of control cycles from one spin packet to the next."""
NAVIGATION_EVERY = 40
"""Number of control cycles from one navigation packet to the next."""
DESCRIPTION_EVERY = 400
"""Number of control cycles from one description packet to the next."""
LEVELS = (Knowledge.LOST, Knowledge.COARSE, Knowledge.FINE)
"""Classes of attitude knowledge, in the order of their numbers in the navigation packet."""
_NAN3 = [math.nan] * 3


class OrbitView:
    """Telemetry packets and status texts of the satellite; implements `flight.loop.body.BodyView`."""

    def __init__(
        self,
        detumbling: FieldDetumblingLaw,
        filter_: OrbitFilter,
        environment: EstimatedEnvironment,
        services: Services,
    ) -> None:
        self._filter, self._environment, self._events = filter_, environment, services.events
        self._facts = services.facts
        self._knowledge = Knowledge.LOST
        self._is_clock_doubted = False
        self._contradictions = 0  # number of reported contradictions of learned states
        self._detumbler = detumbling.detumbler
        self._recorder = services.recorder

    def record_cycle(self, output: ControlOutput) -> None:
        """Record the navigation packet, and the spin packet during detumbling."""
        self._record_knowledge(output)
        if output.mode is not Mode.DETUMBLE or output.cycle.slot % SPIN_EVERY:
            return
        found = self._detumbler
        rate, field = found.rate, found.field
        self._recorder.record(
            SPIN,
            output.cycle.start_ns,
            known=int(rate is not None),
            rate=_NAN3 if rate is None else rate.tolist(),
            rate_sigma=found.rate_sigma,
            field=_NAN3 if field is None else field.tolist(),
            restarts=found.restarts,
            dipole=output.steered.dipole.tolist(),
        )

    def _record_knowledge(self, output: ControlOutput) -> None:
        """Record the navigation packet, and report a change of the attitude knowledge as an event."""
        found, now_ns, estimate = self._filter, output.cycle.start_ns, output.estimate
        known = found.knowledge
        if known is not self._knowledge:
            text = f"{self._knowledge.value} -> {known.value}"
            self._events.report(events.ATTITUDE_KNOWLEDGE, now_ns, text)
            self._knowledge = known
        for text in found.contradictions[self._contradictions :]:
            self._events.report(events.LEARNED_REFUSED, now_ns, text)
        self._contradictions = len(found.contradictions)
        if output.cycle.slot % DESCRIPTION_EVERY == 0 and estimate is not None:
            values = self._filter.description(now_ns)
            fields = {name: values[name].ravel().tolist() for name in values}
            self._recorder.record(DESCRIPTION, now_ns, **fields)
        if output.cycle.slot % NAVIGATION_EVERY:
            return
        sigma = self._environment.field_sigma(now_ns) if self._environment.known else None
        text = (
            f"the magnetic field is extrapolated and has an additional error of {1e9 * (sigma or 0.0):.0f} nT"
        )
        self._facts.update(facts.FIELD_EXTRAPOLATED, None if sigma is None else sigma > 0.0, now_ns, text)
        late = self._environment.clock_doubt
        if late or (self._is_clock_doubted and not self._environment.is_timed):
            self._facts.update(
                facts.CLOCK_OFF, bool(late), now_ns, late or "the clock is set from the date of the elements"
            )
        self._is_clock_doubted = bool(late)
        doubt = found.field_doubt
        self._facts.update(
            facts.FIELD_REFUSED, bool(doubt), now_ns, doubt or "the magnetometer agrees with the estimate"
        )
        self._recorder.record(
            NAVIGATION,
            now_ns,
            knowledge=LEVELS.index(known),
            placed=int(self._environment.known),
            refused=found.refused,
            fixes_refused=self._environment.refused,
            restarts=found.restarts,
            gyro_bias=_NAN3 if estimate is None else estimate.bias.tolist(),
            field_bias=_NAN3 if estimate is None else estimate.field_bias.tolist(),
            residual_dipole=_NAN3 if estimate is None else found.residual_dipole.tolist(),
        )

    def announce(self, target: Target, now_ns: int) -> None:
        """Report a new target as an event."""
        self._events.report(events.TARGET, now_ns, target.law.text)

    def mode_fields(self, wanted: Target | None) -> Mapping[str, float]:
        """Return the satellite's fields of the mode packet."""
        return {"target_q2": math.nan}

    def rate_text(self, rate: MeanRateMeasurement) -> str:
        """Return an angular rate measured from streaks, as text."""
        return f"{np.rad2deg(rate.rate).round(3).tolist()} deg/s"

    def progress(self, output: ControlOutput | None) -> str:
        """Return mode and rate as text, for the progress line."""
        mode = output.mode if output else Mode.BOOT
        if self._knowledge is not Knowledge.LOST:
            return f"{mode.label}, attitude {self._knowledge.value}"
        rate = self._detumbler.rate if mode is Mode.DETUMBLE else None
        if rate is None:
            return mode.label
        return f"{mode.label} {math.degrees(float(np.linalg.norm(rate))):.2f} deg/s from the magnetometer"


class OrbitFeed:
    """Passes gyro and magnetometer readings to the filter; implements `ReadingFeed`."""

    def __init__(self, filter_: OrbitFilter) -> None:
        self._filter = filter_

    def accept(self, reading: ImuReading) -> ReadingAgreement:
        """Collect angular rate and magnetic field for the filter's next step."""
        return ReadingAgreement(self._filter.accept(reading))

    def begin(self, attitude: AttitudeMeasurement) -> bool:
        """Start the filter from an attitude measured with stars, and return whether it started."""
        return self._filter.begin(attitude)


SUNLIT_SHARE = 0.5
"""Fraction of its peak current above which a string of solar cells counts as sunlit."""
_LIGHTEST = 1.6
"""Largest possible current of a string, as a fraction of its peak current, in the light of Sun and Earth."""
_BELOW = 0.8
"""Largest rate of a planned path, as a fraction of the rate at which detumbling starts."""


class SatelliteEstimation(BodyEstimation):
    """State estimation of the satellite: attitude filter, orbit, Sun sensing and horizon cameras."""

    uses_readings_without_rate = True

    def __init__(self, config: OrbitConfig, services: Services, learned: Mapping[str, Learned]) -> None:
        """Start from the slow states that an earlier boot learned."""
        try:
            elements = None if config.elements is None else TwoLineElements(*config.elements)
        except UsageError as error:
            raise ConfigError("elements", f"are not valid two-line elements: {error}") from error
        self.environment = EstimatedEnvironment(elements, services.clock)
        self._services = services
        self.orbit_filter, self.learned_problems = _filter(config, self.environment, learned, _utc(services))
        self.filter = self.orbit_filter
        self.feed: ReadingFeed = OrbitFeed(self.orbit_filter)
        self.detumbler = _detumbler(config, self.orbit_filter, self.environment)
        self.coil_monitor = _coil_monitor(config, self.environment)
        self._coils, self._errors = config.coils.map(), description_errors(config)
        self._field_bias = config.inertial_unit.accuracy.field_bias
        self._low_rate, self._gyro_bias = config.detumble.low_rate, config.estimation.bias_start
        self._used = self.coil_monitor.available
        self._whole_body: Learned | None = None
        if COIL_FACTORS in learned:
            factors, spread = learned[COIL_FACTORS].arrays()
            if problem := self.coil_monitor.restore(factors, np.sqrt(spread.diagonal())):
                self.learned_problems.append(f"{COIL_FACTORS} {problem}")
        self._sun = _sun(config, self.orbit_filter, self.environment)
        self.sun_acquisition = _sun_acquisition(config, services)
        if config.wide_cameras:
            self.horizon_cameras = horizon_camera_feed(
                config.wide_cameras, self.orbit_filter, self.environment, self._sun
            )
            if config.estimation.compare is not None:
                compared = ComparedFeed(self.feed, self.orbit_filter, config, services)
                self.feed, self.horizon_cameras.compare = compared, compared.compare

    def field(self, estimate: Estimate) -> FloatArray:
        """Return the expected magnetic field (3,), T, in body axes, or zero while the orbit is unknown."""
        field = self.environment.field(estimate.time_ns)
        return np.zeros(3) if field is None else attitude_matrix(estimate.quaternion) @ field

    def angular_acceleration_psd(self, time_ns: int) -> FloatArray:
        """Return the power spectral density (3, 3), rad^2/s^3, of the acceleration noise at a time."""
        return self.orbit_filter.acceleration_psd(time_ns)

    def learned(self, estimate: Estimate) -> Mapping[str, Learned]:
        """Return the filter's slow states with their reference time, and the coils' correction factors."""
        coils = self.coil_monitor.correction
        factors = Learned.of(coils.factors, np.diag(coils.deviations**2))
        found = {**learned_of(self.orbit_filter.slow, _utc(self._services)), COIL_FACTORS: factors}
        # With redundant coils, a matrix that was learned while a coil was isolated is not stored.
        if self._used.all() or not self._coils.is_redundant:
            self._whole_body = found[BODY]
        elif self._whole_body is not None:
            found[BODY] = self._whole_body
        else:
            del found[BODY]
        return found

    def coils_corrected(self, change: FloatArray, deviations: FloatArray) -> None:
        """Pass a correction of the coils to the filters, which reset the learned matrix of these coils."""
        self.detumbler.renew_coils()
        self.orbit_filter.correct_coils(change, deviations)
        self._renew_redundant_coils()

    def coils_used(self, used: BoolArray) -> None:
        """Accept the flags (n,) of the coils in use, and reset the learned matrix of redundant coils."""
        self._used = used
        self.detumbler.renew_coils()
        self._renew_redundant_coils()

    def _renew_redundant_coils(self) -> None:
        """Reset the learned matrix of redundant coils, unless only parallel coils are in use."""
        if not self._coils.is_redundant:
            return
        with suppress(UsageError):
            coils, errors, used = self._coils.working(self._used), self._errors, self._used
            gains = np.full(len(coils.current_limits), errors.coil_gain)
            corrected = self.coil_monitor.correction.deviations[used] / _UNIFORM
            gains[: len(corrected)] = np.maximum(errors.coil_gain, corrected)
            self.orbit_filter.renew_coils(coils.error_covariance(gains, errors.coil_axes), used)

    def knowledge(self) -> Knowledge:
        """Return how well the attitude is known."""
        return self.orbit_filter.knowledge

    def orbit(self, time_ns: int) -> OrbitState | None:
        """Return the satellite's position and velocity (ICRS), or None while the orbit is unknown."""
        return self.environment.state(time_ns)

    def magnetometer_changed(self) -> None:
        """Discard the learned errors of the magnetometer that was used before."""
        self.orbit_filter.renew_magnetometer()
        self.detumbler.renew_magnetometer()

    def is_accurate(self, estimate: Estimate) -> bool:
        """Return whether the rate of an estimate is accurate enough to decide that the body is detumbled."""
        return float(estimate.covariance.diagonal()[RATE].max()) <= self._low_rate**2

    def rate_without_gyro(self, time_ns: int) -> FloatArray | None:
        """Return the rate (3,), rad/s, of the filter if it is as accurate as a gyro, and None otherwise."""
        estimate = self.orbit_filter.at(time_ns) if self.orbit_filter.started else None
        if estimate is None or estimate.covariance.diagonal()[RATE].max() > self._gyro_bias**2:
            return None
        return estimate.rate

    def fastest_by_field(self) -> float:
        """Return the rate (rad/s) from the magnetometer plus its standard deviation; infinite if unknown."""
        found = self.orbit_filter.rate_by_field()
        if found is None:
            return math.inf
        sigma = math.sqrt(float(np.linalg.eigvalsh(found.covariance)[-1]))
        return float(np.linalg.norm(found.rate)) + sigma

    def velocity(self, time_ns: int) -> FloatArray | None:
        """Return the velocity (3,), m/s, relative to the Sun (ICRS), or None while the orbit is unknown."""
        return self.environment.velocity(time_ns)

    def accept_fix(self, reading: GpsReading) -> FixVerdict:
        """Compare a GPS fix with magnetic field and sunlight, and return whether the fix is used."""
        field, sigma, sunlit = None, math.inf, False
        measured = self.orbit_filter.field_at_rest
        if measured is not None and abs(reading.time_ns - measured[0]) <= LATEST_WITNESS_NS:
            field = measured[1]
            sigma = _UNIFORM * math.hypot(self._field_bias, self._errors.field_matrix * field)
        sun = self._sun
        if sun is not None and sun.newest is not None:
            recent = abs(reading.time_ns - sun.newest.time_ns) <= LATEST_WITNESS_NS
            shares = sun.newest.currents / sun.strings.peaks
            sunlit = recent and bool(((shares >= SUNLIT_SHARE) & (shares <= _LIGHTEST)).any())
        used = self.environment.fix(reading, Witness(field, sigma, sunlit))
        return FixVerdict(used, self.environment.refusal)

    def accept_sun(self, reading: StringReading) -> str | None:
        """Pass a solar cell reading to the filter and to the Sun acquisition of SAFE."""
        if self._sun is None or self.sun_acquisition is None:
            return None
        self.sun_acquisition.update_sun(reading)
        return self._sun.accept(reading)


class SatelliteControl(BodyControl):
    """Guidance and control of the satellite, built from its configuration."""

    def __init__(self, config: OrbitConfig, estimation: SatelliteEstimation, services: Services) -> None:
        environment, filter_ = estimation.environment, estimation.orbit_filter
        coils = config.coils.map()
        self._objects = ObjectAim(_sensor(config), float(np.mean(coils.limits)), services.events)
        self._pauses = _pauses(config)
        paths = PointingPaths(coils.limits, fastest_rate(config))
        timed = [(step.at, step.target()) for step in config.targets]
        self.modes = frozenset(Mode) - TESTBED
        self.dipoles = coils.dipoles
        self.free_axis = None
        self.paths = paths
        self.planner = PointingPlanner(
            _planned(config),
            paths,
            environment,
            lambda: LearnedBody(filter_.inertia, filter_.torque_sizes, filter_.residual_dipole),
            lambda: estimation.coil_monitor.available,
            self._objects,
            services,
        )
        self.targets = PointingTargets(timed, paths, config.looks_for_objects())
        self.tracker = _tracker(config, filter_, environment)
        self.detumbling = self.field_detumbling = FieldDetumblingLaw(estimation.detumbler, coils)
        self.sun_acquisition = estimation.sun_acquisition

    def follows_objects(self) -> bool:
        """Return whether the satellite searches for an object or follows one."""
        return self._objects.seeks

    def accept_tracks(self, tracks: Sequence[Track], now_ns: int) -> None:
        """Accept the confirmed tracks of objects, and choose the track to follow."""
        self._objects.accept(tracks, now_ns)

    def exposure_start(self, from_ns: int, exposure_ns: int) -> int:
        """Return the first start time (ns), not before `from_ns`, of an exposure without coil switching."""
        return self._pauses.calm(from_ns, exposure_ns)


def make(config: Config, services: Services, learned: Mapping[str, Learned]) -> FlightBody:
    """Return the satellite that a configuration describes, with the states that an earlier boot learned."""
    config = as_orbit(config)
    estimation = SatelliteEstimation(config, services, learned)
    control = SatelliteControl(config, estimation, services)
    view = OrbitView(control.field_detumbling, estimation.orbit_filter, estimation.environment, services)
    camera = config.camera
    corners = None if camera is None or camera.estimator == "likelihood" else corner_estimator(camera)
    return FlightBody(estimation, control, view, corners)


ORBIT = BodyKind(pointing_job.run, make)


def _pauses(config: OrbitConfig) -> WindowSchedule:
    """Return the control windows of pointing, in which the coils are driven for longer than in detumbling."""
    return _windows(config, config.pointing.act)


def _windows(config: OrbitConfig, act: float) -> WindowSchedule:
    durations = (config.detumble.settle, config.detumble.measure, act)
    return WindowSchedule(*(round(seconds * SECOND_NS) for seconds in durations))


def _tracker(config: OrbitConfig, filter_: OrbitFilter, environment: EstimatedEnvironment) -> PointingTracker:
    inertia = config.craft.inertia_matrix()
    return PointingTracker(filter_, environment, _pauses(config), config.coils.map(), inertia)


def _planned(config: OrbitConfig) -> PlannedCraft:
    section = config.pointing
    axes = BodyAxes(np.array(section.axis), np.array(section.across))
    fastest = _BELOW * fastest_rate(config)
    weights = PointingWeights(
        turn=section.turn,
        rate=section.rate,
        dipole=config.dipole_weight(),
        fastest=fastest,
        roll=section.roll,
        axis=axes.pointing,
    )
    pauses = _pauses(config)
    coils = config.coils.map()
    # Without a star camera, the keep-out cones are centred on the pointing axis.
    camera = config.camera
    boresight = section.axis if camera is None else attitude_matrix(np.array(camera.mounting))[2]
    angles, duty = section.cones.angles(), pauses.act_ns / pauses.period_ns
    slew = SlewRequest(
        config.slew_duration(), coils.heat, np.zeros(3), np.array(boresight), angles, planner=section.planner
    )
    return PlannedCraft(config.craft.inertia_matrix(), axes, weights, coils, duty, slew)


def _sensor(config: OrbitConfig) -> Sensor | None:
    """Return the star camera's boresight and field of view, or None if it does not search for objects."""
    camera = config.camera
    if camera is None or not config.looks_for_objects():
        return None
    model = camera_model(camera)
    half = math.atan(0.5 * min(camera.columns, camera.rows) / model.focal_length)
    return Sensor(attitude_matrix(np.array(camera.mounting))[2], half)


def fastest_rate(config: OrbitConfig) -> float:
    """Return the smaller of two rates (rad/s): the tumble rate, and the largest rate of the star camera."""
    camera = config.camera.max_rate if config.camera is not None else None
    return config.modes.tumble_rate if camera is None else min(config.modes.tumble_rate, camera)


_FIELD_ERROR = 2.5e-8
"""Standard deviation (T per axis) of the field model: ring current 20 nT, crust and core 15 nT."""
_FIELD_BIAS_WALK = 3.0e-10
"""Random walk of the magnetometer's bias, T per sqrt(s)."""
_DIPOLE_WALK, _SUNLIT_WALK = 1.5e-6, 2.0e-7
"""Random walk of the residual dipole in shadow and of its increase in sunlight, A m^2 per sqrt(s)."""
_UNIFORM = 1.0 / math.sqrt(3.0)
"""Standard deviation of an error that is uniformly distributed between -1 and 1."""


def description_errors(config: OrbitConfig) -> BodyErrors:
    """Return the configured errors of the satellite's properties."""
    craft, unit = config.craft.accuracy, config.inertial_unit.accuracy
    camera = 0.0 if config.camera is None else math.radians(config.camera.accuracy.mounting_deg)
    return BodyErrors(
        moments=craft.moments,
        axes=math.radians(craft.axes_deg),
        gyro_scale=unit.gyro_scale,
        gyro_alignment=unit.gyro_alignment,
        coil_gain=craft.coil_gain,
        coil_axes=math.radians(craft.coil_axes_deg),
        field_matrix=unit.field_matrix,
        camera=camera,
        horizon=math.radians(max((one.mounting_deg for one in config.wide_cameras), default=0.0)),
    )


def filter_settings(config: OrbitConfig) -> FreeFilterSettings:
    """Return the filter's settings that follow from the configuration."""
    section, coils = config.estimation, config.coils.map()
    strength = float(np.linalg.norm(coils.dipoles, axis=1).max())
    errors, (dipole, sunlit) = description_errors(config), config.dipole_errors()
    return FreeFilterSettings(
        gyro=(section.bias_start, section.bias_walk),
        dipole=(_UNIFORM * dipole, _DIPOLE_WALK),
        sunlit=(_UNIFORM * sunlit, _SUNLIT_WALK),
        coil_noise=section.current_noise * strength / math.sqrt(CONTROL_RATE_HZ),
        torque=config.torque_sizes(),
        magnet=(_UNIFORM * config.inertial_unit.accuracy.field_bias, _FIELD_BIAS_WALK),
        field=_FIELD_ERROR,
        errors=errors,
        coils=None if coils.aligned else coils.error_covariance(errors.coil_gain, errors.coil_axes),
        roles={name: Role(role) for name, role in section.roles.items()},
        gate_sigma=section.gate_sigma,
    )


def _utc(services: Services) -> float:
    """Return the host's UTC (s), from which the age of learned states is computed."""
    return services.clock.utc_ns() / SECOND_NS


def _filter(
    config: OrbitConfig, environment: EstimatedEnvironment, learned: Mapping[str, Learned], utc: float
) -> tuple[OrbitFilter, list[str]]:
    """Return the attitude filter, and the reasons why learned states were rejected."""
    craft, section, unit = config.craft, config.estimation, config.inertial_unit
    inertia, free, coils = craft.inertia_matrix(), filter_settings(config), config.coils.map()
    layout, dipole = free.error_state(inertia), craft.residual_dipole
    slow, problems = start_from(learned, layout, section.changed, utc, dipole)
    settings = OrbitFilterSettings(
        inertia=inertia,
        coils=coils,
        gyro_noise=unit.rate_noise,
        field_noise=section.field_noise,
        unknown_psd=config.torque_noise() ** 2,
        settle_ns=round(config.detumble.settle * SECOND_NS),
        history_ns=round(section.history * SECOND_NS),
        slow=slow,
        free=free,
    )
    return OrbitFilter(settings, environment.at), problems


def _strings(section: SolarStringsSection) -> SolarStringModel:
    normals = np.array([string.normal for string in section.strings])
    return SolarStringModel(normals, np.array([string.peak for string in section.strings]))


def _sun(
    config: OrbitConfig, filter_: OrbitFilter, environment: EstimatedEnvironment
) -> CoarseSunFeed | None:
    section = config.solar_strings
    if section is None:
        return None
    return CoarseSunFeed(_strings(section), round(section.period * SECOND_NS), filter_, environment)


def _sun_acquisition(config: OrbitConfig, services: Services) -> SunAcquisitionLaw | None:
    """Return the law that turns the pointing axis to the Sun in SAFE, or None if there are no solar cells."""
    section, coils = config.solar_strings, config.coils.map()
    if section is None:
        return None
    axis = np.array(config.pointing.axis)
    inertia = config.craft.inertia_matrix()
    settings = SunAcquisitionSettings(inertia=inertia, axis=axis, limit=coils.limits)
    law = SunAcquisition(_pauses(config), settings)
    return SunAcquisitionLaw(law, _strings(section), coils, services.events)


def _detumbler(
    config: OrbitConfig, filter_: OrbitFilter, environment: EstimatedEnvironment
) -> FieldDetumbler:
    section, craft = config.detumble, config.craft
    settings = FieldRateSettings(
        inertia=craft.inertia_matrix(),
        field_sigma=section.field_noise,
        torque_walk=config.torque_noise(),
        gyro_sigma=config.estimation.bias_start,
        errors=description_errors(config),
    )
    braking = FieldDetumblerSettings(
        limit=config.coils.map().limits,
        horizon=section.horizon,
        replan=section.replan,
        gentle=section.gentle,
        spin_up=section.spin_up,
        slow=section.low_rate,
    )
    expected = expected_field(filter_, environment, braking.instants)
    return FieldDetumbler(_windows(config, section.act), braking, settings, expected)


def _coil_monitor(config: OrbitConfig, environment: EstimatedEnvironment) -> CoilMonitor:
    full = tuple(config.coils.supply_voltage / resistance for resistance in config.coils.resistance)
    inertia = config.craft.inertia_matrix()
    settle_ns = round(config.detumble.settle * SECOND_NS)
    air, dipole = config.largest_torques()
    per_torque = np.linalg.norm(np.linalg.inv(inertia), axis=1)

    def disturbance(time_ns: int) -> FloatArray:
        """Return the largest accelerations (3,), rad/s^2; drag is omitted if the orbit is unknown."""
        state = environment.state(time_ns)
        density = 0.0 if state is None else mean_density(float(np.linalg.norm(state.position)))
        return np.asarray((dipole + air * density) * per_torque)

    # A coil's torque is detected more slowly than on the testbed, whose magnetic field is 16 times stronger.
    response = ResponseSettings(
        inertia,
        config.coils.map().dipoles,
        config.inertial_unit.rate_noise,
        bin_samples=16,
        bins=40,
        least_bins=20,
        model_error=2.0e-4,
        torsion=1e-6,
        damping=1e-4,
        errors=description_errors(config),
        settle_ns=settle_ns,
        disturbance=disturbance,
    )
    slow = replace(response, bin_samples=40, least_bins=8, model_error=3.0e-5)
    tumble = config.modes.tumble_rate
    interval_ns, limits = round(config.pointing.coil_test * SECOND_NS), np.array(config.coils.limits)
    self_test = SelfTestSettings(interval_ns, limits, config.inertial_unit.rate_hz) if interval_ns else None
    absent = config.coils.absent
    return CoilMonitor(CoilMonitorSettings(full, response, slow, tumble, self_test=self_test, absent=absent))


class ComparedFeed:
    """Passes readings to the flight filter and to the method of Meller et al.; implements `ReadingFeed`."""

    def __init__(
        self, feed: ReadingFeed, filter_: OrbitFilter, config: OrbitConfig, services: Services
    ) -> None:
        from knightcube.reference.sensor_fusion import GyroBiasFilter, KnownAttitude, SeparateDetermination  # noqa: PLC0415 - seldom needed

        unit, section = config.inertial_unit, config.estimation
        noise = unit.rate_noise / np.sqrt(unit.rate_hz)
        self._known = KnownAttitude
        self._feed, self._filter, self._services = feed, filter_, services
        self._method = SeparateDetermination(GyroBiasFilter(noise, section.bias_start, section.bias_walk))

    def accept(self, reading: ImuReading) -> ReadingAgreement:
        """Pass a reading to both methods."""
        if reading.has_rate:
            self._method.gyro(reading.time_ns, reading.rate)
        return self._feed.accept(reading)

    def begin(self, attitude: AttitudeMeasurement) -> bool:
        """Start the flight filter from a star fix; the method under comparison uses no star fixes."""
        return self._feed.begin(attitude)

    def compare(
        self,
        time_ns: int,
        sun: VectorObservation | None,
        nadir: VectorObservation | None,
        field: VectorObservation | None,
    ) -> None:
        """Determine the attitude at `time_ns` from the directions of the sensors, and record it."""
        found = self._method.update(time_ns, sun, nadir, field)
        past = self._filter.past(time_ns) if self._filter.runs else None
        flown = self._known()
        if past is not None:
            flown = self._known(past.quaternion, past.covariance[ATTITUDE, ATTITUDE])
        methods = ("cameras", "magnetometer", "fused", "filtered")
        named = {name: getattr(found, name) for name in methods} | {"flown": flown}
        values = {name: one.quaternion.tolist() for name, one in named.items()}
        sigmas = {f"{name}_sigma": one.sigma for name, one in named.items()}
        recorder = self._services.recorder
        recorder.record(
            SEPARATE_ATTITUDES,
            self._services.clock.now_ns(),
            middle_ns=time_ns - recorder.epoch_ns,
            gyro_bias=found.bias.tolist(),
            **values,
            **sigmas,
        )
