"""ESOQ2, Mortari's Second Estimator of the Optimal Quaternion (Sease chapter 3, text at 3.23).

Davenport's K has the optimal quaternion as eigenvector of its largest eigenvalue. ESOQ2 takes that eigenvalue
from the characteristic polynomial and the rotation axis from a 3 x 3 singular matrix by cross products, so no
matrix is decomposed. The axis is lost as the rotation tends to none; a reference frame turned by 180 deg
about one of its axes first (sequential rotation) keeps it large: of the four possible frames that with the
least trace of the profile matrix, where the rotation angle is at least 120 deg.

References: Mortari, ESOQ-2 single-point algorithm, Advances in the Astronautical Sciences 95 (1997); Markley
and Mortari, Quaternion attitude estimation using vector observations, J. Astronautical Sciences 48 (2000).
"""

from __future__ import annotations

import numpy as np

from flight.arrays import FloatArray
from flight.attitude.wahba import AttitudeFix, fix, profile_matrix, refuse_unobservable
from flight.quaternion import multiply, normalise

_MOST_STEPS = 100


def solve(observed: FloatArray, reference: FloatArray, sigma: FloatArray) -> AttitudeFix:
    """Return the attitude that best turns `reference` into `observed` (n, 3), errors `sigma` (n,) rad.

    Raises AttitudeError when fewer than two distinct directions are left to fix it.
    """
    refuse_unobservable(observed, reference, sigma)
    weights = 1.0 / sigma**2
    profile = profile_matrix(observed, reference, weights / weights.sum())
    return fix(optimal_quaternion(profile), observed, reference, sigma)


def optimal_quaternion(profile: FloatArray) -> FloatArray:
    """Return the optimal quaternion (4,) of an attitude profile matrix (3, 3) whose weights sum to one."""
    turn = _sequential_rotation(profile)
    # A(turn) is diagonal and its own inverse: the turned frame's references are A(turn) r.
    turned = profile * _SIGNS[turn]
    quaternion = _from_axis(turned, largest_eigenvalue(turned))
    # The polynomial leaves the eigenvalue with an error of rounding over the product of the gaps, which two
    # close directions make large; the quotient's is the square of the quaternion's.
    quotient = quaternion @ davenport_matrix(turned) @ quaternion
    return multiply(_from_axis(turned, float(quotient)), _TURNS[turn])


def davenport_matrix(profile: FloatArray) -> FloatArray:
    """Return Davenport's K (4, 4) of a profile matrix, scalar last."""
    trace = np.trace(profile)
    k = np.empty((4, 4))
    k[:3, :3] = profile + profile.T - trace * np.eye(3)
    k[:3, 3] = k[3, :3] = _skew_part(profile)
    k[3, 3] = trace
    return k


def largest_eigenvalue(profile: FloatArray) -> float:
    """Return the largest root of K's characteristic polynomial, l^4 + b l^2 + c l + d.

    Newton's method from 1, the sum of the weights: no root is larger, and beyond the largest the polynomial
    is convex, so the steps go down to it and never past; the first that does not go down is rounding.
    """
    k = davenport_matrix(profile)
    b = -2.0 * np.sum(profile**2)
    c = -8.0 * np.linalg.det(profile)
    d = np.linalg.det(k)
    root = 1.0
    for _ in range(_MOST_STEPS):
        slope = (4.0 * root**2 + 2.0 * b) * root + c
        step = (((root**2 + b) * root + c) * root + d) / slope if slope > 0.0 else 0.0
        if root - step >= root:
            break
        root -= step
    return float(root)


# No rotation, and half a turn about each axis: the diagonal of its matrix, and its inverse quaternion.
_SIGNS = np.array([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]])
_TURNS = np.array([[0.0, 0.0, 0.0, 1.0], *np.eye(4)[:3]])


def _sequential_rotation(profile: FloatArray) -> int:
    """Return which half turn of the reference leaves the largest rotation: that of the least trace."""
    return int(np.argmin(_SIGNS @ np.diag(profile)))


def _from_axis(profile: FloatArray, eigenvalue: float) -> FloatArray:
    """Return the quaternion (4,) whose axis is the null vector of (t - l)(B + B^T - t - l) - z z^T.

    That is symmetric of rank 2: the cross products of its rows all lie along the axis; the longest is best.
    """
    trace = float(np.trace(profile))
    z = _skew_part(profile)
    s = profile + profile.T - (trace + eigenvalue) * np.eye(3)
    m = (trace - eigenvalue) * s - np.outer(z, z)
    products = np.cross(m[[1, 2, 0]], m[[2, 0, 1]])
    axis = products[np.argmax(np.linalg.norm(products, axis=-1))]
    axis = axis / np.linalg.norm(axis)
    return normalise(np.append((eigenvalue - trace) * axis, z @ axis))


def _skew_part(profile: FloatArray) -> FloatArray:
    """Return z (3,), the sum of w b x r, from the profile matrix."""
    return np.array(
        [
            profile[1, 2] - profile[2, 1],
            profile[2, 0] - profile[0, 2],
            profile[0, 1] - profile[1, 0],
        ]
    )
