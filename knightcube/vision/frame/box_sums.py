"""The light of the 3 x 3 pixels about each pixel: nearly the matched filter of a star one pixel wide."""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import Image, IntArray

# Pixels of a frame that are summed at a time.
_STRETCH = 32_768


def box_sum(image: Image) -> Image:
    """Return the sum over 3 x 3 pixels about each pixel of (rows, columns); the outermost are zero."""
    columns, flat = image.shape[1], np.ascontiguousarray(image).reshape(-1)
    total = np.empty(image.shape, dtype=image.dtype)
    sums = total.reshape(-1)
    # Rows run into each other, which only the outermost pixels see. A stretch that stays in the processor's
    # cache takes a third of the time of the whole frame at once.
    for start in range(columns + 1, flat.size - columns - 1, _STRETCH):
        stop = min(start + _STRETCH, flat.size - columns - 1)
        down = flat[start - columns - 1 : stop - columns + 1] + flat[start - 1 : stop + 1]
        down += flat[start + columns - 1 : stop + columns + 1]
        inner = sums[start:stop]
        np.add(down[:-2], down[1:-1], out=inner)
        inner += down[2:]
    total[[0, -1]] = 0
    total[:, [0, -1]] = 0
    return total


def less_boxes(sums: Image, shape: tuple[int, int], pixels: IntArray, taken: Image) -> Image:
    """Return the flat `sums` over 3 x 3 pixels of a frame of `shape` from which light was `taken`.

    `pixels` (m,) are flat, no one twice; `taken` (m,) is their light.
    """
    out, (rows, columns) = sums.copy(), shape
    for down in (-columns, 0, columns):
        for beside in (-1, 0, 1):
            # Sums that run over the frame's edge end on its outermost pixels, which are zero.
            out[np.clip(pixels + (down + beside), 0, out.size - 1)] -= taken
    framed = out.reshape(rows, columns)
    framed[[0, -1]] = 0
    framed[:, [0, -1]] = 0
    return out
