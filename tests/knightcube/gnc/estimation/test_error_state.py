"""Tests of the declaration of the error state, and of the Kalman update that all filters share."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.errors import UsageError
from knightcube.gnc.estimation.error_state import (
    CONTRADICTED,
    ErrorState,
    PriorCheck,
    Role,
    StateBlock,
    gate_bounds,
    joined,
    updated,
    weigh,
    with_role,
)

BLOCKS = [
    StateBlock("rate", np.array([0.1, 0.2, 0.3]), 1e-3),
    StateBlock("bias", np.array([[0.04, 0.01], [0.01, 0.09]]), np.array([1e-4, 2e-4])),
    StateBlock("age", np.array([0.5])),
]


def problem(measured: int, seed: int = 3) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return a covariance (6, 6), and an innovation with its Jacobian and noise."""
    rng = np.random.default_rng(seed)
    root, noise = rng.standard_normal((6, 6)), rng.standard_normal((measured, measured))
    rows = rng.standard_normal((measured, 6))
    return root @ root.T, rng.standard_normal(measured), rows, noise @ noise.T + 0.1 * np.eye(measured)


def joseph(covariance: FloatArray, gain: FloatArray, rows: FloatArray, noise: FloatArray) -> FloatArray:
    """Return the covariance after a correction with any gain, by Joseph's form."""
    keep = np.eye(len(covariance)) - gain @ rows
    return np.asarray(keep @ covariance @ keep.T + gain @ noise @ gain.T)


@pytest.mark.parametrize("measured", [1, 2, 3])
def test_the_gain_is_optimal_and_the_square_is_that_of_the_innovation(measured: int) -> None:
    covariance, value, rows, noise = problem(measured)
    square, gain, cross, spread = weigh(covariance, value, rows, noise)
    whole = rows @ covariance @ rows.T + noise
    np.testing.assert_allclose(spread, whole, rtol=1e-12)
    np.testing.assert_allclose(gain, covariance @ rows.T @ np.linalg.inv(whole), rtol=1e-9)
    assert square == pytest.approx(value @ np.linalg.solve(whole, value), rel=1e-9)
    after = updated(covariance, gain, cross, spread)
    np.testing.assert_allclose(
        after, np.linalg.inv(np.linalg.inv(covariance) + rows.T @ np.linalg.solve(noise, rows)), rtol=1e-6
    )


@pytest.mark.parametrize("scale", [0.0, 0.4, 1.0, 1.7])
def test_the_update_with_any_gain_is_josephs_and_exactly_symmetric(scale: float) -> None:
    covariance, value, rows, noise = problem(3)
    weighed = weigh(covariance, value, rows, noise)
    gain = weighed.gain * np.linspace(scale, 1.0, 6)[:, None]
    after = updated(covariance, gain, weighed.cross, weighed.spread)
    np.testing.assert_allclose(after, joseph(covariance, gain, rows, noise), rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(after, after.T)


def test_a_considered_block_is_not_corrected_and_keeps_its_covariance() -> None:
    layout = ErrorState(with_role(BLOCKS, {"bias": Role.CONSIDERED}))
    covariance, value, rows, noise = problem(2)
    weighed = weigh(covariance, value, rows, noise)
    gain = layout.estimated(weighed.gain)
    after = updated(covariance, gain, weighed.cross, weighed.spread)
    assert not gain[3:5].any()
    np.testing.assert_array_equal(gain[:3], weighed.gain[:3])
    np.testing.assert_allclose(after[3:5, 3:5], covariance[3:5, 3:5], rtol=1e-12)
    optimal = updated(covariance, weighed.gain, weighed.cross, weighed.spread)
    np.testing.assert_allclose(after[:3], optimal[:3], rtol=1e-9, atol=1e-12)


def test_the_blocks_of_the_state_are_consecutive_and_a_fixed_block_is_known() -> None:
    layout = ErrorState(with_role(BLOCKS, {"rate": Role.FIXED}))
    assert layout.sizes == {"rate": 3, "bias": 2, "age": 1}
    np.testing.assert_array_equal(layout.prior[3:5, 3:5], [[0.04, 0.01], [0.01, 0.09]])
    np.testing.assert_allclose(layout.prior.diagonal(), [0.0, 0.0, 0.0, 0.04, 0.09, 0.25])
    np.testing.assert_allclose(layout.walks, [0.0, 0.0, 0.0, 1e-8, 4e-8, 0.0])
    assert layout.considered is None


def test_two_blocks_with_one_name_and_a_role_without_a_block_are_refused() -> None:
    with pytest.raises(UsageError, match="two blocks of the error state have the same name"):
        ErrorState([BLOCKS[0], BLOCKS[0]])
    with pytest.raises(UsageError, match="has no block camera"):
        with_role(BLOCKS, {"camera": Role.FIXED})


def test_the_first_attitude_and_rate_have_the_errors_of_the_states_on_which_they_depend() -> None:
    rng = np.random.default_rng(5)
    prior, by_states, first = np.zeros((8, 8)), np.zeros((6, 8)), np.diag(np.arange(1.0, 7.0))
    root = rng.standard_normal((2, 2))
    prior[6:, 6:], by_states[:, 6:] = root @ root.T, rng.standard_normal((6, 2))
    errors = np.zeros((8, 8))
    errors[:6, :6], errors[6:, 6:] = np.sqrt(first), root
    errors[:6, 6:] = by_states[:, 6:] @ root
    np.testing.assert_allclose(joined(prior, by_states, first), errors @ errors.T, atol=1e-12)


def test_the_gate_of_one_component_is_the_square_of_its_standard_deviations() -> None:
    assert gate_bounds(5.0)[1] == pytest.approx(25.0)
    assert gate_bounds(5.0)[1] < gate_bounds(5.0)[2] < gate_bounds(5.0)[3]


@pytest.mark.parametrize(("variance", "found"), [(1.0, False), (1.2, False), (2.2, True), (30.0, True)])
def test_learned_states_are_contradicted_by_consistent_innovations_and_not_by_outliers(
    variance: float, found: bool
) -> None:
    check, squares = PriorCheck(), variance * np.random.default_rng(3).chisquare(3, 600)
    squares[10:13], squares[20] = 1e6, np.nan
    times = [time for time, square in enumerate(squares) if check.add(time, square)]
    assert bool(times) is found
    if found:
        assert CONTRADICTED <= times[0] <= CONTRADICTED + 2
        assert len(times) == 1, "a pause follows"


def test_few_innovations_contradict_nothing() -> None:
    check = PriorCheck()
    assert not any(check.add(10.0 * number, 100.0) for number in range(39))
    assert check.add(390.0, 100.0)


@pytest.mark.parametrize("size", [2, 3])
def test_an_innovation_of_singular_covariance_has_no_finite_square(size: int) -> None:
    """The gate of a filter rejects a normalised squared innovation that is not finite."""
    assert np.isnan(weigh(np.zeros((6, 6)), np.ones(size), np.eye(6)[:size], np.zeros((size, size))).square)
