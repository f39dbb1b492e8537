"""Whether a frame shows points or streaks: from the shapes of its brightest areas."""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray
from knightcube.vision.startracker.detection.areas import Areas
from knightcube.vision.startracker.detection.detections import FrameKind, FrameShape

# The brightest areas decide; a rate shows in all of them, or in all but those on its axis.
_LOOKED_AT = 20
_LEAST_PIXELS = 4
_SHORTEST_STREAK = 5.0
_SLENDER = 3.5
_LEAST_STREAKS = 4
_STREAKED_PART = 0.4
_ROUND = 3.0
_THICKEST = 6.0
# Sine of the angle by which a tree's twigs miss one rotation's flow, and streaks do not.
_CROOKED = 0.12


def is_streak(areas: Areas) -> BoolArray:
    """Return which areas (n,) are thin and long."""
    return np.asarray((areas.length > _SHORTEST_STREAK) & (areas.length > _SLENDER * areas.thickness))


def frame_shape(areas: Areas) -> FrameShape:
    """Return the kind of the frame; four streaks are needed, at least four in ten of its areas."""
    chosen = np.argsort(-areas.flux, kind="stable")[: 3 * _LOOKED_AT]
    usable = (areas.pixels[chosen] >= _LEAST_PIXELS) & (areas.thickness[chosen] < _THICKEST)
    chosen = chosen[usable][:_LOOKED_AT]
    streaks = is_streak(areas)[chosen]
    points = areas.length[chosen] < _ROUND * np.maximum(areas.thickness[chosen], 1.0)
    long, short = int(np.count_nonzero(streaks)), int(np.count_nonzero(points & ~streaks))
    if (
        long >= _LEAST_STREAKS
        and long >= _STREAKED_PART * (long + short)
        and share_one_rotation(areas.centre[chosen][streaks], areas.direction[chosen][streaks])
    ):
        return FrameShape(FrameKind.STREAKS, float(np.median(areas.length[chosen][streaks])))
    if short:
        return FrameShape(FrameKind.POINTS, float(np.median(areas.length[chosen][points & ~streaks])))
    return FrameShape(FrameKind.NEITHER, 0.0)


def share_one_rotation(centre: FloatArray, direction: FloatArray) -> bool:
    """Return whether lines at `centre` (n, 2) px, `direction` (n,) rad, follow one rotation of the camera.

    Near the boresight its flow is t + w (-y, x): normal to no line that follows it. The t and w that are
    the least so are the smallest singular vector of the normals' products with the flow.
    """
    middle = centre.mean(axis=0)
    scale = float(np.abs(centre - middle).max()) or 1.0
    x, y = ((centre - middle) / scale).T
    normal = np.stack([-np.sin(direction), np.cos(direction)], axis=-1)
    products = np.column_stack([normal, normal[:, 1] * x - normal[:, 0] * y])
    tx, ty, turn = np.linalg.svd(products)[2][-1]
    flow = np.stack([tx - turn * y, ty + turn * x], axis=-1)
    speed = np.maximum(np.linalg.norm(flow, axis=1), 1e-12)
    return bool(np.median(np.abs(np.sum(flow * normal, axis=1)) / speed) < _CROOKED)
