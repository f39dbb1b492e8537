"""Simulated runs for filter tests: a suspended or free body, IMU samples, and commands."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import from_rotation_vector, multiply
from knightcube.gnc.estimation.attitude_filter import AttitudeFilter, AttitudeFilterSettings
from knightcube.gnc.estimation.estimate import AttitudeMeasurement, Parameters, RateMeasurement
from knightcube.gnc.estimation.rigid_body import RigidBody
from tests.support.consistency_worlds import (
    CYCLE_NS,
    DIPOLE,
    INERTIA,
    KNOWN_PLANT,
    TESTBED_FIELD,
    FreeWorld,
    SuspendedWorld,
)

SUSPENDED = RigidBody(INERTIA, DIPOLE, TESTBED_FIELD, suspended=True)
FREE = RigidBody(INERTIA, DIPOLE, TESTBED_FIELD)
SETTINGS = replace(
    KNOWN_PLANT,
    current_noise=2.02e-3,
    disturbance_walk=1e-4,
    disturbance_start=1e-2,
    torsion_start=0.02,
    damping_start=3e-3,
    gain_start=0.1,
)
TURN_SIGMA, RATE_SIGMA = 2.02e-3, 1.01e-4
TURN_COVARIANCE: FloatArray = np.eye(3) * TURN_SIGMA**2
RATE_COVARIANCE: FloatArray = np.eye(3) * RATE_SIGMA**2


@dataclass(frozen=True, slots=True)
class Flight:
    """True attitudes (n, 4), rates (n, 3), samples and commands; cycle k begins at k * CYCLE_NS."""

    attitudes: FloatArray
    rates: FloatArray
    fields: list[FloatArray]
    commands: list[FloatArray]
    samples: list[tuple[AttitudeMeasurement, RateMeasurement]]
    bias: FloatArray
    parameters: Parameters


def fly(
    seed: int,
    cycles: int,
    suspended: bool,
    amplitude: float = 0.05,
    driven: Callable[[int, FloatArray], FloatArray] = lambda _, command: command,
) -> Flight:
    """Return a flight with noise of IMU and coils, a gyro bias, and a suspension thread or drag.

    `amplitude` (A) is the amplitude of the currents. `driven` returns the true currents for a cycle and its
    command.
    """
    rng = np.random.default_rng(seed)
    world = SuspendedWorld(rng) if suspended else FreeWorld(rng)
    bias = rng.normal(0.0, 1e-3, 3)
    flight = Flight(np.empty((cycles, 4)), np.empty((cycles, 3)), [], [], [], bias, world.parameters)
    for cycle in range(cycles):
        flight.attitudes[cycle], flight.rates[cycle] = world.attitude, world.rate
        flight.fields.append(world.field())
        seen = multiply(from_rotation_vector(rng.normal(0.0, TURN_SIGMA, 3)), world.attitude)
        measured = world.rate + bias + rng.normal(0.0, RATE_SIGMA, 3)
        flight.samples.append(
            (
                AttitudeMeasurement(cycle * CYCLE_NS, seen, TURN_COVARIANCE),
                RateMeasurement(cycle * CYCLE_NS, measured, RATE_COVARIANCE),
            )
        )
        swing = amplitude * math.sin(0.015 * cycle)
        command = np.array([swing, 0.0, 0.0]) if suspended else np.array([swing, -swing, 0.5 * swing])
        flight.commands.append(command)
        world.command(driven(cycle, command))
        world.advance(CYCLE_NS)
    return flight


def begin(flight: Flight, suspended: bool, settings: AttitudeFilterSettings = SETTINGS) -> AttitudeFilter:
    """Return a filter that starts on the first sample of a flight."""
    filter_ = AttitudeFilter(SUSPENDED if suspended else FREE, settings)
    filter_.start(*flight.samples[0])
    filter_.command(0, flight.commands[0], flight.fields[0])
    return filter_


def follow(filter_: AttitudeFilter, flight: Flight, first: int = 1, last: int | None = None) -> None:
    """Run a filter over the cycles `first` to `last` - 1 of a simulated run."""
    for cycle in range(first, len(flight.samples) if last is None else last):
        for sample in flight.samples[cycle]:
            filter_.measure(sample)
        filter_.command(cycle * CYCLE_NS, flight.commands[cycle], flight.fields[cycle])
