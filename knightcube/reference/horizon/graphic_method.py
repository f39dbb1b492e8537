"""Nadir by the Graphic Method: two centre columns cross on the horizon plane (Meller 3.2.2, Fig. 10).

The limb is a circle in the horizon plane, whose distance below the satellite the altitude gives. Each
camera's optical axis passes through the body's origin, so that the plane of its centre column holds the
body's z axis and cuts the horizon plane in a line; where two such lines cross is Z, the point below on that
axis. The way from Z to the circle's centre is the axis's distance from nadir.

The paper leaves the ratio of pixels to kilometres open. Taken here: the circle's centre is as many pixels
below the optical axis as the horizon plane is kilometres below the satellite, which for level cameras is
exact to first order in the tilt, and for any tilt about an optical axis. Pictures are assumed homogeneous.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.errors import FlightError
from knightcube.reference.horizon.circle import Circle
from knightcube.vision.horizon.ellipsoid import MEAN_RADIUS

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
    cameras: tuple[LevelCamera, LevelCamera], horizons: tuple[Circle, Circle], altitude: float
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
