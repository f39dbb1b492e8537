"""What comes of a frame of streaks; how is told elsewhere: the control process takes in but does not work."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from flight.gnc.math.arrays import BoolArray, FloatArray


class StreakStatus(Enum):
    """What came of a frame; the values are those of the `streak` telemetry packet."""

    RATE = "rate"
    AMBIGUOUS = "ambiguous"
    TOO_SHORT = "too-short"
    TOO_FEW = "too-few"
    FAILED = "failed"
    BLACK = "black"
    SATURATED = "saturated"
    FROZEN = "frozen"


@dataclass(frozen=True, slots=True)
class StreakResult:
    """What vision found in one frame.

    Attributes:
        status: `rate`: all is known; `ambiguous`: `rate` is right up to its sign, no prior could tell; any
            other: no rate.
        checksum: of the pixels; no two exposures of a living sensor have the same.
        exposure: s, as given; the rate is the mean over it.
        length: px, median of the streaks used, of those found, or of the regions, as far as it came; NaN when
            none.
        endpoints: (found, 2, 2) px, compensated when there is a rate; first ends are then simultaneous and,
            when the status is `rate`, earlier.
        sigma: (found,) px, expected error of an endpoint, small for the bright.
        used: (found,) which streaks the rate is from.
        rate: (3,) rad/s, camera frame, mean over the exposure, of the camera with respect to the stars; None
            when none.
        covariance: (3, 3) rad^2/s^2 of `rate`; None when none.
        residual: rad, rms of an endpoint; NaN when none.
        hot_pixels: how many were repaired.
    """

    status: StreakStatus
    checksum: int
    exposure: float
    length: float = float("nan")
    endpoints: FloatArray = field(default_factory=lambda: np.empty((0, 2, 2)))
    sigma: FloatArray = field(default_factory=lambda: np.empty(0))
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
