"""The settings of streak processing: one frozen dataclass, defaults for the demonstration's camera.

Each corner detector has settings of its own, tuned on frames of `tests.knightcube.vision.streaks.frames`: the
thresholds for the most streaks kept, the error of an endpoint by `python -m
tests.studies.bench.endpoint_bias`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

DetectorName = Literal["harris", "minimum-eigenvalue", "trajkovic-4", "trajkovic-8"]


@dataclass(frozen=True, slots=True)
class StreakSettings:
    """How a frame is turned into a rate.

    Attributes:
        threshold_sigmas: threshold of the 3 x 3 sum over its noise; 0 takes the image's mean, the thesis's
            option.
        least_area: pixels of the smallest region kept; one noise peak fills nine pixels of the 3 x 3 sum.
        most_streaks: the strongest streaks are processed, no more: the bright few hold most of the
            information.
        saturation: counts at which a pixel clips; None for the top of the integer type (a 12-bit camera:
            4095).
        saturated_fraction: of the pixels, from which the frame is called saturated.
        gain: electrons per count, for the photon noise of bright streaks.
        detector: name of the corner detector in `knightcube.vision.streaks.corners.detectors`; the settings
        below that depend on
            it are Harris's by default, the others' come from `of`.
        smoothing_sigma: px, Gaussian smoothing of a region before the detector; 0 for none.
        derivative_sigma, window_sigma: px, of the Gaussian derivative and of the structure tensor's window.
        harris_k: k of 3.8.
        coarse_relative, fine_relative: T1 and T2 of Trajkovic's detector, parts of the largest simple
            cornerness in the region at half and at full scale.
        peak_relative: least cornerness of an endpoint over the streak's largest; Harris's grows as brightness
            to the fourth power, the others' as its square, so that 0.005 and 0.07 both allow a brightness
            ratio of 3.8 between the ends (a rate that changes within the exposure).
        intensity_half_width: px, N of 3.15.
        centre_of: what the centre of intensity is taken of: the cornerness, or the image as in the thesis.
        endpoint_bias: px, outward along the streak; of the detector, its sigmas and the camera's point
            spread: measure with `python -m tests.studies.bench.endpoint_bias`.
        endpoint_bias_sigma: px, how well it is known; enters the covariance as an error common to all
            streaks.
        endpoint_floor, endpoint_noise: expected error of an endpoint: hypot(floor px, endpoint_noise x noise
            over the streak's counts per px of length) - the weights; its scale is taken from the residuals.
        border: px, streaks nearer to the frame's border are not used.
        least_length: px, median below which no rate is given.
        least_streaks: fewer give no rate.
        axis_tolerance: px, error of an endpoint allowed in the search for the axis.
        outlier_sigmas: robust standard deviations from which a streak is dropped (RSO, overlap, fragment).
        worst_residual: px, rms of an endpoint above which the streaks do not share one rotation: fragments
            that agree by chance leave 1 to 4, stars 0.6 at most (frames of the campaign `streaks`).
        sign_sigmas: the prior's projection on the axis must exceed this many of its sigmas to decide the
            direction.
    """

    threshold_sigmas: float = 4.5
    least_area: int = 14
    most_streaks: int = 30
    saturation: float | None = None
    saturated_fraction: float = 0.25
    gain: float = 1.0
    detector: DetectorName = "harris"
    smoothing_sigma: float = 0.0
    derivative_sigma: float = 1.0
    window_sigma: float = 1.5
    harris_k: float = 0.15
    coarse_relative: float = 0.05
    fine_relative: float = 0.05
    peak_relative: float = 0.005
    intensity_half_width: int = 3
    centre_of: Literal["response", "image"] = "response"
    endpoint_bias: float = 0.035
    endpoint_bias_sigma: float = 0.02
    endpoint_floor: float = 0.03
    endpoint_noise: float = 4.2
    border: int = 6
    least_length: float = 20.0
    least_streaks: int = 4
    axis_tolerance: float = 1.0
    outlier_sigmas: float = 4.0
    worst_residual: float = 0.9
    sign_sigmas: float = 3.0

    @classmethod
    def of(cls, detector: DetectorName, **changes: Any) -> StreakSettings:
        """Return the settings measured for `detector` at a PSF sigma of 1 px, with `changes` on top."""
        return cls(**{"detector": detector, **_OF_DETECTOR[detector], **changes})


_OF_DETECTOR: dict[DetectorName, dict[str, Any]] = {
    # A point spread of 0.7 and of 1.5 px needs an endpoint_bias of -0.14 and 0.40 with Harris, 0.34 and 0.71
    # with the minimum eigenvalue, 1.23 and 1.68 with Trajkovic-4, 0.93 and 1.24 with Trajkovic-8.
    "harris": {},
    "minimum-eigenvalue": {"peak_relative": 0.2, "intensity_half_width": 4, "endpoint_bias": 0.45},
    # The four neighbours see a slanting streak as a row of corners: only smoothing and a high threshold
    # leave the ends, and of about half of all streaks only.
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
