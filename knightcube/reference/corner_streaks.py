"""Body rate and attitude from star streaks by corner detectors (Sease 2013, chapters 3 and 4).

This module defines settings and results, and loads fast because it does not import scipy. The methods are in
`knightcube.reference.corner_streak_rate`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from knightcube.astro.arrays import FloatArray
from knightcube.vision.objects.settings import EndpointSettings
from knightcube.vision.streaks.streak_result import FrameMotion, no_rows

DetectorName = Literal["harris", "minimum-eigenvalue", "trajkovic-4", "trajkovic-8"]


@dataclass(frozen=True, slots=True)
class StreakSettings(EndpointSettings):
    """Settings of the rate estimation. The method `of` returns the settings tuned for a corner detector.

    Attributes:
        saturated_fraction: fraction of saturated pixels above which a frame is rejected.
        detector: name of the corner detector.
        coarse_relative: threshold T1 of Trajkovic's detector for the image at half scale, relative to the
            largest value of `simple_response` in this image.
        fine_relative: threshold T2 of Trajkovic's detector for the image at full scale, relative to the
            largest value of `simple_response` in this image.
        endpoint_bias_sigma: uncertainty of `endpoint_bias`, which is an error common to all streaks, px.
        axis_tolerance: tolerated error of an endpoint in the search for the rotation axis, px.
        outlier_sigmas: number of robust standard deviations above which a streak is rejected.
        worst_residual: largest accepted RMS residual of the endpoints, px. True streaks have residuals of at
            most 0.6 px, and fragments that agree by chance have residuals of 1 to 4 px (campaign `streaks`).
        sign_sigmas: minimum prior rate along the rotation axis, in standard deviations of the prior rate, at
            which the prior rate determines the sense of rotation.
    """

    saturated_fraction: float = 0.25
    detector: DetectorName = "harris"
    coarse_relative: float = 0.05
    fine_relative: float = 0.05
    endpoint_bias_sigma: float = 0.02
    axis_tolerance: float = 1.0
    outlier_sigmas: float = 4.0
    worst_residual: float = 0.9
    sign_sigmas: float = 3.0

    @classmethod
    def of(cls, detector: DetectorName, **changes: Any) -> StreakSettings:
        """Return the settings tuned for a corner detector and a point spread of 1 px, with given changes."""
        return cls(**{"detector": detector, **_OF_DETECTOR[detector], **changes})


_OF_DETECTOR: dict[DetectorName, dict[str, Any]] = {
    # Endpoint biases of Harris's detector for point spreads of 0.7 and 1.5 px: -0.14 and 0.40 px.
    # Endpoint biases of the minimum eigenvalue for point spreads of 0.7 and 1.5 px: 0.34 and 0.71 px.
    # Endpoint biases of Trajkovic-4 for point spreads of 0.7 and 1.5 px: 1.23 and 1.68 px.
    # Endpoint biases of Trajkovic-8 for point spreads of 0.7 and 1.5 px: 0.93 and 1.24 px.
    "harris": {},
    # The minimum eigenvalue is proportional to brightness^2, and Harris's response to brightness^4.
    "minimum-eigenvalue": {"peak_relative": 0.2, "intensity_half_width": 4, "endpoint_bias": 0.45},
    # With 4-connectivity, all pixels of a diagonal streak are detected as corners.
    # Smoothing and a high threshold suppress false corners, but also half of the streak ends.
    "trajkovic-4": {
        "smoothing_sigma": 1.0,
        "peak_relative": 0.4,
        "intensity_half_width": 2,
        "endpoint_bias": 1.35,
        "endpoint_bias_sigma": 0.16,
        "endpoint_floor": 0.13,
    },
    "trajkovic-8": {
        "smoothing_sigma": 1.0,
        "peak_relative": 0.3,
        "intensity_half_width": 2,
        "endpoint_bias": 1.01,
        "endpoint_bias_sigma": 0.07,
        "endpoint_floor": 0.1,
    },
}
DETECTOR_NAMES: tuple[DetectorName, ...] = tuple(_OF_DETECTOR)


@dataclass(frozen=True, slots=True)
class StreakResult(FrameMotion):
    """Body rate from star streaks, with the expected error `sigma` of each streak's endpoints, px."""

    sigma: FloatArray = field(default_factory=no_rows())
