"""Attitudes at the start and end of an exposure, and the rate between them (Sease, eq. 3.22-3.29).

The stars are identified by the midpoints of the streaks, which do not depend on a constant bias of the ends.
The ESOQ2 solver computes the attitude at the start of the exposure from the first ends of the streaks, and
the attitude at the end from the second ends. The mean rate is the rotation between the two attitudes divided
by the exposure time. A fixed star moves as v' = -omega x v, so that Delta = A_end A_start^T = exp(-[omega T
x]), and the rotation axis follows from Delta^T - Delta (Sease, eq. 3.24, 3.26 and 3.27, corrected). The angle
is computed from the quaternion, because the arc cosine of the trace (Sease, eq. 3.25) is inaccurate for small
angles.
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

# Lower limit of the assumed error (px) of an endpoint, because small residuals of few streaks can be due to
# chance.
_LEAST_SIGMA_PX = 0.02


@dataclass(frozen=True, slots=True)
class TwoAttitudes:
    """Attitudes at the start and end of an exposure, and the mean rate between them.

    Attributes:
        start: attitude at the start of the exposure, reference frame into camera axes.
        end: attitude at the end of the exposure, reference frame into camera axes.
        rotation_vector: (3,) rotation axis times angle in camera axes, rad (Sease, eq. 3.25 and 3.26).
        rate: (3,) rate of the camera with respect to the stars in camera axes, rad/s (Sease, eq. 3.27).
        covariance: (3, 3) covariance of the rate for independent errors of the two attitudes, rad^2/s^2.
    """

    start: AttitudeFix
    end: AttitudeFix
    rotation_vector: FloatArray
    rate: FloatArray
    covariance: FloatArray


def attitudes_of_ends(
    endpoints: FloatArray, reference: FloatArray, sigma: FloatArray, pinhole: Pinhole, exposure: float
) -> TwoAttitudes:
    """Return the attitudes at the start and end of an exposure, and the mean rate, from identified streaks.

    Args:
        endpoints: (n, 2, 2) positions (x, y) of the start and end of each streak, corrected for bias, px.
        reference: (n, 3) unit vectors to the stars of the streaks, in the reference frame of the attitudes.
        sigma: (n,) standard deviations of the endpoints, px.
        pinhole: model of the camera.
        exposure: exposure time, s.

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
    # The error of the start attitude is rotated into the end axes, to which the rotation vector refers.
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
    """Return the attitude at mid-exposure, and a streak result with the rate between start and end attitude.

    If the streaks cannot be identified, the streak result is returned unchanged. The covariance of the rate
    is not changed, because it already describes the errors of the streak ends along and across the streaks.

    Args:
        found: streak result of the frame.
        camera: model of the camera.
        scale: range of the relative image scale.
        sky: search index of the guide stars.
        settings: settings of the star identification.
        prior: prior attitude, None if unknown.
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
    """Return the derivatives (3, 3) of the rotation vector with respect to an additional small rotation."""
    angle = float(np.linalg.norm(rotation))
    cross = cross_matrices(rotation[None])[0]
    # For an angle of zero both terms of the coefficient diverge, but their difference has the limit 1/12.
    second = 1.0 / 12.0 if angle < 1e-3 else 1.0 / angle**2 - 1.0 / (2.0 * angle * np.tan(0.5 * angle))
    return np.asarray(np.eye(3) + 0.5 * cross + second * cross @ cross)


def _brightest_first(found: StreakResult, camera: CameraModel) -> tuple[FloatArray, FloatArray]:
    """Return the ends (n, 2, 2) and errors (n,), px, of the used streaks, in order of increasing error."""
    used = np.flatnonzero(found.used)
    used = used[np.argsort(found.sigma[used], kind="stable")]
    sigma = found.sigma[used]
    if len(used):
        typical = np.sqrt(np.mean(sigma**2))
        sigma = sigma * max(found.residual * camera.focal_length, _LEAST_SIGMA_PX) / typical
    return found.endpoints[used], sigma


def _scatter(both: TwoAttitudes, count: int) -> float:
    """Return the ratio of the observed variance of the residuals to the assumed variance.

    The fit of each attitude has two residual components per star and three parameters. The variance ratio is
    multiplied by nu/(nu - 2), where nu is the number of degrees of freedom, to allow for the uncertainty of
    the ratio (Student's t distribution).

    Args:
        both: attitudes at the start and end of the exposure.
        count: number of stars.
    """
    freedom = 4 * count - 6
    squares = 2.0 * (both.start.loss + both.end.loss)
    return squares / (freedom - 2) if freedom > 2 and squares > 0.0 else 1.0
