"""Rotations as tuples of floats: the algebra of `knightcube.astro.quaternion` for the control cycle.

The conventions of the two modules are the same (scalar last, A(compose(p, q)) = A(p) A(q)), and a test
compares them. Tuples are used because a numpy call on three or four numbers takes ten times as long as plain
arithmetic.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from knightcube.astro.arrays import FloatArray

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Matrix = tuple[Vector, Vector, Vector]


def compose(p: Quaternion, q: Quaternion) -> Quaternion:
    """Return the unit quaternion of the rotation q followed by the rotation p."""
    p1, p2, p3, p4 = p
    q1, q2, q3, q4 = q
    a = p4 * q1 + p3 * q2 - p2 * q3 + p1 * q4
    b = -p3 * q1 + p4 * q2 + p1 * q3 + p2 * q4
    c = p2 * q1 - p1 * q2 + p4 * q3 + p3 * q4
    d = -p1 * q1 - p2 * q2 - p3 * q3 + p4 * q4
    scale = 1.0 / math.sqrt(a * a + b * b + c * c + d * d)
    return a * scale, b * scale, c * scale, d * scale


def inverse(q: Quaternion) -> Quaternion:
    """Return the inverse of a unit quaternion."""
    return -q[0], -q[1], -q[2], q[3]


def exponential(x: float, y: float, z: float) -> Quaternion:
    """Return the quaternion of a rotation vector (x, y, z), rad."""
    square = 0.25 * (x * x + y * y + z * z)
    half = math.sqrt(square)
    # Below 1e-4 rad the first omitted term of the sine series, x^4/120, is smaller than the rounding error.
    scale = 0.5 * (math.sin(half) / half if half > 1e-4 else 1.0 - square / 6.0)
    return scale * x, scale * y, scale * z, math.cos(half)


def logarithm(q: Quaternion) -> Vector:
    """Return the rotation vector (rad) of a unit quaternion, with an angle of at most half a revolution."""
    x, y, z, w = q if q[3] >= 0.0 else (-q[0], -q[1], -q[2], -q[3])
    sine = math.sqrt(x * x + y * y + z * z)
    scale = 2.0 * math.atan2(sine, w) / sine if sine > 1e-9 else 2.0
    return scale * x, scale * y, scale * z


def twist(q: Quaternion) -> float:
    """Return the angle of q about the y axis, rad, in [-pi, pi]."""
    return 2.0 * math.atan2(q[1], q[3]) if q[3] >= 0.0 else 2.0 * math.atan2(-q[1], -q[3])


def matrix(q: Quaternion) -> Matrix:
    """Return the rows of the attitude matrix A(q) (Sease, eq. (4.8), corrected)."""
    x, y, z, w = q
    xx, yy, zz = x * x, y * y, z * z
    xy, xz, yz = x * y, x * z, y * z
    xw, yw, zw = x * w, y * w, z * w
    return (
        (1.0 - 2.0 * (yy + zz), 2.0 * (xy + zw), 2.0 * (xz - yw)),
        (2.0 * (xy - zw), 1.0 - 2.0 * (xx + zz), 2.0 * (yz + xw)),
        (2.0 * (xz + yw), 2.0 * (yz - xw), 1.0 - 2.0 * (xx + yy)),
    )


def times(rows: Matrix, v: Vector) -> Vector:
    """Return the product of a matrix (3, 3) and a vector (3,)."""
    (a, b, c), (d, e, f), (g, h, i) = rows
    x, y, z = v
    return a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z


def cross(a: Vector, b: Vector) -> Vector:
    """Return a x b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def skew(v: Vector) -> Matrix:
    """Return the rows of the cross-product matrix [v x], for which times(skew(v), u) = v x u."""
    x, y, z = v
    return (0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0)


def added(a: Vector, b: Sequence[float]) -> Vector:
    """Return a + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def rows_of(array: FloatArray) -> Matrix:
    """Return the rows of an array (3, 3) as tuples."""
    a, b, c = (tuple(row) for row in array.tolist())
    return a, b, c
