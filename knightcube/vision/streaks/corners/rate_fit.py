"""One rotation from the endpoints of many streaks, some of them wrong, with its covariance.

Consensus on the axis orders the ends in time (`grouping`), OLAE gives the rotation, its residuals drop what
is no star or no whole streak (Sease "Combined Indicator", with a median-based scale in place of the standard
deviation, which the outliers themselves would widen), and what remains sets the covariance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray
from knightcube.astro.attitude.olae import OlaeSolution, gain, rotation_between
from knightcube.astro.directions import cross_matrices
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.frame import MAD_TO_SIGMA
from knightcube.vision.streaks.corners.endpoints import chord_outward, extend
from knightcube.vision.streaks.corners.grouping import rotation_angles, rotation_axis
from knightcube.vision.streaks.corners.settings import StreakSettings

# Fewer streaks than this part of the measured ones agreeing on one rotation is no agreement.
_LEAST_AGREEMENT = 0.5
# Robust scales below this part of the expected errors are luck of a small sample, not precision.
_LEAST_SCALE = 0.3
_MOST_ROUNDS = 10


@dataclass(frozen=True, slots=True)
class RotationFit:
    """The rotation of the camera over one exposure, up to the direction of time.

    Attributes:
        rotation_vector: (3,) rad, axis times angle in the camera frame, from the first ends to the second.
        covariance: (3, 3) rad^2.
        endpoints: (n, 2, 2) px, compensated, all first ends simultaneous, all second ends simultaneous.
        used: (n,) which streaks the rotation is from.
        residual: rad, rms error of one end that the residuals (4.7) of the streaks used stand for.
    """

    rotation_vector: FloatArray
    covariance: FloatArray
    endpoints: FloatArray
    used: BoolArray
    residual: float


def fit_rotation(
    raw: FloatArray, sigma: FloatArray, pinhole: Pinhole, settings: StreakSettings
) -> RotationFit | None:
    """Return the rotation that most streaks share, None when no half of them (and `least_streaks`) agree.

    `raw` (n, 2, 2) are endpoints in px as localised, strongest streak first, `sigma` (n,) px their expected
    errors.
    """
    needed = max(settings.least_streaks, _LEAST_AGREEMENT * len(raw))
    outward = chord_outward(raw)
    swapped, used = _consensus(extend(raw, outward, settings.endpoint_bias), sigma, pinhole, settings)
    raw = np.where(swapped[:, None, None], raw[:, ::-1], raw)
    outward = chord_outward(raw)
    errors = np.sqrt(2.0) * sigma / pinhole.focal_length
    # The second pass moves the ends along the arcs that the first found: near the axis streaks are curved.
    for _ in range(2):
        if np.count_nonzero(used) < needed:
            return None
        endpoints = extend(raw, outward, settings.endpoint_bias)
        vectors = pinhole.unit_vectors(endpoints)
        try:
            solution, used = _reject_and_solve(vectors, errors, used, settings)
        except np.linalg.LinAlgError:
            return None
        outward = _arc_outward(raw, solution.rotation_vector, pinhole)
    if np.count_nonzero(used) < needed:
        return None
    covariance = _covariance(solution, vectors[used], errors[used], pinhole, settings)
    residual = float(np.sqrt(0.5 * np.mean(np.sum(solution.residuals**2, axis=-1))))
    return RotationFit(solution.rotation_vector, covariance, endpoints, used, residual)


def _consensus(
    endpoints: FloatArray, sigma: FloatArray, pinhole: Pinhole, settings: StreakSettings
) -> tuple[BoolArray, BoolArray]:
    """Return which streaks (n,) have their ends in the other order than the rest, and which agree roughly."""
    vectors = pinhole.unit_vectors(endpoints)
    length = np.linalg.norm(endpoints[:, 1] - endpoints[:, 0], axis=-1)
    allowed = np.maximum(settings.axis_tolerance, settings.outlier_sigmas * sigma)
    axis, agree = rotation_axis(vectors[:, 0], vectors[:, 1], allowed / length)
    angle = rotation_angles(vectors[:, 0], vectors[:, 1], axis)
    size = np.abs(angle)
    common = np.median(size[agree]) if agree.any() else np.nan
    # Twice the tolerance: both ends count, and the axis is rough where it is nearly normal to the boresight.
    agree &= np.abs(size - common) * length <= 2.0 * allowed * size
    return np.asarray(angle < 0.0), np.asarray(agree)


def _reject_and_solve(
    vectors: FloatArray, errors: FloatArray, used: BoolArray, settings: StreakSettings
) -> tuple[OlaeSolution, BoolArray]:
    """Return the rotation and the streaks it is from, dropped and re-admitted by residual until none changes.

    Raises numpy.linalg.LinAlgError when what remains does not fix a rotation.
    """
    weights = 1.0 / errors**2
    solution = rotation_between(vectors[used, 0], vectors[used, 1], weights[used])
    for _ in range(_MOST_ROUNDS):
        z = np.stack(_components(vectors, solution)) / errors
        scale = np.maximum(MAD_TO_SIGMA * np.median(np.abs(z[:, used]), axis=1), _LEAST_SCALE)
        kept = np.all(np.abs(z) <= settings.outlier_sigmas * scale[:, None], axis=0)
        if np.array_equal(kept, used):
            break
        used = kept
        solution = rotation_between(vectors[used, 0], vectors[used, 1], weights[used])
    return solution, used


def _components(vectors: FloatArray, solution: OlaeSolution) -> tuple[FloatArray, FloatArray]:
    """Return the residuals [s x] g - d of streaks (n, 2, 3) along and across their motion, (n,) each, rad."""
    starts, ends = vectors[:, 0], vectors[:, 1]
    residual = np.cross(starts + ends, solution.rodrigues) - (ends - starts)
    along, across = _motion_axes(starts + ends, solution.rodrigues)
    return np.sum(residual * along, axis=-1), np.sum(residual * across, axis=-1)


def _motion_axes(sums: FloatArray, rodrigues: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return unit vectors (n, 3) along the motion at mid-streak, v' = -omega x v, and across it."""
    along = np.cross(sums, rodrigues)
    along = along / np.linalg.norm(along, axis=-1, keepdims=True)
    across = np.cross(sums, along)
    return along, across / np.linalg.norm(across, axis=-1, keepdims=True)


def _arc_outward(endpoints: FloatArray, rotation: FloatArray, pinhole: Pinhole) -> FloatArray:
    """Return the pixel directions (n, 2, 2) out of each streak along its arc: backwards at the first end."""
    v = pinhole.unit_vectors(endpoints)
    velocity = -np.cross(rotation, v)
    image = velocity[..., :2] * v[..., 2:] - v[..., :2] * velocity[..., 2:]
    return np.asarray(image * np.array([-1.0, 1.0])[:, None])


def _covariance(
    solution: OlaeSolution,
    vectors: FloatArray,
    errors: FloatArray,
    pinhole: Pinhole,
    settings: StreakSettings,
) -> FloatArray:
    """Return the covariance (3, 3) rad^2 of the rotation vector.

    Errors along and across the streaks differ, so each has its own scale, from its residuals over the degrees
    of freedom that the fit left to it, widened by nu/(nu - 2) for the scale's own uncertainty (Student). The
    error common to all ends, the bias of the detector, does not show in residuals: it is added from
    `endpoint_bias_sigma`.
    """
    weights = 1.0 / errors**2
    cross = cross_matrices(solution.sums)
    hat = np.einsum("nij,jk,nlk,n->nil", cross, np.linalg.inv(solution.normal), cross, weights)
    moved = gain(solution, weights)
    covariance = np.zeros((3, 3))
    axes = _motion_axes(solution.sums, solution.rodrigues)
    for direction, residual in zip(axes, _components(vectors, solution), strict=True):
        leverage = float(np.einsum("ni,nij,nj->", direction, hat, direction))
        freedom = max(len(errors) - leverage, 1.0)
        scale = np.sum((residual / errors) ** 2) / freedom
        scale *= freedom / (freedom - 2.0) if freedom > 3.0 else 3.0
        column = np.einsum("nij,nj->ni", moved, direction) * errors[:, None]
        covariance += scale * column.T @ column
    shift = 2.0 * settings.endpoint_bias_sigma / pinhole.focal_length
    common = shift * np.einsum("nij,nj->i", moved, axes[0])
    return np.asarray(covariance + np.outer(common, common))
