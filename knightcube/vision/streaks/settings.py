"""The settings of the maximum-likelihood estimator; the defaults serve the demonstration's camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from knightcube.vision.camera.lens import UNSTATED, CameraKnowledge

_UNCALIBRATED = CameraKnowledge()

RateModel = Literal["auto", "constant", "accelerating"]


@dataclass(frozen=True, slots=True)
class LikelihoodSettings:
    """How a frame is turned into a motion.

    Attributes:
        gain: electrons a count.
        saturation: counts at which a pixel clips; None takes the frame's highest count when several pixels
            share it, else the top of the integer type.
        saturated_fraction: of the pixels, from which the frame is called saturated.
        psf_sigma: px, where the fit of the point spread starts; from 2 on, pixels are summed (`Binning`).
        rate_model: `constant`; `accelerating`: the rate's change over the exposure is fitted too; `auto`: the
            pixels decide.
        line_time: s from the start of one row's exposure to the next's (rolling shutter); 0 is global. None,
            not stated, is fitted as 0 and not believed to be.
        threshold_sigmas: of the 3 x 3 sum, for the first guess.
        most_stars: the brightest are fitted, no more: they hold most of the information.
        most_neighbours: faint stars on the bright ones' pixels that are fitted with them.
        most_faint: at most this many more are found along the known motion and taken out of the others'
            windows.
        faint_sigmas: significance from which a streak along the known motion is believed.
        reach: widths of the point spread to either side of a path that are fitted.
        clip: sigmas of a residual that is no noise.
        least_stars: fewer fix no rate; two do, though none contradicts them.
        least_length: px, median path below which no rate is given.
        least_significance: of the rate in its standard deviations, below which no rate is given.
        worst_misfit: chi-square per degree of freedom above which the motion is not believed, where what is
            left over is as much as a displacement of the streaks by `worst_aside` px.
        worst_shaking: px of displacement, or share of brightness, that all streaks waver in common, above
            which the motion is not smooth.
        worst_doubt: share of the rate to which errors of the model may leave it uncertain, one deviation.
        knowledge: how well the camera is known.
        sign_sigmas: the prior's projection on the axis must exceed this many of its sigmas to decide the
            direction of time.
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
    worst_aside: float = 0.45
    worst_shaking: float = 0.05
    worst_doubt: float = 0.008
    sign_sigmas: float = 3.0
    knowledge: CameraKnowledge = _UNCALIBRATED

    @property
    def delay_per_row(self) -> float:
        """The line time that is fitted, s."""
        return 0.0 if self.line_time is None else self.line_time

    @property
    def line_time_sigma(self) -> float:
        """By how much the line time may differ from that, one standard deviation, s."""
        if self.knowledge.line_time is not None:
            return self.knowledge.line_time
        return UNSTATED if self.line_time is None else 0.0

    @property
    def shutter_unstated(self) -> bool:
        """Whether nobody said how the shutter works, so that it may roll."""
        return self.line_time is None and self.line_time_sigma > 0.0
