"""Least squares fit of the gains of coils under several hypotheses, with nuisance parameters.

The observed accelerations are linear in the gains and in other parameters, such as errors of the inertia. The
other parameters have a Gaussian prior and are eliminated, which leaves normal equations for the gains. A
hypothesis states the expected gain of each coil and the prior weight (inverse variance) of this gain. The
cost of a hypothesis is the weighted sum of the squared residuals of its fit.
"""

from __future__ import annotations

import functools
import math

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.compiled import compiled_form_of, loop_helper


@functools.lru_cache(maxsize=256)
def whitenings(counts: tuple[int, ...], independent: float, variance: float, walk: float) -> FloatArray:
    """Return matrices (w, m, m), each of which whitens the newest differences of bins, as `_whitening` does.

    The number of differences is m for the first matrix, and `counts` contains the numbers for all matrices.
    The elements for earlier differences are zero. The other arguments are those of `_whitening`.
    """
    matrices = np.zeros((len(counts), counts[0], counts[0]))
    for matrix, count in zip(matrices, counts, strict=True):
        matrix[-count:, -count:] = _whitening(count, independent, variance, walk)
    return matrices


def _whitening(count: int, independent: float, variance: float, walk: float) -> FloatArray:
    """Return the matrix (m, m) that whitens the differences of bins and removes their constant part.

    Args:
        count: number m of differences between bins.
        independent: variance of the independent errors of the differences.
        variance: variance of the rate of a bin, divided by the squared time between bins.
        walk: increase per bin of the variance of the disturbance, which is a random walk.
    """
    covariance = (independent + 2.0 * variance) * np.eye(count)
    covariance -= variance * (np.eye(count, k=1) + np.eye(count, k=-1))
    number = np.arange(1, count + 1)
    covariance += walk * np.minimum(number[:, None], number)
    whitening = np.linalg.inv(np.linalg.cholesky(covariance))
    constant = whitening.sum(axis=1)
    constant /= math.sqrt(float(constant @ constant))
    return np.asarray(whitening - np.outer(constant, constant @ whitening))


def _fitted_numpy(
    normal: FloatArray, prior: FloatArray, weights: FloatArray, expected: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Fit n gains and p other parameters under k hypotheses, separately for w sets of equations.

    Args:
        normal: normal equations (w, p + n + 1, p + n + 1): products of the whitened coefficients of the other
            parameters, of the gains and of the right-hand side with each other.
        prior: prior weights (p,) of the other parameters, whose expected values are zero.
        weights: prior weights (k, n) of the gains.
        expected: expected gains (k, n), 1 or -1.

    Returns:
        Gains (w, k, n), variances (w, k, n) of the gains, costs (w, k), and the other parameters (w, p) for
        the first hypothesis. A cost includes the deviations from the expected values.
    """
    others, coils = len(prior), weights.shape[1]
    mixed = normal[:, :others, others:]
    coupling = np.linalg.solve(normal[:, :others, :others] + np.diag(prior), mixed)
    reduced = normal[:, others:, others:] - mixed.transpose(0, 2, 1) @ coupling
    # The weighted sum of squares at gains g is g S g - 2 t g + c. The matrix `reduced` contains S, the vector
    # t as last row and column, and c as last element.
    matrices = reduced[:, None, :coils, :coils] + weights[:, :, None] * np.eye(coils)
    covariance = np.linalg.inv(matrices)
    rights = reduced[:, None, coils, :coils] + weights * expected
    gains = (covariance @ rights[..., None])[..., 0]
    # The prior adds weight * (gain - expected)^2 to the cost for each gain.
    # Expected gains are 1 or -1, so the term weight * expected^2 equals the weight.
    costs = reduced[:, coils, coils, None] + weights.sum(axis=1) - (rights * gains).sum(axis=2)
    other = coupling[:, :, coils] - (coupling[:, :, :coils] @ gains[:, 0, :, None])[..., 0]
    variances: FloatArray = np.array(covariance.diagonal(axis1=2, axis2=3), dtype=np.float64)
    return gains, variances, costs, other


@compiled_form_of(_fitted_numpy)
def fitted(
    normal: FloatArray, prior: FloatArray, weights: FloatArray, expected: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """See `_fitted_numpy`."""
    others, (count, coils) = len(prior), weights.shape
    gains, variances = np.zeros((len(normal), count, coils)), np.zeros((len(normal), count, coils))
    costs, other = np.zeros((len(normal), count)), np.zeros((len(normal), others))
    for place in range(len(normal)):
        rows = normal[place].copy()
        for i in range(others):
            rows[i, i] += prior[i]
        _eliminate(rows, others)
        right = rows[others:-1, -1]
        for k in range(count):
            covariance = rows[others:-1, others:-1].copy()
            for i in range(coils):
                covariance[i, i] += weights[k, i]
            _invert(covariance)
            costs[place, k] = rows[-1, -1]
            for i in range(coils):
                for j in range(coils):
                    gains[place, k, i] += covariance[i, j] * (right[j] + weights[k, j] * expected[k, j])
                variances[place, k, i] = covariance[i, i]
                costs[place, k] += weights[k, i]
                costs[place, k] -= (right[i] + weights[k, i] * expected[k, i]) * gains[place, k, i]
        for i in range(others - 1, -1, -1):
            value = rows[i, -1]
            for j in range(i + 1, others):
                value -= rows[i, j] * other[place, j]
            for j in range(coils):
                value -= rows[i, others + j] * gains[place, 0, j]
            other[place, i] = value / rows[i, i]
    return gains, variances, costs, other


@loop_helper
def _eliminate(rows: FloatArray, count: int) -> None:
    """Eliminate the first `count` unknowns of symmetric equations (m, m) in place, without pivoting."""
    for k in range(count):
        for i in range(k + 1, len(rows)):
            factor = rows[i, k] / rows[k, k]
            for j in range(k + 1, len(rows)):
                rows[i, j] -= factor * rows[k, j]


@loop_helper
def _invert(matrix: FloatArray) -> None:
    """Invert a positive definite matrix (n, n) in place by the Gauss-Jordan method, without pivoting."""
    for k in range(len(matrix)):
        pivot = matrix[k, k]
        matrix[k, k] = 1.0
        for j in range(len(matrix)):
            matrix[k, j] /= pivot
        for i in range(len(matrix)):
            factor = matrix[i, k]
            if i != k:
                matrix[i, k] = 0.0
                for j in range(len(matrix)):
                    matrix[i, j] -= factor * matrix[k, j]
