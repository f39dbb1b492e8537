"""Area and polar moment of plane triangles of unit vectors, with their variances (Michalski 35-48).

Cole & Crassidis, Fast star-pattern recognition using planar triangles, J. Guidance 29 (2006). The triangle is
that of the chords. 47a is corrected to a, b and c; the covariance of a direction is sigma^2 (1 - b b^T) (25).
"""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.reference.star_identification.triangle_shape import TriangleShape


def shape(corners: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return area (t,) and polar moment (t,) about the centroid of triangles (t, 3, 3) (35-37)."""
    a, b, c = _sides(corners)
    s = 0.5 * (a + b + c)
    area = np.sqrt(np.maximum(s * (s - a) * (s - b) * (s - c), 0.0))
    return area, area * (a**2 + b**2 + c**2) / 36.0


def measured_shape(corners: FloatArray, sigma: FloatArray) -> TriangleShape:
    """Return the shape of triangles (t, 3, 3) whose corners have errors `sigma` (t, 3) rad (38-48).

    A triangle without area has infinite variances: its area has no derivative.
    """
    a, b, c = _sides(corners)
    area, moment = shape(corners)
    s = 0.5 * (a + b + c)
    u1, u2 = (s - a) * (s - b) * (s - c), s * (s - b) * (s - c)
    u3, u4 = s * (s - a) * (s - c), s * (s - a) * (s - b)
    with np.errstate(divide="ignore", invalid="ignore"):
        by_side = np.stack([u1 - u2 + u3 + u4, u1 + u2 - u3 + u4, u1 + u2 + u3 - u4]) / (4.0 * area)
        side_by_corner = _side_gradients(corners, a, b, c)
        h = np.einsum("st,stcx->tcx", by_side, side_by_corner)
        moment_by_side = area * np.stack([a, b, c]) / 18.0
        squares = (a**2 + b**2 + c**2) / 36.0
        bar = np.einsum("st,stcx->tcx", moment_by_side, side_by_corner) + squares[:, None, None] * h
        sigma_area, sigma_moment = (np.sqrt(_variance(g, corners, sigma)) for g in (h, bar))
    flat = ~(np.isfinite(sigma_area) & np.isfinite(sigma_moment))
    sigma_area[flat] = sigma_moment[flat] = np.inf
    return TriangleShape(area, moment, sigma_area, sigma_moment)


def _sides(corners: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return a, b, c: between corners 1-2, 2-3 and 1-3 (35b-35d)."""
    p, q, r = np.moveaxis(corners, -2, 0)
    a, b, c = (np.linalg.norm(one - other, axis=-1) for one, other in ((p, q), (q, r), (p, r)))
    return a, b, c


def _side_gradients(corners: FloatArray, a: FloatArray, b: FloatArray, c: FloatArray) -> FloatArray:
    """Return the derivatives (3 sides, t, 3 corners, 3) of the sides by the corners (42)."""
    p, q, r = np.moveaxis(corners, -2, 0)
    ab, bc, ac = (p - q) / a[:, None], (q - r) / b[:, None], (p - r) / c[:, None]
    none = np.zeros_like(ab)
    return np.stack([np.stack(row, axis=1) for row in ((ab, -ab, none), (none, bc, -bc), (ac, none, -ac))])


def _variance(gradient: FloatArray, corners: FloatArray, sigma: FloatArray) -> FloatArray:
    """Return H R H^T (t,) (43, 44)."""
    radial = np.sum(gradient * corners, axis=-1)
    return np.asarray(np.sum(sigma**2 * (np.sum(gradient**2, axis=-1) - radial**2), axis=-1))
