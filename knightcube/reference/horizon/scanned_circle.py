"""The paper's way from a picture to a circle, and from the circle to nadir (Meller et al. 3.1, 3.2).

Lines from the sky to the ground are scanned for the paper's edges, a circle is fitted to them; `--method` of
`flight horizon` and the campaign `horizon-methods` compare it with `nadir`. The paper leaves open from which
side to scan, here the darkest border; and how one camera's circle gives nadir, here as its successors do: the
circle's point nearest to the optical axis is on the limb, nadir lies the Earth's half-angle beyond it towards
the circle's centre. Places are freed of the lens's distortion first. Nothing tells limb from terminator.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray, Image
from knightcube.errors import FlightError
from knightcube.reference.horizon.circle import Circle, NoCircleError, fit_circle
from knightcube.vision.camera.lens import CameraModel
from knightcube.vision.horizon.binary_edges import horizon_points
from knightcube.vision.horizon.ellipsoid import MEAN_RADIUS
from knightcube.vision.horizon.limb_profile import UNIT_DEPTH_HEIGHT

LINES = 3
"""As many as the paper's example has."""
_TO_MIDDLE = 1e-6
"""px between axis and centre: nearer, nadir is on the axis."""


class NoHorizonError(FlightError):
    """The scanned lines have no edges, or their edges lie on no circle."""


@dataclass(frozen=True, slots=True, eq=False)
class ScannedHorizon:
    """A circle through a picture's edges.

    Attributes:
        points: (n, 2) px of the picture.
        circle: px of the pinhole of the same focal length, its axis in the middle (`CameraModel.ideal`).
        middle: (3,) unit vector in camera axes to the edge on the scanned line next to the optical axis.
    """

    points: FloatArray
    circle: Circle
    middle: FloatArray


def scan_horizon(frame: Image, camera: CameraModel, lines: int = LINES) -> ScannedHorizon:
    """Return the circle through the first edges of `lines` lines of a frame. Raises NoHorizonError."""
    points = _first_edges(frame, lines)
    rays = camera.unit_vectors(points) if len(points) else np.zeros((0, 3))
    seen = np.isfinite(rays[:, 0])
    points, rays = points[seen], rays[seen]
    try:
        circle = fit_circle(camera.ideal.project(rays))
    except NoCircleError as error:
        raise NoHorizonError(f"of {lines} lines: {error}") from error
    axis = np.array(camera.ideal.centre)
    across = np.abs(camera.ideal.project(rays) - axis).min(axis=1)
    return ScannedHorizon(points, circle, rays[int(np.argmin(across))])


def circle_nadir(circle: Circle, camera: CameraModel, altitude: float) -> FloatArray:
    """Return nadir (3,), camera axes, from a horizon's circle (px of the ideal pinhole); altitude in m."""
    off = circle.centre - np.array(camera.ideal.centre)
    distance = float(np.linalg.norm(off))
    towards = off / distance if distance > _TO_MIDDLE else np.array([1.0, 0.0])
    limb = math.atan((distance - circle.radius) / camera.focal_length)
    angle = limb + math.asin((MEAN_RADIUS + UNIT_DEPTH_HEIGHT) / (MEAN_RADIUS + altitude))
    return np.array([*(math.sin(angle) * towards), math.cos(angle)])


def _first_edges(frame: Image, lines: int) -> FloatArray:
    """Return the first edges (n, 2) px of evenly spaced lines from the darkest border on."""
    rows, columns = frame.shape
    depth = max(1, min(rows, columns) // 8)
    borders = (frame[:depth], frame[-depth:], frame[:, :depth], frame[:, -depth:])
    side = int(np.argmin([float(np.mean(border)) for border in borders]))
    upright = frame if side < 2 else frame.T
    scanned = upright if side % 2 == 0 else upright[::-1]
    places = ((np.arange(1, lines + 1)) * upright.shape[1]) // (lines + 1)
    found = horizon_points(scanned[:, places].T)
    along = found if side % 2 == 0 else upright.shape[0] - 1 - found
    points = np.stack([places, along] if side < 2 else [along, places], axis=1)
    return np.asarray(points[found >= 0], dtype=float)
