"""The attitude (direction cosine) matrix by singular values of B (Michalski 80-84 corrected).

A = U diag(1, 1, det U det V) V^T: the determinants appear once, in the middle, so that A is a rotation.

Reference: Markley, Attitude determination using vector observations and the singular value decomposition,
J. Astronautical Sciences 36 (1988).
"""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.attitude.wahba import optimal_solver
from knightcube.astro.quaternion import from_matrix


def optimal_quaternion(profile: FloatArray) -> FloatArray:
    """Return the optimal quaternion (4,) of an attitude profile matrix (3, 3)."""
    u, _, vt = np.linalg.svd(profile)
    u[:, 2] *= np.linalg.det(u) * np.linalg.det(vt)
    return from_matrix(u @ vt)


solve = optimal_solver(optimal_quaternion)
"""Return the attitude by this method: a `knightcube.astro.attitude.wahba.Solver`."""
