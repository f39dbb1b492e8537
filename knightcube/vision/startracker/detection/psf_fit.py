"""Stars fitted to their pixels, all at once: Gauss-Newton steps with the weights of the fitted light.

Unknown of each star: place, flux, the sky left beneath it and, on request, its own width. The weights come
from the fitted light, not from the counts: a pixel that happens to be low would otherwise weigh more, and
the flux come out low. The normal matrices are 4 x 4 or 5 x 5, one a star, solved together.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.vision.records import select
from knightcube.vision.startracker.detection.noise_model import NoiseModel
from knightcube.vision.startracker.detection.point_spread import path, profile
from knightcube.vision.startracker.detection.windows import Windows

X, Y, FLUX, SKY, WIDTH = range(5)
NARROWEST, WIDEST = 0.25, 6.0
# Steps are cut to this, px: a start one pixel off must not fly away.
_LONGEST_STEP = 0.7
_WIDEST_STEP = 0.35
# Residuals beyond this many sigmas, in the last steps, are another thing's light.
_CLIP = 6.0
_CLIP_FROM_END = 1
# The condition is made by this, in units of the scaled diagonal: a star without information stays put.
_RIDGE = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class PsfFit:
    """Fitted stars.

    Attributes:
        offset: (n, 2) px from the middle of the window.
        flux, sky, width: (n,).
        covariance: (n, p, p) of x, y, flux, sky and width if it was free.
        chi2: (n,) of `used` pixels (n,).
        residual, variance, leverage: (n, k, k); variance is inf where a pixel was left out.
        model: (n, k, k) counts of the star alone.
    """

    offset: FloatArray
    flux: FloatArray
    sky: FloatArray
    width: FloatArray
    covariance: FloatArray
    chi2: FloatArray
    used: IntArray
    residual: FloatArray
    variance: FloatArray
    leverage: FloatArray
    model: FloatArray

    def select(self, chosen: IntArray) -> PsfFit:
        """Return the stars `chosen` (k,) by number."""
        return select(self, chosen)

    def replaced(self, chosen: IntArray, part: PsfFit) -> PsfFit:
        """Return these with `part` in the place of the stars `chosen` (k,)."""
        out = {item.name: getattr(self, item.name).copy() for item in fields(self)}
        for name, values in out.items():
            values[chosen] = getattr(part, name)
        return PsfFit(**out)


def fit(
    windows: Windows,
    offset: FloatArray,
    flux: FloatArray,
    width: FloatArray,
    noise: NoiseModel,
    free_width: bool,
    steps: int = 4,
) -> PsfFit:
    """Return the stars of `windows`, started at `offset` (n, 2) px, `flux` (n,) and `width` (n,) px."""
    count = 5 if free_width else 4
    values = np.concatenate([offset, flux[:, None], np.zeros((len(flux), 1)), width[:, None]], axis=1)
    for step in range(steps + 1):
        star, jacobian = _jacobian(values, windows, count)
        residual = windows.light - star - values[:, SKY, None, None]
        variance = noise.variance(star, windows.noise)
        good = windows.good
        if step >= steps - _CLIP_FROM_END:
            good = good & ~_foreign(residual, noise.tolerant(star, variance))
        weight = (good / variance).reshape(len(values), -1)
        weighted = jacobian * weight[:, None, :]
        normal = weighted @ jacobian.transpose(0, 2, 1)
        inverse = _inverse(normal)
        if step < steps:
            gradient = (weighted @ residual.reshape(len(values), -1, 1))[:, :, 0]
            _advance(values, (inverse @ gradient[:, :, None])[:, :, 0], windows.half)
    leverage = weight * np.sum(jacobian * (inverse @ jacobian), axis=1)
    return PsfFit(
        values[:, :2],
        values[:, FLUX],
        values[:, SKY],
        values[:, WIDTH],
        inverse,
        np.sum(weight * residual.reshape(len(values), -1) ** 2, axis=1),
        np.count_nonzero(good, axis=(1, 2)),
        residual,
        np.where(good, variance, np.inf),
        leverage.reshape(residual.shape),
        star,
    )


def _jacobian(values: FloatArray, windows: Windows, count: int) -> tuple[FloatArray, FloatArray]:
    """Return the light (n, k, k) of the stars and its derivatives (n, count, k k)."""
    out: FloatArray | None = None
    for shift, share in path(windows.trail):
        part = _derivatives(values, shift, windows.half, count)
        out = share * part if out is None else out + share * part
    assert out is not None  # a path has places
    star = values[:, FLUX, None, None] * out[:, FLUX]
    return star, out.reshape(len(values), count, -1)


def _derivatives(values: FloatArray, shift: FloatArray, half: int, count: int) -> FloatArray:
    """Return the derivatives (n, count, k, k) of the light of stars that stand `shift` (n, 2) px off."""
    across, across_x, across_w = profile(values[:, X] + shift[:, 0], values[:, WIDTH], half)
    down, down_y, down_w = profile(values[:, Y] + shift[:, 1], values[:, WIDTH], half)
    flux = values[:, FLUX, None]
    size = 2 * half + 1
    out = np.empty((len(values), count, size, size))
    np.multiply(down[:, :, None], (flux * across_x)[:, None, :], out=out[:, X])
    np.multiply((flux * down_y)[:, :, None], across[:, None, :], out=out[:, Y])
    np.multiply(down[:, :, None], across[:, None, :], out=out[:, FLUX])
    out[:, SKY] = 1.0
    if count > WIDTH:
        out[:, WIDTH] = (flux * down)[:, :, None] * across_w[:, None, :]
        out[:, WIDTH] += (flux * down_w)[:, :, None] * across[:, None, :]
    return out


def _foreign(residual: FloatArray, variance: FloatArray) -> BoolArray:
    return np.asarray(residual * residual > _CLIP**2 * variance)


def _advance(values: FloatArray, step: FloatArray, half: int) -> None:
    """Move `values` (n, 5) by `step` (n, p), none too far."""
    step[:, :2] = np.clip(step[:, :2], -_LONGEST_STEP, _LONGEST_STEP)
    if step.shape[1] > WIDTH:
        step[:, WIDTH] = np.clip(step[:, WIDTH], -_WIDEST_STEP, _WIDEST_STEP)
    values[:, : step.shape[1]] += step
    values[:, :2] = np.clip(values[:, :2], -half, half)
    values[:, WIDTH] = np.clip(values[:, WIDTH], NARROWEST, min(WIDEST, 1.0 * half))


def _inverse(normal: FloatArray) -> FloatArray:
    """Return the inverses of normal matrices (n, p, p), scaled to a unit diagonal on the way."""
    scale = np.sqrt(np.maximum(np.diagonal(normal, axis1=1, axis2=2), 1e-30))
    outer = scale[:, :, None] * scale[:, None, :]
    return np.asarray(np.linalg.inv(normal / outer + _RIDGE * np.eye(normal.shape[1])) / outer)
