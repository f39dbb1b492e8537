"""What a lens that is not exactly known does beyond a wrong focal length, seen from the picture's middle.

Its axis is not in the middle, and it distorts: tangents u are off by (u . a) u + |u|^2 b + k |u|^2 u + l
|u|^4 u, with tilt a, decentring b and distortion k, l (Brown 1966): the bend (6,) is (a, b, k, l).
"""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.vision.camera.knowledge import CameraKnowledge
from knightcube.vision.camera.lens import CameraModel
from knightcube.vision.startracker.identification.refinement import scale_slope

BENDS = 6
# Standard deviations of the tilt along x and y, as a part of the corner's tangent, and of the distortion
# there by its two terms: 20 px of 1024, 3 and 1 %. The decentring is the product of tilt and distortion.
_TILT, _DISTORTION = 0.03, (0.03, 0.01)

# px, and a share of the radius: what is known better is taken to be known so well.
_LEAST_CENTRE, _LEAST_DISTORTION = 1e-3, 1e-6


def usual_bend(camera: CameraModel) -> FloatArray:
    """Return the information (6,) about the bend that is usual of lenses."""
    corner = float(np.tan(camera.half_diagonal))
    first, second = _DISTORTION
    off = [_TILT * corner] * 2 + [_TILT * first / corner] * 2
    return np.array([*off, first / corner**2, second / corner**4]) ** -2.0


def known_bend(camera: CameraModel, lens: CameraKnowledge) -> FloatArray:
    """Return the information (6,) about the bend of a lens known so well; (0,) of one that is exact.

    An axis that is off the described one turns all stars alike, which is the mounting's, and tilts the lens.
    """
    if lens.centre == lens.distortion == 0.0:
        return np.zeros(0)
    corner = float(np.tan(camera.half_diagonal))
    tilt = max(lens.centre, _LEAST_CENTRE) / camera.focal_length
    first = max(lens.distortion, _LEAST_DISTORTION) / corner**2
    off = [tilt] * 2 + [tilt * first] * 2
    return np.array([*off, first, _DISTORTION[1] / _DISTORTION[0] * first / corner**2]) ** -2.0


def bent(direction: FloatArray, bend: FloatArray) -> FloatArray:
    """Return the unit vectors (n, 3) of what a lens of this `bend` (6,) shows at `direction` (n, 3)."""
    if not bend.any():
        return direction
    out = direction + bend_slope(direction) @ bend
    return np.asarray(out / np.linalg.norm(out, axis=1, keepdims=True))


def bend_slope(seen: FloatArray) -> FloatArray:
    """Return by how much directions (n, 3) move per unit of tilt, decentring and distortion, (n, 3, 6)."""
    tangent = seen[:, :2] / seen[:, 2:]
    square = np.sum(tangent**2, axis=1, keepdims=True)
    # Tilt and distortion stretch a tangent u along itself, by u_x, u_y, |u|^2 and |u|^4.
    along = np.concatenate([tangent, square, square**2], axis=1)
    stretch = scale_slope(seen)[:, :, None] * along[:, None, :]
    across = np.eye(3)[:, :2] - seen[:, :, None] * seen[:, None, :2]
    shift = across * (seen[:, 2:] * square)[:, :, None]
    return np.asarray(np.concatenate([stretch[:, :, :2], shift, stretch[:, :, 2:]], axis=2))
