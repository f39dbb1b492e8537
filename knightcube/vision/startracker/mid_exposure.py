"""The difference between a frame's measured attitude and the attitude at mid-exposure.

At a constant rate the middle of a streak is the star's place at mid-exposure. An acceleration a shifts the
mean of a point's light by a T^2 / 24 and the middle of a streak's two ends by a T^2 / 8; a fit that includes
the acceleration is shifted by terms beyond the square of time only. White angular acceleration of density q
adds the variance q T^3 over 320, 48 and 4743 (the integrals of its second integral over the same weights).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.vision.streaks.maximum_likelihood.result import MotionResult
from knightcube.vision.streaks.streak_result import StreakResult, StreakStatus

NODES = (0.0, 0.25, 0.75, 1.0)
"""Parts of the exposure at which the turn from its middle is evaluated."""
MOVED = {StreakStatus.RATE, StreakStatus.AMBIGUOUS}


@dataclass(frozen=True, slots=True)
class Weighting:
    """How a frame's attitude averages the attitudes during its exposure.

    Attributes:
        weights: of the turns at `NODES`; the remainder to one is the weight of the middle.
        noise_share: variance by white angular acceleration, over q T^3.
    """

    weights: tuple[float, float, float, float]
    noise_share: float


MEAN = Weighting((1 / 12, 1 / 3, 1 / 3, 1 / 12), 1 / 320)
"""Points: the mean over the exposure, by Simpson's rule."""
ENDS = Weighting((1 / 2, 0.0, 0.0, 1 / 2), 1 / 48)
"""Streaks fitted at a constant rate, whose ends decide, or measured at their ends alone."""
MIDDLE = Weighting((-2 / 35, 8 / 35, 8 / 35, -2 / 35), 1 / 4743)
"""Streaks fitted with an acceleration: the middle of the parabola nearest to the motion."""


def weighting_of(motion: StreakResult | MotionResult) -> Weighting:
    """Return the weighting of a frame with such motion."""
    if motion.status not in MOVED:
        return MEAN
    fitted = isinstance(motion, MotionResult) and motion.rate_model == "accelerating"
    return MIDDLE if fitted else ENDS


def middle_covariance(
    weighting: Weighting, turns: FloatArray, angular_acceleration_psd: FloatArray, exposure: float
) -> FloatArray:
    """Return the covariance (3, 3) rad^2 of the measured attitude about that of mid-exposure.

    Args:
        weighting: of the frame.
        turns: (4, 3) rad, by the estimate, from mid-exposure to each of `NODES`.
        angular_acceleration_psd: (3, 3) rad^2/s^3, density of unmodelled white angular acceleration.
        exposure: s.
    """
    known = np.asarray(weighting.weights) @ turns
    return np.outer(known, known) + angular_acceleration_psd * weighting.noise_share * exposure**3


def timing_covariance(motion: MotionResult) -> FloatArray:
    """Return the covariance (3, 3) rad^2 of the turn that all stars of a frame share as error.

    If the rate changes, only the light along a streak shows where its middle was. A wrong acceleration makes
    all stars early or late by the same time, which no number of stars averages out. The best star's
    uncertainty along its path bounds it.
    """
    if motion.acceleration is None or motion.rate is None:
        return np.zeros((3, 3))
    velocity = (motion.endpoints[:, 1] - motion.endpoints[:, 0]) / motion.exposure
    speed = np.linalg.norm(velocity, axis=1)
    moving = motion.used & (speed > 0.0)
    if not moving.any():
        return np.zeros((3, 3))
    along = np.einsum("ni,nij,nj->n", velocity, motion.star_covariance, velocity)[moving]
    return np.outer(motion.rate, motion.rate) * float(np.min(along / speed[moving] ** 4))
