"""The plant model of a configuration."""

from __future__ import annotations

from flight.gnc.guidance.one_axis.plant import SingleAxisPlant
from flight.schema.sections import Config


def plant_of(config: Config) -> SingleAxisPlant:
    """Return the plant model that planner, tracker and filter use."""
    believed = config.plant
    return SingleAxisPlant(
        inertia=believed.inertia,
        torque_constant=believed.coil_turns * believed.coil_area * believed.field,
        resistance=config.coils.resistance[0],
        current_limit=min(
            config.coils.current_limit, config.coils.supply_voltage / config.coils.resistance[0]
        ),
        stiffness=believed.thread_stiffness,
        damping=believed.thread_damping,
    )


def angular_acceleration_psd_of(config: Config, plant: SingleAxisPlant) -> float:
    """Return the power spectral density of the angular acceleration by current noise, rad^2/s^3."""
    noise = plant.torque_constant / plant.inertia * config.estimation.current_noise
    return noise**2 / config.executive.control_rate_hz
