"""Nadir by the methods of Meller et al., chapter 3, to compare with `knightcube.vision.horizon`.

Edges (3.1): a scan line is divided by the average of its high intensities and rounded to 0 or 1. Fluctuations
shorter than a run are filtered out. The first change from 0 to 1 is the edge.

Circle (3.2.1): centre and radius of the horizon's circle by the pseudo-inverse. It assumes an image without
distortion and a horizon that is a circle on a flat detector, which holds near the optical axis only. The
paper does not state the side from which to scan: here it is the darkest border. Nor does it state how the
circle of one camera gives nadir. Here, as in its successors, the point of the circle closest to the optical
axis is on the limb, and nadir lies the Earth's half-angle beyond that point towards the centre of the circle.
The distortion of the lens is removed first. The method does not distinguish limb and terminator.

Graphic Method (3.2.2, Fig. 10): the limb is a circle in the horizon plane, whose distance below the satellite
follows from the altitude. Each camera's optical axis passes through the body's origin, so that the plane of
its centre column holds the body's z axis and cuts the horizon plane in a line. Two such lines cross at Z, the
point below the satellite on that axis. The vector from Z to the circle's centre gives the angle between axis
and nadir. The paper does not state the ratio of pixels to kilometres. Here it is the ratio of the distance
(px) of the circle's centre below the optical axis to the distance (km) of the horizon plane below the
satellite, which is exact to first order in the tilt for level cameras, and for any tilt about an optical
axis.

Vector Method (3.2.2, equation 6): if a point on the horizon moves from Q to P, the shortest rotation from Q
to P rotates the old nadir to the new nadir. A rotation of the body about P is not observed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, Image, IntArray
from knightcube.errors import FlightError
from knightcube.vision.camera.lens import CameraModel
from knightcube.vision.horizon.edges import RUN, run_filtered
from knightcube.vision.horizon.initial_guess import shortest_turn
from knightcube.vision.horizon.limb import MEAN_RADIUS, UNIT_DEPTH_HEIGHT


def high_average(lines: Image) -> FloatArray:
    """Return the average high intensity (n,) of lines (n, m): the mean of the values above mid-range.

    The paper does not define high; here it is above the mean of the minimum and the maximum of a line.
    """
    values = np.asarray(lines, dtype=float)
    middle = 0.5 * (values.min(axis=1, keepdims=True) + values.max(axis=1, keepdims=True))
    high = values >= middle
    return np.asarray(np.sum(values * high, axis=1) / np.sum(high, axis=1))


def binarised(lines: Image, high: FloatArray) -> BoolArray:
    """Return lines (n, m) divided by their high averages (n,) and rounded to 0 or 1 (step 1 of 3.1)."""
    return np.asarray(lines >= 0.5 * np.asarray(high)[:, None])


def first_edges(binary: BoolArray) -> IntArray:
    """Return the index (n,) of the first 1 after a 0 in each binary line (n, m); -1 if there is none."""
    rises = binary[:, 1:] & ~binary[:, :-1]
    return np.where(np.any(rises, axis=1), np.argmax(rises, axis=1) + 1, -1)


def horizon_points(lines: Image) -> IntArray:
    """Return the edge (n,) of each line (n, m) after normalisation, binarisation and filter; -1 for none."""
    return first_edges(run_filtered(binarised(lines, high_average(lines)), RUN))


class NoCircleError(FlightError):
    """Raised for points that lie on no circle: fewer than three, or points on one line."""


@dataclass(frozen=True, slots=True, eq=False)
class HorizonCircle:
    """A circle: centre (2,) and radius in the unit of its points."""

    centre: FloatArray
    radius: float

    def distances(self, points: FloatArray) -> FloatArray:
        """Return the distances (n,) of points (n, 2) outside the circle; negative inside."""
        return np.asarray(np.linalg.norm(points - self.centre, axis=-1) - self.radius)


def fit_circle(points: FloatArray) -> HorizonCircle:
    """Return the circle through points (n, 2), n >= 3, by equations (3) to (5) and (2).

    Each row pairs a point with the next one, and the last with the first. The circle is exact for three
    points; for more points the radius is the root mean square of (2). Raises NoCircleError.
    """
    points = np.asarray(points, dtype=float)
    if len(points) < 3:
        raise NoCircleError(f"{len(points)} points: a circle needs three")
    following = np.roll(points, -1, axis=0)
    squares = np.sum(points**2, axis=1)
    differences = points - following
    sizes = np.linalg.svd(differences, compute_uv=False)
    if sizes[1] <= 1e-9 * sizes[0]:
        raise NoCircleError("the points lie on one line: no circle passes through them")
    centre = np.linalg.pinv(differences) @ (0.5 * (squares - np.roll(squares, -1)))
    return HorizonCircle(centre, float(np.sqrt(np.mean(np.sum((points - centre) ** 2, axis=1)))))


LINES = 3
"""Default number of scanned lines, as in the example of Meller et al."""
_ON_AXIS = 1e-6
"""Distance (px) between optical axis and centre below which nadir lies on the axis."""


class NoHorizonError(FlightError):
    """Raised if the scanned lines have no edges, or if their edges lie on no circle."""


@dataclass(frozen=True, slots=True, eq=False)
class ScannedHorizon:
    """A circle through the edges in an image.

    Attributes:
        points: (n, 2) px, edges in the image.
        circle: px of the ideal pinhole camera of the same focal length (`CameraModel.ideal`).
        middle: (3,) unit vector, camera axes, to the edge closest to the optical axis.
    """

    points: FloatArray
    circle: HorizonCircle
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


def circle_nadir(circle: HorizonCircle, camera: CameraModel, altitude: float) -> FloatArray:
    """Return nadir (3,), camera axes, from a horizon circle (px of the ideal pinhole); altitude in m."""
    off = circle.centre - np.array(camera.ideal.centre)
    distance = float(np.linalg.norm(off))
    towards = off / distance if distance > _ON_AXIS else np.array([1.0, 0.0])
    limb = math.atan((distance - circle.radius) / camera.focal_length)
    angle = limb + math.asin((MEAN_RADIUS + UNIT_DEPTH_HEIGHT) / (MEAN_RADIUS + altitude))
    return np.array([*(math.sin(angle) * towards), math.cos(angle)])


def _first_edges(frame: Image, lines: int) -> FloatArray:
    """Return the first edges (n, 2) px of evenly spaced lines, scanned from the darkest border."""
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
"""Smallest sine of the angle between the centre planes of the cameras."""


class GraphicMethodError(FlightError):
    """Raised if the centre columns do not cross: the cameras point in the same or in opposite directions."""


@dataclass(frozen=True, slots=True, eq=False)
class LevelCamera:
    """A camera with its boresight normal to the body's z axis and its rows down along that axis.

    Attributes:
        right: (2,) body x and y components of the camera's x axis, a unit vector.
        axis: pixel (x, y) of the optical axis.
    """

    right: FloatArray
    axis: tuple[float, float]


def horizon_plane_depth(altitude: float) -> float:
    """Return the distance (m) of the limb's plane below the satellite: d - R^2/d with d = R + altitude."""
    distance = MEAN_RADIUS + altitude
    return distance - MEAN_RADIUS**2 / distance


def graphic_nadir(
    cameras: tuple[LevelCamera, LevelCamera], horizons: tuple[HorizonCircle, HorizonCircle], altitude: float
) -> FloatArray:
    """Return nadir (3,), body axes, from the horizon circles (px) of two cameras; altitude in m.

    Raises GraphicMethodError if the centre columns of the cameras are nearly parallel.
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
    """Return N = [R] N_o (3,); R is the shortest rotation from the unit vector `before` to `after`, (3,)."""
    return np.asarray(shortest_turn(before, after) @ previous)
