"""The light of stars on the pixels about them: a Gaussian integrated over each pixel, and its derivatives.

A star that moves over the exposure is the mean of such Gaussians along its path (Gauss-Legendre quadrature).
"""

from __future__ import annotations

import math

import numpy as np

from knightcube.astro.arrays import FloatArray

# A path shorter than this, px, is a point: it widens one of 1 px by 0.2 %.
_SHORTEST = 0.2
# Enough for paths of four sigmas, to 1e-3 of the light.
_NODES = 4
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


def path(trail: FloatArray) -> list[tuple[FloatArray, float]]:
    """Return places (n, 2) px along paths of `trail` (n, 2) px, from the middle, and each place's share."""
    if not len(trail) or float(np.abs(trail).max()) < _SHORTEST:
        return [(np.zeros_like(trail), 1.0)]
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    return [(0.5 * node * trail, 0.5 * weight) for node, weight in zip(nodes, weights, strict=True)]


def light(offset: FloatArray, sigma: FloatArray, half: int, trail: FloatArray | None = None) -> FloatArray:
    """Return the share (n, k, k), rows first, of each star's light.

    `offset` (n, 2) px, `sigma` (n,) px; `trail` (n, 2) px by which it moves over the exposure, None: none.
    """
    out = np.zeros((len(offset), 2 * half + 1, 2 * half + 1))
    for shift, share in path(np.zeros_like(offset) if trail is None else trail):
        x, y = (offset + shift).T
        across, down = profile(x, sigma, half)[0], profile(y, sigma, half)[0]
        out += share * (down[:, :, None] * across[:, None, :])
    return out
