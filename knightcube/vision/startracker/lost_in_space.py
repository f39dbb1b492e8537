"""Lost in space: identification of the stars of a frame without prior information.

Triangles of the brightest observed stars are looked up by shape, orientation and size among the triangles of
guide stars. Each match of an observed triangle with a triangle of the index votes for three pairs of an
observed star and a guide star. A correct pair occurs in many triangles, whereas a chance pair occurs in only
one. The matches with the most votes are verified against the whole field until one match is accepted. If no
match is accepted, triangles of all observed stars are looked up instead of triangles of the brightest stars.
About a thousand triangles are looked up. Even if most observed points are not stars, some of the triangles
consist of true stars only. If no match is accepted, the mirrored field is tried. Finally, if the given range
of image scales is narrow, scales outside it are tried, because the range may be wrong.

The shape of a triangle on the sphere depends slightly on the scale of the image. A wide range of image scales
is divided into steps that are so narrow that the side ratios stay within the tolerance.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache

import numpy as np
import numpy.typing as npt

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.compiled import compiled_form_of, loop_helper
from knightcube.vision.startracker.attitude_fit import (
    MatchStatus,
    ScaleSteps,
    StarField,
    StarMatch,
    stretched,
)
from knightcube.vision.startracker.index import (
    CELL,
    CELLS,
    FINE,
    LEAST_RATIO,
    RUN_BITS,
    SIZE_BITS,
    SIZE_UNIT,
    SkyIndex,
)
from knightcube.vision.startracker.verification import VerificationSettings, nothing, verify_first

_BRIGHTEST = 12
_NEIGHBOURS = 5
_CENTRES = 40
_MOST_STARS = 64
# Limits of the longest side of a medium-sized triangle, relative to the width of the field.
# Larger triangles are in the index only for bright stars; smaller ones have inaccurate side ratios.
_MIDDLE_SIZES = 0.3, 0.75


@dataclass(frozen=True, slots=True)
class BatchSizes:
    """Sizes of the successive batches of triangles that are looked up in the index.

    Attributes:
        bright: number of triangles in each batch of only the brightest stars, which identify most frames.
        spread: number of triangles in each batch that includes faint stars, for frames whose brightest points
            are not stars.
    """

    bright: tuple[int, ...] = (60, 250)
    spread: tuple[int, ...] = (300, 1000)


def batches_of(
    field: StarField, sizes: BatchSizes, steps: int, spread: Callable[[], list[IntArray]]
) -> Iterator[tuple[IntArray, bool]]:
    """Yield batches of triangles (t, 3), and whether each batch includes faint stars.

    The size of a batch with only the brightest stars is divided by the square root of the number of scale
    steps, `steps`. The function `spread` returns the batches that include faint stars, and is called last,
    because most frames are identified by their brightest stars.
    """
    brightest = triples(min(len(field), _BRIGHTEST))
    begin = 0
    for size in sizes.bright:
        end = min(begin + max(20, int(size / steps**0.5)), len(brightest))
        if end > begin:
            yield brightest[begin:end], False
        begin = end
    if len(field) > _BRIGHTEST or begin < len(brightest):
        yield from ((triangles, True) for triangles in spread() if len(triangles))


def spread_batches(field: StarField, sizes: BatchSizes) -> list[IntArray]:
    """Return batches of triangles (t, 3) of bright and faint stars.

    The last batch also includes triangles of neighbouring stars if the field has more than `_MOST_STARS`
    points, or more than `_BRIGHTEST` points of unknown magnitude. A field and its mirror image have the same
    batches.
    """
    batches = np.split(middle_sized(field, sum(sizes.spread)), np.cumsum(sizes.spread)[:-1])
    if len(field) > (_BRIGHTEST if field.magnitude is None else _MOST_STARS):
        batches[-1] = np.concatenate([batches[-1], neighbours(field)])
    return batches


def middle_sized(field: StarField, most: int) -> IntArray:
    """Return up to `most` medium-sized triangles (t, 3) of the brightest stars, in a random order."""
    triangles = triples(min(len(field), _MOST_STARS), shuffled=True)
    direction = field.direction[:_MOST_STARS]
    # The longest side of a triangle connects the two stars with the smallest cosine of their angle.
    cosine = (direction @ direction.T).ravel()
    shortest, longest = (2.0 * max(field.half_width) * size for size in _MIDDLE_SIZES)
    found = [triangles[:0]]
    while len(triangles) and sum(map(len, found)) < most:
        tried, triangles = triangles[: 2 * most], triangles[2 * most :]
        first, second, third = tried.T
        pairs = np.stack([first, second, third]) * len(direction) + np.stack([second, third, first])
        chord = 2.0 - 2.0 * cosine[pairs].min(axis=0)
        found.append(tried[(chord >= shortest**2) & (chord <= longest**2)])
    return np.concatenate(found)[:most]


@lru_cache(maxsize=64)
def triples(count: int, shuffled: bool = False) -> IntArray:
    """Return all triangles (t, 3) of `count` stars, sorted by the index of each triangle's faintest star.

    If `shuffled` is true, the triangles are in a random order, which is the same in each call.
    """
    first, second, third = np.meshgrid(*[np.arange(count)] * 3, indexing="ij")
    ascending = (first < second) & (second < third)
    triangles = np.stack([first[ascending], second[ascending], third[ascending]], axis=-1)
    order = np.random.default_rng(count).permutation(len(triangles)) if shuffled else np.lexsort(triangles.T)
    return np.asarray(triangles[order])


def neighbours(field: StarField) -> IntArray:
    """Return triangles (t, 3) of a star and two of its nearest neighbours of any brightness."""
    cosines = field.direction[:_CENTRES] @ field.direction.T
    near = np.argsort(-cosines, axis=1)[:, 1 : _NEIGHBOURS + 1]
    one, two = np.triu_indices(_NEIGHBOURS, 1)
    corners = np.stack(
        np.broadcast_arrays(np.arange(len(near))[:, None], near[:, one], near[:, two]), axis=-1
    ).reshape(-1, 3)
    one, two, three = np.sort(corners, axis=1).T
    packed = np.unique((one * len(field) + two) * len(field) + three)
    pair, three = np.divmod(packed, len(field))
    return np.stack([*np.divmod(pair, len(field)), three], axis=-1)


_LARGEST_SIZE = (1 << SIZE_BITS) - 1


@dataclass(frozen=True, slots=True, eq=False)
class TriangleMatches:
    """Matches of observed triangles with triangles of guide stars.

    Attributes:
        observed: indices of the observed stars at the corners of each match (k, 3), uint16.
        star: indices of the guide stars at the corresponding corners (k, 3), uint16.
        scale: factor (k,) on the observed tangents for which both triangles have equal longest sides.
        code: hash codes (k, 3), uint32, of the three pairs of an observed star and a guide star in each
            match. In two matches of similar scale, the same pair has the same code.
    """

    observed: npt.NDArray[np.uint16]
    star: npt.NDArray[np.uint16]
    scale: FloatArray
    code: npt.NDArray[np.uint32]

    def __len__(self) -> int:
        return len(self.scale)

    @classmethod
    def of(cls, parts: Sequence[TriangleMatches]) -> TriangleMatches:
        """Return the concatenation of several sets of matches."""
        if len(parts) == 1:
            return parts[0]
        return cls(
            np.concatenate([part.observed for part in parts]),
            np.concatenate([part.star for part in parts]),
            np.concatenate([part.scale for part in parts]),
            np.concatenate([part.code for part in parts]),
        )


_BINS_PER_LN_SCALE = 15.0
# Factors of a multiplicative hash. They are below 2^31, so that products fit into 64 bits.
_OF_STAR, _OF_PAIR, _OF_CODE = 1021, 257, 1_640_531_527


def _codes(
    observed: npt.NDArray[np.uint16], star: npt.NDArray[np.uint16], scale: FloatArray, lowest: float
) -> npt.NDArray[np.uint32]:
    """Return hash codes (k, 3) of the pairs in k matches; equal pairs of similar scale have equal codes."""
    bins = (np.log(scale / lowest) * _BINS_PER_LN_SCALE).astype(np.uint32)
    pair = star.astype(np.uint32) * np.uint32(_OF_STAR) + observed
    return np.asarray((pair * np.uint32(_OF_PAIR) + bins[:, None]) * np.uint32(_OF_CODE))


def _votes(code: npt.NDArray[np.uint32]) -> npt.NDArray[np.intp]:
    """Return the votes (k,) for each of k matches of triangles.

    The votes of a pair of an observed star and a guide star are the number of matches of similar scale that
    contain the pair. The votes of a match are the sum of the votes of its three pairs. In rare cases,
    different pairs have the same first bits of their codes, and their votes are added.
    """
    bits = max(13, code.size.bit_length())
    slot = code >> np.uint32(32 - bits)
    return np.asarray(np.bincount(slot.ravel(), minlength=1 << bits)[slot].sum(axis=1))


def look_up(
    field: StarField,
    sky: SkyIndex,
    steps: ScaleSteps,
    triangles: IntArray,
    tolerance: float,
    distortion: float,
    most: int,
) -> tuple[TriangleMatches, int]:
    """Return the matches of observed triangles in the index, and the number of index entries read.

    The array `triangles` (t, 3) contains the indices of the observed stars at the corners of each triangle.
    The tolerance of a side ratio is in standard deviations, with an additional error due to `distortion` of
    the lens. At most `most` index entries are read, in the order of the observed triangles.
    """
    observed, star, scale, code, read = _look_up(
        np.ascontiguousarray(field.direction),
        np.ascontiguousarray(field.sigma),
        np.array([steps.middle, steps.lowest, steps.highest]),
        np.ascontiguousarray(triangles),
        tolerance,
        distortion,
        LEAST_RATIO,
        most,
        *sky.triangles.table,
    )
    return TriangleMatches(observed, star, scale, code), read


_Matches = tuple[npt.NDArray[np.uint16], npt.NDArray[np.uint16], FloatArray, npt.NDArray[np.uint32]]
_Found = tuple[*_Matches, int]


def _look_up_numpy(
    direction: FloatArray,
    sigma: FloatArray,
    steps: FloatArray,
    triangles: IntArray,
    tolerance: float,
    distortion: float,
    least_ratio: float,
    most: int,
    key: npt.NDArray[np.uint32],
    star_of: npt.NDArray[np.uint16],
    places: npt.NDArray[np.uint16],
    below: npt.NDArray[np.int32],
    layout: IntArray,
) -> _Found:
    """Return the arrays of the `TriangleMatches`, and the number of entries read."""
    scales = steps[0]
    corners, sides, left = _forms(direction, triangles, scales)
    size = np.maximum(sides[:, 2], SIZE_UNIT)
    spread = np.sqrt(np.mean(sigma[corners] ** 2, axis=1))
    step = np.tile(np.arange(len(scales)), len(triangles))
    # The error of a side ratio is computed from the errors of two directions and of the longest side.
    slack = (1.6 * tolerance) * spread * scales[step] / size + distortion
    ratio = sides[:, :2] / size[:, None]
    usable = np.flatnonzero((slack <= CELL) & (ratio[:, 0] + slack >= least_ratio))
    corners, size, left = corners[usable], size[usable], left[usable]
    slack, ratio, step = slack[usable], ratio[usable], step[usable]
    lowest = size * (steps[1] / scales)[step] * (1.0 - slack)
    highest = size * (steps[2] / scales)[step] * (1.0 + slack)
    query, short, middle, begin, end = _runs(below, ratio, slack, left, lowest, highest)
    # Only the first ranges of index entries are read, with at most `most` entries in total.
    count = end - begin
    kept = int(np.searchsorted(np.cumsum(count), most, side="right"))
    begin, count = begin[:kept], count[:kept]
    query, short, middle = query[: len(count)], short[: len(count)], middle[: len(count)]
    # Arrays of int32 instead of int64 halve the computing time, of which most is spent on index entries.
    first = (begin - (np.cumsum(count) - count)).astype(np.int32)
    entry = np.arange(int(count.sum()), dtype=np.int32) + np.repeat(first, count)
    near = np.ones(len(entry), dtype=np.bool_)
    place = places[entry].view(np.uint8).reshape(-1, 2)
    for column, cells in enumerate((short, middle)):
        lowest_place, width = _places(ratio[query, column], slack[query], cells)
        # Differences of unsigned bytes wrap around, so that positions below the lowest position are excluded.
        near &= place[:, column] - np.repeat(lowest_place, count) <= np.repeat(width, count)
    chosen = np.flatnonzero(near)
    total = len(entry)
    entry = entry[chosen]
    query = query[np.searchsorted(np.cumsum(count), chosen, side="right")]
    longest = (key[entry] & np.uint32(_LARGEST_SIZE)) * SIZE_UNIT
    # The ranges of index entries also contain triangles that are too small or too large for the scale step.
    fits = np.flatnonzero((longest >= lowest[query]) & (longest <= highest[query]))
    entry, query, longest = entry[fits], query[fits], longest[fits]
    scale = longest / size[query] * scales[step[query]]
    observed, star = corners[query].astype(np.uint16), star_of[entry]
    return observed, star, scale, _codes(observed, star, scale, steps[1, 0] * (1.0 - CELL)), total


@compiled_form_of(_look_up_numpy)
def _look_up(
    direction: FloatArray,
    sigma: FloatArray,
    steps: FloatArray,
    triangles: IntArray,
    tolerance: float,
    distortion: float,
    least_ratio: float,
    most: int,
    key: npt.NDArray[np.uint32],
    star_of: npt.NDArray[np.uint16],
    places: npt.NDArray[np.uint16],
    below: npt.NDArray[np.int32],
    layout: IntArray,
) -> _Found:
    cells, unit = layout[0], 1.0 / (1 << layout[2])
    lowest = steps[1, 0] * (1.0 - 1.0 / cells)
    seen = _at_scales(direction, steps[0])
    # If a triangle is sufficiently accurate, at most three cells agree with each of its two side ratios.
    runs = np.empty((9 * len(triangles) * len(seen), 7), dtype=np.int64)
    limits = np.empty((len(triangles) * len(seen), 3))
    corners = np.empty((len(triangles) * len(seen), 3), dtype=np.int64)
    side = np.empty(3)
    queries, count, total = 0, 0, 0
    for t in range(len(triangles)):
        for s in range(len(seen)):
            left = _sorted_sides(seen[s], triangles[t], side, corners[queries])
            a, b, c = sigma[corners[queries, 0]], sigma[corners[queries, 1]], sigma[corners[queries, 2]]
            size = max(side[2], unit)
            spread = math.sqrt((a * a + b * b + c * c) / 3.0)
            slack = 1.6 * tolerance * spread * steps[0, s] / size + distortion
            if not (slack <= 1.0 / cells and side[0] / size + slack >= least_ratio):
                continue
            limits[queries, 0] = size * (steps[1, s] / steps[0, s]) * (1.0 - slack)
            limits[queries, 1] = size * (steps[2, s] / steps[0, s]) * (1.0 + slack)
            limits[queries, 2] = steps[0, s] / size
            added = _add_runs(
                left, side[0] / size, side[1] / size, slack, limits[queries], below, layout, runs[count:]
            )
            for run in range(count, count + added):
                if total + runs[run, 1] - runs[run, 0] > most:
                    kept = _matching_entries(runs[:run], total, limits, key, places, layout)
                    return *_matches(*kept, limits, corners, key, star_of, layout, lowest), total
                total += runs[run, 1] - runs[run, 0]
                runs[run, 6] = queries
            queries, count = queries + 1, count + added
    kept = _matching_entries(runs[:count], total, limits, key, places, layout)
    return *_matches(*kept, limits, corners, key, star_of, layout, lowest), total


@loop_helper
def _add_runs(
    left: int,
    short: float,
    middle: float,
    slack: float,
    limits: FloatArray,
    below: npt.NDArray[np.int32],
    layout: IntArray,
    runs: IntArray,
) -> int:
    """Write the ranges of keys that may contain triangles similar to an observed triangle to `runs`.

    Each row of `runs` contains the first index of a range, the index after the last, and the lowest and
    highest possible positions of both side ratios within their cells. Returns the number of ranges.
    """
    cells, fine, size_bits, run_bits = layout
    sizes = 1 << size_bits
    first, last = int(min(limits[0] * sizes, sizes - 1.0)), int(min(limits[1] * sizes, sizes - 1.0))
    count = 0
    for i in range(max(int((short - slack) * cells), 0), min(int((short + slack) * cells), cells - 1) + 1):
        low, high = _place_limits(short, slack, i, cells, fine)
        from_cell, to_cell = int((middle - slack) * cells), int((middle + slack) * cells)
        for j in range(max(from_cell, 0), min(to_cell, cells - 1) + 1):
            form = ((left * cells + i) * cells + j) << size_bits
            lower, upper = _place_limits(middle, slack, j, cells, fine)
            runs[count, 0] = below[(form | first) >> run_bits]
            runs[count, 1] = below[((form | last) >> run_bits) + 1]
            runs[count, 2], runs[count, 3], runs[count, 4], runs[count, 5] = low, high, lower, upper
            count += 1
    return count


@loop_helper
def _matching_entries(
    runs: IntArray,
    total: int,
    limits: FloatArray,
    key: npt.NDArray[np.uint32],
    places: npt.NDArray[np.uint16],
    layout: IntArray,
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
    """Return the index entries (k,) that match, among the `total` entries in `runs`, and their triangles."""
    entry, query = np.empty(total + 8, dtype=np.int32), np.empty(total + 8, dtype=np.int32)
    found, sizes, most = 0, 1 << layout[2], 0
    for run in range(len(runs)):
        most = max(most, runs[run, 1] - runs[run, 0])
    # Eight entries are compared at a time, so that the compiled comparison consists of vector instructions.
    near = np.zeros(8 * (most // 8 + 1), dtype=np.uint8)
    eight = near.view(np.uint64)
    for run in range(len(runs)):
        begin, end, low, high, lower, upper, triangle = runs[run]
        if begin == end:
            continue
        # All entries of a range are in the same cells.
        # Entries outside the range are excluded by the length of their longest side.
        form = np.int64(key[begin]) & ~(sizes - 1)
        shortest = form + min(math.ceil(limits[triangle, 0] * sizes), sizes - 1)
        longest = form + min(math.floor(limits[triangle, 1] * sizes), sizes - 1)
        groups = (end - begin + 7) // 8
        begin = max(min(begin, len(key) - 8 * groups), 0)
        lengths = key[begin : begin + 8 * groups]
        if len(lengths) < 8 * groups:
            near[:] = 0
        _mark(
            near[: len(lengths)],
            lengths,
            places[begin : begin + 8 * groups],
            (np.uint32(shortest), np.uint32(longest)),
            (np.uint8(low), np.uint8(high)),
            (np.uint8(lower), np.uint8(upper)),
        )
        for group in range(groups):
            if eight[group]:
                for k in range(8 * group, 8 * group + 8):
                    entry[found], query[found] = begin + k, triangle
                    found += int(near[k])
    return entry[:found], query[:found]


@loop_helper
def _mark(
    near: npt.NDArray[np.uint8],
    lengths: npt.NDArray[np.uint32],
    places: npt.NDArray[np.uint16],
    length: tuple[np.uint32, np.uint32],
    short: tuple[np.uint8, np.uint8],
    middle: tuple[np.uint8, np.uint8],
) -> None:
    """Write 1 to `near` (k,) for index entries within the limits of key and positions, otherwise 0."""
    for k in range(len(near)):
        one, two = np.uint8(places[k] & 0xFF), np.uint8(places[k] >> 8)
        fits = (lengths[k] >= length[0]) & (lengths[k] <= length[1])
        fits &= (one >= short[0]) & (one <= short[1]) & (two >= middle[0]) & (two <= middle[1])
        near[k] = np.uint8(fits)


@loop_helper
def _matches(
    entry: npt.NDArray[np.int32],
    query: npt.NDArray[np.int32],
    limits: FloatArray,
    corners: IntArray,
    key: npt.NDArray[np.uint32],
    star_of: npt.NDArray[np.uint16],
    layout: IntArray,
    lowest: float,
) -> _Matches:
    """Return the arrays of the `TriangleMatches` for k index entries that match the triangles `query`."""
    observed, star = np.empty((len(entry), 3), dtype=np.uint16), np.empty((len(entry), 3), dtype=np.uint16)
    scale, code = np.empty(len(entry)), np.empty((len(entry), 3), dtype=np.uint32)
    sizes = 1 << layout[2]
    for k in range(len(entry)):
        one, two = entry[k], query[k]
        scale[k] = float(np.int64(key[one]) & (sizes - 1)) / sizes * limits[two, 2]
        part = int(math.log(scale[k] / lowest) * _BINS_PER_LN_SCALE)
        for c in range(3):
            observed[k, c], star[k, c] = corners[two, c], star_of[one, c]
            pair = np.int64(star_of[one, c]) * _OF_STAR + corners[two, c]
            code[k, c] = ((pair * _OF_PAIR + part) & 0xFFFFFFFF) * _OF_CODE & 0xFFFFFFFF
    return observed, star, scale, code


@loop_helper
def _at_scales(direction: FloatArray, scales: FloatArray) -> FloatArray:
    """Return unit vectors (s, n, 3) at s scales."""
    seen = np.empty((len(scales), len(direction), 3))
    for s in range(len(scales)):
        for i in range(len(direction)):
            x, y, z = scales[s] * direction[i, 0], scales[s] * direction[i, 1], direction[i, 2]
            norm = math.sqrt(x * x + y * y + z * z)
            seen[s, i, 0], seen[s, i, 1], seen[s, i, 2] = x / norm, y / norm, z / norm
    return seen


@loop_helper
def _sorted_sides(seen: FloatArray, triangle: IntArray, side: FloatArray, corner: IntArray) -> int:
    """Write sorted sides and their opposite corners; return 1 if their orientation is left, otherwise 0."""
    for c in range(3):
        one, two = triangle[(c + 1) % 3], triangle[(c + 2) % 3]
        cosine = seen[one, 0] * seen[two, 0] + seen[one, 1] * seen[two, 1] + seen[one, 2] * seen[two, 2]
        length = math.sqrt(max(2.0 - 2.0 * cosine, 0.0))
        at = c
        while at > 0 and side[at - 1] > length:
            side[at], corner[at] = side[at - 1], corner[at - 1]
            at -= 1
        side[at], corner[at] = length, triangle[c]
    a, b, c = corner[0], corner[1], corner[2]
    au, av = seen[a, 0] / seen[a, 2], seen[a, 1] / seen[a, 2]
    bu, bv = seen[b, 0] / seen[b, 2], seen[b, 1] / seen[b, 2]
    cu, cv = seen[c, 0] / seen[c, 2], seen[c, 1] / seen[c, 2]
    return 1 if (bu - au) * (cv - av) > (cu - au) * (bv - av) else 0


@loop_helper
def _place_limits(ratio: float, slack: float, cell: int, cells: int, fine: int) -> tuple[int, int]:
    """Return the lowest and highest position within a cell that differ from `ratio` by at most `slack`."""
    wanted = ratio * (cells * fine) - 0.5 - cell * fine
    reach = slack * (cells * fine) + 0.5
    lowest = min(max(math.ceil(wanted - reach), 0), fine - 1)
    return lowest, min(max(math.floor(wanted + reach), lowest), fine - 1)


def _places(
    ratio: FloatArray, slack: FloatArray, cells: IntArray
) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.uint8]]:
    """Return the lowest position in a cell within `slack` of each ratio, and the range of positions."""
    # Positions within a cell are in units of 1 / FINE of its width, and refer to the middle of a unit.
    wanted = ratio * (CELLS * FINE) - 0.5 - cells * FINE
    reach = slack * (CELLS * FINE) + 0.5
    lowest = np.clip(np.ceil(wanted - reach), 0, FINE - 1)
    highest = np.clip(np.floor(wanted + reach), lowest, FINE - 1)
    return lowest.astype(np.uint8), (highest - lowest).astype(np.uint8)


def _forms(
    seen: FloatArray, triangles: IntArray, scales: FloatArray
) -> tuple[IntArray, FloatArray, BoolArray]:
    """Return corners and sides (t s, 3) of t triangles at s scales, sorted by side length.

    The third returned value is the orientation of the corners in the image (t s,).
    """
    x, y, z = seen.T
    direction = np.empty((len(scales), len(seen), 3))
    direction[:, :, 0] = scales[:, None] * x
    direction[:, :, 1] = scales[:, None] * y
    direction[:, :, 2] = z
    direction /= np.sqrt(np.einsum("sij,sij->si", direction, direction))[:, :, None]
    first, second, third = triangles.T
    one = np.stack([second, third, first], axis=-1)
    two = np.stack([third, first, second], axis=-1)
    cosine = (direction @ direction.transpose(0, 2, 1))[:, one, two]
    sides = np.sqrt(np.maximum(2.0 - 2.0 * cosine, 0.0)).transpose(1, 0, 2).reshape(-1, 3)
    order = np.argsort(sides, axis=1)
    rows = np.arange(len(sides))[:, None]
    corners = np.repeat(triangles, len(scales), axis=0)[rows, order]
    a, b, c = corners.T
    u, v = x / z, y / z
    left = (u[b] - u[a]) * (v[c] - v[a]) > (u[c] - u[a]) * (v[b] - v[a])
    return corners, sides[rows, order], left


def _runs(
    below: npt.NDArray[np.int32],
    ratio: FloatArray,
    slack: FloatArray,
    left: BoolArray,
    lowest: FloatArray,
    highest: FloatArray,
) -> tuple[IntArray, IntArray, IntArray, IntArray, IntArray]:
    """Return the ranges of sorted triangle keys that may contain triangles similar to observed triangles.

    For each range, the result contains the index of the observed triangle (query), the cells of its two side
    ratios, the first index in the sorted keys, and the index after the last. Each side ratio of an observed
    triangle may lie in up to three cells.
    """
    low = np.maximum(((ratio - slack[:, None]) * CELLS).astype(np.int64), 0)
    high = np.minimum(((ratio + slack[:, None]) * CELLS).astype(np.int64), CELLS - 1)
    spans = high - low
    widest = int(spans.max(initial=0)) + 1
    here = np.arange(widest) <= spans[:, :, None]
    # The ranges are sorted by observed triangle, because only the first ranges are read.
    query, along_short, along_middle = np.nonzero(here[:, 0, :, None] & here[:, 1, None, :])
    short = low[query, 0] + along_short
    middle = low[query, 1] + along_middle
    form = ((left[query] * CELLS + short) * CELLS + middle) << SIZE_BITS
    first = np.minimum(lowest / SIZE_UNIT, _LARGEST_SIZE).astype(np.int64)[query]
    last = np.minimum(highest / SIZE_UNIT, _LARGEST_SIZE).astype(np.int64)[query]
    begin, end = below[(form | first) >> RUN_BITS], below[((form | last) >> RUN_BITS) + 1]
    return query, short, middle, begin, end


@dataclass(frozen=True, slots=True)
class IdentificationSettings:
    """Settings of the identification without prior attitude.

    Attributes:
        tolerance: tolerance of the ratios of a triangle's sides, in standard deviations.
        distortion: additional error of a side ratio due to distortion of the lens.
        batches: numbers of observed triangles to look up in each batch.
        work: maximum number of index entries to read.
        verified: maximum number of candidate attitudes to verify after each batch of triangles.
        mirror: whether the mirrored field is tried if the field itself is not identified.
        hint_error: factor by which a narrow range of scales is extended at both ends if no match is found; 1
            for no extension. The range (1, 1) of a calibrated camera is never extended.
        verification: settings of the verification of candidates.
    """

    tolerance: float = 3.0
    distortion: float = 0.0015
    batches: BatchSizes = field(default_factory=BatchSizes)
    work: int = 600_000
    verified: int = 12
    mirror: bool = True
    hint_error: float = 1.25
    verification: VerificationSettings = field(default_factory=VerificationSettings)


# Factor on the tolerance and on the number of verified candidates for triangles that include faint stars.
# The factor is below 1, because many true triangles vote for the same pairs.
_OF_SPREAD = 0.6
# Number of matches with the most votes that are considered for each candidate to be verified.
_RANKED = 8
# Factor on the expected number of chance matches for a mirrored field or a scale outside the given range.
_RARE = 10.0
DEFAULT = IdentificationSettings()


def identify(observed: StarField, sky: SkyIndex, settings: IdentificationSettings = DEFAULT) -> StarMatch:
    """Return the identified stars and the attitude of a frame, or a status that states the failure."""
    if len(observed) < settings.verification.least_matches:
        return nothing(observed, MatchStatus.TOO_FEW_STARS)
    spread = cache(lambda: spread_batches(observed, settings.batches))
    answer = _search(observed, sky, settings, 1.0, spread)
    if answer.status is not MatchStatus.IDENTIFIED and settings.mirror:
        answer = _search(observed.mirrored(), sky, settings, _RARE, spread)
        answer = replace(answer, mirrored=answer.status is MatchStatus.IDENTIFIED)
    lowest, highest = observed.scale
    if answer.status is not MatchStatus.IDENTIFIED and 1.0 < highest / lowest < settings.hint_error**2:
        wider = lowest / settings.hint_error, highest * settings.hint_error
        answer = _search(replace(observed, scale=wider), sky, settings, _RARE, spread)
    return answer


def _search(
    observed: StarField,
    sky: SkyIndex,
    settings: IdentificationSettings,
    searched: float,
    spread_triangles: Callable[[], list[IntArray]],
) -> StarMatch:
    """Return the identification of a field, without trying the mirrored field or other scales."""
    steps = ScaleSteps.of(observed, settings.distortion)
    found: list[TriangleMatches] = []
    tried = np.empty((0, 2), dtype=np.int64)
    work = 0
    for triangles, spread in batches_of(observed, settings.batches, len(steps), spread_triangles):
        share = _OF_SPREAD if spread else 1.0
        finds, read = look_up(
            observed,
            sky,
            steps,
            triangles,
            share * settings.tolerance,
            settings.distortion,
            settings.work - work,
        )
        if len(finds):
            found.append(finds)
        most = round(share * settings.verified)
        if found:
            direction, whole = np.ascontiguousarray(observed.direction), TriangleMatches.of(found)
            matches = whole.observed, whole.star, whole.scale, whole.code
            matrices, scales, tried = _choose(
                direction, sky.stars.direction, *matches, tried, most, *observed.scale
            )
            answer = verify_first(observed, sky, matrices, scales, searched, settings.verification)
            if answer.status is MatchStatus.IDENTIFIED:
                return answer
        work += read
        if work >= settings.work:
            break
    return nothing(observed)


_Chosen = tuple[FloatArray, FloatArray, IntArray]


def _choose_numpy(
    direction: FloatArray,
    guide: FloatArray,
    observed: npt.NDArray[np.uint16],
    star: npt.NDArray[np.uint16],
    scale: FloatArray,
    code: npt.NDArray[np.uint32],
    tried: IntArray,
    most: int,
    lowest: float,
    highest: float,
) -> _Chosen:
    """Return attitude matrices (c, 3, 3) and scales (c,) of the matches with the most votes.

    A match is omitted if two of its pairs of an observed star and a guide star are among the pairs `tried`
    (k, 2). The third returned value is the array `tried`, extended by the pairs of the new candidates.
    """
    votes = _votes(code)
    # There may be a hundred thousand matches, so only the matches with the most votes are sorted.
    count = min(_RANKED * most, len(votes))
    least = np.partition(votes, len(votes) - count)[len(votes) - count]
    more, equal = np.flatnonzero(votes > least), np.flatnonzero(votes == least)
    first = np.concatenate([more, equal[: count - len(more)]])
    pairs_tried = set(map(tuple, tried.tolist()))
    matrices, scales = [], []
    for find in first[np.lexsort((first, -votes[first]))].tolist():
        pairs = list(zip(observed[find].tolist(), star[find].tolist(), strict=True))
        if sum(pair in pairs_tried for pair in pairs) >= 2:
            continue
        pairs_tried.update(pairs)
        tried = np.concatenate([tried, pairs])
        # The attitude transforms the guide stars of the match into the observed stars.
        seen = stretched(direction[observed[find]], float(scale[find]))
        matrices.append(_frame(seen).T @ _frame(guide[star[find]]))
        # The scale from one triangle is inaccurate, so it is limited to the range of possible scales.
        scales.append(min(max(float(scale[find]), lowest), highest))
        if len(scales) == most:
            break
    return np.array(matrices).reshape(-1, 3, 3), np.array(scales), tried


@compiled_form_of(_choose_numpy)
def _choose(
    direction: FloatArray,
    guide: FloatArray,
    observed: npt.NDArray[np.uint16],
    star: npt.NDArray[np.uint16],
    scale: FloatArray,
    code: npt.NDArray[np.uint32],
    tried: IntArray,
    most: int,
    lowest: float,
    highest: float,
) -> _Chosen:
    votes = _counted_votes(code)
    order = _most_voted(votes, min(_RANKED * most, len(votes)))
    pairs = np.empty((len(tried) + 3 * most, 2), dtype=np.int64)
    pairs[: len(tried)] = tried
    matrices, scales = np.empty((most, 3, 3)), np.empty(most)
    seen, wanted = np.empty((3, 3)), np.empty((3, 3))
    known, count = len(tried), 0
    for find in order:
        if _shared_pairs(pairs[:known], observed[find], star[find]) >= 2:
            continue
        squared = scale[find] * scale[find]
        for c in range(3):
            one, two = np.int64(observed[find, c]), np.int64(star[find, c])
            pairs[known, 0], pairs[known, 1] = one, two
            known += 1
            z = direction[one, 2]
            shrink = 1.0 / math.sqrt(squared + (1.0 - squared) * z * z)
            seen[0, c] = direction[one, 0] * scale[find] * shrink
            seen[1, c] = direction[one, 1] * scale[find] * shrink
            seen[2, c] = z * shrink
            for axis in range(3):
                wanted[axis, c] = guide[two, axis]
        _into_frame(seen)
        _into_frame(wanted)
        for row in range(3):
            for column in range(3):
                total = 0.0
                for axis in range(3):
                    total += seen[row, axis] * wanted[column, axis]
                matrices[count, row, column] = total
        scales[count] = min(max(scale[find], lowest), highest)
        count += 1
        if count == most:
            break
    return matrices[:count].copy(), scales[:count].copy(), pairs[:known].copy()


@loop_helper
def _shared_pairs(pairs: IntArray, observed: npt.NDArray[np.uint16], star: npt.NDArray[np.uint16]) -> int:
    """Return how many of the three pairs of a match, (3,) and (3,), are among the pairs (k, 2)."""
    shared = 0
    for c in range(3):
        for k in range(len(pairs)):
            if pairs[k, 0] == observed[c] and pairs[k, 1] == star[c]:
                shared += 1
                break
    return shared


@loop_helper
def _counted_votes(code: npt.NDArray[np.uint32]) -> IntArray:
    """Return the votes (k,) of k matches, as `_votes` does."""
    bits, size = 0, 3 * len(code)
    while size:
        size >>= 1
        bits += 1
    bits = max(13, bits)
    unused = 32 - bits
    count = np.zeros(1 << bits, dtype=np.int32)
    for k in range(len(code)):
        for c in range(3):
            count[np.int64(code[k, c]) >> unused] += 1
    votes = np.empty(len(code), dtype=np.int64)
    for k in range(len(code)):
        votes[k] = 0
        for c in range(3):
            votes[k] += count[np.int64(code[k, c]) >> unused]
    return votes


@loop_helper
def _most_voted(votes: IntArray, wanted: int) -> IntArray:
    """Return the indices (`wanted`,) of the matches with the most votes; ties go to lower indices."""
    highest = 0
    for k in range(len(votes)):
        highest = max(highest, votes[k])
    # The index of the first match with v votes among the sorted matches is `begin[v]`.
    begin = np.zeros(highest + 2, dtype=np.int64)
    for k in range(len(votes)):
        begin[votes[k]] += 1
    above = 0
    for v in range(highest, -1, -1):
        here = begin[v]
        begin[v] = above
        above += here
    order = np.empty(wanted, dtype=np.int64)
    for k in range(len(votes)):
        at = begin[votes[k]]
        if at < wanted:
            order[at] = k
            begin[votes[k]] += 1
    return order


@loop_helper
def _into_frame(corners: FloatArray) -> None:
    """Replace the columns of `corners`, three unit vectors, by the axes that `_frame` returns as rows."""
    mx = corners[0, 0] + corners[0, 1] + corners[0, 2]
    my = corners[1, 0] + corners[1, 1] + corners[1, 2]
    mz = corners[2, 0] + corners[2, 1] + corners[2, 2]
    norm = math.sqrt(mx * mx + my * my + mz * mz)
    mx, my, mz = mx / norm, my / norm, mz / norm
    dx, dy, dz = corners[0, 0] - corners[0, 1], corners[1, 0] - corners[1, 1], corners[2, 0] - corners[2, 1]
    along = mx * dx + my * dy + mz * dz
    dx, dy, dz = dx - along * mx, dy - along * my, dz - along * mz
    norm = math.sqrt(dx * dx + dy * dy + dz * dz)
    dx, dy, dz = dx / norm, dy / norm, dz / norm
    corners[0, 0], corners[1, 0], corners[2, 0] = mx, my, mz
    corners[0, 1], corners[1, 1], corners[2, 1] = dx, dy, dz
    corners[0, 2], corners[1, 2], corners[2, 2] = my * dz - mz * dy, mz * dx - mx * dz, mx * dy - my * dx


def _frame(corners: FloatArray) -> FloatArray:
    """Return the axes (rows of (3, 3)) of a frame fixed to three unit vectors; the first is their mean."""
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = corners.tolist()
    mx, my, mz = ax + bx + cx, ay + by + cy, az + bz + cz
    norm = math.sqrt(mx * mx + my * my + mz * mz)
    mx, my, mz = mx / norm, my / norm, mz / norm
    dx, dy, dz = ax - bx, ay - by, az - bz
    along = mx * dx + my * dy + mz * dz
    dx, dy, dz = dx - along * mx, dy - along * my, dz - along * mz
    norm = math.sqrt(dx * dx + dy * dy + dz * dz)
    dx, dy, dz = dx / norm, dy / norm, dz / norm
    return np.array([[mx, my, mz], [dx, dy, dz], [my * dz - mz * dy, mz * dx - mx * dz, mx * dy - my * dx]])
