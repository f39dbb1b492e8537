"""Bright regions too short for corners: points and short streaks in a frame whose stars are streaks."""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.frame.regions import line_of, positions
from knightcube.vision.objects.rso_indicators import star_ends
from knightcube.vision.objects.settings import ObjectSettings
from knightcube.vision.streaks.corners.segmentation import Regions
from knightcube.vision.streaks.corners.settings import StreakSettings
from knightcube.vision.streaks.corners.streaks import Segmented, expected_sigma, near_border

# Bright parts shorter than this are points.
_LEAST_LINE_PX = 4.0


def short_regions(
    segmented: Segmented,
    rotation: FloatArray,
    pinhole: Pinhole,
    settings: StreakSettings,
    objects: ObjectSettings,
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Return ends (n, 2, 2), errors (n,) px and labels (n,) of bright regions too short for corners.

    Only where stars would not be short. The ends are those of the uniform line with the region's moments; a
    point's two ends coincide.
    """
    regions = segmented.regions
    noise = segmented.background.typical_noise
    chosen = (
        ~np.isin(regions.label, segmented.candidates.label)
        & (regions.length < settings.least_length)
        & (regions.flux >= objects.point_significance * noise * np.sqrt(regions.area))
        & ~near_border(regions, segmented.signal.shape, settings.border)
    )
    brightest = np.flatnonzero(chosen)[np.argsort(-regions.flux[chosen], kind="stable")]
    short = regions.select(brightest[: objects.most_points])
    ends = np.array([_line_of(segmented, short, index) for index in range(len(short))]).reshape(-1, 2, 2)
    sigma = np.hypot(1.0, expected_sigma(short, segmented.background, settings))
    expected = pinhole.project(star_ends(pinhole.unit_vectors(ends), rotation))
    # Near the axis stars are points too.
    streaked: BoolArray = np.linalg.norm(expected[:, 1] - expected[:, 0], axis=-1) >= settings.least_length
    return ends[streaked], sigma[streaked], short.label[streaked]


def _line_of(segmented: Segmented, regions: Regions, index: int) -> FloatArray:
    """Return the ends (2, 2) px of the uniform line with the moments of a region's bright part.

    Bright is above half of the brightest pixel, so that a faint star's streak under a point does not lengthen
    it.
    """
    top, bottom, left, right = regions.boxes[index]
    row, column = positions(regions.labels[top:bottom, left:right] == regions.label[index])
    weight = segmented.signal[row + top, column + left].astype(float)
    bright = weight >= 0.5 * weight.max()
    points = np.stack([column + left, row + top], axis=-1)[bright].astype(float)
    weight = weight[bright] / weight[bright].sum()
    centre = weight @ points
    offset = points - centre
    # Shorter than the point spread the moments measure noise, not length.
    return line_of(centre, (offset * weight[:, None]).T @ offset, _LEAST_LINE_PX)
