"""Fit of a Gaussian point spread function (PSF) to the pixels of all stars of a frame at once.

The fit of a star in a square window determines its position, flux, residual sky level and optionally its
width. A star that moves during the exposure is modelled as a mean of Gaussians along its path (Gauss-Legendre
quadrature). The weights of the Gauss-Newton fit are computed from the fitted model, not from the counts.
Weights computed from the counts would be larger for pixels that are low by chance, so that the fitted flux
would be too low. The normal equations of all stars, 4 x 4 or 5 x 5 each, are solved together.

The variance of a pixel is noise^2 + light / gain + (mismatch x light)^2, where light is the star's counts in
the pixel. The three terms of the variance of a pixel are the sky noise, the photon noise, and the difference
between the PSF and a Gaussian. If the gain is unknown, gain and mismatch are measured from the residuals of
the stars. Gain and mismatch can be distinguished, because the variance due to photon noise is proportional to
the light, and the variance due to the mismatch is proportional to the square of the light.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, Image, IntArray, select
from knightcube.compiled import compiled_form_of, loop_helper


@dataclass(frozen=True, slots=True, eq=False)
class StarWindows:
    """Square windows of k x k pixels around n stars, k = 2 half + 1.

    Attributes:
        middle: column and row of the middle pixel of each window (n, 2).
        half: half-width of the windows around stars, px.
        light: counts of each pixel above the sky, including saturated pixels (n, k, k); 0 outside the frame.
        good: mask of the pixels that are inside the frame and not saturated (n, k, k).
        noise: standard deviation of a background pixel in each window (n,), counts.
        trail: displacement of each star from the beginning to the end of the exposure (n, 2), px.
    """

    middle: IntArray
    half: int
    light: FloatArray
    good: BoolArray
    noise: FloatArray
    trail: FloatArray

    def select(self, chosen: BoolArray | IntArray) -> StarWindows:
        """Return the windows `chosen` by a mask (n,) or by indices."""
        return select(self, chosen, "half")

    def without(self, light: FloatArray) -> StarWindows:
        """Return the windows with the counts `light` (n, k, k) subtracted."""
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
    """Return the windows of half-width `half` around the pixels `middle` (n, 2) inside the frame.

    The level (n,) and noise (n,) of the sky in each window are in counts. A pixel with counts of `ceiling` or
    more is saturated and not used. The displacement of each star during the exposure is `trail` (n, 2), px.
    """
    light, good = _cut(pixels, middle, half, level, float(ceiling))
    path = np.zeros((len(middle), 2)) if trail is None else trail
    return StarWindows(middle, half, light, good, noise, path)


def _cut_numpy(
    pixels: Image, middle: IntArray, half: int, level: FloatArray, ceiling: float
) -> tuple[FloatArray, BoolArray]:
    """Return the counts above the level in the windows, and the mask of the usable pixels (n, k, k)."""
    rows, columns = pixels.shape
    step = np.arange(-half, half + 1)
    column, row = middle[:, :1] + step, middle[:, 1:] + step
    good = ((row >= 0) & (row < rows))[:, :, None] & ((column >= 0) & (column < columns))[:, None, :]
    row, column = np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)
    counts = pixels[row[:, :, None], column[:, None, :]].astype(np.float64)
    light = np.where(good, counts - level[:, None, None], 0.0)
    return light, good & (counts < ceiling)


@compiled_form_of(_cut_numpy)
def _cut(
    pixels: Image, middle: IntArray, half: int, level: FloatArray, ceiling: float
) -> tuple[FloatArray, BoolArray]:
    """See `_cut_numpy`."""
    (rows, columns), size = pixels.shape, 2 * half + 1
    light = np.zeros((len(middle), size, size))
    good = np.zeros((len(middle), size, size), dtype=np.bool_)
    for star in range(len(middle)):
        left, top = middle[star, 0] - half, middle[star, 1] - half
        for row in range(max(0, -top), min(size, rows - top)):
            for column in range(max(0, -left), min(size, columns - left)):
                counts = float(pixels[top + row, left + column])
                light[star, row, column] = counts - level[star]
                good[star, row, column] = counts < ceiling
    return light, good


def smoothed(light: FloatArray) -> FloatArray:
    """Return windows (n, k, k) smoothed by [1 2 1] along rows and columns; the outermost pixels are zero."""
    down = light[:, :-2] + 2.0 * light[:, 1:-1] + light[:, 2:]
    out = np.zeros_like(light)
    out[:, 1:-1, 1:-1] = down[:, :, :-2] + 2.0 * down[:, :, 1:-1] + down[:, :, 2:]
    return out


@dataclass(frozen=True, slots=True, eq=False)
class StarTargets:
    """The pixels around which n stars are measured, with the sky background at these pixels.

    Attributes:
        pixels: counts of the frame (rows, columns).
        middle: column and row of the pixel around which each star is measured (n, 2).
        level, noise: level and standard deviation of the sky background at each star (n,), counts.
        ceiling: counts at which pixels saturate.
        core: radius of the saturated disc of each star (n,), px; 0 if the star is not saturated.
        trail: displacement of each star from the beginning to the end of the exposure (n, 2), px.
        correlation: ratio of the noise of a sum of pixels to the noise of a sum of independent pixels.
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
        """Return the windows around all targets, or around `middle` (n, 2) if it is given."""
        about = self.middle if middle is None else middle
        return cut(self.pixels, about, half, self.level, self.noise, self.ceiling, self.trail)

    def select(self, chosen: BoolArray | IntArray) -> StarTargets:
        """Return the targets `chosen` by a mask (n,) or by indices."""
        return select(self, chosen, "pixels", "ceiling", "correlation")

    def __len__(self) -> int:
        return len(self.middle)


# Length (px) of a star's path below which the path is neglected. Such a path widens a PSF of 1 px by 0.2 %.
_SHORTEST = 0.2
# Number of quadrature nodes, for an error of 0.1 % of the flux on paths of four PSF widths.
_NODES = 4
_BELL, _ROOT_HALF = 1.0 / math.sqrt(2.0 * math.pi), math.sqrt(0.5)


def profile(offset: FloatArray, sigma: FloatArray, half: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the fraction (n, k) of a star's flux in each of k = 2 half + 1 pixels along one axis.

    The second and third returned arrays (n, k) are the derivatives of the fraction, 1/px, with respect to
    `offset` and with respect to `sigma`. The position of the star relative to the centre of the middle pixel
    is `offset` (n,), px, and the standard deviation of the PSF is `sigma` (n,), px.
    """
    from scipy.special import ndtr  # noqa: PLC0415 - scipy occupies memory

    edges = (np.arange(-half, half + 2) - 0.5 - offset[:, None]) / sigma[:, None]
    whole = ndtr(edges)
    bell = _BELL * np.exp(-0.5 * edges * edges)
    slope = bell / sigma[:, None]
    spread = edges * slope
    share = whole[:, 1:] - whole[:, :-1]
    return share, slope[:, :-1] - slope[:, 1:], spread[:, :-1] - spread[:, 1:]


def path(trail: FloatArray) -> list[tuple[FloatArray, float]]:
    """Return the nodes of a quadrature along the paths of n stars, with their weights.

    Each quadrature node is a displacement of the stars from the midpoints of their paths (n, 2), px. The
    vectors `trail` (n, 2), px, lead from the start to the end of each path.
    """
    if not len(trail) or float(np.abs(trail).max()) < _SHORTEST:
        return [(np.zeros_like(trail), 1.0)]
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    return [(0.5 * node * trail, 0.5 * weight) for node, weight in zip(nodes, weights, strict=True)]


def nodes(trail: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the nodes (m, n, 2), px, and weights (m,) of `path` as arrays."""
    if not trail.any():
        return np.zeros((1, *trail.shape)), np.ones(1)
    shift, share = zip(*path(trail), strict=True)
    return np.array(shift), np.array(share)


def light(offset: FloatArray, sigma: FloatArray, half: int, trail: FloatArray | None = None) -> FloatArray:
    """Return the fraction of each star's flux in each pixel of its window (n, k, k), rows first.

    The `offset` (n, 2), px, of each star is relative to the centre of the middle pixel. The standard
    deviation of its PSF is `sigma` (n,), px, and its displacement during the exposure is `trail` (n, 2), px.
    """
    out = np.zeros((len(offset), 2 * half + 1, 2 * half + 1))
    for shift, share in path(np.zeros_like(offset) if trail is None else trail):
        x, y = (offset + shift).T
        across, down = profile(x, sigma, half)[0], profile(y, sigma, half)[0]
        out += share * (down[:, :, None] * across[:, None, :])
    return out


# Tolerated residual of a pixel due to a wrong PSF, as a fraction of the star's counts in the pixel.
_TOLERATED = 0.25
_LEAST_PIXELS = 40
_ROUNDS = 3


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """The noise model of pixels that contain the light of a star.

    The photon noise has the variance `photon` per count (the reciprocal of the gain). The PSF differs from a
    Gaussian by the fraction `mismatch` of the star's counts.
    """

    photon: float = 0.0
    mismatch: float = 0.0

    def variance(self, light: FloatArray, noise: FloatArray) -> FloatArray:
        """Return the variances of pixels with `light` (n, k, k), counts, and sky `noise` (n,), counts."""
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
    """Return the noise model from the residuals of a fit of stars; a given gain (e/count) is kept.

    The residuals (n, k, k), counts, have the assumed variances (n, k, k), which are infinite for unused
    pixels. The fit has absorbed the fraction `leverage` (n, k, k) of each variance, and `light` (n, k, k)
    contains the fitted counts. The squared residual minus the squared sky noise (n,) is modelled as a sum of
    non-negative multiples of light and light^2, found by least squares. Each squared residual is weighted
    with the reciprocal of its variance, which is computed for normally distributed residuals.
    """
    used = np.isfinite(variance) & (light > 0.5 * noise[:, None, None]) & (leverage < 0.8)
    given = 0.0 if gain is None else 1.0 / gain
    if np.count_nonzero(used) < _LEAST_PIXELS:
        return NoiseModel(given, 0.0)
    if gain is not None:
        return NoiseModel(given, _shared_mismatch(residual, leverage, light, noise, used, given))
    photon, square = _noise_terms(residual, leverage, light, noise, used)
    return NoiseModel(photon, math.sqrt(square))


def _noise_terms_numpy(
    residual: FloatArray, leverage: FloatArray, light: FloatArray, noise: FloatArray, used: BoolArray
) -> tuple[float, float]:
    """Return the non-negative coefficients of light and light^2 in the variance of the `used` pixels."""
    m = light[used]
    floor = np.broadcast_to((noise**2)[:, None, None], light.shape)[used]
    excess = residual[used] ** 2 / (1.0 - leverage[used]) - floor
    photon, square = 0.0, 0.0
    for _ in range(_ROUNDS):
        expected = floor + photon * m + square * m * m
        weight = 1.0 / expected**2
        # Residuals beyond 5 standard deviations, due to neighbouring stars or hot pixels, are ignored.
        weight = np.where(excess < 25.0 * expected, weight, 0.0) if square or photon else weight
        of_square, of_both, of_light = (float(np.sum(weight * m**power)) for power in (4, 3, 2))
        along, across = float(np.sum(weight * excess * m)), float(np.sum(weight * excess * m * m))
        photon, square = _non_negative(of_light, of_both, of_square, along, across)
    return photon, square


@compiled_form_of(_noise_terms_numpy)
def _noise_terms(
    residual: FloatArray, leverage: FloatArray, light: FloatArray, noise: FloatArray, used: BoolArray
) -> tuple[float, float]:
    """See `_noise_terms_numpy`."""
    stars, rows, columns = light.shape
    photon, square = 0.0, 0.0
    for _ in range(_ROUNDS):
        of_light, of_both, of_square, along, across = 0.0, 0.0, 0.0, 0.0, 0.0
        for star in range(stars):
            floor = noise[star] ** 2
            for row in range(rows):
                for column in range(columns):
                    if not used[star, row, column]:
                        continue
                    m, free = light[star, row, column], 1.0 - leverage[star, row, column]
                    excess = residual[star, row, column] ** 2 / free - floor
                    expected = floor + photon * m + square * m * m
                    if (square == photon == 0.0) or excess < 25.0 * expected:
                        weight = m / expected**2
                        along += weight * excess
                        across += weight * excess * m
                        of_light += weight * m
                        of_both += weight * m * m
                        of_square += weight * m * m * m
        photon, square = _non_negative(of_light, of_both, of_square, along, across)
    return photon, square


def _shared_mismatch(
    residual: FloatArray,
    leverage: FloatArray,
    light: FloatArray,
    noise: FloatArray,
    used: BoolArray,
    photon: float,
) -> float:
    """Return the mismatch of PSF and Gaussian for known photon noise, as a weighted median over the stars.

    A median is used because a wrong PSF affects all stars, whereas neighbouring stars affect only a few.
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


@loop_helper
def _non_negative(
    of_light: float, of_both: float, of_square: float, along: float, across: float
) -> tuple[float, float]:
    """Return the non-negative coefficients a, b of a fit of light and light^2, from two normal equations.

    The coefficient a belongs to light, and b to light^2. The first three arguments are the weighted sums of
    light^2, light^3 and light^4 over the pixels. The arguments `along` and `across` are the weighted sums of
    the excess variance times light and of the excess variance times light^2. The normal equations are
    of_light a + of_both b = along and of_both a + of_square b = across.
    """
    determinant = of_light * of_square - of_both**2
    if determinant > 1e-12 * of_light * of_square:
        first = (of_square * along - of_both * across) / determinant
        second = (of_light * across - of_both * along) / determinant
        if first >= 0.0 and second >= 0.0:
            return first, second
    first, second = max(0.0, along / of_light), max(0.0, across / of_square)
    return (first, 0.0) if first * along >= second * across else (0.0, second)


X, Y, FLUX, SKY, WIDTH = range(5)
NARROWEST, WIDEST = 0.25, 6.0
# Maximum steps of position and width (px), with which a fit converges even from an initial error of 1 px.
_LONGEST_STEP = 0.7
_WIDEST_STEP = 0.35
# Residual (standard deviations) above which a pixel is excluded in the last steps, and number of last steps.
_CLIP = 6.0
_CLIP_FROM_END = 1
# Regularisation of the scaled normal matrix, by which a star without usable pixels keeps its position.
_RIDGE = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class PsfFit:
    """The fits of n stars in their windows.

    Attributes:
        offset: position of each star relative to the middle of its window (n, 2), px.
        flux: flux of each star (n,), counts.
        sky: residual sky level at each star (n,), counts per pixel.
        width: standard deviation of each star's Gaussian (n,), px.
        covariance: covariance of x, y, flux and sky, and of the width if it was fitted (n, p, p).
        chi2: chi-square of each fit (n,).
        used: number of pixels used in each fit (n,).
        residual, leverage: residual (counts) and leverage of each pixel (n, k, k).
        variance: assumed variance of each pixel (n, k, k), counts^2; infinite for unused pixels.
        model: fitted counts of the star without sky (n, k, k).
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
        """Return the fits of the stars with the indices `chosen` (k,)."""
        return select(self, chosen)

    def replaced(self, chosen: IntArray, part: PsfFit) -> PsfFit:
        """Return a copy in which `part` replaces the fits of the stars with the indices `chosen` (k,)."""
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
    """Return the fits of the stars in `windows` after `steps` Gauss-Newton steps.

    The initial positions `offset` (n, 2), px, are relative to the middle of the window, the initial fluxes
    (n,) are in counts, and the initial widths (n,) are standard deviations of the Gaussians, px.
    """
    values = np.concatenate([offset, flux[:, None], np.zeros((len(flux), 1)), width[:, None]], axis=1)
    shift, share = nodes(windows.trail)
    found = _solve(
        np.ascontiguousarray(windows.light),
        np.ascontiguousarray(windows.good),
        np.ascontiguousarray(windows.noise),
        shift,
        share,
        values,
        (noise.photon, noise.mismatch),
        5 if free_width else 4,
        steps,
    )
    return PsfFit(values[:, :2], values[:, FLUX], values[:, SKY], values[:, WIDTH], *found)


_Solved = tuple[FloatArray, FloatArray, IntArray, FloatArray, FloatArray, FloatArray, FloatArray]
"""Type of the attributes covariance, chi2, used, residual, variance, leverage and model of `PsfFit`."""


def _solve_numpy(
    light: FloatArray,
    good: BoolArray,
    noise: FloatArray,
    shift: FloatArray,
    share: FloatArray,
    values: FloatArray,
    model: tuple[float, float],
    count: int,
    steps: int,
) -> _Solved:
    """Fit the parameters `values` (n, 5) in place, the first `count` of which are free, and return the fits.

    The quadrature has m nodes with the displacements `shift` (m, n, 2), px, and the weights `share` (m,). The
    argument `model` contains the photon noise and the mismatch of the noise model.
    """
    size = light.shape[1]
    # All steps share two arrays, because allocating large arrays takes more time than the arithmetic.
    jacobian = np.empty((len(values), count, size * size))
    weighted = np.empty_like(jacobian)
    for step in range(steps + 1):
        star = _model(values, shift, share, jacobian)
        residual = light - star
        residual -= values[:, SKY, None, None]
        variance = NoiseModel(*model).variance(star, noise)
        used = good
        if step >= steps - _CLIP_FROM_END:
            # The limit above which pixels are excluded tolerates PSFs that are not Gaussian.
            used = used & ~(residual * residual > _CLIP**2 * (variance + (_TOLERATED * star) ** 2))
        weight = (used / variance).reshape(len(values), -1)
        np.multiply(jacobian, weight[:, None, :], out=weighted)
        normal = weighted @ jacobian.transpose(0, 2, 1)
        inverse = _inverse(normal)
        if step < steps:
            gradient = (weighted @ residual.reshape(len(values), -1, 1))[:, :, 0]
            _advance(values, (inverse @ gradient[:, :, None])[:, :, 0], size // 2)
    np.matmul(inverse, jacobian, out=weighted)
    weighted *= jacobian
    return (
        inverse,
        np.sum(weight * residual.reshape(len(values), -1) ** 2, axis=1),
        np.count_nonzero(used, axis=(1, 2)),
        residual,
        np.where(used, variance, np.inf),
        (weight * np.sum(weighted, axis=1)).reshape(residual.shape),
        star,
    )


@compiled_form_of(_solve_numpy)
def _solve(
    light: FloatArray,
    good: BoolArray,
    noise: FloatArray,
    shift: FloatArray,
    share: FloatArray,
    values: FloatArray,
    model: tuple[float, float],
    count: int,
    steps: int,
) -> _Solved:
    """See `_solve_numpy`."""
    stars, size = light.shape[0], light.shape[1]
    area, half = size * size, float(size // 2)
    covariance = np.empty((stars, count, count))
    chi2, number = np.zeros(stars), np.zeros(stars, dtype=np.int64)
    residual, variance = np.empty((stars, area)), np.empty((stars, area))
    leverage, modelled = np.empty((stars, area)), np.empty((stars, area))
    jacobian, weight, weighted = np.empty((5, area)), np.empty(area), np.empty(area)
    normal, gradient = np.empty((count, count)), np.empty(count)
    # All passes share their arrays, because an allocation takes as long as the arithmetic of a row.
    profiles, factor = np.empty((2, 3, size + 1)), np.empty((count + 1, count))
    for star in range(stars):
        value, counts, off, expected = values[star], modelled[star], residual[star], variance[star]
        usable, seen = good[star].reshape(area), light[star].reshape(area)
        for step in range(steps + 1):
            _derivatives(value, shift[:, star], share, profiles, jacobian)
            for pixel in range(area):
                counts[pixel] = value[FLUX] * jacobian[FLUX, pixel]
                off[pixel] = seen[pixel] - counts[pixel] - value[SKY]
            # In the last steps, pixels with residuals above a limit are excluded (see `_solve_numpy`).
            limit = _CLIP**2 if step >= steps - _CLIP_FROM_END else np.inf
            _weights(counts, off, usable, noise[star], model, limit, expected, weight)
            for i in range(count):
                for pixel in range(area):
                    weighted[pixel] = weight[pixel] * jacobian[i, pixel]
                gradient[i] = _inner(weighted, off)
                for j in range(i + 1):
                    normal[i, j] = _inner(weighted, jacobian[j])
            _invert(normal, factor, covariance[star])
            if step < steps:
                for i in range(count):
                    longest = _LONGEST_STEP if i < FLUX else (_WIDEST_STEP if i == WIDTH else np.inf)
                    value[i] += min(max(_inner(covariance[star, i], gradient), -longest), longest)
                value[X] = min(max(value[X], -half), half)
                value[Y] = min(max(value[Y], -half), half)
                value[WIDTH] = min(max(value[WIDTH], NARROWEST), WIDEST, half)
        _write_leverage(jacobian, covariance[star], weight, leverage[star])
        for pixel in range(area):
            chi2[star] += weight[pixel] * off[pixel] ** 2
            number[star] += weight[pixel] > 0.0
            if weight[pixel] == 0.0:
                expected[pixel] = np.inf
    return (
        covariance,
        chi2,
        number,
        residual.reshape(light.shape),
        variance.reshape(light.shape),
        leverage.reshape(light.shape),
        modelled.reshape(light.shape),
    )


@loop_helper
def _derivatives(
    value: FloatArray, shift: FloatArray, share: FloatArray, profiles: FloatArray, jacobian: FloatArray
) -> None:
    """Write the derivatives (5, k * k) of one star's counts with respect to its parameters `value` (5,).

    The array `profiles` (2, 3, k + 1) is overwritten.
    """
    (across, down), size = (profiles[0], profiles[1]), profiles.shape[2] - 1
    jacobian[:] = 0.0
    jacobian[SKY] = 1.0
    for node in range(len(share)):
        _profile(value[X] + shift[node, 0], value[WIDTH], across)
        _profile(value[Y] + shift[node, 1], value[WIDTH], down)
        flux = share[node] * value[FLUX]
        for row in range(size):
            of_x, of_y, of_flux = flux * down[0, row], flux * down[1, row], share[node] * down[0, row]
            of_width, pixel = flux * down[2, row], row * size
            for column in range(size):
                one = across[0, column]
                jacobian[X, pixel + column] += of_x * across[1, column]
                jacobian[Y, pixel + column] += of_y * one
                jacobian[FLUX, pixel + column] += of_flux * one
                jacobian[WIDTH, pixel + column] += of_x * across[2, column] + of_width * one


@loop_helper
def _weights(
    counts: FloatArray,
    off: FloatArray,
    usable: BoolArray,
    noise: float,
    model: tuple[float, float],
    limit: float,
    variance: FloatArray,
    weight: FloatArray,
) -> None:
    """Write variance and weight of the pixels of one star.

    The weight of a pixel is zero if the pixel is not `usable`, or if the square of its residual `off` exceeds
    `limit` times the tolerated variance.
    """
    photon, mismatch = model
    for pixel in range(len(counts)):
        of_star = max(counts[pixel], 0.0)
        variance[pixel] = noise**2 + photon * of_star + (mismatch * of_star) ** 2
        largest = limit * (variance[pixel] + (_TOLERATED * counts[pixel]) ** 2)
        kept = usable[pixel] and off[pixel] * off[pixel] <= largest
        weight[pixel] = 1.0 / variance[pixel] if kept else 0.0


@loop_helper
def _write_leverage(
    jacobian: FloatArray, covariance: FloatArray, weight: FloatArray, leverage: FloatArray
) -> None:
    """Write the fraction of each pixel's variance that the fit of one star has absorbed."""
    leverage[:] = 0.0
    for i in range(len(covariance)):
        for j in range(i + 1):
            share = covariance[i, j] if i == j else 2.0 * covariance[i, j]
            for pixel in range(len(weight)):
                leverage[pixel] += share * jacobian[i, pixel] * jacobian[j, pixel]
    for pixel in range(len(weight)):
        leverage[pixel] *= weight[pixel]


@loop_helper
def _inner(first: FloatArray, second: FloatArray) -> float:
    """Return the inner product of two vectors."""
    total = 0.0
    for k in range(len(first)):
        total += first[k] * second[k]
    return total


# Spacing of the tabulated edges, and the farthest edge, in standard deviations of the PSF.
_SPACING, _FARTHEST_EDGE = 1.0 / 32.0, 8.0
_EDGES = np.arange(-_FARTHEST_EDGE, _FARTHEST_EDGE + 0.5 * _SPACING, _SPACING).tolist()
_SHARES = np.array([0.5 * math.erfc(-edge * _ROOT_HALF) for edge in _EDGES])
_BELLS = np.array([_BELL * math.exp(-0.5 * edge * edge) for edge in _EDGES])


@loop_helper
def _profile(offset: float, sigma: float, out: FloatArray) -> None:
    """Write the three arrays that `profile` returns, for one star, to `out` (3, k + 1), last column unused.

    The normal distribution function and its density are computed from Taylor series about the nearest node of
    a table, because `erfc` and `exp` would take a third of the time of a fit. The error of the series is
    below 1e-12.
    """
    size = out.shape[1] - 1
    for k in range(size + 1):
        edge = min(max((k - 0.5 * size - offset) / sigma, -_FARTHEST_EDGE), _FARTHEST_EDGE)
        place = int((edge + _FARTHEST_EDGE) / _SPACING + 0.5)
        x = place * _SPACING - _FARTHEST_EDGE
        off, square, bell = edge - x, x * x, _BELLS[place]
        # The coefficients of the distribution are Hermite polynomials.
        fifth = (square * (square - 6.0) + 3.0) / 120.0 - off * x * (square * (square - 10.0) + 15.0) / 720.0
        third = (square - 1.0) / 6.0 + off * (x * (3.0 - square) / 24.0 + off * fifth)
        out[0, k] = _SHARES[place] + bell * off * (1.0 + off * (off * third - 0.5 * x))
        power = -off * (x + 0.5 * off)
        fourth = 1.0 + power / 5.0 * (1.0 + power / 6.0 * (1.0 + power / 7.0))
        growth = 1.0 + power * (1.0 + power / 2.0 * (1.0 + power / 3.0 * (1.0 + power / 4.0 * fourth)))
        out[1, k] = bell * growth / sigma
        out[2, k] = edge * out[1, k]
    for k in range(size):
        out[0, k] = out[0, k + 1] - out[0, k]
        out[1, k] -= out[1, k + 1]
        out[2, k] -= out[2, k + 1]


@loop_helper
def _invert(normal: FloatArray, factor: FloatArray, out: FloatArray) -> None:
    """Write the inverse of one normal matrix (p, p), given by its lower triangle, to `out`.

    The array `factor` (p + 1, p) is overwritten.
    """
    count = len(normal)
    scale = factor[count]
    for i in range(count):
        scale[i] = math.sqrt(max(normal[i, i], 1e-30))
    # The Cholesky factor of the scaled matrix is computed first, and is then inverted.
    for i in range(count):
        for j in range(i + 1):
            value = normal[i, j] / (scale[i] * scale[j]) + (_RIDGE if i == j else 0.0)
            for k in range(j):
                value -= factor[i, k] * factor[j, k]
            factor[i, j] = math.sqrt(max(value, _RIDGE)) if i == j else value / factor[j, j]
    for j in range(count):
        factor[j, j] = 1.0 / factor[j, j]
        for i in range(j + 1, count):
            value = 0.0
            for k in range(j, i):
                value -= factor[i, k] * factor[k, j]
            factor[i, j] = value / factor[i, i]
    for i in range(count):
        for j in range(i + 1):
            value = 0.0
            for k in range(i, count):
                value += factor[k, i] * factor[k, j]
            out[i, j] = value / (scale[i] * scale[j])
            out[j, i] = out[i, j]


def _model(values: FloatArray, shift: FloatArray, share: FloatArray, jacobian: FloatArray) -> FloatArray:
    """Return the modelled counts of the stars (n, k, k), and write their derivatives to `jacobian`.

    The derivatives (n, p, k * k) are with respect to the first p of the five parameters `values` (n, 5) of
    each star, where p is 4 or 5.
    """
    flux, size, count = values[:, FLUX, None], math.isqrt(jacobian.shape[2]), jacobian.shape[1]
    total = jacobian.reshape(len(values), count, size, size)
    out = total
    if len(share) != 1:
        out = np.empty_like(total)
        total[:] = 0.0
    for moved, part in zip(shift, share, strict=True):
        across, across_x, across_w = profile(values[:, X] + moved[:, 0], values[:, WIDTH], size // 2)
        down, down_y, down_w = profile(values[:, Y] + moved[:, 1], values[:, WIDTH], size // 2)
        np.multiply(down[:, :, None], (flux * across_x)[:, None, :], out=out[:, X])
        np.multiply((flux * down_y)[:, :, None], across[:, None, :], out=out[:, Y])
        np.multiply(down[:, :, None], across[:, None, :], out=out[:, FLUX])
        out[:, SKY] = 1.0
        if count > WIDTH:
            np.multiply((flux * down)[:, :, None], across_w[:, None, :], out=out[:, WIDTH])
            out[:, WIDTH] += (flux * down_w)[:, :, None] * across[:, None, :]
        if out is not total:
            out *= part
            total += out
    return np.asarray(values[:, FLUX, None, None] * total[:, FLUX])


def _advance(values: FloatArray, step: FloatArray, half: int) -> None:
    """Add `step` (n, p) to the first p of the parameters `values` (n, 5), both limited to their ranges."""
    step[:, :2] = np.clip(step[:, :2], -_LONGEST_STEP, _LONGEST_STEP)
    if step.shape[1] > WIDTH:
        step[:, WIDTH] = np.clip(step[:, WIDTH], -_WIDEST_STEP, _WIDEST_STEP)
    values[:, : step.shape[1]] += step
    values[:, :2] = np.clip(values[:, :2], -half, half)
    values[:, WIDTH] = np.clip(values[:, WIDTH], NARROWEST, min(WIDEST, 1.0 * half))


def _inverse(normal: FloatArray) -> FloatArray:
    """Return the inverses of normal matrices (n, p, p), computed after scaling to a unit diagonal."""
    scale = np.sqrt(np.maximum(np.diagonal(normal, axis1=1, axis2=2), 1e-30))
    outer = scale[:, :, None] * scale[:, None, :]
    return np.asarray(np.linalg.inv(normal / outer + _RIDGE * np.eye(normal.shape[1])) / outer)


# Distance of a star from a window's edge, in PSF standard deviations, above which its light is neglected.
_BEYOND = 3.0
_MOST_OVERLAP = 0.8
_LEAST_OVERLAP = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """Ordered pairs of stars: indices (p,) of a star and of a neighbour that contributes light to its window.

    The largest overlap of each star with a neighbour is `overlap` (n,), between 0 and 1.
    """

    first: IntArray
    second: IntArray
    overlap: FloatArray


def neighbours(points: FloatArray, flux: FloatArray, psf_sigma: float, half: int) -> Pairs:
    """Return the pairs of stars at `points` (n, 2), px, of which one contributes light to the other's window.

    The overlap of two star images at the distance d is exp(-d^2 / 4 sigma^2), where sigma is the standard
    deviation of the PSF. An overlap below 1 % is set to 0.
    """
    reach = half + _BEYOND * psf_sigma
    return Pairs(*_pairs(np.ascontiguousarray(points), np.ascontiguousarray(flux), psf_sigma, reach))


def _pairs_numpy(
    points: FloatArray, flux: FloatArray, psf_sigma: float, reach: float
) -> tuple[IntArray, IntArray, FloatArray]:
    """Return the attributes of the `Pairs` of stars closer than `reach`, px, along both axes."""
    x, y = points.T
    across, down = x[:, None] - x, y[:, None] - y
    near = (np.abs(across) < reach) & (np.abs(down) < reach) & (flux > 0.0)
    np.fill_diagonal(near, val=False)
    first, second = np.nonzero(near)
    square = across[first, second] ** 2 + down[first, second] ** 2
    each = np.minimum(np.exp(-square / (4.0 * psf_sigma**2)), _MOST_OVERLAP)
    overlap = np.zeros(len(points))
    np.maximum.at(overlap, first, np.where(each > _LEAST_OVERLAP, each, 0.0))
    return first, second, overlap


@compiled_form_of(_pairs_numpy)
def _pairs(
    points: FloatArray, flux: FloatArray, psf_sigma: float, reach: float
) -> tuple[IntArray, IntArray, FloatArray]:
    """See `_pairs_numpy`."""
    count, overlap = 0, np.zeros(len(points))
    first, second = np.empty(16, dtype=np.int64), np.empty(16, dtype=np.int64)
    for one in range(len(points)):
        for other in range(len(points)):
            across, down = points[one, 0] - points[other, 0], points[one, 1] - points[other, 1]
            if abs(across) < reach and abs(down) < reach and one != other and flux[other] > 0.0:
                if count == len(first):
                    first, second = np.append(first, first), np.append(second, second)
                first[count], second[count] = one, other
                count += 1
                square = across * across + down * down
                each = min(math.exp(-square / (4.0 * psf_sigma * psf_sigma)), _MOST_OVERLAP)
                overlap[one] = max(overlap[one], each if each > _LEAST_OVERLAP else 0.0)
    return first[:count].copy(), second[:count].copy(), overlap


def neighbour_light(
    pairs: Pairs,
    windows: StarWindows,
    middle: IntArray,
    offset: FloatArray,
    flux: FloatArray,
    width: FloatArray,
) -> FloatArray:
    """Return the counts of all neighbours in the window of each star (n, k, k).

    The stars have middle pixels (n, 2), offsets from the middle (n, 2), px, fluxes (n,), counts, and widths
    (n,), px.
    """
    place = (middle + offset)[pairs.second] - middle[pairs.first]
    counts = np.maximum(flux, 0.0)[pairs.second]
    given = place, counts, width[pairs.second], *nodes(windows.trail[pairs.second])
    return _summed_light(pairs.first, *given, len(middle), windows.half)


def _summed_light_numpy(
    own: IntArray,
    place: FloatArray,
    flux: FloatArray,
    width: FloatArray,
    shift: FloatArray,
    share: FloatArray,
    count: int,
    half: int,
) -> FloatArray:
    """Return the sums (count, k, k) of the counts of p stars in the windows `own` (p,).

    The stars have the positions `place` (p, 2) relative to the middle of the window, px. The quadrature has m
    nodes with the displacements `shift` (m, p, 2), px, and the weights `share` (m,).
    """
    out = np.zeros((count, 2 * half + 1, 2 * half + 1))
    for moved, part in zip(shift, share, strict=True):
        x, y = (place + moved).T
        across, down = profile(x, width, half)[0], profile(y, width, half)[0]
        np.add.at(out, own, (part * flux)[:, None, None] * (down[:, :, None] * across[:, None, :]))
    return out


@compiled_form_of(_summed_light_numpy)
def _summed_light(
    own: IntArray,
    place: FloatArray,
    flux: FloatArray,
    width: FloatArray,
    shift: FloatArray,
    share: FloatArray,
    count: int,
    half: int,
) -> FloatArray:
    """See `_summed_light_numpy`."""
    size = 2 * half + 1
    out, across, down = np.zeros((count, size, size)), np.empty((3, size + 1)), np.empty((3, size + 1))
    for star in range(len(own)):
        for node in range(len(share)):
            _profile(place[star, 0] + shift[node, star, 0], width[star], across)
            _profile(place[star, 1] + shift[node, star, 1], width[star], down)
            for row in range(size):
                counts = share[node] * flux[star] * down[0, row]
                for column in range(size):
                    out[own[star], row, column] += counts * across[0, column]
    return out
