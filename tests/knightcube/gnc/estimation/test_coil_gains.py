"""Tests of the fit of coil gains with nuisance parameters under several hypotheses."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.gnc.estimation.rigid_body import fitted_gains, whitenings
from tests.support.compiled_forms import assert_forms_agree


def _problem(coils: int, others: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return equations (2, 40, p + n + 1), prior weights (p,) and (h, n), and expected gains (h, n)."""
    rng = np.random.default_rng(10 * coils + others)
    rows = rng.standard_normal((2, 40, others + coils + 1)) * np.geomspace(0.1, 10.0, others + coils + 1)
    weights = rng.uniform(0.01, 1000.0, (2 * coils + 2, coils))
    return rows, rng.uniform(0.1, 10.0, others), weights, rng.choice([-1.0, 1.0], weights.shape)


@pytest.mark.parametrize(("coils", "others"), [(3, 2), (3, 16), (4, 6), (1, 0)])
def test_gains_and_costs_equal_a_least_squares_solution_that_contains_the_priors(
    coils: int, others: int
) -> None:
    rows, prior, weights, expected = _problem(coils, others)
    gains, variances, costs, other = fitted_gains(rows.transpose(0, 2, 1) @ rows, prior, weights, expected)
    for place in range(2):
        for k, (weight, value) in enumerate(zip(weights, expected, strict=True)):
            root = np.sqrt(np.concatenate([prior, weight]))
            matrix = np.vstack([rows[place, :, :-1], np.diag(root)])
            right = np.concatenate([rows[place, :, -1], np.zeros(others), np.sqrt(weight) * value])
            found, (cost,), _, _ = np.linalg.lstsq(matrix, right)
            covariance = np.linalg.inv(matrix.T @ matrix)
            assert gains[place, k] == pytest.approx(found[others:], rel=1e-8, abs=1e-10)
            assert variances[place, k] == pytest.approx(covariance.diagonal()[others:], rel=1e-8)
            assert costs[place, k] == pytest.approx(cost, rel=1e-8)
            if k == 0:
                assert other[place] == pytest.approx(found[:others], rel=1e-7, abs=1e-9)


@pytest.mark.parametrize(("coils", "others"), [(3, 2), (3, 16)])
def test_the_loop_form_of_the_fit_equals_the_numpy_form(coils: int, others: int) -> None:
    rows, prior, weights, expected = _problem(coils, others)
    assert_forms_agree(fitted_gains, rows.transpose(0, 2, 1) @ rows, prior, weights, expected)


def test_whitened_differences_have_unit_variance_except_for_their_constant_part() -> None:
    independent, variance, walk = 2.0, 3.0, 0.5
    covariance = (independent + 2.0 * variance) * np.eye(6) + walk * np.minimum.outer(
        np.arange(1, 7), np.arange(1, 7)
    )
    covariance -= variance * (np.eye(6, k=1) + np.eye(6, k=-1))
    long, short = whitenings((6, 4), independent, variance, walk)
    white = long @ covariance @ long.T
    assert white @ white == pytest.approx(white, abs=1e-12), "the covariance is a projection"
    assert np.trace(white) == pytest.approx(5.0)
    assert long @ np.ones(6) == pytest.approx(np.zeros(6), abs=1e-12)
    assert not short[:2].any()
    assert not short[:, :2].any()
    assert short[2:, 2:] @ np.ones(4) == pytest.approx(np.zeros(4), abs=1e-12)
