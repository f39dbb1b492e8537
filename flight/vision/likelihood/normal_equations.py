"""What the pixels say of a scene: score and information, star by star (Fisher scoring).

Each pixel weighs by the variance that the model itself predicts, so the fixed point is that of maximum
likelihood for Poisson light. The residual is of all stars together, so streaks may cross.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flight.arrays import BoolArray, FloatArray, IntArray
from flight.pinhole import Pinhole
from flight.vision.likelihood import spot_model, streak_model
from flight.vision.likelihood.exposed_frame import ExposedFrame
from flight.vision.likelihood.scene import Scene
from flight.vision.likelihood.shutter import Shutter
from flight.vision.likelihood.spot_model import Patches
from flight.vision.likelihood.streak_model import Float32Array
from flight.vision.likelihood.strips import Strips
from flight.vision.likelihood.windows import Windows

SHARED = 7
"""Turn (3), growth (3), width of the point spread."""
ALONE = 4
"""x, y, light, sky of a star."""

# A star's place along a streak whose ends are both outside is not known: this keeps its step finite, px.
_LOOSE = 30.0
# The sky about a star is near the frame's background, counts.
_SKY = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """The normal equations of a scene.

    Attributes:
        information: (n, SHARED + ALONE, SHARED + ALONE), of each star's pixels.
        gradient: (n, SHARED + ALONE).
        chi2, pixels: (n,) of each star's pixels: sum of squared residuals over their variance, and how many.
        clipped: (n,) share of the star's light on pixels left out.
        linear: the light's derivatives on all windows; used: how many pixels of the frame they lie on.
    """

    information: FloatArray
    gradient: FloatArray
    chi2: FloatArray
    pixels: FloatArray
    clipped: FloatArray
    linear: list[Linear]
    used: int


@dataclass(frozen=True, slots=True, eq=False)
class Linear:
    """Derivatives of the light on some blocks of pixels.

    Attributes:
        star: (b,) whose block it is; index (b, p) into the pixels in use; weight (b, p), inside (b, p).
        images: (b, i, p), which `matrix` (b, i, SHARED + ALONE) mixes to derivatives.
    """

    star: IntArray
    index: IntArray
    inside: BoolArray
    weight: Float32Array
    images: Float32Array
    matrix: FloatArray


def evaluate(
    frame: ExposedFrame,
    pinhole: Pinhole,
    shutter: Shutter,
    scene: Scene,
    windows: Windows,
    clip: float,
    growing: bool,
) -> Evaluation:
    """Return the normal equations of `scene` on its windows.

    Pixels whose residual exceeds `clip` sigma (and a tenth of the model) are left out; 0 leaves none.
    """
    strips, patches = windows.strips, windows.patches
    long, spot = scene.stars[windows.long], scene.stars[windows.spot]
    images = streak_model.images(pinhole, scene.motion, shutter, long, scene.width, strips)
    spots, change = spot_model.derivatives(pinhole, scene.motion, shutter, spot, scene.sigma, patches)
    of_block = windows.long[strips.star]
    streak_light = images[:, 0] * scene.light[of_block, None, None].astype(np.float32)
    streak_light += scene.sky[of_block, None, None].astype(np.float32)
    spot_light = spots * scene.light[windows.spot, None, None] + scene.sky[windows.spot, None, None]
    total = frame.modelled(
        (strips.index, streak_light * strips.inside), (patches.index, spot_light * patches.inside)
    )
    n, size = len(scene.stars), SHARED + ALONE
    number, used = _numbered(frame, strips, patches)
    out = Evaluation(
        np.zeros((n, size, size)), np.zeros((n, size)), np.zeros(n), np.zeros(n), np.zeros(n), [], used
    )
    if len(strips.star):
        weight, residual = frame.residual(strips.index, strips.inside, total, clip)
        matrix = _block_parameters(pinhole, shutter, scene, windows, growing)
        matrix[:, :, :SHARED] *= scene.trusted[of_block, None, None]
        _count(out, of_block, weight, residual, streak_light, strips.inside)
        _add(out, of_block, number[strips.index], strips.inside, weight, residual, images, matrix)
    if len(spot):
        weight, residual = frame.residual(patches.index, patches.inside, total, clip)
        _count(out, windows.spot, weight, residual, spot_light, patches.inside)
        spot_images = _spot_images(scene, windows, spots, change)
        matrix = np.tile(np.eye(size), (len(spot), 1, 1))
        matrix[:, :, :SHARED] *= scene.trusted[windows.spot, None, None]
        _add(out, windows.spot, number[patches.index], patches.inside, weight, residual, spot_images, matrix)
    return out


def _numbered(frame: ExposedFrame, strips: Strips, patches: Patches) -> tuple[IntArray, int]:
    """Return a number for each pixel of the frame that is in use, and how many there are."""
    use = np.zeros(frame.signal.size, dtype=np.bool_)
    use[strips.index] = True
    use[patches.index] = True
    where = np.flatnonzero(use)
    number = np.zeros(frame.signal.size, dtype=np.int64)
    number[where] = np.arange(len(where))
    return number, len(where)


def light_of(
    frame: ExposedFrame, pinhole: Pinhole, shutter: Shutter, scene: Scene, windows: Windows
) -> Float32Array:
    """Return the light (rows * columns) of all stars of `scene`, sky left out."""
    strips, patches = windows.strips, windows.patches
    long, spot = scene.stars[windows.long], scene.stars[windows.spot]
    images = streak_model.images(pinhole, scene.motion, shutter, long, scene.width, strips)
    spots, _ = spot_model.derivatives(pinhole, scene.motion, shutter, spot, scene.sigma, patches)
    streaks = images[:, 0] * scene.light[windows.long[strips.star], None, None].astype(np.float32)
    spots = spots * scene.light[windows.spot, None, None]
    return frame.modelled((strips.index, streaks * strips.inside), (patches.index, spots * patches.inside))


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
    index: IntArray,
    inside: BoolArray,
    weight: Float32Array,
    residual: Float32Array,
    images: Float32Array,
    matrix: FloatArray,
) -> None:
    """Add blocks of pixels to the normal equations."""
    blocks = len(images)
    flat = images.reshape(blocks, images.shape[1], -1)
    weight, residual = weight.reshape(blocks, -1), residual.reshape(blocks, -1)
    weighted = flat * weight[:, None]
    gram = (weighted @ flat.swapaxes(1, 2)).astype(np.float64)
    slope = (weighted @ residual[..., None]).astype(np.float64)
    turned = matrix.swapaxes(1, 2)
    np.add.at(out.information, star, turned @ gram @ matrix)
    np.add.at(out.gradient, star, (turned @ slope)[..., 0])
    out.linear.append(
        Linear(star, index.reshape(blocks, -1), inside.reshape(blocks, -1), weight, flat, matrix)
    )


def _spot_images(scene: Scene, windows: Windows, spots: FloatArray, change: FloatArray) -> Float32Array:
    """Return the derivatives (n, SHARED + ALONE, p, p) of the spots' light."""
    light = scene.light[windows.spot, None, None, None]
    images = np.empty((len(spots), SHARED + ALONE, *spots.shape[1:]), dtype=np.float32)
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

    Unlike the blocks of `Evaluation.information`, it knows that stars share pixels.
    """
    n = len(alone)
    vector = np.concatenate([np.tile(shared, (n, 1)), alone], axis=1)
    change = np.zeros(evaluation.used)
    for part in evaluation.linear:
        mixture = np.einsum("bip,bp->bi", part.matrix, vector[part.star]).astype(np.float32)
        light = (mixture[:, None, :] @ part.images)[:, 0] * part.inside
        change += np.bincount(part.index.reshape(-1), light.reshape(-1), evaluation.used)
    change32 = change.astype(np.float32)
    out = np.zeros((n, SHARED + ALONE))
    for part in evaluation.linear:
        felt = part.weight * change32[part.index]
        slope = (part.images @ felt[..., None])[..., 0].astype(np.float64)
        np.add.at(out, part.star, np.einsum("bip,bi->bp", part.matrix, slope))
    return out[:, :SHARED].sum(axis=0), out[:, SHARED:] + prior_information(evaluation) * alone


def prior_information(evaluation: Evaluation) -> FloatArray:
    """Return the information (n, ALONE) that keeps what the pixels do not tell finite."""
    return np.broadcast_to(np.array([_LOOSE**-2, _LOOSE**-2, 0.0, _SKY**-2]), (len(evaluation.chi2), ALONE))


def _count(
    out: Evaluation,
    star: IntArray,
    weight: Float32Array,
    residual: Float32Array,
    light: Float32Array | FloatArray,
    inside: BoolArray,
) -> None:
    n, axes = len(out.chi2), (1, 2)
    used = weight > 0.0
    out.chi2[:] += np.bincount(star, (weight * residual * residual).sum(axis=axes), n)
    out.pixels[:] += np.bincount(star, used.sum(axis=axes), n)
    lit = np.bincount(star, (light * inside).sum(axis=axes), n)
    lost = np.bincount(star, (light * (inside & ~used)).sum(axis=axes), n)
    out.clipped[:] += lost / np.where(lit > 0.0, lit, np.inf)
