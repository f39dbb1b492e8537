"""The input and the result of a star identification method (Michalski 3.2)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from knightcube.astro.arrays import FloatArray, IntArray
from knightcube.astro.attitude.wahba import AttitudeFix


@dataclass(frozen=True, slots=True, eq=False)
class StarField:
    """The observed points of a frame, the brightest first; some of them may not be stars.

    Attributes:
        direction: unit vectors (n, 3) in the camera frame, for the assumed focal length.
        sigma: standard deviation of each direction along one axis (n,), rad.
        half_width: tangents of half the field of view along x and y (2,).
        scale: lowest and highest factor by which the tangents x/z, y/z must be multiplied for the true focal
            length; (1, 1) for a calibrated camera.
        magnitude: instrumental magnitudes (n,), up to a common constant; None if only the order is known.
    """

    direction: FloatArray
    sigma: FloatArray
    half_width: tuple[float, float]
    scale: tuple[float, float] = (1.0, 1.0)
    magnitude: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.direction)

    def rescaled(self, factor: float) -> StarField:
        """Return the field with all tangents multiplied by `factor`, and the range of the scale adapted."""
        stretched = self.direction * np.array([factor, factor, 1.0])
        return replace(
            self,
            direction=stretched / np.linalg.norm(stretched, axis=-1, keepdims=True),
            sigma=self.sigma * factor,
            half_width=(self.half_width[0] * factor, self.half_width[1] * factor),
            scale=(self.scale[0] / factor, self.scale[1] / factor),
        )

    def mirrored(self) -> StarField:
        """Return the mirrored field: left and right are exchanged about the boresight."""
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
    """The guide stars assigned to the observed stars, and the attitude that follows.

    Attributes:
        status: the other attributes are valid for IDENTIFIED only.
        star: numbers of the guide stars (n,); -1 for an observed point without one.
        fix: attitude from all matched stars, ICRS to camera, with its covariance; None unless identified.
        scale: factor by which the tangents of the observed directions had to be multiplied.
        scale_sigma: standard deviation of the scale; 0 if the scale was given.
        log10_false_alarm: log10 of the probability that random stars would match as well anywhere in the sky;
            0 if unknown.
        distortion: fitted distortion of the lens, as the relative shift of a star in the corner
            (`attitude_fit`); 0 if the stars matched without distortion.
        from_lens: part of the covariance of `fix` that is due to the uncertainty of `distortion` (3, 3),
            rad^2.
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
