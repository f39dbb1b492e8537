"""FOAM, Markley's Fast Optimal Attitude Matrix (Michalski 3.4.6).

Computes the attitude matrix from B, its adjugate and the characteristic polynomial's largest root; no angle
is singular.

Reference: Markley, Attitude determination using vector observations: a fast optimal matrix algorithm,
J. Astronautical Sciences 41 (1993).
"""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.attitude.adjugate import adjugate, determinant
from knightcube.astro.attitude.profile import by_eigenvalue
from knightcube.astro.attitude.wahba import optimal_solver
from knightcube.astro.quaternion import from_matrix


def optimal_quaternion(profile: FloatArray) -> FloatArray:
    """Return the optimal quaternion (4,) of an attitude profile matrix (3, 3) whose weights sum to one."""
    return by_eigenvalue(profile, _from_attitude_matrix)


solve = optimal_solver(optimal_quaternion)
"""Return the attitude by this method: a `knightcube.astro.attitude.wahba.Solver`."""


def _from_attitude_matrix(profile: FloatArray, eigenvalue: float) -> FloatArray:
    """Return the quaternion (4,) of [(k + |B|^2) B + l adj(B)^T - B B^T B] / (k l - det B).

    k = (l^2 - |B|^2)/2.
    """
    rows = profile.tolist()
    cofactors = adjugate(rows)
    square = float(np.vdot(profile, profile))
    kappa = 0.5 * (eigenvalue**2 - square)
    matrix = (kappa + square) * profile + eigenvalue * np.array(cofactors).T - profile @ profile.T @ profile
    return from_matrix(matrix / (kappa * eigenvalue - determinant(rows, cofactors)))
