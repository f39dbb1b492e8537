"""Settings of the maximum-likelihood estimator. The default values fit the camera of the demonstration."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

from knightcube.vision.camera.lens import UNSTATED, CameraKnowledge, Lens

_UNCALIBRATED = CameraKnowledge()

RateModel = Literal["auto", "constant", "accelerating"]


@dataclass(frozen=True, slots=True)
class LikelihoodSettings:
    """Settings of the motion estimate from one frame.

    Attributes:
        gain: gain of the camera, electrons per count.
        saturation: smallest count at which a pixel is saturated. If `saturation` is None, the highest count
            of the frame is used if several pixels have that count, otherwise the maximum of the integer type.
        saturated_fraction: smallest fraction of saturated pixels for which a frame is rejected.
        psf_sigma: initial standard deviation of the point spread, px. If `psf_sigma` is 2 px or more, the
            frame is binned.
        rate_model: `constant` for a constant rate, `accelerating` for a linearly changing rate, or `auto` to
            let a score test decide.
        line_time: delay between the exposures of successive rows, s. The line time is positive for a rolling
            shutter and 0 for a global shutter. If the line time is None, it is unknown, and the fit assumes 0
            with a large uncertainty.
        threshold_sigmas: threshold of the 3 x 3 sums for bright regions, in standard deviations.
        most_stars: maximum number of bright stars that determine the motion.
        most_neighbours: maximum number of fainter stars that are fitted because they overlap bright stars.
        most_faint: maximum number of faint stars that are detected and subtracted without a fit.
        faint_sigmas: minimum significance of a detected streak, in standard deviations.
        reach: half width of the strip of pixels that is fitted along a star's path, in point-spread widths.
        clip: residual above which a pixel is excluded from the fit, in standard deviations.
        least_stars: minimum number of stars for which a rate is reported. Two stars determine a rate, but do
            not allow a check of their agreement.
        least_length: minimum median length of the streaks for which a rate is reported, px.
        least_significance: minimum ratio of a rate to its standard deviation for the rate to be reported.
        worst_misfit: chi-square per degree of freedom above which a motion is rejected, provided that the
            residuals also exceed `worst_displacement`.
        worst_displacement: largest rms displacement across the streaks, px, with which a motion is accepted
            in spite of a large misfit.
        worst_shaking: largest accepted vibration common to all streaks, as displacement across the streaks
            (px) or as relative change of brightness along them.
        worst_uncertainty: largest accepted relative uncertainty (one standard deviation) of the rate from
            model errors.
        sign_sigmas: minimum significance (standard deviations) of the prior rate along the rotation axis, for
            a decision on the sign of the rotation.
        knowledge: standard deviations of the camera's calibration parameters.
    """

    gain: float = 1.0
    saturation: float | None = None
    saturated_fraction: float = 0.25
    psf_sigma: float = 1.0
    rate_model: RateModel = "auto"
    line_time: float | None = None
    threshold_sigmas: float = 4.5
    most_stars: int = 24
    most_neighbours: int = 80
    most_faint: int = 800
    faint_sigmas: float = 6.0
    reach: float = 3.6
    clip: float = 5.0
    least_stars: int = 2
    least_length: float = 3.0
    least_significance: float = 5.0
    worst_misfit: float = 4.0
    worst_displacement: float = 0.45
    worst_shaking: float = 0.05
    worst_uncertainty: float = 0.008
    sign_sigmas: float = 3.0
    knowledge: CameraKnowledge = _UNCALIBRATED

    @property
    def delay_per_row(self) -> float:
        """The line time (s) that the fit assumes."""
        return 0.0 if self.line_time is None else self.line_time

    @property
    def line_time_sigma(self) -> float:
        """The standard deviation (s) of the line time that the fit assumes."""
        if self.knowledge.line_time is not None:
            return self.knowledge.line_time
        return UNSTATED if self.line_time is None else 0.0

    @property
    def shutter_unstated(self) -> bool:
        """Whether the type of shutter is unknown, so that it may be a rolling shutter."""
        return self.line_time is None and self.line_time_sigma > 0.0


def knowledge_of_pinhole(knowledge: CameraKnowledge, lens: Lens) -> CameraKnowledge:
    """Return the accuracy of the pinhole camera that replaces a calibrated `lens` in the fit of streaks.

    The fit does not model the lens distortion. The difference between lens and pinhole is therefore included
    in the uncertainty of the pinhole.
    """
    middle = 0.5 * (lens.columns - 1), 0.5 * (lens.rows - 1)
    square = math.hypot(*middle) ** 2 / lens.focal_length**2
    return replace(
        knowledge,
        centre=math.hypot(knowledge.centre, math.dist(lens.centre, middle)),
        distortion=math.hypot(
            knowledge.distortion,
            square * (lens.k1 + square * lens.k2),
            lens.aspect,
            lens.shear,
            3.0 * math.sqrt(square) * math.hypot(lens.p1, lens.p2),
        ),
    )
