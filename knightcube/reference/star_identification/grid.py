"""The grid method (Michalski 3.2.7; Padgett & Kreutz-Delgado, IEEE TAES 33, 1997).

Each observed star's pattern is compared with those of all guide stars by counting the cells occupied in both.
The neighbour that aligns a pattern may be false or its guide star lost, so the next ones are tried too.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from knightcube.astro.arrays import IntArray
from knightcube.reference.star_identification.grid_table import BUFFER, cells_of, tangent_places
from knightcube.reference.star_identification.known_sky import KnownSky
from knightcube.reference.star_identification.search import Candidates
from knightcube.reference.star_identification.settings import ClassicalSettings
from knightcube.reference.star_identification.view import View

_ALIGNMENTS = 3
_BEST = 4
_LEAST_CELLS = 3


def propose(view: View, sky: KnownSky, settings: ClassicalSettings) -> Iterator[Candidates]:
    """Yield the guide stars whose patterns are most like each observed star's, the central first."""
    middle = np.argsort(-view.direction[:, 2], kind="stable")
    for centre in middle[: max(1, settings.patterns // _ALIGNMENTS)]:
        place = tangent_places(view.direction, np.full(len(view.direction), centre), view.direction)
        distance = np.hypot(*place.T)
        radius = np.tan(sky.grid.radius)
        near = np.flatnonzero((distance > 0.0) & (distance < radius))
        aligning = near[distance[near] > BUFFER * radius]
        for neighbour in aligning[np.argsort(distance[aligning])[:_ALIGNMENTS]]:
            others = near[near != neighbour]
            along = np.broadcast_to(place[neighbour], (len(others), 2))
            cells = np.unique(cells_of(place[others], along, sky.grid.radius))
            yield _matches(sky, cells, int(centre), int(neighbour))


def _matches(sky: KnownSky, cells: IntArray, centre: int, neighbour: int) -> Candidates:
    votes = sky.grid.votes(cells)
    best = np.argpartition(-votes, _BEST)[:_BEST]
    best = best[votes[best] >= _LEAST_CELLS]
    best = best[np.argsort(-votes[best], kind="stable")]
    star = np.stack([best, sky.grid.aligning[best].astype(np.int64)], axis=-1)
    return Candidates(np.tile([centre, neighbour], (len(best), 1)), star)
