"""The attitudes at both ends of the streaks, and the rate between them: the thesis's own way (3.22-3.29).

The streaks' ends come from corner detectors; their middles, which a constant bias of the ends does not move,
are identified, and each end then gives an attitude of its own.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flight.gnc.attitude.wahba import AttitudeError
from flight.gnc.camera.lens import CameraModel
from flight.gnc.math.arrays import FloatArray
from flight.gnc.math.quaternion import from_rotation_vector, multiply
from flight.gnc.vision.startracker.detection import FrameKind
from flight.gnc.vision.startracker.index.sky_index import SkyIndex
from flight.gnc.vision.startracker.solution import FrameSolution, SolveStatus
from flight.gnc.vision.startracker.solve import AttitudePrior, SolveSettings, solve_places
from flight.gnc.vision.streaks.corners import two_attitudes
from flight.gnc.vision.streaks.corners.two_attitudes import TwoAttitudes
from flight.gnc.vision.streaks.streak_result import StreakResult

# px, of an endpoint: a residual below is luck of few streaks, not precision.
_LEAST_SIGMA_PX = 0.02


def solve_ends(
    found: StreakResult,
    camera: CameraModel,
    scale: tuple[float, float],
    sky: SkyIndex,
    settings: SolveSettings,
    prior: AttitudePrior | None = None,
) -> tuple[FrameSolution, StreakResult]:
    """Return the attitude at mid-exposure, and `found` with the rate between the attitudes of its ends.

    Where the streaks cannot be identified `found` stays as it is. The rate's covariance stays in any case:
    it is from the same ends, whose errors along and across the streaks the fit without names told apart.
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
        both = two_attitudes.solve(
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


def _brightest_first(found: StreakResult, camera: CameraModel) -> tuple[FloatArray, FloatArray]:
    """Return the ends (n, 2, 2) px of the streaks used, and their errors (n,) px by the residuals."""
    used = np.flatnonzero(found.used)
    # The brightest have the least errors.
    used = used[np.argsort(found.sigma[used], kind="stable")]
    sigma = found.sigma[used]
    if len(used):
        typical = np.sqrt(np.mean(sigma**2))
        sigma = sigma * max(found.residual * camera.focal_length, _LEAST_SIGMA_PX) / typical
    return found.endpoints[used], sigma


def _scatter(both: TwoAttitudes, count: int) -> float:
    """Return the variance that the residuals of `count` stars at both ends bear out, over the assumed one.

    Each end has two components a star and lost three to its attitude; widened by nu/(nu - 2) for the scale's
    own uncertainty (Student).
    """
    freedom = 4 * count - 6
    squares = 2.0 * (both.start.loss + both.end.loss)
    return squares / (freedom - 2) if freedom > 2 and squares > 0.0 else 1.0
