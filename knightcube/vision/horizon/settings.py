"""Settings of the horizon search, the response of the camera, and prior knowledge for one image.

A horizon does not determine the rotation about nadir. The prior knowledge (position, Sun, rough attitude,
directions from other sensors) resolves it and tests a fitted horizon.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from knightcube.astro.arrays import FloatArray, Image
from knightcube.astro.earth.figure import SEMI_MAJOR_AXIS
from knightcube.errors import UsageError

LEAST_ALTITUDE = 50e3
"""Lowest altitude (m) from which a limb is visible: below, the camera is inside the air."""


@dataclass(frozen=True, slots=True, eq=False)
class SensedDirection:
    """A direction known in camera and inertial axes, such as the coarse Sun or the magnetic field.

    Attributes:
        camera: measured direction (3,) in camera axes, of any length.
        inertial: direction (3,) by ephemeris or field model in inertial axes, of any length.
        sigma: standard deviation per axis, rad.
    """

    camera: FloatArray
    inertial: FloatArray
    sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class RoughAttitude:
    """An attitude (4,), inertial into camera axes, scalar last, and its standard deviation per axis, rad."""

    quaternion: FloatArray
    sigma: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HorizonKnowledge:
    """Optional data from GPS, ephemerides and coarse sensors for one image.

    Attributes:
        position: position (3,), m from the Earth's centre, inertial axes. It gives the altitude and, with
            `pole`, the limb of the ellipsoid.
        altitude: height above a sphere of the mean radius, m, if the position is unknown.
        sun: direction (3,) to the Sun, inertial axes, of any length.
        pole: direction (3,) of the Earth's axis, inertial axes.
        attitude: rough attitude of the camera, for instance predicted by a filter.
        sensed: directions from coarse sensors.

    Raises:
        ValueError: if a value is not finite, has another shape, or lies inside the Earth.
    """

    position: FloatArray | None = None
    altitude: float | None = None
    sun: FloatArray | None = None
    pole: FloatArray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    attitude: RoughAttitude | None = None
    sensed: tuple[SensedDirection, ...] = ()

    def __post_init__(self) -> None:
        for name in ("position", "sun", "pole"):
            value = getattr(self, name)
            if value is not None and (np.shape(value) != (3,) or not np.all(np.isfinite(value))):
                raise ValueError(f"{name} = {value}: give (3,) finite numbers")
        if self.position is not None and np.linalg.norm(self.position) < SEMI_MAJOR_AXIS + LEAST_ALTITUDE:
            raise ValueError(f"position = {self.position}: inside the Earth, give metres from its centre")
        if self.altitude is not None and not LEAST_ALTITUDE <= self.altitude < np.inf:
            raise ValueError(
                f"altitude = {self.altitude}: give metres above the Earth, {LEAST_ALTITUDE:g} at least"
            )


@dataclass(frozen=True, slots=True)
class LogarithmicResponse:
    """The response counts = pedestal + counts_per_decade log10(1 + light / dark current) of a detector."""

    pedestal: float
    counts_per_decade: float

    def light(self, counts: Image) -> FloatArray:
        """Return the light of `counts` (...), in units of the dark current."""
        return np.asarray(10.0 ** ((counts - self.pedestal) / self.counts_per_decade) - 1.0)


def light_of(counts: Image, response: LogarithmicResponse | None) -> FloatArray:
    """Return the light of counts (...) in any unit; without a response, the light is proportional to them."""
    if response is None:
        return np.asarray(counts, dtype=float)
    if counts.dtype == np.uint8:
        return np.asarray(response.light(np.arange(256.0))[counts])
    return response.light(counts)


@dataclass(frozen=True, slots=True, kw_only=True)
class EdgeSettings:
    """Settings of the search for edges along scan lines.

    Attributes:
        lines: number of columns, and of rows, that are read.
        more_lines: the same number for a second search.
        run: window of the filter that removes short fluctuations, px, odd (Meller 3.1).
        threshold: threshold of bright pixels, as a fraction of the span from dark to bright pixels.
        contrast: height of the weakest edge, as a fraction of the same span.
        most: maximum number of edges per line; the edges with the darkest dark side are kept.
        psf_sigma: blur of the optics, px.
        response: response of the detector; None: linear.
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
        if self.lines < 2:
            raise UsageError(f"lines {self.lines}: give at least 2 columns and rows")
        if self.run < 1 or self.run % 2 == 0:
            raise UsageError(f"run {self.run}: must be an odd number of pixels")
        for name in ("threshold", "contrast"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise UsageError(f"{name} {getattr(self, name)}: must lie between 0 and 1")


@dataclass(frozen=True, slots=True, kw_only=True)
class HorizonSettings:
    """Settings of the choice of the horizon among edges, and its assumed errors.

    Attributes:
        edges: settings of the search for edges.
        limb_height_sigma: standard deviation of the apparent limb's height, m. The default holds for air of
            unknown scale height (6.5 to 9.5 km) and haze (a third more or less); 1,000 holds for known air.
        altitude_sigma: standard deviation of the altitude of a given position, m.
        altitudes: range of an unknown altitude, m. A disc of any size is the limb from some altitude: the
            default, for low orbits, excludes logos and lens ghosts.
        tolerance: distance of an edge from a circular cone, px; it covers the flattening of the Earth.
        least_edges: minimum number of edges of a horizon.
        enough_edges: number of edges below which a horizon is searched again on more lines.
        some_edges: number of edges below which an image is not searched again.
        candidates: maximum number of horizons searched for in one image.
        tries: number of pairs or triples of edges tried for each candidate.
        sphere_sigma: standard deviation per axis, rad, added if the direction of the flattening is unknown.
    """

    edges: EdgeSettings = field(default_factory=EdgeSettings)
    limb_height_sigma: float = 3000.0
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
        low, high = self.altitudes
        if not LEAST_ALTITUDE <= low < high < math.inf:
            raise UsageError(
                f"altitudes of {1e-3 * low:g} to {1e-3 * high:g} km: give an increasing range from"
                f" {1e-3 * LEAST_ALTITUDE:g} km, below which no limb is visible"
            )
