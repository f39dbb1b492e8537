"""The four corner detectors by name: the image of one region to its cornerness (Sease 3.1-3.13).

Each is tuned and calibrated by itself: take its settings from `StreakSettings.of(name)`.
"""

from __future__ import annotations

from collections.abc import Callable

from knightcube.astro.arrays import FloatArray
from knightcube.vision.streaks.corners.corners import (
    StructureTensor,
    harris_response,
    minimum_eigenvalue,
    smoothed,
    structure_tensor,
)
from knightcube.vision.streaks.corners.settings import DetectorName, StreakSettings
from knightcube.vision.streaks.corners.trajkovic import trajkovic_response


def cornerness(image: FloatArray, settings: StreakSettings) -> FloatArray:
    """Return the response (rows, columns) of the detector that `settings` name."""
    return _DETECTORS[settings.detector](smoothed(image, settings.smoothing_sigma), settings)


def _harris(image: FloatArray, settings: StreakSettings) -> FloatArray:
    return harris_response(_tensor(image, settings), settings.harris_k)


def _minimum_eigenvalue(image: FloatArray, settings: StreakSettings) -> FloatArray:
    return minimum_eigenvalue(_tensor(image, settings))


def _trajkovic_4(image: FloatArray, settings: StreakSettings) -> FloatArray:
    return trajkovic_response(image, 4, settings.coarse_relative, settings.fine_relative)


def _trajkovic_8(image: FloatArray, settings: StreakSettings) -> FloatArray:
    return trajkovic_response(image, 8, settings.coarse_relative, settings.fine_relative)


def _tensor(image: FloatArray, settings: StreakSettings) -> StructureTensor:
    return structure_tensor(image, settings.derivative_sigma, settings.window_sigma)


_DETECTORS: dict[DetectorName, Callable[[FloatArray, StreakSettings], FloatArray]] = {
    "harris": _harris,
    "minimum-eigenvalue": _minimum_eigenvalue,
    "trajkovic-4": _trajkovic_4,
    "trajkovic-8": _trajkovic_8,
}
