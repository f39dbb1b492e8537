"""Settings of the horizon search, the camera's response to light, and prior knowledge for one image.

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

ICRS_POLE: FloatArray = np.array([0.0, 0.0, 1.0])
LEAST_ALTITUDE = 50e3
"""Least altitude (m): within the air no limb is visible."""


@dataclass(frozen=True, slots=True, eq=False)
class SensedDirection:
    """A direction known in both frames: the coarse Sun of the solar strings, or the magnetic field.

    Attributes:
        camera: (3,) as sensed, camera axes; of any length.
        inertial: (3,) by ephemeris or field model; of any length.
        sigma: rad, of an axis.
    """

    camera: FloatArray
    inertial: FloatArray
    sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class RoughAttitude:
    """An attitude of the camera, inertial into camera axes, (4,) scalar last, and its spread, rad an axis."""

    quaternion: FloatArray
    sigma: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HorizonKnowledge:
    """Data of GPS, ephemerides and coarse sensors; the horizon is fitted without them, too.

    Attributes:
        position: (3,) m from the Earth's centre, inertial axes: sets the altitude and, with `pole`, the
            ellipsoid's cone.
        altitude: m above a sphere of the mean radius, where there is no position.
        sun: (3,) towards the Sun, inertial axes; of any length.
        pole: (3,) the Earth's axis, inertial axes.
        attitude: a rough one, from the filter.
        sensed: directions from coarse sensors.

    Raises ValueError for a value that is not finite, of another shape, or inside the Earth.
    """

    position: FloatArray | None = None
    altitude: float | None = None
    sun: FloatArray | None = None
    pole: FloatArray = field(default_factory=ICRS_POLE.copy)
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
    """counts = pedestal + counts_per_decade log10(1 + light), light in units of the dark current."""

    pedestal: float
    counts_per_decade: float

    def light(self, counts: Image) -> FloatArray:
        """Return the light of `counts` (...)."""
        return np.asarray(10.0 ** ((counts - self.pedestal) / self.counts_per_decade) - 1.0)


def light_of(counts: Image, response: LogarithmicResponse | None) -> FloatArray:
    """Return the light of counts (...), of any scale; without a response they are proportional to it."""
    if response is None:
        return np.asarray(counts, dtype=float)
    if counts.dtype == np.uint8:
        return np.asarray(response.light(np.arange(256.0))[counts])
    return response.light(counts)


@dataclass(frozen=True, slots=True, kw_only=True)
class EdgeSettings:
    """How edges are found along scan lines.

    Attributes:
        lines: number of columns, and of rows, that are read.
        more_lines: the same for a second look.
        run: px, odd: shorter fluctuations are filtered out (Meller 3.1).
        threshold: of bright pixels, as a share of the way from the low to the high average.
        contrast: of the weakest edge, as a share of the same way.
        most: edges kept for each of `lines`, those with the darkest dark side.
        psf_sigma: px, the blur of the optics.
        response: the detector's, if it is not linear.
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
            raise UsageError(f"lines {self.lines}: at least 2 columns and rows are read")
        if self.run < 1 or self.run % 2 == 0:
            raise UsageError(f"run {self.run}: must be an odd number of pixels")
        for name in ("threshold", "contrast"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise UsageError(f"{name} {getattr(self, name)}: must lie between 0 and 1")


@dataclass(frozen=True, slots=True, kw_only=True)
class HorizonSettings:
    """How the horizon is chosen among edges, and its assumed errors.

    Attributes:
        edges: see `EdgeSettings`.
        limb_height_sigma: m, of the apparent limb's height: the default is for air of unknown scale height
            (6.5 to 9.5 km) and haze (a third more or less), 1,000 for known air.
        altitude_sigma: m, of a given position.
        altitudes: m, least and greatest of an unknown altitude. A disc of any size is the limb of some
            altitude: the default, of low orbits, refuses logos and ghosts of a lens.
        tolerance: px, within which edges agree with a circular cone; the Earth's flattening fits into it.
        least_edges: of a horizon.
        enough_edges: a horizon of fewer edges is searched again on more lines.
        some_edges: a picture of fewer edges is not searched again.
        candidates: number of horizons searched for in one picture.
        tries: pairs or triples of edges tried for each.
        sphere_sigma: rad an axis, added where the flattening's direction is unknown.
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
                f"altitudes of {1e-3 * low:g} to {1e-3 * high:g} km: the limb is seen as one from"
                f" {1e-3 * LEAST_ALTITUDE:g} km up, and the least comes first"
            )
