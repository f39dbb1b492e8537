"""All pairs of guide stars that one frame can show, by their angle (Michalski 3.3.1 and 3.3.4, eq. 49-61).

Two numbers and a float32 angle a pair, in order of the angle, with a k-vector of one cell for four pairs.
float32 rounds an angle below 0.5 rad by 0.003" at most.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from knightcube.astro.arrays import FloatArray, IntArray
from knightcube.reference.star_identification import k_vector
from knightcube.reference.star_identification.k_vector import KVector, members
from knightcube.vision.startracker.index import table_file
from knightcube.vision.startracker.index.guide_stars import GuideStars

KIND = table_file.Kind(b"KCPAIRS1", 1, "pair table", "make it again")
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


def build(stars: GuideStars, widest: float) -> PairTable:
    """Return all pairs of `stars` nearer than `widest` rad. Raises ValueError for an angle not in (0, pi)."""
    if not 0.0 < widest < np.pi:
        raise ValueError(f"widest = {widest!r}: an angle between 0 and pi rad")
    pairs = cKDTree(stars.direction).query_pairs(2.0 * np.sin(0.5 * widest), output_type="ndarray")
    angle = angles(stars.direction[pairs[:, 0]], stars.direction[pairs[:, 1]]).astype(np.float32)
    order = np.lexsort((pairs[:, 1], pairs[:, 0], angle))
    number = np.uint16 if len(stars) <= 1 << 16 else np.uint32
    ordered = pairs[order].astype(number)
    key = k_vector.build(angle[order], max(1, len(order) // _PAIRS_A_CELL))
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


def save(table: PairTable, path: Path) -> None:
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
    table_file.save(path, KIND, columns, facts)


def load(path: Path) -> PairTable:
    """Return the table of a file, mapped. Raises InputError when it is missing, damaged or outdated."""
    columns, facts = table_file.load(path, KIND)
    key = KVector(columns["angle"], columns["count"], facts["slope"], facts["origin"])
    return PairTable(columns["first"], columns["second"], key, int(facts["stars"]), facts["widest"])
