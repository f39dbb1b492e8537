"""QUEST: the Gibbs vector from the characteristic polynomial's largest root (Michalski 3.4.4, 78, 79).

The Cayley-Hamilton theorem gives the adjugate that solves [(l + t) - S] y = z without a division, so 180 deg
gives no infinity; there the quaternion still loses digits with det M, so the reference frame is first turned
by the half turn that leaves the smallest rotation (sequential rotation).

Reference: Shuster and Oh, Three-axis attitude determination from vector observations, J. Guidance and Control
4 (1981); Cheng and Shuster, Improvement to the implementation of the QUEST algorithm, J. Guidance, Control,
and Dynamics 37 (2014), on the digits that Newton's root loses; here the quotient of `by_eigenvalue` recovers
them.
"""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.attitude.adjugate import adjugate, determinant
from knightcube.astro.attitude.profile import (
    by_eigenvalue,
    half_turn,
    in_turned_frame,
    largest_eigenvalue,
    skew_part,
)
from knightcube.astro.attitude.wahba import optimal_solver
from knightcube.astro.quaternion import normalise


def optimal_quaternion(profile: FloatArray) -> FloatArray:
    """Return the optimal quaternion (4,) of an attitude profile matrix (3, 3) whose weights sum to one."""
    largest = _largest_component(profile, largest_eigenvalue(profile))
    return in_turned_frame(profile, lambda turned: by_eigenvalue(turned, _from_gibbs), largest)


solve = optimal_solver(optimal_quaternion)
"""Return the attitude by this method: a `knightcube.astro.attitude.wahba.Solver`."""


def _largest_component(profile: FloatArray, eigenvalue: float) -> int:
    """Return which component of the optimal quaternion is the largest.

    det M is the scalar part's square times the eigenvalue's gaps, and after each half turn that of another
    component. B's trace is cheaper but does not contain the roll in a narrow field.
    """
    frames = [half_turn(component)[0] * profile for component in range(4)]
    return int(np.argmax(np.linalg.det([_gibbs_matrix(frame, eigenvalue) for frame in frames])))


def _from_gibbs(profile: FloatArray, eigenvalue: float) -> FloatArray:
    """Return the quaternion (4,) along (adj(M) z, det M): the Gibbs vector is M^-1 z."""
    matrix = _gibbs_matrix(profile, eigenvalue).tolist()
    cofactors = adjugate(matrix)
    return normalise(np.append(np.array(cofactors) @ skew_part(profile), determinant(matrix, cofactors)))


def _gibbs_matrix(profile: FloatArray, eigenvalue: float) -> FloatArray:
    """Return M = l + t - S (3, 3)."""
    return np.asarray((eigenvalue + profile.trace()) * np.eye(3) - profile - profile.T)
