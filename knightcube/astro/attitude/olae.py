"""OLAE (Optimal Linear Attitude Estimator): linear least squares for the Gibbs vector (Sease, eq. 4.1-4.7).

For an observed direction b = A r and the Gibbs (Rodrigues) vector g of A, the equation [s x] g = d is exact,
where s = b + r and d = b - r. The function `rotation_between` solves these equations by least squares. If r
are the starts and b the ends of star streaks, A is the rotation during the exposure. The mean rate is then
the rotation vector divided by the exposure time, with the sign convention v' = -omega x v (Sease, eq.
4.8-4.10, corrected).

The function `solve` computes attitudes with any rotation angle. The reference frame is first rotated by 180
deg about an axis chosen from the TRIAD attitude, which limits the remaining rotation angle to 120 deg and |g|
to 1.74. An error e of the observed direction b enters the equation of OLAE as (1 + [g x]) e, which is larger
than e by a factor of up to sqrt(1 + g^2) and anisotropic. The weights 1/sigma^2 are therefore not optimal.
The OLAE attitude differs from the solution of Wahba's problem by an angle of the order of the noise. The
returned covariance is that of the OLAE attitude.

Reference: Mortari, Markley and Singla, Optimal linear attitude estimator, Journal of Guidance, Control, and
Dynamics 30 (2007).
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
    """Rotation estimated by OLAE.

    Attributes:
        rodrigues: (3,) Gibbs vector g: rotation axis times the tangent of half the angle (Sease, eq. 4.4).
        quaternion: (4,) quaternion whose attitude matrix rotates starts into ends (Sease, eq. 4.5 and 4.6).
        residuals: (n, 3) residuals [s x] g - d of the pairs of directions (Sease, eq. 4.7).
        sums: (n, 3) sums s = b + r of the pairs of directions (Sease, eq. 4.1).
        normal: (3, 3) normal matrix, the sum of w [s x]^T [s x], which is -2 times M in Sease, eq. 4.3.
    """

    rodrigues: FloatArray
    quaternion: FloatArray
    residuals: FloatArray
    sums: FloatArray
    normal: FloatArray

    @property
    def rotation_vector(self) -> FloatArray:
        """Rotation vector (3,): rotation axis times angle, rad."""
        return to_rotation_vector(self.quaternion)

    def jacobian(self) -> FloatArray:
        """Return the derivatives (3, 3) of the rotation vector with respect to the Gibbs vector."""
        tangent = float(np.linalg.norm(self.rodrigues))
        if tangent < 1e-12:
            return 2.0 * np.eye(3)
        axis = self.rodrigues / tangent
        along = np.outer(axis, axis)
        return np.asarray(
            2.0 / (1.0 + tangent**2) * along + 2.0 * np.arctan(tangent) / tangent * (np.eye(3) - along)
        )


def rotation_between(starts: FloatArray, ends: FloatArray, weights: FloatArray) -> OlaeSolution:
    """Return the least-squares rotation between two sets of directions (Sease, eq. 4.1-4.7).

    Raises numpy.linalg.LinAlgError if the directions do not determine a rotation, for example a single
    direction.

    Args:
        starts: (n, 3) unit vectors before the rotation.
        ends: (n, 3) unit vectors after the rotation.
        weights: (n,) weights of the directions.
    """
    sums, differences = ends + starts, ends - starts
    cross = cross_matrices(sums)
    weighted = cross * weights[:, None, None]
    normal = np.einsum("nji,njk->ik", weighted, cross)
    if np.linalg.cond(normal) > _WORST_CONDITION:
        raise np.linalg.LinAlgError("the directions do not determine a rotation")
    rodrigues = np.linalg.solve(normal, np.einsum("nji,nj->i", weighted, differences))
    residuals = np.einsum("nij,j->ni", cross, rodrigues) - differences
    quaternion = normalise(np.append(rodrigues, 1.0))
    return OlaeSolution(rodrigues, quaternion, residuals, sums, normal)


def gain(solution: OlaeSolution, weights: FloatArray) -> FloatArray:
    """Return the derivatives (n, 3, 3) of the rotation vector with respect to each difference d = b - r."""
    cross = cross_matrices(solution.sums)
    inverse = np.linalg.inv(solution.normal)
    transposed = np.swapaxes(cross, 1, 2) * weights[:, None, None]
    return np.asarray(np.einsum("ij,jk,nkl->nil", solution.jacobian(), inverse, transposed))


def solve(observed: FloatArray, reference: FloatArray, sigma: FloatArray) -> AttitudeFix:
    """Return the OLAE attitude that rotates reference directions into observed directions.

    Raises AttitudeError if the directions do not determine an attitude.

    Args:
        observed: (n, 3) observed unit vectors.
        reference: (n, 3) reference unit vectors.
        sigma: (n,) standard deviations of the observed directions, rad.
    """
    seen = sightings(observed, reference, sigma)
    rough = attitude_of_pair(seen, *best_pair(seen, sigma))
    signs, rotation = half_rotation(int(np.argmax(np.abs(rough))))
    try:
        found = rotation_between(reference * signs, observed, seen.weight)
    except np.linalg.LinAlgError as error:
        raise AttitudeError(f"no attitude: {error}") from error
    inverse = np.asarray(np.linalg.inv(found.normal), dtype=np.float64)
    # One iterative refinement step restores the accuracy that the normal equations lose by rounding.
    gibbs = found.rodrigues - inverse @ (seen.weight @ np.cross(found.residuals, found.sums))
    quaternion = upright(multiply(normalise(np.append(gibbs, 1.0)), rotation))
    # An error e of a direction is perpendicular to that direction and enters the equation as (1 + [g x]) e.
    # The change dg of the Gibbs vector is a small rotation of 2 (1 - [g x]) dg/(1 + g^2).
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
