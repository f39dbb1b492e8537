"""Is a frame of one piece? Rows that an earlier frame had, noise and all, were not exposed anew.

Read noise makes every row of a living sensor unlike all others. So where some rows are those of an earlier
frame and others are not, the frame is torn: a buffer that was only partly written. Where all are, the camera
is frozen, which is told elsewhere. Rows without noise, as of a dark sensor of few bits, say nothing.
"""

from __future__ import annotations

import zlib
from collections import deque

import numpy as np

from flight.gnc.math.arrays import Image

_ROWS = 32
_FRAMES = 4
"""As many as a driver has buffers."""
_LEAST_CHANGES = 0.125
"""Part of a row's neighbours that differ where there is noise."""


class RepeatedRows:
    """Remembers checksums of some rows of the last frames."""

    def __init__(self) -> None:
        self._seen: deque[dict[int, int]] = deque(maxlen=_FRAMES)

    def look(self, pixels: Image) -> int:
        """Take a frame (rows, columns); return at how many rows of those looked at it is an earlier one's.

        0 for a frame of one piece, and for one that is an earlier frame altogether.
        """
        rows = np.unique(np.linspace(0, len(pixels) - 1, _ROWS).astype(int)).tolist()
        here = {row: zlib.crc32(pixels[row].tobytes()) for row in rows if _has_noise(pixels[row])}
        old = sum(any(before.get(row) == value for before in self._seen) for row, value in here.items())
        self._seen.append(here)
        return old if old < len(here) else 0


def _has_noise(row: Image) -> bool:
    return int(np.count_nonzero(row[1:] != row[:-1])) >= _LEAST_CHANGES * len(row)
