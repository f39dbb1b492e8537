"""The variance of a pixel under a star: sky, photons, and the Gaussian's mismatch.

variance = noise^2 + light / gain + (mismatch light)^2. Where the gain is unknown, it and the mismatch are
measured from the stars' own residuals: noise of photons grows as the light, a wrong shape as its square.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray

# Residuals allowed before they are another thing's light, as part of the star's light in the pixel.
_TOLERATED = 0.25
_LEAST_PIXELS = 40
_ROUNDS = 3


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """`photon` counts^2 a count of light (1/gain) and `mismatch`, a part of the light."""

    photon: float = 0.0
    mismatch: float = 0.0

    def variance(self, light: FloatArray, noise: FloatArray) -> FloatArray:
        """Return counts^2 (n, k, k) of pixels with `light` (n, k, k) on a sky of `noise` (n,)."""
        seen = np.maximum(light, 0.0)
        return np.asarray((noise**2)[:, None, None] + self.photon * seen + (self.mismatch * seen) ** 2)

    def tolerant(self, light: FloatArray, variance: FloatArray) -> FloatArray:
        """Return `variance` widened for shapes that no Gaussian has."""
        return np.asarray(variance + (_TOLERATED * light) ** 2)


def measure_noise(
    residual: FloatArray,
    variance: FloatArray,
    leverage: FloatArray,
    light: FloatArray,
    noise: FloatArray,
    gain: float | None,
) -> NoiseModel:
    """Return the noise model that the residuals (n, k, k) of a fit show; a given `gain` is kept.

    Least squares of residual^2 - noise^2 on light and light^2, weighted by the spread of squared normal
    residuals and never negative. `leverage` is the part of each residual that the fit absorbed.
    """
    used = np.isfinite(variance) & (light > 0.5 * noise[:, None, None]) & (leverage < 0.8)
    given = 0.0 if gain is None else 1.0 / gain
    if np.count_nonzero(used) < _LEAST_PIXELS:
        return NoiseModel(given, 0.0)
    if gain is not None:
        return NoiseModel(given, _shared_mismatch(residual, leverage, light, noise, used, given))
    m = light[used]
    floor = np.broadcast_to((noise**2)[:, None, None], light.shape)[used]
    excess = residual[used] ** 2 / (1.0 - leverage[used]) - floor
    photon, square = 0.0, 0.0
    for _ in range(_ROUNDS):
        expected = floor + photon * m + square * m * m
        weight = 1.0 / expected**2
        # Residuals beyond 5 sigma of the present model are let go: neighbours and hot pixels.
        weight = np.where(excess < 25.0 * expected, weight, 0.0) if square or photon else weight
        photon, square = _non_negative(m, excess, weight)
    return NoiseModel(photon, float(np.sqrt(square)))


def _shared_mismatch(
    residual: FloatArray,
    leverage: FloatArray,
    light: FloatArray,
    noise: FloatArray,
    used: BoolArray,
    photon: float,
) -> float:
    """Return the mismatch that stars of a known photon noise share: the median of theirs, by their weight.

    A wrong shape is the same in all of them; a neighbour's light, which is none, is in a few.
    """
    m = np.where(used, light, 0.0)
    floor = np.broadcast_to((noise**2)[:, None, None], light.shape)
    excess = np.where(used, residual**2 / np.where(used, 1.0 - leverage, 1.0) - floor - photon * m, 0.0)
    square = 0.0
    for _ in range(_ROUNDS):
        weight = (m / (floor + photon * m + square * m * m)) ** 2
        own, least = np.sum(weight * excess, axis=(1, 2)), np.sum(weight * m * m, axis=(1, 2))
        seen = least > 0.0
        ratio, share = own[seen] / least[seen], least[seen]
        order = np.argsort(ratio)
        whole = np.cumsum(share[order])
        square = max(0.0, float(ratio[order][np.searchsorted(whole, 0.5 * whole[-1])]))
    return float(np.sqrt(square))


def _non_negative(m: FloatArray, excess: FloatArray, weight: FloatArray) -> tuple[float, float]:
    """Return the parts of `excess` that go with m and with m^2, neither below zero."""
    first, second, third = (float(np.sum(weight * m**power)) for power in (2, 3, 4))
    along, square = float(np.sum(weight * excess * m)), float(np.sum(weight * excess * m * m))
    determinant = first * third - second**2
    if determinant > 1e-12 * first * third:
        both = (
            (third * along - second * square) / determinant,
            (first * square - second * along) / determinant,
        )
        if min(both) >= 0.0:
            return both
    alone = max(0.0, along / first), max(0.0, square / third)
    gains = alone[0] * along, alone[1] * square
    return (alone[0], 0.0) if gains[0] >= gains[1] else (0.0, alone[1])
