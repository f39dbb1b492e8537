"""The Earth as an ellipsoid and the directions of its limb.

Stretched along its axes an ellipsoid becomes the unit sphere, whose limb is a circular cone about the way to
its centre; the stretching takes rays to rays, so that a ray is on the limb exactly when its stretched self is
on that cone (Christian & Robinson 2016, "Noniterative Horizon-Based Optical Navigation by Cholesky
Factorization", J. Guid. Control Dyn. 39, 2757). In the camera's axes the limb is a quadratic cone.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.figure import SEMI_MAJOR_AXIS, SEMI_MINOR_AXIS

MEAN_RADIUS = (2.0 * SEMI_MAJOR_AXIS + SEMI_MINOR_AXIS) / 3.0
"""m, 6,371,008.8 (WGS 84)."""


_IDENTITY: FloatArray = np.eye(3)


@dataclass(frozen=True, slots=True, eq=False)
class Ellipsoid:
    """A spheroid about the origin.

    Attributes:
        pole: (3,) unit vector along the axis.
        equatorial, polar: its semi-axes in m.
    """

    pole: FloatArray
    equatorial: float
    polar: float
    _along: FloatArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_along", np.outer(self.pole, self.pole))

    def stretching(self, height: float = 0.0) -> FloatArray:
        """Return L (3, 3), symmetric, with |L x| = 1 on the surface with both axes longer by `height` m."""
        return self._along_axes(1.0 / (self.equatorial + height), 1.0 / (self.polar + height))

    def shape(self, height: float = 0.0) -> FloatArray:
        """Return the inverse (3, 3) of `stretching`: it takes the unit sphere to the surface."""
        return self._along_axes(self.equatorial + height, self.polar + height)

    def stretching_by_height(self, height: float = 0.0) -> FloatArray:
        """Return dL/dh (3, 3) of `stretching`."""
        return self._along_axes(-1.0 / (self.equatorial + height) ** 2, -1.0 / (self.polar + height) ** 2)

    def height_of(self, position: FloatArray) -> float:
        """Return the height above the surface, m, of a position (3,), along its own radius."""
        distance = float(np.linalg.norm(position))
        return distance - distance / float(np.linalg.norm(self.stretching() @ position))

    def tangent_cone(self, position: FloatArray, height: float = 0.0) -> FloatArray:
        """Return M (3, 3), symmetric: u^T M u is 0 for rays u from `position` along the limb, > 0 within.

        M = Q r r^T Q - (r^T Q r - 1) Q with Q = L^T L, the discriminant of |L (r + t u)| = 1 in t; L is that
        of the surface `height` m higher.
        """
        stretching = self.stretching(height)
        shape = stretching.T @ stretching
        normal = shape @ position
        return np.asarray(np.outer(normal, normal) - (position @ normal - 1.0) * shape)

    def _along_axes(self, across: float, along: float) -> FloatArray:
        return across * _IDENTITY + (along - across) * self._along


def earth(pole: FloatArray) -> Ellipsoid:
    """Return the WGS 84 ellipsoid with its axis along `pole` (3,)."""
    return Ellipsoid(np.asarray(pole) / np.linalg.norm(pole), SEMI_MAJOR_AXIS, SEMI_MINOR_AXIS)


def mean_sphere() -> Ellipsoid:
    """Return the sphere of the Earth's mean radius."""
    return Ellipsoid(np.array([0.0, 0.0, 1.0]), MEAN_RADIUS, MEAN_RADIUS)
