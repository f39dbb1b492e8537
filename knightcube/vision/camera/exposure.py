"""How long to expose: stars that streak should do so over enough pixels to tell their rate."""

from __future__ import annotations

from dataclasses import dataclass

STREAK = 20.0
"""Wanted streak length (px): rates are poor below 5 px, and faint stars are lost above 100 px."""
POINT = 1.0
"""Motion in the usual exposure (px) below which a star is a point."""


@dataclass(frozen=True, slots=True)
class Exposures:
    """The exposures of a camera.

    Attributes:
        usual: s, of points.
        least, most: s, of streaks.
        scale: px by rad.
    """

    usual: float
    least: float
    most: float
    scale: float

    def at(self, rate: float) -> float:
        """Return the exposure, s, while the camera turns at `rate` rad/s across its boresight."""
        speed = rate * self.scale
        if speed * self.usual < POINT:
            return self.usual
        return min(max(STREAK / speed, self.least), self.most)
