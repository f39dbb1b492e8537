"""Connected areas of light above the noise: their moments, their peaks, and where they are a clutter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, Image, IntArray
from knightcube.vision.frame.regions import label_pixels, moments
from knightcube.vision.frame.saturation import saturation_of_bright
from knightcube.vision.startracker.detection.sky import BrightPixels, Sky

_BLOCK = 32


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
    owner, count = label_pixels(bright.index, bright.shape[1])
    row, column = np.divmod(bright.index, bright.shape[1])
    counts = pixels[row, column].astype(np.float64)
    light = np.maximum(counts - sky.level.at(column, row), 0.0)
    found = moments(owner, column, row, light, count)
    ceiling = saturation_of_bright(counts, pixels, saturation)
    return Areas(
        row,
        column,
        owner,
        bright.smooth,
        _peaks(bright.smooth, *_adjoining(bright.index, bright.shape[1])),
        counts >= ceiling,
        ceiling,
        np.bincount(owner, minlength=count),
        found.flux,
        found.centre,
        found.length,
        found.thickness,
        found.direction,
        bright.shape,
    )


def cluttered(areas: Areas, place: IntArray, share: float) -> BoolArray:
    """Return which pixels `place` (p, 2) lie in blocks of 32 px of which the areas fill more than `share`.

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


def _adjoining(index: IntArray, columns: int) -> tuple[IntArray, IntArray]:
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


def _peaks(smooth: FloatArray, first: IntArray, second: IntArray) -> BoolArray:
    """Return which pixels (m,) are higher than all that touch them; of equals the last one wins.

    Pixels below the noise threshold are lower than those above it.
    """
    best = np.ones(len(smooth), dtype=bool)
    best[first[smooth[first] <= smooth[second]]] = False
    best[second[smooth[second] < smooth[first]]] = False
    return best
