"""Settings of the search for objects among the stars and of its streaks, and the objects found in a frame."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from knightcube.astro.arrays import FloatArray


@dataclass(frozen=True, slots=True)
class EndpointSettings:
    """How streaks are separated and their ends located; the defaults suit the demonstration's camera.

    Attributes:
        threshold_sigmas: threshold of the 3 x 3 sum in standard deviations; 0 selects the image's mean, as in
            the thesis.
        least_area: minimum number of pixels in a region; a noise peak fills nine pixels of the 3 x 3 sum.
        most_streaks: maximum number of regions that are measured, strongest first.
        saturation: counts at which a pixel saturates; None: the maximum of the integer type.
        gain: electrons per count.
        smoothing_sigma: px, Gaussian smoothing before the corner detector; 0: none.
        derivative_sigma: px, of the Gaussian derivative.
        window_sigma: px, of the window of the structure tensor.
        harris_k: k of 3.8.
        peak_relative: minimum cornerness of an endpoint relative to the largest of its streak. The Harris
            response grows with the fourth power of the brightness, so that 0.005 allows a brightness ratio of
            3.8 between the ends.
        intensity_half_width: px, N of 3.15.
        centre_of: image of which the centre of intensity is computed: the cornerness, or the frame as in the
            thesis.
        endpoint_bias: px, outward shift along the streak that compensates the detector, for a given camera:
            `python -m tests.studies.bench.endpoint_bias`.
        endpoint_floor: px, error of an endpoint of a bright streak.
        endpoint_noise: px, error of an endpoint per ratio of noise to counts per px of length.
        border: px, distance from the frame's border within which streaks are rejected.
        least_length: px, minimum median length of the streaks.
        least_streaks: minimum number of streaks.
    """

    threshold_sigmas: float = 4.5
    least_area: int = 14
    most_streaks: int = 30
    saturation: float | None = None
    gain: float = 1.0
    smoothing_sigma: float = 0.0
    derivative_sigma: float = 1.0
    window_sigma: float = 1.5
    harris_k: float = 0.15
    peak_relative: float = 0.005
    intensity_half_width: int = 3
    centre_of: Literal["response", "image"] = "response"
    endpoint_bias: float = 0.035
    endpoint_floor: float = 0.03
    endpoint_noise: float = 4.2
    border: int = 6
    least_length: float = 20.0
    least_streaks: int = 4


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
