"""The result of the maximum-likelihood estimator for one frame."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from knightcube.astro.arrays import FloatArray, IntArray
from knightcube.astro.quaternion import from_rotation_vector
from knightcube.vision.streaks.maximum_likelihood.course import Course
from knightcube.vision.streaks.maximum_likelihood.settings import RateModel
from knightcube.vision.streaks.streak_result import FrameMotion, no_rows


@dataclass(frozen=True, slots=True)
class MotionResult(FrameMotion):
    """The motion of one exposure and the stars; the rate is that at mid-exposure.

    Every star found has two ends: `endpoints` (n, 2, 2). `used` (n,) are those that were fitted to their
    pixels and determine the motion; `length` and `residual` (expected, not left over) are theirs.

    Attributes:
        stars: (n, 2) px at mid-exposure; `star_covariance` (n, 2, 2) px^2.
        endpoint_covariance: (n, 2, 2, 2) px^2, star, end.
        directions: (n, 3, 3) unit vectors at start, middle, end, camera frame.
        flux: (n,) counts over the exposure; `significance` (n,) in its standard deviations.
        faint_endpoints: (m, 2, 2) px, of streaks found along the motion but not fitted: to about a pixel.
        faint_flux: (m,) counts; faint_significance (m,).
        psf_sigma: px, fitted.
        misfit: chi-square per degree of freedom, median of the bright stars: 1 where the rate model holds.
        rate_model: which was fitted, `constant` or `accelerating`.
        acceleration: (3,) rad/s^2 if fitted, else None.
        reason: of a missing rate, in a line; empty with a rate.
        course: the known course that the fit took for the rest of the motion; None without one.
        line_time_sigma: s, by how much the shutter's line time may differ from the one that was fitted.
    """

    stars: FloatArray = field(default_factory=no_rows(2))
    star_covariance: FloatArray = field(default_factory=no_rows(2, 2))
    endpoint_covariance: FloatArray = field(default_factory=no_rows(2, 2, 2))
    directions: FloatArray = field(default_factory=no_rows(3, 3))
    flux: FloatArray = field(default_factory=no_rows())
    significance: FloatArray = field(default_factory=no_rows())
    faint_endpoints: FloatArray = field(default_factory=no_rows(2, 2))
    faint_flux: FloatArray = field(default_factory=no_rows())
    faint_significance: FloatArray = field(default_factory=no_rows())
    psf_sigma: float = float("nan")
    misfit: float = float("nan")
    rate_model: RateModel = "constant"
    acceleration: FloatArray | None = None
    reason: str = ""
    course: Course | None = None
    line_time_sigma: float = 0.0

    @property
    def start_to_end(self) -> FloatArray | None:
        """The change of attitude over the exposure (4,), A(q) v_start = v_end; None without a rate.

        By the mean rate where it changes: exact about a fixed axis.
        """
        return None if self.rate is None else from_rotation_vector(self.rate * self.exposure)

    def late(self, chosen: IntArray, middle_row: float) -> FloatArray:
        """Return by how many px (m, 2) a standard deviation of the line time displaces `chosen` (m,) stars.

        Each is exposed later by its row's distance from `middle_row`; (0, 2) where the line time is exact.
        """
        if not self.line_time_sigma:
            return np.empty((0, 2))
        start, end = self.endpoints[chosen].swapaxes(0, 1)
        delay = self.line_time_sigma / self.exposure * (self.stars[chosen, 1:] - middle_row)
        return np.asarray((end - start) * delay)

    def reversed(self) -> Self:
        """Return the same motion in the other direction of time; the change of the rate keeps its sign."""
        return replace(
            FrameMotion.reversed(self),
            endpoint_covariance=self.endpoint_covariance[:, ::-1],
            directions=self.directions[:, ::-1],
            faint_endpoints=self.faint_endpoints[:, ::-1],
            course=None,
        )
