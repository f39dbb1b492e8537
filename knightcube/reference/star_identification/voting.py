"""Geometric voting (Michalski 3.2.6; Kolomenkin, Pollak, Shimshoni & Lindenbaum, IEEE TAES 44, 2008).

Every pair of observed stars votes: a guide star with a partner at the pair's angle gets one vote for being
either of the two, however many partners it has (if each counted, crowded parts of the sky would outvote the
true stars from 0.3 px of noise on). The assignments with the most votes then vote among
themselves: those whose angles agree belong together, and the largest such family is the candidate.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.reference.star_identification.known_sky import KnownSky
from knightcube.reference.star_identification.pair_table import angles
from knightcube.reference.star_identification.search import Candidates
from knightcube.reference.star_identification.settings import ClassicalSettings
from knightcube.reference.star_identification.view import View

_VOTERS = 16
_KEPT = 8
_PARTNERS = 3
_FAMILIES = 6


def propose(view: View, sky: KnownSky, settings: ClassicalSettings) -> Iterator[Candidates]:
    """Yield the family of each of the assignments with the most agreement, one pair of it a candidate."""
    voters = min(len(view.direction), _VOTERS)
    one, other = np.triu_indices(voters, 1)
    _, low, high = view.angles(one, other, settings.tolerance)
    ballot = _ballot(voters, one, other, low, high, sky)
    # Several for each observed star: the true one is not always first.
    star = np.argpartition(-ballot, _KEPT, axis=1)[:, :_KEPT].ravel()
    observed = np.repeat(np.arange(voters), _KEPT)
    agrees = _agreement(view, sky, observed, star, settings.tolerance)
    for leader in np.argsort(-agrees.sum(axis=1), kind="stable")[:_FAMILIES]:
        family = np.flatnonzero(agrees[leader])
        if not len(family):
            return
        apart = angles(view.direction[observed[family]], view.direction[observed[leader]])
        partners = family[np.argsort(-apart)[:_PARTNERS]]
        lead = np.full(len(partners), leader)
        yield Candidates(
            np.stack([observed[lead], observed[partners]], axis=-1),
            np.stack([star[lead], star[partners]], axis=-1),
        )


def _ballot(
    voters: int, one: IntArray, other: IntArray, low: FloatArray, high: FloatArray, sky: KnownSky
) -> FloatArray:
    """Return the votes (voters, stars) for each guide star to be each observed star."""
    first, _, owner = sky.pairs.between(low, high)
    in_favour = np.zeros((len(one), len(sky.stars)), dtype=np.float32)
    in_favour[owner, first] = 1.0
    member = np.zeros((voters, len(one)), dtype=np.float32)
    pairs = np.arange(len(one))
    member[one, pairs] = member[other, pairs] = 1.0
    return np.asarray(member @ in_favour)


def _agreement(view: View, sky: KnownSky, observed: IntArray, star: IntArray, tolerance: float) -> BoolArray:
    """Return which assignments (k, k) of observed to guide stars are compatible."""
    count = len(observed)
    one, other = (index.ravel() for index in np.indices((count, count)))
    _, low, high = view.angles(observed[one], observed[other], tolerance)
    direction = sky.stars.direction[star]
    true = angles(direction[one], direction[other])
    # Two observed stars nearer than their errors may have the same guide star for their best.
    different = (observed[one] != observed[other]) & (star[one] != star[other])
    alike = (true >= low) & (true < high) & different
    return np.asarray(alike.reshape(count, count))
