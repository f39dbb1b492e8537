"""A colour camera's raw frame: pixels in turn behind filters of other colours, of unlike responses.

What the four pixels of a cell of two by two respond to the stars, on the whole, the bright regions say: each
has about the same light on all four. Divided by it a frame is as the fit expects it; what is left is that
stars have colours.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.vision.frame import box_sum
from knightcube.vision.streaks.maximum_likelihood.blobs import Blobs
from knightcube.vision.streaks.maximum_likelihood.exposed_frame import ExposedFrame

# Brightest regions by which the responses are measured, at most and at least.
_MOST = 24
_LEAST = 6
# A response differs from the mean where it is this far off it, by this number of its deviations.
_UNEVEN = 0.06
_SURE = 8.0
# Deviation of a normal distribution in its quartiles' distance; error of a median over that of a mean.
_QUARTILES = 1.35
_MEDIAN = 1.25


def without_mosaic(frame: ExposedFrame, blobs: Blobs) -> ExposedFrame | None:
    """Return `frame` with all its pixels of one response; None where they have one."""
    response = _responses(blobs)
    if response is None:
        return None
    rows, columns = frame.shape
    share = np.tile(response.reshape(2, 2), (rows // 2 + 1, columns // 2 + 1))[:rows, :columns]
    each = share.astype(np.float32)
    signal = frame.signal.reshape(frame.shape) / each
    return replace(
        frame,
        signal=signal.reshape(-1),
        sums=box_sum(signal).reshape(-1),
        floor=(frame.floor / np.square(each).reshape(-1)).astype(np.float32),
    )


def _responses(blobs: Blobs) -> FloatArray | None:
    """Return the responses (4,), of mean 1, of even and odd columns of even rows, then of odd rows."""
    count = min(len(blobs), _MOST)
    if count < _LEAST:
        return None
    place = 4 * blobs.owner + 2 * (blobs.row % 2) + blobs.column % 2
    light = np.bincount(place, blobs.light, 4 * len(blobs)).reshape(-1, 4)[:count]
    share = light / np.mean(light, axis=1, keepdims=True)
    low, middle, high = np.quantile(share, (0.25, 0.5, 0.75), axis=0)
    off = np.abs(middle - 1.0)
    error = _MEDIAN * (high - low) / _QUARTILES / np.sqrt(count)
    if not np.any((off > _UNEVEN) & (off > _SURE * error)) or np.any(middle <= 0.0):
        return None
    return np.asarray(middle / middle.mean())
