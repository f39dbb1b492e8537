"""Nadir determination as in Meller et al., chapter 3, for comparison with `knightcube.vision.horizon`.

Edge detection (Meller et al., section 3.1): The intensities of a scan line are divided by the average of its
high intensities and rounded to 0 or 1. Short fluctuations along the scan line are filtered out. The first
change from 0 to 1 is the edge of the horizon.

Circle fit (Meller et al., section 3.2.1): The centre and radius of the horizon circle are computed by a
pseudo-inverse. The method assumes that the image has no distortion and that the horizon is a circle on the
flat detector, which is valid near the optical axis only. Meller et al. do not state from which side the image
is scanned (here from the darkest border), nor how to compute nadir from the circle in the image of one
camera. This implementation removes the lens distortion before the fit, and assumes that the point of the
circle closest to the optical axis lies on the limb. Nadir lies on the line from the assumed limb point to the
circle's centre, at the Earth's angular radius from the limb point. The circle fit does not distinguish
between limb and terminator.

Graphic Method (Meller et al., section 3.2.2 and Fig. 10): The limb is a circle in the horizon plane, whose
distance below the satellite follows from the altitude. The plane through the centre column of a camera image
contains the body's z axis and intersects the horizon plane in a line. The lines of two cameras intersect in a
point Z on the z axis. The vector from Z to the centre of the horizon circle gives the angle between the z
axis and nadir. Meller et al. do not state the image scale (px/km). In this implementation, the image scale is
the distance of the circle's centre below the optical axis (px), divided by the distance of the horizon plane
below the satellite (km). This scale is exact if the optical axis is horizontal, even if the camera is rolled
about this axis, and correct to first order for other tilts.

Vector Method (Meller et al., section 3.2.2, equation 6): If a point on the horizon moves from direction Q to
direction P, the shortest rotation from Q to P rotates the old nadir direction to the new nadir direction. A
rotation of the body about the direction P of the horizon point is not observable.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, Image, IntArray
from knightcube.errors import KnightCubeError
from knightcube.vision.camera.lens import CameraModel
from knightcube.vision.horizon.edges import RUN, run_filtered
from knightcube.vision.horizon.initial_guess import shortest_turn
from knightcube.vision.horizon.limb import MEAN_RADIUS, UNIT_DEPTH_HEIGHT


def high_average(lines: Image) -> FloatArray:
    """Return the mean (n,) of the high intensities of each scan line (n, m).

    Meller et al. do not define a high intensity. In this implementation, an intensity is high if it is at
    least the mean of the line's minimum and maximum.
    """
    values = np.asarray(lines, dtype=float)
    middle = 0.5 * (values.min(axis=1, keepdims=True) + values.max(axis=1, keepdims=True))
    high = values >= middle
    return np.asarray(np.sum(values * high, axis=1) / np.sum(high, axis=1))


def first_edges(binary: BoolArray) -> IntArray:
    """Return the index (n,) of the first 0-to-1 change in each binary line (n, m), or -1 if there is none."""
    rises = binary[:, 1:] & ~binary[:, :-1]
    return np.where(np.any(rises, axis=1), np.argmax(rises, axis=1) + 1, -1)


def horizon_points(lines: Image) -> IntArray:
    """Return the edge positions (n,) in scan lines (n, m), or -1 for a line without an edge."""
    # Each line is divided by its average high intensity and rounded (Meller et al., section 3.1, step 1).
    return first_edges(run_filtered(lines >= 0.5 * high_average(lines)[:, None], RUN))


class NoCircleError(KnightCubeError):
    """Raised if the points do not define a circle: fewer than three points, or collinear points."""


@dataclass(frozen=True, slots=True, eq=False)
class HorizonCircle:
    """Circle fitted to horizon points: centre (2,) and radius, in the unit of the points."""

    centre: FloatArray
    radius: float

    def distances(self, points: FloatArray) -> FloatArray:
        """Return the distances (n,) of points (n, 2) from the circle, negative for points inside."""
        return np.asarray(np.linalg.norm(points - self.centre, axis=-1) - self.radius)


def fit_circle(points: FloatArray) -> HorizonCircle:
    """Return the least-squares circle through points (n, 2), by equations (2) to (5) of Meller et al.

    Each row of the linear system combines a point and the next point; the last row combines the last and the
    first point. A circle through three points fits exactly. For more points the radius of the circle is the
    RMS distance of the points from the centre. Raises NoCircleError for fewer than three points or collinear
    points.
    """
    points = np.asarray(points, dtype=float)
    if len(points) < 3:
        raise NoCircleError(f"{len(points)} points: a circle needs at least three")
    following = np.roll(points, -1, axis=0)
    squares = np.sum(points**2, axis=1)
    differences = points - following
    sizes = np.linalg.svd(differences, compute_uv=False)
    if sizes[1] <= 1e-9 * sizes[0]:
        raise NoCircleError("the points lie on one line: no circle passes through them")
    centre = np.linalg.pinv(differences) @ (0.5 * (squares - np.roll(squares, -1)))
    return HorizonCircle(centre, float(np.sqrt(np.mean(np.sum((points - centre) ** 2, axis=1)))))


LINES = 3
"""Default number of scan lines, as in the example of Meller et al."""
_ON_AXIS = 1e-6
"""Distance (px) between optical axis and circle centre below which the direction to the centre is unknown and
is assumed to be the x axis."""


class NoHorizonError(KnightCubeError):
    """Raised if the scan lines contain too few edges, or if the edges define no circle."""


@dataclass(frozen=True, slots=True, eq=False)
class ScannedHorizon:
    """Horizon edges in an image and the circle through these edges.

    Attributes:
        points: (n, 2) edge positions in the image, px.
        circle: circle in the image of an ideal pinhole camera with the same focal length
            (`CameraModel.ideal`), px.
        middle: (3,) unit vector, in camera axes, to the horizon edge closest to the optical axis.
    """

    points: FloatArray
    circle: HorizonCircle
    middle: FloatArray


def scan_horizon(frame: Image, camera: CameraModel, lines: int = LINES) -> ScannedHorizon:
    """Return the circle through the first edges in scan lines.

    Raises NoHorizonError if the edges define no circle.
    """
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


def circle_nadir(circle: HorizonCircle, camera: CameraModel, altitude: float) -> FloatArray:
    """Return the nadir (3,) in camera axes for a circle in the ideal pinhole's image and an altitude, m."""
    off = circle.centre - np.array(camera.ideal.centre)
    distance = float(np.linalg.norm(off))
    towards = off / distance if distance > _ON_AXIS else np.array([1.0, 0.0])
    limb = math.atan((distance - circle.radius) / camera.focal_length)
    angle = limb + math.asin((MEAN_RADIUS + UNIT_DEPTH_HEIGHT) / (MEAN_RADIUS + altitude))
    return np.array([*(math.sin(angle) * towards), math.cos(angle)])


def _first_edges(frame: Image, lines: int) -> FloatArray:
    """Return the first edges (n, 2), px, in evenly spaced lines that are scanned from the darkest border."""
    rows, columns = frame.shape
    depth = max(1, min(rows, columns) // 8)
    borders = (frame[:depth], frame[-depth:], frame[:, :depth], frame[:, -depth:])
    side = int(np.argmin([float(np.mean(border)) for border in borders]))
    upright = frame if side < 2 else frame.T
    scanned = upright if side % 2 == 0 else upright[::-1]
    positions = ((np.arange(1, lines + 1)) * upright.shape[1]) // (lines + 1)
    found = horizon_points(scanned[:, positions].T)
    along = found if side % 2 == 0 else upright.shape[0] - 1 - found
    points = np.stack([positions, along] if side < 2 else [along, positions], axis=1)
    return np.asarray(points[found >= 0], dtype=float)


_MINIMUM_SINE = 0.1
"""Minimum sine of the angle between the planes through the centre columns of the two cameras."""


class GraphicMethodError(KnightCubeError):
    """Raised if the cameras point in nearly the same or opposite directions."""


@dataclass(frozen=True, slots=True, eq=False)
class LevelCamera:
    """Camera whose boresight is perpendicular and whose y axis is parallel to the body z axis.

    The unit vector `right` (2,) contains the components of the camera's x axis along body x and y. The
    optical axis is at the pixel `axis` (x, y).
    """

    right: FloatArray
    axis: tuple[float, float]


def horizon_plane_depth(altitude: float) -> float:
    """Return the distance (m) of the horizon plane below the satellite: d - R^2/d with d = R + altitude."""
    distance = MEAN_RADIUS + altitude
    return distance - MEAN_RADIUS**2 / distance


def graphic_nadir(
    cameras: tuple[LevelCamera, LevelCamera], horizons: tuple[HorizonCircle, HorizonCircle], altitude: float
) -> FloatArray:
    """Return the nadir direction (3,) in body axes by the Graphic Method, for an altitude in m.

    Raises GraphicMethodError if the boresights of the cameras are nearly parallel.
    """
    depth = horizon_plane_depth(altitude)
    across = np.stack([camera.right for camera in cameras])
    if abs(float(np.linalg.det(across))) < _MINIMUM_SINE:
        raise GraphicMethodError("the centre columns of the two cameras are nearly parallel and do not cross")
    offsets = []
    for camera, horizon in zip(cameras, horizons, strict=True):
        right, below = horizon.centre - np.array(camera.axis)
        offsets.append(right * depth / below)
    centre_from_z = np.linalg.solve(across, np.array(offsets))
    nadir = np.array([centre_from_z[0], centre_from_z[1], depth])
    return np.asarray(nadir / np.linalg.norm(nadir))


def propagated_nadir(previous: FloatArray, before: FloatArray, after: FloatArray) -> FloatArray:
    """Return the nadir direction (3,) by the Vector Method.

    The previous nadir is rotated by the shortest rotation from `before` to `after`, the directions (3,) of a
    horizon point at the previous and at the current time.
    """
    return np.asarray(shortest_turn(before, after) @ previous)
