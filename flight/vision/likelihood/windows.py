"""The pixels that are fitted: strips about long streaks, patches about spots."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from flight.arrays import BoolArray, FloatArray, IntArray
from flight.pinhole import Pinhole
from flight.vision.likelihood.exposed_frame import ExposedFrame, Float32Array
from flight.vision.likelihood.scene import Scene, path_lengths, window_times
from flight.vision.likelihood.shutter import Shutter
from flight.vision.likelihood.spot_model import Patches, cut_patches
from flight.vision.likelihood.strips import Strips, cut_strips

# Paths shorter than this many widths are summed instant by instant.
_SPOT_WIDTHS = 8.0
# Predicted light within so many sigmas of saturation is left out: chosen by the model, not by the noise.
_MARGIN = 3.0
_UNRESOLVED = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """What the frame shows on some blocks of pixels, all arrays (b, ...) alike.

    Attributes:
        slot: number of the pixel among those in use, the same for every star that shares it.
        inside: whether the pixel exists, tells something, and is meant.
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
        long, spot: stars (a,), (b,) of each kind, indices into the scene.
        strips, patches: their pixels; star i of the strips is `long[i]`.
        pixels: (m,) flat indices of the pixels in use, by slot.
        on_strips, on_patches: what the frame shows there.
        shared: how many pixels are of several stars.
    """

    long: IntArray
    spot: IntArray
    strips: Strips
    patches: Patches
    pixels: IntArray
    on_strips: Sight
    on_patches: Sight
    shared: int

    def total(self, on_strips: Float32Array, on_patches: FloatArray) -> Float32Array:
        """Return the light (m,) of all stars on the pixels in use, from that on each star's own."""
        slots = np.concatenate([self.on_strips.slot.reshape(-1), self.on_patches.slot.reshape(-1)])
        light = np.concatenate(
            [
                (on_strips * self.strips.inside).reshape(-1),
                (on_patches * self.patches.inside).reshape(-1).astype(np.float32),
            ]
        )
        return np.bincount(slots, light, len(self.pixels)).astype(np.float32)

    def only(self, on_strips: BoolArray, on_patches: BoolArray) -> Windows:
        """Return the windows with only these pixels meant."""
        return replace(
            self,
            on_strips=replace(self.on_strips, inside=on_strips),
            on_patches=replace(self.on_patches, inside=on_patches),
        )


def cut_windows(
    frame: ExposedFrame, pinhole: Pinhole, shutter: Shutter, scene: Scene, reach: float
) -> Windows:
    """Return the pixels of `frame` within `reach` widths of the stars' paths."""
    length = path_lengths(pinhole, scene.motion, scene.stars)
    limit = _SPOT_WIDTHS * scene.width
    long, spot = np.flatnonzero(length >= limit), np.flatnonzero(length < limit)
    room = reach * scene.width
    times = window_times(pinhole, scene.motion, shutter, scene.stars[long])
    strips = cut_strips(pinhole, scene.motion, scene.stars[long], times, room)
    longest = float(length[spot].max(initial=0.0))
    patches = cut_patches(pinhole, scene.stars[spot], int(np.ceil(room + 0.5 * longest)))
    index = np.concatenate([strips.index.reshape(-1), patches.index.reshape(-1)])
    inside = np.concatenate([strips.inside.reshape(-1), patches.inside.reshape(-1)])
    # Each pixel is told by the last place that names it; only memory of pixels in use is touched.
    number = np.empty(frame.signal.size, dtype=np.int32)
    number[index] = np.arange(len(index), dtype=np.int32)
    last = number[index]
    own = last == np.arange(len(index), dtype=np.int32)
    pixels = index[own]
    slot = (np.cumsum(own) - 1)[last]
    shared = np.bincount(slot[inside], minlength=len(pixels)) > 1
    crowded = shared[slot] & inside
    common = np.cumsum(shared) - 1
    cut = strips.index.size
    return Windows(
        long,
        spot,
        strips,
        patches,
        pixels,
        _sight(frame, strips.index, strips.inside, slot[:cut], crowded[:cut], common),
        _sight(frame, patches.index, patches.inside, slot[cut:], crowded[cut:], common),
        int(np.count_nonzero(shared)),
    )


def _sight(
    frame: ExposedFrame,
    index: IntArray,
    inside: BoolArray,
    slot: IntArray,
    crowded: BoolArray,
    common: IntArray,
) -> Sight:
    signal = frame.signal[index]
    places = np.flatnonzero(crowded)
    return Sight(
        slot.reshape(index.shape),
        inside & ~frame.bad[index],
        signal,
        frame.floor[index],
        # The background's level is what a pixel's counts exceed its signal by.
        np.float32(frame.top) - frame.counts[index] + signal,
        frame.gain,
        places,
        common[slot[places]],
    )
