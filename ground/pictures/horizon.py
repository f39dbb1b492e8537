"""A picture of the horizon that was found: the fitted limb, the edges on it, and those that are not."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ground.pictures.overlay import STREAK, UNUSED, draw_ring, outlined
from knightcube.astro.arrays import FloatArray
from knightcube.reference.horizon import ScannedHorizon
from knightcube.vision.camera.lens import CameraModel
from knightcube.vision.horizon.illumination import limb_rays
from knightcube.vision.horizon.limb import LimbView
from knightcube.vision.horizon.nadir import HorizonSolution

_RADIUS = 5.0
_DOT = 0.0


def limb_in_picture(view: LimbView, camera: CameraModel) -> FloatArray:
    """Return pixels (m, 2) along the limb of a view, at most a pixel apart, where the camera sees it."""
    # The limb is seldom longer than the way round the picture.
    count = 8 * (camera.columns + camera.rows)
    points = camera.project(limb_rays(view, count))
    return np.asarray(points[camera.contains(points)])


def draw_horizon(
    picture: npt.NDArray[np.uint8], solution: HorizonSolution, camera: CameraModel
) -> npt.NDArray[np.uint8]:
    """Return `picture` (rows, columns, 3) with the horizon drawn on it.

    The fitted limb as a line, orange rings for the edges on it, blue ones for the others.
    """
    drawn = picture.copy()
    for point in limb_in_picture(solution.view, camera) if solution.view is not None else ():
        draw_ring(drawn, point, _DOT, STREAK)
    for point, used in zip(solution.points, solution.on_horizon, strict=True):
        draw_ring(drawn, point, _RADIUS, STREAK if used else UNUSED)
    return outlined(picture, drawn)


def draw_circle(
    picture: npt.NDArray[np.uint8], seen: ScannedHorizon, camera: CameraModel
) -> npt.NDArray[np.uint8]:
    """Return `picture` (rows, columns, 3) with the paper's circle and its edges, in orange."""
    drawn = picture.copy()
    angle = np.arange(8 * (camera.columns + camera.rows)) * (0.25 * np.pi / (camera.columns + camera.rows))
    ring = seen.circle.centre + seen.circle.radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points = camera.project(camera.ideal.unit_vectors(ring))
    for point in points[camera.contains(points)]:
        draw_ring(drawn, point, _DOT, STREAK)
    for point in seen.points:
        draw_ring(drawn, point, _RADIUS, STREAK)
    return outlined(picture, drawn)
