"""The settings of streak processing: one frozen dataclass, defaults for the demonstration's camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


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
        detector: name of the corner detector in `flight.vision.streaks.DETECTORS`.
        derivative_sigma, window_sigma: px, of the Gaussian derivative and of the structure tensor's window.
        harris_k: k of 3.8.
        peak_relative: least cornerness of an endpoint over the streak's largest; it grows as brightness to
            the fourth power, so 0.005 allows a brightness ratio of 3.8 between the ends (a rate that changes
            within the exposure).
        intensity_half_width: px, N of 3.15.
        endpoint_bias: px, outward along the streak; of the detector, its sigmas and the camera's point
            spread: measure with `python -m tests.bench.endpoint_bias`.
        endpoint_bias_sigma: px, how well it is known; enters the covariance as an error common to all
            streaks.
        endpoint_floor, endpoint_noise: expected error of an endpoint: hypot(floor px, endpoint_noise x noise
            over the streak's counts per px of length) - the weights; its scale is taken from the residuals.
        border: px, streaks nearer to the frame's border are not used.
        least_length: px, median below which no rate is given.
        least_streaks: fewer give no rate.
        axis_tolerance: px, error of an endpoint allowed in the search for the axis.
        outlier_sigmas: robust standard deviations from which a streak is dropped (RSO, overlap, fragment).
        sign_sigmas: the prior's projection on the axis must exceed so many of its sigmas to decide the
            direction.
    """

    threshold_sigmas: float = 4.5
    least_area: int = 14
    most_streaks: int = 30
    saturation: float | None = None
    saturated_fraction: float = 0.25
    gain: float = 1.0
    detector: Literal["harris"] = "harris"
    derivative_sigma: float = 1.0
    window_sigma: float = 1.5
    harris_k: float = 0.15
    peak_relative: float = 0.005
    intensity_half_width: int = 3
    endpoint_bias: float = 0.035
    endpoint_bias_sigma: float = 0.02
    endpoint_floor: float = 0.03
    endpoint_noise: float = 4.2
    border: int = 6
    least_length: float = 20.0
    least_streaks: int = 4
    axis_tolerance: float = 1.0
    outlier_sigmas: float = 4.0
    sign_sigmas: float = 3.0
