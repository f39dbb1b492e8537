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
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
import numpy.typing as npt

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.compiled import compiled_form_of, loop_helper
from knightcube.vision.startracker.attitude_fit import (
    MatchStatus,
    StarField,
    StarMatch,
    stretched,
)
from knightcube.vision.startracker.index import (
    CELLS,
    FINE,
    LEAST_RATIO,
    OCTAVE,
    RUN_BITS,
    SIZES,
    SkyIndex,
)
from knightcube.vision.startracker.observed_triangles import BatchSizes, batches_of, spread_batches
from knightcube.vision.startracker.verification import VerificationSettings, nothing, verify_first


def scale_steps(field: StarField, tolerance: float) -> FloatArray:
    """Return the image scales (2 s + 1,) at the s + 1 limits and s middles of s steps, in ascending order.

    Side ratios in a step differ from those in the middle of the step by at most `tolerance`. At a field angle
    of tangent t, a gnomonic image is enlarged by 1 + t^2 along the radius and by 1 + t^2 / 2 across the
    radius. The ratio of two sides of a triangle at the field-angle tangent t therefore depends on their
    directions by up to t^2 / 2. The number of steps is computed for a triangle half-way between the image
    centre and a corner.
    """
    lowest, highest = field.scale
    half_way = 0.25 * (field.half_width[0] ** 2 + field.half_width[1] ** 2)
    steps = max(1, math.ceil((highest**2 - lowest**2) * half_way / (4.0 * tolerance)))
    return np.asarray(np.sqrt(np.linspace(lowest**2, highest**2, 2 * steps + 1)))


@dataclass(frozen=True, slots=True, eq=False)
class TriangleMatches:
    """Matches of observed triangles with triangles of guide stars.

    Attributes:
        observed: indices of the observed stars at the corners of each match (k, 3), uint16.
        star: indices of the guide stars at the corresponding corners (k, 3), uint16.
        scale: factor (k,) on the observed tangents that makes the longest sides of both triangles equal. The
            int32 value is the factor's binary logarithm times `OCTAVE`.
    """

    observed: npt.NDArray[np.uint16]
    star: npt.NDArray[np.uint16]
    scale: npt.NDArray[np.int32]

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
        )


# Binary logarithm of the width of a bin of similar scales, in the units of `TriangleMatches.scale`.
_SCALE_BITS = 10
# Factors of a multiplicative hash. They are below 2^31, so that products fit into 64 bits.
_OF_STAR, _OF_PAIR, _OF_CODE = 1021, 257, 1_640_531_527


def _votes(
    observed: npt.NDArray[np.uint16], star: npt.NDArray[np.uint16], scale: npt.NDArray[np.int32]
) -> npt.NDArray[np.intp]:
    """Return the votes (k,) for each of k matches of triangles.

    The votes of a pair of an observed star and a guide star are the number of matches of similar scale that
    contain the pair. The votes of a match are the sum of the votes of its three pairs. In rare cases,
    different pairs have the same hash value, and their votes are added.
    """
    bits = max(13, star.size.bit_length() + 1)
    similar = ((scale + (1 << _SCALE_BITS - 1)) >> _SCALE_BITS).astype(np.uint32)
    pair = star.astype(np.uint32) * np.uint32(_OF_STAR) + observed
    code = (pair * np.uint32(_OF_PAIR) + similar[:, None]) * np.uint32(_OF_CODE)
    slot = code >> np.uint32(32 - bits)
    return np.asarray(np.bincount(slot.ravel(), minlength=1 << bits)[slot].sum(axis=1))


def look_up(
    field: StarField,
    sky: SkyIndex,
    scales: FloatArray,
    triangles: IntArray,
    tolerance: float,
    distortion: float,
    most: int,
) -> tuple[TriangleMatches, int]:
    """Return the matches of observed triangles in the index, and the number of index entries read.

    The array `triangles` (t, 3) contains the indices of the observed stars at the corners of each triangle.
    The array `scales` contains the limits and middles of scale steps, as `scale_steps` returns them. For a
    triangle whose side ratios depend little on the scale, successive steps are joined. The tolerance of a
    side ratio is in standard deviations, with an additional error due to `distortion` of the lens. At most
    `most` index entries are read, in the order of the observed triangles.
    """
    observed, star, scale, read = _look_up(
        np.ascontiguousarray(field.direction),
        np.ascontiguousarray(field.sigma),
        scales,
        np.ascontiguousarray(triangles),
        tolerance,
        distortion,
        LEAST_RATIO,
        most,
        *sky.triangles.table,
    )
    return TriangleMatches(observed, star, scale), read


# Maximum error of a side ratio. Triangles with larger errors are not distinctive.
_LARGEST_SLACK = 1.0 / 80.0
_Found = tuple[npt.NDArray[np.uint16], npt.NDArray[np.uint16], npt.NDArray[np.int32], int]


def _look_up_numpy(
    direction: FloatArray,
    sigma: FloatArray,
    scales: FloatArray,
    triangles: IntArray,
    tolerance: float,
    distortion: float,
    least_ratio: float,
    most: int,
    entries: npt.NDArray[np.uint32],
    star_of: npt.NDArray[np.uint16],
    below: npt.NDArray[np.int32],
    layout: IntArray,
) -> _Found:
    """Return the arrays of the `TriangleMatches`, and the number of entries read."""
    number, begin, end = _joined_steps(direction, triangles, scales, distortion)
    middle = scales[begin + end]
    corners, sides, left = _forms(direction, triangles[number], middle)
    size = sides[:, 2]
    spread = np.sqrt(np.mean(sigma[corners] ** 2, axis=1))
    # The error of a side ratio is computed from the errors of two directions and of the longest side.
    slack = (1.6 * tolerance) * spread * middle / size + distortion
    ratio = sides[:, :2] / size[:, None]
    usable = np.flatnonzero((slack <= _LARGEST_SLACK) & (ratio[:, 0] + slack >= least_ratio))
    corners, ratio, slack, left = corners[usable], ratio[usable], slack[usable], left[usable]
    begin, end = begin[usable], end[usable]
    # Logarithms of the longest sides at scale 1, and of their limits at the lowest and the highest scale.
    side = np.log2(size[usable] / middle[usable]) * OCTAVE + SIZES
    lowest = side + (np.log2(scales) * OCTAVE)[2 * begin] - slack * (OCTAVE / math.log(2.0))
    highest = side + (np.log2(scales) * OCTAVE)[2 * end] + slack * (OCTAVE / math.log(2.0))
    sizes = np.clip(np.stack([lowest, highest], axis=-1), 0, SIZES - 1).astype(np.int64)
    places = np.stack([ratio - slack[:, None], ratio + slack[:, None]], axis=-1) * (CELLS * FINE)
    places = np.clip(places, 0, CELLS * FINE - 1).astype(np.int64)
    query, cells, begin, end = _runs(below, sizes, places, left)
    # Only the first ranges of index entries are read, with at most `most` entries in total.
    count = end - begin
    kept = int(np.searchsorted(np.cumsum(count), most, side="right"))
    begin, count, query, cells = begin[:kept], count[:kept], query[:kept], cells[:kept]
    # Most of the time is spent on these indices; int32 instead of int64 halves this time.
    first = (begin - (np.cumsum(count) - count)).astype(np.int32)
    entry = np.arange(int(count.sum()), dtype=np.int32) + np.repeat(first, count)
    columns = np.ascontiguousarray(entries[entry]).view(np.uint8).reshape(-1, 4)
    near = np.ones(len(entry), dtype=np.bool_)
    for column in range(2):
        limits = np.clip(places[query, column] - cells[:, column, None] * FINE, 0, FINE - 1).astype(np.uint8)
        # Differences of unsigned bytes wrap around, so that positions below the lowest position are excluded.
        above = columns[:, 1 - column] - np.repeat(limits[:, 0], count)
        near &= above <= np.repeat(limits[:, 1] - limits[:, 0], count)
    chosen = np.flatnonzero(near)
    total = len(entry)
    entry = entry[chosen]
    query = query[np.searchsorted(np.cumsum(count), chosen, side="right")]
    longest = (entries[entry] >> np.uint32(16)).astype(np.int64)
    # The ranges of index entries also contain triangles that are too small or too large for the scale step.
    fits = np.flatnonzero((longest >= sizes[query, 0]) & (longest <= sizes[query, 1]))
    entry, query, longest = entry[fits], query[fits], longest[fits]
    scale = np.floor(longest + 0.5 - side[query]).astype(np.int32)
    return corners[query].astype(np.uint16), star_of[entry], scale, total


@compiled_form_of(_look_up_numpy)
def _look_up(
    direction: FloatArray,
    sigma: FloatArray,
    scales: FloatArray,
    triangles: IntArray,
    tolerance: float,
    distortion: float,
    least_ratio: float,
    most: int,
    entries: npt.NDArray[np.uint32],
    star_of: npt.NDArray[np.uint16],
    below: npt.NDArray[np.int32],
    layout: IntArray,
) -> _Found:
    octave, steps = layout[2], len(scales) // 2
    limits = np.log2(scales) * octave
    corners = np.empty((len(triangles) * steps, 3), dtype=np.uint16)
    longest = np.empty(len(triangles) * steps)
    runs = np.empty((len(triangles) * steps * _MOST_RUNS, 3), dtype=np.int32)
    windows = np.empty((len(runs), 2), dtype=np.uint32)
    side, corner, queries, count = np.empty(3), np.empty(3, dtype=np.int64), 0, 0
    for t in range(len(triangles)):
        corner[0], corner[1], corner[2] = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        a, b, c = sigma[corner[0]], sigma[corner[1]], sigma[corner[2]]
        spread = 1.6 * tolerance * math.sqrt((a * a + b * b + c * c) / 3.0)
        joined = _joined(direction, scales, distortion, corner, side)
        for begin in range(0, steps, joined):
            end = min(begin + joined, steps)
            middle = scales[begin + end]
            _sort_sides(direction, middle, corner, side)
            short, medium = side[0] / side[2], side[1] / side[2]
            slack = spread * middle / side[2] + distortion
            if not (slack <= _LARGEST_SLACK and short + slack >= least_ratio):
                continue
            longest[queries] = math.log2(side[2] / middle) * octave + layout[1]
            corners[queries, 0], corners[queries, 1], corners[queries, 2] = corner[0], corner[1], corner[2]
            margin = slack * (octave / math.log(2.0))
            lowest = longest[queries] + limits[2 * begin] - margin
            highest = longest[queries] + limits[2 * end] + margin
            if highest < layout[4] or lowest > layout[5]:
                continue
            left = _is_left(direction, corner)
            after = count + _add_runs(
                left, short, medium, slack, lowest, highest, below, layout, runs[count:], windows[count:]
            )
            runs[count:after, 2] = queries
            count, queries = after, queries + 1
    entry, query, total = _matching_entries(runs[:count], windows, entries, most)
    return *_matches(entry, query, entries, longest, corners, star_of), total


# Maximum number of pairs of cells that contain both side ratios; each ratio is in up to five cells.
_MOST_RUNS = 25


@loop_helper
def _joined(
    direction: FloatArray, scales: FloatArray, distortion: float, corner: IntArray, side: FloatArray
) -> int:
    """Return the number of successive scale steps that `_joined_steps` joins for a triangle."""
    steps = len(scales) // 2
    if steps == 1:
        return 1
    _sort_sides(direction, scales[0], corner, side)
    short, medium = side[0] / side[2], side[1] / side[2]
    _sort_sides(direction, scales[-1], corner, side)
    change = max(abs(short - side[0] / side[2]), abs(medium - side[1] / side[2]))
    return int(min(max(2.0 * distortion * steps / max(change, 1e-9), 1.0), float(steps)))


@loop_helper
def _add_runs(
    left: int,
    short: float,
    medium: float,
    slack: float,
    lowest: float,
    highest: float,
    below: npt.NDArray[np.int32],
    layout: IntArray,
    runs: npt.NDArray[np.int32],
    windows: npt.NDArray[np.uint32],
) -> int:
    """Write the ranges of entries that may contain triangles similar to an observed triangle.

    The first two columns of `runs` are the index of the first entry and the index after the last. The two
    columns of `windows` are entries with the lower and with the upper limits of the longest side and of both
    positions. Returns the number of ranges.
    """
    cells, sizes, run_bits = layout[0], layout[1], layout[3]
    width = cells * 256.0
    first, last = int(min(max(lowest, 0.0), sizes - 1.0)), int(min(max(highest, 0.0), sizes - 1.0))
    low, high = int(max((short - slack) * width, 0.0)), int(min((short + slack) * width, width - 1.0))
    lower, upper = int(max((medium - slack) * width, 0.0)), int(min((medium + slack) * width, width - 1.0))
    count = 0
    for i in range(low >> 8, (high >> 8) + 1):
        shortest, longest = max(low - (i << 8), 0), min(high - (i << 8), 255)
        for j in range(lower >> 8, (upper >> 8) + 1):
            form = ((left * cells + i) * cells + j) * (sizes >> run_bits)
            runs[count, 0] = below[form + (first >> run_bits)]
            runs[count, 1] = below[form + (last >> run_bits) + 1]
            windows[count, 0] = first << 16 | shortest << 8 | max(lower - (j << 8), 0)
            windows[count, 1] = last << 16 | longest << 8 | min(upper - (j << 8), 255)
            count += 1
    return count


@loop_helper
def _matching_entries(
    runs: npt.NDArray[np.int32], windows: npt.NDArray[np.uint32], entries: npt.NDArray[np.uint32], most: int
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32], int]:
    """Return the entries (k,) within the `windows`, their triangles, and the number of entries read.

    Only the first ranges are read, with at most `most` entries in total.
    """
    kept, total = 0, 0
    while kept < len(runs) and total + runs[kept, 1] - runs[kept, 0] <= most:
        total += runs[kept, 1] - runs[kept, 0]
        kept += 1
    entry, query = np.empty(total + 1, dtype=np.int32), np.empty(total + 1, dtype=np.int32)
    found, touched = 0, np.uint32(0)
    for begin in range(0, kept, _RUNS_AHEAD):
        end = min(begin + _RUNS_AHEAD, kept)
        # The first loop only loads entries into the cache. The processor loads many entries at the same time.
        for run in range(begin, end):
            for k in range(runs[run, 0], runs[run, 1], _CACHE_LINE):
                touched ^= entries[k]
        for run in range(begin, end):
            smallest, low, lower = _fields(windows[run, 0])
            largest, high, upper = _fields(windows[run, 1])
            for k in range(runs[run, 0], runs[run, 1]):
                size, short, medium = _fields(entries[k])
                fits = (size >= smallest) & (size <= largest)
                fits &= (short >= low) & (short <= high) & (medium >= lower) & (medium <= upper)
                entry[found], query[found] = k, runs[run, 2]
                found += int(fits)
    # The compiler would omit the first loop if its result were not used.
    entry[found] = touched & np.uint32(1)
    return entry[:found], query[:found], total


# Number of ranges whose entries are loaded before they are compared, and number of entries in a cache line.
_RUNS_AHEAD, _CACHE_LINE = 256, 16


@loop_helper
def _fields(entry: np.uint32) -> tuple[np.uint32, np.uint32, np.uint32]:
    """Return the longest side and the two positions that an entry of the index contains."""
    return entry >> np.uint32(16), entry >> np.uint32(8) & np.uint32(0xFF), entry & np.uint32(0xFF)


@loop_helper
def _matches(
    entry: npt.NDArray[np.int32],
    query: npt.NDArray[np.int32],
    entries: npt.NDArray[np.uint32],
    longest: FloatArray,
    corners: npt.NDArray[np.uint16],
    star_of: npt.NDArray[np.uint16],
) -> tuple[npt.NDArray[np.uint16], npt.NDArray[np.uint16], npt.NDArray[np.int32]]:
    """Return the arrays of the `TriangleMatches` for k entries that match the observed triangles `query`."""
    observed, star = np.empty((len(entry), 3), dtype=np.uint16), np.empty((len(entry), 3), dtype=np.uint16)
    scale = np.empty(len(entry), dtype=np.int32)
    for k in range(len(entry)):
        one, two = entry[k], query[k]
        scale[k] = math.floor(np.int64(entries[one] >> 16) + 0.5 - longest[two])
        for c in range(3):
            observed[k, c], star[k, c] = corners[two, c], star_of[one, c]
    return observed, star, scale


@loop_helper
def _sort_sides(direction: FloatArray, scale: float, corner: IntArray, side: FloatArray) -> None:
    """Sort the corners of a triangle by the lengths of the opposite sides; write the lengths to `side`."""
    i, j, k = corner[0], corner[1], corner[2]
    squared = scale * scale
    a = 1.0 / math.sqrt(squared + (1.0 - squared) * direction[i, 2] * direction[i, 2])
    b = 1.0 / math.sqrt(squared + (1.0 - squared) * direction[j, 2] * direction[j, 2])
    c = 1.0 / math.sqrt(squared + (1.0 - squared) * direction[k, 2] * direction[k, 2])
    opposite_i = _cosine(direction[j], direction[k], squared) * b * c
    opposite_j = _cosine(direction[k], direction[i], squared) * c * a
    opposite_k = _cosine(direction[i], direction[j], squared) * a * b
    # The shortest side has the largest cosine.
    if opposite_i < opposite_j:
        i, j, opposite_i, opposite_j = j, i, opposite_j, opposite_i
    if opposite_j < opposite_k:
        j, k, opposite_j, opposite_k = k, j, opposite_k, opposite_j
    if opposite_i < opposite_j:
        i, j, opposite_i, opposite_j = j, i, opposite_j, opposite_i
    corner[0], corner[1], corner[2] = i, j, k
    side[0] = math.sqrt(max(2.0 - 2.0 * opposite_i, _TINY))
    side[1] = math.sqrt(max(2.0 - 2.0 * opposite_j, _TINY))
    side[2] = math.sqrt(max(2.0 - 2.0 * opposite_k, _TINY))


@loop_helper
def _cosine(one: FloatArray, two: FloatArray, squared: float) -> float:
    """Return the scalar product of two directions whose x and y are multiplied by the root of `squared`."""
    cosine: float = squared * (one[0] * two[0] + one[1] * two[1]) + one[2] * two[2]
    return cosine


# Smallest squared side of an observed triangle; two observed stars may have the same direction.
_TINY = 1e-18


@loop_helper
def _is_left(direction: FloatArray, corner: IntArray) -> int:
    """Return 1 if the orientation of the corners is left, otherwise 0."""
    a, b, c = corner[0], corner[1], corner[2]
    x = direction[b, 1] * direction[c, 2] - direction[b, 2] * direction[c, 1]
    y = direction[b, 2] * direction[c, 0] - direction[b, 0] * direction[c, 2]
    z = direction[b, 0] * direction[c, 1] - direction[b, 1] * direction[c, 0]
    return 1 if direction[a, 0] * x + direction[a, 1] * y + direction[a, 2] * z > 0.0 else 0


def _joined_steps(
    direction: FloatArray, triangles: IntArray, scales: FloatArray, distortion: float
) -> tuple[IntArray, IntArray, IntArray]:
    """Return ranges of scale steps in which the side ratios of t triangles are nearly constant.

    The ratios change by at most 2 `distortion` in a range, unless the range is a single step. For each range,
    the result contains the number of the triangle, the first step, and the step after the last.
    """
    steps = len(scales) // 2
    if steps == 1:
        number = np.arange(len(triangles))
        return number, np.zeros_like(number), np.ones_like(number)
    first, last = (
        sides[:, :2] / sides[:, 2:]
        for _, sides, _ in (_forms(direction, triangles, np.full(len(triangles), s)) for s in scales[[0, -1]])
    )
    change = np.maximum(np.abs(last - first).max(axis=1), 1e-9)
    joined = np.clip(2.0 * distortion * steps / change, 1, steps).astype(np.int64)
    count = -(-steps // joined)
    number = np.repeat(np.arange(len(triangles)), count)
    begin = (np.arange(len(number)) - np.repeat(np.cumsum(count) - count, count)) * joined[number]
    return number, begin, np.minimum(begin + joined[number], steps)


def _forms(
    seen: FloatArray, triangles: IntArray, scales: FloatArray
) -> tuple[IntArray, FloatArray, BoolArray]:
    """Return corners and sides (t, 3) of triangles (t, 3) at the scales (t,), sorted by side length.

    The third returned value is the orientation of the corners (t,).
    """
    direction = seen[triangles] * np.stack([scales, scales, np.ones(len(scales))], axis=-1)[:, None]
    direction /= np.sqrt(np.einsum("tij,tij->ti", direction, direction))[:, :, None]
    cosine = np.einsum("tij,tij->ti", direction[:, [1, 2, 0]], direction[:, [2, 0, 1]])
    squared = np.maximum(2.0 - 2.0 * cosine, _TINY)
    order = np.argsort(squared, axis=1)
    rows = np.arange(len(triangles))[:, None]
    corners = triangles[rows, order]
    a, b, c = seen[corners].transpose(1, 0, 2)
    left = np.einsum("ti,ti->t", a, np.cross(b, c)) > 0.0
    return corners, np.sqrt(squared[rows, order]), left


def _runs(
    below: npt.NDArray[np.int32], sizes: IntArray, places: IntArray, left: BoolArray
) -> tuple[IntArray, IntArray, IntArray, IntArray]:
    """Return the ranges of index entries that may contain triangles similar to observed triangles.

    The longest sides of the observed triangles have the limits `sizes` (t, 2), and their two side ratios have
    the limits `places` (t, 2, 2), in steps of which a cell has `FINE`. For each range, the result contains
    the index of the observed triangle, the cells (2,) of the two ratios, the first entry, and the entry after
    the last.
    """
    low, high = places[:, :, 0] // FINE, places[:, :, 1] // FINE
    spans = high - low
    here = np.arange(int(spans.max(initial=0)) + 1) <= spans[:, :, None]
    # The order is that of the observed triangles, because a limited number of the first ranges is read.
    query, along_short, along_middle = np.nonzero(here[:, 0, :, None] & here[:, 1, None, :])
    cells = low[query] + np.stack([along_short, along_middle], axis=-1)
    form = ((left[query] * CELLS + cells[:, 0]) * CELLS + cells[:, 1]) * (SIZES >> RUN_BITS)
    first, last = (sizes[query] >> RUN_BITS).T
    return query, cells, below[form + first], below[form + last + 1]


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
    work: int = 200_000
    verified: int = 12
    mirror: bool = True
    hint_error: float = 1.25
    verification: VerificationSettings = field(default_factory=VerificationSettings)


# Factor on the tolerance for triangles that include faint stars.
# The factor is below 1, because many true triangles vote for the same pairs.
_OF_SPREAD = 0.3
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
    scales = scale_steps(observed, settings.distortion)
    found: list[TriangleMatches] = []
    tried = np.empty((0, 2), dtype=np.int64)
    work = 0
    for triangles, spread in batches_of(observed, settings.batches, len(scales) // 2, spread_triangles):
        finds, read = look_up(
            observed,
            sky,
            scales,
            triangles,
            (_OF_SPREAD if spread else 1.0) * settings.tolerance,
            settings.distortion,
            settings.work - work,
        )
        if len(finds):
            found.append(finds)
        if found:
            direction, whole = np.ascontiguousarray(observed.direction), TriangleMatches.of(found)
            matches = whole.observed, whole.star, whole.scale
            matrices, zooms, tried = _choose(
                direction, sky.stars.direction, *matches, tried, settings.verified, *observed.scale, OCTAVE
            )
            answer = verify_first(observed, sky, matrices, zooms, searched, settings.verification)
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
    scale: npt.NDArray[np.int32],
    tried: IntArray,
    most: int,
    lowest: float,
    highest: float,
    octave: int,
) -> _Chosen:
    """Return attitude matrices (c, 3, 3) and scales (c,) of the matches with the most votes.

    A match is omitted if two of its pairs of an observed star and a guide star are among the pairs `tried`
    (k, 2). The third returned value is the array `tried`, extended by the pairs of the new candidates.
    """
    votes = _votes(observed, star, scale)
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
        factor = 2.0 ** (float(scale[find]) / octave)
        seen = stretched(direction[observed[find]], factor)
        matrices.append(_frame(seen).T @ _frame(guide[star[find]]))
        # The scale from one triangle is inaccurate, so it is limited to the range of possible scales.
        scales.append(min(max(factor, lowest), highest))
        if len(scales) == most:
            break
    return np.array(matrices).reshape(-1, 3, 3), np.array(scales), tried


@compiled_form_of(_choose_numpy)
def _choose(
    direction: FloatArray,
    guide: FloatArray,
    observed: npt.NDArray[np.uint16],
    star: npt.NDArray[np.uint16],
    scale: npt.NDArray[np.int32],
    tried: IntArray,
    most: int,
    lowest: float,
    highest: float,
    octave: int,
) -> _Chosen:
    votes = _counted_votes(observed, star, scale)
    order = _most_voted(votes, min(_RANKED * most, len(votes)))
    pairs = np.empty((len(tried) + 3 * most, 2), dtype=np.int64)
    for k in range(len(tried)):
        pairs[k, 0], pairs[k, 1] = tried[k, 0], tried[k, 1]
    matrices, scales = np.empty((most, 3, 3)), np.empty(most)
    seen, wanted = np.empty((3, 3)), np.empty((3, 3))
    known, count = len(tried), 0
    for find in order:
        if _shared_pairs(pairs[:known], observed[find], star[find]) >= 2:
            continue
        factor = 2.0 ** (scale[find] / octave)
        squared = factor * factor
        for c in range(3):
            one, two = np.int64(observed[find, c]), np.int64(star[find, c])
            pairs[known, 0], pairs[known, 1] = one, two
            known += 1
            z = direction[one, 2]
            shrink = 1.0 / math.sqrt(squared + (1.0 - squared) * z * z)
            seen[0, c] = direction[one, 0] * factor * shrink
            seen[1, c] = direction[one, 1] * factor * shrink
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
        scales[count] = min(max(factor, lowest), highest)
        count += 1
        if count == most:
            break
    return matrices[:count].copy(), scales[:count].copy(), pairs[:known].copy()


@loop_helper
def _shared_pairs(pairs: IntArray, observed: npt.NDArray[np.uint16], star: npt.NDArray[np.uint16]) -> int:
    """Return how many of the three pairs of `observed` (3,) and `star` (3,) are among the `pairs` (k, 2)."""
    shared = 0
    for c in range(3):
        for k in range(len(pairs)):
            if pairs[k, 0] == observed[c] and pairs[k, 1] == star[c]:
                shared += 1
                break
    return shared


@loop_helper
def _counted_votes(
    observed: npt.NDArray[np.uint16], star: npt.NDArray[np.uint16], scale: npt.NDArray[np.int32]
) -> IntArray:
    """Return the votes (k,) of k matches, as `_votes` does."""
    bits, size = 1, 3 * len(star)
    while size:
        size >>= 1
        bits += 1
    bits = max(13, bits)
    unused, rounded = 32 - bits, 1 << (_SCALE_BITS - 1)
    count = np.zeros(1 << bits, dtype=np.uint16)
    slot = np.empty((len(star), 3), dtype=np.uint32)
    for k in range(len(star)):
        similar = (np.int64(scale[k]) + rounded) >> _SCALE_BITS
        for c in range(3):
            pair = np.int64(star[k, c]) * _OF_STAR + np.int64(observed[k, c])
            code = ((pair * _OF_PAIR + similar) & 0xFFFFFFFF) * _OF_CODE & 0xFFFFFFFF
            slot[k, c] = code >> unused
            count[code >> unused] += 1
    votes = np.empty(len(star), dtype=np.int64)
    for k in range(len(star)):
        votes[k] = np.int64(count[slot[k, 0]]) + np.int64(count[slot[k, 1]]) + np.int64(count[slot[k, 2]])
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
