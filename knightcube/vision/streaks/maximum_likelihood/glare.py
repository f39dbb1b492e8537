"""Light of no star, as a limb or a reflection, where the background does not follow it.

A bright region that is solid over more px than any star's light is wide is no star's. Its pixels, and those
about them, where the background follows the light as badly, are left out like hot pixels. A net of streaks
that cross is not solid.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from knightcube.astro.arrays import BoolArray
from knightcube.vision.frame import box_sum
from knightcube.vision.streaks.maximum_likelihood.blobs import Blobs
from knightcube.vision.streaks.maximum_likelihood.exposed_frame import ExposedFrame

# Mean width, px, from which on a region may be solid: the brightest stars have half of it.
_BROAD = 25.0
_LEAST_LENGTH = 40.0
# Side, px, of the square that must find room in a solid region.
_SOLID = 31
# px about a solid region that are left out, too.
_ABOUT = 12


def without_glare(frame: ExposedFrame, blobs: Blobs) -> ExposedFrame | None:
    """Return `frame` without the solid ones of its regions; None when none is solid."""
    area = np.bincount(blobs.owner, minlength=len(blobs))
    broad = area > _BROAD * np.maximum(blobs.length, _LEAST_LENGTH)
    if not broad.any():
        return None
    from scipy import ndimage  # noqa: PLC0415 - few frames need it

    # What lies beyond the frame's border is as what lies at it.
    room = ndimage.minimum_filter(_drawn(frame, blobs, broad), _SOLID)
    solid = np.bincount(blobs.owner, room[blobs.row, blobs.column], len(blobs)) > 0.0
    if not solid.any():
        return None
    out = ndimage.maximum_filter(_drawn(frame, blobs, solid), 2 * _ABOUT + 1).reshape(-1)
    signal = np.where(out, np.float32(0.0), frame.signal)
    sums = box_sum(signal.reshape(frame.shape)).reshape(-1)
    return replace(frame, signal=signal, sums=sums, bad=frame.bad | out)


def _drawn(frame: ExposedFrame, blobs: Blobs, which: BoolArray) -> BoolArray:
    """Return on which pixels (rows, columns) the regions `which` (n,) lie."""
    within = which[blobs.owner]
    mask = np.zeros(frame.shape, dtype=np.bool_)
    mask[blobs.row[within], blobs.column[within]] = True
    return mask
