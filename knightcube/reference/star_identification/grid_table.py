"""The grid pattern about a star: which cells its neighbours fall into (Padgett & Kreutz-Delgado 1997).

The star is the origin of a tangent plane; its nearest neighbour beyond a buffer radius turns the plane
to a standard position; each other star within the pattern radius occupies a cell.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from knightcube.astro.arrays import FloatArray, IntArray
from knightcube.reference.star_identification.k_vector import members

CELLS = 40
BUFFER = 0.15
"""Least distance of the aligning star, in pattern radii: a near one aligns the plane badly."""


@dataclass(frozen=True, slots=True, eq=False)
class GridTable:
    """Guide stars by occupied cell.

    Attributes:
        radius: rad, of the patterns.
        aligning: (n,) int32 guide star that turns each guide star's pattern, -1 without a neighbour.
        begin: (cells + 1,) int64, where each cell's stars begin in `star`.
        star: (m,) int32 guide stars, cell after cell.
    """

    radius: float
    aligning: npt.NDArray[np.int32]
    begin: npt.NDArray[np.int64]
    star: npt.NDArray[np.int32]

    def votes(self, cells: IntArray) -> IntArray:
        """Return for each guide star (n,) how many of the occupied `cells` (k,) it has too."""
        place, _ = members(self.begin[cells], self.begin[cells + 1])
        return np.bincount(self.star[place], minlength=len(self.aligning))


def build_grid(direction: FloatArray, tree: cKDTree, radius: float) -> GridTable:
    """Return the patterns of all guide stars (n, 3), of `radius` rad."""
    pairs = tree.query_pairs(2.0 * np.sin(0.5 * radius), output_type="ndarray").astype(np.int64)
    centre = np.concatenate([pairs[:, 0], pairs[:, 1]])
    other = np.concatenate([pairs[:, 1], pairs[:, 0]])
    place = tangent_places(direction, centre, direction[other])
    distance = np.hypot(*place.T)
    far = np.flatnonzero(distance > BUFFER * np.tan(radius))
    order = far[np.lexsort((distance[far], centre[far]))]
    stars, first = np.unique(centre[order], return_index=True)
    aligning = np.full(len(direction), -1, dtype=np.int32)
    aligning[stars] = other[order[first]]
    along = np.full((len(direction), 2), np.nan)
    along[stars] = place[order[first]]
    counted = (aligning[centre] >= 0) & (aligning[centre] != other)
    cell = cells_of(place[counted], along[centre[counted]], radius)
    by_cell = np.unique(cell * len(direction) + centre[counted])
    begin = np.searchsorted(by_cell // len(direction), np.arange(CELLS * CELLS + 1))
    return GridTable(radius, aligning, begin, (by_cell % len(direction)).astype(np.int32))


def tangent_places(direction: FloatArray, centre: IntArray, others: FloatArray) -> FloatArray:
    """Return places (k, 2) of directions `others` (k, 3) on the planes that touch at stars `centre` (k,)."""
    z = direction[centre]
    helper = np.where(np.abs(z[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    x = np.cross(helper, z)
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    y = np.cross(z, x)
    height = np.sum(others * z, axis=-1)
    return np.stack([np.sum(others * x, axis=-1) / height, np.sum(others * y, axis=-1) / height], axis=-1)


def cells_of(place: FloatArray, along: FloatArray, radius: float) -> IntArray:
    """Return the cells (k,) of places (k, 2) when the plane is turned until `along` (k, 2) lies on +x."""
    unit = along / np.linalg.norm(along, axis=-1, keepdims=True)
    x = np.sum(place * unit, axis=-1)
    y = unit[:, 0] * place[:, 1] - unit[:, 1] * place[:, 0]
    turned = np.stack([x, y], axis=-1) / np.tan(radius)
    column, row = np.clip((0.5 * CELLS * (turned + 1.0)).astype(np.int64), 0, CELLS - 1).T
    return np.asarray(row * CELLS + column)
