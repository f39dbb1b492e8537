"""The angle of a ray from the limb, and its gradient by attitude, limb height and altitude.

Stretched until the Earth is the unit sphere (`knightcube.vision.horizon.ellipsoid`), a ray of the camera
makes an angle with the way to the centre; less the half-angle of the limb's cone that is the residual: 0 on
the limb, positive outside. Its gradient is exact.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.vision.horizon.ellipsoid import Ellipsoid

PARAMETERS = 5
"""Small rotation of the camera (3, camera axes, rad), height of the limb (m), altitude (m)."""
LIMB_HEIGHT, ALTITUDE = 3, 4


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """The camera's position and attitude, and the limb's height.

    Attributes:
        rotation: (3, 3), inertial into camera axes.
        position: (3,) m, inertial axes.
        surface: the Earth's, without atmosphere.
        limb_height: m above the surface, where the limb appears.
    """

    rotation: FloatArray
    position: FloatArray
    surface: Ellipsoid
    limb_height: float

    @property
    def nadir(self) -> FloatArray:
        """The direction (3,) to the Earth's centre, camera axes."""
        return np.asarray(-(self.rotation @ self.position) / math.sqrt(self.position @ self.position))

    def moved(self, step: FloatArray) -> View:
        """Return the view after a step (5,) of the parameters."""
        distance = float(np.linalg.norm(self.position))
        return View(
            turn(step[:3]) @ self.rotation,
            self.position * (1.0 + step[ALTITUDE] / distance),
            self.surface,
            self.limb_height + float(step[LIMB_HEIGHT]),
        )

    def cone(self) -> FloatArray:
        """Return the limb's quadratic cone (3, 3) in camera axes, see `Ellipsoid.tangent_cone`."""
        cone = self.surface.tangent_cone(self.position, self.limb_height)
        return np.asarray(self.rotation @ cone @ self.rotation.T)


def turn(vector: FloatArray) -> FloatArray:
    """Return the matrix (3, 3) that turns vectors by |vector| rad about `vector` (3,) (Rodrigues)."""
    # Plain floats: for one vector numpy costs ten times as much.
    x, y, z = vector.tolist()
    angle = math.sqrt(x * x + y * y + z * z)
    first = math.sin(angle) / angle if angle > 0.0 else 1.0
    half = 0.5 * angle
    second = 0.5 * (math.sin(half) / half) ** 2 if angle > 0.0 else 0.5
    cosine = math.cos(angle)
    return np.array(
        [
            [cosine + second * x * x, second * x * y - first * z, second * x * z + first * y],
            [second * x * y + first * z, cosine + second * y * y, second * y * z - first * x],
            [second * x * z - first * y, second * y * z + first * x, cosine + second * z * z],
        ]
    )


def crossed(one: FloatArray, other: FloatArray) -> FloatArray:
    """Return the cross products (n, 3) of vectors (n, 3); five times as fast as numpy's general one."""
    x1, y1, z1 = one.T
    x2, y2, z2 = other.T
    product = np.empty((len(one), 3))
    product[:, 0] = y1 * z2 - z1 * y2
    product[:, 1] = z1 * x2 - x1 * z2
    product[:, 2] = x1 * y2 - y1 * x2
    return product


def limb_residuals(view: View, rays: FloatArray) -> FloatArray:
    """Return the angles (n,) rad by which rays (n, 3), unit, camera axes, lie outside the limb."""
    stretching = view.surface.stretching(view.limb_height)
    centre = -(stretching @ view.position)
    size = math.sqrt(centre @ centre)
    stretched = rays @ (view.rotation @ stretching)
    cosine = stretched @ (centre / size)
    cosine /= np.sqrt(np.einsum("ij,ij->i", stretched, stretched))
    angles = np.arccos(np.minimum(np.maximum(cosine, -1.0), 1.0))
    return np.asarray(angles - math.asin(min(1.0, 1.0 / size)))


def limb_gradients(view: View, rays: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the residuals (n,) and their gradients (n, 5) with respect to the parameters of `moved`."""
    stretching = view.surface.stretching(view.limb_height)
    by_height = view.surface.stretching_by_height(view.limb_height)
    centre = -(stretching @ view.position)
    size = math.sqrt(centre @ centre)
    towards = centre / size
    to_stretched = view.rotation @ stretching
    stretched = rays @ to_stretched
    lengths = np.sqrt(np.einsum("ij,ij->i", stretched, stretched))
    cosine = stretched @ towards / lengths
    sine = np.sqrt(1.0 - cosine * cosine)
    # The residual's change by a stretched ray; then back through the stretching into camera axes.
    slope = (stretched * (cosine / lengths)[:, None] - towards) / (lengths * sine)[:, None]
    back = to_stretched.T
    # Columns y, z, x and z, x, y at once: what a cross product takes.
    by_ray = slope @ np.concatenate(
        [back[:, _AFTER], back[:, _BEFORE], (view.rotation @ by_height).T], axis=1
    )
    gradients = np.empty((len(rays), PARAMETERS))
    # The camera turned by d sees with u what it saw with u - d x u.
    gradients[:, :3] = by_ray[:, :3] * rays[:, _BEFORE] - by_ray[:, 3:6] * rays[:, _AFTER]
    # The half-angle is arcsin(1/size): it grows by this for each m that the centre draws nearer.
    by_size = 1.0 / (size * math.sqrt(size * size - 1.0))
    step = -(by_height @ view.position)
    along = float(towards @ step)
    aside = stretched @ ((step - along * towards) / size)
    gradients[:, LIMB_HEIGHT] = (
        np.einsum("ij,ij->i", rays, by_ray[:, 6:]) - aside / (lengths * sine) + along * by_size
    )
    # Farther away along its own radius the centre stays in its direction.
    gradients[:, ALTITUDE] = by_size * size / math.sqrt(view.position @ view.position)
    return np.arccos(cosine) - math.asin(1.0 / size), gradients


_AFTER, _BEFORE = [1, 2, 0], [2, 0, 1]
