"""Optimal Linear Attitude Estimator: the rotation between two sets of directions (Sease 4.1-4.7).

With b = A r and the Rodrigues vector g of A, d = [s x] g exactly, where s = b + r and d = b - r: linear least
squares, no iteration. With r the starts and b the ends of streaks, A is the body's change of attitude, so the
mean rate is the rotation vector over the exposure, with the sign of v' = -omega x v (4.8-4.10 corrected).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flight.gnc.math.arrays import FloatArray
from flight.gnc.math.quaternion import normalise, to_rotation_vector


@dataclass(frozen=True, slots=True)
class OlaeSolution:
    """The estimated rotation.

    Attributes:
        rodrigues: (3,) axis times tan of half the angle, g of 4.4.
        quaternion: (4,) A(q) turns `starts` into `ends` (4.5, 4.6).
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


def cross_matrices(vectors: FloatArray) -> FloatArray:
    """Return [v x] (n, 3, 3) of vectors (n, 3)."""
    matrices = np.zeros((len(vectors), 3, 3))
    x, y, z = vectors.T
    matrices[:, 0, 1], matrices[:, 0, 2], matrices[:, 1, 2] = -z, y, -x
    matrices[:, 1, 0], matrices[:, 2, 0], matrices[:, 2, 1] = z, -y, x
    return matrices


def solve(starts: FloatArray, ends: FloatArray, weights: FloatArray) -> OlaeSolution:
    """Return the rotation that best turns `starts` into `ends` (n, 3), with weights (n,): 4.1-4.7.

    Raises numpy.linalg.LinAlgError when the directions do not fix a rotation (fewer than two distinct ones).
    """
    sums, differences = ends + starts, ends - starts
    cross = cross_matrices(sums)
    weighted = cross * weights[:, None, None]
    normal = np.einsum("nji,njk->ik", weighted, cross)
    if np.linalg.cond(normal) > 1e12:
        raise np.linalg.LinAlgError("the directions do not fix a rotation")
    rodrigues = np.linalg.solve(normal, np.einsum("nji,nj->i", weighted, differences))
    residuals = np.einsum("nij,j->ni", cross, rodrigues) - differences
    quaternion = normalise(np.append(rodrigues, 1.0))
    return OlaeSolution(rodrigues, quaternion, residuals, sums, normal)


def gain(solution: OlaeSolution, weights: FloatArray) -> FloatArray:
    """Return the matrices (n, 3, 3) by which an error of each d moves the rotation vector."""
    cross = cross_matrices(solution.sums)
    inverse = np.linalg.inv(solution.normal)
    turned = np.swapaxes(cross, 1, 2) * weights[:, None, None]
    return np.asarray(np.einsum("ij,jk,nkl->nil", solution.jacobian(), inverse, turned))
