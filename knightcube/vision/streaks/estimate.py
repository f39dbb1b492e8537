"""The motion over one exposure from all pixels of all its streaks, from the frame to a covariance.

Regions give a first guess, the brightest stars a first fit, the motion a matched filter for the faint; the
joint fit of the bright with the faint accounted for gives the answer. Pure and deterministic, made for a
worker process. One frame cannot distinguish omega from -omega; a prior (gyro, or the last estimate) decides.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from enum import Enum
from itertools import chain, islice

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, Image, IntArray
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.frame import saturation_count
from knightcube.vision.streaks.faint_stars import FaintStars, find_faint, frame_angles, polar_grid
from knightcube.vision.streaks.first_guess import (
    SCANNED_STARS,
    Circles,
    Guess,
    course_motion,
    find_turning,
    guess_axis,
    scan_angles,
    scanned_motions,
    seen_growth,
    voted_motions,
)
from knightcube.vision.streaks.frame import Blobs, Reading, read_frame
from knightcube.vision.streaks.geometry import (
    Course,
    Motion,
    Scene,
    Shutter,
    in_chains,
    mid_exposure,
    path_lengths,
    positions,
    sensitivities,
    window_times,
)
from knightcube.vision.streaks.joint_fit import (
    FIRST,
    LAST,
    ExposedCamera,
    Fit,
    Work,
    iterate,
    last_fit,
    misfit,
    trailing,
    true_ends,
    unbroken,
)
from knightcube.vision.streaks.normal_equations import ALONE, Evaluation
from knightcube.vision.streaks.settings import LikelihoodSettings
from knightcube.vision.streaks.streak_result import (
    MotionResult,
    StreakStatus,
    admit,
    direction_of_time,
    in_time,
    validate,
)
from knightcube.vision.streaks.uncertainty import Claim, claim, turning_back

SAME_ANGLE = 0.05
"""Angles are distinguished to this part."""

_FIRST_STARS = 12
# This many guesses are tried at most.
_MOST_GUESSES = 5
# This many angles of the whole frame's light.
_MOST_ANGLES = 2
# Of them, for a rate that changes.
_MOST_GROWING = 2
_STILL_ROUNDS = 12
# A guess is made of this many whole streaks, or of a scan; regions longer than it speak against it.
_WHOLE = 8
_CONTRADICTED = 0.3
# A hypothesis with this many stars needs no rival where it explains this part of them, the rest being crowded
# by others, this part of their ends is in place, and it explains so much light, in sigmas squared.
_MANY = 3
_EXPLAINED = 0.4
_IN_PLACE = 0.6
_EVIDENT = 3000.0
_WORST_FIRST = 12.0
# In a crowded frame, one with this part of its pixels lit, the brightest regions are several stars in one,
# and a motion as long as those explains a little of everything: up to this much, the light of the whole frame
# is asked.
_CROWDED = 0.05
_BEYOND_CROWD = 100_000.0
# A star is explained when at most this part of its light is left; none counts more than this many sigmas.
_LEFT_OVER = 0.01
_ENOUGH = 200.0
# Regions longer than a hypothesis allows speak against it, but may be two streaks in one.
_CONTRADICTION = 0.6
_CALM = 2.0
# Motions that differ by less than this part are one.
_SAME_MOTION = 0.005
# Ends in place of a hypothesis of the wrong turn: it may have one of the two of each streak.
_BY_CHANCE = 0.4


def first_fits(camera: ExposedCamera, blobs: Blobs, near: float | None) -> Iterator[Fit]:
    """Yield fits of the brightest stars, the likeliest motion first: one that they support, then its rivals.

    `near` rad is a turn known from elsewhere, None when unknown.
    """
    rivals: list[tuple[float, Fit]] = []
    yielded: list[FloatArray] = []
    for guess in islice(_guesses(camera, blobs, near), _MOST_GUESSES):
        if camera.work.exhausted:
            break
        tried = _tried(camera, guess)
        if tried is None:
            continue
        explained, convincing, done = tried
        if any(alike(done.scene.motion.whole, other) for other in yielded):
            continue
        if convincing and all(explained > rival for rival, _ in rivals):
            likelier = None if rivals else _likelier(camera, blobs, explained, done)
            if likelier is not None:
                rivals.append((explained, done))
                done = likelier
            yielded.append(done.scene.motion.whole)
            yield done
        elif misfit(done.evaluation) <= _WORST_FIRST:
            rivals.append((explained, done))
    if rivals and not yielded:
        # No region shows the angle: the light of the whole frame may.
        axis = max(rivals, key=lambda rival: rival[0])[1].scene.motion.whole
        angles = seen_angles(camera, axis)
        for explained, convincing, done in _rescanned(camera, axis, angles):
            rivals.append((explained, done))
            if convincing:
                break
    rivals.sort(key=lambda rival: -rival[0])
    for _, done in rivals:
        if not any(alike(done.scene.motion.whole, other) for other in yielded):
            yielded.append(done.scene.motion.whole)
            yield done


def _likelier(camera: ExposedCamera, blobs: Blobs, explained: float, done: Fit) -> Fit | None:
    """Return a fit that explains more than `done`, by the whole frame's light; None without one, or need."""
    if blobs.lit <= _CROWDED or explained >= _BEYOND_CROWD:
        return None
    turn = done.scene.motion.whole
    size = float(np.linalg.norm(turn))
    angles = seen_angles(camera, turn)
    if any(abs(size - angle) < SAME_ANGLE * size for angle in angles):
        return None
    best = None
    for light, convincing, fit in _rescanned(camera, turn, angles):
        if light <= explained:
            continue
        if abs(float(np.linalg.norm(fit.scene.motion.whole)) - size) < SAME_ANGLE * size:
            return None
        best, explained = fit, light
        if convincing:
            break
    return best


def seen_angles(camera: ExposedCamera, turn: FloatArray) -> list[float]:
    """Return the likeliest angles, rad, about the axis of `turn` (3,), by the light of the whole frame."""
    camera.work.passed(camera.frame.signal.size)
    return frame_angles(camera.frame, camera.pinhole, turn, _MOST_ANGLES)


def rescanned_fits(camera: ExposedCamera, turn: FloatArray, angles: list[float]) -> Iterator[Fit]:
    """Yield fits of the brightest stars about the axis of `turn` (3,), near each of `angles` (rad)."""
    for _, _, done in _rescanned(camera, turn, angles):
        yield done


def _rescanned(
    camera: ExposedCamera, turn: FloatArray, angles: list[float]
) -> Iterator[tuple[float, bool, Fit]]:
    """Yield how much light the fits near `angles` explain, whether that convinces, and the fits."""
    settings, pinhole = camera.settings, camera.pinhole
    nothing = np.empty(0, dtype=np.int64), np.empty(0, dtype=np.float32)
    frame = polar_grid(pinhole, Motion.steady(turn)).frame
    for angle in angles:
        if camera.work.exhausted:
            return
        camera.work.passed(camera.frame.signal.size)
        motion = Motion.steady(frame[2] * angle)
        found = find_faint(camera.frame, nothing, pinhole, motion, settings.faint_sigmas, settings.most_faint)
        bright = np.argsort(-found.light, kind="stable")[:SCANNED_STARS]
        x, y, z = frame @ pinhole.unit_vectors(found.stars[bright]).T
        circles = Circles(frame, z, np.arctan2(y, x))
        for turned in islice(scan_angles(camera.frame, pinhole, circles, 1, angle), 1):
            stars, light = turned.stars[:_FIRST_STARS], turned.light[:_FIRST_STARS]
            if len(light) < settings.least_stars:
                continue
            tried = _tried(camera, Guess(Motion.steady(frame[2] * turned.angle), stars, light, 0.0))
            if tried is not None:
                yield tried


def alike(one: FloatArray, other: FloatArray) -> bool:
    """Return whether two turns (3,) are one motion, forwards or backwards in time."""
    apart = min(np.linalg.norm(one - other), np.linalg.norm(one + other))
    return float(apart) < _SAME_MOTION * float(np.linalg.norm(one))


def _guesses(camera: ExposedCamera, blobs: Blobs, near: float | None) -> Iterator[Guess]:
    """Yield where to start, the likeliest first: by whole streaks if there are many, else by a scan."""
    turning = find_turning(blobs, camera.pinhole)
    if turning is None:
        return
    if camera.course is not None:
        known = course_motion(camera.course, blobs, camera.pinhole, _FIRST_STARS)
        if len(known.light) >= camera.settings.least_stars:
            yield known
    growth = 0.0 if camera.settings.rate_model == "constant" else seen_growth(turning, blobs)
    if growth:
        yield from voted_motions(turning, blobs, camera.pinhole, _FIRST_STARS, growth)[:_MOST_GROWING]
    voted = voted_motions(turning, blobs, camera.pinhole, _FIRST_STARS)
    if voted and len(voted[0].light) >= _WHOLE and voted[0].contradicted < _CONTRADICTED:
        yield voted.pop(0)
    yield from scanned_motions(turning, camera.frame, camera.pinhole, _FIRST_STARS, near)
    yield from voted


def _tried(camera: ExposedCamera, guess: Guess) -> tuple[float, bool, Fit] | None:
    """Return how much light a guess explains once fitted, whether that convinces, and the fit."""
    count = len(guess.light)
    everyone = np.ones(count, dtype=np.bool_)
    width = float(np.hypot(camera.sigma, 0.29))
    motion = guess.motion if camera.course is None else camera.course.scaled_to(guess.motion.whole)
    motion = motion if camera.sense is None else motion.along(camera.sense)
    stars = mid_exposure(camera.pinhole, motion, camera.shutter, guess.stars)
    scene = Scene(motion, width, stars, guess.light, np.zeros(count), everyone)
    camera = replace(camera, growing=not motion.constant)
    done = iterate(camera, scene, camera.free, FIRST)
    if done is None:
        return None
    evidence, share = _borne_out(done)
    ends = _ending(camera, done.scene)
    explained = evidence * (1.0 - _CONTRADICTION * guess.contradicted) * max(ends - _BY_CHANCE, 0.02)
    convincing = explained > _EVIDENT and share > _EXPLAINED and ends > _IN_PLACE and count >= _MANY
    return explained, convincing, done


def still_fit(camera: ExposedCamera, blobs: Blobs) -> Fit | None:
    """Return the stars of a camera at rest: their centroids, and the width of the point spread."""
    count = min(len(blobs), camera.settings.most_stars)
    width = float(np.hypot(camera.sigma, 0.29))
    everyone = np.ones(count, dtype=np.bool_)
    still = Motion.steady(np.zeros(3))
    scene = Scene(still, width, blobs.centre[:count], blobs.flux[:count], np.zeros(count), everyone)
    free = np.array([False] * 6 + [True])
    return iterate(camera, scene, free, replace(LAST, rounds=_STILL_ROUNDS))


def _ending(camera: ExposedCamera, scene: Scene) -> float:
    """Return what part of the ends is where it should be, or of the streaks unbroken, whichever is less.

    1 when none can be judged.
    """
    times = window_times(camera.pinhole, scene.motion, camera.shutter, scene.stars)
    seen = camera.frame, camera.pinhole, scene.motion, scene.stars, scene.light, times
    ends = true_ends(*seen)
    judged = ends[np.isfinite(ends)], unbroken(*seen)
    return min(float(np.mean(share)) if len(share) else 1.0 for share in judged)


def _borne_out(done: Fit) -> tuple[float, float]:
    """Return how much light a fit explains, in sigmas squared, and what part of the stars.

    A turn of the wrong size leaves an end of each streak over, or makes one of nothing: a good part of its
    light. No single star outweighs the rest.
    """
    light = done.scene.light**2 / np.maximum(done.solution.joint[:, 9, 9], 1e-30)
    left = done.evaluation.chi2 - done.evaluation.pixels
    good = left < _LEFT_OVER * light + done.evaluation.pixels
    calm = 1.0 if done.restless < _CALM else 0.3
    return calm * float(np.sum(np.minimum(light, _ENOUGH**2)[good])), float(np.mean(good))


# Share of the stars that may seem pieces of longer streaks by chance.
_MOST_CHAINED = 0.45
# Share of the ends on the detector that are where the motion puts them: without doubt, and at least.
_TRUE_ENDS = (0.75, 0.6)
# Share of the stars that are dark along a good part of their path, which one may be for reasons of its own.
_BROKEN = (0.12, 0.35)
# With this many stars both of whose ends are in place nothing else raises doubt.
_VOUCHING = 3
# Share of the light of streaks that lie in the frame from end to end which the motion must have on its side.
_WHOLE_LIGHT = 0.5
# Where the rate changes by more than the first part of itself, the second part of the stars may have light
# beyond an end.
_UNEVEN = 0.4
_MOST_TRAILING = 0.5


class Wholeness(Enum):
    """Whether the streaks' ends and the light between them support a motion."""

    WHOLE = "whole"
    DOUBTED = "doubted"
    BROKEN = "broken"


def wholeness(camera: ExposedCamera, scene: Scene, faint: FaintStars) -> Wholeness:
    """Return whether the stars that decide are as long as their light; doubted when some of them are not.

    In a crowded frame what passes for a star may be several: a few that are dark here or there do not speak
    against the motion, but ask for another witness, unless enough streaks vouch for it with both ends, which
    alone give the angle turned. So does a motion that most streaks with both ends disown, and one that none
    vouches for; where the ends of those that decide are not where they should be, it is not the motion.
    """
    stars = np.concatenate([scene.stars, faint.stars])
    light = np.concatenate([scene.light, faint.light])
    chained = in_chains(camera.pinhole, scene.motion, stars, light, len(scene.stars))
    if float(np.mean(chained[scene.trusted])) > _MOST_CHAINED:
        return Wholeness.BROKEN
    deciding = scene.select(scene.trusted)
    times = window_times(camera.pinhole, deciding.motion, camera.shutter, deciding.stars)
    seen = camera.frame, camera.pinhole, scene.motion, deciding.stars, deciding.light, times
    if abs(scene.motion.relative_growth) > _UNEVEN and trailing(*seen) > _MOST_TRAILING:
        return Wholeness.BROKEN
    ends, lit = true_ends(*seen), unbroken(*seen)
    known = np.isfinite(ends)
    both = known.all(axis=1)
    right = float(np.mean(ends[known])) if known.any() else 1.0
    if both.any() and float(np.mean(ends[both])) < _TRUE_ENDS[1]:
        return Wholeness.BROKEN
    in_place = ends[both].all(axis=1)
    vouched = np.count_nonzero(in_place) >= _VOUCHING and float(np.mean(in_place)) >= _TRUE_ENDS[0]
    dark = np.count_nonzero(lit == 0.0)
    for worst, (least_ends, most_broken) in zip(
        (Wholeness.BROKEN, Wholeness.DOUBTED), zip(_TRUE_ENDS[::-1], _BROKEN[::-1], strict=True), strict=True
    ):
        if right < least_ends or dark > max(1.0, most_broken * len(lit)):
            return Wholeness.WHOLE if vouched and worst is Wholeness.DOUBTED else worst
    unvouched = bool(known.any()) and not both.any()
    doubted = unvouched or (not vouched and _disowned(camera, scene))
    return Wholeness.DOUBTED if doubted else Wholeness.WHOLE


def _disowned(camera: ExposedCamera, scene: Scene) -> bool:
    """Return whether most light of the bright streaks that show both ends is not of stars that agree."""
    times = window_times(camera.pinhole, scene.motion, camera.shutter, scene.stars)
    inside = np.ones(len(scene.stars), dtype=np.bool_)
    for time in times.T:
        inside &= camera.pinhole.contains(positions(camera.pinhole, scene.motion, scene.stars, time))
    # Fainter stars were never asked.
    bright = inside & (scene.light >= scene.light[scene.trusted].min())
    light = scene.light[bright]
    return float(light[scene.trusted[bright]].sum()) < _WHOLE_LIGHT * float(light.sum())


# Streaks of both fits are of one star within this many px. The stars must prefer one direction by this much
# chi-square together, and by this many times their scatter; none counts more than so much.
_SAME_STAR = 3.0
_LEAST_MARGIN = 50.0
_LEAST_AGREEMENT = 3.0
_ENOUGH_MISFIT = 50.0


@dataclass(frozen=True, slots=True, eq=False)
class Misfits:
    """Streaks' middles (n, 2) px, and by how much the chi-square (n,) of each exceeds its pixels."""

    middles: FloatArray
    excess: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Directed:
    """The answer for one direction, and its misfits; None where they are not needed."""

    result: MotionResult
    misfits: Misfits | None


def rolling_answer(
    answer: Callable[[FloatArray], Directed | None],
    axis: FloatArray,
    prior_rate: FloatArray | None,
    prior_sigma: float,
    sigmas: float,
) -> MotionResult | None:
    """Return the motion under a rolling shutter; None without one.

    `answer` gives it for turns along a vector (3,), `axis` (3,) is the first guess of the turn's, of either
    sign; the prior (rad/s, None if unknown) is believed beyond `sigmas` of its own.
    """
    if prior_rate is not None:
        sign = direction_of_time(axis, prior_rate, prior_sigma, sigmas)
        found = answer(sign * axis) if sign else None
        if found is not None:
            rate = found.result.rate
            if rate is None:
                return found.result
            if direction_of_time(rate, prior_rate, prior_sigma, sigmas) > 0:
                return replace(found.result, status=StreakStatus.RATE)
    seen = [found for found in (answer(axis), answer(-axis)) if found is not None]
    if not seen:
        return None
    known = [found for found in seen if found.result.rate is not None]
    if len(known) < 2:
        # A direction that failed may be the true one.
        return replace(seen[0].result, status=StreakStatus.FAILED, rate=None, covariance=None)
    one, other = known
    preference = _preference(one.misfits, other.misfits)
    if preference:
        return (one if preference > 0 else other).result
    return _between(one.result, other.result)


def _preference(one: Misfits | None, other: Misfits | None) -> int:
    """Return 1 where the stars agree that `one` fits them better, -1 for `other`, 0 where they do not."""
    assert one is not None
    assert other is not None
    apart = np.linalg.norm(one.middles[:, None] - other.middles, axis=2)
    mine, theirs = np.nonzero(apart < _SAME_STAR)
    better = np.clip(other.excess[theirs] - one.excess[mine], -_ENOUGH_MISFIT, _ENOUGH_MISFIT)
    total, scatter = float(better.sum()), float(np.sqrt(np.sum(better**2)))
    if abs(total) < max(_LEAST_MARGIN, _LEAST_AGREEMENT * scatter):
        return 0
    return 1 if total > 0.0 else -1


def _between(one: MotionResult, other: MotionResult) -> MotionResult:
    """Return the motion between two of opposite directions, its covariance spanning both."""
    assert one.rate is not None
    assert one.covariance is not None
    assert other.rate is not None
    assert other.covariance is not None
    apart = one.rate + other.rate
    covariance = 0.5 * (one.covariance + other.covariance) + 0.25 * np.outer(apart, apart)
    return replace(one, rate=one.rate - 0.5 * apart, covariance=covariance)


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
