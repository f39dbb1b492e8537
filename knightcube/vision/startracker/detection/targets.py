"""Where stars are to be measured, and the sky there."""

from __future__ import annotations

from dataclasses import dataclass

from knightcube.astro.arrays import BoolArray, FloatArray, Image, IntArray
from knightcube.vision.records import select
from knightcube.vision.startracker.detection.windows import Windows, cut


@dataclass(frozen=True, slots=True, eq=False)
class Targets:
    """Where stars are to be measured.

    Attributes:
        pixels: (rows, columns) counts.
        middle: (n, 2) column and row.
        level, noise: (n,) counts of a pixel without a star.
        ceiling: counts at which pixels saturate.
        core: (n,) px, radius of the saturated disc.
        trail: (n, 2) px, from the begin to the end of a star's path over the exposure.
        correlation: how much more noisy sums of pixels are than of independent ones.
    """

    pixels: Image
    middle: IntArray
    level: FloatArray
    noise: FloatArray
    ceiling: float
    core: FloatArray
    trail: FloatArray
    correlation: float

    def windows(self, half: int, middle: IntArray | None = None) -> Windows:
        """Return the windows about all targets, or about `middle` (n, 2) beside them."""
        about = self.middle if middle is None else middle
        return cut(self.pixels, about, half, self.level, self.noise, self.ceiling, self.trail)

    def select(self, chosen: BoolArray | IntArray) -> Targets:
        """Return the targets that `chosen` picks."""
        return select(self, chosen, "pixels", "ceiling", "correlation")

    def __len__(self) -> int:
        return len(self.middle)
