"""Threshold and connected regions of a frame (Sease chapter 3, "Streak Identification & Separation").

The working threshold is local background plus k sigma on the 3 x 3 sum, which is nearly the matched filter of
a star one pixel wide (errata, chapter 3); the image's mean is kept as the thesis's own option.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from flight.gnc.math.arrays import BoolArray, FloatArray, Image, IntArray

_EIGHT_NEIGHBOURS = np.ones((3, 3), dtype=np.int64)
# Pixels of a frame that are summed at a time.
_STRETCH = 32_768


@dataclass(frozen=True, slots=True)
class Regions:
    """Connected regions of one frame, `n` of them, the small ones already dropped.

    Attributes:
        labels: (rows, columns) int32, which region a pixel belongs to: 0 none, else `label` of the region.
        label: (n,) the region's number in `labels`.
        boxes: (n, 4) first row, last row + 1, first column, last column + 1.
        area: (n,) pixels.
        flux: (n,) counts above the background.
        length: (n,) px, of the uniform line with the region's second moments; about 0 for a round blob.
    """

    labels: Image
    label: IntArray
    boxes: IntArray
    area: IntArray
    flux: FloatArray
    length: FloatArray

    def select(self, keep: BoolArray | IntArray) -> Regions:
        """Return the regions that `keep` picks, by mask (n,) or by index in the order given."""
        return Regions(
            self.labels,
            self.label[keep],
            self.boxes[keep],
            self.area[keep],
            self.flux[keep],
            self.length[keep],
        )

    def __len__(self) -> int:
        return self.label.size


def repair_hot_pixels(signal: Image, noise: Image, sharpness: float = 0.15, sigmas: float = 10.0) -> int:
    """Replace in place the pixels of `signal` that no optics could make, and return how many.

    Hot is a pixel above `sigmas` times the noise (rows, columns) whose every neighbour stays below
    `sharpness` of it (plus 3 sigma): a star's image wider than sigma 0.5 px gives its neighbours more. It
    takes its neighbours' mean.
    """
    row, column = positions(signal > sigmas * noise)
    inside = (row > 0) & (row < signal.shape[0] - 1) & (column > 0) & (column < signal.shape[1] - 1)
    row, column = row[inside], column[inside]
    steps = [(dr, dc) for dr in (-1, 0, 1) for dc in (-1, 0, 1) if (dr, dc) != (0, 0)]
    around = np.stack([signal[row + dr, column + dc] for dr, dc in steps])
    hot = around.max(axis=0) < sharpness * signal[row, column] + 3.0 * noise[row, column]
    signal[row[hot], column[hot]] = around[:, hot].mean(axis=0)
    return int(np.count_nonzero(hot))


def positions(mask: BoolArray) -> tuple[IntArray, IntArray]:
    """Return rows and columns of a mask's true pixels: as nonzero, much faster when they are few."""
    row, column = np.divmod(np.flatnonzero(mask), mask.shape[1])
    return row, column


def box_sum(image: Image) -> Image:
    """Return the sum over 3 x 3 pixels about each pixel of (rows, columns); the outermost are zero."""
    columns, flat = image.shape[1], np.ascontiguousarray(image).reshape(-1)
    total = np.empty(image.shape, dtype=image.dtype)
    sums = total.reshape(-1)
    # Rows run into each other, which only the outermost pixels see. A stretch that stays in the processor's
    # cache takes a third of the time of the whole frame at once.
    for start in range(columns + 1, flat.size - columns - 1, _STRETCH):
        stop = min(start + _STRETCH, flat.size - columns - 1)
        down = flat[start - columns - 1 : stop - columns + 1] + flat[start - 1 : stop + 1]
        down += flat[start + columns - 1 : stop + columns + 1]
        inner = sums[start:stop]
        np.add(down[:-2], down[1:-1], out=inner)
        inner += down[2:]
    total[[0, -1]] = 0
    total[:, [0, -1]] = 0
    return total


def less_boxes(sums: Image, shape: tuple[int, int], pixels: IntArray, taken: Image) -> Image:
    """Return the flat `sums` over 3 x 3 pixels of a frame of `shape` from which light was `taken`.

    `pixels` (m,) are flat, no one twice; `taken` (m,) is their light.
    """
    out, (rows, columns) = sums.copy(), shape
    for down in (-columns, 0, columns):
        for beside in (-1, 0, 1):
            # What runs over the frame's edge ends on its outermost pixels, which are zero.
            out[np.clip(pixels + (down + beside), 0, out.size - 1)] -= taken
    framed = out.reshape(rows, columns)
    framed[[0, -1]] = 0
    framed[:, [0, -1]] = 0
    return out


def threshold_local(signal: Image, noise: Image, sigmas: float) -> BoolArray:
    """Return where the 3 x 3 sum of `signal` (background removed) exceeds `sigmas` times that sum's noise."""
    return np.asarray(box_sum(signal) > (3.0 * sigmas) * noise)


def threshold_mean(pixels: Image) -> BoolArray:
    """Return where `pixels` exceed the image's mean: the thesis's own threshold, for frames without noise."""
    return np.asarray(pixels > pixels.mean())


def find_regions(mask: BoolArray, signal: Image, least_area: int) -> Regions:
    """Return the 8-connected regions of `mask` of `least_area` pixels or more, with moments in `signal`."""
    labels, count = ndimage.label(mask, structure=_EIGHT_NEIGHBOURS)
    row, column = positions(mask)
    number = labels[row, column]
    area = np.bincount(number, minlength=count + 1)
    kept = np.flatnonzero(area >= least_area)
    kept = kept[kept > 0]
    weight = np.maximum(signal[row, column], 0.0).astype(np.float64)
    flux = np.bincount(number, weight, count + 1).astype(np.float64)
    # Above the image's mean a region may still lie below the background: without counts it has no moments.
    whole = np.where(flux > 0.0, flux, np.inf)
    mean_x = np.bincount(number, weight * column, count + 1) / whole
    mean_y = np.bincount(number, weight * row, count + 1) / whole
    dx, dy = column - mean_x[number], row - mean_y[number]
    xx = np.bincount(number, weight * dx * dx, count + 1) / whole
    yy = np.bincount(number, weight * dy * dy, count + 1) / whole
    xy = np.bincount(number, weight * dx * dy, count + 1) / whole
    # The difference of the principal moments is free of the point spread, which widens both alike; a line of
    # length L has L^2/12.
    length = np.sqrt(12.0 * np.hypot(xx - yy, 2.0 * xy))
    return Regions(labels, kept, _boxes(labels, count)[kept], area[kept], flux[kept], length[kept])


def _boxes(labels: Image, count: int) -> IntArray:
    """Return the bounding boxes (count + 1, 4) of all labels; row 0 (the background) is zeros."""
    found = ndimage.find_objects(labels, max_label=count)
    rows = [(s[0].start, s[0].stop, s[1].start, s[1].stop) for s in found]
    return np.array([(0, 0, 0, 0), *rows], dtype=np.int64)
