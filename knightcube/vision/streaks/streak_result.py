"""The result of a frame of streaks; loads no method: workers compute, the control process only reads."""

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
    """Whether a frame gave a rate, or why not; the values are those of the `streak` telemetry packet."""

    RATE = "rate"
    AMBIGUOUS = "ambiguous"
    TOO_SHORT = "too-short"
    TOO_FEW = "too-few"
    FAILED = "failed"
    BLACK = "black"
    SATURATED = "saturated"
    FROZEN = "frozen"


def no_rows(*shape: int) -> Callable[[], FloatArray]:
    """Return the default factory of a field: an empty array (0, *shape)."""
    return partial(np.empty, (0, *shape))


@dataclass(frozen=True, slots=True)
class FrameMotion:
    """The motion in one frame and the streaks it is from: common to both estimators.

    Attributes:
        status: `rate`: all is known; `ambiguous`: `rate` is right up to its sign, no prior could decide; any
            other: no rate.
        checksum: of the pixels; no two exposures of a living sensor have the same.
        exposure: s, as given; the rate is the mean over it.
        length: px, median of the streaks used, else of those found, else of the regions; NaN when none.
        endpoints: (found, 2, 2) px, compensated when there is a rate; first ends are then simultaneous and,
            when the status is `rate`, earlier.
        used: (found,) which streaks the rate is from.
        rate: (3,) rad/s, camera frame, mean over the exposure, of the camera with respect to the stars; None
            when none.
        covariance: (3, 3) rad^2/s^2 of `rate`; None when none.
        residual: rad, rms of an endpoint; NaN when none.
        hot_pixels: how many were repaired or left out.
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
        """How many streaks with two endpoints there were."""
        return len(self.endpoints)

    @property
    def used_count(self) -> int:
        """How many streaks the rate is from."""
        return int(np.count_nonzero(self.used))

    def reversed(self) -> Self:
        """Return the same motion in the other direction of time."""
        assert self.rate is not None
        return replace(self, rate=-self.rate, endpoints=self.endpoints[:, ::-1])


@dataclass(frozen=True, slots=True)
class MotionResult(FrameMotion):
    """The motion of one exposure and the stars; the rate is that at mid-exposure.

    Every star found has two ends: `endpoints` (n, 2, 2). `used` (n,) are those that were fitted to their
    pixels and determine the motion; `length` and `residual` (expected, not left over) are theirs.

    Attributes:
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
        reason: of a missing rate, in a line; empty with a rate.
        course: the known course that the fit took for the rest of the motion; None without one.
        line_time_sigma: s, by how much the shutter's line time may differ from the one that was fitted.
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
        """The change of attitude over the exposure (4,), A(q) v_start = v_end; None without a rate.

        By the mean rate where it changes: exact about a fixed axis.
        """
        return None if self.rate is None else from_rotation_vector(self.rate * self.exposure)

    def late(self, chosen: IntArray, middle_row: float) -> FloatArray:
        """Return by how many px (m, 2) a standard deviation of the line time displaces `chosen` (m,) stars.

        Each is exposed later by its row's distance from `middle_row`; (0, 2) where the line time is exact.
        """
        if not self.line_time_sigma:
            return np.empty((0, 2))
        start, end = self.endpoints[chosen].swapaxes(0, 1)
        delay = self.line_time_sigma / self.exposure * (self.stars[chosen, 1:] - middle_row)
        return np.asarray((end - start) * delay)

    def reversed(self) -> Self:
        """Return the same motion in the other direction of time; the change of the rate keeps its sign."""
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
    """Raise FlightError for an impossible frame, exposure (s) or prior (rad/s)."""
    expected = (pinhole.rows, pinhole.columns)
    if pixels.shape != expected:
        raise FlightError(f"frame of shape {pixels.shape}, the camera has {expected}: set the camera's size")
    if not np.issubdtype(pixels.dtype, np.unsignedinteger):
        raise FlightError(
            f"frame of {pixels.dtype}: pixels must be unsigned integers, as the camera gave them"
        )
    if not (np.isfinite(exposure) and exposure > 0.0):
        raise FlightError(f"exposure of {exposure} s: must be finite and positive")
    if prior_rate is not None and not (np.shape(prior_rate) == (3,) and np.all(np.isfinite(prior_rate))):
        raise FlightError(f"prior rate {prior_rate}: must be three finite values in rad/s, or None")
    if not prior_sigma >= 0.0:
        raise FlightError(f"prior sigma {prior_sigma} rad/s: must not be negative or NaN")


def admit(
    pixels: Image, previous_checksum: int | None, saturation: float, saturated_fraction: float
) -> tuple[int, StreakStatus | None]:
    """Return the checksum of `pixels`, and why they show no scene: black, saturated, frozen; None if they do.

    Pixels equal to the previous frame's mean a frozen camera: no two exposures have the same noise.
    """
    checksum = zlib.crc32(pixels.tobytes())
    state = frame_state(pixels, saturation, saturated_fraction)
    if state is not FrameState.USABLE:
        return checksum, StreakStatus(state.value)
    return checksum, StreakStatus.FROZEN if checksum == previous_checksum else None


def in_time(result: Result, prior_rate: FloatArray | None, prior_sigma: float, sigmas: float) -> Result:
    """Return an ambiguous `result` in the direction of time that the prior gives it, where it is sure."""
    if result.rate is None or prior_rate is None:
        return result
    sign = direction_of_time(result.rate, np.asarray(prior_rate, dtype=float), prior_sigma, sigmas)
    if sign == 0:
        return result
    return replace(result if sign > 0 else result.reversed(), status=StreakStatus.RATE)


def direction_of_time(rate: FloatArray, prior_rate: FloatArray, prior_sigma: float, sigmas: float) -> int:
    """Return the sign (+1, -1) that a prior gives `rate` (3,), or 0 when it is too weak.

    The prior's projection on the axis decides where it exceeds `sigmas` times its deviation `prior_sigma`.
    """
    projection = float(rate @ prior_rate / np.linalg.norm(rate))
    if abs(projection) <= sigmas * prior_sigma:
        return 0
    return 1 if projection > 0.0 else -1
