"""The attitude from matched stars whose places in the image have covariances of their own.

A star drawn out to a streak is known well across its path and badly along it. Each residual b - A r is taken
in the two directions across the star, whitened by the place's covariance, and the sum of squares made least
by Gauss-Newton: the maximum likelihood for Gaussian errors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flight.arrays import FloatArray
from flight.attitude.wahba import AttitudeError, AttitudeFix
from flight.lens import CameraModel
from flight.quaternion import attitude_matrix, from_matrix
from flight.startracker.refinement import inflation, scale_slope, stretched, turned
from flight.vision.olae import cross_matrices

_MOST_STEPS = 8
_SETTLED = 1e-11
# px, over which the slope of the lens is taken.
_STEP_PX = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class ImageFit:
    """The attitude, and what the stars say of the fit.

    Attributes:
        fix: the attitude; its covariance is widened where the stars scatter beyond theirs.
        scale: factor of the tangents x/z, y/z; 1 when it was held.
        scale_sigma: relative standard deviation of the scale; 0 when it was held.
        squares: (n,) squared error of each star over its covariance, of two degrees of freedom.
    """

    fix: AttitudeFix
    scale: float
    scale_sigma: float
    squares: FloatArray


def fit_in_image(
    points: FloatArray,
    covariance: FloatArray,
    reference: FloatArray,
    camera: CameraModel,
    start: FloatArray,
    free_scale: bool = False,
) -> ImageFit:
    """Return the attitude that puts stars at `reference` (n, 3) to `points` (n, 2) px.

    Args:
        points: (n, 2) px.
        covariance: (n, 2, 2) px^2 of each.
        reference: (n, 3) unit vectors.
        camera: with its lens.
        start: (4,) an attitude near the answer, reference into camera.
        free_scale: whether the focal length may be wrong.

    Raises AttitudeError when the stars do not fix what is asked.
    """
    observed = camera.unit_vectors(points)
    whitener = _whitener(points, observed, covariance, camera)
    matrix, scale = attitude_matrix(start), 1.0
    parameters = 4 if free_scale else 3
    for _ in range(_MOST_STEPS):
        seen, predicted = stretched(observed, scale), reference @ matrix.T
        residual = np.einsum("nij,nj->ni", whitener, seen - predicted).ravel()
        flat = _slope(whitener, seen, predicted, free_scale)
        try:
            inverse = np.linalg.inv(flat.T @ flat)
        except np.linalg.LinAlgError as error:
            raise AttitudeError(f"{len(points)} stars in one place fix no attitude") from error
        step = -inverse @ (flat.T @ residual)
        if not np.all(np.abs(step) < 1.0):
            raise AttitudeError(f"{len(points)} stars do not agree on an attitude")
        matrix = turned(matrix, step[:3])
        scale *= float(np.exp(step[3])) if free_scale else 1.0
        if np.abs(step).max() < _SETTLED:
            break
    left = np.einsum("nij,nj->ni", whitener, stretched(observed, scale) - reference @ matrix.T)
    squares = np.sum(left**2, axis=1)
    inverse = inverse * inflation(squares, parameters)
    turn = np.ascontiguousarray(inverse[:3, :3], dtype=np.float64)
    fix = AttitudeFix(from_matrix(matrix), turn, 0.5 * float(squares.sum()))
    return ImageFit(fix, scale, float(np.sqrt(inverse[3, 3])) if free_scale else 0.0, squares)


def _slope(whitener: FloatArray, seen: FloatArray, predicted: FloatArray, free_scale: bool) -> FloatArray:
    """Return d(whitened residuals)/d(turn, ln scale), (2n, 3 or 4)."""
    turn = -whitener @ cross_matrices(predicted)
    if not free_scale:
        return np.asarray(turn.reshape(-1, 3))
    scale = np.einsum("nij,nj->ni", whitener, scale_slope(seen))
    return np.concatenate([turn, scale[:, :, None]], axis=2).reshape(-1, 4)


def _whitener(
    points: FloatArray, observed: FloatArray, covariance: FloatArray, camera: CameraModel
) -> FloatArray:
    """Return matrices (n, 2, 3) that turn an error of a direction into two of variance one."""
    slopes = np.stack(
        [
            camera.unit_vectors(points + offset) - camera.unit_vectors(points - offset)
            for offset in _STEP_PX * np.eye(2)
        ],
        axis=-1,
    ) / (2.0 * _STEP_PX)
    root = np.linalg.cholesky(covariance)
    spread = slopes @ root
    # The pseudo-inverse: the third direction, along the line of sight, carries no error.
    return np.asarray(np.linalg.inv(np.swapaxes(spread, -1, -2) @ spread) @ np.swapaxes(spread, -1, -2))
