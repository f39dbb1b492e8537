"""Functions of the attitude profile matrix B (3, 3), with weights of sum one, that solvers share.

Davenport's K, whose eigenvector of largest eigenvalue is the optimal quaternion (Michalski 69-75), that
eigenvalue from the characteristic polynomial, and the reference frame turned by 180 deg about one of its axes
where a solver's formula is singular (sequential rotation).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.attitude.adjugate import adjugate, determinant
from knightcube.astro.attitude.wahba import AttitudeError
from knightcube.astro.quaternion import multiply

_MOST_STEPS = 100
# The product of the largest eigenvalue's gaps, of which two are of the order of one in a narrow field.
_LEAST_SLOPE = 1e-13
# Half a turn about each axis, and the identity: the diagonal of the matrix, and the quaternion.
_SIGNS = np.array([[1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0], [1.0, 1.0, 1.0]])
_TURNS = np.eye(4)


def skew_part(profile: FloatArray) -> FloatArray:
    """Return z (3,), the sum of w b x r (Michalski 72 corrected: its second component is B31 - B13)."""
    (_, xy, xz), (yx, _, yz), (zx, zy, _) = profile.tolist()
    return np.array([yz - zy, zx - xz, xy - yx])


def davenport_matrix(profile: FloatArray) -> FloatArray:
    """Return Davenport's K (4, 4), scalar last (Michalski 69)."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = profile.tolist()
    s, t, u = xy + yx, xz + zx, yz + zy
    p, q, r = yz - zy, zx - xz, xy - yx
    return np.array(
        [
            [xx - yy - zz, s, t, p],
            [s, yy - xx - zz, u, q],
            [t, u, zz - xx - yy, r],
            [p, q, r, xx + yy + zz],
        ]
    )


def largest_eigenvalue(profile: FloatArray) -> float:
    """Return the largest root of K's characteristic polynomial, l^4 + b l^2 + c l + d.

    Newton's method from 1, the sum of the weights: no root is larger, and beyond the largest the polynomial
    is convex, so the steps descend to the root without passing it; the first that does not descend is
    rounding.
    """
    b, c, d = _characteristic(profile)
    root = 1.0
    for _ in range(_MOST_STEPS):
        slope = (4.0 * root**2 + 2.0 * b) * root + c
        step = (((root**2 + b) * root + c) * root + d) / slope if slope > 0.0 else 0.0
        if root - step >= root:
            break
        root -= step
    return root


def by_eigenvalue(
    profile: FloatArray, quaternion_at: Callable[[FloatArray, float], FloatArray]
) -> FloatArray:
    """Return the optimal quaternion (4,) by a solver's formula of profile and largest eigenvalue.

    The polynomial gives the eigenvalue with an error of rounding over the product of the gaps, large for two
    close directions; the Rayleigh quotient has the square of the quaternion's error. Raises AttitudeError
    where the largest eigenvalue is double and the attitude undefined.
    """
    root = largest_eigenvalue(profile)
    _check_single(profile, root)
    quaternion = quaternion_at(profile, root)
    quotient = float(quaternion @ davenport_matrix(profile) @ quaternion)
    _check_single(profile, quotient)
    return quaternion_at(profile, quotient)


def _characteristic(profile: FloatArray) -> tuple[float, float, float]:
    """Return b, c and d of K's characteristic polynomial; K has no trace, and d is Markley's, of FOAM."""
    rows = profile.tolist()
    cofactors = adjugate(rows)
    square = _square(rows)
    return -2.0 * square, -8.0 * determinant(rows, cofactors), square**2 - 4.0 * _square(cofactors)


def _check_single(profile: FloatArray, root: float) -> None:
    """Raise AttitudeError where the polynomial's slope at its largest root is within rounding."""
    b, c, _ = _characteristic(profile)
    if (4.0 * root**2 + 2.0 * b) * root + c <= _LEAST_SLOPE:
        raise AttitudeError("the directions fit several attitudes equally well: they share none")


def half_turn(component: int) -> tuple[FloatArray, FloatArray]:
    """Return the signs (3,) of half a turn's diagonal matrix, and its quaternion (4,).

    About axis 0, 1 or 2, or for 3 the identity. The turn moves that component of a quaternion into the scalar
    part: if it is the largest, at most 120 deg of rotation remain.
    """
    return _SIGNS[component], _TURNS[component]


def in_turned_frame(
    profile: FloatArray, solve: Callable[[FloatArray], FloatArray], component: int
) -> FloatArray:
    """Return a solver's quaternion (4,), found in the reference frame after a half turn."""
    signs, turn = half_turn(component)
    # The turn's matrix is diagonal and its own inverse.
    return multiply(solve(profile * signs), turn)


def traces(profile: FloatArray) -> FloatArray:
    """Return the traces (4,) of the profile matrix in the frame after each half turn."""
    return np.asarray(_SIGNS @ profile.diagonal())


def _square(rows: list[list[float]]) -> float:
    """Return the sum of a matrix's squared elements."""
    return sum(x * x for row in rows for x in row)
