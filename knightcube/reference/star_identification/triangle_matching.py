"""Triangles by area and polar moment (Michalski 3.2.2, 3.2.3; Cole & Crassidis 2004, 2006).

An observed triangle's area, plus and minus its propagated standard deviation, is a range of the table's
k-vector; candidates are the triangles in it whose polar moment and sides, in order of length, agree too: the
order of the sides matches the corners. The sources pivot to a neighbouring triangle when several remain; here
each of them is compared with the field.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import combinations

import numpy as np

from knightcube.astro.arrays import FloatArray, IntArray
from knightcube.reference.star_identification import planar_triangle, spherical_triangle
from knightcube.reference.star_identification.k_vector import members
from knightcube.reference.star_identification.known_sky import KnownSky
from knightcube.reference.star_identification.search import Candidates
from knightcube.reference.star_identification.settings import ClassicalSettings
from knightcube.reference.star_identification.triangle_shape import TriangleShape
from knightcube.reference.star_identification.triangle_table import TriangleTable, ordered, side_lengths
from knightcube.reference.star_identification.view import View

_BATCH = 10
Measure = Callable[[FloatArray, FloatArray], TriangleShape]


def propose_planar(view: View, sky: KnownSky, settings: ClassicalSettings) -> Iterator[Candidates]:
    """Yield the plane triangles that match, see `_propose`."""
    return _propose(view, sky, settings, sky.planar, planar_triangle.measured_shape)


def propose_spherical(view: View, sky: KnownSky, settings: ClassicalSettings) -> Iterator[Candidates]:
    """Yield the spherical triangles that match, see `_propose`."""
    return _propose(view, sky, settings, sky.spherical, spherical_triangle.measured_shape)


def _propose(
    view: View, sky: KnownSky, settings: ClassicalSettings, table: TriangleTable, measure: Measure
) -> Iterator[Candidates]:
    """Yield the matches of some triangles at a time, those of the brightest stars first."""
    chosen = sorted(combinations(range(view.stars), 3), key=lambda corners: corners[::-1])
    triangles = np.array(chosen[: settings.patterns], dtype=np.int64).reshape(-1, 3)
    for begin in range(0, len(triangles), _BATCH):
        batch = ordered(view.direction, triangles[begin : begin + _BATCH])
        found = measure(view.direction[batch], view.sigma[batch])
        yield _matches(view, sky, table, batch, found, settings.tolerance)


def _matches(
    view: View,
    sky: KnownSky,
    table: TriangleTable,
    triangles: IntArray,
    found: TriangleShape,
    tolerance: float,
) -> Candidates:
    """Return the triangles of the table that are like the observed ones (t, 3)."""
    # An area grows as the square of the scale, a polar moment as its fourth power.
    reach = tolerance * found.sigma_area + 2.0 * view.slack * found.area
    # float32 rounds the table's values.
    reach = reach + 1e-7 * found.area
    # The area of a flat triangle is too uncertain.
    usable = np.flatnonzero(reach < 0.2 * found.area)
    low, high = found.area[usable] - reach[usable], found.area[usable] + reach[usable]
    place, owner = members(*table.area.ranges(low, high))
    owner = usable[owner]
    reach = tolerance * found.sigma_moment + (4.0 * view.slack + 1e-7) * found.moment
    alike = np.abs(table.moment[place] - found.moment[owner]) <= reach[owner]
    place, owner = place[alike], owner[alike]
    star, observed = table.corner[place].astype(np.int64), triangles[owner]
    off = side_lengths(sky.stars.direction[star]) - side_lengths(view.direction[observed])
    allowed = tolerance * np.sqrt(2.0) * view.sigma.max() + view.slack * side_lengths(
        view.direction[observed]
    )
    volumes = [np.linalg.det(one) for one in (sky.stars.direction[star], view.direction[observed])]
    alike = np.all(np.abs(off) <= allowed, axis=-1) & (volumes[0] * volumes[1] > 0.0)
    return Candidates(observed[alike], star[alike])
