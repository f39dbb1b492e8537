"""What may be objects in a frame, and how they are sighted."""

from __future__ import annotations

from dataclasses import dataclass, field

from knightcube.astro.arrays import FloatArray
from knightcube.vision.objects.settings import ObjectSettings


@dataclass(frozen=True, slots=True)
class SightSettings:
    """How objects are sighted.

    Attributes:
        search: of the search among streaks.
        faintest: V; the catalogue has nearly all stars so bright, and half a magnitude of what is fainter.
        significance: least counts of an area over the noise of its pixels.
        clearance: px from the nearest catalogue star, beside half the area's own length.
        floor: px, standard deviation along an axis that no brightness betters (campaign `object-passes`).
        centre_sigma: px, the same of a centre of light, where the pixels could not be fitted.
        streak_sigma: px, of the middle of an object's streak by its ends, likewise.
        most: sightings of a frame, the brightest.
    """

    search: ObjectSettings = field(default_factory=ObjectSettings)
    faintest: float = 7.0
    significance: float = 25.0
    clearance: float = 4.0
    floor: float = 0.002
    centre_sigma: float = 0.05
    streak_sigma: float = 0.1
    most: int = 16


@dataclass(frozen=True, slots=True, eq=False)
class Sighted:
    """What may be objects in a frame, the brightest first.

    Attributes:
        points: (n, 2) px at mid-exposure.
        directions: (n, 3) unit vectors, ICRS, free of the stars' aberration.
        covariance: (n, 3, 3) rad^2, ICRS axes, of the places in the image.
        magnitudes: (n,) V by the frame's stars; NaN when unknown.
        attitude: (3, 3) rad^2, ICRS axes, of the attitude: common to all.
    """

    points: FloatArray
    directions: FloatArray
    covariance: FloatArray
    magnitudes: FloatArray
    attitude: FloatArray
