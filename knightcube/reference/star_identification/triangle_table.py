"""Triangles of the brighter guide stars by area, with a k-vector, and beside each its polar moment.

Every triangle whose sides fit into one frame. Corners stand opposite the shortest, the middle and the longest
side, so that a match of shape matches the corners as well.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.reference.star_identification import k_vector
from knightcube.reference.star_identification.k_vector import KVector, members
from knightcube.reference.star_identification.pair_table import PairTable

Shape = Callable[[FloatArray], tuple[FloatArray, FloatArray]]


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


def build(
    direction: FloatArray, pairs: PairTable, chosen: BoolArray, widest: float, shape: Shape
) -> TriangleTable:
    """Return the triangles of the `chosen` guide stars (n,), none of whose sides exceeds `widest` rad.

    `direction` (n, 3) are the guide stars that `pairs` numbers.
    """
    corners = ordered(direction, _triangles(pairs, chosen, widest))
    area, moment = shape(direction[corners])
    order = np.argsort(area, kind="stable")
    number = np.uint16 if len(chosen) <= 1 << 16 else np.uint32
    key = k_vector.build(area[order].astype(np.float32))
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
