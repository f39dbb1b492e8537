"""How stars that are nearly points move over the exposure: by the camera's turn, row after row."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.vision.camera.lens import CameraModel


@dataclass(frozen=True, slots=True, eq=False)
class ShortTrails:
    """How stars that are nearly points move over the exposure.

    Attributes:
        turn: (3,) rad, of the camera over the exposure, its axes.
        delay: exposures from one row's to the next's, and `delay_sigma`, its standard deviation.
    """

    turn: FloatArray
    delay: float = 0.0
    delay_sigma: float = 0.0

    def of(self, camera: CameraModel, direction: FloatArray) -> FloatArray:
        """Return by how much stars at `direction` (n, 3), camera axes, move: (n, 2) px."""
        moved = 0.5 * np.cross(direction, self.turn)
        return np.nan_to_num(camera.project(direction + moved) - camera.project(direction - moved))

    def late(self, camera: CameraModel, points: FloatArray) -> FloatArray:
        """Return by how much stars at `points` (n, 2) px are off for each exposure of delay: (n, 2) px."""
        return self.of(camera, camera.unit_vectors(points)) * (points[:, 1:] - camera.centre[1])
