"""Settings and result of the estimator by corner detectors; importing them loads no scipy."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from knightcube.astro.arrays import FloatArray
from knightcube.vision.objects.settings import EndpointSettings
from knightcube.vision.streaks.streak_result import FrameMotion, no_rows

DetectorName = Literal["harris", "minimum-eigenvalue", "trajkovic-4", "trajkovic-8"]


@dataclass(frozen=True, slots=True)
class StreakSettings(EndpointSettings):
    """How a frame is turned into a rate; `of` returns the settings that were tuned for a detector.

    Attributes:
        saturated_fraction: fraction of saturated pixels from which a frame is rejected.
        detector: name of the corner detector.
        coarse_relative: T1 of Trajkovic's detector, relative to the largest simple cornerness at half scale.
        fine_relative: T2 of Trajkovic's detector, relative to the largest simple cornerness at full scale.
        endpoint_bias_sigma: px, uncertainty of `endpoint_bias`, an error common to all streaks.
        axis_tolerance: px, error of an endpoint that is allowed in the search for the axis.
        outlier_sigmas: robust standard deviations from which a streak is rejected.
        worst_residual: px, largest rms of an endpoint. Fragments that agree by chance leave 1 to 4 px, stars
            0.6 px at most (campaign `streaks`).
        sign_sigmas: ratio of the prior's projection on the axis to its standard deviation from which the
            prior decides the sense of rotation.
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
        """Return the settings of `detector` for a point spread of 1 px, with some of them changed."""
        return cls(**{"detector": detector, **_OF_DETECTOR[detector], **changes})


_OF_DETECTOR: dict[DetectorName, dict[str, Any]] = {
    # For point spreads of 0.7 and 1.5 px the endpoint bias is -0.14 and 0.40 px with Harris, 0.34 and 0.71 px
    # with the minimum eigenvalue, 1.23 and 1.68 px with Trajkovic-4, 0.93 and 1.24 px with Trajkovic-8.
    "harris": {},
    # The response grows with the square of the brightness, not with its fourth power.
    "minimum-eigenvalue": {"peak_relative": 0.2, "intensity_half_width": 4, "endpoint_bias": 0.45},
    # A slanting streak is a row of corners to four neighbours. Smoothing and a high threshold leave only the
    # ends, of about half of all streaks.
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
    """The motion by corner detectors.

    Attributes:
        sigma: (found,) px, expected error of an endpoint.
    """

    sigma: FloatArray = field(default_factory=no_rows())
