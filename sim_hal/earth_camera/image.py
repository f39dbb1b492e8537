"""Frames of Earth and Sun."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.ndimage import binary_dilation

from knightcube.astro.arrays import FloatArray, Image
from sim_hal.earth_camera.detector import counts
from sim_hal.earth_camera.model import EarthCameraModel, pixel_rays
from sim_hal.earth_camera.optics import blurred
from sim_hal.earth_camera.radiance import look, radiance
from sim_hal.earth_camera.scene import EarthScene
from sim_hal.earth_camera.sun_disc import add_disc, add_glare

Float32Array = npt.NDArray[np.float32]

_FINE = np.sqrt(1.0 / 12.0) * np.array([[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]])
"""px from a pixel's centre, (4, 2): Gauss and Legendre's two points, exact for cubics along each axis."""


def render(model: EarthCameraModel, scene: EarthScene, generator: np.random.Generator) -> Image:
    """Return the frame (rows, columns) that the camera gives: uint8 to 8 bits, uint16 above.

    All noise that changes from frame to frame is drawn from `generator`.
    """
    return counts(model, _light(model, scene), generator)


def expected_radiance(model: EarthCameraModel, scene: EarthScene) -> FloatArray:
    """Return the radiance (rows, columns) on the detector, blur and glare included, without noise."""
    return _light(model, scene).astype(np.float64)


def _light(model: EarthCameraModel, scene: EarthScene) -> Float32Array:
    image = blurred(model, _earth(model, scene))
    add_disc(scene, model, image)
    add_glare(scene, model, image)
    return image


def _earth(model: EarthCameraModel, scene: EarthScene) -> Float32Array:
    """Return the Earth's radiance (rows, columns), averaged over the pixels where the limb crosses them."""
    rays = pixel_rays(model.lens)
    sight = look(scene, rays)
    light = radiance(scene, rays, sight)
    limb = (~sight.hits & (light > 0.0)).reshape(model.rows, model.columns)
    # Of the ground's pixels those count, too, that reach over the limb.
    at_limb = np.flatnonzero(binary_dilation(limb, np.ones((3, 3), dtype=bool)))
    if len(at_limb):
        pixels = np.stack([at_limb % model.columns, at_limb // model.columns], axis=1)
        fine = model.lens.unit_vectors((pixels[:, None, :] + _FINE).reshape(-1, 2))
        light[at_limb] = radiance(scene, fine, look(scene, fine)).reshape(-1, len(_FINE)).mean(axis=1)
    return light.reshape(model.rows, model.columns)
