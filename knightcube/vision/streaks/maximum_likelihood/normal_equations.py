"""What the pixels say of a scene: score and information, star by star (Fisher scoring).

Each pixel weighs by the variance that the model itself predicts, so the fixed point is that of maximum
likelihood for Poisson light. The residual is of all stars together, so streaks may cross.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks.maximum_likelihood import spot_model, streak_model
from knightcube.vision.streaks.maximum_likelihood.exposed_frame import Float32Array
from knightcube.vision.streaks.maximum_likelihood.scene import Scene
from knightcube.vision.streaks.maximum_likelihood.shutter import Shutter
from knightcube.vision.streaks.maximum_likelihood.windows import Sight, Windows

SHARED = 7
"""Turn (3), growth (3), width of the point spread."""
ALONE = 4
"""x, y, light, sky of a star."""

# This many blocks are multiplied at a time: the weighted ones stay in the processor's cache.
_AT_ONCE = 128
# A star's place along a streak whose ends are both outside is not known: this keeps its step finite, px.
_LOOSE = 30.0
# The sky about a star is near the frame's background, counts.
_SKY = 3.0
PRIOR = np.array([_LOOSE**-2, _LOOSE**-2, 0.0, _SKY**-2])
"""The information (ALONE,) that keeps finite the numbers that the pixels do not determine."""


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """The normal equations of a scene.

    Attributes:
        information: (n, SHARED + ALONE, SHARED + ALONE), of each star's pixels.
        gradient: (n, SHARED + ALONE).
        chi2, pixels: (n,) of each star's pixels: sum of squared residuals over their variance, and how many.
        crowds: the light's derivatives on the pixels that stars share; shared: how many those are.
        kept: which pixels of the strips and of the patches were not left out.
    """

    information: FloatArray
    gradient: FloatArray
    chi2: FloatArray
    pixels: FloatArray
    crowds: list[Crowd]
    shared: int
    kept: tuple[BoolArray, BoolArray]


@dataclass(frozen=True, slots=True, eq=False)
class Crowd:
    """Derivatives of stars' light on pixels (e,) that other stars share, in order of their blocks (b,).

    Attributes:
        star: (b,) whose block it is; `matrix` (b, i, SHARED + ALONE) mixes images to derivatives.
        block, slot: (e,) of each pixel; first: (b,) where each block's pixels begin.
        weight: (e,); images: (i, e).
    """

    star: IntArray
    matrix: FloatArray
    block: IntArray
    first: IntArray
    slot: IntArray
    weight: Float32Array
    images: Float32Array


def evaluate(
    pinhole: Pinhole, shutter: Shutter, scene: Scene, windows: Windows, clip: float, growing: bool
) -> Evaluation:
    """Return the normal equations of `scene` on its windows.

    Pixels whose residual exceeds `clip` sigma (and a tenth of the model) are left out; 0 leaves none.
    """
    strips = windows.strips
    images, spots, change = shapes(pinhole, shutter, scene, windows)
    of_block = windows.long[strips.star]
    streak_light = images[:, 0] * scene.light[of_block, None, None].astype(np.float32)
    streak_light += scene.sky[of_block, None, None].astype(np.float32)
    spot_light = spots * scene.light[windows.spot, None, None] + scene.sky[windows.spot, None, None]
    total = windows.total(streak_light, spot_light)
    n, size = len(scene.stars), SHARED + ALONE
    weights, residuals = zip(
        windows.on_strips.residual(total, clip), windows.on_patches.residual(total, clip), strict=True
    )
    out = Evaluation(
        np.zeros((n, size, size)),
        np.zeros((n, size)),
        np.zeros(n),
        np.zeros(n),
        [],
        windows.shared,
        (weights[0] > 0.0, weights[1] > 0.0),
    )
    if len(strips.star):
        matrix = _block_parameters(pinhole, shutter, scene, windows, growing)
        matrix[:, :, :SHARED] *= scene.trusted[of_block, None, None]
        images[:, streak_model.IMAGES] = residuals[0]
        _add(out, of_block, windows.on_strips, weights[0], images, matrix)
    if len(windows.spot):
        spot_images = _spot_images(scene, windows, spots, change)
        matrix = np.tile(np.eye(size), (len(windows.spot), 1, 1))
        matrix[:, :, :SHARED] *= scene.trusted[windows.spot, None, None]
        spot_images[:, size] = residuals[1]
        _add(out, windows.spot, windows.on_patches, weights[1], spot_images, matrix)
    return out


def light_of(pinhole: Pinhole, shutter: Shutter, scene: Scene, windows: Windows) -> Float32Array:
    """Return the light of all stars of `scene` on the pixels in use of its windows, sky left out."""
    images, spots, _ = shapes(pinhole, shutter, scene, windows)
    streaks = images[:, 0] * scene.light[windows.long[windows.strips.star], None, None].astype(np.float32)
    return windows.total(streaks, spots * scene.light[windows.spot, None, None])[:-1]


def shapes(
    pinhole: Pinhole, shutter: Shutter, scene: Scene, windows: Windows
) -> tuple[Float32Array, FloatArray, FloatArray]:
    """Return the images of the strips, the spots' light and its derivatives, all of stars of light 1.

    The images have room for the residual behind them.
    """
    long, spot = scene.stars[windows.long], scene.stars[windows.spot]
    images = streak_model.images(pinhole, scene.motion, shutter, long, scene.width, windows.strips, 1)
    spots, change = spot_model.derivatives(pinhole, scene.motion, shutter, spot, scene.sigma, windows.patches)
    return images, spots, change


def _block_parameters(
    pinhole: Pinhole, shutter: Shutter, scene: Scene, windows: Windows, growing: bool
) -> FloatArray:
    """Return (b, IMAGES, SHARED + ALONE): which mixture of a block's images each parameter changes."""
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
    sight: Sight,
    weight: Float32Array,
    images: Float32Array,
    matrix: FloatArray,
) -> None:
    """Add blocks of pixels, in order of their stars, to the normal equations.

    The last of the `images` is the residual: its products with the others are the score, with itself the
    chi-square.
    """
    blocks, count = images.shape[:2]
    flat = images.reshape(blocks, count, -1)
    weight = weight.reshape(blocks, -1)
    gram = np.empty((blocks, count, count))
    for begin in range(0, blocks, _AT_ONCE):
        part = slice(begin, begin + _AT_ONCE)
        gram[part] = (flat[part] * weight[part, None]) @ flat[part].swapaxes(1, 2)
    turned = matrix.swapaxes(1, 2)
    first = np.flatnonzero(np.diff(star, prepend=-1))
    owner = star[first]
    out.information[owner] += np.add.reduceat(turned @ gram[:, :-1, :-1] @ matrix, first)
    out.gradient[owner] += np.add.reduceat((turned @ gram[:, :-1, -1:])[..., 0], first)
    out.chi2[owner] += np.add.reduceat(gram[:, -1, -1], first)
    out.pixels[owner] += np.add.reduceat((weight > 0.0).sum(axis=1), first)
    if len(sight.crowded):
        out.crowds.append(_crowd(star, sight, weight, flat, matrix))


def _crowd(
    star: IntArray, sight: Sight, weight: Float32Array, images: Float32Array, matrix: FloatArray
) -> Crowd:
    block, place = np.divmod(sight.crowded, images.shape[2])
    first = np.flatnonzero(np.diff(block, prepend=-1))
    held = block[first]
    _, count, size = images.shape
    place += block * (count * size)
    drawn = np.empty((count - 1, len(place)), dtype=np.float32)
    for image in drawn:
        image[:] = images.reshape(-1).take(place)
        place += size
    return Crowd(
        star[held],
        matrix[held],
        np.repeat(np.arange(len(held)), np.diff(first, append=len(block))),
        first,
        sight.common,
        weight.reshape(-1)[sight.crowded],
        drawn,
    )


def _spot_images(scene: Scene, windows: Windows, spots: FloatArray, change: FloatArray) -> Float32Array:
    """Return the derivatives (n, SHARED + ALONE + 1, p, p) of the spots' light, the last left empty."""
    light = scene.light[windows.spot, None, None, None]
    images = np.empty((len(spots), SHARED + ALONE + 1, *spots.shape[1:]), dtype=np.float32)
    images[:, :6] = change[:, :6] * light
    # The width is that of Gaussian and pixel together: d sigma / d width = width / sigma.
    images[:, 6] = change[:, 8] * light[:, 0] * (scene.width / scene.sigma)
    images[:, 7:9] = change[:, 6:8] * light
    images[:, 9] = spots
    images[:, 10] = 1.0
    return images


def apply_information(
    evaluation: Evaluation, shared: FloatArray, alone: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the information of all stars together times (shared (SHARED,), alone (n, ALONE)).

    To the blocks of `Evaluation.information` the coupling of stars that share pixels is added.
    """
    n = len(alone)
    vector = np.concatenate([np.broadcast_to(shared, (n, SHARED)), alone], axis=1)
    out = (evaluation.information @ vector[..., None])[..., 0]
    change = np.zeros(evaluation.shared)
    lights = []
    for crowd in evaluation.crowds:
        mixture = (crowd.matrix @ vector[crowd.star][..., None])[..., 0].T.astype(np.float32)
        lights.append(np.einsum("ie,ie->e", mixture.take(crowd.block, axis=1), crowd.images))
        change += np.bincount(crowd.slot, lights[-1], evaluation.shared)
    for crowd, light in zip(evaluation.crowds, lights, strict=True):
        weighted = crowd.weight * (change[crowd.slot] - light).astype(np.float32)
        slope = np.add.reduceat(crowd.images * weighted, crowd.first, axis=1).T.astype(np.float64)
        np.add.at(out, crowd.star, (slope[:, None] @ crowd.matrix)[:, 0])
    return out[:, :SHARED].sum(axis=0), out[:, SHARED:] + PRIOR * alone
