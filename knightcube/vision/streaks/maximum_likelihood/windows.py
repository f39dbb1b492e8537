"""The pixels that are fitted: strips about long streaks, patches about spots and the slow parts of streaks.

The light of a streak is 1/speed of the star, which the strips' model expands about each point. About a rest
that fails: where the rate grows from nothing, or falls to it, a patch serves the slow part of each streak.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks.maximum_likelihood.exposed_frame import ExposedFrame, Float32Array
from knightcube.vision.streaks.maximum_likelihood.motion import Motion, paths, positions
from knightcube.vision.streaks.maximum_likelihood.scene import Scene, path_lengths, window_times
from knightcube.vision.streaks.maximum_likelihood.shutter import Shutter
from knightcube.vision.streaks.maximum_likelihood.spot_model import Patches, cut_patches
from knightcube.vision.streaks.maximum_likelihood.strips import STEEPEST, Strips, cut_strips

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
