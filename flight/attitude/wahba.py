"""Wahba's problem: the attitude A that best turns reference directions r into observed b (Sease 3.22, 3.23).

Loss: half the sum of |b - A r|^2 / sigma^2, so that twice the least loss is a chi-square of 2n - 3 degrees of
freedom when each sigma is an observation's error in rad across its direction. All arrays are (n, 3) unit
vectors and (n,) sigmas; the thesis's uniform weights 1/N are equal sigmas.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flight.arrays import FloatArray
from flight.errors import FlightError
from flight.quaternion import attitude_matrix

# Directions within about 1e-6 rad of one line leave the turn about it to rounding.
_LEAST_SPREAD = 1e-12
_UNIT_TOLERANCE = 1e-6


class AttitudeError(FlightError):
    """Directions that fix no attitude, or are none."""


@dataclass(frozen=True, slots=True)
class AttitudeFix:
    """The attitude that least squares finds.

    Attributes:
        quaternion: (4,) reference into the observer's frame, scalar part not negative.
        covariance: (3, 3) rad^2, of small turns about the observer's axes, from the given sigmas.
        loss: half the sum of squared residuals over their sigmas.
    """

    quaternion: FloatArray
    covariance: FloatArray
    loss: float


def profile_matrix(observed: FloatArray, reference: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the attitude profile matrix (3, 3): the sum of w b r^T."""
    return np.asarray((observed * weights[:, None]).T @ reference)


def information(observed: FloatArray, sigma: FloatArray) -> FloatArray:
    """Return the Fisher information (3, 3) of small turns, 1/rad^2: the sum of (1 - b b^T)/sigma^2."""
    weighted = observed / sigma[:, None]
    return np.asarray(np.sum(1.0 / sigma**2) * np.eye(3) - weighted.T @ weighted)


def fix(
    quaternion: FloatArray, observed: FloatArray, reference: FloatArray, sigma: FloatArray
) -> AttitudeFix:
    """Return what a solver's `quaternion` (4,) is worth: its covariance and its loss (3.23)."""
    q = np.where(quaternion[3] < 0.0, -quaternion, quaternion)
    residual = (observed - reference @ attitude_matrix(q).T) / sigma[:, None]
    covariance = np.asarray(np.linalg.inv(information(observed, sigma)), dtype=np.float64)
    return AttitudeFix(q, covariance, 0.5 * float(np.sum(residual**2)))


def refuse_unobservable(observed: FloatArray, reference: FloatArray, sigma: FloatArray) -> None:
    """Raise AttitudeError for arguments that are no directions or do not fix an attitude."""
    n = len(observed)
    if observed.shape != (n, 3) or reference.shape != (n, 3) or sigma.shape != (n,):
        raise AttitudeError(
            f"observed {observed.shape}, reference {reference.shape}, sigma {sigma.shape}:"
            " give (n, 3), (n, 3) and (n,)"
        )
    if not (np.all(np.isfinite(sigma)) and np.all(sigma > 0.0)):
        raise AttitudeError(f"sigma {sigma}: each must be finite and positive, in rad")
    for name, vectors in (("observed", observed), ("reference", reference)):
        # A NaN fails the comparison too.
        if not np.all(np.abs(np.linalg.norm(vectors, axis=-1) - 1.0) <= _UNIT_TOLERANCE):
            raise AttitudeError(f"{name} directions must be finite and of unit length")
        eigenvalues = np.linalg.eigvalsh(information(vectors, sigma)) if n else np.zeros(3)
        if eigenvalues[0] <= _LEAST_SPREAD * eigenvalues[-1]:
            raise AttitudeError(f"{n} {name} directions on one line fix no attitude: two distinct ones do")
