"""What the optics do to the Earth's image: a narrow Gaussian blur, and a little light scattered far."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import numpy.typing as npt
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.ndimage import gaussian_filter, zoom

from sim_hal.earth_camera.model import EarthCameraModel

Float32Array = npt.NDArray[np.float32]

_BIN = 8
"""px: scattered light is so smooth that it is reckoned on bins."""


def blurred(model: EarthCameraModel, image: Float32Array) -> Float32Array:
    """Return `image` (rows, columns) through the optics; beyond its edges it is taken to go on."""
    narrow = gaussian_filter(image, model.blur, mode="nearest", truncate=4.0) if model.blur > 0.0 else image
    if model.scatter == 0.0:
        return np.asarray(narrow)
    return np.asarray(narrow * np.float32(1.0 - model.scatter) + _scattered(model, image))


def _scattered(model: EarthCameraModel, image: Float32Array) -> Float32Array:
    rows, columns = image.shape
    padded = np.pad(image, ((0, -rows % _BIN), (0, -columns % _BIN)), mode="edge")
    down, across = padded.shape[0] // _BIN, padded.shape[1] // _BIN
    bins = padded.reshape(down, _BIN, across, _BIN).mean(axis=(1, 3))
    kernel, shape = _kernel(down, across, model.scatter, model.scatter_angle, model.lens.focal_length)
    spread = irfft2(rfft2(bins, shape) * kernel, shape)[:down, :across]
    smooth = zoom(spread, _BIN, order=1, grid_mode=True, mode="nearest")
    return np.asarray(smooth[:rows, :columns], dtype=np.float32)


@lru_cache(maxsize=4)
def _kernel(
    down: int, across: int, scatter: float, angle: float, focal_length: float
) -> tuple[npt.NDArray[np.complex64], tuple[int, int]]:
    """Return the transform of scattering from bin to bin, and its shape.

    The law of `sun_disc.add_glare` with distances in the image over the focal length for angles.
    """
    shape = (next_fast_len(2 * down), next_fast_len(2 * across))
    y, x = (np.minimum(np.arange(n), n - np.arange(n)) * (_BIN / focal_length) for n in shape)
    # Points of one bin are apart, too: in the mean square by a third of its width's square.
    squares = y[:, None] ** 2 + x**2 + (_BIN / focal_length) ** 2 / 3.0
    share = scatter / (math.pi * angle**2 * math.log(1.0 + 2.0 / angle**2))
    kernel = share * (_BIN / focal_length) ** 2 / (1.0 + squares / angle**2)
    return rfft2(kernel.astype(np.float32)), shape
