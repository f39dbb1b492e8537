"""The result of a fit: what it says of the stars, and whether it says a rate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.vision.streaks.maximum_likelihood.claim import Claim, claim
from knightcube.vision.streaks.maximum_likelihood.iteration import ExposedCamera, Fit
from knightcube.vision.streaks.maximum_likelihood.matched_filter import FaintStars
from knightcube.vision.streaks.maximum_likelihood.motion import positions, sensitivities
from knightcube.vision.streaks.maximum_likelihood.normal_equations import ALONE, Evaluation
from knightcube.vision.streaks.maximum_likelihood.result import MotionResult
from knightcube.vision.streaks.maximum_likelihood.scene import Scene, path_lengths, window_times
from knightcube.vision.streaks.maximum_likelihood.turning_back import turning_back
from knightcube.vision.streaks.maximum_likelihood.wholeness import Wholeness
from knightcube.vision.streaks.streak_result import StreakStatus

# Turn, growth, x and y among the shared parameters and a star's own.
_GEOMETRY = np.array([0, 1, 2, 3, 4, 5, 7, 8])
_LIGHT = 9
# The last step, in standard deviations, from which a fit has not settled.
_RESTLESS = 2.0
# A motion that turned back within the exposure must explain the streaks better by this many sigmas squared.
_TURNED_BACK = 30.0
# Streaks so close, px, and as bright as this part of one run beside it; a sky has few such pairs.
_BESIDE = 8.0
_LIKE = 0.3
_MOST_PAIRED = 0.4
# Two streaks so close, px, are one.
_SAME = 1.5


def with_stars(seen: MotionResult, camera: ExposedCamera, last: Fit) -> MotionResult:
    """Return `seen` with the stars of the fit, their ends, and their covariances."""
    settings, joint = camera.settings, last.solution.joint
    significance = last.scene.light / np.sqrt(np.maximum(joint[:, _LIGHT, _LIGHT], 1e-30))
    kept = np.flatnonzero(significance > settings.faint_sigmas)
    kept = kept[_distinct(last.scene.stars[kept], last.scene.light[kept])]
    scene, joint, significance = last.scene.select(kept), joint[kept], significance[kept]
    n = len(kept)
    geometry = joint[:, _GEOMETRY[:, None], _GEOMETRY]
    endpoints, covariances = np.empty((n, 2, 2)), np.empty((n, 2, 2, 2))
    for end, times in enumerate(_times(camera, scene, scene.stars).T):
        endpoints[:, end] = positions(camera.pinhole, scene.motion, scene.stars, times)
        change = sensitivities(camera.pinhole, scene.motion, scene.stars, times)
        covariances[:, end] = change @ geometry @ change.swapaxes(1, 2)
    used = scene.trusted
    length = path_lengths(camera.pinhole, scene.motion, scene.stars)
    moments = (endpoints[:, 0], scene.stars, endpoints[:, 1])
    spread = float(np.sqrt(np.median(np.trace(covariances[:, 0], axis1=1, axis2=2)))) if n else float("nan")
    return replace(
        seen,
        length=float(np.median(length[used])) if used.any() else float("nan"),
        endpoints=endpoints,
        used=used,
        stars=scene.stars,
        star_covariance=joint[:, 7:9, 7:9],
        endpoint_covariance=covariances,
        directions=np.stack([camera.pinhole.unit_vectors(points) for points in moments], axis=1),
        flux=scene.light,
        significance=significance,
        psf_sigma=scene.sigma,
        misfit=_misfit(last.evaluation, kept, significance),
        rate_model="accelerating" if last.free[3] else "constant",
        residual=spread / camera.pinhole.focal_length,
    )


def with_rate(result: MotionResult, camera: ExposedCamera, last: Fit, whole: Wholeness) -> MotionResult:
    """Return `result` with the rate, or with why there is none."""
    settings, scene = camera.settings, last.scene
    if result.used_count < settings.least_stars:
        why = f"{result.used_count} streaks agree, {settings.least_stars} at least are needed"
        return replace(result, status=StreakStatus.TOO_FEW, reason=why)
    known = claim(result, camera, last)
    size = float(np.linalg.norm(known.turn))
    deviation = float(np.sqrt(known.turn @ known.covariance @ known.turn)) / size
    still = not size > settings.least_significance * deviation
    reason = _why_not(result, camera, last, whole, known)
    if result.length < settings.least_length or (still and not reason):
        why = f"streaks of {result.length:.1f} px are too short for a rate"
        return replace(result, status=StreakStatus.TOO_SHORT, reason=why)
    if reason:
        return replace(result, status=StreakStatus.FAILED, reason=reason)
    return replace(
        result,
        status=StreakStatus.AMBIGUOUS,
        rate=known.turn / result.exposure,
        covariance=known.covariance / result.exposure**2,
        acceleration=scene.motion.growth / result.exposure**2 if last.free[3] else None,
    )


def _why_not(result: MotionResult, camera: ExposedCamera, last: Fit, whole: Wholeness, known: Claim) -> str:
    """Return why a motion that was fitted is not believed, in a line; empty when it is."""
    settings, shaking = camera.settings, known.shaking
    checks = (
        (last.restless > _RESTLESS, "the fit does not settle"),
        (
            not result.misfit < settings.worst_misfit and not known.aside < settings.worst_aside,
            f"the streaks are unlike the model: misfit {result.misfit:.1f}",
        ),
        (whole is Wholeness.BROKEN, "the motion makes pieces of streaks, or joins several"),
        (
            max(shaking.across, shaking.along) > settings.worst_shaking,
            f"the body shook: all streaks waver by {shaking.across:.2f} px across and "
            f"{100.0 * shaking.along:.0f} % in brightness",
        ),
        (
            _paired(result) > _MOST_PAIRED,
            "most streaks run beside another: the body shook, or the point spread is hollow",
        ),
        (
            known.doubt > settings.worst_doubt,
            f"uncertain by {100.0 * known.doubt:.1f} %: streaks disagree, lens or shutter are not known well "
            f"enough, or the point spread, {result.psf_sigma / settings.psf_sigma:.2f} times as wide as "
            "described",
        ),
    )
    reason = next((reason for failed, reason in checks if failed), "")
    if not reason and turning_back(camera, last.scene) > _TURNED_BACK:
        return "the motion turned back within the exposure"
    return reason


def _paired(result: MotionResult) -> float:
    """Return what part of the used stars has another, not much fainter, beside it.

    The light of a body that shakes many times in an exposure gathers where the motion turns round, on either
    side of each path.
    """
    apart = np.linalg.norm(result.stars[result.used, None] - result.stars, axis=2)
    rival = result.flux > _LIKE * result.flux[result.used, None]
    return float(np.mean((rival & (apart > 0.0) & (apart < _BESIDE)).any(axis=1)))


def with_faint(result: MotionResult, camera: ExposedCamera, scene: Scene, faint: FaintStars) -> MotionResult:
    """Return `result` with the streaks that were only found along the motion."""
    times = _times(camera, scene, faint.stars)
    ends = [positions(camera.pinhole, scene.motion, faint.stars, time) for time in times.T]
    return replace(
        result,
        faint_endpoints=np.stack(ends, axis=1),
        faint_flux=faint.light,
        faint_significance=faint.significance,
    )


def _times(camera: ExposedCamera, scene: Scene, stars: FloatArray) -> FloatArray:
    return window_times(camera.pinhole, scene.motion, camera.shutter, stars)


def _distinct(stars: FloatArray, light: FloatArray) -> BoolArray:
    """Return which stars (n, 2) have no brighter one in the same place: a fit may move one into another."""
    near = np.linalg.norm(stars[:, None] - stars, axis=2) < _SAME
    return np.asarray(~(near & (light > light[:, None])).any(axis=1))


def _misfit(evaluation: Evaluation, kept: IntArray, significance: FloatArray) -> float:
    """Return the median chi-square per degree of freedom of the ten most significant stars."""
    leading = kept[np.argsort(-significance, kind="stable")[:10]]
    if not len(leading):
        return float("nan")
    freedom = np.maximum(evaluation.pixels[leading] - ALONE - 1.0, 1.0)
    return float(np.median(evaluation.chi2[leading] / freedom))
