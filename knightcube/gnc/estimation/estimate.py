"""The filter's estimate: attitude, rate, gyro bias and disturbance with their covariance."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.gnc.estimation.rigid_body import Parameters

TURN, RATE, BIAS, DISTURBANCE, PARAMETERS = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12), slice(12, 15)
LATENCY = 15
FIELD_BIAS = slice(16, 19)
"""Where the parts of the error stand in the covariance (19, 19)."""


class Knowledge(Enum):
    """How well the attitude is known."""

    FINE = "fine"
    COARSE = "coarse"
    LOST = "lost"


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """The state at `time_ns`.

    Attributes:
        quaternion: (4,) reference into body.
        rate: (3,) rad/s, body axes.
        bias: (3,) rad/s, of the gyro.
        disturbance: (3,) rad/s^2, angular acceleration that the model does not account for.
        parameters: of the model: the thread's torsion and damping, the coils' gain.
        covariance: (19, 19) of small turns about the body's axes, rate, and so on (TURN, RATE, ...).
        measured_ns: the time of the newest measurement in it: its age says whether to trust it.
        latency: s, by which the inertial unit's samples are older than they say.
        field_bias: (3,) T, what the magnetometer reads too much, body axes.
    """

    time_ns: int
    quaternion: FloatArray
    rate: FloatArray
    bias: FloatArray
    disturbance: FloatArray
    parameters: Parameters
    covariance: FloatArray
    measured_ns: int
    latency: float = 0.0
    field_bias: FloatArray = field(default_factory=lambda: np.zeros(3))
