"""Separable point spread functions: a horizontal profile times a vertical one."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from knightcube.astro.arrays import FloatArray, IntArray

Float32Array = npt.NDArray[np.float32]

STEPS = 256
"""Table entries a pixel; between two of them the profile is interpolated (error below 1e-5 of its peak)."""


@dataclass(frozen=True, slots=True)
class PointSpread:
    """A separable point spread function.

    Attributes:
        profile: fraction of the light on a pixel by the distance of its centre from the point, px.
        reach: whole pixels from the pixel the point is on, beyond which no light falls.
        patch: px of a path that are gathered at once.
        quadrature: number of samples for a path by its length in px.
    """

    profile: Callable[[FloatArray], FloatArray]
    reach: int
    patch: float
    quadrature: Callable[[float], int]

    def shares(self, positions: FloatArray, size: int) -> Float32Array:
        """Return the light (..., size) on pixels 0 .. size - 1 in a line, of points at `positions` (...)."""
        table, rise = _table(self, size)
        entry, beyond = _entries(positions)
        shares = table.take(entry, axis=0)
        shares += beyond[..., None] * rise.take(entry, axis=0)
        return np.asarray(shares)

    def own_shares(self, positions: FloatArray) -> Float32Array:
        """Return the light (..., size) on pixels 0 .. size - 1, each of its own point of `positions`."""
        pixel = np.arange(positions.shape[-1])
        table, rise = _table(self, len(pixel))
        entry, beyond = _entries(positions)
        return np.asarray(table[entry, pixel] + beyond * rise[entry, pixel])


@lru_cache(maxsize=8)
def integrated_gaussian(sigma: float) -> PointSpread:
    """Return a Gaussian of `sigma` px integrated over each pixel."""

    def profile(offset: FloatArray) -> FloatArray:
        return np.asarray(ndtr((offset + 0.5) / sigma) - ndtr((offset - 0.5) / sigma))

    def quadrature(length: float) -> int:
        # Gauss-Legendre converges at about one sample a sigma; this many leave 1e-4 of the streak's peak.
        return 1 if length < 0.02 * sigma else math.ceil(1.5 + 0.95 * length / sigma)

    return PointSpread(profile, math.ceil(4.0 * sigma), max(4.0, 8.0 * sigma), quadrature)


@lru_cache(maxsize=8)
def bilinear_gaussian(sigma: float) -> PointSpread:
    """Return the thesis's: shared among the nearest pixels (2.5, 2.6), blurred by a sampled kernel (2.9)."""
    taps = np.exp(-0.5 * (np.array([-1.0, 0.0, 1.0]) / sigma) ** 2)
    taps /= taps.sum()

    def profile(offset: FloatArray) -> FloatArray:
        distance = np.abs(np.asarray(offset)[..., None] - np.array([-1.0, 0.0, 1.0]))
        return np.asarray(np.clip(1.0 - distance, 0.0, None) @ taps)

    def quadrature(length: float) -> int:
        # The profile has corners: no order of quadrature helps, only samples much closer than a pixel.
        return 1 if length < 1e-3 else math.ceil(2.0 + 8.0 * length)

    return PointSpread(profile, 2, 8.0, quadrature)


def _entries(positions: FloatArray) -> tuple[IntArray, Float32Array]:
    """Return the table's entry before each of `positions`, and how far beyond it that lies, 0 .. 1."""
    scaled = positions * STEPS
    entry = scaled.astype(np.intp)
    return entry, (scaled - entry).astype(np.float32)


@lru_cache(maxsize=32)
def _table(spread: PointSpread, size: int) -> tuple[Float32Array, Float32Array]:
    """Return the shares (size * STEPS + 1, size) of points 1/STEPS px apart, and their rises to the next."""
    positions = np.arange(size * STEPS + 2) / STEPS
    table = spread.profile(np.arange(size) - positions[:, None])
    # Normalised, so that the light beyond the reach is not lost.
    shares = np.asarray(table / table.sum(axis=1, keepdims=True), dtype=np.float32)
    return shares[:-1], np.diff(shares, axis=0)
