"""The result of a fit: what it says of the stars, and whether it says a rate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flight.gnc.math.arrays import BoolArray, FloatArray, IntArray
from flight.gnc.vision.streaks.maximum_likelihood.agreement import disagreement, own_estimates
from flight.gnc.vision.streaks.maximum_likelihood.equation_solver import shared_covariance
from flight.gnc.vision.streaks.maximum_likelihood.iteration import ExposedCamera, Fit
from flight.gnc.vision.streaks.maximum_likelihood.matched_filter import FaintStars
from flight.gnc.vision.streaks.maximum_likelihood.motion import positions, sensitivities
from flight.gnc.vision.streaks.maximum_likelihood.normal_equations import ALONE, Evaluation
from flight.gnc.vision.streaks.maximum_likelihood.result import MotionResult
from flight.gnc.vision.streaks.maximum_likelihood.scene import Scene, path_lengths, window_times
from flight.gnc.vision.streaks.maximum_likelihood.wholeness import Wholeness
from flight.gnc.vision.streaks.streak_result import StreakStatus

# Rounds of conjugate gradients for the covariance.
_CONJUGATE = 12
# Turn, growth, x and y among the shared parameters and a star's own.
_GEOMETRY = np.array([0, 1, 2, 3, 4, 5, 7, 8])
_LIGHT = 9
# The last step, in standard deviations, from which a fit has not settled.
_RESTLESS = 2.0
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
        return replace(result, status=StreakStatus.TOO_FEW)
    exact = shared_covariance(last.evaluation, last.free, _CONJUGATE)
    covariance = (last.solution.covariance if exact is None else exact)[:3, :3]
    turn = scene.motion.whole
    size = float(np.linalg.norm(turn))
    deviation = float(np.sqrt(turn @ covariance @ turn)) / size
    if result.length < settings.least_length or not size > settings.least_significance * deviation:
        return replace(result, status=StreakStatus.TOO_SHORT)
    if last.restless > _RESTLESS or not result.misfit < settings.worst_misfit or whole is Wholeness.BROKEN:
        return replace(result, status=StreakStatus.FAILED)
    estimates = own_estimates(last.evaluation, scene, last.free)
    spread = 1.0 if estimates is None else disagreement(estimates, scene.trusted)
    # What made others disagree is as likely to hide, less of it, in the light of those that agree.
    asked = min(settings.most_stars, len(scene.trusted))
    spread = max(result.misfit, spread, 1.0) * asked / max(int(np.count_nonzero(scene.trusted)), 1)
    return replace(
        result,
        status=StreakStatus.AMBIGUOUS,
        rate=turn / result.exposure,
        # What the model does not explain makes it less certain; what fits too well, no more. A fit that goes
        # to and fro, as pixels are left out and taken in, is known no better than that.
        covariance=covariance * spread * (1.0 + last.restless**2) / result.exposure**2,
        acceleration=scene.motion.growth / result.exposure**2 if last.free[3] else None,
    )


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
