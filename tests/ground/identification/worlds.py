"""Simulated testbeds that differ from the configured testbed by the stated accuracies, and their flights."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from flight.bodies.testbed.control import plant_of
from flight.schema import reader as configuration
from flight.schema.bodies import Identification, TestbedConfig
from ground.identification.fit import (
    DIPOLE_ERROR,
    FIELD_ERROR,
    INERTIA_ERROR,
    MAGNETOMETER_ERROR,
    AbsolutePlant,
    MotionConstants,
    excitation_config,
)
from ground.identification.record import HorizontalField, Record, read_record
from knightcube.astro.arrays import FloatArray
from knightcube.gnc.control.one_axis import ExcitationController, ExcitationSettings
from knightcube.gnc.guidance.plant import PathSample
from sim_hal.settings import ImuNoise, Simulation, Thread, Truth
from sim_hal.worlds.testbed import Testbed, TestbedModel
from tests.support import flights

PERIOD = 0.025
ANGLE_BOUND, RATE_BOUND, CURRENT_BOUND = 2.0 * 1.75e-3, 1.75e-4, 3.5e-3
"""Bounds of the uniform noise of the angle (2 q2), of the rate, and of the current in a driven coil."""


@dataclass(frozen=True)
class World:
    """True constants of a testbed.

    `dipole` is the dipole moment per commanded ampere, and `magnetometer` is the scale factor of the sensor.
    """

    inertia: float
    dipole: float
    field: float
    stiffness: float
    damping: float
    bias: float = 0.0
    magnetometer: float = 1.0
    seed: int = 1

    @property
    def constants(self) -> MotionConstants:
        """True gain, torsion and damping, each divided by the inertia, and the true bias."""
        return MotionConstants(
            gain=self.dipole * self.field / self.inertia,
            torsion=self.stiffness / self.inertia,
            damping=self.damping / self.inertia,
            bias=self.bias,
        )


def believed() -> TestbedConfig:
    """Return the configuration that the flight software assumes."""
    return flights.demo_config(200.0, camera=False)


def drawn(rng: np.random.Generator) -> World:
    """Return a random world with the stated scale errors and up to three times the usual stiffness."""
    config = believed()
    plant = config.plant

    def about(value: float, error: float) -> float:
        return value * math.exp(error * float(np.clip(rng.standard_normal(), -3.0, 3.0)))

    return World(
        inertia=about(plant.inertia, INERTIA_ERROR),
        dipole=about(plant.coil_turns * plant.coil_area, DIPOLE_ERROR),
        field=about(plant.field, FIELD_ERROR),
        stiffness=rng.uniform(0.0, 3.0e-5),
        damping=rng.uniform(0.0, 6.0e-6),
        bias=1e-4 * rng.standard_normal(),
        magnetometer=about(1.0, MAGNETOMETER_ERROR),
        seed=int(rng.integers(1, 2**31)),
    )


def fly_stack(world: World, folder: Path, duration: float = 200.0) -> Record:
    """Run the excitation with drivers, loop and log.

    A wrong coil resistance represents an error of the dipole.
    """
    config = excitation_config(believed(), duration)
    resistance = config.coils.resistance[0] * config.plant.coil_turns * config.plant.coil_area / world.dipole
    section: Simulation = configuration.replace(
        flights.demo_world(),
        seed=world.seed,
        thread=Thread(stiffness=world.stiffness, damping=world.damping),
        truth=Truth(inertia=world.inertia, field=world.field, resistance=(resistance, 23.0, 23.0)),
        imu=ImuNoise(quaternion_noise=1.75e-3, rate_noise=1.75e-4, gyro_bias=(0.0, world.bias, 0.0)),
    )
    record = read_record(flights.fly(config, folder, section=section), config.coils.stale_after)
    if record.field is None:
        return record
    # The emulated magnetometer has no scale error, so the scale error of the world is applied to its samples
    # here.
    field = replace(record.field, magnitude=record.field.magnitude * world.magnetometer)
    return replace(record, field=field)


def usual_excitation() -> ExcitationSettings:
    """Return the default excitation."""
    move = Identification()
    return ExcitationSettings(move.current_share, move.largest_q2, move.swing)


def fly_bare(
    world: World, duration: float = 100.0, settings: ExcitationSettings | None = None, noise: float = 1.0
) -> Record:
    """Run the excitation on the testbed without drivers and filter. `noise` multiplies all noise."""
    rng = np.random.default_rng(world.seed)
    plant = plant_of(believed())
    controller = ExcitationController(plant, PERIOD, settings or usual_excitation())
    flowing: list[FloatArray] = [np.zeros(3)]
    testbed = Testbed(
        TestbedModel(
            world.inertia, world.dipole, world.field, world.stiffness, world.damping, (23.0, 23.0, 23.0), 3.4
        ),
        angle=0.3,
        release_rate=-0.05,
        currents=lambda: flowing[0],
    )
    testbed.release_at(0)
    count = round(duration / PERIOD)
    time, angle, rate, current = (np.zeros(count) for _ in range(4))
    uniform = noise * rng.uniform(-1.0, 1.0, (count, 3))
    rest = PathSample(0.0, 0.0, 0.0)
    testbed.advance_to(1)
    for k in range(count):
        testbed.advance_to(round(k * PERIOD * 1e9))
        time[k], angle[k], rate[k] = k * PERIOD, testbed.angle, testbed.rate
        current[k] = controller.command(rest, testbed.angle, testbed.rate).current
        on = current[k] != 0.0
        flowing[0] = np.array([current[k] + on * CURRENT_BOUND * uniform[k, 2], 0.0, 0.0])
    return Record(
        time=time,
        angle=angle + ANGLE_BOUND * uniform[:, 0],
        rate=rate + world.bias + RATE_BOUND * uniform[:, 1],
        switch_time=time,
        current=current,
        clipped=np.zeros(count, dtype=bool),
        period=PERIOD,
        field=HorizontalField(world.field * world.magnetometer, 0.0, count),
    )


def motion_error(world: World, constants: MotionConstants) -> FloatArray:
    """Return the errors (3,) of gain, torsion and damping: estimated minus true values."""
    return np.asarray(constants.to_array() - world.constants.to_array())[:3]


def scale_error(world: World, plant: AbsolutePlant) -> FloatArray:
    """Return the estimated minus the true values (6,) of ln J, ln n A, ln B, ln gain, torsion and damping."""
    true = world.constants
    gain = plant.torque_constant.value / plant.inertia.value
    return np.array(
        [
            math.log(plant.inertia.value / world.inertia),
            math.log(plant.dipole.value / world.dipole),
            math.log(plant.field.value / world.field),
            math.log(gain / true.gain),
            plant.stiffness.value / plant.inertia.value - true.torsion,
            plant.damping.value / plant.inertia.value - true.damping,
        ]
    )
