"""What the pixels say of a scene: score and information, star by star (Fisher scoring).

Each pixel weighs by the variance that the model itself predicts, so the fixed point is that of maximum
likelihood for Poisson light. The residual is of all stars together, so streaks may cross.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks import streak_model
from knightcube.vision.streaks.frame import ExposedFrame, Float32Array
from knightcube.vision.streaks.geometry import (
    Motion,
    Scene,
    Shutter,
    path_lengths,
    paths,
    positions,
    sensitivities,
    window_times,
)
from knightcube.vision.streaks.streak_model import STEEPEST, Patches, Strips, cut_patches, cut_strips

# Paths shorter than this many widths are summed instant by instant.
_SPOT_WIDTHS = 8.0
# Predicted light within this many sigmas of saturation is left out: chosen by the model, not by the noise.
_MARGIN = 3.0
# Instants at which a path is tested for being in the frame.
_INSTANTS = 9
_UNRESOLVED = 0.1
# The speed along a strip may change by this part of itself over a width of the point spread.
_STEADY = 0.05
# A fast part shorter than this many widths is left to the patch.
_LEAST_FAST = 4.0
_SLOWEST = 1e-3
# Instants at which the rate is looked at for that.
_SAMPLES = 129


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """The frame on some blocks of pixels, all arrays (b, ...) alike.

    Attributes:
        slot: number of the pixel among those in use, the same for every star that shares it; one past the
            last where the pixel does not exist.
        inside: whether the pixel exists, is usable and wanted.
        signal, floor, ceiling: of the frame.
        gain: electrons a count.
        crowded: (e,) flat positions of the pixels that other stars share; common: (e,) their numbers among
            all that are shared.
    """

    slot: IntArray
    inside: BoolArray
    signal: Float32Array
    floor: Float32Array
    ceiling: Float32Array
    gain: float
    crowded: IntArray
    common: IntArray

    def residual(self, total: Float32Array, clip: float) -> tuple[Float32Array, Float32Array]:
        """Return weights (1/variance, 0 where left out) and residuals under the light `total` by slot.

        Residuals of more than `clip` sigma and a tenth of the model are no noise: left out; 0 leaves none out
        for that.
        """
        model = total.take(self.slot)
        variance = np.maximum(model, np.float32(0.0))
        variance *= np.float32(1.0 / self.gain)
        variance += self.floor
        residual = self.signal - model
        deviation = np.sqrt(variance)
        good = self.inside & (model + np.float32(_MARGIN) * deviation < self.ceiling)
        if clip > 0.0:
            deviation *= np.float32(clip)
            deviation += np.float32(_UNRESOLVED) * model
            good &= np.abs(residual) <= deviation
        weight = np.where(good, np.float32(1.0) / variance, np.float32(0.0))
        residual[~good] = 0.0
        return weight, residual


@dataclass(frozen=True, slots=True, eq=False)
class Windows:
    """The pixels that are fitted: strips about long streaks, patches about spots.

    Attributes:
        long, spot: stars (a,), (b,) with a strip and with a patch, indices into the scene; a streak that is
            slow in part has both.
        strips, patches: their pixels; star i of the strips is `long[i]`.
        pixels: (m,) flat indices of the pixels in use, by slot; slot: of all blocks' pixels, one after other.
        on_strips, on_patches: the frame there.
        shared: how many pixels are of several stars.
    """

    long: IntArray
    spot: IntArray
    strips: Strips
    patches: Patches
    pixels: IntArray
    slot: IntArray
    on_strips: Sight
    on_patches: Sight
    shared: int

    def total(self, on_strips: Float32Array, on_patches: FloatArray) -> Float32Array:
        """Return the light (m + 1,) of all stars on the pixels in use, from that on each star's own.

        The last one is for pixels that do not exist.
        """
        light = np.concatenate([on_strips.reshape(-1), on_patches.reshape(-1).astype(np.float32)])
        return np.bincount(self.slot, light, len(self.pixels) + 1).astype(np.float32)

    def only(self, on_strips: BoolArray, on_patches: BoolArray) -> Windows:
        """Return the windows with only these pixels meant."""
        return replace(
            self,
            on_strips=replace(self.on_strips, inside=on_strips),
            on_patches=replace(self.on_patches, inside=on_patches),
        )


def window_areas(pinhole: Pinhole, scene: Scene, reach: float) -> FloatArray:
    """Return about how many pixels (n,) each star's window takes, `reach` widths to either side of its path.

    All lines of all strips are as long as that which its path crosses most obliquely.
    """
    n, room = len(scene.stars), reach * scene.width
    if n == 0:
        return np.empty(0)
    time = np.tile(np.linspace(-0.5, 0.5, _INSTANTS), n)
    there = positions(pinhole, scene.motion, np.repeat(scene.stars, _INSTANTS, axis=0), time)
    seen = pinhole.contains(there).reshape(n, _INSTANTS).mean(axis=1)
    step = np.abs(np.diff(there.reshape(n, _INSTANTS, 2), axis=1))
    lines = step.max(axis=2)
    steep = float(np.min(lines / np.maximum(np.hypot(step[..., 0], step[..., 1]), 1e-9)))
    across = 2.0 * np.floor(room / min(max(steep, STEEPEST), 1.0) + 0.5) + 1.0
    return np.asarray(across * (lines.sum(axis=1) * seen + 2.0 * room))


def cut_windows(
    frame: ExposedFrame, pinhole: Pinhole, shutter: Shutter, scene: Scene, reach: float
) -> Windows:
    """Return the pixels of `frame` within `reach` widths of the stars' paths."""
    long, spot, strips, patches = _placed(pinhole, shutter, scene, reach * scene.width)
    index = np.concatenate([strips.index.reshape(-1), patches.index.reshape(-1)])
    inside = np.concatenate([strips.inside.reshape(-1), patches.inside.reshape(-1)])
    named = index[inside]
    # Each pixel belongs to the last place that names it; only memory of pixels in use is touched.
    turn = np.arange(len(named), dtype=np.int32)
    number = np.empty(frame.signal.size, dtype=np.int32)
    number[named] = turn
    last = number.take(named)
    own = last == turn
    pixels = named[own]
    place = (np.cumsum(own) - 1).take(last)
    shared = np.bincount(place, minlength=len(pixels)) > 1
    slot = np.full(len(index), len(pixels))
    slot[inside] = place
    crowded = np.flatnonzero(np.append(shared, False).take(slot))
    common = np.cumsum(shared) - 1
    cut = strips.index.size
    return Windows(
        long,
        spot,
        strips,
        patches,
        pixels,
        slot,
        _sight(frame, strips.index, strips.inside, slot[:cut], crowded[crowded < cut], common),
        _sight(frame, patches.index, patches.inside, slot[cut:], crowded[crowded >= cut] - cut, common),
        int(np.count_nonzero(shared)),
    )


def _placed(
    pinhole: Pinhole, shutter: Shutter, scene: Scene, room: float
) -> tuple[IntArray, IntArray, Strips, Patches]:
    """Return which stars have strips (a,), and patches (b,), within `room` px of their paths, and those."""
    times = window_times(pinhole, scene.motion, shutter, scene.stars)
    fast, slow = _divided(pinhole, scene, times)
    whole = path_lengths(pinhole, scene.motion, scene.stars) >= _SPOT_WIDTHS * scene.width
    long = np.flatnonzero(whole & (fast[:, 1] > fast[:, 0]))
    spot = np.flatnonzero(~(whole & (fast[:, 1] > fast[:, 0])) | (slow[:, 1] > slow[:, 0]))
    strips = cut_strips(pinhole, scene.motion, scene.stars[long], fast[long], room, fast[long] == times[long])
    # The part of a path that a patch serves: the slow one of a streak, all of a spot.
    part = np.where(np.isin(spot, long)[:, None], slow[spot], times[spot])
    patches = _patches_about(pinhole, scene, spot, part, room)
    strips = _beside_patches(strips, long, patches, spot)
    return long, spot, strips, patches


def _divided(pinhole: Pinhole, scene: Scene, times: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return when (n, 2) each star is fast enough for strips within `times` (n, 2), and when it is slow.

    The slow part is at the end towards which the rate falls; what there is none of has no duration.
    """
    motion = scene.motion
    if motion.constant or not motion.whole.any():
        return times, np.zeros_like(times)
    time = np.linspace(times.min(), times.max(), _SAMPLES)
    pace, change = motion.pace(time), np.abs(motion.pace(time, 1)).max()
    steady = Motion.steady(motion.whole)
    velocity = paths(pinhole, steady, scene.stars, np.zeros(len(times))).velocity
    speed = np.maximum(np.hypot(velocity[:, 0], velocity[:, 1]), _SLOWEST)
    # Slow wherever the speed may change by too much of itself over a width.
    slow = pace < np.sqrt(change * scene.width / (_STEADY * speed))[:, None]
    fast, rest = times.copy(), times.copy()
    if pace[0] < pace[-1]:
        until = np.where(slow.any(axis=1), time[_SAMPLES - 1 - slow[:, ::-1].argmax(axis=1)], -np.inf)
        fast[:, 0] = rest[:, 1] = np.clip(until, times[:, 0], times[:, 1])
    else:
        since = np.where(slow.any(axis=1), time[slow.argmax(axis=1)], np.inf)
        fast[:, 1] = rest[:, 0] = np.clip(since, times[:, 0], times[:, 1])
    way = speed * (motion.progress(fast[:, 1]) - motion.progress(fast[:, 0]))
    fast[way < _LEAST_FAST * scene.width] = 0.0
    return fast, rest


def _patches_about(pinhole: Pinhole, scene: Scene, spot: IntArray, part: FloatArray, room: float) -> Patches:
    """Return patches with all pixels within `room` px of stars `spot` (n,) at times `part` (n, 2)."""
    sampled = part[:, :1] + np.diff(part) * np.linspace(0.0, 1.0, _INSTANTS)
    stars = np.repeat(scene.stars[spot], _INSTANTS, axis=0)
    there = positions(pinhole, scene.motion, stars, sampled.reshape(-1)).reshape(-1, _INSTANTS, 2)
    low, high = there.min(axis=1), there.max(axis=1)
    half = int(np.ceil(room + 0.5 * float(np.max(high - low, initial=0.0))))
    return cut_patches(pinhole, 0.5 * (low + high), half)


def _beside_patches(strips: Strips, long: IntArray, patches: Patches, spot: IntArray) -> Strips:
    """Return the strips without the pixels that a patch of the same star has."""
    both = np.isin(long, spot)
    if not both.any():
        return strips
    patch = np.searchsorted(spot, long)[strips.star]
    split = np.flatnonzero(both[strips.star])
    patch = patch[split]
    along = np.arange(strips.index.shape[2])[:, None] * strips.step[split, None, None]
    pixel = strips.corner[split, :, None] + along
    theirs = np.stack([patches.column[patch], patches.row[patch]], axis=-1)
    low, high = theirs[:, None, None, 0], theirs[:, None, None, -1]
    inside = strips.inside.copy()
    inside[split] &= ~np.all((pixel >= low) & (pixel <= high), axis=-1)
    return replace(strips, inside=inside)


def _sight(
    frame: ExposedFrame,
    index: IntArray,
    inside: BoolArray,
    slot: IntArray,
    crowded: IntArray,
    common: IntArray,
) -> Sight:
    signal = frame.signal.take(index)
    return Sight(
        slot.reshape(index.shape),
        inside & ~frame.bad.take(index),
        signal,
        frame.floor.take(index),
        # The background's level is what a pixel's counts exceed its signal by.
        np.float32(frame.top) - frame.counts.take(index) + signal,
        frame.gain,
        crowded,
        common.take(slot.take(crowded)),
    )


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
    spots, change = streak_model.derivatives(
        pinhole, scene.motion, shutter, spot, scene.sigma, windows.patches
    )
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


# Conjugate gradients stop at this part of the first step's squared norm: covariances are then as exact.
_CONVERGED = 1e-2


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """One step and the covariance.

    Attributes:
        shared: (SHARED,) step of the shared parameters; alone: (n, ALONE) of each star's own.
        eliminated: the equations that gave it, stars not sharing pixels.
    """

    shared: FloatArray
    alone: FloatArray
    eliminated: Eliminated

    @property
    def covariance(self) -> FloatArray:
        """The covariance (SHARED, SHARED) of the shared parameters."""
        kept = self.eliminated.kept
        out = np.zeros((SHARED, SHARED))
        out[kept[:, None], kept] = self.eliminated.inner
        return out

    @property
    def joint(self) -> FloatArray:
        """The covariance (n, SHARED + ALONE, SHARED + ALONE) of the shared parameters and each star's."""
        kept, gain, inner = self.eliminated.kept, self.eliminated.gain, self.eliminated.inner
        joint = np.zeros((len(gain), SHARED + ALONE, SHARED + ALONE))
        joint[:, :SHARED, :SHARED] = self.covariance
        crossed = -inner @ gain
        joint[:, kept, SHARED:] = crossed
        joint[:, SHARED:, kept] = crossed.swapaxes(1, 2)
        joint[:, SHARED:, SHARED:] = self.eliminated.own + gain.swapaxes(1, 2) @ inner @ gain
        return joint


@dataclass(frozen=True, slots=True, eq=False)
class Eliminated:
    """The normal equations with every star's own numbers eliminated, stars not sharing pixels.

    Attributes:
        kept: (k,) which shared parameters are fitted.
        own: (n, ALONE, ALONE) inverse of each star's block; gain: (n, k, ALONE).
        inner: (k, k) covariance of the shared parameters.
    """

    kept: IntArray
    own: FloatArray
    gain: FloatArray
    inner: FloatArray

    def solve(self, shared: FloatArray, alone: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the solution for a right-hand side (SHARED,), (n, ALONE)."""
        step = self.inner @ (shared[self.kept] - np.einsum("nij,nj->i", self.gain, alone))
        out = np.zeros(SHARED)
        out[self.kept] = step
        return out, np.einsum("nij,nj->ni", self.own, alone) - step @ self.gain


def eliminate(evaluation: Evaluation, free: BoolArray) -> Eliminated | None:
    """Return the eliminated equations, None when the shared parameters are not determined.

    `free` (SHARED,): which shared parameters are fitted.
    """
    alone = evaluation.information[:, SHARED:, SHARED:].copy()
    diagonal = np.einsum("nii->ni", alone)
    diagonal += PRIOR
    # Light of a star outside has no information: a unit keeps the block regular, its gradient is zero.
    diagonal += np.where(diagonal > 0.0, 0.0, 1.0)
    own = _scaled_inverse(alone)
    kept = np.flatnonzero(free)
    cross = evaluation.information[:, kept, SHARED:]
    gain = cross @ own
    normal = (evaluation.information[:, kept[:, None], kept] - gain @ cross.swapaxes(1, 2)).sum(axis=0)
    scale = np.sqrt(np.diag(normal).clip(min=0.0))
    if not np.all(np.isfinite(normal)) or not np.all(scale > 0.0):
        return None
    scaled = normal / np.outer(scale, scale)
    least, most = np.linalg.eigvalsh(scaled)[[0, -1]]
    if most > 1e10 * least:
        return None
    return Eliminated(kept, own, gain, np.linalg.inv(scaled) / np.outer(scale, scale))


def solve(evaluation: Evaluation, scene: Scene, free: BoolArray, rounds: int) -> Solution | None:
    """Return the step to the maximum, None when the shared parameters are not determined.

    At most `rounds` conjugate gradients account for the pixels that stars share; 0 neglects them.
    """
    eliminated = eliminate(evaluation, free)
    if eliminated is None:
        return None
    alone = evaluation.gradient[:, SHARED:] - PRIOR * _from_prior(scene)
    shared = np.where(free, evaluation.gradient[:, :SHARED].sum(axis=0), 0.0)
    step = _conjugate(evaluation, eliminated, free, (shared, alone), rounds)
    return Solution(*step, eliminated)


def _from_prior(scene: Scene) -> FloatArray:
    """Return how far each star's numbers are from where the prior puts them: only the sky has a place."""
    return np.stack([np.zeros_like(scene.sky)] * 3 + [scene.sky], axis=-1)


def turn_covariance(evaluation: Evaluation, free: BoolArray, rounds: int) -> FloatArray | None:
    """Return the covariance (3, 3) of the turn, shared pixels accounted for; None without one."""
    eliminated = eliminate(evaluation, free)
    if eliminated is None:
        return None
    alone = np.zeros((len(evaluation.chi2), ALONE))
    out = np.empty((3, 3))
    for k in range(3):
        # Scaled to a unit of the solution, so that one tolerance serves all.
        unit = np.zeros(SHARED)
        unit[k] = 1.0 / np.sqrt(eliminated.inner[k].max())
        solved, _ = _conjugate(evaluation, eliminated, free, (unit, alone), rounds)
        out[k] = solved[:3] / unit[k]
    return 0.5 * (out + out.T)


def _conjugate(
    evaluation: Evaluation,
    eliminated: Eliminated,
    free: BoolArray,
    right: tuple[FloatArray, FloatArray],
    rounds: int,
) -> tuple[FloatArray, FloatArray]:
    """Return the solution of the normal equations of all stars together for `right`.

    Conjugate gradients, preconditioned by the equations of stars that share no pixels: few rounds do.
    """
    x = eliminated.solve(*right)
    if rounds == 0:
        return x

    def product(v: tuple[FloatArray, FloatArray]) -> tuple[FloatArray, FloatArray]:
        shared, alone = apply_information(evaluation, *v)
        return np.where(free, shared, 0.0), alone

    def dot(a: tuple[FloatArray, FloatArray], b: tuple[FloatArray, FloatArray]) -> float:
        return float(a[0] @ b[0] + np.sum(a[1] * b[1]))

    image = product(x)
    residual = right[0] - image[0], right[1] - image[1]
    z = eliminated.solve(*residual)
    direction, size = z, dot(residual, z)
    first = abs(dot(right, x))
    for _ in range(rounds):
        if size <= _CONVERGED * first:
            break
        image = product(direction)
        length = size / dot(direction, image)
        x = x[0] + length * direction[0], x[1] + length * direction[1]
        residual = residual[0] - length * image[0], residual[1] - length * image[1]
        z = eliminated.solve(*residual)
        size, before = dot(residual, z), size
        direction = z[0] + size / before * direction[0], z[1] + size / before * direction[1]
    return x


def _scaled_inverse(matrices: FloatArray) -> FloatArray:
    scale = np.sqrt(np.einsum("nii->ni", matrices))
    outer = scale[:, :, None] * scale[:, None, :]
    scaled = matrices / outer
    scaled[:, range(ALONE), range(ALONE)] += 1e-9
    return np.asarray(np.linalg.inv(scaled) / outer)


def moved(scene: Scene, solution: Solution, pinhole: Pinhole, longest: float) -> tuple[Scene, float]:
    """Return the scene after a step that moves no end of a streak by more than `longest` px.

    Also returned is by how many px the shared parameters' step would have moved an end, or the width.
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
    turn, growth = scene.motion.turn + shared[:3], scene.motion.growth + shared[3:6]
    after = replace(
        scene,
        motion=replace(scene.motion, turn=turn, growth=growth),
        width=scene.width + float(shared[6]),
        stars=scene.stars + step[:, :2],
        light=np.maximum(scene.light + step[:, 2], 0.3 * scene.light),
        sky=scene.sky + step[:, 3],
    )
    return after, max(ends, abs(float(solution.shared[6])))


# The error of a median over that of a mean.
_MEDIAN = 1.25


# A star with less than this part of the best one's information is ignored.
_NOTHING = 1e-9
# Of what a star knows a direction that has less than this part of its best known one's is ignored.
_KNOWN = 1e-4
# Stars of unequal weight count as fewer equal ones; fewer than this have no spread.
_LEAST_EFFECTIVE = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class OwnEstimates:
    """Each star's own estimate of the shared parameters: change (n, k) along k directions; deviation."""

    change: FloatArray
    deviation: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class OwnEquations:
    """What each star by itself says of the free shared parameters, its own numbers eliminated.

    Attributes:
        kept: (k,) which shared parameters are free.
        information: (n, k, k); score: (n, k).
    """

    kept: IntArray
    information: FloatArray
    score: FloatArray


def own_estimates(evaluation: Evaluation, scene: Scene, free: BoolArray) -> OwnEstimates | None:
    """Return each star's own estimate of the turn and the width; None when they are not determined."""
    alone = own_equations(evaluation, free)
    return None if alone is None else estimates_of(alone, scene)


def estimates_of(alone: OwnEquations, scene: Scene) -> OwnEstimates:
    """Return each star's own estimate of the turn, along it and across it twice, and of the width.

    All are steps from the scene's; the units are rad, and px for the width.
    """
    axis = scene.motion.whole / max(float(np.linalg.norm(scene.motion.whole)), 1e-12)
    across = np.linalg.svd(axis[None])[2][1:]
    directions = np.zeros((4, SHARED))
    directions[0, :3], directions[1:3, :3], directions[3, 6] = axis, across, 1.0
    directions = directions[:, alone.kept]
    information = np.einsum("ai,nij,aj->na", directions, alone.information, directions)
    informed = information > _NOTHING * information.max(axis=0)
    information = np.where(informed, information, _NOTHING * information.max(axis=0) + 1e-300)
    return OwnEstimates(
        np.where(informed, alone.score @ directions.T / information, 0.0), 1.0 / np.sqrt(information)
    )


def agreed_step(evaluation: Evaluation, step: FloatArray) -> tuple[float, int]:
    """Return by how much, in sigmas squared, the stars together ask for `step` (SHARED,), and how many ask.

    Each star asks for its own part of the step. The spread of what they ask is the measure, where it is more
    than the noise: one star in whose light another's is hidden moves no agreement.
    """
    alone = own_equations(evaluation, step != 0.0)
    if alone is None:
        return 0.0, 0
    part = step[alone.kept]
    asked, due = alone.score @ part, np.einsum("i,nij,j->n", part, alone.information, part)
    count = int(np.count_nonzero(due > 0.0))
    spread = float(np.sum((asked - due) ** 2)) * count / max(count - 1, 1)
    total = float(due.sum())
    return total**2 / max(total, spread, 1e-300), count


def own_equations(evaluation: Evaluation, free: BoolArray) -> OwnEquations | None:
    """Return what each star says of the `free` shared parameters; None when they are not determined."""
    eliminated = eliminate(evaluation, free)
    if eliminated is None:
        return None
    kept, gain = eliminated.kept, eliminated.gain
    cross = evaluation.information[:, SHARED:][:, :, kept]
    schur = evaluation.information[:, kept[:, None], kept] - gain @ cross
    score = evaluation.gradient[:, kept] - np.einsum("nij,nj->ni", gain, evaluation.gradient[:, SHARED:])
    return OwnEquations(kept, schur, score)


def agreeing(estimates: OwnEstimates, floors: FloatArray, sigmas: float) -> BoolArray:
    """Return which stars (n,) agree with most: within `sigmas` of the weighted median in all directions.

    A star in whose light another's is hidden is wider or longer than the rest; `floors` (k,) are added to the
    deviations for what the model does not describe.
    """
    agree = np.ones(len(estimates.change), dtype=np.bool_)
    for change, deviation, floor in zip(estimates.change.T, estimates.deviation.T, floors, strict=True):
        spread = np.hypot(deviation, floor)
        order = np.argsort(change)
        weight = np.cumsum(1.0 / spread[order])
        middle = change[order][np.searchsorted(weight, 0.5 * weight[-1])]
        # The median of few is itself uncertain: a star that knows more than all others is not to yield to it.
        error = _MEDIAN * np.sqrt(len(spread)) / np.sum(1.0 / spread)
        agree &= np.abs(change - middle) <= sigmas * np.hypot(spread, error)
    return agree


def disagreement(estimates: OwnEstimates, which: BoolArray) -> float:
    """Return the chi-square per degree of freedom between stars `which` (n,): 1 when all obey the model."""
    change, weight = estimates.change[which], estimates.deviation[which] ** -2
    if len(change) < 3:
        return 1.0
    total = weight.sum(axis=0)
    mean = np.sum(weight * change, axis=0) / total
    # Each counts by its weight: the spread of a few bright ones is not lost among many faint.
    effective = np.maximum(total**2 / np.sum(weight**2, axis=0), _LEAST_EFFECTIVE)
    found = np.sum(weight**2 * (change - mean) ** 2, axis=0) / total * effective / (effective - 1.0)
    # The largest of several is larger than one, by about a standard deviation.
    return float(np.max(found / (1.0 + np.sqrt(2.0 / (effective - 1.0)))))


def contradiction(alone: OwnEquations) -> float:
    """Return by how much all that the stars say contradicts itself: chi-square per degree of freedom.

    Unlike `disagreement` it counts every direction that a star knows of, each star by its own noise.
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
