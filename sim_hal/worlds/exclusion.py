"""Exclusion: the Sun or the Earth in the camera's field, or the Earth between camera and object.

Sease 2.16-2.19 corrected: the boresight is the camera's +z. The field is taken as a cone about it; with half
the field of view (the thesis's) a corner of the frame may still see the Sun or the limb, with the pinhole's
half diagonal it may not. Vectors in ICRS, positions geocentric in m.
"""

from __future__ import annotations

import numpy as np

from knightcube.astro import quaternion
from knightcube.astro.arrays import BoolArray, FloatArray
from knightcube.astro.earth.figure import EARTH_RADIUS
from knightcube.astro.earth.sun import SUN_RADIUS
from knightcube.vision.camera.lens import Pinhole


def boresights(attitudes: FloatArray, mounting: FloatArray = quaternion.IDENTITY) -> FloatArray:
    """Return the boresights (m, 3), ICRS, at body `attitudes` (m, 4); `mounting` (4,) body into camera."""
    return np.asarray(quaternion.attitude_matrix(quaternion.multiply(mounting, attitudes))[..., 2, :])


def sun_in_field(
    boresight: FloatArray, position: FloatArray, sun: FloatArray, half_angle: float, buffer: float = 0.0
) -> BoolArray:
    """Return at which `boresight` (m, 3) the Sun's disc is within `half_angle` + `buffer` rad (2.16, 2.17).

    `position` (m, 3) is the camera's, `sun` (m, 3) the Sun's; `buffer` is for stray light past the baffle.
    """
    to_sun = np.asarray(sun) - position
    return _within(boresight, to_sun, SUN_RADIUS, half_angle + buffer)


def earth_in_field(
    boresight: FloatArray, position: FloatArray, half_angle: float, buffer: float = 0.0
) -> BoolArray:
    """Return at which `boresight` (m, 3) the Earth is within `half_angle` + `buffer` rad (2.18, 2.19)."""
    return _within(boresight, -np.asarray(position), EARTH_RADIUS, half_angle + buffer)


def hidden_by_earth(position: FloatArray, target: FloatArray) -> BoolArray:
    """Return for which pairs the Earth stands between `position` and `target`, (m, 3) each."""
    way = target - position
    length = np.sum(way * way, axis=-1)
    nearest = np.clip(-np.sum(position * way, axis=-1) / np.where(length > 0.0, length, 1.0), 0.0, 1.0)
    closest = np.linalg.norm(position + nearest[..., None] * way, axis=-1)
    return np.asarray(closest < EARTH_RADIUS)


def in_field(
    camera: Pinhole, attitudes: FloatArray, directions: FloatArray, margin: float = 0.0
) -> BoolArray:
    """Return which `directions` (m, 3) ICRS are within `margin` px of the detector at camera `attitudes`."""
    seen = (quaternion.attitude_matrix(attitudes) @ directions[..., None])[..., 0]
    return camera.contains(camera.project(seen), margin)


def _within(boresight: FloatArray, to_body: FloatArray, radius: float, half_angle: float) -> BoolArray:
    distance = np.linalg.norm(to_body, axis=-1)
    cosine = np.sum(boresight * to_body, axis=-1) / distance
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))
    return np.asarray(angle < np.arcsin(np.minimum(1.0, radius / distance)) + half_angle)
