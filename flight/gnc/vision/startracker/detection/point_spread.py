"""The light of stars on the pixels about them: a Gaussian integrated over each pixel, and its derivatives."""

from __future__ import annotations

import math

import numpy as np

from flight.gnc.math.arrays import FloatArray

_BELL = 1.0 / math.sqrt(2.0 * math.pi)


def profile(offset: FloatArray, sigma: FloatArray, half: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the share (n, k) of a star's light in each of k = 2 half + 1 pixels, and its derivatives.

    `offset` (n,) px is the star's place from the middle pixel's centre, `sigma` (n,) px. The derivatives
    (n, k) are by place and by sigma.
    """
    from scipy.special import ndtr  # noqa: PLC0415 - see `regions.label_pixels`

    edges = (np.arange(-half, half + 2) - 0.5 - offset[:, None]) / sigma[:, None]
    whole = ndtr(edges)
    bell = _BELL * np.exp(-0.5 * edges * edges)
    slope = bell / sigma[:, None]
    spread = edges * slope
    share = whole[:, 1:] - whole[:, :-1]
    return share, slope[:, :-1] - slope[:, 1:], spread[:, :-1] - spread[:, 1:]


def light(offset: FloatArray, sigma: FloatArray, half: int) -> FloatArray:
    """Return the share (n, k, k), rows first, of each star's light; `offset` (n, 2) px, `sigma` (n,) px."""
    across, down = profile(offset[:, 0], sigma, half)[0], profile(offset[:, 1], sigma, half)[0]
    return np.asarray(down[:, :, None] * across[:, None, :])
