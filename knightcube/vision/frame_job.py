"""Attitude and rate from one frame, by the decision tree that the vision worker and `knightcube solve` share.

1. In flight, the motion over the exposure is estimated for every frame, because each frame reports a rate.
   For an image from a file, the motion is only estimated if a fast survey of the bright areas shows streaks.
   If the streaks give no attitude, for example because they are the bars of a fence, the points of the image
   are identified.

2. Point stars are searched near their predicted positions if a prior attitude is available. Without a
   prior attitude, or if the stars are not found near their predictions, the whole frame is searched.

3. Streaked stars are identified by their positions at mid-exposure, by the same method as point stars.
Afterwards, the streaks are fitted again, with a corrected focal length or the directions of the identified
stars.

4. If point stars are not identified, or lie far from their predicted positions, they may be defocused: a star
is a ring or a disc, whose parts are detected as points. After binning, each star is a single spot.

The control process creates the job and receives the result. The streak estimators and scipy are imported at
their first use, because they occupy tens of MB and the control process does not need them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from knightcube.astro.arrays import FloatArray, Image
from knightcube.astro.attitude.wahba import AttitudeFix
from knightcube.astro.quaternion import attitude_matrix, conjugate, multiply
from knightcube.errors import KnightCubeError
from knightcube.vision.camera.images import KeptFrames, keep_frame
from knightcube.vision.camera.lens import CameraModel, Lens, Pinhole, streak_camera
from knightcube.vision.frame import Bins, FrameState, frame_state, raw_counts, saturation_count
from knightcube.vision.lens_knowledge import LensKnowledge
from knightcube.vision.objects.settings import FieldPoints, MeasuredObjects, ObjectMeasurementSettings
from knightcube.vision.startracker.detect import measure_areas
from knightcube.vision.startracker.index import SkyIndex, load_once
from knightcube.vision.startracker.index.build import default_index
from knightcube.vision.startracker.sky_map import ShortTrails
from knightcube.vision.startracker.solve import (
    MOVED,
    SHAPE_DOUBT,
    AttitudePrior,
    FrameSolution,
    RatePrior,
    SolveSettings,
    SolveStatus,
    attitudes_agree,
    solve_faint,
    solve_motion,
    solve_near,
    solve_points,
)
from knightcube.vision.startracker.survey import (
    DetectionSettings,
    FrameKind,
    Survey,
    accepted_psf,
    survey,
)
from knightcube.vision.startracker.tracking import PRIOR_SIGMAS
from knightcube.vision.streaks.streak_result import (
    REASONS,
    FrameMotion,
    LikelihoodSettings,
    MotionResult,
    StreakStatus,
)

_UNIDENTIFIED = {SolveStatus.NO_MATCH, SolveStatus.TOO_FEW_STARS}
_AT_REST = {StreakStatus.TOO_SHORT, StreakStatus.TOO_FEW}
# Correction of the assumed focal length, as a fraction, above which the motion is fitted a second time.
_SCALE_TOLERANCE = 0.01
# Motion (px) of a star over the exposure below which the star is measured as a point.
_POINT_PX = 1.0
# Predicted streak length (px) below which stars are measured as points if no motion can be fitted.
_SHORT_PX = 4.0
# Uncertainty (px) of the predicted motion above which the models of star images do not include the motion.
_KNOWN_PX = 0.3
# Scatter (px, per axis) of identified points about their predictions above which defocus is possible.
# Without defocus, the scatter is below 0.2 px (campaign `resting`).
_SCATTERED_PX = 0.25
# Standard deviation (px) of the boresight above which each star is possibly detected as several points.
_UNCERTAIN_PX = 0.5
# Minimum number of bins in a row and in a column.
_LEAST_BINNED = 64
BIN_SIZES = 3, 5
"""Bin sizes (px) with which an unsolved image, or an image of defocused stars, is binned."""


@dataclass(frozen=True, slots=True)
class TrackerSettings:
    """Settings of the star identification.

    Attributes:
        solve: settings of star detection, identification and attitude.
        scale: lowest and highest ratio of the true to the assumed tangents of field angles, (1, 1) for a
            calibrated lens.
        index: file of the sky index, or None for the default index.
    """

    solve: SolveSettings
    scale: tuple[float, float]
    index: Path | None = None


class StreakEstimator(Protocol):
    """Interface of an alternative motion estimator for streaks, which must support pickling."""

    def motion(
        self,
        pixels: Image,
        pinhole: Pinhole,
        exposure: float,
        prior_rate: FloatArray | None,
        prior_sigma: float,
        previous_checksum: int | None,
    ) -> FrameMotion:
        """Return the motion over the `exposure`, s.

        The arguments are those of `streaks.estimate.estimate_motion`.
        """

    def solve(
        self,
        found: FrameMotion,
        camera: CameraModel,
        scale: tuple[float, float],
        sky: SkyIndex,
        settings: SolveSettings,
        prior: AttitudePrior | None,
    ) -> tuple[FrameSolution, FrameMotion]:
        """Return the attitude at mid-exposure from the motion `found`, and a refined motion."""


@dataclass(frozen=True, slots=True)
class FrameJob:
    """A frame with its camera, prior estimates and settings.

    Attributes:
        pixels: counts of the frame (rows, columns).
        camera: the camera.
        exposure: exposure time, s.
        estimator: settings of the maximum-likelihood estimator, or an alternative estimator of streaks.
        tracker: settings of the star identification. If `tracker` is None, stars are not identified.
        rate_prior, attitude_prior: predicted rate and attitude of the camera, or None if unknown.
        previous_checksum: checksum of the previous frame. Identical checksums indicate a frozen camera.
        motion_first: whether the motion is estimated even if a survey shows no streaks.
        objects: settings of the measurement of objects. If `objects` is None, objects are not measured.
        kept: folder in which the frame is saved on disk, or None if the frame is not saved.
        lens: lens parameters estimated from earlier frames, with which this frame is solved, together with
            the time since the last frame, s. If `lens` is None, the lens parameters are not estimated.
        detection: settings of the detection of points if no stars are identified.
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
    lens: tuple[LensKnowledge, float] | None = None
    detection: DetectionSettings = field(default_factory=DetectionSettings)

    def with_lens(self) -> FrameJob:
        """Return the job with the estimated lens parameters, if usable, instead of the configured parameters.

        The priors of this job refer to the camera axes of the configured lens. The priors of the returned job
        refer to the camera axes of the estimated lens.
        """
        if self.lens is None or not self.lens[0].usable:
            return self
        known, estimator, tracker = self.lens[0], self.estimator, self.tracker
        accuracy, line_time, psf_sigma = known.accuracy, known.shutter[0], known.psf_sigma
        if isinstance(estimator, LikelihoodSettings):
            estimator = replace(estimator, line_time=line_time, psf_sigma=psf_sigma, knowledge=accuracy)
        if tracker is not None:
            detection = replace(tracker.solve.detection, psf_sigma=accepted_psf(psf_sigma))
            solve = replace(tracker.solve, detection=detection, lens=accuracy)
            tracker = replace(tracker, solve=solve, scale=(1.0, 1.0))
        attitude, rate, turn = self.attitude_prior, self.rate_prior, known.turn
        if attitude is not None:
            attitude = replace(attitude, quaternion=multiply(turn, attitude.quaternion))
        if rate is not None:
            matrix, course = attitude_matrix(turn), rate.course
            course = None if course is None else replace(course, terms=course.terms @ matrix.T)
            rate = replace(rate, rate=matrix @ rate.rate, course=course)
        return replace(
            self,
            camera=known.camera,
            estimator=estimator,
            tracker=tracker,
            attitude_prior=attitude,
            rate_prior=rate,
        )


@dataclass(frozen=True, slots=True)
class FrameFound:
    """The result of a frame.

    Attributes:
        motion: motion of the camera over the exposure.
        solution: attitude at mid-exposure, or None if stars were not identified.
        objects: points that may be space objects instead of stars, or None if not measured.
        lens: estimated lens parameters after the frame, or None if they are not estimated.
        field: points of light for the search for objects without a star catalogue, or None if not measured.
        problem: reason why the sky index could not be used, or an empty string.
        turn: quaternion (4,) from the camera axes of the configured lens to the camera axes of the lens with
            which the frame was solved, or None if the axes are the same.
    """

    motion: FrameMotion
    solution: FrameSolution | None
    objects: MeasuredObjects | None = None
    lens: LensKnowledge | None = None
    field: FieldPoints | None = None
    problem: str = ""
    turn: FloatArray | None = None

    def in_configured_axes(self) -> FrameFound:
        """Return the result with rate and attitude in the axes of the configured lens."""
        if self.turn is None:
            return self
        motion, solution, back = self.motion, self.solution, conjugate(self.turn)
        matrix = attitude_matrix(back)
        if motion.rate is not None and motion.covariance is not None:
            covariance = matrix @ motion.covariance @ matrix.T
            motion = replace(motion, rate=matrix @ motion.rate, covariance=covariance)
        if solution is not None and solution.fix is not None:
            fix, quaternion = solution.fix, multiply(back, solution.fix.quaternion)
            fix = replace(
                fix,
                quaternion=quaternion if quaternion[3] >= 0.0 else -quaternion,
                covariance=matrix @ fix.covariance @ matrix.T,
            )
            solution = replace(solution, fix=fix)
        return replace(self, motion=motion, solution=solution, turn=None)


def run(job: FrameJob) -> FrameFound:
    """Return attitude and rate of the camera from a frame.

    The worker process imports this function by its name.
    """
    tracker = job.tracker
    sky, problem = _sky(tracker)
    if tracker is None or sky is None:
        motion, lens, points = _motion(job), None if job.lens is None else job.lens[0], None
        if job.objects is not None:
            from knightcube.vision.objects.measure import measure_points  # noqa: PLC0415 - needs scipy

            points = measure_points(job.pixels, job.camera, job.exposure, motion, job.objects, job.detection)
        found = FrameFound(motion, None, lens=lens, field=points, problem=problem)
    else:
        found = run_with_lens(job, tracker, sky)
        if job.objects is not None and found.solution is not None:
            from knightcube.vision.objects.measure import measure_objects  # noqa: PLC0415 - needs scipy

            velocity, detection = tracker.solve.velocity, tracker.solve.detection
            objects = measure_objects(
                job.pixels, found.solution, job.exposure, sky.stars.epoch, velocity, detection, job.objects
            )
            found = replace(found, objects=objects)
        found = found.in_configured_axes()
    if job.kept is not None:
        keep_frame(job.kept, job.pixels, _facts(job, found))
    return found


def run_with_lens(job: FrameJob, tracker: TrackerSettings, sky: SkyIndex) -> FrameFound:
    """Return attitude and rate from a frame solved with the estimated lens, and the updated lens estimate.

    Rate and attitude refer to the camera axes of the lens with which the frame was solved. If the frame
    contradicts the estimated lens, the frame is solved again with the configured lens.
    """
    through = job.with_lens()
    found = attitude_and_rate(through, through.tracker or tracker, sky)
    if job.lens is None:
        return found
    if through is not job:
        found = replace(found, turn=job.lens[0].turn)
    before, elapsed = job.lens
    if found.solution is None:
        return replace(found, lens=before)
    lens = before.update(found.solution, sky, tracker.solve.velocity, elapsed)
    if lens.contradictions > before.contradictions:
        found = attitude_and_rate(job, tracker, sky)
        if found.solution is not None:
            lens = lens.update(found.solution, sky, tracker.solve.velocity)
    return replace(found, lens=lens)


def _sky(tracker: TrackerSettings | None) -> tuple[SkyIndex | None, str]:
    """Return the sky index, or None and the reason, which is empty if no stars are to be identified."""
    if tracker is None:
        return None, ""
    try:
        return (default_index() if tracker.index is None else load_once(tracker.index)), ""
    except (KnightCubeError, OSError) as error:
        return None, f"stars are not identified: {error}"


def _facts(job: FrameJob, found: FrameFound) -> dict[str, Any]:
    """Return the results of a frame in camera axes as plain values for the metadata file."""
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
    """Return points (n, 2), px, rounded to tenths of a pixel, as nested lists."""
    return [[round(x, 1), round(y, 1)] for x, y in points.tolist()]


def prepare() -> None:
    """Import the streak estimator, so that the first job of a worker starts without delay."""
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
    """Return the attitude from an image (rows, columns), and the rate if the image shows streaks.

    The arguments are those of `found_in_image`.
    """
    found = found_in_image(
        pixels, camera, scale, exposure, sky, settings, attitude_prior, rate_prior
    ).solution
    assert found is not None  # the tracker is given
    return found


def found_in_image(
    pixels: Image,
    camera: CameraModel,
    scale: tuple[float, float],
    exposure: float,
    sky: SkyIndex,
    settings: SolveSettings,
    attitude_prior: AttitudePrior | None = None,
    rate_prior: RatePrior | None = None,
    lens: LensKnowledge | None = None,
) -> FrameFound:
    """Return the solution of an image (rows, columns), and the lens parameters estimated up to this image.

    The image has integers or floating-point numbers, which are converted to counts. If the image shows no
    stars because it is overexposed, or because all its pixels are equal, the reason states this. The scale is
    the lowest and highest ratio of the true to the assumed tangents of field angles, (1, 1) for a calibrated
    camera. Stars are first searched near the positions predicted by `attitude_prior`. The predicted rate
    determines the sense of the rotation, which a single frame of a global shutter does not show. The
    parameters `lens` are estimated from earlier images of the camera, or None if they are not estimated.
    """
    pixels, unit, zero = raw_counts(pixels)
    if unit != 1.0 or zero != 0.0:
        settings = replace(
            settings,
            detection=settings.detection.in_units_of(unit, zero),
            likelihood=settings.likelihood.in_units_of(unit, zero),
        )
    tracker = TrackerSettings(settings, scale)
    # A rate with a large uncertainty is accepted, because the attitude depends only on the star positions.
    estimator = replace(settings.likelihood, worst_uncertainty=math.inf, worst_shaking=math.inf)
    job = FrameJob(
        pixels, camera, exposure, estimator, tracker, rate_prior, attitude_prior, motion_first=False
    )
    found = run_with_lens(job if lens is None else replace(job, lens=(lens, 0.0)), tracker, sky)
    if found.solution is None or found.solution.status is not SolveStatus.NO_STARS:
        return found
    likelihood = settings.likelihood
    top = min(saturation_count(pixels), likelihood.saturation or math.inf)
    state = frame_state(pixels, top, likelihood.saturated_fraction)
    if state is FrameState.USABLE:
        return found
    return replace(found, solution=replace(found.solution, reason=REASONS[StreakStatus(state.value)]))


def in_whole_image(found: FrameSolution, bins: Bins, shape: tuple[int, ...]) -> FrameSolution:
    """Return a solution of a binned image, converted to the pixels of the image (rows, columns)."""
    (rows, columns), size, offset = shape, bins.size, bins.offset
    camera, focal_length = found.camera, size * found.camera.focal_length
    whole: CameraModel = Pinhole(columns, rows, focal_length)
    if isinstance(camera, Lens):
        x, y = (offset + size * np.array(camera.centre)).tolist()
        whole = replace(camera, columns=columns, rows=rows, focal_length=focal_length, centre=(x, y))
    return replace(
        found,
        camera=whole,
        points=offset + size * found.points,
        expected=offset + size * found.expected,
        covariance=size**2 * found.covariance,
        late=size * found.late,
        psf_sigma=size * found.psf_sigma,
    )


def attitude_and_rate(job: FrameJob, tracker: TrackerSettings, sky: SkyIndex) -> FrameFound:
    """Return attitude and rate from a frame by the decision tree in the module docstring."""
    found = _of_sharp_stars(job, tracker, sky)
    best = found.solution
    for size in BIN_SIZES:
        bins = Bins.centred(job.pixels.shape, size)
        small = bins is None or min(bins.rows, bins.columns) < _LEAST_BINNED
        if best is None or bins is None or small or not _may_be_defocused(best, found.motion, tracker):
            break
        again = _of_defocused_stars(job, tracker, sky, bins)
        if again.fix is not None and (best.fix is None or _is_better(again, best)):
            best = again
    return found if best is found.solution else replace(found, solution=best)


def _is_better(one: FrameSolution, other: FrameSolution) -> bool:
    """Return whether the attitude of `one`, after binning, is more credible than that of `other`.

    The attitude of `one` is more credible if the points of `one` scatter less than half as much, or if the
    attitude is more certain. It is also more credible if the two attitudes contradict each other, because the
    parts of defocused stars, unlike whole stars, can all be displaced in the same direction.
    """
    assert one.fix is not None
    assert other.fix is not None
    if _direction_sigma(one.fix) < _direction_sigma(other.fix) or _scatter(one) < 0.5 * _scatter(other):
        return True
    covariance = one.fix.covariance + other.fix.covariance
    return not attitudes_agree(one.fix.quaternion, other.fix.quaternion, covariance)


def _direction_sigma(fix: AttitudeFix) -> float:
    """Return the standard deviation, rad, of the direction of the boresight along one axis."""
    return math.sqrt(0.5 * float(np.trace(fix.covariance[:2, :2])))


def _scatter(solution: FrameSolution) -> float:
    """Return the scatter, px, of the identified points of a solution about their predicted positions."""
    off = solution.points[solution.matched] - solution.expected[solution.matched]
    # Half of the normally distributed displacements in a plane are within 1.18 standard deviations.
    return float(np.median(np.hypot(off[:, 0], off[:, 1]))) / 1.18


def _may_be_defocused(solution: FrameSolution, motion: FrameMotion, tracker: TrackerSettings) -> bool:
    """Return whether the points of a frame of a calibrated camera are possibly parts of defocused stars."""
    lowest, highest = tracker.scale
    if solution.kind is not FrameKind.POINTS or lowest != highest or tracker.solve.method is not None:
        return False
    if solution.torn:
        return False
    if solution.fix is None or motion.status is StreakStatus.FAILED or _scatter(solution) > _SCATTERED_PX:
        return True
    return _direction_sigma(solution.fix) * solution.camera.focal_length > _UNCERTAIN_PX


def binned_settings(settings: SolveSettings, size: int) -> SolveSettings:
    """Return the settings for a frame that is binned by `size` px.

    Point spread, gain and saturation of the binned frame are measured.
    """
    detection = replace(settings.detection, psf_sigma=None, gain=None, saturation=None)
    lens = None if settings.lens is None else settings.lens.binned(size)
    return replace(settings, detection=detection, lens=lens)


def _of_defocused_stars(job: FrameJob, tracker: TrackerSettings, sky: SkyIndex, bins: Bins) -> FrameSolution:
    """Return the attitude from a frame after binning.

    Because the shape of a defocused star is unknown, an error common to all stars is assumed, which is a
    fraction of the bin size.
    """
    estimator, size, solve = job.estimator, bins.size, binned_settings(tracker.solve, bins.size)
    if isinstance(estimator, LikelihoodSettings):
        estimator = estimator.binned(size)
    camera = job.camera.binned(bins.columns, bins.rows, size)
    binned = replace(job, pixels=bins.sums(job.pixels), camera=camera, estimator=estimator)
    tracker, solution, prior = replace(tracker, solve=solve), None, job.attitude_prior
    if prior is not None:
        trails = _short_trails(binned)
        solution = solve_near(binned.pixels, binned.camera, tracker.scale, sky, solve, prior, trails)
    if solution is None:
        solution = _from_points(binned, tracker, sky, survey(binned.pixels, solve.detection))
    doubt = SHAPE_DOUBT / camera.focal_length
    return in_whole_image(solution.wider(np.diag([doubt**2, doubt**2, 0.0])), bins, job.pixels.shape)


def _of_sharp_stars(job: FrameJob, tracker: TrackerSettings, sky: SkyIndex) -> FrameFound:
    """Return attitude and rate from a frame by the first three steps in the module docstring."""
    motion = _motion(job) if job.motion_first else None
    rests = _predicted_within(job, _POINT_PX) if motion is None else _shows_no_motion(job, motion)
    # A fit to a few short streaks is uncertain, so stars are searched near their predicted positions.
    trails, prior = _short_trails(job), job.attitude_prior
    if prior is not None and (rests or (trails is not None and _predicted_within(job, _SHORT_PX))):
        near = solve_near(job.pixels, job.camera, tracker.scale, sky, tracker.solve, prior, trails)
        if near is not None:
            return FrameFound(_no_motion(job) if motion is None else motion, near)
    if motion is None:
        return _of_picture(job, tracker, sky)
    if rests:
        seen = survey(job.pixels, tracker.solve.detection)
        return FrameFound(motion, _from_points(job, tracker, sky, seen))
    if motion.status not in MOVED:
        return FrameFound(motion, None)
    return _from_motion(job, tracker, sky, motion)


def _from_motion(job: FrameJob, tracker: TrackerSettings, sky: SkyIndex, motion: FrameMotion) -> FrameFound:
    """Return the attitude from a frame of streaks, computed by the method of the job's streak estimator."""
    if isinstance(motion, MotionResult):
        return _from_streaks(job, tracker, sky, motion)
    assert not isinstance(job.estimator, LikelihoodSettings)  # the motion is not a MotionResult
    solution, refined = job.estimator.solve(
        motion, job.camera, tracker.scale, sky, tracker.solve, job.attitude_prior
    )
    return FrameFound(refined, solution)


def _of_picture(job: FrameJob, tracker: TrackerSettings, sky: SkyIndex) -> FrameFound:
    """Return attitude and rate from an image that a survey has classified as points or streaks."""
    seen = survey(job.pixels, tracker.solve.detection)
    found: FrameFound | None = None
    if seen.shape.kind is FrameKind.STREAKS:
        found = _from_motion(job, tracker, sky, _motion(job))
        if found.solution is None or found.solution.status is SolveStatus.SOLVED:
            return found
    # The bars of a fence look like streaks, but the stars in the sky beside the fence are points.
    points = _from_points(job, tracker, sky, seen)
    if found is not None and points.status is not SolveStatus.SOLVED:
        return found
    return FrameFound(_no_motion(job), points)


def _from_points(job: FrameJob, tracker: TrackerSettings, sky: SkyIndex, seen: Survey) -> FrameSolution:
    """Return the attitude from the points of a frame, or from faint stars if too few points are stars."""
    stars = measure_areas(seen).stars()
    solution = solve_points(stars, job.camera, tracker.scale, sky, tracker.solve, job.attitude_prior)
    if solution.status not in _UNIDENTIFIED or tracker.solve.method is not None:
        return solution
    faint = solve_faint(seen.pixels, stars, job.camera, tracker.scale, sky, tracker.solve)
    return solution if faint is None or faint.fix is None else faint


def _from_streaks(job: FrameJob, tracker: TrackerSettings, sky: SkyIndex, motion: MotionResult) -> FrameFound:
    """Return attitude and motion from a frame of streaks, and fit the motion a second time if possible."""
    settings, prior = tracker.solve, job.attitude_prior
    solution = solve_motion(motion, job.camera, tracker.scale, sky, settings, prior)
    if solution.status is not SolveStatus.SOLVED:
        return FrameFound(motion, solution)
    if abs(solution.camera.focal_length / job.camera.focal_length - 1.0) > _SCALE_TOLERANCE:
        again = _motion(replace(job, camera=solution.camera))
        assert isinstance(again, MotionResult)  # The first and the second fit use the same estimator.
        # Focal length and lens are still uncertain, and their errors are part of the covariance.
        near = 1.0 - _SCALE_TOLERANCE, 1.0 + _SCALE_TOLERANCE
        return FrameFound(again, solve_motion(again, solution.camera, near, sky, settings, prior))
    if not job.motion_first:
        # A second fit to a single image would take 50 % more time and improve the accuracy only slightly.
        return FrameFound(motion, solution)
    from knightcube.vision.startracker.catalogue_refit import refit_with_catalogue  # noqa: PLC0415

    assert isinstance(job.estimator, LikelihoodSettings)  # the motion is a MotionResult
    better = refit_with_catalogue(job.pixels, solution, sky, settings, job.estimator)
    return FrameFound(motion if better.motion is None else better.motion, better)


def _motion(job: FrameJob) -> FrameMotion:
    """Return the motion over the exposure from the estimator of the job."""
    from knightcube.vision.streaks.estimate import estimate_motion  # noqa: PLC0415

    prior = job.rate_prior
    rate, sigma = (prior.rate, prior.sigma) if prior is not None else (None, math.inf)
    lens, estimator, previous = job.camera.ideal, job.estimator, job.previous_checksum
    if isinstance(estimator, LikelihoodSettings):
        lens = streak_camera(job.camera)
        course = prior.course if prior is not None else None
        return estimate_motion(job.pixels, lens, job.exposure, estimator, rate, sigma, previous, course)
    return estimator.motion(job.pixels, lens, job.exposure, rate, sigma, previous)


def _no_motion(job: FrameJob) -> MotionResult:
    """Return a result without a rate, for a frame of point stars."""
    return MotionResult(StreakStatus.TOO_SHORT, 0, job.exposure)


def _shows_no_motion(job: FrameJob, motion: FrameMotion) -> bool:
    """Return whether the stars are at rest, or are predicted to move too little for streaks."""
    failed = motion.status is StreakStatus.FAILED and job.rate_prior is not None
    return motion.status in _AT_REST or (failed and _predicted_within(job, _SHORT_PX))


def _short_trails(job: FrameJob) -> ShortTrails | None:
    """Return the predicted short streaks of the stars, or None if the predicted motion is too uncertain."""
    prior, estimator = job.rate_prior, job.estimator
    if prior is None or prior.sigma * job.exposure * job.camera.focal_length > _KNOWN_PX:
        return None
    turn = prior.rate * job.exposure
    if not isinstance(estimator, LikelihoodSettings):
        return ShortTrails(turn)
    delay, doubt = estimator.delay_per_row / job.exposure, estimator.line_time_sigma / job.exposure
    return ShortTrails(turn, delay, doubt)


def _predicted_within(job: FrameJob, length: float) -> bool:
    """Return whether the priors predict streaks shorter than `length`, px.

    If no rate is predicted, the rate is assumed to be zero. If no attitude is predicted, the result is False.
    """
    if job.attitude_prior is None:
        return False
    if job.rate_prior is None:
        return True
    most = float(np.linalg.norm(job.rate_prior.rate)) + PRIOR_SIGMAS * job.rate_prior.sigma
    return most * job.exposure * job.camera.focal_length < length
