"""The result of an identification method (Michalski 3.2)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from knightcube.astro.arrays import FloatArray, IntArray
from knightcube.astro.attitude.wahba import AttitudeFix


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
