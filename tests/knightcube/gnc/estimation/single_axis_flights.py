"""Simulated runs about one axis that several tests of the estimation share."""

from __future__ import annotations

import math

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.gnc.guidance.plant import SingleAxisPlant
from tests.knightcube.gnc.estimation.single_axis import ANGLE, RATE, Measurement, SingleAxisSettings

PLANT = SingleAxisPlant(inertia=1.05e-3, torque_constant=2.916e-4, resistance=23.0, current_limit=0.148)


SETTINGS = SingleAxisSettings(current_noise=2.02e-3, control_period=0.025, disturbance_walk=5e-4)


PERIOD = 25_000_000


ANGLE_SIGMA, RATE_SIGMA = 2.02e-3, 1.01e-4


def simulate(
    rng: np.random.Generator, cycles: int, stiffness: float = 1e-5
) -> tuple[FloatArray, list[float], list[Measurement]]:
    """Return truth (cycles, 2) of angle and rate, commands and noisy measurements of a suspended body."""
    angle, rate = rng.normal(0.0, 0.3), rng.normal(0.0, 0.02)
    truth, commands, measurements = np.empty((cycles, 2)), [], []
    for cycle in range(cycles):
        truth[cycle] = angle, rate
        time_ns = cycle * PERIOD
        angle_error, rate_error = rng.uniform(-1, 1, 2) * math.sqrt(3.0) * [ANGLE_SIGMA, RATE_SIGMA]
        measurements.append(Measurement(time_ns, ANGLE, angle + angle_error, ANGLE_SIGMA**2))
        measurements.append(Measurement(time_ns, RATE, rate + rate_error, RATE_SIGMA**2))
        command = 0.05 * math.sin(0.01 * cycle)
        commands.append(command)
        actual = command + rng.uniform(-3.5e-3, 3.5e-3)
        for _ in range(10):
            torque = PLANT.torque_constant * actual * math.cos(angle) - stiffness * angle
            rate += torque / PLANT.inertia * 0.0025
            angle += rate * 0.0025
    return truth, commands, measurements
