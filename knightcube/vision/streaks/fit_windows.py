"""Selection of the fitted pixels: strips of pixels along long streaks, and square patches around spots.

Long streaks are fitted on strips of pixels along their paths, and stars with short or slow paths (spots) on
square patches of pixels. The model of a streak on a strip expands the flux per px to first order around each
block of pixels. The first-order expansion of the flux is not valid if the speed is nearly zero. If the rate
increases from zero or decreases to zero, a square patch of pixels covers the slow part of each streak.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from knightcube.astro.arrays import BoolArray, Float32Array, FloatArray, Image, IntArray
from knightcube.compiled import compiled_form_of
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks.frame import ReducedFrame
from knightcube.vision.streaks.geometry import (
    CameraMotion,
    Shutter,
    StreakScene,
    exposure_bounds,
    path_lengths,
    paths,
    positions,
)
from knightcube.vision.streaks.path_pixels import STEEPEST, Patches, Strips, cut_patches, cut_strips

# Path length (point-spread widths) below which a star is fitted on a square patch of pixels.
_SPOT_WIDTHS = 8.0
# Margin (standard deviations) between the modelled counts and saturation below which a pixel is excluded. The
# modelled counts are used, because a selection by the measured counts would be biased by their noise.
_MARGIN = 3.0
# Number of instants at which the position of a star on its path is evaluated.
_INSTANTS = 9
# Allowance for model errors in the exclusion of outliers, relative to the modelled counts of a pixel.
_UNRESOLVED = 0.1
# Largest relative change of a star's speed over one point-spread width on a strip of pixels.
_STEADY = 0.05
# Minimum length (point-spread widths) of the fast part of a path for a fit on a strip of pixels.
_LEAST_FAST = 4.0
# Lower limit (px per exposure) of a star's speed, which avoids divisions by zero.
_SLOWEST = 1e-3
# Number of instants at which the rate is evaluated to find the slow part of a star's path.
_SAMPLES = 129


@dataclass(frozen=True, slots=True, eq=False)
class BlockPixels:
    """The values of the frame at the fitted pixels.

    The first axis of the arrays is the index of a block of pixels.

    Attributes:
        slot: index of each pixel in the list of all fitted pixels, which contains a pixel shared by several
            stars only once. For a pixel outside the frame, `slot` is the number of fitted pixels.
        inside: mask of the fitted pixels of each block.
        signal: counts of each pixel above the background.
        floor: noise variance of each pixel without a star, counts^2.
        ceiling: smallest counts above the background at which each pixel is saturated.
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
        pixels = self.slot, self.inside, self.signal, self.floor, self.ceiling
        return residuals(total, *pixels, self.gain, clip)


def residuals(
    total: Float32Array,
    slot: IntArray,
    inside: BoolArray,
    signal: Float32Array,
    floor: Float32Array,
    ceiling: Float32Array,
    gain: float,
    clip: float,
) -> tuple[Float32Array, Float32Array]:
    """Return weights and residuals of pixels, see `BlockPixels.residual`."""
    model = total.take(slot)
    variance = np.maximum(model, np.float32(0.0))
    variance *= np.float32(1.0 / gain)
    variance += floor
    residual = signal - model
    deviation = np.sqrt(variance)
    good = inside & (model + np.float32(_MARGIN) * deviation < ceiling)
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
        long: indices of the stars whose long streak is fitted on a strip of pixels (a,). If the star moves
            slowly on part of its path, it also has a square patch of pixels for this part.
        spot: indices of the stars that are fitted on a square patch of pixels (b,).
        strips: pixels of the strips along long streaks. The star with index i in `strips` has the index
            `long[i]` in the scene.
        patches: pixels of the square patches around spots. The patch with index i belongs to the star with
            the index `spot[i]` in the scene.
        pixels: flat indices in the frame of all m fitted pixels (m,), each given once.
        slot: index in the list `pixels` of each pixel of all strips and patches, as a flat array.
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
        """Return the sum of the counts of all stars on each fitted pixel, as an array (m + 1,).

        The last element is the sum of the counts on pixels outside the frame.
        """
        return _summed(self.slot, on_strips.reshape(-1), on_patches.reshape(-1), len(self.pixels) + 1)

    def only(self, on_strips: BoolArray, on_patches: BoolArray) -> FitWindows:
        """Return the fit windows reduced to the pixels selected by the masks `on_strips` and `on_patches`."""
        return replace(
            self,
            on_strips=replace(self.on_strips, inside=on_strips),
            on_patches=replace(self.on_patches, inside=on_patches),
        )


def _summed_numpy(slot: IntArray, first: Float32Array, second: FloatArray, count: int) -> Float32Array:
    """Return the sum (count,), over the values of `first` and `second`, of all counts on each fitted pixel.

    The array `slot` contains the index of the pixel for each value of `first`, and then of `second`.
    """
    light = np.concatenate([first, second.astype(np.float32)])
    return np.bincount(slot, light, count).astype(np.float32)


@compiled_form_of(_summed_numpy)
def _summed(slot: IntArray, first: Float32Array, second: FloatArray, count: int) -> Float32Array:
    """See `_summed_numpy`."""
    total, begin = np.zeros(count), len(first)
    for p in range(begin):
        total[slot[p]] += first[p]
    for p in range(len(second)):
        total[slot[begin + p]] += second[p]
    return total.astype(np.float32)


def window_areas(pinhole: Pinhole, scene: StreakScene, reach: float) -> FloatArray:
    """Return the approximate number of pixels (n,) within `reach` point-spread widths of each star's path.

    The strips of all stars are assumed to be as wide as the strip along the path that is most oblique to rows
    and columns.
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
    pixels, slot, times = _numbered(index, inside, frame.signal.size)
    shared = times > 1
    crowded = np.flatnonzero(np.append(shared, False).take(slot))
    common = (np.cumsum(shared) - 1).take(slot.take(crowded))
    of_frame = frame.signal, frame.floor, frame.counts, frame.bad
    good, signal, floor, ceiling = _frame_values(index, inside, *of_frame, float(frame.top))
    cut, first = strips.index.size, int(np.searchsorted(crowded, strips.index.size))

    def view(shape: tuple[int, ...], begin: int, of: slice) -> BlockPixels:
        part = slice(begin, begin + math.prod(shape))
        return BlockPixels(
            slot[part].reshape(shape),
            good[part].reshape(shape),
            signal[part].reshape(shape),
            floor[part].reshape(shape),
            ceiling[part].reshape(shape),
            frame.gain,
            crowded[of] - begin,
            common[of],
        )

    on_strips = view(strips.index.shape, 0, slice(0, first))
    on_patches = view(patches.index.shape, cut, slice(first, len(crowded)))
    shares = int(np.count_nonzero(shared))
    return FitWindows(long, spot, strips, patches, pixels, slot, on_strips, on_patches, shares)


def _numbered_numpy(index: IntArray, inside: BoolArray, size: int) -> tuple[IntArray, IntArray, IntArray]:
    """Return the list of m distinct fitted pixels, the index of each pixel in the list, and frequencies (m,).

    The pixels are given as flat indices `index` (p,) in a frame of `size` pixels, which contain repeated
    values if windows overlap. The returned index is m for a pixel that is not `inside`.
    """
    named = index[inside]
    # If a pixel occurs in several windows, `number` keeps the index of the last occurrence.
    order = np.arange(len(named), dtype=np.int32)
    number = np.empty(size, dtype=np.int32)
    number[named] = order
    last = number.take(named)
    own = last == order
    pixels = named[own]
    place = (np.cumsum(own) - 1).take(last)
    slot = np.full(len(index), len(pixels))
    slot[inside] = place
    return pixels, slot, np.bincount(place, minlength=len(pixels))


@compiled_form_of(_numbered_numpy)
def _numbered(index: IntArray, inside: BoolArray, size: int) -> tuple[IntArray, IntArray, IntArray]:
    """See `_numbered_numpy`."""
    number = np.empty(size, dtype=np.int32)
    for p in range(len(index)):
        if inside[p]:
            number[index[p]] = p
    pixels, count = np.empty(len(index), dtype=np.int64), 0
    for p in range(len(index)):
        if inside[p] and number[index[p]] == p:
            pixels[count] = index[p]
            count += 1
            number[index[p]] = -count
    slot, times = np.full(len(index), count), np.zeros(count, dtype=np.int64)
    for p in range(len(index)):
        if inside[p]:
            slot[p] = -number[index[p]] - 1
            times[slot[p]] += 1
    return pixels[:count].copy(), slot, times


def _frame_values_numpy(
    index: IntArray,
    inside: BoolArray,
    signal: Float32Array,
    floor: Float32Array,
    counts: Image,
    bad: BoolArray,
    top: float,
) -> tuple[BoolArray, Float32Array, Float32Array, Float32Array]:
    """Return a mask of the usable pixels, and signal, floor and ceiling of all pixels, see `BlockPixels`."""
    light = signal.take(index)
    # The background is the raw counts minus the signal, and is subtracted from the saturation level.
    ceiling = np.float32(top) - counts.take(index) + light
    return inside & ~bad.take(index), light, floor.take(index), ceiling.astype(np.float32)


@compiled_form_of(_frame_values_numpy)
def _frame_values(
    index: IntArray,
    inside: BoolArray,
    signal: Float32Array,
    floor: Float32Array,
    counts: Image,
    bad: BoolArray,
    top: float,
) -> tuple[BoolArray, Float32Array, Float32Array, Float32Array]:
    """See `_frame_values_numpy`."""
    size = len(index)
    good, light = np.empty(size, dtype=np.bool_), np.empty(size, dtype=np.float32)
    variance, ceiling = np.empty(size, dtype=np.float32), np.empty(size, dtype=np.float32)
    for p in range(size):
        at = index[p]
        good[p] = inside[p] and not bad[at]
        light[p], variance[p] = signal[at], floor[at]
        ceiling[p] = top - counts[at] + signal[at]
    return good, light, variance, ceiling


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
    """Return start and end times of the fast part (n, 2) and of the slow part (n, 2) of each star's path.

    The slow part of a path is at that end of the exposure at which the rate is smaller. If a path has no fast
    part or no slow part, the start and end times of the missing part are equal.
    """
    motion = scene.motion.smooth
    if motion.constant or not motion.rotation.any():
        return times, np.zeros_like(times)
    time = np.linspace(times.min(), times.max(), _SAMPLES)
    pace, change = motion.relative_rate(time), np.abs(motion.relative_rate(time, 1)).max()
    steady = CameraMotion.steady(motion.rotation)
    velocity = paths(pinhole, steady, scene.stars, np.zeros(len(times))).velocity
    speed = np.maximum(np.hypot(velocity[:, 0], velocity[:, 1]), _SLOWEST)
    # A star is slow while the relative change of its speed over one point-spread width exceeds the limit
    # `_STEADY`.
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
