"""What a fit may claim of its turn: its covariance with all that the model does not describe.

Noise gives the least covariance. Stars that disagree beyond their noise widen it. So do errors of the
camera's description, as far as the stars do not show them, and what is common to all stars and shows in no
disagreement: a point spread other than the one described, and a body that shakes. Both leave the ends of the
streaks uncertain by some px, alike for all.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray
from knightcube.vision.streaks.maximum_likelihood.agreement import (
    OwnEquations,
    contradiction,
    disagreement,
    estimates_of,
    own_equations,
)
from knightcube.vision.streaks.maximum_likelihood.equation_solver import turn_covariance
from knightcube.vision.streaks.maximum_likelihood.iteration import ExposedCamera, Fit
from knightcube.vision.streaks.maximum_likelihood.joint_fit import bared_fit, refit
from knightcube.vision.streaks.maximum_likelihood.left_over import (
    LeftOver,
    displaced_ends,
    displaced_sides,
    left_over,
)
from knightcube.vision.streaks.maximum_likelihood.lens_errors import bent_camera, correct, seeming_turns
from knightcube.vision.streaks.maximum_likelihood.result import MotionResult
from knightcube.vision.streaks.maximum_likelihood.scene import PIXEL_VARIANCE, Scene
from knightcube.vision.streaks.maximum_likelihood.shaking import Shaking, find_shaking

# Rounds of conjugate gradients for the covariance.
_CONJUGATE = 12
# Up to this number, stars hardly contradict each other: their variance counts by the factor.
_UNCHECKED = (2, 4.0)
# Fitted and described point spread are the same when their variances differ by this part.
_SAME_SPREAD = 0.05
# Ends are uncertain by this part of the square root of the difference of the variances;
_END_SHARE = 0.6
# where streaks show them, at most by this floor, px, and by these shares of the displacement that the light
# left over about them amounts to: beyond chance, and with it.
_END_FLOOR = 0.12
_END_SHOWN = 1.5
_END_CHANCE = 0.5
# Px by which ends are uncertain for each px, or unit of brightness, that all streaks waver in common.
_END_SHAKING = 25.0
# The lens is corrected so often at most, as long as an error of it is more than this part of its deviation,
# where it leaves the turn uncertain by this part of it, unless the stars show it.
_MOST_LENSES = 3
_SMALL_ERROR = 0.2
_WORTH = 0.002
# A covariance beyond this many times that of noise is by errors of the model: three deviations.
_BEYOND_NOISE = 9.0


@dataclass(frozen=True, slots=True, eq=False)
class Claim:
    """What is known of the turn.

    Attributes:
        turn: (3,) rad, corrected for the camera's errors where the stars show them.
        covariance: (3, 3) rad^2.
        doubt: share of the turn to which errors of the model leave it uncertain, as a vector: common to all
            stars or not. A shutter that nobody described is not counted: the covariance says all of it.
        shaking: of the body.
        aside: px across the streaks, what the model leaves over there as a displacement.
    """

    turn: FloatArray
    covariance: FloatArray
    doubt: float
    shaking: Shaking
    aside: float


def claim(result: MotionResult, camera: ExposedCamera, whole: Fit) -> Claim:
    """Return what the `whole` fit may claim of its turn; `result` has its stars.

    Where stars are hidden in the streaks, the turn is that of the brightest, fitted with those.
    """
    camera, whole, lens = _straightened(camera, whole, result.exposure)
    bared = bared_fit(camera, whole)
    last = whole if bared is None else bared
    scene, settings = last.scene, camera.settings
    exact = turn_covariance(last.evaluation, last.free, _CONJUGATE)
    noise = last.solution.covariance[:3, :3] if exact is None else exact
    if bared is not None:
        lens = _with_lens(camera, bared, result.exposure, lens.counted)
    turn = scene.motion.whole + lens.step
    # What made others disagree is as likely to hide, less of it, in the light of those that agree.
    agreed = int(np.count_nonzero(scene.trusted))
    asked = int(np.count_nonzero(scene.light >= scene.light[scene.trusted].min(initial=np.inf)))
    spread = max(result.misfit, lens.spread, 1.0) * max(asked / max(agreed, 1), 1.0)
    if agreed <= _UNCHECKED[0]:
        spread *= _UNCHECKED[1]
    left = left_over(camera, whole)
    shaking = find_shaking(camera, whole.scene, left)
    end = np.hypot(
        _spread_doubt(left, whole.scene, settings.psf_sigma, result.misfit),
        _END_SHAKING * max(shaking.across, shaking.along),
    )
    ends = float(np.sqrt(2.0) * end / result.length)
    # What the model does not explain makes it less certain; what fits too well, no more. A fit that goes
    # to and fro, as pixels are left out and taken in, is known no better than that.
    covariance = noise * spread * (1.0 + last.restless**2)
    longer = ends**2 * float(turn @ turn)
    # Ends that are alike uncertain make the turn longer or shorter; the covariance leaves room for its axis.
    common = float(np.trace(lens.described)) + longer
    unmodelled = max(common, common + float(np.trace(covariance - _BEYOND_NOISE * noise)))
    covariance = covariance + lens.added + longer * np.eye(3)
    return Claim(
        turn, covariance, float(np.sqrt(unmodelled / (turn @ turn))), shaking, _aside(left, whole.scene)
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Lens:
    """What errors of the camera's description make of the turn.

    Attributes:
        step: (3,), its correction; added, described: (3, 3), as of `Correction`.
        spread: of the stars, in that of the noise.
        error: (m,) as of `Correction`, beside those that the fit knew, `counted` (m,), None without; seen:
            whether the stars show them.
    """

    step: FloatArray
    added: FloatArray
    described: FloatArray
    spread: float
    error: FloatArray
    counted: FloatArray | None
    seen: bool


def _straightened(camera: ExposedCamera, whole: Fit, exposure: float) -> tuple[ExposedCamera, Fit, _Lens]:
    """Return camera and fit with the likeliest errors of the lens, and what is left of them in the turn.

    Streaks that are displaced by much of their width ask for too small a correction: the fit goes on through
    the lens that they ask for, until they ask no more. It is worth its time where the stars show that the
    lens is another, and where not to know it is most of the doubt.
    """
    first = lens = _with_lens(camera, whole, exposure, None)
    if not lens.seen and np.trace(lens.described) < _WORTH**2 * np.sum(whole.scene.motion.whole**2):
        return camera, whole, lens
    through, fit, error = camera, whole, np.zeros(len(lens.error))
    for _ in range(_MOST_LENSES):
        if not np.any(np.abs(lens.error) > _SMALL_ERROR) or camera.work.exhausted:
            break
        error = error + lens.error
        through = bent_camera(replace(camera, growing=bool(whole.free[3])), error)
        again = refit(through, fit)
        if again is None:
            return camera, whole, first
        fit = again
        lens = _with_lens(through, fit, exposure, error)
    return through, fit, lens


def _with_lens(camera: ExposedCamera, last: Fit, exposure: float, counted: FloatArray | None) -> _Lens:
    """Return what errors of the camera's description make of the turn, beside those `counted` (m,)."""
    nothing = np.zeros((3, 3))
    equations = own_equations(last.evaluation, last.free)
    if equations is None:
        return _Lens(np.zeros(3), nothing, nothing, 1.0, np.zeros(0), counted, False)
    trusted = np.flatnonzero(last.scene.trusted)
    scene = last.scene.select(trusted)
    equations = OwnEquations(equations.kept, equations.information[trusted], equations.score[trusted])
    seeming = seeming_turns(camera, scene, exposure)
    spread = _spread(equations, scene)
    exact = _Lens(np.zeros(3), nothing, nothing, spread, np.zeros(0), counted, False)
    if not seeming.shape[2]:
        return exact
    described = seeming.shape[2] - int(camera.settings.shutter_unstated)
    shared = np.zeros((len(trusted), len(equations.kept), seeming.shape[2]))
    shared[:, :3] = seeming
    corrected, before = None, 1.0
    # The part of the disagreement that the camera's errors explain is not counted as noise.
    for _ in range(2):
        corrected = correct(equations.information, equations.score, shared, before, described, counted)
        if corrected is None:
            return exact
        left = replace(equations, score=corrected.score)
        before = max(1.0, min(spread, _spread(left, scene)))
    assert corrected is not None
    added, stated = corrected.added[:3, :3], corrected.described[:3, :3]
    seen = bool(corrected.step.any())
    return _Lens(
        corrected.step[:3], added, stated, before if seen else spread, corrected.error, counted, seen
    )


def _spread(equations: OwnEquations, scene: Scene) -> float:
    """Return by how much the stars contradict each other, in the variance of their noise."""
    everyone: BoolArray = np.ones(len(scene.light), dtype=np.bool_)
    return max(disagreement(estimates_of(equations, scene), everyone), contradiction(equations))


def _spread_doubt(left: LeftOver, scene: Scene, sigma: float, misfit: float) -> float:
    """Return by how many px the ends of streaks are uncertain by a point spread other than `sigma` px.

    Where the fit leaves nothing over about the ends the point spread is as wide along the streaks as across
    them, and of the model's shape, however wide. What is left over there may be another shape, or the light
    of a body that shakes too fast to be seen, whose ends are farther off than they seem.
    """
    described = sigma**2 + PIXEL_VARIANCE
    beyond = abs(scene.width**2 - described) - _SAME_SPREAD * described
    if beyond <= 0.0:
        return 0.0
    another = _END_SHARE * float(np.sqrt(beyond)) * max(misfit, 1.0)
    ends = displaced_ends(left, scene)
    if ends is None:
        return another
    seen = np.hypot(_END_SHOWN * ends.shown, _END_CHANCE * ends.chance)
    return min(another, float(np.hypot(_END_FLOOR, seen)))


def _aside(left: LeftOver, scene: Scene) -> float:
    sides = displaced_sides(left, scene)
    return 0.0 if sides is None else sides.shown
