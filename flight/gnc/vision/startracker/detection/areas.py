"""Connected areas of light above the noise: their moments, their peaks, and where they are a clutter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flight.gnc.math.arrays import BoolArray, FloatArray, Image, IntArray
from flight.gnc.vision.startracker.detection.sky import BrightPixels, Sky

_BLOCK = 32
# A count that so many pixels share, and none exceeds, may be where the converter saturates: it is, if so many
# times fewer stand within this part of it below.
_PLATEAU, _PILED_UP, _PLATEAU_REACH = 4, 2.0, 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Areas:
    """Connected areas, `n` of them, and their `m` pixels.

    Attributes:
        row, column, owner: (m,) of each pixel, and the number of its area.
        smooth: (m,) counts of the smoothed frame above its level.
        peak: (m,) whether no neighbour is higher.
        saturated: (m,) whether the pixel is.
        ceiling: counts at which pixels saturate; inf where nothing is known.
        pixels: (n,) how many.
        flux: (n,) counts.
        centre: (n, 2) px, of light.
        length: (n,) px, of the uniform line with the area's moments, free of the point spread.
        thickness: (n,) px, rms across.
        direction: (n,) rad, of the length to the rows.
        shape: rows, columns of the frame.
    """

    row: IntArray
    column: IntArray
    owner: IntArray
    smooth: FloatArray
    peak: BoolArray
    saturated: BoolArray
    ceiling: float
    pixels: IntArray
    flux: FloatArray
    centre: FloatArray
    length: FloatArray
    thickness: FloatArray
    direction: FloatArray
    shape: tuple[int, int]

    def __len__(self) -> int:
        return len(self.flux)


def find_areas(pixels: Image, sky: Sky, bright: BrightPixels, saturation: float | None) -> Areas:
    """Return the 8-connected areas of `bright` pixels, with moments in `pixels` less the sky."""
    first, second = adjoining(bright.index, bright.shape[1])
    count, owner = connected(first, second, len(bright.index))
    row, column = np.divmod(bright.index, bright.shape[1])
    counts = pixels[row, column].astype(np.float64)
    light = np.maximum(counts - sky.level.at(column, row), 0.0)
    flux = np.bincount(owner, light, count).astype(np.float64)
    whole = np.where(flux > 0.0, flux, np.inf)
    x, y = np.bincount(owner, light * column, count) / whole, np.bincount(owner, light * row, count) / whole
    dx, dy = column - x[owner], row - y[owner]
    xx = np.bincount(owner, light * dx * dx, count) / whole
    yy = np.bincount(owner, light * dy * dy, count) / whole
    xy = np.bincount(owner, light * dx * dy, count) / whole
    spread = np.hypot(xx - yy, 2.0 * xy)
    ceiling = _ceiling(counts, pixels, saturation)
    return Areas(
        row,
        column,
        owner,
        bright.smooth,
        _peaks(bright.smooth, first, second),
        counts >= ceiling,
        ceiling,
        np.bincount(owner, minlength=count),
        flux,
        np.stack([x, y], axis=-1),
        np.sqrt(12.0 * spread),
        np.sqrt(np.maximum(0.5 * (xx + yy - spread), 0.0)),
        0.5 * np.arctan2(2.0 * xy, xx - yy),
        bright.shape,
    )


def adjoining(index: IntArray, columns: int) -> tuple[IntArray, IntArray]:
    """Return the pairs (p,) of pixels that touch, by number in `index` (m,), flat and increasing.

    Two pixels that the frame's border parts are never both given: the outermost columns hold none.
    """
    pairs = []
    for step in (1, columns - 1, columns, columns + 1):
        other = np.searchsorted(index, index + step)
        other[other == len(index)] = 0
        first = np.flatnonzero(index[other] == index + step) if len(index) else other
        pairs.append((first, other[first]))
    return np.concatenate([p[0] for p in pairs]), np.concatenate([p[1] for p in pairs])


def cluttered(areas: Areas, place: IntArray, share: float) -> BoolArray:
    """Tell which pixels `place` (p, 2) lie in blocks of 32 px of which the areas fill more than `share`.

    Half a block's step each way is looked at too, so that where the blocks begin does not matter.
    """
    down, across = areas.shape[0] // _BLOCK + 2, areas.shape[1] // _BLOCK + 2
    found = np.zeros(len(place), dtype=bool)
    for shift_y in (0, _BLOCK // 2):
        for shift_x in (0, _BLOCK // 2):
            block = (areas.row + shift_y) // _BLOCK * across + (areas.column + shift_x) // _BLOCK
            filled = np.bincount(block, minlength=down * across)
            own = (place[:, 1] + shift_y) // _BLOCK * across + (place[:, 0] + shift_x) // _BLOCK
            found |= filled[own] > share * _BLOCK**2
    return found


def connected(first: IntArray, second: IntArray, count: int) -> tuple[int, IntArray]:
    """Return how many groups the pairs (p,) make of `count` pixels, and each one's group (count,)."""
    from scipy import sparse  # noqa: PLC0415 - a process that only names the detection need not hold it
    from scipy.sparse import csgraph  # noqa: PLC0415

    if not count:
        return 0, np.zeros(0, dtype=np.int64)
    graph = sparse.coo_matrix((np.ones(len(first), dtype=np.int8), (first, second)), (count, count))
    groups, owner = csgraph.connected_components(graph, directed=False)
    return int(groups), owner.astype(np.int64)


def _peaks(smooth: FloatArray, first: IntArray, second: IntArray) -> BoolArray:
    """Return which pixels (m,) are higher than all that touch them; of equals the last one wins.

    What is not above the noise is lower than what is.
    """
    best = np.ones(len(smooth), dtype=bool)
    best[first[smooth[first] <= smooth[second]]] = False
    best[second[smooth[second] < smooth[first]]] = False
    return best


def _ceiling(counts: FloatArray, pixels: Image, given: float | None) -> float:
    """Return the count at which pixels clip: given, seen as a plateau, or the type's top; inf for none."""
    if given is not None:
        return given
    top = float(np.iinfo(pixels.dtype).max) if pixels.dtype.kind in "ui" else np.inf
    highest = counts.max(initial=-np.inf)
    if highest >= top:
        return top
    # Counts pile up where the converter ends; in a dim frame's noise the last count is the rarest.
    if not len(counts):
        return top
    at_top = int(np.count_nonzero(counts == highest))
    step = max(1.0, _PLATEAU_REACH * float(highest - np.median(counts)))
    below = int(np.count_nonzero(counts >= highest - step)) - at_top
    flat = at_top >= _PLATEAU and at_top > _PILED_UP * below
    return float(highest) if flat else top
