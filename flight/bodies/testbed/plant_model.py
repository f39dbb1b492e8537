"""The plant model of a configuration."""

from __future__ import annotations

from flight.schema.testbed import TestbedConfig
from knightcube.gnc.guidance.one_axis.plant import SingleAxisPlant


def plant_of(config: TestbedConfig) -> SingleAxisPlant:
    """Return the plant model that planner, tracker and filter use."""
    section = config.plant
    return SingleAxisPlant(
        inertia=section.inertia,
        torque_constant=section.coil_turns * section.coil_area * section.field,
        resistance=config.coils.resistance[0],
        current_limit=min(
            config.coils.current_limit, config.coils.supply_voltage / config.coils.resistance[0]
        ),
        stiffness=section.thread_stiffness,
        damping=section.thread_damping,
    )


def angular_acceleration_psd_of(config: TestbedConfig, plant: SingleAxisPlant) -> float:
    """Return the power spectral density of the angular acceleration due to current noise, rad^2/s^3."""
    noise = plant.torque_constant / plant.inertia * config.estimation.current_noise
    return noise**2 / config.executive.control_rate_hz
