"""The count at which pixels saturate, the step between counts, and frames without a scene.

A frame without a scene is dead (one value everywhere) or overexposed. The step between counts is 257 where
8-bit counts were written as 16 bits, and 16 where 12-bit counts were.
"""

from __future__ import annotations

from enum import Enum

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, Image

# A living sensor differs from one single value in more pixels than this; a dead one may have hot pixels.
_DEAD_FRACTION = 1e-4
# A count that several pixels share, and none exceeds, is where the converter saturates.
_PLATEAU = 6
# The same in a frame of any camera: a count shared by fewer pixels, but by this factor more than stand within
# this part of the range below it.
_LEAST_PLATEAU, _PILED_UP, _PLATEAU_REACH = 4, 2.0, 0.02


class FrameState(Enum):
    """Whether a frame holds a scene: `usable`, or why not."""

    USABLE = "usable"
    BLACK = "black"
    SATURATED = "saturated"


def frame_state(pixels: Image, saturation: float, saturated_fraction: float) -> FrameState:
    """Distinguish a dead frame (one value everywhere) and an overexposed one from a frame worth processing.

    Saturated: at least `saturated_fraction` of the pixels (rows, columns) reach `saturation` counts.
    """
    if np.count_nonzero(at_least(pixels, saturation)) >= saturated_fraction * pixels.size:
        return FrameState.SATURATED
    # Compared in the frame's own type: whole numbers take a quarter of the time.
    usual = np.median(pixels[::8, ::8]).astype(pixels.dtype)
    if np.count_nonzero(pixels != usual) <= _DEAD_FRACTION * pixels.size:
        return FrameState.BLACK
    return FrameState.USABLE


def saturation_level(pixels: Image, given: float | None) -> float:
    """Return the count at which pixels clip: `given`, the integer type's top, or infinity for other types."""
    if given is not None:
        return given
    return float(np.iinfo(pixels.dtype).max) if pixels.dtype.kind in "ui" else np.inf


def saturation_count(pixels: Image) -> float:
    """Return the count at which `pixels` clip: their highest when several share it, else the type's top.

    Serves frames of streaks, whose bright stars spread over many pixels.
    """
    highest = pixels.max()
    # One value everywhere is a dead frame's; a converter's top it is at the type's top only.
    if pixels.min() < highest and np.count_nonzero(pixels == highest) >= _PLATEAU:
        return float(highest)
    return saturation_level(pixels, None)


def saturation_of_bright(counts: FloatArray, pixels: Image, given: float | None) -> float:
    """Return the count at which pixels clip: `given`, a plateau of the bright `counts` (m,), or the top.

    Serves frames of points from any camera. A dim frame's highest counts are noise, where the last one is the
    rarest; a plateau holds more pixels than the counts just below it.
    """
    top = saturation_level(pixels, given)
    highest = counts.max(initial=-np.inf)
    if given is not None or highest >= top or not len(counts):
        return top
    at_top = int(np.count_nonzero(counts == highest))
    step = max(1.0, _PLATEAU_REACH * float(highest - np.median(counts)))
    below = int(np.count_nonzero(counts >= highest - step)) - at_top
    flat = at_top >= _LEAST_PLATEAU and at_top > _PILED_UP * below
    return float(highest) if flat else top


def at_least(pixels: Image, level: float) -> BoolArray:
    """Return which `pixels`, of an unsigned integer type, reach `level` counts."""
    if not np.issubdtype(pixels.dtype, np.integer) or not 0.0 <= level <= np.iinfo(pixels.dtype).max:
        return np.asarray(pixels >= level)
    return np.asarray(pixels >= pixels.dtype.type(np.ceil(level)))


# Pixels are sampled so sparsely first; repaired ones between the steps are fewer than this part.
_STRIDE = 16
_MOST_BETWEEN = 0.01


def in_steps(pixels: Image) -> tuple[Image, int, int]:
    """Return unsigned `pixels` (rows, columns) in steps of their counts, the step, and the count of step 0.

    Pixels whose counts have no common step come back as they are, with 1 and 0.
    """
    values = np.unique(pixels[::_STRIDE, ::_STRIDE]).astype(np.int64)
    step = int(np.gcd.reduce(values - values[0]))
    if step <= 1:
        return pixels, 1, 0
    offset = int(values[0]) % step
    between = np.count_nonzero((pixels.astype(np.int64) - offset) % step)
    if between > _MOST_BETWEEN * pixels.size:
        return pixels, 1, 0
    steps = (pixels.astype(np.int64) - offset + step // 2) // step
    return np.maximum(steps, 0).astype(pixels.dtype), step, offset
