"""The point spread's width as the frame itself shows it, before any fit.

Across a streak light falls off as a Gaussian of width w: displaced by d px across, it resembles itself by
exp(-d^2/(4 w^2)). Along columns and along rows the resemblances of a streak multiply to that of d across it,
whichever way it runs, and however it bends. Two displacements, neither zero: the pixels' noise then says
nothing.
"""

from __future__ import annotations

import numpy as np

from knightcube.vision.streaks.maximum_likelihood.blobs import Blobs
from knightcube.vision.streaks.maximum_likelihood.exposed_frame import ExposedFrame
from knightcube.vision.streaks.maximum_likelihood.scene import PIXEL_VARIANCE

_NEAR, _FAR = 1, 3
# Brightest regions by which the width is measured, at most and at least.
_MOST = 12
_LEAST = 3


def seen_sigma(frame: ExposedFrame, blobs: Blobs) -> float | None:
    """Return the standard deviation, px, of the point spread without the pixel's square; None if unseen.

    The median of the brightest regions: another star's light beside a streak, or a bright limb, is not most.
    """
    chosen = np.flatnonzero(blobs.owner < _MOST)
    owner, columns = blobs.owner[chosen], frame.shape[1]
    pixel = blobs.row[chosen] * columns + blobs.column[chosen]
    count = min(len(blobs), _MOST)
    light = blobs.light[chosen]
    fallen = np.zeros(count)
    with np.errstate(divide="ignore", invalid="ignore"):
        for step in (1, columns):
            alike = []
            for distance in (_NEAR * step, _FAR * step):
                beside = frame.signal.take(pixel + distance, mode="clip")
                beside = beside + frame.signal.take(pixel - distance, mode="clip")
                alike.append(np.bincount(owner, light * beside, count))
            fallen += np.log(alike[0] / alike[1])
        variance = (_FAR**2 - _NEAR**2) / (4.0 * fallen)
    known = variance[np.isfinite(variance) & (variance > 0.0)]
    if len(known) < _LEAST:
        return None
    return float(np.sqrt(max(float(np.median(known)) - PIXEL_VARIANCE, 0.0)))
