"""The significance of a horizon: how many cones fit chance edges as well, and what stands in its sky.

An upper bound of the expected number of cones, among all that differ in the picture, near which chance edges
lie as often and as closely. The density of chance edges is that of the edges beside the limb. These lie on
curves: a coast or a cloud's rim of radius R that touches the limb stays within the gate g of it over
2 sqrt(2 g R). Scan lines across one such piece are not independent; the pieces are counted instead.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray
from knightcube.vision.camera.lens import CameraModel

_GATES = (0.25, 0.5, 1.0, 2.0)
"""px: the one that gives the fewest chance cones counts."""
_GRAZING = 0.3
"""Cosine, as for limb points: more oblique scan lines give none."""
_ROUND = 0.1
"""Of the picture's size: radius of the curves on which chance edges lie."""
_BESIDE = 0.05
"""Of the picture's size: distance from the limb within which other edges give the density."""


@dataclass(frozen=True, slots=True)
class LimbInView:
    """The limb in a picture.

    Attributes:
        length: px, of the part that should show edges.
        crossings: of that part and the scan lines.
        all_crossings: of all that is in the picture, and the scan lines.
    """

    length: float
    crossings: float
    all_crossings: float


def limb_in_view(
    points: FloatArray, inside: BoolArray, due: BoolArray, space: tuple[float, float]
) -> LimbInView:
    """Return a closed limb `points` (n, 2) px where they are `inside` the picture (n,), and `due` (n,) there.

    `space` is px between the columns that are read, and between the rows.
    """
    with np.errstate(invalid="ignore"):
        step = np.abs(np.roll(points, -1, axis=0) - points)
    both = [kept & np.roll(kept, -1) for kept in (inside & due, inside)]
    size = np.hypot(step[:, 0], step[:, 1])
    # A column is crossed where the limb goes along x.
    crossings = np.sum(step * (step > _GRAZING * size[:, None]) / np.array(space), axis=1)
    return LimbInView(
        *(float(np.sum(each)) for each in (size[both[0]], crossings[both[0]], crossings[both[1]]))
    )


def log10_chance(
    limb: LimbInView, residuals: FloatArray, others: FloatArray, camera: CameraModel, unknowns: int
) -> float:
    """Return log10 of the bound on chance cones as good as a limb.

    `residuals` (k,) px are those of its edges, `others` (m,) px the distances of all other edges from the
    limb; `unknowns` is 2 for nadir, 3 with the altitude.
    """
    size = float(max(camera.columns, camera.rows))
    lines = max(limb.crossings, float(len(residuals)), 1.0)
    beside = _BESIDE * size
    # One edge more than seen: none beside the limb does not make the density zero.
    near = np.count_nonzero(np.abs(others) < beside) + 1.0
    density = near / (2.0 * beside * max(limb.all_crossings, lines))
    best = math.inf
    for gate in _GATES:
        hits = np.count_nonzero(np.abs(residuals) <= gate) / lines
        pieces = min(lines, limb.length / (2.0 * math.sqrt(2.0 * gate * _ROUND * size)))
        chance = min(2.0 * gate * density, 0.5)
        cones = math.log10(len(_GATES)) + unknowns * math.log10(size / gate)
        best = min(best, cones + _log10_tail(pieces, hits, chance))
    return best


def _log10_tail(number: float, share: float, chance: float) -> float:
    """Return log10 of the probability that a `share` of `number` or more happens (Chernoff's bound)."""
    if share <= chance:
        return 0.0
    rest = 0.0 if share >= 1.0 else (1.0 - share) * math.log((1.0 - share) / (1.0 - chance))
    return -number * (share * math.log(share / chance) + rest) / math.log(10.0)
