"""From candidate patterns to an identification: the part that all classical methods share.

A method yields batches of candidates, observed stars and the guide stars they may be. Each gives an attitude,
the brightest observed stars are carried to the sky by it, and those that fall near guide stars are counted;
the best counts are verified against the whole field, which rejects false candidates of any method.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from knightcube.astro.arrays import FloatArray, IntArray
from knightcube.reference.star_identification.known_sky import KnownSky
from knightcube.reference.star_identification.settings import DEFAULT, ClassicalSettings
from knightcube.reference.star_identification.view import View, views
from knightcube.vision.startracker.identification.field import StarField
from knightcube.vision.startracker.identification.identification import Identification, Status
from knightcube.vision.startracker.identification.verification import nothing, verify_matrix


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """Patterns of observed stars that look like patterns of guide stars.

    Attributes:
        observed: (k, m) numbers of observed stars, m >= 2, the first two far apart: they fix the attitude.
        star: (k, m) numbers of guide stars.
    """

    observed: IntArray
    star: IntArray

    def __len__(self) -> int:
        return len(self.observed)


_LEAST_BASE = 10.0
"""Of a candidate's first two stars, in sigmas of a direction."""
_LEAST_JOINS = 4
Propose = Callable[[View, KnownSky, ClassicalSettings], Iterator[Candidates]]


def search(
    field: StarField, sky: KnownSky, propose: Propose, settings: ClassicalSettings = DEFAULT
) -> Identification:
    """Return the first candidate of `propose` that the whole field verifies, within the budget of work.

    Raises FieldUnknown when the scale of the field is known too badly.
    """
    if len(field) < settings.verification.least_matches:
        return nothing(field, Status.TOO_FEW_STARS)
    steps = list(views(field, settings))
    settings = replace(settings, joins=max(_LEAST_JOINS, settings.joins // len(steps)))
    for view in steps:
        spent = 0
        for candidates in propose(view, sky, settings):
            taken = min(len(candidates), settings.candidates - spent)
            spent += taken
            answer = _best(view, sky, candidates, taken, settings)
            if answer is not None:
                return answer
            if spent >= settings.candidates:
                break
    return nothing(field)


def _best(
    view: View, sky: KnownSky, candidates: Candidates, taken: int, settings: ClassicalSettings
) -> Identification | None:
    """Return the first of the `taken` candidates that holds, those that most stars support first."""
    if not taken:
        return None
    observed, star = candidates.observed[:taken], candidates.star[:taken]
    # Points within their errors of one another fix no attitude, nor does one guide star taken twice.
    base = view.direction[observed[:, 0]] - view.direction[observed[:, 1]]
    apart = np.linalg.norm(base, axis=-1) > _LEAST_BASE * view.sigma.max()
    apart &= star[:, 0] != star[:, 1]
    if not apart.any():
        return None
    observed, star = observed[apart], star[apart]
    matrices = attitudes(view.direction[observed[:, :2]], sky.stars.direction[star[:, :2]])
    support = _support(view, sky, matrices, observed, settings)
    least = min(settings.verification.least_matches, len(view.direction))
    for number in np.argsort(-support, kind="stable")[: settings.verified]:
        if support[number] < least:
            return None
        answer = verify_matrix(
            view.field,
            sky.index,
            matrices[number],
            view.scale,
            settings=settings.verification,
        )
        if answer.status is Status.IDENTIFIED:
            return answer
    return None


def attitudes(observed: FloatArray, reference: FloatArray) -> FloatArray:
    """Return the attitudes (k, 3, 3) that lay pairs (k, 2, 3) on one another, middle on middle."""
    return np.swapaxes(_frames(observed), -1, -2) @ _frames(reference)


def _frames(pairs: FloatArray) -> FloatArray:
    middle = pairs[:, 0] + pairs[:, 1]
    along = pairs[:, 0] - pairs[:, 1]
    middle = middle / np.linalg.norm(middle, axis=-1, keepdims=True)
    along = along / np.linalg.norm(along, axis=-1, keepdims=True)
    return np.stack([middle, along, np.cross(middle, along)], axis=1)


def _support(
    view: View, sky: KnownSky, matrices: FloatArray, observed: IntArray, settings: ClassicalSettings
) -> IntArray:
    """Return how many of the brightest observed stars each attitude (k, 3, 3) lays near a guide star."""
    seen = view.direction[: settings.screened]
    pair = view.direction[observed[:, :2]]
    base = np.linalg.norm(pair[:, 0] - pair[:, 1], axis=-1)
    middle = 0.5 * (pair[:, 0] + pair[:, 1])
    lever = np.linalg.norm(seen[None] - middle[:, None], axis=-1)
    sigma = float(view.sigma.max())
    # The turn that the base's two errors leave acts on the lever; each star has an error of its own.
    gate = settings.tolerance * sigma * np.sqrt(1.5 + 2.0 * (lever / base[:, None]) ** 2)
    gate = np.minimum(gate + view.slack * lever, 0.25 * math.atan(min(sky.half_width)))
    distance, _ = sky.tree.query(seen @ matrices, distance_upper_bound=float(gate.max()))
    return np.asarray((distance <= gate).sum(axis=1))
