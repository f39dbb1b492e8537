"""Gaussian derivatives, the structure tensor, the Harris response and the smaller eigenvalue."""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.vision.streaks.corners.corners import (
    gaussian_derivative_kernel,
    gaussian_kernel,
    gradient,
    harris_response,
    kernel_radius,
    minimum_eigenvalue,
    smoothed,
    structure_tensor,
)


def test_the_derivative_kernel_is_the_published_one_of_3_4() -> None:
    printed = np.array([[0.0466, 0, -0.0466], [0.3446, 0, -0.3446], [0.0466, 0, -0.0466]])
    kernel = np.outer(gaussian_kernel(0.5, 1), gaussian_derivative_kernel(0.5, 1))
    # 3.4 is written for convolution, which mirrors it.
    np.testing.assert_allclose(kernel[:, ::-1], printed, atol=5.5e-5)


def test_the_gradient_of_a_ramp_is_its_slope() -> None:
    y, x = np.mgrid[0:40, 0:50]
    gx, gy = gradient(3.0 * x - 2.0 * y, sigma=1.0)
    # The kernels are cut at three sigma: 3 % of the derivative's weight lies beyond.
    np.testing.assert_allclose(gx[8:-8, 8:-8], 3.0, rtol=0.03)
    np.testing.assert_allclose(gy[8:-8, 8:-8], -2.0, rtol=0.03)


def _by_hand(image: FloatArray, row: int, column: int, sigma: float, window: float) -> FloatArray:
    """Return the structure tensor (2, 2) at one pixel by plain double sums."""
    r, w = kernel_radius(sigma), kernel_radius(window)
    tensor = np.zeros((2, 2))
    for j in range(-w, w + 1):
        for i in range(-w, w + 1):
            g = np.zeros(2)
            for n in range(-r, r + 1):
                for m in range(-r, r + 1):
                    value = image[row + j + n, column + i + m]
                    bell = np.exp(-(m * m + n * n) / (2 * sigma**2)) / (2 * np.pi * sigma**2)
                    g += value * bell * np.array([m, n]) / sigma**2
            weight = np.exp(-(i * i + j * j) / (2 * window**2)) / (2 * np.pi * window**2)
            tensor += weight * np.outer(g, g)
    return tensor


def test_the_structure_tensor_equals_a_hand_computation() -> None:
    image = np.random.default_rng(1).normal(size=(25, 25))
    tensor = structure_tensor(image, 1.0, 1.5)
    expected = _by_hand(image, 12, 11, 1.0, 1.5)
    found = [[tensor.xx[12, 11], tensor.xy[12, 11]], [tensor.xy[12, 11], tensor.yy[12, 11]]]
    np.testing.assert_allclose(found, expected, rtol=1e-10)


def test_without_the_window_the_tensor_would_have_rank_one() -> None:
    image = np.random.default_rng(2).normal(size=(25, 25))
    gx, gy = gradient(image, 1.0)
    np.testing.assert_allclose(gx * gx * gy * gy - (gx * gy) ** 2, 0.0, atol=1e-12)
    tensor = structure_tensor(image, 1.0, 1.5)
    determinant = tensor.xx * tensor.yy - tensor.xy**2
    assert determinant.min() > 0.0


def test_the_harris_response_is_that_of_the_eigenvalues() -> None:
    image = np.random.default_rng(3).normal(size=(20, 20))
    tensor = structure_tensor(image, 1.0, 1.5)
    matrices = np.stack([np.stack([tensor.xx, tensor.xy], -1), np.stack([tensor.xy, tensor.yy], -1)], -2)
    low, high = np.moveaxis(np.linalg.eigvalsh(matrices), -1, 0)
    expected = low * high - 0.15 * (low + high) ** 2
    np.testing.assert_allclose(harris_response(tensor, 0.15), expected, rtol=1e-9, atol=1e-12)


def test_an_edge_answers_negative_and_a_corner_positive() -> None:
    image = np.zeros((40, 40))
    image[20:, 20:] = 1.0
    response = harris_response(structure_tensor(image, 1.0, 1.5))
    assert response[20, 35] < 0.0
    assert response[20, 20] > 0.0


def test_the_smaller_eigenvalue_is_numpys_of_the_summed_tensor() -> None:
    image = np.random.default_rng(4).normal(size=(20, 20))
    tensor = structure_tensor(image, 1.0, 1.5)
    matrices = np.stack([np.stack([tensor.xx, tensor.xy], -1), np.stack([tensor.xy, tensor.yy], -1)], -2)
    np.testing.assert_allclose(minimum_eigenvalue(tensor), np.linalg.eigvalsh(matrices)[..., 0], rtol=1e-9)


def test_the_smaller_eigenvalue_vanishes_on_an_edge_and_in_the_flat() -> None:
    image = np.zeros((40, 40))
    image[20:] = 1.0
    response = minimum_eigenvalue(structure_tensor(image, 1.0, 1.5))
    np.testing.assert_allclose(response, 0.0, atol=1e-15)
    image[:, :20] = 0.0
    corner = minimum_eigenvalue(structure_tensor(image, 1.0, 1.5))
    assert corner[20, 20] > 1e-3
    assert corner[20, 20] > 10.0 * corner[20, 35]


def test_smoothing_keeps_the_light_and_none_keeps_the_image() -> None:
    image = np.zeros((31, 31))
    image[15, 15] = 7.0
    blurred = smoothed(image, 1.3)
    np.testing.assert_allclose(blurred.sum(), 7.0, rtol=1e-12)
    assert blurred[15, 15] < 1.0
    np.testing.assert_array_equal(smoothed(image, 0.0), image)
