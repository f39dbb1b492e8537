"""Prior knowledge of the camera's position and attitude: all optional, each with its spread."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.figure import SEMI_MAJOR_AXIS

ICRS_POLE: FloatArray = np.array([0.0, 0.0, 1.0])
LEAST_ALTITUDE = 50e3
"""m: lower down, within the air, no limb is visible."""


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
