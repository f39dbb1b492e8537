"""The motion over one exposure from all pixels of all its streaks, from the frame to a covariance.

Regions give a first guess, the brightest stars a first fit, the motion a matched filter for the faint; the
joint fit of the bright with the faint accounted for gives the answer. Pure and deterministic, made for a
worker process. One frame cannot distinguish omega from -omega; a prior (gyro, or the last estimate) decides.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import chain, islice

import numpy as np

from knightcube.astro.arrays import FloatArray, Image
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.frame import saturation_count
from knightcube.vision.streaks.admission import admit, in_time, validate
from knightcube.vision.streaks.maximum_likelihood.blobs import Blobs
from knightcube.vision.streaks.maximum_likelihood.course import Course
from knightcube.vision.streaks.maximum_likelihood.first_guess import guess_axis
from knightcube.vision.streaks.maximum_likelihood.hypotheses import (
    SAME_ANGLE,
    alike,
    first_fits,
    rescanned_fits,
    seen_angles,
    still_fit,
)
from knightcube.vision.streaks.maximum_likelihood.iteration import ExposedCamera, Fit
from knightcube.vision.streaks.maximum_likelihood.joint_fit import last_fit
from knightcube.vision.streaks.maximum_likelihood.motion import positions
from knightcube.vision.streaks.maximum_likelihood.reading import Reading, read_frame
from knightcube.vision.streaks.maximum_likelihood.result import MotionResult
from knightcube.vision.streaks.maximum_likelihood.result_of_fit import with_faint, with_rate, with_stars
from knightcube.vision.streaks.maximum_likelihood.scene import window_times
from knightcube.vision.streaks.maximum_likelihood.settings import LikelihoodSettings
from knightcube.vision.streaks.maximum_likelihood.shutter import Shutter
from knightcube.vision.streaks.maximum_likelihood.shutter_direction import (
    Directed,
    Misfits,
    rolling_answer,
)
from knightcube.vision.streaks.maximum_likelihood.wholeness import Wholeness, wholeness
from knightcube.vision.streaks.maximum_likelihood.work import Work
from knightcube.vision.streaks.streak_result import StreakStatus

# This many motions are fitted in full before the frame is given up.
_MOST_MOTIONS = 2
# Median length, px, of regions below which a frame without an agreed motion is one of stars at rest.
_AT_REST = 4.0
# The same of the brightest regions, below which no streak of the least length can be among them.
_SPOT = 2.2
_BRIGHTEST = 12
# Why there is no rate where a motion was fitted, and where none was.
_NONE = "light and ends of the streaks bear out no motion"
_NO_MOTION = "the bright areas agree on no motion"


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
    """Return the rate over one exposure, with its covariance, and the stars of the frame `pixels`.

    Args:
        pixels: (rows, columns) of an unsigned integer type, as the camera gave them.
        pinhole: the camera, of the same shape.
        exposure: s.
        settings: of the camera and the fit.
        prior_rate: (3,) rad/s, camera frame: decides the direction of rotation; None when unknown.
        prior_sigma: rad/s, standard deviation of each component of `prior_rate`.
        previous_checksum: of the frame before: the same pixels again are a frozen camera.
        prior_course: how the camera turned, where that is known from elsewhere.

    Raises FlightError for a frame, exposure or prior that is impossible. Why a scene gives no rate is
    reported by the status.
    """
    validate(pixels, pinhole, exposure, prior_rate, prior_sigma)
    # A frame may clip below where the camera says it does, never above.
    saturation = min(saturation_count(pixels), settings.saturation or np.inf)
    checksum, unusable = admit(pixels, previous_checksum, saturation, settings.saturated_fraction)
    if unusable is not None:
        return MotionResult(unusable, checksum, exposure)
    read = read_frame(pixels, pinhole, saturation, settings)
    binning, blobs = read.binning, read.blobs
    camera = _exposed_camera(read, exposure, binning.settings(settings), prior_course)
    hot, unsure = read.frame.hot_pixels, settings.line_time_sigma
    seen = MotionResult(StreakStatus.FAILED, checksum, exposure, hot_pixels=hot, line_time_sigma=unsure)
    if len(blobs) < settings.least_stars:
        return replace(seen, status=StreakStatus.TOO_FEW)
    answer = None if _resting(blobs) else _in_time(camera, seen, blobs, prior_rate, prior_sigma, prior_course)
    return binning.in_pixels(_without_rate(seen, camera, blobs) if answer is None else answer)


def _exposed_camera(
    read: Reading, exposure: float, settings: LikelihoodSettings, course: Course | None
) -> ExposedCamera:
    """Return the frame with its camera, its shutter and the known course, where the rate may change."""
    growing = settings.rate_model == "accelerating"
    pinhole = read.binning.pinhole
    shutter = _shutter(pinhole, exposure, settings)
    camera = ExposedCamera(read.frame, pinhole, shutter, settings, read.sigma, growing)
    if course is None or settings.rate_model == "constant":
        return camera
    return replace(camera, course=course.motion(pinhole.focal_length))


def _in_time(
    camera: ExposedCamera,
    seen: MotionResult,
    blobs: Blobs,
    prior_rate: FloatArray | None,
    prior_sigma: float,
    course: Course | None,
) -> MotionResult | None:
    """Return the motion in the direction of the prior; None without a motion."""
    sigmas = camera.settings.sign_sigmas
    near = None if prior_rate is None else float(np.linalg.norm(prior_rate)) * seen.exposure
    if not camera.shutter.delay_per_row:
        found = None if course is None else _on_course(camera, seen, blobs, near, course)
        if found is None:
            found = _answer(replace(camera, course=None, work=Work()), seen, blobs, near)
        return None if found is None else in_time(found.result, prior_rate, prior_sigma, sigmas)
    axis = guess_axis(blobs, camera.pinhole)
    if axis is None:
        return None

    def along(sense: FloatArray) -> Directed | None:
        return _answer(replace(camera, sense=sense, work=Work()), seen, blobs, near)

    return rolling_answer(along, axis[0], prior_rate, prior_sigma, sigmas)


def _on_course(
    camera: ExposedCamera, seen: MotionResult, blobs: Blobs, near: float | None, course: Course
) -> Directed | None:
    """Return the answer by the known course; None where it is of no use, or the pixels deny it."""
    found = None if camera.course is None else _answer(camera, seen, blobs, near)
    if found is None or found.result.status is StreakStatus.FAILED:
        return None
    if found.result.covariance is None:
        return found
    covariance = found.result.covariance + course.covariance(seen.exposure)
    return replace(found, result=replace(found.result, covariance=covariance, course=course))


def _answer(camera: ExposedCamera, seen: MotionResult, blobs: Blobs, near: float | None) -> Directed | None:
    """Return the first motion that passes every test, else the likeliest; None without one."""
    rivals = islice(first_fits(camera, blobs, near), _MOST_MOTIONS)
    first = next(rivals, None)
    if first is None:
        return None
    leading = _fitted(camera, seen, first)
    if leading.whole is Wholeness.WHOLE:
        return leading.answer
    # A doubted motion to which the light of the whole frame leads again has two witnesses. To ask it costs
    # less than to fit a rival, and the axis is often right, known well from pieces of streaks, where the
    # angle is not.
    angles = seen_angles(camera, leading.turn)
    if leading.stands and _witnessed(leading.turn, angles):
        return leading.answer
    candidates = [leading]
    for fit in chain(rescanned_fits(camera, leading.turn, angles), rivals):
        if camera.work.exhausted:
            break
        candidate = _fitted(camera, seen, fit)
        again = any(other.stands and alike(candidate.turn, other.turn) for other in candidates)
        if candidate.whole is Wholeness.WHOLE or (
            candidate.stands and (again or _witnessed(candidate.turn, angles))
        ):
            return candidate.answer
        candidates.append(candidate)
    seen = leading.answer.result
    refused = replace(
        seen, status=StreakStatus.FAILED, rate=None, covariance=None, reason=seen.reason or _NONE
    )
    return replace(leading.answer, result=refused)


def _witnessed(turn: FloatArray, angles: list[float]) -> bool:
    """Return whether `turn` (3,) is by the likeliest of the frame's `angles`."""
    size = float(np.linalg.norm(turn))
    return bool(angles) and abs(size - angles[0]) < SAME_ANGLE * size


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate:
    """A motion that was fitted: the answer it gives, its turn (3,), and whether its streaks are whole."""

    answer: Directed
    turn: FloatArray
    whole: Wholeness

    @property
    def stands(self) -> bool:
        return self.whole is not Wholeness.BROKEN


def _fitted(camera: ExposedCamera, seen: MotionResult, first: Fit) -> _Candidate:
    """Return what the joint fit from `first` says; a fit that failed is broken."""
    last, faint = last_fit(camera, first)
    if last is None:
        return _Candidate(Directed(seen, None), first.scene.motion.whole, Wholeness.BROKEN)
    whole = wholeness(camera, last.scene, faint)
    answer = with_faint(with_stars(seen, camera, last), camera, last.scene, faint)
    answer = with_rate(answer, camera, last, whole)
    failed = answer.status is StreakStatus.FAILED
    directed = Directed(answer, _misfits(camera, last) if camera.shutter.delay_per_row else None)
    return _Candidate(directed, last.scene.motion.whole, Wholeness.BROKEN if failed else whole)


def _misfits(camera: ExposedCamera, last: Fit) -> Misfits:
    """Return what the model leaves over of the brightest streaks, no pixel left out."""
    whole = camera.evaluate(last.scene, last.windows, clip=0.0)
    bright = slice(camera.settings.most_stars)
    motion, stars = last.scene.motion, last.scene.stars[bright]
    time = window_times(camera.pinhole, motion, camera.shutter, stars).mean(axis=1)
    middles = positions(camera.pinhole, motion, stars, time)
    return Misfits(middles, whole.chi2[bright] - whole.pixels[bright])


def _shutter(pinhole: Pinhole, exposure: float, settings: LikelihoodSettings) -> Shutter:
    return Shutter(settings.delay_per_row / exposure, pinhole.centre[1])


def _resting(blobs: Blobs) -> bool:
    """Return whether most of the brightest regions are spots: then no motion is searched for."""
    return float(np.median(blobs.length[:_BRIGHTEST])) < _SPOT


def _without_rate(seen: MotionResult, camera: ExposedCamera, blobs: Blobs) -> MotionResult:
    """Return `seen` for a frame without an agreed motion: stars at rest, or a failure."""
    length = float(np.median(blobs.length))
    # Of a crowded sky at rest the faint regions run together, but not the brightest.
    if length >= _AT_REST and not _resting(blobs):
        return replace(seen, status=StreakStatus.FAILED, length=length, reason=_NO_MOTION)
    resting = still_fit(camera, blobs)
    if resting is None:
        return replace(seen, status=StreakStatus.TOO_SHORT, length=length)
    return replace(with_stars(seen, camera, resting), status=StreakStatus.TOO_SHORT)
