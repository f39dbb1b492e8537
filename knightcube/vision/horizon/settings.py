"""Settings of the horizon search, the response of the detector, and prior knowledge for one image.

A horizon does not determine the rotation about nadir. Prior knowledge (position, Sun, rough attitude,
directions from other sensors) determines this rotation and is compared with a fitted horizon.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from knightcube.astro.arrays import (
    FloatArray,
    Image,
    brief,
    check_fields,
    check_type,
    checked_deviation,
    checked_number,
    finite_array,
    real_number,
    unit_quaternion,
    unit_vector,
)
from knightcube.astro.earth.figure import SEMI_MAJOR_AXIS
from knightcube.errors import ArgumentError, UsageError

LEAST_ALTITUDE = 50e3
"""Lowest altitude (m) from which the limb is visible; a lower camera is inside the atmosphere."""

_FEWEST_EDGES = 3
"""Number of edges that determine a cone, and with it the nadir and the altitude."""


@dataclass(frozen=True, slots=True, eq=False)
class SensedDirection:
    """A direction known in camera and inertial axes, such as the direction of the Sun or the magnetic field.

    Attributes:
        camera: measured direction (3,) in camera axes, of any length.
        inertial: direction (3,) from an ephemeris or field model in inertial axes, of any length.
        sigma: standard deviation of the measured direction per axis, rad.

    Raises:
        ArgumentError: if a direction is not three finite numbers or is zero, or if `sigma` is not positive.
    """

    camera: FloatArray
    inertial: FloatArray
    sigma: float

    def __post_init__(self) -> None:
        for name in ("camera", "inertial"):
            unit_vector(name, getattr(self, name))
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=float))
        _check_sigma(self.sigma)


@dataclass(frozen=True, slots=True, eq=False)
class RoughAttitude:
    """An approximate attitude (4,) of a camera, inertial to camera axes, with `sigma` per axis, rad.

    The quaternion has the scalar part last. Raises ArgumentError if the quaternion is not of unit length, or
    if `sigma` is not positive.
    """

    quaternion: FloatArray
    sigma: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "quaternion", unit_quaternion("quaternion", self.quaternion))
        _check_sigma(self.sigma)


def _check_sigma(sigma: float) -> None:
    """Raise ArgumentError unless the standard deviation of prior knowledge is positive or infinite."""
    if checked_deviation("sigma", sigma, "rad") == 0.0:
        raise ArgumentError("sigma", f"{sigma}: give a standard deviation above 0 rad")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HorizonKnowledge:
    """Optional prior knowledge for one image, from GPS, ephemerides and coarse sensors.

    Attributes:
        position: position (3,) of the camera, m from the Earth's centre, inertial axes.
        altitude: height of the camera above the Earth's mean radius, m, used if the position is unknown.
        sun: direction (3,) to the Sun, inertial axes, of any length.
        pole: direction (3,) of the Earth's rotation axis, inertial axes.
        attitude: approximate attitude of the camera, for instance as predicted by a filter.
        sensed: directions measured by coarse sensors.

    Raises:
        ArgumentError: if a value is not finite or has a wrong shape or type, if a direction is zero, or if
            the position is inside the Earth.
    """

    position: FloatArray | None = None
    altitude: float | None = None
    sun: FloatArray | None = None
    pole: FloatArray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    attitude: RoughAttitude | None = None
    sensed: tuple[SensedDirection, ...] = ()

    def __post_init__(self) -> None:
        for name in ("position", "sun", "pole"):
            if (value := getattr(self, name)) is not None:
                object.__setattr__(self, name, finite_array(name, value, (3,)))
        for name in ("sun", "pole"):
            if (value := getattr(self, name)) is not None:
                unit_vector(name, value)
        if self.attitude is not None:
            check_type("attitude", self.attitude, RoughAttitude)
        check_type("sensed", self.sensed, tuple)
        for each in self.sensed:
            check_type("sensed", each, SensedDirection)
        if self.position is not None and np.linalg.norm(self.position) < SEMI_MAJOR_AXIS + LEAST_ALTITUDE:
            raise ArgumentError("position", f"{self.position}: inside the Earth, give metres from its centre")
        if self.altitude is not None and not LEAST_ALTITUDE <= real_number(self.altitude) < np.inf:
            least = f"give metres above the Earth, {LEAST_ALTITUDE:g} at least"
            raise ArgumentError("altitude", f"{brief(self.altitude)}: {least}")


@dataclass(frozen=True, slots=True)
class LogarithmicResponse:
    """A detector whose counts are pedestal + counts_per_decade log10(1 + light / dark current)."""

    pedestal: float
    counts_per_decade: float

    def light(self, counts: Image) -> FloatArray:
        """Return the light intensity for `counts` (...), in units of the dark current."""
        return np.asarray(10.0 ** ((counts - self.pedestal) / self.counts_per_decade) - 1.0)


def light_of(counts: Image, response: LogarithmicResponse | None) -> FloatArray:
    """Return the light intensity for `counts` (...), in arbitrary units.

    Without a `response` of the detector, the intensity is proportional to the counts.
    """
    if response is None:
        return np.asarray(counts, dtype=float)
    if counts.dtype == np.uint8:
        return np.asarray(response.light(np.arange(256.0))[counts])
    return response.light(counts)


@dataclass(frozen=True, slots=True, kw_only=True)
class EdgeSettings:
    """Settings of the search for edges along scan lines.

    Attributes:
        lines: number of columns, and of rows, that the first search reads.
        more_lines: number of columns, and of rows, that a second search of the image reads.
        run: window of the majority filter against short fluctuations, px, an odd number (Meller et al.,
            section 3.1).
        threshold: brightness above which a pixel counts as bright, as a fraction of the range from the dark
            level to the bright level.
        contrast: minimum step height of an edge, as a fraction of the range from dark to bright level.
        most: maximum number of edges in an image, as a multiple of the number of lines; the edges with the
            darkest dark side are kept.
        psf_sigma: standard deviation of the blur of the optics, px. A larger blur is fitted if the brightness
            profiles of the limb show it clearly.
        response: response of the detector, or None for a linear detector.

    Raises:
        UsageError: if a value is out of range.
    """

    lines: int = 32
    more_lines: int = 96
    run: int = 5
    threshold: float = 0.3
    contrast: float = 0.15
    most: int = 5
    psf_sigma: float = 0.6
    response: LogarithmicResponse | None = None

    def __post_init__(self) -> None:
        check_fields(self)
        if self.response is not None:
            check_type("response", self.response, LogarithmicResponse)
        checked_deviation("psf_sigma", self.psf_sigma, "pixels")
        for name in ("lines", "more_lines"):
            if getattr(self, name) < 2:
                raise UsageError(f"{name} {getattr(self, name)}: give at least 2 columns and rows")
        if self.run < 1 or self.run % 2 == 0:
            raise UsageError(f"run {self.run}: must be an odd number of pixels")
        if self.most < 1:
            raise UsageError(f"most {self.most}: give at least 1 edge for each line")
        for name in ("threshold", "contrast"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise UsageError(f"{name} {getattr(self, name)}: must lie between 0 and 1")


@dataclass(frozen=True, slots=True, kw_only=True)
class HorizonSettings:
    """Settings of the search for the horizon among edges, and assumed errors of altitude and limb.

    Attributes:
        edges: settings of the search for edges.
        limb_height_sigma: standard deviation of the apparent limb's height, m. The default standard deviation
            of the limb height is valid for an atmosphere of unknown scale height (6.5 to 9.5 km) and unknown
            haze. If scale height and haze are known, the value can be reduced to 1,000 m.
        uneven_limb_sigma: standard deviation of the variation of the limb's height along the limb, m. The
            height of the limb varies with the elevation of the Sun, latitude, haze and clouds.
        altitude_sigma: standard deviation of the altitude of a known position, m.
        altitudes: range of an unknown altitude, m. The default range of altitudes covers low orbits. An
            unlimited range would accept any bright disc as the Earth, for instance a lens ghost.
        tolerance: largest distance of an edge from a horizon's circular cone, px; it includes the Earth's
            flattening.
        least_edges: minimum number of edges on a horizon.
        enough_edges: number of edges on a horizon below which the image is searched again on more scan lines.
        some_edges: number of edges in an image below which the image is not searched again.
        candidates: maximum number of candidate horizons in one image.
        tries: maximum number of pairs or triples of edges that are tried for each horizon.
        sphere_sigma: standard deviation per axis, rad, of the tilt of the limb that the Earth's flattening
            causes for a camera close to the surface. The tilt is added to the uncertainty of nadir if the
            direction of the flattening is unknown. The tilt of the limb decreases with the square of the
            distance from the Earth's centre.

    Raises:
        UsageError: if a value is out of range.
    """

    edges: EdgeSettings = field(default_factory=EdgeSettings)
    limb_height_sigma: float = 3000.0
    uneven_limb_sigma: float = 2000.0
    altitude_sigma: float = 50.0
    altitudes: tuple[float, float] = (100e3, 2_000e3)
    tolerance: float = 2.0
    least_edges: int = 8
    enough_edges: int = 20
    some_edges: int = 4
    candidates: int = 4
    tries: int = 400
    sphere_sigma: float = math.radians(0.1)

    def __post_init__(self) -> None:
        check_fields(self)
        check_type("edges", self.edges, EdgeSettings)
        for name, unit in (
            ("limb_height_sigma", "metres"),
            ("altitude_sigma", "metres"),
            ("tolerance", "pixels"),
        ):
            checked_number(name, getattr(self, name), unit)
        for name, unit in (("uneven_limb_sigma", "m"), ("sphere_sigma", "rad")):
            checked_deviation(name, getattr(self, name), unit)
        for name, least in (("least_edges", _FEWEST_EDGES), ("candidates", 1), ("tries", 1)):
            if getattr(self, name) < least:
                raise UsageError(f"{name} {getattr(self, name)}: give at least {least}")
        low, high = finite_array("altitudes", self.altitudes, (2,)).tolist()
        if not LEAST_ALTITUDE <= low < high < math.inf:
            raise UsageError(
                f"altitudes of {1e-3 * low:g} to {1e-3 * high:g} km: give the lower altitude first,"
                f" and at least {1e-3 * LEAST_ALTITUDE:g} km, below which no limb is visible"
            )
