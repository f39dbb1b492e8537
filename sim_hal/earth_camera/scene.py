"""Where camera, Earth and Sun are when a frame is taken."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from hal.interfaces.errors import OutOfRange
from knightcube.astro import quaternion
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.figure import semi_axes
from sim_hal.earth_camera.atmosphere import Atmosphere

DEVICE = "Earth scene"


def _icrs_pole() -> FloatArray:
    return np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True, eq=False)
class EarthScene:
    """Camera, Earth and Sun at one instant.

    Attributes:
        position: of the camera, (3,) m, geocentric, ICRS.
        attitude: quaternion (4,), ICRS into camera.
        sun: the Sun's position, (3,) m, geocentric, ICRS.
        pole: the Earth's pole, (3,) unit, ICRS; 0.15 deg from the default by now.
        rotation: rad, the Earth's turn about its pole: it carries the ground with it.
        texture: the seed of land, sea and cloud.
        atmosphere: the air.

    Raises OutOfRange for a camera inside the Earth, ValueError for arrays of another shape or not finite.
    """

    position: FloatArray
    attitude: FloatArray
    sun: FloatArray
    pole: FloatArray = field(default_factory=_icrs_pole)
    rotation: float = 0.0
    texture: int = 0
    atmosphere: Atmosphere = field(default_factory=Atmosphere)

    def __post_init__(self) -> None:
        for name, size in (("position", 3), ("attitude", 4), ("sun", 3), ("pole", 3)):
            value = np.asarray(getattr(self, name), dtype=float)
            if value.shape != (size,) or not np.all(np.isfinite(value)):
                raise ValueError(f"{DEVICE}: {name} = {value}: give ({size},) finite numbers")
            object.__setattr__(self, name, value)
        for name in ("attitude", "pole"):
            length = float(np.linalg.norm(getattr(self, name)))
            if abs(length - 1.0) > 1e-6:
                raise OutOfRange(DEVICE, f"length of {name}", length, 1.0, 1.0, "")
        if not np.isfinite(self.rotation):
            raise OutOfRange(DEVICE, "rotation", self.rotation, -np.inf, np.inf, "rad")
        outside = float(np.linalg.norm(self.in_earth(self.position) / semi_axes()))
        if outside <= 1.0:
            raise OutOfRange(DEVICE, "position in Earth radii", outside, 1.0, np.inf, "")

    @property
    def camera_matrix(self) -> FloatArray:
        """The matrix (3, 3) from ICRS into camera axes."""
        return quaternion.attitude_matrix(self.attitude)

    @property
    def earth_matrix(self) -> FloatArray:
        """The matrix (3, 3) from ICRS into axes fixed to the Earth, its pole last."""
        # The axis that the pole is least along makes the sounder cross product.
        aside = np.cross(self.pole, np.eye(3)[int(np.argmin(np.abs(self.pole)))])
        first = np.cross(aside / np.linalg.norm(aside), self.pole)
        second = np.cross(self.pole, first)
        cosine, sine = np.cos(self.rotation), np.sin(self.rotation)
        return np.stack([cosine * first + sine * second, cosine * second - sine * first, self.pole])

    def in_earth(self, vectors: FloatArray) -> FloatArray:
        """Return vectors (..., 3), ICRS, in axes fixed to the Earth."""
        return np.asarray(vectors @ self.earth_matrix.T)
