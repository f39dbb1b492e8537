"""The tables of the classical methods: pairs, triangles and grids of guide stars for one field of view.

Each table is built at its first use: a camera that uses one method holds the tables of one.
"""

from __future__ import annotations

import math
from functools import cached_property

from scipy.spatial import cKDTree

from knightcube.reference.star_identification import (
    pair_table,
    planar_triangle,
    spherical_triangle,
    triangle_table,
)
from knightcube.reference.star_identification.grid_table import GridTable, build_grid
from knightcube.reference.star_identification.pair_table import PairTable
from knightcube.reference.star_identification.triangle_table import TriangleTable
from knightcube.vision.startracker.index.guide_stars import GuideStars
from knightcube.vision.startracker.index.sky_index import SkyIndex

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
            pair_table.faintest_for(index.stars, self.solid_angle, STARS_IN_FIELD)
        )
        self._pairs = pairs

    @property
    def widest(self) -> float:
        """The largest angle of two stars in the field, rad: its diagonal."""
        return 2.0 * math.atan(math.hypot(*self.half_width))

    @cached_property
    def pairs(self) -> PairTable:
        """All pairs that the field can show."""
        return self._pairs or pair_table.build(self.stars, self.widest)

    @cached_property
    def tree(self) -> cKDTree:
        """The guide stars by place."""
        return cKDTree(self.stars.direction)

    @cached_property
    def planar(self) -> TriangleTable:
        """Triangles by plane area."""
        return self._triangles(planar_triangle.shape)

    @cached_property
    def spherical(self) -> TriangleTable:
        """Triangles by spherical area."""
        return self._triangles(spherical_triangle.shape)

    @cached_property
    def grid(self) -> GridTable:
        """The pattern about each guide star."""
        return build_grid(self.stars.direction, self.tree, math.atan(min(self.half_width)))

    def _triangles(self, shape: triangle_table.Shape) -> TriangleTable:
        side = 2.0 * math.atan(min(self.half_width))
        # The circle of the field's size about a star.
        radius = math.acos(1.0 - self.solid_angle / (2.0 * math.pi))
        chosen = triangle_table.locally_bright(self.pairs, radius, TRIANGLE_STARS_IN_FIELD)
        return triangle_table.build(self.stars.direction, self.pairs, chosen, side, shape)
