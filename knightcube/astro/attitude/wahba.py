"""Wahba's problem: the attitude A that best turns reference directions r into observed b (Sease 3.22, 3.23).

Loss: half the sum of |b - A r|^2 / sigma^2 (Michalski 77 corrected), so that twice the least loss is a
chi-square of 2n - 3 degrees of freedom when each sigma is an observation's error in rad across its direction.
All arrays are (n, 3) unit vectors and (n,) sigmas; the thesis's uniform weights 1/N are equal sigmas.

Every solver that uses the profile matrix B loses digits to its rounding: two directions d rad apart differ in
B by d^2, so the quaternion has an error of rounding over d^2. `refine` recovers them from the residuals,
where the same two differ by d.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.attitude.adjugate import Rows, adjugate, determinant
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, multiply, normalise
from knightcube.errors import FlightError

# For directions within about 1e-6 rad of one line the turn about it is rounding.
_LEAST_SPREAD = 1e-12
_UNIT_TOLERANCE = 1e-6
_EYE = np.eye(3)
_MOST_TURNS = 100
# rad: each turn is at most a tenth of the last, so after one this small less than 1e-12 is left.
_SETTLED = 1e-11
# Several times the rounding of the residuals: turns do not get smaller than this over the directions' spread.
_ROUNDING = 3e-15
# The square of the convergence ratio of turns that neglect the residuals' curvature.
_CLOSE_FIT = 1e-2


class AttitudeError(FlightError):
    """Directions that fix no attitude, or invalid ones."""


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeFix:
    """A solver's attitude.

    Attributes:
        quaternion: (4,) reference into the observer's frame, scalar part not negative.
        covariance: (3, 3) rad^2, of small turns about the observer's axes, from the given sigmas.
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
        weight: (n,) 1/sigma^2, scaled to the sum of one.
        total: the sum of 1/sigma^2, 1/rad^2.
        profile: (3, 3) the attitude profile matrix, the sum of weight b r^T.
        covariance: (3, 3) rad^2, of the optimal attitude's small turns about the observer's axes: the
            inverse of `information`.
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
    _check_shapes(n, observed, reference, sigma)
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


def information(observed: FloatArray, sigma: FloatArray) -> FloatArray:
    """Return the Fisher information (3, 3) of small turns, 1/rad^2: the sum of (1 - b b^T)/sigma^2."""
    weighted = observed / sigma[:, None]
    return np.asarray(np.sum(1.0 / sigma**2) * np.eye(3) - weighted.T @ weighted)


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


def optimal_solver(optimal_quaternion: Callable[[FloatArray], FloatArray]) -> Solver:
    """Return the solver that takes its quaternion (4,) from the profile matrix (3, 3)."""

    def solve(observed: FloatArray, reference: FloatArray, sigma: FloatArray) -> AttitudeFix:
        seen = sightings(observed, reference, sigma)
        return fix(seen, optimal_quaternion(seen.profile))

    return solve


def upright(quaternion: FloatArray) -> FloatArray:
    """Return the quaternion (4,) of the same attitude whose scalar part is not negative."""
    return -quaternion if quaternion[3] < 0.0 else quaternion


def refine(seen: Sightings, quaternion: FloatArray) -> tuple[FloatArray, float]:
    """Return the attitude (4,) of least loss, by Newton's method from `quaternion` (4,), and that loss.

    Raises AttitudeError where the method does not converge, or converges to a point that is no minimum.
    """
    weight = seen.weight[:, None]
    # Of the order of the inverse square of the directions' spread, rad.
    narrowness = seen.total * float(seen.covariance.trace())
    smallest = max(_SETTLED**2, _ROUNDING**2 * narrowness)
    for _ in range(_MOST_TURNS):
        turned = seen.reference @ attitude_matrix(quaternion).T
        residual = seen.observed - turned
        weighted = residual * weight
        loss = 0.5 * seen.total * float(np.vdot(weighted, residual))
        # Of the sum of w (b - A r)(A r)^T: its skew part is the loss's gradient, the sum of w (A r) x b.
        moment = weighted.T @ turned
        (_, xy, xz), (yx, _, yz), (zx, zy, _) = moment.tolist()
        inverse, least = _curvature(seen, moment, turned, 2.0 * loss / seen.total * narrowness**2)
        turn = inverse @ (seen.total * np.array([yz - zy, zx - xz, xy - yx]))
        small = float(turn @ turn) < smallest
        if small and not least:
            raise AttitudeError("the directions fit several attitudes equally well: they share none")
        quaternion = _turned(quaternion, turn, small)
        if small:
            return quaternion, loss
    raise AttitudeError(f"no attitude within {_MOST_TURNS} turns: the directions do not agree on any")


def _curvature(
    seen: Sightings, moment: FloatArray, turned: FloatArray, neglected: float
) -> tuple[FloatArray, bool]:
    """Return the inverse (3, 3) of the loss's second derivative, and whether that is positive definite.

    That derivative differs from the information by at most |moment| <= sqrt(2 loss/total), a relative
    difference whose square is below `neglected`: where that is small the information is used (Gauss-Newton).
    The four stationary attitudes are K's eigenvectors and only one is a minimum, unless the largest
    eigenvalue is double, as for mirrored directions: then a circle of attitudes is.
    """
    if neglected < _CLOSE_FIT:
        return seen.covariance, True
    profile = moment + (turned * seen.weight[:, None]).T @ turned
    hessian = np.trace(profile) * _EYE - 0.5 * (profile + profile.T)
    if np.linalg.eigvalsh(hessian)[0] <= _LEAST_SPREAD:
        return seen.covariance, False
    return np.linalg.inv(hessian) / seen.total, True


def _turned(quaternion: FloatArray, turn: FloatArray, small: bool) -> FloatArray:
    """Return the attitude (4,) turned by `turn` (3,) rad about the observer's axes."""
    if small:
        x, y, z = turn.tolist()
        # Of unit length to the square of the turn, which is below rounding.
        return multiply(np.array([0.5 * x, 0.5 * y, 0.5 * z, 1.0]), quaternion)
    return normalise(multiply(from_rotation_vector(turn), quaternion))


def _check_shapes(n: int, observed: FloatArray, reference: FloatArray, sigma: FloatArray) -> None:
    """Raise AttitudeError for wrong shapes and invalid errors."""
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


def _check_unit_length(both: FloatArray) -> None:
    """Raise AttitudeError unless both halves of the rows (n, 6) are of unit length."""
    vectors = both.reshape(-1, 2, 3)
    excess = np.einsum("nij,nij->ni", vectors, vectors) - 1.0
    # One number shows that all are right; a NaN fails the comparison too.
    if np.vdot(excess, excess) <= (2.0 * _UNIT_TOLERANCE) ** 2:
        return
    right = np.abs(excess) <= 2.0 * _UNIT_TOLERANCE
    if not np.all(right):
        name = "reference" if np.all(right[:, 0]) else "observed"
        raise AttitudeError(f"{name} directions must be finite and of unit length")


def _cofactors(gram: FloatArray, n: int, name: str) -> tuple[Rows, float]:
    """Return the adjugate and the determinant of 1 - gram (3, 3), the information of weights of sum one.

    Its eigenvalues add up to 2 and none exceeds 1, so its determinant is within a factor of two the least.
    Raises AttitudeError when that is rounding.
    """
    rows = (_EYE - gram).tolist()
    cofactors = adjugate(rows)
    volume = determinant(rows, cofactors)
    if volume <= _LEAST_SPREAD:
        raise _on_one_line(n, name)
    return cofactors, volume


def _on_one_line(n: int, name: str) -> AttitudeError:
    return AttitudeError(f"{n} {name} directions on one line fix no attitude: two distinct ones do")
