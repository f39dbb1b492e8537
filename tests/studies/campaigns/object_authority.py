"""Could a body with a stated authority have kept an object in its field? A linear programme of its own.

The boresight is a point on the sky whose deviation (2,) from the object obeys, in axes carried along the
object's path without turning, d'' = a - s'' - R d: a the body's part, s'' the object's own acceleration along
its path, R what neighbouring great circles approach each other by. The body is turned about any axis across
the field with up to the authority; what of that is about the boresight makes it roll, at a limited rate. It
begins at rest. A real body has less authority about some axes and disturbances besides.
"""

from __future__ import annotations

import itertools

import numpy as np
from scipy.optimize import linprog
from scipy.sparse import csr_array, lil_array

from knightcube.astro.arrays import FloatArray

_SIDES = 16
"""Of the polygons about the circles of deviation and authority; the authority's lies outside the circle."""


def least_deviation(
    seconds: float,
    directions: FloatArray,
    boresight: FloatArray,
    field: FloatArray,
    authority: float,
    roll: float,
) -> float:
    """Return the least that the largest deviation can be, rad, over instants each `seconds` s.

    `directions` (n, 3) of the object, `boresight` (3,) at the first instant, at rest there; `field` (n, 3);
    all in axes of the sky. `authority` rad/s^2; `roll` rad/s, the fastest about the boresight.
    """
    axes, count = _carried(directions), len(directions)
    speed = np.gradient(directions, seconds, axis=0)
    own = np.einsum("nij,nj->ni", axes, np.gradient(speed, seconds, axis=0))
    moved = np.einsum("nij,nj->ni", axes, speed)
    turned = _turned(directions, axes, field)
    first = axes[0] @ boresight
    first = first / np.linalg.norm(first) * np.arccos(np.clip(boresight @ directions[0], -1.0, 1.0))
    # Unknowns of each instant: deviation, its rate, roll rate, two turning accelerations; last, the largest.
    right = np.zeros(5 * count)
    rows = lil_array((5 * count, 7 * count + 1))
    rows[:5, :5] = np.eye(5)
    right[:4] = np.concatenate([first, -moved[0]])
    for n in range(count - 1):
        curve = moved[n] @ moved[n] * np.eye(2) - np.outer(moved[n], moved[n])
        step = np.zeros((5, 14))
        step[:, :5], step[:, 7:12] = -np.eye(5), np.eye(5)
        step[:2, 9:11] = -seconds * np.eye(2)
        step[2:4, :2] = seconds * curve
        step[2:5, 5:7] = -seconds * turned[n]
        rows[5 * (n + 1) : 5 * (n + 2), 7 * n : 7 * n + 14] = step
        right[5 * (n + 1) + 2 : 5 * (n + 1) + 4] = -seconds * own[n]
    bounds, most = _polygons(count, authority)
    cost = np.zeros(7 * count + 1)
    cost[-1] = 1.0
    within = np.full((7 * count + 1, 2), [-np.inf, np.inf])
    within[4:-1:7] = [-roll, roll]
    found = linprog(cost, bounds, most, csr_array(rows), right, bounds=within)
    assert found.status == 0, found.message
    return float(found.fun)


def _polygons(count: int, authority: float) -> tuple[csr_array, FloatArray]:
    """Return rows and right sides: every deviation within the largest, the accelerations within authority."""
    sides = np.arange(_SIDES) * 2.0 * np.pi / _SIDES
    corner = np.stack([np.cos(sides), np.sin(sides)], axis=1)
    bounds, most = lil_array((2 * _SIDES * count, 7 * count + 1)), np.zeros(2 * _SIDES * count)
    for n in range(count):
        top = 2 * _SIDES * n
        bounds[top : top + _SIDES, 7 * n : 7 * n + 2] = corner
        bounds[top : top + _SIDES, 7 * count] = -np.ones((_SIDES, 1))
        bounds[top + _SIDES : top + 2 * _SIDES, 7 * n + 5 : 7 * n + 7] = corner
        most[top + _SIDES : top + 2 * _SIDES] = authority
    return csr_array(bounds), most


def _carried(directions: FloatArray) -> FloatArray:
    """Return two axes (n, 2, 3) across each direction, each pair the last one's after the shortest turn."""
    first = np.cross(directions[0], np.eye(3)[int(np.argmin(np.abs(directions[0])))])
    first /= np.linalg.norm(first)
    axes = [np.array([first, np.cross(directions[0], first)])]
    for before, after in itertools.pairwise(directions):
        axes.append(axes[-1] - np.outer(axes[-1] @ after, before + after) / (1.0 + before @ after))
    return np.array(axes)


def _turned(directions: FloatArray, axes: FloatArray, field: FloatArray) -> FloatArray:
    """Return (n, 3, 2): acceleration of deviation and roll by each of two turns across the field."""
    found = np.zeros((len(directions), 3, 2))
    for n, (direction, both, strength) in enumerate(zip(directions, axes, field, strict=True)):
        along = strength / np.linalg.norm(strength)
        one = np.cross(along, np.eye(3)[int(np.argmin(np.abs(along)))])
        one /= np.linalg.norm(one)
        turns = np.array([one, np.cross(along, one)])
        found[n] = np.vstack([both @ np.cross(turns, direction).T, turns @ direction])
    return found
