"""The step between a frame's counts: 257 where eight bits were written as sixteen, 16 where twelve were."""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import Image

# Pixels are sampled so sparsely first; repaired ones between the steps are fewer than this part.
_STRIDE = 16
_MOST_BETWEEN = 0.01


def in_steps(pixels: Image) -> tuple[Image, int, int]:
    """Return unsigned `pixels` (rows, columns) in steps of their counts, the step, and the count of step 0.

    Pixels whose counts have no common step come back as they are, with 1 and 0.
    """
    values = np.unique(pixels[::_STRIDE, ::_STRIDE]).astype(np.int64)
    step = int(np.gcd.reduce(values - values[0]))
    if step <= 1:
        return pixels, 1, 0
    offset = int(values[0]) % step
    between = np.count_nonzero((pixels.astype(np.int64) - offset) % step)
    if between > _MOST_BETWEEN * pixels.size:
        return pixels, 1, 0
    steps = (pixels.astype(np.int64) - offset + step // 2) // step
    return np.maximum(steps, 0).astype(pixels.dtype), step, offset
