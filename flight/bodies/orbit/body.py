"""A satellite in orbit with three coils. `ORBIT` builds it from the configuration.

This body detumbles and rests; it is not steered to attitudes yet, and its modes say so.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from flight.bodies.orbit.brake import FieldBrake
from flight.bodies.orbit.feed import MagnetometerFeed
from flight.bodies.orbit.view import OrbitView
from flight.gnc.control.detumble import WindowSchedule
from flight.gnc.control.three_axes.field_detumbler import FieldBraking, FieldDetumbler
from flight.gnc.estimation.attitude_filter import AttitudeFilter
from flight.gnc.estimation.estimate import Estimate
from flight.gnc.estimation.field_rate import FieldRateSettings
from flight.gnc.estimation.filter_settings import FilterSettings, slow_prior
from flight.gnc.estimation.rigid_body import RigidBody
from flight.gnc.math.arrays import FloatArray
from flight.loop.body import Body, BodyKind
from flight.loop.fdir.coils.response import ResponseSettings
from flight.loop.fdir.coils.watch import CoilWatch, CoilWatchSettings
from flight.loop.services import Services
from flight.loop.state.content import Learned
from flight.loop.state.learning import start_from
from flight.loop.unsteered import MODES, Unsteered
from flight.schema.orbit import OrbitConfig, as_orbit
from flight.schema.sections import Config
from hal.interfaces.wires import SECOND_NS


def make(config: Config, services: Services, learned: Mapping[str, Learned]) -> Body:
    """Return the satellite of a configuration, with the parameters that an earlier boot learned."""
    config = as_orbit(config)
    filter_, problems = _filter(config, learned)
    brake = FieldBrake(_detumbler(config), config.craft.dipole_per_ampere)
    unsteered = Unsteered()

    def field(estimate: Estimate) -> FloatArray:
        found = brake.field(estimate.time_ns)
        return np.zeros(3) if found is None else found

    return Body(
        modes=MODES,
        filter=filter_,
        learned_problems=problems,
        paths=unsteered,
        planner=unsteered,
        targets=unsteered,
        tracker=unsteered,
        feed=MagnetometerFeed(),
        brake=brake,
        coil_watch=_coil_watch(config),
        view=OrbitView(brake, services),
        field=field,
        free_axis=None,
        dipole_per_ampere=config.craft.dipole_per_ampere,
        angular_acceleration_psd=(config.detumble.torque_noise) ** 2,
    )


ORBIT = BodyKind(None, make)


def _filter(config: OrbitConfig, learned: Mapping[str, Learned]) -> tuple[AttitudeFilter, list[str]]:
    section, craft = config.estimation, config.craft
    body = RigidBody(np.diag(craft.inertia), craft.dipole_per_ampere, np.zeros(3))
    settings = FilterSettings(
        current_noise=section.current_noise,
        control_period=1.0 / config.executive.control_rate_hz,
        disturbance_walk=section.disturbance_walk,
        bias_start=section.bias_start,
        torsion_start=0.0,
        damping_start=0.0,
        gain_start=section.gain_start,
        latency_start=section.latency_start,
        latency_walk=section.latency_walk,
        unknown_current=config.coils.current_limit,
        gate_sigma=section.gate_sigma,
        history_ns=round(section.history * SECOND_NS),
    )
    prior, problems = start_from(learned, slow_prior(body, settings), section.changed)
    return AttitudeFilter(body, settings, prior), problems


def _detumbler(config: OrbitConfig) -> FieldDetumbler:
    section, craft = config.detumble, config.craft
    settle_ns, measure_ns, act_ns = (
        round(seconds * SECOND_NS) for seconds in (section.settle, section.measure, section.act)
    )
    settings = FieldRateSettings(
        inertia=np.diag(craft.inertia), field_sigma=section.field_noise, torque_walk=section.torque_noise
    )
    limit = config.coils.current_limit * craft.dipole_per_ampere
    braking = FieldBraking(limit=limit, horizon=section.horizon, replan=section.replan)
    return FieldDetumbler(WindowSchedule(settle_ns, measure_ns, act_ns), braking, settings)


def _coil_watch(config: OrbitConfig) -> CoilWatch:
    x, y, z = (config.coils.supply_voltage / resistance for resistance in config.coils.resistance)
    inertia, dipole = np.diag(config.craft.inertia), config.craft.dipole_per_ampere
    response = ResponseSettings(inertia, dipole, config.inertial_unit.rate_noise)
    return CoilWatch(CoilWatchSettings((x, y, z), response=response))
