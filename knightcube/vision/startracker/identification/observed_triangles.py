"""The triangles of observed stars to be looked up, in order."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from knightcube.astro.arrays import IntArray
from knightcube.vision.startracker.identification.field import StarField

_BRIGHTEST = 12
_NEIGHBOURS = 5
_CENTRES = 40
_MOST_STARS = 64
# Of the field's width: larger triangles are in the index only if their stars are bright, smaller ones are
# less sharp.
_MIDDLE_SIZES = 0.3, 0.75


@dataclass(frozen=True, slots=True)
class BatchSizes:
    """Numbers of triangles that are looked up at once, batch after batch.

    Attributes:
        bright: of the brightest stars, at each step of scale; these solve most frames.
        spread: of triangles spread over many stars, where the brightest are false.
    """

    bright: tuple[int, ...] = (60, 250)
    spread: tuple[int, ...] = (300, 1000)


def batches_of(field: StarField, sizes: BatchSizes, steps: int) -> Iterator[tuple[IntArray, bool]]:
    """Yield triangles (t, 3) and whether they are spread over many stars.

    With many `steps` of scale a batch of the brightest is smaller, by the root of their number. The last
    batch has triangles of neighbours too, for a list that is not in order of brightness.
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
    """Return triangles (t, 3) of middle size of the brightest stars, in a random order."""
    triangles = triples(min(len(field), _MOST_STARS))
    first, second, third = triangles.T
    direction = field.direction[:_MOST_STARS]
    cosine = direction @ direction.T
    least = np.minimum(np.minimum(cosine[first, second], cosine[second, third]), cosine[third, first])
    longest = np.sqrt(np.maximum(2.0 - 2.0 * least, 0.0)) / (2.0 * max(field.half_width))
    kept = np.flatnonzero((longest >= _MIDDLE_SIZES[0]) & (longest <= _MIDDLE_SIZES[1]))
    # The same order in every run: the same list has the same answer.
    return np.asarray(triangles[np.random.default_rng(len(field)).permutation(kept)])


@lru_cache(maxsize=32)
def triples(count: int) -> IntArray:
    """Return all triangles (t, 3) of `count` stars, in order of the faintest star of each."""
    first, second, third = np.meshgrid(*[np.arange(count)] * 3, indexing="ij")
    ascending = (first < second) & (second < third)
    triangles = np.stack([first[ascending], second[ascending], third[ascending]], axis=-1)
    return np.asarray(triangles[np.lexsort(triangles.T)])


def neighbours(field: StarField) -> IntArray:
    """Return triangles (t, 3) of stars and their nearest neighbours, which need not be bright."""
    cosines = field.direction[:_CENTRES] @ field.direction.T
    near = np.argsort(-cosines, axis=1)[:, 1 : _NEIGHBOURS + 1]
    one, two = np.triu_indices(_NEIGHBOURS, 1)
    corners = np.stack(
        np.broadcast_arrays(np.arange(len(near))[:, None], near[:, one], near[:, two]), axis=-1
    ).reshape(-1, 3)
    return np.unique(np.sort(corners, axis=1), axis=0)
