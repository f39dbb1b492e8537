"""Directions: unit vectors, and the plane across one."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from knightcube.astro.arrays import FloatArray


def tangent_basis(direction: Iterable[float]) -> FloatArray:
    """Return two unit vectors (2, 3) at right angles to a unit vector (3,) and to each other.

    With the direction itself last they are a right-handed frame.
    """
    # Plain floats: numpy takes ten times as long for one vector.
    x, y, z = map(float, direction)
    # Across the coordinate axis farthest from it.
    least = min((abs(x), 0), (abs(y), 1), (abs(z), 2))[1]
    first = ((0.0, z, -y), (-z, 0.0, x), (y, -x, 0.0))[least]
    length = math.hypot(*first)
    a, b, c = first[0] / length, first[1] / length, first[2] / length
    return np.array(((a, b, c), (y * c - z * b, z * a - x * c, x * b - y * a)))


def cross_product(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return a x b of vectors (3,), ten times as fast as numpy does."""
    ax, ay, az = a.tolist()
    bx, by, bz = b.tolist()
    return np.array((ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx))


def cross_matrices(vectors: FloatArray) -> FloatArray:
    """Return [v x] (n, 3, 3) of vectors (n, 3)."""
    matrices = np.zeros((len(vectors), 3, 3))
    x, y, z = vectors.T
    matrices[:, 0, 1], matrices[:, 0, 2], matrices[:, 1, 2] = -z, y, -x
    matrices[:, 1, 0], matrices[:, 2, 0], matrices[:, 2, 1] = z, -y, x
    return matrices
