"""The tables of the classical methods for one field of view: pairs, triangles and grid patterns.

Each table is built when it is first used: a camera that uses one method holds the tables of one method.

The grid pattern of a star is the set of cells that its neighbours occupy (Padgett & Kreutz-Delgado 1997). The
star is the origin of a tangent plane; its nearest neighbour beyond a buffer radius defines the +x axis; each
other star within the pattern radius occupies a cell.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from knightcube.astro.arrays import FloatArray, IntArray
from knightcube.reference.star_identification.pair_table import PairTable, build_pairs, faintest_for, members
from knightcube.reference.star_identification.triangle_table import (
    Shape,
    TriangleTable,
    build_triangles,
    locally_bright,
    planar_shape,
    spherical_shape,
)
from knightcube.vision.startracker.index.sky_index import GuideStars, SkyIndex

GRID_CELLS = 40
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
    begin = np.searchsorted(by_cell // len(direction), np.arange(GRID_CELLS * GRID_CELLS + 1))
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
    column, row = np.clip((0.5 * GRID_CELLS * (turned + 1.0)).astype(np.int64), 0, GRID_CELLS - 1).T
    return np.asarray(row * GRID_CELLS + column)


STARS_IN_FIELD = 24.0
TRIANGLE_STARS_IN_FIELD = 9


class KnownSky:
    """The guide stars that a field of view shows, and the tables made of them.

    Attributes:
        index: all guide stars; the numbers of an identification are theirs.
        half_width: (2,) tangents of the half field that the tables are for.
        stars: the guide stars down to the magnitude at which a field shows 24 of them on average.
    """

    def __init__(
        self, index: SkyIndex, half_width: tuple[float, float], pairs: PairTable | None = None
    ) -> None:
        """Use the `pairs` of a file if given, else build them at their first use."""
        self.index = index
        self.half_width = half_width
        x, y = half_width
        self.solid_angle = 4.0 * math.asin(x * y / math.sqrt((1.0 + x * x) * (1.0 + y * y)))
        self.stars: GuideStars = index.stars.brighter_than(
            faintest_for(index.stars, self.solid_angle, STARS_IN_FIELD)
        )
        self._pairs = pairs

    @property
    def widest(self) -> float:
        """The largest angle of two stars in the field, rad: its diagonal."""
        return 2.0 * math.atan(math.hypot(*self.half_width))

    @cached_property
    def pairs(self) -> PairTable:
        """All pairs that the field can show."""
        return self._pairs or build_pairs(self.stars, self.widest)

    @cached_property
    def tree(self) -> cKDTree:
        """The guide stars by place."""
        return cKDTree(self.stars.direction)

    @cached_property
    def planar(self) -> TriangleTable:
        """Triangles by plane area."""
        return self._triangles(planar_shape)

    @cached_property
    def spherical(self) -> TriangleTable:
        """Triangles by spherical area."""
        return self._triangles(spherical_shape)

    @cached_property
    def grid(self) -> GridTable:
        """The pattern about each guide star."""
        return build_grid(self.stars.direction, self.tree, math.atan(min(self.half_width)))

    def _triangles(self, shape: Shape) -> TriangleTable:
        side = 2.0 * math.atan(min(self.half_width))
        # The circle of the field's size about a star.
        radius = math.acos(1.0 - self.solid_angle / (2.0 * math.pi))
        chosen = locally_bright(self.pairs, radius, TRIANGLE_STARS_IN_FIELD)
        return build_triangles(self.stars.direction, self.pairs, chosen, side, shape)
