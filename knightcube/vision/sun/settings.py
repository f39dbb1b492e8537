"""Settings of the search for the Sun in a camera's frame."""

from __future__ import annotations

import math
from dataclasses import dataclass

from knightcube.errors import UsageError


@dataclass(frozen=True, slots=True, kw_only=True)
class SunSettings:
    """How the Sun is distinguished from other bright objects, and its assumed errors.

    At one exposure the Sun's bright disc, glare included, has one radius: give that within about a fifth;
    within wide bounds a cloud may pass for the Sun. The defaults are for a logarithmic camera like the Fuga
    15d; `LINEAR` is for a linear one whose white clouds come near to saturation.

    Attributes:
        level: counts, exceeded by the Sun's image. For a logarithmic camera well above the brightest cloud,
            so that only the disc remains; for a linear one a little below saturation.
        stride: px between the rows that are read first.
        least_radius: rad; smaller patches are hot pixels. The disc itself has 0.0047.
        greatest_radius: rad; larger patches are clouds, or the Earth.
        tolerance: px rms by which the rim may be off a circle.
        least_agreement: share of the rim within the frame that must lie on the circle.
        least_arc: rad of the rim that must be seen.
        rim_sigma: px, a rim point's error that the fit's residuals may not show.
        floor_sigma: px an axis, least error of the centre, from the pixels' pattern.
    """

    level: float = 200.0
    stride: int = 3
    least_radius: float = math.radians(0.35)
    greatest_radius: float = math.radians(0.6)
    tolerance: float = 0.25
    least_agreement: float = 0.55
    least_arc: float = math.radians(110.0)
    rim_sigma: float = 0.03
    floor_sigma: float = 0.01

    def __post_init__(self) -> None:
        if self.stride < 1:
            raise UsageError(f"stride {self.stride}: must be a whole number of pixels from 1")
        if not 0.0 < self.least_radius < self.greatest_radius < 0.5:
            raise UsageError(
                f"least_radius {self.least_radius} and greatest_radius {self.greatest_radius}: "
                "give rad that grow, the greatest below 0.5"
            )
        for name in ("level", "tolerance", "rim_sigma", "floor_sigma"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise UsageError(f"{name} {getattr(self, name)}: must be positive")
        if not 0.5 <= self.least_agreement <= 1.0:
            raise UsageError(f"least_agreement {self.least_agreement}: must lie between 0.5 and 1")
        if not 0.0 < self.least_arc <= 2.0 * math.pi:
            raise UsageError(f"least_arc {self.least_arc}: must lie between 0 and 2 pi rad")


LINEAR = SunSettings(least_radius=math.radians(1.3), greatest_radius=math.radians(2.0))
"""For a linear 8-bit camera, a white matt surface at 200 counts, its optics scattering 1 % of the light."""
