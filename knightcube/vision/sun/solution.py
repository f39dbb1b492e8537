"""The result for one frame: the Sun's direction with its covariance, or the reason for none."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from knightcube.astro.arrays import FloatArray


class SunStatus(Enum):
    """The outcome of the search for the Sun."""

    FOUND = "found"
    PARTIAL = "partial"
    """Found, but cut by the frame's edge: see the covariance."""
    NO_SUN = "no-sun"
    """Nothing is bright enough."""
    NOT_THE_SUN = "not-the-sun"
    """Something is bright enough, but too small, too large or not round: see the reason."""


@dataclass(frozen=True, slots=True, eq=False)
class SunMeasurement:
    """The direction to the Sun's centre from one frame.

    Attributes:
        direction: (3,) unit vector in camera axes.
        basis: (2, 3), two unit vectors normal to it and to one another.
        tangent_covariance: (2, 2) rad^2, of the direction's error along `basis`; without the lens's
            calibration.
        point: (2,) px, of the centre; NaN outside the lens's image.
        radius: rad, of the bright disc, glare included.
        residual: px rms, of the rim points that were used.
        arc: rad of the rim that was used.
        cut: whether the frame's edge cuts the bright disc.
    """

    direction: FloatArray
    basis: FloatArray
    tangent_covariance: FloatArray
    point: FloatArray
    radius: float
    residual: float
    arc: float
    cut: bool

    @property
    def covariance(self) -> FloatArray:
        """The covariance (3, 3) rad^2 of the direction's error: of rank 2, nothing along the direction."""
        return np.asarray(self.basis.T @ self.tangent_covariance @ self.basis)

    @property
    def sigma(self) -> float:
        """The root of the mean variance over the two axes, rad."""
        return float(np.sqrt(0.5 * np.trace(self.tangent_covariance)))


@dataclass(frozen=True, slots=True, eq=False)
class SunSolution:
    """The outcome of one frame.

    Attributes:
        sun: the measurement, when the status is FOUND or PARTIAL.
        pixels_read: number of pixels read.
    """

    status: SunStatus
    reason: str = ""
    sun: SunMeasurement | None = None
    pixels_read: int = 0
