"""What an identification flight and its fit start from: the user's own configuration."""

from __future__ import annotations

import msgspec

from flight.schema import reader as configuration
from flight.schema.document import to_yaml
from flight.schema.testbed import Step, TestbedConfig
from ground.identification.constants import Constants, Noise
from ground.identification.scale import Belief, Beliefs

DURATION = 200.0
"""s: each manoeuvre once with either sign, and the time in between."""


def excitation_config(config: TestbedConfig, duration: float) -> TestbedConfig:
    """Return `config` with `duration` s of the excitation in place of its steps, without camera or paths."""
    return configuration.replace(
        config,
        name=f"identify {config.name}"[:64],
        camera=None,
        guidance=configuration.replace(config.guidance, strategy="step"),
        control=configuration.replace(config.control, tracker="excitation"),
        steps=(Step(at=0.0, q2=0.0),),
        duration=duration,
    )


def config_text(config: TestbedConfig) -> str:
    """Return a configuration as text that `flight.schema.reader` reads back as the same."""
    return to_yaml(msgspec.to_builtins(config))


def beliefs_of(config: TestbedConfig) -> Beliefs:
    """Return what a configuration believes of the scale, and how firmly."""
    plant, known = config.plant, config.identification
    return Beliefs(
        inertia=Belief(plant.inertia, known.inertia_error),
        dipole=Belief(plant.coil_turns * plant.coil_area, known.dipole_error),
        field=Belief(plant.field, known.field_error),
        magnetometer_error=known.magnetometer_error,
    )


def believed_constants(config: TestbedConfig) -> Constants:
    """Return the constants per inertia that a configuration believes in."""
    plant = config.plant
    gain = plant.coil_turns * plant.coil_area * plant.field / plant.inertia
    return Constants(gain, plant.thread_stiffness / plant.inertia, plant.thread_damping / plant.inertia)


def noise_of(config: TestbedConfig) -> Noise:
    """Return the noise that a configuration believes in, where a fit begins."""
    unit = config.inertial_unit
    return Noise(max(config.estimation.current_noise, 1e-4), unit.angle_noise, unit.rate_noise)
