"""Looks up observed triangles in the index: all of them, at all steps of scale, at once."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.vision.startracker.identification.field import StarField
from knightcube.vision.startracker.index.sky_index import SkyIndex
from knightcube.vision.startracker.index.triangle_index import (
    CELL,
    CELLS,
    FINE,
    LEAST_RATIO,
    RUN_BITS,
    SIZE_BITS,
    SIZE_UNIT,
)

_LARGEST_SIZE = (1 << SIZE_BITS) - 1


@dataclass(frozen=True, slots=True, eq=False)
class ScaleSteps:
    """Ranges of scale that together cover the lens's range, each narrow enough for one set of shapes.

    Attributes:
        middle: (s,) scale at which the shapes are computed.
        lowest, highest: (s,) ends of each range.
    """

    middle: FloatArray
    lowest: FloatArray
    highest: FloatArray

    def __len__(self) -> int:
        return len(self.middle)

    @classmethod
    def of(cls, field: StarField, tolerance: float) -> ScaleSteps:
        """Return the steps for the scales of a field, with ratios of sides within `tolerance` in each.

        At the tangent t from the boresight a gnomonic image is stretched by 1 + t^2 along the radius and by
        1 + t^2 / 2 across it, so the ratio of two sides at half the way to the corner varies by t^2 / 2.
        """
        lowest, highest = field.scale
        half_way = 0.25 * (field.half_width[0] ** 2 + field.half_width[1] ** 2)
        count = max(1, math.ceil((highest**2 - lowest**2) * half_way / (4.0 * tolerance)))
        edges = np.sqrt(np.linspace(lowest**2, highest**2, count + 1))
        return cls(np.sqrt(edges[:-1] * edges[1:]), edges[:-1], edges[1:])


@dataclass(frozen=True, slots=True, eq=False)
class TriangleMatches:
    """Observed triangles that look like triangles of guide stars, corner by corner.

    Attributes:
        observed: (k, 3) uint32, numbers of observed stars.
        star: (k, 3) uint32, numbers of guide stars.
        scale: (k,) factor of the tangents that makes the longest sides equal.
    """

    observed: npt.NDArray[np.uint32]
    star: npt.NDArray[np.uint32]
    scale: FloatArray

    def __len__(self) -> int:
        return len(self.scale)

    @classmethod
    def of(cls, parts: Sequence[TriangleMatches]) -> TriangleMatches:
        """Return several as one."""
        if len(parts) == 1:
            return parts[0]
        return cls(
            np.concatenate([part.observed for part in parts]),
            np.concatenate([part.star for part in parts]),
            np.concatenate([part.scale for part in parts]),
        )

    def votes(self) -> IntArray:
        """Return for each pair of each match (k, 3) how many matches of about the same scale have it."""
        bins = np.log(self.scale) * _BINS_PER_LN_SCALE
        bins -= bins.min()
        bits = max(13, self.star.size.bit_length())
        # A multiplicative hash: two pairs rarely share a slot, and if they do it is harmless.
        code = (self.star * np.uint32(1021) + self.observed) * np.uint32(257)
        code += bins.astype(np.uint32)[:, None]
        slot = (code * np.uint32(2654435761)) >> np.uint32(32 - bits)
        return np.asarray(np.bincount(slot.ravel(), minlength=1 << bits)[slot])


_BINS_PER_LN_SCALE = 15.0


def look_up(
    field: StarField,
    sky: SkyIndex,
    steps: ScaleSteps,
    triangles: IntArray,
    tolerance: float,
    distortion: float,
    most: int,
) -> tuple[TriangleMatches, int]:
    """Return the matches of observed `triangles` (t, 3), and the number of index entries read.

    Args:
        field: the observed stars.
        sky: the guide stars' triangles.
        steps: ranges of scale.
        triangles: numbers of observed stars.
        tolerance: of a ratio of sides, in its sigmas.
        distortion: additional error of a ratio.
        most: entries that may be read; the first triangles take precedence.
    """
    corners, sides, left = _forms(field, triangles, steps)
    size = np.maximum(sides[:, 2], SIZE_UNIT)
    sigma = np.sqrt(np.mean(field.sigma[corners] ** 2, axis=1))
    step = np.tile(np.arange(len(steps)), len(triangles))
    # The error of a difference of two directions, and of the side that it is divided by.
    slack = (1.6 * tolerance) * sigma * steps.middle[step] / size + distortion
    ratio = sides[:, :2] / size[:, None]
    usable = np.flatnonzero((slack <= CELL) & (ratio[:, 0] + slack >= LEAST_RATIO))
    corners, size, left = corners[usable], size[usable], left[usable]
    slack, ratio, step = slack[usable], ratio[usable], step[usable]
    lowest = size * (steps.lowest / steps.middle)[step] * (1.0 - slack)
    highest = size * (steps.highest / steps.middle)[step] * (1.0 + slack)
    query, short, middle, begin, end = _runs(sky, ratio, slack, left, lowest, highest)
    begin, count = _affordable(begin, end, most)
    query, short, middle = query[: len(count)], short[: len(count)], middle[: len(count)]
    # int32: the entries are the bulk of the work.
    first = (begin - (np.cumsum(count) - count)).astype(np.int32)
    entry = np.arange(int(count.sum()), dtype=np.int32) + np.repeat(first, count)
    near = np.ones(len(entry), dtype=np.bool_)
    for column, cells in enumerate((short, middle)):
        lowest_place, width = _places(ratio[query, column], slack[query], cells)
        place = sky.triangles.shape[:, column][entry]
        # Below the lowest place the difference of the bytes wraps round to a large one.
        near &= place - np.repeat(lowest_place, count) <= np.repeat(width, count)
    chosen = np.flatnonzero(near)
    total = len(entry)
    entry = entry[chosen]
    query = query[np.searchsorted(np.cumsum(count), chosen, side="right")]
    longest = (sky.triangles.key[entry] & np.uint32(_LARGEST_SIZE)) * SIZE_UNIT
    # The runs hold some triangles too small or too large for the step.
    fits = np.flatnonzero((longest >= lowest[query]) & (longest <= highest[query]))
    entry, query, longest = entry[fits], query[fits], longest[fits]
    scale = longest / size[query] * steps.middle[step[query]]
    star = sky.triangles.corners[entry].astype(np.uint32)
    return TriangleMatches(corners[query].astype(np.uint32), star, scale), total


def _affordable(begin: IntArray, end: IntArray, most: int) -> tuple[IntArray, IntArray]:
    """Return begin and length of the first runs, which hold `most` entries at most."""
    count = end - begin
    kept = int(np.searchsorted(np.cumsum(count), most, side="right"))
    return begin[:kept], count[:kept]


def _places(
    ratio: FloatArray, slack: FloatArray, cells: IntArray
) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.uint8]]:
    """Return the lowest place in its cell that is within `slack` of each ratio, and how many follow it."""
    # In units of the finest division of a ratio, from its middle.
    wanted = ratio * (CELLS * FINE) - 0.5 - cells * FINE
    reach = slack * (CELLS * FINE) + 0.5
    lowest = np.clip(np.ceil(wanted - reach), 0, FINE - 1)
    highest = np.clip(np.floor(wanted + reach), lowest, FINE - 1)
    return lowest.astype(np.uint8), (highest - lowest).astype(np.uint8)


def _forms(
    field: StarField, triangles: IntArray, steps: ScaleSteps
) -> tuple[IntArray, FloatArray, BoolArray]:
    """Return corners (t s, 3) in order of the sides opposite, sides (t s, 3), whether they turn left."""
    x, y, z = field.direction.T
    direction = np.empty((len(steps), len(field), 3))
    direction[:, :, 0] = steps.middle[:, None] * x
    direction[:, :, 1] = steps.middle[:, None] * y
    direction[:, :, 2] = z
    direction /= np.sqrt(np.einsum("sij,sij->si", direction, direction))[:, :, None]
    first, second, third = triangles.T
    one = np.stack([second, third, first], axis=-1)
    two = np.stack([third, first, second], axis=-1)
    cosine = (direction @ direction.transpose(0, 2, 1))[:, one, two]
    sides = np.sqrt(np.maximum(2.0 - 2.0 * cosine, 0.0)).transpose(1, 0, 2).reshape(-1, 3)
    order = np.argsort(sides, axis=1)
    rows = np.arange(len(sides))[:, None]
    corners = np.repeat(triangles, len(steps), axis=0)[rows, order]
    a, b, c = corners.T
    u, v = x / z, y / z
    left = (u[b] - u[a]) * (v[c] - v[a]) > (u[c] - u[a]) * (v[b] - v[a])
    return corners, sides[rows, order], left


def _runs(
    sky: SkyIndex,
    ratio: FloatArray,
    slack: FloatArray,
    left: BoolArray,
    lowest: FloatArray,
    highest: FloatArray,
) -> tuple[IntArray, IntArray, IntArray, IntArray, IntArray]:
    """Return the runs of keys that hold triangles like the queries.

    For each run: its query, the cells of the short and the middle ratio, its begin and end. A query's ratios
    may lie in up to three cells each.
    """
    low = np.maximum(((ratio - slack[:, None]) * CELLS).astype(np.int64), 0)
    high = np.minimum(((ratio + slack[:, None]) * CELLS).astype(np.int64), CELLS - 1)
    spans = high - low
    widest = int(spans.max(initial=0)) + 1
    here = np.arange(widest) <= spans[:, :, None]
    # In order of the queries: the first triangles get the first of the entries that may be read.
    query, along_short, along_middle = np.nonzero(here[:, 0, :, None] & here[:, 1, None, :])
    short = low[query, 0] + along_short
    middle = low[query, 1] + along_middle
    form = ((left[query] * CELLS + short) * CELLS + middle) << SIZE_BITS
    first = np.minimum(lowest / SIZE_UNIT, _LARGEST_SIZE).astype(np.int64)[query]
    last = np.minimum(highest / SIZE_UNIT, _LARGEST_SIZE).astype(np.int64)[query]
    below = sky.triangles.below
    begin, end = below[(form | first) >> RUN_BITS], below[((form | last) >> RUN_BITS) + 1]
    return query, short, middle, begin, end
