"""Settings of the search for objects among streaks and points, and the objects measured in a frame."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from knightcube.astro.arrays import BoolArray, FloatArray, finite_array


@dataclass(frozen=True, slots=True)
class EndpointSettings:
    """Settings of the segmentation of streaks and of the location of their ends.

    The defaults are suitable for the camera of the demonstration.

    Attributes:
        threshold_sigmas: threshold for the sum of 3 x 3 pixels, in standard deviations of this sum; with 0
            the threshold is the image mean, as in Sease.
        least_area: minimum number of pixels in a region. A noise peak in one pixel raises the 3 x 3 sums of
            nine pixels.
        most_streaks: maximum number of bright regions that are measured; regions with the largest ratio of
            length to endpoint error are measured first.
        saturation: counts at which a pixel saturates, or None for the maximum of the integer type.
        gain: electrons per count.
        smoothing_sigma: standard deviation of the Gaussian that smooths the image before the corner detector,
            px; 0 for no smoothing.
        derivative_sigma: standard deviation of the Gaussian derivative, px.
        window_sigma: standard deviation of the Gaussian window of the structure tensor, px.
        harris_k: constant k of the Harris response (Sease, eq. (3.8)).
        peak_relative: minimum cornerness (Harris response) of an endpoint, as a fraction of the largest
            cornerness of the streak. The Harris response grows with the fourth power of the brightness, so
            that 0.005 allows a brightness ratio of 3.8 between the two ends.
        intensity_half_width: half-width of the window of the centre of intensity, px (N in Sease, eq.
            (3.15)).
        centre_of: image in which the centre of intensity locates an endpoint, "response" for the Harris
            response, or "image" for the frame as in Sease.
        endpoint_bias: outward displacement of the endpoints that compensates the bias of the corner detector,
            px; measured for a point spread function (PSF) of 1 px.
        endpoint_floor: standard deviation of the position of an endpoint of a bright streak, px.
        endpoint_noise: standard deviation of an endpoint due to pixel noise, px, divided by the ratio of
            pixel noise to the streak's counts per px of length.
        border: distance from the border of the frame within which streaks are rejected, px.
        least_length: minimum median length of the streaks in a frame, px.
        least_streaks: minimum number of streaks in a frame.
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
        bounds: thresholds of the three indicators "centre", "displacement" and "residual", in expected
            standard deviations, as measured in images without an object.
        strict: additional threshold of the three indicators, in standard deviations over the streaks of the
            image; 2.5 as in Sease.
        psf_sigma: standard deviation of the camera's point spread function (PSF), px.
        gain: electrons per count.
        saturation: counts at which a pixel saturates, or None for the maximum of the integer type.
        most_streaks: maximum number of regions that are examined as streaks.
        most_points: maximum number of short regions that are examined as points.
        most_merged: maximum number of regions that are searched again after their stars are removed.
        least_share: minimum flux of an object found beside stars, as a fraction of the flux of the region.
            The default is the fraction of a bright star's streak that remains at its end after subtraction if
            the rotation has an error of 2 %.
        most_corners: number of corners (peaks of the Harris response) above which a region is not examined.
        point_significance: minimum flux of a short region, in standard deviations of its noise.
        improvement: minimum decrease of chi-square when an object is added to a model of stars.
        crossing_improvement: minimum decrease of chi-square for an object whose streak crosses stars. It is
            larger than `improvement`, because many lines are tested.
        worst_fit: largest chi-square per pixel along the streak of an accepted object.
        streak_sigma: standard deviation, per axis, of the midpoint of a streak that is too short to locate
            its ends, px.
        end_floor: minimum standard deviation of an end of an object's streak, px, due to faint stars.

    Raises:
        ArgumentError: unless the bounds are three finite numbers.
    """

    bounds: tuple[float, float, float] = (8.0, 10.0, 10.0)
    strict: float = 2.5
    psf_sigma: float = 1.0
    gain: float = 1.0
    saturation: float | None = None
    most_streaks: int = 80
    most_points: int = 20
    most_merged: int = 10
    least_share: float = 0.04
    most_corners: int = 6
    point_significance: float = 20.0
    improvement: float = 300.0
    crossing_improvement: float = 600.0
    worst_fit: float = 2.5
    streak_sigma: float = 0.1
    end_floor: float = 0.2

    def __post_init__(self) -> None:
        finite_array("bounds", self.bounds, (3,))


@dataclass(frozen=True, slots=True)
class ObjectMeasurementSettings:
    """Settings of the measurement of possible objects in an image with a known attitude.

    Attributes:
        search: settings of the search for objects in images whose stars are streaks.
        faintest: V magnitude of the faintest object that is reported; the star catalogue must be complete to
            fainter magnitudes.
        significance: minimum flux of an area of light, in standard deviations of its noise.
        clearance: minimum distance between an object and the nearest catalogue star, px, in addition to half
            the length of the object's area of light.
        floor: minimum standard deviation per axis of a position, px (from the campaign `object-passes`).
        centre_sigma: minimum standard deviation per axis, px, of the centroid that is used if the fit of an
            object fails.
        most: maximum number of objects that are reported, the brightest first.
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
        directions: unit vectors to the objects (n, 3), ICRS, corrected for stellar aberration if the velocity
            of the camera is known.
        covariance: covariances of the directions due to the errors of the positions (n, 3, 3), rad^2, ICRS.
        magnitudes: V magnitudes of the objects (n,), measured by comparison with the stars of the image, or
            NaN if unknown.
        attitude: covariance of the attitude error (3, 3), rad^2, ICRS axes. The attitude error is common to
            all objects.
    """

    points: FloatArray
    directions: FloatArray
    covariance: FloatArray
    magnitudes: FloatArray
    attitude: FloatArray


FLOOR_PX = 0.1
"""Smallest standard deviation (px) per axis of a point of light; its main cause is saturation."""


@dataclass(frozen=True, slots=True, eq=False)
class FieldPoints:
    """Points of light in a frame whose stars are not identified: moving points first, then the brightest.

    Attributes:
        points: positions at mid-exposure (n, 2), px.
        directions: unit vectors at mid-exposure (n, 3), camera axes.
        sigma: standard deviation of each direction per axis (n,), rad.
        flux: flux of each point (n,), counts.
        moving: mask of the points that move relative to the stars within the single frame (n,).
    """

    points: FloatArray
    directions: FloatArray
    sigma: FloatArray
    flux: FloatArray
    moving: BoolArray
