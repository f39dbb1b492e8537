"""Connected regions of light with their moments: what the first guess is made of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from flight.arrays import BoolArray, FloatArray, IntArray
from flight.vision.likelihood.exposed_frame import ExposedFrame, Float32Array
from flight.vision.segmentation import positions

_EIGHT_NEIGHBOURS = np.ones((3, 3), dtype=np.int64)
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

    def __len__(self) -> int:
        return len(self.flux)


def find_blobs(frame: ExposedFrame, sigmas: float, most: int) -> Blobs:
    """Return the `most` brightest regions whose 3 x 3 sum exceeds `sigmas` of its noise."""
    signal, floor = frame.signal.reshape(frame.shape), frame.floor.reshape(frame.shape)
    mask = _above(frame.sums.reshape(frame.shape), floor, 3.0 * sigmas)
    labels, count = ndimage.label(mask, structure=_EIGHT_NEIGHBOURS)
    row, column = positions(mask)
    number = labels[row, column]
    light = np.maximum(signal[row, column], 0.0).astype(np.float64)
    area = np.bincount(number, minlength=count + 1)
    flux = np.bincount(number, light, count + 1)
    flux[area < _LEAST_AREA] = 0.0
    chosen = np.argsort(-flux, kind="stable")[:most]
    chosen = chosen[flux[chosen] > 0.0]
    rank = np.full(count + 1, -1)
    rank[chosen] = np.arange(len(chosen))
    owner = rank[number]
    kept = owner >= 0
    return _measured(frame, owner[kept], column[kept], row[kept], light[kept], len(chosen))


def _above(sums: Float32Array, floor: Float32Array, sigmas: float) -> BoolArray:
    """Tell where `sums` exceed `sigmas` times the root of `floor`, all (rows, columns)."""
    mask = sums > np.float32(sigmas * np.sqrt(floor.min()))
    row, column = positions(mask)
    mask[row, column] = sums[row, column] > np.float32(sigmas) * np.sqrt(floor[row, column])
    return mask


def _measured(
    frame: ExposedFrame, owner: IntArray, column: IntArray, row: IntArray, light: FloatArray, count: int
) -> Blobs:
    flux = np.bincount(owner, light, count).astype(np.float64)
    x = np.bincount(owner, light * column, count) / flux
    y = np.bincount(owner, light * row, count) / flux
    dx, dy = column - x[owner], row - y[owner]
    xx = np.bincount(owner, light * dx * dx, count) / flux
    yy = np.bincount(owner, light * dy * dy, count) / flux
    xy = np.bincount(owner, light * dx * dy, count) / flux
    angle = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    rows, columns = frame.shape
    edge = (row < _BORDER) | (row >= rows - _BORDER) | (column < _BORDER) | (column >= columns - _BORDER)
    return Blobs(
        np.stack([x, y], axis=-1),
        np.stack([-np.sin(angle), np.cos(angle)], axis=-1),
        np.sqrt(12.0 * np.hypot(xx - yy, 2.0 * xy)),
        flux,
        np.bincount(owner, edge.astype(float), count) > 0.0,
        owner,
        column,
        row,
        light,
    )
