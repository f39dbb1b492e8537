"""Tests of status, sign and time reversal of results, and of the checks of arguments."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.errors import KnightCubeError
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks.streak_result import (
    REASONS,
    MotionResult,
    StreakStatus,
    admit,
    direction_of_time,
    in_time,
    validate,
)

_RATE = np.array([0.0, 0.02, 0.01])
_ENDS = np.arange(12.0).reshape(3, 2, 2)


def _result() -> MotionResult:
    return MotionResult(
        StreakStatus.AMBIGUOUS,
        1,
        0.5,
        endpoints=_ENDS,
        used=np.array([True, False, True]),
        rate=_RATE,
        stars=_ENDS.mean(axis=1),
        directions=np.arange(27.0).reshape(3, 3, 3),
        line_time_sigma=1e-5,
    )


def test_a_sufficient_prior_decides_the_direction_of_time() -> None:
    assert direction_of_time(_RATE, 0.1 * _RATE, 5e-4, 3.0) == 1
    assert direction_of_time(_RATE, -0.1 * _RATE, 5e-4, 3.0) == -1
    assert direction_of_time(_RATE, 0.1 * _RATE, 1e-3, 3.0) == 0


def test_a_result_is_reversed_by_a_prior_of_the_other_sense() -> None:
    same = in_time(_result(), _RATE, 1e-3, 3.0)
    assert same.status is StreakStatus.RATE
    np.testing.assert_array_equal(same.endpoints, _ENDS)
    other = in_time(_result(), -_RATE, 1e-3, 3.0)
    assert other.status is StreakStatus.RATE
    np.testing.assert_array_equal(other.rate, -_RATE)
    np.testing.assert_array_equal(other.endpoints, _ENDS[:, ::-1])
    np.testing.assert_array_equal(other.directions, _result().directions[:, ::-1])
    assert in_time(_result(), None, 0.0, 3.0).status is StreakStatus.AMBIGUOUS


def test_counts_and_displacements_follow_the_streaks() -> None:
    result = _result()
    assert (result.found, result.used_count) == (3, 2)
    chosen = np.array([0, 2])
    moved = result.line_time_displacement(chosen, 1.0)
    delay = 1e-5 / 0.5 * (result.stars[chosen, 1] - 1.0)
    np.testing.assert_allclose(moved, np.array([[2.0, 2.0], [2.0, 2.0]]) * delay[:, None])
    exact = MotionResult(StreakStatus.RATE, 1, 0.5)
    assert exact.line_time_displacement(np.arange(0), 0.0).shape == (0, 2)
    assert exact.start_to_end is None


def test_unusable_frames_have_a_status() -> None:
    noise = np.random.default_rng(1).integers(90, 110, (40, 40)).astype(np.uint16)
    checksum, status = admit(noise, None, 4095.0, 0.25)
    assert status is None
    assert admit(noise, checksum, 4095.0, 0.25) == (checksum, StreakStatus.FROZEN)
    assert admit(np.full_like(noise, 7), None, 4095.0, 0.25)[1] is StreakStatus.BLACK
    assert admit(np.full_like(noise, 4095) - (noise > 100), None, 4094.0, 0.25)[1] is StreakStatus.SATURATED


def test_every_status_without_a_rate_has_a_reason() -> None:
    assert set(REASONS) == set(StreakStatus) - {StreakStatus.RATE, StreakStatus.AMBIGUOUS}


@pytest.mark.parametrize(
    ("shape", "exposure", "prior", "sigma", "named"),
    [
        ((40, 41), 1.0, None, 0.0, "shape"),
        ((40, 40), 0.0, None, 0.0, "exposure"),
        ((40, 40), np.nan, None, 0.0, "exposure"),
        ((40, 40), 1.0, np.array([0.0, np.nan, 0.0]), 0.0, "prior_rate"),
        ((40, 40), 1.0, np.zeros(2), 0.0, "prior_rate"),
        ((40, 40), 1.0, np.zeros(3), -1.0, "prior_sigma"),
        ((40, 40), 1.0, np.zeros(3), np.nan, "prior_sigma"),
    ],
)
def test_invalid_arguments_are_named(
    shape: tuple[int, int], exposure: float, prior: np.ndarray | None, sigma: float, named: str
) -> None:
    pinhole = Pinhole(40, 40, 100.0)
    with pytest.raises(KnightCubeError, match=named):
        validate(np.zeros(shape, np.uint16), pinhole, exposure, prior, sigma)
    with pytest.raises(KnightCubeError, match="unsigned"):
        validate(np.zeros((40, 40)), pinhole, 1.0, None, 0.0)
