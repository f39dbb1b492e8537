"""OLAE, the Optimal Linear Attitude Estimator: linear least squares for the Gibbs vector (Sease 4.1-4.6).

With b = A r and g the Gibbs vector of A, b - r = [(b + r) x] g exactly: d = [s x] g. Sequential rotation from
TRIAD's attitude keeps the angle at 120 deg or less, |g| below 1.74. An error e of b enters the equation as (1
+ [g x]) e, larger than e by up to the root of 1 + g^2 and different by direction, so the weights 1/sigma^2
are not optimal: the result differs from Wahba's by the order of the noise, and the covariance is that of this
estimator. Because Wahba's is efficient, the difference of the two attitudes has the difference of the two
covariances.

Reference: Mortari, Markley and Singla, Optimal linear attitude estimator, J. Guidance, Control, and Dynamics
30 (2007). The rotation between a streak's ends, with its residuals, is `flight.gnc.vision.objects.olae`.
"""

from __future__ import annotations

import numpy as np

from flight.gnc.attitude.profile import half_turn
from flight.gnc.attitude.triad import attitude_of_pair, best_pair
from flight.gnc.attitude.wahba import (
    AttitudeError,
    AttitudeFix,
    Sightings,
    profile_matrix,
    sightings,
    upright,
)
from flight.gnc.math.arrays import FloatArray
from flight.gnc.math.quaternion import multiply, normalise

_LEAST_VOLUME = 1e-12


def solve(observed: FloatArray, reference: FloatArray, sigma: FloatArray) -> AttitudeFix:
    """Return the attitude that turns `reference` into `observed` (n, 3), errors `sigma` (n,) rad.

    Raises AttitudeError when the directions fix no attitude.
    """
    seen = sightings(observed, reference, sigma)
    rough = attitude_of_pair(seen, *best_pair(seen, sigma))
    signs, turn = half_turn(int(np.argmax(np.abs(rough))))
    turned = reference * signs
    sums = observed + turned
    normal = np.sum(seen.weight * np.sum(sums**2, axis=1)) * np.eye(3) - profile_matrix(
        sums, sums, seen.weight
    )
    if np.linalg.det(normal) <= _LEAST_VOLUME:
        raise AttitudeError("the directions leave the linear equations singular: they share no attitude")
    inverse = np.linalg.inv(normal)
    difference = observed - turned
    gibbs = inverse @ (seen.weight @ np.cross(difference, sums))
    # The normal equations lose the same digits as B; the residuals of the equations recover them.
    gibbs += inverse @ (seen.weight @ np.cross(difference - np.cross(sums, gibbs), sums))
    quaternion = upright(multiply(normalise(np.append(gibbs, 1.0)), turn))
    return AttitudeFix(quaternion, _covariance(seen, sums, gibbs, inverse), seen.loss(quaternion))


def _covariance(seen: Sightings, sums: FloatArray, gibbs: FloatArray, inverse: FloatArray) -> FloatArray:
    """Return the covariance (3, 3) rad^2 of small turns about the observer's axes.

    Propagates (1 + [g x]) e of each error e through the normal equations, and the change of g to the small
    turn 2 (1 - [g x]) dg/(1 + g^2).
    """
    square = 1.0 + gibbs @ gibbs
    across = np.cross(sums, gibbs)
    # An error has no component along its direction.
    along = np.cross(sums, seen.observed + np.cross(gibbs, seen.observed))
    spread = (
        square * np.linalg.inv(inverse)
        - profile_matrix(across, across, seen.weight)
        - profile_matrix(along, along, seen.weight)
    )
    gain = 2.0 / square * (np.eye(3) - np.cross(gibbs, np.eye(3)).T) @ inverse
    return np.asarray(gain @ spread @ gain.T / seen.total)
