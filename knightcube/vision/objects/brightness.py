"""Weights of the pixels of a frame, and the brightnesses of streaks that best explain the pixels.

The brightnesses are fitted by non-negative least squares. The weight of a pixel is the reciprocal of its
standard deviation, which includes background noise, photon noise and the model error of bright streaks.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.linalg import lapack
from scipy.optimize import nnls

from knightcube.astro.arrays import BoolArray, FloatArray, Image, IntArray
from knightcube.compiled import compiled_form_of, loop_helper
from knightcube.errors import KnightCubeError

SHAPE_ERROR = 0.1
"""Error of a bright streak's modelled counts, as a fraction, due to errors of ends, PSF and uniformity."""
# Regularisation of the fit of brightnesses: number added to the unit diagonal of the normal equations.
_RIDGE = 1e-10
# Gradient, relative to the largest right-hand side, below which a brightness remains zero.
_OPTIMAL = 1e-12
# Maximum number of iterations of the fit, divided by the number of brightnesses.
_ITERATIONS = 30


def _pixel_weights_numpy(
    signal: FloatArray, level: float, noise: float, gain: float, saturation: float
) -> FloatArray:
    light = np.maximum(signal, 0.0)
    clipped = signal + level >= 0.95 * saturation
    error = np.sqrt(noise**2 + light / gain + (SHAPE_ERROR * light) ** 2)
    return np.where(clipped, 0.0, 1.0 / error)


@compiled_form_of(_pixel_weights_numpy)
def pixel_weights(
    signal: FloatArray, level: float, noise: float, gain: float, saturation: float
) -> FloatArray:
    """Return the reciprocal standard deviations of pixels with `signal` counts above the background `level`.

    The standard deviation includes the noise of the background (`noise`, counts), photon noise (`gain` in
    electrons per count) and the model error of bright streaks. Pixels above 95 % of the `saturation` counts
    have the weight 0. The arrays of the signal and of the result have the shape (rows, columns).
    """
    weight = np.zeros(signal.shape)
    for row in range(signal.shape[0]):
        for column in range(signal.shape[1]):
            light = max(signal[row, column], 0.0)
            if signal[row, column] + level < 0.95 * saturation:
                variance = noise * noise + light / gain + (SHAPE_ERROR * light) ** 2
                weight[row, column] = 1.0 / math.sqrt(variance)
    return weight


def _counts_at_numpy(
    image: Image, pixels: IntArray, level: float, noise: float, gain: float, saturation: float
) -> tuple[FloatArray, FloatArray, float]:
    signal = image[pixels[:, 1], pixels[:, 0]].astype(np.float64)
    weight = _pixel_weights_numpy(signal, level, noise, gain, saturation)
    return signal, weight, float(np.sum((noise**2 + np.maximum(signal, 0.0) / gain) * weight**2))


@compiled_form_of(_counts_at_numpy)
def counts_at(
    image: Image, pixels: IntArray, level: float, noise: float, gain: float, saturation: float
) -> tuple[FloatArray, FloatArray, float]:
    """Return the counts (p,) above the background and the weights (p,) of pixels, and expected chi-square.

    Each pixel contributes to the expected chi-square the fraction of its variance that is due to background
    noise and photon noise. The image (rows, columns) contains the counts above the background, and the pixels
    (p, 2) are given as (x, y). The other arguments are those of `pixel_weights`.
    """
    signal, weight, expected = np.empty(len(pixels)), np.zeros(len(pixels)), 0.0
    for p in range(len(pixels)):
        counts = float(image[pixels[p, 1], pixels[p, 0]])
        light = max(counts, 0.0)
        random = noise * noise + light / gain
        variance = random + (SHAPE_ERROR * light) ** 2
        signal[p] = counts
        if counts + level < 0.95 * saturation:
            weight[p] = 1.0 / math.sqrt(variance)
            expected += random * weight[p] * weight[p]
    return signal, weight, expected


def _equations_with_numpy(
    images: FloatArray, target: FloatArray, sums: FloatArray, line: FloatArray
) -> FloatArray:
    products = np.append(images @ line, line @ line)
    right = np.append(sums[-1], line @ target)
    whole = np.vstack([np.column_stack([sums[:-1], products[:-1]]), products, right])
    return np.asarray(whole)


@compiled_form_of(_equations_with_numpy)
def equations_with(images: FloatArray, target: FloatArray, sums: FloatArray, line: FloatArray) -> FloatArray:
    """Return the normal equations (k + 2, k + 1) of k images (k, p) and one more image `line` (p,).

    The array `sums` (k + 1, k) contains the normal equations of the k images, see `equations`.
    """
    size, first, last = len(images), 0, len(line)
    while first < last and line[first] == 0.0:
        first += 1
    while last > first and line[last - 1] == 0.0:
        last -= 1
    whole, own = np.empty((size + 2, size + 1)), line[first:last]
    for k in range(size):
        for other in range(size):
            whole[k, other] = sums[k, other]
        whole[size, k] = whole[k, size] = _dot(images[k, first:last], own, last - first)
        whole[size + 1, k] = sums[size, k]
    whole[size, size] = _dot(own, own, last - first)
    whole[size + 1, size] = _dot(own, target[first:last], last - first)
    return whole


def brightnesses(normal: FloatArray, right: FloatArray, power: float) -> tuple[FloatArray, float]:
    """Return the non-negative least-squares coefficients (k,) of k images, and the chi-square.

    The matrix `normal` (k, k) contains the scalar products of the weighted images with one another. The
    vector `right` (k,) contains the scalar products of these images with the weighted pixels of the frame.
    The argument `power` is the sum of the squares of the weighted pixels. Raises KnightCubeError if the
    equations are not positive definite, or if the solver does not converge.
    """
    brightness, decrease, failure = _non_negative(normal, right)
    if failure == _NOT_DEFINITE:
        raise KnightCubeError(
            f"brightnesses of {len(right)} streaks: the equations are not positive definite"
        )
    if failure == _NOT_CONVERGED:
        raise KnightCubeError(f"brightnesses of {len(right)} streaks: the fit does not converge")
    return brightness, max(power - decrease, 0.0)


def _equations_numpy(images: FloatArray, target: FloatArray) -> FloatArray:
    return np.vstack([images @ images.T, images @ target])


@compiled_form_of(_equations_numpy)
def equations(images: FloatArray, target: FloatArray) -> FloatArray:
    """Return the normal equations (k + 1, k) of the fit of k weighted images (k, p) to pixels `target` (p,).

    The first k rows are the matrix of the equations and the last row is their right-hand side.
    """
    size, pixels = images.shape
    # Most images are zero outside a small range of the pixels.
    first, last = np.empty(size, dtype=np.int64), np.empty(size, dtype=np.int64)
    sums = np.empty((size + 1, size))
    for k in range(size):
        first[k], last[k] = 0, pixels
        while first[k] < pixels and images[k, first[k]] == 0.0:
            first[k] += 1
        while last[k] > first[k] and images[k, last[k] - 1] == 0.0:
            last[k] -= 1
        own = slice(first[k], last[k])
        sums[size, k] = _dot(images[k, own], target[own], last[k] - first[k])
        for other in range(k + 1):
            low, high = max(first[k], first[other]), min(last[k], last[other])
            total = 0.0
            if low < high:
                total = _dot(images[k, low:high], images[other, low:high], high - low)
            sums[k, other] = sums[other, k] = total
    return sums


_NOT_DEFINITE, _NOT_CONVERGED = 1, 2


def _non_negative_numpy(normal: FloatArray, right: FloatArray) -> tuple[FloatArray, float, int]:
    scale = np.sqrt(np.maximum(normal.diagonal(), 1e-300))
    scaled = normal / scale / scale[:, None]
    scaled.reshape(-1)[:: len(scale) + 1] += _RIDGE
    # LAPACK is called directly, because the argument checks of numpy take longer than the routines.
    factor, failed = lapack.dpotrf(scaled, lower=1)
    if failed:
        return np.zeros(len(scale)), 0.0, _NOT_DEFINITE
    # The triangular system of k rows has the same least-squares solution as the system of all pixels.
    reduced, _ = lapack.dtrtrs(factor, right / scale, lower=1)
    try:
        brightness, residual = nnls(factor.T, reduced, maxiter=_ITERATIONS * len(scale))
    except RuntimeError:
        return np.zeros(len(scale)), 0.0, _NOT_CONVERGED
    return brightness / scale, float(reduced @ reduced - residual**2), 0


@compiled_form_of(_non_negative_numpy)
def _non_negative(normal: FloatArray, right: FloatArray) -> tuple[FloatArray, float, int]:
    """Return the non-negative solution (k,) of the normal equations of a least-squares fit of k images.

    The second result is the decrease of chi-square relative to a model without images. The third result is 0,
    or the failure `_NOT_DEFINITE` or `_NOT_CONVERGED`. The loop form is the active-set method of Lawson and
    Hanson (Solving Least Squares Problems, chapter 23) with the Cholesky factor of the equations of the
    positive coefficients.
    """
    size = len(right)
    scale, scaled, target = np.empty(size), np.empty((size, size)), np.empty(size)
    for k in range(size):
        scale[k] = math.sqrt(max(normal[k, k], 1e-300))
        target[k] = right[k] / scale[k]
    for k in range(size):
        for other in range(size):
            scaled[k, other] = normal[k, other] / (scale[k] * scale[other])
        # The regularisation keeps the equations invertible if images are equal or empty.
        scaled[k, k] += _RIDGE
    lower, order = np.zeros((size, size)), np.arange(size)
    solution = np.zeros(size)
    for k in range(size):
        if not _append_row(lower, scaled, order, k):
            return solution, 0.0, _NOT_DEFINITE
    # The vector `reduced` is the right-hand side of the triangular system of the unconstrained solution.
    reduced = np.empty(size)
    for k in range(size):
        reduced[k] = (target[k] - _dot(lower[k], reduced, k)) / lower[k, k]
    factor = np.zeros((size, size))
    converged = _set_positive(scaled, target, factor, order, solution)
    decrease = 0.0
    for k in range(size):
        off = reduced[k]
        for other in range(k, size):
            off -= lower[other, k] * solution[other]
        decrease += reduced[k] * reduced[k] - off * off
    return solution / scale, decrease, 0 if converged else _NOT_CONVERGED


@loop_helper
def _dot(first: FloatArray, second: FloatArray, count: int) -> float:
    """Return the scalar product of the first `count` elements of two arrays."""
    total = 0.0
    for k in range(count):
        total += first[k] * second[k]
    return total


@loop_helper
def _append_row(factor: FloatArray, matrix: FloatArray, order: IntArray, count: int) -> bool:
    """Append the row of image `order[count]` to a Cholesky factor, and return whether the factor exists."""
    own = order[count]
    for k in range(count):
        factor[count, k] = (matrix[own, order[k]] - _dot(factor[count], factor[k], k)) / factor[k, k]
    rest = matrix[own, own] - _dot(factor[count], factor[count], count)
    if not rest > 0.0:
        return False
    factor[count, count] = math.sqrt(rest)
    return True


@loop_helper
def _solve_positive(
    factor: FloatArray, target: FloatArray, order: IntArray, count: int, found: FloatArray
) -> None:
    """Set `found` to the coefficients of the images `order[:count]` whose Cholesky factor is `factor`."""
    for k in range(count):
        found[k] = (target[order[k]] - _dot(factor[k], found, k)) / factor[k, k]
    for k in range(count - 1, -1, -1):
        for other in range(k + 1, count):
            found[k] -= factor[other, k] * found[other]
        found[k] /= factor[k, k]


@loop_helper
def _steepest(
    matrix: FloatArray, target: FloatArray, solution: FloatArray, excluded: BoolArray
) -> tuple[int, float]:
    """Return the image that is not excluded and has the largest gradient, and the gradient."""
    best, largest = -1, 0.0
    for k in range(len(target)):
        if not excluded[k]:
            gradient = target[k] - _dot(matrix[k], solution, len(target))
            if gradient > largest:
                best, largest = k, gradient
    return best, largest


@loop_helper
def _set_positive(
    matrix: FloatArray, target: FloatArray, factor: FloatArray, order: IntArray, solution: FloatArray
) -> bool:
    """Set `solution` to the non-negative solution of the equations, and return whether it converged.

    The images with positive coefficients are the first in `order`, and `factor` is the Cholesky factor of
    their equations.
    """
    size, count, largest = len(target), 0, 0.0
    for k in range(size):
        largest = max(largest, abs(target[k]))
    found, excluded = np.zeros(size), np.zeros(size, dtype=np.bool_)
    for _ in range(_ITERATIONS * size):
        best, gradient = _steepest(matrix, target, solution, excluded)
        if gradient <= _OPTIMAL * largest:
            return True
        order[count] = best
        excluded[best] = True
        if not _append_row(factor, matrix, order, count):
            continue
        _solve_positive(factor, target, order, count + 1, found)
        # If the coefficient is not positive, its gradient was above zero only because of rounding errors.
        if found[count] > 0.0:
            count = _without_negative(matrix, target, factor, order, count + 1, found, solution)
            excluded[:] = False
            for k in range(count):
                excluded[order[k]] = True
    return False


@loop_helper
def _without_negative(
    matrix: FloatArray,
    target: FloatArray,
    factor: FloatArray,
    order: IntArray,
    count: int,
    found: FloatArray,
    solution: FloatArray,
) -> int:
    """Remove images until all coefficients `found` are positive, and return the number of images kept.

    On return, `solution` contains the coefficients of all images.
    """
    while True:
        part, first = 1.0, -1
        for k in range(count):
            if found[k] <= 0.0:
                before = solution[order[k]]
                share = before / (before - found[k]) if before > 0.0 else 0.0
                if first < 0 or share < part:
                    part, first = share, k
        for k in range(count):
            solution[order[k]] += part * (found[k] - solution[order[k]])
        if first < 0:
            return count
        solution[order[first]] = 0.0
        kept = 0
        for k in range(count):
            if solution[order[k]] > 0.0:
                order[kept] = order[k]
                _append_row(factor, matrix, order, kept)
                kept += 1
            else:
                solution[order[k]] = 0.0
        count = kept
        _solve_positive(factor, target, order, count, found)
