"""The pyramid (Michalski 3.2.4; Mortari, Samaan, Bruccoleri & Junkins, Navigation 51, 2004).

Triangles are cycled so that no observed star stays in many of them one after the other: a false star spoils
few. A triangle that matches, by the k-vector, becomes a pyramid when a fourth observed star has a guide
star at the right angle from all three corners; only pyramids are candidates, and the fourth star is what
makes chance matches rare.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice

import numpy as np

from knightcube.astro.arrays import IntArray
from knightcube.reference.star_identification.known_sky import KnownSky
from knightcube.reference.star_identification.polygon import matching_triangles, shared, within
from knightcube.reference.star_identification.search import Candidates
from knightcube.reference.star_identification.settings import ClassicalSettings
from knightcube.reference.star_identification.view import View


def propose(view: View, sky: KnownSky, settings: ClassicalSettings) -> Iterator[Candidates]:
    """Yield the pyramids that match, triangle by triangle."""
    for corners in islice(cycled_triangles(view.stars), settings.joins):
        found = matching_triangles(view, sky, corners, settings.tolerance)
        if len(found):
            yield _pyramids(view, sky, corners, found, settings.tolerance)


def cycled_triangles(stars: int) -> Iterator[tuple[int, int, int]]:
    """Yield all triangles of `stars` stars in the source's order: by the steps between their numbers."""
    for step in range(1, stars - 1):
        for further in range(1, stars - step):
            for pivot in range(stars - step - further):
                yield pivot, pivot + step, pivot + step + further


def _pyramids(
    view: View, sky: KnownSky, corners: tuple[int, int, int], found: IntArray, tolerance: float
) -> Candidates:
    """Return the triangles `found` (k, 3) that a fourth star confirms, once for each that does."""
    rest = np.setdiff1d(np.arange(view.stars), corners)
    pivot = np.full(len(rest), corners[0])
    _, low, high = view.angles(pivot, rest, tolerance)
    near, fourth, owner = sky.pairs.between(low, high)
    wanted = np.zeros(len(sky.stars), dtype=bool)
    wanted[found[:, 0]] = True
    kept = wanted[near]
    near, fourth, owner = near[kept], fourth[kept], owner[kept]
    place, of = shared(found[:, 0], near)
    fourth, owner = fourth[place], owner[place]
    alike = np.ones(len(of), dtype=bool)
    for corner in (1, 2):
        _, low, high = view.angles(np.full(len(rest), corners[corner]), rest, tolerance)
        alike &= within(sky, found[of, corner], fourth, low[owner], high[owner])
    triangles, fourth, owner = found[of[alike]], fourth[alike], owner[alike]
    observed = np.column_stack([np.tile(corners, (len(owner), 1)), rest[owner]])
    # One pyramid of each triangle is enough: verification uses the other stars.
    _, once = np.unique(triangles, axis=0, return_index=True)
    return Candidates(observed[once], np.column_stack([triangles, fourth])[once])
