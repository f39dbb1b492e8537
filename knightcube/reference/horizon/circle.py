"""The circular horizon in a picture: centre and radius by the pseudo-inverse (Meller et al. 3.2.1).

It assumes a homogeneous picture: no distortion, and a horizon that is a circle on a flat detector, which
holds near the optical axis only. `knightcube.vision.horizon.limb_fit` is the default.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.errors import FlightError


class NoCircleError(FlightError):
    """The points lie on no circle: fewer than three, or in one line."""


@dataclass(frozen=True, slots=True, eq=False)
class Circle:
    """A circle: centre (2,) and radius, in the points' unit."""

    centre: FloatArray
    radius: float

    def distances(self, points: FloatArray) -> FloatArray:
        """Return how far points (n, 2) lie outside the circle, (n,); negative within."""
        return np.asarray(np.linalg.norm(points - self.centre, axis=-1) - self.radius)


def fit_circle(points: FloatArray) -> Circle:
    """Return the circle through points (n, 2), n >= 3, by equations (3) to (5) and (2).

    Each row pairs a point with the next, the last with the first. For three points it is exact; for more the
    radius is the root mean square of (2). Raises NoCircleError.
    """
    points = np.asarray(points, dtype=float)
    if len(points) < 3:
        raise NoCircleError(f"{len(points)} points: a circle needs three")
    following = np.roll(points, -1, axis=0)
    squares = np.sum(points**2, axis=1)
    differences = points - following
    sizes = np.linalg.svd(differences, compute_uv=False)
    if sizes[1] <= 1e-9 * sizes[0]:
        raise NoCircleError("the points lie in one line: no circle passes through them")
    centre = np.linalg.pinv(differences) @ (0.5 * (squares - np.roll(squares, -1)))
    return Circle(centre, float(np.sqrt(np.mean(np.sum((points - centre) ** 2, axis=1)))))
