"""State, prior and estimate of the attitude filter, and the parameters of the model that it may estimate."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import NamedTuple

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.gnc.estimation.measurements import MeanRateMeasurement
from knightcube.gnc.estimation.rotation import Quaternion, Vector

ATTITUDE, RATE, BIAS, DISTURBANCE = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
PARAMETERS, LATENCY, FIELD_BIAS = slice(12, 15), 15, slice(16, 19)
"""Indices of the parts of the error state in the covariance (19, 19)."""
SIZE = 19
"""Size of the error state."""


class Parameters(NamedTuple):
    """Uncertain parameters of the model, which may be estimated.

    Attributes:
        torsion: 1/s^2, k / J22 of the thread.
        damping: 1/s, c / J22 of the thread.
        gain: ratio of the true to the modelled acceleration by the coils (dipole times field over inertia).
    """

    torsion: float = 0.0
    damping: float = 0.0
    gain: float = 1.0


NOMINAL = Parameters()


class Knowledge(Enum):
    """Accuracy with which the attitude is known."""

    FINE = "fine"
    COARSE = "coarse"
    LOST = "lost"


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """The estimate at `time_ns`.

    Attributes:
        quaternion: (4,) reference into body.
        rate: (3,) rad/s, body axes.
        bias: (3,) rad/s, of the gyro.
        disturbance: (3,) rad/s^2, angular acceleration that the model does not contain.
        parameters: torsion and damping of the thread, gain of the coils.
        covariance: (19, 19) of the error state: small rotations about the body axes, rate, and so on.
        measured_ns: time of the newest measurement used.
        latency: s, age of the inertial unit's samples at their time stamp.
        field_bias: (3,) T, bias of the magnetometer, body axes.
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


class FilterState(NamedTuple):
    """The state of the filter at one time, as tuples of floats.

    Attributes:
        kept: attitudes at the starts of exposures, in order of time, each with its measurement.
        latency: s, age of the inertial unit's samples at their time stamp.
        field_bias: T, of the magnetometer, body axes.
    """

    quaternion: Quaternion
    rate: Vector
    bias: Vector
    disturbance: Vector
    parameters: Parameters
    kept: tuple[tuple[MeanRateMeasurement, Quaternion], ...] = ()
    latency: float = 0.0
    field_bias: Vector = (0.0, 0.0, 0.0)

    def kept_index(self, measurement: MeanRateMeasurement) -> int:
        """Return the index in `kept` of the attitude at the start of an exposure."""
        return next(index for index, (owner, _) in enumerate(self.kept) if owner is measurement)


@dataclass(frozen=True, slots=True, eq=False)
class SlowPrior:
    """Prior of the states that change slowly or not at all; a variance of zero marks a known state.

    Attributes:
        bias: (3,) rad/s of the gyro, and `bias_covariance` (3, 3).
        parameters: of the model, and `parameters_covariance` (3, 3).
        latency: s, age of the inertial unit's samples at their time stamp, and `latency_variance`.
    """

    bias: FloatArray = field(default_factory=lambda: np.zeros(3))
    bias_covariance: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))
    parameters: Parameters = NOMINAL
    parameters_covariance: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))
    latency: float = 0.0
    latency_variance: float = 0.0
