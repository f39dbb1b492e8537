"""What detection hands over: stars with honest errors, and what was refused and why."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum, IntFlag

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.vision.records import select


class Quality(IntFlag):
    """Faults of a detection. Those of the first line are still stars, their errors widened."""

    POINT = 0
    SATURATED, BLENDED, CLIPPED = 1, 2, 4
    HOT, EXTENDED, STREAK, CLUTTER = 16, 32, 64, 128


REFUSED = int(Quality.HOT | Quality.EXTENDED | Quality.STREAK | Quality.CLUTTER)


class FrameKind(Enum):
    """The content of a frame: stars at rest, stars drawn out to streaks, or neither."""

    POINTS = "points"
    STREAKS = "streaks"
    NEITHER = "neither"


@dataclass(frozen=True, slots=True)
class FrameShape:
    """What kind of frame it is, and the median length of its streaks, px (about 0 for points)."""

    kind: FrameKind
    length: float


@dataclass(frozen=True, slots=True, eq=False)
class Detections:
    """Sources of one frame, the brightest first.

    Attributes:
        points: (n, 2) px, x and y.
        sigma: (n,) px, standard deviation along one axis.
        covariance: (n, 2, 2) px^2.
        flux: (n,) counts above the background.
        background: (n,) counts a pixel beneath the source.
        signal_to_noise: (n,) flux over its standard deviation.
        width: (n,) px, the sigma of the Gaussian that fits the source best by itself; NaN where not measured.
        quality: (n,) int64, `Quality` flags.
        prediction: (n,) number of the prediction a source was found at; -1 for one of a whole frame.
        psf_sigma: px, of the stars of this frame; NaN where it was neither given nor measured.
    """

    points: FloatArray
    sigma: FloatArray
    covariance: FloatArray
    flux: FloatArray
    background: FloatArray
    signal_to_noise: FloatArray
    width: FloatArray
    quality: IntArray
    prediction: IntArray
    psf_sigma: float

    @classmethod
    def none(cls, psf_sigma: float = np.nan) -> Detections:
        """Return no detections."""
        empty, whole = np.zeros(0), np.zeros(0, dtype=np.int64)
        return cls(
            np.zeros((0, 2)),
            empty,
            np.zeros((0, 2, 2)),
            empty,
            empty,
            empty,
            empty,
            whole,
            whole,
            psf_sigma,
        )

    @property
    def is_star(self) -> BoolArray:
        """Which (n,) may be stars: not refused as hot, extended, streak or clutter."""
        return np.asarray((self.quality & REFUSED) == 0)

    def select(self, chosen: BoolArray | IntArray) -> Detections:
        """Return those that `chosen` picks, by mask (n,) or by number in the order given."""
        return select(self, chosen, "psf_sigma")

    def in_order(self) -> Detections:
        """Return them with the brightest first."""
        return self.select(np.argsort(-self.flux, kind="stable"))

    def scaled(self, unit: float) -> Detections:
        """Return them with flux and background in units of 1 / `unit`."""
        return replace(self, flux=self.flux * unit, background=self.background * unit)

    def stars(self) -> Detections:
        """Return those that may be stars."""
        return self.select(self.is_star)

    def __len__(self) -> int:
        return len(self.flux)
