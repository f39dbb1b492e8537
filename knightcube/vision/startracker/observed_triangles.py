"""Triangles of observed stars, in the order in which they are looked up in the index.

Triangles of only the brightest stars identify most frames. If the brightest points of a frame are not stars,
medium-sized triangles of all stars and triangles of neighbouring stars follow.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from knightcube.astro.arrays import FloatArray, IntArray
from knightcube.compiled import compiled_form_of
from knightcube.vision.startracker.attitude_fit import StarField

_BRIGHTEST = 12
_NEIGHBOURS = 5
_CENTRES = 40
_MOST_STARS = 64
# Limits of the longest side of a medium-sized and of a larger triangle, relative to the width of the field.
# Larger triangles are in the index only for bright stars; smaller ones have inaccurate side ratios.
_MIDDLE_SIZES = 0.2, 0.5, 0.75


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
    batches = np.split(middle_sized(field, sum(sizes.spread), sizes.spread[0]), np.cumsum(sizes.spread)[:-1])
    if len(field) > (_BRIGHTEST if field.magnitude is None else _MOST_STARS):
        batches[-1] = np.concatenate([batches[-1], neighbours(field)])
    return batches


def middle_sized(field: StarField, most: int, least: int) -> IntArray:
    """Return up to `most` medium-sized triangles (t, 3) of the brightest stars, in a random order.

    If fewer than `least` triangles are of medium size, larger triangles follow, up to `least` triangles in
    total.
    """
    triangles = triples(min(len(field), _MOST_STARS), shuffled=True)
    shortest, medium, longest = (float(2.0 * max(field.half_width) * size) for size in _MIDDLE_SIZES)
    return _of_sizes(np.ascontiguousarray(field.direction), triangles, shortest, medium, longest, most, least)


def _of_sizes_numpy(
    direction: FloatArray,
    triangles: IntArray,
    shortest: float,
    medium: float,
    longest: float,
    most: int,
    least: int,
) -> IntArray:
    """See `middle_sized`; the triangles (t, 3) are in a random order, and the limits are chords."""
    direction = direction[:_MOST_STARS]
    # The longest side of a triangle connects the two stars with the smallest cosine of their angle.
    cosine = (direction @ direction.T).ravel()
    found, larger = [triangles[:0]], [triangles[:0]]
    while len(triangles) and sum(map(len, found)) < most:
        tried, triangles = triangles[: 2 * most], triangles[2 * most :]
        first, second, third = tried.T
        pairs = np.stack([first, second, third]) * len(direction) + np.stack([second, third, first])
        chord = 2.0 - 2.0 * cosine[pairs].min(axis=0)
        found.append(tried[(chord >= shortest**2) & (chord <= medium**2)])
        larger.append(tried[(chord > medium**2) & (chord <= longest**2)])
    count = min(max(sum(map(len, found)), least), most)
    return np.concatenate(found + larger)[:count]


@compiled_form_of(_of_sizes_numpy)
def _of_sizes(
    direction: FloatArray,
    triangles: IntArray,
    shortest: float,
    medium: float,
    longest: float,
    most: int,
    least: int,
) -> IntArray:
    """See `_of_sizes_numpy`."""
    stars = min(len(direction), _MOST_STARS)
    squared = np.empty((stars, stars))
    for one in range(stars):
        for other in range(stars):
            cosine = 0.0
            for axis in range(3):
                cosine += direction[one, axis] * direction[other, axis]
            squared[one, other] = 2.0 - 2.0 * cosine
    found, larger = np.empty((most, 3), dtype=np.int64), np.empty((most, 3), dtype=np.int64)
    count, more = 0, 0
    for t in range(len(triangles)):
        if count == most:
            break
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        chord = max(squared[a, b], squared[b, c], squared[c, a])
        if shortest**2 <= chord <= medium**2:
            found[count, 0], found[count, 1], found[count, 2] = a, b, c
            count += 1
        elif medium**2 < chord <= longest**2 and more < most:
            larger[more, 0], larger[more, 1], larger[more, 2] = a, b, c
            more += 1
    added = min(max(min(least, most) - count, 0), more)
    for k in range(added):
        for star in range(3):
            found[count + k, star] = larger[k, star]
    return found[: count + added].copy()


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
