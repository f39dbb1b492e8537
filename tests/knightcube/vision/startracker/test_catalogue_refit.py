"""Tests of the second fit, with all catalogue stars: accuracy, covariance, and rejection."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from functools import cache

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import conjugate, from_rotation_vector, multiply, to_rotation_vector
from knightcube.vision.startracker.catalogue_refit import refit_with_catalogue
from knightcube.vision.startracker.solve import (
    AttitudePrior,
    FrameSolution,
    SolveSettings,
    SolveStatus,
    solve_motion,
)
from knightcube.vision.streaks.estimate import estimate_motion
from knightcube.vision.streaks.streak_result import LikelihoodSettings
from sim_hal.star_camera import StarCameraModel
from tests.knightcube.vision.startracker.frames import SkyFrame, sky, sky_frame

_CAMERA = StarCameraModel(field_of_view=float(np.deg2rad(20.0)))
_LIKELIHOOD = LikelihoodSettings(saturation=float(_CAMERA.highest_count), gain=_CAMERA.gain, line_time=0.0)
_SETTINGS = SolveSettings(likelihood=_LIKELIHOOD)
_STREAK_PX, _EXPOSURE = 450.0, 0.2
_SEEDS = (5, 6, 8)
_MILKY_WAY = 16


@cache
def _first(seed: int, streak_px: float = _STREAK_PX) -> tuple[SkyFrame, FrameSolution]:
    """Return a frame with streaks of nearly half the field of view, and the solution of the first fit."""
    frame = sky_frame(np.random.default_rng([77, seed]), streak_px, _EXPOSURE, _CAMERA)
    motion = estimate_motion(frame.pixels, _CAMERA.pinhole, _EXPOSURE, _LIKELIHOOD, frame.rate, 0.0)
    prior = AttitudePrior(multiply(from_rotation_vector(np.array([2e-4, -1e-4, 1e-4])), frame.attitude), 3e-4)
    return frame, solve_motion(motion, _CAMERA.pinhole, (1.0, 1.0), sky(), _SETTINGS, prior)


@cache
def _second(seed: int) -> FrameSolution:
    frame, first = _first(seed)
    return refit_with_catalogue(frame.pixels, first, sky(), _SETTINGS, _LIKELIHOOD)


def _error(solution: FrameSolution, truth: FloatArray) -> FloatArray:
    assert solution.fix is not None
    return to_rotation_vector(multiply(solution.fix.quaternion, conjugate(truth)))


def _rate_error(solution: FrameSolution, frame: SkyFrame) -> float:
    assert solution.motion is not None
    assert solution.motion.rate is not None
    return float(np.linalg.norm(solution.motion.rate - frame.rate) / np.linalg.norm(frame.rate))


def test_the_second_fit_improves_attitude_and_rate() -> None:
    """The second fit has smaller rms errors of attitude and rate than the first fit, over three frames.

    In these frames, undetected stars bias the first fit.
    """
    errors = []
    for seed in _SEEDS:
        frame, first = _first(seed)
        bound = frame.attitude_bound(30)
        least = float(np.sqrt(bound[0, 0] + bound[1, 1]))
        both = first, _second(seed)
        errors.append([float(np.linalg.norm(_error(one, frame.attitude)[:2])) / least for one in both])
        errors[-1] += [_rate_error(one, frame) for one in both]
    before, after, rate_before, rate_after = np.sqrt(np.mean(np.square(errors), axis=0))
    assert after < 1.0
    assert after < 0.8 * before
    assert rate_after < 0.65 * rate_before


def test_stars_rejected_because_of_hidden_stars_are_accepted_again() -> None:
    for seed in _SEEDS:
        first, second = _first(seed)[1].motion, _second(seed).motion
        assert first is not None
        assert second is not None
        assert second.used_count > first.used_count


def test_the_errors_agree_with_the_covariance() -> None:
    """The normalised squared error is below the 99.9 % quantile of a chi-square with 9 degrees of freedom."""
    squares = 0.0
    for seed in _SEEDS:
        error, fix = _error(_second(seed), _first(seed)[0].attitude), _second(seed).fix
        assert fix is not None
        squares += float(error @ np.linalg.solve(fix.covariance, error))
    assert squares < 27.9


def test_the_second_fit_needs_little_memory_in_the_milky_way() -> None:
    """In the Milky Way, the second fit examines only close pairs of the 1200 stars, to save memory.

    The memory of the worker is limited.
    """
    frame, first = _first(_MILKY_WAY, 120.0)
    tracemalloc.start()
    try:
        refit_with_catalogue(frame.pixels, first, sky(), _SETTINGS, _LIKELIHOOD)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 45 * 2**20


def test_a_star_missing_in_the_catalogue_stays_untrusted() -> None:
    """A star that is missing in the catalogue is not trusted.

    The second brightest of the identified stars is removed from the catalogue.
    """
    frame, first = _first(_SEEDS[0])
    struck = int(np.sort(first.star[first.matched])[1])
    known = sky()
    kept = np.delete(np.arange(len(known.stars)), struck)
    stars = replace(
        known.stars,
        hip=known.stars.hip[kept],
        direction=known.stars.direction[kept],
        magnitude=known.stars.magnitude[kept],
    )
    without = replace(known, stars=stars, motion=known.motion[kept])
    number = np.where(np.isin(first.star, [-1, struck]), -1, np.searchsorted(kept, first.star))
    renumbered = replace(first, star=number)
    motion = refit_with_catalogue(frame.pixels, renumbered, without, _SETTINGS, _LIKELIHOOD).motion
    assert motion is not None
    assert motion is not first.motion
    place = first.points[first.star == struck][0]
    apart = np.linalg.norm(motion.stars - place, axis=1)
    assert apart.min() < 1.0
    assert not motion.used[apart.argmin()]


def test_a_contradicting_second_rate_is_rejected() -> None:
    """A second rate that contradicts the first rate is rejected.

    In the test, the first rate is wrong by 1 % but has a small covariance, so the correct second rate is
    rejected.
    """
    frame, first = _first(_SEEDS[0])
    motion = first.motion
    assert motion is not None
    assert motion.rate is not None
    assert motion.covariance is not None
    off = replace(first, motion=replace(motion, rate=1.01 * motion.rate))
    assert refit_with_catalogue(frame.pixels, off, sky(), _SETTINGS, _LIKELIHOOD) is off


def test_unsolved_uncalibrated_and_unstreaked_frames_are_not_fitted_again() -> None:
    frame, first = _first(_SEEDS[0])
    for other in (
        replace(first, status=SolveStatus.NO_MATCH),
        replace(first, scale_sigma=1e-4),
        replace(first, motion=None),
    ):
        assert refit_with_catalogue(frame.pixels, other, sky(), _SETTINGS, _LIKELIHOOD) is other
