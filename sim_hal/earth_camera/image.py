"""Frames of Earth and Sun: the radiance through optics and detector.

The optics blur the Earth's image by a narrow Gaussian and scatter a little light over the whole frame. The
detector has a response, noise and a fixed pattern of its pixels, and gives counts.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import numpy.typing as npt
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.ndimage import binary_dilation, gaussian_filter, zoom

from knightcube.astro.arrays import FloatArray, Image, IntArray
from sim_hal.earth_camera.model import EarthCameraModel, pixel_rays
from sim_hal.earth_camera.radiance import add_disc, add_glare, look, radiance
from sim_hal.earth_camera.scene import EarthScene

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


def counts(model: EarthCameraModel, radiance: Float32Array, generator: np.random.Generator) -> Image:
    """Return the frame (rows, columns) that `radiance` (rows, columns) gives."""
    offsets, spread, dead, hot, hot_counts = _pattern(model)
    if model.response == "logarithmic":
        signal = np.log10(1.0 + radiance * np.float32(1.0 / model.darkest))
        signal *= np.float32(model.counts_per_decade)
        signal += _normal(model, model.noise, generator)
    else:
        charge = radiance * np.float32(model.sensitivity) * (1.0 + spread)
        if model.blooming:
            spill(charge, model.full_well)
        charge += np.sqrt(charge) * _normal(model, 1.0, generator)
        np.clip(charge, 0.0, model.full_well, out=charge)
        charge += _normal(model, model.read_noise, generator)
        signal = charge / np.float32(model.gain)
    signal += offsets + np.float32(model.pedestal)
    # A pixel that works no more has no noise of the light's.
    flat = signal.reshape(-1)
    flat[dead] = 0.0
    flat[hot] = hot_counts
    signal += np.float32(0.5)  # truncation below then rounds to the nearest count
    np.clip(signal, 0.0, model.highest_count, out=signal)
    return np.asarray(signal.astype(model.count_type))


def spill(charge: Float32Array, full_well: float) -> None:
    """Spread charge beyond the full well along each column of `charge` (rows, columns), half up, half down.

    Each pixel on the way fills to the brim before the next one gets any; what reaches an edge is lost.
    """
    for column in np.flatnonzero(np.any(charge > full_well, axis=0)):
        line = charge[:, column]
        over = np.maximum(line - full_well, 0.0)
        np.minimum(line, full_well, out=line)
        for way in (slice(None), slice(None, None, -1)):
            _pour(line[way], 0.5 * over[way], full_well)


def _pour(line: Float32Array, over: Float32Array, full_well: float) -> None:
    carried = 0.0
    for row, excess in enumerate(over.tolist()):
        carried += excess
        if carried > 0.0:
            taken = min(carried, full_well - float(line[row]))
            line[row] += taken
            carried -= taken


def _normal(model: EarthCameraModel, sigma: float, generator: np.random.Generator) -> Float32Array:
    return generator.standard_normal((model.rows, model.columns), dtype=np.float32) * np.float32(sigma)


@lru_cache(maxsize=8)
def _pattern(
    model: EarthCameraModel,
) -> tuple[Float32Array, Float32Array, IntArray, IntArray, Float32Array]:
    """Return offsets in counts, departures of sensitivity, dead and hot pixels, the hot ones' counts."""
    rng = np.random.default_rng(model.seed)
    size = model.rows * model.columns
    offsets = _normal(model, model.fixed_pattern, rng)
    spread = _normal(model, model.response_spread, rng)
    blemished = rng.choice(size, size=model.dead_pixels + model.hot_pixels, replace=False)
    bright = rng.uniform(0.3, 1.0, size=model.hot_pixels) * model.highest_count
    dead, hot = blemished[: model.dead_pixels], blemished[model.dead_pixels :]
    return offsets, spread, dead, hot, bright.astype(np.float32)


_FINE = np.sqrt(1.0 / 12.0) * np.array([[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]])
"""px from a pixel's centre, (4, 2): Gauss and Legendre's two points, exact for cubics along each axis."""


def render(model: EarthCameraModel, scene: EarthScene, generator: np.random.Generator) -> Image:
    """Return the frame (rows, columns) that the camera gives: uint8 to 8 bits, uint16 above.

    All noise that changes from frame to frame is drawn from `generator`.
    """
    return counts(model, _light(model, scene), generator)


def expected_radiance(model: EarthCameraModel, scene: EarthScene) -> FloatArray:
    """Return the radiance (rows, columns) on the detector, blur and glare included, without noise."""
    return _light(model, scene).astype(np.float64)


def _light(model: EarthCameraModel, scene: EarthScene) -> Float32Array:
    image = blurred(model, _earth(model, scene))
    add_disc(scene, model, image)
    add_glare(scene, model, image)
    return image


def _earth(model: EarthCameraModel, scene: EarthScene) -> Float32Array:
    """Return the Earth's radiance (rows, columns), averaged over the pixels where the limb crosses them."""
    rays = pixel_rays(model.lens)
    sight = look(scene, rays)
    light = radiance(scene, rays, sight)
    limb = (~sight.hits & (light > 0.0)).reshape(model.rows, model.columns)
    # Of the ground's pixels those count, too, that reach over the limb.
    at_limb = np.flatnonzero(binary_dilation(limb, np.ones((3, 3), dtype=bool)))
    if len(at_limb):
        pixels = np.stack([at_limb % model.columns, at_limb // model.columns], axis=1)
        fine = model.lens.unit_vectors((pixels[:, None, :] + _FINE).reshape(-1, 2))
        light[at_limb] = radiance(scene, fine, look(scene, fine)).reshape(-1, len(_FINE)).mean(axis=1)
    return light.reshape(model.rows, model.columns)
