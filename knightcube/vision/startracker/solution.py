"""The star tracker's result for one frame."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np

from knightcube.astro.arrays import FloatArray, IntArray
from knightcube.astro.attitude.wahba import AttitudeFix
from knightcube.vision.camera.lens import CameraModel
from knightcube.vision.startracker.detection import FrameKind
from knightcube.vision.startracker.lens_bend import BENDS
from knightcube.vision.startracker.sky_map import SkyMap
from knightcube.vision.streaks.maximum_likelihood.result import MotionResult


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
