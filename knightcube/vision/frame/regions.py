"""Connected regions of bright pixels, the moments of their light, and hot pixels.

Hot pixels are bright pixels with dark neighbours, which no optics could produce: a star's image wider than
sigma 0.5 px gives the brightest pixel's four neighbours at least 15 % of that pixel's light. Corner
detectors need an image without gaps, and a search for peaks examines a limited number of them. They replace
hot pixels, and only certain ones. A fit to pixels leaves hot pixels out instead, which costs nothing if one
of them was part of a star.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, Image, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Moments:
    """The light of `n` regions.

    Attributes:
        flux: (n,) counts.
        centre: (n, 2) px, x and y, of light.
        length: (n,) px, of the uniform line with the region's second moments; about 0 for a round one.
        thickness: (n,) px, rms across.
        direction: (n,) rad, from the rows to the line.
    """

    flux: FloatArray
    centre: FloatArray
    length: FloatArray
    thickness: FloatArray
    direction: FloatArray


def positions(mask: BoolArray) -> tuple[IntArray, IntArray]:
    """Return rows and columns of a mask's true pixels: as nonzero, much faster when they are few."""
    row, column = np.divmod(np.flatnonzero(mask), mask.shape[1])
    return row, column


def label_pixels(pixel: IntArray, columns: int) -> tuple[IntArray, int]:
    """Return the region number (m,) of each flat `pixel` (m,), ascending, and the count of regions.

    Regions are 8-connected and numbered in the order of their first pixels. Runs of pixels along rows are
    joined: there are many times fewer of them than pixels.
    """
    # One column more, which is empty: no run goes on in the next row.
    pixel, columns = pixel + pixel // columns, columns + 1
    first = np.flatnonzero(np.diff(pixel, prepend=-2) > 1)
    length = np.diff(first, append=len(pixel))
    start, stop = pixel[first], pixel[first] + length
    # A run touches those of the next row from one column before it to one after.
    low = np.searchsorted(stop, start + columns)
    count = np.searchsorted(start, stop + columns, side="right") - low
    one = np.repeat(np.arange(len(first)), count)
    other = np.arange(len(one)) + np.repeat(low - np.cumsum(count) + count, count)
    number, regions = _joined(one, other, len(first))
    return np.repeat(number, length), regions


def _joined(one: IntArray, other: IntArray, count: int) -> tuple[IntArray, int]:
    """Return the number (count,) of the group of each of `count` items, and how many groups there are.

    Pairs (m,) join them; groups are numbered in the order of their first items. Each item points to a smaller
    one of its group, by shorter and shorter ways (Shiloach and Vishkin 1982). For this alone scipy.sparse
    would take 12 MiB of the vision worker.
    """
    root = np.arange(count)
    while True:
        least = np.minimum(root[one], root[other])
        apart = np.flatnonzero(root[one] != root[other])
        if not len(apart):
            break
        for ends in (one, other):
            np.minimum.at(root, root[ends[apart]], least[apart])
        while np.any((nearer := root[root]) != root):
            root = nearer
    first = root == np.arange(count)
    return (np.cumsum(first) - 1)[root], int(np.count_nonzero(first))


def moments(owner: IntArray, column: IntArray, row: IntArray, light: FloatArray, count: int) -> Moments:
    """Return the moments of `count` regions of pixels (m,), each with its region's number and its `light`.

    A region without light has none: zeros.
    """
    flux = np.bincount(owner, light, count).astype(np.float64)
    whole = np.where(flux > 0.0, flux, np.inf)
    x, y = np.bincount(owner, light * column, count) / whole, np.bincount(owner, light * row, count) / whole
    dx, dy = column - x[owner], row - y[owner]
    xx = np.bincount(owner, light * dx * dx, count) / whole
    yy = np.bincount(owner, light * dy * dy, count) / whole
    xy = np.bincount(owner, light * dx * dy, count) / whole
    # The difference of the principal moments is free of the point spread, which widens both alike; a line of
    # length L has L^2/12.
    spread = np.hypot(xx - yy, 2.0 * xy)
    return Moments(
        flux,
        np.stack([x, y], axis=-1),
        np.sqrt(12.0 * spread),
        np.sqrt(np.maximum(0.5 * (xx + yy - spread), 0.0)),
        0.5 * np.arctan2(2.0 * xy, xx - yy),
    )


def line_of(centre: FloatArray, covariance: FloatArray, least_length: float) -> FloatArray:
    """Return the ends (2, 2) px of the uniform line about `centre` (2,) with second moments (2, 2) px^2.

    Both are the centre where it is not longer than `least_length` px.
    """
    (across, along), axes = np.linalg.eigh(covariance)
    length = float(np.sqrt(12.0 * max(along - across, 0.0)))
    half = 0.5 * length * axes[:, 1] if length > least_length else np.zeros(2)
    return np.stack([centre - half, centre + half])


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
