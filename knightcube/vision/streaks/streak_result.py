"""The result of an estimate from streaks, and checks of its arguments that all estimators share.

The control process reads results that workers compute, so that this module imports no estimator. One frame
does not distinguish the rate omega from -omega; a prior, from a gyro or the last estimate, decides.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import partial
from typing import Self, TypeVar

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, Image, IntArray
from knightcube.astro.quaternion import from_rotation_vector
from knightcube.errors import FlightError
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.frame import FrameState, frame_state
from knightcube.vision.streaks.geometry import Course
from knightcube.vision.streaks.settings import RateModel


class StreakStatus(Enum):
    """Outcome of a frame: a rate, or why there is none.

    The values are those of the `streak` telemetry packet.
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
    StreakStatus.FAILED: "no motion is consistent with enough of the light",
    StreakStatus.TOO_FEW: "too few streaks are significant",
    StreakStatus.TOO_SHORT: "the stars hardly moved",
    StreakStatus.BLACK: "all pixels of the frame are equal",
    StreakStatus.SATURATED: "the frame is overexposed",
    StreakStatus.FROZEN: "the frame is the same as the previous one",
}
"""Reasons why a frame has no rate, in one line, for results without a more detailed reason."""


def no_rows(*shape: int) -> Callable[[], FloatArray]:
    """Return a default factory for a field: an empty array (0, *shape)."""
    return partial(np.empty, (0, *shape))


@dataclass(frozen=True, slots=True)
class FrameMotion:
    """The motion in one frame and its streaks.

    Attributes:
        status: `rate`: the rate is known; `ambiguous`: the rate is known up to its sign; others: no rate.
        checksum: checksum of the pixels, which differs between any two exposures of a working sensor.
        exposure: exposure time, s.
        length: px, median length of the used streaks, otherwise of all found streaks or regions; NaN if none
            is found.
        endpoints: (found, 2, 2) px. If the frame has a rate, all first ends are simultaneous. With status
            `rate` they are earlier than the second ends.
        used: (found,) which streaks determine the rate.
        rate: (3,) rad/s, camera axes, of the camera with respect to the stars; None if unknown.
        covariance: (3, 3) rad^2/s^2 of `rate`; None if unknown.
        residual: rad, rms error of an endpoint; NaN if unknown.
        hot_pixels: number of hot pixels, which are repaired or excluded.
    """

    status: StreakStatus
    checksum: int
    exposure: float
    length: float = float("nan")
    endpoints: FloatArray = field(default_factory=no_rows(2, 2))
    used: BoolArray = field(default_factory=lambda: np.empty(0, dtype=np.bool_))
    rate: FloatArray | None = None
    covariance: FloatArray | None = None
    residual: float = float("nan")
    hot_pixels: int = 0

    @property
    def found(self) -> int:
        """The number of streaks with two endpoints."""
        return len(self.endpoints)

    @property
    def used_count(self) -> int:
        """The number of streaks that determine the rate."""
        return int(np.count_nonzero(self.used))

    def reversed(self) -> Self:
        """Return the motion with the opposite direction of time."""
        assert self.rate is not None
        return replace(self, rate=-self.rate, endpoints=self.endpoints[:, ::-1])


@dataclass(frozen=True, slots=True)
class MotionResult(FrameMotion):
    """The maximum-likelihood motion of one exposure and its stars; `rate` is the mean over the exposure.

    The `used` stars determine the motion. `length` and `residual`, here the expected error, refer to these
    stars.

    Attributes:
        stars: (n, 2) px at mid-exposure.
        star_covariance: (n, 2, 2) px^2 of `stars`.
        endpoint_covariance: (n, 2, 2, 2) px^2, star, end.
        directions: (n, 3, 3) unit vectors at start, middle and end, camera axes.
        flux: (n,) counts over the exposure.
        significance: (n,) flux over its standard deviation.
        faint_endpoints: (m, 2, 2) px, accurate to about 1 px, of streaks that were detected but not fitted.
        faint_flux: (m,) counts.
        faint_significance: (m,) flux over its standard deviation.
        psf_sigma: px, fitted standard deviation of the point spread.
        misfit: median chi-square per degree of freedom of the bright stars.
        rate_model: the fitted model, `constant` or `accelerating`.
        acceleration: (3,) rad/s^2 if fitted, else None.
        reason: reason for a missing rate, in one line; empty if there is a rate.
        course: rotation from navigation whose higher terms the fit used; None if it used none.
        line_time_sigma: s, standard deviation of the shutter's line time.
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
        """The quaternion (4,) of the rotation over the exposure, A(q) v_start = v_end; None without a rate.

        It follows from the mean rate and is exact for a fixed axis of rotation.
        """
        return None if self.rate is None else from_rotation_vector(self.rate * self.exposure)

    def line_time_displacement(self, chosen: IntArray, middle_row: float) -> FloatArray:
        """Return displacements (m, 2) px of `chosen` (m,) stars by one standard deviation of the line time.

        The delay is proportional to the distance of a star's row from `middle_row`. The array is empty (0, 2)
        if the line time is exact.
        """
        if not self.line_time_sigma:
            return np.empty((0, 2))
        start, end = self.endpoints[chosen].swapaxes(0, 1)
        delay = self.line_time_sigma / self.exposure * (self.stars[chosen, 1:] - middle_row)
        return np.asarray((end - start) * delay)

    def reversed(self) -> Self:
        """Return the motion with the opposite direction of time and the same acceleration."""
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
    """Raise FlightError for an invalid frame, exposure (s) or prior (rad/s)."""
    expected = (pinhole.rows, pinhole.columns)
    if pixels.shape != expected:
        raise FlightError(f"frame of shape {pixels.shape}, the camera has {expected}: set the camera's size")
    if not np.issubdtype(pixels.dtype, np.unsignedinteger):
        raise FlightError(f"frame of {pixels.dtype}: pass the raw counts as unsigned integers")
    if not (np.isfinite(exposure) and exposure > 0.0):
        raise FlightError(f"exposure of {exposure} s: must be finite and positive")
    if prior_rate is not None and not (np.shape(prior_rate) == (3,) and np.all(np.isfinite(prior_rate))):
        raise FlightError(f"prior rate {prior_rate}: must be three finite values in rad/s, or None")
    if not prior_sigma >= 0.0:
        raise FlightError(f"prior sigma {prior_sigma} rad/s: must not be negative or NaN")


def admit(
    pixels: Image, previous_checksum: int | None, saturation: float, saturated_fraction: float
) -> tuple[int, StreakStatus | None]:
    """Return the checksum of `pixels`, and the status of an unusable frame: black, saturated or frozen.

    A frame equal to the previous one indicates a frozen camera, because two exposures differ in their noise.
    """
    checksum = zlib.crc32(pixels.tobytes())
    state = frame_state(pixels, saturation, saturated_fraction)
    if state is not FrameState.USABLE:
        return checksum, StreakStatus(state.value)
    return checksum, StreakStatus.FROZEN if checksum == previous_checksum else None


def in_time(result: Result, prior_rate: FloatArray | None, prior_sigma: float, sigmas: float) -> Result:
    """Return `result` in the direction of time of the prior, unchanged if the prior is too uncertain."""
    if result.rate is None or prior_rate is None:
        return result
    sign = direction_of_time(result.rate, np.asarray(prior_rate, dtype=float), prior_sigma, sigmas)
    if sign == 0:
        return result
    return replace(result if sign > 0 else result.reversed(), status=StreakStatus.RATE)


def direction_of_time(rate: FloatArray, prior_rate: FloatArray, prior_sigma: float, sigmas: float) -> int:
    """Return the sign (+1, -1) by which a prior orients `rate` (3,), 0 if the prior is too uncertain.

    The prior's projection on the axis must exceed `sigmas` times its standard deviation `prior_sigma`.
    """
    projection = float(rate @ prior_rate / np.linalg.norm(rate))
    if abs(projection) <= sigmas * prior_sigma:
        return 0
    return 1 if projection > 0.0 else -1
