"""Normal equations of a scene on the pixels of its fit windows (Fisher scoring).

The weight of a pixel is the inverse of the variance that the model predicts. The iteration therefore
converges to the maximum likelihood for Poisson noise. The residual of a pixel is its value minus the modelled
flux of all stars, so that streaks may cross. The four parameters of each star are eliminated from the
equations, which leaves the shared parameters (rate, acceleration, width). Stars that share pixels are
coupled, and a few conjugate-gradient iterations account for the coupling.

Each star also provides its own estimate of the shared parameters. A blend of two stars is wider or longer
than the image of a single star, and the flux of a neighbouring star shifts the ends of a streak. Blended
stars are excluded from the fit of the motion, because their estimates disagree with the majority.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from knightcube.astro.arrays import BoolArray, Float32Array, FloatArray, IntArray
from knightcube.compiled import compiled_form_of, loop_helper
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks import coupled_stars, streak_model
from knightcube.vision.streaks.fit_windows import BlockPixels, FitWindows, residuals
from knightcube.vision.streaks.frame import MEDIAN_ERROR
from knightcube.vision.streaks.geometry import Shutter, StreakScene, sensitivities

SHARED = 7
"""Number of parameters that all stars share: rate (3), acceleration (3) and point-spread width (1)."""
ALONE = 4
"""Number of parameters of a single star: x, y, flux and sky level."""

# Constants of `fit_windows.residuals` that the compiled functions of this module use.
_MARGIN = 3.0
_UNRESOLVED = 0.1
# Number of blocks of pixels processed in one matrix product, small enough for the processor's cache.
_AT_ONCE = 128
# Prior standard deviation (px) of a star's position, for streaks with both ends outside the frame.
_LOOSE = 30.0
# Prior standard deviation (counts) of the sky level around a star, relative to the background.
_SKY = 3.0
PRIOR = np.array([_LOOSE**-2, _LOOSE**-2, 0.0, _SKY**-2])
"""Prior information, as inverse variances, on the parameters (ALONE,) of a star: x, y, flux and sky level."""


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """The normal equations for the shared parameters and the stars of a scene.

    Attributes:
        information: Fisher information (n, SHARED + ALONE, SHARED + ALONE) from the pixels of each star, on
            the shared parameters and on the parameters of that star.
        gradient: gradient (n, SHARED + ALONE) of the log-likelihood of each star's pixels, with respect to
            the shared parameters and the parameters of that star.
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


@dataclass(frozen=True, slots=True, eq=False)
class SharedPixels:
    """Derivatives of the modelled counts at the e pixels that several stars share, sorted by block of pixels.

    Attributes:
        star: index of the star of each block of pixels (b,).
        matrix: coefficients (b, i, SHARED + ALONE) that combine the i images of each of b blocks into the
            derivatives with respect to each parameter.
        first: index of the first shared pixel of each block (b,).
        slot: index of each pixel in the list of all pixels that several stars share (e,).
        weight: inverse variance of the counts of each of the e shared pixels (e,).
        images: values of the i images that are combined into the derivatives, at the e shared pixels (i, e).
    """

    star: IntArray
    matrix: FloatArray
    first: IntArray
    slot: IntArray
    weight: Float32Array
    images: Float32Array


def evaluate(
    pinhole: Pinhole, shutter: Shutter, scene: StreakScene, windows: FitWindows, clip: float, growing: bool
) -> Evaluation:
    """Return the normal equations of `scene` on the pixels of its fit windows.

    The residual limit `clip` for outlier pixels is described in `BlockPixels.residual`. The flag `growing`
    states whether the angular acceleration is fitted.
    """
    strips = windows.strips
    images, spots, change = model_images(pinhole, shutter, scene, windows)
    of_block = windows.long[strips.star]
    streak_light = images[:, 0] * scene.light[of_block, None, None].astype(np.float32)
    streak_light += scene.sky[of_block, None, None].astype(np.float32)
    spot_light = spots * scene.light[windows.spot, None, None] + scene.sky[windows.spot, None, None]
    total = windows.total(streak_light, spot_light)
    n, size = len(scene.stars), SHARED + ALONE
    out = Evaluation(
        np.zeros((n, size, size)), np.zeros((n, size)), np.zeros(n), np.zeros(n), [], windows.shared, []
    )
    matrix = _block_coefficients(pinhole, shutter, scene, windows, growing)
    matrix[:, :, :SHARED] *= scene.trusted[of_block, None, None]
    _add(out, of_block, windows.on_strips, images, matrix, total, clip)
    spot_images = _spot_images(scene, windows, spots, change)
    matrix = np.tile(np.eye(size), (len(windows.spot), 1, 1))
    matrix[:, :, :SHARED] *= scene.trusted[windows.spot, None, None]
    _add(out, windows.spot, windows.on_patches, spot_images, matrix, total, clip)
    return out


def light_of(pinhole: Pinhole, shutter: Shutter, scene: StreakScene, windows: FitWindows) -> Float32Array:
    """Return the modelled counts (m,) of all stars of `scene` on the m fitted pixels, without sky level."""
    images, spots, _ = model_images(pinhole, shutter, scene, windows)
    streaks = images[:, 0] * scene.light[windows.long[windows.strips.star], None, None].astype(np.float32)
    return windows.total(streaks, spots * scene.light[windows.spot, None, None])[:-1]


def model_images(
    pinhole: Pinhole, shutter: Shutter, scene: StreakScene, windows: FitWindows
) -> tuple[Float32Array, FloatArray, FloatArray]:
    """Return the images that are combined to model long streaks, and the images and derivatives of spots.

    The last image of each long streak is not initialised. It is a buffer for the residuals.
    """
    long, spot = scene.stars[windows.long], scene.stars[windows.spot]
    images = streak_model.images(pinhole, scene.motion, shutter, long, scene.width, windows.strips, 1)
    spots, change = streak_model.spot_derivatives(
        pinhole, scene.motion, shutter, spot, scene.sigma, windows.patches
    )
    return images, spots, change


def _block_coefficients(
    pinhole: Pinhole, shutter: Shutter, scene: StreakScene, windows: FitWindows, growing: bool
) -> FloatArray:
    """Return coefficients (b, IMAGES, SHARED + ALONE) that combine images into derivatives of the counts.

    The derivatives are with respect to the shared parameters and the parameters of the star of each block.
    """
    strips = windows.strips
    light = scene.light[windows.long[strips.star]]
    geometry = streak_model.coefficients(
        pinhole, scene.motion, shutter, scene.stars[windows.long], strips, growing
    )
    matrix = np.zeros((len(strips.star), streak_model.IMAGES, SHARED + ALONE))
    matrix[:, :, :6] = geometry[:, :, :6] * light[:, None, None]
    matrix[:, 5, 6] = light
    matrix[:, :, 7:9] = geometry[:, :, 6:] * light[:, None, None]
    matrix[:, 0, 9] = 1.0
    matrix[:, 6, 10] = 1.0
    return matrix


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

    The last of the `images` of each block of pixels is filled with the residuals of the modelled counts
    `total` of all fitted pixels. The residual limit `clip` is that of `fit_windows.residuals`.
    """
    blocks, count = images.shape[:2]
    if not blocks:
        out.kept.append(view.inside)
        return
    flat = images.reshape(blocks, count, -1)
    weight = np.empty((blocks, flat.shape[2]), dtype=np.float32)
    slot, inside = view.slot.reshape(weight.shape), view.inside.reshape(weight.shape)
    floor, ceiling = view.floor.reshape(weight.shape), view.ceiling.reshape(weight.shape)
    levels = view.signal.reshape(weight.shape), floor, ceiling
    sums = out.information, out.gradient, out.chi2, out.pixels
    limits = float(view.gain), float(clip)
    _sum_products(*sums, weight, flat, star, matrix, total, slot, inside, levels, limits)
    out.kept.append((weight > 0.0).reshape(view.inside.shape))
    if len(view.crowded):
        out.crowds.append(_shared_pixels(star, view, weight, flat, matrix))


def _sum_products_numpy(
    information: FloatArray,
    gradient: FloatArray,
    chi2: FloatArray,
    pixels: FloatArray,
    weight: Float32Array,
    images: Float32Array,
    star: IntArray,
    matrix: FloatArray,
    total: Float32Array,
    slot: IntArray,
    inside: BoolArray,
    levels: tuple[Float32Array, Float32Array, Float32Array],
    limits: tuple[float, float],
) -> None:
    """Add weighted products of the images of b blocks of p pixels to the normal equations of their stars.

    The weights (b, p), and the residuals in the last of the `images` (b, i + 1, p), are computed from the
    modelled counts `total` of all fitted pixels. Products of the residual with the other images give the
    gradient, and the squared residual gives chi-square. Coefficients `matrix` (b, i, SHARED + ALONE) combine
    the images into derivatives. The tuple `levels` contains signal, floor and ceiling of `BlockPixels`. The
    tuple `limits` contains the arguments gain and clip of `fit_windows.residuals`.
    """
    weight[:], images[:, -1] = residuals(total, slot, inside, *levels, *limits)
    blocks, count = images.shape[:2]
    gram = np.empty((blocks, count, count))
    for begin in range(0, blocks, _AT_ONCE):
        part = slice(begin, begin + _AT_ONCE)
        gram[part] = (images[part] * weight[part, None]) @ images[part].swapaxes(1, 2)
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
    star: IntArray,
    matrix: FloatArray,
    total: Float32Array,
    slot: IntArray,
    inside: BoolArray,
    levels: tuple[Float32Array, Float32Array, Float32Array],
    limits: tuple[float, float],
) -> None:
    """See `_sum_products_numpy`."""
    (signal, floor, ceiling), (gain, clip) = levels, limits
    blocks, count, size = images.shape
    gram, weighted = np.empty((count, count)), np.empty(size, dtype=np.float32)
    model, least = np.empty(size, dtype=np.float32), np.float32(0.0)
    per_count, margin, unresolved = np.float32(1.0 / gain), np.float32(_MARGIN), np.float32(_UNRESOLVED)
    share, room = np.float32(clip), np.float32(0.0 if clip > 0.0 else np.inf)
    for b in range(blocks):
        owner, left, weights = star[b], images[b, count - 1], weight[b]
        variance, off, full = floor[b], signal[b], ceiling[b]
        for p in range(size):
            model[p] = total[slot[b, p]]
        for p in range(size):
            expected = max(model[p], least) * per_count + variance[p]
            residual, deviation = off[p] - model[p], np.float32(math.sqrt(expected))
            good = (model[p] + margin * deviation < full[p]) & inside[b, p]
            good &= abs(residual) <= share * deviation + unresolved * model[p] + room
            weights[p] = np.float32(1.0) / expected if good else least
            left[p] = residual if good else least
        for p in range(size):
            pixels[owner] += weights[p] > 0.0
        for i in range(count):
            for p in range(size):
                weighted[p] = weights[p] * images[b, i, p]
            for k in range(i, count):
                gram[i, k] = _scalar_product(weighted, images[b, k])
                gram[k, i] = gram[i, k]
        _add_block(information[owner], gradient[owner], gram, matrix[b])
        chi2[owner] += gram[count - 1, count - 1]
    for b in range(blocks):
        of_star = information[star[b]]
        if b == 0 or star[b] != star[b - 1]:
            for q in range(len(of_star)):
                for r in range(q):
                    of_star[r, q] = of_star[q, r]


@loop_helper
def _scalar_product(a: Float32Array, b: Float32Array) -> np.floating[Any]:
    """Return the scalar product of two arrays of equal length."""
    total: np.floating[Any] = np.float32(0.0)
    for p in range(len(a)):
        total += a[p] * b[p]
    return total


@loop_helper
def _add_block(information: FloatArray, gradient: FloatArray, gram: FloatArray, matrix: FloatArray) -> None:
    """Add the products `gram` of images to the gradient and to the lower half of one star's information."""
    images, count = matrix.shape
    along = np.empty(images)
    for q in range(count):
        used = False
        for i in range(images):
            along[i] = 0.0
        for k in range(images):
            share = matrix[k, q]
            if share != 0.0:
                used = True
                gradient[q] += share * gram[k, images]
                for i in range(images):
                    along[i] += share * gram[k, i]
        if used:
            for r in range(q + 1):
                for i in range(images):
                    information[q, r] += along[i] * matrix[i, r]


def _shared_pixels(
    star: IntArray, view: BlockPixels, weight: Float32Array, images: Float32Array, matrix: FloatArray
) -> SharedPixels:
    """Return the derivatives of the modelled counts on the pixels that belong to several stars."""
    block, drawn = _at_pixels(images, view.crowded)
    first = np.flatnonzero(np.diff(block, prepend=-1))
    held = block[first]
    weights = weight.reshape(-1)[view.crowded]
    return SharedPixels(star[held], matrix[held], first, view.common, weights, drawn)


def _at_pixels_numpy(images: Float32Array, crowded: IntArray) -> tuple[IntArray, Float32Array]:
    """Return the indices (e,) of the blocks that contain e pixels, and the values (i, e) of i images there.

    The array `images` (b, i + 1, p) contains i + 1 images on the p pixels of each of b blocks. The last image
    contains the residuals and is omitted. The array `crowded` (e,) contains the flat indices of the given
    pixels in an array (b, p).
    """
    _, count, size = images.shape
    block, place = np.divmod(crowded, size)
    place += block * (count * size)
    drawn = np.empty((count - 1, len(place)), dtype=np.float32)
    for image in drawn:
        image[:] = images.reshape(-1).take(place)
        place += size
    return block, drawn


@compiled_form_of(_at_pixels_numpy)
def _at_pixels(images: Float32Array, crowded: IntArray) -> tuple[IntArray, Float32Array]:
    """See `_at_pixels_numpy`."""
    _, count, size = images.shape
    block, drawn = np.empty_like(crowded), np.empty((count - 1, len(crowded)), dtype=np.float32)
    for e in range(len(crowded)):
        block[e] = crowded[e] // size
        of_block, place = images[block[e]], crowded[e] - block[e] * size
        for i in range(count - 1):
            drawn[i, e] = of_block[i, place]
    return block, drawn


def _spot_images(
    scene: StreakScene, windows: FitWindows, spots: FloatArray, change: FloatArray
) -> Float32Array:
    """Return derivatives (n, SHARED + ALONE + 1, p, p) of n spots of p x p pixels with respect to parameters.

    The last element along the second axis is not initialised. It is a buffer for the residuals.
    """
    light = scene.light[windows.spot, None, None, None]
    images = np.empty((len(spots), SHARED + ALONE + 1, *spots.shape[1:]), dtype=np.float32)
    images[:, :6] = change[:, :6] * light
    # The squared width is sigma^2 plus the variance of a pixel, so that d sigma / d width = width / sigma.
    images[:, 6] = change[:, 8] * light[:, 0] * (scene.width / scene.sigma)
    images[:, 7:9] = change[:, 6:8] * light
    images[:, 9] = spots
    images[:, 10] = 1.0
    return images


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """One Gauss-Newton step of the fit, and the covariance of the parameters.

    Attributes:
        shared: step of the parameters that all stars share (SHARED,).
        alone: step of the parameters of each single star (n, ALONE).
        eliminated: normal equations for the shared parameters alone, in which the coupling of stars by shared
            pixels is neglected.
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
        """The covariance (n, SHARED + ALONE, SHARED + ALONE) of the shared and each star's own parameters."""
        kept, gain, inner = self.eliminated.kept, self.eliminated.gain, self.eliminated.inner
        joint = np.zeros((len(gain), SHARED + ALONE, SHARED + ALONE))
        joint[:, :SHARED, :SHARED] = self.covariance
        crossed = -inner @ gain
        joint[:, kept, SHARED:] = crossed
        joint[:, SHARED:, kept] = crossed.swapaxes(1, 2)
        joint[:, SHARED:, SHARED:] = self.eliminated.own + gain.swapaxes(1, 2) @ inner @ gain
        return joint


@dataclass(frozen=True, slots=True, eq=False)
class EliminatedEquations:
    """Normal equations for the shared parameters alone, in which coupling by shared pixels is neglected.

    Attributes:
        kept: indices of the k fitted parameters among the shared parameters (k,).
        own: inverse (n, ALONE, ALONE) of the block of the information matrix for the parameters of each star.
        gain: product of `own` and the block of the information matrix that couples k shared and each star's
            own parameters (n, k, ALONE).
        inner: covariance of the k fitted shared parameters (k, k).
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
    own, gain, normal = _eliminated(evaluation.information, kept)
    scale = np.sqrt(np.diag(normal).clip(min=0.0))
    if not np.all(np.isfinite(normal)) or not np.all(scale > 0.0):
        return None
    scaled = normal / np.outer(scale, scale)
    least, most = np.linalg.eigvalsh(scaled)[[0, -1]]
    if most > 1e10 * least:
        return None
    return EliminatedEquations(kept, own, gain, np.linalg.inv(scaled) / np.outer(scale, scale))


def _eliminated_numpy(information: FloatArray, kept: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the attributes `own` and `gain` of `EliminatedEquations`, and the information matrix (k, k).

    The arguments are the information of `Evaluation` and the indices `kept` (k,) of the fitted parameters.
    """
    alone = information[:, SHARED:, SHARED:].copy()
    diagonal = np.einsum("nii->ni", alone)
    diagonal += PRIOR
    # For a star without fitted pixels, the diagonal element of the flux is set to 1, so that the star's block
    # is invertible.
    diagonal += np.where(diagonal > 0.0, 0.0, 1.0)
    root = np.sqrt(np.einsum("nii->ni", alone))
    outer = root[:, :, None] * root[:, None, :]
    unit = alone / outer
    unit[:, range(ALONE), range(ALONE)] += 1e-9
    own = np.asarray(np.linalg.inv(unit) / outer)
    cross = information[:, kept, SHARED:]
    gain = cross @ own
    normal = (information[:, kept[:, None], kept] - gain @ cross.swapaxes(1, 2)).sum(axis=0)
    return own, gain, normal


@compiled_form_of(_eliminated_numpy)
def _eliminated(information: FloatArray, kept: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """See `_eliminated_numpy`."""
    n, count = len(information), len(kept)
    own, gain = np.empty((n, ALONE, ALONE)), np.empty((n, count, ALONE))
    normal, unit, root = np.zeros((count, count)), np.empty((ALONE, 2 * ALONE)), np.empty(ALONE)
    for star in range(n):
        for i in range(ALONE):
            diagonal = information[star, SHARED + i, SHARED + i] + PRIOR[i]
            root[i] = math.sqrt(diagonal if diagonal > 0.0 else 1.0 + diagonal)
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
    return own, gain, normal


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

    The coupling of stars by shared pixels is included by at most `rounds` conjugate-gradient iterations. If
    `rounds` is 0, the coupling of stars by shared pixels is neglected.
    """
    eliminated = eliminate(evaluation, free)
    if eliminated is None:
        return None
    # The prior of the sky level is centred on zero, and the prior of the position on the current position.
    offset = np.stack([np.zeros_like(scene.sky)] * 3 + [scene.sky], axis=-1)
    alone = evaluation.gradient[:, SHARED:] - PRIOR * offset
    shared = np.where(free, evaluation.gradient[:, :SHARED].sum(axis=0), 0.0)
    step = _coupled(evaluation, eliminated, free, np.concatenate([shared, alone.reshape(-1)]), rounds)
    return Solution(step[:SHARED], step[SHARED:].reshape(alone.shape), eliminated)


def rate_covariance(evaluation: Evaluation, free: BoolArray, rounds: int) -> FloatArray | None:
    """Return the covariance (3, 3) of the rate with the effect of shared pixels, or None if singular."""
    eliminated = eliminate(evaluation, free)
    if eliminated is None:
        return None
    out = np.empty((3, 3))
    for k in range(3):
        # The equations are scaled so that the solution is of order one and the same tolerance is valid for
        # all frames.
        unit = np.zeros(SHARED + ALONE * len(evaluation.chi2))
        unit[k] = 1.0 / np.sqrt(eliminated.inner[k].max())
        out[k] = _coupled(evaluation, eliminated, free, unit, rounds)[:3] / unit[k]
    return 0.5 * (out + out.T)


def _coupled(
    evaluation: Evaluation,
    eliminated: EliminatedEquations,
    free: BoolArray,
    right: FloatArray,
    rounds: int,
) -> FloatArray:
    """Return the solution of the coupled normal equations, see `coupled_stars.solution`."""
    crowds = [(of.star, of.matrix, of.first, of.slot, of.weight, of.images) for of in evaluation.crowds]
    first, second = (*crowds, coupled_stars.NO_CROWD, coupled_stars.NO_CROWD)[:2]
    alone = eliminated.kept, eliminated.own, eliminated.gain, eliminated.inner
    return coupled_stars.solution(
        evaluation.information, PRIOR, (first, second), evaluation.shared, alone, free, right, rounds
    )


def stepped(
    scene: StreakScene, solution: Solution, pinhole: Pinhole, longest: float
) -> tuple[StreakScene, float]:
    """Return the scene after a step of the fit that is limited to `longest` px at each streak end.

    The second returned value is the largest displacement (px) of a streak end by the unlimited step, or the
    change (px) of the point-spread width if that is larger.
    """
    n = len(scene.stars)
    growing = bool(solution.shared[3:6].any())
    change = sensitivities(
        pinhole, scene.motion, np.tile(scene.stars, (2, 1)), np.repeat([-0.5, 0.5], n), growing
    )
    along = change[:, :, :6] @ solution.shared[:6]
    ends = float(np.hypot(along[:, 0], along[:, 1]).max(initial=0.0))
    share = min(1.0, longest / max(ends, 1e-9), 0.3 * scene.width / max(abs(solution.shared[6]), 1e-9))
    step = solution.alone * share
    far = np.hypot(step[:, 0], step[:, 1])
    step[:, :2] *= np.minimum(1.0, longest / np.maximum(far, 1e-9))[:, None]
    shared = share * solution.shared
    turn, growth = scene.motion.rate + shared[:3], scene.motion.acceleration + shared[3:6]
    after = replace(
        scene,
        motion=replace(scene.motion, rate=turn, acceleration=growth),
        width=scene.width + float(shared[6]),
        stars=scene.stars + step[:, :2],
        light=np.maximum(scene.light + step[:, 2], 0.3 * scene.light),
        sky=scene.sky + step[:, 3],
    )
    return after, max(ends, abs(float(solution.shared[6])))


# Fisher information of a star, relative to the most informative star, below which the star is ignored.
_NOTHING = 1e-9
# Smallest used eigenvalue of a star's information matrix, relative to its largest eigenvalue.
_KNOWN = 1e-4
# Minimum effective number of stars for an estimate of the scatter between stars.
# The effective number of stars is smaller than the number of stars if the weights are unequal.
_LEAST_EFFECTIVE = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class StarEstimates:
    """Estimates of k parameter changes from each of n stars, and their standard deviations, both (n, k)."""

    change: FloatArray
    deviation: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class StarEquations:
    """Normal equations of each star for the shared parameters, after elimination of the star's parameters.

    Attributes:
        kept: indices of the k fitted parameters among the shared parameters (k,).
        information: information matrix of each star for the k fitted parameters (n, k, k).
        score: gradient (n, k) of each star's log-likelihood with respect to the k fitted parameters.
    """

    kept: IntArray
    information: FloatArray
    score: FloatArray


def star_estimates(evaluation: Evaluation, scene: StreakScene, free: BoolArray) -> StarEstimates | None:
    """Return the estimate from each individual star, or None if the equations are singular."""
    alone = star_equations(evaluation, free)
    return None if alone is None else estimates_of(alone, scene)


def estimates_of(alone: StarEquations, scene: StreakScene) -> StarEstimates:
    """Return, for each star, its estimate of three rate components and of the point-spread width.

    The rate components are along the rotation axis and along two vectors normal to it. Each estimate is the
    difference from the value in `scene`, in rad per exposure for the rate and in px for the width.
    """
    axis = scene.motion.rotation / max(float(np.linalg.norm(scene.motion.rotation)), 1e-12)
    across = np.linalg.svd(axis[None])[2][1:]
    directions = np.zeros((4, SHARED))
    directions[0, :3], directions[1:3, :3], directions[3, 6] = axis, across, 1.0
    directions = directions[:, alone.kept]
    information = np.einsum("ai,nij,aj->na", directions, alone.information, directions)
    informed = information > _NOTHING * information.max(axis=0)
    information = np.where(informed, information, _NOTHING * information.max(axis=0) + 1e-300)
    return StarEstimates(
        np.where(informed, alone.score @ directions.T / information, 0.0), 1.0 / np.sqrt(information)
    )


def step_significance(evaluation: Evaluation, step: FloatArray) -> tuple[float, int]:
    """Return the squared significance of a `step` of the shared parameters, and the number of stars.

    If the scatter of the stars' estimates exceeds their noise, the significance is computed from the scatter.
    Therefore, a single blended star cannot make a step significant.
    """
    alone = star_equations(evaluation, step != 0.0)
    if alone is None:
        return 0.0, 0
    part = step[alone.kept]
    asked, due = alone.score @ part, np.einsum("i,nij,j->n", part, alone.information, part)
    count = int(np.count_nonzero(due > 0.0))
    spread = float(np.sum((asked - due) ** 2)) * count / max(count - 1, 1)
    total = float(due.sum())
    return total**2 / max(total, spread, 1e-300), count


def star_equations(evaluation: Evaluation, free: BoolArray) -> StarEquations | None:
    """Return the normal equations of each star for the `free` shared parameters, or None if singular."""
    eliminated = eliminate(evaluation, free)
    if eliminated is None:
        return None
    kept, gain = eliminated.kept, eliminated.gain
    cross = evaluation.information[:, SHARED:][:, :, kept]
    schur = evaluation.information[:, kept[:, None], kept] - gain @ cross
    score = evaluation.gradient[:, kept] - np.einsum("nij,nj->ni", gain, evaluation.gradient[:, SHARED:])
    return StarEquations(kept, schur, score)


def consistent_stars(estimates: StarEstimates, floors: FloatArray, sigmas: float) -> BoolArray:
    """Return which stars' estimates lie within `sigmas` standard deviations of the weighted median, (n,).

    A star is accepted only if its estimates of all k parameters lie within `sigmas` standard deviations. The
    model errors `floors` (k,) are added in quadrature to the standard deviations.
    """
    agree = np.ones(len(estimates.change), dtype=np.bool_)
    for change, deviation, floor in zip(estimates.change.T, estimates.deviation.T, floors, strict=True):
        spread = np.hypot(deviation, floor)
        order = np.argsort(change)
        weight = np.cumsum(1.0 / spread[order])
        middle = change[order][np.searchsorted(weight, 0.5 * weight[-1])]
        # A star that is more accurate than all others is not rejected, because the uncertainty of the median
        # is included.
        error = MEDIAN_ERROR * np.sqrt(len(spread)) / np.sum(1.0 / spread)
        agree &= np.abs(change - middle) <= sigmas * np.hypot(spread, error)
    return agree


def disagreement(estimates: StarEstimates, which: BoolArray) -> float:
    """Return the chi-square per degree of freedom of the differences between the stars `which` (n,)."""
    change, weight = estimates.change[which], estimates.deviation[which] ** -2
    if len(change) < 3:
        return 1.0
    total = weight.sum(axis=0)
    mean = np.sum(weight * change, axis=0) / total
    # The weights are squared, so that many faint stars do not hide the scatter of a few bright stars.
    effective = np.maximum(total**2 / np.sum(weight**2, axis=0), _LEAST_EFFECTIVE)
    found = np.sum(weight**2 * (change - mean) ** 2, axis=0) / total * effective / (effective - 1.0)
    # Even without excess scatter, the largest of several reduced chi-squares exceeds 1 by about one standard
    # deviation.
    return float(np.max(found / (1.0 + np.sqrt(2.0 / (effective - 1.0)))))


def contradiction(alone: StarEquations) -> float:
    """Return the chi-square per degree of freedom of all stars' estimates about their common solution.

    In contrast to `disagreement`, this test uses all combinations of parameters that a star determines, each
    with the noise of that star.
    """
    total = alone.information.sum(axis=0)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(total), 1e-300))
    information = alone.information * np.outer(scale, scale)
    step = np.linalg.lstsq(information.sum(axis=0), alone.score.sum(axis=0) * scale, rcond=None)[0]
    values, vectors = np.linalg.eigh(information)
    left = np.einsum("nji,nj->ni", vectors, alone.score * scale - information @ step)
    known = values > _KNOWN * np.maximum(values.max(axis=1, keepdims=True), 1e-300)
    freedom = int(np.count_nonzero(known)) - len(step)
    if freedom < 1:
        return 1.0
    return float(np.sum(left[known] ** 2 / values[known])) / freedom
