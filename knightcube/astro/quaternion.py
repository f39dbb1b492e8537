"""Quaternion algebra for unit quaternions, scalar last, with the convention v_body = A(q) v_reference.

The quaternion convention is that of Sease 2013 and Wertz 1978. Quaternions are multiplied in the order of the
attitude matrices: A(multiply(p, q)) = A(p) A(q). The attitude matrix is equation 4.8 of Sease 2013 with a
correction, because the printed lower triangle repeats the upper triangle. The kinematic equation is equation
2.12 of Sease 2013 with a corrected sign of the upper left block, which is minus the cross-product matrix. The
formulas of quaternion algebra are contained in this module only.

`NED_TO_TESTBED` and `attitude_map` convert between the reference frames of the mission. The y axis of the
testbed frame T points down along the thread, and the magnetic field points along -z. Magnetic north is the
direction of the field, so that N = -z, D = y and E = D x N = -x, and v_T = [[0, -1, 0], [0, 0, 1], [-1, 0,
0]] v_NED.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from knightcube.astro.arrays import FloatArray

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
    """Return the quaternion (4,) of an attitude matrix (3, 3), with a scalar part of at least 0.

    The largest component is computed first (Shepperd's method), so that the method has no singularity.
    """
    a = np.asarray(matrix)
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


def from_rotation_vector(vector: FloatArray) -> FloatArray:
    """Return the quaternions (..., 4) of rotation vectors (..., 3), rad.

    The attitude of a body that rotates with a constant rate w is q(t) = multiply(from_rotation_vector(w t),
    q(0)).
    """
    v = np.asarray(vector, dtype=float)
    if v.ndim == 1:
        x, y, z = v.tolist()
        half_angle = 0.5 * math.sqrt(x * x + y * y + z * z)
        phase = np.pi * (half_angle / np.pi)  # rounds in the same way as numpy.sinc
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

    Angles near 0 and pi are accurate.
    """
    vector = to_rotation_vector(multiply(p, conjugate(q)))
    return np.asarray(np.linalg.norm(vector, axis=-1))


def about_axis_y(angle: float) -> FloatArray:
    """Return the quaternion of a rotation by `angle` (rad) about the y axis, the testbed's thread."""
    return np.array([0.0, np.sin(0.5 * angle), 0.0, np.cos(0.5 * angle)])


def angle_about_axis_y(q: FloatArray) -> float:
    """Return the rotation angle (rad) of q (4,) about the y axis, the testbed's thread, in [-pi, pi)."""
    angle = 2.0 * np.arctan2(q[1], q[3])
    return float(np.remainder(angle + np.pi, 2.0 * np.pi) - np.pi)


NED_TO_TESTBED: FloatArray = np.array([0.5, -0.5, -0.5, 0.5])


def attitude_map(mounting: FloatArray, reference: FloatArray) -> FloatArray:
    """Return the matrix M (4, 4) that converts an inertial unit's attitude to the body attitude.

    The quaternion q (4,) of the inertial unit rotates NED into sensor axes. The product M q = mounting q
    conj(reference) rotates the mission's reference frame into body axes.

    Args:
        mounting: (4,) quaternion that rotates sensor axes into body axes.
        reference: (4,) quaternion that rotates NED into the mission's reference frame.
    """
    return np.asarray(multiply(multiply(mounting, np.eye(4)), conjugate(reference)).T)
