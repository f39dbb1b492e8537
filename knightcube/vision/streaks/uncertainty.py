"""Covariance of the fitted rotation, including errors that the model does not describe.

The covariance due to photon noise alone is a lower limit. The covariance is increased by the scatter of the
stars beyond their noise, and by calibration errors of the camera that the stars do not determine. Two errors
affect all stars equally and therefore cause no scatter. These errors are a point spread function (PSF) with
an unexpected width or profile, which moves the ends of all streaks, and vibration of the body. The residuals
at the streak ends and along the streaks limit the errors from PSF and vibration.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.special import chdtri

from knightcube.astro.arrays import BoolArray, Float32Array, FloatArray
from knightcube.vision.camera.lens import DistortedPinhole
from knightcube.vision.streaks.camera_motion import CameraMotion
from knightcube.vision.streaks.fit_windows import SLOWEST
from knightcube.vision.streaks.geometry import (
    GAUSSIAN,
    PIXEL_VARIANCE,
    StreakScene,
    path_lengths,
    positions,
    sensitivities_and_velocity,
)
from knightcube.vision.streaks.joint_fit import FitProblem, StreakFit, brightest_fit, refit
from knightcube.vision.streaks.normal_equations import (
    ALONE,
    WIDTH,
    StarEquations,
    estimates_of,
    rate_covariance,
    star_equations,
)
from knightcube.vision.streaks.streak_result import LikelihoodSettings, MotionResult
from knightcube.vision.streaks.vibration import (
    CommonMotion,
    StreakResiduals,
    find_common_motion,
    residuals_of_fit,
    vibration_covariance,
)

# Minimum sensitivity of a pixel to a streak's displacement, as a fraction of its block's largest sensitivity.
_LEAST_SENSITIVITY = 0.02


@dataclass(frozen=True, slots=True)
class Displacement:
    """RMS displacement (px) of streaks, or of their ends, that would cause the residuals of the fit.

    The significant displacement `shown` follows from the excess chi-square minus two standard deviations of
    chi-square, and the upper limit `chance` from the excess plus one standard deviation.
    """

    shown: float
    chance: float


def end_displacement(left: StreakResiduals, scene: StreakScene) -> Displacement | None:
    """Return the displacement of streak ends that explains the residuals, or None if no end is visible.

    The errors of a learned profile of the PSF are as large elsewhere on the streaks as at their ends. For a
    learned profile, only residuals that are larger at the ends than elsewhere show a displacement.
    """
    light = scene.light[left.star, None, None].astype(np.float32)
    change = light * (left.images[:, 3] + left.images[:, 4])
    near = _sensitive(left, change)
    elsewhere = (left.weight > 0.0) & ~near
    squares = left.weight * left.residual * left.residual
    usual = float(np.mean(squares[elsewhere], dtype=np.float64)) if elsewhere.any() else 1.0
    if scene.profile == GAUSSIAN:
        usual = min(usual, 1.0)
    return _displacement(left, squares, change, near, usual)


def side_displacement(left: StreakResiduals, scene: StreakScene) -> Displacement | None:
    """Return the displacement across the streaks that explains the residuals, or None without streaks."""
    light = scene.light[left.star, None, None].astype(np.float32)
    change = np.abs(light * left.images[:, 1])
    along = _sensitive(left, change) & ~_sensitive(left, light * (left.images[:, 3] + left.images[:, 4]))
    return _displacement(left, left.weight * left.residual * left.residual, change, along, 1.0)


def _sensitive(left: StreakResiduals, change: Float32Array) -> BoolArray:
    """Return the mask of fitted pixels sensitive to a displacement, given the `change` of their counts."""
    most = change.max(axis=(1, 2), keepdims=True, initial=0.0)
    return np.asarray((left.weight > 0.0) & (change > _LEAST_SENSITIVITY * most))


def _displacement(
    left: StreakResiduals, squares: Float32Array, change: Float32Array, on: BoolArray, usual: float
) -> Displacement | None:
    """Return the displacement that explains the squared residuals `squares` on the pixels of the mask `on`.

    The array `change` contains the derivatives of the counts with respect to the displacement, 1/px. The
    value `usual` is the expected weighted square of a residual if the displacement is zero.
    """
    count = int(np.count_nonzero(on))
    information = float(np.sum((left.weight * change * change)[on], dtype=np.float64))
    if not count or information <= 0.0:
        return None
    beyond = float(np.sum(squares[on], dtype=np.float64)) - count * usual
    chance = float(np.sqrt(2.0 * count))
    shown = float(np.sqrt(max(beyond - 2.0 * chance, 0.0) / information))
    return Displacement(shown, float(np.sqrt((max(beyond, 0.0) + chance) / information)))


# Instants (exposures since mid-exposure) at which paths with and without lens error are compared.
_INSTANTS = np.linspace(-0.5, 0.5, 9)
# Indices of rate and star position among the parameters of `geometry.sensitivities`.
_RATE_AND_POSITION = np.array([0, 1, 2, 6, 7])
# Probability that a calibration error is corrected although the camera has none.
_BY_CHANCE = 1e-5


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationCorrection:
    """Effect of camera calibration errors on the shared parameters of the fit.

    Attributes:
        step: correction of the k fitted parameters (k,), 0 if the calibration errors are not significant.
        added: increase of the covariance (k, k), compared with an exactly known camera.
        described: part of `added` (k, k) due to calibration errors with a specified standard deviation.
        score: gradient of the log-likelihood of each star after the correction (n, k).
        error: most likely values of the m calibration errors, in standard deviations (m,).
    """

    step: FloatArray
    added: FloatArray
    described: FloatArray
    score: FloatArray
    error: FloatArray


def correct(
    information: FloatArray,
    score: FloatArray,
    apparent: FloatArray,
    spread: float,
    described: int,
    counted: FloatArray | None = None,
) -> CalibrationCorrection | None:
    """Return the joint solution for shared parameters and calibration errors, or None if it is singular.

    The information (n, k, k) and the score (n, k) are described in `StarEquations`. The argument `spread` is
    that of `_LensEffect`. Each of m calibration errors of one standard deviation changes each star's estimate
    by `apparent` (n, k, m); the first `described` errors have a specified standard deviation. The fit has
    already corrected the errors `counted` (m,), in standard deviations, and only the remaining errors are
    estimated.
    """
    m = apparent.shape[2]
    known = information / spread
    shared = known.sum(axis=0)
    weighted = known @ apparent
    cross = weighted.sum(axis=0)
    own = np.sum(apparent.swapaxes(1, 2) @ weighted, axis=0) + np.eye(m)
    asked = np.einsum("nkm,nk->m", apparent, score) / spread
    if counted is not None:
        asked = asked - counted
    total = score.sum(axis=0) / spread
    try:
        leading = np.linalg.solve(shared, cross)
        left = own - cross.T @ leading
        error = np.linalg.solve(left, asked - leading.T @ total)
        added, stated = (
            _added(leading[:, :count], left[:count, :count], error[:count]) for count in (m, described)
        )
    except np.linalg.LinAlgError:
        return None
    change = leading @ error
    seen = counted is not None or float((asked - leading.T @ total) @ error) > chdtri(m, _BY_CHANCE)
    remaining = score - np.einsum("nij,nj->ni", information, apparent @ error - change)
    return CalibrationCorrection(seen * -change, added, stated, remaining, error)


def _added(leading: FloatArray, left: FloatArray, error: FloatArray) -> FloatArray:
    """Return the covariance (k, k) due to calibration errors that have the information matrix `left` (m, m).

    The standard deviation of each correction is assumed to equal the correction, because large displacements
    of streaks are underestimated.
    """
    change = leading @ error
    return np.asarray(leading @ np.linalg.inv(left) @ leading.T + np.outer(change, change))


def apparent_rates(camera: FitProblem, scene: StreakScene, exposure: float) -> FloatArray:
    """Return the apparent rate changes (n, 3, m), rad per exposure, of n stars due to m calibration errors.

    Each calibration error has the size of its standard deviation. Exactly known calibration parameters
    are omitted. If the errors are independent and the line time is uncertain, the last of the m errors is the
    error of the line time. A streak determines the position of its path perpendicular to the path, and its
    ends determine the length.
    """
    errors = _error_root(camera)
    n = len(scene.stars)
    if not errors.shape[1]:
        return np.empty((n, 3, 0))
    time, stars = np.repeat(_INSTANTS, n), np.tile(scene.stars, (len(_INSTANTS), 1))
    sensitive, velocity = sensitivities_and_velocity(camera.pinhole, scene.motion, stars, time, growing=False)
    place = positions(camera.pinhole, scene.motion, stars, time)
    away, corner = place - np.array(camera.pinhole.centre), np.hypot(*camera.pinhole.centre)
    cubic = away * (np.sum(away**2, axis=1, keepdims=True) / corner**2)
    moves = [away, np.array([[1.0, 0.0]]), np.array([[0.0, 1.0]]), cubic, velocity / exposure * away[:, 1:]]
    shift = np.stack([np.broadcast_to(move, away.shape) for move in moves], axis=-1) @ errors
    speed = np.maximum(np.linalg.norm(velocity, axis=1, keepdims=True), SLOWEST)
    tangent = velocity / speed
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    ends = np.abs(time) == 0.5

    def determined(of: FloatArray) -> FloatArray:
        across = np.einsum("pi,pij->pj", normal, of).reshape(len(_INSTANTS), n, -1)
        along = np.einsum("pi,pij->pj", tangent[ends], of[ends]).reshape(2, n, -1)
        return np.concatenate([across, along]).swapaxes(0, 1)

    change = determined(sensitive[:, :, _RATE_AND_POSITION])
    return np.asarray((np.linalg.pinv(change) @ determined(shift))[:, :3])


def _error_root(camera: FitProblem) -> FloatArray:
    """Return a square root (5, m) of the covariance of calibration errors, one column per independent error.

    The rows are relative focal length, centre x and y (px), distortion at the corner, and line time (s). If
    the errors are independent and the line time is uncertain, the last column is the error of the line time.
    """
    known = camera.settings.knowledge
    if known.covariance is not None:
        covariance = np.array(known.covariance)
        unit = np.sqrt(np.diag(covariance))
        size, axes = np.linalg.eigh(covariance / np.outer(*[np.maximum(unit, 1e-30)] * 2))
        return np.asarray(unit[:, None] * axes * np.sqrt(np.maximum(size, 0.0)))
    sizes = np.array([known.focal_length, known.centre, known.centre, known.distortion, 0.0])
    sizes[4] = camera.settings.line_time_sigma
    return np.diag(sizes)[:, sizes > 0.0]


def distorted_camera(camera: FitProblem, error: FloatArray) -> FitProblem:
    """Return `camera` with a lens that has calibration errors `error` (m,), given in standard deviations."""
    # The last row contains the errors of the line time, which is not a property of the lens.
    change = _error_root(camera)[:4] @ error
    lens = DistortedPinhole.of(camera.pinhole)
    scale, x, y, cubic = (change + np.array([lens.scale, *lens.shift, lens.cubic])).tolist()
    return replace(camera, pinhole=replace(lens, shift=(x, y), scale=scale, cubic=cubic))


# Minimum relative change of the rate of a motion that starts or ends near rest.
_NEAR_REST = 1.5
# Maximum number of bright streaks that are tested for a reversal of the rotation.
_MOST_STARS = 10
# Sampling step (px) of the intensity along a star's path in the test for a reversal.
_STEP = 0.5
# Margin (px) by which the examined path extends beyond the point at which the star's image is at rest.
_BEFORE = 5.0
# Ratio of the length of the path that is examined for a reversal to the length of the fitted path.
_BEYOND = 1.9
# Half width (px) of the band of pixels around a path that is examined for a reversal.
_ASIDE = 3
# Trial ratios of the shorter to the longer of the durations before and after a reversal of the rotation.
_SHARES = np.concatenate([np.arange(0.15, 0.96, 0.1), [0.97, 0.98, 0.99]])
# Trial ratios of the path length of a reversing motion to the fitted path length.
_LENGTHS = np.concatenate([np.arange(0.95, 1.1, 0.01), np.arange(1.1, 1.71, 0.05)])
# Error of the modelled brightness profile across a star's path, as a fraction of the brightness.
_PROFILE_ERROR = 0.05
# Upper limit of a single star's contribution to the chi-square improvement by a reversal.
_MOST_IMPROVEMENT = 100.0


class _PathLight(NamedTuple):
    """Sums over the pixels of a streak that determine chi-square for any intensity along its path.

    The distances along the path (k,), px, are counted from the point at which the image of the star is at
    rest. A pixel has the counts d, the weight w and the value g of the PSF profile across the path. The
    arrays `square`, `cross` and `plain` are the sums of w g^2, w g d and w g over the pixels nearest to each
    point of the path. The `moments` are the sums of w, w d and w d^2 over all pixels.
    """

    places: FloatArray
    square: FloatArray
    cross: FloatArray
    plain: FloatArray
    moments: tuple[float, float, float]
    pixels: int


def reversal_improvement(camera: FitProblem, scene: StreakScene) -> float:
    """Return the decrease of the bright streaks' chi-square if the rotation reverses during the exposure.

    The decrease is 0 if no reversing rotation fits better, if the rate is far from zero, or if the motion is
    from the navigation filter. For a rate that changes linearly, the intensity along a path is proportional
    to 1/sqrt(s) at a distance of s px from the point of rest. A rotation that reverses covers the first part
    of the path twice, which doubles the intensity there. If the durations before and after the reversal are
    equal, the intensity equals the intensity of a motion from rest, and the pixels do not distinguish the two
    motions.
    """
    motion, change = scene.motion, scene.motion.relative_acceleration
    if abs(change) < _NEAR_REST or motion.higher_terms.any():
        return 0.0
    scene = scene.select(np.flatnonzero(scene.trusted))
    scene = scene.select(np.argsort(-scene.light, kind="stable")[:_MOST_STARS])
    first = -0.5 * np.sign(change)
    rests = positions(camera.pinhole, motion, scene.stars, np.full(len(scene.stars), first))
    onward = CameraMotion.steady(-np.sign(first) * motion.rotation)
    share = (0.5 - 1.0 / abs(change)) / (0.5 + 1.0 / abs(change))
    better = np.zeros((len(_SHARES), len(_LENGTHS)))
    for rest, length in zip(rests, path_lengths(camera.pinhole, motion, scene.stars), strict=True):
        streak = _path_light(camera, onward, rest, float(length), scene.width)
        fitted = _reversal_chi2(streak, np.array([share]), np.array([length]), scene.width)
        others = _reversal_chi2(streak, _SHARES, _LENGTHS * length, scene.width)
        scale = max(1.0, float(min(others.min(), fitted.min())) / max(streak.pixels, 1))
        better += np.clip((fitted - others) / scale, -_MOST_IMPROVEMENT, _MOST_IMPROVEMENT)
    return max(0.0, float(better.max()))


def _path_light(
    camera: FitProblem, onward: CameraMotion, rest: FloatArray, length: float, width: float
) -> _PathLight:
    """Return the sums along the path of a star that starts from rest at the pixel `rest` (2,)."""
    from scipy.spatial import cKDTree  # noqa: PLC0415 - few motions are near rest

    frame, pinhole = camera.frame, camera.pinhole
    places = np.arange(-_BEFORE, _BEYOND * length + _BEFORE, _STEP)
    path = positions(pinhole, onward, np.repeat(rest[None], len(places), axis=0), places / length)
    offset = np.arange(-_ASIDE, _ASIDE + 1)
    x, y = (np.rint(path[:, axis]).astype(np.int64)[:, None, None] for axis in (0, 1))
    x, y = np.broadcast_arrays(x + offset[:, None], y + offset)
    inside = (x >= 0) & (x < pinhole.columns) & (y >= 0) & (y < pinhole.rows)
    index = np.unique(y[inside] * pinhole.columns + x[inside])
    index = index[~frame.bad[index]]
    points = np.stack([index % pinhole.columns, index // pinhole.columns], axis=1)
    # A table of all distances would need gigabytes for a streak of 1000 px.
    nearest = cKDTree(path).query(points)[1]
    apart = np.sum((points - path[nearest]) ** 2, axis=1)
    # Pixels that are nearest to the first or the last sampled point of a path may lie beyond the path.
    kept = (apart < _ASIDE**2) & (nearest > 0) & (nearest < len(places) - 1)
    index, apart, nearest = index[kept], apart[kept], nearest[kept]
    data = frame.signal[index].astype(float)
    bright = np.maximum(data, 0.0)
    weight = 1.0 / (frame.floor[index] + bright / frame.gain + (_PROFILE_ERROR * bright) ** 2)
    across = np.exp(-0.5 * apart / width**2)
    terms = across**2, across * data, across
    square, cross, plain = (np.bincount(nearest, weight * each, len(places)).astype(float) for each in terms)
    moments = float(np.sum(weight)), float(weight @ data), float(weight @ data**2)
    return _PathLight(places, square, cross, plain, moments, len(index))


def _reversal_chi2(one: _PathLight, shares: FloatArray, lengths: FloatArray, width: float) -> FloatArray:
    """Return the chi-square (s, l) of a streak for s x l reversing motions.

    The motion reverses once. The array `shares` (s,) contains ratios of the durations before and after the
    reversal, and `lengths` (l,) the path lengths, px. Flux of the star and sky level are fitted to the pixels
    for each trial motion.
    """
    edges = np.append(one.places, one.places[-1] + _STEP) - 0.5 * _STEP
    # The variable `before` is the flux before each boundary between the samples along the path.
    # A negative ratio of durations describes a motion that starts after the point of rest.
    share, root = shares[:, None, None], np.sqrt(np.clip(edges / lengths[:, None], 0.0, 1.0))
    before = np.maximum(root, -share) + np.minimum(root, np.maximum(share, 0.0)) + np.minimum(share, 0.0)
    light = np.diff(before / (1.0 + share), axis=-1)
    light = gaussian_filter1d(light, width / _STEP, axis=-1, mode="constant")
    square, cross, plain = light**2 @ one.square, light @ one.cross, light @ one.plain
    weight, first, second = one.moments
    determinant = np.maximum(square * weight - plain**2, 1e-30)
    explained = (weight * cross**2 - 2.0 * plain * cross * first + square * first**2) / determinant
    return np.asarray(second - explained)


# Maximum number of conjugate-gradient iterations in the computation of the covariance.
_CONJUGATE = 12
# Error of the rotation, as a fraction of the fitted angular acceleration times the square of the exposure
# time. It is the rms error of a parabola that is fitted to the rotation angle of a body at which a torque
# begins at a random time of the exposure, divided by the rms fitted acceleration.
_TORQUE_STEP = 0.031
# Upper limit (px) of this error. If the acceleration is so large (3 px or more) that the error exceeds the
# limit, other checks mostly reject the frame.
_MOST_OF_STEP = 0.1
# Number of stars up to which their agreement cannot be tested, and the factor of the variance in this case.
_UNCHECKED = (2, 4.0)
# Relative differences between fitted and configured PSF variance that are neglected if the fitted PSF is
# narrower or wider than configured. The second limit is small, because a fast vibration makes streaks wider.
# For a wider PSF, one standard deviation of the difference is neglected in addition.
_NARROWER, _WIDER = 0.02, 0.004
# Ratio of a streak end's error to the square root of the difference of fitted and configured PSF variance.
_END_SHARE = 1.0
# Minimum uncertainty (px) of streak ends whose residuals indicate a displacement.
_END_FLOOR = 0.12
# Minimum uncertainty (px) of streak ends if the profile of the PSF or a vibration was fitted to the frame.
_FITTED_FLOOR = 0.04
# Fraction of the rate's uncertainty that counts as model error if the profile of the PSF was learned.
_LEARNED_SHARE = 0.5
# Ratio of the uncertainty of the streak ends to the significant displacement that explains their residuals.
_END_SHOWN = 1.5
# Ratio of the uncertainty of the streak ends to the upper limit of their displacement.
_END_CHANCE = 0.5
# Error of the streak ends (px) per vibration across the streaks (px) or along them (fraction of brightness).
_END_COMMON = 25.0
# Maximum number of iterations of the lens correction.
_MOST_LENSES = 3
# Remaining calibration error (standard deviations) below which the lens correction counts as converged.
_SMALL_ERROR = 0.2
# Relative uncertainty of the rotation due to lens errors above which the lens is always corrected.
_WORTHWHILE = 0.002
# Ratio of covariance to noise covariance (three sigma) above which the excess counts as model error.
_BEYOND_NOISE = 9.0


@dataclass(frozen=True, slots=True, eq=False)
class RotationUncertainty:
    """The rotation over the exposure and its uncertainty.

    Attributes:
        rotation: rotation vector (3,), corrected for significant calibration errors, rad.
        covariance: covariance (3, 3) of `rotation`, rad^2.
        model_error: uncertainty from model errors, as a fraction of the rotation, without the calibration
            errors of the camera, which are included only in `covariance`.
        common_motion: deviation from the smooth motion that is common to all streaks, such as vibration; 0 if
            `covariance` includes an unresolved vibration.
        aside: displacement of streaks across their paths that would explain the residuals, px, or 0 if the
            misfit is acceptable.
    """

    rotation: FloatArray
    covariance: FloatArray
    model_error: float
    common_motion: CommonMotion
    aside: float


def rotation_uncertainty(result: MotionResult, camera: FitProblem, whole: StreakFit) -> RotationUncertainty:
    """Return the rotation of the camera over the exposure from the fit `whole`, with its uncertainty.

    The argument `result` contains the stars of the fit. The fit may omit faint stars that overlap fitted
    streaks. In that case, the rotation is taken from a second fit, which contains the brightest streaks and
    all faint stars that overlap them.
    """
    camera, whole, lens = _corrected_lens(camera, whole, result.exposure)
    brightest = brightest_fit(camera, whole)
    last = whole if brightest is None else brightest
    scene, settings = last.scene, camera.settings
    noise = rate_covariance(last.evaluation, last.solution.eliminated, last.free, _CONJUGATE)
    if brightest is not None:
        lens = _lens_effect(camera, brightest, result.exposure, lens.counted)
    rotation = scene.motion.rotation + lens.step
    # The cause of the rejection of some stars may also affect the accepted stars to a smaller degree.
    agreed = int(np.count_nonzero(scene.trusted))
    judged = int(np.count_nonzero(scene.light >= scene.light[scene.trusted].min(initial=np.inf)))
    spread = max(result.misfit, lens.spread, _misfit_of_motion(last), 1.0) * max(judged / max(agreed, 1), 1.0)
    if agreed <= _UNCHECKED[0]:
        spread *= _UNCHECKED[1]
    residuals = residuals_of_fit(camera, whole)
    vibration, fast = vibration_covariance(camera, whole.scene, residuals)
    common_motion = find_common_motion(camera, whole.scene, residuals)
    if fast > 0.0:
        # The covariance of the unresolved vibration includes the motion common to all streaks.
        common_motion = CommonMotion()
    end = _end_uncertainty(residuals, whole, settings, result.misfit)
    shaken = _END_COMMON * max(common_motion.across, common_motion.along)
    ends = float(np.sqrt(2.0) * np.hypot(end, shaken) / result.length)
    # If the fit did not converge, the uncertainty includes its last step.
    covariance = noise * spread * (1.0 + last.last_step**2)
    # An error common to all streak ends changes the rotation angle. The axis is assigned the same
    # uncertainty.
    longer = ends**2 * float(rotation @ rotation)
    unmodelled = longer + max(0.0, float(np.trace(covariance - _BEYOND_NOISE * noise)))
    covariance = covariance + lens.added + longer * np.eye(3)
    covariance = covariance + spread * vibration
    if last.free[3]:
        # The torque, for instance of a coil, may have changed abruptly instead of being constant.
        error, most = _TORQUE_STEP * scene.motion.acceleration, _MOST_OF_STEP / camera.pinhole.focal_length
        error *= most / max(float(np.linalg.norm(error)), most)
        covariance = covariance + np.outer(error, error)
    if scene.profile != GAUSSIAN:
        unmodelled = max(unmodelled, _LEARNED_SHARE**2 * float(np.trace(covariance)))
    fits = result.misfit < settings.worst_misfit
    sides = None if fits else side_displacement(residuals, whole.scene)
    model_error, aside = float(np.sqrt(unmodelled / (rotation @ rotation))), sides.shown if sides else 0.0
    return RotationUncertainty(rotation, covariance, model_error, common_motion, aside)


@dataclass(frozen=True, slots=True, eq=False)
class _LensEffect:
    """Effect of calibration errors on the rotation over the exposure, as in `CalibrationCorrection`.

    The correction `step` (3,), rad, and the covariances (3, 3), rad^2, apply to the rotation vector. The fit
    has corrected the calibration errors `counted` (m,), and the errors `error` (m,) remain, both in standard
    deviations.

    Attributes:
        spread: ratio of the variance of the stars' estimates to the variance due to noise alone.
        seen: whether the calibration errors estimated from the stars are significant.
    """

    step: FloatArray
    added: FloatArray
    described: FloatArray
    spread: float
    error: FloatArray
    counted: FloatArray | None
    seen: bool


def _corrected_lens(
    camera: FitProblem, whole: StreakFit, exposure: float
) -> tuple[FitProblem, StreakFit, _LensEffect]:
    """Return camera and fit after a correction of the lens, and the effect of the remaining errors.

    If a lens error displaces the streaks far, its estimate is too small. The fit is therefore repeated with
    the corrected lens until the correction is small. The lens is corrected if the stars show a significant
    lens error, or if the lens errors cause most of the uncertainty.
    """
    first = lens = _lens_effect(camera, whole, exposure, None)
    if not lens.seen and np.trace(lens.described) < _WORTHWHILE**2 * np.sum(whole.scene.motion.rotation**2):
        return camera, whole, lens
    through, fit, error = camera, whole, np.zeros(len(lens.error))
    for _ in range(_MOST_LENSES):
        if not np.any(np.abs(lens.error) > _SMALL_ERROR) or camera.work.exhausted:
            break
        error = error + lens.error
        through = distorted_camera(replace(camera, growing=bool(whole.free[3])), error)
        again = refit(through, fit)
        if again is None:
            return camera, whole, first
        fit = again
        lens = _lens_effect(through, fit, exposure, error)
    return through, fit, lens


def _lens_effect(
    camera: FitProblem, last: StreakFit, exposure: float, counted: FloatArray | None
) -> _LensEffect:
    """Return the effect on the rotation of calibration errors that have not yet been corrected.

    The fit has already corrected the calibration errors `counted` (m,), in standard deviations.
    """
    nothing = np.zeros((3, 3))
    equations = star_equations(last.evaluation, last.solution.eliminated)
    trusted = np.flatnonzero(last.scene.trusted)
    scene = last.scene.select(trusted)
    equations = StarEquations(equations.kept, equations.information[trusted], equations.score[trusted])
    apparent = apparent_rates(camera, scene, exposure)
    spread = _scatter(equations, scene)
    exact = _LensEffect(np.zeros(3), nothing, nothing, spread, np.zeros(0), counted, False)
    if not apparent.shape[2]:
        return exact
    described = apparent.shape[2] - int(camera.settings.shutter_unstated)
    shared = np.zeros((len(trusted), len(equations.kept), apparent.shape[2]))
    shared[:, :3] = apparent
    corrected, before = None, 1.0
    # Differences between the estimates of the stars that are due to calibration errors do not count as noise.
    for _ in range(2):
        corrected = correct(equations.information, equations.score, shared, before, described, counted)
        if corrected is None:
            return exact
        left = replace(equations, score=corrected.score)
        before = max(1.0, min(spread, _scatter(left, scene)))
    assert corrected is not None
    added, stated = corrected.added[:3, :3], corrected.described[:3, :3]
    seen = bool(corrected.step.any())
    return _LensEffect(
        corrected.step[:3], added, stated, before if seen else spread, corrected.error, counted, seen
    )


def _misfit_of_motion(last: StreakFit) -> float:
    """Return the chi-square per degree of freedom of the stars, weighted by their information on the rate.

    A single bright star can determine a component of the rate. In that case, only the residuals of this star
    show the error of the component; the median over all stars and the scatter of the stars do not show it.
    The largest of the values for the three components of the rate is returned.
    """
    trusted = np.flatnonzero(last.scene.trusted)
    equations = star_equations(last.evaluation, last.solution.eliminated)
    _, deviation = estimates_of(equations, last.scene)
    weight = deviation[trusted, :3] ** -2
    freedom = np.maximum(last.evaluation.pixels[trusted] - ALONE - 1.0, 1.0)
    each = last.evaluation.chi2[trusted] / freedom
    return float(np.max(each @ weight / weight.sum(axis=0)))


# Smallest used eigenvalue of a star's information matrix, as a fraction of the largest eigenvalue.
_KNOWN = 1e-4
# Lower limit of the effective number of stars, which is smaller than their number for unequal weights.
_LEAST_EFFECTIVE = 2.0


def _scatter(equations: StarEquations, scene: StreakScene) -> float:
    """Return the ratio of the variance of the stars' estimates to the variance due to noise alone."""
    return max(disagreement(*estimates_of(equations, scene)), contradiction(equations))


def disagreement(change: FloatArray, deviation: FloatArray) -> float:
    """Return the chi-square per degree of freedom of differences between the stars' estimates (n, k)."""
    if len(change) < 3:
        return 1.0
    weight = deviation**-2
    total = weight.sum(axis=0)
    mean = np.sum(weight * change, axis=0) / total
    # The weights are squared, so that many faint stars do not hide the scatter of a few bright stars.
    effective = np.maximum(total**2 / np.sum(weight**2, axis=0), _LEAST_EFFECTIVE)
    found = np.sum(weight**2 * (change - mean) ** 2, axis=0) / total * effective / (effective - 1.0)
    # Without excess scatter, the largest of several reduced chi-squares is about 1 plus one standard
    # deviation.
    return float(np.max(found / (1.0 + np.sqrt(2.0 / (effective - 1.0)))))


def contradiction(alone: StarEquations) -> float:
    """Return the chi-square per degree of freedom of all stars' estimates relative to their joint solution.

    In contrast to `disagreement`, this test uses all combinations of parameters that a star determines, each
    with the noise of that star.
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


def _end_uncertainty(
    left: StreakResiduals, whole: StreakFit, settings: LikelihoodSettings, misfit: float
) -> float:
    """Return the uncertainty (px) of streak ends due to a PSF that may differ from the model.

    If the residuals at the streak ends are not significant, the PSF is assumed to have the modelled profile
    and the same width along and across the streaks. Significant residuals at the streak ends indicate a
    different profile of the PSF or an unresolved fast vibration, which shifts the apparent ends. If a profile
    or a vibration was fitted, the width of the streaks does not limit the errors of their ends.
    """
    scene, described = whole.scene, settings.psf_sigma**2 + PIXEL_VARIANCE
    learned = 2.0 * settings.psf_sigma * settings.knowledge.psf_sigma
    fitted = 2.0 * scene.width * float(np.sqrt(whole.solution.covariance[WIDTH, WIDTH]))
    wider = scene.width**2 - described
    beyond = wider - _WIDER * described - float(np.hypot(fitted, learned))
    beyond = max(beyond, -wider - _NARROWER * described - learned)
    resolved = scene.profile != GAUSSIAN or scene.motion.vibration.exists
    if beyond <= 0.0 and not resolved:
        return 0.0
    another = _END_SHARE * float(np.sqrt(max(beyond, 0.0))) * max(misfit, 1.0)
    ends = end_displacement(left, scene)
    if ends is None:
        return another
    seen = np.hypot(_END_SHOWN * ends.shown, _END_CHANCE * ends.chance)
    if resolved:
        return float(np.hypot(_FITTED_FLOOR, seen))
    return min(another, float(np.hypot(_END_FLOOR, seen)))
