"""Davenport's q-method: the eigenvector of K's largest eigenvalue, by decomposition (Michalski 3.4.2).

No angle is singular and no iteration can fail. LAPACK decomposes a 4 x 4 matrix faster than the closed forms
run in an interpreter, so this most robust solver is also the fastest here, and the default.
"""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.attitude.profile import davenport_matrix
from knightcube.astro.attitude.wahba import optimal_solver


def optimal_quaternion(profile: FloatArray) -> FloatArray:
    """Return the optimal quaternion (4,) of an attitude profile matrix (3, 3)."""
    return np.asarray(np.linalg.eigh(davenport_matrix(profile))[1][:, 3])


solve = optimal_solver(optimal_quaternion)
"""Return the attitude by this method: a `knightcube.astro.attitude.wahba.Solver`."""
