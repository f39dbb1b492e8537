"""Trajkovic and Hedley's corner detector with four or eight neighbours (Sease 3.9-3.13 corrected).

At a corner no line through the pixel keeps its intensity: the cornerness is the least, over all directions,
of the squared changes towards both ends of a diameter. Between two neighbouring diameters the intensities are
interpolated linearly, so that the least is found in closed form: with r and r' the changes along them and t
    from
0 to 1, it is that of A t^2 + 2 B t + C, where C = r, A = r' - r - 2B. B pairs the two ends of one diameter
(3.12 corrected: the printed B1 mixes them). Image: (rows, columns); x runs along columns, y along rows.

Reference: Trajkovic, Hedley, Fast corner detection, Image and Vision Computing 16 (1998).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray

# One end (x, y) of each diameter, in the order in which they turn.
_DIAMETERS = {4: ((1, 0), (0, 1)), 8: ((1, 0), (1, 1), (0, 1), (-1, 1))}


class _Changes(NamedTuple):
    """Intensity at the two ends of one diameter less that of the centre, each (rows, columns)."""

    ahead: FloatArray
    behind: FloatArray

    @property
    def squared(self) -> FloatArray:
        """The response along the diameter: r_A or r_B of 3.10."""
        return np.asarray(self.ahead**2 + self.behind**2)


def simple_response(image: FloatArray, neighbours: int) -> FloatArray:
    """Return the least squared change over the `neighbours`/2 diameters, 4 or 8 neighbours (3.9, 3.10)."""
    return np.asarray(np.min([changes.squared for changes in _changes(image, neighbours)], axis=0))


def interpixel_response(image: FloatArray, neighbours: int) -> FloatArray:
    """Return the least squared change over all directions between the diameters too (3.11-3.13 corrected).

    The least over each pair of neighbouring diameters: with four neighbours the same as 3.11 with B the
    smaller of B1 and B2, since both share A and C up to the direction in which t runs.
    """
    ring = _changes(image, neighbours)
    # Past the last diameter comes the first again, its ends exchanged.
    following = [*ring[1:], _Changes(ring[0].behind, ring[0].ahead)]
    return np.asarray(np.min([_least_between(*pair) for pair in zip(ring, following, strict=True)], axis=0))


def trajkovic_response(
    image: FloatArray, neighbours: int, coarse_relative: float, fine_relative: float
) -> FloatArray:
    """Return the inter-pixel cornerness where both thresholds let it through, zero elsewhere.

    T1 applies to the simple cornerness of the image at half scale, T2 to that of the image itself (Sease,
    text at 3.10); both are given as parts of the largest value in `image`, so that brightness does not
    matter.
    """
    simple = simple_response(image, neighbours)
    likely = _coarse_corners(image, neighbours, coarse_relative)
    likely &= simple >= fine_relative * simple.max(initial=0.0)
    return np.where(likely, interpixel_response(image, neighbours), 0.0)


def _least_between(first: _Changes, second: _Changes) -> FloatArray:
    """Return the least response (rows, columns) between two neighbouring diameters, ends included."""
    r, r_second = first.squared, second.squared
    b = first.ahead * (second.ahead - first.ahead) + first.behind * (second.behind - first.behind)
    a = r_second - r - 2.0 * b
    inside = (b < 0.0) & (a + b > 0.0)
    return np.where(inside, r - b**2 / np.where(inside, a, 1.0), np.minimum(r, r_second))


def _changes(image: FloatArray, neighbours: int) -> list[_Changes]:
    """Return the intensity changes along each diameter; the border's pixels are repeated."""
    rows, columns = image.shape
    padded = np.pad(image, 1, mode="edge")

    def towards(x: int, y: int) -> FloatArray:
        return np.asarray(padded[1 + y : 1 + y + rows, 1 + x : 1 + x + columns] - image)

    return [_Changes(towards(x, y), towards(-x, -y)) for x, y in _DIAMETERS[neighbours]]


def _coarse_corners(image: FloatArray, neighbours: int, relative: float) -> BoolArray:
    """Return which pixels (rows, columns) lie at or beside a likely corner of the image at half scale."""
    rows, columns = image.shape
    even = np.pad(image, ((0, rows % 2), (0, columns % 2)), mode="edge")
    half = even.reshape(even.shape[0] // 2, 2, even.shape[1] // 2, 2).mean(axis=(1, 3))
    simple = simple_response(half, neighbours)
    likely = simple >= relative * simple.max(initial=0.0)
    grown = np.pad(likely, 1)
    beside = np.zeros_like(likely)
    for y in range(3):
        for x in range(3):
            beside |= grown[y : y + likely.shape[0], x : x + likely.shape[1]]
    return np.asarray(np.kron(beside, np.ones((2, 2), dtype=np.bool_))[:rows, :columns])
