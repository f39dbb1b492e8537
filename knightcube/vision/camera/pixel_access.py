"""Random access to a camera's pixels by whole columns or rows.

The Fuga 15d of Meller et al. is read by address, like a memory (chapter 1); a detector that must be read out
whole implements the same two calls.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from knightcube.astro.arrays import Image, IntArray


class PixelAccess(Protocol):
    """A camera or picture whose rows and columns can be read individually."""

    @property
    def rows(self) -> int:
        """Pixels in a column."""

    @property
    def columns(self) -> int:
        """Pixels in a row."""

    def read_rows(self, indices: IntArray) -> Image:
        """Return the rows (n, columns) of those indices (n,)."""

    def read_columns(self, indices: IntArray) -> Image:
        """Return the columns (n, rows) of those indices (n,)."""


class ArrayPixels:
    """An image in memory that counts the pixels read.

    Attributes:
        pixels_read: since creation; a pixel read by row and by column counts twice.
    """

    def __init__(self, image: Image) -> None:
        if image.ndim != 2 or 0 in image.shape:
            raise ValueError(f"an image of shape {image.shape}: must be (rows, columns), none of them 0")
        if image.dtype.kind == "f" and not np.all(np.isfinite(image)):
            raise ValueError("an image with pixels that are not finite")
        self._image = image
        self.pixels_read = 0

    @property
    def rows(self) -> int:
        """Pixels in a column."""
        return int(self._image.shape[0])

    @property
    def columns(self) -> int:
        """Pixels in a row."""
        return int(self._image.shape[1])

    def read_rows(self, indices: IntArray) -> Image:
        """Return the rows (n, columns) of those indices (n,)."""
        self.pixels_read += len(indices) * self.columns
        return np.asarray(self._image[np.asarray(indices, dtype=int)])

    def read_columns(self, indices: IntArray) -> Image:
        """Return the columns (n, rows) of those indices (n,)."""
        self.pixels_read += len(indices) * self.rows
        return np.asarray(self._image[:, np.asarray(indices, dtype=int)].T)
