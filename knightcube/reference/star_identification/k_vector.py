"""The k-vector range search: finds sorted keys in a range without a binary search.

A straight line is drawn through the sorted keys; the k-vector counts the keys below each of its evenly
spaced values, so that the line's inverse gives the cell of any value and two look-ups bound a range
(Michalski 53-61; Mortari & Neta, K-vector range searching techniques, 2000). Ranges are half-open, low <=
key < high, and both ends are tested against the keys of their cells: the result is exact, where 61 returns
some keys too many.

Corrected: 54 needs 2 delta-epsilon, as in the source, for the line to end above the largest key, and 56 is
2.22e-16; here the margin is taken relative to the keys' size.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from knightcube.astro.arrays import FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class KVector:
    """Sorted keys and the counts that find them.

    Attributes:
        key: (n,) floating, in ascending order.
        count: (cells + 1,) uint32, keys below each value of the line.
        slope, origin: of the line (53): its value at j is origin + slope j.
    """

    key: npt.NDArray[Any]
    count: npt.NDArray[np.uint32]
    slope: float
    origin: float

    def __len__(self) -> int:
        return len(self.key)

    def ranges(self, low: npt.ArrayLike, high: npt.ArrayLike) -> tuple[IntArray, IntArray]:
        """Return start and stop (m,) of the keys with low <= key < high, for m ranges at once.

        An empty range has stop = start. Raises ValueError for a NaN.
        """
        start = self._below(np.atleast_1d(np.asarray(low, dtype=np.float64)))
        stop = self._below(np.atleast_1d(np.asarray(high, dtype=np.float64)))
        return start, np.maximum(start, stop)

    def _below(self, value: FloatArray) -> IntArray:
        """Return how many keys are below each value (m,)."""
        if np.isnan(value).any():
            raise ValueError("a range of NaN: its ends must be numbers")
        if not len(self.key):
            return np.zeros(len(value), dtype=np.int64)
        last = len(self.count) - 2
        with np.errstate(over="ignore"):
            # Far beyond the keys the quotient is infinite, which the clip takes for the last cell.
            cell = np.clip((value - self.origin) / self.slope, 0.0, last).astype(np.int64)
        # The quotient may round over the line's value that bounds the cell.
        cell = np.maximum(cell - (self.origin + self.slope * cell > value), 0)
        cell = np.minimum(cell + (self.origin + self.slope * (cell + 1) <= value), last)
        lower = self.count[cell].astype(np.int64)
        upper = self.count[cell + 1].astype(np.int64)
        while True:
            open_ = np.flatnonzero(lower < upper)
            if not len(open_):
                return lower
            middle = (lower[open_] + upper[open_]) // 2
            below = self.key[middle] < value[open_]
            lower[open_[below]] = middle[below] + 1
            upper[open_[~below]] = middle[~below]


def build(key: npt.NDArray[Any], cells: int | None = None) -> KVector:
    """Return the k-vector of sorted keys (n,); as many cells as keys, as in the source, by default.

    Raises ValueError when the keys are not finite or not in order, or `cells` is not positive.
    """
    wide = key.astype(np.float64)
    if not np.all(np.isfinite(wide)) or np.any(np.diff(wide) < 0.0):
        raise ValueError("the keys of a k-vector must be finite and in ascending order")
    number = max(len(key) - 1, 1) if cells is None else cells
    if number < 1:
        raise ValueError(f"cells = {cells}: at least one")
    if not len(key):
        return KVector(key, np.zeros(number + 1, dtype=np.uint32), 1.0, 0.0)
    margin = (number + 4) * np.finfo(np.float64).eps * max(abs(wide[0]), abs(wide[-1]), 1e-200)
    slope = (wide[-1] - wide[0] + 2.0 * margin) / number
    origin = wide[0] - margin
    count = np.searchsorted(wide, origin + slope * np.arange(number + 1)).astype(np.uint32)
    count[0], count[-1] = 0, len(key)
    return KVector(key, count, float(slope), float(origin))


def members(start: IntArray, stop: IntArray) -> tuple[IntArray, IntArray]:
    """Return all places in the ranges (m,) one after the other, and the number of the range of each."""
    length = stop - start
    owner = np.repeat(np.arange(len(start)), length)
    begin = np.cumsum(length) - length
    return np.arange(len(owner)) + (start - begin)[owner], owner
