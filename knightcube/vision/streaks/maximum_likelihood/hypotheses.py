"""Rival motions for the brightest stars: guessed, fitted, and judged by what light and ends they explain."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.vision.streaks.maximum_likelihood.angle_scan import SCANNED_STARS, Circles, scan_angles
from knightcube.vision.streaks.maximum_likelihood.blobs import Blobs
from knightcube.vision.streaks.maximum_likelihood.end_checks import true_ends, unbroken
from knightcube.vision.streaks.maximum_likelihood.first_guess import (
    Guess,
    course_motion,
    find_turning,
    scanned_motions,
    seen_growth,
    voted_motions,
)
from knightcube.vision.streaks.maximum_likelihood.iteration import (
    FIRST,
    LAST,
    ExposedCamera,
    Fit,
    iterate,
    misfit,
)
from knightcube.vision.streaks.maximum_likelihood.matched_filter import find_faint
from knightcube.vision.streaks.maximum_likelihood.motion import Motion
from knightcube.vision.streaks.maximum_likelihood.polar_grid import polar_grid
from knightcube.vision.streaks.maximum_likelihood.scene import Scene, mid_exposure, window_times
from knightcube.vision.streaks.maximum_likelihood.whole_frame_scan import frame_angles

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
