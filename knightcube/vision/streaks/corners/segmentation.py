"""Threshold and connected regions of a frame (Sease chapter 3, "Streak Identification & Separation").

The working threshold is local background plus k sigma on the 3 x 3 sum, which is nearly the matched filter of
a star one pixel wide (errata, chapter 3); the image's mean is kept as the thesis's own option.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from knightcube.astro.arrays import BoolArray, FloatArray, Image, IntArray, select
from knightcube.vision.frame import box_sum, label_pixels, moments


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

    def select(self, chosen: BoolArray | IntArray) -> Regions:
        """Return the regions that `chosen` picks, by mask (n,) or by index in the order given."""
        return select(self, chosen, "labels")

    def __len__(self) -> int:
        return self.label.size


def threshold_local(signal: Image, noise: Image, sigmas: float) -> BoolArray:
    """Return where the 3 x 3 sum of `signal` (background removed) exceeds `sigmas` times that sum's noise."""
    return np.asarray(box_sum(signal) > (3.0 * sigmas) * noise)


def threshold_mean(pixels: Image) -> BoolArray:
    """Return where `pixels` exceed the image's mean: the thesis's own threshold, for frames without noise."""
    return np.asarray(pixels > pixels.mean())


def find_regions(mask: BoolArray, signal: Image, least_area: int) -> Regions:
    """Return the 8-connected regions of `mask` of `least_area` pixels or more, with moments in `signal`."""
    pixel = np.flatnonzero(mask)
    number, count = label_pixels(pixel, mask.shape[1])
    labels = np.zeros(mask.shape, dtype=np.int32)
    labels.reshape(-1)[pixel] = number + 1
    row, column = np.divmod(pixel, mask.shape[1])
    # Above the image's mean a region may still lie below the background: without light it has no moments.
    light = np.maximum(signal[row, column], 0.0).astype(np.float64)
    found = moments(number, column, row, light, count)
    area = np.bincount(number, minlength=count)
    slices = ndimage.find_objects(labels)
    boxes = np.array([(s[0].start, s[0].stop, s[1].start, s[1].stop) for s in slices], dtype=np.int64)
    kept = np.flatnonzero(area >= least_area)
    return Regions(
        labels, kept + 1, boxes.reshape(-1, 4)[kept], area[kept], found.flux[kept], found.length[kept]
    )
