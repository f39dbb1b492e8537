"""True nadir, Sun direction and limb of a simulated scene, and its noise-free pixel counts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray, tangent_basis
from knightcube.astro.earth.figure import semi_axes
from sim_hal.earth_camera import EarthCameraModel, EarthScene, towards_sun
from sim_hal.earth_light import Atmosphere

APPARENT_LIMB_HEIGHT = Atmosphere().apparent_limb_height
"""Height (m) above the ellipsoid at which a sunlit limb has half its brightness in the default atmosphere."""


@dataclass(frozen=True, slots=True, eq=False)
class LimbTruth:
    """Points of the limb on the detector, ordered around the Earth.

    Attributes:
        points: pixels (n, 2).
        directions: unit vectors (n, 3) in camera axes.
        solar_cosines: cosine (n,) of the Sun's zenith distance at the tangent point of each line of sight.
            The cosine is positive if the ground is sunlit. The atmosphere is sunlit some degrees beyond the
            sunlit ground.
    """

    points: FloatArray
    directions: FloatArray
    solar_cosines: FloatArray


def sun_direction(scene: EarthScene) -> FloatArray:
    """Return the unit vector (3,) from the camera to the Sun, camera axes, even if the Sun is hidden."""
    return towards_sun(scene)[0]


def sun_point(scene: EarthScene, model: EarthCameraModel) -> FloatArray:
    """Return the pixel (2,) of the Sun's centre, even off the detector; NaN outside the field of the lens."""
    return np.asarray(model.lens.project(sun_direction(scene)[None, :])[0])


def limb_directions(
    scene: EarthScene, count: int = 720, height: float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """Return unit vectors (count, 3) along the limb, camera axes, and their solar cosines (count,).

    The lines of sight touch the ellipsoid that is `height` m above the ellipsoid of WGS 84. If the axes are
    scaled so that this ellipsoid is the unit sphere, the tangent points q form a circle in the plane q . p =
    1, where p is the camera's position. Raises ValueError if the camera is inside the ellipsoid.
    """
    axes = semi_axes(height)
    origin = scene.in_earth(scene.position) / axes
    square = float(origin @ origin)
    if square <= 1.0:
        raise ValueError(f"limb at {height} m: the camera is not above that height")
    centre = origin / square
    angle = np.arange(count) * (2.0 * np.pi / count)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1) @ tangent_basis(origin / np.sqrt(square))
    touching = centre + np.sqrt(1.0 - 1.0 / square) * ring
    lines = (touching - origin) * axes @ scene.earth_matrix @ scene.camera_matrix.T
    normals = touching / axes
    sun = scene.in_earth(scene.sun / np.linalg.norm(scene.sun))
    cosines = normals @ sun / np.linalg.norm(normals, axis=1)
    return np.asarray(lines / np.linalg.norm(lines, axis=1, keepdims=True)), np.asarray(cosines)


def limb_truth(
    scene: EarthScene, model: EarthCameraModel, count: int = 3600, height: float | None = None
) -> LimbTruth:
    """Return the limb points that are on the detector, out of `count` points around the whole limb.

    `height` (m) above the ellipsoid is by default the atmosphere's apparent limb height.
    """
    if height is None:
        height = scene.atmosphere.apparent_limb_height
    directions, cosines = limb_directions(scene, count, height)
    points = model.lens.project(directions)
    seen = model.lens.contains(points)
    return LimbTruth(points[seen], directions[seen], cosines[seen])


def ideal_counts(model: EarthCameraModel, radiance: FloatArray) -> FloatArray:
    """Return the unrounded counts (...) that `radiance` (...) causes in a pixel without noise and defects."""
    light = np.asarray(radiance, dtype=float)
    if model.response == "logarithmic":
        counts = model.pedestal + model.counts_per_decade * np.log10(1.0 + light / model.darkest)
    else:
        counts = model.pedestal + np.minimum(light * model.sensitivity, model.full_well) / model.gain
    return np.asarray(np.clip(counts, 0.0, model.highest_count))


def radiance_of(model: EarthCameraModel, counts: FloatArray) -> FloatArray:
    """Return the radiance (...) that causes `counts` (...) in a pixel without noise and defects."""
    above = np.asarray(counts, dtype=float) - model.pedestal
    if model.response == "logarithmic":
        return np.asarray(model.darkest * (10.0 ** (above / model.counts_per_decade) - 1.0))
    return np.asarray(above * model.gain / model.sensitivity)
