"""The corner detectors of the thesis by name: an image of one region to its cornerness (Sease 3.1-3.13).

Harris's response and the structure tensor are those of `knightcube.vision.objects.streak_ends`. Trajkovic and
Hedley: at a corner no line through the pixel keeps its intensity, so that the cornerness is the minimum over
all directions of the squared changes towards both ends of a diameter. The intensity is interpolated linearly
between two neighbouring diameters, for a closed form: with the squared changes r and r' along the two and t
from 0 to 1, the change is A t^2 + 2 B t + C with C = r and A = r' - r - 2B. B pairs the two ends of one
diameter (3.12 corrected: the printed B1 mixes them).

Reference: Trajkovic and Hedley, Fast corner detection, Image and Vision Computing 16 (1998).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import ndimage

from knightcube.astro.arrays import BoolArray, FloatArray
from knightcube.reference.corner_streaks.settings import StreakSettings
from knightcube.vision.objects.settings import EndpointSettings
from knightcube.vision.objects.streak_ends import StructureTensor, harris_cornerness, smoothed, tensor_of

# One end (x, y) of each diameter, in order of direction.
_DIAMETERS = {4: ((1, 0), (0, 1)), 8: ((1, 0), (1, 1), (0, 1), (-1, 1))}


def cornerness(image: FloatArray, settings: EndpointSettings) -> FloatArray:
    """Return the response (rows, columns) of the detector that `settings`, of a `StreakSettings`, name."""
    assert isinstance(settings, StreakSettings)
    if settings.detector == "harris":
        return harris_cornerness(image, settings)
    if settings.detector == "minimum-eigenvalue":
        return minimum_eigenvalue(tensor_of(image, settings))
    neighbours = 4 if settings.detector == "trajkovic-4" else 8
    image = smoothed(image, settings.smoothing_sigma)
    return trajkovic_response(image, neighbours, settings.coarse_relative, settings.fine_relative)


def minimum_eigenvalue(tensor: StructureTensor) -> FloatArray:
    """Return the smaller eigenvalue of the tensor at every pixel (3.6), never negative."""
    half_trace = 0.5 * (tensor.xx + tensor.yy)
    larger = half_trace + np.hypot(0.5 * (tensor.xx - tensor.yy), tensor.xy)
    determinant = tensor.xx * tensor.yy - tensor.xy**2
    # The determinant over the larger eigenvalue does not cancel where the smaller one is near zero.
    return np.asarray(np.maximum(determinant, 0.0) / np.where(larger > 0.0, larger, 1.0))


class _Changes(NamedTuple):
    """Intensities at the two ends of a diameter, minus the intensity of the centre; each (rows, columns)."""

    ahead: FloatArray
    behind: FloatArray

    @property
    def squared(self) -> FloatArray:
        """The squared intensity change along the diameter, r_A or r_B of Sease 3.10."""
        return np.asarray(self.ahead**2 + self.behind**2)


def trajkovic_response(
    image: FloatArray, neighbours: int, coarse_relative: float, fine_relative: float
) -> FloatArray:
    """Return the inter-pixel cornerness where it passes both thresholds, and zero elsewhere.

    T1 applies to the simple cornerness of the image at half scale, T2 to that of the image itself (Sease,
    text at 3.10). Both are relative to the largest value in the image.
    """
    simple = simple_response(image, neighbours)
    likely = _coarse_corners(image, neighbours, coarse_relative)
    likely &= simple >= fine_relative * simple.max(initial=0.0)
    return np.where(likely, interpixel_response(image, neighbours), 0.0)


def simple_response(image: FloatArray, neighbours: int) -> FloatArray:
    """Return the minimum squared intensity change over the diameters (Sease 3.9, 3.10).

    They connect opposite pixels of 4 or 8 `neighbours`.
    """
    return np.asarray(np.min([changes.squared for changes in _changes(image, neighbours)], axis=0))


def interpixel_response(image: FloatArray, neighbours: int) -> FloatArray:
    """Return the minimum squared intensity change over all directions (Sease 3.11-3.13, corrected).

    It is the minimum over all pairs of neighbouring diameters, which for four neighbours equals 3.11 with the
    smaller of B1 and B2 as B.
    """
    ring = _changes(image, neighbours)
    # The last diameter is followed by the first with its ends exchanged.
    following = [*ring[1:], _Changes(ring[0].behind, ring[0].ahead)]
    return np.asarray(np.min([_least_between(*pair) for pair in zip(ring, following, strict=True)], axis=0))


def _least_between(first: _Changes, second: _Changes) -> FloatArray:
    """Return the minimum response (rows, columns) between two neighbouring diameters, both included."""
    r, r_second = first.squared, second.squared
    b = first.ahead * (second.ahead - first.ahead) + first.behind * (second.behind - first.behind)
    a = r_second - r - 2.0 * b
    inside = (b < 0.0) & (a + b > 0.0)
    return np.where(inside, r - b**2 / np.where(inside, a, 1.0), np.minimum(r, r_second))


def _changes(image: FloatArray, neighbours: int) -> list[_Changes]:
    """Return the intensity changes along each diameter; pixels at the border are repeated."""
    rows, columns = image.shape
    padded = np.pad(image, 1, mode="edge")

    def towards(x: int, y: int) -> FloatArray:
        return np.asarray(padded[1 + y : 1 + y + rows, 1 + x : 1 + x + columns] - image)

    return [_Changes(towards(x, y), towards(-x, -y)) for x, y in _DIAMETERS[neighbours]]


def _coarse_corners(image: FloatArray, neighbours: int, relative: float) -> BoolArray:
    """Return which pixels (rows, columns) lie at or beside a likely corner of the image at half scale."""
    rows, columns = image.shape
    even = np.pad(image, ((0, rows % 2), (0, columns % 2)), mode="edge")
    half = even.reshape(even.shape[0] // 2, 2, even.shape[1] // 2, 2).mean(axis=(1, 3))
    simple = simple_response(half, neighbours)
    likely = ndimage.maximum_filter(simple >= relative * simple.max(initial=0.0), 3)
    return np.asarray(np.kron(likely, np.ones((2, 2), dtype=np.bool_))[:rows, :columns])
