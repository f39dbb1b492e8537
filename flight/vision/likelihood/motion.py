"""How a star moves over the detector while the camera turns, and how that depends on the rate.

Time is in exposures, zero at mid-exposure. With turn u = omega T and growth g = (d omega/dt) T^2, both in the
camera's axes, the rate is u + g t and the stars move as v' = -(u + g t) x v. The rotation since mid-exposure
is the vector u t + g t^2/2 + (u x g) t^3/12, exact without growth and to the fourth order with it (Magnus).
A star is named by its pixel at mid-exposure.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from flight.arrays import FloatArray
from flight.pinhole import Pinhole

_TINY = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """The camera's rotation over one exposure.

    Attributes:
        turn: (3,) rad, rate at mid-exposure times the exposure.
        growth: (3,) rad, change of the rate over the exposure times the exposure.
    """

    turn: FloatArray
    growth: FloatArray

    @classmethod
    def steady(cls, turn: FloatArray) -> Motion:
        """Return the motion at constant rate."""
        return cls(np.asarray(turn, dtype=float), np.zeros(3))

    @property
    def constant(self) -> bool:
        """Whether the rate does not change."""
        return not self.growth.any()


@dataclass(frozen=True, slots=True, eq=False)
class Paths:
    """Points on paths, (m,) of them: where, how fast, how bent, in px and exposures.

    Attributes:
        position, velocity, acceleration: (m, 2).
    """

    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray


def paths(pinhole: Pinhole, motion: Motion, stars: FloatArray, time: FloatArray) -> Paths:
    """Return where the stars that are at pixels `stars` (m, 2) at mid-exposure are at `time` (m,)."""
    x, y, z = _rotated(motion, _columns(pinhole, stars), time)
    focal = pinhole.focal_length
    w = _rate(motion, time)
    vx, vy, vz = _cross((x, y, z), w)  # -omega x v
    ax, ay, az = _cross((vx, vy, vz), w)
    if not motion.constant:
        extra = _cross((x, y, z), tuple(motion.growth))
        ax, ay, az = ax + extra[0], ay + extra[1], az + extra[2]
    inverse = 1.0 / z
    px, py = x * inverse, y * inverse
    qx, qy = (vx - px * vz) * inverse, (vy - py * vz) * inverse
    rx = (ax - px * az - 2.0 * qx * vz) * inverse
    ry = (ay - py * az - 2.0 * qy * vz) * inverse
    centre = pinhole.centre
    return Paths(
        np.stack([focal * px + centre[0], focal * py + centre[1]], axis=-1),
        focal * np.stack([qx, qy], axis=-1),
        focal * np.stack([rx, ry], axis=-1),
    )


def sensitivities(
    pinhole: Pinhole, motion: Motion, stars: FloatArray, time: FloatArray, growing: bool = True
) -> FloatArray:
    """Return d(pixel at `time`)/d(turn, growth, star's pixel at mid-exposure): (m, 2, 8).

    Exact in the turn and the star; in the growth to second order of the angle turned, and left zero unless
    `growing`.
    """
    v = _rotated(motion, _columns(pinhole, stars), time)
    focal = pinhole.focal_length
    x, y, z = v
    scale = focal / z
    px, py = x / z * scale, y / z * scale
    out = np.zeros((len(time), 2, 8))

    def put(column: int, change: _Vector) -> None:
        out[:, 0, column] = change[0] * scale - px * change[2]
        out[:, 1, column] = change[1] * scale - py * change[2]

    for column, psi in _attitude_changes(motion, time, growing):
        put(column, _cross(v, psi))
    one, none = np.full(len(time), 1.0 / focal), np.zeros(len(time))
    put(6, _rotated(motion, (one, none, none), time))
    put(7, _rotated(motion, (none, one, none), time))
    return out


def _attitude_changes(motion: Motion, time: FloatArray, growing: bool) -> Iterator[tuple[int, _Vector]]:
    """Return by which small rotation, against the camera, each of turn and growth changes the attitude."""
    # The mean rate since mid-exposure: what changes beyond it is of higher order.
    mean = [turn + 0.5 * time * growth for turn, growth in zip(motion.turn, motion.growth, strict=True)]
    angle = np.sqrt(mean[0] ** 2 + mean[1] ** 2 + mean[2] ** 2)
    inverse = 1.0 / np.maximum(angle, _TINY)
    axis = [component * inverse for component in mean]
    phi = angle * time
    # Integral of the rotation from t' to t over t': the change of attitude that a change of rate makes.
    sine = time * np.sinc(phi / np.pi)
    versine = 0.5 * time * phi * np.sinc(0.5 * phi / np.pi) ** 2
    for j in range(3):
        along = (time - sine) * axis[j]
        psi = [along * component for component in axis]
        psi[j] = psi[j] + sine
        after, before = (j + 1) % 3, (j + 2) % 3
        # axis x unit vector j has the components below, and none along j.
        psi[after] = psi[after] - versine * axis[before]
        psi[before] = psi[before] + versine * axis[after]
        yield j, (psi[0], psi[1], psi[2])
        if growing:
            half, sixth = 0.5 * time**2, time**3 / 6.0
            bent = [np.zeros_like(time), np.zeros_like(time), np.zeros_like(time)]
            bent[j] = half
            bent[after] = -sixth * mean[before]
            bent[before] = sixth * mean[after]
            yield 3 + j, (bent[0], bent[1], bent[2])


_Vector = tuple[FloatArray, FloatArray, FloatArray]


def _columns(pinhole: Pinhole, stars: FloatArray) -> _Vector:
    """Return directions, not normalised (z is 1), of pixels (m, 2), by component."""
    centre = pinhole.centre
    x = (stars[:, 0] - centre[0]) / pinhole.focal_length
    y = (stars[:, 1] - centre[1]) / pinhole.focal_length
    return x, y, np.ones(len(stars))


def _rate(motion: Motion, time: FloatArray) -> _Vector:
    x, y, z = (turn + growth * time for turn, growth in zip(motion.turn, motion.growth, strict=True))
    return x, y, z


def _cross(a: _Vector, b: _Vector) -> _Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _rotated(motion: Motion, v: _Vector, time: FloatArray) -> _Vector:
    """Return fixed directions in the camera's axes at `time`: v cos - (a x v) sin + a (a.v)(1 - cos)."""
    if motion.constant:
        angle = float(np.linalg.norm(motion.turn))
        a: _Vector = tuple(motion.turn / max(angle, _TINY))
        phi = angle * time
    else:
        twist = np.cross(motion.turn, motion.growth) / 12.0
        parts = np.stack([motion.turn, 0.5 * motion.growth, twist])
        vector = np.stack([time, time**2, time**3], axis=-1) @ parts
        phi = np.sqrt(np.sum(vector**2, axis=-1))
        unit = vector / np.maximum(phi, _TINY)[:, None]
        a = unit[:, 0], unit[:, 1], unit[:, 2]
    cosine, sine = np.cos(phi), np.sin(phi)
    along = (a[0] * v[0] + a[1] * v[1] + a[2] * v[2]) * (1.0 - cosine)
    c = _cross(v, a)  # -(a x v)
    return (
        v[0] * cosine + c[0] * sine + a[0] * along,
        v[1] * cosine + c[1] * sine + a[1] * along,
        v[2] * cosine + c[2] * sine + a[2] * along,
    )
