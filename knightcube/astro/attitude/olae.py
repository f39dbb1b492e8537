"""OLAE, the Optimal Linear Attitude Estimator: linear least squares for the Gibbs vector (Sease 4.1-4.7).

With b = A r and g the Gibbs (Rodrigues) vector of A, [s x] g = d exactly, where s = b + r and d = b - r.
`rotation_between` solves these equations; with r the starts and b the ends of streaks, A is the change of
attitude over the exposure, and the mean rate is the rotation vector over the exposure, with the sign of
v' = -omega x v (4.8-4.10 corrected).

`solve` gives an attitude of any size: sequential rotation, started from TRIAD, keeps the angle at 120 deg or
less, |g| below 1.74. An error e of b enters the equation as (1 + [g x]) e, larger than e by up to the root of
1 + g^2 and different in each direction, so that the weights 1/sigma^2 are not the best ones. The result
therefore differs from Wahba's by an amount of the order of the noise; the covariance is that of OLAE.

Reference: Mortari, Markley and Singla, Optimal linear attitude estimator, J. Guidance, Control, and Dynamics
30 (2007).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray, cross_matrices
from knightcube.astro.attitude.wahba import (
    AttitudeError,
    AttitudeFix,
    attitude_of_pair,
    best_pair,
    half_rotation,
    profile_matrix,
    sightings,
    upright,
)
from knightcube.astro.quaternion import multiply, normalise, to_rotation_vector

_WORST_CONDITION = 1e12


@dataclass(frozen=True, slots=True)
class OlaeSolution:
    """The estimated rotation.

    Attributes:
        rodrigues: (3,) axis times tan of half the angle, g of 4.4.
        quaternion: (4,) A(q) rotates `starts` into `ends` (4.5, 4.6).
        residuals: (n, 3) [s x] g - d, of each pair; their lengths are 4.7.
        sums: (n, 3) s = b + r of 4.1.
        normal: (3, 3) sum of w [s x]^T [s x], minus twice the printed M of 4.3.
    """

    rodrigues: FloatArray
    quaternion: FloatArray
    residuals: FloatArray
    sums: FloatArray
    normal: FloatArray

    @property
    def rotation_vector(self) -> FloatArray:
        """The rotation as axis times angle (3,), rad."""
        return to_rotation_vector(self.quaternion)

    def jacobian(self) -> FloatArray:
        """Return d(rotation vector)/d(Rodrigues vector), (3, 3)."""
        tangent = float(np.linalg.norm(self.rodrigues))
        if tangent < 1e-12:
            return 2.0 * np.eye(3)
        axis = self.rodrigues / tangent
        along = np.outer(axis, axis)
        return np.asarray(
            2.0 / (1.0 + tangent**2) * along + 2.0 * np.arctan(tangent) / tangent * (np.eye(3) - along)
        )


def rotation_between(starts: FloatArray, ends: FloatArray, weights: FloatArray) -> OlaeSolution:
    """Return the rotation that best takes `starts` to `ends` (n, 3), with weights (n,): 4.1-4.7.

    Raises numpy.linalg.LinAlgError when the directions do not fix a rotation (fewer than two distinct ones).
    """
    sums, differences = ends + starts, ends - starts
    cross = cross_matrices(sums)
    weighted = cross * weights[:, None, None]
    normal = np.einsum("nji,njk->ik", weighted, cross)
    if np.linalg.cond(normal) > _WORST_CONDITION:
        raise np.linalg.LinAlgError("the directions do not fix a rotation")
    rodrigues = np.linalg.solve(normal, np.einsum("nji,nj->i", weighted, differences))
    residuals = np.einsum("nij,j->ni", cross, rodrigues) - differences
    quaternion = normalise(np.append(rodrigues, 1.0))
    return OlaeSolution(rodrigues, quaternion, residuals, sums, normal)


def gain(solution: OlaeSolution, weights: FloatArray) -> FloatArray:
    """Return the matrices (n, 3, 3) from the error of each d to the error of the rotation vector."""
    cross = cross_matrices(solution.sums)
    inverse = np.linalg.inv(solution.normal)
    transposed = np.swapaxes(cross, 1, 2) * weights[:, None, None]
    return np.asarray(np.einsum("ij,jk,nkl->nil", solution.jacobian(), inverse, transposed))


def solve(observed: FloatArray, reference: FloatArray, sigma: FloatArray) -> AttitudeFix:
    """Return the attitude that rotates `reference` into `observed` (n, 3), errors `sigma` (n,) rad.

    Raises AttitudeError when the directions fix no attitude.
    """
    seen = sightings(observed, reference, sigma)
    rough = attitude_of_pair(seen, *best_pair(seen, sigma))
    signs, rotation = half_rotation(int(np.argmax(np.abs(rough))))
    try:
        found = rotation_between(reference * signs, observed, seen.weight)
    except np.linalg.LinAlgError as error:
        raise AttitudeError(f"no attitude: {error}") from error
    inverse = np.asarray(np.linalg.inv(found.normal), dtype=np.float64)
    # Forming the normal equations costs digits; one step from the equations' own residuals restores them.
    gibbs = found.rodrigues - inverse @ (seen.weight @ np.cross(found.residuals, found.sums))
    quaternion = upright(multiply(normalise(np.append(gibbs, 1.0)), rotation))
    # Each error e enters as (1 + [g x]) e, and has no part along its direction. The normal equations make a
    # change dg of it, a small rotation of 2 (1 - [g x]) dg/(1 + g^2).
    square = 1.0 + gibbs @ gibbs
    across = np.cross(found.sums, gibbs)
    along = np.cross(found.sums, observed + np.cross(gibbs, observed))
    spread = (
        square * found.normal
        - profile_matrix(across, across, seen.weight)
        - profile_matrix(along, along, seen.weight)
    )
    by_error = 2.0 / square * (np.eye(3) - np.cross(gibbs, np.eye(3)).T) @ inverse
    covariance = np.asarray(by_error @ spread @ by_error.T / seen.total)
    return AttitudeFix(quaternion, covariance, seen.loss(quaternion))
