"""Predictive attitude determination: the rotation that brings predicted directions to the observed ones.

Michalski 3.4.1 names it without a formula. Crassidis and Markley's predictive filter chooses, at each step,
the body rate for which the directions predicted to first order leave the least weighted residual; with
measurements of one instant the steps converge to Wahba's optimum, because the rotation vanishes only with the
gradient of Wahba's loss. It uses residuals instead of the profile matrix, and so loses no digits.

References: Crassidis and Markley, Predictive filtering for attitude estimation without rate sensors,
J. Guidance, Control, and Dynamics 20 (1997); Park and Crassidis, Attitude determination methods using
pseudolite signal phase measurements, Navigation 53 (2006).
"""

from __future__ import annotations

from knightcube.astro.arrays import FloatArray
from knightcube.astro.attitude.triad import attitude_of_pair, best_pair
from knightcube.astro.attitude.wahba import AttitudeFix, fix, sightings


def solve(observed: FloatArray, reference: FloatArray, sigma: FloatArray) -> AttitudeFix:
    """Return the attitude that best turns `reference` into `observed` (n, 3), errors `sigma` (n,) rad.

    Starts from TRIAD's. Raises AttitudeError when the directions fix no attitude or the steps do not
    converge.
    """
    seen = sightings(observed, reference, sigma)
    return fix(seen, attitude_of_pair(seen, *best_pair(seen, sigma)))


def follow(
    previous: FloatArray, observed: FloatArray, reference: FloatArray, sigma: FloatArray
) -> AttitudeFix:
    """Return the attitude, starting from the `previous` one (4,) instead of TRIAD's, for tracking.

    Raises AttitudeError as `solve` does.
    """
    return fix(sightings(observed, reference, sigma), previous)
