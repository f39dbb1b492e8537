"""A frame made ready for the fit: light above the background, its noise, and which pixels tell nothing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from flight.arrays import BoolArray, FloatArray, Image, IntArray
from flight.vision.background import estimate_background
from flight.vision.segmentation import positions

Float32Array = npt.NDArray[np.float32]

# A count that so many pixels share, and none exceeds, is where the converter saturates.
_PLATEAU = 6
# Predicted light within so many sigmas of saturation is left out: chosen by the model, not by the noise.
_MARGIN = 3.0
_UNRESOLVED = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class ExposedFrame:
    """A frame of (rows, columns), its arrays flat.

    Attributes:
        shape: rows, columns.
        signal: counts above the background.
        floor: counts^2, variance of a pixel without a star.
        ceiling: counts above the background at which the pixel saturates.
        bad: pixels that tell nothing: saturated or hot.
        gain: electrons a count.
        hot_pixels: how many of `bad` are hot.
    """

    shape: tuple[int, int]
    signal: Float32Array
    floor: Float32Array
    ceiling: Float32Array
    bad: BoolArray
    gain: float
    hot_pixels: int

    def modelled(self, *parts: tuple[IntArray, Float32Array | FloatArray]) -> Float32Array:
        """Return the light (rows * columns) of all stars, from their pixels' indices and light."""
        index = np.concatenate([part[0].reshape(-1) for part in parts])
        light = np.concatenate([part[1].reshape(-1) for part in parts])
        return np.bincount(index, light, len(self.signal)).astype(np.float32)

    def residual(
        self, index: IntArray, inside: BoolArray, total: Float32Array, clip: float
    ) -> tuple[Float32Array, Float32Array]:
        """Return weights (1/variance, 0 where left out) and residuals of the pixels at `index`.

        `total` is `modelled`. Residuals of more than `clip` sigma and a tenth of
        the model are no noise: left out; 0 leaves none out for that.
        """
        model = total[index]
        variance = self.floor[index] + np.maximum(model, 0.0) * np.float32(1.0 / self.gain)
        residual = self.signal[index] - model
        good = inside & ~self.bad[index]
        good &= model + np.float32(_MARGIN) * np.sqrt(variance) < self.ceiling[index]
        if clip > 0.0:
            allowed = np.float32(clip) * np.sqrt(variance) + np.float32(_UNRESOLVED) * model
            good &= np.abs(residual) <= allowed
        weight = np.where(good, 1.0 / variance, np.float32(0.0))
        return weight, np.where(good, residual, np.float32(0.0))


def expose_frame(pixels: Image, saturation: float | None, gain: float) -> ExposedFrame:
    """Return `pixels` (rows, columns) ready for the fit.

    `saturation` in counts; None takes the highest count of the frame when many pixels share it, else the
    top of the integer type.
    """
    background = estimate_background(pixels)
    level = background.map(background.level)
    noise = background.map(background.noise)
    signal = pixels.astype(np.float32)
    top = saturation_count(pixels) if saturation is None else saturation
    bad = pixels >= top
    signal -= level
    hot = find_hot_pixels(signal, noise)
    signal[hot] = 0.0
    bad[hot] = True
    return ExposedFrame(
        (pixels.shape[0], pixels.shape[1]),
        signal.reshape(-1),
        np.square(noise).reshape(-1),
        (np.float32(top) - level).reshape(-1),
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
    signal: Float32Array, noise: Float32Array, sharpness: float = 0.15, sigmas: float = 8.0
) -> tuple[IntArray, IntArray]:
    """Return rows and columns of pixels above `sigmas` times the noise that no optics could make.

    Their every neighbour stays below `sharpness` of them and 3 sigma.
    """
    row, column = positions(signal > sigmas * noise)
    inside = (row > 0) & (row < signal.shape[0] - 1) & (column > 0) & (column < signal.shape[1] - 1)
    row, column = row[inside], column[inside]
    steps = [(dr, dc) for dr in (-1, 0, 1) for dc in (-1, 0, 1) if (dr, dc) != (0, 0)]
    around = np.stack([signal[row + dr, column + dc] for dr, dc in steps])
    hot = around.max(axis=0) < sharpness * signal[row, column] + 3.0 * noise[row, column]
    return row[hot], column[hot]
