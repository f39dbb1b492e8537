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
        endpoint_bias: px, outward shift along the streak that compensates the detector, measured for a point
            spread of 1 px.
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
    """Thresholds and limits of the search for objects among streaks.

    Attributes:
        bounds: standard deviations of centre, displacement and residual below which an indicator never fires
            (the measured spread without an object).
        strict: standard deviations within the image that must be exceeded too, 2.5 in the thesis.
        psf_sigma: point spread of the camera, px.
        gain: electrons per count.
        saturation: counts at which a pixel saturates; None: the maximum of the integer type.
        most_streaks: maximum number of examined regions; a rate needs fewer.
        most_points: maximum number of examined short regions.
        most_merged: maximum number of regions that are searched after their stars are removed.
        least_share: least light of an object beside stars, as a fraction of the light of its region: an error
            of the rotation of 2 % leaves that much at the end of a bright star's streak.
        most_corners: number of corners above which a region is not decided.
        point_significance: least light of a short region, in standard deviations.
        improvement: least gain in chi-square of an object over stars.
        crossing_improvement: the same for an object that crosses stars, the best of many tested lines.
        worst_fit: largest chi-square per pixel of an accepted object.
        streak_sigma: standard deviation per axis of the midpoint between the ends of an object, px.
    """

    bounds: tuple[float, float, float] = (8.0, 10.0, 10.0)
    strict: float = 2.5
    psf_sigma: float = 1.0
    gain: float = 1.0
    saturation: float | None = None
    most_streaks: int = 80
    most_points: int = 20
    most_merged: int = 12
    least_share: float = 0.04
    most_corners: int = 6
    point_significance: float = 20.0
    improvement: float = 300.0
    crossing_improvement: float = 600.0
    worst_fit: float = 2.5
    streak_sigma: float = 0.1


@dataclass(frozen=True, slots=True)
class ObjectMeasurementSettings:
    """Settings of the measurement of possible objects in an image with a known attitude.

    Attributes:
        search: settings of the search among streaks.
        faintest: V of the faintest object. The catalogue has nearly all stars of this magnitude, and half a
            magnitude of fainter ones.
        significance: least light of an area, in standard deviations.
        clearance: least distance from the nearest catalogue star, px, in addition to half the area's length.
        floor: least standard deviation per axis, px, for any brightness (campaign `object-passes`).
        centre_sigma: least standard deviation of a centre of light, px, if the pixels could not be fitted.
        most: maximum number of objects, the brightest.
    """

    search: ObjectSettings = field(default_factory=ObjectSettings)
    faintest: float = 7.0
    significance: float = 25.0
    clearance: float = 4.0
    floor: float = 0.002
    centre_sigma: float = 0.05
    most: int = 16


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredObjects:
    """Possible objects in an image, the brightest first.

    Attributes:
        points: positions at mid-exposure (n, 2), px.
        directions: unit vectors (n, 3), ICRS, without the aberration of the stars.
        covariance: covariance of the positions as directions (n, 3, 3), rad^2, ICRS axes.
        magnitudes: V magnitudes relative to the stars of the image (n,); NaN if unknown.
        attitude: covariance of the attitude (3, 3), rad^2, ICRS axes, which all objects share.
    """

    points: FloatArray
    directions: FloatArray
    covariance: FloatArray
    magnitudes: FloatArray
    attitude: FloatArray
