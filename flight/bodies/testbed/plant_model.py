"""The plant that a configuration believes in."""

from __future__ import annotations

from flight.gnc.guidance.one_axis.plant import SingleAxisPlant
from flight.schema.sections import Config


def plant_of(config: Config) -> SingleAxisPlant:
    """Return the plant that the configuration believes in."""
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


def unrest_of(config: Config, plant: SingleAxisPlant) -> float:
    """Return the density of the angular acceleration that the coils' uncertain current makes, rad^2/s^3."""
    noise = plant.torque_constant / plant.inertia * config.estimation.current_noise
    return noise**2 / config.executive.control_rate_hz
