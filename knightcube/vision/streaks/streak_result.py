"""Settings and results of a motion estimate from star streaks, and checks of its arguments.

The control process reads results that worker processes compute. The module imports no estimator, because the
control process needs only the results. A single frame does not distinguish the rate omega from -omega. A
prior rate, from a gyro or the previous estimate, determines the sign of the rate.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import partial
from typing import Literal, Self, TypeVar

import numpy as np

from knightcube.astro.arrays import (
    BoolArray,
    FloatArray,
    Image,
    IntArray,
    checked_deviation,
    finite_array,
)
from knightcube.astro.quaternion import from_rotation_vector
from knightcube.errors import ArgumentError
from knightcube.vision.camera.lens import UNSTATED, CameraKnowledge, Pinhole, check_shape
from knightcube.vision.frame import FrameState, check_pixels, checked_exposure, frame_state, gain_in_counts
from knightcube.vision.streaks.geometry import GAUSSIAN, Course, PsfProfile

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
        psf_sigma: initial standard deviation of the point spread function (PSF), px. If `psf_sigma` is 2 px
            or more, the frame is binned.
        rate_model: `constant` for a constant rate, `accelerating` for a linearly changing rate, or `auto` to
            let a score test decide.
        line_time: delay between the exposures of successive rows, s. The line time is positive for a rolling
            shutter and 0 for a global shutter. If the line time is None, it is unknown, and the fit assumes 0
            with a standard deviation of 30 us. The line time of a slower rolling shutter must be stated.
        threshold_sigmas: threshold of the 3 x 3 sums for bright regions, in standard deviations.
        most_stars: maximum number of bright stars that determine the motion.
        most_neighbours: maximum number of fainter stars that are fitted because they overlap bright stars.
        most_faint: maximum number of faint stars that are detected and subtracted without a fit.
        faint_sigmas: minimum significance of a detected streak, in standard deviations.
        reach: half width of the strip of pixels that is fitted along a star's path, 1 to 20 point-spread
            widths.
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
            (px) or as change of brightness along them (fraction).
        worst_uncertainty: largest accepted standard deviation of the rate from model errors, as a fraction of
            the rate.
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
        """Whether the shutter may be a rolling shutter because its type is unknown."""
        return self.line_time is None and self.line_time_sigma > 0.0

    def binned(self, size: int) -> LikelihoodSettings:
        """Return the settings for frames that are binned by `size` px, with the line time of binned rows."""
        if size == 1:
            return self
        line_time = None if self.line_time is None else self.line_time * size
        knowledge = replace(self.knowledge.binned(size), line_time=self.line_time_sigma * size)
        return replace(self, psf_sigma=self.psf_sigma / size, line_time=line_time, knowledge=knowledge)

    def in_units_of(self, unit: float, zero: float) -> LikelihoodSettings:
        """Return the settings for a frame from which `zero` was subtracted and that was divided by `unit`."""
        if unit == 1.0 and zero == 0.0:
            return self
        saturation = None if self.saturation is None else (self.saturation - zero) / unit
        return replace(self, saturation=saturation, gain=gain_in_counts(self.gain, unit))


class StreakStatus(Enum):
    """Outcome of a frame: a rate, or the reason why no rate is reported.

    The telemetry packet `streak` uses the same values.
    """

    RATE = "rate"
    AMBIGUOUS = "ambiguous"
    TOO_SHORT = "too-short"
    TOO_FEW = "too-few"
    FAILED = "failed"
    BLACK = "black"
    SATURATED = "saturated"
    FROZEN = "frozen"


REASONS = {
    StreakStatus.FAILED: "no motion explains enough of the light in the frame",
    StreakStatus.TOO_FEW: "too few streaks are significant",
    StreakStatus.TOO_SHORT: "the stars moved too little for a rate",
    StreakStatus.BLACK: "all pixels of the frame are equal",
    StreakStatus.SATURATED: "the frame is overexposed",
    StreakStatus.FROZEN: "the frame is the same as the previous one",
}
"""One-line reasons why no rate is reported, which are used if a result has no more detailed reason."""


def no_rows(*shape: int) -> Callable[[], FloatArray]:
    """Return a default factory for a dataclass field that creates an empty array (0, *shape)."""
    return partial(np.empty, (0, *shape))


@dataclass(frozen=True, slots=True)
class FrameMotion:
    """The motion of the camera in one frame, and the star streaks.

    Attributes:
        status: outcome of the frame. With the status `rate`, the rate is known; with `ambiguous`, the rate is
            known except for its sign; otherwise no rate was found.
        checksum: checksum of every fourth row of the frame. Any two exposures of a working sensor have
            different checksums.
        exposure: exposure time, s.
        length: median length, px, of the used streaks, or of all streaks or regions found if none is used;
            NaN if none is found.
        endpoints: both ends (x, y) of each of the streaks found (found, 2, 2), px. If a rate was found, the
            first ends of all streaks correspond to the same instant. With the status `rate`, the first end of
            each streak is earlier than its second end.
        used: mask of the streaks that contribute to the rate (found,).
        rate: angular rate of the camera relative to the stars (3,), in camera axes, rad/s; None if unknown.
        covariance: covariance of `rate` (3, 3), rad^2/s^2; None if unknown.
        residual: rms error of the ends of the streaks, rad; NaN if unknown.
        hot_pixels: number of hot pixels in the frame, which are repaired or excluded.
    """

    status: StreakStatus
    checksum: int
    exposure: float
    length: float = float("nan")
    endpoints: FloatArray = field(default_factory=no_rows(2, 2))
    used: BoolArray = field(default_factory=partial(np.full, 0, np.False_))
    rate: FloatArray | None = None
    covariance: FloatArray | None = None
    residual: float = float("nan")
    hot_pixels: int = 0

    @property
    def found(self) -> int:
        """The number of streaks found."""
        return len(self.endpoints)

    @property
    def used_count(self) -> int:
        """The number of streaks that determine the rate."""
        return int(np.count_nonzero(self.used))

    def reversed(self) -> Self:
        """Return the time-reversed motion, with the negative rate and swapped streak ends."""
        assert self.rate is not None
        return replace(self, rate=-self.rate, endpoints=self.endpoints[:, ::-1])


@dataclass(frozen=True, slots=True)
class MotionResult(FrameMotion):
    """The maximum-likelihood motion over one exposure, and the stars of the frame.

    The attribute `rate` is the mean rate over the exposure. The mask `used` selects the stars that determine
    the motion. The attributes `length` and `residual` refer to the used stars only, and `residual` is the
    expected error of a streak end.

    Attributes:
        stars: positions of the n stars at mid-exposure (n, 2), px.
        star_covariance: covariance of each star position (n, 2, 2), px^2, without the errors that other stars
            near the streak cause. Positions and fluxes of stars whose streak extends beyond the frame are
            unreliable: 81 of 135 such positions in simulated frames differed by more than 4 sigma.
        endpoint_covariance: covariance (2, 2) of both ends of each streak (n, 2, 2, 2), px^2.
        directions: unit vectors at the start, middle and end of each streak (n, 3, 3), in camera axes.
        flux: total counts of each star over the exposure (n,).
        significance: flux of each star divided by its standard deviation (n,).
        faint_endpoints: both ends of m streaks that were detected but not fitted (m, 2, 2), px, accurate to
            about 1 px.
        faint_flux: flux of each of the m faint stars over the exposure (m,), counts.
        faint_significance: flux of each of the m faint stars divided by its standard deviation (m,).
        psf_sigma: fitted standard deviation of the PSF, px.
        psf_profile: fitted profile of the PSF.
        misfit: median chi-square per degree of freedom of the bright stars.
        rate_model: fitted model of the rate, `constant` or `accelerating`.
        acceleration: fitted angular acceleration (3,), rad/s^2, or None if it was not fitted.
        reason: one-line reason why no rate was found. If a rate was found, `reason` is empty.
        course: rotation estimated by the navigation filter if the fit took its higher-order terms, otherwise
            None.
        line_time_sigma: standard deviation of the delay between the exposures of successive rows, s.
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
    psf_profile: PsfProfile = GAUSSIAN
    misfit: float = float("nan")
    rate_model: RateModel = "constant"
    acceleration: FloatArray | None = None
    reason: str = ""
    course: Course | None = None
    line_time_sigma: float = 0.0

    def __bool__(self) -> bool:
        """Return whether a rate was found."""
        return self.rate is not None

    def __repr__(self) -> str:
        """Return one line of text: status, rate, uncertainty and number of stars, or the reason."""
        if self.rate is None or self.covariance is None:
            return f"<MotionResult {self.status.value}: {self.reason}>"
        sigma = float(np.sqrt(np.trace(self.covariance)))
        rate = ", ".join(f"{value:.6f}" for value in self.rate)
        stars = f"{len(self.stars)} stars"
        return f"<MotionResult {self.status.value}: rate [{rate}] +- {sigma:.2g} rad/s, {stars}>"

    @property
    def start_to_end(self) -> FloatArray | None:
        """The quaternion (4,) of the rotation over the exposure, A(q) v_start = v_end; None without a rate.

        The quaternion is computed from the mean rate and is exact for a fixed rotation axis.
        """
        return None if self.rate is None else from_rotation_vector(self.rate * self.exposure)

    def line_time_displacement(self, chosen: IntArray, middle_row: float) -> FloatArray:
        """Return the displacements (m, 2), px, of the stars `chosen` due to a line time error of one sigma.

        The delay of a star is proportional to the distance of its row from `middle_row`. If the line time is
        exactly known, an empty array (0, 2) is returned.
        """
        if not self.line_time_sigma:
            return np.empty((0, 2))
        start, end = self.endpoints[chosen].swapaxes(0, 1)
        delay = self.line_time_sigma / self.exposure * (self.stars[chosen, 1:] - middle_row)
        return np.asarray((end - start) * delay)

    def reversed(self) -> Self:
        """Return the time-reversed motion, with the negative rate and the same acceleration."""
        return replace(
            FrameMotion.reversed(self),
            endpoint_covariance=self.endpoint_covariance[:, ::-1],
            directions=self.directions[:, ::-1],
            faint_endpoints=self.faint_endpoints[:, ::-1],
            course=None,
        )


Result = TypeVar("Result", bound=FrameMotion)


def validate(
    pixels: Image, pinhole: Pinhole, exposure: float, prior_rate: FloatArray | None, prior_sigma: float
) -> None:
    """Raise ArgumentError if the frame, exposure (s), prior rate (rad/s) or prior deviation is invalid."""
    check_shape(pixels, pinhole)
    if pixels.dtype.kind != "u":
        raise ArgumentError("frame", f"pixels of {pixels.dtype}: pass the raw counts as unsigned integers")
    check_pixels(pixels)
    checked_exposure(exposure)
    if prior_rate is not None:
        finite_array("prior_rate", prior_rate, (3,))
    checked_deviation("prior_sigma", prior_sigma, "rad/s")


# Distance (px) between the rows of a frame that its checksum includes.
_CHECKED_ROWS = 4


def admit(
    pixels: Image, previous_checksum: int | None, saturation: float, saturated_fraction: float
) -> tuple[int, StreakStatus | None]:
    """Return a checksum of some rows of `pixels`, and the status if the frame is unusable, otherwise None.

    A frame equal to the previous frame indicates a frozen camera, because noise makes any two exposures
    differ.
    """
    checksum = zlib.crc32(np.ascontiguousarray(pixels[::_CHECKED_ROWS]).data)
    state = frame_state(pixels, saturation, saturated_fraction)
    if state is not FrameState.USABLE:
        return checksum, StreakStatus(state.value)
    return checksum, StreakStatus.FROZEN if checksum == previous_checksum else None


def in_time(result: Result, prior_rate: FloatArray | None, prior_sigma: float, sigmas: float) -> Result:
    """Return `result` with the sign of the prior rate, or unchanged if the prior rate is too uncertain."""
    if result.rate is None or prior_rate is None:
        return result
    sign = direction_of_time(result.rate, np.asarray(prior_rate, dtype=float), prior_sigma, sigmas)
    if sign == 0:
        return result
    return replace(result if sign > 0 else result.reversed(), status=StreakStatus.RATE)


def direction_of_time(rate: FloatArray, prior_rate: FloatArray, prior_sigma: float, sigmas: float) -> int:
    """Return the sign (+1, -1) by which `rate` (3,) must be multiplied to agree with the prior rate, or 0.

    The result is 0 unless the component of the prior rate along `rate` exceeds `sigmas` times its standard
    deviation `prior_sigma`.
    """
    projection = float(rate @ prior_rate / np.linalg.norm(rate))
    if abs(projection) <= sigmas * prior_sigma:
        return 0
    return 1 if projection > 0.0 else -1
