"""A frame made ready for the fit: light above the background, its noise, and which pixels tell nothing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from flight.gnc.math.arrays import BoolArray, Image, IntArray
from flight.gnc.vision.streaks.background import at_least, estimate_background
from flight.gnc.vision.streaks.segmentation import box_sum, positions

Float32Array = npt.NDArray[np.float32]

# A count that so many pixels share, and none exceeds, is where the converter saturates.
_PLATEAU = 6


@dataclass(frozen=True, slots=True, eq=False)
class ExposedFrame:
    """A frame of (rows, columns), its arrays flat.

    Attributes:
        shape: rows, columns.
        signal: counts above the background; sums: of it, over 3 x 3 pixels.
        floor: counts^2, variance of a pixel without a star.
        counts: as the camera gave them; top: at which a pixel saturates.
        bad: pixels that tell nothing: saturated or hot.
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
    """Return `pixels` (rows, columns) ready for the fit.

    `saturation` in counts; None takes the highest count of the frame when many pixels share it, else the
    top of the integer type.
    """
    background = estimate_background(pixels)
    # Written over itself: fresh megabytes cost more than the arithmetic.
    signal = background.map(background.level)
    np.subtract(pixels, signal, out=signal)
    floor = background.map(np.square(background.noise))
    top = saturation_count(pixels) if saturation is None else saturation
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


def saturation_count(pixels: Image) -> float:
    """Return the count at which `pixels` clip: their highest when several share it, else the type's top."""
    highest = pixels.max()
    if np.count_nonzero(pixels == highest) >= _PLATEAU:
        return float(highest)
    return float(np.iinfo(pixels.dtype).max)


def find_hot_pixels(
    signal: Float32Array, variance: Float32Array, sharpness: float = 0.15, sigmas: float = 8.0
) -> tuple[IntArray, IntArray]:
    """Return rows and columns of pixels above `sigmas` times the noise that no optics could make.

    `variance` is the noise squared. Their every neighbour stays below `sharpness` of them and 3 sigma.
    """
    row, column = positions(signal > np.float32(sigmas * np.sqrt(variance.min())))
    noise = np.sqrt(variance[row, column])
    bright = signal[row, column] > sigmas * noise
    row, column, noise = row[bright], column[bright], noise[bright]
    inside = (row > 0) & (row < signal.shape[0] - 1) & (column > 0) & (column < signal.shape[1] - 1)
    row, column, noise = row[inside], column[inside], noise[inside]
    steps = [(dr, dc) for dr in (-1, 0, 1) for dc in (-1, 0, 1) if (dr, dc) != (0, 0)]
    around = np.stack([signal[row + dr, column + dc] for dr, dc in steps])
    hot = around.max(axis=0) < sharpness * signal[row, column] + 3.0 * noise
    return row[hot], column[hot]
