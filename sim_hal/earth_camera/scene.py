"""The positions of camera, Earth and Sun when a frame is taken, and the Earth's atmosphere.

The air thins exponentially and scatters sunlight once, which gives the soft limb, twilight, and haze over
the ground. The optical depth along an oblique path is the vertical one times Chapman's function, here the
limit for a scale height far below the Earth's radius, sqrt(pi X/2) exp(X mu^2/2) erfc(mu sqrt(X/2)) with X
their ratio and mu the cosine from the zenith (Huestis 2001, J. Quant. Spectrosc. Radiat. Transfer 69, 709).
The formula is also valid with the Sun below the horizon, and gives twilight. Not modelled: refraction (which
would raise the apparent limb by 0.2 km, 0.004 deg), ozone, and clouds above the limb.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy.special import erfcx

from hal.interfaces.errors import OutOfRange, check_limits
from knightcube.astro import quaternion
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.figure import SEMI_MAJOR_AXIS, semi_axes

Float32Array = npt.NDArray[np.float32]

ATMOSPHERE = "atmosphere"
_DEEPEST = -9.0
"""Below it the Sun's rays pass through optical depths of 1e35: dark."""


@dataclass(frozen=True, slots=True)
class Atmosphere:
    """Exponential air.

    Attributes:
        scale_height: m.
        optical_depth: vertical, of the whole of it; Rayleigh's at 550 nm (Bucholtz 1995, Appl. Opt. 34).
        multiple: brightness of light scattered any number of times over that of light scattered once.
    """

    scale_height: float = 8000.0
    optical_depth: float = 0.097
    multiple: float = 1.5

    def __post_init__(self) -> None:
        limits = {
            "scale_height": (100.0, 50e3, "m"),
            "optical_depth": (0.011, 10.0, ""),
            "multiple": (0.0, 4.0, ""),
        }
        check_limits(ATMOSPHERE, self, limits)

    @property
    def _ratio(self) -> float:
        return SEMI_MAJOR_AXIS / self.scale_height

    @property
    def limb_depth(self) -> float:
        """The optical depth of a line that touches the ground, end to end: some 70 times the vertical."""
        return self.optical_depth * math.sqrt(2.0 * math.pi * self._ratio)

    @property
    def apparent_limb_height(self) -> float:
        """The tangent height in m at which a sunlit limb has half the brightness it tends to further down.

        There 1 - exp(-depth) is 1/2, and the depth is `limb_depth` exp(-height/scale height).
        """
        return self.scale_height * math.log(self.limb_depth / math.log(2.0))

    def tangent_depth(self, heights: Float32Array) -> Float32Array:
        """Return the optical depth right through along lines whose tangent heights (...) m are given."""
        return np.asarray(self.limb_depth * np.exp(-heights / self.scale_height))

    def slant_depth(self, cosines: Float32Array) -> Float32Array:
        """Return the optical depth from the ground out, at cosines (...) from the zenith, of either sign."""
        root = math.sqrt(0.5 * self._ratio)
        argument = np.maximum(cosines * root, _DEEPEST)
        return np.asarray(self.optical_depth * math.sqrt(math.pi) * root * erfcx(argument))

    def scattered(self, depth: Float32Array, bottom: Float32Array, sunward: Float32Array) -> Float32Array:
        """Return the share of sunlight scattered along lines of sight, before the phase function.

        `depth` (...) is the optical depth along the line; `bottom` (...) the density at its lowest point over
        that at the ground; `sunward` (...) the optical depth from the ground below there towards the Sun.
        Light comes from above where the line's own depth reaches one, and the Sun's attenuation is averaged
        over the air above that (exponential in the density, so its mean is (1 - exp(-x))/x).
        """
        x = np.maximum(sunward * bottom / (1.0 + depth), 1e-6)
        return np.asarray(np.expm1(-depth) * np.expm1(-x) / x)

    def phase(self, cosines: Float32Array) -> Float32Array:
        """Return the radiance of endless sunlit air at cosines (...) of the angle from the Sun's rays.

        Rayleigh's phase function over four (a white matt surface being 1), times `multiple`.
        """
        return np.asarray(self.multiple * 0.1875 * (1.0 + cosines * cosines))


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
