"""One-dimensional edges along scan lines, to a whole pixel (Meller et al. 3.1).

A line is divided by the average of its high intensities and rounded to 0 or 1; fluctuations shorter than a
run are filtered out; the first change from 0 to 1 is the edge.
"""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, Image, IntArray

RUN = 5
"""px: window of the majority filter; shorter fluctuations are removed."""


def high_average(lines: Image) -> FloatArray:
    """Return the average high intensity (n,) of lines (n, m): the mean of what lies above mid-range.

    The paper does not define high; here it is above the middle between a line's least and most.
    """
    values = np.asarray(lines, dtype=float)
    middle = 0.5 * (values.min(axis=1, keepdims=True) + values.max(axis=1, keepdims=True))
    high = values >= middle
    return np.asarray(np.sum(values * high, axis=1) / np.sum(high, axis=1))


def binarised(lines: Image, high: FloatArray) -> BoolArray:
    """Return lines (n, m) divided by their high averages (n,) and rounded to 0 or 1 (step 1 of 3.1)."""
    return np.asarray(lines >= 0.5 * np.asarray(high)[:, None])


def run_filtered(binary: BoolArray, run: int = RUN) -> BoolArray:
    """Return binary lines (n, m) with runs shorter than half of `run` px, odd, filtered out (step 2 of 3.1).

    A pixel becomes what most of the `run` pixels about it are; beyond a line's ends stands its last pixel.
    """
    half = run // 2
    size = binary.shape[1]
    padded = np.empty((len(binary), size + 2 * half), dtype=np.int16)
    padded[:, half : half + size] = binary
    padded[:, :half], padded[:, half + size :] = binary[:, :1], binary[:, -1:]
    total = padded[:, :size].copy()
    for place in range(1, run):
        total += padded[:, place : place + size]
    return np.asarray(total > half)


def first_edges(binary: BoolArray) -> IntArray:
    """Return for each binary line (n, m) the first 1 that follows a 0, (n,); -1 where there is none."""
    rises = binary[:, 1:] & ~binary[:, :-1]
    return np.where(np.any(rises, axis=1), np.argmax(rises, axis=1) + 1, -1)


def horizon_points(lines: Image, run: int = RUN) -> IntArray:
    """Return the paper's edge (n,) of each line (n, m): normalised, binarised, filtered; -1 for none."""
    return first_edges(run_filtered(binarised(lines, high_average(lines)), run))
