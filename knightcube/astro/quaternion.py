"""Quaternion algebra for unit quaternions, scalar last, with the convention v_body = A(q) v_reference.

The quaternion convention is that of Sease 2013 and Wertz 1978. Quaternions are multiplied in the order of the
attitude matrices: A(multiply(p, q)) = A(p) A(q). The attitude matrix is equation 4.8 of Sease 2013 with a
correction, because the printed lower triangle repeats the upper triangle. The kinematic equation is equation
2.12 of Sease 2013 with a corrected sign of the upper left block, which is minus the cross-product matrix. The
formulas of quaternion algebra are contained in this module only.

`NED_TO_TESTBED` and `attitude_map` convert between the reference frames of the mission. The y axis of the
testbed frame T points down along the suspension thread, and the magnetic field points along -z. Magnetic
north is the direction of the field, so that N = -z, D = y and E = D x N = -x, and v_T = [[0, -1, 0], [0, 0,
1], [-1, 0, 0]] v_NED.

The function `compose` and the functions after it implement the same algebra with tuples of floats for the
control cycle, because a numpy call on three or four numbers takes ten times as long as plain arithmetic.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.compiled import loop_helper

IDENTITY: FloatArray = np.array([0.0, 0.0, 0.0, 1.0])


def _components(q: FloatArray) -> Iterable[Any]:
    """Return the components of q (..., 4) as four arrays (...), or as four floats if q is one quaternion."""
    return q.tolist() if q.ndim == 1 else np.moveaxis(q, -1, 0)


def normalise(q: FloatArray) -> FloatArray:
    """Return quaternions (..., 4) or vectors (..., 3) normalised to unit length."""
    if q.shape == (4,):
        a, b, c, d = q.tolist()
        return np.asarray(q / math.sqrt(a * a + b * b + c * c + d * d))
    return np.asarray(q / np.linalg.norm(q, axis=-1, keepdims=True))


def conjugate(q: FloatArray) -> FloatArray:
    """Return the inverse rotations of unit quaternions (..., 4)."""
    return np.asarray(q * np.array([-1.0, -1.0, -1.0, 1.0]))


def multiply(p: FloatArray, q: FloatArray) -> FloatArray:
    """Return the rotation q followed by the rotation p as quaternions (..., 4): A(result) = A(p) A(q)."""
    p, q = np.asarray(p), np.asarray(q)
    p1, p2, p3, p4 = _components(p)
    q1, q2, q3, q4 = _components(q)
    product = [
        p4 * q1 + p3 * q2 - p2 * q3 + p1 * q4,
        -p3 * q1 + p4 * q2 + p1 * q3 + p2 * q4,
        p2 * q1 - p1 * q2 + p4 * q3 + p3 * q4,
        -p1 * q1 - p2 * q2 - p3 * q3 + p4 * q4,
    ]
    return np.array(product) if p.ndim == q.ndim == 1 else np.stack(product, axis=-1)


def attitude_matrix(q: FloatArray) -> FloatArray:
    """Return the attitude matrix A(q), (..., 3, 3), reference to body (Sease 2013, eq. 4.8, corrected)."""
    q = np.asarray(q)
    q1, q2, q3, q4 = _components(q)
    s1, s2, s3, s4 = q1 * q1, q2 * q2, q3 * q3, q4 * q4
    rows = [
        [s1 - s2 - s3 + s4, 2 * (q1 * q2 + q3 * q4), 2 * (q1 * q3 - q2 * q4)],
        [2 * (q1 * q2 - q3 * q4), -s1 + s2 - s3 + s4, 2 * (q2 * q3 + q1 * q4)],
        [2 * (q1 * q3 + q2 * q4), 2 * (q2 * q3 - q1 * q4), -s1 - s2 + s3 + s4],
    ]
    return np.array(rows) if q.ndim == 1 else np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def from_matrix(matrix: FloatArray) -> FloatArray:
    """Return the quaternions (..., 4) of attitude matrices (..., 3, 3), with scalar parts of at least 0.

    The largest component is computed first (Shepperd's method), so that the method has no singularity.
    """
    a = np.asarray(matrix)
    if a.ndim > 2:
        return _from_matrices(a)
    trace = a[0, 0] + a[1, 1] + a[2, 2]
    squares = np.array([a[0, 0], a[1, 1], a[2, 2], trace])
    largest = int(np.argmax(squares))
    if largest == 3:
        q = np.array([a[1, 2] - a[2, 1], a[2, 0] - a[0, 2], a[0, 1] - a[1, 0], 1.0 + trace])
    else:
        i, j, k = largest, (largest + 1) % 3, (largest + 2) % 3
        q = np.empty(4)
        q[i] = 1.0 + 2.0 * a[i, i] - trace
        q[j] = a[i, j] + a[j, i]
        q[k] = a[i, k] + a[k, i]
        q[3] = a[j, k] - a[k, j]
    q = normalise(q)
    return -q if q[3] < 0 else q


def _from_matrices(a: FloatArray) -> FloatArray:
    """Return the quaternions (..., 4) of attitude matrices (..., 3, 3), by Shepperd's method (see above)."""
    products = np.empty((*a.shape[:-2], 4, 4))  # products of the components of q, times 4
    products[..., :3, :3] = a + np.swapaxes(a, -1, -2)
    own, trace = np.diagonal(a, axis1=-2, axis2=-1), np.trace(a, axis1=-2, axis2=-1)
    i, j, k = np.arange(3), np.array([1, 2, 0]), np.array([2, 0, 1])
    products[..., i, i] = 1.0 + 2.0 * own - trace[..., None]
    products[..., 3, :3] = products[..., :3, 3] = a[..., j, k] - a[..., k, j]
    products[..., 3, 3] = 1.0 + trace
    largest = np.argmax(np.concatenate([own, trace[..., None]], axis=-1), axis=-1)
    q = normalise(np.take_along_axis(products, largest[..., None, None], axis=-2)[..., 0, :])
    return np.where(q[..., 3:] < 0.0, -q, q)


def from_rotation_vector(vector: FloatArray) -> FloatArray:
    """Return the quaternions (..., 4) of rotation vectors (..., 3), rad.

    A body that rotates with a constant rate w has the attitude multiply(from_rotation_vector(w t), q(0)).
    """
    v = np.asarray(vector, dtype=float)
    if v.ndim == 1:
        x, y, z = v.tolist()
        half_angle = 0.5 * math.sqrt(x * x + y * y + z * z)
        phase = np.pi * (half_angle / np.pi)  # numpy.sinc rounds in the same way
        scale = 0.5 * (np.sin(phase) / phase) if phase else 0.5
        return np.array([scale * x, scale * y, scale * z, np.cos(half_angle)])
    half = 0.5 * np.linalg.norm(v, axis=-1, keepdims=True)
    # The function numpy.sinc computes sin(x)/x exactly for small angles.
    return np.concatenate([0.5 * np.sinc(half / np.pi) * v, np.cos(half)], axis=-1)


def to_rotation_vector(q: FloatArray) -> FloatArray:
    """Return the rotation vectors (..., 3), rad, of quaternions (..., 4), with angles of at most pi."""
    q = np.asarray(q)
    q = np.where(q[..., 3:] < 0, -q, q)
    sine = np.linalg.norm(q[..., :3], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, q[..., 3:])
    small = sine < 1e-9
    scale = np.where(small, 2.0, angle / np.where(small, 1.0, sine))
    return np.asarray(scale * q[..., :3])


def derivative(q: FloatArray, rate: FloatArray) -> FloatArray:
    """Return dq/dt (4,), 1/s, for a body rate (3,), rad/s (Sease 2013, eq. 2.12, corrected)."""
    return np.asarray(0.5 * multiply(np.append(rate, 0.0), q))


def angle_between(p: FloatArray, q: FloatArray) -> FloatArray:
    """Return the rotation angles (rad) between attitudes p and q (..., 4).

    The computation is also accurate for angles near 0 and pi.
    """
    vector = to_rotation_vector(multiply(p, conjugate(q)))
    return np.asarray(np.linalg.norm(vector, axis=-1))


def about_axis_y(angle: float) -> FloatArray:
    """Return the quaternion of a rotation by `angle` (rad) about the y axis, the testbed's rotation axis."""
    return np.array([0.0, np.sin(0.5 * angle), 0.0, np.cos(0.5 * angle)])


def angle_about_axis_y(q: FloatArray) -> float:
    """Return the angle (rad) of q (4,) about the y axis, the testbed's rotation axis, in [-pi, pi)."""
    angle = 2.0 * math.atan2(q[1], q[3])
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


NED_TO_TESTBED: FloatArray = np.array([0.5, -0.5, -0.5, 0.5])


def attitude_map(mounting: FloatArray, reference: FloatArray) -> FloatArray:
    """Return the matrix M (4, 4) that converts an inertial unit's attitude to the body attitude.

    The quaternion q (4,) of the inertial unit rotates NED into sensor axes, and `mounting` rotates sensor
    axes into body axes. The quaternion `reference` rotates NED into the mission's reference frame. The
    product M q = mounting q conj(reference) rotates the mission's reference frame into body axes.
    """
    return np.asarray(multiply(multiply(mounting, np.eye(4)), conjugate(reference)).T)


Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Matrix = tuple[Vector, Vector, Vector]


@loop_helper
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


@loop_helper
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


@loop_helper
def twist(q: Quaternion) -> float:
    """Return the angle of q about the y axis, rad, in [-pi, pi]."""
    return 2.0 * math.atan2(q[1], q[3]) if q[3] >= 0.0 else 2.0 * math.atan2(-q[1], -q[3])


@loop_helper
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


@loop_helper
def times(rows: Matrix, v: Vector) -> Vector:
    """Return the product of a matrix (3, 3) and a vector (3,)."""
    (a, b, c), (d, e, f), (g, h, i) = rows
    x, y, z = v
    return a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z


@loop_helper
def cross(a: Vector, b: Vector) -> Vector:
    """Return a x b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@loop_helper
def skew(v: Vector) -> Matrix:
    """Return the rows of the cross-product matrix [v x], for which times(skew(v), u) = v x u."""
    x, y, z = v
    return (0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0)


@loop_helper
def added(a: Vector, b: Sequence[float]) -> Vector:
    """Return a + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def rows_of(array: FloatArray) -> Matrix:
    """Return the rows of an array (3, 3) as tuples."""
    a, b, c = (tuple(row) for row in array.tolist())
    return a, b, c
