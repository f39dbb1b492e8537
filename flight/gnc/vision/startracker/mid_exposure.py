"""By how much the attitude that a frame gives may differ from that of mid-exposure.

Under a constant rate the middle of a streak is the star's place at mid-exposure. A body that speeds up or is
shaken was elsewhere: the mean of a point's light is drawn off by a T^2 / 24, the middle of a streak's two
ends by a T^2 / 8; a fit that knows of the acceleration is drawn off by what is left beyond the square of
time. White angular acceleration of density q leaves q T^3 over 320, 48 and 4743 (the integrals of its second
integral over the same weights).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flight.gnc.math.arrays import FloatArray
from flight.gnc.vision.streaks.maximum_likelihood.result import MotionResult
from flight.gnc.vision.streaks.streak_result import StreakResult, StreakStatus

NODES = (0.0, 0.25, 0.75, 1.0)
"""Parts of the exposure at which the turn away from its middle is asked."""
MOVED = {StreakStatus.RATE, StreakStatus.AMBIGUOUS}


@dataclass(frozen=True, slots=True)
class Weighting:
    """How a frame's attitude comes from the attitudes during its exposure.

    Attributes:
        weights: of the turns at `NODES`; that of the middle, the rest to one, has no turn.
        shaken: variance that white acceleration leaves, over q T^3.
    """

    weights: tuple[float, float, float, float]
    shaken: float


MEAN = Weighting((1 / 12, 1 / 3, 1 / 3, 1 / 12), 1 / 320)
"""Points: the mean over the exposure, by Simpson's rule."""
ENDS = Weighting((1 / 2, 0.0, 0.0, 1 / 2), 1 / 48)
"""Streaks fitted at a constant rate, whose ends hold them, or known by their ends alone."""
MIDDLE = Weighting((-2 / 35, 8 / 35, 8 / 35, -2 / 35), 1 / 4743)
"""Streaks fitted with an acceleration: the middle of the parabola nearest to the motion."""


def weighting_of(motion: StreakResult | MotionResult) -> Weighting:
    """Return how the attitude of a frame of such motion comes about."""
    if motion.status not in MOVED:
        return MEAN
    fitted = isinstance(motion, MotionResult) and motion.rate_model == "accelerating"
    return MIDDLE if fitted else ENDS


def middle_covariance(
    weighting: Weighting, turns: FloatArray, angular_acceleration_psd: float, exposure: float
) -> FloatArray:
    """Return by how much the attitude is in doubt, (3, 3) rad^2.

    Args:
        weighting: of the frame.
        turns: (4, 3) rad, as the estimate has them, from mid-exposure to each of `NODES`.
        angular_acceleration_psd: rad^2/s^3, density of the white angular acceleration that nobody knows of.
        exposure: s.
    """
    known = np.asarray(weighting.weights) @ turns
    return np.outer(known, known) + np.eye(3) * angular_acceleration_psd * weighting.shaken * exposure**3


def timing_covariance(motion: MotionResult) -> FloatArray:
    """Return the covariance (3, 3) rad^2 of the turn by which all stars of a frame may be off together.

    Where the rate changes, the ends hold a streak and only its light along the path tells where the middle
    was: if the acceleration is wrong all stars are early or late by the same time, and no number of stars
    averages that out. No star's own uncertainty along its path is less than it.
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
