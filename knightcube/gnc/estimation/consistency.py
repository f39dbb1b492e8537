"""Comparison of estimates with the truth: attitude errors, and the check of errors against covariances.

The normalised estimation error squared (NEES) of an error e with the covariance P is e' P^-1 e. If the errors
are normally distributed with the stated covariances, the sum of the NEES of n independent errors with k
components is chi-square distributed with n k degrees of freedom (Bar-Shalom, Li and Kirubarajan 2001, section
5.4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.special import gammaincinv

from knightcube.astro.arrays import FloatArray, finite_array, real_number, unit_quaternion
from knightcube.astro.quaternion import conjugate, multiply, to_rotation_vector
from knightcube.errors import ArgumentError


def attitude_error(true: npt.ArrayLike, estimated: npt.ArrayLike) -> FloatArray:
    """Return the rotation vector (3,), rad, in body axes, from an estimated to the true attitude.

    This is the attitude error whose covariance the filters state.

    Args:
        true: quaternion (4,) from reference into body axes, scalar last.
        estimated: quaternion (4,) of the estimate.

    Raises:
        ArgumentError: if an argument is not a unit quaternion.
    """
    p, q = unit_quaternion("true", true), unit_quaternion("estimated", estimated)
    return to_rotation_vector(multiply(p, conjugate(q)))


@dataclass(frozen=True, slots=True, eq=False)
class Consistency:
    """The NEES of n errors. The truth value is True if the mean NEES is within its bounds.

    Attributes:
        nees: NEES (n,), divided by the number of components of an error, so that the expected value is 1.
        mean: mean of `nees`. A mean above `upper` shows that the covariances are too small, and a mean below
            `lower` that they are too large.
        lower, upper: bounds of `mean`.
    """

    nees: FloatArray
    mean: float
    lower: float
    upper: float

    def __bool__(self) -> bool:
        """Return whether the mean NEES is within its bounds."""
        return self.lower <= self.mean <= self.upper

    def __repr__(self) -> str:
        count = len(self.nees)
        return (
            f"<Consistency {'consistent' if self else 'inconsistent'}: mean NEES {self.mean:.3f}, bounds "
            f"{self.lower:.3f} to {self.upper:.3f}, {count} error{'s' if count != 1 else ''}>"
        )


def check_consistency(
    errors: npt.ArrayLike,
    covariances: npt.ArrayLike,
    *,
    confidence: float = 0.99,
    independent: int | None = None,
) -> Consistency:
    """Return the mean normalised estimation error squared (NEES) of errors, with its bounds.

    The bounds hold for normally distributed errors that are independent of each other, such as one error per
    simulated flight. Errors of one flight are correlated in time, and their mean NEES varies more.

    Args:
        errors: errors (n, k), true minus estimated values. An attitude error is that of `attitude_error`.
        covariances: covariances (n, k, k) that the estimator stated for the errors.
        confidence: probability with which the mean NEES of consistent estimates is within the bounds.
        independent: number of independent errors among the n errors, from which the bounds are computed. The
            default is n.

    Raises:
        ArgumentError: if an array has another shape or is not finite, if a covariance is not symmetric and
            positive definite, or if a number is out of range.
    """
    e, p = finite_array("errors", errors), finite_array("covariances", covariances)
    if e.ndim != 2 or not e.size:
        raise ArgumentError("errors", f"an array of shape {e.shape}: give at least one row, of shape (n, k)")
    count, size = e.shape
    if p.shape != (count, size, size):
        raise ArgumentError("covariances", f"an array of shape {p.shape}: give {(count, size, size)}")
    sigma = np.sqrt(np.maximum(p.diagonal(axis1=1, axis2=2), 0.0))
    scale = np.where(sigma > 0.0, sigma, 1.0)
    correlation = p / (scale[:, :, None] * scale[:, None, :])
    symmetric = np.abs(correlation - correlation.swapaxes(1, 2)).max(axis=(1, 2)) < 1e-6
    valid = symmetric & (sigma > 0.0).all(axis=1) & (np.linalg.eigvalsh(correlation)[:, 0] > 0.0)
    if not valid.all():
        number = int(np.argmin(valid))
        raise ArgumentError(f"covariances[{number}]", "must be symmetric and positive definite")
    if not 0.0 < real_number(confidence) < 1.0:
        raise ArgumentError("confidence", f"{confidence!r}: give a probability above 0 and below 1")
    sets = count if independent is None else independent
    if not isinstance(sets, (int, np.integer)) or not 1 <= sets <= count:
        raise ArgumentError("independent", f"{sets!r}: give a whole number from 1 to {count}")
    scaled = e / scale
    nees = np.einsum("ni,ni->n", scaled, np.linalg.solve(correlation, scaled[:, :, None])[:, :, 0]) / size
    # The mean is a chi-square variable, divided by its number of degrees of freedom, 2 `half`.
    half = 0.5 * sets * size
    lower, upper = (gammaincinv(half, 0.5 * (1.0 + side * confidence)) / half for side in (-1.0, 1.0))
    return Consistency(nees, float(nees.mean()), float(lower), float(upper))
