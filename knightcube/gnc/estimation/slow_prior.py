"""The filter's prior of the states that change slowly or not at all."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.gnc.estimation.rigid_body import NOMINAL, Parameters


def _known(size: int) -> FloatArray:
    return np.zeros((size, size))


@dataclass(frozen=True, slots=True, eq=False)
class SlowPrior:
    """Values and covariances; a variance of zero means known and not estimated.

    Attributes:
        bias: (3,) rad/s of the gyro, and `bias_covariance` (3, 3).
        parameters: of the model, and `parameters_covariance` (3, 3).
        latency: s, age of the inertial unit's samples at their stamp, and `latency_variance`.
    """

    bias: FloatArray = dataclasses.field(default_factory=lambda: np.zeros(3))
    bias_covariance: FloatArray = dataclasses.field(default_factory=lambda: _known(3))
    parameters: Parameters = NOMINAL
    parameters_covariance: FloatArray = dataclasses.field(default_factory=lambda: _known(3))
    latency: float = 0.0
    latency_variance: float = 0.0
