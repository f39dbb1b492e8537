"""Tables of the classical methods of star identification: pairs, triangles and grid patterns of guide stars.

Pairs by angle (Michalski 3.3.1 and 3.3.4, eq. 49-61): two numbers and a float32 angle, which is rounded by
0.003" at most below 0.5 rad. Pairs are sorted by angle and searched with a k-vector, one cell for four pairs.
The k-vector finds the keys of a range without a binary search (Mortari & Neta, K-vector range searching
techniques, 2000). A straight line is drawn through the sorted keys; the k-vector counts the keys below each
of its evenly spaced values, so that the inverse of the line gives the cell of any value and two look-ups
bound a range. Ranges are half-open, low <= key < high, and both ends are compared with the keys of their
cells: the result is exact, while equation 61 returns some keys too many. Two corrections: equation 54 needs 2
delta-epsilon, as in the source, for the line to end above the largest key, and equation 56 is 2.22e-16; here
the margin is relative to the size of the keys.

Triangles of the brighter guide stars by area and polar moment. Plane triangles (Michalski 35-48; Cole &
Crassidis, Fast star-pattern recognition using planar triangles, J. Guidance 29, 2006) are those of the
chords. Equation 47a is corrected to a, b and c; the covariance of a direction is sigma^2 (1 - b b^T) (25).
Spherical triangles (Michalski 32-34; Cole & Crassidis, Fast star pattern recognition using spherical
triangles, AIAA 2004): the source sums the polar moment over ever smaller triangles. Here Gaussian quadrature
integrates theta^2 over the plane triangle of the chords, each element of which covers det(v1, v2, v3)/|p|^3
of the sphere. theta is the angle from the mean direction of the corners. The table holds every triangle whose
sides fit into one frame, sorted by area with a k-vector. Corners stand opposite the shortest, the middle and
the longest side, so that a match of shape also matches the corners.

The grid pattern of a star is the set of cells that its neighbours occupy (Padgett & Kreutz-Delgado 1997). The
star is the origin of a tangent plane; its nearest neighbour beyond a buffer radius defines the +x axis; each
other star within the pattern radius occupies a cell.

Each table is built at its first use, so that a camera with one method holds the tables of one method.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.vision.startracker.index.sky_index import (
    GuideStars,
    SkyIndex,
)


@dataclass(frozen=True, slots=True, eq=False)
class KVector:
    """Sorted keys, and a table of counts by which ranges of keys are found (k-vector).

    Attributes:
        key: (n,) floating, in ascending order.
        count: (cells + 1,) uint32, keys below each value of the line.
        slope, origin: the line (53) has the value origin + slope j at j.
    """

    key: npt.NDArray[Any]
    count: npt.NDArray[np.uint32]
    slope: float
    origin: float

    def __len__(self) -> int:
        return len(self.key)

    def ranges(self, low: npt.ArrayLike, high: npt.ArrayLike) -> tuple[IntArray, IntArray]:
        """Return start and stop (m,) of the keys with low <= key < high, for m ranges at once.

        An empty range has stop = start. Raises ValueError for a NaN.
        """
        start = self._below(np.atleast_1d(np.asarray(low, dtype=np.float64)))
        stop = self._below(np.atleast_1d(np.asarray(high, dtype=np.float64)))
        return start, np.maximum(start, stop)

    def _below(self, value: FloatArray) -> IntArray:
        """Return the number of keys below each value (m,)."""
        if np.isnan(value).any():
            raise ValueError("a range of NaN: its ends must be numbers")
        if not len(self.key):
            return np.zeros(len(value), dtype=np.int64)
        last = len(self.count) - 2
        with np.errstate(over="ignore"):
            # Far beyond the keys the quotient is infinite; it is clipped to the last cell.
            cell = np.clip((value - self.origin) / self.slope, 0.0, last).astype(np.int64)
        # Rounding may move the quotient across the bound of the cell.
        cell = np.maximum(cell - (self.origin + self.slope * cell > value), 0)
        cell = np.minimum(cell + (self.origin + self.slope * (cell + 1) <= value), last)
        lower = self.count[cell].astype(np.int64)
        upper = self.count[cell + 1].astype(np.int64)
        while True:
            open_ = np.flatnonzero(lower < upper)
            if not len(open_):
                return lower
            middle = (lower[open_] + upper[open_]) // 2
            below = self.key[middle] < value[open_]
            lower[open_[below]] = middle[below] + 1
            upper[open_[~below]] = middle[~below]


def build_k_vector(key: npt.NDArray[Any], cells: int | None = None) -> KVector:
    """Return the k-vector of sorted keys (n,), by default with as many cells as keys, as in the source.

    Raises ValueError when the keys are not finite or not in order, or `cells` is not positive.
    """
    wide = key.astype(np.float64)
    if not np.all(np.isfinite(wide)) or np.any(np.diff(wide) < 0.0):
        raise ValueError("the keys of a k-vector must be finite and in ascending order")
    number = max(len(key) - 1, 1) if cells is None else cells
    if number < 1:
        raise ValueError(f"cells = {cells}: at least one")
    if not len(key):
        return KVector(key, np.zeros(number + 1, dtype=np.uint32), 1.0, 0.0)
    margin = (number + 4) * np.finfo(np.float64).eps * max(abs(wide[0]), abs(wide[-1]), 1e-200)
    slope = (wide[-1] - wide[0] + 2.0 * margin) / number
    origin = wide[0] - margin
    count = np.searchsorted(wide, origin + slope * np.arange(number + 1)).astype(np.uint32)
    count[0], count[-1] = 0, len(key)
    return KVector(key, count, float(slope), float(origin))


def members(start: IntArray, stop: IntArray) -> tuple[IntArray, IntArray]:
    """Return all indices in the ranges (m,) one after the other, and the range that each belongs to."""
    length = stop - start
    owner = np.repeat(np.arange(len(start)), length)
    begin = np.cumsum(length) - length
    return np.arange(len(owner)) + (start - begin)[owner], owner


_PAIRS_A_CELL = 4


@dataclass(frozen=True, slots=True, eq=False)
class PairTable:
    """Pairs in order of their angle.

    Attributes:
        first, second: (m,) uint16, uint32 from 65,536 stars on: numbers of guide stars, first < second.
        angle: their angle, rad, float32, with its k-vector.
        stars: number of paired guide stars, the brightest ones.
        widest: rad, the largest angle.
    """

    first: npt.NDArray[Any]
    second: npt.NDArray[Any]
    angle: KVector
    stars: int
    widest: float

    def __len__(self) -> int:
        return len(self.first)

    def between(self, low: npt.ArrayLike, high: npt.ArrayLike) -> tuple[IntArray, IntArray, IntArray]:
        """Return all pairs with low <= angle < high (m,), in both orders, with the range of each.

        The three arrays (k,) are guide star, partner and index of the range.
        """
        place, owner = members(*self.angle.ranges(low, high))
        first = self.first[place].astype(np.int64)
        second = self.second[place].astype(np.int64)
        return (
            np.concatenate([first, second]),
            np.concatenate([second, first]),
            np.concatenate([owner, owner]),
        )


def build_pairs(stars: GuideStars, widest: float) -> PairTable:
    """Return all pairs of `stars` closer than `widest` rad. Raises ValueError for an angle not in (0, pi)."""
    if not 0.0 < widest < np.pi:
        raise ValueError(f"widest = {widest!r}: an angle between 0 and pi rad")
    pairs = cKDTree(stars.direction).query_pairs(2.0 * np.sin(0.5 * widest), output_type="ndarray")
    angle = angles(stars.direction[pairs[:, 0]], stars.direction[pairs[:, 1]]).astype(np.float32)
    order = np.lexsort((pairs[:, 1], pairs[:, 0], angle))
    number = np.uint16 if len(stars) <= 1 << 16 else np.uint32
    ordered = pairs[order].astype(number)
    key = build_k_vector(angle[order], max(1, len(order) // _PAIRS_A_CELL))
    return PairTable(ordered[:, 0].copy(), ordered[:, 1].copy(), key, len(stars), widest)


def faintest_for(stars: GuideStars, solid_angle: float, wanted: float) -> float:
    """Return the magnitude limit at which a field of `solid_angle` sr shows `wanted` stars on average."""
    number = int(np.ceil(wanted * 4.0 * np.pi / solid_angle))
    return (
        float(stars.magnitude[number])
        if number < len(stars)
        else float(np.nextafter(stars.magnitude[-1], 99.0))
    )


def angles(one: FloatArray, other: FloatArray) -> FloatArray:
    """Return the angles (...,) between unit vectors (..., 3), from half the chord: accurate if small (22)."""
    return np.asarray(2.0 * np.arcsin(np.minimum(0.5 * np.linalg.norm(one - other, axis=-1), 1.0)))


@dataclass(frozen=True, slots=True, eq=False)
class TriangleShape:
    """Shape parameters of t triangles, with standard deviations.

    Attributes:
        area: (t,) sr.
        moment: (t,) polar moment about the centroid, rad^4.
        sigma_area, sigma_moment: (t,) their standard deviations.
    """

    area: FloatArray
    moment: FloatArray
    sigma_area: FloatArray
    sigma_moment: FloatArray


def planar_shape(corners: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return area (t,) and polar moment (t,) about the centroid of triangles (t, 3, 3) (35-37)."""
    a, b, c = _sides(corners)
    s = 0.5 * (a + b + c)
    area = np.sqrt(np.maximum(s * (s - a) * (s - b) * (s - c), 0.0))
    return area, area * (a**2 + b**2 + c**2) / 36.0


def measured_planar_shape(corners: FloatArray, sigma: FloatArray) -> TriangleShape:
    """Return the shape of triangles (t, 3, 3) whose corners have errors `sigma` (t, 3) rad (38-48).

    A triangle without area has infinite variances, because its area has no derivative.
    """
    a, b, c = _sides(corners)
    area, moment = planar_shape(corners)
    s = 0.5 * (a + b + c)
    u1, u2 = (s - a) * (s - b) * (s - c), s * (s - b) * (s - c)
    u3, u4 = s * (s - a) * (s - c), s * (s - a) * (s - b)
    with np.errstate(divide="ignore", invalid="ignore"):
        by_side = np.stack([u1 - u2 + u3 + u4, u1 + u2 - u3 + u4, u1 + u2 + u3 - u4]) / (4.0 * area)
        side_by_corner = _side_gradients(corners, a, b, c)
        h = np.einsum("st,stcx->tcx", by_side, side_by_corner)
        moment_by_side = area * np.stack([a, b, c]) / 18.0
        squares = (a**2 + b**2 + c**2) / 36.0
        bar = np.einsum("st,stcx->tcx", moment_by_side, side_by_corner) + squares[:, None, None] * h
        sigma_area, sigma_moment = (np.sqrt(_variance(g, corners, sigma)) for g in (h, bar))
    flat = ~(np.isfinite(sigma_area) & np.isfinite(sigma_moment))
    sigma_area[flat] = sigma_moment[flat] = np.inf
    return TriangleShape(area, moment, sigma_area, sigma_moment)


def _sides(corners: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the sides a, b and c between corners 1-2, 2-3 and 1-3 (Michalski 35b-35d)."""
    p, q, r = np.moveaxis(corners, -2, 0)
    a, b, c = (np.linalg.norm(one - other, axis=-1) for one, other in ((p, q), (q, r), (p, r)))
    return a, b, c


def _side_gradients(corners: FloatArray, a: FloatArray, b: FloatArray, c: FloatArray) -> FloatArray:
    """Return the derivatives (3 sides, t, 3 corners, 3) of the sides by the corners (42)."""
    p, q, r = np.moveaxis(corners, -2, 0)
    ab, bc, ac = (p - q) / a[:, None], (q - r) / b[:, None], (p - r) / c[:, None]
    none = np.zeros_like(ab)
    return np.stack([np.stack(row, axis=1) for row in ((ab, -ab, none), (none, bc, -bc), (ac, none, -ac))])


def _variance(gradient: FloatArray, corners: FloatArray, sigma: FloatArray) -> FloatArray:
    """Return H R H^T (t,) (43, 44)."""
    radial = np.sum(gradient * corners, axis=-1)
    return np.asarray(np.sum(sigma**2 * (np.sum(gradient**2, axis=-1) - radial**2), axis=-1))


_STEP = 1e-5
_ORDER = 6


def _quadrature() -> tuple[FloatArray, FloatArray]:
    """Return the points (36, 3), barycentric, and weights (36,) of collapsed Gaussian quadrature."""
    nodes, weights = np.polynomial.legendre.leggauss(_ORDER)
    nodes, weights = 0.5 * (nodes + 1.0), 0.5 * weights
    u, v = (grid.ravel() for grid in np.meshgrid(nodes, nodes))
    points = np.stack([1.0 - u, u * (1.0 - v), u * v], axis=-1)
    return points, 2.0 * u * np.outer(weights, weights).ravel()


_POINTS, _WEIGHTS = _quadrature()


def spherical_shape(corners: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return area (...,) and polar moment (...,) of triangles (..., 3, 3) of unit vectors (32-34)."""
    p, q, r = np.moveaxis(corners, -2, 0)
    # Equation 32 loses small differences of the sides; the solid angle by Van Oosterom & Strackee does not.
    volume = np.abs(np.sum(p * np.cross(q, r), axis=-1))
    sides = 1.0 + np.sum(p * q, axis=-1) + np.sum(q * r, axis=-1) + np.sum(r * p, axis=-1)
    area = 2.0 * np.arctan2(volume, sides)
    middle = p + q + r
    middle = middle / np.linalg.norm(middle, axis=-1, keepdims=True)
    inside = _POINTS @ corners
    length = np.linalg.norm(inside, axis=-1)
    chord = np.linalg.norm(inside / length[..., None] - middle[..., None, :], axis=-1)
    theta = 2.0 * np.arcsin(np.minimum(0.5 * chord, 1.0))
    # Barycentric coordinates cover half a unit square.
    moment = 0.5 * volume * np.sum(_WEIGHTS * theta**2 / length**3, axis=-1)
    return area, moment


def measured_spherical_shape(corners: FloatArray, sigma: FloatArray) -> TriangleShape:
    """Return the shape of triangles (t, 3, 3) with corner errors `sigma` (t, 3) rad, by differences."""
    area, moment = spherical_shape(corners)
    variance_area, variance_moment = np.zeros_like(area), np.zeros_like(moment)
    for corner in range(3):
        at = corners[:, corner]
        along = corners[:, (corner + 1) % 3] - at
        along = along - np.sum(along * at, axis=-1, keepdims=True) * at
        # Two coincident corners define no direction along their side: any direction will do.
        length = np.linalg.norm(along, axis=-1, keepdims=True)
        along = np.where(length > 0.0, along / np.where(length > 0.0, length, 1.0), _across(at))
        for direction in (along, np.cross(at, along)):
            ends = []
            for sign in (1.0, -1.0):
                moved = corners.copy()
                moved[:, corner] = np.cos(_STEP) * at + sign * np.sin(_STEP) * direction
                ends.append(spherical_shape(moved))
            slopes = [(ahead - behind) / (2.0 * _STEP) for ahead, behind in zip(*ends, strict=True)]
            variance_area += (sigma[:, corner] * slopes[0]) ** 2
            variance_moment += (sigma[:, corner] * slopes[1]) ** 2
    return TriangleShape(area, moment, np.sqrt(variance_area), np.sqrt(variance_moment))


def _across(direction: FloatArray) -> FloatArray:
    """Return a unit vector (t, 3) normal to each direction (t, 3)."""
    axis = np.eye(3)[np.argmin(np.abs(direction), axis=-1)]
    normal = np.cross(direction, axis)
    return np.asarray(normal / np.linalg.norm(normal, axis=-1, keepdims=True))


Shape = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
"""Function from the corners of triangles to their areas and polar moments."""
MeasuredShape = Callable[[FloatArray, FloatArray], TriangleShape]
"""Function from the corners of triangles and their errors (rad) to shapes with standard deviations."""


@dataclass(frozen=True, slots=True, eq=False)
class TriangleTable:
    """Triangles in order of their area.

    Attributes:
        corner: (t, 3) uint16 or uint32 numbers of guide stars.
        area: (t,) float32, with its k-vector.
        moment: (t,) float32 polar moment.
    """

    corner: npt.NDArray[np.unsignedinteger[npt.NBitBase]]
    area: KVector
    moment: npt.NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.corner)


def build_triangles(
    direction: FloatArray, pairs: PairTable, chosen: BoolArray, widest: float, shape: Shape
) -> TriangleTable:
    """Return the triangles of the `chosen` guide stars (n,) with all sides up to `widest` rad.

    `direction` (n, 3) are the guide stars to which `pairs` refers.
    """
    corners = ordered(direction, _triangles(pairs, chosen, widest))
    area, moment = shape(direction[corners])
    order = np.argsort(area, kind="stable")
    number = np.uint16 if len(chosen) <= 1 << 16 else np.uint32
    key = build_k_vector(area[order].astype(np.float32))
    return TriangleTable(corners[order].astype(number), key, moment[order].astype(np.float32))


def locally_bright(pairs: PairTable, radius: float, rank: int) -> BoolArray:
    """Return which guide stars (n,) have fewer than `rank` brighter ones within `radius` rad.

    A sparse part of the sky thus has as many stars as a dense one.
    """
    start, stop = pairs.angle.ranges(0.0, radius)
    # The second star of a pair has the larger index and is therefore the fainter one.
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
    """Return all triangles (t, 3), in ascending order of the indices, whose three sides are pairs."""
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


GRID_CELLS = 40
BUFFER = 0.15
"""Minimum distance of the aligning star, in pattern radii, because the direction to a closer star is
inaccurate."""


@dataclass(frozen=True, slots=True, eq=False)
class GridTable:
    """Guide stars by occupied cell.

    Attributes:
        radius: rad, of the patterns.
        aligning: (n,) int32 guide star that aligns the pattern of each guide star; -1 without a neighbour.
        begin: (cells + 1,) int64, index in `star` of the first star of each cell.
        star: (m,) int32 guide stars, ordered by cell.
    """

    radius: float
    aligning: npt.NDArray[np.int32]
    begin: npt.NDArray[np.int64]
    star: npt.NDArray[np.int32]

    def votes(self, cells: IntArray) -> IntArray:
        """Return for each guide star (n,) the number of the `cells` (k,) that its pattern occupies."""
        place, _ = members(self.begin[cells], self.begin[cells + 1])
        return np.bincount(self.star[place], minlength=len(self.aligning))


def build_grid(direction: FloatArray, tree: cKDTree, radius: float) -> GridTable:
    """Return the patterns, with a radius of `radius` rad, of all guide stars (n, 3)."""
    pairs = tree.query_pairs(2.0 * np.sin(0.5 * radius), output_type="ndarray").astype(np.int64)
    centre = np.concatenate([pairs[:, 0], pairs[:, 1]])
    other = np.concatenate([pairs[:, 1], pairs[:, 0]])
    place = tangent_positions(direction, centre, direction[other])
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


def tangent_positions(direction: FloatArray, centre: IntArray, others: FloatArray) -> FloatArray:
    """Return the positions (k, 2) of directions `others` (k, 3) on tangent planes at stars `centre` (k,)."""
    z = direction[centre]
    helper = np.where(np.abs(z[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    x = np.cross(helper, z)
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    y = np.cross(z, x)
    height = np.sum(others * z, axis=-1)
    return np.stack([np.sum(others * x, axis=-1) / height, np.sum(others * y, axis=-1) / height], axis=-1)


def cells_of(place: FloatArray, along: FloatArray, radius: float) -> IntArray:
    """Return the cells (k,) of positions (k, 2) in a plane rotated so that `along` (k, 2) is on +x."""
    unit = along / np.linalg.norm(along, axis=-1, keepdims=True)
    x = np.sum(place * unit, axis=-1)
    y = unit[:, 0] * place[:, 1] - unit[:, 1] * place[:, 0]
    turned = np.stack([x, y], axis=-1) / np.tan(radius)
    column, row = np.clip((0.5 * GRID_CELLS * (turned + 1.0)).astype(np.int64), 0, GRID_CELLS - 1).T
    return np.asarray(row * GRID_CELLS + column)


STARS_IN_FIELD = 24.0
TRIANGLE_STARS_IN_FIELD = 9


class KnownSky:
    """The guide stars that a field of view shows, and the tables of their pairs, triangles and patterns.

    Attributes:
        index: all guide stars; identifications refer to their indices.
        half_width: (2,) tangents of half the field of view.
        stars: the guide stars down to the magnitude at which a field shows 24 of them on average.
    """

    def __init__(self, index: SkyIndex, half_width: tuple[float, float]) -> None:
        """Use the guide stars of `index` for fields of `half_width` (2,), tangents of the half angles."""
        self.index = index
        self.half_width = half_width
        x, y = half_width
        self.solid_angle = 4.0 * math.asin(x * y / math.sqrt((1.0 + x * x) * (1.0 + y * y)))
        self.stars: GuideStars = index.stars.brighter_than(
            faintest_for(index.stars, self.solid_angle, STARS_IN_FIELD)
        )

    @property
    def widest(self) -> float:
        """Largest angle between two stars in the field, rad: its diagonal."""
        return 2.0 * math.atan(math.hypot(*self.half_width))

    @cached_property
    def pairs(self) -> PairTable:
        """All pairs that fit into the field."""
        return build_pairs(self.stars, self.widest)

    @cached_property
    def tree(self) -> cKDTree:
        """Search tree of the guide stars' directions."""
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
        """The pattern around each guide star."""
        return build_grid(self.stars.direction, self.tree, math.atan(min(self.half_width)))

    def _triangles(self, shape: Shape) -> TriangleTable:
        side = 2.0 * math.atan(min(self.half_width))
        # The radius of a circle with the solid angle of the field.
        radius = math.acos(1.0 - self.solid_angle / (2.0 * math.pi))
        chosen = locally_bright(self.pairs, radius, TRIANGLE_STARS_IN_FIELD)
        return build_triangles(self.stars.direction, self.pairs, chosen, side, shape)
