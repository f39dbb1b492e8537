"""The triangles of observed stars to be looked up, in order."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

import numpy as np

from flight.gnc.math.arrays import IntArray
from flight.gnc.vision.startracker.identification.field import StarField

_BRIGHTEST = 20
_NEIGHBOURS = 5
_CENTRES = 40


def batches_of(field: StarField, sizes: tuple[int, ...], steps: int) -> Iterator[IntArray]:
    """Yield triangles (t, 3), those of the brightest stars first.

    With many `steps` of scale a batch is smaller, by the root of their number: the first solves most frames.
    """
    brightest = triples(min(len(field), _BRIGHTEST))
    begin = 0
    for size in sizes:
        end = min(begin + max(20, int(size / steps**0.5)), len(brightest))
        if end > begin:
            yield brightest[begin:end]
        begin = end
    if len(field) > _BRIGHTEST:
        yield neighbours(field)


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
