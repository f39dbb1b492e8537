"""What a line of sight meets: ground below air, air alone, or the dark; in units of a white surface's.

Lines are met with the WGS 84 ellipsoid exactly, in axes scaled so that it is the unit sphere. The ground is
matt (Lambert); direct sunlight reaches it through the air, and what both send passes the air again.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from knightcube.astro.arrays import BoolArray, FloatArray
from knightcube.astro.earth.figure import semi_axes
from knightcube.astro.earth.sun import ASTRONOMICAL_UNIT
from sim_hal.earth_camera.albedo import albedo
from sim_hal.earth_camera.scene import EarthScene

Float32Array = npt.NDArray[np.float32]

TOP = 120e3
"""m: height above which air is invisible (a millionth of the limb's brightness)."""
_DARKEST = -0.2
"""Cosine from the zenith of a Sun, 11.5 deg below the horizon, that lights only the air above `TOP`."""


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """Where lines of sight (n, 3) pass: their first meeting with the ellipsoid, or their nearest point to it.

    Attributes:
        hits: which (n,) meet the ground.
        heights: m (n,), of the nearest point above the ellipsoid; 0 for those that hit, infinite where
            the Earth lies behind.
        places: points (n, 3) in Earth-fixed axes scaled to the unit sphere.
    """

    hits: BoolArray
    heights: Float32Array
    places: FloatArray


def look(scene: EarthScene, rays: FloatArray) -> Sight:
    """Return where `rays` (n, 3), of any length, in camera axes, pass the Earth."""
    axes = semi_axes()
    origin = scene.in_earth(scene.position) / axes
    into_earth = (scene.camera_matrix @ scene.earth_matrix.T) / axes
    scaled = rays @ into_earth
    squares = np.einsum("ij,ij->i", scaled, scaled)
    along = scaled @ origin
    # The nearest point's distance from the centre, without the cancellation of b^2 - ac.
    step = -along / squares
    nearest = origin + step[:, None] * scaled
    distance = np.einsum("ij,ij->i", nearest, nearest)
    ahead = along < 0.0
    hits = ahead & (distance <= 1.0)
    back = np.sqrt(np.maximum(1.0 - distance, 0.0) / squares)
    places = nearest - np.where(hits, back, 0.0)[:, None] * scaled
    length = np.sqrt(distance)
    local = np.sqrt(nearest**2 @ axes**2) / length
    heights = np.where(ahead, np.maximum(length - 1.0, 0.0) * local, np.inf).astype(np.float32)
    return Sight(np.asarray(hits), heights, places)


def radiance(scene: EarthScene, rays: FloatArray, sight: Sight) -> Float32Array:
    """Return the radiance (n,) along unit `rays` (n, 3) in camera axes that pass the Earth as `sight` says.

    The Sun's disc is left out.
    """
    result = np.zeros(len(rays), dtype=np.float32)
    seen = np.flatnonzero(sight.heights < TOP)
    normals = _normals(sight.places[seen])
    to_earth = scene.earth_matrix @ scene.camera_matrix.T
    distance = float(np.linalg.norm(scene.sun))
    sun = scene.in_earth(scene.sun / distance)
    sunward = normals @ sun
    lit = np.flatnonzero(sunward > _DARKEST)
    seen, normals = seen[lit], normals[lit]
    solar = sunward[lit].astype(np.float32)
    directions = rays[seen]
    upward = np.maximum(-np.einsum("ij,ij->i", directions, normals @ to_earth), 0.0).astype(np.float32)
    # Cosine of the scattering angle: 1, forward, for a line of sight towards the Sun.
    turned = (directions @ (to_earth.T @ sun)).astype(np.float32)
    air, hits = scene.atmosphere, sight.hits[seen]
    bottom = np.exp(-sight.heights[seen] / air.scale_height)
    depth = np.where(hits, air.slant_depth(upward), air.limb_depth * bottom)
    towards = air.slant_depth(solar)
    light = air.phase(turned) * air.scattered(depth, bottom, towards)
    ground = np.flatnonzero(hits & (solar > 0.0))
    matt = albedo(_unit(sight.places[seen[ground]] * semi_axes()), scene.texture) * solar[ground]
    light[ground] += matt * np.exp(-depth[ground] - towards[ground])
    result[seen] = light * np.float32((ASTRONOMICAL_UNIT / distance) ** 2)
    return result


def _unit(vectors: FloatArray) -> FloatArray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def _normals(places: FloatArray) -> FloatArray:
    """Return the verticals (n, 3) at `places` (n, 3), scaled to the unit sphere, or above them."""
    return _unit(places / semi_axes())
