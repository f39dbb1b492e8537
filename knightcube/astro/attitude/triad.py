"""TRIAD: the attitude from two directions, the first assumed exact (Michalski 3.4.5).

Of more than two directions it uses the ordered pair whose covariance has the least trace. The result does not
have the least loss, and its covariance is larger than an optimal solver's. Because the optimal one is
efficient, the difference of the two attitudes has the difference of the two covariances.

Reference: Shuster and Oh, Three-axis attitude determination from vector observations, J. Guidance and Control
4 (1981), the covariance after the TRIAD algorithm.
"""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.attitude.wahba import AttitudeError, AttitudeFix, Sightings, sightings, upright
from knightcube.astro.quaternion import from_matrix


def solve(observed: FloatArray, reference: FloatArray, sigma: FloatArray) -> AttitudeFix:
    """Return the attitude that turns the best pair of `reference` into `observed` (n, 3), errors (n,) rad.

    The loss is that of all directions. Raises AttitudeError when they fix no attitude.
    """
    seen = sightings(observed, reference, sigma)
    first, second = best_pair(seen, sigma)
    quaternion = upright(attitude_of_pair(seen, first, second))
    spread = _covariance(observed[first], observed[second], float(sigma[first]), float(sigma[second]))
    return AttitudeFix(quaternion, spread, seen.loss(quaternion))


def best_pair(seen: Sightings, sigma: FloatArray) -> tuple[int, int]:
    """Return the anchor and the other direction, by number, of the pair that fixes the attitude best.

    Raises AttitudeError when all pairs lie on one line, in either frame.
    """
    sines = np.minimum(_squared_sines(seen.observed), _squared_sines(seen.reference))
    squared = sigma**2
    with np.errstate(divide="ignore"):
        # The trace of the covariance: sigma1^2 + (sigma1^2 + sigma2^2)/|b1 x b2|^2.
        trace = squared[:, None] + (squared[:, None] + squared) / sines
    first, second = np.unravel_index(np.argmin(trace), trace.shape)
    if not sines[first, second] > 0.0:
        raise AttitudeError("no pair of directions is apart in both frames: they share no attitude")
    return int(first), int(second)


def attitude_of_pair(seen: Sightings, first: int, second: int) -> FloatArray:
    """Return the quaternion (4,) that maps the first onto its observed, the second into their plane."""
    body = _triad(seen.observed[first], seen.observed[second])
    return from_matrix(body.T @ _triad(seen.reference[first], seen.reference[second]))


def _squared_sines(vectors: FloatArray) -> FloatArray:
    """Return the squared sines (n, n) of the angles between unit vectors (n, 3), zero on the diagonal."""
    normal = np.cross(vectors[:, None], vectors)
    return np.asarray(np.einsum("ijk,ijk->ij", normal, normal))


def _triad(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the orthonormal rows (3, 3): the first direction, the pair's normal, and their cross product."""
    normal = np.cross(first, second)
    normal /= np.linalg.norm(normal)
    return np.stack([first, normal, np.cross(first, normal)])


def _covariance(anchor: FloatArray, other: FloatArray, sigma: float, sigma_other: float) -> FloatArray:
    """Return the covariance (3, 3) rad^2 of small turns about the observer's axes (Shuster and Oh)."""
    normal, cosine = np.cross(anchor, other), anchor @ other
    mixed = np.outer(anchor, other)
    along = (sigma_other**2 - sigma**2) * np.outer(anchor, anchor)
    return np.asarray(
        sigma**2 * np.eye(3) + (along + sigma**2 * cosine * (mixed + mixed.T)) / (normal @ normal)
    )
