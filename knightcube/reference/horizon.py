"""Nadir by the methods of Meller et al., chapter 3, to compare with `knightcube.vision.horizon`.

Edges (3.1): a scan line is divided by the average of its high intensities and rounded to 0 or 1; fluctuations
shorter than a run are filtered out; the first change from 0 to 1 is the edge.

Circle (3.2.1): centre and radius of the horizon's circle by the pseudo-inverse. It assumes an image without
distortion and a horizon that is a circle on a flat detector, which holds near the optical axis only. The
paper leaves open from which side to scan: here from the darkest border. It also leaves open how one camera's
circle gives nadir: here, as in its successors, the circle's point nearest to the optical axis is on the limb,
and nadir lies the Earth's half-angle beyond it towards the circle's centre. The lens's distortion is removed
first. Nothing distinguishes limb from terminator.

Graphic Method (3.2.2, Fig. 10): the limb is a circle in the horizon plane, whose distance below the satellite
follows from the altitude. Each camera's optical axis passes through the body's origin, so that the plane of
its centre column holds the body's z axis and cuts the horizon plane in a line. Two such lines cross at Z, the
point below the satellite on that axis. The vector from Z to the circle's centre gives the angle between axis
and nadir. The paper leaves the ratio of pixels to kilometres open. Here the circle's centre is as many pixels
below the optical axis as the horizon plane is kilometres below the satellite, which is exact to first order
in the tilt for level cameras, and for any tilt about an optical axis.

Vector Method (3.2.2, equation 6): a place on the horizon that was at Q moves to P; the rotation from Q to P
takes the old nadir to the new one. Two vectors leave the rotation about themselves open; the shortest
rotation is used, and a rotation of the body about P is not observed.
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
    """Return the average high intensity (n,) of lines (n, m): the mean of what lies above mid-range.

    The paper does not define high; here it is above the middle between a line's least and most.
    """
    values = np.asarray(lines, dtype=float)
    middle = 0.5 * (values.min(axis=1, keepdims=True) + values.max(axis=1, keepdims=True))
    high = values >= middle
    return np.asarray(np.sum(values * high, axis=1) / np.sum(high, axis=1))


def binarised(lines: Image, high: FloatArray) -> BoolArray:
    """Return lines (n, m) divided by their high averages (n,) and rounded to 0 or 1 (step 1 of 3.1)."""
    return np.asarray(lines >= 0.5 * np.asarray(high)[:, None])


def first_edges(binary: BoolArray) -> IntArray:
    """Return for each binary line (n, m) the first 1 that follows a 0, (n,); -1 where there is none."""
    rises = binary[:, 1:] & ~binary[:, :-1]
    return np.where(np.any(rises, axis=1), np.argmax(rises, axis=1) + 1, -1)


def horizon_points(lines: Image, run: int = RUN) -> IntArray:
    """Return the paper's edge (n,) of each line (n, m): normalised, binarised, filtered; -1 for none."""
    return first_edges(run_filtered(binarised(lines, high_average(lines)), run))


class NoCircleError(FlightError):
    """The points lie on no circle: fewer than three, or in one line."""


@dataclass(frozen=True, slots=True, eq=False)
class HorizonCircle:
    """A circle: centre (2,) and radius, in the points' unit."""

    centre: FloatArray
    radius: float

    def distances(self, points: FloatArray) -> FloatArray:
        """Return how far points (n, 2) lie outside the circle, (n,); negative within."""
        return np.asarray(np.linalg.norm(points - self.centre, axis=-1) - self.radius)


def fit_circle(points: FloatArray) -> HorizonCircle:
    """Return the circle through points (n, 2), n >= 3, by equations (3) to (5) and (2).

    Each row pairs a point with the next, the last with the first. For three points it is exact; for more the
    radius is the root mean square of (2). Raises NoCircleError.
    """
    points = np.asarray(points, dtype=float)
    if len(points) < 3:
        raise NoCircleError(f"{len(points)} points: a circle needs three")
    following = np.roll(points, -1, axis=0)
    squares = np.sum(points**2, axis=1)
    differences = points - following
    sizes = np.linalg.svd(differences, compute_uv=False)
    if sizes[1] <= 1e-9 * sizes[0]:
        raise NoCircleError("the points lie in one line: no circle passes through them")
    centre = np.linalg.pinv(differences) @ (0.5 * (squares - np.roll(squares, -1)))
    return HorizonCircle(centre, float(np.sqrt(np.mean(np.sum((points - centre) ** 2, axis=1)))))


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


_LEAST_ANGLE = 0.1
"""Sine between the cameras' centre planes."""


class GraphicMethodError(FlightError):
    """The centre columns do not cross: cameras that look the same or the opposite way."""


@dataclass(frozen=True, slots=True, eq=False)
class LevelCamera:
    """A camera whose boresight is normal to the body's z axis, its rows down along it.

    Attributes:
        right: (2,) body x and y of the camera's x axis, unit.
        axis: the pixel (x, y) on the optical axis.
    """

    right: FloatArray
    axis: tuple[float, float]


def horizon_plane_depth(altitude: float, radius: float = MEAN_RADIUS) -> float:
    """Return how far below the satellite the limb's plane lies, m: d - R^2/d with d = R + altitude."""
    distance = radius + altitude
    return distance - radius**2 / distance


def graphic_nadir(
    cameras: tuple[LevelCamera, LevelCamera], horizons: tuple[HorizonCircle, HorizonCircle], altitude: float
) -> FloatArray:
    """Return nadir (3,), body axes, from the horizon circles (px) in two cameras' pictures; altitude in m.

    Raises GraphicMethodError.
    """
    depth = horizon_plane_depth(altitude)
    across = np.stack([camera.right for camera in cameras])
    if abs(float(np.linalg.det(across))) < _LEAST_ANGLE:
        raise GraphicMethodError("the two cameras' centre columns are nearly parallel: they cross nowhere")
    offsets = []
    for camera, horizon in zip(cameras, horizons, strict=True):
        right, below = horizon.centre - np.array(camera.axis)
        offsets.append(right * depth / below)
    centre_from_z = np.linalg.solve(across, np.array(offsets))
    nadir = np.array([centre_from_z[0], centre_from_z[1], depth])
    return np.asarray(nadir / np.linalg.norm(nadir))


def propagated_nadir(previous: FloatArray, before: FloatArray, after: FloatArray) -> FloatArray:
    """Return N = [R] N_o (3,), R the shortest rotation of the sight `before` (3,) to `after` (3,), unit."""
    return np.asarray(shortest_turn(before, after) @ previous)
