"""Air that thins exponentially and scatters sunlight once: the soft limb, twilight, and haze over the ground.

The optical depth of an oblique way through it is the vertical one times Chapman's function, here the limit
for a scale height far below the Earth's radius, sqrt(pi X/2) exp(X mu^2/2) erfc(mu sqrt(X/2)) with X their
ratio and mu the cosine from the zenith (Huestis 2001, J. Quant. Spectrosc. Radiat. Transfer 69, 709). It
serves where the Sun is below the horizon, too, and gives twilight. No refraction (it would raise the
apparent limb by 0.2 km, 0.004 deg), no ozone, no clouds that tower above the limb.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.special import erfcx

from hal.interfaces.errors import check_limits
from knightcube.astro.earth.figure import SEMI_MAJOR_AXIS

Float32Array = npt.NDArray[np.float32]

DEVICE = "atmosphere"
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
        check_limits(DEVICE, self, limits)

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
