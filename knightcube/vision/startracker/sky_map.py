"""From the pixels of a solved picture to the sky, and back."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import attitude_matrix
from knightcube.vision.camera.lens import CameraModel
from knightcube.vision.startracker.aberration import apparent
from knightcube.vision.startracker.lens_bend import BENDS, bent

# Each step leaves the bend's slope, a few percent, of the error before it.
_STEPS = 8


@dataclass(frozen=True, slots=True, eq=False)
class SkyMap:
    """A camera with its attitude (4,), ICRS to camera, and the bend (6,) of its lens.

    `velocity` (3,) m/s of the camera: directions of the sky are then free of aberration.
    """

    camera: CameraModel
    quaternion: FloatArray
    bend: FloatArray = field(default_factory=lambda: np.zeros(BENDS))
    velocity: FloatArray | None = None

    def directions(self, points: FloatArray) -> FloatArray:
        """Return the unit vectors (n, 3), ICRS, of pixels (n, 2)."""
        seen = bent(self.camera.unit_vectors(points), self.bend) @ attitude_matrix(self.quaternion)
        # Apparent to a camera that flies the other way: right to the square of v/c, 0.002".
        return seen if self.velocity is None else apparent(seen, -self.velocity)

    def pixels(self, directions: FloatArray) -> FloatArray:
        """Return the pixels (n, 2) of unit vectors (n, 3), ICRS; NaN of what the camera does not see."""
        if self.velocity is not None:
            directions = apparent(directions, self.velocity)
        wanted = self.camera.project(directions @ attitude_matrix(self.quaternion).T)
        points = wanted
        for _ in range(_STEPS if self.bend.any() else 0):
            points = points + wanted - self.camera.project(bent(self.camera.unit_vectors(points), self.bend))
        return points
