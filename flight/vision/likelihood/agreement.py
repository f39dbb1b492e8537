"""Which stars agree about what all share.

A close pair taken for one star is wider or longer than the rest; another's light in a streak shifts its ends.
Each star's own estimate of the shared parameters, with its deviation, shows it: most stars agree, to what
their information allows, and those that do not lose their say.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flight.arrays import BoolArray, FloatArray
from flight.vision.likelihood.normal_equations import SHARED, Evaluation
from flight.vision.likelihood.scene import Scene
from flight.vision.likelihood.solution import eliminate

# The error of a median over that of a mean.
_MEDIAN = 1.25


@dataclass(frozen=True, slots=True, eq=False)
class Opinions:
    """What each star alone says of what all share: change (n, k) along k directions, and its deviation."""

    change: FloatArray
    deviation: FloatArray


def opinions(evaluation: Evaluation, scene: Scene, free: BoolArray) -> Opinions | None:
    """Return each star's own estimate of the turn, along it and across it twice, and of the width.

    All are steps from the scene's; the units are rad, and px for the width.
    """
    eliminated = eliminate(evaluation, free)
    if eliminated is None:
        return None
    kept, gain = eliminated.kept, eliminated.gain
    cross = evaluation.information[:, SHARED:][:, :, kept]
    schur = evaluation.information[:, kept[:, None], kept] - gain @ cross
    score = evaluation.gradient[:, kept] - np.einsum("nij,nj->ni", gain, evaluation.gradient[:, SHARED:])
    axis = scene.motion.turn / max(float(np.linalg.norm(scene.motion.turn)), 1e-12)
    across = np.linalg.svd(axis[None])[2][1:]
    directions = np.zeros((4, SHARED))
    directions[0, :3], directions[1:3, :3], directions[3, 6] = axis, across, 1.0
    directions = directions[:, kept]
    information = np.einsum("ai,nij,aj->na", directions, schur, directions)
    information = np.maximum(information, 1e-300)
    return Opinions(score @ directions.T / information, 1.0 / np.sqrt(information))


def agreeing(said: Opinions, floors: FloatArray, sigmas: float) -> BoolArray:
    """Tell which stars (n,) say the same as most: within `sigmas` of the weighted median in all directions.

    A star in whose light another's is hidden is wider or longer than the rest; `floors` (k,) are added to the
    deviations for what the model does not describe.
    """
    agree = np.ones(len(said.change), dtype=np.bool_)
    for change, deviation, floor in zip(said.change.T, said.deviation.T, floors, strict=True):
        spread = np.hypot(deviation, floor)
        order = np.argsort(change)
        weight = np.cumsum(1.0 / spread[order])
        middle = change[order][np.searchsorted(weight, 0.5 * weight[-1])]
        # The median of few is itself uncertain: a star that knows more than all others is not to yield to it.
        error = _MEDIAN * np.sqrt(len(spread)) / np.sum(1.0 / spread)
        agree &= np.abs(change - middle) <= sigmas * np.hypot(spread, error)
    return agree


def disagreement(said: Opinions, which: BoolArray) -> float:
    """Return the chi-square per degree of freedom between stars `which` (n,): 1 when all obey the model."""
    change, weight = said.change[which], said.deviation[which] ** -2
    if len(change) < 3:
        return 1.0
    mean = np.sum(weight * change, axis=0) / weight.sum(axis=0)
    found = np.sum(weight * (change - mean) ** 2, axis=0) / (len(change) - 1)
    # The largest of several is larger than one, by about a standard deviation.
    return float(np.max(found) / (1.0 + np.sqrt(2.0 / (len(change) - 1))))
