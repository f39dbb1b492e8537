"""Groups edges that may lie on one horizon: cones through pairs or triples, by the number that agree.

Every pair of edges, thinned evenly where there are many, gives a cone of the known half-angle (every triple,
where the altitude is not known); an edge agrees when it lies near the cone and grows brighter towards nadir.
The edges of the best cone are removed and the search goes on, so the terminator, a coast or a band of cloud
becomes a candidate of its own. Sample consensus (Fischler & Bolles 1981) without random choice.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.vision.horizon.cone import nadirs_of_pairs, nadirs_of_triples


@dataclass(frozen=True, slots=True, eq=False)
class EdgeRays:
    """Edges as directions.

    Attributes:
        rays: (n, 3) unit, camera axes.
        brighter: (n, 3) the ray's change over one pixel towards the bright side along the scan line.
        pixel: (n,) rad, the size of a pixel there.
    """

    rays: FloatArray
    brighter: FloatArray
    pixel: FloatArray

    def __len__(self) -> int:
        return len(self.rays)

    def chosen(self, which: BoolArray | IntArray) -> EdgeRays:
        """Return the edges `which`, flags (n,) or indices."""
        return EdgeRays(self.rays[which], self.brighter[which], self.pixel[which])


@dataclass(frozen=True, slots=True, eq=False)
class ConeCandidate:
    """A circular cone and the edges (n,) that agree with it."""

    direction: FloatArray
    cosine: float
    members: BoolArray


def best_cone(
    edges: EdgeRays,
    free: BoolArray,
    cosines: tuple[float, float] | None,
    tolerance: float,
    tries: int,
) -> ConeCandidate | None:
    """Return the cone through `free` edges (n,) with which most of these agree, or None.

    `cosines` is the half-angle's cosine (where known, a range of no width) or its least and greatest;
    `tolerance` is in pixels, `tries` the number of pairs or triples tried.
    """
    chosen = np.flatnonzero(free)
    directions, half_angles = _hypotheses(edges, chosen, cosines, tries)
    if not len(directions):
        return None
    counts = np.count_nonzero(_agreeing(edges.chosen(chosen), directions, half_angles, tolerance), axis=1)
    best = slice(place := int(np.argmax(counts)), place + 1)
    members = _agreeing(edges, directions[best], half_angles[best], tolerance)[0]
    return ConeCandidate(directions[place], float(half_angles[place]), members)


def left_free(edges: EdgeRays, free: BoolArray, cone: ConeCandidate, tolerance: float) -> BoolArray:
    """Return which of the `free` edges (n,) lie on no cone yet, `cone` being the last; see `best_cone`."""
    near = _agreeing(edges, cone.direction[None], np.array([cone.cosine]), 2.0 * tolerance)[0]
    return np.asarray(free & ~near & ~cone.members)


def _hypotheses(
    edges: EdgeRays, free: IntArray, cosines: tuple[float, float] | None, tries: int
) -> tuple[FloatArray, FloatArray]:
    if cosines is not None and cosines[0] == cosines[1]:
        first, second = _pairs(len(free), tries)
        one, other = free[first], free[second]
        directions = nadirs_of_pairs(edges.rays[one], edges.rays[other], cosines[0])
        # A pair that does not agree with its own cone need not be compared with others.
        sides = edges.brighter[one], edges.brighter[other]
        agrees = [np.einsum("kij,ij->ki", directions, side) > 0.0 for side in sides]
        directions = directions[agrees[0] & agrees[1]]
        half_angles = np.full(len(directions), cosines[0])
    else:
        directions, half_angles = nadirs_of_triples(
            *(edges.rays[free[i]] for i in _triples(len(free), tries))
        )
        if cosines is not None:
            outside = (half_angles < cosines[0]) | (half_angles > cosines[1])
            directions[outside] = np.nan
    sound = np.isfinite(directions[:, 0])
    return directions[sound], half_angles[sound]


@lru_cache(maxsize=64)
def _pairs(count: int, tries: int) -> tuple[IntArray, IntArray]:
    """Return two lists of indices below `count`: all pairs, or `tries` of them evenly chosen."""
    first, second = np.triu_indices(count, 1)
    if len(first) > tries:
        chosen = np.linspace(0, len(first) - 1, tries).astype(int)
        first, second = first[chosen], second[chosen]
    return first, second


def _triples(count: int, tries: int) -> tuple[IntArray, IntArray, IntArray]:
    """Return three lists of indices below `count`: strides of all sizes, from every place."""
    number = np.arange(tries)
    first = number % count
    # Two strides that wander through all pairs: multiples of the golden section and of the root of two.
    one = 1 + ((number * 0.6180339887) % 1.0 * (count - 1)).astype(int)
    two = 1 + ((number * 0.4142135624) % 1.0 * (count - 1)).astype(int)
    sound = one != two
    return first[sound], (first + one)[sound] % count, (first + two)[sound] % count


def _agreeing(edges: EdgeRays, directions: FloatArray, cosines: FloatArray, tolerance: float) -> BoolArray:
    """Return (k, n) which edges lie within `tolerance` px of cones (k, 3), (k,), their bright side inside."""
    sines = np.sqrt(np.maximum(1.0 - cosines**2, 1e-6))
    # cos(angle) - cos(rho) is sin(rho) times the distance, near the cone.
    off = directions @ edges.rays.T
    off -= cosines[:, None]
    near = np.abs(off, out=off) <= sines[:, None] * (tolerance * edges.pixel)
    near &= directions @ edges.brighter.T > 0.0
    return near
