"""Detects torn frames: buffers that were only partly overwritten.

Read noise makes every row of a working sensor unique, so a row that equals an earlier frame's is a copy. A
frame with some copied rows is torn. A frame of copied rows only means a frozen camera, which is detected
elsewhere. Rows without noise, as of a dark sensor of few bits, are ignored.
"""

from __future__ import annotations

import zlib
from collections import deque

import numpy as np

from knightcube.astro.arrays import Image

_ROWS = 32
_FRAMES = 4
"""The number of a driver's buffers."""
_LEAST_CHANGES = 0.125
"""A row has noise when at least this fraction of neighbouring pixels differ."""


class RepeatedRows:
    """Keeps checksums of some rows of the last frames."""

    def __init__(self) -> None:
        self._seen: deque[dict[int, int]] = deque(maxlen=_FRAMES)

    def look(self, pixels: Image) -> int:
        """Check a frame (rows, columns); return how many sampled rows are copies of an earlier frame's.

        0 for an intact frame, and for a frame of copied rows only.
        """
        rows = np.unique(np.linspace(0, len(pixels) - 1, _ROWS).astype(int)).tolist()
        here = {row: zlib.crc32(pixels[row].tobytes()) for row in rows if _has_noise(pixels[row])}
        old = sum(any(before.get(row) == value for before in self._seen) for row, value in here.items())
        self._seen.append(here)
        return old if old < len(here) else 0


def _has_noise(row: Image) -> bool:
    return int(np.count_nonzero(row[1:] != row[:-1])) >= _LEAST_CHANGES * len(row)
