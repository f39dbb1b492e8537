"""The testbed: a body on a thread in a fixed horizontal field, rotated about the thread by one coil.

`TESTBED` builds the testbed from the configuration. Only this package depends on the suspension by a thread
and on q2, the second component of the quaternion.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np

from flight.bodies.streak_methods import corner_estimator
from flight.bodies.testbed.control import (
    BdotLaw,
    CageField,
    CageFilter,
    CageTracker,
    Planning,
    PlanningSettings,
    Strategy,
    ThreadReader,
    ThreadTargets,
    ThreadTracker,
    TimedStep,
    controller_of,
    law_of,
    plant_of,
)
from flight.link import events
from flight.link.events import ORBITAL, Mode
from flight.link.telemetry.definitions import CONTROL, TARGET
from flight.loop.body import (
    KEPT,
    BodyControl,
    BodyEstimation,
    BodyKind,
    ControlOutput,
    FlightBody,
    ReadingAgreement,
    Target,
    Tracker,
)
from flight.loop.coil_monitor import CoilMonitor, CoilMonitorSettings
from flight.loop.coil_response import ResponseSettings
from flight.loop.facts import Services
from flight.loop.state import Learned, start_from
from flight.schema.bodies import TestbedConfig, as_testbed
from flight.schema.sections import CONTROL_RATE_HZ, Config
from hal.interfaces.devices import ImuReading
from hal.interfaces.wires import SECOND_NS
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import about_axis_y, angle_about_axis_y, attitude_matrix
from knightcube.gnc.control.detumble import (
    Detumbler,
    DetumblerSettings,
    WindowSchedule,
    share_in_rotating_field,
)
from knightcube.gnc.estimation.attitude_filter import AttitudeFilter, AttitudeFilterSettings, slow_prior
from knightcube.gnc.estimation.estimate import (
    ATTITUDE,
    RATE,
    AttitudeMeasurement,
    Estimate,
    MeanRateMeasurement,
    Parameters,
    RateMeasurement,
)
from knightcube.gnc.estimation.rigid_body import RigidBody
from knightcube.gnc.guidance import vmc as plan_job
from knightcube.gnc.guidance.path_guidance import AcceptanceRules, PathGuidance
from knightcube.gnc.guidance.plant import PathCost, SingleAxisPlant
from knightcube.gnc.guidance.vmc import NODES

_UNKNOWN_RATE = 1.0
"""Standard deviation (rad/s) of the body rate if the filter starts without a gyro."""
_LEAST_FIELD = 0.5
"""Smallest measured horizontal field that gives a heading, as a fraction of the modelled field."""
_COILS_DECAYED_NS = 50_000_000
"""Time (ns) from switching a coil off until its field no longer affects the filtered readings of the inertial
unit."""
_CONSTANT_FOR = 5.0
"""Time (s) during which the coils' field at the magnetometer is treated as constant."""
_REFUSED_TO_RESTART = 8
"""Number of consecutive rejected angles, measured with the coils off, after which the filter starts again."""
_VACUUM_PERMEABILITY = 4e-7 * math.pi  # T m/A


class UnitFeed:
    """Starts and updates the filter from attitude and rate of the inertial unit; implements `ReadingFeed`.

    The inertial unit's own attitude filter depends on its gyro. While the rate is invalid, the angle about
    the thread therefore follows from the horizontal magnetic field, and the rate from the plant model. The
    field of the body's own coils at the magnetometer is not known. The unknown field is treated as an error
    that stays constant for `_CONSTANT_FOR` seconds and is as large as the field at the centre of a coil.
    While the coils are driven, star attitudes and streak rates therefore outweigh the magnetometer.
    """

    def __init__(
        self, filter_: AttitudeFilter, config: TestbedConfig, field: Callable[[int], FloatArray]
    ) -> None:
        """`field` is a function of a time that returns the magnetic field (3,), T, in reference axes."""
        unit = config.inertial_unit
        self._filter, self._field = filter_, field
        # Field (T) at the centre of a square coil per dipole moment (A m^2), by the law of Biot and Savart.
        side = math.sqrt(config.plant.coil_area)
        self._field_per_dipole = 2.0 * math.sqrt(2.0) * _VACUUM_PERMEABILITY / (math.pi * side**3)
        self._same_error = max(_CONSTANT_FOR * unit.rate_hz, 1.0)
        self._refused = 0
        self._angle_covariance: FloatArray = np.eye(3) * unit.angle_noise**2
        self._rate_covariance: FloatArray = np.eye(3) * unit.rate_noise**2

    def accept(self, reading: ImuReading) -> ReadingAgreement:
        """Start the filter from a reading, or update it with the attitude and the rate of the reading."""
        latency = self._filter.latency
        time_ns = reading.time_ns - round(latency * SECOND_NS)
        if not reading.has_rate:
            return self._accept_field(time_ns, reading.field, latency)
        attitude = AttitudeMeasurement(time_ns, reading.quaternion, self._angle_covariance, latency)
        rate = RateMeasurement(time_ns, reading.rate, self._rate_covariance, latency)
        if not self._filter.started:
            self._filter.start(attitude, rate)
            return ReadingAgreement(True)
        # Attitude and rate have separate gates, so a correct rate is used even if the attitude is rejected.
        turned = self._filter.measure(attitude)
        moved = self._filter.started and self._filter.measure(rate)
        if turned and moved:
            return ReadingAgreement(True)
        angle = angle_about_axis_y(reading.quaternion)
        return ReadingAgreement(turned or moved, f"angle {angle:.4f} rad, rate {reading.rate[1]:.5f} rad/s")

    def _accept_field(self, time_ns: int, field: FloatArray, latency: float) -> ReadingAgreement:
        """Start the filter from the direction of the magnetic field, or update it with this direction."""
        x, _, z = field.tolist()
        reference_x, _, reference_z = self._field(time_ns).tolist()
        strength, expected = math.hypot(x, z), math.hypot(reference_x, reference_z)
        if not strength >= _LEAST_FIELD * expected:
            text = f"horizontal field {strength:.2e} T, expected {expected:.2e} T,"
            return ReadingAgreement(False, text)
        angle = math.atan2(reference_x, reference_z) - math.atan2(x, z)
        dipole = self._filter.largest_dipole(time_ns - _COILS_DECAYED_NS, time_ns)
        by_coils = self._field_per_dipole * dipole / expected
        covariance = self._angle_covariance + self._same_error * by_coils**2 * np.eye(3)
        attitude = AttitudeMeasurement(time_ns, about_axis_y(angle), covariance, latency)
        at_rest = not dipole
        # The many readings that the coils disturb are too uncertain to restart a wrong estimate.
        if not self._filter.started or (at_rest and self._refused >= _REFUSED_TO_RESTART):
            self._refused = 0
            unknown = RateMeasurement(time_ns, np.zeros(3), np.eye(3) * _UNKNOWN_RATE**2, latency)
            self._filter.start(attitude, unknown)
            return ReadingAgreement(True)
        if self._filter.measure(attitude):
            self._refused = 0 if at_rest else self._refused
            return ReadingAgreement(True)
        self._refused += at_rest
        return ReadingAgreement(False, f"the angle computed from the magnetic field, {angle:.4f} rad,")

    def begin(self, attitude: AttitudeMeasurement) -> bool:
        """Return False, because only readings of the inertial unit start this filter."""
        return False


class ThreadView:
    """The telemetry packets and status texts of the testbed; implements `flight.loop.body.BodyView`."""

    def __init__(self, reader: ThreadReader, planning: Planning, services: Services) -> None:
        self._read = reader.read
        self._planning, self._recorder, self._events = planning, services.recorder, services.events

    def record_cycle(self, output: ControlOutput) -> None:
        """Record the control packet of a cycle."""
        estimate = self._read(output.estimate) if output.estimate is not None else None
        steered, sample, written = output.steered, output.steered.reference, output.written
        now_ns, nan = output.cycle.start_ns, math.nan
        self._recorder.record(
            CONTROL,
            now_ns,
            cycle=output.cycle.slot,
            state=int(steered.state),
            estimate_age=(now_ns - estimate.measured_ns) * 1e-9 if estimate else nan,
            angle=estimate.angle if estimate else nan,
            q2=estimate.q2 if estimate else nan,
            rate=estimate.rate if estimate else nan,
            angle_sigma=estimate.angle_sigma if estimate else nan,
            rate_sigma=estimate.rate_sigma if estimate else nan,
            target_q2=law_of(output.target).q2 if output.target else nan,
            path_q2=math.sin(0.5 * sample.angle) if sample else nan,
            path_rate=sample.rate if sample else nan,
            path_acceleration=sample.acceleration if sample else nan,
            plan=self._planning.flown,
            current_command=steered.currents.tolist(),
            current_written=written.current.tolist(),
            saturated=int(written.saturated or steered.saturated),
        )

    def announce(self, target: Target, now_ns: int) -> None:
        """Record and report a new target, except one that holds the present attitude."""
        if target.index == KEPT:
            return
        law = law_of(target)
        self._recorder.record(TARGET, now_ns, index=target.index, q2=law.q2, rate=law.rate)
        self._events.report(events.TARGET, now_ns, f"step {target.index}: q2 = {law.q2:+.2f}")

    def mode_fields(self, wanted: Target | None) -> Mapping[str, float]:
        """Return the fields of the mode packet that belong to this body."""
        return {"target_q2": math.nan if wanted is None else law_of(wanted).q2}

    def rate_text(self, rate: MeanRateMeasurement) -> str:
        """Return an angular rate measured from streaks, as text."""
        return f"{rate.rate[1]:.5f} rad/s +- {math.sqrt(rate.covariance[1, 1]):.1e}"

    def progress(self, output: ControlOutput | None) -> str:
        """Return target and attitude as text for the progress line."""
        target, estimate = (None, None) if output is None else (output.target, output.estimate)
        wanted = law_of(target).q2 if target else 0.0
        if estimate is None:
            return f"q2   -    -> {wanted:+.2f}"
        now = self._read(estimate)
        return f"q2 {now.q2:+.4f} -> {wanted:+.2f}  {now.rate:+.4f} rad/s"


_THREAD_AXIS = np.array([0.0, 1.0, 0.0])


class TestbedEstimation(BodyEstimation):
    """Estimation of the testbed: its attitude filter and coil monitor."""

    uses_readings_without_rate = True

    def __init__(
        self,
        config: TestbedConfig,
        learned: Mapping[str, Learned],
        reader: ThreadReader | None = None,
        cage: CageField | None = None,
    ) -> None:
        """Start from the plant parameters that an earlier boot learned."""
        plant = plant_of(config)
        self._reader = reader or thread_reader(plant)
        self._cage = cage
        self._field = surrounding_field(config)
        noise = plant.torque_constant / plant.inertia * config.estimation.current_noise
        self._density = noise**2 / CONTROL_RATE_HZ * np.eye(3)
        filter_, self.learned_problems = attitude_filter(config, plant, learned, cage)
        self.filter = filter_
        self.feed = UnitFeed(filter_, config, self._field_at)
        self.coil_monitor = coil_monitor(config, plant)
        self._largest = np.array([config.modes.arrived_angle / 3.0, config.modes.arrived_rate])

    def is_accurate(self, estimate: Estimate) -> bool:
        """Return whether an estimate is accurate enough to verify an arrival at the target.

        Three standard deviations of the angle, but only one of the rate, must be within the limits, because
        the noise of the rate averages out soon.
        """
        variances = estimate.covariance.diagonal()
        largest = np.array([variances[ATTITUDE].max(), variances[RATE].max()])
        return bool((largest <= self._largest**2).all())

    def field(self, estimate: Estimate) -> FloatArray:
        """Return the magnetic field (3,), T, in body axes."""
        angle = self._reader.read(estimate).angle
        return np.asarray(attitude_matrix(about_axis_y(angle)) @ self._field_at(estimate.time_ns))

    def _field_at(self, time_ns: int) -> FloatArray:
        """Return the magnetic field (3,), T, in reference axes."""
        return self._field if self._cage is None else self._cage.at(time_ns)

    def angular_acceleration_psd(self, time_ns: int) -> FloatArray:
        """Return the power spectral density (3, 3), rad^2/s^3, of the acceleration due to current noise."""
        return self._density


class TestbedControl(BodyControl):
    """Guidance and control of the testbed, built from its configuration."""

    def __init__(
        self, config: TestbedConfig, reader: ThreadReader, cage: CageField | None, services: Services
    ) -> None:
        plant, settings = plant_of(config), planning_settings(config)
        rules = AcceptanceRules(late_after=config.guidance.late_after)
        guidance = PathGuidance(plant, rules, arrives=settings.strategy is not Strategy.RECEDING)
        steps = [TimedStep(step.at, step.q2, step.rate) for step in config.steps]
        self.modes = frozenset(Mode) - ORBITAL
        self.dipoles = dipole_per_ampere(config) * np.eye(3)
        self.free_axis = _THREAD_AXIS
        self.paths = guidance
        self.planner = self.planning = Planning(plant, settings, guidance, reader, services)
        self.targets = ThreadTargets(steps, reader, guidance, self.planning)
        self.tracker = _tracker(config, plant, reader, cage)
        self.detumbling = detumbling_law(config, plant)


def make(config: Config, services: Services, learned: Mapping[str, Learned]) -> FlightBody:
    """Return the testbed of a configuration, started with the parameters that an earlier boot learned."""
    config = as_testbed(config)
    cage = None if config.cage is None else CageField(config.cage, config.plant.field, services.clock)
    reader = thread_reader(plant_of(config))
    control = TestbedControl(config, reader, cage, services)
    estimation = TestbedEstimation(config, learned, reader, cage)
    view = ThreadView(reader, control.planning, services)
    camera = config.camera
    corners = None if camera is None or camera.estimator == "likelihood" else corner_estimator(camera)
    return FlightBody(estimation, control, view, corners)


def thread_reader(plant: SingleAxisPlant) -> ThreadReader:
    """Return the `ThreadReader` for the stiffness and the damping of the suspension thread of `plant`."""
    return ThreadReader(Parameters(plant.stiffness / plant.inertia, plant.damping / plant.inertia))


def _tracker(
    config: TestbedConfig, plant: SingleAxisPlant, reader: ThreadReader, cage: CageField | None
) -> Tracker:
    """Return the path tracker. It uses the coil on body x or, in a Helmholtz cage, the coils on x and z."""
    period, dipole = 1.0 / CONTROL_RATE_HZ, dipole_per_ampere(config)
    controller = controller_of(config.control, plant, period, config.identification)
    tracker = ThreadTracker(controller, reader, dipole)
    return tracker if cage is None else CageTracker(tracker, reader, plant, cage, dipole)


TESTBED = BodyKind(plan_job.run, make)


def surrounding_field(config: TestbedConfig) -> FloatArray:
    """Return the magnetic field (3,), T, that surrounds the testbed, in reference axes."""
    return np.array([0.0, 0.0, -config.plant.field])


def dipole_per_ampere(config: TestbedConfig) -> float:
    """Return the number of turns times the area of each coil, m^2."""
    return config.plant.coil_turns * config.plant.coil_area


def attitude_filter(
    config: TestbedConfig,
    plant: SingleAxisPlant,
    learned: Mapping[str, Learned],
    cage: CageField | None = None,
) -> tuple[AttitudeFilter, list[str]]:
    """Return the filter of the testbed, and the reasons why `learned` parameters were rejected."""
    section = config.estimation
    body = RigidBody(
        np.eye(3) * plant.inertia,
        dipole_per_ampere(config),
        surrounding_field(config),
        suspended=True,
        stiffness=plant.stiffness,
        damping=plant.damping,
    )
    settings = AttitudeFilterSettings(
        current_noise=section.current_noise,
        control_period=1.0 / CONTROL_RATE_HZ,
        disturbance_walk=section.disturbance_walk,
        bias_start=section.bias_start,
        torsion_start=section.torsion_start,
        damping_start=section.damping_start,
        gain_start=section.gain_start,
        latency_start=section.latency_start,
        latency_walk=section.latency_walk,
        unknown_current=plant.current_limit,
        gate_sigma=section.gate_sigma,
        history_ns=round(section.history * SECOND_NS),
    )
    prior, problems = start_from(learned, slow_prior(body, settings), section.changed)
    if cage is None:
        return AttitudeFilter(body, settings, prior), problems
    return CageFilter(cage, body, settings, prior), problems


def detumbling_law(config: TestbedConfig, plant: SingleAxisPlant) -> BdotLaw:
    """Return the detumbling law with its control windows."""
    section = config.detumble
    durations = (section.settle, section.measure, section.act)
    schedule = WindowSchedule(*(round(seconds * SECOND_NS) for seconds in durations))
    turning = section.field_turn > 0.0
    share = share_in_rotating_field(section.field_turn, schedule) if turning else section.share
    dipole = dipole_per_ampere(config)
    braking = DetumblerSettings(plant.inertia, dipole, plant.current_limit, share)
    return BdotLaw(Detumbler(schedule, braking), dipole)


def coil_monitor(config: TestbedConfig, plant: SingleAxisPlant) -> CoilMonitor:
    """Return the monitor of the coils and their circuit."""
    full = tuple(config.coils.supply_voltage / resistance for resistance in config.coils.resistance)
    response = ResponseSettings(
        np.eye(3) * plant.inertia,
        dipole_per_ampere(config),
        config.inertial_unit.rate_noise,
        free=(False, True, False),
    )
    tumble = config.modes.tumble_rate
    return CoilMonitor(CoilMonitorSettings(full, response=response, tumble_rate=tumble))


def planning_settings(config: TestbedConfig) -> PlanningSettings:
    """Return the settings of path planning."""
    section = config.guidance
    return PlanningSettings(
        horizon=section.horizon,
        replan_period=section.replan_period,
        late_after_ns=round(section.late_after * SECOND_NS),
        nodes=section.nodes or NODES,
        strategy=Strategy(section.strategy),
        time_price=section.time_price,
        current_share=section.current_share,
        cost=PathCost(section.cost),
    )
