"""Corner detection by the structure tensor: the endpoints of a streak answer like corners (Sease 3.1-3.8).

Structure tensor from Gaussian derivatives, its products summed under a Gaussian window (3.5 corrected:
without the window the tensor has rank 1 and its smaller eigenvalue is always zero), its smaller eigenvalue
and the Harris response. All functions take and give images (rows, columns); x runs along columns, y along
rows.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import ndimage

from knightcube.astro.arrays import FloatArray, Image


class StructureTensor(NamedTuple):
    """The three distinct elements of the windowed structure tensor at every pixel, each (rows, columns)."""

    xx: FloatArray
    xy: FloatArray
    yy: FloatArray


def gaussian_kernel(sigma: float, radius: int) -> FloatArray:
    """Return the sampled normal density (2 radius + 1,), one factor of 3.3."""
    x = np.arange(-radius, radius + 1)
    return np.asarray(np.exp(-0.5 * (x / sigma) ** 2) / (np.sqrt(2.0 * np.pi) * sigma))


def gaussian_derivative_kernel(sigma: float, radius: int) -> FloatArray:
    """Return the kernel (2 radius + 1,) that correlates to d/dx of the image smoothed by `sigma` px.

    Its outer product with `gaussian_kernel` is the kernel of 3.4, mirrored: 3.4 is written for convolution.
    """
    x = np.arange(-radius, radius + 1)
    return np.asarray(x / sigma**2 * gaussian_kernel(sigma, radius))


def gradient(image: Image, sigma: float) -> tuple[FloatArray, FloatArray]:
    """Return the Gaussian derivatives along x and y, counts per px; the border's pixels are repeated."""
    radius = kernel_radius(sigma)
    smooth, slope = gaussian_kernel(sigma, radius), gaussian_derivative_kernel(sigma, radius)
    along_x = _separable(image, smooth, slope)
    along_y = _separable(image, slope, smooth)
    return along_x, along_y


def structure_tensor(image: Image, derivative_sigma: float, window_sigma: float) -> StructureTensor:
    """Return the gradient's products summed under a Gaussian window of `window_sigma` px (3.5 corrected)."""
    gx, gy = gradient(image, derivative_sigma)
    window = gaussian_kernel(window_sigma, kernel_radius(window_sigma))
    return StructureTensor(*(_separable(product, window, window) for product in (gx * gx, gx * gy, gy * gy)))


def harris_response(tensor: StructureTensor, k: float = 0.15) -> FloatArray:
    """Return Det(A) - k Tr(A)^2, positive where both eigenvalues are large (3.7, 3.8)."""
    trace = tensor.xx + tensor.yy
    return np.asarray(tensor.xx * tensor.yy - tensor.xy**2 - k * trace**2)


def minimum_eigenvalue(tensor: StructureTensor) -> FloatArray:
    """Return the smaller eigenvalue of the tensor at every pixel (3.6), never negative."""
    half_trace = 0.5 * (tensor.xx + tensor.yy)
    larger = half_trace + np.hypot(0.5 * (tensor.xx - tensor.yy), tensor.xy)
    determinant = tensor.xx * tensor.yy - tensor.xy**2
    # The product of both over the larger: their difference would cancel where it is small.
    return np.asarray(np.maximum(determinant, 0.0) / np.where(larger > 0.0, larger, 1.0))


def smoothed(image: Image, sigma: float) -> FloatArray:
    """Return the image smoothed by a Gaussian of `sigma` px (3.3); as it is when `sigma` is zero."""
    if sigma <= 0.0:
        return np.asarray(image, dtype=np.float64)
    kernel = gaussian_kernel(sigma, kernel_radius(sigma))
    return _separable(image, kernel / kernel.sum(), kernel / kernel.sum())


def kernel_radius(sigma: float) -> int:
    """Return the half width in pixels at which a kernel of `sigma` px is cut: three sigma, at least one."""
    return max(1, int(np.ceil(3.0 * sigma)))


def _separable(image: Image, down: FloatArray, across: FloatArray) -> FloatArray:
    """Return the correlation of `image` with the outer product of `down` (rows) and `across` (columns)."""
    half = ndimage.correlate1d(image, down, axis=0, mode="nearest", output=np.float64)
    return np.asarray(ndimage.correlate1d(half, across, axis=1, mode="nearest"))
