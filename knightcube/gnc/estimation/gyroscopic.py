"""The torque-free angular acceleration of a rigid body, and how uncertain it is while the inertia is.

Euler's equation J w' = J w x w makes the acceleration a quadratic form of the rate: w' = Q p(w), with the six
products p of the rate's components. Errors of the inertia tensor, and of the gyro's scale and alignment, only
change the coefficients Q. A fit that takes the changes of Q as nuisance parameters is therefore not misled by
them (Psiaki 2005, JGCD 28(4); Pittelkau 2001, JGCD 24(6)).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.directions import cross_matrices
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector

_FIRST, _SECOND = (0, 1, 2, 1, 2, 0), (0, 1, 2, 2, 0, 1)
"""Axes of the six products: xx, yy, zz, yz, zx, xy."""
_DRAWS = 2000
"""Random bodies that give the covariance of Q; with 1000 and 4000 the six largest modes agree within 5 %."""
_NEGLIGIBLE = 1e-6
"""Share of the largest variance below which a mode is left out."""


@dataclass(frozen=True, slots=True)
class BodyErrors:
    """Largest errors of a body's description, each drawn uniformly.

    Attributes:
        moments: of the principal moments of inertia, relative.
        axes: of the principal axes, as a rotation about each body axis, rad.
        gyro_scale: of the gyro's scale factors, relative.
        gyro_alignment: of each gyro axis toward each other axis, rad.
    """

    moments: float = 0.1
    axes: float = math.radians(5.0)
    gyro_scale: float = 3e-3
    gyro_alignment: float = 2e-3


def rate_products(rates: FloatArray) -> FloatArray:
    """Return the six products (n, 6) of rates (n, 3): xx, yy, zz, yz, zx, xy."""
    return rates[:, _FIRST] * rates[:, _SECOND]


def gyroscopic_coefficients(inertia: FloatArray) -> FloatArray:
    """Return Q (..., 3, 6), such that Q p(w) is the torque-free acceleration, of tensors (..., 3, 3)."""
    return _folded(_quadratic(inertia))


def coefficient_modes(inertia: FloatArray, errors: BodyErrors) -> FloatArray:
    """Return changes (k, 3, 6) of Q whose sum, with independent weights of variance 1, spans the errors.

    They are the principal components of Q over random bodies about a believed `inertia` (3, 3); tensors that
    violate the triangle inequality are left out. The draws have a fixed seed.
    """
    generator = np.random.default_rng(0)
    moments, axes = np.linalg.eigh(inertia)
    drawn = moments * (1.0 + errors.moments * generator.uniform(-1.0, 1.0, (_DRAWS, 3)))
    drawn = drawn[2.0 * drawn.max(axis=1) < drawn.sum(axis=1)]
    count = len(drawn)
    turns = from_rotation_vector(errors.axes * generator.uniform(-1.0, 1.0, (count, 3)))
    principal = attitude_matrix(turns) @ axes
    tensors = np.einsum("nij,nj,nkj->nik", principal, drawn, principal)
    gyro = errors.gyro_alignment * generator.uniform(-1.0, 1.0, (count, 3, 3))
    gyro[:, range(3), range(3)] = 1.0 + errors.gyro_scale * generator.uniform(-1.0, 1.0, (count, 3))
    back = np.linalg.inv(gyro)
    measured = np.einsum("nil,nlmo,nmj,nok->nijk", gyro, _quadratic(tensors), back, back, optimize=True)
    changes = (_folded(measured) - gyroscopic_coefficients(inertia)).reshape(count, 18)
    variances, vectors = np.linalg.eigh(changes.T @ changes / count)
    kept = variances > _NEGLIGIBLE * variances[-1]
    return np.asarray((vectors[:, kept] * np.sqrt(variances[kept])).T.reshape(-1, 3, 6))


def _quadratic(inertia: FloatArray) -> FloatArray:
    """Return T (..., 3, 3, 3) of tensors (..., 3, 3): the acceleration is w'_i = T_ijk w_j w_k."""
    crosses = cross_matrices(np.eye(3))
    return np.asarray(-np.einsum("...il,jlm,...mk->...ijk", np.linalg.inv(inertia), crosses, inertia))


def _folded(quadratic: FloatArray) -> FloatArray:
    """Return the coefficients (..., 3, 6) of the products, of T (..., 3, 3, 3)."""
    folded = quadratic[..., _FIRST, _SECOND] + quadratic[..., _SECOND, _FIRST]
    folded[..., :3] *= 0.5
    return np.asarray(folded)
