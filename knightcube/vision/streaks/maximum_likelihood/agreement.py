"""Which stars agree about the shared parameters.

A close pair taken for one star is wider or longer than the rest; another's light in a streak shifts its ends.
Each star's own estimate of the shared parameters, with its deviation, shows it: most stars agree, to what
their information allows, and those that do not are no longer trusted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.vision.streaks.maximum_likelihood.equation_solver import eliminate
from knightcube.vision.streaks.maximum_likelihood.normal_equations import SHARED, Evaluation
from knightcube.vision.streaks.maximum_likelihood.scene import Scene

# The error of a median over that of a mean.
_MEDIAN = 1.25


# A star with less than this part of the best one's information is ignored.
_NOTHING = 1e-9
# Of what a star knows a direction that has less than this part of its best known one's is ignored.
_KNOWN = 1e-4
# Stars of unequal weight count as fewer equal ones; fewer than this have no spread.
_LEAST_EFFECTIVE = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class OwnEstimates:
    """Each star's own estimate of the shared parameters: change (n, k) along k directions; deviation."""

    change: FloatArray
    deviation: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class OwnEquations:
    """What each star by itself says of the free shared parameters, its own numbers eliminated.

    Attributes:
        kept: (k,) which shared parameters are free.
        information: (n, k, k); score: (n, k).
    """

    kept: IntArray
    information: FloatArray
    score: FloatArray


def own_estimates(evaluation: Evaluation, scene: Scene, free: BoolArray) -> OwnEstimates | None:
    """Return each star's own estimate of the turn and the width; None when they are not determined."""
    alone = own_equations(evaluation, free)
    return None if alone is None else estimates_of(alone, scene)


def estimates_of(alone: OwnEquations, scene: Scene) -> OwnEstimates:
    """Return each star's own estimate of the turn, along it and across it twice, and of the width.

    All are steps from the scene's; the units are rad, and px for the width.
    """
    axis = scene.motion.whole / max(float(np.linalg.norm(scene.motion.whole)), 1e-12)
    across = np.linalg.svd(axis[None])[2][1:]
    directions = np.zeros((4, SHARED))
    directions[0, :3], directions[1:3, :3], directions[3, 6] = axis, across, 1.0
    directions = directions[:, alone.kept]
    information = np.einsum("ai,nij,aj->na", directions, alone.information, directions)
    informed = information > _NOTHING * information.max(axis=0)
    information = np.where(informed, information, _NOTHING * information.max(axis=0) + 1e-300)
    return OwnEstimates(
        np.where(informed, alone.score @ directions.T / information, 0.0), 1.0 / np.sqrt(information)
    )


def agreed_step(evaluation: Evaluation, step: FloatArray) -> tuple[float, int]:
    """Return by how much, in sigmas squared, the stars together ask for `step` (SHARED,), and how many ask.

    Each star asks for its own part of the step. The spread of what they ask is the measure, where it is more
    than the noise: one star in whose light another's is hidden moves no agreement.
    """
    alone = own_equations(evaluation, step != 0.0)
    if alone is None:
        return 0.0, 0
    part = step[alone.kept]
    asked, due = alone.score @ part, np.einsum("i,nij,j->n", part, alone.information, part)
    count = int(np.count_nonzero(due > 0.0))
    spread = float(np.sum((asked - due) ** 2)) * count / max(count - 1, 1)
    total = float(due.sum())
    return total**2 / max(total, spread, 1e-300), count


def own_equations(evaluation: Evaluation, free: BoolArray) -> OwnEquations | None:
    """Return what each star says of the `free` shared parameters; None when they are not determined."""
    eliminated = eliminate(evaluation, free)
    if eliminated is None:
        return None
    kept, gain = eliminated.kept, eliminated.gain
    cross = evaluation.information[:, SHARED:][:, :, kept]
    schur = evaluation.information[:, kept[:, None], kept] - gain @ cross
    score = evaluation.gradient[:, kept] - np.einsum("nij,nj->ni", gain, evaluation.gradient[:, SHARED:])
    return OwnEquations(kept, schur, score)


def agreeing(estimates: OwnEstimates, floors: FloatArray, sigmas: float) -> BoolArray:
    """Return which stars (n,) agree with most: within `sigmas` of the weighted median in all directions.

    A star in whose light another's is hidden is wider or longer than the rest; `floors` (k,) are added to the
    deviations for what the model does not describe.
    """
    agree = np.ones(len(estimates.change), dtype=np.bool_)
    for change, deviation, floor in zip(estimates.change.T, estimates.deviation.T, floors, strict=True):
        spread = np.hypot(deviation, floor)
        order = np.argsort(change)
        weight = np.cumsum(1.0 / spread[order])
        middle = change[order][np.searchsorted(weight, 0.5 * weight[-1])]
        # The median of few is itself uncertain: a star that knows more than all others is not to yield to it.
        error = _MEDIAN * np.sqrt(len(spread)) / np.sum(1.0 / spread)
        agree &= np.abs(change - middle) <= sigmas * np.hypot(spread, error)
    return agree


def disagreement(estimates: OwnEstimates, which: BoolArray) -> float:
    """Return the chi-square per degree of freedom between stars `which` (n,): 1 when all obey the model."""
    change, weight = estimates.change[which], estimates.deviation[which] ** -2
    if len(change) < 3:
        return 1.0
    total = weight.sum(axis=0)
    mean = np.sum(weight * change, axis=0) / total
    # Each counts by its weight: the spread of a few bright ones is not lost among many faint.
    effective = np.maximum(total**2 / np.sum(weight**2, axis=0), _LEAST_EFFECTIVE)
    found = np.sum(weight**2 * (change - mean) ** 2, axis=0) / total * effective / (effective - 1.0)
    # The largest of several is larger than one, by about a standard deviation.
    return float(np.max(found / (1.0 + np.sqrt(2.0 / (effective - 1.0)))))


def contradiction(alone: OwnEquations) -> float:
    """Return by how much all that the stars say contradicts itself: chi-square per degree of freedom.

    Unlike `disagreement` it counts every direction that a star knows of, each star by its own noise.
    """
    total = alone.information.sum(axis=0)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(total), 1e-300))
    information = alone.information * np.outer(scale, scale)
    step = np.linalg.lstsq(information.sum(axis=0), alone.score.sum(axis=0) * scale, rcond=None)[0]
    values, vectors = np.linalg.eigh(information)
    left = np.einsum("nji,nj->ni", vectors, alone.score * scale - information @ step)
    known = values > _KNOWN * np.maximum(values.max(axis=1, keepdims=True), 1e-300)
    freedom = int(np.count_nonzero(known)) - len(step)
    if freedom < 1:
        return 1.0
    return float(np.sum(left[known] ** 2 / values[known])) / freedom
