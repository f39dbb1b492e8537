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
from knightcube.vision.streaks.maximum_likelihood.result import MotionResult
from knightcube.vision.streaks.streak_result import StreakResult, StreakStatus


class SolveStatus(Enum):
    """The outcome of one frame."""

    SOLVED = "solved"
    NO_STARS = "no-stars"
    TOO_FEW_STARS = "too-few-stars"
    NO_MATCH = "no-match"
    AMBIGUOUS = "ambiguous"


@dataclass(frozen=True, slots=True, eq=False)
class FrameSolution:
    """Attitude at mid-exposure, and the rate where the stars are streaks.

    Attributes:
        status: the fields below `camera` hold for SOLVED only.
        reason: why it is not solved, in a sentence; empty when it is.
        kind: what the frame shows.
        points: (n, 2) px at mid-exposure of the points taken for stars, brightest first.
        covariance: (n, 2, 2) px^2.
        late: (n, 2) px by which one standard deviation of the shutter's line time displaces the points;
            (0, 2) where it is exact.
        camera: with the focal length fitted to the stars, if it was free.
        star: (n,) numbers of guide stars, -1 for none.
        expected: (n, 2) px, where attitude, lens and shutter put the guide star; NaN for none.
        fix: attitude, ICRS to camera, and its covariance; the smaller scalar part is not negative.
        scale_sigma: relative standard deviation of the focal length; 0 where it was given.
        bend: (6,) of a lens that is not exact, as the stars show it (`lens_bend`), else zeros.
        log10_false_alarm: of the probability that a frame of random points would have been solved.
        tracked: whether the stars were found near the prior attitude.
        motion: from the streaks, camera frame; None for points.
        mirrored: whether the picture shows the sky as a mirror does; `fix` is then of the picture with left
            and right exchanged about the optical axis, `points` and `expected` are of the picture as it came.
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
        """Which of the points (m,) are guide stars."""
        return np.flatnonzero(self.star >= 0)

    def wider(self, by: FloatArray) -> FrameSolution:
        """Return the solution with a covariance (3, 3) rad^2 added to its attitude's, where it has one."""
        if self.fix is None:
            return self
        return replace(self, fix=replace(self.fix, covariance=self.fix.covariance + by))

    def sky_map(self, velocity: FloatArray | None = None) -> SkyMap | None:
        """Return the way from pixels to the sky and back; None when not solved.

        `velocity` (3,) m/s is that which the frame was solved with.
        """
        return None if self.fix is None else SkyMap(self.camera, self.fix.quaternion, self.bend, velocity)


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
