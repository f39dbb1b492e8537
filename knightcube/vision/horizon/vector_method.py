"""Nadir propagated by the Vector Method: two successive sights of one place (Meller 3.2.2, equation 6).

A place on the horizon stood at Q, on the optical axis, and stands at P a moment later: the rotation that
takes Q to P takes the old nadir to the new one. Two vectors leave the turn about themselves open; the
shortest rotation is taken; a turn of the body about P is not observed.
"""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.directions import tangent_basis


def carried_nadir(previous: FloatArray, before: FloatArray, after: FloatArray) -> FloatArray:
    """Return N = [R] N_o (3,), R the shortest rotation of the sight `before` (3,) to `after` (3,), unit."""
    return np.asarray(shortest_turn(before, after) @ previous)


def shortest_turn(source: FloatArray, target: FloatArray) -> FloatArray:
    """Return the matrix (3, 3) that takes a unit vector to another; opposite ones, by any half turn."""
    middle = source + target
    square = float(middle @ middle)
    if square < 1e-12:
        return _half_turn(tangent_basis(source)[0], 1.0)
    # A half turn about the source leaves it, a half turn about the middle takes it to the target.
    return np.asarray(_half_turn(middle, square) @ _half_turn(source, 1.0))


def _half_turn(axis: FloatArray, square: float) -> FloatArray:
    return np.asarray(2.0 / square * np.outer(axis, axis) - np.eye(3))
