"""The attitudes at both ends of the streaks, and the rate between them: the thesis's own way (3.22-3.29).

The streaks' ends come from corner detectors; their middles, which a constant bias of the ends does not move,
are identified, and each end then gives an attitude of its own.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flight.attitude.wahba import AttitudeError
from flight.lens import CameraModel
from flight.quaternion import from_rotation_vector, multiply
from flight.startracker.detection import FrameKind
from flight.startracker.sky_index import SkyIndex
from flight.startracker.solution import FrameSolution, SolveStatus
from flight.startracker.solve import AttitudePrior, SolveSettings, solve_places
from flight.vision import two_attitudes
from flight.vision.streak_rate import StreakResult

_FEWEST_PX = 0.02


def solve_ends(
    found: StreakResult,
    camera: CameraModel,
    scale: tuple[float, float],
    sky: SkyIndex,
    settings: SolveSettings,
    prior: AttitudePrior | None = None,
) -> tuple[FrameSolution, StreakResult]:
    """Return the attitude at mid-exposure, and `found` with the rate between the attitudes of its ends.

    Where the streaks cannot be identified `found` stays as it is.
    """
    ends = found.endpoints[found.used]
    sigma = max(found.residual * camera.focal_length, _FEWEST_PX)
    covariance = np.repeat(0.5 * sigma**2 * np.eye(2)[None], len(ends), axis=0)
    # Longest first: the brighter a star, the longer its streak stands above the threshold.
    order = np.argsort(-np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1), kind="stable")
    ends = ends[order]
    solution = solve_places(
        ends.mean(axis=1), covariance, FrameKind.STREAKS, camera, scale, sky, settings, prior
    )
    if solution.status is not SolveStatus.SOLVED:
        return solution, found
    matched = solution.matched
    reference = sky.stars.direction[solution.star[matched]]
    try:
        both = two_attitudes.solve(
            ends[matched], reference, np.full(len(matched), sigma), solution.camera.ideal, found.exposure
        )
    except AttitudeError:
        return solution, found
    middle = multiply(from_rotation_vector(0.5 * both.rotation_vector), both.start.quaternion)
    fix = replace(
        both.start,
        quaternion=middle,
        covariance=0.25 * (both.start.covariance + both.end.covariance),
        loss=both.start.loss + both.end.loss,
    )
    return replace(solution, fix=fix), replace(found, rate=both.rate, covariance=both.covariance)
