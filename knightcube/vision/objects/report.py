"""The result of the search for objects: a verdict on each streak, and the objects."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from knightcube.astro.arrays import FloatArray
from knightcube.vision.objects.rso_indicators import Indicators


class Verdict(Enum):
    """The verdict on a streak: a star by its indicators, stars by its pixels, an object, or neither."""

    STAR = "star"
    STARS = "stars"
    OBJECT = "object"
    UNCLEAR = "unclear"


@dataclass(frozen=True, slots=True)
class SpaceObject:
    """A streak or point that does not move as the stars do.

    Attributes:
        endpoints: (2, 2) px, in the order of time for which the motion among the stars is the slower.
        fired: names of the indicators that singled it out; none when it was found by its pixels alone.
        flux: counts.
        improvement: of chi-square over stars.
        relative_rate: rad/s, its motion among the stars.
        direction: (2,) unit vector in the image (x, y), of that motion at mid-exposure.
        other_relative_rate: rad/s, for the other order of the endpoints, which one frame cannot exclude.
    """

    endpoints: FloatArray
    fired: tuple[str, ...]
    flux: float
    improvement: float
    relative_rate: float
    direction: FloatArray
    other_relative_rate: float


@dataclass(frozen=True, slots=True)
class ObjectReport:
    """The streaks examined and the objects found.

    Attributes:
        indicators: of all streaks with two ends, then of the short regions.
        verdicts: one for each of them.
        crowded: verdicts of the regions with more than two corners.
        objects: brightest first.
        rotation: (3,) rad, camera frame, as used.
    """

    indicators: Indicators
    verdicts: tuple[Verdict, ...]
    crowded: tuple[Verdict, ...]
    objects: tuple[SpaceObject, ...]
    rotation: FloatArray
