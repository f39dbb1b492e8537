"""A camera on the body: where each of several cameras looks, so that one result in body axes can use all."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import attitude_matrix
from knightcube.vision.camera.lens import CameraModel


@dataclass(frozen=True, slots=True, eq=False)
class MountedCamera:
    """A lens and its mounting.

    Attributes:
        lens: pixels to directions in the camera's axes.
        mounting: quaternion (4,), body into camera.
        to_camera: the matrix (3, 3) of that.
    """

    lens: CameraModel
    mounting: FloatArray
    to_camera: FloatArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "mounting", np.asarray(self.mounting, dtype=float))
        object.__setattr__(self, "to_camera", attitude_matrix(self.mounting))

    def seen(self, directions: FloatArray) -> FloatArray:
        """Return directions (..., 3), body axes, in the camera's."""
        return np.asarray(directions @ self.to_camera.T)

    def in_body(self, rays: FloatArray) -> FloatArray:
        """Return rays (..., 3), camera axes, in the body's."""
        return np.asarray(rays @ self.to_camera)
