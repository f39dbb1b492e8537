"""By how much a frame's attitude differs from that of mid-exposure when the body speeds up or is shaken."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.vision.startracker.solution import (
    ENDS,
    MEAN,
    MIDDLE,
    NODES,
    Weighting,
    middle_covariance,
    weighting_of,
)
from knightcube.vision.streaks.streak_result import MotionResult, StreakResult, StreakStatus

_EXPOSURE = 2.0
_TIMES = _EXPOSURE * (np.array(NODES) - 0.5)
# Weights over time, from -1 to 1, that a weighting stands for: mean, ends, and the least squares' parabola.
_EVEN = np.linspace(-1.0, 1.0, 401)
_PARABOLA = np.linalg.pinv(np.stack([np.ones(401), _EVEN, _EVEN**2], axis=1))[0]
_WEIGHTS = {
    "mean": (MEAN, np.full(401, 1.0 / 401.0)),
    "ends": (ENDS, np.array([0.5, *np.zeros(399), 0.5])),
    "middle": (MIDDLE, _PARABOLA),
}


def _turns(*powers: float) -> FloatArray:
    """Return turns (4, 3) about x that go as a polynomial of time, without its constant."""
    angle = sum(factor * _TIMES ** (power + 1) for power, factor in enumerate(powers))
    return np.outer(angle, [1.0, 0.0, 0.0])


@pytest.mark.parametrize(("weighting", "part"), [(MEAN, 24.0), (ENDS, 8.0), (MIDDLE, np.inf)])
def test_a_steady_acceleration_draws_the_attitude_off_as_the_integral_says(
    weighting: Weighting, part: float
) -> None:
    """Of a t^2 / 2 the mean over T is a T^2 / 24, the ends are at a T^2 / 8, a parabola fitted at nothing."""
    acceleration = 0.3
    off = middle_covariance(weighting, _turns(0.0, 0.5 * acceleration), np.zeros((3, 3)), _EXPOSURE)
    assert off[0, 0] == pytest.approx((acceleration * _EXPOSURE**2 / part) ** 2, abs=1e-30)
    assert np.count_nonzero(off) == np.count_nonzero(off[0, 0])


@pytest.mark.parametrize("weighting", [MEAN, ENDS, MIDDLE])
def test_a_steady_rate_leaves_no_doubt_nor_does_what_is_odd_in_time(weighting: Weighting) -> None:
    assert middle_covariance(weighting, _turns(0.7, 0.0, 0.4), np.zeros((3, 3)), _EXPOSURE).max() < 1e-30


@pytest.mark.parametrize("name", list(_WEIGHTS))
def test_the_nodes_stand_for_the_whole_exposure(name: str) -> None:
    """To the fourth power of time they give what the fine weights do."""
    weighting, fine = _WEIGHTS[name]
    time = 0.5 * _EXPOSURE * _EVEN
    off = middle_covariance(weighting, _turns(0.0, 0.2, 0.0, 0.9), np.zeros((3, 3)), _EXPOSURE)
    assert np.sqrt(off[0, 0]) == pytest.approx(abs(fine @ (0.2 * time**2 + 0.9 * time**4)), rel=0.05)


@pytest.mark.parametrize("name", list(_WEIGHTS))
def test_white_acceleration_scatters_the_attitude_as_much_as_is_said(name: str) -> None:
    """Monte Carlo of 4,000 exposures, each side of the middle integrated twice; its variance to 10 %."""
    weighting, fine = _WEIGHTS[name]
    density, steps, trials = 0.03, 200, 4000
    step = 0.5 * _EXPOSURE / steps
    kicks = np.random.default_rng(1).standard_normal((2, trials, steps)) * np.sqrt(density * step)
    rate = np.cumsum(kicks, axis=2)
    angle = np.cumsum(rate, axis=2) * step
    away = np.concatenate([angle[0, :, ::-1], np.zeros((trials, 1)), angle[1]], axis=1)
    found = np.var(away @ fine)
    said = middle_covariance(weighting, np.zeros((4, 3)), density * np.eye(3), _EXPOSURE)
    assert found == pytest.approx(said[0, 0], rel=0.1)
    np.testing.assert_array_equal(said, said[0, 0] * np.eye(3))


def test_the_kind_of_motion_tells_how_the_attitude_comes_about() -> None:
    rest, moved = StreakStatus.TOO_SHORT, StreakStatus.RATE
    assert weighting_of(StreakResult(rest, 0, 1.0)) is MEAN
    assert weighting_of(MotionResult(rest, 0, 1.0)) is MEAN
    assert weighting_of(StreakResult(moved, 0, 1.0)) is ENDS
    assert weighting_of(MotionResult(StreakStatus.AMBIGUOUS, 0, 1.0)) is ENDS
    assert weighting_of(MotionResult(moved, 0, 1.0, rate_model="accelerating")) is MIDDLE
