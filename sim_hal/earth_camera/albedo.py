"""Land, sea and cloud: noise with a power-law spectrum, read on the sphere at two scales.

A periodic volume of noise is made from the seed; the sphere cuts through it once with the whole Earth
inside (continents, weather) and once much magnified (coasts, single clouds). So there are no poles and no
seams. It is nobody's Earth, but has what a horizon finder must bear: bright edges everywhere inside the limb.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt
from scipy.ndimage import map_coordinates
from scipy.special import ndtri

from knightcube.astro.arrays import FloatArray

Float32Array = npt.NDArray[np.float32]

OCEAN, LAND, CLOUD = 0.06, 0.22, 0.65
"""Reflectances: sea reflects 0.05 to 0.1 of visible light, soil and plants 0.1 to 0.3, cloud up to 0.8."""
LAND_SHARE, CLOUD_SHARE = 0.29, 0.55

_CELLS = 96
_SLOPE = -2.3
"""Of the amplitude over wave number in three dimensions, near the spectrum of clouds."""
_RADIUS = 0.42 * _CELLS
"""Cells in the Earth's radius: the sphere fits in the volume."""
_MAGNIFICATION = 11.0
_FINE = 0.5
"""Amplitude of the fine noise over the coarse one."""
_SOFT = 0.1
"""Standard deviations of the noise over which a coast or a cloud's rim passes."""


def albedo(directions: FloatArray, seed: int) -> Float32Array:
    """Return the ground's albedo (n,) below Earth-fixed unit directions (n, 3)."""
    places = np.ascontiguousarray(directions.T, dtype=np.float32)
    places *= _RADIUS
    places += 0.5 * _CELLS
    land, cloud = (
        _covered(volume, places, share)
        for volume, share in zip(_volumes(seed), (LAND_SHARE, CLOUD_SHARE), strict=True)
    )
    ground = OCEAN + (LAND - OCEAN) * land
    return np.asarray(ground + (CLOUD - ground) * cloud)


def _covered(volume: Float32Array, places: Float32Array, share: float) -> Float32Array:
    """Return how far (n,) each of `places` (3, n) is covered, 0 .. 1, `share` of the Earth being so."""
    coarse = _read(volume, places)
    fine = _read(volume, places * np.float32(_MAGNIFICATION))
    height = (coarse + _FINE * fine) / np.hypot(1.0, _FINE)
    return np.asarray(np.clip((height - ndtri(1.0 - share)) / _SOFT + 0.5, 0.0, 1.0), dtype=np.float32)


def _read(volume: Float32Array, places: Float32Array) -> Float32Array:
    return np.asarray(map_coordinates(volume, places, order=1, mode="grid-wrap"))


@lru_cache(maxsize=4)
def _volumes(seed: int) -> tuple[Float32Array, Float32Array]:
    """Return two independent periodic volumes of zero mean and unit variance, for land and for cloud."""
    across = np.fft.fftfreq(_CELLS, 1.0 / _CELLS).astype(np.float32)
    wave = np.sqrt(across[:, None, None] ** 2 + across[None, :, None] ** 2 + across**2)
    amplitude = np.where(wave >= 1.5, np.maximum(wave, 1.5) ** _SLOPE, 0.0)
    rng = np.random.default_rng(seed)
    shape = (_CELLS, _CELLS, _CELLS)
    white = rng.standard_normal(shape, np.float32) + 1j * rng.standard_normal(shape, np.float32)
    # White noise's transform is white noise: real and imaginary parts come out independent.
    noise = np.fft.ifftn(white * amplitude)
    land, cloud = noise.real, noise.imag
    return (land / land.std()).astype(np.float32), (cloud / cloud.std()).astype(np.float32)
