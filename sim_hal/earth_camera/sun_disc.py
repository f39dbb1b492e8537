"""The Sun: its disc, darker at the rim, cut by the Earth, dimmed by air; and its glare in the optics."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter

from knightcube.astro.arrays import FloatArray
from knightcube.astro.directions import tangent_basis
from knightcube.astro.earth.sun import SUN_RADIUS
from knightcube.vision.camera.lens import CameraModel
from sim_hal.earth_camera.model import EarthCameraModel, pixel_rays
from sim_hal.earth_camera.radiance import look
from sim_hal.earth_camera.scene import EarthScene

Float32Array = npt.NDArray[np.float32]

RIM_DARKENING = 0.6
"""Linear coefficient of limb darkening near 550 nm (Cox 2000, Allen's Astrophysical Quantities)."""
_SUBPIXELS = 6
_RINGS, _SPOKES = 24, 48


def towards_sun(scene: EarthScene) -> tuple[FloatArray, float]:
    """Return the unit vector (3,) in camera axes from the camera to the Sun, and its disc's radius in rad."""
    offset = scene.sun - scene.position
    distance = float(np.linalg.norm(offset))
    return scene.camera_matrix @ offset / distance, math.asin(SUN_RADIUS / distance)


def visible_share(scene: EarthScene) -> float:
    """Return the share of the Sun's light that Earth and air let through to the camera, 0 .. 1."""
    axis, radius = towards_sun(scene)
    share = np.sqrt((np.arange(_RINGS) + 0.5) / _RINGS)
    angle = np.arange(_SPOKES) * (2.0 * np.pi / _SPOKES)
    spokes = np.stack([np.cos(angle), np.sin(angle)], axis=1) @ tangent_basis(axis)
    rays = axis + math.tan(radius) * (share[:, None, None] * spokes).reshape(-1, 3)
    weights = np.repeat(_darkening(share**2), _SPOKES)
    return float(_transmission(scene, rays) @ weights / weights.sum())


def add_disc(scene: EarthScene, model: EarthCameraModel, image: Float32Array) -> None:
    """Add the disc's radiance, blurred, to `image` (rows, columns)."""
    axis, radius = towards_sun(scene)
    window = _window(model.lens, axis, radius, math.ceil(4.0 * model.blur) + 1)
    if window is None:
        return
    left, top, width, height = window
    grid = (np.arange(max(width, height) * _SUBPIXELS) + 0.5) / _SUBPIXELS - 0.5
    x, y = np.meshgrid(left + grid[: width * _SUBPIXELS], top + grid[: height * _SUBPIXELS])
    rays = model.lens.unit_vectors(np.stack([x.ravel(), y.ravel()], axis=1))
    # Squares of chords: the angle's cosine is flat where the disc is.
    share = np.sum((rays - axis) ** 2, axis=1) / (2.0 * math.sin(0.5 * radius)) ** 2
    fine = np.zeros(len(rays))
    # Outside the lens's field the ray is NaN, and every comparison is false.
    inside = np.flatnonzero(share < 1.0)
    fine[inside] = _darkening(share[inside]) * _transmission(scene, rays[inside])
    fine *= (1.0 - model.scatter) / math.sin(radius) ** 2
    blurred = gaussian_filter(fine.reshape(x.shape), model.blur * _SUBPIXELS, mode="constant", truncate=4.0)
    patch = blurred.reshape(height, _SUBPIXELS, width, _SUBPIXELS).mean(axis=(1, 3))
    rows = slice(max(top, 0), min(top + height, model.rows))
    columns = slice(max(left, 0), min(left + width, model.columns))
    if rows.start < rows.stop and columns.start < columns.stop:
        image[rows, columns] += patch[
            rows.start - top : rows.stop - top, columns.start - left : columns.stop - left
        ]


def add_glare(scene: EarthScene, model: EarthCameraModel, image: Float32Array) -> None:
    """Add the sunlight that the optics scatter to `image` (rows, columns), the Sun in the field or beside it.

    The scattered radiance falls from its centre as 1/(1 + (s/s0)^2), s the chord: the shape of Harvey and
    Shack for polished optics, with a slope of two; over the hemisphere it holds the share `scatter`. The lens
    has no hood: sunlight reaches it from all of the half space before it, by the cosine of its incidence.
    """
    axis, _ = towards_sun(scene)
    if axis[2] <= 0.0 or model.scatter == 0.0:
        return
    light = visible_share(scene) * float(axis[2]) * scatter_centre(model)
    squares = 2.0 - 2.0 * (pixel_rays(model.lens) @ axis).reshape(image.shape)
    image += (light / (1.0 + squares / model.scatter_angle**2)).astype(np.float32)


def scatter_centre(model: EarthCameraModel) -> float:
    """Return the radiance at the centre of scattered sunlight, when it holds the share `scatter` of it all.

    The integral of 1/(1 + (s/s0)^2) over the hemisphere is pi s0^2 ln(1 + 2/s0^2), and the irradiance of the
    Sun is pi in these units.
    """
    square = model.scatter_angle**2
    return model.scatter / (square * math.log(1.0 + 2.0 / square))


def _darkening(share: FloatArray) -> FloatArray:
    """Return the disc's brightness at squares of radius (...), 0 .. 1, its mean over the disc being one."""
    rim = 1.0 - RIM_DARKENING * (1.0 - np.sqrt(np.maximum(1.0 - share, 0.0)))
    return np.asarray(rim / (1.0 - RIM_DARKENING / 3.0))


def _transmission(scene: EarthScene, rays: FloatArray) -> FloatArray:
    sight = look(scene, rays)
    through = np.exp(-scene.atmosphere.tangent_depth(sight.heights))
    return np.where(sight.hits, 0.0, through)


def _window(
    lens: CameraModel, axis: FloatArray, radius: float, margin: int
) -> tuple[int, int, int, int] | None:
    """Return left, top, width and height of the pixels that the disc and its blur may touch, or None."""
    angle = np.arange(16) * (np.pi / 8.0)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1) @ tangent_basis(axis)
    # A sixteen-sided figure holds the disc when it is wider by 1/cos(pi/16).
    rim = lens.project(axis + math.tan(radius) / math.cos(np.pi / 16.0) * ring)
    rim = rim[~np.isnan(rim[:, 0])]
    if not len(rim):
        return None
    # Cut to the detector before the cast: at 90 deg from the axis a rim lies beyond any integer.
    outer = np.array([lens.columns, lens.rows]) - 1 + margin
    low = np.maximum(np.floor(rim.min(axis=0)) - margin, -margin)
    high = np.minimum(np.ceil(rim.max(axis=0)) + margin, outer)
    if np.any(low > high):
        return None
    (left, top), (width, height) = low.astype(int).tolist(), (high - low).astype(int).tolist()
    return left, top, width + 1, height + 1
