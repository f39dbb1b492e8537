"""Connected regions of bright pixels, and the moments of their light."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray


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
