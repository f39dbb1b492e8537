"""The rim of a bright disc: where the light along spokes from inside falls through a level.

Spokes run along great circles, so that lens and perspective do not deform the rim: the Sun's is a circle on
the sphere anywhere in the frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray, Image
from knightcube.astro.directions import tangent_basis
from knightcube.vision.camera.lens import CameraModel

SPOKES = 48
_STEP = 0.5
"""px along a spoke between samples."""


@dataclass(frozen=True, slots=True, eq=False)
class Rim:
    """Rim points about a direction, in its tangent plane.

    Attributes:
        axis: (3,) unit vector in camera axes, where the spokes start.
        basis: (2, 3) axes of the plane.
        points: (n, 2) rad, of arc length from the axis: azimuthal equidistant.
        cut: number of `SPOKES` that left the frame before the rim.
        endless: number that met no rim within reach.
    """

    axis: FloatArray
    basis: FloatArray
    points: FloatArray
    cut: int
    endless: int

    def direction(self, point: FloatArray) -> FloatArray:
        """Return the unit vector (3,) in camera axes of a `point` (2,) rad in the tangent plane."""
        arc = float(np.hypot(*point))
        return np.asarray(np.cos(arc) * self.axis + np.sinc(arc / np.pi) * (point @ self.basis))


def trace(
    strip: Image, first_row: int, camera: CameraModel, axis: FloatArray, level: float, reach: float
) -> Rim:
    """Return the rim about `axis` (3,) within `reach` rad, in `strip`, rows from `first_row` on."""
    basis = tangent_basis(axis)
    angle = np.arange(SPOKES) * (2.0 * np.pi / SPOKES)
    ways = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    step = _STEP / camera.focal_length
    arcs = np.arange(int(reach / step) + 1) * step
    rays = np.cos(arcs)[:, None] * axis + np.sin(arcs)[:, None] * (ways @ basis)[:, None, :]
    counts = sample(strip, first_row, camera.project(rays.reshape(-1, 3))).reshape(SPOKES, -1)
    inner, outer = counts[:, :-1], counts[:, 1:]
    # Outside the frame the counts are NaN, and no comparison holds.
    falls = (inner >= level) & (outer < level)
    crosses = falls.any(axis=1)
    at = falls.argmax(axis=1)[crosses]
    inside, outside = inner[crosses, at], outer[crosses, at]
    arc = step * (at + (inside - level) / (inside - outside))
    leaves = np.isnan(counts).any(axis=1)
    cut, endless = np.count_nonzero(leaves & ~crosses), np.count_nonzero(~leaves & ~crosses)
    return Rim(axis, basis, arc[:, None] * ways[crosses], int(cut), int(endless))


def sample(strip: Image, first_row: int, points: FloatArray) -> FloatArray:
    """Return the counts (n,) at `points` (n, 2), bilinear between pixels; NaN outside the strip."""
    rows, columns = strip.shape
    x, y = points[:, 0], points[:, 1] - first_row
    inside = (x >= 0.0) & (x <= columns - 1.0) & (y >= 0.0) & (y <= rows - 1.0)
    x, y = np.where(inside, x, 0.0), np.where(inside, y, 0.0)
    column = np.minimum(x.astype(int), max(columns - 2, 0))
    row = np.minimum(y.astype(int), max(rows - 2, 0))
    x, y = x - column, y - row
    flat = strip.reshape(-1)
    corner = row * columns + column
    right, down = (1 if columns > 1 else 0), (columns if rows > 1 else 0)
    top = flat[corner] * (1.0 - x) + flat[corner + right] * x
    bottom = flat[corner + down] * (1.0 - x) + flat[corner + down + right] * x
    return np.where(inside, top * (1.0 - y) + bottom * y, np.nan)
