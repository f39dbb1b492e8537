"""Area and polar moment of spherical triangles (Michalski 32-34), with their variances.

Cole & Crassidis, Fast star pattern recognition using spherical triangles, AIAA 2004. They sum the moment
over ever smaller triangles; here the integral of theta^2 is taken over the plane triangle of the chords, each
of whose elements covers det(v1, v2, v3)/|p|^3 of the sphere, by Gauss's rule. theta is the angle from the
direction of the corners' mean.
"""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.reference.star_identification.triangle_shape import TriangleShape

_STEP = 1e-5
_ORDER = 6


def _quadrature() -> tuple[FloatArray, FloatArray]:
    """Return barycentric points (36, 3) and weights (36,), which sum to one: Gauss's, collapsed."""
    nodes, weights = np.polynomial.legendre.leggauss(_ORDER)
    nodes, weights = 0.5 * (nodes + 1.0), 0.5 * weights
    u, v = (grid.ravel() for grid in np.meshgrid(nodes, nodes))
    points = np.stack([1.0 - u, u * (1.0 - v), u * v], axis=-1)
    return points, 2.0 * u * np.outer(weights, weights).ravel()


_POINTS, _WEIGHTS = _quadrature()


def shape(corners: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return area (...,) and polar moment (...,) of triangles (..., 3, 3) of unit vectors (32-34)."""
    p, q, r = np.moveaxis(corners, -2, 0)
    # 32 rounds small differences of the sides away; the solid angle by Van Oosterom & Strackee does not.
    volume = np.abs(np.sum(p * np.cross(q, r), axis=-1))
    sides = 1.0 + np.sum(p * q, axis=-1) + np.sum(q * r, axis=-1) + np.sum(r * p, axis=-1)
    area = 2.0 * np.arctan2(volume, sides)
    middle = p + q + r
    middle = middle / np.linalg.norm(middle, axis=-1, keepdims=True)
    inside = _POINTS @ corners
    length = np.linalg.norm(inside, axis=-1)
    chord = np.linalg.norm(inside / length[..., None] - middle[..., None, :], axis=-1)
    theta = 2.0 * np.arcsin(np.minimum(0.5 * chord, 1.0))
    # Barycentric coordinates cover half a unit square.
    moment = 0.5 * volume * np.sum(_WEIGHTS * theta**2 / length**3, axis=-1)
    return area, moment


def measured_shape(corners: FloatArray, sigma: FloatArray) -> TriangleShape:
    """Return the shape of triangles (t, 3, 3) with corners in error by `sigma` (t, 3) rad, by differences."""
    area, moment = shape(corners)
    variance_area, variance_moment = np.zeros_like(area), np.zeros_like(moment)
    for corner in range(3):
        at = corners[:, corner]
        along = corners[:, (corner + 1) % 3] - at
        along = along - np.sum(along * at, axis=-1, keepdims=True) * at
        # Two coincident corners define no direction along their side: any serves.
        length = np.linalg.norm(along, axis=-1, keepdims=True)
        along = np.where(length > 0.0, along / np.where(length > 0.0, length, 1.0), _across(at))
        for turn in (along, np.cross(at, along)):
            ends = []
            for sign in (1.0, -1.0):
                moved = corners.copy()
                moved[:, corner] = np.cos(_STEP) * at + sign * np.sin(_STEP) * turn
                ends.append(shape(moved))
            slopes = [(ahead - behind) / (2.0 * _STEP) for ahead, behind in zip(*ends, strict=True)]
            variance_area += (sigma[:, corner] * slopes[0]) ** 2
            variance_moment += (sigma[:, corner] * slopes[1]) ** 2
    return TriangleShape(area, moment, np.sqrt(variance_area), np.sqrt(variance_moment))


def _across(direction: FloatArray) -> FloatArray:
    """Return a unit vector (t, 3) normal to each direction (t, 3)."""
    axis = np.eye(3)[np.argmin(np.abs(direction), axis=-1)]
    normal = np.cross(direction, axis)
    return np.asarray(normal / np.linalg.norm(normal, axis=-1, keepdims=True))
