"""Settings of the search for objects among the stars, and the objects measured in a frame."""

from __future__ import annotations

from dataclasses import dataclass, field

from knightcube.astro.arrays import FloatArray


@dataclass(frozen=True, slots=True)
class ObjectSettings:
    """Thresholds and limits of the search for objects.

    Attributes:
        bounds: standard deviations of centre, displacement and residual below which none fires, whatever the
            spread within the frame: `python -m tests.studies.bench.rso_spread`.
        strict: the thesis's 2.5 sigma, of the spread within the frame.
        psf_sigma: px, of the camera.
        most_streaks: how many regions are examined; the rate needs fewer.
        most_points: how many short regions are examined.
        most_merged: how many regions are searched for an object among the light of their stars.
        least_share: part of a region's light that an object beside stars must have: an error of the rotation
            of 2 % leaves that much at the end of a bright star's streak.
        most_corners: regions with more are left unclear.
        point_significance: least counts of a short region over the noise of its area.
        improvement: least gain in chi-square of an object over stars.
        crossing_improvement: the same for an object that crosses stars, the best of many lines tried.
        worst_fit: largest chi-square per pixel of an accepted object.
    """

    bounds: tuple[float, float, float] = (8.0, 10.0, 10.0)
    strict: float = 2.5
    psf_sigma: float = 1.0
    most_streaks: int = 80
    most_points: int = 20
    most_merged: int = 12
    least_share: float = 0.04
    most_corners: int = 6
    point_significance: float = 20.0
    improvement: float = 300.0
    crossing_improvement: float = 600.0
    worst_fit: float = 2.5


@dataclass(frozen=True, slots=True)
class ObjectMeasurementSettings:
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
class MeasuredObjects:
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
