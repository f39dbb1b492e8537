"""Solvers of Wahba's problem with a common signature (Michalski, section 3.4).

Most solvers (`PROFILE_METHODS`) compute the optimal quaternion from the attitude profile matrix B (3, 3),
with weights that sum to one. The function `refine` of the module `wahba` corrects the effect of the rounding
errors of B on the quaternion. The default solver is Davenport's q-method, because it has no singularity and
no iteration that can fail, and because LAPACK decomposes a 4 x 4 matrix faster than Python evaluates the
closed-form solutions. If the formula of a solver is singular, the reference frame is first rotated by 180 deg
about one of its axes (sequential rotation). The function `weighted_fit` solves the least-squares problem with
a full covariance matrix per direction.

- Davenport's q-method: Michalski, section 3.4.2, eq. 69-75.

- SVD: Michalski, eq. 80-84, corrected (the determinants occur only once, in the middle), and Markley,
  Attitude determination using vector observations and the singular value decomposition, Journal of the
  Astronautical Sciences 36 (1988).

- QUEST: Michalski, section 3.4.4, eq. 78 and 79, and Shuster and Oh, Three-axis attitude determination from
  vector observations, Journal of Guidance and Control 4 (1981). The Rayleigh quotient avoids the loss of
  accuracy of Newton's method (Cheng and Shuster, Journal of Guidance, Control, and Dynamics 37, 2014).

- ESOQ2: Sease, chapter 3, text at eq. 3.23; Mortari, ESOQ-2 single-point algorithm, Advances in the
  Astronautical Sciences 95 (1997), and Markley and Mortari, Quaternion attitude estimation using vector
  observations, Journal of the Astronautical Sciences 48 (2000).

- FOAM: Michalski, section 3.4.6, and Markley, Attitude determination using vector observations: a fast
  optimal matrix algorithm, Journal of the Astronautical Sciences 41 (1993).

- Predictive filter: In each step the filter chooses the body rate that minimises the weighted residuals of
  the directions predicted to first order (Michalski, section 3.4.1, without a formula; Crassidis and Markley,
  Journal of Guidance, Control, and Dynamics 20, 1997; Park and Crassidis, Navigation 53, 2006). For
  measurements at one time, the steps converge to the solution of Wahba's problem, and the rounding errors of
  B have no effect.

- TRIAD: The attitude follows from the pair of directions whose covariance has the smallest trace, and the
  first direction of the pair is assumed to be exact (Michalski, section 3.4.5; covariance of Shuster and Oh).

- OLAE (optimal linear attitude estimator): The Gibbs vector follows from linear least squares (Sease, eq.
  4.1-4.7). For an observed direction b = A r and the Gibbs (Rodrigues) vector g of A, the equation [s x] g =
  d is exact, where s = b + r and d = b - r. If r are the starts and b the ends of star streaks, A is the
  rotation during the exposure. The mean rate is then the rotation vector divided by the exposure time, with
  the sign convention v' = -omega x v (Sease, eq. 4.8-4.10, corrected). The reference is Mortari, Markley and
  Singla, Optimal linear attitude estimator, Journal of Guidance, Control, and Dynamics 30 (2007).

TRIAD and OLAE do not minimise the loss function of Wahba's problem, whose solution is a statistically
efficient estimate. The difference between the TRIAD or OLAE attitude and the optimal attitude therefore has a
covariance equal to the difference between the covariances of the two attitudes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray, cross_matrices, tangent_basis
from knightcube.astro.attitude.wahba import (
    AttitudeError,
    AttitudeFix,
    Solver,
    adjugate,
    attitude_of_pair,
    best_pair,
    determinant,
    fix,
    half_rotation,
    profile_matrix,
    sightings,
    upright,
)
from knightcube.astro.quaternion import (
    attitude_matrix,
    from_matrix,
    from_rotation_vector,
    multiply,
    normalise,
    to_rotation_vector,
)

_MAXIMUM_STEPS = 100
_MINIMUM_SLOPE = 1e-13
"""Minimum product of the three differences between the largest and another eigenvalue of Davenport's K.

In a narrow field of view, two of the three eigenvalue differences are of the order of one.
"""
_WORST_CONDITION = 1e12
"""Condition number of the normal matrix above which directions do not determine a rotation by OLAE."""


def skew_part(profile: FloatArray) -> FloatArray:
    """Return z (3,), the weighted sum of the cross products b x r, from the profile matrix B.

    The formula is Michalski, eq. 72, in which the second component is corrected to B31 - B13.
    """
    (_, xy, xz), (yx, _, yz), (zx, zy, _) = profile.tolist()
    return np.array([yz - zy, zx - xz, xy - yx])


def davenport_matrix(profile: FloatArray) -> FloatArray:
    """Return Davenport's matrix K (4, 4) for quaternions with the scalar last (Michalski, eq. 69)."""
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


def _characteristic(profile: FloatArray) -> tuple[float, float, float]:
    """Return the coefficients b, c and d of det(K - l) = l^4 + b l^2 + c l + d, as in Markley's FOAM."""
    rows = profile.tolist()
    cofactors = adjugate(rows)
    square, cofactor_square = (sum(x * x for row in matrix for x in row) for matrix in (rows, cofactors))
    return -2.0 * square, -8.0 * determinant(rows, cofactors), square**2 - 4.0 * cofactor_square


def largest_eigenvalue(profile: FloatArray) -> float:
    """Return the largest root of the characteristic polynomial of Davenport's matrix K.

    Newton's method starts from the sum of the weights, 1, which is an upper bound of all roots. The
    polynomial is convex above the largest root, so that the iteration decreases monotonically towards this
    root. Newton's iteration ends when rounding prevents a further decrease.
    """
    b, c, d = _characteristic(profile)
    root = 1.0
    for _ in range(_MAXIMUM_STEPS):
        slope = (4.0 * root**2 + 2.0 * b) * root + c
        step = (((root**2 + b) * root + c) * root + d) / slope if slope > 0.0 else 0.0
        if root - step >= root:
            break
        root -= step
    return root


def _by_eigenvalue(
    profile: FloatArray, quaternion_at: Callable[[FloatArray, float], FloatArray]
) -> FloatArray:
    """Return the optimal quaternion (4,) by a formula that needs the largest eigenvalue of K.

    The function `quaternion_at` returns the quaternion for the profile matrix and the eigenvalue. The error
    of the polynomial's root is the rounding error divided by the product of the eigenvalue differences, and
    is therefore large for two close directions. The eigenvalue is therefore improved by the Rayleigh
    quotient, whose error is quadratic in the error of the quaternion. Raises AttitudeError if the largest
    eigenvalue is double, so that the attitude is undefined.
    """

    def check(root: float) -> None:
        b, c, _ = _characteristic(profile)
        if (4.0 * root**2 + 2.0 * b) * root + c <= _MINIMUM_SLOPE:
            raise AttitudeError("several attitudes fit the directions equally well")

    root = largest_eigenvalue(profile)
    check(root)
    quaternion = quaternion_at(profile, root)
    quotient = float(quaternion @ davenport_matrix(profile) @ quaternion)
    check(quotient)
    return quaternion_at(profile, quotient)


def _in_rotated_frame(
    profile: FloatArray, component: int, quaternion_at: Callable[[FloatArray, float], FloatArray]
) -> FloatArray:
    """Return the quaternion (4,) of `_by_eigenvalue`, computed in a reference frame rotated by 180 deg."""
    signs, rotation = half_rotation(component)
    # The matrix of a rotation by 180 deg about a coordinate axis is diagonal and its own inverse.
    return multiply(_by_eigenvalue(profile * signs, quaternion_at), rotation)


def davenport(profile: FloatArray) -> FloatArray:
    """Return the optimal quaternion (4,) by Davenport's q-method, an eigenvalue decomposition of K."""
    return np.asarray(np.linalg.eigh(davenport_matrix(profile))[1][:, 3])


def singular_values(profile: FloatArray) -> FloatArray:
    """Return the optimal quaternion (4,) by singular value decomposition of the profile matrix B.

    With B = U S V^T, the attitude matrix is A = U diag(1, 1, det U det V) V^T.
    """
    u, _, vt = np.linalg.svd(profile)
    u[:, 2] *= np.linalg.det(u) * np.linalg.det(vt)
    return from_matrix(u @ vt)


def quest(profile: FloatArray) -> FloatArray:
    """Return the optimal quaternion (4,) by QUEST, from the Gibbs vector M^-1 z.

    The matrix is M = l + t - S, with the largest eigenvalue l of K, the trace t of B and S = B + B^T. The
    adjugate of the matrix M is used instead of the inverse, so that a rotation by 180 deg causes no division
    by zero. A small determinant of the matrix M still causes a loss of accuracy. The reference frame is
    therefore rotated by 180 deg such that the determinant is largest and the remaining rotation smallest. The
    determinant of the matrix M is proportional to the square of the quaternion's scalar part. The trace of
    the profile matrix B would be a cheaper criterion, but does not depend on the roll angle in a narrow field
    of view.
    """

    def gibbs_matrix(profile: FloatArray, eigenvalue: float) -> FloatArray:
        return np.asarray((eigenvalue + profile.trace()) * np.eye(3) - profile - profile.T)

    def from_gibbs(profile: FloatArray, eigenvalue: float) -> FloatArray:
        matrix = gibbs_matrix(profile, eigenvalue).tolist()
        cofactors = adjugate(matrix)
        return normalise(np.append(np.array(cofactors) @ skew_part(profile), determinant(matrix, cofactors)))

    root = largest_eigenvalue(profile)
    frames = [half_rotation(component)[0] * profile for component in range(4)]
    largest = int(np.argmax(np.linalg.det([gibbs_matrix(frame, root) for frame in frames])))
    return _in_rotated_frame(profile, largest, from_gibbs)


def esoq2(profile: FloatArray) -> FloatArray:
    """Return the optimal quaternion (4,) by ESOQ2, which computes the rotation axis by cross products.

    The axis is the null vector of the symmetric matrix (t - l)(B + B^T - t - l) - z z^T of rank 2, with the
    largest eigenvalue l of K and the trace t of B. The cross products of the matrix rows are parallel to the
    axis, and the longest cross product is the most accurate. The axis is undefined for small rotations. The
    reference frame is therefore rotated by 180 deg such that the trace of the profile matrix B is smallest
    and the remaining rotation largest.
    """

    def from_axis(profile: FloatArray, eigenvalue: float) -> FloatArray:
        trace = float(profile.trace())
        z = skew_part(profile)
        s = profile + profile.T - (trace + eigenvalue) * np.eye(3)
        products = np.array(adjugate(((trace - eigenvalue) * s - np.outer(z, z)).tolist()))
        axis = products[np.argmax(np.abs(products.diagonal()))]
        axis = axis / np.linalg.norm(axis)
        return normalise(np.append((eigenvalue - trace) * axis, z @ axis))

    traces = np.array([half_rotation(component)[0] for component in range(4)]) @ profile.diagonal()
    return _in_rotated_frame(profile, int(traces.argmin()), from_axis)


def foam(profile: FloatArray) -> FloatArray:
    """Return the optimal quaternion (4,) by FOAM, which has no singularity.

    The attitude matrix is [(k + |B|^2) B + l adj(B)^T - B B^T B] / (k l - det B), with the profile matrix B,
    the largest eigenvalue l of K and k = (l^2 - |B|^2)/2.
    """

    def from_attitude_matrix(profile: FloatArray, eigenvalue: float) -> FloatArray:
        rows = profile.tolist()
        cofactors = adjugate(rows)
        square = float(np.vdot(profile, profile))
        kappa = 0.5 * (eigenvalue**2 - square)
        matrix = (
            (kappa + square) * profile + eigenvalue * np.array(cofactors).T - profile @ profile.T @ profile
        )
        return from_matrix(matrix / (kappa * eigenvalue - determinant(rows, cofactors)))

    return _by_eigenvalue(profile, from_attitude_matrix)


def predictive(observed: FloatArray, reference: FloatArray, sigma: FloatArray) -> AttitudeFix:
    """Return the optimal attitude by the predictive filter, starting from the TRIAD attitude.

    The arguments and exceptions are those of `Solver`.
    """
    seen = sightings(observed, reference, sigma)
    return fix(seen, attitude_of_pair(seen, *best_pair(seen, sigma)))


def triad(observed: FloatArray, reference: FloatArray, sigma: FloatArray) -> AttitudeFix:
    """Return the TRIAD attitude of the best pair of directions, with Wahba's loss summed over all directions.

    The arguments and exceptions are those of `Solver`.
    """
    seen = sightings(observed, reference, sigma)
    first, second = best_pair(seen, sigma)
    quaternion = upright(attitude_of_pair(seen, first, second))
    anchor, other = observed[first], observed[second]
    variance, other_variance = float(sigma[first]) ** 2, float(sigma[second]) ** 2
    normal, cosine = np.cross(anchor, other), anchor @ other
    mixed = np.outer(anchor, other)
    along = (other_variance - variance) * np.outer(anchor, anchor)
    covariance = np.asarray(
        variance * np.eye(3) + (along + variance * cosine * (mixed + mixed.T)) / (normal @ normal)
    )
    return AttitudeFix(quaternion, covariance, seen.loss(quaternion))


@dataclass(frozen=True, slots=True)
class OlaeSolution:
    """Rotation estimated by OLAE.

    Attributes:
        rodrigues: (3,) Gibbs vector g: rotation axis times the tangent of half the angle (Sease, eq. 4.4).
        quaternion: (4,) quaternion whose attitude matrix rotates starts into ends (Sease, eq. 4.5 and 4.6).
        residuals: (n, 3) residuals [s x] g - d of the pairs of directions, with d = b - r (Sease, eq. 4.7).
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
    """Return the least-squares rotation from unit vectors `starts` to `ends` (n, 3) (Sease, eq. 4.1-4.7).

    Raises numpy.linalg.LinAlgError if the directions do not determine a rotation.
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


def olae(observed: FloatArray, reference: FloatArray, sigma: FloatArray) -> AttitudeFix:
    """Return the OLAE attitude, with the covariance of the OLAE estimate.

    The reference frame is first rotated by 180 deg. The axis is chosen from the TRIAD attitude so that the
    remaining rotation angle is at most 120 deg and |g| at most 1.74. An error e of the observed direction b
    enters the equation as (1 + [g x]) e, which is larger than e by a factor of up to sqrt(1 + g^2) and
    anisotropic. The weights 1/sigma^2 are therefore not optimal, and the OLAE attitude differs from the
    solution of Wahba's problem by an angle of the order of the noise. The arguments and exceptions are those
    of `Solver`.
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


PROFILE_METHODS: dict[str, Callable[[FloatArray], FloatArray]] = {
    "davenport": davenport,
    "esoq2": esoq2,
    "foam": foam,
    "quest": quest,
    "svd": singular_values,
}
"""Functions, by name, that return the optimal quaternion (4,) for an attitude profile matrix (3, 3)."""


def _profile_solver(method: Callable[[FloatArray], FloatArray]) -> Solver:
    def solve(observed: FloatArray, reference: FloatArray, sigma: FloatArray) -> AttitudeFix:
        seen = sightings(observed, reference, sigma)
        return fix(seen, method(seen.profile))

    return solve


SOLVERS: dict[str, Solver] = {
    **{name: _profile_solver(method) for name, method in PROFILE_METHODS.items()},
    "olae": olae,
    "predictive": predictive,
    "triad": triad,
}
OPTIMAL = frozenset(SOLVERS) - {"olae", "triad"}
DEFAULT = "davenport"


def solve(observed: FloatArray, reference: FloatArray, sigma: FloatArray) -> AttitudeFix:
    """Return the attitude by the default solver. The arguments and exceptions are those of `Solver`."""
    return SOLVERS[DEFAULT](observed, reference, sigma)


@dataclass(frozen=True, slots=True, eq=False)
class VectorObservation:
    """Observation of one direction with a full covariance matrix.

    Attributes:
        observed: (3,) observed unit vector in body axes.
        reference: (3,) reference unit vector in inertial axes.
        covariance: (3, 3) covariance of `observed`, body axes, rad^2; only the part across the direction is
            used.
    """

    observed: FloatArray
    reference: FloatArray
    covariance: FloatArray

    @property
    def sigma(self) -> float:
        """RMS standard deviation per axis perpendicular to the direction, rad."""
        along = float(self.observed @ self.covariance @ self.observed)
        return float(np.sqrt(0.5 * (np.trace(self.covariance) - along)))


def field_observation(field: FloatArray, reference: FloatArray, covariance: FloatArray) -> VectorObservation:
    """Return the direction observation of a measured magnetic field (3,), body axes, T.

    The covariance (3, 3), T^2, includes the magnetometer bias. The field `reference` (3,), T, is the field of
    the model in inertial axes. Raises AttitudeError if the error of the field's direction exceeds one radian.
    """
    strength = float(np.linalg.norm(reference))
    if not float(np.sqrt(np.trace(covariance))) < strength:
        raise AttitudeError(f"a field of {strength:.2e} T is too weak to give a direction")
    return VectorObservation(
        field / np.linalg.norm(field), reference / strength, np.asarray(covariance / strength**2)
    )


def weighted_fit(observations: Sequence[VectorObservation]) -> AttitudeFix:
    """Return the least-squares attitude of directions with full covariance matrices.

    Gauss-Newton iterations start from the QUEST attitude. Twice the loss has a chi-square distribution with
    2n - 3 degrees of freedom for n directions. Raises AttitudeError if the attitude is not determined.
    """
    observed, reference = (
        np.array([getattr(o, name) for o in observations]) for name in ("observed", "reference")
    )
    quaternion = SOLVERS["quest"](observed, reference, np.array([o.sigma for o in observations])).quaternion
    for _ in range(20):
        information, moment, _ = _normal_equations(quaternion, observations)
        step = np.asarray(np.linalg.solve(information, moment), dtype=float)
        quaternion = normalise(multiply(from_rotation_vector(step), quaternion))
        if float(step @ step) < 1e-9**2:  # convergence limit (rad); the convergence is nearly quadratic
            break
    information, _, loss = _normal_equations(quaternion, observations)
    return AttitudeFix(quaternion, np.asarray(np.linalg.inv(information), dtype=float), loss)


def _normal_equations(
    quaternion: FloatArray, observations: Sequence[VectorObservation]
) -> tuple[FloatArray, FloatArray, float]:
    """Return the information matrix (3, 3) for small rotations, the right-hand side (3,) and the loss."""
    information, moment, loss = np.zeros((3, 3)), np.zeros(3), 0.0
    matrix = attitude_matrix(quaternion)
    for observation in observations:
        expected = matrix @ observation.reference
        across = tangent_basis(expected.tolist())
        weight = np.linalg.inv(across @ observation.covariance @ across.T)
        # A further small rotation e of the body changes the direction A r to A r + [A r x] e.
        rows = across @ cross_matrices(expected[None])[0]
        residual = across @ (observation.observed - expected)
        information += rows.T @ weight @ rows
        moment += rows.T @ weight @ residual
        loss += 0.5 * float(residual @ weight @ residual)
    return information, moment, loss
