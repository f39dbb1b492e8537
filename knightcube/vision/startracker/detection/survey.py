"""The first pass over a frame, of points or of streaks: its sky, and what stands above the noise."""

from __future__ import annotations

from dataclasses import dataclass

from knightcube.astro.arrays import Image
from knightcube.vision.startracker.detection.areas import Areas, find_areas
from knightcube.vision.startracker.detection.detections import FrameShape
from knightcube.vision.startracker.detection.frame_kind import frame_shape
from knightcube.vision.startracker.detection.settings import DetectionSettings
from knightcube.vision.startracker.detection.sky import (
    Sky,
    find_bright,
    in_counts,
    measure_sky,
    without_hot_pixels,
)


@dataclass(frozen=True, slots=True, eq=False)
class Survey:
    """One pass over a frame: its sky, and the areas that stand above the noise.

    Attributes:
        pixels: (rows, columns) in counts, `unit` of the frame's own numbers each; many hot ones are replaced.
        settings: in these counts.
    """

    pixels: Image
    unit: float
    settings: DetectionSettings
    sky: Sky
    areas: Areas

    @property
    def shape(self) -> FrameShape:
        """Whether they are points or streaks."""
        return frame_shape(self.areas)


def survey(pixels: Image, settings: DetectionSettings | None = None) -> Survey:
    """Return what stands above the noise of a frame (rows, columns). Raises ValueError as `detect`."""
    pixels, unit = in_counts(pixels)
    settings = (settings or DetectionSettings()).in_units_of(unit)
    pixels = without_hot_pixels(pixels, settings.most_stars)
    sky = measure_sky(pixels)
    bright = find_bright(pixels, sky, settings.threshold_sigmas)
    return Survey(pixels, unit, settings, sky, find_areas(pixels, sky, bright, settings.saturation))


def kind_of_frame(pixels: Image, settings: DetectionSettings | None = None) -> FrameShape:
    """Return whether a frame (rows, columns) shows points, streaks or neither, and how long they are.

    Raises ValueError as `detect`.
    """
    return survey(pixels, settings).shape
