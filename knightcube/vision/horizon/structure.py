"""Masks of the spacecraft's own structure in the images of the horizon cameras.

A mask is configured (polygons or an image file), or is estimated from successive frames. While the limb moves
over the image, the brightness of each pixel of the scene changes repeatedly, whereas the brightness of the
structure stays constant. `StructureMap` compares the mean brightness of square blocks of pixels with that in
the last counted frame. A frame is counted if a quarter of its blocks have changed. A block that did not
change in `_QUIET_FRAMES` successive counted frames shows structure. A block whose brightness changes is at
once removed from the mask, so that a wrong mask does not hide a limb.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, Image, IntArray

_BLOCK = 8
"""Width and height of a block, px."""
_CHANGE = 0.08
"""Threshold for a change of a block's mean brightness, relative to the brightness range of the image."""
_MOVED = 0.25
"""Minimum fraction of changed blocks for a frame to be counted."""
_QUIET_FRAMES = 12
"""Number of successive counted frames in which a block must be unchanged to count as structure."""
_LARGEST = 0.4
"""Largest fraction of the image that an estimated mask may cover.

An estimated mask that covers a larger fraction is discarded.
"""


def polygon_mask(rows: int, columns: int, polygons: Sequence[Sequence[tuple[float, float]]]) -> BoolArray:
    """Return the mask (rows, columns) of the pixels inside any polygon, by the even-odd rule.

    Each polygon is a sequence of corners (x, y), px, with (0, 0) at the centre of the top-left pixel.
    """
    mask = np.zeros((rows, columns), dtype=bool)
    if not polygons:
        return mask
    y, x = np.mgrid[0:rows, 0:columns].astype(float)
    for corners in polygons:
        inside = np.zeros_like(mask)
        for (x1, y1), (x2, y2) in zip(corners, (*corners[1:], corners[0]), strict=True):
            if y1 != y2:
                crosses = (y1 > y) != (y2 > y)
                inside ^= crosses & (x < x1 + (x2 - x1) * (y - y1) / (y2 - y1))
        mask |= inside
    return mask


@dataclass(frozen=True, slots=True, eq=False)
class StructureMap:
    """Blocks of one camera's images that show structure, by configuration or by estimation from frames.

    Attributes:
        rows, columns: number of pixels of the images.
        configured: mask of the blocks that contain configured structure (m, n).
        level: mean brightness of the blocks in the last counted frame (m, n), or an empty array (0, 0) before
            the first frame.
        quiet: number of counted frames since the last change of each block (m, n).
    """

    rows: int
    columns: int
    configured: BoolArray
    level: FloatArray
    quiet: IntArray

    @classmethod
    def of(cls, configured: BoolArray) -> StructureMap:
        """Return a map with only the configured structure, given its mask `configured` (rows, columns)."""
        blocks = np.asarray(_blocks(configured.astype(float)) > 0.0)
        rows, columns = configured.shape
        return cls(rows, columns, blocks, np.zeros((0, 0)), np.zeros(blocks.shape, dtype=np.int64))

    def after(self, image: Image) -> StructureMap:
        """Return the map after a frame (rows, columns)."""
        level = _blocks(image)
        if not self.level.size:
            return replace(self, level=level)
        low, high = np.quantile(np.stack([level, self.level]), [0.02, 0.98])
        changed = np.abs(level - self.level) > _CHANGE * max(float(high - low), 1e-12)
        quiet = np.where(changed, 0, self.quiet)
        if np.count_nonzero(changed & ~self.configured) < _MOVED * changed.size:
            return replace(self, quiet=quiet)
        quiet = np.where(changed, 0, quiet + 1)
        if np.mean(quiet >= _QUIET_FRAMES) > _LARGEST:
            quiet = np.zeros_like(quiet)
        return replace(self, level=level, quiet=quiet)

    @property
    def mask(self) -> BoolArray | None:
        """The mask (rows, columns) of the pixels that show the spacecraft's structure, or None if none do.

        The estimated structure is widened by one block, because a block at the border of the structure shows
        partly the spacecraft and partly the scene. An unchanged block counts as structure only if at least
        two of its neighbours are also unchanged.
        """
        learned = self.quiet >= _QUIET_FRAMES
        learned &= _neighbours(learned) >= 2
        blocks = self.configured | (_neighbours(learned) > 0) | learned
        if not blocks.any():
            return None
        grown = np.repeat(np.repeat(blocks, _BLOCK, axis=0), _BLOCK, axis=1)
        return np.asarray(grown[: self.rows, : self.columns])


def _neighbours(blocks: BoolArray) -> IntArray:
    """Return the number of set neighbours of each block (m, n), of at most eight."""
    padded = np.pad(blocks.astype(np.int64), 1)
    m, n = blocks.shape
    around = sum(padded[i : i + m, j : j + n] for i in range(3) for j in range(3))
    return np.asarray(around - blocks)


def _blocks(image: Image | FloatArray) -> FloatArray:
    """Return the mean of each block of an image (rows, columns); incomplete blocks repeat the border."""
    rows, columns = image.shape
    padded = np.pad(image, ((0, -rows % _BLOCK), (0, -columns % _BLOCK)), mode="edge")
    m, n = padded.shape[0] // _BLOCK, padded.shape[1] // _BLOCK
    return np.asarray(padded.reshape(m, _BLOCK, n, _BLOCK).mean(axis=(1, 3), dtype=float))
