"""Angle matching (Michalski 3.2.1; Gottlieb in Wertz 1978, 7.7): pairs by angle, triangles of pairs.

The triangles of the brightest observed stars are taken in order of brightness. Pairs of guide stars with
the angle of two sides are joined at the star they share; those whose third angle agrees are candidates.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import numpy as np

from knightcube.reference.star_identification.known_sky import KnownSky
from knightcube.reference.star_identification.polygon import matching_triangles
from knightcube.reference.star_identification.search import Candidates
from knightcube.reference.star_identification.settings import ClassicalSettings
from knightcube.reference.star_identification.view import View


def propose(view: View, sky: KnownSky, settings: ClassicalSettings) -> Iterator[Candidates]:
    """Yield the triangles that match, those of the brightest observed stars first."""
    triangles = sorted(combinations(range(view.stars), 3), key=lambda corners: corners[::-1])
    for corners in triangles[: settings.joins]:
        found = matching_triangles(view, sky, corners, settings.tolerance)
        yield Candidates(np.tile(corners, (len(found), 1)), found)
