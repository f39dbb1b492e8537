"""Conversion between pixels and directions in the sky, for a camera of known attitude.

The conversion includes stellar aberration, which displaces stars towards the camera's direction of motion by
up to 20.8". Aberration is computed by the exact formula of special relativity (Green, Spherical Astronomy,
1985, section 8.3, and Explanatory Supplement, section 7.2.3).

The conversion also includes lens errors: tilt and decentring, which displace the optical axis from the image
centre, and distortion. The lens errors displace a point with the tangents u by (u . a) u + |u|^2 b + k |u|^2
u + l |u|^4 u, with tilt a, decentring b and distortion k, l (Brown 1966). Pixels that are not square, for
example in a picture that was scaled differently along its two axes, displace the point by p (u_x, -u_y) + q
(u_y, u_x), with the aspect p and the shear q. The vector `bend` in the code contains the eight lens errors:
the two components of a, the two components of b, and k, l, p and q.

`Pointing` gives the right ascension, declination and roll of an attitude.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.sun import SPEED_OF_LIGHT
from knightcube.astro.quaternion import attitude_matrix, from_matrix
from knightcube.compiled import compiled_form_of, loop_helper
from knightcube.vision.camera.lens import CameraKnowledge, CameraModel
from knightcube.vision.startracker.attitude_fit import scale_slope


def apparent(direction: FloatArray, velocity: FloatArray) -> FloatArray:
    """Return the apparent directions (n, 3) of stars for a camera with a velocity (3,), m/s, as unit vectors.

    The velocity is barycentric. Raises ValueError unless the velocity is finite and below the speed of light.
    """
    beta = np.asarray(velocity, dtype=float) / SPEED_OF_LIGHT
    square = float(beta @ beta)
    if not square < 1.0:
        raise ValueError(f"velocity = {velocity!r} m/s: give a finite one below the speed of light")
    slowed = np.sqrt(1.0 - square)
    along = (direction @ beta)[:, None]
    shifted = slowed * direction + beta + along / (1.0 + slowed) * beta
    return np.asarray(shifted / (1.0 + along))


BENDS, ASPECT = 8, 6
"""Number of lens errors in the vector `bend`, and index of the aspect."""
# Standard deviation of the tilt of a typical lens, relative to the corner's tangent (20 px of 1024 px).
# Standard deviations of the two distortion terms of a typical lens at the image corner (3 % and 1 %).
_TILT, _DISTORTION = 0.03, (0.03, 0.01)
_DECENTRING = 0.004
"""Prior standard deviation of the image corner's displacement by decentring, as a fraction of its radius."""
_ASPECT = 0.01
"""Prior standard deviation of aspect and shear; 0.01 changes the ratio of width to height by 2 %."""

# Minimum standard deviations of the optical axis (px) and of the distortion (relative to the radius).
_LEAST_CENTRE, _LEAST_DISTORTION = 1e-3, 1e-6


def usual_bend(camera: CameraModel) -> FloatArray:
    """Return the reciprocal prior variances (8,) of the lens errors of a typical uncalibrated lens."""
    corner = float(np.tan(camera.half_diagonal))
    first, second = _DISTORTION
    off = [_TILT * corner] * 2 + [_DECENTRING / corner] * 2
    return np.array([*off, first / corner**2, second / corner**4, _ASPECT, _ASPECT]) ** -2.0


def known_bend(camera: CameraModel, lens: CameraKnowledge) -> FloatArray:
    """Return the reciprocal prior variances (6,) of lens errors for a known accuracy and square pixels.

    For a lens that is known exactly, an empty array (0,) is returned. An error of the optical axis's position
    in the image has the effect of a tilt of the lens. The rotation of all stars by the same angle, which an
    error of the optical axis also causes, is attributed to the camera's mounting instead of the lens.
    """
    if lens.centre == lens.distortion == 0.0:
        return np.zeros(0)
    corner = float(np.tan(camera.half_diagonal))
    tilt = max(lens.centre, _LEAST_CENTRE) / camera.focal_length
    first = max(lens.distortion, _LEAST_DISTORTION) / corner**2
    off = [tilt] * 2 + [tilt * first] * 2
    return np.array([*off, first, _DISTORTION[1] / _DISTORTION[0] * first / corner**2]) ** -2.0


def bent(direction: FloatArray, bend: FloatArray) -> FloatArray:
    """Return unit vectors (n, 3) corrected for the lens errors `bend` (8,)."""
    return _bent(np.ascontiguousarray(direction), bend) if bend.any() else direction


def _bent_numpy(direction: FloatArray, bend: FloatArray) -> FloatArray:
    out = direction + bend_slope(direction) @ bend
    return np.asarray(out / np.linalg.norm(out, axis=1, keepdims=True))


@compiled_form_of(_bent_numpy)
def _bent(direction: FloatArray, bend: FloatArray) -> FloatArray:
    out = np.empty_like(direction)
    for k in range(len(direction)):
        x, y, z = direction[k]
        out[k, 0], out[k, 1], out[k, 2] = _bent_one(x, y, z, bend)
    return out


@loop_helper
def _bent_one(x: float, y: float, z: float, bend: FloatArray) -> tuple[float, float, float]:
    """Return one unit vector corrected for the lens errors `bend` (8,)."""
    tx, ty = x / z, y / z
    square = tx * tx + ty * ty
    along = bend[0] * tx + bend[1] * ty + (bend[4] + bend[5] * square) * square
    # Displacement of the tangents by decentring and by pixels that are not square, multiplied by z.
    dx = z * (square * bend[2] + tx * bend[6] + ty * bend[7])
    dy = z * (square * bend[3] - ty * bend[6] + tx * bend[7])
    inward = x * dx + y * dy
    ox = x + along * x * z * z + dx - x * inward
    oy = y + along * y * z * z + dy - y * inward
    oz = z - along * z * (x * x + y * y) - z * inward
    size = math.sqrt(ox * ox + oy * oy + oz * oz)
    return ox / size, oy / size, oz / size


# Maximum number of iterations that invert the lens errors, and step (rad) below which they end.
# Each iteration reduces the error to a few per cent.
_BEND_STEPS, _LEAST_STEP = 8, 1e-11
# Last step (rad) above which the iteration has diverged, as it does for directions far outside the image.
_DIVERGED = 1e-4


def _unbent_numpy(direction: FloatArray, bend: FloatArray) -> FloatArray:
    """Return the unit vectors (n, 3) that `bent` transforms into `direction` (n, 3).

    The result is NaN for z <= 0, and for directions so far outside the image that the iteration diverges.
    """
    wanted = np.where(direction[:, 2:] > 0.0, direction, np.nan)
    found = wanted
    for _ in range(_BEND_STEPS):
        step = wanted - _bent_numpy(found, bend)
        found = found + step
        found = found / np.linalg.norm(found, axis=1, keepdims=True)
        if not np.any(np.abs(step) > _LEAST_STEP):
            break
    return np.where(np.all(np.abs(step) < _DIVERGED, axis=1, keepdims=True), found, np.nan)


@compiled_form_of(_unbent_numpy)
def _unbent(direction: FloatArray, bend: FloatArray) -> FloatArray:
    """See `_unbent_numpy`."""
    out = np.full(direction.shape, np.nan)
    for k in range(len(direction)):
        wx, wy, wz = direction[k]
        x, y, z, step = wx, wy, wz, math.inf
        for _ in range(_BEND_STEPS if wz > 0.0 else 0):
            bx, by, bz = _bent_one(x, y, z, bend)
            step = max(abs(wx - bx), abs(wy - by), abs(wz - bz))
            x, y, z = x + wx - bx, y + wy - by, z + wz - bz
            size = math.sqrt(x * x + y * y + z * z)
            x, y, z = x / size, y / size, z / size
            if not step > _LEAST_STEP:
                break
        if step < _DIVERGED:
            out[k, 0], out[k, 1], out[k, 2] = x, y, z
    return out


def bend_slope(seen: FloatArray) -> FloatArray:
    """Return derivatives (n, 3, 8) of unit vectors `seen` (n, 3) with respect to the eight lens errors."""
    tangent = seen[:, :2] / seen[:, 2:]
    square = np.sum(tangent**2, axis=1, keepdims=True)
    # Tilt and distortion scale a tangent u by relative amounts proportional to u_x, u_y, |u|^2 and |u|^4.
    along = np.concatenate([tangent, square, square**2], axis=1)
    stretch = scale_slope(seen)[:, :, None] * along[:, None, :]
    across = np.eye(3)[:, :2] - seen[:, :, None] * seen[:, None, :2]
    shift = across * (seen[:, 2:] * square)[:, :, None]
    aspect, shear = tangent * np.array([1.0, -1.0]), tangent[:, ::-1]
    pixels = across @ (np.stack([aspect, shear], axis=2) * seen[:, 2:, None])
    return np.asarray(np.concatenate([stretch[:, :, :2], shift, stretch[:, :, 2:], pixels], axis=2))


@dataclass(frozen=True, slots=True)
class Pointing:
    """The attitude of a camera as right ascension, declination and roll.

    Attributes:
        right_ascension: right ascension of the boresight, ICRS, rad, in [0, 2 pi).
        declination: declination of the boresight, ICRS, rad.
        roll: position angle of the image's upward direction (-y) from north towards east, rad, in [0, 2 pi).
            At a celestial pole, north is defined by the meridian of right ascension zero.
    """

    right_ascension: float
    declination: float
    roll: float

    @classmethod
    def of(cls, quaternion: FloatArray) -> Pointing:
        """Return the pointing of an attitude quaternion (4,) from ICRS to camera axes."""
        _, y, z = attitude_matrix(quaternion)
        declination = np.arctan2(z[2], np.hypot(z[0], z[1]))
        right_ascension = np.arctan2(z[1], z[0])
        north, east = _north_and_east(float(right_ascension), float(declination))
        roll = np.arctan2(-y @ east, -y @ north)
        full = 2.0 * np.pi
        # The remainder of a tiny negative angle is rounded to 2 pi, whose remainder is 0.
        return cls(float(right_ascension % full % full), float(declination), float(roll % full % full))

    def quaternion(self) -> FloatArray:
        """Return the attitude quaternion (4,) from ICRS to camera axes."""
        cosine = np.cos(self.declination)
        z = np.array(
            [
                cosine * np.cos(self.right_ascension),
                cosine * np.sin(self.right_ascension),
                np.sin(self.declination),
            ]
        )
        north, east = _north_and_east(self.right_ascension, self.declination)
        y = -(np.cos(self.roll) * north + np.sin(self.roll) * east)
        return from_matrix(np.stack([np.cross(y, z), y, z]))


def _north_and_east(right_ascension: float, declination: float) -> tuple[FloatArray, FloatArray]:
    """Return the unit vectors (3,), (3,) towards north and east at a position in the sky."""
    sine, cosine = np.sin(right_ascension), np.cos(right_ascension)
    north = np.array([-np.sin(declination) * cosine, -np.sin(declination) * sine, np.cos(declination)])
    return north, np.array([-sine, cosine, 0.0])


@dataclass(frozen=True, slots=True, eq=False)
class SkyMap:
    """The conversion between pixels and directions for a camera of known attitude.

    Attributes:
        camera: camera model.
        quaternion: attitude quaternion (4,) from ICRS to camera axes.
        bend: lens errors that the camera model does not include (8,); zeros if the lens is exact.
        velocity: velocity of the camera (3,), m/s, for the correction of aberration, or None.
        mirrored: whether the image shows the mirrored sky; the attitude then refers to the image after left
            and right are swapped about the optical axis.
    """

    camera: CameraModel
    quaternion: FloatArray
    bend: FloatArray = field(default_factory=lambda: np.zeros(BENDS))
    velocity: FloatArray | None = None
    mirrored: bool = False

    def directions(self, points: FloatArray) -> FloatArray:
        """Return the ICRS directions of pixels (n, 2), as unit vectors (n, 3)."""
        rays = self.camera.unit_vectors(self._exchanged(points))
        seen = bent(rays, self.bend) @ attitude_matrix(self.quaternion)
        # The aberration for the opposite velocity inverts the aberration to within (v/c)^2 or 0.002".
        return seen if self.velocity is None else apparent(seen, -self.velocity)

    def pixels(self, directions: FloatArray) -> FloatArray:
        """Return the pixels (n, 2) of unit vectors (n, 3), ICRS, or NaN for directions not imaged."""
        if self.velocity is not None:
            directions = apparent(directions, self.velocity)
        seen = directions @ attitude_matrix(self.quaternion).T
        if self.bend.any():
            seen = _unbent(np.ascontiguousarray(seen), self.bend)
        return self._exchanged(self.camera.project(seen))

    def _exchanged(self, points: FloatArray) -> FloatArray:
        """Return pixels (n, 2) with left and right swapped if the image shows the mirrored sky."""
        if not self.mirrored:
            return points
        return np.asarray(np.array([2.0 * self.camera.centre[0], 0.0]) + points * np.array([-1.0, 1.0]))


@dataclass(frozen=True, slots=True, eq=False)
class ShortTrails:
    """The rotation of the camera during an exposure in which stars move by a few pixels.

    Attributes:
        turn: rotation vector of the camera over the exposure (3,), rad, camera axes.
        delay: delay between consecutive rows of a rolling shutter, as a fraction of the exposure time.
        delay_sigma: standard deviation of `delay`.
    """

    turn: FloatArray
    delay: float = 0.0
    delay_sigma: float = 0.0

    def of(self, camera: CameraModel, direction: FloatArray) -> FloatArray:
        """Return the displacements (n, 2), px, of stars at `direction` (n, 3) during the exposure."""
        moved = 0.5 * np.cross(direction, self.turn)
        return np.nan_to_num(camera.project(direction + moved) - camera.project(direction - moved))

    def late(self, camera: CameraModel, points: FloatArray) -> FloatArray:
        """Return the displacements (n, 2), px, of stars at `points` (n, 2), px, per unit of `delay`."""
        return self.of(camera, camera.unit_vectors(points)) * (points[:, 1:] - camera.centre[1])
