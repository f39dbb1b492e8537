"""Estimation of the camera's motion during one exposure from all pixels of all star streaks.

The bright regions of the frame give initial guesses of the motion, and each guess is fitted to the brightest
stars. A matched filter along each fitted motion detects faint stars. The final estimate is a joint fit of the
motion and the bright stars, with a model that includes the flux of the faint stars. A final check verifies
that each modelled streak matches one complete streak in the frame. If the fitted rotation is too small, a
streak is modelled as several segments. If the fitted rotation is too large, several streaks are modelled as
one streak. All functions of this module are pure and deterministic.

With a rolling shutter, a star that moves in the readout direction is exposed longer than a star that moves
against it. Under a rolling shutter, a motion and its time reversal produce streaks of different lengths. A
prior rate determines the sign of the rotation before the fit. Without a prior rate, both signs of the
rotation are fitted, and the better fit is selected. If neither sign of the rotation fits significantly
better, the sign remains unknown, and the rate is the mean of one fitted rate and the negative of the other
fitted rate. The covariance of the averaged rate includes the difference between the two fits.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum
from itertools import chain, islice
from typing import get_args

import numpy as np
from numpy.typing import ArrayLike

from knightcube.astro.arrays import BoolArray, FloatArray, Image, brief, finite_array
from knightcube.errors import ArgumentError
from knightcube.vision.camera.lens import (
    CameraModel,
    Pinhole,
    check_knowledge,
    image_of_camera,
    streak_camera,
)
from knightcube.vision.frame import check_detector, raw_counts, saturation_count
from knightcube.vision.streaks.camera_motion import CameraMotion
from knightcube.vision.streaks.faint_stars import FaintStars
from knightcube.vision.streaks.first_fits import (
    LIGHT,
    alike,
    first_fits,
    fits_near_angles,
    has_angle,
    likely_angles,
    with_vibration,
)
from knightcube.vision.streaks.first_guess import (
    guess_axis,
)
from knightcube.vision.streaks.frame import BrightRegions, PreparedFrame, prepare_frames
from knightcube.vision.streaks.geometry import (
    GAUSSIAN,
    Course,
    Shutter,
    StreakScene,
    azimuth_differences,
    complete_streaks,
    exposure_bounds,
    path_lengths,
    polar_angles,
    positions,
    sensitivities,
)
from knightcube.vision.streaks.joint_fit import (
    LAST,
    FitProblem,
    StreakFit,
    WorkBudget,
    final_fit,
    iterate,
    misfit,
    refit,
    trailing_fraction,
    true_ends,
    unbroken,
)
from knightcube.vision.streaks.psf_profile import fit_profile
from knightcube.vision.streaks.streak_result import (
    REASONS,
    LikelihoodSettings,
    MotionResult,
    RateModel,
    StreakStatus,
    admit,
    direction_of_time,
    in_time,
    validate,
)
from knightcube.vision.streaks.uncertainty import (
    RotationUncertainty,
    reversal_improvement,
    rotation_uncertainty,
)
from knightcube.vision.streaks.vibration import fit_vibration

# Maximum number of iterations of the fit for a camera at rest.
_STILL_ROUNDS = 12


def still_fit(camera: FitProblem, regions: BrightRegions) -> StreakFit | None:
    """Return a fit of star positions, fluxes and the point-spread width for a camera at rest."""
    count = min(len(regions), camera.settings.most_stars)
    still = CameraMotion.steady(np.zeros(3))
    scene = StreakScene.of(still, camera.sigma, regions.centre[:count], regions.flux[:count])
    free = np.array([False] * 6 + [True])
    return iterate(camera, scene, free, replace(LAST, rounds=_STILL_ROUNDS))


# Largest accepted fraction of stars that seem to be segments of a longer streak.
_MOST_CHAINED = 0.45
# Minimum fractions of confirmed streak ends for an accepted motion (first) and a doubtful motion (second).
_TRUE_ENDS = (0.75, 0.6)
# Largest fractions of streaks with gaps for an accepted motion (first) and a doubtful motion (second).
_BROKEN = (0.12, 0.35)
# Minimum number of streaks with two confirmed ends for which gaps in other streaks are tolerated.
_CONFIRMING = 3
# Minimum fraction of the flux of complete streaks that belongs to streaks consistent with the motion.
_AGREEING_LIGHT = 0.5
# Relative change of the rate during the exposure above which streaks are tested for flux beyond their ends.
_UNEVEN = 0.4
# Largest accepted fraction of stars with flux beyond a streak end.
_MOST_TRAILING = 0.5
# Largest distance (px) across the streak between two segments of one streak.
_CHAIN_ASIDE = 1.3
# Smallest and largest angle between two segments of one streak, as fractions of the rotation angle.
_CHAIN_APART = (0.55, 1.7)
# Largest flux ratio of two segments of one streak.
_CHAIN_RATIO = 2.5


class StreakVerdict(Enum):
    """Result of the streak check, which tests a motion by the ends of its streaks and by gaps in them."""

    CONFIRMED = "confirmed"
    DOUBTFUL = "doubtful"
    REJECTED = "rejected"


def check_streaks(camera: FitProblem, scene: StreakScene, faint: FaintStars) -> StreakVerdict:
    """Return the result of the streak check: whether the streaks of a motion have confirmed ends and no gaps.

    In a frame with many stars, a streak may be a blend of several stars. A motion is doubtful if some streaks
    have gaps or wrong ends, unless enough other streaks have two confirmed ends. A motion is also doubtful if
    no streak has both ends in the frame, or if most flux of complete streaks contradicts the motion. A motion
    is rejected if too many streaks have gaps, wrong ends or faint trails, or are parts of longer streaks.
    """
    stars = np.concatenate([scene.stars, faint.stars])
    light = np.concatenate([scene.light, faint.light])
    chained = chained_stars(camera.pinhole, scene.motion, stars, light, len(scene.stars))
    if float(np.mean(chained[scene.trusted])) > _MOST_CHAINED:
        return StreakVerdict.REJECTED
    deciding = scene.select(scene.trusted)
    ends, lit = true_ends(camera, deciding), unbroken(camera, deciding)
    known = np.isfinite(ends)
    # The ends of short streaks cannot be confirmed, but the pixels beyond them must be dark.
    uneven = abs(scene.motion.relative_acceleration) > _UNEVEN
    if (uneven or not known.any()) and trailing_fraction(camera, deciding) > _MOST_TRAILING:
        return StreakVerdict.REJECTED
    both = known.all(axis=1)
    right = float(np.mean(ends[known])) if known.any() else 1.0
    if both.any() and float(np.mean(ends[both])) < _TRUE_ENDS[1]:
        return StreakVerdict.REJECTED
    in_place = ends[both].all(axis=1)
    confirmed = np.count_nonzero(in_place) >= _CONFIRMING and float(np.mean(in_place)) >= _TRUE_ENDS[0]
    dark = np.count_nonzero(lit == 0.0)
    verdicts = StreakVerdict.REJECTED, StreakVerdict.DOUBTFUL
    for worst, least_ends, most_broken in zip(verdicts, _TRUE_ENDS[::-1], _BROKEN[::-1], strict=True):
        if right < least_ends or dark > max(1.0, most_broken * len(lit)):
            return StreakVerdict.CONFIRMED if confirmed and worst is StreakVerdict.DOUBTFUL else worst
    unconfirmed = bool(known.any()) and not both.any()
    doubted = unconfirmed or (not confirmed and _most_disagree(camera, scene))
    return StreakVerdict.DOUBTFUL if doubted else StreakVerdict.CONFIRMED


def chained_stars(
    pinhole: Pinhole, motion: CameraMotion, stars: FloatArray, light: FloatArray, judged: int
) -> BoolArray:
    """Return a mask (judged,) of those of the first `judged` stars that seem to be segments of streaks.

    If the assumed rotation is too small, each streak is modelled as a chain of shorter streaks of equal flux
    on one circle about the rotation axis, and each short streak fits its pixels as well as a complete streak.
    Different stars rarely form a chain of equal segments by chance.
    """
    polar, azimuth = polar_angles(pinhole, motion, stars)
    one, other = np.nonzero(np.abs(polar[:judged, None] - polar) < _CHAIN_ASIDE / pinhole.focal_length)
    rotations = azimuth_differences(azimuth[one], azimuth[other])
    rotations = rotations / max(float(np.linalg.norm(motion.rotation)), 1e-12)
    ratio = light[one] / np.maximum(light[other], 1e-9)
    joined = (rotations > _CHAIN_APART[0]) & (rotations < _CHAIN_APART[1])
    joined &= (ratio < _CHAIN_RATIO) & (ratio > 1.0 / _CHAIN_RATIO)
    return np.bincount(one[joined], minlength=judged) > 0


def _most_disagree(camera: FitProblem, scene: StreakScene) -> bool:
    """Return whether most flux of bright, complete streaks belongs to stars that contradict the motion."""
    inside = complete_streaks(camera.pinhole, scene.motion, camera.shutter, scene.stars)
    # Stars fainter than all stars in the fit are ignored, because they were not compared with the motion.
    bright = inside & (scene.light >= scene.light[scene.trusted].min())
    # Errors of lens and shutter exclude bright stars from the fit although their streaks end in place.
    excluded = np.flatnonzero(bright & ~scene.trusted)
    if not len(excluded):
        return False
    in_place = (true_ends(camera, scene.select(excluded)) == 1.0).all(axis=1)
    wrong = float(scene.light[excluded[~in_place]].sum())
    return wrong > (1.0 - _AGREEING_LIGHT) * float(scene.light[bright].sum())


# Largest distance (px) between the positions of one star in the fits with both signs of the rotation.
_SAME_STAR = 3.0
# Minimum chi-square difference between the two signs of the rotation for a decision on the sign.
_LEAST_MARGIN = 50.0
# Minimum ratio of the chi-square difference between both signs to its scatter, for a decision on the sign.
_LEAST_AGREEMENT = 3.0
# Reason reported if a motion with only one sign of the rotation fits the frame of a rolling shutter.
_ONE_SIGN = "the streaks of the rolling shutter do not show the direction of the rotation: give a prior rate"
# Upper limit of a single star's chi-square difference in the decision on the sign of the rotation.
_MOST_DIFFERENCE = 50.0


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate:
    """A motion from the joint fit, with the result of the streak check.

    The rotation vector over the exposure is `rotation` (3,), rad. For a rolling shutter, `middles` (n, 2),
    px, are the centres of the n bright streaks, and `excess` (n,) is the chi-square of each streak minus the
    number of its pixels. For a global shutter, `middles` and `excess` are empty.
    """

    result: MotionResult
    rotation: FloatArray
    verdict: StreakVerdict
    middles: FloatArray
    excess: FloatArray

    @property
    def possible(self) -> bool:
        """Whether the streak check does not reject the motion."""
        return self.verdict is not StreakVerdict.REJECTED


def _rolling_result(
    fit_along: Callable[[FloatArray], _Candidate | None],
    axis: FloatArray,
    prior_rate: FloatArray | None,
    prior_sigma: float,
    sigmas: float,
) -> MotionResult | None:
    """Return the result for a camera with a rolling shutter, or None if no motion fits.

    The function `fit_along` fits a motion whose rotation vector has a positive component along a given vector
    (3,). The rotation `axis` (3,) is an initial guess with arbitrary sign. The prior rate determines the sign
    if its significance exceeds `sigmas` standard deviations.
    """
    if prior_rate is not None:
        sign = direction_of_time(axis, prior_rate, prior_sigma, sigmas)
        found = fit_along(sign * axis) if sign else None
        if found is not None:
            rate = found.result.rate
            if rate is None:
                return found.result
            if direction_of_time(rate, prior_rate, prior_sigma, sigmas) > 0:
                return replace(found.result, status=StreakStatus.RATE)
    both = [found for found in (fit_along(axis), fit_along(-axis)) if found is not None]
    if not both:
        return None
    known = [found for found in both if found.result.rate is not None]
    if len(known) < 2:
        # If the fit succeeds for only one sign, the other sign may still be correct, so no rate is returned.
        reason = _ONE_SIGN if known else both[0].result.reason
        return replace(both[0].result, status=StreakStatus.FAILED, rate=None, covariance=None, reason=reason)
    one, other = known
    distance = np.linalg.norm(one.middles[:, None] - other.middles, axis=2)
    of_one, of_other = np.nonzero(distance < _SAME_STAR)
    better = np.clip(other.excess[of_other] - one.excess[of_one], -_MOST_DIFFERENCE, _MOST_DIFFERENCE)
    total, scatter = float(better.sum()), float(np.sqrt(np.sum(better**2)))
    if abs(total) >= max(_LEAST_MARGIN, _LEAST_AGREEMENT * scatter):
        return (one if total > 0.0 else other).result
    first, second = one.result, other.result
    assert first.rate is not None
    assert first.covariance is not None
    assert second.rate is not None
    assert second.covariance is not None
    sum_of_both = first.rate + second.rate
    covariance = 0.5 * (first.covariance + second.covariance) + 0.25 * np.outer(sum_of_both, sum_of_both)
    return replace(first, rate=first.rate - 0.5 * sum_of_both, covariance=covariance)


# Indices of rate, acceleration, x and y in the vector of the shared parameters, then those of one star.
_GEOMETRY = np.array([0, 1, 2, 3, 4, 5, 7, 8])
# Last step of a joint fit (standard deviations) above which the fit has not converged.
_UNSETTLED = 2.0
# Minimum distance (point-spread widths) from the frame's border at which the end of a streak is visible.
_END_WIDTHS = 2.0
# Minimum decrease of chi-square for which a rotation that reverses during the exposure is assumed.
_REVERSED = 30.0
# Largest distance (px) between the two streaks of a double image, which a vibration causes.
_DOUBLE = 8.0
# Minimum flux ratio of the fainter to the brighter component of a double image.
_DOUBLE_RATIO = 0.3
# Largest fraction of stars with a double image in a frame whose rate is accepted.
_MOST_DOUBLE = 0.4
# Distance (px) below which two fitted streaks count as the same star.
_SAME = 1.5


def with_stars(seen: MotionResult, camera: FitProblem, last: StreakFit) -> MotionResult:
    """Return a copy of the result `seen` with stars, streak ends and covariances of the fit `last`."""
    settings, joint = camera.settings, last.solution.joint
    significance = last.scene.light / np.sqrt(np.maximum(joint[:, LIGHT, LIGHT], 1e-30))
    kept = np.flatnonzero(significance > settings.faint_sigmas)
    # If the fit has moved one star onto another star, only the brighter star is kept.
    stars, light = last.scene.stars[kept], last.scene.light[kept]
    near = np.linalg.norm(stars[:, None] - stars, axis=2) < _SAME
    kept = kept[~(near & (light > light[:, None])).any(axis=1)]
    scene, joint, significance = last.scene.select(kept), joint[kept], significance[kept]
    n = len(kept)
    geometry = joint[:, _GEOMETRY[:, None], _GEOMETRY]
    endpoints, covariances = np.empty((n, 2, 2)), np.empty((n, 2, 2, 2))
    bounds = exposure_bounds(camera.pinhole, scene.motion, camera.shutter, scene.stars)
    for end, times in enumerate(bounds.T):
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
        psf_profile=scene.profile,
        misfit=misfit(last.evaluation, kept[np.argsort(-significance, kind="stable")[:10]]),
        rate_model="accelerating" if last.free[3] else "constant",
        residual=spread / camera.pinhole.focal_length,
    )


def with_rate(
    result: MotionResult, camera: FitProblem, last: StreakFit, verdict: StreakVerdict
) -> MotionResult:
    """Return `result` completed with the rate, or with the reason why no rate is reported."""
    settings = camera.settings
    if result.used_count < settings.least_stars:
        why = f"{result.used_count} streaks agree, at least {settings.least_stars} are needed"
        return replace(result, status=StreakStatus.TOO_FEW, reason=why)
    known = rotation_uncertainty(result, camera, last)
    size = float(np.linalg.norm(known.rotation))
    deviation = float(np.sqrt(known.rotation @ known.covariance @ known.rotation)) / size
    still = not size > settings.least_significance * deviation
    reason = _rejection(result, camera, last, verdict, known)
    if result.length < settings.least_length or (still and not reason):
        why = f"streaks of {result.length:.1f} px are too short for a rate"
        return replace(result, status=StreakStatus.TOO_SHORT, reason=why)
    if reason:
        return replace(result, status=StreakStatus.FAILED, reason=reason)
    exposure = result.exposure
    acceleration = last.scene.motion.acceleration / exposure**2 if last.free[3] else None
    result = replace(result, rate=known.rotation / exposure, covariance=known.covariance / exposure**2)
    return replace(result, status=StreakStatus.AMBIGUOUS, acceleration=acceleration)


def _rejection(
    result: MotionResult,
    camera: FitProblem,
    last: StreakFit,
    verdict: StreakVerdict,
    known: RotationUncertainty,
) -> str:
    """Return the reason why a fitted motion is rejected, or an empty string if it is accepted."""
    settings, common = camera.settings, known.common_motion
    distance = np.linalg.norm(result.stars[result.used, None] - result.stars, axis=2)
    bright = result.flux > _DOUBLE_RATIO * result.flux[result.used, None]
    double = float(np.mean((bright & (distance > 0.0) & (distance < _DOUBLE)).any(axis=1)))
    used, margin = result.stars[result.used], _END_WIDTHS * last.scene.width
    whole = complete_streaks(camera.pinhole, last.scene.motion, camera.shutter, used, margin)
    checks = (
        (not whole.any(), "no streak has both ends in the frame: expose for a shorter time"),
        (last.last_step > _UNSETTLED, "the fit did not converge"),
        (
            not result.misfit < settings.worst_misfit and not known.aside < settings.worst_displacement,
            f"the streaks do not fit the model: misfit {result.misfit:.1f}",
        ),
        (verdict is StreakVerdict.REJECTED, _WRONG_ENDS),
        (
            max(common.across, common.along) > settings.worst_shaking,
            f"the body vibrated: all streaks vary together by {common.across:.2f} px across and "
            f"{100.0 * common.along:.0f} % in brightness",
        ),
        (double > _MOST_DOUBLE, "most streaks are double: the body vibrated, or the point spread is a ring"),
        (
            known.model_error > settings.worst_uncertainty,
            f"the rate is uncertain by {100.0 * known.model_error:.1f} %, more than "
            f"{100.0 * settings.worst_uncertainty:g} %: the streaks disagree, lens or shutter differ from "
            f"the configuration, or the point spread is {result.psf_sigma / settings.psf_sigma:.2f} times as "
            "wide as configured",
        ),
    )
    reason = next((reason for failed, reason in checks if failed), "")
    if not reason and reversal_improvement(camera, last.scene) > _REVERSED:
        return "the rotation reversed within the exposure"
    return reason


# Maximum number of preliminary motions for which the joint fit is run before a frame is rejected.
_MOST_MOTIONS = 2
# Median region length (px) below which the stars count as at rest, if the regions do not share one motion.
_AT_REST = 4.0
# Median length (px) of the brightest regions below which a frame counts as free of streaks.
_SPOT = 2.2
# Number of the brightest regions whose median length shows whether a frame is free of streaks.
_BRIGHTEST = 12
# Smallest and largest half width of the fitted strips of pixels, in point-spread widths.
_REACHES = (1.0, 20.0)
# Reason reported if the streak check rejects a motion.
_WRONG_ENDS = "the motion divides streaks into segments or joins several"
# Reason reported if no fitted motion passes the streak check.
_NO_CONSISTENT_MOTION = "no motion is consistent with the brightness and the ends of the streaks"
# Reason reported if no motion could be fitted.
_NO_COMMON_MOTION = "the bright regions do not share one motion"


def estimate_rate(
    image: Image,
    camera: CameraModel,
    exposure: float,
    *,
    prior_rate: ArrayLike | None = None,
    prior_sigma: float = 0.0,
    settings: LikelihoodSettings | None = None,
) -> MotionResult:
    """Return a camera's rate estimated from the star streaks in one image.

    The attributes of the result include the mean `rate` (3,), rad/s, of the camera relative to the stars, in
    camera axes, and its `covariance` (3, 3). The quaternion `start_to_end` (4,) of the result is the rotation
    over the exposure. A single image does not show the sign of the rotation. Without a prior rate, the status
    is therefore `ambiguous` and the rate is known except for its sign. If `rate` is None, the attribute
    `reason` states the cause.

    Args:
        image: pixel values (rows, columns) of any integer or floating type, 16 x 16 pixels or larger. Raw
            counts are best, because the gain and the saturation are in the unit of the pixel values.
        camera: pinhole model or calibrated lens.
        exposure: exposure time, s.
        prior_rate: approximate rate (3,) in camera axes, rad/s. The prior rate determines only the sign of
            the rotation. If its component along the measured rate is at most `settings.sign_sigmas` standard
            deviations, the status is `ambiguous`.
        prior_sigma: standard deviation of each component of `prior_rate`, rad/s.
        settings: gain, saturation, point spread and line time of the camera, and limits of the fit.

    Raises:
        ArgumentError: if the image is not an array of finite numbers of the size of the camera, if exposure
            or prior deviation is not a positive number, if the prior rate is not three finite numbers, or if
            the settings are impossible.
    """
    settings = LikelihoodSettings() if settings is None else settings
    check_detector(settings, LikelihoodSettings)
    check_knowledge("settings.knowledge", settings.knowledge)
    if settings.rate_model not in get_args(RateModel):
        text = f"{brief(settings.rate_model)}: give one of {', '.join(get_args(RateModel))}"
        raise ArgumentError("settings.rate_model", text)
    if not _REACHES[0] <= settings.reach <= _REACHES[1]:
        text = f"{settings.reach}: give {_REACHES[0]:g} to {_REACHES[1]:g} point-spread widths"
        raise ArgumentError("settings.reach", text)
    pixels, unit, zero = raw_counts(image_of_camera(image, camera))
    settings = settings.in_units_of(unit, zero)
    prior = None if prior_rate is None else finite_array("prior_rate", prior_rate, (3,))
    found = estimate_motion(pixels, streak_camera(camera), exposure, settings, prior, prior_sigma)
    found = replace(found, flux=unit * found.flux, faint_flux=unit * found.faint_flux)
    explained = found.rate is not None or found.reason
    return found if explained else replace(found, reason=REASONS[found.status])


def estimate_motion(
    pixels: Image,
    pinhole: Pinhole,
    exposure: float,
    settings: LikelihoodSettings,
    prior_rate: FloatArray | None = None,
    prior_sigma: float = 0.0,
    previous_checksum: int | None = None,
    prior_course: Course | None = None,
) -> MotionResult:
    """Return the mean rate over one exposure with its covariance, and the stars of the frame `pixels`.

    The camera `pinhole` has the shape of the frame (rows, columns). The exposure, the settings and the prior
    rate are described in `estimate_rate`. The status is `frozen` if the checksum of the frame equals
    `previous_checksum`, that of the previous frame. The `prior_course` is the rotation as a function of time
    during the exposure, as estimated by the navigation filter; None if unknown.

    Raises ArgumentError for an invalid frame, exposure or prior. If the frame yields no rate, the attributes
    `status` and `reason` of the result state the cause.
    """
    validate(pixels, pinhole, exposure, prior_rate, prior_sigma)
    # The actual saturation level of a frame may be lower than the configured one, but never higher.
    saturation = min(saturation_count(pixels), settings.saturation or np.inf)
    checksum, unusable = admit(pixels, previous_checksum, saturation, settings.saturated_fraction)
    if unusable is not None:
        return MotionResult(unusable, checksum, exposure)
    seen = MotionResult(StreakStatus.FAILED, checksum, exposure, line_time_sigma=settings.line_time_sigma)
    best = seen
    for attempt, prepared in enumerate(prepare_frames(pixels, pinhole, saturation, settings)):
        found = _attempt(prepared, seen, settings, prior_rate, prior_sigma, prior_course)
        if not attempt or found.rate is not None:
            best = found
        if best.status is not StreakStatus.FAILED:
            break
    return best


def _attempt(
    prepared: PreparedFrame,
    seen: MotionResult,
    settings: LikelihoodSettings,
    prior_rate: FloatArray | None,
    prior_sigma: float,
    prior_course: Course | None,
) -> MotionResult:
    """Return the result of `estimate_motion` for a prepared frame; `seen` is a result without stars."""
    binning, frame, regions, sigma = prepared
    settings, pinhole = settings.binned(binning.size), binning.pinhole
    shutter = Shutter(settings.delay_per_row / seen.exposure, pinhole.centre[1])
    camera = FitProblem(frame, pinhole, shutter, settings, sigma, settings.rate_model == "accelerating")
    if prior_course is not None and settings.rate_model != "constant":
        camera = replace(camera, course=prior_course.motion(pinhole.focal_length))
    seen = replace(seen, hot_pixels=frame.hot_pixels)
    if len(regions) < settings.least_stars:
        return replace(seen, status=StreakStatus.TOO_FEW)
    spots = float(np.median(regions.length[:_BRIGHTEST])) < _SPOT
    if not spots:
        found = _in_direction(camera, seen, regions, prior_rate, prior_sigma, prior_course)
        if found is not None:
            return binning.in_pixels(found)
    length = float(np.median(regions.length))
    # If a camera at rest images many stars, the faint regions merge, but the brightest regions do not.
    if length >= _AT_REST and not spots:
        seen = replace(seen, length=length, reason=_NO_COMMON_MOTION)
    else:
        resting = still_fit(camera, regions)
        seen = replace(seen, length=length) if resting is None else with_stars(seen, camera, resting)
        seen = replace(seen, status=StreakStatus.TOO_SHORT)
    return binning.in_pixels(seen)


def _in_direction(
    camera: FitProblem,
    seen: MotionResult,
    regions: BrightRegions,
    prior_rate: FloatArray | None,
    prior_sigma: float,
    course: Course | None,
) -> MotionResult | None:
    """Return the result with the sign of the rotation from the prior rate, or None if no motion fits."""
    sigmas = camera.settings.sign_sigmas
    near = None if prior_rate is None else float(np.linalg.norm(prior_rate)) * seen.exposure
    if camera.shutter.delay_per_row:
        axis = guess_axis(regions, camera.pinhole)
        if axis is None:
            return None

        def fit_along(sense: FloatArray) -> _Candidate | None:
            along = replace(camera, sense=sense, work=WorkBudget())
            return _motion_of_course(along, seen, regions, near, course)

        return _rolling_result(fit_along, axis[0], prior_rate, prior_sigma, sigmas)
    found = _motion_of_course(camera, seen, regions, near, course)
    return None if found is None else in_time(found.result, prior_rate, prior_sigma, sigmas)


def _motion_of_course(
    camera: FitProblem, seen: MotionResult, regions: BrightRegions, near: float | None, course: Course | None
) -> _Candidate | None:
    """Return the best motion with the time course `course`, or without it if the pixels contradict it."""
    if course is not None and camera.course is not None:
        found = _best_motion(camera, seen, regions, near)
        if found is not None and found.result.status is not StreakStatus.FAILED:
            if found.result.covariance is None:
                return found
            covariance = found.result.covariance + course.covariance(seen.exposure)
            ahead = camera.sense is None or float(camera.sense @ course.terms[0]) > 0.0
            result = replace(found.result, covariance=covariance, course=course if ahead else None)
            return replace(found, result=result)
    return _best_motion(replace(camera, course=None, work=WorkBudget()), seen, regions, near)


def _best_motion(
    camera: FitProblem, seen: MotionResult, regions: BrightRegions, near: float | None
) -> _Candidate | None:
    """Return the first motion that passes all tests, or the most likely motion with the status FAILED.

    A motion with the status FAILED does not contain a rate. Returns None if no motion is found.
    """
    rivals = islice(first_fits(camera, regions, near), _MOST_MOTIONS)
    first = next(rivals, None)
    if first is None:
        return None
    leading = _fitted(camera, seen, first)
    if leading.verdict is StreakVerdict.CONFIRMED:
        return leading
    # A doubtful motion is accepted if a scan of the whole frame gives the same rotation angle.
    # If streaks are broken into fragments, the fit often finds the correct axis, but a wrong angle.
    angles = likely_angles(camera, leading.rotation)
    if leading.possible and has_angle(leading.rotation, angles):
        return leading
    candidates = [leading]
    rescanned = (tried.fit for tried in fits_near_angles(camera, leading.rotation, angles))
    for fit in chain(rescanned, rivals):
        if camera.work.exhausted:
            break
        candidate = _fitted(camera, seen, fit)
        again = any(other.possible and alike(candidate.rotation, other.rotation) for other in candidates)
        if candidate.verdict is StreakVerdict.CONFIRMED or (
            candidate.possible and (again or has_angle(candidate.rotation, angles))
        ):
            return candidate
        candidates.append(candidate)
    reason = leading.result.reason or _NO_CONSISTENT_MOTION
    rejected = replace(leading.result, status=StreakStatus.FAILED, rate=None, covariance=None, reason=reason)
    return replace(leading, result=rejected)


def _fitted(camera: FitProblem, seen: MotionResult, first: StreakFit) -> _Candidate:
    """Return the motion of the joint fit that starts from the preliminary fit `first`.

    If the joint fit does not succeed, the motion is marked as REJECTED. A rejected motion is fitted again
    with a vibration if its residuals show one, and then with a point-spread profile learned from the frame.
    """
    last, found = _candidate(camera, seen, first)
    if found.possible or first.scene.motion.vibration.exists or first.scene.profile != GAUSSIAN:
        return found
    start = first
    if last is not None:
        scene = last.scene.select(np.flatnonzero(last.scene.trusted))
        scene = scene.select(np.argsort(-scene.light, kind="stable")[: len(first.scene.light)])
        start = replace(last, scene=scene, windows=camera.windows(scene), hidden=None)
    camera = replace(camera, growing=bool(start.free[3]))
    # No profile of the PSF explains streaks whose ends contradict the motion.
    wrong = found.result.reason == _WRONG_ENDS
    for fit_again in (with_vibration,) if wrong else (with_vibration, fit_profile):
        again = fit_again(camera, start)
        other = None if again is None else _candidate(camera, seen, again)[1]
        if other is not None and other.possible:
            return other
    return found


def _candidate(
    camera: FitProblem, seen: MotionResult, first: StreakFit
) -> tuple[StreakFit | None, _Candidate]:
    """Return the joint fit that starts from the fit `first` (None if it fails), and the resulting motion.

    A learned profile of the PSF multiplies the work of each evaluation of the model. The work of a fit with
    such a profile is therefore limited separately.
    """
    if first.scene.profile != GAUSSIAN:
        camera = replace(camera, work=WorkBudget())
    last, faint = final_fit(camera, first)
    if last is not None and last.scene.motion.vibration.exists:
        done = last
        last = fit_vibration(camera, done, lambda scene: refit(camera, replace(done, scene=scene)))
    middles, excess = np.empty((0, 2)), np.empty(0)
    if last is None:
        return None, _Candidate(seen, first.scene.motion.rotation, StreakVerdict.REJECTED, middles, excess)
    scene, motion = last.scene, last.scene.motion
    verdict = check_streaks(camera, scene, faint)
    bounds = exposure_bounds(camera.pinhole, motion, camera.shutter, faint.stars)
    ends = [positions(camera.pinhole, motion, faint.stars, time) for time in bounds.T]
    found = replace(with_stars(seen, camera, last), faint_endpoints=np.stack(ends, axis=1))
    found = replace(found, faint_flux=faint.light, faint_significance=faint.significance)
    result = with_rate(found, camera, last, verdict)
    if result.status is StreakStatus.FAILED:
        verdict = StreakVerdict.REJECTED
    if camera.shutter.delay_per_row:
        # The residuals of the brightest streaks are evaluated without excluding outlier pixels.
        whole = camera.evaluate(scene, last.windows, clip=0.0)
        bright = slice(camera.settings.most_stars)
        stars = scene.stars[bright]
        time = exposure_bounds(camera.pinhole, motion, camera.shutter, stars).mean(axis=1)
        middles = positions(camera.pinhole, motion, stars, time)
        excess = whole.chi2[bright] - whole.pixels[bright]
    return last, _Candidate(result, motion.rotation, verdict, middles, excess)
