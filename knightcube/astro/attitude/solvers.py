"""Solvers of Wahba's problem, all of one signature, in the table `SOLVERS` (Michalski 3.4).

Most solvers compute the optimal quaternion from the attitude profile matrix B (3, 3), with weights that sum
to one (`PROFILE_METHODS`); `knightcube.astro.attitude.wahba.refine` then recovers the digits that B lost.
Davenport's q-method is the default: no angle is singular, no iteration can fail, and LAPACK decomposes a
4 x 4 matrix faster than the interpreter evaluates the closed forms. Where the formula of a solver is
singular, the reference frame is first rotated by 180 deg about one of its axes (sequential rotation).

`weighted_fit` is the least-squares attitude for whole covariances instead of one sigma per direction.

- Davenport (3.4.2, 69-75), the eigenvector of the largest eigenvalue of K.
- Singular values of B (80-84 corrected: the determinants appear once, in the middle). Markley, Attitude
  determination using vector observations and the singular value decomposition, J. Astronautical Sciences 36
  (1988).
- QUEST (3.4.4, 78, 79). Shuster and Oh, Three-axis attitude determination from vector observations, J.
  Guidance and Control 4 (1981). Cheng and Shuster, J. Guidance, Control, and Dynamics 37 (2014), on the
  digits that the root of Newton's method loses; here the Rayleigh quotient recovers them.
- ESOQ2 (Sease chapter 3, text at 3.23). Mortari, ESOQ-2 single-point algorithm, Advances in the Astronautical
  Sciences 95 (1997); Markley and Mortari, Quaternion attitude estimation using vector observations, J.
  Astronautical Sciences 48 (2000).
- FOAM (3.4.6). Markley, Attitude determination using vector observations: a fast optimal matrix algorithm, J.
  Astronautical Sciences 41 (1993).
- Predictive (3.4.1, named there without a formula). The predictive filter chooses at each step the body rate
  for which the directions predicted to first order leave the smallest weighted residual. With measurements of
  one instant the steps converge to Wahba's optimum. It uses residuals instead of B and loses no digits.
  Crassidis and Markley, J. Guidance, Control, and Dynamics 20 (1997); Park and Crassidis, Navigation 53
  (2006).
- TRIAD (3.4.5), from the pair of directions whose covariance has the smallest trace; the first of the pair is
  assumed exact. The covariance is that of Shuster and Oh. The result does not have the minimum loss.
- OLAE, see `knightcube.astro.attitude.olae`.

The optimal estimate is efficient. The difference of TRIAD's or OLAE's attitude from the optimal one therefore
has the difference of the two covariances.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray, cross_matrices, tangent_basis
from knightcube.astro.attitude import olae
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
    sightings,
    upright,
)
from knightcube.astro.quaternion import (
    attitude_matrix,
    from_matrix,
    from_rotation_vector,
    multiply,
    normalise,
)

_MAXIMUM_STEPS = 100
_MINIMUM_SLOPE = 1e-13
"""Smallest product of the differences of the largest eigenvalue of K from the others. Two of the three are of
the order of one in a narrow field."""


def skew_part(profile: FloatArray) -> FloatArray:
    """Return z (3,), the sum of w b x r (Michalski 72 corrected: its second component is B31 - B13)."""
    (_, xy, xz), (yx, _, yz), (zx, zy, _) = profile.tolist()
    return np.array([yz - zy, zx - xz, xy - yx])


def davenport_matrix(profile: FloatArray) -> FloatArray:
    """Return Davenport's K (4, 4), scalar last (Michalski 69)."""
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
    """Return b, c and d of the characteristic polynomial l^4 + b l^2 + c l + d of K (Markley's FOAM)."""
    rows = profile.tolist()
    cofactors = adjugate(rows)
    square, cofactor_square = (sum(x * x for row in matrix for x in row) for matrix in (rows, cofactors))
    return -2.0 * square, -8.0 * determinant(rows, cofactors), square**2 - 4.0 * cofactor_square


def largest_eigenvalue(profile: FloatArray) -> float:
    """Return the largest root of the characteristic polynomial of K.

    Newton's method starts from 1, the sum of the weights, which no root exceeds. Beyond the largest root the
    polynomial is convex, so that the steps descend to the root without passing it. The first step that does
    not descend is due to rounding.
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
    """Return the optimal quaternion (4,) by a formula of profile and largest eigenvalue.

    The error of the polynomial's root is the rounding error over the product of the eigenvalue differences,
    large for two close directions. The Rayleigh quotient has the square of the quaternion's error. Raises
    AttitudeError if the largest eigenvalue is double and the attitude undefined.
    """

    def check(root: float) -> None:
        b, c, _ = _characteristic(profile)
        if (4.0 * root**2 + 2.0 * b) * root + c <= _MINIMUM_SLOPE:
            raise AttitudeError("the directions fit several attitudes equally well: they determine none")

    root = largest_eigenvalue(profile)
    check(root)
    quaternion = quaternion_at(profile, root)
    quotient = float(quaternion @ davenport_matrix(profile) @ quaternion)
    check(quotient)
    return quaternion_at(profile, quotient)


def _in_rotated_frame(
    profile: FloatArray, component: int, quaternion_at: Callable[[FloatArray, float], FloatArray]
) -> FloatArray:
    """Return the quaternion (4,) of `_by_eigenvalue`, found in the reference frame after a half rotation."""
    signs, rotation = half_rotation(component)
    # The matrix of a half rotation is diagonal and its own inverse.
    return multiply(_by_eigenvalue(profile * signs, quaternion_at), rotation)


def davenport(profile: FloatArray) -> FloatArray:
    """Return the optimal quaternion (4,) by decomposition of K."""
    return np.asarray(np.linalg.eigh(davenport_matrix(profile))[1][:, 3])


def singular_values(profile: FloatArray) -> FloatArray:
    """Return the optimal quaternion (4,) of A = U diag(1, 1, det U det V) V^T, B = U S V^T."""
    u, _, vt = np.linalg.svd(profile)
    u[:, 2] *= np.linalg.det(u) * np.linalg.det(vt)
    return from_matrix(u @ vt)


def quest(profile: FloatArray) -> FloatArray:
    """Return the optimal quaternion (4,) from the Gibbs vector M^-1 z, M = l + t - S.

    The Cayley-Hamilton theorem gives the adjugate of M without a division, so that 180 deg gives no infinity.
    The quaternion still loses digits with det M. The frame is therefore rotated so that the smallest rotation
    remains: det M is the square of the scalar part times the eigenvalue differences, and after each half
    rotation that of another component. The trace of B is cheaper but does not contain the roll in a narrow
    field.
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
    """Return the optimal quaternion (4,) from the rotation axis, found by cross products.

    The axis is the null vector of (t - l)(B + B^T - t - l) - z z^T, which is symmetric of rank 2. The cross
    products of its rows, the rows of its adjugate, all lie along the axis; the longest is the most precise.
    The axis is undefined for small rotations, so the frame is rotated so that the largest rotation remains:
    by the half rotation that gives B the smallest trace.
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
    """Return the optimal quaternion (4,) of [(k + |B|^2) B + l adj(B)^T - B B^T B] / (k l - det B).

    k is (l^2 - |B|^2)/2. No angle is singular.
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
    """Return the optimal attitude by predictive steps from TRIAD's attitude. Raises AttitudeError."""
    seen = sightings(observed, reference, sigma)
    return fix(seen, attitude_of_pair(seen, *best_pair(seen, sigma)))


def triad(observed: FloatArray, reference: FloatArray, sigma: FloatArray) -> AttitudeFix:
    """Return the attitude of the best pair; the loss is that of all directions. Raises AttitudeError."""
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


PROFILE_METHODS: dict[str, Callable[[FloatArray], FloatArray]] = {
    "davenport": davenport,
    "esoq2": esoq2,
    "foam": foam,
    "quest": quest,
    "svd": singular_values,
}
"""Functions from an attitude profile matrix (3, 3) to the optimal quaternion (4,)."""


def _profile_solver(method: Callable[[FloatArray], FloatArray]) -> Solver:
    def solve(observed: FloatArray, reference: FloatArray, sigma: FloatArray) -> AttitudeFix:
        seen = sightings(observed, reference, sigma)
        return fix(seen, method(seen.profile))

    return solve


SOLVERS: dict[str, Solver] = {
    **{name: _profile_solver(method) for name, method in PROFILE_METHODS.items()},
    "olae": olae.solve,
    "predictive": predictive,
    "triad": triad,
}
OPTIMAL = frozenset(SOLVERS) - {"olae", "triad"}
DEFAULT = "davenport"


def solve(observed: FloatArray, reference: FloatArray, sigma: FloatArray) -> AttitudeFix:
    """Return the attitude of the default solver; arguments and exceptions are those of every `Solver`."""
    return SOLVERS[DEFAULT](observed, reference, sigma)


@dataclass(frozen=True, slots=True, eq=False)
class VectorObservation:
    """One direction: `observed` (3,) in body and `reference` (3,) in inertial axes, unit vectors.

    `covariance` (3, 3) rad^2 is that of `observed` in body axes; its part along the direction has no effect.
    """

    observed: FloatArray
    reference: FloatArray
    covariance: FloatArray

    @property
    def sigma(self) -> float:
        """The mean sigma per axis across the direction, rad."""
        along = float(self.observed @ self.covariance @ self.observed)
        return float(np.sqrt(0.5 * (np.trace(self.covariance) - along)))


def field_observation(field: FloatArray, reference: FloatArray, covariance: FloatArray) -> VectorObservation:
    """Return the direction of a field: `field` (3,) T, body, and its model `reference` (3,) T.

    The covariance (3, 3) T^2 must include the error of the magnetometer's bias. Raises AttitudeError for a
    field so weak that the error of its direction exceeds one radian.
    """
    strength = float(np.linalg.norm(reference))
    if not float(np.sqrt(np.trace(covariance))) < strength:
        raise AttitudeError(f"a field of {strength:.2e} T gives no direction within its errors")
    return VectorObservation(
        field / np.linalg.norm(field), reference / strength, np.asarray(covariance / strength**2)
    )


def weighted_fit(observations: Sequence[VectorObservation]) -> AttitudeFix:
    """Return the least-squares attitude under the whole covariances of the directions.

    Gauss-Newton steps start from QUEST's attitude. Twice the loss is a chi-square of 2n - 3 degrees of
    freedom. Raises AttitudeError when the directions fix no attitude.
    """
    observed, reference = (
        np.array([getattr(o, name) for o in observations]) for name in ("observed", "reference")
    )
    quaternion = SOLVERS["quest"](observed, reference, np.array([o.sigma for o in observations])).quaternion
    for _ in range(20):
        information, moment, _ = _normal_equations(quaternion, observations)
        step = np.asarray(np.linalg.solve(information, moment), dtype=float)
        quaternion = normalise(multiply(from_rotation_vector(step), quaternion))
        if float(step @ step) < 1e-9**2:  # rad; convergence is nearly quadratic
            break
    information, _, loss = _normal_equations(quaternion, observations)
    return AttitudeFix(quaternion, np.asarray(np.linalg.inv(information), dtype=float), loss)


def _normal_equations(
    quaternion: FloatArray, observations: Sequence[VectorObservation]
) -> tuple[FloatArray, FloatArray, float]:
    """Return the information (3, 3) of small rotations, their moment (3,) and half the sum of squares."""
    information, moment, loss = np.zeros((3, 3)), np.zeros(3), 0.0
    matrix = attitude_matrix(quaternion)
    for observation in observations:
        expected = matrix @ observation.reference
        across = tangent_basis(expected.tolist())
        weight = np.linalg.inv(across @ observation.covariance @ across.T)
        # After a further small rotation e of the body the direction is A r + [A r x] e.
        rows = across @ cross_matrices(expected[None])[0]
        residual = across @ (observation.observed - expected)
        information += rows.T @ weight @ rows
        moment += rows.T @ weight @ residual
        loss += 0.5 * float(residual @ weight @ residual)
    return information, moment, loss
