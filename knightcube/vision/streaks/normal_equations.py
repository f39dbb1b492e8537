"""Selection of the fitted pixels, and the normal equations of a scene (Fisher scoring).

Long streaks are fitted on strips of pixels along their paths, and stars with short or slow paths (spots) on
square patches of pixels. The flux per px of a streak is inversely proportional to the speed of the star. The
model of a streak on a strip expands the flux per px to first order around each block of pixels. This
expansion does not hold near zero speed. If the rate increases from zero or decreases to zero, a square patch
of pixels covers the slow part of each streak.

The weight of a pixel is the inverse of the variance that the model predicts. The iteration therefore
converges to the maximum likelihood for Poisson noise. The residual of a pixel is its value minus the modelled
flux of all stars, so that streaks may cross. The four parameters of each star are eliminated from the
equations, which leaves the shared parameters (rate, acceleration, width). Stars that share pixels are
coupled, and a few conjugate-gradient iterations account for the coupling.

Each star also provides its own estimate of the shared parameters. A blend of two stars is wider or longer
than a single star, and flux of a neighbouring star shifts the ends of a streak. Blended stars, whose
estimates disagree with the majority, no longer affect the motion.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from knightcube.astro.arrays import BoolArray, Float32Array, FloatArray, IntArray
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks import streak_model
from knightcube.vision.streaks.frame import MEDIAN_ERROR, ReducedFrame
from knightcube.vision.streaks.geometry import (
    CameraMotion,
    Shutter,
    StreakScene,
    exposure_bounds,
    path_lengths,
    paths,
    positions,
    sensitivities,
)
from knightcube.vision.streaks.streak_model import STEEPEST, Patches, Strips, cut_patches, cut_strips

# Path length, in point-spread widths, below which a star is fitted on a square patch of pixels.
_SPOT_WIDTHS = 8.0
# Margin below saturation, in standard deviations of the modelled counts, within which a pixel is excluded.
# The modelled counts are used, because a selection by the measured counts would be biased by their noise.
_MARGIN = 3.0
# Number of instants at which the position of a star on its path is evaluated.
_INSTANTS = 9
# Residual, relative to the modelled counts, up to which a pixel is never excluded as an outlier.
_UNRESOLVED = 0.1
# Largest relative speed change over one point-spread width for which a star is fitted on a pixel strip.
_STEADY = 0.05
# Minimum length (point-spread widths) of the fast part of a path that is fitted on a pixel strip.
_LEAST_FAST = 4.0
# Lower limit (px per exposure) of a star's speed in denominators.
_SLOWEST = 1e-3
# Number of instants at which the rate is evaluated to find the slow part of a star's path.
_SAMPLES = 129


@dataclass(frozen=True, slots=True, eq=False)
class BlockPixels:
    """The frame's values at the fitted pixels, which are grouped in b blocks along the first array axis.

    Attributes:
        slot: index of each pixel in the list of all fitted pixels, in which a pixel that two stars share
            occurs only once. For a pixel outside the frame, `slot` is the number of fitted pixels.
        inside: mask of the fitted pixels of each block.
        signal: counts of each pixel above the background.
        floor: noise variance of each pixel without a star, counts^2.
        ceiling: counts above the background from which each pixel is saturated.
        gain: gain of the camera, electrons per count.
        crowded: flat indices (e,), in the arrays of this class, of the e pixels that several stars share.
        common: index of each fitted pixel in the list of the pixels that several stars share.
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
        """Return weights and residuals of the pixels for the modelled counts `total` of all fitted pixels.

        The weight is the inverse variance, or 0 for an excluded pixel. Pixels whose residuals exceed `clip`
        standard deviations plus a tenth of the modelled counts are excluded; `clip` 0 excludes none.
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
class FitWindows:
    """The fitted pixels: strips of pixels along long streaks, and square patches of pixels around spots.

    Attributes:
        long: indices of the stars whose long streak is fitted on a strip of pixels (a,). If part of the
            streak is slow, the star also has a square patch of pixels for this part.
        spot: indices of the stars that are fitted on a square patch of pixels (b,).
        strips: pixels of the strips along long streaks. The star with index i in `strips` has the index
            `long[i]` in the scene.
        patches: pixels of the square patches around spots. The patch with index i belongs to the star with
            the index `spot[i]` in the scene.
        pixels: flat indices in the frame of all m fitted pixels (m,), each given once.
        slot: for each pixel of all strips and patches, its index in the list `pixels`, as a flat array.
        on_strips: values of the frame on the strips of pixels along long streaks.
        on_patches: values of the frame on the square patches of pixels around spots.
        shared: number of pixels that belong to more than one star.
    """

    long: IntArray
    spot: IntArray
    strips: Strips
    patches: Patches
    pixels: IntArray
    slot: IntArray
    on_strips: BlockPixels
    on_patches: BlockPixels
    shared: int

    def total(self, on_strips: Float32Array, on_patches: FloatArray) -> Float32Array:
        """Return the summed counts (m + 1,) of all stars on the m fitted pixels, from each star's own counts.

        The last element is the sum of the counts on pixels outside the frame.
        """
        light = np.concatenate([on_strips.reshape(-1), on_patches.reshape(-1).astype(np.float32)])
        return np.bincount(self.slot, light, len(self.pixels) + 1).astype(np.float32)

    def only(self, on_strips: BoolArray, on_patches: BoolArray) -> FitWindows:
        """Return the fit windows reduced to the pixels selected by the masks `on_strips` and `on_patches`."""
        return replace(
            self,
            on_strips=replace(self.on_strips, inside=on_strips),
            on_patches=replace(self.on_patches, inside=on_patches),
        )


def window_areas(pinhole: Pinhole, scene: StreakScene, reach: float) -> FloatArray:
    """Return the approximate number of pixels (n,) within `reach` point-spread widths of each star's path.

    For all stars, the strip of pixels is assumed to have the width of the widest strip, whose path is the
    most oblique to rows and columns.
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
    frame: ReducedFrame, pinhole: Pinhole, shutter: Shutter, scene: StreakScene, reach: float
) -> FitWindows:
    """Return fit windows with all pixels of `frame` within `reach` point-spread widths of the paths."""
    long, spot, strips, patches = _strips_and_patches(pinhole, shutter, scene, reach * scene.width)
    index = np.concatenate([strips.index.reshape(-1), patches.index.reshape(-1)])
    inside = np.concatenate([strips.inside.reshape(-1), patches.inside.reshape(-1)])
    named = index[inside]
    # If a pixel occurs in several windows, `number` keeps the index of the last occurrence.
    order = np.arange(len(named), dtype=np.int32)
    number = np.empty(frame.signal.size, dtype=np.int32)
    number[named] = order
    last = number.take(named)
    own = last == order
    pixels = named[own]
    place = (np.cumsum(own) - 1).take(last)
    shared = np.bincount(place, minlength=len(pixels)) > 1
    slot = np.full(len(index), len(pixels))
    slot[inside] = place
    crowded = np.flatnonzero(np.append(shared, False).take(slot))
    common = np.cumsum(shared) - 1
    cut = strips.index.size
    return FitWindows(
        long,
        spot,
        strips,
        patches,
        pixels,
        slot,
        _block_pixels(frame, strips.index, strips.inside, slot[:cut], crowded[crowded < cut], common),
        _block_pixels(
            frame, patches.index, patches.inside, slot[cut:], crowded[crowded >= cut] - cut, common
        ),
        int(np.count_nonzero(shared)),
    )


def _strips_and_patches(
    pinhole: Pinhole, shutter: Shutter, scene: StreakScene, room: float
) -> tuple[IntArray, IntArray, Strips, Patches]:
    """Return the indices of stars with long streaks (a,) and of spots (b,), and the pixel strips and patches.

    The pixel strips and patches contain the pixels within `room` px of the paths.
    """
    times = exposure_bounds(pinhole, scene.motion, shutter, scene.stars)
    fast, slow = _divided(pinhole, scene, times)
    whole = path_lengths(pinhole, scene.motion, scene.stars) >= _SPOT_WIDTHS * scene.width
    long = np.flatnonzero(whole & (fast[:, 1] > fast[:, 0]))
    spot = np.flatnonzero(~(whole & (fast[:, 1] > fast[:, 0])) | (slow[:, 1] > slow[:, 0]))
    strips = cut_strips(pinhole, scene.motion, scene.stars[long], fast[long], room, fast[long] == times[long])
    # A square patch of pixels covers the slow part of a streak, or the complete path of a spot.
    part = np.where(np.isin(spot, long)[:, None], slow[spot], times[spot])
    sampled = part[:, :1] + np.diff(part) * np.linspace(0.0, 1.0, _INSTANTS)
    stars = np.repeat(scene.stars[spot], _INSTANTS, axis=0)
    there = positions(pinhole, scene.motion, stars, sampled.reshape(-1)).reshape(-1, _INSTANTS, 2)
    low, high = there.min(axis=1), there.max(axis=1)
    half = int(np.ceil(room + 0.5 * float(np.max(high - low, initial=0.0))))
    patches = cut_patches(pinhole, 0.5 * (low + high), half)
    strips = _without_patches(strips, long, patches, spot)
    return long, spot, strips, patches


def _divided(pinhole: Pinhole, scene: StreakScene, times: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return start and end times (n, 2) of the fast part of each star's path, and of its slow part.

    The slow part of a path is at the streak end at which the rate is smaller. If a path has no fast part or
    no slow part, the start and end times of the missing part are equal.
    """
    motion = scene.motion
    if motion.constant or not motion.rotation.any():
        return times, np.zeros_like(times)
    time = np.linspace(times.min(), times.max(), _SAMPLES)
    pace, change = motion.relative_rate(time), np.abs(motion.relative_rate(time, 1)).max()
    steady = CameraMotion.steady(motion.rotation)
    velocity = paths(pinhole, steady, scene.stars, np.zeros(len(times))).velocity
    speed = np.maximum(np.hypot(velocity[:, 0], velocity[:, 1]), _SLOWEST)
    # A star counts as slow while its speed may change too much over one point-spread width.
    slow = pace < np.sqrt(change * scene.width / (_STEADY * speed))[:, None]
    fast, rest = times.copy(), times.copy()
    if pace[0] < pace[-1]:
        until = np.where(slow.any(axis=1), time[_SAMPLES - 1 - slow[:, ::-1].argmax(axis=1)], -np.inf)
        divided: FloatArray = np.clip(until, times[:, 0], times[:, 1])
        fast[:, 0] = rest[:, 1] = divided
    else:
        since = np.where(slow.any(axis=1), time[slow.argmax(axis=1)], np.inf)
        divided = np.clip(since, times[:, 0], times[:, 1])
        fast[:, 1] = rest[:, 0] = divided
    way = speed * (motion.progress(fast[:, 1]) - motion.progress(fast[:, 0]))
    fast[way < _LEAST_FAST * scene.width] = 0.0
    return fast, rest


def _without_patches(strips: Strips, long: IntArray, patches: Patches, spot: IntArray) -> Strips:
    """Return the pixels along each star's path, without pixels of the star's own square patch."""
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


def _block_pixels(
    frame: ReducedFrame,
    index: IntArray,
    inside: BoolArray,
    slot: IntArray,
    crowded: IntArray,
    common: IntArray,
) -> BlockPixels:
    """Return the values of the frame on blocks of pixels, given by the pixels' flat indices `index`."""
    signal = frame.signal.take(index)
    return BlockPixels(
        slot.reshape(index.shape),
        inside & ~frame.bad.take(index),
        signal,
        frame.floor.take(index),
        # The background is the raw counts minus the signal, and is subtracted from the saturation level.
        np.float32(frame.top) - frame.counts.take(index) + signal,
        frame.gain,
        crowded,
        common.take(slot.take(crowded)),
    )


SHARED = 7
"""Number of parameters that all stars share: rate (3), acceleration (3) and point-spread width (1)."""
ALONE = 4
"""Number of parameters of a single star: x, y, flux and sky level."""

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
        information: Fisher information on shared and own parameters from the pixels of each star, (n, SHARED
            + ALONE, SHARED + ALONE).
        gradient: gradient of the log-likelihood of each star's pixels by shared and own parameters, (n,
            SHARED + ALONE).
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
    kept: tuple[BoolArray, BoolArray]


@dataclass(frozen=True, slots=True, eq=False)
class SharedPixels:
    """Derivatives of the modelled counts at the e pixels that several stars share, sorted by block of pixels.

    Attributes:
        star: index of the star of each block of pixels (b,).
        matrix: coefficients that combine i images into the derivatives by each parameter, (b, i, SHARED +
            ALONE) for b blocks.
        block: index of the block to which each of the e shared pixels belongs (e,).
        first: index of the first shared pixel of each block (b,).
        slot: index of each pixel in the list of all pixels that several stars share (e,).
        weight: inverse variance of the counts of each of the e shared pixels (e,).
        images: values of the i images that are combined into the derivatives, at the e shared pixels (i, e).
    """

    star: IntArray
    matrix: FloatArray
    block: IntArray
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
        matrix = _block_coefficients(pinhole, shutter, scene, windows, growing)
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


def light_of(pinhole: Pinhole, shutter: Shutter, scene: StreakScene, windows: FitWindows) -> Float32Array:
    """Return the modelled counts (m,) of all stars of `scene` on the m fitted pixels, without sky level."""
    images, spots, _ = model_images(pinhole, shutter, scene, windows)
    streaks = images[:, 0] * scene.light[windows.long[windows.strips.star], None, None].astype(np.float32)
    return windows.total(streaks, spots * scene.light[windows.spot, None, None])[:-1]


def model_images(
    pinhole: Pinhole, shutter: Shutter, scene: StreakScene, windows: FitWindows
) -> tuple[Float32Array, FloatArray, FloatArray]:
    """Return the images whose combinations model long streaks, and the images of spots with derivatives.

    The last image of each long streak is left uninitialised, as room for the residual.
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
    """Return coefficients (b, IMAGES, SHARED + ALONE) that combine images into derivatives by parameter."""
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
    weight: Float32Array,
    images: Float32Array,
    matrix: FloatArray,
) -> None:
    """Add the contributions of blocks of pixels, in the order of their stars, to the normal equations.

    The last of the `images` of each block of pixels is the residual. Products of the residual with the other
    images give the gradient, and the squared residual gives chi-square.
    """
    blocks, count = images.shape[:2]
    flat = images.reshape(blocks, count, -1)
    weight = weight.reshape(blocks, -1)
    gram = np.empty((blocks, count, count))
    for begin in range(0, blocks, _AT_ONCE):
        part = slice(begin, begin + _AT_ONCE)
        gram[part] = (flat[part] * weight[part, None]) @ flat[part].swapaxes(1, 2)
    transposed = matrix.swapaxes(1, 2)
    first = np.flatnonzero(np.diff(star, prepend=-1))
    owner = star[first]
    out.information[owner] += np.add.reduceat(transposed @ gram[:, :-1, :-1] @ matrix, first)
    out.gradient[owner] += np.add.reduceat((transposed @ gram[:, :-1, -1:])[..., 0], first)
    out.chi2[owner] += np.add.reduceat(gram[:, -1, -1], first)
    out.pixels[owner] += np.add.reduceat((weight > 0.0).sum(axis=1), first)
    if len(view.crowded):
        out.crowds.append(_shared_pixels(star, view, weight, flat, matrix))


def _shared_pixels(
    star: IntArray, view: BlockPixels, weight: Float32Array, images: Float32Array, matrix: FloatArray
) -> SharedPixels:
    """Return the derivatives of the modelled counts on pixels that several stars share."""
    block, place = np.divmod(view.crowded, images.shape[2])
    first = np.flatnonzero(np.diff(block, prepend=-1))
    held = block[first]
    _, count, size = images.shape
    place += block * (count * size)
    drawn = np.empty((count - 1, len(place)), dtype=np.float32)
    for image in drawn:
        image[:] = images.reshape(-1).take(place)
        place += size
    return SharedPixels(
        star[held],
        matrix[held],
        np.repeat(np.arange(len(held)), np.diff(first, append=len(block))),
        first,
        view.common,
        weight.reshape(-1)[view.crowded],
        drawn,
    )


def _spot_images(
    scene: StreakScene, windows: FitWindows, spots: FloatArray, change: FloatArray
) -> Float32Array:
    """Return the derivatives (n, SHARED + ALONE + 1, p, p) of n spot images of p x p pixels by parameter.

    The last element along the second axis is left uninitialised, as room for the residual.
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


def apply_information(
    evaluation: Evaluation, shared: FloatArray, alone: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the product of the information matrix of the whole scene with a vector (`shared`, `alone`).

    `shared` (SHARED,) holds the shared parameters, and `alone` (n, ALONE) the parameters of each star. The
    product includes the coupling of stars by shared pixels.
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


# Squared residual norm, relative to the squared norm of the first step, at which conjugate gradients stop.
_CONVERGED = 1e-2


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """One Gauss-Newton step of the fit, with the covariance of the parameters.

    Attributes:
        shared: step of the parameters that all stars share (SHARED,).
        alone: step of the own parameters of each star (n, ALONE).
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
        own: inverse of the block of the information matrix for each star's own parameters (n, ALONE, ALONE).
        gain: product of `own` and the block of the information matrix that couples k shared and each star's
            own parameters (n, k, ALONE).
        inner: covariance of the k fitted shared parameters (k, k).
    """

    kept: IntArray
    own: FloatArray
    gain: FloatArray
    inner: FloatArray

    def solve(self, shared: FloatArray, alone: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the solution of the equations for the right-hand sides `shared` and `alone` (n, ALONE)."""
        step = self.inner @ (shared[self.kept] - np.einsum("nij,nj->i", self.gain, alone))
        out = np.zeros(SHARED)
        out[self.kept] = step
        return out, np.einsum("nij,nj->ni", self.own, alone) - step @ self.gain


def eliminate(evaluation: Evaluation, free: BoolArray) -> EliminatedEquations | None:
    """Return the equations for the shared parameters alone, or None if they are singular.

    The mask `free` (SHARED,) selects those shared parameters that are fitted.
    """
    alone = evaluation.information[:, SHARED:, SHARED:].copy()
    diagonal = np.einsum("nii->ni", alone)
    diagonal += PRIOR
    # For a star outside the frame, a diagonal element of 1 for the flux keeps the star's block invertible.
    diagonal += np.where(diagonal > 0.0, 0.0, 1.0)
    root = np.sqrt(np.einsum("nii->ni", alone))
    outer = root[:, :, None] * root[:, None, :]
    unit = alone / outer
    unit[:, range(ALONE), range(ALONE)] += 1e-9
    own = np.asarray(np.linalg.inv(unit) / outer)
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
    return EliminatedEquations(kept, own, gain, np.linalg.inv(scaled) / np.outer(scale, scale))


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
    step = _conjugate(evaluation, eliminated, free, (shared, alone), rounds)
    return Solution(*step, eliminated)


def rate_covariance(evaluation: Evaluation, free: BoolArray, rounds: int) -> FloatArray | None:
    """Return the covariance (3, 3) of the rate with the effect of shared pixels, or None if singular."""
    eliminated = eliminate(evaluation, free)
    if eliminated is None:
        return None
    alone = np.zeros((len(evaluation.chi2), ALONE))
    out = np.empty((3, 3))
    for k in range(3):
        # The equations are scaled so that the solution is of order one and one tolerance suits all frames.
        unit = np.zeros(SHARED)
        unit[k] = 1.0 / np.sqrt(eliminated.inner[k].max())
        solved, _ = _conjugate(evaluation, eliminated, free, (unit, alone), rounds)
        out[k] = solved[:3] / unit[k]
    return 0.5 * (out + out.T)


def _conjugate(
    evaluation: Evaluation,
    eliminated: EliminatedEquations,
    free: BoolArray,
    right: tuple[FloatArray, FloatArray],
    rounds: int,
) -> tuple[FloatArray, FloatArray]:
    """Return the solution of the coupled normal equations for the right-hand side `right`.

    The equations without coupling of stars are the preconditioner of the conjugate gradients, so that few
    iterations suffice.
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


def stepped(
    scene: StreakScene, solution: Solution, pinhole: Pinhole, longest: float
) -> tuple[StreakScene, float]:
    """Return the scene after a step of the fit that moves no streak end by more than `longest` px.

    The second value is the largest displacement (px) of a streak end, or change of the point-spread width, by
    the full step.
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
# Smallest eigenvalue of a star's information matrix that is used, relative to the largest eigenvalue.
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
        score: gradient of each star's log-likelihood by the k fitted parameters (n, k).
    """

    kept: IntArray
    information: FloatArray
    score: FloatArray


def star_estimates(evaluation: Evaluation, scene: StreakScene, free: BoolArray) -> StarEstimates | None:
    """Return each star's estimate of rate and point-spread width, or None if the equations are singular."""
    alone = star_equations(evaluation, free)
    return None if alone is None else estimates_of(alone, scene)


def estimates_of(alone: StarEquations, scene: StreakScene) -> StarEstimates:
    """Return each star's estimate of three rate components and of the point-spread width.

    The rate components are along the rotation axis and two normals. All estimates are changes relative to the
    scene, in rad per exposure for the rate and in px for the width.
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

    If the estimates of the stars scatter more than their noise, the significance is computed from the
    scatter. A single blended star can therefore not make a step significant.
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
        # A star more accurate than all others is not rejected, because the median's uncertainty is included.
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
    # Squared weights keep many faint stars from hiding the scatter of a few bright stars.
    effective = np.maximum(total**2 / np.sum(weight**2, axis=0), _LEAST_EFFECTIVE)
    found = np.sum(weight**2 * (change - mean) ** 2, axis=0) / total * effective / (effective - 1.0)
    # Without excess scatter, the largest of several reduced chi-squares still exceeds 1 by about its sigma.
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
