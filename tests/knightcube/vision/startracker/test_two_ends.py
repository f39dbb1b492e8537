"""The thesis's own way: corner detectors' ends, identified, give two attitudes and the rate between them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import conjugate, from_rotation_vector, multiply, to_rotation_vector
from knightcube.vision.startracker.solution import FrameSolution, SolveStatus
from knightcube.vision.startracker.solve import AttitudePrior, SolveSettings
from knightcube.vision.startracker.two_ends import solve_ends
from knightcube.vision.streaks.corners.settings import DetectorName, StreakSettings
from knightcube.vision.streaks.corners.streak_rate import estimate_rate
from knightcube.vision.streaks.streak_result import StreakResult, StreakStatus
from tests.knightcube.vision.startracker.frames import NARROW, SkyFrame, sky, sky_frame

_EXPOSURE = 0.5
_STREAK_PX = 40.0


@cache
def _frame(seed: int) -> SkyFrame:
    return sky_frame(np.random.default_rng([31, seed]), _STREAK_PX, _EXPOSURE)


def _streaks(frame: SkyFrame, detector: DetectorName = "harris") -> StreakResult:
    settings = StreakSettings.of(detector)
    return estimate_rate(frame.pixels, NARROW.pinhole, frame.exposure, settings, frame.rate, 1e-6)


def _solve(found: StreakResult, prior: AttitudePrior | None = None) -> tuple[FrameSolution, StreakResult]:
    return solve_ends(found, NARROW.pinhole, (1.0, 1.0), sky(), SolveSettings(), prior)


def _error(solution: FrameSolution, truth: FloatArray) -> FloatArray:
    assert solution.fix is not None
    return to_rotation_vector(multiply(solution.fix.quaternion, conjugate(truth)))


@pytest.mark.parametrize("detector", ["harris", "minimum-eigenvalue", "trajkovic-4", "trajkovic-8"])
def test_the_streaks_of_every_detector_are_identified_and_both_ends_give_the_rate(
    detector: DetectorName,
) -> None:
    """The attitude to a third of a pixel, 15"; the rate to 2 %, the thesis's own figure."""
    frame = _frame(0)
    solution, found = _solve(_streaks(frame, detector))
    assert solution.status is SolveStatus.SOLVED
    assert len(solution.matched) >= 0.9 * found.used_count
    assert np.linalg.norm(_error(solution, frame.attitude)[:2]) < 0.33 / NARROW.pinhole.focal_length
    assert found.rate is not None
    assert np.linalg.norm(found.rate) == pytest.approx(np.linalg.norm(frame.rate), rel=0.02)


def test_the_errors_of_attitude_and_rate_are_of_the_size_that_they_are_said_to_be() -> None:
    """Ten frames of three degrees of freedom each: chi-square within its 1e-5 quantiles, twice as wide."""
    attitude, rate = 0.0, 0.0
    for seed in range(10):
        frame = _frame(seed)
        solution, found = _solve(_streaks(frame))
        assert solution.fix is not None
        assert found.rate is not None
        assert found.covariance is not None
        error = _error(solution, frame.attitude)
        attitude += float(error @ np.linalg.solve(solution.fix.covariance, error))
        error = found.rate - frame.rate
        rate += float(error @ np.linalg.solve(found.covariance, error))
    assert 4.0 < attitude < 140.0
    assert 4.0 < rate < 140.0


def test_a_wrong_direction_of_time_leaves_the_attitude_at_mid_exposure_and_turns_the_rate() -> None:
    """Which end was first no single frame tells: the middle is the same, the rate its opposite."""
    frame = _frame(1)
    streaks = _streaks(frame)
    turned = replace(streaks, endpoints=streaks.endpoints[:, ::-1])
    (solution, found), (other, back) = _solve(streaks), _solve(turned)
    assert solution.fix is not None
    assert np.linalg.norm(_error(other, solution.fix.quaternion)) < 1e-6
    assert found.rate is not None
    assert back.rate == pytest.approx(-found.rate, rel=1e-3, abs=1e-6)


def test_a_prior_tells_where_to_look() -> None:
    frame = _frame(1)
    near = multiply(from_rotation_vector(np.array([2e-4, 1e-4, -3e-4])), frame.attitude)
    solution, _ = _solve(_streaks(frame), AttitudePrior(near, 3e-4))
    assert solution.tracked
    assert np.linalg.norm(_error(solution, frame.attitude)[:2]) < 0.33 / NARROW.pinhole.focal_length


def test_streaks_of_no_sky_are_refused_and_their_rate_stays() -> None:
    """Mirrored ends are nowhere in the sky."""
    streaks = _streaks(_frame(2))
    mirrored = streaks.endpoints * np.array([-1.0, 1.0]) + np.array([NARROW.pinhole.columns - 1.0, 0.0])
    strewn = replace(streaks, endpoints=mirrored)
    solution, found = _solve(strewn)
    assert solution.status is SolveStatus.NO_MATCH
    assert solution.fix is None
    assert found is strewn


def test_no_streak_is_no_star() -> None:
    solution, _ = _solve(StreakResult(StreakStatus.TOO_FEW, 0, _EXPOSURE))
    assert solution.status is SolveStatus.NO_STARS
