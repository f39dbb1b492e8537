"""The learned parameters: the parts of an estimate that belong to the devices, not to the motion.

The next boot starts from them, with the covariance increased by a fraction of the configured prior, for
changes meanwhile. Values that the prior makes implausible are rejected.
"""

from __future__ import annotations

import dataclasses
import zlib
from collections.abc import Mapping

import msgspec
import numpy as np

from flight.loop.state.content import Learned
from flight.schema.sections import Config
from knightcube.astro.arrays import FloatArray
from knightcube.gnc.estimation.estimate import BIAS, FIELD_BIAS, LATENCY, PARAMETERS, Estimate
from knightcube.gnc.estimation.rigid_body import Parameters
from knightcube.gnc.estimation.slow_prior import SlowPrior

GYRO_BIAS, PLANT, IMU_LATENCY, MAGNETOMETER_BIAS = "gyro-bias", "plant", "imu-latency", "magnetometer-bias"

_BELIEVED = 4.0
"""Sigmas of the configured prior: learned values further from the prior are rejected."""


def learned_of(estimate: Estimate) -> dict[str, Learned]:
    """Return the estimate's slow parts by name, in its units and axes.

    The gyro's bias; torsion, damping and coil gain of the plant; the age of the inertial unit's samples; the
    magnetometer's bias. Cross-covariances are dropped.
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
    """Return a digest of the devices of a configuration."""
    return f"{zlib.crc32(msgspec.json.encode(config.hardware())):08x}"


def start_from(
    learned: Mapping[str, Learned], configured: SlowPrior, changed: float
) -> tuple[SlowPrior, list[str]]:
    """Return the filter's prior, and why learned parameters were rejected.

    `configured` is the prior without learning; since the last boot a value may have changed by the fraction
    `changed` of its standard deviation in `configured`.
    """
    problems: list[str] = []

    def accept(name: str, values: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
        if name not in learned:
            return values, covariance
        found, spread = learned[name].arrays()
        problem = _problem(found, values, covariance)
        if problem:
            problems.append(f"{name} {found.tolist()}: {problem}")
            return values, covariance
        return _widened(found, spread, values, covariance, changed)

    bias, bias_covariance = accept(GYRO_BIAS, configured.bias, configured.bias_covariance)
    plant, plant_covariance = accept(PLANT, np.array(configured.parameters), configured.parameters_covariance)
    age, age_covariance = accept(
        IMU_LATENCY, np.array([configured.latency]), np.array([[configured.latency_variance]])
    )
    torsion, damping, gain = plant.tolist()
    prior = dataclasses.replace(
        configured,
        bias=bias,
        bias_covariance=bias_covariance,
        parameters=Parameters(torsion, damping, gain),
        parameters_covariance=plant_covariance,
        latency=float(age[0]),
        latency_variance=float(age_covariance[0, 0]),
    )
    return prior, problems


def _problem(found: FloatArray, values: FloatArray, covariance: FloatArray) -> str:
    """Return why a learned value is implausible; empty when plausible."""
    if found.shape != values.shape:
        return f"{len(values)} values are wanted"
    sigma = np.sqrt(np.diag(covariance))
    if np.any((sigma > 0.0) & (np.abs(found - values) > _BELIEVED * sigma)):
        return f"not within {_BELIEVED:g} sigma of {values.tolist()} +- {sigma.tolist()}"
    return ""


def _widened(
    found: FloatArray, spread: FloatArray, values: FloatArray, covariance: FloatArray, changed: float
) -> tuple[FloatArray, FloatArray]:
    """Return learned values with the increased covariance; values not estimated stay as configured."""
    variance = np.diag(covariance)
    estimated = variance > 0.0
    both = np.outer(estimated, estimated)
    wide = np.where(both, spread, 0.0) + np.diag(changed**2 * variance)
    return np.where(estimated, found, values), wide
