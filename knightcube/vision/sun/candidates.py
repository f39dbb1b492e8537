"""Places in a frame where the Sun could be: bright patches on a few rows, read first by random access."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import find_objects, label

from knightcube.astro.arrays import FloatArray, Image
from knightcube.vision.camera.pixel_access import PixelAccess

MOST = 4
"""Patches that are examined, the largest first."""
LEAST = 3
"""Pixels of a patch on the rows that are read: a chord of the Sun's disc, but not a hot pixel."""


@dataclass(frozen=True, slots=True, eq=False)
class Patch:
    """A bright patch: its `middle` (2,) px, and `half` px of its greater extent."""

    middle: FloatArray
    half: float


def bright_patches(
    pixels: PixelAccess, level: float, stride: int, narrowest: float, widest: float
) -> tuple[list[Patch], bool]:
    """Return the patches above `level` counts on every `stride`th row, largest first.

    Patches narrower than `narrowest` px or wider than `widest` are excluded; the second value is whether
    any wide one was.
    """
    rows = np.arange(stride // 2, pixels.rows, stride)
    bright = pixels.read_rows(rows) >= level
    if not bright.any():
        return [], False
    # Labelling costs per pixel: only the box about all bright pixels is labelled.
    down, across = np.flatnonzero(bright.any(axis=1)), np.flatnonzero(bright.any(axis=0))
    top, left = int(down[0]), int(across[0])
    labels, count = label(bright[top : down[-1] + 1, left : across[-1] + 1])
    sizes = np.bincount(labels.ravel(), minlength=count + 1)[1:]
    boxes = find_objects(labels)
    patches: list[Patch] = []
    wide = False
    for patch in np.argsort(-sizes, kind="stable").tolist():
        if sizes[patch] < LEAST or len(patches) == MOST:
            break
        box = boxes[patch]
        extent = max((box[0].stop - box[0].start) * stride, box[1].stop - box[1].start)
        wide = wide or extent > widest
        if not narrowest <= extent <= widest:
            continue
        y, x = np.nonzero(labels[box] == patch + 1)
        y, x = y + box[0].start + top, x + box[1].start + left
        middle = np.array([x.mean(), rows[0] + stride * y.mean()])
        patches.append(Patch(middle, 0.5 * extent))
    return patches, wide


def window(pixels: PixelAccess, middle: FloatArray, reach: float) -> tuple[Image, int]:
    """Return the rows within `reach` px of the point `middle` (2,), and the first one's number."""
    first = max(int(np.floor(middle[1] - reach)), 0)
    last = min(int(np.ceil(middle[1] + reach)), pixels.rows - 1)
    return pixels.read_rows(np.arange(first, last + 1)), first
