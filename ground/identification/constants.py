"""What identification looks for: the constants of the motion per inertia, and the size of the noise."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from knightcube.astro.arrays import FloatArray


@dataclass(frozen=True, slots=True)
class Constants:
    """The fitted constants, each divided by the inertia, as motion shows it.

    Attributes:
        gain: g = n A B / J, rad/s^2/A.
        torsion: kappa = k / J, 1/s^2.
        damping: delta = c / J, 1/s.
        disturbance: d, rad/s^2; in it the thread's angle of rest, kappa theta_0.
        bias: b of the gyro, rad/s.
        delay: tau, s from the cycle that wrote a current to its effect.
    """

    gain: float
    torsion: float
    damping: float
    disturbance: float = 0.0
    bias: float = 0.0
    delay: float = 0.0

    def to_array(self) -> FloatArray:
        """Return them as (6,), in order of the fields."""
        return np.array([getattr(self, name) for name in NAMES])

    @classmethod
    def of(cls, values: FloatArray) -> Constants:
        """Return them from an array (6,)."""
        return cls(*(float(value) for value in values))


NAMES = tuple(field.name for field in fields(Constants))
UNITS = dict(zip(NAMES, ("rad/s^2/A", "1/s^2", "1/s", "rad/s^2", "rad/s", "s"), strict=True))


@dataclass(frozen=True, slots=True)
class Noise:
    """Standard deviations: of the current in a coil that is on, A, and of a sample's angle and rate."""

    current: float
    angle: float
    rate: float

    def to_logarithms(self) -> FloatArray:
        """Return their logarithms (3,)."""
        return np.log([self.current, self.angle, self.rate])

    @classmethod
    def of_logarithms(cls, values: FloatArray) -> Noise:
        """Return them from their logarithms (3,)."""
        return cls(*(float(value) for value in np.exp(values)))
