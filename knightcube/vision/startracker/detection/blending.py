"""Stars so close that each lies in the other's window: whose light is where, and the precision lost."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray, IntArray
from knightcube.vision.startracker.detection.point_spread import light
from knightcube.vision.startracker.detection.windows import Windows

# A neighbour farther than this many sigmas of the point spread beyond the window gives it nothing.
_BEYOND = 3.0
_MOST_OVERLAP = 0.8
_LEAST_OVERLAP = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """Ordered pairs: `first` (p,) has `second` (p,) in its window; `overlap` (n,) of each star's image."""

    first: IntArray
    second: IntArray
    overlap: FloatArray


def neighbours(points: FloatArray, flux: FloatArray, psf_sigma: float, half: int) -> Pairs:
    """Return which of the stars at `points` (n, 2) px send light into another's window.

    The overlap is that of the two images, exp(-d^2 / 4 sigma^2): 0 for a lone star and where the neighbour
    is too faint to matter.
    """
    apart = points[:, None] - points
    reach = half + _BEYOND * psf_sigma
    near = (np.abs(apart) < reach).all(axis=-1) & (flux > 0.0)
    np.fill_diagonal(near, val=False)
    first, second = np.nonzero(near)
    square = np.sum(apart[first, second] ** 2, axis=-1)
    each = np.minimum(np.exp(-square / (4.0 * psf_sigma**2)), _MOST_OVERLAP)
    overlap = np.zeros(len(points))
    np.maximum.at(overlap, first, np.where(each > _LEAST_OVERLAP, each, 0.0))
    return Pairs(first, second, overlap)


def neighbour_light(
    pairs: Pairs, windows: Windows, middle: IntArray, offset: FloatArray, flux: FloatArray, width: FloatArray
) -> FloatArray:
    """Return the light (n, k, k) of all neighbours in each star's window about `middle` (n, 2).

    The stars are at `offset` (n, 2) px from there, of `flux` (n,) and `width` (n,) px.
    """
    size = 2 * windows.half + 1
    out = np.zeros((len(middle), size, size))
    place = (middle + offset)[pairs.second] - middle[pairs.first]
    share = light(place, width[pairs.second], windows.half, windows.trail[pairs.second])
    np.add.at(out, pairs.first, share * np.maximum(flux, 0.0)[pairs.second, None, None])
    return out
