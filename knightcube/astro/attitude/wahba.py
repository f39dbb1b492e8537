"""Wahba's problem: the attitude A that best rotates reference directions r into observed directions b.

The loss is half the sum of |b - A r|^2 / sigma^2 (Sease, eq. 3.22 and 3.23, and Michalski, eq. 77,
corrected). Each sigma is the standard deviation of an observed direction per axis, rad. Twice the minimum
loss of n directions has a chi-square distribution with 2n - 3 degrees of freedom. Equal standard deviations
give the uniform weights 1/N of Sease 2013.

Solvers based on the profile matrix B lose accuracy by rounding. Two directions with a separation of d rad
change B only by terms of the order d^2, so that the error of the quaternion is the rounding error divided by
d^2. The function `refine` restores the accuracy from the residuals of the directions, which are linear in d.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import (
    attitude_matrix,
    from_matrix,
    from_rotation_vector,
    multiply,
    normalise,
)
from knightcube.errors import KnightCubeError

_MINIMUM_SPREAD = 1e-12
"""Determinant of the information matrix below which the directions do not determine an attitude.

The threshold corresponds to directions that are collinear within about 1e-6 rad.
"""
_UNIT_TOLERANCE = 1e-6
_EYE = np.eye(3)
_MAXIMUM_STEPS = 100
_CONVERGED = 1e-11
"""Length (rad) of a Newton step below which the iteration ends.

The error after the last Newton step is smaller, because each step is at most a tenth of the previous step.
"""
_ROUNDING = 3e-15
"""Residual below which a Newton step is not meaningful: several times the rounding error of the residuals."""
_CLOSE_FIT = 1e-2
"""Largest squared convergence ratio for which Gauss-Newton steps are used instead of Newton steps."""
Rows = list[list[float]]


class AttitudeError(KnightCubeError):
    """Raised for directions that are invalid or do not determine an attitude."""


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeFix:
    """Attitude determined from directions.

    Attributes:
        quaternion: (4,) rotation of the reference frame into the observer's frame, with a scalar >= 0.
        covariance: (3, 3) covariance of small rotations about the observer's axes, rad^2.
        loss: half the sum of squared normalised residuals.
    """

    quaternion: FloatArray
    covariance: FloatArray
    loss: float


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """Checked directions that determine an attitude, with quantities that all solvers need.

    Attributes:
        observed, reference: (n, 3) unit vectors in the observer's frame and in the reference frame.
        weight: (n,) weights 1/sigma^2, scaled to a sum of one.
        total: sum of 1/sigma^2, 1/rad^2.
        profile: (3, 3) attitude profile matrix, the weighted sum of b r^T.
        covariance: (3, 3) covariance of small rotations about the observer's axes, rad^2.
    """

    observed: FloatArray
    reference: FloatArray
    weight: FloatArray
    total: float
    profile: FloatArray
    covariance: FloatArray

    def loss(self, quaternion: FloatArray) -> float:
        """Return half the sum of squared normalised residuals for an attitude quaternion (4,)."""
        residual = self.observed - self.reference @ attitude_matrix(quaternion).T
        return 0.5 * self.total * float(np.vdot(residual * self.weight[:, None], residual))


def sightings(observed: FloatArray, reference: FloatArray, sigma: FloatArray) -> Sightings:
    """Check directions, and return the directions with the quantities that all solvers need.

    The arguments are those of `Solver`. Raises AttitudeError if the directions do not determine an attitude.
    """
    n = len(observed)
    if observed.shape != (n, 3) or reference.shape != (n, 3) or sigma.shape != (n,):
        raise AttitudeError(
            f"observed {observed.shape}, reference {reference.shape}, sigma {sigma.shape}:"
            " give (n, 3), (n, 3) and (n,)"
        )
    if n < 2:
        raise _on_one_line(n, "observed")
    # The comparison is written so that NaN is rejected as well.
    if not (np.minimum.reduce(sigma) > 0.0 and np.vdot(sigma, sigma) < np.inf):
        raise AttitudeError(f"sigma {sigma}: each must be finite and positive, in rad")
    weight = 1.0 / (sigma * sigma)
    total = float(np.add.reduce(weight))
    weight /= total
    both = np.empty((n, 6))
    both[:, :3], both[:, 3:] = observed, reference
    _check_unit_length(both)
    # The product contains the profile matrix B, and in diagonal blocks the weighted sums of b b^T and r r^T.
    gram = (both * weight[:, None]).T @ both
    cofactors, volume = _cofactors(gram[:3, :3], n, "observed")
    _cofactors(gram[3:, 3:], n, "reference")
    covariance = np.array(cofactors) / (volume * total)
    return Sightings(observed, reference, weight, total, gram[:3, 3:], covariance)


def profile_matrix(observed: FloatArray, reference: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the attitude profile matrix (3, 3), the weighted sum of b r^T (Michalski, eq. 70)."""
    return np.asarray((observed * weights[:, None]).T @ reference)


def fix(seen: Sightings, quaternion: FloatArray) -> AttitudeFix:
    """Return the optimal attitude, refined from a solver's attitude (4,) (Sease, eq. 3.23)."""
    optimum, loss = refine(seen, quaternion)
    return AttitudeFix(upright(optimum), seen.covariance, loss)


class Solver(Protocol):
    """Function that computes an attitude from directions."""

    def __call__(self, observed: FloatArray, reference: FloatArray, sigma: FloatArray) -> AttitudeFix:
        """Return the attitude that rotates reference directions into observed directions.

        Raises AttitudeError if the directions do not determine an attitude.

        Args:
            observed: (n, 3) observed unit vectors.
            reference: (n, 3) reference unit vectors.
            sigma: (n,) standard deviations of the observed directions, rad.
        """
        ...


_SIGNS = np.array([[1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0], [1.0, 1.0, 1.0]])
_HALF_ROTATIONS = np.eye(4)


def half_rotation(component: int) -> tuple[FloatArray, FloatArray]:
    """Return the matrix diagonal (3,) and the quaternion (4,) of a 180 deg rotation about a coordinate axis.

    The index `component` is 0, 1 or 2 for the axes x, y and z, and 3 for the identity. The 180 deg rotation
    moves the quaternion component with this index into the scalar part. If the moved component is the largest
    component, the remaining rotation is at most 120 deg.
    """
    return _SIGNS[component], _HALF_ROTATIONS[component]


def best_pair(seen: Sightings, sigma: FloatArray) -> tuple[int, int]:
    """Return the indices of the two directions that determine the TRIAD attitude most accurately.

    TRIAD assumes that the first direction is exact. Raises AttitudeError if all directions are collinear.
    """
    sines = np.minimum(_squared_sines(seen.observed), _squared_sines(seen.reference))
    squared = sigma**2
    with np.errstate(divide="ignore"):
        # The trace of the covariance is sigma1^2 + (sigma1^2 + sigma2^2)/|b1 x b2|^2.
        trace = squared[:, None] + (squared[:, None] + squared) / sines
    first, second = np.unravel_index(np.argmin(trace), trace.shape)
    if not sines[first, second] > 0.0:
        raise AttitudeError(
            "the attitude is undefined: every pair of directions is parallel in at least one frame"
        )
    return int(first), int(second)


def _squared_sines(vectors: FloatArray) -> FloatArray:
    """Return the squared sines (n, n) of the angles between all pairs of unit vectors (n, 3)."""
    normal = np.cross(vectors[:, None], vectors)
    return np.asarray(np.einsum("ijk,ijk->ij", normal, normal))


def attitude_of_pair(seen: Sightings, first: int, second: int) -> FloatArray:
    """Return the TRIAD attitude quaternion (4,) of the directions with the indices `first` and `second`.

    The attitude rotates the first reference direction exactly into the first observed direction.
    """

    def triad(vectors: FloatArray) -> FloatArray:
        normal = np.cross(vectors[first], vectors[second])
        normal /= np.linalg.norm(normal)
        return np.stack([vectors[first], normal, np.cross(vectors[first], normal)])

    return from_matrix(triad(seen.observed).T @ triad(seen.reference))


def upright(quaternion: FloatArray) -> FloatArray:
    """Return the quaternion (4,) of the same attitude with a scalar part of at least 0."""
    return -quaternion if quaternion[3] < 0.0 else quaternion


def refine(seen: Sightings, quaternion: FloatArray) -> tuple[FloatArray, float]:
    """Return the attitude quaternion (4,) of minimum loss, computed by Newton's method, and the minimum loss.

    The second derivative of the loss differs from the information matrix by at most sqrt(2 loss/total). If
    the loss is small, the information matrix is used as second derivative (Gauss-Newton method). The four
    stationary points of the loss are the eigenvectors of Davenport's matrix K, and only one stationary point
    is a minimum. If the largest eigenvalue is double, as for mirrored directions, the minimum is not unique.

    Raises AttitudeError if the iteration does not converge, or converges to a point that is not a minimum.
    """
    weight = seen.weight[:, None]
    # The variable `narrowness` is about 1 / (angular extent of the directions, rad)^2.
    narrowness = seen.total * float(seen.covariance.trace())
    smallest = max(_CONVERGED**2, _ROUNDING**2 * narrowness)
    for _ in range(_MAXIMUM_STEPS):
        rotated = seen.reference @ attitude_matrix(quaternion).T
        residual = seen.observed - rotated
        weighted = residual * weight
        loss = 0.5 * seen.total * float(np.vdot(weighted, residual))
        # The gradient of the loss is the skew-symmetric part of the weighted sum of (b - A r)(A r)^T.
        moment = weighted.T @ rotated
        (_, xy, xz), (yx, _, yz), (zx, zy, _) = moment.tolist()
        inverse, is_minimum = seen.covariance, True
        if 2.0 * loss / seen.total * narrowness**2 >= _CLOSE_FIT:
            profile = moment + (rotated * weight).T @ rotated
            hessian = np.trace(profile) * _EYE - 0.5 * (profile + profile.T)
            is_minimum = bool(np.linalg.eigvalsh(hessian)[0] > _MINIMUM_SPREAD)
            if is_minimum:
                inverse = np.linalg.inv(hessian) / seen.total
        step = inverse @ (seen.total * np.array([yz - zy, zx - xz, xy - yx]))
        if float(step @ step) >= smallest:
            quaternion = normalise(multiply(from_rotation_vector(step), quaternion))
            continue
        if not is_minimum:
            raise AttitudeError("several attitudes fit the directions equally well")
        x, y, z = step.tolist()
        # The quaternion is not normalised, because its length error is below the rounding error.
        return multiply(np.array([0.5 * x, 0.5 * y, 0.5 * z, 1.0]), quaternion), loss
    raise AttitudeError(
        f"no convergence in {_MAXIMUM_STEPS} steps: the directions may not be consistent with any attitude"
    )


def adjugate(rows: Rows) -> Rows:
    """Return the adjugate (inverse times determinant) of a 3 x 3 matrix, faster than numpy."""
    (a, b, c), (d, e, f), (g, h, i) = rows
    return [
        [e * i - f * h, c * h - b * i, b * f - c * e],
        [f * g - d * i, a * i - c * g, c * d - a * f],
        [d * h - e * g, b * g - a * h, a * e - b * d],
    ]


def determinant(rows: Rows, adjugate_rows: Rows) -> float:
    """Return the determinant of a 3 x 3 matrix whose adjugate is known."""
    (a, b, c), column = rows[0], adjugate_rows
    return a * column[0][0] + b * column[1][0] + c * column[2][0]


def _check_unit_length(both: FloatArray) -> None:
    """Raise AttitudeError unless both halves (3,) of each row of an array (n, 6) are unit vectors."""
    vectors = both.reshape(-1, 2, 3)
    excess = np.einsum("nij,nij->ni", vectors, vectors) - 1.0
    # The sum of the squared excesses is small only if all vectors have unit length and no component is NaN.
    if np.vdot(excess, excess) <= (2.0 * _UNIT_TOLERANCE) ** 2:
        return
    right = np.abs(excess) <= 2.0 * _UNIT_TOLERANCE
    if not np.all(right):
        name = "reference" if np.all(right[:, 0]) else "observed"
        raise AttitudeError(f"{name} directions must be finite and of unit length")


def _cofactors(gram: FloatArray, n: int, name: str) -> tuple[Rows, float]:
    """Return adjugate and determinant of the information matrix 1 - `gram` (3, 3) for normalised weights.

    The eigenvalues of the information matrix add up to 2 and are at most 1. The determinant is therefore at
    most the smallest eigenvalue, and at least 4/9 of this eigenvalue. Raises AttitudeError if the smallest
    eigenvalue is below the rounding error.
    """
    rows = (_EYE - gram).tolist()
    cofactors = adjugate(rows)
    volume = determinant(rows, cofactors)
    if volume <= _MINIMUM_SPREAD:
        raise _on_one_line(n, name)
    return cofactors, volume


def _on_one_line(n: int, name: str) -> AttitudeError:
    return AttitudeError(f"{n} {name} directions on one line do not determine an attitude")
