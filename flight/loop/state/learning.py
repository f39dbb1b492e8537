"""What of an estimate is worth keeping over a boot: what belongs to the devices, not to the motion.

The next boot starts from it, with a spread that allows for what may have changed meanwhile: a share of what
the configuration allows a start that knows nothing. What lies outside of that belief is not taken.
"""

from __future__ import annotations

import dataclasses
import zlib
from collections.abc import Mapping

import msgspec
import numpy as np

from flight.gnc.estimation.estimate import BIAS, FIELD_BIAS, LATENCY, PARAMETERS, Estimate
from flight.gnc.estimation.rigid_body import Parameters
from flight.gnc.estimation.slow_prior import SlowPrior
from flight.gnc.math.arrays import FloatArray
from flight.loop.state.content import Learned
from flight.schema.sections import Config

GYRO_BIAS, PLANT, IMU_LATENCY, MAGNETOMETER_BIAS = "gyro-bias", "plant", "imu-latency", "magnetometer-bias"

_BELIEVED = 4.0
"""Sigmas of a start that knows nothing: what was learned further from it is not believed."""


def learned_of(estimate: Estimate) -> dict[str, Learned]:
    """Return the estimate's slow parts by name, in its units and axes.

    The gyro's bias; torsion, damping and coil gain of the plant; the age of the inertial unit's samples; the
    magnetometer's bias. What they have to do with each other is left out: each has its own covariance.
    """
    parts: dict[str, tuple[FloatArray, slice]] = {
        GYRO_BIAS: (estimate.bias, BIAS),
        PLANT: (np.array(estimate.parameters), PARAMETERS),
        IMU_LATENCY: (np.array([estimate.latency]), slice(LATENCY, LATENCY + 1)),
        MAGNETOMETER_BIAS: (estimate.field_bias, FIELD_BIAS),
    }
    return {
        name: Learned.of(values, estimate.covariance[where, where]) for name, (values, where) in parts.items()
    }


def digest_of(config: Config) -> str:
    """Return what stands for the devices of a configuration: what was learned of others is of no use."""
    devices = (config.plant, config.coils, config.inertial_unit)
    return f"{zlib.crc32(msgspec.json.encode(devices)):08x}"


def start_from(
    learned: Mapping[str, Learned], believed: SlowPrior, changed: float
) -> tuple[SlowPrior, list[str]]:
    """Return what the filter may start from, and why some of what was learned was not taken.

    `believed` is what holds without any learning; since the last boot a value may have changed by the part
    `changed` of its standard deviation there.
    """
    problems: list[str] = []

    def take(name: str, values: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
        if name not in learned:
            return values, covariance
        found, spread = learned[name].arrays()
        problem = _problem(found, values, covariance)
        if problem:
            problems.append(f"{name} {found.tolist()}: {problem}")
            return values, covariance
        return _widened(found, spread, values, covariance, changed)

    bias, bias_covariance = take(GYRO_BIAS, believed.bias, believed.bias_covariance)
    plant, plant_covariance = take(PLANT, np.array(believed.parameters), believed.parameters_covariance)
    age, age_covariance = take(
        IMU_LATENCY, np.array([believed.latency]), np.array([[believed.latency_variance]])
    )
    torsion, damping, gain = plant.tolist()
    prior = dataclasses.replace(
        believed,
        bias=bias,
        bias_covariance=bias_covariance,
        parameters=Parameters(torsion, damping, gain),
        parameters_covariance=plant_covariance,
        latency=float(age[0]),
        latency_variance=float(age_covariance[0, 0]),
    )
    return prior, problems


def _problem(found: FloatArray, values: FloatArray, covariance: FloatArray) -> str:
    """Return why what was learned cannot be true; empty where it can."""
    if found.shape != values.shape:
        return f"{len(values)} values are wanted"
    sigma = np.sqrt(np.diag(covariance))
    if np.any((sigma > 0.0) & (np.abs(found - values) > _BELIEVED * sigma)):
        return f"not within {_BELIEVED:g} sigma of {values.tolist()} +- {sigma.tolist()}"
    return ""


def _widened(
    found: FloatArray, spread: FloatArray, values: FloatArray, covariance: FloatArray, changed: float
) -> tuple[FloatArray, FloatArray]:
    """Return what was learned with what may have changed; what is not estimated stays what it is."""
    variance = np.diag(covariance)
    estimated = variance > 0.0
    both = np.outer(estimated, estimated)
    wide = np.where(both, spread, 0.0) + np.diag(changed**2 * variance)
    return np.where(estimated, found, values), wide
