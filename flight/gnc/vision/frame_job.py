"""The vision worker's job: one frame in; its rate, and the attitude that its stars give, out.

The control process makes the job and takes in what was found. The estimators, and scipy with them, are tens
of MB and of no use there: they are imported where the work is done.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from flight.gnc.camera.lens import CameraModel
from flight.gnc.math.arrays import Image
from flight.gnc.vision.startracker.detection import measure_areas, survey
from flight.gnc.vision.startracker.index import sky_index
from flight.gnc.vision.startracker.index.build import default_index
from flight.gnc.vision.startracker.index.sky_index import SkyIndex
from flight.gnc.vision.startracker.solution import FrameSolution
from flight.gnc.vision.startracker.solve import (
    AttitudePrior,
    RatePrior,
    SolveSettings,
    solve_motion,
    solve_near,
    solve_points,
)
from flight.gnc.vision.startracker.two_ends import solve_ends
from flight.gnc.vision.streaks.corners.settings import StreakSettings
from flight.gnc.vision.streaks.maximum_likelihood.result import MotionResult
from flight.gnc.vision.streaks.maximum_likelihood.settings import LikelihoodSettings
from flight.gnc.vision.streaks.streak_result import StreakResult, StreakStatus

Found = StreakResult | MotionResult

_AT_REST = {StreakStatus.TOO_SHORT, StreakStatus.TOO_FEW}
_MOVED = {StreakStatus.RATE, StreakStatus.AMBIGUOUS}


@dataclass(frozen=True, slots=True)
class TrackerSettings:
    """What the star tracker must know.

    Attributes:
        solve: of its steps.
        scale: (lowest, highest) factor by which the lens's focal length may be wrong: (1, 1) when calibrated.
        index: file of the sky index; None for the default one.
    """

    solve: SolveSettings
    scale: tuple[float, float]
    index: Path | None = None


@dataclass(frozen=True, slots=True)
class FrameJob:
    """A frame (rows, columns), the camera, what is believed, and how to go about it.

    The kind of the estimator's settings says which is meant; without a tracker stars are not identified.
    """

    pixels: Image
    camera: CameraModel
    exposure: float
    estimator: StreakSettings | LikelihoodSettings
    tracker: TrackerSettings | None
    rate_prior: RatePrior | None
    attitude_prior: AttitudePrior | None
    previous_checksum: int | None


@dataclass(frozen=True, slots=True)
class FrameFound:
    """The motion over the exposure, and the attitude in its middle; None when it was not asked for."""

    motion: Found
    solution: FrameSolution | None


def run(job: FrameJob) -> FrameFound:
    """Return what the frame tells; at the top level of a module, so that a worker process can import it."""
    estimate_motion, estimate_rate = prepare()
    lens, prior = job.camera.ideal, job.rate_prior
    rate, sigma = (prior.rate, prior.sigma) if prior is not None else (None, math.inf)
    if isinstance(job.estimator, LikelihoodSettings):
        motion = estimate_motion(
            job.pixels, lens, job.exposure, job.estimator, rate, sigma, job.previous_checksum
        )
        return _known_better(job, FrameFound(motion, _attitude(job, motion)))
    streaks = estimate_rate(job.pixels, lens, job.exposure, job.estimator, rate, sigma, job.previous_checksum)
    if job.tracker is None or streaks.status not in _MOVED:
        return FrameFound(streaks, _attitude(job, streaks))
    tracker = job.tracker
    sky = _sky(tracker)
    solution, found = solve_ends(streaks, job.camera, tracker.scale, sky, tracker.solve, job.attitude_prior)
    return FrameFound(found, solution)


def prepare() -> tuple[Callable[..., MotionResult], Callable[..., StreakResult]]:
    """Import what `run` needs, and return the two estimators; a worker does so before its first job."""
    from flight.gnc.vision.streaks.corners.streak_rate import estimate_rate  # noqa: PLC0415
    from flight.gnc.vision.streaks.maximum_likelihood.estimate import estimate_motion  # noqa: PLC0415

    return estimate_motion, estimate_rate


def _known_better(job: FrameJob, found: FrameFound) -> FrameFound:
    """Return what a second fit finds, the stars of a solved frame of streaks being known by then."""
    solution, tracker = found.solution, job.tracker
    if solution is None or solution.motion is None or tracker is None:
        return found
    if not isinstance(job.estimator, LikelihoodSettings):
        return found
    from flight.gnc.vision.startracker.known_sky import with_known_sky  # noqa: PLC0415

    better = with_known_sky(job.pixels, solution, _sky(tracker), tracker.solve, job.estimator)
    return FrameFound(better.motion or found.motion, better)


def _attitude(job: FrameJob, motion: Found) -> FrameSolution | None:
    """Return the attitude from the stars that the motion placed, or from points where nothing moved."""
    tracker, prior = job.tracker, job.attitude_prior
    if tracker is None:
        return None
    if isinstance(motion, MotionResult) and motion.status in _MOVED:
        return solve_motion(motion, job.camera, tracker.scale, _sky(tracker), tracker.solve, prior)
    if motion.status not in _AT_REST:
        return None
    sky = _sky(tracker)
    if prior is not None:
        near = solve_near(job.pixels, job.camera, tracker.scale, sky, tracker.solve, prior)
        if near is not None:
            return near
    found = measure_areas(survey(job.pixels, tracker.solve.detection)).stars()
    return solve_points(found, job.camera, tracker.scale, sky, tracker.solve, prior)


def _sky(tracker: TrackerSettings) -> SkyIndex:
    return default_index() if tracker.index is None else sky_index.load_once(tracker.index)
