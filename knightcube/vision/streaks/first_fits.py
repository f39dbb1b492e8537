"""Preliminary fits of the motion to the brightest streaks, in descending order of likelihood.

Initial guesses follow from the lengths of the bright regions or from a scan of the rotation angle. Each guess
is fitted to the brightest stars. A fit is convincing if its residuals are small and most streaks in the frame
end where their models end. If no guess leads to a convincing fit, a vibration or a profile of the point
spread function (PSF) is fitted in addition, and then the whole frame is scanned for the angle.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain, islice

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.vision.streaks.camera_motion import CameraMotion
from knightcube.vision.streaks.faint_stars import find_faint
from knightcube.vision.streaks.first_guess import (
    FRAME_CAP,
    SCANNED_STARS,
    Circles,
    MotionGuess,
    find_axis,
    frame_angles,
    measured_rate_change,
    motion_by_course,
    motions_by_length,
    motions_by_scan,
    scan_angles,
)
from knightcube.vision.streaks.frame import BrightRegions
from knightcube.vision.streaks.geometry import (
    StreakScene,
    mid_exposure_positions,
)
from knightcube.vision.streaks.joint_fit import (
    FIRST,
    LAST,
    FitProblem,
    StreakFit,
    iterate,
    misfit,
    true_ends,
    unbroken,
)
from knightcube.vision.streaks.polar_grid import polar_grid
from knightcube.vision.streaks.psf_profile import fit_profile
from knightcube.vision.streaks.vibration import fit_vibration

LIGHT = 9
"""Index of the flux in the vector of the shared parameters followed by one star's parameters."""

# Relative difference below which two rotation angles count as equal.
_SAME_ANGLE = 0.05
# Relative difference below which two rotation vectors count as the same motion.
_SAME_MOTION = 0.005
# Number of the brightest stars in a preliminary fit of the motion.
_FIRST_STARS = 12
# Maximum number of initial guesses of the motion that are fitted.
_MOST_GUESSES = 5
# Maximum number of initial guesses with an angular acceleration.
_MOST_GROWING = 2
# Maximum number of rotation angles that the scan of the whole frame proposes.
_MOST_ANGLES = 2
# Minimum number of complete streaks for a guess of the rotation angle from streak lengths alone.
_WHOLE = 8
# Largest accepted fraction of the flux in regions that are longer than the guessed streak length.
_CONTRADICTED = 0.3
# Minimum number of stars in a preliminary fit that is accepted without comparison with other fits.
_MANY = 3
# Minimum fraction of well-fitted stars in a preliminary fit that is accepted without comparison.
_EXPLAINED = 0.4
# Minimum fraction of confirmed streak ends in a preliminary fit that is accepted without comparison.
_IN_PLACE = 0.6
# Minimum chi-square explained by a preliminary fit that is accepted without comparison with other fits.
_EVIDENT = 3000.0
# Largest median chi-square per degree of freedom of a usable preliminary fit.
_WORST_FIRST = 12.0
# Fraction of bright pixels above which the brightest regions of a frame are assumed to be blends of stars.
_CROWDED = 0.05
# Chi-square explained by the best fit above which even a frame of blended stars is not scanned.
_BEYOND_CROWD = 100_000.0
# Largest excess chi-square of a well-fitted star, as a fraction of the star's squared significance.
_MOST_RESIDUAL = 0.01
# Upper limit of a star's significance in the explained chi-square, in standard deviations.
_ENOUGH = 200.0
# Relative reduction of the explained chi-square if all flux is in regions longer than the guessed streaks.
_CONTRADICTION = 0.6
# Median chi-square per degree of freedom of a preliminary fit above which a vibration is fitted.
_SHAKEN = 2.5
# Last step of a preliminary fit (standard deviations) below which the fit counts as converged.
_CALM = 2.0
# Fraction of streak ends that even a fit with a wrong rotation angle matches, at about one per streak.
_ENDS_BY_CHANCE = 0.4


def first_fits(camera: FitProblem, regions: BrightRegions, near: float | None) -> Iterator[StreakFit]:
    """Yield preliminary fits of the motion to the brightest stars, in descending order of likelihood.

    The argument `near` (rad) is the rotation angle expected from a prior rate, or None.
    """
    rivals: list[tuple[float, StreakFit]] = []
    yielded: list[FloatArray] = []
    for tried in _fits_of_guesses(camera, regions, near):
        explained, done = tried.explained, tried.fit
        if any(alike(done.scene.motion.rotation, other) for other in yielded):
            continue
        if tried.convincing and not tried.shaken and all(explained >= rival for rival, _ in rivals):
            likelier = None if yielded else _likelier(camera, regions, explained, done)
            if likelier is not None:
                rivals.append((explained, done))
                done = likelier
            yielded.append(done.scene.motion.rotation)
            yield done
        elif misfit(done.evaluation) <= _WORST_FIRST:
            rivals.append((explained, done))
    if rivals and not yielded:
        # If the bright regions do not determine the rotation angle, the whole frame is scanned.
        axis = max(rivals, key=lambda rival: rival[0])[1].scene.motion.rotation
        angles = likely_angles(camera, axis)
        for tried in fits_near_angles(camera, axis, angles):
            rivals.append((tried.explained, tried.fit))
            if tried.convincing:
                break
    rivals.sort(key=lambda rival: -rival[0])
    for _, done in rivals:
        if not any(alike(done.scene.motion.rotation, other) for other in yielded):
            yielded.append(done.scene.motion.rotation)
            yield done


def _fits_of_guesses(camera: FitProblem, regions: BrightRegions, near: float | None) -> Iterator[_FirstFit]:
    """Yield fits of a smooth motion to the initial guesses, and then fits that include a disturbance.

    A fit with a vibration or with a learned profile of the PSF needs many times the work of a smooth fit.
    With a wrong guess, such a fit would use up the work limit of the frame, so smooth motions are fitted to
    all guesses first.
    """
    shaken = []
    for guess in islice(_guesses(camera, regions, near), _MOST_GUESSES):
        if camera.work.exhausted:
            return
        fit = _tried(camera, guess)
        if fit is None:
            continue
        if fit.shaken:
            shaken.append(fit)
        yield fit
    for fit in sorted(shaken, key=lambda fit: not fit.convincing):
        if camera.work.exhausted:
            return
        yield _disturbed(camera, fit)


def _likelier(
    camera: FitProblem, regions: BrightRegions, explained: float, done: StreakFit
) -> StreakFit | None:
    """Return a fit that explains more chi-square than the fit `done`, from a scan of the whole frame.

    Returns None if the scan finds no better fit, if few pixels of the frame are bright, or if the fit `done`
    already explains enough chi-square.
    """
    if regions.lit <= _CROWDED or explained >= _BEYOND_CROWD:
        return None
    rotation = done.scene.motion.rotation
    size = float(np.linalg.norm(rotation))
    angles = likely_angles(camera, rotation)
    if any(abs(size - angle) < _SAME_ANGLE * size for angle in angles):
        return None
    best = None
    for tried in fits_near_angles(camera, rotation, angles):
        if tried.explained <= explained:
            continue
        if abs(float(np.linalg.norm(tried.fit.scene.motion.rotation)) - size) < _SAME_ANGLE * size:
            return None
        best, explained = tried.fit, tried.explained
        if tried.convincing:
            break
    return best


def likely_angles(camera: FitProblem, rotation: FloatArray) -> list[float]:
    """Return the likely rotation angles (rad) about the axis of `rotation` (3,), from scans of the frame.

    Bright streaks show the angle best, unless the light along them varies. A second scan therefore limits the
    samples.
    """
    angles: list[float] = []
    for cap in (np.inf, FRAME_CAP):
        camera.work.passed(camera.frame.signal.size)
        angles += frame_angles(camera.frame, camera.pinhole, rotation, _MOST_ANGLES, cap)
    return angles


def fits_near_angles(camera: FitProblem, rotation: FloatArray, angles: list[float]) -> Iterator[_FirstFit]:
    """Yield preliminary fits with rotation angles near `angles` (rad) about the axis of `rotation` (3,)."""
    settings, pinhole = camera.settings, camera.pinhole
    nothing = np.empty(0, dtype=np.int64), np.empty(0, dtype=np.float32)
    frame = polar_grid(pinhole, CameraMotion.steady(rotation)).frame
    for angle in angles:
        if camera.work.exhausted:
            return
        camera.work.passed(camera.frame.signal.size)
        motion = CameraMotion.steady(frame[2] * angle)
        found = find_faint(camera.frame, nothing, pinhole, motion, settings.faint_sigmas, settings.most_faint)
        bright = np.argsort(-found.light, kind="stable")[:SCANNED_STARS]
        if len(bright) < settings.least_stars:
            continue
        x, y, z = frame @ pinhole.ideal.unit_vectors(found.stars[bright]).T
        circles = Circles(frame, z, np.arctan2(y, x))
        for best, stars, light in scan_angles(camera.frame, pinhole, circles, 1, angle):
            if len(light[:_FIRST_STARS]) < settings.least_stars:
                continue
            motion = CameraMotion.steady(frame[2] * best)
            tried = _tried(camera, MotionGuess(motion, stars[:_FIRST_STARS], light[:_FIRST_STARS], 0.0))
            if tried is not None:
                yield _disturbed(camera, tried) if tried.shaken else tried


def has_angle(rotation: FloatArray, angles: list[float]) -> bool:
    """Return whether the angle of `rotation` (3,) equals the most likely angle in `angles` (rad)."""
    size = float(np.linalg.norm(rotation))
    return bool(angles) and abs(size - angles[0]) < _SAME_ANGLE * size


def alike(one: FloatArray, other: FloatArray) -> bool:
    """Return whether two rotation vectors (3,) are equal or opposite within the tolerance `_SAME_MOTION`."""
    apart = min(np.linalg.norm(one - other), np.linalg.norm(one + other))
    return float(apart) < _SAME_MOTION * float(np.linalg.norm(one))


def _guesses(camera: FitProblem, regions: BrightRegions, near: float | None) -> Iterator[MotionGuess]:
    """Yield initial guesses of the motion, in descending order of likelihood.

    The rotation angles are derived from streak lengths if many streaks are complete, otherwise from a scan.
    """
    guess = find_axis(regions, camera.pinhole)
    if guess is None:
        return
    if camera.course is not None:
        known = motion_by_course(camera.course, regions, camera.pinhole, _FIRST_STARS)
        if len(known.light) >= camera.settings.least_stars:
            yield known
    growth = 0.0 if camera.settings.rate_model == "constant" else measured_rate_change(guess, regions)
    if growth:
        growing = motions_by_length(guess, regions, camera.pinhole, _FIRST_STARS, growth)
        yield from islice(growing, _MOST_GROWING)
    voted = motions_by_length(guess, regions, camera.pinhole, _FIRST_STARS)
    first = list(islice(voted, 1))
    if first and len(first[0].light) >= _WHOLE and first[0].contradicted < _CONTRADICTED:
        yield first.pop()
    yield from motions_by_scan(guess, camera.frame, camera.pinhole, _FIRST_STARS, near)
    yield from chain(first, voted)


@dataclass(frozen=True, slots=True, eq=False)
class _FirstFit:
    """Fit of the motion to the brightest stars, starting from the initial guess `guess`.

    Attributes:
        ends: fraction of confirmed streak ends, or of unbroken streaks if that is smaller.
        explained: chi-square that the fit explains.
        convincing: whether the fit is accepted without comparison with other fits.
        shaken: whether the residuals may show a vibration or another profile of the PSF.
    """

    fit: StreakFit
    guess: MotionGuess
    ends: float
    explained: float
    convincing: bool
    shaken: bool = False


def _tried(camera: FitProblem, guess: MotionGuess) -> _FirstFit | None:
    """Return the fit of a smooth motion that starts from `guess`, or None if the fit does not succeed."""
    motion = guess.motion if camera.course is None else camera.course.scaled_to(guess.motion.rotation)
    motion = motion if camera.sense is None else motion.directed(camera.sense)
    stars = mid_exposure_positions(camera.pinhole, motion, camera.shutter, guess.stars)
    scene = StreakScene.of(motion, camera.sigma, stars, guess.light)
    camera = replace(camera, growing=not motion.constant)
    done = iterate(camera, scene, camera.free, FIRST)
    if done is None:
        return None
    correct = true_ends(camera, done.scene)
    judged = correct[np.isfinite(correct)], unbroken(camera, done.scene)
    ends = min(float(np.mean(each)) if len(each) else 1.0 for each in judged)
    shaken = ends > _IN_PLACE and misfit(done.evaluation) > _SHAKEN
    return replace(_judged(done, guess, ends), shaken=shaken)


def _disturbed(camera: FitProblem, first: _FirstFit) -> _FirstFit:
    """Return the fit `first` with a vibration if its residuals show one.

    If the fit is still poor, a profile of the PSF is learned in addition.
    """
    camera = replace(camera, growing=bool(first.fit.free[3]))
    done = with_vibration(camera, first.fit) or first.fit
    found = _judged(done, first.guess, first.ends)
    if not found.convincing and misfit(done.evaluation) > _WORST_FIRST:
        learned = fit_profile(camera, done)
        found = found if learned is None else _judged(learned, first.guess, first.ends)
    return found


def _judged(done: StreakFit, guess: MotionGuess, ends: float) -> _FirstFit:
    """Return the fit with the chi-square that it explains, and whether it is convincing."""
    # With a wrong rotation angle, the model has large residuals at one end of each streak.
    light = done.scene.light**2 / np.maximum(done.solution.joint[:, LIGHT, LIGHT], 1e-30)
    residual = done.evaluation.chi2 - done.evaluation.pixels
    good = residual < _MOST_RESIDUAL * light + done.evaluation.pixels
    calm = 1.0 if done.last_step < _CALM else 0.3
    evidence, share = calm * float(np.sum(np.minimum(light, _ENOUGH**2)[good])), float(np.mean(good))
    explained = evidence * (1.0 - _CONTRADICTION * guess.contradicted) * max(ends - _ENDS_BY_CHANCE, 0.02)
    convincing = explained > _EVIDENT and share > _EXPLAINED and ends > _IN_PLACE
    return _FirstFit(done, guess, ends, explained, convincing and len(guess.light) >= _MANY)


def with_vibration(camera: FitProblem, fit: StreakFit) -> StreakFit | None:
    """Return a preliminary fit that includes a vibration, or None if the residuals show no vibration.

    With a tolerance larger than that of the final fit, residuals of bright stars would look like faint stars.
    """
    limits = replace(FIRST, tolerance=LAST.tolerance)
    return fit_vibration(
        camera, fit, lambda scene: iterate(camera, scene, camera.free, limits, camera.windows(scene))
    )
