"""Triangles of the brighter guide stars by area and polar moment, and the errors of both.

Plane triangles (Michalski 35-48; Cole & Crassidis, Fast star-pattern recognition using planar triangles,
J. Guidance 29, 2006) are those of the chords. Equation 47a is corrected to a, b and c; the covariance of a
direction is sigma^2 (1 - b b^T) (25).

Spherical triangles (Michalski 32-34; Cole & Crassidis, Fast star pattern recognition using spherical
triangles, AIAA 2004): the source sums the polar moment over ever smaller triangles. Here Gaussian quadrature
integrates theta^2 over the plane triangle of the chords, each element of which covers det(v1, v2, v3)/|p|^3
of the sphere. theta is the angle from the mean direction of the corners.

The table holds every triangle whose sides fit into one frame, sorted by area with a k-vector. Corners stand
opposite the shortest, the middle and the longest side, so that a match of shape also matches the corners.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.reference.star_identification.pair_table import KVector, PairTable, build_k_vector, members


@dataclass(frozen=True, slots=True, eq=False)
class TriangleShape:
    """Properties of t triangles.

    Attributes:
        area: (t,) sr.
        moment: (t,) polar moment about the centroid, rad^4.
        sigma_area, sigma_moment: (t,) their standard deviations.
    """

    area: FloatArray
    moment: FloatArray
    sigma_area: FloatArray
    sigma_moment: FloatArray


def planar_shape(corners: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return area (t,) and polar moment (t,) about the centroid of triangles (t, 3, 3) (35-37)."""
    a, b, c = _sides(corners)
    s = 0.5 * (a + b + c)
    area = np.sqrt(np.maximum(s * (s - a) * (s - b) * (s - c), 0.0))
    return area, area * (a**2 + b**2 + c**2) / 36.0


def measured_planar_shape(corners: FloatArray, sigma: FloatArray) -> TriangleShape:
    """Return the shape of triangles (t, 3, 3) whose corners have errors `sigma` (t, 3) rad (38-48).

    A triangle without area has infinite variances: its area has no derivative.
    """
    a, b, c = _sides(corners)
    area, moment = planar_shape(corners)
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


def spherical_shape(corners: FloatArray) -> tuple[FloatArray, FloatArray]:
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


def measured_spherical_shape(corners: FloatArray, sigma: FloatArray) -> TriangleShape:
    """Return the shape of triangles (t, 3, 3) with corners in error by `sigma` (t, 3) rad, by differences."""
    area, moment = spherical_shape(corners)
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
                ends.append(spherical_shape(moved))
            slopes = [(ahead - behind) / (2.0 * _STEP) for ahead, behind in zip(*ends, strict=True)]
            variance_area += (sigma[:, corner] * slopes[0]) ** 2
            variance_moment += (sigma[:, corner] * slopes[1]) ** 2
    return TriangleShape(area, moment, np.sqrt(variance_area), np.sqrt(variance_moment))


def _across(direction: FloatArray) -> FloatArray:
    """Return a unit vector (t, 3) normal to each direction (t, 3)."""
    axis = np.eye(3)[np.argmin(np.abs(direction), axis=-1)]
    normal = np.cross(direction, axis)
    return np.asarray(normal / np.linalg.norm(normal, axis=-1, keepdims=True))


Shape = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
"""Returns the areas and the polar moments of triangles."""
MeasuredShape = Callable[[FloatArray, FloatArray], TriangleShape]
"""Returns the shapes of triangles with their standard deviations, from corners and their errors (rad)."""


@dataclass(frozen=True, slots=True, eq=False)
class TriangleTable:
    """Triangles in order of their area.

    Attributes:
        corner: (t, 3) uint16 or uint32 numbers of guide stars.
        area: with its k-vector, float32.
        moment: (t,) float32 polar moment.
    """

    corner: npt.NDArray[np.unsignedinteger[npt.NBitBase]]
    area: KVector
    moment: npt.NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.corner)


def build_triangles(
    direction: FloatArray, pairs: PairTable, chosen: BoolArray, widest: float, shape: Shape
) -> TriangleTable:
    """Return the triangles of the `chosen` guide stars (n,), none of whose sides exceeds `widest` rad.

    `direction` (n, 3) are the guide stars that `pairs` numbers.
    """
    corners = ordered(direction, _triangles(pairs, chosen, widest))
    area, moment = shape(direction[corners])
    order = np.argsort(area, kind="stable")
    number = np.uint16 if len(chosen) <= 1 << 16 else np.uint32
    key = build_k_vector(area[order].astype(np.float32))
    return TriangleTable(corners[order].astype(number), key, moment[order].astype(np.float32))


def locally_bright(pairs: PairTable, radius: float, rank: int) -> BoolArray:
    """Return which guide stars (n,) have fewer than `rank` brighter ones within `radius` rad.

    So a sparse part of the sky has as many as a dense one.
    """
    start, stop = pairs.angle.ranges(0.0, radius)
    # The second of a pair has the larger number, and so is the fainter.
    brighter = np.bincount(pairs.second[start[0] : stop[0]], minlength=pairs.stars)
    return np.asarray(brighter < rank)


def ordered(direction: FloatArray, triangles: IntArray) -> IntArray:
    """Return triangles (t, 3) with their corners opposite the shortest, the middle and the longest side."""
    sides = side_lengths(direction[triangles])
    return np.take_along_axis(triangles, np.argsort(sides, axis=-1, kind="stable"), axis=-1)


def side_lengths(corners: FloatArray) -> FloatArray:
    """Return the chords (..., 3) opposite each corner of triangles (..., 3, 3)."""
    return np.asarray(np.linalg.norm(np.roll(corners, -1, axis=-2) - np.roll(corners, 1, axis=-2), axis=-1))


def _triangles(pairs: PairTable, chosen: BoolArray, widest: float) -> IntArray:
    """Return all triangles (t, 3), numbers ascending, whose three sides are pairs."""
    start, stop = pairs.angle.ranges(0.0, widest)
    first = pairs.first[start[0] : stop[0]].astype(np.int64)
    second = pairs.second[start[0] : stop[0]].astype(np.int64)
    stars = len(chosen)
    bright = chosen[first] & chosen[second]
    code = np.sort(first[bright] * stars + second[bright])
    first, second = code // stars, code % stars
    end = np.searchsorted(first, first, side="right")
    place, owner = members(np.arange(len(first)) + 1, end)
    closing = second[owner] * stars + second[place]
    found = np.minimum(np.searchsorted(code, closing), len(code) - 1)
    closed = code[found] == closing if len(code) else np.zeros(0, dtype=bool)
    triangles = np.stack([first[owner], second[owner], second[place]], axis=-1)
    return np.asarray(triangles[closed])
