"""Normal equations of a scene on the pixels of its fit windows (Fisher scoring).

The weight of a pixel is the inverse of the variance that the model predicts. The iteration therefore
converges to the maximum likelihood for Poisson noise. The residual of a pixel is its value minus the modelled
flux of all stars, so that streaks may cross. The four parameters of each star are eliminated from the
equations, which leaves the shared parameters (rate, acceleration, width). Stars that share pixels are
coupled, and a few conjugate-gradient iterations account for the coupling. The equations without the coupling
are the preconditioner of these iterations.

Each star also provides its own estimate of the shared parameters. A blend of two stars is wider or longer
than the image of a single star, and the flux of a neighbouring star shifts the ends of a streak. Blended
stars are excluded from the fit of the motion, because their estimates disagree with the majority.

The vector of all parameters has the length s + n a: s parameters are common to all stars, and `a` parameters
belong to each of the n stars.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from knightcube.astro.arrays import BoolArray, Float32Array, FloatArray, IntArray, tangent_basis
from knightcube.compiled import compiled_form_of, loop_helper
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks import streak_model, vibrating_streaks
from knightcube.vision.streaks.fit_windows import BlockPixels, FitWindows, at_pixels
from knightcube.vision.streaks.frame import MEDIAN_ERROR
from knightcube.vision.streaks.geometry import Shutter, StreakScene
from knightcube.vision.streaks.scene_images import model_images

SHARED = 7
"""Number of parameters that all stars share: rate (3), acceleration (3) and point-spread width (1)."""
ALONE = 4
"""Number of parameters of a single star: x, y, flux and sky level."""
_PARAMETERS = SHARED + ALONE
WIDTH = 6
"""Index of the point-spread width among the shared parameters."""

SATURATION_MARGIN = 3.0
"""Margin (standard deviations) between modelled counts and saturation below which a pixel is excluded.

A selection by measured counts, instead of modelled counts, would be biased by noise."""
# Allowance for model errors in the exclusion of outliers, as a fraction of a pixel's modelled counts.
_UNRESOLVED = 0.1
# Number of blocks of pixels processed in one matrix product, small enough for the processor's cache.
_AT_ONCE = 128
# Prior standard deviation (px) of a star's position, for streaks with both ends outside the frame.
_LOOSE = 30.0
# Prior standard deviation (counts) of the difference between the sky level at a star and the background.
_SKY = 3.0
PRIOR = np.array([_LOOSE**-2, _LOOSE**-2, 0.0, _SKY**-2])
"""Prior information, as inverse variances, on the parameters (ALONE,) of a star: x, y, flux and sky level."""


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """The normal equations for the shared parameters and the n stars of a scene.

    Attributes:
        information: Fisher information (n, SHARED + ALONE, SHARED + ALONE) from the pixels of each star, on
            the shared parameters and on the parameters of that star.
        gradient: gradient (n, SHARED + ALONE) of the log-likelihood with respect to the shared parameters and
            the parameters of each star.
        chi2: chi-square of the residuals on the pixels of each star (n,).
        pixels: number of fitted pixels of each star (n,).
        crowds: derivatives of the modelled counts on the pixels that several stars share.
        shared: number of pixels that several stars share.
        kept: masks of the pixels that the fit used, one mask for the strips and one for the patches.
    """

    information: FloatArray
    gradient: FloatArray
    chi2: FloatArray
    pixels: FloatArray
    crowds: list[SharedPixels]
    shared: int
    kept: list[BoolArray]

    def without(self, rejected: BoolArray) -> Evaluation:
        """Return the equations without the effect of the stars `rejected` (n,) on the shared parameters."""
        information, gradient = self.information.copy(), self.gradient.copy()
        information[rejected, :SHARED] = information[rejected, :, :SHARED] = gradient[rejected, :SHARED] = 0.0
        crowds = []
        for crowd in self.crowds:
            matrix = crowd.matrix.copy()
            matrix[rejected[crowd.star], :, :SHARED] = 0.0
            crowds.append(crowd._replace(matrix=matrix))
        return replace(self, information=information, gradient=gradient, crowds=crowds)


class SharedPixels(NamedTuple):
    """Derivatives of the modelled counts at the e pixels that several stars share, sorted by block of pixels.

    The coefficients `matrix` (b, i, SHARED + ALONE) combine i `images` (i, e) into derivatives for the
    parameters of the `star` of each block (b,). The array `first` (b,) contains the index of the first shared
    pixel of each block. The arrays `slot` (e,) and `weight` (e,) contain the index of each pixel in the list
    of all shared pixels, and its inverse variance.
    """

    star: IntArray
    matrix: FloatArray
    first: IntArray
    slot: IntArray
    weight: Float32Array
    images: Float32Array


def evaluate(
    pinhole: Pinhole,
    shutter: Shutter,
    scene: StreakScene,
    windows: FitWindows,
    clip: float,
    growing: bool,
    tested: bool = False,
) -> Evaluation:
    """Return the normal equations of `scene` on the pixels of its fit windows.

    The residual limit `clip` for outlier pixels is in standard deviations. The flag `growing` states whether
    the angular acceleration is fitted, and `tested` whether a score test needs the derivatives with respect
    to it. For the score test, derivatives that are linear within a block of pixels suffice; for the fit, they
    do not.
    """
    strips = windows.strips
    images, spots, change = model_images(pinhole, shutter, scene, windows, growing)
    of_block = windows.long[strips.star]
    total = windows.total(images, spots, scene.light, scene.sky)
    n, size = len(scene.stars), SHARED + ALONE
    sums = np.zeros((n, size, size)), np.zeros((n, size)), np.zeros(n), np.zeros(n)
    out = Evaluation(*sums, [], windows.shared, [])
    long = scene.stars[windows.long]
    camera, accelerated = (pinhole, scene.motion, shutter), growing or tested
    if scene.motion.vibration.exists:
        geometry = vibrating_streaks.coefficients(*camera, long, strips, accelerated)
    else:
        geometry = streak_model.coefficients(*camera, long, strips, accelerated, growing)
    matrix = _matrices(geometry, scene.light[of_block], scene.trusted[of_block])
    _add(out, of_block, windows.on_strips, images, matrix, total, clip)
    if not len(windows.spot):
        out.kept.append(windows.on_patches.inside)
        return out
    spot_images = _spot_images(scene, windows, spots, change)
    matrix = np.tile(np.eye(size), (len(windows.spot), 1, 1))
    matrix[:, :, :SHARED] *= scene.trusted[windows.spot, None, None]
    _add(out, windows.spot, windows.on_patches, spot_images, matrix, total, clip)
    return out


def _matrices_numpy(geometry: FloatArray, light: FloatArray, trusted: BoolArray) -> FloatArray:
    """Return the coefficients (b, IMAGES, SHARED + ALONE) that combine images into derivatives of the counts.

    The coefficients `geometry` (b, IMAGES, 8) are those of `streak_model.coefficients`. The array `light`
    (b,) is the flux of the star of each block, and `trusted` (b,) states whether this star contributes to the
    fit of the shared parameters.
    """
    out = np.zeros((*geometry.shape[:2], SHARED + ALONE))
    out[:, :, :6] = geometry[:, :, :6] * light[:, None, None]
    out[:, 5, WIDTH] = light
    out[:, :, 7:9] = geometry[:, :, 6:] * light[:, None, None]
    out[:, 0, 9] = out[:, 6, 10] = 1.0
    out[:, :, :SHARED] *= trusted[:, None, None]
    return out


@compiled_form_of(_matrices_numpy)
def _matrices(geometry: FloatArray, light: FloatArray, trusted: BoolArray) -> FloatArray:
    out = np.zeros((geometry.shape[0], geometry.shape[1], _PARAMETERS))
    for b in range(len(out)):
        shared = light[b] if trusted[b] else 0.0
        for i in range(geometry.shape[1]):
            for k in range(6):
                out[b, i, k] = geometry[b, i, k] * shared
            out[b, i, 7], out[b, i, 8] = geometry[b, i, 6] * light[b], geometry[b, i, 7] * light[b]
        out[b, 5, WIDTH], out[b, 0, 9], out[b, 6, 10] = shared, 1.0, 1.0
    return out


def _add(
    out: Evaluation,
    star: IntArray,
    view: BlockPixels,
    images: Float32Array,
    matrix: FloatArray,
    total: Float32Array,
    clip: float,
) -> None:
    """Add the contributions of blocks of pixels, in the order of their stars, to the normal equations.

    The last of the `images` of each block is overwritten by the residuals, which follow from the modelled
    counts `total` of all fitted pixels.
    """
    blocks, count = images.shape[:2]
    if not blocks:
        out.kept.append(view.inside)
        return
    flat = images.reshape(blocks, count, -1)
    weight = np.empty((blocks, flat.shape[2]), dtype=np.float32)
    shape, sums = weight.shape, (out.information, out.gradient, out.chi2, out.pixels)
    slot, inside, signal = view.slot.reshape(shape), view.inside.reshape(shape), view.signal.reshape(shape)
    pixels = slot, inside, signal, view.floor.reshape(shape), view.ceiling.reshape(shape)
    limits = float(view.gain), float(clip)
    _sum_products(*sums, weight, flat, (star, matrix), total, pixels, limits)
    out.kept.append((weight > 0.0).reshape(view.inside.shape))
    if len(view.crowded):
        held, first, drawn = at_pixels(flat, view.crowded)
        crowded = weight.reshape(-1)[view.crowded]
        out.crowds.append(SharedPixels(star[held], matrix[held], first, view.common, crowded, drawn))


Pixels = tuple[IntArray, BoolArray, Float32Array, Float32Array, Float32Array]
"""Attributes `slot`, `inside`, `signal`, `floor` and `ceiling` of `BlockPixels`."""


def residuals(
    total: Float32Array, pixels: Pixels, limits: tuple[float, float]
) -> tuple[Float32Array, Float32Array]:
    """Return weights and residuals of pixels for the modelled counts `total` of all fitted pixels.

    The weight is the inverse variance, or 0 for an excluded pixel. The `limits` are the gain (electrons per
    count) and the residual limit `clip`. Pixels whose residuals exceed `clip` standard deviations plus a
    tenth of the modelled counts are excluded; `clip` 0 excludes none.
    """
    (slot, inside, signal, floor, ceiling), (gain, clip) = pixels, limits
    model = total.take(slot)
    variance = np.maximum(model, np.float32(0.0))
    variance *= np.float32(1.0 / gain)
    variance += floor
    residual = signal - model
    deviation = np.sqrt(variance)
    good = inside & (model + np.float32(SATURATION_MARGIN) * deviation < ceiling)
    if clip > 0.0:
        deviation *= np.float32(clip)
        deviation += np.float32(_UNRESOLVED) * model
        good &= np.abs(residual) <= deviation
    weight = np.where(good, np.float32(1.0) / variance, np.float32(0.0))
    residual[~good] = 0.0
    return weight, residual


def _sum_products_numpy(
    information: FloatArray,
    gradient: FloatArray,
    chi2: FloatArray,
    pixels: FloatArray,
    weight: Float32Array,
    images: Float32Array,
    of_blocks: tuple[IntArray, FloatArray],
    total: Float32Array,
    of_pixels: Pixels,
    limits: tuple[float, float],
) -> None:
    """Add weighted products of the images of b blocks of p pixels to the normal equations of their stars.

    The weights (b, p), and the residuals in the last of the `images` (b, i + 1, p), are computed from the
    modelled counts `total` of all fitted pixels. Products of the residual with the other images give the
    gradient, and the squared residual gives chi-square. The pair `of_blocks` contains the star (b,) of each
    block, and the coefficients (b, i, SHARED + ALONE) that combine the images into derivatives of the
    modelled counts with respect to the parameters. If an image is zero on a block of pixels, its coefficients
    are set to zero.
    """
    star, matrix = of_blocks
    weight[:], images[:, -1] = residuals(total, of_pixels, limits)
    blocks, count = images.shape[:2]
    gram = np.empty((blocks, count, count))
    for begin in range(0, blocks, _AT_ONCE):
        part = slice(begin, begin + _AT_ONCE)
        gram[part] = (images[part] * weight[part, None]) @ images[part].swapaxes(1, 2)
    matrix *= np.diagonal(gram, axis1=1, axis2=2)[:, :-1, None] > 0.0
    transposed = matrix.swapaxes(1, 2)
    first = np.flatnonzero(np.diff(star, prepend=-1))
    owner = star[first]
    information[owner] += np.add.reduceat(transposed @ gram[:, :-1, :-1] @ matrix, first)
    gradient[owner] += np.add.reduceat((transposed @ gram[:, :-1, -1:])[..., 0], first)
    chi2[owner] += np.add.reduceat(gram[:, -1, -1], first)
    pixels[owner] += np.add.reduceat((weight > 0.0).sum(axis=1), first)


@compiled_form_of(_sum_products_numpy)
def _sum_products(
    information: FloatArray,
    gradient: FloatArray,
    chi2: FloatArray,
    pixels: FloatArray,
    weight: Float32Array,
    images: Float32Array,
    of_blocks: tuple[IntArray, FloatArray],
    total: Float32Array,
    of_pixels: Pixels,
    limits: tuple[float, float],
) -> None:
    (star, matrix), (gain, clip) = of_blocks, limits
    slot, inside, signal, floor, ceiling = of_pixels
    blocks, count, size = images.shape
    gram, weighted = np.zeros((count, count)), np.empty(size, dtype=np.float32)
    model, least = np.empty(size, dtype=np.float32), np.float32(0.0)
    per_count, margin, unresolved = (
        np.float32(1.0 / gain),
        np.float32(SATURATION_MARGIN),
        np.float32(_UNRESOLVED),
    )
    share, room = np.float32(clip), np.float32(0.0 if clip > 0.0 else np.inf)
    for b in range(blocks):
        owner, left, weights = star[b], images[b, count - 1], weight[b]
        variance, off, full, within = floor[b], signal[b], ceiling[b], inside[b]
        for p in range(size):
            model[p] = total[slot[b, p]]
        for p in range(size):
            expected = max(model[p], least) * per_count + variance[p]
            residual, deviation = off[p] - model[p], np.float32(math.sqrt(expected))
            good = (model[p] + margin * deviation < full[p]) & within[p]
            good &= abs(residual) <= share * deviation + unresolved * model[p] + room
            weights[p] = np.float32(1.0) / expected if good else least
        for p in range(size):
            left[p] = off[p] - model[p] if weights[p] > least else least
        used = 0
        for p in range(size):
            used += weights[p] > least
        pixels[owner] += used
        _multiply_images(gram, images[b], weights, weighted)
        _add_block(information[owner], gradient[owner], gram, matrix[b])
        chi2[owner] += gram[count - 1, count - 1]


@loop_helper
def _scalar_product(a: Any, b: Any) -> Any:
    """Return the scalar product of two arrays (m,) of one type, in this type."""
    total = a.dtype.type(0.0)
    for k in range(len(a)):
        total += a[k] * b[k]
    return total


@loop_helper
def _multiply_images(
    gram: FloatArray, images: Float32Array, weights: Float32Array, weighted: Float32Array
) -> None:
    """Compute the weighted scalar products `gram` (i, i) of all pairs of i images (i, p).

    The `weights` (p,) are those of the p pixels. The array `weighted` (p,) is overwritten.
    """
    count, size = images.shape
    for i in range(count):
        square = np.float32(0.0)
        for p in range(size):
            weighted[p] = weights[p] * images[i, p]
            square += weights[p] * images[i, p] * images[i, p]
        gram[i, i] = square
        for k in range(i):
            product = np.float32(0.0)
            for p in range(size if square > 0.0 and gram[k, k] > 0.0 else 0):
                product += weighted[p] * images[k, p]
            gram[i, k] = product
            gram[k, i] = product


@loop_helper
def _add_block(information: FloatArray, gradient: FloatArray, gram: FloatArray, matrix: FloatArray) -> None:
    """Add the products `gram` of images to the gradient and the information matrix of one star.

    If an image is zero, its row of the coefficients `matrix` (i, SHARED + ALONE) is set to zero.
    """
    images = len(matrix)
    row = np.empty(_PARAMETERS)
    for i in range(images):
        # In most blocks, the images of the streak ends are zero.
        if not gram[i, i] > 0.0:
            matrix[i] = 0.0
            continue
        row[:] = 0.0
        for k in range(images):
            if gram[k, k] > 0.0:
                _add_scaled(row, gram[i, k], matrix[k])
        for q in range(_PARAMETERS):
            share = matrix[i, q]
            if share != 0.0:
                gradient[q] += share * gram[i, images]
                _add_scaled(information[q], share, row)


def _spot_images(
    scene: StreakScene, windows: FitWindows, spots: FloatArray, change: FloatArray
) -> Float32Array:
    """Return the derivatives (n, SHARED + ALONE + 1, p, p) of the counts of n spots on p x p pixels each.

    The last element along the second axis is an uninitialised buffer for the residuals.
    """
    light = scene.light[windows.spot, None, None, None]
    images = np.empty((len(spots), SHARED + ALONE + 1, *spots.shape[1:]), dtype=np.float32)
    images[:, :6] = change[:, :6] * light
    # The squared width is sigma^2 plus the variance of a pixel, so that d sigma / d width = width / sigma.
    images[:, WIDTH] = change[:, 8] * light[:, 0] * (scene.width / scene.sigma)
    images[:, 7:9] = change[:, 6:8] * light
    images[:, 9] = spots
    images[:, 10] = 1.0
    return images


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """One Gauss-Newton step of the fit, and the covariance of the parameters.

    The step consists of changes of the shared parameters (SHARED,) and of each star's own parameters (n,
    ALONE).
    """

    shared: FloatArray
    alone: FloatArray
    eliminated: EliminatedEquations

    @property
    def covariance(self) -> FloatArray:
        """The covariance (SHARED, SHARED) of the parameters that all stars share."""
        kept = self.eliminated.kept
        out = np.zeros((SHARED, SHARED))
        out[kept[:, None], kept] = self.eliminated.inner
        return out

    @property
    def joint(self) -> FloatArray:
        """The covariance (n, SHARED + ALONE, SHARED + ALONE), for each star, of shared and own parameters."""
        kept, gain, inner = self.eliminated.kept, self.eliminated.gain, self.eliminated.inner
        joint = np.zeros((len(gain), SHARED + ALONE, SHARED + ALONE))
        joint[:, :SHARED, :SHARED] = self.covariance
        crossed = -inner @ gain
        joint[:, kept, SHARED:] = crossed
        joint[:, SHARED:, kept] = crossed.swapaxes(1, 2)
        joint[:, SHARED:, SHARED:] = self.eliminated.own + gain.swapaxes(1, 2) @ inner @ gain
        return joint


class EliminatedEquations(NamedTuple):
    """Normal equations for the shared parameters alone, in which coupling by shared pixels is neglected.

    The attribute `kept` (k,) contains the indices of the fitted shared parameters, and `inner` (k, k) is
    their covariance. For each star, `own` (n, ALONE, ALONE) is the inverse of its block of the information
    matrix, and `gain`, with the shape (n, k, ALONE), the product of `own` and the block that couples shared
    and own parameters.
    """

    kept: IntArray
    own: FloatArray
    gain: FloatArray
    inner: FloatArray


def eliminate(evaluation: Evaluation, free: BoolArray) -> EliminatedEquations | None:
    """Return the equations for the shared parameters alone, or None if they are singular.

    The mask `free` (SHARED,) selects those shared parameters that are fitted.
    """
    kept = np.flatnonzero(free)
    own, gain, inner, size = _eliminated(evaluation.information, kept)
    return EliminatedEquations(kept, own, gain, inner) if size < _SINGULAR else None


# Information (1/counts^2) assumed on the flux of a star without fitted pixels, to avoid a singular block.
_UNFITTED = 1e-30
# Largest element of the inverse of a regular information matrix that is scaled to a unit diagonal.
_SINGULAR = 1e10


def _eliminated_numpy(
    information: FloatArray, kept: IntArray
) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Return the attributes `own`, `gain` and `inner` of `EliminatedEquations`, and a measure of singularity.

    The arguments are the information of `Evaluation` and the indices `kept` (k,) of the fitted parameters.
    The measure of singularity is the largest element of the inverse of the information matrix scaled to a
    unit diagonal, or infinity.
    """
    alone = information[:, SHARED:, SHARED:].copy()
    diagonal = np.einsum("nii->ni", alone)
    diagonal += PRIOR
    diagonal += np.where(diagonal > 0.0, 0.0, _UNFITTED)
    root = np.sqrt(np.einsum("nii->ni", alone))
    outer = root[:, :, None] * root[:, None, :]
    unit = alone / outer
    unit[:, range(ALONE), range(ALONE)] += 1e-9
    own = np.asarray(np.linalg.inv(unit) / outer)
    cross = information[:, kept, SHARED:]
    gain = cross @ own
    normal = (information[:, kept[:, None], kept] - gain @ cross.swapaxes(1, 2)).sum(axis=0)
    scale = np.sqrt(np.diag(normal).clip(min=0.0))
    if not np.all(np.isfinite(normal)) or not np.all(scale > 0.0):
        return own, gain, normal, np.inf
    try:
        inverse = np.linalg.inv(normal / np.outer(scale, scale))
    except np.linalg.LinAlgError:
        return own, gain, normal, np.inf
    return own, gain, inverse / np.outer(scale, scale), float(np.abs(inverse).max(initial=0.0))


@compiled_form_of(_eliminated_numpy)
def _eliminated(information: FloatArray, kept: IntArray) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    n, count = len(information), len(kept)
    own, gain = np.empty((n, ALONE, ALONE)), np.empty((n, count, ALONE))
    normal, unit, root = np.zeros((count, count)), np.empty((ALONE, 2 * ALONE)), np.empty(ALONE)
    for star in range(n):
        for i in range(ALONE):
            diagonal = information[star, SHARED + i, SHARED + i] + PRIOR[i]
            root[i] = math.sqrt(diagonal if diagonal > 0.0 else _UNFITTED + diagonal)
        for i in range(ALONE):
            for j in range(ALONE):
                unit[i, j] = information[star, SHARED + i, SHARED + j] / (root[i] * root[j])
                unit[i, ALONE + j] = 0.0
            unit[i, i] = 1.0 + 1e-9
            unit[i, ALONE + i] = 1.0
        _invert(unit)
        for i in range(ALONE):
            for j in range(ALONE):
                own[star, i, j] = unit[i, ALONE + j] / (root[i] * root[j])
        for i in range(count):
            for j in range(ALONE):
                gain[star, i, j] = 0.0
                for k in range(ALONE):
                    gain[star, i, j] += information[star, kept[i], SHARED + k] * own[star, k, j]
            for j in range(count):
                normal[i, j] += information[star, kept[i], kept[j]]
                for k in range(ALONE):
                    normal[i, j] -= gain[star, i, k] * information[star, kept[j], SHARED + k]
    return own, gain, normal, _inverted(normal)


@loop_helper
def _inverted(matrix: FloatArray) -> float:
    """Replace an information matrix (k, k) by its inverse, and return a measure of its singularity.

    The measure is that of `_eliminated_numpy`.
    """
    count, size = len(matrix), 0.0
    scale, pair = np.empty(count), np.zeros((count, 2 * count))
    for i in range(count):
        scale[i] = math.sqrt(max(matrix[i, i], 0.0))
        if not 0.0 < scale[i] < np.inf:
            return float(np.inf)
    for i in range(count):
        for j in range(count):
            pair[i, j] = matrix[i, j] / (scale[i] * scale[j])
        pair[i, count + i] = 1.0
    _invert(pair)
    for i in range(count):
        for j in range(count):
            inverse = pair[i, count + j]
            matrix[i, j] = inverse / (scale[i] * scale[j])
            size = max(size, abs(inverse)) if np.isfinite(inverse) else np.inf
    return size


@loop_helper
def _invert(pair: FloatArray) -> None:
    """Replace the right half of a matrix (m, 2 m) by the inverse of the left half times the right half.

    The left half is symmetric and positive definite, so that no pivot is zero.
    """
    for i in range(len(pair)):
        factor = 1.0 / pair[i, i]
        for j in range(i, pair.shape[1]):
            pair[i, j] *= factor
        for k in range(len(pair)):
            if k != i:
                share = pair[k, i]
                for j in range(i, pair.shape[1]):
                    pair[k, j] -= share * pair[i, j]


def solve(evaluation: Evaluation, scene: StreakScene, free: BoolArray, rounds: int) -> Solution | None:
    """Return the step of all parameters towards maximum likelihood, or None if the equations are singular.

    At most `rounds` conjugate-gradient iterations account for the coupling of stars by shared pixels.
    """
    eliminated = eliminate(evaluation, free)
    if eliminated is None:
        return None
    alone = evaluation.gradient[:, SHARED:].copy()
    # The prior of the sky level is centred on zero, and the prior of the position on the current position.
    alone[:, 3] -= PRIOR[3] * scene.sky
    shared = np.where(free, evaluation.gradient[:, :SHARED].sum(axis=0), 0.0)
    step = _coupled(evaluation, eliminated, free, np.concatenate([shared, alone.reshape(-1)]), rounds)
    return Solution(step[:SHARED], step[SHARED:].reshape(alone.shape), eliminated)


def rate_covariance(
    evaluation: Evaluation, eliminated: EliminatedEquations, free: BoolArray, rounds: int
) -> FloatArray:
    """Return the covariance (3, 3) of the rate with the effect of shared pixels."""
    out = np.empty((3, 3))
    for k in range(3):
        # The equations are scaled so that the same tolerance is valid for all frames.
        unit = np.zeros(SHARED + ALONE * len(evaluation.chi2))
        unit[k] = 1.0 / np.sqrt(eliminated.inner[k].max())
        out[k] = _coupled(evaluation, eliminated, free, unit, rounds)[:3] / unit[k]
    return 0.5 * (out + out.T)


def _coupled(
    evaluation: Evaluation, eliminated: EliminatedEquations, free: BoolArray, right: FloatArray, rounds: int
) -> FloatArray:
    """Return the solution of the coupled normal equations, see `solution`."""
    first, second = (*evaluation.crowds, _NO_CROWD, _NO_CROWD)[:2]
    crowds, common = (first, second), evaluation.shared
    return solution(evaluation.information, crowds, common, eliminated, free, right, rounds)


# Ratio of the squared residual norm to that of the right-hand side at which conjugate gradients stop.
_CONVERGED = 1e-2

_NONE = np.zeros(0, np.int64)
_NO_LIGHT = np.zeros(0, np.float32), np.zeros((1, 0), np.float32)
_NO_CROWD = SharedPixels(_NONE, np.zeros((0, 1, 1)), _NONE, _NONE, *_NO_LIGHT)
"""Empty `SharedPixels` for stars that do not share pixels."""
_Crowds = tuple[SharedPixels, SharedPixels]


def _solution_numpy(
    information: FloatArray,
    crowds: _Crowds,
    common: int,
    eliminated: EliminatedEquations,
    free: BoolArray,
    right: FloatArray,
    rounds: int,
) -> FloatArray:
    x = _without_coupling(eliminated, right, len(free))
    if rounds == 0:
        return x

    def product(vector: FloatArray) -> FloatArray:
        return _product(information, crowds, common, free, vector)

    residual = right - product(x)
    z = _without_coupling(eliminated, residual, len(free))
    direction, size, first = z, float(residual @ z), abs(float(right @ x))
    for _ in range(rounds):
        if size <= _CONVERGED * first:
            break
        image = product(direction)
        length = size / float(direction @ image)
        x = x + length * direction
        residual = residual - length * image
        z = _without_coupling(eliminated, residual, len(free))
        size, before = float(residual @ z), size
        direction = z + size / before * direction
    return x


def _without_coupling(eliminated: EliminatedEquations, right: FloatArray, shared: int) -> FloatArray:
    """Return the solution of the uncoupled equations, whose first `shared` parameters are common to all."""
    kept, own, gain, inner = eliminated
    alone = right[shared:].reshape(gain.shape[0], -1)
    step = inner @ (right[kept] - np.einsum("nij,nj->i", gain, alone))
    out = np.zeros_like(right)
    out[kept] = step
    out[shared:] = (np.einsum("nij,nj->ni", own, alone) - step @ gain).reshape(-1)
    return out


def _product(
    information: FloatArray, crowds: _Crowds, common: int, free: BoolArray, parameters: FloatArray
) -> FloatArray:
    """Return the product of the information matrix of the whole scene with a vector of parameters.

    The coupling of a star is the change of the modelled counts on its shared pixels due to all other stars.
    """
    n, shared = len(information), len(free)
    alone = parameters[shared:].reshape(n, -1)
    vector = np.concatenate([np.broadcast_to(parameters[:shared], (n, shared)), alone], axis=1)
    out = (information @ vector[..., None])[..., 0]
    change, lights = np.zeros(common), []
    held = [crowd for crowd in crowds if len(crowd[0])]
    for star, matrix, first, slot, _, images in held:
        mixture = (matrix @ vector[star][..., None])[..., 0].T.astype(np.float32)
        block = np.repeat(np.arange(len(first)), np.diff(first, append=len(slot)))
        lights.append(np.einsum("ie,ie->e", mixture.take(block, axis=1), images))
        change += np.bincount(slot, lights[-1], common)
    for (star, matrix, first, slot, weight, images), light in zip(held, lights, strict=True):
        weighted = weight * (change[slot] - light).astype(np.float32)
        slope = np.add.reduceat(images * weighted, first, axis=1).T.astype(np.float64)
        np.add.at(out, star, (slope[:, None] @ matrix)[:, 0])
    total = np.where(free, out[:, :shared].sum(axis=0), 0.0)
    return np.concatenate([total, (out[:, shared:] + PRIOR * alone).reshape(-1)])


@compiled_form_of(_solution_numpy)
def solution(
    information: FloatArray,
    crowds: _Crowds,
    common: int,
    eliminated: EliminatedEquations,
    free: BoolArray,
    right: FloatArray,
    rounds: int,
) -> FloatArray:
    """Return the vector of parameters (s + n a,) that solves the coupled normal equations.

    The array `information` is that of `Evaluation`, `crowds` are the shared pixels of strips and of patches,
    and `common` is their number. The mask `free` (s,) selects the fitted shared parameters, and `right` (s +
    n a,) is the right-hand side. At most `rounds` iterations start from the solution of `eliminated`, which
    neglects the coupling; if `rounds` is 0, this solution is returned.
    """
    x, image, z = np.empty_like(right), np.empty_like(right), np.empty_like(right)
    light = np.empty(len(crowds[0][3]) + len(crowds[1][3]), dtype=np.float32)
    scratch = np.empty(common), light, np.empty((2, *information.shape[:2]))
    _solve_alone(eliminated, right, len(free), x)
    if rounds == 0:
        return x
    _multiply(information, crowds, free, x, scratch, image)
    residual = right - image
    _solve_alone(eliminated, residual, len(free), z)
    direction, size, first = z.copy(), _scalar_product(residual, z), abs(_scalar_product(right, x))
    for _ in range(rounds):
        if size <= _CONVERGED * first:
            break
        _multiply(information, crowds, free, direction, scratch, image)
        length = size / _scalar_product(direction, image)
        for k in range(len(x)):
            x[k] += length * direction[k]
            residual[k] -= length * image[k]
        _solve_alone(eliminated, residual, len(free), z)
        before = size
        size = _scalar_product(residual, z)
        for k in range(len(x)):
            direction[k] = z[k] + size / before * direction[k]
    return x


@loop_helper
def _solve_alone(eliminated: EliminatedEquations, right: FloatArray, shared: int, out: FloatArray) -> None:
    """Compiled form of `_without_coupling`, which writes the solution to `out`."""
    kept, own, gain, inner = eliminated
    alone, left = own.shape[1], np.empty(len(kept))
    for i in range(len(kept)):
        left[i] = right[kept[i]]
    for star in range(len(own)):
        of_star = right[shared + alone * star : shared + alone * (star + 1)]
        for i in range(len(kept)):
            left[i] -= _scalar_product(gain[star, i], of_star)
    out[:] = 0.0
    for i in range(len(kept)):
        out[kept[i]] = _scalar_product(inner[i], left)
    for star in range(len(own)):
        begin = shared + alone * star
        of_star = right[begin : begin + alone]
        for j in range(alone):
            out[begin + j] = _scalar_product(own[star, j], of_star)
            for i in range(len(kept)):
                out[begin + j] -= out[kept[i]] * gain[star, i, j]


@loop_helper
def _multiply(
    information: FloatArray,
    crowds: _Crowds,
    free: BoolArray,
    parameters: FloatArray,
    scratch: tuple[FloatArray, Float32Array, FloatArray],
    product: FloatArray,
) -> None:
    """Compiled form of `_product`, which writes the product to `product`.

    The three scratch arrays, with the shapes (common,), (e,) and (2, n, s + a), are overwritten. The number e
    is the sum, over all stars, of the numbers of their shared pixels.
    """
    change, light, vectors = scratch
    vector, out, shared, alone, begin = vectors[0], vectors[1], len(free), ALONE, 0
    for star in range(len(information)):
        for k in range(shared):
            vector[star, k] = parameters[k]
        for k in range(alone):
            vector[star, shared + k] = parameters[shared + alone * star + k]
        for i in range(shared + alone):
            out[star, i] = _scalar_product(information[star, i], vector[star])
    change[:] = 0.0
    for crowd in crowds:
        _add_changes(crowd, vector, light[begin : begin + len(crowd[3])], change)
        begin += len(crowd[3])
    begin = 0
    for crowd in crowds:
        _add_coupling(crowd, change, light[begin : begin + len(crowd[3])], out)
        begin += len(crowd[3])
    product[:shared] = 0.0
    for star in range(len(out)):
        for k in range(shared):
            product[k] += out[star, k] if free[k] else 0.0
        for k in range(alone):
            place = shared + alone * star + k
            product[place] = out[star, shared + k] + PRIOR[k] * parameters[place]


@loop_helper
def _add_changes(crowd: SharedPixels, vector: FloatArray, light: Float32Array, change: FloatArray) -> None:
    """Set `light` (e,) to the change of each star's counts due to the parameter step `vector` (n, s + a).

    The sum over all stars that share a pixel is added to the element of `change` for this pixel.
    """
    star, matrix, first, slot, _, images = crowd
    light[:] = 0.0
    for b in range(len(first)):
        stop = first[b + 1] if b + 1 < len(first) else len(slot)
        own = vector[star[b]]
        for i in range(len(images)):
            row, share = matrix[b, i], 0.0
            # The constant number of parameters permits the compiler to unroll the loop.
            for q in range(_PARAMETERS):
                share += row[q] * own[q]
            if share != 0.0:
                _add_scaled(light[first[b] : stop], np.float32(share), images[i, first[b] : stop])
    for e in range(len(slot)):
        change[slot[e]] += light[e]


@loop_helper
def _add_coupling(crowd: SharedPixels, change: FloatArray, light: Float32Array, out: FloatArray) -> None:
    """Add the coupling of the stars to their uncoupled products `out` (n, s + a); `light` is overwritten."""
    star, matrix, first, slot, weight, images = crowd
    for e in range(len(slot)):
        light[e] = weight[e] * (change[slot[e]] - light[e])
    for b in range(len(first)):
        stop = first[b + 1] if b + 1 < len(first) else len(slot)
        own = out[star[b]]
        for i in range(len(images)):
            row = matrix[b, i]
            if row.any():
                slope = float(_scalar_product(light[first[b] : stop], images[i, first[b] : stop]))
                for q in range(_PARAMETERS):
                    own[q] += slope * row[q]


@loop_helper
def _add_scaled(total: Any, factor: Any, values: Any) -> None:
    for k in range(len(total)):
        total[k] += factor * values[k]


# Ratio of a star's Fisher information to the largest of all stars below which the star is ignored.
_NOTHING = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class StarEquations:
    """Normal equations of each star for k shared parameters, after elimination of the star's own parameters.

    The attribute `kept` (k,) contains the indices of the fitted parameters. The equations consist of the
    information matrix (n, k, k) and the gradient (n, k) of the log-likelihood of each star (`score`).
    """

    kept: IntArray
    information: FloatArray
    score: FloatArray


def estimates_of(alone: StarEquations, scene: StreakScene) -> tuple[FloatArray, FloatArray]:
    """Return estimates (n, 4) of three rate components and the point-spread width from each of n stars.

    The rate components are along the rotation axis and along two vectors normal to it. Each estimate is the
    difference from the value in `scene`, in rad per exposure for the rate and in px for the width. The second
    array (n, 4) contains the standard deviations of the estimates.
    """
    axis = scene.motion.rotation / max(float(np.linalg.norm(scene.motion.rotation)), 1e-12)
    directions = np.zeros((4, SHARED))
    directions[0, :3], directions[1:3, :3], directions[3, WIDTH] = axis, tangent_basis(axis), 1.0
    directions = directions[:, alone.kept]
    information = np.sum((alone.information @ directions.T) * directions.T, axis=1)
    informed = information > _NOTHING * information.max(axis=0)
    information = np.where(informed, information, _NOTHING * information.max(axis=0) + 1e-300)
    change = np.where(informed, alone.score @ directions.T / information, 0.0)
    return change, 1.0 / np.sqrt(information)


def star_equations(evaluation: Evaluation, eliminated: EliminatedEquations) -> StarEquations:
    """Return the normal equations of each star for the shared parameters of the `eliminated` equations."""
    kept, gain = eliminated.kept, eliminated.gain
    cross = evaluation.information[:, SHARED:][:, :, kept]
    schur = evaluation.information[:, kept[:, None], kept] - gain @ cross
    score = evaluation.gradient[:, kept] - np.einsum("nij,nj->ni", gain, evaluation.gradient[:, SHARED:])
    return StarEquations(kept, schur, score)


def consistent_stars(
    estimates: FloatArray, deviations: FloatArray, floors: FloatArray, sigmas: float
) -> BoolArray:
    """Return a mask (n,) of the stars whose k estimates (n, k) lie within `sigmas` deviations of the medians.

    The model errors `floors` (k,) are added in quadrature to the standard `deviations` (n, k).
    """
    agree = np.ones(len(estimates), dtype=np.bool_)
    for change, deviation, floor in zip(estimates.T, deviations.T, floors, strict=True):
        spread = np.hypot(deviation, floor)
        order = np.argsort(change)
        weight = np.cumsum(1.0 / spread[order])
        middle = change[order][np.searchsorted(weight, 0.5 * weight[-1])]
        # The error of the median is included, so that a star more accurate than all others is not rejected.
        error = MEDIAN_ERROR * np.sqrt(len(spread)) / np.sum(1.0 / spread)
        agree &= np.abs(change - middle) <= sigmas * np.hypot(spread, error)
    return agree
