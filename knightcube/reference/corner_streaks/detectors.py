"""Corner detectors, which compute the cornerness of each pixel in an image region (Sease, eq. 3.1-3.13).

The Harris response and the structure tensor are computed by `knightcube.vision.objects.streak_ends`.

The detector of Trajkovic and Hedley (Fast corner detection, Image and Vision Computing 16, 1998) uses the
diameters of a small circle around a pixel. At a corner of an image region, the intensity changes along every
diameter of the circle. The cornerness is therefore the minimum, over all directions, of the sum of the
squared intensity changes from the centre to both ends of a diameter. Between the ends of two neighbouring
diameters, the intensity is interpolated linearly with a parameter t from 0 to 1. With the squared changes r
and r' along two neighbouring diameters, the squared change between the diameters is A t^2 + 2 B t + C with C
= r and A = r' - r - 2B. The coefficient B is a sum of two terms. Each term belongs to two neighbouring ends,
one of each diameter. The coefficient B1 printed in Sease, eq. 3.12, is corrected, because it combines the
wrong pairs of ends.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import ndimage

from knightcube.astro.arrays import BoolArray, FloatArray
from knightcube.reference.corner_streaks.settings import StreakSettings
from knightcube.vision.objects.settings import EndpointSettings
from knightcube.vision.objects.streak_ends import StructureTensor, harris_cornerness, smoothed, tensor_of

# For 4 and for 8 neighbour pixels: offset (x, y) from the centre pixel to one end of each diameter. A
# diameter is a line through the centre pixel that ends at two opposite neighbours.
_DIAMETERS = {4: ((1, 0), (0, 1)), 8: ((1, 0), (1, 1), (0, 1), (-1, 1))}


def cornerness(image: FloatArray, settings: EndpointSettings) -> FloatArray:
    """Return the response (rows, columns) of the corner detector selected in a `StreakSettings` object."""
    assert isinstance(settings, StreakSettings)
    if settings.detector == "harris":
        return harris_cornerness(image, settings)
    if settings.detector == "minimum-eigenvalue":
        return minimum_eigenvalue(tensor_of(image, settings))
    neighbours = 4 if settings.detector == "trajkovic-4" else 8
    image = smoothed(image, settings.smoothing_sigma)
    return trajkovic_response(image, neighbours, settings.coarse_relative, settings.fine_relative)


def minimum_eigenvalue(tensor: StructureTensor) -> FloatArray:
    """Return the smaller eigenvalue (rows, columns) of the structure tensor, at least 0 (Sease, eq. 3.6)."""
    half_trace = 0.5 * (tensor.xx + tensor.yy)
    larger = half_trace + np.hypot(0.5 * (tensor.xx - tensor.yy), tensor.xy)
    determinant = tensor.xx * tensor.yy - tensor.xy**2
    # The smaller eigenvalue is the determinant divided by the larger eigenvalue, which avoids cancellation.
    return np.asarray(np.maximum(determinant, 0.0) / np.where(larger > 0.0, larger, 1.0))


class _Changes(NamedTuple):
    """Intensity changes (rows, columns) from the centre pixel to the two ends of a diameter."""

    ahead: FloatArray
    behind: FloatArray

    @property
    def squared(self) -> FloatArray:
        """Sum of the squared intensity changes along the diameter, r_A or r_B in Sease, eq. 3.10."""
        return np.asarray(self.ahead**2 + self.behind**2)


def trajkovic_response(
    image: FloatArray, neighbours: int, coarse_relative: float, fine_relative: float
) -> FloatArray:
    """Return the interpixel cornerness of pixels above the thresholds T1 and T2, and zero for other pixels.

    The thresholds T1 and T2 are relative to the largest simple cornerness in the image (Sease, text at eq.
    3.10).

    Args:
        image: (rows, columns) image intensities.
        neighbours: number of neighbour pixels used, 4 or 8.
        coarse_relative: threshold T1 of the simple cornerness in the image at half scale.
        fine_relative: threshold T2 of the simple cornerness in the image at full scale.
    """
    simple = simple_response(image, neighbours)
    likely = _coarse_corners(image, neighbours, coarse_relative)
    likely &= simple >= fine_relative * simple.max(initial=0.0)
    return np.where(likely, interpixel_response(image, neighbours), 0.0)


def simple_response(image: FloatArray, neighbours: int) -> FloatArray:
    """Return the simple cornerness: the minimum squared intensity change over the diameters.

    A diameter is a line through a pixel that ends at two opposite pixels of its 4 or 8 neighbours (Sease, eq.
    3.9 and 3.10).
    """
    return np.asarray(np.min([changes.squared for changes in _changes(image, neighbours)], axis=0))


def interpixel_response(image: FloatArray, neighbours: int) -> FloatArray:
    """Return the interpixel cornerness: the minimum squared intensity change over all directions.

    The minimum is computed for each pair of neighbouring diameters (Sease, eq. 3.11-3.13, corrected). For
    four neighbours, the minimum equals Sease, eq. 3.11, with the smaller of the coefficients B1 and B2 as B.
    """
    ring = _changes(image, neighbours)
    # The neighbour of the last diameter is the first diameter with swapped ends.
    following = [*ring[1:], _Changes(ring[0].behind, ring[0].ahead)]
    return np.asarray(np.min([_least_between(*pair) for pair in zip(ring, following, strict=True)], axis=0))


def _least_between(first: _Changes, second: _Changes) -> FloatArray:
    """Return the minimum squared change (rows, columns) over the directions between two diameters."""
    r, r_second = first.squared, second.squared
    b = first.ahead * (second.ahead - first.ahead) + first.behind * (second.behind - first.behind)
    a = r_second - r - 2.0 * b
    inside = (b < 0.0) & (a + b > 0.0)
    return np.where(inside, r - b**2 / np.where(inside, a, 1.0), np.minimum(r, r_second))


def _changes(image: FloatArray, neighbours: int) -> list[_Changes]:
    """Return the intensity changes along each diameter. The image is extended by repeating border pixels."""
    rows, columns = image.shape
    padded = np.pad(image, 1, mode="edge")

    def towards(x: int, y: int) -> FloatArray:
        return np.asarray(padded[1 + y : 1 + y + rows, 1 + x : 1 + x + columns] - image)

    return [_Changes(towards(x, y), towards(-x, -y)) for x, y in _DIAMETERS[neighbours]]


def _coarse_corners(image: FloatArray, neighbours: int, relative: float) -> BoolArray:
    """Return a mask (rows, columns) of the pixels close to a likely corner in the image at half scale."""
    rows, columns = image.shape
    even = np.pad(image, ((0, rows % 2), (0, columns % 2)), mode="edge")
    half = even.reshape(even.shape[0] // 2, 2, even.shape[1] // 2, 2).mean(axis=(1, 3))
    simple = simple_response(half, neighbours)
    likely = ndimage.maximum_filter(simple >= relative * simple.max(initial=0.0), 3)
    return np.asarray(np.kron(likely, np.ones((2, 2), dtype=np.bool_))[:rows, :columns])
