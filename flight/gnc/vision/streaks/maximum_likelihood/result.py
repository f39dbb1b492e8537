"""What the maximum-likelihood estimator found in one frame."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from flight.gnc.math.arrays import BoolArray, FloatArray
from flight.gnc.math.quaternion import from_rotation_vector
from flight.gnc.vision.streaks.maximum_likelihood.settings import RateModel
from flight.gnc.vision.streaks.streak_result import StreakStatus


def _none(*shape: int) -> FloatArray:
    return np.empty(shape)


@dataclass(frozen=True, slots=True)
class MotionResult:
    """The motion of one exposure; what `StreakResult` carries, and the stars.

    Attributes:
        status: `rate`: all is known; `ambiguous`: right up to the direction of time; any other: no rate.
        checksum: of the pixels.
        exposure: s.
        length: px, median path of the stars used; NaN when none.
        endpoints: (n, 2, 2) px, where each star was at the start and at the end of the exposure.
        used: (n,) whether the star was fitted to its pixels (others were found along the motion).
        rate: (3,) rad/s at mid-exposure, camera frame; None when none.
        covariance: (3, 3) rad^2/s^2; None when none.
        residual: rad, rms expected error of an endpoint of the stars used; NaN when none.
        hot_pixels: how many were left out.
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
        start_to_end: (4,) attitude change over the exposure, A(q) v_start = v_end; None when no rate.
    """

    status: StreakStatus
    checksum: int
    exposure: float
    length: float = float("nan")
    endpoints: FloatArray = field(default_factory=lambda: _none(0, 2, 2))
    used: BoolArray = field(default_factory=lambda: np.empty(0, dtype=np.bool_))
    rate: FloatArray | None = None
    covariance: FloatArray | None = None
    residual: float = float("nan")
    hot_pixels: int = 0
    stars: FloatArray = field(default_factory=lambda: _none(0, 2))
    star_covariance: FloatArray = field(default_factory=lambda: _none(0, 2, 2))
    endpoint_covariance: FloatArray = field(default_factory=lambda: _none(0, 2, 2, 2))
    directions: FloatArray = field(default_factory=lambda: _none(0, 3, 3))
    flux: FloatArray = field(default_factory=lambda: _none(0))
    significance: FloatArray = field(default_factory=lambda: _none(0))
    faint_endpoints: FloatArray = field(default_factory=lambda: _none(0, 2, 2))
    faint_flux: FloatArray = field(default_factory=lambda: _none(0))
    faint_significance: FloatArray = field(default_factory=lambda: _none(0))
    psf_sigma: float = float("nan")
    misfit: float = float("nan")
    rate_model: RateModel = "constant"
    acceleration: FloatArray | None = None

    @property
    def found(self) -> int:
        """How many streaks there were."""
        return len(self.stars)

    @property
    def used_count(self) -> int:
        """How many streaks the rate is from."""
        return int(np.count_nonzero(self.used))

    @property
    def start_to_end(self) -> FloatArray | None:
        """The change of attitude over the exposure (4,): A(q) takes directions at its start to its end.

        Of a rate that changes, the mean is meant: exact about a fixed axis.
        """
        return None if self.rate is None else from_rotation_vector(self.rate * self.exposure)
