"""Hot pixels: bright ones with dark neighbours, which no optics could make.

A star's image wider than sigma 0.5 px gives its brightest pixel's four neighbours at least 15 % of that
pixel's light. Corner detectors need an image without gaps, and a search for peaks has room for a number of
them: there hot pixels are replaced, the certain ones only. A fit of pixels leaves them out instead, which
costs nothing if one of them was a star's.
"""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, Image, IntArray
from knightcube.vision.frame.regions import positions

# Part of a pixel's light that its neighbours would get from a star, and sigmas of their noise on top; never
# more than another part, which a faint star's neighbours reach.
_SHARPNESS, _NOISE, _MOST = 0.15, 3.0, 0.3
# Of two hot pixels side by side only the third brightest is dark: asked of bright ones, with less noise.
_PAIR, _PAIR_NOISE = 20.0, 1.0
_AROUND = tuple((dr, dc) for dr in (-1, 0, 1) for dc in (-1, 0, 1) if (dr, dc) != (0, 0))


def repair_hot_pixels(signal: Image, noise: Image, sigmas: float = 10.0) -> int:
    """Replace the hot pixels of `signal` (rows, columns) by their neighbours' median; return how many.

    `noise` (rows, columns) is of one pixel; only pixels above `sigmas` times it are examined.
    """
    row, column = positions(signal > sigmas * noise)
    row, column, around = _hot(signal, row, column, noise[row, column])
    signal[row, column] = np.median(around, axis=0)
    return len(row)


def find_hot_pixels(signal: Image, variance: Image, sigmas: float = 8.0) -> tuple[IntArray, IntArray]:
    """Return rows and columns of the hot pixels of `signal` that exceed `sigmas` of their noise.

    `variance` (rows, columns) is the noise squared.
    """
    row, column = positions(signal > np.float32(sigmas * np.sqrt(variance.min())))
    noise = np.sqrt(variance[row, column])
    bright = signal[row, column] > sigmas * noise
    row, column, _ = _hot(signal, row[bright], column[bright], noise[bright])
    return row, column


def are_hot(light: FloatArray, noise: FloatArray) -> BoolArray:
    """Return which windows (n,) of nine pixels, `light` (9, n), hold one hot pixel or two, and nothing else.

    `noise` (n,) is of one pixel.
    """
    # The third brightest, the second and the highest.
    third, second, highest = np.partition(light, (6, 7, 8), axis=0)[6:]
    alone = second < np.minimum(_SHARPNESS * highest + _NOISE * noise, _MOST * highest)
    pair = (highest > _PAIR * noise) & (third < _SHARPNESS * highest + _PAIR_NOISE * noise)
    return np.asarray(alone | pair)


def _hot(
    signal: Image, row: IntArray, column: IntArray, noise: FloatArray
) -> tuple[IntArray, IntArray, FloatArray]:
    """Return those of the pixels (m,) that are hot, and the eight pixels (8, k) about each."""
    inside = (row > 0) & (row < signal.shape[0] - 1) & (column > 0) & (column < signal.shape[1] - 1)
    row, column, noise = row[inside], column[inside], noise[inside]
    around = np.stack([signal[row + dr, column + dc] for dr, dc in _AROUND])
    own = signal[row, column]
    # Of two hot pixels side by side each is examined; a third beside them is none of the two.
    hot = are_hot(np.concatenate([around, own[None]]), noise) & (np.count_nonzero(around > own, axis=0) <= 1)
    return row[hot], column[hot], around[:, hot]
