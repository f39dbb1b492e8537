"""The input and the result of a star identification method (Michalski 3.2)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from knightcube.astro.arrays import FloatArray, IntArray
from knightcube.astro.attitude.wahba import AttitudeFix


@dataclass(frozen=True, slots=True, eq=False)
class StarField:
    """Observed points, brightest first; some of them may not be stars.

    Attributes:
        direction: (n, 3) unit vectors, camera frame, by the assumed focal length.
        sigma: (n,) rad, standard deviation of each direction along one axis.
        half_width: (2,) tangents of the half field along x and y.
        scale: (lowest, highest) factor of all tangents x/z, y/z for the true focal length: (1, 1) for a
            calibrated camera.
        magnitude: (n,) instrumental, up to one common constant; None if only the order is known.
    """

    direction: FloatArray
    sigma: FloatArray
    half_width: tuple[float, float]
    scale: tuple[float, float] = (1.0, 1.0)
    magnitude: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.direction)

    def rescaled(self, factor: float) -> StarField:
        """Return the field with all tangents multiplied by `factor`, about which the scale is known."""
        stretched = self.direction * np.array([factor, factor, 1.0])
        return replace(
            self,
            direction=stretched / np.linalg.norm(stretched, axis=-1, keepdims=True),
            sigma=self.sigma * factor,
            half_width=(self.half_width[0] * factor, self.half_width[1] * factor),
            scale=(self.scale[0] / factor, self.scale[1] / factor),
        )

    def mirrored(self) -> StarField:
        """Return the field as a mirror shows it: left and right exchanged about the boresight."""
        return replace(self, direction=self.direction * np.array([-1.0, 1.0, 1.0]))

    def subset(self, chosen: IntArray) -> StarField:
        """Return the field of the stars `chosen` (k,) by number, in that order."""
        magnitude = None if self.magnitude is None else self.magnitude[chosen]
        return replace(self, direction=self.direction[chosen], sigma=self.sigma[chosen], magnitude=magnitude)


class Status(Enum):
    """The outcome of an identification."""

    IDENTIFIED = "identified"
    TOO_FEW_STARS = "too-few-stars"
    NO_MATCH = "no-match"
    AMBIGUOUS = "ambiguous"


@dataclass(frozen=True, slots=True, eq=False)
class Identification:
    """Which guide star each observed star is.

    Attributes:
        status: the rest is meaningful for IDENTIFIED only.
        star: (n,) numbers of guide stars, -1 for an observed star that is none of them.
        fix: attitude from all matched stars, ICRS to camera, with its covariance; None unless identified.
        scale: by which the tangents of the observed directions had to be multiplied.
        scale_sigma: its standard deviation; 0 when the scale was given.
        log10_false_alarm: of the probability that random stars would match as well anywhere in the sky; 0 if
            unknown.
        distortion: relative shift of a star in the corner that the lens was found to have (see the module
            `distortion`); 0 where the stars matched without.
        from_lens: (3, 3) rad^2, the part of the covariance of `fix` that is the uncertainty of `distortion`.
        mirrored: whether the sky was found in the mirrored field (`StarField.mirrored`); `fix` is the
            attitude of that field.
    """

    status: Status
    star: IntArray
    fix: AttitudeFix | None = None
    scale: float = 1.0
    scale_sigma: float = 0.0
    log10_false_alarm: float = 0.0
    distortion: float = 0.0
    from_lens: FloatArray | None = None
    mirrored: bool = False
