"""The result of a frame of streaks; loads no method: workers compute, the control process only reads."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import partial
from typing import Self

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray


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
class StreakResult(FrameMotion):
    """The motion by corner detectors.

    Attributes:
        sigma: (found,) px, expected error of an endpoint, small for the bright.
    """

    sigma: FloatArray = field(default_factory=no_rows())
