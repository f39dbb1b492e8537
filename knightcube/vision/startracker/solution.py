"""The result of the star tracker for one frame, and how its attitude relates to mid-exposure.

At a constant rate the middle of a streak is the position of the star at mid-exposure. An acceleration a
shifts the mean of a point's light by a T^2 / 24 and the middle of the two ends of a streak by a T^2 / 8. A
fit that includes the acceleration is shifted only by terms beyond the square of time. White angular
acceleration of density q adds the variance q T^3 over 320, 48 and 4743 respectively (the integrals of its
second integral over the same weights).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np

from knightcube.astro.arrays import FloatArray, IntArray
from knightcube.astro.attitude.wahba import AttitudeFix
from knightcube.vision.camera.lens import CameraModel
from knightcube.vision.startracker.detection import FrameKind
from knightcube.vision.startracker.sky_map import BENDS, SkyMap
from knightcube.vision.streaks.streak_result import MotionResult, StreakResult, StreakStatus


class SolveStatus(Enum):
    """The outcome of one frame."""

    SOLVED = "solved"
    NO_STARS = "no-stars"
    TOO_FEW_STARS = "too-few-stars"
    NO_MATCH = "no-match"
    AMBIGUOUS = "ambiguous"


@dataclass(frozen=True, slots=True, eq=False)
class FrameSolution:
    """The attitude of one frame at mid-exposure, and the rate if the stars are streaks.

    Attributes:
        status: the attributes from `star` on are valid for SOLVED only.
        reason: why the frame was not solved, in one sentence; empty if it was.
        kind: whether the frame shows points or streaks.
        camera: the camera, with the focal length fitted to the stars if it was free.
        points: positions of the detected stars at mid-exposure (n, 2), px, the brightest first.
        covariance: of the positions (n, 2, 2), px^2.
        late: displacement of the points by one standard deviation of the line time of the shutter (n, 2), px;
            (0, 2) if the line time is exact.
        star: numbers of the guide stars (n,); -1 for a point without one.
        expected: predicted positions of the guide stars (n, 2), px; NaN for a point without one.
        fix: attitude, ICRS to camera, and its covariance; the scalar part of the quaternion is not negative.
        scale_sigma: relative standard deviation of the focal length; 0 if it was given.
        bend: fitted errors of an inexact lens (6,), see `sky_map`; zeros for an exact lens.
        log10_false_alarm: log10 of the probability that a frame of random points would have been solved.
        tracked: whether the stars were identified near the prior attitude.
        motion: motion from the streaks, camera frame; None for points.
        mirrored: whether the image shows the mirrored sky. `fix` is then the attitude of the image with left
            and right exchanged about the optical axis; `points` and `expected` refer to the original image.
    """

    status: SolveStatus
    reason: str
    kind: FrameKind
    camera: CameraModel
    points: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    covariance: FloatArray = field(default_factory=lambda: np.empty((0, 2, 2)))
    late: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    star: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    expected: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    fix: AttitudeFix | None = None
    scale_sigma: float = 0.0
    bend: FloatArray = field(default_factory=lambda: np.zeros(BENDS))
    log10_false_alarm: float = 0.0
    tracked: bool = False
    motion: MotionResult | None = None
    mirrored: bool = False

    @property
    def matched(self) -> IntArray:
        """The numbers (m,) of the points that are guide stars."""
        return np.flatnonzero(self.star >= 0)

    def wider(self, by: FloatArray) -> FrameSolution:
        """Return the solution with `by` (3, 3), rad^2, added to the covariance of its attitude, if any."""
        if self.fix is None:
            return self
        return replace(self, fix=replace(self.fix, covariance=self.fix.covariance + by))

    def sky_map(self, velocity: FloatArray | None = None) -> SkyMap | None:
        """Return the conversion between pixels and directions; None if the frame was not solved.

        `velocity` (3,), m/s, is the velocity with which the frame was solved.
        """
        return None if self.fix is None else SkyMap(self.camera, self.fix.quaternion, self.bend, velocity)


NODES = (0.0, 0.25, 0.75, 1.0)
"""Fractions of the exposure at which the rotation since mid-exposure is evaluated."""
MOVED = {StreakStatus.RATE, StreakStatus.AMBIGUOUS}


@dataclass(frozen=True, slots=True)
class Weighting:
    """The weights with which the attitude of a frame averages the attitudes during its exposure.

    Attributes:
        weights: weights of the rotations at `NODES`; the remainder to one is the weight of mid-exposure.
        noise_share: variance due to white angular acceleration, in units of q T^3.
    """

    weights: tuple[float, float, float, float]
    noise_share: float


MEAN = Weighting((1 / 12, 1 / 3, 1 / 3, 1 / 12), 1 / 320)
"""Points: the mean over the exposure, by Simpson's rule."""
ENDS = Weighting((1 / 2, 0.0, 0.0, 1 / 2), 1 / 48)
"""Streaks fitted at a constant rate, which their ends determine, or measured at their ends alone."""
MIDDLE = Weighting((-2 / 35, 8 / 35, 8 / 35, -2 / 35), 1 / 4743)
"""Streaks fitted with an acceleration: the middle of the parabola that fits the motion best."""


def weighting_of(motion: StreakResult | MotionResult) -> Weighting:
    """Return the weighting of a frame with this motion."""
    if motion.status not in MOVED:
        return MEAN
    fitted = isinstance(motion, MotionResult) and motion.rate_model == "accelerating"
    return MIDDLE if fitted else ENDS


def middle_covariance(
    weighting: Weighting, turns: FloatArray, angular_acceleration_psd: FloatArray, exposure: float
) -> FloatArray:
    """Return the covariance (3, 3), rad^2, of the measured attitude relative to that at mid-exposure.

    Args:
        weighting: weighting of the frame.
        turns: estimated rotations from mid-exposure to each of `NODES` (4, 3), rad.
        angular_acceleration_psd: density of unmodelled white angular acceleration (3, 3), rad^2/s^3.
        exposure: exposure time, s.
    """
    known = np.asarray(weighting.weights) @ turns
    return np.outer(known, known) + angular_acceleration_psd * weighting.noise_share * exposure**3


def timing_covariance(motion: MotionResult) -> FloatArray:
    """Return the covariance (3, 3), rad^2, of the rotation error that all stars of a frame share.

    If the rate changes, only the light along a streak determines its position at mid-exposure. A wrong
    acceleration makes all stars early or late by the same time, which does not average out over the stars.
    The uncertainty of the best star along its path bounds this error.
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
