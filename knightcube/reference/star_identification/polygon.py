"""Triangles of guide stars whose three angles are those of three observed stars, by the k-vector."""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.reference.star_identification.k_vector import members
from knightcube.reference.star_identification.known_sky import KnownSky
from knightcube.reference.star_identification.view import View


def matching_triangles(
    view: View, sky: KnownSky, corners: tuple[int, int, int], tolerance: float
) -> IntArray:
    """Return guide stars (k, 3) that may be the observed `corners`, angles and sense of turning alike.

    Pairs with the angle of the first side and of the second are joined where they share a star; the third
    angle is tested as its cosine.
    """
    pivot, second, third = corners
    one, other = np.array([pivot, pivot, second]), np.array([second, third, third])
    _, low, high = view.angles(one, other, tolerance)
    a, b, owner = sky.pairs.between(low[:2], high[:2])
    first = owner == 0
    a1, b1, a2, c2 = a[first], b[first], a[~first], b[~first]
    place, of = shared(a1, a2)
    triangles = np.stack([a1[of], b1[of], c2[place]], axis=-1)
    # A range that reaches zero or pi is clipped there: the cosine is not monotonic beyond.
    alike = within(sky, triangles[:, 1], triangles[:, 2], low[2], high[2])
    triangles = triangles[alike & (triangles[:, 1] != triangles[:, 2])]
    turns = _turning(sky.stars.direction[triangles]) == _turning(view.direction[[list(corners)]])
    return np.asarray(triangles[turns])


def shared(left: IntArray, right: IntArray) -> tuple[IntArray, IntArray]:
    """Return all places (k,) in `right` and (k,) in `left` that hold the same number."""
    order = np.argsort(right, kind="stable")
    ranked = right[order]
    place, of = members(np.searchsorted(ranked, left), np.searchsorted(ranked, left, side="right"))
    return order[place], of


def within(sky: KnownSky, one: IntArray, other: IntArray, low: FloatArray, high: FloatArray) -> BoolArray:
    """Return which pairs of guide stars (k,) have an angle within limits."""
    direction = sky.stars.direction
    cosine = np.einsum("kx,kx->k", direction[one], direction[other])
    least, most = np.cos(np.minimum(high, np.pi)), np.cos(np.maximum(low, 0.0))
    return np.asarray((cosine > least) & (cosine <= most))


def _turning(corners: FloatArray) -> BoolArray:
    """Return which triangles (k, 3, 3) turn left, seen from within the sphere."""
    a, b, c = np.moveaxis(corners, -2, 0)
    return np.asarray(np.einsum("kx,kx->k", a, np.cross(b, c)) > 0.0)
