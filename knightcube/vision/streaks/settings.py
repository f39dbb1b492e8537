"""Settings of the maximum-likelihood estimator. The defaults are for the camera of the demonstration."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

from knightcube.vision.camera.lens import UNSTATED, CameraKnowledge, Lens

_UNCALIBRATED = CameraKnowledge()

RateModel = Literal["auto", "constant", "accelerating"]


@dataclass(frozen=True, slots=True)
class LikelihoodSettings:
    """Settings of the estimate of the motion from one frame.

    Attributes:
        gain: electrons per count.
        saturation: counts at which a pixel saturates. If None, it is the highest count of the frame if
            several pixels have it, otherwise the maximum of the integer type.
        saturated_fraction: minimum fraction of saturated pixels at which a frame is rejected.
        psf_sigma: px, initial standard deviation of the point spread. If it is 2 px or more, pixels are
            summed.
        rate_model: `constant` for a constant rate, `accelerating` for a linear change of the rate, or `auto`
            for a choice by a test on the pixels.
        line_time: s, delay of each row's exposure relative to the row above (rolling shutter), 0 for a global
            shutter. If None, it is unknown, and the fit uses 0 with a large uncertainty.
        threshold_sigmas: threshold of the 3 x 3 sums for the first guess, in standard deviations.
        most_stars: maximum number of the brightest stars, which determine the motion.
        most_neighbours: maximum number of fitted fainter stars that overlap the bright stars.
        most_faint: maximum number of faint stars that are detected and subtracted without a fit.
        faint_sigmas: minimum significance of a detected streak.
        reach: half width of the fitted strip along a path, in widths of the point spread.
        clip: residual, in standard deviations, above which a pixel is excluded.
        least_stars: minimum number of stars. Two stars determine a rate, but their agreement does not test
            it.
        least_length: px, minimum median path length.
        least_significance: minimum ratio of the rate to its standard deviation.
        worst_misfit: chi-square per degree of freedom above which a motion is rejected, if the residuals also
            exceed `worst_displacement`.
        worst_displacement: px, largest displacement across the streaks that is equivalent to the residuals.
        worst_shaking: largest displacement (px), or relative change of brightness, common to all streaks.
        worst_uncertainty: largest relative uncertainty (one standard deviation) of the rate due to errors of
            the model.
        sign_sigmas: minimum ratio of the prior rate's projection on the axis to its standard deviation, for a
            decision about the direction of time.
        knowledge: accuracy of the camera's calibration.
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
        """The line time (s) assumed in the fit."""
        return 0.0 if self.line_time is None else self.line_time

    @property
    def line_time_sigma(self) -> float:
        """The standard deviation (s) of the assumed line time."""
        if self.knowledge.line_time is not None:
            return self.knowledge.line_time
        return UNSTATED if self.line_time is None else 0.0

    @property
    def shutter_unstated(self) -> bool:
        """Whether the type of shutter is unknown, so that it may be a rolling shutter."""
        return self.line_time is None and self.line_time_sigma > 0.0


def knowledge_of_pinhole(knowledge: CameraKnowledge, lens: Lens) -> CameraKnowledge:
    """Return the accuracy of the pinhole that replaces a calibrated `lens` in the fit of streaks.

    The fit does not model the distortion, so that the difference between lens and pinhole counts as an
    uncertainty.
    """
    middle = 0.5 * (lens.columns - 1), 0.5 * (lens.rows - 1)
    square = math.hypot(*middle) ** 2 / lens.focal_length**2
    return replace(
        knowledge,
        centre=math.hypot(knowledge.centre, math.dist(lens.centre, middle)),
        distortion=math.hypot(knowledge.distortion, square * (lens.k1 + square * lens.k2)),
    )
