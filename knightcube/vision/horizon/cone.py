"""Circular cones through a few limb rays: the horizon of a sphere, in closed form.

All rays u of a sphere's limb make one angle rho with nadir n: u.g = 1 with g = n / cos rho, linear in g
(Christian & Robinson 2016, for a sphere). With rho known two rays leave two directions for n; unknown, three
rays leave one. Vectorised over pairs or triples, for the search among points of which some are limb.
"""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.vision.horizon.limb_equation import crossed

_PARALLEL = 1e-12


def nadirs_of_pairs(first: FloatArray, second: FloatArray, cosine: float) -> FloatArray:
    """Return both directions (2, n, 3) that make the angle of `cosine` with two rays (n, 3) each.

    NaN where the rays are too far apart for it, or one and the same.
    """
    dot = np.einsum("ij,ij->i", first, second)
    normal = crossed(first, second)
    square = np.einsum("ij,ij->i", normal, normal)
    share = cosine / (1.0 + np.maximum(dot, -1.0 + _PARALLEL))
    inside = 1.0 - 2.0 * cosine * share
    sound = (inside >= 0.0) & (square > _PARALLEL)
    height = np.where(sound, np.sqrt(np.abs(inside) / np.where(sound, square, 1.0)), np.nan)
    middle = share[:, None] * (first + second)
    aside = height[:, None] * normal
    return np.stack([middle + aside, middle - aside])


def nadirs_of_triples(
    first: FloatArray, second: FloatArray, third: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the directions (n, 3) and cosines (n,) of the cones through three rays (n, 3) each.

    NaN where three rays lie in one plane with the camera.
    """
    normal = crossed(second - first, third - first)
    size = np.linalg.norm(normal, axis=1)
    directions = normal / np.where(size > _PARALLEL, size, np.nan)[:, None]
    cosines = np.einsum("ij,ij->i", directions, first)
    # Of a direction and its opposite the nadir is within 90 deg of its limb.
    sign = np.where(cosines < 0.0, -1.0, 1.0)
    return directions * sign[:, None], cosines * sign
