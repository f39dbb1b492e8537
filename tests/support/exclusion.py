"""Exclusion of camera frames with the Sun or the Earth in the field (Sease 2.16-2.19, corrected).

The boresight is the camera's +z axis, and the field is a cone around it. With half the field of view as half
angle (the thesis's choice), a corner of the frame may still contain the Sun or the limb. With half the
diagonal as half angle, no corner may contain the Sun or the limb. Vectors are in ICRS, geocentric positions
in m.
"""

from __future__ import annotations

import numpy as np

from knightcube.astro import quaternion
from knightcube.astro.arrays import BoolArray, FloatArray
from knightcube.astro.earth.figure import EARTH_RADIUS
from knightcube.astro.earth.sun import SUN_RADIUS
from knightcube.vision.camera.lens import Pinhole


def boresights(attitudes: FloatArray, mounting: FloatArray = quaternion.IDENTITY) -> FloatArray:
    """Return boresights (m, 3), ICRS, for body `attitudes` (m, 4) and `mounting` (4,) from body to camera."""
    return np.asarray(quaternion.attitude_matrix(quaternion.multiply(mounting, attitudes))[..., 2, :])


def sun_in_field(
    boresight: FloatArray, position: FloatArray, sun: FloatArray, half_angle: float, buffer: float = 0.0
) -> BoolArray:
    """Return whether the Sun is within `half_angle` + `buffer` (rad) of each `boresight` (m, 3) (2.16, 2.17).

    `position` (m, 3) is the position of the camera, and `sun` (m, 3) is the position of the Sun. `buffer`
    accounts for stray light past the baffle.
    """
    to_sun = np.asarray(sun) - position
    return _within(boresight, to_sun, SUN_RADIUS, half_angle + buffer)


def earth_in_field(
    boresight: FloatArray, position: FloatArray, half_angle: float, buffer: float = 0.0
) -> BoolArray:
    """Return whether the Earth is within `half_angle` + `buffer` (rad) of the boresights (2.18, 2.19)."""
    return _within(boresight, -np.asarray(position), EARTH_RADIUS, half_angle + buffer)


def in_field(
    camera: Pinhole, attitudes: FloatArray, directions: FloatArray, margin: float = 0.0
) -> BoolArray:
    """Return which `directions` (m, 3), ICRS, are on the detector or up to `margin` px outside of it."""
    seen = (quaternion.attitude_matrix(attitudes) @ directions[..., None])[..., 0]
    return camera.contains(camera.project(seen), margin)


def _within(boresight: FloatArray, to_body: FloatArray, radius: float, half_angle: float) -> BoolArray:
    distance = np.linalg.norm(to_body, axis=-1)
    cosine = np.sum(boresight * to_body, axis=-1) / distance
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))
    return np.asarray(angle < np.arcsin(np.minimum(1.0, radius / distance)) + half_angle)
