"""The currents of solar strings on a body's faces: sunlight, the Earth's, shadow, and the cells' own errors.

The Earth's light is summed over the ground that the satellite sees, matt and everywhere of one albedo,
sunlit by the cosine law: 0.3 is the Earth's mean (Stephens et al. 2015, Rev. Geophys. 53: 0.29).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hal.interfaces.errors import check_limits
from knightcube.astro.arrays import FloatArray
from knightcube.astro.directions import tangent_basis
from knightcube.astro.earth.figure import EARTH_RADIUS
from knightcube.astro.earth.shadow import sunlit_share
from knightcube.astro.earth.sun import ASTRONOMICAL_UNIT

DEVICE = "solar strings"
_RINGS, _SPOKES = 16, 32


@dataclass(frozen=True, slots=True, eq=False)
class SolarStringsModel:
    """What the strings do.

    Attributes:
        normals: (n, 3) unit vectors, outward, in body axes.
        peaks: (n,) A, at one astronomical unit, straight upon them.
        gain_errors: (n,) relative departures from the peaks.
        grazing: rad; light that falls in within so much of the surface is reflected: the cosine gives way.
        noise: A, standard deviation.
        albedo: of the Earth.
    """

    normals: FloatArray
    peaks: FloatArray
    gain_errors: FloatArray
    grazing: float = math.radians(5.0)
    noise: float = 2e-3
    albedo: float = 0.3

    def __post_init__(self) -> None:
        count = len(self.normals)
        if np.shape(self.normals) != (count, 3) or np.shape(self.peaks) != (count,):
            raise ValueError(f"{DEVICE}: give normals (n, 3) and peaks (n,)")
        if np.shape(self.gain_errors) != (count,):
            raise ValueError(f"{DEVICE}: give one gain error a string")
        limits = {"grazing": (0.0, 0.5, "rad"), "noise": (0.0, 10.0, "A"), "albedo": (0.0, 1.0, "")}
        check_limits(DEVICE, self, limits)

    def currents(
        self, position: FloatArray, sun: FloatArray, body: FloatArray, generator: np.random.Generator
    ) -> FloatArray:
        """Return the currents (n,) A at `position` (3,) m, the Sun at `sun` (3,) m, geocentric, ICRS.

        `body` (3, 3) is the attitude matrix, ICRS into body axes.
        """
        to_sun = sun - position
        distance = float(np.linalg.norm(to_sun))
        share = float(sunlit_share(position, sun)) * (ASTRONOMICAL_UNIT / distance) ** 2
        normals = self.normals @ body
        light = share * self._accepted(normals @ to_sun / distance)
        light = light + self._earthlight(normals, position, sun)
        noise = self.noise * generator.standard_normal(len(self.peaks))
        # A string's diode lets no current back.
        return np.asarray(np.maximum(self.peaks * (1.0 + self.gain_errors) * light + noise, 0.0))

    def _accepted(self, cosines: FloatArray) -> FloatArray:
        """Return what of light at `cosines` (...) of incidence becomes current, 0 .. 1."""
        grazing = math.sin(self.grazing)
        dimmed = cosines * np.clip(cosines / grazing, 0.0, 1.0) if grazing > 0.0 else cosines
        return np.asarray(np.maximum(dimmed, 0.0))

    def _earthlight(self, normals: FloatArray, position: FloatArray, sun: FloatArray) -> FloatArray:
        """Return the Earth's light on strings of `normals` (n, 3), ICRS, over the Sun's."""
        rays, ground, solid = _ground_in_view(position)
        lit = np.maximum(ground @ (sun / np.linalg.norm(sun)), 0.0)
        return np.asarray(self._accepted(normals @ rays.T) @ (self.albedo / np.pi * solid * lit))


def _ground_in_view(position: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Return unit vectors (m, 3) from `position` (3,) m to the ground, its verticals (m, 3), and sr for each.

    Rings of equal solid angle as the satellite sees them, so that the near ground has its weight.
    """
    distance = float(np.linalg.norm(position))
    down = -position / distance
    widest = math.sqrt(1.0 - (EARTH_RADIUS / distance) ** 2)
    cosine = 1.0 - (np.arange(_RINGS) + 0.5) / _RINGS * (1.0 - widest)
    sine = np.sqrt(1.0 - cosine**2)
    angle = np.arange(_SPOKES) * (2.0 * np.pi / _SPOKES)
    spokes = np.stack([np.cos(angle), np.sin(angle)], axis=1) @ tangent_basis(down)
    rays = cosine[:, None, None] * down + sine[:, None, None] * spokes
    length = distance * cosine - np.sqrt(EARTH_RADIUS**2 - (distance * sine) ** 2)
    ground = (position + length[:, None, None] * rays) / EARTH_RADIUS
    return rays.reshape(-1, 3), ground.reshape(-1, 3), 2.0 * np.pi * (1.0 - widest) / (_RINGS * _SPOKES)
