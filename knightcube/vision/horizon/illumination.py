"""Predicts a picture's light from a view: sky, sunlit ground, night and the lit limb.

The paper leaves open how to distinguish a horizon from the terminator (Meller 3.3). A correct view predicts
the whole picture: nothing bright in the sky or on the night side, and an edge all along the lit limb. A view
fitted to the terminator does not.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.directions import tangent_basis
from knightcube.vision.horizon.limb_equation import View, limb_residuals
from knightcube.vision.horizon.observation import Samples

TWILIGHT = np.radians(12.0)
"""Sun this far below the horizon: ground and air count as night."""
DAYLIGHT = np.radians(8.0)
"""Sun this far above the horizon: ground and limb count as lit."""
GLARE = np.radians(12.0)
"""About the Sun, where stray light is as bright as the Earth."""
_ATMOSPHERE = 60e3
"""m: above it no air is as bright as the Earth."""


@dataclass(frozen=True, slots=True)
class Agreement:
    """How well a view explains the picture's light.

    Attributes:
        stray: the share of sky and night that is bright.
        missing: the share of sunlit ground that is dark.
        dark_samples, lit_samples: number of samples of each share.
    """

    stray: float
    missing: float
    dark_samples: int
    lit_samples: int


def sun_elevation(view: View, rays: FloatArray, sun: FloatArray) -> FloatArray:
    """Return the Sun's elevation (n,) rad where rays (n, 3) meet the surface, or pass it nearest.

    `sun` (3,) is a unit vector in inertial axes.
    """
    stretching = view.surface.stretching()
    origin = stretching @ view.position
    directions = rays @ (view.rotation @ stretching)
    squares = np.einsum("ij,ij->i", directions, directions)
    along = directions @ origin
    depth = np.maximum(along * along - squares * (origin @ origin - 1.0), 0.0)
    places = origin - ((along + np.sqrt(depth)) / squares)[:, None] * directions
    normals = places @ stretching
    sine = normals @ sun / np.sqrt(np.einsum("ij,ij->i", normals, normals))
    return np.asarray(np.arcsin(np.minimum(np.maximum(sine, -1.0), 1.0)))


def agreement(view: View, sun: FloatArray | None, samples: Samples) -> Agreement:
    """Return how a view agrees with samples; without a Sun only the sky counts."""
    rays, bright = samples.rays, samples.bright
    outside = limb_residuals(view, rays)
    distance = float(np.linalg.norm(view.position))
    reach = np.sqrt(max(distance**2 - view.surface.equatorial**2, 1.0))
    dark = outside > np.arctan(_ATMOSPHERE / reach)
    lit = np.zeros(len(rays), dtype=bool)
    if sun is not None:
        elevation = sun_elevation(view, rays, sun)
        away = rays @ (view.rotation @ sun) < np.cos(GLARE)
        dark = away & (dark | ((outside < 0.0) & (elevation < -TWILIGHT)))
        lit = (outside < -0.01) & (elevation > DAYLIGHT)
    darks, lits = int(np.count_nonzero(dark)), int(np.count_nonzero(lit))
    return Agreement(
        float(np.count_nonzero(bright & dark)) / max(darks, 1),
        float(np.count_nonzero(lit & ~bright)) / max(lits, 1),
        darks,
        lits,
    )


def limb_rays(view: View, count: int) -> FloatArray:
    """Return `count` rays (count, 3) in camera axes evenly round the limb."""
    stretching = view.surface.stretching(view.limb_height)
    centre = -(stretching @ view.position)
    size = float(np.linalg.norm(centre))
    axis = centre / size
    stretched = np.sqrt(1.0 - size**-2) * axis + _circle(count) @ (tangent_basis(axis) / size)
    # Back from the stretched space, where the Earth is the unit sphere, then into the camera.
    rays = stretched @ (view.rotation @ view.surface.shape(view.limb_height)).T
    return np.asarray(rays / np.sqrt(np.einsum("ij,ij->i", rays, rays))[:, None])


@lru_cache(maxsize=8)
def _circle(count: int) -> FloatArray:
    angle = np.arange(count) * (2.0 * np.pi / count)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)
