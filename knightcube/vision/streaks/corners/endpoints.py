"""Endpoints of a streak from its cornerness: sub-maximal suppression, centre of intensity (Sease 3.15, 3.16).

The Gaussians of the chain shift the peaks along the streak by a constant of the point spread and the kernels
(Sease, end of chapter 3). `extend` moves them back by that constant, measured with
`python -m tests.studies.bench.endpoint_bias`.
"""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray


def local_maxima(response: FloatArray, mask: BoolArray, relative: float) -> IntArray:
    """Return the pixels (x, y), (n, 2), that exceed all eight neighbours: sub-maximal suppression.

    Only pixels of `mask` count, off the image's border, with at least `relative` of the largest response in
    the mask.
    """
    inner = response[1:-1, 1:-1]
    rows, columns = inner.shape
    allowed = mask[1:-1, 1:-1]
    top = float(inner[allowed].max(initial=0.0))
    if top <= 0.0:
        return np.empty((0, 2), dtype=np.int64)
    y, x = np.nonzero(allowed & (inner >= relative * top))
    steps = [(dy, dx) for dy in (0, 1, 2) for dx in (0, 1, 2) if (dy, dx) != (1, 1)]
    neighbours = np.stack([response[dy : dy + rows, dx : dx + columns][y, x] for dy, dx in steps])
    peak = inner[y, x] > neighbours.max(axis=0)
    return np.stack([x[peak] + 1, y[peak] + 1], axis=-1)


def centre_of_intensity(image: FloatArray, pixel: IntArray, half_width: int) -> FloatArray:
    """Return the intensity-weighted centre (x, y) of the (2 half_width + 1)^2 pixels about `pixel` (x, y).

    3.15 corrected (the printed sums lack the coordinate) and 3.16. Negative pixels weigh nothing; a window
    that the border cuts loses the same on the other side, so that it stays centred on `pixel`.
    """
    x, y = int(pixel[0]), int(pixel[1])
    rows, columns = image.shape
    n = min(half_width, x, y, columns - 1 - x, rows - 1 - y)
    window = np.maximum(image[y - n : y + n + 1, x - n : x + n + 1], 0.0)
    total = window.sum()
    if total <= 0.0:
        return np.array([x, y], dtype=float)
    i = np.arange(-n, n + 1)
    return np.array([x + window.sum(axis=0) @ i / total, y + window.sum(axis=1) @ i / total])


def find_corners(
    response: FloatArray, mask: BoolArray, relative: float, half_width: int, intensity: FloatArray
) -> FloatArray:
    """Return the corners (n, 2) of a region: its peaks of cornerness, each to a fraction of a pixel.

    The centre is that of `intensity`: the response itself, or the image, which is the thesis's own and lies
    up to 2 px inside the streak. A streak has two; more betray noise, crossing streaks or something that is
    no star (chapter 3).
    """
    peaks = local_maxima(response, mask, relative)
    centres = [centre_of_intensity(intensity, peak, half_width) for peak in peaks]
    return np.array(centres).reshape(-1, 2)


def extend(endpoints: FloatArray, outward: FloatArray, bias: float) -> FloatArray:
    """Return the endpoints (..., 2) moved by `bias` px along `outward` (..., 2), of any length but zero."""
    return np.asarray(endpoints + bias * outward / np.linalg.norm(outward, axis=-1, keepdims=True))


def chord_outward(endpoints: FloatArray) -> FloatArray:
    """Return the directions (n, 2, 2) out of each streak (n, 2, 2) at its two ends, along the chord."""
    chord = endpoints[:, 1] - endpoints[:, 0]
    return np.stack([-chord, chord], axis=1)
