"""From a configuration to what each room of the loop must know."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from flight.bodies.testbed.planning import PlanningSettings, Strategy
from flight.gnc.control.detumble import Braking, Detumbler, WindowSchedule, share_in_turning_field
from flight.gnc.estimation.attitude_filter import AttitudeFilter, FilterSettings, slow_prior
from flight.gnc.estimation.rigid_body import Parameters, RigidBody
from flight.gnc.guidance.one_axis.plant import SingleAxisPlant
from flight.gnc.guidance.one_axis.vmc import NODES
from flight.gnc.math.arrays import FloatArray
from flight.gnc.vision.startracker.detection import DetectionSettings
from flight.gnc.vision.startracker.frame_job import TrackerSettings
from flight.gnc.vision.startracker.solve import SolveSettings
from flight.gnc.vision.streaks.corners.settings import StreakSettings
from flight.gnc.vision.streaks.maximum_likelihood.settings import LikelihoodSettings
from flight.loop.fdir.coils.response import ResponseSettings
from flight.loop.fdir.coils.watch import CoilWatch, CoilWatchSettings
from flight.loop.imaging import ImagingSettings
from flight.loop.navigation import NavigationSettings
from flight.loop.state.content import Learned
from flight.loop.state.learning import start_from
from flight.schema.camera_model import camera_model
from flight.schema.sections import Camera, Config

SECOND_NS = 1_000_000_000


def surrounding_field(config: Config) -> FloatArray:
    """Return the field (3,) T in which the testbed hangs, reference axes."""
    return np.array([0.0, 0.0, -config.plant.field])


def dipole_per_ampere(config: Config) -> float:
    """Return n A of each coil, m^2."""
    return config.plant.coil_turns * config.plant.coil_area


def attitude_filter(
    config: Config, plant: SingleAxisPlant, learned: Mapping[str, Learned] | None = None
) -> tuple[AttitudeFilter, list[str]]:
    """Return the filter of a body on the thread, and why some of what was `learned` was not taken."""
    section, believed = config.estimation, config.plant
    body = RigidBody(
        np.eye(3) * plant.inertia,
        believed.coil_turns * believed.coil_area,
        surrounding_field(config),
        suspended=True,
        stiffness=plant.stiffness,
        damping=plant.damping,
    )
    settings = FilterSettings(
        current_noise=section.current_noise,
        control_period=1.0 / config.executive.control_rate_hz,
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
    prior, problems = start_from(learned or {}, slow_prior(body, settings), section.changed)
    return AttitudeFilter(body, settings, prior), problems


def navigation_settings(config: Config, plant: SingleAxisPlant) -> NavigationSettings:
    """Return what navigation must know of the unit and the thread."""
    section = config.estimation
    return NavigationSettings(
        config.inertial_unit.angle_noise,
        config.inertial_unit.rate_noise,
        round(config.inertial_unit.max_age * SECOND_NS),
        round(section.coast * SECOND_NS),
        round(SECOND_NS / config.executive.control_rate_hz),
        Parameters(plant.stiffness / plant.inertia, plant.damping / plant.inertia),
        surrounding_field(config),
    )


def detumbler(config: Config, plant: SingleAxisPlant) -> Detumbler:
    """Return the law and the windows of detumbling."""
    section = config.detumble
    settle_ns, measure_ns, act_ns = (
        round(seconds * SECOND_NS) for seconds in (section.settle, section.measure, section.act)
    )
    schedule = WindowSchedule(settle_ns, measure_ns, act_ns)
    turning = section.field_turn > 0.0
    share = share_in_turning_field(section.field_turn, schedule) if turning else section.share
    return Detumbler(schedule, Braking(plant.inertia, dipole_per_ampere(config), plant.current_limit, share))


def coil_watch(config: Config, plant: SingleAxisPlant) -> CoilWatch:
    """Return the watch over the coils' circuit."""
    x, y, z = (config.coils.supply_voltage / resistance for resistance in config.coils.resistance)
    response = ResponseSettings(
        np.eye(3) * plant.inertia,
        dipole_per_ampere(config),
        config.inertial_unit.rate_noise,
        free=(False, True, False),
    )
    return CoilWatch(CoilWatchSettings((x, y, z), response=response))


def planning_settings(config: Config) -> PlanningSettings:
    """Return how paths are asked for."""
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


def imaging_settings(camera: Camera, unrest: float) -> ImagingSettings:
    """Return the camera as vision must know it; `unrest` as `ImagingSettings` has it."""
    return ImagingSettings(
        camera=camera_model(camera),
        exposure_ns=round(camera.exposure * SECOND_NS),
        max_age_ns=round(camera.max_age * SECOND_NS),
        late_ns=round(camera.late_after * SECOND_NS),
        slow_ns=round(camera.vision_slow_after * SECOND_NS),
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
