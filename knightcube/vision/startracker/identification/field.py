"""The stars of one frame and the assumed lens: the input of an identification method."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from knightcube.astro.arrays import FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class StarField:
    """Observed points, brightest first; some of them may not be stars.

    Attributes:
        direction: (n, 3) unit vectors, camera frame, by the assumed focal length.
        sigma: (n,) rad, standard deviation of each direction along one axis.
        half_width: (2,) tangents of the half field along x and y.
        scale: (lowest, highest) factor of all tangents x/z, y/z for the true focal length: (1, 1) for a
            calibrated camera.
        magnitude: (n,) instrumental, up to one common constant; None if only the order is known.
    """

    direction: FloatArray
    sigma: FloatArray
    half_width: tuple[float, float]
    scale: tuple[float, float] = (1.0, 1.0)
    magnitude: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.direction)

    def rescaled(self, factor: float) -> StarField:
        """Return the field with all tangents multiplied by `factor`, about which the scale is known."""
        stretched = self.direction * np.array([factor, factor, 1.0])
        return replace(
            self,
            direction=stretched / np.linalg.norm(stretched, axis=-1, keepdims=True),
            sigma=self.sigma * factor,
            half_width=(self.half_width[0] * factor, self.half_width[1] * factor),
            scale=(self.scale[0] / factor, self.scale[1] / factor),
        )

    def mirrored(self) -> StarField:
        """Return the field as a mirror shows it: left and right exchanged about the boresight."""
        return replace(self, direction=self.direction * np.array([-1.0, 1.0, 1.0]))

    def subset(self, chosen: IntArray) -> StarField:
        """Return the field of the stars `chosen` (k,) by number, in that order."""
        magnitude = None if self.magnitude is None else self.magnitude[chosen]
        return replace(self, direction=self.direction[chosen], sigma=self.sigma[chosen], magnitude=magnitude)
