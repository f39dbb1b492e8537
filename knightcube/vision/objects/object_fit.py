"""The place of an object by all the light of its pixels, beside the known stars that are near.

An object is a short trail of constant brightness with the camera's point spread; a star is known by place and
brightness, nearly. Gauss-Newton fits place, extent and brightness of the object, the sky, and the brightness
of each star, weighted by the noise that the fitted light has. Pixels that clip say nothing and are left out:
a centre of light, of which they cut the top, is drawn off by 0.03 px. The covariance is that of the fit,
widened where the pixels are farther from the model than their noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray
from knightcube.vision.objects.star_light import spread_over, spread_with_slopes

_REACH = 5.0
"""Point spreads about the object that are looked at."""
_STEP_PX = 0.7
_ROUNDS, _SETTLED = 12, 1e-4
"""Steps at most, and px of the last one."""
_EXTENT = 2.0
"""px, how far the half extent may be from its first guess; a point's extent changes nothing else."""
STAR_SIGMA = 0.3
"""Part of a star's light by which the catalogue's brightness, in another colour, may be off."""


@dataclass(frozen=True, slots=True, eq=False)
class Trails:
    """n straight trails: `middle` and `half` extent (n, 2) px, and `flux` (n,) counts."""

    middle: FloatArray
    half: FloatArray
    flux: FloatArray

    def near(self, point: FloatArray, reach: float) -> Trails:
        """Return those whose middle is within `reach` px of a point (2,) in each axis, beside their half."""
        away = np.abs(self.middle - point) - np.abs(self.half)
        chosen = np.all(away < reach, axis=1)
        return Trails(self.middle[chosen], self.half[chosen], self.flux[chosen])


@dataclass(frozen=True, slots=True, eq=False)
class Patch:
    """Pixels about a point: `light` (rows, columns) counts over the sky, the first of them at `corner` (2,).

    `noise` counts without light, `gain` electrons a count, `usable` which pixels did not clip, `psf` px.
    """

    light: FloatArray
    corner: FloatArray
    noise: float
    gain: float
    usable: BoolArray
    psf: float
    ceiling: float

    def image(self, middle: FloatArray, half: FloatArray) -> FloatArray:
        """Return one count of a trail as the pixels get it."""
        rows, columns = self.light.shape
        return spread_over(_path(middle - self.corner, half)[0], columns, rows, self.psf)


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """An object: `middle` (2,) px and its `covariance` (2, 2), `flux` counts and its `flux_sigma`.

    `misfit` is chi-square over its degrees of freedom.
    """

    middle: FloatArray
    covariance: FloatArray
    flux: float
    flux_sigma: float
    misfit: float


def reach_of(half: FloatArray, psf: float) -> float:
    """Return px from an object's middle that its patch needs on each side."""
    return float(np.abs(half).max()) + _REACH * psf


def fit_object(
    patch: Patch, middle: FloatArray, half: FloatArray, flux: float, stars: Trails
) -> Fitted | None:
    """Return the object near `middle` (2,) px of a half extent (2,) px; None where the pixels have none."""
    images = [patch.image(star, extent) for star, extent in zip(stars.middle, stars.half, strict=True)]
    given = np.maximum(stars.flux, 1e-9)
    believed = _believed(half, given)
    unknowns = np.concatenate([middle, half, [flux, 0.0], given])
    for _ in range(_ROUNDS):
        light, change = _model(patch, unknowns, images)
        usable = patch.usable & (light < patch.ceiling)
        spare = int(np.count_nonzero(usable)) - len(unknowns)
        if spare < 2:
            return None
        weight = (usable / (patch.noise**2 + np.maximum(light, 0.0) / patch.gain)).ravel()
        off = (patch.light - light).ravel()
        normal, right = (change * weight) @ change.T, (change * weight) @ off
        for place, value, sigma in believed:
            normal[place, place] += sigma**-2
            right[place] += (value - unknowns[place]) / sigma**2
        step = np.linalg.solve(normal, right)
        step[:4] = np.clip(step[:4], -0.5, 0.5)
        unknowns = unknowns + step
        misfit = float(np.sum(weight * off**2)) / spare
        if np.abs(step[:2]).max() < _SETTLED:
            break
    # As of the stars (`inflation`), three deviations of chi-square are left to chance.
    excess = misfit if misfit > 1.0 + 3.0 * (2.0 / spare) ** 0.5 else 1.0
    covariance = np.asarray(np.linalg.inv(normal), dtype=np.float64) * excess
    away = np.abs(unknowns[:2] - middle).max()
    if not np.isfinite(unknowns).all() or unknowns[4] <= 0.0 or away > reach_of(half, patch.psf):
        return None
    deviation = float(np.sqrt(covariance[4, 4]))
    return Fitted(unknowns[:2], covariance[:2, :2], float(unknowns[4]), deviation, misfit)


def _model(patch: Patch, unknowns: FloatArray, images: list[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Return the light (rows, columns) of unknowns (k,), and how it changes with each (k, pixels)."""
    rows, columns = patch.light.shape
    path, share = _path(unknowns[:2] - patch.corner, unknowns[2:4])
    both = np.stack([np.ones(len(share)), share])
    shape, *slopes = spread_with_slopes(path, both, columns, rows, patch.psf)
    light = unknowns[4] * shape + unknowns[5]
    for flux, image in zip(unknowns[6:], images, strict=True):
        light = light + flux * image
    change = [*(unknowns[4] * slope for slope in slopes), shape, np.ones(shape.shape), *images]
    return light, np.array([part.ravel() for part in change])


def _believed(half: FloatArray, stars: FloatArray) -> list[tuple[int, float, float]]:
    """Return unknown, value and deviation of what is believed before: the extent, the stars' light."""
    known = [(2 + k, float(half[k]), _EXTENT) for k in range(2)]
    return known + [(6 + k, float(light), STAR_SIGMA * float(light)) for k, light in enumerate(stars)]


def _path(middle: FloatArray, half: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return points (m, 2) px along a trail, and the part (m,) from -1 to 1 of its half that each is off."""
    count = max(4, int(np.ceil(2.0 * float(np.linalg.norm(half)) / _STEP_PX)))
    share = (np.arange(count) + 0.5) * 2.0 / count - 1.0
    return middle + share[:, None] * half, share
