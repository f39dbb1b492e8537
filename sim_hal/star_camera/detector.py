"""The detector's response to light: noise, saturation, counts (Sease 2.10, 2.11, text after them)."""

from __future__ import annotations

from functools import cache

import numpy as np
import numpy.typing as npt
from scipy.special import ndtri

from knightcube.astro.arrays import Image
from sim_hal.star_camera.model import StarCameraModel
from sim_hal.star_camera.point_spread import Float32Array

FAINT_SHARE = 0.25
"""A pixel is faint while its light adds at most this share to the variance of the background."""
GREATEST_SKEWNESS = 0.05
"""Below it noise may be drawn as Gaussian: its distribution function is then off by 0.004 (Edgeworth)."""

SLICES = 1 << 16
OUTER_SLICES = 64


def counts(
    model: StarCameraModel, electrons: Float32Array, exposure: float, rng: np.random.Generator
) -> Image:
    """Return the frame (rows, columns) of counts that `electrons` of light in `exposure` s give."""
    light = electrons
    if model.hot_pixels:
        light = electrons.copy()
        column, row, current = np.array(model.hot_pixels).T
        np.add.at(light, (row.astype(int), column.astype(int)), (current * exposure).astype(np.float32))
    if any(model.background_gradient):
        light = light + _stray_light(model)
    draw = _uniform if model.noise == "uniform" else _poisson
    signal = draw(model, light, exposure, rng)
    signal *= np.float32(1.0 / model.gain)
    signal += np.float32(model.pedestal + 0.5)  # truncation below then rounds to the nearest count
    np.clip(signal, 0.0, model.highest_count, out=signal)
    return np.asarray(signal.astype(model.count_type))


def _stray_light(model: StarCameraModel) -> Float32Array:
    """Return e- (rows, columns) that grow evenly across and down, from none in the darkest corner."""
    across, down = model.background_gradient
    light = across * np.arange(model.columns) + down * np.arange(model.rows)[:, None]
    return np.asarray(model.gain * (light - light.min()), dtype=np.float32)


def _poisson(
    model: StarCameraModel, light: Float32Array, exposure: float, rng: np.random.Generator
) -> Float32Array:
    """Return e- with shot noise of light and dark current, filled to the well at most, and read noise.

    2.10 and 2.11 corrected: Poisson and Gaussian instead of uniform. Where light is faint beside a background
    whose noise is all but Gaussian, the sum of the three is drawn as one Gaussian of the same mean and
    variance; everywhere else each is drawn as what it is.
    """
    dark = model.dark_current * exposure
    variance = model.read_noise**2 + dark
    faint = FAINT_SHARE * variance
    gaussian = all(dark + mean <= GREATEST_SKEWNESS * (variance + mean) ** 1.5 for mean in (0.0, faint))
    roomy = model.full_well > dark + faint + 10.0 * np.sqrt(dark + faint)
    if not (gaussian and roomy):
        return _exact(model, light.reshape(-1), dark, rng).reshape(light.shape)
    signal = light + np.float32(variance)
    np.sqrt(signal, out=signal)
    signal *= _normal(light.shape, rng)
    signal += light
    signal += np.float32(dark)
    bright = np.flatnonzero(light > faint)
    signal.reshape(-1)[bright] = _exact(model, light.reshape(-1)[bright], dark, rng)
    return signal


def _normal(shape: tuple[int, ...], rng: np.random.Generator) -> Float32Array:
    """Return standard normal draws, four times as fast as the generator's own.

    A 16-bit number picks one of 65,536 slices of equal probability and gives its middle; of the outermost
    slices, where they are wide, it gives a point drawn within. So the tails are as long as they should be.
    """
    count = int(np.prod(shape))
    words = rng.integers(0, 2**64, size=(count + 3) // 4, dtype=np.uint64)
    slices = words.view(np.uint16)[:count]
    normal = _slice_middles().take(slices)
    outer = np.flatnonzero((slices < OUTER_SLICES) | (slices >= SLICES - OUTER_SLICES))
    chance = (slices[outer] + rng.uniform(2.0**-32, 1.0, size=len(outer))) / SLICES
    normal[outer] = ndtri(chance)
    return np.asarray(normal.reshape(shape))


@cache
def _slice_middles() -> Float32Array:
    return np.asarray(ndtri((np.arange(SLICES) + 0.5) / SLICES), dtype=np.float32)


def _exact(
    model: StarCameraModel, light: Float32Array, dark: float, rng: np.random.Generator
) -> npt.NDArray[np.float32]:
    # Ten wells and a thousand electrons fill the well for certain; the draw overflows far beyond.
    mean = np.minimum(light.astype(np.float64) + dark, 10.0 * model.full_well + 1000.0)
    collected = np.minimum(rng.poisson(mean), model.full_well).astype(np.float32)
    collected += np.float32(model.read_noise) * rng.standard_normal(light.shape, dtype=np.float32)
    return np.asarray(collected)


def _uniform(
    model: StarCameraModel, light: Float32Array, exposure: float, rng: np.random.Generator
) -> Float32Array:
    """Return e- with the thesis's draw: sqrt(signal) and sqrt(RN^2 + DC T), each times a uniform 0 .. 1."""
    rest = np.sqrt(model.read_noise**2 + model.dark_current * exposure)
    signal = light + np.sqrt(light) * rng.random(light.shape, dtype=np.float32)
    signal += np.float32(rest) * rng.random(light.shape, dtype=np.float32)
    return np.minimum(signal, np.float32(model.full_well))
