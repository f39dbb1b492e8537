"""Orders cameras for reading: first those that should have the most of the sunlit limb in view."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.directions import tangent_basis
from knightcube.vision.camera.mounted import MountedCamera
from knightcube.vision.horizon.ellipsoid import MEAN_RADIUS
from knightcube.vision.horizon.limb_points import LOWEST_SUN
from knightcube.vision.horizon.limb_profile import UNIT_DEPTH_HEIGHT

_POINTS = 180


@dataclass(frozen=True, slots=True)
class LimbInView:
    """What a camera should see of the limb.

    Attributes:
        index: of the camera.
        limb: rad round the limb that are in its field.
        lit: rad of these that the Sun lights.
    """

    index: int
    limb: float
    lit: float


def cameras_by_limb(
    nadir: FloatArray, altitude: float, sun: FloatArray | None, cameras: Sequence[MountedCamera]
) -> list[LimbInView]:
    """Return the cameras in the order in which they are to be read for the horizon, the best first.

    `nadir` (3,) and `sun` (3,) are unit vectors in body axes, believed ones; without the Sun all the limb
    counts as lit. `altitude` m is above the mean Earth.
    """
    sine = (MEAN_RADIUS + UNIT_DEPTH_HEIGHT) / (MEAN_RADIUS + altitude)
    angle = np.arange(_POINTS) * (2.0 * np.pi / _POINTS)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1) @ tangent_basis(nadir)
    rays = math.sqrt(1.0 - sine**2) * nadir + sine * ring
    # Where a ray touches, the ground's normal is the ray's part across nadir, and a little of its opposite.
    normals = math.sqrt(1.0 - sine**2) * ring - sine * nadir
    lit = np.ones(_POINTS, dtype=bool) if sun is None else normals @ sun > math.sin(LOWEST_SUN)
    step = 2.0 * math.pi / _POINTS
    found = []
    for index, camera in enumerate(cameras):
        inside = camera.lens.contains(camera.lens.project(camera.seen(rays)))
        found.append(
            LimbInView(index, step * np.count_nonzero(inside), step * np.count_nonzero(inside & lit))
        )
    return sorted(found, key=lambda one: (-one.lit, -one.limb))
