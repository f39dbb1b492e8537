"""Lost in space: identification of the stars of a frame without prior information.

Triangles of the brightest observed stars are looked up by shape, orientation and size among the triangles of
guide stars. Each match of an observed triangle with a triangle of the index votes for three pairs of an
observed star and a guide star. Correct pairs occur in many triangles, and chance pairs in only one. The
matches with the most votes are verified against the whole field until one match is accepted. If no match is
accepted, triangles of all observed stars, and not only of the brightest, are looked up. Even if most observed
points are not stars, some of the thousand triangles that are looked up consist of true stars only. If no
match is accepted, the mirrored field is tried. Finally, image scales outside the given range are tried if the
range is narrow, because a narrow range may be wrong.

The shape of a triangle on the sphere depends slightly on the scale of the image. A wide range of image scales
is divided into steps that are so narrow that the side ratios stay within the tolerance.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.vision.startracker.attitude_fit import (
    MatchStatus,
    StarField,
    StarMatch,
    stretched,
)
from knightcube.vision.startracker.index.sky_index import (
    CELL,
    CELLS,
    FINE,
    LEAST_RATIO,
    RUN_BITS,
    SIZE_BITS,
    SIZE_UNIT,
    SkyIndex,
)
from knightcube.vision.startracker.verification import (
    VerificationSettings,
    nothing,
    verify,
)

_BRIGHTEST = 12
_NEIGHBOURS = 5
_CENTRES = 40
_MOST_STARS = 64
# Limits of the longest side of a triangle, relative to the width of the field.
# Larger triangles in the index consist of bright stars only, and smaller triangles are less accurate.
_MIDDLE_SIZES = 0.3, 0.75


@dataclass(frozen=True, slots=True)
class BatchSizes:
    """Numbers of triangles in successive batches of triangles that are looked up in the index.

    Attributes:
        bright: numbers of triangles of the brightest stars in each batch, for each step of scale; these
            batches identify most frames.
        spread: numbers of triangles of many stars in each batch, for frames whose brightest points are not
            stars.
    """

    bright: tuple[int, ...] = (60, 250)
    spread: tuple[int, ...] = (300, 1000)


def batches_of(field: StarField, sizes: BatchSizes, steps: int) -> Iterator[tuple[IntArray, bool]]:
    """Yield batches of triangles (t, 3), and whether each batch includes faint stars.

    The size of a batch of the brightest stars is divided by the square root of the number of `steps` of
    scale. The last batch includes triangles of neighbouring stars, for points that are not sorted by
    brightness.
    """
    brightest = triples(min(len(field), _BRIGHTEST))
    begin = 0
    for size in sizes.bright:
        end = min(begin + max(20, int(size / steps**0.5)), len(brightest))
        if end > begin:
            yield brightest[begin:end], False
        begin = end
    if len(field) <= _BRIGHTEST and begin == len(brightest):
        return
    spread = np.split(middle_sized(field)[: sum(sizes.spread)], np.cumsum(sizes.spread)[:-1])
    if len(field) > _BRIGHTEST:
        spread[-1] = np.concatenate([spread[-1], neighbours(field)])
    yield from ((triangles, True) for triangles in spread if len(triangles))


def middle_sized(field: StarField) -> IntArray:
    """Return medium-sized triangles (t, 3) of the brightest stars, in a random order."""
    triangles = triples(min(len(field), _MOST_STARS))
    first, second, third = triangles.T
    direction = field.direction[:_MOST_STARS]
    cosine = direction @ direction.T
    least = np.minimum(np.minimum(cosine[first, second], cosine[second, third]), cosine[third, first])
    longest = np.sqrt(np.maximum(2.0 - 2.0 * least, 0.0)) / (2.0 * max(field.half_width))
    kept = np.flatnonzero((longest >= _MIDDLE_SIZES[0]) & (longest <= _MIDDLE_SIZES[1]))
    # The seed is fixed, so that the same field always gives the same triangles.
    return np.asarray(triangles[np.random.default_rng(len(field)).permutation(kept)])


@lru_cache(maxsize=32)
def triples(count: int) -> IntArray:
    """Return all triangles (t, 3) of `count` stars, sorted by the index of each triangle's faintest star."""
    first, second, third = np.meshgrid(*[np.arange(count)] * 3, indexing="ij")
    ascending = (first < second) & (second < third)
    triangles = np.stack([first[ascending], second[ascending], third[ascending]], axis=-1)
    return np.asarray(triangles[np.lexsort(triangles.T)])


def neighbours(field: StarField) -> IntArray:
    """Return triangles (t, 3) of a star and two of its nearest neighbours of any brightness."""
    cosines = field.direction[:_CENTRES] @ field.direction.T
    near = np.argsort(-cosines, axis=1)[:, 1 : _NEIGHBOURS + 1]
    one, two = np.triu_indices(_NEIGHBOURS, 1)
    corners = np.stack(
        np.broadcast_arrays(np.arange(len(near))[:, None], near[:, one], near[:, two]), axis=-1
    ).reshape(-1, 3)
    return np.unique(np.sort(corners, axis=1), axis=0)


_LARGEST_SIZE = (1 << SIZE_BITS) - 1


@dataclass(frozen=True, slots=True, eq=False)
class ScaleSteps:
    """Steps that divide the range of possible scales, so that triangle shapes are constant within a step.

    Attributes:
        middle: scale in each step with which the triangle shapes are computed (s,).
        lowest, highest: limits of the scale of each step (s,).
    """

    middle: FloatArray
    lowest: FloatArray
    highest: FloatArray

    def __len__(self) -> int:
        return len(self.middle)

    @classmethod
    def of(cls, field: StarField, tolerance: float) -> ScaleSteps:
        """Return steps of a field's range of scales, within each of which side ratios vary by `tolerance`.

        At a field angle of tangent t, a gnomonic image is enlarged by 1 + t^2 along the radius and by 1 + t^2
        / 2 across the radius. The ratio of two sides of a triangle at the field angle of tangent t therefore
        varies by t^2 / 2. The steps are computed for the field angle half-way to the corner of the field.
        """
        lowest, highest = field.scale
        half_way = 0.25 * (field.half_width[0] ** 2 + field.half_width[1] ** 2)
        count = max(1, math.ceil((highest**2 - lowest**2) * half_way / (4.0 * tolerance)))
        edges = np.sqrt(np.linspace(lowest**2, highest**2, count + 1))
        return cls(np.sqrt(edges[:-1] * edges[1:]), edges[:-1], edges[1:])


@dataclass(frozen=True, slots=True, eq=False)
class TriangleMatches:
    """Matches of observed triangles with triangles of guide stars.

    Attributes:
        observed: indices of the observed stars at the corners of each match (k, 3), uint32.
        star: indices of the guide stars at the corresponding corners (k, 3), uint32.
        scale: factor on the observed tangents for which both triangles of a match have equal longest sides
            (k,).
    """

    observed: npt.NDArray[np.uint32]
    star: npt.NDArray[np.uint32]
    scale: FloatArray

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

    def votes(self) -> IntArray:
        """Return the votes (k, 3) for each pair of an observed star and a guide star in each match.

        The votes of a pair are the number of matches of similar scale that contain the pair.
        """
        bins = np.log(self.scale) * _BINS_PER_LN_SCALE
        bins -= bins.min()
        bits = max(13, self.star.size.bit_length())
        # With this multiplicative hash, two pairs rarely share a slot, which would only add wrong votes.
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
    """Return the matches of observed triangles in the index, and the number of index entries read.

    Args:
        field: observed points of the frame, some of which may not be stars.
        sky: sky index of guide stars and their triangles.
        steps: steps into which the range of image scales is divided.
        triangles: indices of the observed stars at the corners of each triangle (t, 3).
        tolerance: tolerance of a side ratio, in standard deviations.
        distortion: additional error of a side ratio due to distortion of the lens.
        most: maximum number of index entries to read, in the order of the observed triangles.
    """
    corners, sides, left = _forms(field, triangles, steps)
    size = np.maximum(sides[:, 2], SIZE_UNIT)
    sigma = np.sqrt(np.mean(field.sigma[corners] ** 2, axis=1))
    step = np.tile(np.arange(len(steps)), len(triangles))
    # The error of a side ratio follows from the errors of two directions and of the longest side.
    slack = (1.6 * tolerance) * sigma * steps.middle[step] / size + distortion
    ratio = sides[:, :2] / size[:, None]
    usable = np.flatnonzero((slack <= CELL) & (ratio[:, 0] + slack >= LEAST_RATIO))
    corners, size, left = corners[usable], size[usable], left[usable]
    slack, ratio, step = slack[usable], ratio[usable], step[usable]
    lowest = size * (steps.lowest / steps.middle)[step] * (1.0 - slack)
    highest = size * (steps.highest / steps.middle)[step] * (1.0 + slack)
    query, short, middle, begin, end = _runs(sky, ratio, slack, left, lowest, highest)
    # Only the first ranges of index entries are read, with at most `most` entries in total.
    count = end - begin
    kept = int(np.searchsorted(np.cumsum(count), most, side="right"))
    begin, count = begin[:kept], count[:kept]
    query, short, middle = query[: len(count)], short[: len(count)], middle[: len(count)]
    # Arrays of int32 instead of int64 halve the time, most of which is spent on index entries.
    first = (begin - (np.cumsum(count) - count)).astype(np.int32)
    entry = np.arange(int(count.sum()), dtype=np.int32) + np.repeat(first, count)
    near = np.ones(len(entry), dtype=np.bool_)
    for column, cells in enumerate((short, middle)):
        lowest_place, width = _places(ratio[query, column], slack[query], cells)
        place = sky.triangles.shape[:, column][entry]
        # Differences of unsigned bytes wrap around, so that positions below the lowest one fail the test.
        near &= place - np.repeat(lowest_place, count) <= np.repeat(width, count)
    chosen = np.flatnonzero(near)
    total = len(entry)
    entry = entry[chosen]
    query = query[np.searchsorted(np.cumsum(count), chosen, side="right")]
    longest = (sky.triangles.key[entry] & np.uint32(_LARGEST_SIZE)) * SIZE_UNIT
    # The ranges of entries also contain some triangles that are too small or too large for the step of scale.
    fits = np.flatnonzero((longest >= lowest[query]) & (longest <= highest[query]))
    entry, query, longest = entry[fits], query[fits], longest[fits]
    scale = longest / size[query] * steps.middle[step[query]]
    star = sky.triangles.corners[entry].astype(np.uint32)
    return TriangleMatches(corners[query].astype(np.uint32), star, scale), total


def _places(
    ratio: FloatArray, slack: FloatArray, cells: IntArray
) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.uint8]]:
    """Return the lowest position within a cell that agrees with each ratio, and how many higher ones agree.

    A position agrees with a side ratio if they differ by at most `slack`.
    """
    # Positions within a cell are in units of 1 / FINE of its width, and refer to the middle of such a unit.
    wanted = ratio * (CELLS * FINE) - 0.5 - cells * FINE
    reach = slack * (CELLS * FINE) + 0.5
    lowest = np.clip(np.ceil(wanted - reach), 0, FINE - 1)
    highest = np.clip(np.floor(wanted + reach), lowest, FINE - 1)
    return lowest.astype(np.uint8), (highest - lowest).astype(np.uint8)


def _forms(
    field: StarField, triangles: IntArray, steps: ScaleSteps
) -> tuple[IntArray, FloatArray, BoolArray]:
    """Return corners and sides (t s, 3) of t triangles at s scales, sorted by side length.

    The third returned value is the orientation of the corners in the image (t s,).
    """
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
    """Return the ranges of sorted triangle keys that may contain triangles similar to observed triangles.

    For each range, the result holds the index of the observed triangle (query), the cells of its two side
    ratios, and the first and last + 1 index in the sorted keys. Each side ratio of an observed triangle may
    lie in up to three cells.
    """
    low = np.maximum(((ratio - slack[:, None]) * CELLS).astype(np.int64), 0)
    high = np.minimum(((ratio + slack[:, None]) * CELLS).astype(np.int64), CELLS - 1)
    spans = high - low
    widest = int(spans.max(initial=0)) + 1
    here = np.arange(widest) <= spans[:, :, None]
    # The ranges are in the order of the triangles, so that those of the first triangles are read first.
    query, along_short, along_middle = np.nonzero(here[:, 0, :, None] & here[:, 1, None, :])
    short = low[query, 0] + along_short
    middle = low[query, 1] + along_middle
    form = ((left[query] * CELLS + short) * CELLS + middle) << SIZE_BITS
    first = np.minimum(lowest / SIZE_UNIT, _LARGEST_SIZE).astype(np.int64)[query]
    last = np.minimum(highest / SIZE_UNIT, _LARGEST_SIZE).astype(np.int64)[query]
    below = sky.triangles.below
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
        mirror: whether the mirrored field is searched for as well.
        hint_error: factor by which the true scale may lie outside a narrow range of scales; 1 if the range is
            certain. A calibrated scale, (1, 1), is always considered certain.
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


# Factor on the tolerance and on the number of verified candidates, for batches of triangles of many stars.
# The factor is below 1, because many true triangles vote for the same stars.
_OF_SPREAD = 0.6
# Factor by which chance matches must be less likely in the mirrored field or outside the range of scales.
_RARE = 10.0
DEFAULT = IdentificationSettings()


def identify(observed: StarField, sky: SkyIndex, settings: IdentificationSettings = DEFAULT) -> StarMatch:
    """Return the identified stars and the attitude of a frame, or a status that states why there are none."""
    if len(observed) < settings.verification.least_matches:
        return nothing(observed, MatchStatus.TOO_FEW_STARS)
    answer = _search(observed, sky, settings, 1.0)
    if answer.status is not MatchStatus.IDENTIFIED and settings.mirror:
        answer = _search(observed.mirrored(), sky, settings, _RARE)
        answer = replace(answer, mirrored=answer.status is MatchStatus.IDENTIFIED)
    lowest, highest = observed.scale
    if answer.status is not MatchStatus.IDENTIFIED and 1.0 < highest / lowest < settings.hint_error**2:
        wider = lowest / settings.hint_error, highest * settings.hint_error
        answer = _search(replace(observed, scale=wider), sky, settings, _RARE)
    return answer


def _search(
    observed: StarField, sky: SkyIndex, settings: IdentificationSettings, searched: float
) -> StarMatch:
    """Return the identification of a field, without trying the mirrored field or other scales."""
    steps = ScaleSteps.of(observed, settings.distortion)
    found: list[TriangleMatches] = []
    tried: set[tuple[int, int]] = set()
    work = 0
    for triangles, spread in batches_of(observed, settings.batches, len(steps)):
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
        found.append(finds)
        most = round(share * settings.verified)
        for matrix, scale in _candidates(observed, sky, TriangleMatches.of(found), tried, most):
            answer = verify(observed, sky, matrix, scale, searched, settings.verification)
            if answer.status is MatchStatus.IDENTIFIED:
                return answer
        work += read
        if work >= settings.work:
            break
    return nothing(observed)


def _candidates(
    observed: StarField, sky: SkyIndex, finds: TriangleMatches, tried: set[tuple[int, int]], most: int
) -> Iterator[tuple[FloatArray, float]]:
    """Yield attitude matrices (3, 3) and scales of the matches with the most votes, each only once."""
    if not len(finds):
        return
    votes = finds.votes().sum(axis=1)
    # There may be a hundred thousand matches, so only the matches with the most votes are sorted.
    first = np.argpartition(-votes, min(8 * most, len(votes) - 1))[: 8 * most]
    order = first[np.lexsort((first, -votes[first]))]
    yielded = 0
    for find in order.tolist():
        pairs = list(zip(finds.observed[find].tolist(), finds.star[find].tolist(), strict=True))
        if sum(pair in tried for pair in pairs) >= 2:
            continue
        tried.update(pairs)
        # The scale from one triangle is inaccurate, so it is limited to the range of possible scales.
        scale = min(max(float(finds.scale[find]), observed.scale[0]), observed.scale[1])
        # The attitude transforms the guide stars of the match into the observed stars.
        seen = stretched(observed.direction[finds.observed[find]], float(finds.scale[find]))
        yield np.asarray(_frame(seen).T @ _frame(sky.stars.direction[finds.star[find]])), scale
        yielded += 1
        if yielded == most:
            return


def _frame(corners: FloatArray) -> FloatArray:
    """Return the axes, as rows (3, 3), of a coordinate frame fixed to a triangle of unit vectors (3, 3).

    The first axis of the coordinate frame points to the centre of the triangle.
    """
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
