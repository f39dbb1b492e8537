"""From one frame to attitude and rate: the only decision tree, of the vision worker and of `flight solve`.

1. The motion over the exposure is estimated: of every frame in flight, which reports it; of any other
   picture only where a survey of its bright areas shows streaks, for the survey is cheaper. If these give no
   attitude (a fence or a striped wall looks like streaks too), the picture's points are tried.
2. Stars at rest are looked for near their predicted places if there is a prior attitude, else, or if that
   fails, in the whole frame.
3. Streaks give their stars' places at mid-exposure, which are identified like points. A focal length that
   proves wrong, or the stars known by then, lead to a second fit of the streaks.

The control process creates the job and receives its result. The estimators, and scipy with them, take tens
of MB that it does not need: they are imported where the work is done.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from knightcube.astro.arrays import FloatArray, Image
from knightcube.vision.camera.images import KeptFrames, keep_frame
from knightcube.vision.camera.lens import CameraModel, Pinhole
from knightcube.vision.objects.settings import MeasuredObjects, ObjectMeasurementSettings
from knightcube.vision.startracker.detection import FrameKind, Survey, measure_areas, survey
from knightcube.vision.startracker.index import sky_index
from knightcube.vision.startracker.index.build import default_index
from knightcube.vision.startracker.index.sky_index import SkyIndex
from knightcube.vision.startracker.sky_map import ShortTrails
from knightcube.vision.startracker.solve import (
    MOVED,
    PRIOR_SIGMAS,
    AttitudePrior,
    FrameSolution,
    RatePrior,
    SolveSettings,
    SolveStatus,
    solve_motion,
    solve_near,
    solve_points,
)
from knightcube.vision.streaks.settings import LikelihoodSettings
from knightcube.vision.streaks.streak_result import FrameMotion, MotionResult, StreakStatus

_AT_REST = {StreakStatus.TOO_SHORT, StreakStatus.TOO_FEW}
# The motion is fitted again where the focal length was wrong by more.
_SCALE_TOLERANCE = 0.01
# A star that moves by less over the exposure is a point.
_POINT_PX = 1.0
# Streaks predicted to be shorter are found like points where the frame itself agrees on no motion: in a
# crowded sky regions run together and look longer than they are.
_SHORT_PX = 4.0
# A trail known to this, px, is in the model of a star's light.
_KNOWN_PX = 0.3


@dataclass(frozen=True, slots=True)
class TrackerSettings:
    """How stars are identified.

    Attributes:
        solve: settings of the steps.
        scale: (lowest, highest) factor by which the lens's focal length may be wrong: (1, 1) when calibrated.
        index: file of the sky index; None for the default one.
    """

    solve: SolveSettings
    scale: tuple[float, float]
    index: Path | None = None


class StreakEstimator(Protocol):
    """Another estimator of streaks, to compare with; it can be pickled."""

    def motion(
        self,
        pixels: Image,
        pinhole: Pinhole,
        exposure: float,
        prior_rate: FloatArray | None,
        prior_sigma: float,
        previous_checksum: int | None,
    ) -> FrameMotion:
        """Return the motion over the exposure (s), with arguments as `estimate_motion` has them."""

    def solve(
        self,
        found: FrameMotion,
        camera: CameraModel,
        scale: tuple[float, float],
        sky: SkyIndex,
        settings: SolveSettings,
        prior: AttitudePrior | None,
    ) -> tuple[FrameSolution, FrameMotion]:
        """Return the attitude at mid-exposure by the streaks of a motion `found`, and the refined motion."""


@dataclass(frozen=True, slots=True)
class FrameJob:
    """A frame (rows, columns) with its camera, priors and settings.

    Attributes:
        exposure: s.
        estimator: settings of the maximum-likelihood estimator, or another estimator of streaks.
        tracker: None: stars are not identified.
        previous_checksum: of the frame before; the same pixels again mean a frozen camera.
        motion_first: whether the motion is estimated in any case, not only where a survey shows streaks.
        objects: how objects are sighted once the stars gave the attitude; None: they are not.
        kept: where the frame is kept; None: it is not.
    """

    pixels: Image
    camera: CameraModel
    exposure: float
    estimator: LikelihoodSettings | StreakEstimator
    tracker: TrackerSettings | None
    rate_prior: RatePrior | None
    attitude_prior: AttitudePrior | None
    previous_checksum: int | None = None
    motion_first: bool = True
    objects: ObjectMeasurementSettings | None = None
    kept: KeptFrames | None = None


@dataclass(frozen=True, slots=True)
class FrameFound:
    """The motion over the exposure, and the attitude in its middle; None if stars were not looked for.

    `objects` are what may be objects; None if they were not looked for, or the attitude is not known.
    """

    motion: FrameMotion
    solution: FrameSolution | None
    objects: MeasuredObjects | None = None


def run(job: FrameJob) -> FrameFound:
    """Return attitude and rate of a frame; at the top level of a module for the worker process to import."""
    found = _found(job)
    if job.kept is not None:
        keep_frame(job.kept, job.pixels, _facts(job, found))
    return found


def _facts(job: FrameJob, found: FrameFound) -> dict[str, Any]:
    """Return what was found in a frame as plain values, camera axes, for its file."""
    motion, solution = found.motion, found.solution
    rate = motion.rate if motion.status is StreakStatus.RATE else None
    fix = None if solution is None else solution.fix
    return {
        "exposure_s": job.exposure,
        "streaks": motion.status.value,
        "rate_rad_s": None if rate is None else rate.tolist(),
        "stars": None if solution is None else solution.status.value,
        "identified": 0 if solution is None else int((solution.star >= 0).sum()),
        "attitude": None if fix is None else fix.quaternion.tolist(),
        "objects": None if found.objects is None else len(found.objects.points),
        "star_points": [] if solution is None else _places(solution.points[solution.star >= 0]),
        "object_points": [] if found.objects is None else _places(found.objects.points),
    }


def _places(points: FloatArray) -> list[list[float]]:
    """Return points (n, 2) px in tenths of a pixel: enough to mark them."""
    return [[round(x, 1), round(y, 1)] for x, y in points.tolist()]


def _found(job: FrameJob) -> FrameFound:
    tracker = job.tracker
    if tracker is None:
        return FrameFound(_motion(job), None)
    sky = default_index() if tracker.index is None else sky_index.load_once(tracker.index)
    found = attitude_and_rate(job, tracker, sky)
    if job.objects is None or found.solution is None:
        return found
    return replace(found, objects=_objects(job, tracker, sky, found.solution, job.objects))


def prepare() -> None:
    """Import the estimator; a worker does so before its first job."""
    from knightcube.vision.streaks import estimate  # noqa: F401, PLC0415


def solve_frame(
    pixels: Image,
    camera: CameraModel,
    scale: tuple[float, float],
    exposure: float,
    sky: SkyIndex,
    settings: SolveSettings,
    attitude_prior: AttitudePrior | None = None,
    rate_prior: RatePrior | None = None,
) -> FrameSolution:
    """Return the attitude of any picture (rows, columns), and its rate if it shows streaks.

    Args:
        pixels: counts.
        camera: assumed, of the frame's shape.
        scale: (lowest, highest) factor of the tangents: (1, 1) for a calibrated camera.
        exposure: s.
        sky: the guide stars.
        settings: of the steps.
        attitude_prior: where to look first.
        rate_prior: gives the direction of time, which one frame does not show.
    """
    tracker = TrackerSettings(settings, scale)
    # Of a picture the places of the stars are wanted: a rate that is hardly known serves as well.
    estimator = replace(settings.likelihood, worst_doubt=math.inf, worst_shaking=math.inf)
    job = FrameJob(
        pixels, camera, exposure, estimator, tracker, rate_prior, attitude_prior, motion_first=False
    )
    found = attitude_and_rate(job, tracker, sky).solution
    assert found is not None  # only a flight does without one
    return found


def attitude_and_rate(job: FrameJob, tracker: TrackerSettings, sky: SkyIndex) -> FrameFound:
    """Return attitude and rate of a frame: the decision tree."""
    motion = _motion(job) if job.motion_first else None
    rests = _predicted_within(job, _POINT_PX) if motion is None else _shows_no_motion(job, motion)
    # Of short streaks few are fitted, and may be taken for their reverse; all stars have predicted places.
    near = _near(job, tracker, sky) if rests or _known_to_be_short(job) else None
    if near is not None:
        return FrameFound(motion or _no_motion(job), near)
    if motion is None:
        return _of_picture(job, tracker, sky)
    if rests:
        seen = survey(job.pixels, tracker.solve.detection)
        return FrameFound(motion, _from_points(job, tracker, sky, seen))
    if motion.status not in MOVED:
        return FrameFound(motion, None)
    return _from_motion(job, tracker, sky, motion)


def _near(job: FrameJob, tracker: TrackerSettings, sky: SkyIndex) -> FrameSolution | None:
    """Return the attitude from stars near their predicted places, None without a prior or where they fail."""
    prior = job.attitude_prior
    if prior is None:
        return None
    return solve_near(job.pixels, job.camera, tracker.scale, sky, tracker.solve, prior, _short_trails(job))


def _from_motion(job: FrameJob, tracker: TrackerSettings, sky: SkyIndex, motion: FrameMotion) -> FrameFound:
    """Return the attitude of a frame of streaks by the way of the estimator that found their motion."""
    if isinstance(motion, MotionResult):
        return _from_streaks(job, tracker, sky, motion)
    assert not isinstance(job.estimator, LikelihoodSettings)  # it makes a MotionResult
    solution, refined = job.estimator.solve(
        motion, job.camera, tracker.scale, sky, tracker.solve, job.attitude_prior
    )
    return FrameFound(refined, solution)


def _of_picture(job: FrameJob, tracker: TrackerSettings, sky: SkyIndex) -> FrameFound:
    """Return attitude and rate of a picture, of which a survey says whether it shows points or streaks."""
    seen = survey(job.pixels, tracker.solve.detection)
    found: FrameFound | None = None
    if seen.shape.kind is FrameKind.STREAKS:
        found = _from_motion(job, tracker, sky, _motion(job))
        if found.solution is None or found.solution.status is SolveStatus.SOLVED:
            return found
    # A fence or a striped wall looks like streaks; the sky beside it shows points.
    points = _from_points(job, tracker, sky, seen)
    if found is not None and points.status is not SolveStatus.SOLVED:
        return found
    return FrameFound(_no_motion(job), points)


def _from_points(job: FrameJob, tracker: TrackerSettings, sky: SkyIndex, seen: Survey) -> FrameSolution:
    stars = measure_areas(seen).stars()
    return solve_points(stars, job.camera, tracker.scale, sky, tracker.solve, job.attitude_prior)


def _from_streaks(job: FrameJob, tracker: TrackerSettings, sky: SkyIndex, motion: MotionResult) -> FrameFound:
    """Return the attitude of a frame of streaks, and its motion, fitted again if the solution allows."""
    settings, prior = tracker.solve, job.attitude_prior
    solution = solve_motion(motion, job.camera, tracker.scale, sky, settings, prior)
    if solution.status is not SolveStatus.SOLVED:
        return FrameFound(motion, solution)
    if abs(solution.camera.focal_length / job.camera.focal_length - 1.0) > _SCALE_TOLERANCE:
        again = _motion(replace(job, camera=solution.camera))
        assert isinstance(again, MotionResult)  # as `motion`, by the same estimator
        return FrameFound(again, solve_motion(again, solution.camera, (1.0, 1.0), sky, settings, prior))
    if not job.motion_first:
        # The refit costs a picture half as much again, for little.
        return FrameFound(motion, solution)
    from knightcube.vision.startracker.catalogue_refit import refit_with_catalogue  # noqa: PLC0415

    assert isinstance(job.estimator, LikelihoodSettings)  # it made a MotionResult
    better = refit_with_catalogue(job.pixels, solution, sky, settings, job.estimator)
    return FrameFound(better.motion or motion, better)


def _motion(job: FrameJob) -> FrameMotion:
    """Return the motion over the exposure, by the estimator of the job."""
    from knightcube.vision.streaks.estimate import estimate_motion  # noqa: PLC0415

    prior = job.rate_prior
    rate, sigma = (prior.rate, prior.sigma) if prior is not None else (None, math.inf)
    lens, estimator, previous = job.camera.ideal, job.estimator, job.previous_checksum
    if isinstance(estimator, LikelihoodSettings):
        course = prior.course if prior is not None else None
        return estimate_motion(job.pixels, lens, job.exposure, estimator, rate, sigma, previous, course)
    return estimator.motion(job.pixels, lens, job.exposure, rate, sigma, previous)


def _objects(
    job: FrameJob,
    tracker: TrackerSettings,
    sky: SkyIndex,
    solution: FrameSolution,
    settings: ObjectMeasurementSettings,
) -> MeasuredObjects | None:
    """Return what may be objects."""
    from knightcube.vision.objects.measure import measure_objects  # noqa: PLC0415 - scipy comes with it

    return measure_objects(
        job.pixels,
        solution,
        job.exposure,
        sky.stars.epoch,
        tracker.solve.velocity,
        tracker.solve.detection,
        settings,
    )


def _no_motion(job: FrameJob) -> MotionResult:
    """Return the motion of a frame of points of which none was estimated."""
    return MotionResult(StreakStatus.TOO_SHORT, 0, job.exposure)


def _shows_no_motion(job: FrameJob, motion: FrameMotion) -> bool:
    """Return whether stars are at rest, or move so little, by the priors, that a frame shows no motion."""
    failed = motion.status is StreakStatus.FAILED and job.rate_prior is not None
    return motion.status in _AT_REST or (failed and _predicted_within(job, _SHORT_PX))


def _short_trails(job: FrameJob) -> ShortTrails | None:
    """Return how stars move over the exposure where that is known to a fraction of a pixel."""
    prior, estimator = job.rate_prior, job.estimator
    if prior is None or prior.sigma * job.exposure * job.camera.focal_length > _KNOWN_PX:
        return None
    turn = prior.rate * job.exposure
    if not isinstance(estimator, LikelihoodSettings):
        return ShortTrails(turn)
    delay, doubt = estimator.delay_per_row / job.exposure, estimator.line_time_sigma / job.exposure
    return ShortTrails(turn, delay, doubt)


def _known_to_be_short(job: FrameJob) -> bool:
    """Return whether streaks are known to be so short that they are measured as points with trails."""
    return _short_trails(job) is not None and _predicted_within(job, _SHORT_PX)


def _predicted_within(job: FrameJob, length: float) -> bool:
    """Return whether the priors predict streaks shorter than a length, px; without a rate prior they do."""
    if job.attitude_prior is None:
        return False
    if job.rate_prior is None:
        return True
    most = float(np.linalg.norm(job.rate_prior.rate)) + PRIOR_SIGMAS * job.rate_prior.sigma
    return most * job.exposure * job.camera.focal_length < length
