"""Rounds of the fit: evaluate, solve, move, until the shared parameters have settled."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.special import fdtri

from knightcube.astro.arrays import BoolArray, FloatArray
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks.maximum_likelihood.agreement import agreed_step
from knightcube.vision.streaks.maximum_likelihood.equation_solver import Solution, moved, solve
from knightcube.vision.streaks.maximum_likelihood.exposed_frame import ExposedFrame
from knightcube.vision.streaks.maximum_likelihood.motion import Motion, positions
from knightcube.vision.streaks.maximum_likelihood.normal_equations import ALONE, SHARED, Evaluation, evaluate
from knightcube.vision.streaks.maximum_likelihood.scene import Scene
from knightcube.vision.streaks.maximum_likelihood.settings import LikelihoodSettings
from knightcube.vision.streaks.maximum_likelihood.shutter import Shutter
from knightcube.vision.streaks.maximum_likelihood.windows import Windows, cut_windows
from knightcube.vision.streaks.maximum_likelihood.work import Work

_LONGEST_STEP = 3.0
# An end so far, px, from where its window was cut has left the window's middle.
_DRIFT = 2.0
# Ends of untrusted stars may be farther from it; after the first round in fresh windows by any distance: all
# windows are not cut again for those whose light hardly fixes their place.
_FAINT_DRIFT = 3.2
# The growth may change by this part of the turn before that.
_GROWN = 0.1
# Converged: no shared parameter moves by more than this part of its standard deviation. The step is
# taken, and what it leaves is of second order.
SETTLED = 0.4
# Out of patience, a step that is not so much shorter than the one before ends the rounds.
_LEAST_PROGRESS = 0.7
# After this many rounds the choice of pixels left out is final.
_LOOKS = 1
# Probability of a constant rate being taken for a changing one.
_BY_CHANCE = 1e-4
# Below this part of the limit no closer test is needed.
_FAR_BELOW = 0.5
# The parameters of the change.
_GROWTHS = 3
GROWING = np.ones(SHARED, dtype=np.bool_)
_WIDEST = 6.0
# A joint fit whose point spread grows beyond this many of the first fit's has lost the streaks.
_WIDER = 1.6


@dataclass(frozen=True, slots=True)
class Rounds:
    """How a scene is fitted.

    Attributes:
        rounds: at most.
        clipped: whether pixels far beyond the noise are left out.
        tolerance: steps of an end or the width that are as good as none, px; settled: in deviations.
        conjugate: gradients at most for the pixels that stars share.
        patience: rounds that are spent whether or not they bring the fit on.
    """

    rounds: int
    clipped: bool
    tolerance: float
    settled: float
    conjugate: int
    patience: int


FIRST = Rounds(6, clipped=False, tolerance=0.1, settled=SETTLED, conjugate=4, patience=2)
ROUGH = Rounds(3, clipped=True, tolerance=0.003, settled=1.5, conjugate=6, patience=3)
LAST = Rounds(7, clipped=True, tolerance=0.003, settled=SETTLED, conjugate=12, patience=4)


@dataclass(frozen=True, slots=True, eq=False)
class ExposedCamera:
    """A frame with all that is known of how it was taken.

    Attributes:
        growing: whether the rate may change.
        course: the motion as it is known from elsewhere; None where unknown, or as good as constant.
        work: that was done on the frame.
        sigma: px, of the point spread, where the fit of its width starts.
        sense: (3,) a vector along which the camera turns, not against it; None where either will do.
    """

    frame: ExposedFrame
    pinhole: Pinhole
    shutter: Shutter
    settings: LikelihoodSettings
    sigma: float
    growing: bool = False
    sense: FloatArray | None = None
    course: Motion | None = None
    work: Work = field(default_factory=Work)

    @property
    def free(self) -> BoolArray:
        """Which shared parameters are fitted."""
        return np.array([True] * 3 + [self.growing] * 3 + [True])

    @property
    def undecided(self) -> bool:
        """Whether the pixels are yet to show that the rate changes."""
        return self.settings.rate_model == "auto" and not self.growing

    def windows(self, scene: Scene) -> Windows:
        """Return the pixels about the scene's streaks."""
        return cut_windows(self.frame, self.pinhole, self.shutter, scene, self.settings.reach)

    def evaluate(self, scene: Scene, windows: Windows, clip: float) -> Evaluation:
        """Return the normal equations."""
        self.work.evaluated(len(windows.slot))
        growth = self.growing or (self.undecided and clip > 0.0)
        return evaluate(self.pinhole, self.shutter, scene, windows, clip, growth)


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A scene after its last step, with the equations of that step.

    Attributes:
        windows: its pixels; free: (SHARED,) which shared parameters were fitted.
        restless: the last step of the shared parameters, in standard deviations; 0 when the fit has settled.
        hidden: stars on its pixels that were not fitted, but taken out as they were known; None without.
    """

    scene: Scene
    solution: Solution
    evaluation: Evaluation
    restless: float
    windows: Windows
    free: BoolArray
    hidden: Scene | None = None

    def grows(self) -> bool:
        """Return whether the pixels show that the rate changes: a score test of the constant one.

        The stars' agreement on the change is held against their spread (Hotelling).
        """
        # As if no stars shared pixels first: mostly that decides.
        for conjugate, share in ((0, _FAR_BELOW), (LAST.conjugate, 1.0)):
            solution = solve(self.evaluation, self.scene, GROWING, conjugate)
            if solution is None:
                return False
            agreed, stars = agreed_step(self.evaluation, solution.shared)
            freedom = stars - _GROWTHS
            if freedom < 1:
                return False
            limit = float(fdtri(_GROWTHS, freedom, 1.0 - _BY_CHANCE)) * _GROWTHS * (stars - 1) / freedom
            if agreed <= share * limit:
                return False
        return True


def iterate(
    camera: ExposedCamera, scene: Scene, free: BoolArray, how: Rounds, windows: Windows | None = None
) -> Fit | None:
    """Return the fit after some rounds, None when the stars do not fix the motion."""
    faint_drift, cut_at = _FAINT_DRIFT if windows is None else np.inf, scene
    windows = whole = windows or camera.windows(scene)
    restless, asked, before = np.inf, np.inf, np.zeros(SHARED)
    widest = _WIDER * scene.width if how.clipped else _WIDEST
    solution, evaluation = None, None
    for turn in range(how.rounds):
        evaluation = None  # tens of MB, as is the next
        evaluation = camera.evaluate(scene, windows, camera.settings.clip if how.clipped else 0.0)
        solution = solve(evaluation, scene, free, how.conjugate)
        if solution is None:
            return None
        scene, wanted = moved(scene, solution, camera.pinhole, _LONGEST_STEP)
        if not _possible(scene) or scene.width > widest:
            return None
        deviation = np.sqrt(np.maximum(np.diag(solution.covariance)[free], 1e-30))
        restless = float(np.max(np.abs(solution.shared[free]) / deviation))
        if restless <= how.settled or wanted <= how.tolerance:
            restless = 0.0
            break
        # Steps that lead on in one direction are a long way; those to and fro lead nowhere.
        onward = (
            float(np.sum(solution.shared * before / np.maximum(np.diag(solution.covariance), 1e-30))) > 0.0
        )
        if turn >= how.patience and wanted > _LEAST_PROGRESS * asked and not onward:
            break
        asked, before = wanted, solution.shared
        if _drifted(camera, cut_at, scene, faint_drift if turn == 0 else np.inf):
            del windows, whole  # tens of MB, as are the new ones
            windows = whole = camera.windows(scene)
            cut_at = scene
        elif how.clipped and turn >= _LOOKS:
            # Pixels that come and go as they are left out and taken in would keep the fit from settling.
            windows = whole.only(*evaluation.kept)
    if solution is None or evaluation is None:
        return None
    return Fit(scene, solution, evaluation, restless, whole, free)


def _possible(scene: Scene) -> bool:
    return (
        0.3 < scene.width < _WIDEST
        and bool(np.all(np.isfinite(scene.stars)))
        and float(np.linalg.norm(scene.motion.whole)) <= np.pi
    )


def _drifted(camera: ExposedCamera, before: Scene, after: Scene, faint: float) -> bool:
    """Return whether an end of a streak has left its window's middle; untrusted ones by `faint` px.

    Windows are also cut for where a rate that changes makes the streaks slow.
    """
    grown = float(np.linalg.norm(after.motion.growth - before.motion.growth))
    if grown > _GROWN * float(np.linalg.norm(after.motion.whole)):
        return True
    n = len(before.stars)
    at = np.repeat([-0.5, 0.5], n)
    there = positions(camera.pinhole, after.motion, np.tile(after.stars, (2, 1)), at)
    was = positions(camera.pinhole, before.motion, np.tile(before.stars, (2, 1)), at)
    far = np.abs(there - was).max(axis=1).reshape(2, n).max(axis=0)
    return bool(np.any(far > np.where(after.trusted, _DRIFT, faint)))


def misfit(evaluation: Evaluation) -> float:
    """Return the median chi-square a pixel of the stars."""
    freedom = np.maximum(evaluation.pixels - ALONE - 1.0, 1.0)
    return float(np.median(evaluation.chi2 / freedom))
