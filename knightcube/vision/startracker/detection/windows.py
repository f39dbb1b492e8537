"""Square windows of pixels about stars, stacked, so that all stars are measured at once."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, Image, IntArray
from knightcube.vision.records import select


@dataclass(frozen=True, slots=True, eq=False)
class Windows:
    """Windows of k x k pixels, k = 2 half + 1.

    Attributes:
        middle: (n, 2) column and row of the middle pixel.
        half: px.
        light: (n, k, k) counts above the sky, 0 where there is no pixel; saturated ones as they are.
        good: (n, k, k) which pixels exist and are usable.
        noise: (n,) counts, of a pixel without a star.
        trail: (n, 2) px, from the begin to the end of a star's path over the exposure.
    """

    middle: IntArray
    half: int
    light: FloatArray
    good: BoolArray
    noise: FloatArray
    trail: FloatArray

    def select(self, chosen: BoolArray | IntArray) -> Windows:
        """Return the windows that `chosen` picks."""
        return select(self, chosen, "half")

    def without(self, light: FloatArray) -> Windows:
        """Return the windows with `light` (n, k, k) taken off."""
        return replace(self, light=self.light - light)

    def __len__(self) -> int:
        return len(self.middle)


def cut(
    pixels: Image,
    middle: IntArray,
    half: int,
    level: FloatArray,
    noise: FloatArray,
    ceiling: float,
    trail: FloatArray | None = None,
) -> Windows:
    """Return the windows of `pixels` (rows, columns) about the pixels `middle` (n, 2), which are inside.

    `level` (n,) is the sky's, `noise` (n,) its noise; pixels at `ceiling` counts or above are saturated and
    not used. Without `trail` (n, 2) the stars stand still.
    """
    rows, columns = pixels.shape
    step = np.arange(-half, half + 1)
    column, row = middle[:, :1] + step, middle[:, 1:] + step
    good = ((row >= 0) & (row < rows))[:, :, None] & ((column >= 0) & (column < columns))[:, None, :]
    row, column = np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)
    counts = pixels[row[:, :, None], column[:, None, :]].astype(np.float64)
    light = np.where(good, counts - level[:, None, None], 0.0)
    path = np.zeros((len(middle), 2)) if trail is None else trail
    return Windows(middle, half, light, good & (counts < ceiling), noise, path)


def smoothed(light: FloatArray) -> FloatArray:
    """Return windows (n, k, k) under the search's kernel, [1 2 1] each way; the outermost pixels are zero."""
    down = light[:, :-2] + 2.0 * light[:, 1:-1] + light[:, 2:]
    out = np.zeros_like(light)
    out[:, 1:-1, 1:-1] = down[:, :, :-2] + 2.0 * down[:, :, 1:-1] + down[:, :, 2:]
    return out
