"""ESOQ2, Mortari's Second Estimator of the Optimal Quaternion (Sease chapter 3, text at 3.23).

Davenport's K has the optimal quaternion as eigenvector of its largest eigenvalue. ESOQ2 takes that eigenvalue
from the characteristic polynomial and the rotation axis from a 3 x 3 singular matrix by cross products, so no
matrix is decomposed. The axis becomes undefined for small rotations: the reference frame is first turned by
the half turn that gives B the least trace, and so leaves the largest rotation (sequential rotation).

References: Mortari, ESOQ-2 single-point algorithm, Advances in the Astronautical Sciences 95 (1997); Markley
and Mortari, Quaternion attitude estimation using vector observations, J. Astronautical Sciences 48 (2000).
"""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.attitude.adjugate import adjugate
from knightcube.astro.attitude.profile import by_eigenvalue, in_turned_frame, skew_part, traces
from knightcube.astro.attitude.wahba import optimal_solver
from knightcube.astro.quaternion import normalise


def optimal_quaternion(profile: FloatArray) -> FloatArray:
    """Return the optimal quaternion (4,) of an attitude profile matrix (3, 3) whose weights sum to one."""
    widest = int(traces(profile).argmin())
    return in_turned_frame(profile, lambda turned: by_eigenvalue(turned, _from_axis), widest)


solve = optimal_solver(optimal_quaternion)
"""Return the attitude by this method: a `knightcube.astro.attitude.wahba.Solver`."""


def _from_axis(profile: FloatArray, eigenvalue: float) -> FloatArray:
    """Return the quaternion (4,) whose axis is the null vector of (t - l)(B + B^T - t - l) - z z^T.

    That matrix is symmetric of rank 2: the cross products of its rows, the rows of its adjugate, all lie
    along the axis; the longest is the most precise.
    """
    trace = float(profile.trace())
    z = skew_part(profile)
    s = profile + profile.T - (trace + eigenvalue) * np.eye(3)
    products = np.array(adjugate(((trace - eigenvalue) * s - np.outer(z, z)).tolist()))
    axis = products[np.argmax(np.abs(products.diagonal()))]
    axis = axis / np.linalg.norm(axis)
    return normalise(np.append((eigenvalue - trace) * axis, z @ axis))
