"""All pairs of guide stars that one frame can show, by angle (Michalski 3.3.1 and 3.3.4, eq. 49-61).

A pair takes two numbers and a float32 angle. float32 rounds an angle below 0.5 rad by 0.003" at most. Pairs
are sorted by angle and searched with a k-vector, one cell for four pairs.

The k-vector finds the keys of a range without a binary search. A straight line is drawn through the sorted
keys; the k-vector counts the keys below each of its evenly spaced values, so that the inverse of the line
gives the cell of any value and two look-ups bound a range (Mortari & Neta, K-vector range searching
techniques, 2000). Ranges are half-open, low <= key < high, and both ends are tested against the keys of their
cells: the result is exact, where equation 61 returns some keys too many. Two corrections: equation 54 needs
2 delta-epsilon, as in the source, for the line to end above the largest key, and equation 56 is 2.22e-16;
here the margin is relative to the size of the keys.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from knightcube.astro.arrays import FloatArray, IntArray
from knightcube.vision.startracker.index.sky_index import GuideStars, TableKind, load_table, save_table


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


def build_k_vector(key: npt.NDArray[Any], cells: int | None = None) -> KVector:
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


KIND = TableKind(b"KCPAIRS1", 1, "pair table", "make it again")
_PAIRS_A_CELL = 4


@dataclass(frozen=True, slots=True, eq=False)
class PairTable:
    """Pairs in order of their angle.

    Attributes:
        first, second: (m,) uint16, uint32 from 65,536 stars on: numbers of guide stars, first < second.
        angle: their angle, rad, float32, with its k-vector.
        stars: how many guide stars, the brightest, were paired.
        widest: rad, the largest angle.
    """

    first: npt.NDArray[Any]
    second: npt.NDArray[Any]
    angle: KVector
    stars: int
    widest: float

    def __len__(self) -> int:
        return len(self.first)

    def between(self, low: npt.ArrayLike, high: npt.ArrayLike) -> tuple[IntArray, IntArray, IntArray]:
        """Return all pairs with low <= angle < high (m,), both ways round, and whose range each is in.

        The three are (k,): guide star, its partner, number of the range.
        """
        place, owner = members(*self.angle.ranges(low, high))
        first = self.first[place].astype(np.int64)
        second = self.second[place].astype(np.int64)
        return (
            np.concatenate([first, second]),
            np.concatenate([second, first]),
            np.concatenate([owner, owner]),
        )


def build_pairs(stars: GuideStars, widest: float) -> PairTable:
    """Return all pairs of `stars` nearer than `widest` rad. Raises ValueError for an angle not in (0, pi)."""
    if not 0.0 < widest < np.pi:
        raise ValueError(f"widest = {widest!r}: an angle between 0 and pi rad")
    pairs = cKDTree(stars.direction).query_pairs(2.0 * np.sin(0.5 * widest), output_type="ndarray")
    angle = angles(stars.direction[pairs[:, 0]], stars.direction[pairs[:, 1]]).astype(np.float32)
    order = np.lexsort((pairs[:, 1], pairs[:, 0], angle))
    number = np.uint16 if len(stars) <= 1 << 16 else np.uint32
    ordered = pairs[order].astype(number)
    key = build_k_vector(angle[order], max(1, len(order) // _PAIRS_A_CELL))
    return PairTable(ordered[:, 0].copy(), ordered[:, 1].copy(), key, len(stars), widest)


def faintest_for(stars: GuideStars, solid_angle: float, wanted: float) -> float:
    """Return the magnitude limit at which a field of `solid_angle` sr shows `wanted` stars on average."""
    number = int(np.ceil(wanted * 4.0 * np.pi / solid_angle))
    return (
        float(stars.magnitude[number])
        if number < len(stars)
        else float(np.nextafter(stars.magnitude[-1], 99.0))
    )


def angles(one: FloatArray, other: FloatArray) -> FloatArray:
    """Return the angles (...,) between unit vectors (..., 3), by half the chord: exact where small (22)."""
    return np.asarray(2.0 * np.arcsin(np.minimum(0.5 * np.linalg.norm(one - other, axis=-1), 1.0)))


def save_pairs(table: PairTable, path: Path) -> None:
    """Write the table to `path`, whole or not at all."""
    columns = {
        "first": table.first,
        "second": table.second,
        "angle": table.angle.key,
        "count": table.angle.count,
    }
    facts = {
        "slope": table.angle.slope,
        "origin": table.angle.origin,
        "stars": float(table.stars),
        "widest": table.widest,
    }
    save_table(path, KIND, columns, facts)


def load_pairs(path: Path) -> PairTable:
    """Return the table of a file, mapped. Raises InputError when it is missing, damaged or outdated."""
    columns, facts = load_table(path, KIND)
    key = KVector(columns["angle"], columns["count"], facts["slope"], facts["origin"])
    return PairTable(columns["first"], columns["second"], key, int(facts["stars"]), facts["widest"])
