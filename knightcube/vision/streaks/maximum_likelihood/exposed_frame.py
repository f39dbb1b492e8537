"""A frame made ready for the fit: light above the background, its noise, and which pixels to leave out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from knightcube.astro.arrays import BoolArray, Image
from knightcube.vision.frame import (
    at_least,
    box_sum,
    estimate_background,
    find_hot_pixels,
    in_steps,
    saturation_count,
)

Float32Array = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class ExposedFrame:
    """A frame of (rows, columns), its arrays flat; a count is a step of the converter's.

    Attributes:
        shape: rows, columns.
        signal: counts above the background; sums: of it, over 3 x 3 pixels.
        floor: counts^2, variance of a pixel without a star.
        counts: as the camera gave them; top: at which a pixel saturates.
        bad: pixels to leave out: saturated or hot.
        gain: electrons a count.
        hot_pixels: how many of `bad` are hot.
    """

    shape: tuple[int, int]
    signal: Float32Array
    sums: Float32Array
    floor: Float32Array
    counts: Image
    top: float
    bad: BoolArray
    gain: float
    hot_pixels: int


def expose_frame(pixels: Image, saturation: float | None, gain: float) -> ExposedFrame:
    """Return `pixels` (rows, columns) ready for the fit, in steps of their counts.

    `saturation` in counts and `gain` in e- a count of `pixels`; a saturation of None takes the highest count
    of the frame when many pixels share it, else the top of the integer type.
    """
    top = saturation_count(pixels) if saturation is None else saturation
    pixels, step, offset = in_steps(pixels)
    top, gain = (top - offset) / step, gain * step
    background = estimate_background(pixels)
    # Written over itself: fresh megabytes cost more than the arithmetic.
    signal = background.map(background.level)
    np.subtract(pixels, signal, out=signal)
    floor = background.map(np.square(background.noise))
    bad = at_least(pixels, top)
    hot = find_hot_pixels(signal, floor)
    signal[hot] = 0.0
    bad[hot] = True
    return ExposedFrame(
        (pixels.shape[0], pixels.shape[1]),
        signal.reshape(-1),
        box_sum(signal).reshape(-1),
        floor.reshape(-1),
        pixels.reshape(-1),
        top,
        bad.reshape(-1),
        gain,
        len(hot[0]),
    )
