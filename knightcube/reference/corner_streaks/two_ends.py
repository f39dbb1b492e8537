"""The attitudes at both ends of an exposure and the rate between them: the thesis's method (3.22-3.29).

The middles of the streaks, which a constant bias of the ends does not move, are identified. The first ends
then give the attitude at the start of the exposure and the second ends the attitude at its end, each by
ESOQ2. The rotation between the two over the exposure is the mean rate. A star fixed in the sky moves with
v' = -omega x v, so that Delta = A_end A_start^T = exp(-[omega T x]) and the axis is that of Delta^T - Delta
(3.24, 3.26 and 3.27 corrected). The angle is taken from the quaternion, because the arc cosine of the trace
(3.25) loses half of the digits at small angles.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from knightcube.astro.arrays import FloatArray, cross_matrices
from knightcube.astro.attitude.solvers import SOLVERS
from knightcube.astro.attitude.wahba import AttitudeError, AttitudeFix
from knightcube.astro.quaternion import (
    attitude_matrix,
    conjugate,
    from_rotation_vector,
    multiply,
    to_rotation_vector,
)
from knightcube.errors import FlightError
from knightcube.reference.corner_streaks.settings import StreakResult
from knightcube.vision.camera.lens import CameraModel, Pinhole
from knightcube.vision.startracker.detection import FrameKind
from knightcube.vision.startracker.index.sky_index import SkyIndex
from knightcube.vision.startracker.solve import (
    AttitudePrior,
    FrameSolution,
    SolveSettings,
    SolveStatus,
    solve_places,
)

# Minimum error (px) of an endpoint; smaller residuals are chance agreement of few streaks.
_LEAST_SIGMA_PX = 0.02


@dataclass(frozen=True, slots=True)
class TwoAttitudes:
    """The attitudes at the two ends of one exposure and the mean rate between them.

    Attributes:
        start: attitude at the start, reference frame into camera axes.
        end: attitude at the end.
        rotation_vector: (3,) rad, camera axes: principal axis times principal angle (3.25, 3.26).
        rate: (3,) rad/s, camera axes, of the camera with respect to the stars (3.27 with identity R_cam).
        covariance: (3, 3) rad^2/s^2 of `rate`, for independent errors of the two ends.
    """

    start: AttitudeFix
    end: AttitudeFix
    rotation_vector: FloatArray
    rate: FloatArray
    covariance: FloatArray


def attitudes_of_ends(
    endpoints: FloatArray, reference: FloatArray, sigma: FloatArray, pinhole: Pinhole, exposure: float
) -> TwoAttitudes:
    """Return attitudes and rate from identified streaks.

    Args:
        endpoints: (n, 2, 2) px, streak, end, (x, y), without bias; the first ends are the earlier ones.
        reference: (n, 3) unit vectors of the streaks' stars, in the reference frame of the attitudes.
        sigma: (n,) px, error of an endpoint.
        pinhole: the camera.
        exposure: s.

    Raises AttitudeError if the stars do not determine an attitude, FlightError for an invalid exposure.
    """
    if not (np.isfinite(exposure) and exposure > 0.0):
        raise FlightError(f"exposure of {exposure} s: must be finite and positive")
    vectors = pinhole.unit_vectors(endpoints)
    errors = sigma / pinhole.focal_length
    start = SOLVERS["esoq2"](vectors[:, 0], reference, errors)
    end = SOLVERS["esoq2"](vectors[:, 1], reference, errors)
    turn = multiply(end.quaternion, conjugate(start.quaternion))
    rotation = to_rotation_vector(turn)
    # The error at the start is rotated into the axes at the end; both errors then change the rotation vector.
    propagated = attitude_matrix(turn)
    jacobian = _turn_to_vector(rotation)
    covariance = jacobian @ (end.covariance + propagated @ start.covariance @ propagated.T) @ jacobian.T
    return TwoAttitudes(start, end, rotation, rotation / exposure, covariance / exposure**2)


def solve_ends(
    found: StreakResult,
    camera: CameraModel,
    scale: tuple[float, float],
    sky: SkyIndex,
    settings: SolveSettings,
    prior: AttitudePrior | None = None,
) -> tuple[FrameSolution, StreakResult]:
    """Return the attitude at mid-exposure, and `found` with the rate between the attitudes of its ends.

    If the streaks cannot be identified, `found` is returned unchanged. The covariance of the rate is not
    changed: it comes from the same ends, with separate errors along and across the streaks.
    """
    ends, sigma = _brightest_first(found, camera)
    covariance = 0.5 * sigma[:, None, None] ** 2 * np.eye(2)
    solution = solve_places(
        ends.mean(axis=1), covariance, FrameKind.STREAKS, camera, scale, sky, settings, prior
    )
    if solution.status is not SolveStatus.SOLVED:
        return solution, found
    matched = solution.matched
    reference = sky.stars.direction[solution.star[matched]]
    try:
        both = attitudes_of_ends(
            ends[matched], reference, sigma[matched], solution.camera.ideal, found.exposure
        )
    except AttitudeError:
        return solution, found
    scatter = _scatter(both, len(matched))
    middle = multiply(from_rotation_vector(0.5 * both.rotation_vector), both.start.quaternion)
    fix = replace(
        both.start,
        quaternion=middle,
        covariance=0.25 * scatter * (both.start.covariance + both.end.covariance),
        loss=(both.start.loss + both.end.loss) / scatter,
    )
    return replace(solution, fix=fix), replace(found, rate=both.rate)


def _turn_to_vector(rotation: FloatArray) -> FloatArray:
    """Return the derivatives (3, 3) of the rotation vector with respect to a small rotation after it."""
    angle = float(np.linalg.norm(rotation))
    cross = cross_matrices(rotation[None])[0]
    # Both terms of the coefficient diverge at zero, where it is 1/12.
    second = 1.0 / 12.0 if angle < 1e-3 else 1.0 / angle**2 - 1.0 / (2.0 * angle * np.tan(0.5 * angle))
    return np.asarray(np.eye(3) + 0.5 * cross + second * cross @ cross)


def _brightest_first(found: StreakResult, camera: CameraModel) -> tuple[FloatArray, FloatArray]:
    """Return ends (n, 2, 2) px and errors (n,) px of the streaks used, in order of increasing error."""
    used = np.flatnonzero(found.used)
    used = used[np.argsort(found.sigma[used], kind="stable")]
    sigma = found.sigma[used]
    if len(used):
        typical = np.sqrt(np.mean(sigma**2))
        sigma = sigma * max(found.residual * camera.focal_length, _LEAST_SIGMA_PX) / typical
    return found.endpoints[used], sigma


def _scatter(both: TwoAttitudes, count: int) -> float:
    """Return the ratio of the residuals' variance to the assumed one, for `count` stars.

    Each end has two components per star and three parameters of its attitude. The ratio is widened by
    nu/(nu - 2) for its own uncertainty (Student).
    """
    freedom = 4 * count - 6
    squares = 2.0 * (both.start.loss + both.end.loss)
    return squares / (freedom - 2) if freedom > 2 and squares > 0.0 else 1.0
