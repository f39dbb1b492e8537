"""Connected regions of light with their moments: the basis of the first guess."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.vision.frame import label_pixels, moments
from knightcube.vision.streaks.maximum_likelihood.exposed_frame import ExposedFrame, Float32Array

# One noise peak fills nine pixels of the 3 x 3 sum.
_LEAST_AREA = 12
# Threshold and point spread widen a region by about this at each end, px.
_BORDER = 3


@dataclass(frozen=True, slots=True, eq=False)
class Blobs:
    """Regions, brightest first, and their pixels.

    Attributes:
        centre: (n, 2) px, of light.
        normal: (n, 2) unit vector across the region.
        length: (n,) px, of the uniform line with the region's moments.
        flux: (n,) counts.
        cut: (n,) whether the region reaches the frame's border.
        owner: (m,) region of each pixel; column, row, light: (m,) of it.
        lit: part of the frame's pixels that lie in regions, chosen or not.
    """

    centre: FloatArray
    normal: FloatArray
    length: FloatArray
    flux: FloatArray
    cut: BoolArray
    owner: IntArray
    column: IntArray
    row: IntArray
    light: FloatArray
    lit: float

    def __len__(self) -> int:
        return len(self.flux)


def find_blobs(frame: ExposedFrame, sigmas: float, most: int) -> Blobs:
    """Return the `most` brightest regions whose 3 x 3 sum exceeds `sigmas` of its noise."""
    pixel = _above(frame.sums, frame.floor, 3.0 * sigmas)
    number, count = label_pixels(pixel, frame.shape[1])
    light = np.maximum(frame.signal[pixel], 0.0).astype(np.float64)
    area = np.bincount(number, minlength=count)
    flux = np.bincount(number, light, count)
    flux[area < _LEAST_AREA] = 0.0
    chosen = np.argsort(-flux, kind="stable")[:most]
    chosen = chosen[flux[chosen] > 0.0]
    rank = np.full(count, -1)
    rank[chosen] = np.arange(len(chosen))
    owner = rank[number]
    kept = np.flatnonzero(owner >= 0)
    row, column = np.divmod(pixel[kept], frame.shape[1])
    lit = len(pixel) / frame.signal.size
    return _measured(frame, owner[kept], column, row, light[kept], len(chosen), lit)


def _above(sums: Float32Array, floor: Float32Array, sigmas: float) -> IntArray:
    """Return where (m,) flat `sums` exceed `sigmas` times the root of `floor`, ascending."""
    pixel = np.flatnonzero(sums > np.float32(sigmas * np.sqrt(floor.min())))
    return pixel[sums[pixel] > np.float32(sigmas) * np.sqrt(floor[pixel])]


def _measured(
    frame: ExposedFrame,
    owner: IntArray,
    column: IntArray,
    row: IntArray,
    light: FloatArray,
    count: int,
    lit: float,
) -> Blobs:
    found = moments(owner, column, row, light, count)
    rows, columns = frame.shape
    edge = (row < _BORDER) | (row >= rows - _BORDER) | (column < _BORDER) | (column >= columns - _BORDER)
    return Blobs(
        found.centre,
        np.stack([-np.sin(found.direction), np.cos(found.direction)], axis=-1),
        found.length,
        found.flux,
        np.bincount(owner, edge.astype(float), count) > 0.0,
        owner,
        column,
        row,
        light,
        lit,
    )
