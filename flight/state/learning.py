"""What of an estimate is worth keeping over a boot: what belongs to the devices, not to the motion."""

from __future__ import annotations

import numpy as np

from flight.arrays import FloatArray
from flight.estimation.estimate import BIAS, FIELD_BIAS, LATENCY, PARAMETERS, Estimate
from flight.state.content import Learned

GYRO_BIAS, PLANT, IMU_LATENCY, MAGNETOMETER_BIAS = "gyro-bias", "plant", "imu-latency", "magnetometer-bias"


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
