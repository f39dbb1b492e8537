"""Quaternion algebra: scalar last, unit, `q` rotates reference into body: v_body = A(q) v_reference.

The convention is that of Sease 2013 and Wertz 1978. Composition follows the matrices: A(multiply(p, q)) =
A(p) A(q). The attitude matrix is 4.8 corrected (its printed lower triangle repeats the upper one), the
kinematics 2.12 corrected (the upper left block is minus the cross-product matrix). No other module repeats
these formulas.

`NED_TO_TESTBED` and `attitude_map` rotate between the frames of the mission. The testbed frame T has y down
along the thread and the field along -z. Magnetic north is the direction of the field, so N = -z, D = y and
E = D x N = -x: v_T = [[0, -1, 0], [0, 0, 1], [-1, 0, 0]] v_NED.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from knightcube.astro.arrays import FloatArray

IDENTITY: FloatArray = np.array([0.0, 0.0, 0.0, 1.0])


def _components(q: FloatArray) -> Iterable[Any]:
    """Return the components of q (..., 4) as four arrays (...), or as floats, which are faster, for one q."""
    return q.tolist() if q.ndim == 1 else np.moveaxis(q, -1, 0)


def normalise(q: FloatArray) -> FloatArray:
    """Return q (..., 4), or vectors (..., 3), scaled to unit length."""
    if q.shape == (4,):
        a, b, c, d = q.tolist()
        return np.asarray(q / math.sqrt(a * a + b * b + c * c + d * d))
    return np.asarray(q / np.linalg.norm(q, axis=-1, keepdims=True))


def conjugate(q: FloatArray) -> FloatArray:
    """Return the inverse rotation of unit quaternions (..., 4)."""
    return np.asarray(q * np.array([-1.0, -1.0, -1.0, 1.0]))


def multiply(p: FloatArray, q: FloatArray) -> FloatArray:
    """Return the rotation q followed by p, (..., 4): A(result) = A(p) A(q)."""
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
    """Return A(q), (..., 3, 3), reference into body (Sease 4.8 corrected)."""
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
    """Return the quaternion (4,) of an attitude matrix (3, 3), scalar part not negative.

    Takes the largest of the four squared components first (Shepperd's method), so no angle is singular.
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
    """Return the quaternion (..., 4) of a rotation by |vector| rad about vector (..., 3).

    A body that rotates with constant rate w for a time t has q(t) = multiply(from_rotation_vector(w t),
    q(0)).
    """
    v = np.asarray(vector, dtype=float)
    if v.ndim == 1:
        x, y, z = v.tolist()
        half_angle = 0.5 * math.sqrt(x * x + y * y + z * z)
        phase = np.pi * (half_angle / np.pi)  # rounded as numpy's sinc does
        scale = 0.5 * (np.sin(phase) / phase) if phase else 0.5
        return np.array([scale * x, scale * y, scale * z, np.cos(half_angle)])
    half = 0.5 * np.linalg.norm(v, axis=-1, keepdims=True)
    # sin(x)/x through numpy's sinc keeps the small-angle limit exact.
    return np.concatenate([0.5 * np.sinc(half / np.pi) * v, np.cos(half)], axis=-1)


def to_rotation_vector(q: FloatArray) -> FloatArray:
    """Return the rotation vector (..., 3), rad, of the shorter rotation."""
    q = np.asarray(q)
    q = np.where(q[..., 3:] < 0, -q, q)
    sine = np.linalg.norm(q[..., :3], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, q[..., 3:])
    small = sine < 1e-9
    scale = np.where(small, 2.0, angle / np.where(small, 1.0, sine))
    return np.asarray(scale * q[..., :3])


def derivative(q: FloatArray, rate: FloatArray) -> FloatArray:
    """Return dq/dt (4,) at body rate (3,) rad/s (Sease 2.12 corrected)."""
    return np.asarray(0.5 * multiply(np.append(rate, 0.0), q))


def angle_between(p: FloatArray, q: FloatArray) -> FloatArray:
    """Return the rotation angle in rad between attitudes p and q (..., 4), accurate at zero and at pi."""
    vector = to_rotation_vector(multiply(p, conjugate(q)))
    return np.asarray(np.linalg.norm(vector, axis=-1))


def about_axis_y(angle: float) -> FloatArray:
    """Return the quaternion of a rotation by `angle` rad about the y axis, the testbed's thread."""
    return np.array([0.0, np.sin(0.5 * angle), 0.0, np.cos(0.5 * angle)])


def angle_about_axis_y(q: FloatArray) -> float:
    """Return the rotation of q (4,) about the y axis, the twist about the thread, rad in [-pi, pi)."""
    angle = 2.0 * np.arctan2(q[1], q[3])
    return float(np.remainder(angle + np.pi, 2.0 * np.pi) - np.pi)


NED_TO_TESTBED: FloatArray = np.array([0.5, -0.5, -0.5, 0.5])


def attitude_map(mounting: FloatArray, reference: FloatArray) -> FloatArray:
    """Return the matrix M (4, 4) that maps the attitude of an inertial unit to that of the body.

    The unit measures q (4,), NED into sensor axes. `mounting` (4,) rotates sensor into body axes and
    `reference` (4,) rotates NED into the mission's reference frame. M q = mounting q conj(reference) rotates
    the reference frame into body axes.
    """
    return np.asarray(multiply(multiply(mounting, np.eye(4)), conjugate(reference)).T)
