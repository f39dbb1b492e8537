"""Light that is no streak: a limb, a reflection, as far as the background leaves it over.

Regions that are broad for their length are of no star. Their pixels, and those about them, where the
background follows the light no better, are left out like hot ones.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flight.gnc.vision.frame.box_sums import box_sum
from flight.gnc.vision.streaks.maximum_likelihood.blobs import Blobs
from flight.gnc.vision.streaks.maximum_likelihood.exposed_frame import ExposedFrame

# A region is broad when its area is that of so many px across all its length: bright stars have half of it.
_BROAD = 25.0
_LEAST_LENGTH = 40.0
# So many px about it are left out too.
_ABOUT = 12


def without_glare(frame: ExposedFrame, blobs: Blobs) -> ExposedFrame | None:
    """Return `frame` without the broad ones of its regions; None when none is broad."""
    area = np.bincount(blobs.owner, minlength=len(blobs))
    broad = area > _BROAD * np.maximum(blobs.length, _LEAST_LENGTH)
    if not broad.any():
        return None
    from scipy import ndimage  # noqa: PLC0415 - few frames need it

    within = broad[blobs.owner]
    mask = np.zeros(frame.shape, dtype=np.bool_)
    mask[blobs.row[within], blobs.column[within]] = True
    out = ndimage.maximum_filter(mask, 2 * _ABOUT + 1).reshape(-1)
    signal = np.where(out, np.float32(0.0), frame.signal)
    sums = box_sum(signal.reshape(frame.shape)).reshape(-1)
    return replace(frame, signal=signal, sums=sums, bad=frame.bad | out)
