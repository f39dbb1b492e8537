"""Random access to a camera's pixels: whole columns or rows, nothing else is read.

The Fuga 15d of Meller et al. answers an address with that pixel's light, like a memory (chapter 1); a
detector that must be read out whole stands behind the same two calls.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from flight.gnc.math.arrays import Image, IntArray


class PixelAccess(Protocol):
    """A camera or a picture whose lines can be read one by one."""

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
    """A picture in memory that counts how many of its pixels were read.

    Attributes:
        pixels_read: since it was made; a pixel on a row and a column that were read counts twice.
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
