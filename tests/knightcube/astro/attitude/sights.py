"""Star directions that a simulated camera measures, and their information about the attitude."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, normalise


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """Measured and true directions (n, 3), errors (n,), rad, and the true attitude (4,)."""

    observed: FloatArray
    reference: FloatArray
    sigma: FloatArray
    quaternion: FloatArray


def information(observed: FloatArray, sigma: FloatArray) -> FloatArray:
    """Return the Fisher information (3, 3), 1/rad^2, of small rotations: the sum of (1 - b b^T)/sigma^2."""
    weighted = observed / sigma[:, None]
    return np.asarray(np.sum(1.0 / sigma**2) * np.eye(3) - weighted.T @ weighted)


def unit(vectors: FloatArray) -> FloatArray:
    """Return the vectors (..., 3), scaled to unit length."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def sight(
    rng: np.random.Generator,
    n: int,
    half_field: float | None,
    sigma: float,
    angle: float | None = None,
) -> Sight:
    """Return n stars within `half_field` rad of a random boresight, or in the whole sky if it is None.

    `sigma` (rad) is the approximate error of each measured direction. `angle` (rad) is the rotation about a
    random axis. If `angle` is None, the attitude is drawn uniformly from all rotations.
    """
    drawn = rng.normal(size=(n, 3))
    if half_field is not None:
        boresight = unit(rng.normal(size=3))
        reach = half_field * np.sqrt(rng.uniform(size=(n, 1)))
        drawn = boresight + reach * unit(np.cross(boresight, drawn))
    reference = unit(drawn)
    quaternion = normalise(rng.normal(size=4))
    if angle is not None:
        quaternion = from_rotation_vector(angle * unit(quaternion[:3]))
    errors = sigma * rng.uniform(0.3, 3.0, n)
    noise = errors[:, None] * rng.normal(size=(n, 3))
    observed = unit(reference @ attitude_matrix(quaternion).T + noise)
    return Sight(observed, reference, errors, quaternion)
