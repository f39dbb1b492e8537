"""Tables for the classical methods of star identification: pairs, triangles and grid patterns of guide stars.

Pair table (Michalski, sections 3.3.1 and 3.3.4, eq. 49-61): A pair consists of two star indices and the angle
between the stars, stored as float32 with a rounding error of at most 0.003" for angles below 0.5 rad. Pairs
are sorted by angle and searched with a k-vector, which finds the keys of a range without a binary search
(Mortari & Neta, K-vector range searching techniques, 2000). A k-vector approximates the sorted keys by a
straight line, and contains, for evenly spaced values on the line, the number of keys below each value. Two
look-ups in the k-vector give the beginning and end of a range of keys, which is half-open (low <= key <
high). Equation 61 of Michalski also returns some keys just outside the range; this implementation compares
the keys in the two boundary cells with the limits. Equation 54 of Michalski is corrected to 2 delta-epsilon,
as in the original paper, so that the straight line ends above the largest key. The margin 2.22e-16 in
equation 56 of Michalski is replaced by a margin proportional to the magnitude of the keys.

Triangle tables: Triangles of the brighter guide stars are described by area and polar moment. Planar
triangles have chords as sides (Michalski, eq. 35-48, and Cole & Crassidis, Fast star-pattern recognition
using planar triangles, Journal of Guidance, Control, and Dynamics 29, 2006). Equation 47a of Michalski is
corrected to contain the sides a, b and c. The covariance of a direction b is sigma^2 (1 - b b^T) (Michalski,
eq. 25). Spherical triangles have great-circle arcs as sides (Michalski, eq. 32-34, and Cole & Crassidis, Fast
star pattern recognition using spherical triangles, AIAA 2004). Instead of the recursive subdivision of the
source, Gaussian quadrature computes the polar moment as the integral of theta^2 over the triangle, where
theta is the angle from the mean direction of the corners. Each table contains all triangles whose sides fit
into one frame, sorted by area with a k-vector. The corners of a triangle are ordered by the length of the
opposite side, so that matching triangles also have matching corners.

Grid table (Padgett & Kreutz-Delgado 1997): The grid pattern of a star is the set of cells that the
neighbouring stars within the pattern radius occupy on the tangent plane. The nearest neighbour outside a
buffer radius defines the +x axis.

Each table is built at its first use, so that only the tables of the methods in use need memory.
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
from knightcube.vision.startracker.index import GuideStars, SkyIndex


@dataclass(frozen=True, slots=True, eq=False)
class KVector:
    """K-vector: sorted keys, and a table of counts that accelerates the search for ranges of keys.

    Attributes:
        key: (n,) keys in ascending order.
        count: (cells + 1,) number of keys below each evenly spaced value of the straight line.
        slope, origin: parameters of the straight line origin + slope j at index j (Michalski, eq. 53).
    """

    key: npt.NDArray[Any]
    count: npt.NDArray[np.uint32]
    slope: float
    origin: float

    def __len__(self) -> int:
        return len(self.key)

    def ranges(self, low: npt.ArrayLike, high: npt.ArrayLike) -> tuple[IntArray, IntArray]:
        """Return, for m ranges at once, the start and stop indices (m,) of the keys with low <= key < high.

        An empty range has equal start and stop indices. Raises ValueError if a limit is NaN.
        """
        start = self._below(np.atleast_1d(np.asarray(low, dtype=np.float64)))
        stop = self._below(np.atleast_1d(np.asarray(high, dtype=np.float64)))
        return start, np.maximum(start, stop)

    def _below(self, value: FloatArray) -> IntArray:
        """Return the number of keys below each value (m,)."""
        if np.isnan(value).any():
            raise ValueError("a range has NaN as a bound: give two numbers")
        if not len(self.key):
            return np.zeros(len(value), dtype=np.int64)
        last = len(self.count) - 2
        with np.errstate(over="ignore"):
            # The cell number of a value far above all keys may overflow to infinity and is then clipped.
            cell = np.clip((value - self.origin) / self.slope, 0.0, last).astype(np.int64)
        # The cell number is corrected if rounding has moved the value into a neighbouring cell.
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
    """Return the k-vector of sorted keys (n,).

    By default the k-vector has about one cell per key, as in the publication. Raises ValueError if the keys
    are not finite or not sorted, or if `cells` is not positive.
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
    """Return the concatenated indices (k,) of m ranges, and for each index the number (k,) of its range."""
    length = stop - start
    owner = np.repeat(np.arange(len(start)), length)
    begin = np.cumsum(length) - length
    return np.arange(len(owner)) + (start - begin)[owner], owner


_PAIRS_A_CELL = 4


@dataclass(frozen=True, slots=True, eq=False)
class PairTable:
    """Table of guide star pairs, sorted by angle.

    Attributes:
        first, second: (m,) indices of the two guide stars of each pair, with first < second.
        angle: k-vector of the angles between the two stars, rad.
        stars: number of guide stars from which pairs are formed.
        widest: largest angle of a pair, rad.
    """

    first: npt.NDArray[Any]
    second: npt.NDArray[Any]
    angle: KVector
    stars: int
    widest: float

    def __len__(self) -> int:
        return len(self.first)

    def between(self, low: npt.ArrayLike, high: npt.ArrayLike) -> tuple[IntArray, IntArray, IntArray]:
        """Return all pairs whose angle lies in one of m ranges low <= angle < high, each pair in both orders.

        The three result arrays (k,) contain the guide star, its partner and the index of the range.
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
    """Return all pairs of guide stars with an angle below `widest`, rad.

    Raises ValueError unless `widest` lies between 0 and pi.
    """
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
    """Return the limiting magnitude at which a field of view contains `wanted` guide stars on average.

    The stars are in order of brightness, and `solid_angle` is the size of the field of view, sr.
    """
    number = int(np.ceil(wanted * 4.0 * np.pi / solid_angle))
    return (
        float(stars.magnitude[number])
        if number < len(stars)
        else float(np.nextafter(stars.magnitude[-1], 99.0))
    )


def angles(one: FloatArray, other: FloatArray) -> FloatArray:
    """Return the angles (...,), rad, between unit vectors (..., 3).

    The angles are computed from the chord, which is accurate for small angles (Michalski, eq. 22).
    """
    return np.asarray(2.0 * np.arcsin(np.minimum(0.5 * np.linalg.norm(one - other, axis=-1), 1.0)))


def cosine_sigma(cosine: FloatArray, one: FloatArray, other: FloatArray) -> FloatArray:
    """Return the standard deviations (k,) of the cosines of measured angles (Michalski, eq. 26 to 31).

    With the covariance R = sigma^2 (I - b b^T) of a direction b (eq. 25b), the variance of eq. 31 becomes
    (sigma_1^2 + sigma_2^2) sin^2 a + sigma_1^2 sigma_2^2 (1 + cos^2 a) for the angle a. The second term is
    the trace of R1 R2, which matters only if the angle between two stars is of the order of the direction
    errors. The standard deviations of the directions are `one` and `other` (k,), rad.
    """
    first, second, square = one**2, other**2, cosine**2
    return np.asarray(np.sqrt((first + second) * (1.0 - square) + first * second * (1.0 + square)))


@dataclass(frozen=True, slots=True, eq=False)
class TriangleShape:
    """Areas (t,), sr, and polar moments (t,), rad^4, of t triangles, with their standard deviations."""

    area: FloatArray
    moment: FloatArray
    sigma_area: FloatArray
    sigma_moment: FloatArray


def planar_shape(corners: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the areas (t,) and polar moments (t,) of planar triangles (t, 3, 3) (Michalski, eq. 35-37).

    The polar moments are about the centroids of the triangles.
    """
    a, b, c = _sides(corners)
    s = 0.5 * (a + b + c)
    area = np.sqrt(np.maximum(s * (s - a) * (s - b) * (s - c), 0.0))
    return area, area * (a**2 + b**2 + c**2) / 36.0


def measured_planar_shape(corners: FloatArray, sigma: FloatArray) -> TriangleShape:
    """Return the shapes of t planar triangles with standard deviations (Michalski, eq. 38-48).

    The corners (t, 3, 3) are unit vectors with the standard deviations `sigma` (t, 3), rad. A triangle with
    zero area has infinite standard deviations, because the area is not differentiable.
    """
    a, b, c = _sides(corners)
    area, moment = planar_shape(corners)
    s = 0.5 * (a + b + c)
    u1, u2 = (s - a) * (s - b) * (s - c), s * (s - b) * (s - c)
    u3, u4 = s * (s - a) * (s - c), s * (s - a) * (s - b)
    with np.errstate(divide="ignore", invalid="ignore"):
        by_side = np.stack([u1 - u2 + u3 + u4, u1 + u2 - u3 + u4, u1 + u2 + u3 - u4]) / (4.0 * area)
        # Derivatives of the side lengths with respect to the corners (Michalski, eq. 42), (3, t, 3, 3).
        p, q, r = np.moveaxis(corners, -2, 0)
        ab, bc, ac = (p - q) / a[:, None], (q - r) / b[:, None], (p - r) / c[:, None]
        none = np.zeros_like(ab)
        side_by_corner = np.stack(
            [np.stack(row, axis=1) for row in ((ab, -ab, none), (none, bc, -bc), (ac, none, -ac))]
        )
        h = np.einsum("st,stcx->tcx", by_side, side_by_corner)
        moment_by_side = area * np.stack([a, b, c]) / 18.0
        squares = (a**2 + b**2 + c**2) / 36.0
        bar = np.einsum("st,stcx->tcx", moment_by_side, side_by_corner) + squares[:, None, None] * h
        sigma_area, sigma_moment = (np.sqrt(_variance(g, corners, sigma)) for g in (h, bar))
    flat = ~(np.isfinite(sigma_area) & np.isfinite(sigma_moment))
    sigma_area[flat] = sigma_moment[flat] = np.inf
    return TriangleShape(area, moment, sigma_area, sigma_moment)


def _sides(corners: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the side lengths a (corners 1-2), b (2-3) and c (1-3) of triangles (Michalski, eq. 35b-35d)."""
    p, q, r = np.moveaxis(corners, -2, 0)
    a, b, c = (np.linalg.norm(one - other, axis=-1) for one, other in ((p, q), (q, r), (p, r)))
    return a, b, c


def _variance(gradient: FloatArray, corners: FloatArray, sigma: FloatArray) -> FloatArray:
    """Return the variances (t,) H R H^T of a shape parameter with gradient H (Michalski, eq. 43 and 44)."""
    radial = np.sum(gradient * corners, axis=-1)
    return np.asarray(np.sum(sigma**2 * (np.sum(gradient**2, axis=-1) - radial**2), axis=-1))


_STEP = 1e-5
_ORDER = 6


def _quadrature() -> tuple[FloatArray, FloatArray]:
    """Return the barycentric points (36, 3) and weights (36,) of Gaussian quadrature over a triangle."""
    nodes, weights = np.polynomial.legendre.leggauss(_ORDER)
    nodes, weights = 0.5 * (nodes + 1.0), 0.5 * weights
    u, v = (grid.ravel() for grid in np.meshgrid(nodes, nodes))
    points = np.stack([1.0 - u, u * (1.0 - v), u * v], axis=-1)
    return points, 2.0 * u * np.outer(weights, weights).ravel()


_POINTS, _WEIGHTS = _quadrature()


def spherical_shape(corners: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the areas (...,) and polar moments (...,) of spherical triangles (Michalski, eq. 32-34).

    The argument `corners` (..., 3, 3) contains the unit vectors to the three corners of each triangle.
    """
    p, q, r = np.moveaxis(corners, -2, 0)
    # The formula of Van Oosterom & Strackee is more accurate for small triangles than Michalski's eq. 32.
    volume = np.abs(np.sum(p * np.cross(q, r), axis=-1))
    sides = 1.0 + np.sum(p * q, axis=-1) + np.sum(q * r, axis=-1) + np.sum(r * p, axis=-1)
    area = 2.0 * np.arctan2(volume, sides)
    middle = p + q + r
    middle = middle / np.linalg.norm(middle, axis=-1, keepdims=True)
    inside = _POINTS @ corners
    length = np.linalg.norm(inside, axis=-1)
    chord = np.linalg.norm(inside / length[..., None] - middle[..., None, :], axis=-1)
    theta = 2.0 * np.arcsin(np.minimum(0.5 * chord, 1.0))
    # The factor 0.5 is the area of the triangle over which the barycentric coordinates are integrated.
    moment = 0.5 * volume * np.sum(_WEIGHTS * theta**2 / length**3, axis=-1)
    return area, moment


def measured_spherical_shape(corners: FloatArray, sigma: FloatArray) -> TriangleShape:
    """Return the shapes of spherical triangles with standard deviations from numerical derivatives.

    The arguments are those of `measured_planar_shape`.
    """
    area, moment = spherical_shape(corners)
    variance_area, variance_moment = np.zeros_like(area), np.zeros_like(moment)
    for corner in range(3):
        at = corners[:, corner]
        along = corners[:, (corner + 1) % 3] - at
        along = along - np.sum(along * at, axis=-1, keepdims=True) * at
        # For two coincident corners an arbitrary direction is used, because their side has no direction.
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
    """Return unit vectors (t, 3) perpendicular to the directions (t, 3)."""
    axis = np.eye(3)[np.argmin(np.abs(direction), axis=-1)]
    normal = np.cross(direction, axis)
    return np.asarray(normal / np.linalg.norm(normal, axis=-1, keepdims=True))


Shape = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
"""Function that returns the areas and polar moments of triangles with given corners."""
MeasuredShape = Callable[[FloatArray, FloatArray], TriangleShape]
"""Function that returns the shapes of triangles with given corners and standard deviations (rad)."""


@dataclass(frozen=True, slots=True, eq=False)
class TriangleTable:
    """Triangles of guide stars, sorted by area: indices of the corners (t, 3), and polar moments (t,)."""

    corner: npt.NDArray[np.unsignedinteger[npt.NBitBase]]
    area: KVector
    moment: npt.NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.corner)


def build_triangles(
    direction: FloatArray, pairs: PairTable, chosen: BoolArray, widest: float, shape: Shape
) -> TriangleTable:
    """Return the table of all triangles of the `chosen` (n,) guide stars with sides of at most `widest` rad.

    The function `shape` returns areas and polar moments of triangles.
    """
    corners = ordered(direction, _triangles(pairs, chosen, widest))
    area, moment = shape(direction[corners])
    order = np.argsort(area, kind="stable")
    number = np.uint16 if len(chosen) <= 1 << 16 else np.uint32
    key = build_k_vector(area[order].astype(np.float32))
    return TriangleTable(corners[order].astype(number), key, moment[order].astype(np.float32))


def locally_bright(pairs: PairTable, radius: float, rank: int) -> BoolArray:
    """Return, for each guide star (n,), whether fewer than `rank` brighter stars lie within `radius`, rad.

    The selected stars have about the same density in sparse and in dense regions of the sky.
    """
    start, stop = pairs.angle.ranges(0.0, radius)
    # The second star of a pair has the larger index and is therefore fainter than the first star.
    brighter = np.bincount(pairs.second[start[0] : stop[0]], minlength=pairs.stars)
    return np.asarray(brighter < rank)


def ordered(direction: FloatArray, triangles: IntArray) -> IntArray:
    """Return triangles (t, 3) with the corners ordered by the length of the opposite side, shortest first."""
    sides = side_lengths(direction[triangles])
    return np.take_along_axis(triangles, np.argsort(sides, axis=-1, kind="stable"), axis=-1)


def side_lengths(corners: FloatArray) -> FloatArray:
    """Return the lengths (..., 3) of the sides (chords) opposite the corners of triangles (..., 3, 3)."""
    return np.asarray(np.linalg.norm(np.roll(corners, -1, axis=-2) - np.roll(corners, 1, axis=-2), axis=-1))


def _triangles(pairs: PairTable, chosen: BoolArray, widest: float) -> IntArray:
    """Return all triangles (t, 3) of selected guide stars whose three sides are in the pair table."""
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
"""Minimum distance, in pattern radii, of the neighbouring star that defines the orientation of a grid
pattern. The direction to a closer star would define the orientation of the pattern inaccurately."""


@dataclass(frozen=True, slots=True, eq=False)
class GridTable:
    """Table of the grid patterns of all guide stars, which lists the guide stars for each occupied cell.

    Attributes:
        radius: radius of the patterns, rad.
        aligning: (n,) index of the neighbour that defines the orientation of each guide star's pattern, or -1
            for a star without such a neighbour.
        begin: (cells + 1,) index of the first entry of each cell in `star`.
        star: (m,) indices of guide stars, ordered by cell.
    """

    radius: float
    aligning: npt.NDArray[np.int32]
    begin: npt.NDArray[np.int64]
    star: npt.NDArray[np.int32]

    def votes(self, cells: IntArray) -> IntArray:
        """Return, for each guide star (n,), how many of the given cells (k,) its grid pattern occupies."""
        place, _ = members(self.begin[cells], self.begin[cells + 1])
        return np.bincount(self.star[place], minlength=len(self.aligning))


def build_grid(direction: FloatArray, tree: cKDTree, radius: float) -> GridTable:
    """Return the table of the grid patterns of all guide stars (n, 3); the pattern radius is in rad."""
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
    """Return the positions (k, 2) of stars `others` (k, 3) on the tangent planes at stars `centre` (k,)."""
    z = direction[centre]
    helper = np.where(np.abs(z[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    x = np.cross(helper, z)
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    y = np.cross(z, x)
    height = np.sum(others * z, axis=-1)
    return np.stack([np.sum(others * x, axis=-1) / height, np.sum(others * y, axis=-1) / height], axis=-1)


def cells_of(place: FloatArray, along: FloatArray, radius: float) -> IntArray:
    """Return the grid cells (k,) of positions (k, 2) in tangent planes, with +x towards `along` (k, 2)."""
    unit = along / np.linalg.norm(along, axis=-1, keepdims=True)
    x = np.sum(place * unit, axis=-1)
    y = unit[:, 0] * place[:, 1] - unit[:, 1] * place[:, 0]
    turned = np.stack([x, y], axis=-1) / np.tan(radius)
    column, row = np.clip((0.5 * GRID_CELLS * (turned + 1.0)).astype(np.int64), 0, GRID_CELLS - 1).T
    return np.asarray(row * GRID_CELLS + column)


STARS_IN_FIELD = 24.0
TRIANGLE_STARS_IN_FIELD = 9


class KnownSky:
    """Guide stars for a given field of view, with the tables of their pairs, triangles and grid patterns.

    Attributes:
        index: search index of all guide stars; the indices of stars in identifications refer to this index.
        half_width: (2,) tangents of half the angles of the field of view.
        stars: guide stars brighter than the magnitude at which a field contains 24 guide stars on average.
    """

    def __init__(self, index: SkyIndex, half_width: tuple[float, float]) -> None:
        """Select the guide stars for a field of view with the half-angle tangents `half_width` (2,)."""
        self.index = index
        self.half_width = half_width
        x, y = half_width
        self.solid_angle = 4.0 * math.asin(x * y / math.sqrt((1.0 + x * x) * (1.0 + y * y)))
        self.stars: GuideStars = index.stars.brighter_than(
            faintest_for(index.stars, self.solid_angle, STARS_IN_FIELD)
        )

    @property
    def widest(self) -> float:
        """Largest angle (rad) between two stars in the field of view, which is the diagonal of the field."""
        return 2.0 * math.atan(math.hypot(*self.half_width))

    @cached_property
    def pairs(self) -> PairTable:
        """Table of all guide star pairs that fit into the field of view."""
        return build_pairs(self.stars, self.widest)

    @cached_property
    def tree(self) -> cKDTree:
        """Search tree of the directions to the guide stars."""
        return cKDTree(self.stars.direction)

    @cached_property
    def planar(self) -> TriangleTable:
        """Table of planar triangles of guide stars."""
        return self._triangles(planar_shape)

    @cached_property
    def spherical(self) -> TriangleTable:
        """Table of spherical triangles of guide stars."""
        return self._triangles(spherical_shape)

    @cached_property
    def grid(self) -> GridTable:
        """Table of the grid patterns around all guide stars."""
        return build_grid(self.stars.direction, self.tree, math.atan(min(self.half_width)))

    def _triangles(self, shape: Shape) -> TriangleTable:
        side = 2.0 * math.atan(min(self.half_width))
        # Radius (rad) of a circle with the same solid angle as the field of view.
        radius = math.acos(1.0 - self.solid_angle / (2.0 * math.pi))
        chosen = locally_bright(self.pairs, radius, TRIANGLE_STARS_IN_FIELD)
        return build_triangles(self.stars.direction, self.pairs, chosen, side, shape)
