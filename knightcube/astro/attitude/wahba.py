"""Wahba's problem: the attitude A that best rotates reference directions r into observed ones b.

The loss is half the sum of |b - A r|^2 / sigma^2 (Sease 3.22, 3.23; Michalski 77 corrected). Twice the
minimum loss is a chi-square of 2n - 3 degrees of freedom if each sigma is the error of an observation, rad
across its direction. All arrays are (n, 3) unit vectors and (n,) sigmas. Equal sigmas give the uniform
weights 1/N of the thesis.

A solver that uses the profile matrix B loses digits to its rounding: two directions d rad apart differ in B
by d^2, so the error of the quaternion is the rounding error over d^2. `refine` recovers the digits from the
residuals, where the same two directions differ by d.
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
from knightcube.errors import FlightError

_MINIMUM_SPREAD = 1e-12
"""Determinant of the information below which directions (within about 1e-6 rad of a line) fix no attitude."""
_UNIT_TOLERANCE = 1e-6
_EYE = np.eye(3)
_MAXIMUM_STEPS = 100
_CONVERGED = 1e-11
"""Length (rad) of the last Newton step: each step is at most a tenth of the one before."""
_ROUNDING = 3e-15
"""Several times the rounding of the residuals. No step is smaller than this over the directions' spread."""
_CLOSE_FIT = 1e-2
"""Largest square of the convergence ratio of Gauss-Newton steps."""
Rows = list[list[float]]


class AttitudeError(FlightError):
    """Directions that fix no attitude, or invalid ones."""


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeFix:
    """A solver's attitude.

    Attributes:
        quaternion: (4,) reference into the observer's frame, scalar part not negative.
        covariance: (3, 3) rad^2, of small rotations about the observer's axes, from the given sigmas.
        loss: half the sum of squared residuals over their sigmas.
    """

    quaternion: FloatArray
    covariance: FloatArray
    loss: float


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """Checked directions that fix an attitude, and the sums that solvers share.

    Attributes:
        observed, reference: (n, 3) unit vectors.
        weight: (n,) 1/sigma^2, scaled to a sum of one.
        total: sum of 1/sigma^2, 1/rad^2.
        profile: (3, 3) attitude profile matrix, the sum of weight b r^T.
        covariance: (3, 3) rad^2, of small rotations of the optimal attitude about the observer's axes.
    """

    observed: FloatArray
    reference: FloatArray
    weight: FloatArray
    total: float
    profile: FloatArray
    covariance: FloatArray

    def loss(self, quaternion: FloatArray) -> float:
        """Return half the sum of squared residuals over their sigmas at an attitude (4,)."""
        residual = self.observed - self.reference @ attitude_matrix(quaternion).T
        return 0.5 * self.total * float(np.vdot(residual * self.weight[:, None], residual))


def sightings(observed: FloatArray, reference: FloatArray, sigma: FloatArray) -> Sightings:
    """Return checked directions (n, 3), (n, 3) with errors (n,) rad, ready to be solved.

    Raises AttitudeError for invalid directions and for directions that fix no attitude.
    """
    n = len(observed)
    if observed.shape != (n, 3) or reference.shape != (n, 3) or sigma.shape != (n,):
        raise AttitudeError(
            f"observed {observed.shape}, reference {reference.shape}, sigma {sigma.shape}:"
            " give (n, 3), (n, 3) and (n,)"
        )
    if n < 2:
        raise _on_one_line(n, "observed")
    # A NaN fails the comparison too.
    if not (np.minimum.reduce(sigma) > 0.0 and np.vdot(sigma, sigma) < np.inf):
        raise AttitudeError(f"sigma {sigma}: each must be finite and positive, in rad")
    weight = 1.0 / (sigma * sigma)
    total = float(np.add.reduce(weight))
    weight /= total
    both = np.empty((n, 6))
    both[:, :3], both[:, 3:] = observed, reference
    _check_unit_length(both)
    # One product contains B and, in its diagonal blocks, the two sums of weight v v^T.
    gram = (both * weight[:, None]).T @ both
    cofactors, volume = _cofactors(gram[:3, :3], n, "observed")
    _cofactors(gram[3:, 3:], n, "reference")
    covariance = np.array(cofactors) / (volume * total)
    return Sightings(observed, reference, weight, total, gram[:3, 3:], covariance)


def profile_matrix(observed: FloatArray, reference: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the attitude profile matrix (3, 3): the sum of w b r^T (Michalski 70)."""
    return np.asarray((observed * weights[:, None]).T @ reference)


def fix(seen: Sightings, quaternion: FloatArray) -> AttitudeFix:
    """Return the optimal attitude from a solver's `quaternion` (4,), with its covariance and loss (3.23)."""
    optimum, loss = refine(seen, quaternion)
    return AttitudeFix(upright(optimum), seen.covariance, loss)


class Solver(Protocol):
    """Computes an attitude from directions."""

    def __call__(self, observed: FloatArray, reference: FloatArray, sigma: FloatArray) -> AttitudeFix:
        """Return the attitude that turns `reference` into `observed` (n, 3), errors `sigma` (n,) rad.

        Raises AttitudeError when the directions fix no attitude.
        """
        ...


_SIGNS = np.array([[1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0], [1.0, 1.0, 1.0]])
_HALF_ROTATIONS = np.eye(4)


def half_rotation(component: int) -> tuple[FloatArray, FloatArray]:
    """Return the signs (3,) of the diagonal matrix of a half rotation, and its quaternion (4,).

    The axis is `component` 0, 1 or 2; 3 gives the identity. The rotation moves that component of a quaternion
    into the scalar part: if it is the largest, at most 120 deg of rotation remain.
    """
    return _SIGNS[component], _HALF_ROTATIONS[component]


def best_pair(seen: Sightings, sigma: FloatArray) -> tuple[int, int]:
    """Return the indices of anchor and other direction of the pair that fixes the attitude best (TRIAD).

    Raises AttitudeError when all pairs lie on one line, in either frame.
    """
    sines = np.minimum(_squared_sines(seen.observed), _squared_sines(seen.reference))
    squared = sigma**2
    with np.errstate(divide="ignore"):
        # The trace of the covariance: sigma1^2 + (sigma1^2 + sigma2^2)/|b1 x b2|^2.
        trace = squared[:, None] + (squared[:, None] + squared) / sines
    first, second = np.unravel_index(np.argmin(trace), trace.shape)
    if not sines[first, second] > 0.0:
        raise AttitudeError("no two directions differ in both frames: they determine no attitude")
    return int(first), int(second)


def _squared_sines(vectors: FloatArray) -> FloatArray:
    """Return the squared sines (n, n) of the angles between unit vectors (n, 3), zero on the diagonal."""
    normal = np.cross(vectors[:, None], vectors)
    return np.asarray(np.einsum("ijk,ijk->ij", normal, normal))


def attitude_of_pair(seen: Sightings, first: int, second: int) -> FloatArray:
    """Return the quaternion (4,) that maps the first onto its observed, the second into their plane."""

    def triad(vectors: FloatArray) -> FloatArray:
        normal = np.cross(vectors[first], vectors[second])
        normal /= np.linalg.norm(normal)
        return np.stack([vectors[first], normal, np.cross(vectors[first], normal)])

    return from_matrix(triad(seen.observed).T @ triad(seen.reference))


def upright(quaternion: FloatArray) -> FloatArray:
    """Return the quaternion (4,) of the same attitude whose scalar part is not negative."""
    return -quaternion if quaternion[3] < 0.0 else quaternion


def refine(seen: Sightings, quaternion: FloatArray) -> tuple[FloatArray, float]:
    """Return the attitude (4,) of minimum loss, by Newton's method from `quaternion` (4,), and that loss.

    The second derivative of the loss differs from the information by at most sqrt(2 loss/total). If that
    difference is small, the information is used (Gauss-Newton). The four stationary attitudes are the
    eigenvectors of Davenport's K. Only one is a minimum, unless the largest eigenvalue is double, as for
    mirrored directions: then a circle of attitudes has the minimum loss.

    Raises AttitudeError if the method does not converge, or converges to a point that is not a minimum.
    """
    weight = seen.weight[:, None]
    # Of the order of the inverse square of the directions' spread, rad.
    narrowness = seen.total * float(seen.covariance.trace())
    smallest = max(_CONVERGED**2, _ROUNDING**2 * narrowness)
    for _ in range(_MAXIMUM_STEPS):
        rotated = seen.reference @ attitude_matrix(quaternion).T
        residual = seen.observed - rotated
        weighted = residual * weight
        loss = 0.5 * seen.total * float(np.vdot(weighted, residual))
        # The skew part of the sum of w (b - A r)(A r)^T is the gradient of the loss, the sum of w (A r) x b.
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
            raise AttitudeError("the directions fit several attitudes equally well: they determine none")
        x, y, z = step.tolist()
        # The length differs from one by the square of the step, which is below rounding.
        return multiply(np.array([0.5 * x, 0.5 * y, 0.5 * z, 1.0]), quaternion), loss
    raise AttitudeError(f"no attitude within {_MAXIMUM_STEPS} steps: no attitude fits the directions")


def adjugate(rows: Rows) -> Rows:
    """Return the adjugate of a 3 x 3 matrix, its inverse times its determinant; faster than numpy."""
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
    """Raise AttitudeError unless both halves of the rows (n, 6) are of unit length."""
    vectors = both.reshape(-1, 2, 3)
    excess = np.einsum("nij,nij->ni", vectors, vectors) - 1.0
    # This sum is small if all lengths are right; a NaN fails the comparison too.
    if np.vdot(excess, excess) <= (2.0 * _UNIT_TOLERANCE) ** 2:
        return
    right = np.abs(excess) <= 2.0 * _UNIT_TOLERANCE
    if not np.all(right):
        name = "reference" if np.all(right[:, 0]) else "observed"
        raise AttitudeError(f"{name} directions must be finite and of unit length")


def _cofactors(gram: FloatArray, n: int, name: str) -> tuple[Rows, float]:
    """Return adjugate and determinant of 1 - gram (3, 3), the information for weights with a sum of one.

    Its eigenvalues add up to 2 and none exceeds 1, so its determinant is within a factor of two of the
    smallest eigenvalue. Raises AttitudeError if that eigenvalue is below rounding.
    """
    rows = (_EYE - gram).tolist()
    cofactors = adjugate(rows)
    volume = determinant(rows, cofactors)
    if volume <= _MINIMUM_SPREAD:
        raise _on_one_line(n, name)
    return cofactors, volume


def _on_one_line(n: int, name: str) -> AttitudeError:
    return AttitudeError(f"{n} {name} directions on one line fix no attitude: two distinct ones do")
