"""How the camera turned over an exposure as it is known from elsewhere: by the gyro and the commanded torque.

The pixels give the rate and its even change. What else the rate did, a step within the exposure for one, they
show less well than navigation knows it: those terms of the motion are taken as known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.vision.streaks.maximum_likelihood.motion import Motion

_DEGREE = 7
# A course within this many px of a constant rate counts as constant; it is sampled at _INSTANTS.
_UNEVEN = 0.05
_INSTANTS = 65
# Its rate must be known to this many px an exposure.
_MOST_VAGUE = 3.0
# Taken as known, it shifts the mean rate by this part of its deviation.
_SHARE = 0.15


@dataclass(frozen=True, slots=True, eq=False)
class Course:
    """A known turn.

    Attributes:
        terms: (k, 3) rad, coefficients of t, t^2, ... of the rotation vector since mid-exposure, t in
            exposures, camera axes.
        sigma: rad, standard deviation of the rate times the exposure.
    """

    terms: FloatArray
    sigma: float

    @classmethod
    def of_rates(cls, rates: FloatArray, exposure: float, sigma: float) -> Course:
        """Return the course of `rates` (n, 3) rad/s, known to `sigma`, at even times over `exposure` s."""
        times = np.linspace(-0.5, 0.5, len(rates))[:, None]
        powers = np.arange(_DEGREE)
        fitted = np.linalg.lstsq(times**powers, rates, rcond=None)[0]
        missed = float(np.sqrt(np.mean(np.sum((rates - times**powers @ fitted) ** 2, axis=1))))
        return cls(fitted * exposure / (powers[:, None] + 1.0), exposure * float(np.hypot(sigma, missed)))

    def motion(self, focal_length: float) -> Motion | None:
        """Return the motion for a camera of `focal_length` px; None where vague, or as good as constant."""
        motion = Motion(self.terms[0], 2.0 * self.terms[1], self.terms[2:])
        time = np.linspace(-0.5, 0.5, _INSTANTS)
        uneven = (motion.progress(time) - time) * float(np.linalg.norm(motion.whole)) * focal_length
        return motion if np.ptp(uneven) > _UNEVEN and self.sigma * focal_length < _MOST_VAGUE else None

    def covariance(self, exposure: float) -> FloatArray:
        """Return what taking the course as known adds to the covariance (3, 3) rad^2/s^2 of the mean rate."""
        return np.eye(3) * (_SHARE * self.sigma / exposure) ** 2
