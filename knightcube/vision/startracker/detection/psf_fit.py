"""Stars fitted to their pixels with a Gaussian point spread function (PSF), all stars of a frame at once.

Each star is fitted in a square window: position, flux, residual sky level and, on request, its own width. A
star that moves over the exposure is the mean of Gaussians along its path (Gauss-Legendre quadrature). The
Gauss-Newton weights come from the fitted light, not from the counts: otherwise a pixel that happens to be low
would weigh more, and the flux would be too low. The normal matrices, 4 x 4 or 5 x 5 for each star, are solved
together.

The variance of a pixel is noise^2 + light / gain + (mismatch light)^2: sky, photons, and the difference
between the PSF and a Gaussian. Where the gain is unknown, gain and mismatch are measured from the residuals
of the stars: photon noise grows with the light, the mismatch with its square.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, Image, IntArray, select


@dataclass(frozen=True, slots=True, eq=False)
class StarWindows:
    """Square windows of k x k pixels around n stars, k = 2 half + 1.

    Attributes:
        middle: column and row of the middle pixel (n, 2).
        half: half width of the windows, px.
        light: counts above the sky (n, k, k); 0 outside of the frame; saturated pixels are unchanged.
        good: which pixels are inside of the frame and not saturated (n, k, k).
        noise: noise of a pixel without a star (n,), counts.
        trail: displacement of the star from the beginning to the end of the exposure (n, 2), px.
    """

    middle: IntArray
    half: int
    light: FloatArray
    good: BoolArray
    noise: FloatArray
    trail: FloatArray

    def select(self, chosen: BoolArray | IntArray) -> StarWindows:
        """Return the windows that `chosen` picks."""
        return select(self, chosen, "half")

    def without(self, light: FloatArray) -> StarWindows:
        """Return the windows with `light` (n, k, k) subtracted."""
        return replace(self, light=self.light - light)

    def __len__(self) -> int:
        return len(self.middle)


def cut(
    pixels: Image,
    middle: IntArray,
    half: int,
    level: FloatArray,
    noise: FloatArray,
    ceiling: float,
    trail: FloatArray | None = None,
) -> StarWindows:
    """Return the windows around the pixels `middle` (n, 2), which must be inside of the frame.

    Args:
        pixels: frame (rows, columns), counts.
        middle: columns and rows of the middle pixels (n, 2).
        half: half width of the windows, px.
        level: sky background (n,), counts.
        noise: noise of a pixel without a star (n,), counts.
        ceiling: pixels of this many counts or more are saturated and not used.
        trail: displacement of the stars over the exposure (n, 2), px; None: none.
    """
    rows, columns = pixels.shape
    step = np.arange(-half, half + 1)
    column, row = middle[:, :1] + step, middle[:, 1:] + step
    good = ((row >= 0) & (row < rows))[:, :, None] & ((column >= 0) & (column < columns))[:, None, :]
    row, column = np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)
    counts = pixels[row[:, :, None], column[:, None, :]].astype(np.float64)
    light = np.where(good, counts - level[:, None, None], 0.0)
    path = np.zeros((len(middle), 2)) if trail is None else trail
    return StarWindows(middle, half, light, good & (counts < ceiling), noise, path)


def smoothed(light: FloatArray) -> FloatArray:
    """Return windows (n, k, k) smoothed by [1 2 1] along rows and columns; the outermost pixels are zero."""
    down = light[:, :-2] + 2.0 * light[:, 1:-1] + light[:, 2:]
    out = np.zeros_like(light)
    out[:, 1:-1, 1:-1] = down[:, :, :-2] + 2.0 * down[:, :, 1:-1] + down[:, :, 2:]
    return out


@dataclass(frozen=True, slots=True, eq=False)
class StarTargets:
    """The pixels around which n stars are measured, with the sky there.

    Attributes:
        pixels: frame (rows, columns), counts.
        middle: column and row of each star (n, 2).
        level, noise: background and noise of a pixel without a star (n,), counts.
        ceiling: counts at which pixels saturate.
        core: radius of the saturated disc (n,), px; 0 if no pixel is saturated.
        trail: displacement of the star from the beginning to the end of the exposure (n, 2), px.
        correlation: noise of a sum of pixels relative to that of independent pixels.
    """

    pixels: Image
    middle: IntArray
    level: FloatArray
    noise: FloatArray
    ceiling: float
    core: FloatArray
    trail: FloatArray
    correlation: float

    def windows(self, half: int, middle: IntArray | None = None) -> StarWindows:
        """Return the windows around all targets, or around `middle` (n, 2) instead."""
        about = self.middle if middle is None else middle
        return cut(self.pixels, about, half, self.level, self.noise, self.ceiling, self.trail)

    def select(self, chosen: BoolArray | IntArray) -> StarTargets:
        """Return the targets that `chosen` picks."""
        return select(self, chosen, "pixels", "ceiling", "correlation")

    def __len__(self) -> int:
        return len(self.middle)


# Length (px) below which a path counts as a point: it widens a PSF of 1 px by 0.2 %.
_SHORTEST = 0.2
# Number of quadrature nodes: accurate to 1e-3 of the light for paths of four sigmas.
_NODES = 4
_BELL = 1.0 / math.sqrt(2.0 * math.pi)


def profile(offset: FloatArray, sigma: FloatArray, half: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the share (n, k) of a star's light in each of k = 2 half + 1 pixels along one axis.

    Also return its derivatives (n, k) by position and by sigma. `offset` (n,) is the position of the star
    relative to the centre of the middle pixel, px; `sigma` (n,) is the width of the PSF, px.
    """
    from scipy.special import ndtr  # noqa: PLC0415 - see `regions.label_pixels`

    edges = (np.arange(-half, half + 2) - 0.5 - offset[:, None]) / sigma[:, None]
    whole = ndtr(edges)
    bell = _BELL * np.exp(-0.5 * edges * edges)
    slope = bell / sigma[:, None]
    spread = edges * slope
    share = whole[:, 1:] - whole[:, :-1]
    return share, slope[:, :-1] - slope[:, 1:], spread[:, :-1] - spread[:, 1:]


def path(trail: FloatArray) -> list[tuple[FloatArray, float]]:
    """Return positions (n, 2), px, along paths of `trail` (n, 2), relative to the middle, with weights."""
    if not len(trail) or float(np.abs(trail).max()) < _SHORTEST:
        return [(np.zeros_like(trail), 1.0)]
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    return [(0.5 * node * trail, 0.5 * weight) for node, weight in zip(nodes, weights, strict=True)]


def light(offset: FloatArray, sigma: FloatArray, half: int, trail: FloatArray | None = None) -> FloatArray:
    """Return the share of each star's light in each pixel of its window (n, k, k), rows first.

    Args:
        offset: position relative to the centre of the middle pixel (n, 2), px.
        sigma: width of the PSF (n,), px.
        half: half width of the window, px.
        trail: displacement of the star over the exposure (n, 2), px; None: none.
    """
    out = np.zeros((len(offset), 2 * half + 1, 2 * half + 1))
    for shift, share in path(np.zeros_like(offset) if trail is None else trail):
        x, y = (offset + shift).T
        across, down = profile(x, sigma, half)[0], profile(y, sigma, half)[0]
        out += share * (down[:, :, None] * across[:, None, :])
    return out


# Residual that a wrong PSF may cause, as a fraction of the star's light in the pixel.
_TOLERATED = 0.25
_LEAST_PIXELS = 40
_ROUNDS = 3


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """The noise of a pixel with the light of a star.

    Attributes:
        photon: photon noise, counts^2 per count of light (1/gain).
        mismatch: difference between the PSF and a Gaussian, as a fraction of the light.
    """

    photon: float = 0.0
    mismatch: float = 0.0

    def variance(self, light: FloatArray, noise: FloatArray) -> FloatArray:
        """Return the variance (n, k, k), counts^2, of pixels with `light` (n, k, k) and sky `noise` (n,)."""
        seen = np.maximum(light, 0.0)
        return np.asarray((noise**2)[:, None, None] + self.photon * seen + (self.mismatch * seen) ** 2)


def measure_noise(
    residual: FloatArray,
    variance: FloatArray,
    leverage: FloatArray,
    light: FloatArray,
    noise: FloatArray,
    gain: float | None,
) -> NoiseModel:
    """Return the noise model from the residuals of a fit; a given `gain` is kept.

    This is a non-negative least-squares fit of residual^2 - noise^2 by light and light^2, weighted with the
    variance of the square of a normal residual.

    Args:
        residual: residuals of the fit (n, k, k), counts.
        variance: their assumed variance (n, k, k), counts^2; infinite for unused pixels.
        leverage: part of the variance of each residual that the fit absorbed (n, k, k).
        light: fitted light of the stars (n, k, k), counts.
        noise: noise of a pixel without a star (n,), counts.
        gain: electrons per count, if known.
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
        # Residuals beyond 5 sigma of the present model are ignored: neighbours and hot pixels.
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
    """Return the mismatch as the weighted median over the stars, for a known photon noise.

    A wrong PSF affects all stars alike; the light of a neighbour, which is not a mismatch, affects a few.
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
    """Return the non-negative least-squares coefficients of `excess` by m and m^2."""
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


X, Y, FLUX, SKY, WIDTH = range(5)
NARROWEST, WIDEST = 0.25, 6.0
# Maximum steps of position and width (px): a start one pixel off must not diverge.
_LONGEST_STEP = 0.7
_WIDEST_STEP = 0.35
# Residuals (sigmas) beyond which a pixel is excluded, and the number of last steps in which this is done.
_CLIP = 6.0
_CLIP_FROM_END = 1
# Regularisation of the scaled normal matrix: a star without information keeps its position.
_RIDGE = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class PsfFit:
    """The fits of n stars in their windows.

    Attributes:
        offset: position relative to the middle of the window (n, 2), px.
        flux: counts (n,).
        sky: residual sky level, counts per pixel (n,).
        width: sigma of the Gaussian (n,), px.
        covariance: of x, y, flux and sky, and of the width if it was free (n, p, p).
        chi2: sum of the squared residuals over their variance (n,).
        used: number of pixels used (n,).
        residual, variance, leverage: of each pixel (n, k, k); the variance of an unused pixel is infinite.
        model: light of the star alone (n, k, k), counts.
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
        """Return these fits with the stars `chosen` (k,) replaced by `part`."""
        out = {item.name: getattr(self, item.name).copy() for item in fields(self)}
        for name, values in out.items():
            values[chosen] = getattr(part, name)
        return PsfFit(**out)


def fit(
    windows: StarWindows,
    offset: FloatArray,
    flux: FloatArray,
    width: FloatArray,
    noise: NoiseModel,
    free_width: bool,
    steps: int = 4,
) -> PsfFit:
    """Return the fits of the stars in `windows`.

    Args:
        windows: windows around the stars.
        offset: initial positions relative to the middle of the window (n, 2), px.
        flux: initial fluxes (n,), counts.
        width: initial widths (n,), px.
        noise: noise of the pixels.
        free_width: whether the width of each star is fitted.
        steps: number of Gauss-Newton steps.
    """
    count = 5 if free_width else 4
    values = np.concatenate([offset, flux[:, None], np.zeros((len(flux), 1)), width[:, None]], axis=1)
    for step in range(steps + 1):
        star, jacobian = _jacobian(values, windows, count)
        residual = windows.light - star - values[:, SKY, None, None]
        variance = noise.variance(star, windows.noise)
        good = windows.good
        if step >= steps - _CLIP_FROM_END:
            # The limit tolerates PSFs that are not Gaussian.
            good = good & ~(residual * residual > _CLIP**2 * (variance + (_TOLERATED * star) ** 2))
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


def _jacobian(values: FloatArray, windows: StarWindows, count: int) -> tuple[FloatArray, FloatArray]:
    """Return the light (n, k, k) of the stars and its derivatives (n, count, k k)."""
    total: FloatArray | None = None
    flux, size = values[:, FLUX, None], 2 * windows.half + 1
    for shift, share in path(windows.trail):
        across, across_x, across_w = profile(values[:, X] + shift[:, 0], values[:, WIDTH], windows.half)
        down, down_y, down_w = profile(values[:, Y] + shift[:, 1], values[:, WIDTH], windows.half)
        out = np.empty((len(values), count, size, size))
        np.multiply(down[:, :, None], (flux * across_x)[:, None, :], out=out[:, X])
        np.multiply((flux * down_y)[:, :, None], across[:, None, :], out=out[:, Y])
        np.multiply(down[:, :, None], across[:, None, :], out=out[:, FLUX])
        out[:, SKY] = 1.0
        if count > WIDTH:
            out[:, WIDTH] = (flux * down)[:, :, None] * across_w[:, None, :]
            out[:, WIDTH] += (flux * down_w)[:, :, None] * across[:, None, :]
        total = share * out if total is None else total + share * out
    assert total is not None  # a path has at least one point
    star = values[:, FLUX, None, None] * total[:, FLUX]
    return star, total.reshape(len(values), count, -1)


def _advance(values: FloatArray, step: FloatArray, half: int) -> None:
    """Change `values` (n, 5) in place by `step` (n, p), limited to the maximum step."""
    step[:, :2] = np.clip(step[:, :2], -_LONGEST_STEP, _LONGEST_STEP)
    if step.shape[1] > WIDTH:
        step[:, WIDTH] = np.clip(step[:, WIDTH], -_WIDEST_STEP, _WIDEST_STEP)
    values[:, : step.shape[1]] += step
    values[:, :2] = np.clip(values[:, :2], -half, half)
    values[:, WIDTH] = np.clip(values[:, WIDTH], NARROWEST, min(WIDEST, 1.0 * half))


def _inverse(normal: FloatArray) -> FloatArray:
    """Return the inverses of normal matrices (n, p, p), which are scaled to a unit diagonal meanwhile."""
    scale = np.sqrt(np.maximum(np.diagonal(normal, axis1=1, axis2=2), 1e-30))
    outer = scale[:, :, None] * scale[:, None, :]
    return np.asarray(np.linalg.inv(normal / outer + _RIDGE * np.eye(normal.shape[1])) / outer)


# Distance (PSF sigmas) beyond a window's edge from which a neighbour contributes no light to it.
_BEYOND = 3.0
_MOST_OVERLAP = 0.8
_LEAST_OVERLAP = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """Ordered pairs of stars whose light overlaps.

    Attributes:
        first, second: numbers of stars (p,), (p,); the second sends light into the window of the first.
        overlap: largest overlap of each star with a neighbour (n,), 0 to 1.
    """

    first: IntArray
    second: IntArray
    overlap: FloatArray


def neighbours(points: FloatArray, flux: FloatArray, psf_sigma: float, half: int) -> Pairs:
    """Return which of the stars at `points` (n, 2) px send light into the window of another star.

    The overlap of two images at the distance d is exp(-d^2 / 4 sigma^2); it is 0 for an isolated star and
    where it is below 1 %.
    """
    apart = points[:, None] - points
    reach = half + _BEYOND * psf_sigma
    near = (np.abs(apart) < reach).all(axis=-1) & (flux > 0.0)
    np.fill_diagonal(near, val=False)
    first, second = np.nonzero(near)
    square = np.sum(apart[first, second] ** 2, axis=-1)
    each = np.minimum(np.exp(-square / (4.0 * psf_sigma**2)), _MOST_OVERLAP)
    overlap = np.zeros(len(points))
    np.maximum.at(overlap, first, np.where(each > _LEAST_OVERLAP, each, 0.0))
    return Pairs(first, second, overlap)


def neighbour_light(
    pairs: Pairs,
    windows: StarWindows,
    middle: IntArray,
    offset: FloatArray,
    flux: FloatArray,
    width: FloatArray,
) -> FloatArray:
    """Return the light (n, k, k), counts, of all neighbours in the window of each star.

    The stars are at `offset` (n, 2) px from the middle pixels `middle` (n, 2) of their windows, with `flux`
    (n,), counts, and `width` (n,), px.
    """
    size = 2 * windows.half + 1
    out = np.zeros((len(middle), size, size))
    place = (middle + offset)[pairs.second] - middle[pairs.first]
    share = light(place, width[pairs.second], windows.half, windows.trail[pairs.second])
    np.add.at(out, pairs.first, share * np.maximum(flux, 0.0)[pairs.second, None, None])
    return out
