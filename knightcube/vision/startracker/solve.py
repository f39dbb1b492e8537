"""Attitude of a frame from its stars, in steps that `knightcube.vision.frame_job` selects.

If the stars are points, the module `detect` measures their positions. If the stars are streaks, their fitted
positions at mid-exposure are used instead. Identification first searches near a prior attitude, if there is
one, and then in the whole sky. The resulting attitude refers to mid-exposure.

During an exposure at a constant rate, the middle of a streak is the position of the star at mid-exposure.
During an exposure of length T, an angular acceleration a displaces the centroid of a point by a T^2 / 24, and
the midpoint between the two ends of a streak by a T^2 / 8. If the fit of a streak includes the acceleration,
only terms of higher order in time displace the position. A white-noise angular acceleration of spectral
density q adds a variance of q T^3 / 320 to the position of a point, of q T^3 / 48 to the midpoint of a
streak's ends, and of q T^3 / 4743 to a fit that includes the acceleration.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np

from knightcube.astro.arrays import FloatArray, Image, IntArray
from knightcube.astro.attitude.wahba import AttitudeError, AttitudeFix, Solver
from knightcube.astro.quaternion import attitude_matrix, conjugate, from_matrix, multiply, to_rotation_vector
from knightcube.vision.camera.lens import CameraKnowledge, CameraModel, Lens, LensError, Pinhole
from knightcube.vision.startracker.attitude_fit import MatchStatus, StarField, StarMatch
from knightcube.vision.startracker.detect import Detections, measure_near
from knightcube.vision.startracker.faint_stars import FrameLight, match_by_light
from knightcube.vision.startracker.image_fit import ImageFit, Unknowns, attitude_by, fit_in_image
from knightcube.vision.startracker.index import SkyIndex
from knightcube.vision.startracker.lost_in_space import IdentificationSettings, identify
from knightcube.vision.startracker.sky_map import BENDS, ShortTrails, SkyMap, apparent, known_bend, usual_bend
from knightcube.vision.startracker.survey import DetectionSettings, FrameKind, accepted_psf
from knightcube.vision.startracker.torn_frames import at_another_attitude, displacement
from knightcube.vision.startracker.tracking import PRIOR_SIGMAS, track
from knightcube.vision.startracker.verification import expected_stars
from knightcube.vision.streaks.geometry import PIXEL_VARIANCE, Course
from knightcube.vision.streaks.streak_result import (
    REASONS,
    FrameMotion,
    LikelihoodSettings,
    MotionResult,
    StreakStatus,
)


class SolveStatus(Enum):
    """The outcome of the attitude determination of one frame."""

    SOLVED = "solved"
    NO_STARS = "no-stars"
    TOO_FEW_STARS = "too-few-stars"
    NO_MATCH = "no-match"
    AMBIGUOUS = "ambiguous"


@dataclass(frozen=True, slots=True, eq=False)
class FrameSolution:
    """The attitude of one frame at mid-exposure, and the rate if the stars are streaks.

    Attributes:
        status: outcome of the frame. The attributes from `star` on, except `motion`, are valid only for the
            status SOLVED.
        reason: why the frame was not solved, in one sentence; empty if it was solved.
        kind: whether the frame shows points or streaks.
        camera: camera model, with the fitted focal length if the focal length was free.
        points: positions of the detected stars at mid-exposure (n, 2), px, the brightest first.
        covariance: covariances of the positions (n, 2, 2), px^2.
        late: displacement of the points (n, 2), px, due to an error of one standard deviation of the
            shutter's line time; (0, 2) if the line time is exact.
        star: index of the guide star of each point (n,); -1 for a point without a guide star.
        expected: predicted positions of the guide stars (n, 2), px, or NaN for a point without a guide star.
        fix: attitude from ICRS to camera axes and its covariance; the quaternion's scalar is not negative.
        scale_sigma: relative standard deviation of the focal length; 0 if the focal length was given.
        bend: fitted lens errors (8,), see `sky_map`; zeros if the lens is exact.
        log10_false_alarm: log10 of the probability that a frame of random points would match equally well.
        tracked: whether the stars were identified by a search near the prior attitude.
        faint: whether the stars were identified by the light of faint stars (`solve_faint`).
        motion: motion of the camera from the streaks, camera frame, or None for points.
        mirrored: whether the image shows the mirrored sky. For a mirrored sky, `fix` is the attitude of the
            image after it is flipped left to right at the optical axis. The points of a solution are those
            of the original image even for a mirrored sky.
        psf_sigma: measured standard deviation of the point spread, px; NaN if unknown.
        torn: whether a part of the rows is displaced, or shows another attitude.
    """

    status: SolveStatus
    reason: str
    kind: FrameKind
    camera: CameraModel
    points: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    covariance: FloatArray = field(default_factory=lambda: np.empty((0, 2, 2)))
    late: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    star: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    expected: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    fix: AttitudeFix | None = None
    scale_sigma: float = 0.0
    bend: FloatArray = field(default_factory=lambda: np.zeros(BENDS))
    log10_false_alarm: float = 0.0
    tracked: bool = False
    faint: bool = False
    motion: MotionResult | None = None
    mirrored: bool = False
    psf_sigma: float = math.nan
    torn: bool = False

    @property
    def matched(self) -> IntArray:
        """The indices (m,) of the points that are identified as guide stars."""
        return np.flatnonzero(self.star >= 0)

    def wider(self, by: FloatArray) -> FrameSolution:
        """Return the solution with `by` (3, 3), rad^2, added to the covariance; unchanged if not solved."""
        if self.fix is None:
            return self
        return replace(self, fix=replace(self.fix, covariance=self.fix.covariance + by))

    def sky_map(self, velocity: FloatArray | None = None) -> SkyMap | None:
        """Return the conversion between pixels and directions, or None if the frame was not solved.

        `velocity` (3,), m/s, is the camera's velocity with which the frame was solved.
        """
        if self.fix is None:
            return None
        return SkyMap(self.camera, self.fix.quaternion, self.bend, velocity, self.mirrored)


NODES = (0.0, 0.25, 0.75, 1.0)
"""Times at which the rotation since mid-exposure is evaluated, as fractions of the exposure."""
MOVED = {StreakStatus.RATE, StreakStatus.AMBIGUOUS}


@dataclass(frozen=True, slots=True)
class Weighting:
    """Weights that express the attitude measured in a frame as a mean of the attitudes during the exposure.

    Attributes:
        weights: weights of the rotations since mid-exposure at `NODES`; the weight of mid-exposure is one
            minus their sum.
        noise_share: variance due to white angular acceleration, divided by its spectral density and by the
            cube of the exposure time.
    """

    weights: tuple[float, float, float, float]
    noise_share: float


MEAN = Weighting((1 / 12, 1 / 3, 1 / 3, 1 / 12), 1 / 320)
"""Weighting by Simpson's rule for points, which show the mean attitude over the exposure."""
ENDS = Weighting((1 / 2, 0.0, 0.0, 1 / 2), 1 / 48)
"""Weighting for streaks that are fitted with a constant rate, or of which only the ends are measured."""
MIDDLE = Weighting((-2 / 35, 8 / 35, 8 / 35, -2 / 35), 1 / 4743)
"""Weighting for streaks that are fitted with an acceleration.

The measured attitude is the value at mid-exposure of the parabola that fits the rotation best.
"""


def weighting_of(motion: FrameMotion) -> Weighting:
    """Return the weighting for the motion of a frame."""
    if motion.status not in MOVED:
        return MEAN
    fitted = isinstance(motion, MotionResult) and motion.rate_model == "accelerating"
    return MIDDLE if fitted else ENDS


def middle_covariance(
    weighting: Weighting, turns: FloatArray, angular_acceleration_psd: FloatArray, exposure: float
) -> FloatArray:
    """Return the covariance (3, 3), rad^2, of the measured attitude relative to the attitude at mid-exposure.

    The rotation vectors `turns` (4, 3), rad, lead from mid-exposure to the times `NODES`. The argument
    `angular_acceleration_psd` (3, 3), rad^2/s^3, is the power spectral density of the unmodelled angular
    acceleration, which is assumed to be white noise.
    """
    known = np.asarray(weighting.weights) @ turns
    return np.outer(known, known) + angular_acceleration_psd * weighting.noise_share * exposure**3


def timing_covariance(motion: MotionResult) -> FloatArray:
    """Return the covariance (3, 3), rad^2, of the rotation error common to all streaks of a frame.

    If the rate changes, only the brightness along a streak determines the star's position at mid-exposure. An
    error of the acceleration shifts all stars along their paths by the same time interval, which does not
    average out over the stars. The time error common to all stars is at most the time error of the star with
    the most accurate position along its path.
    """
    if motion.acceleration is None or motion.rate is None:
        return np.zeros((3, 3))
    velocity = (motion.endpoints[:, 1] - motion.endpoints[:, 0]) / motion.exposure
    speed = np.linalg.norm(velocity, axis=1)
    moving = motion.used & (speed > 0.0)
    if not moving.any():
        return np.zeros((3, 3))
    along = np.einsum("ni,nij,nj->n", velocity, motion.star_covariance, velocity)[moving]
    return np.outer(motion.rate, motion.rate) * float(np.min(along / speed[moving] ** 4))


SHAPE_DOUBT = 0.05
"""Common centroid error of all stars, relative to the excess width of the PSF, from the campaign `resting`.
"""
# Minimum position error (px) of a star, due to residual lens distortion and to the colour of the star.
_LEAST_SIGMA_PX = 0.005
# Minimum position error (px) of a star due to its colour, if the accuracy of the lens is stated.
_COLOUR_PX = 0.002
# Excess chi-square (`ImageFit.excess`) above which the positions contradict their uncertainties.
_CONTRADICTED = 1.5
# Position error (px) assumed for an uncalibrated lens in the second attempt to identify the stars.
# The first attempt to identify the stars assumes smaller errors, so that fewer stars agree by chance.
_UNCALIBRATED_SIGMA_PX = 0.3
# Attitude error (px) due to an uncalibrated lens and refraction, after the fit of the lens.
# For the rotation about the boresight, an attitude error in px is measured at the image edge.
# The error is the difference between the attitudes that different solvers find for the same photograph.
_UNCALIBRATED_LENS_PX = 0.25
# Minimum flux of a streak used for identification, in standard deviations of the flux.
_LEAST_SIGNIFICANCE = 5.0
# Standard deviation (px) above which a star position is not used, for instance of a truncated streak.
_PLACELESS_PX = 5.0
# Distance (px) below which a point may be a part of the same star as a matched point.
_SPLIT_PX = 10.0
# Stars are assumed to be imaged as several points each if too many points are near matched points.
# The limit is the number of nearby points expected by chance, plus the sum of two terms.
# The first term is `_SPLIT_SIGMAS` standard deviations of the number of nearby points.
# The second term is the fraction `_SPLIT_SHARE` of the matched points.
_SPLIT_SIGMAS, _SPLIT_SHARE = 4.0, 0.25
# Largest chi-square of the difference of two attitudes that agree (1 false rejection in 100,000 frames).
_NEAR = 25.9
# Minimum height (standard deviations) of a star near its predicted position, and minimum number of stars.
# These limits are for a frame in which few stars are detected without a prediction.
_FAINT_SIGMAS, _FEWEST_FAINT = 3.5, 3
# Number of guide stars that the tracking mode searches near their predicted positions.
_LOOKED_FOR = 30
# Minimum and maximum search radius (px) around a predicted position.
# If a larger search radius is needed, a search of the whole frame is faster.
_LEAST_RADIUS_PX, _MOST_RADIUS_PX = 3.0, 15.0
# Maximum number of fits, each with larger variances for stars displaced by unresolved catalogue stars.
_COMPANION_ROUNDS = 3
# Distance (PSF widths) up to which an unresolved star can displace another one.
_COMPANION_REACH = 8.0
# Fraction of the matched points that are brighter than the faintest point that may show another attitude.
_BRIGHT_SHARE = 0.9
# Number of such points, without a matched point between their rows, for which another attitude is searched.
_NEIGHBOURS = 4
# Chi-square of a star, and number of such stars, above which a displaced part of the rows is searched.
_OUTLIER, _FEWEST_OUTLIERS = 12.0, 4
# Displacement (px) of a part of the rows above which an attitude is refused.
_LARGE_STEP_PX = 2.0


@dataclass(frozen=True, slots=True)
class SolveSettings:
    """Settings and methods of the star tracker.

    Attributes:
        detection: settings of the detection of points.
        likelihood: settings of the streak estimator for images from files; flight uses other settings.
        identification: settings of the default identification method.
        method: identification function, or None for the default method.
        attitude: solver of Wahba's problem, or None for the fit of the image positions.
        velocity: velocity of the camera relative to the solar system barycentre (3,), m/s, for the correction
            of aberration, or None for no correction.
        lens: standard deviations of the parameters of a lens with known focal length, or None if exact.
        uncalibrated_lens: whether optical axis and distortion are fitted too if the focal length is
            uncertain.
    """

    detection: DetectionSettings = field(default_factory=DetectionSettings)
    likelihood: LikelihoodSettings = field(default_factory=LikelihoodSettings)
    identification: IdentificationSettings = field(default_factory=IdentificationSettings)
    method: Callable[[StarField, SkyIndex], StarMatch] | None = None
    attitude: Solver | None = None
    velocity: FloatArray | None = None
    lens: CameraKnowledge | None = None
    uncalibrated_lens: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class AttitudePrior:
    """A predicted attitude (4,) of the camera, ICRS to camera axes, with `sigma` about each axis, rad."""

    quaternion: FloatArray
    sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class RatePrior:
    """A predicted angular velocity (3,) of the camera, rad/s, camera axes, with `sigma` per component.

    The rotation of the camera as a function of time during the exposure is `course`, or None if unknown.
    """

    rate: FloatArray
    sigma: float
    course: Course | None = None


def solve_points(
    found: Detections,
    camera: CameraModel,
    scale: tuple[float, float],
    sky: SkyIndex,
    settings: SolveSettings,
    prior: AttitudePrior | None = None,
) -> FrameSolution:
    """Return the attitude of a frame in which stars are detected as points."""
    solution = solve_places(
        found.points, found.covariance, FrameKind.POINTS, camera, scale, sky, settings, prior, found.flux
    )
    solution = _beside_companions(solution, found, camera, scale, sky, settings)
    return _in_one_piece(_shape_unknown(solution, found, settings), found.flux, sky, prior)


def solve_faint(
    pixels: Image,
    found: Detections,
    camera: CameraModel,
    scale: tuple[float, float],
    sky: SkyIndex,
    settings: SolveSettings,
) -> FrameSolution | None:
    """Return the attitude of a frame in which few stars are detected, from the light of faint stars, or None.

    The brightest sources `found` may be stars. At an attitude at which the light of faint stars is
    significant, the stars are measured near their predicted positions with a lower threshold.
    """
    seen = FrameSolution(SolveStatus.NO_STARS, "", FrameKind.POINTS, camera, found.points, found.covariance)
    limit = settings.identification.verification.log10_false_alarm
    field, light = star_field(seen, found.flux, scale), FrameLight.of(pixels, camera)
    match = match_by_light(field, sky, light, limit)
    if match is None:
        return None
    across, down = (width * match.scale for width in field.half_width)
    star = expected_stars(sky, match.matrix, (across, down), _LOOKED_FOR)
    places = camera.rescaled(1.0 / match.scale).project(sky.stars.direction[star] @ match.matrix.T)
    width = found.psf_sigma if settings.detection.psf_sigma is None else settings.detection.psf_sigma
    detection = replace(
        settings.detection,
        psf_sigma=accepted_psf(width) if math.isfinite(width) else None,
        threshold_sigmas=_FAINT_SIGMAS,
        search_radius=_LEAST_RADIUS_PX,
    )
    near = measure_near(pixels, places, detection).stars()
    if len(near) < _FEWEST_FAINT:
        return None
    identified = StarMatch(
        MatchStatus.IDENTIFIED,
        star[near.prediction],
        AttitudeFix(from_matrix(match.matrix), np.eye(3) / camera.focal_length**2, 0.0),
        match.scale,
        0.0 if scale[0] == scale[1] else 1.0,
        match.log10_chance,
    )
    seen = replace(seen, points=near.points, covariance=near.covariance, faint=True)
    return _shape_unknown(_with_attitude(seen, identified, sky, settings), near, settings)


def solve_places(
    points: FloatArray,
    covariance: FloatArray,
    kind: FrameKind,
    camera: CameraModel,
    scale: tuple[float, float],
    sky: SkyIndex,
    settings: SolveSettings,
    prior: AttitudePrior | None = None,
    flux: FloatArray | None = None,
) -> FrameSolution:
    """Return the attitude from star positions (n, 2), px, the brightest first, and their covariances."""
    seen = FrameSolution(
        SolveStatus.NO_STARS, "no star stands above the noise", kind, camera, points, covariance
    )
    return _identify(seen, flux, scale, sky, settings, prior) if len(points) else seen


def solve_motion(
    motion: MotionResult,
    camera: CameraModel,
    scale: tuple[float, float],
    sky: SkyIndex,
    settings: SolveSettings,
    prior: AttitudePrior | None = None,
) -> FrameSolution:
    """Return the attitude at mid-exposure of a frame of streaks, from the star positions in `motion`."""
    seen = FrameSolution(
        SolveStatus.NO_STARS,
        f"the streaks give no motion: {motion.reason or REASONS.get(motion.status, motion.status.value)}",
        FrameKind.STREAKS,
        camera,
        motion=motion,
    )
    placed = np.trace(motion.star_covariance, axis1=1, axis2=2) < 2.0 * _PLACELESS_PX**2
    chosen = np.flatnonzero(placed & (motion.significance > _LEAST_SIGNIFICANCE))
    chosen = chosen[np.argsort(-motion.flux[chosen], kind="stable")]
    if not len(chosen):
        return seen
    seen = replace(
        seen,
        points=motion.stars[chosen],
        covariance=motion.star_covariance[chosen],
        late=motion.line_time_displacement(chosen, camera.centre[1]),
    )
    solution = _identify(seen, motion.flux[chosen], scale, sky, settings, prior)
    if solution.fix is None:
        return solution
    covariance = solution.fix.covariance + timing_covariance(motion)
    fix = replace(solution.fix, covariance=covariance)
    return replace(solution, fix=fix, psf_sigma=motion.psf_sigma)


def points_near(
    pixels: Image,
    camera: CameraModel,
    sky: SkyIndex,
    settings: SolveSettings,
    prior: AttitudePrior,
    trails: ShortTrails | None = None,
) -> Detections:
    """Return the stars detected near the predicted positions of the brightest guide stars.

    If the prior attitude is too uncertain, no stars are returned. The argument `trails` describes the motion
    of the stars during the exposure, if the motion is known and no longer than a few pixels.
    """
    radius = PRIOR_SIGMAS * prior.sigma * camera.focal_length + _LEAST_RADIUS_PX
    if radius > _MOST_RADIUS_PX:
        return Detections.none()
    matrix = attitude_matrix(prior.quaternion)
    half_width = 0.5 * camera.columns / camera.focal_length, 0.5 * camera.rows / camera.focal_length
    expected = expected_stars(sky, matrix, half_width, _LOOKED_FOR)
    places = camera.project(sky.stars.direction[expected] @ matrix.T)
    trail = None if trails is None else trails.of(camera, sky.stars.direction[expected] @ matrix.T)
    return measure_near(pixels, places, replace(settings.detection, search_radius=radius), trail).stars()


def solve_near(
    pixels: Image,
    camera: CameraModel,
    scale: tuple[float, float],
    sky: SkyIndex,
    settings: SolveSettings,
    prior: AttitudePrior,
    trails: ShortTrails | None = None,
) -> FrameSolution | None:
    """Return the attitude from stars near their predicted positions, or None if the stars do not agree.

    The argument `trails` describes the motion of the stars during the exposure, as for `points_near`.
    """
    found = points_near(pixels, camera, sky, settings, prior, trails)
    if not len(found):
        return None
    late = np.zeros((len(found), 2)) if trails is None else trails.late(camera, found.points)
    points = found.points if trails is None else found.points - trails.delay * late
    seen = FrameSolution(
        SolveStatus.NO_STARS, "", FrameKind.POINTS, camera, points, found.covariance, tracked=True
    )
    if trails is not None and trails.delay_sigma:
        seen = replace(seen, late=trails.delay_sigma * late)
    near = track(star_field(seen, found.flux, scale), sky, prior.quaternion, prior.sigma)
    if near.status is not MatchStatus.IDENTIFIED:
        return None
    solution = _with_attitude(seen, near, sky, settings)
    solution = _beside_companions(solution, found, camera, scale, sky, settings)
    solution = _shape_unknown(solution, found, settings)
    solution = _in_one_piece(solution, found.flux, sky, prior) if trails is None else solution
    return solution if _agrees(solution, prior) else None


def _beside_companions(
    solution: FrameSolution,
    found: Detections,
    camera: CameraModel,
    scale: tuple[float, float],
    sky: SkyIndex,
    settings: SolveSettings,
) -> FrameSolution:
    """Return the solution with larger variances of the stars that an unresolved catalogue star displaces.

    A bright star that is measured together with a fainter neighbour is displaced by several of its standard
    deviations. Such a star can dominate the attitude and exclude undisplaced stars. If a star is displaced by
    more than its standard deviation, the stars are matched and the attitude is fitted again. The new attitude
    may match a displaced star that did not match before, so the check is repeated. The `camera` and `scale`
    must be those with which `solution` was computed.
    """
    for _ in range(_COMPANION_ROUNDS):
        shift = _shift_by_companions(solution, found.psf_sigma, sky, settings.velocity)
        displaced = shift**2 > 0.5 * np.trace(solution.covariance, axis1=1, axis2=2)
        if solution.fix is None or not np.any(displaced):
            break
        seen = _mirrored(solution) if solution.mirrored else solution
        doubt = np.where(displaced, shift**2, 0.0)[:, None, None] * np.eye(2)
        seen = replace(seen, camera=camera, covariance=seen.covariance + doubt)
        sigma = float(shift.max()) / solution.camera.focal_length
        near = track(star_field(seen, found.flux, scale), sky, solution.fix.quaternion, sigma)
        again = _with_attitude(seen, near, sky, settings)
        if near.status is not MatchStatus.IDENTIFIED or again.status is not SolveStatus.SOLVED:
            break
        again = replace(again, log10_false_alarm=solution.log10_false_alarm)
        solution = _mirrored(again) if solution.mirrored else again
    return solution


def _shift_by_companions(
    solution: FrameSolution, psf_sigma: float, sky: SkyIndex, velocity: FloatArray | None
) -> FloatArray:
    """Return the displacements (n,), px, of the measured stars by catalogue stars that were not measured.

    If all pixels have equal noise, a companion at the distance d displaces the fit of a Gaussian of width s
    by d exp(-d^2 / 4 s^2), times the ratio of the fluxes. For noise that grows with the brightness, the
    displacement is about twice as large; this displacement is returned.
    """
    shift = np.zeros(len(solution.points))
    if solution.fix is None or not math.isfinite(psf_sigma):
        return shift
    camera, star = solution.camera, solution.star[solution.matched]
    half_width = 0.5 * camera.columns / camera.focal_length, 0.5 * camera.rows / camera.focal_length
    matrix, direction = attitude_matrix(solution.fix.quaternion), sky.stars.direction
    width = math.sqrt(psf_sigma**2 + PIXEL_VARIANCE)
    companion = np.setdiff1d(expected_stars(sky, matrix, half_width, len(sky.stars)), star)
    nearest = np.max(direction[companion] @ direction[star].T, axis=1, initial=-1.0)
    companion = companion[nearest > math.cos(_COMPANION_REACH * width / camera.focal_length)]
    # A companion at an unmatched point was measured together with the star, and does not displace it.
    seen = _mirrored(solution) if solution.mirrored else solution
    rest = camera.unit_vectors(np.delete(seen.points, solution.matched, axis=0)) @ matrix
    rest = rest[np.isfinite(rest).all(axis=1)]
    rest = rest if velocity is None else apparent(rest, -velocity)
    nearest = np.max(direction[companion] @ rest.T, axis=1, initial=-1.0)
    companion = companion[np.arccos(np.minimum(nearest, 1.0)) * camera.focal_length > psf_sigma + 0.5]
    apart = direction[companion] - direction[star, None]
    distance = camera.focal_length * np.linalg.norm(apart, axis=-1)
    fainter = sky.stars.magnitude[companion] - sky.stars.magnitude[star, None]
    weight = 2.0 * np.exp(-(distance**2) / (4.0 * width**2))
    shift[solution.matched] = np.sum(distance * np.minimum(10.0 ** (-0.4 * fainter) * weight, 1.0), axis=1)
    return shift


def _agrees(solution: FrameSolution, prior: AttitudePrior) -> bool:
    """Return whether an attitude agrees with the prior attitude."""
    if solution.fix is None:
        return True
    known = solution.fix.covariance + prior.sigma**2 * np.eye(3)
    return attitudes_agree(solution.fix.quaternion, prior.quaternion, known)


def attitudes_agree(one: FloatArray, other: FloatArray, covariance: FloatArray) -> bool:
    """Return whether the difference of two attitudes (4,) agrees with its covariance (3, 3), rad^2."""
    off = to_rotation_vector(multiply(one, conjugate(other)))
    return bool(off @ np.linalg.solve(covariance, off) < _NEAR)


def _shape_unknown(solution: FrameSolution, found: Detections, settings: SolveSettings) -> FrameSolution:
    """Return the solution with its covariance increased if the stars are wider than the given PSF.

    If star images have a tail, due to the lens or to stray light, the centroids depend on the weights of the
    pixels, and all positions have a common error.
    """
    width, given = found.width[np.isfinite(found.width)], settings.detection.psf_sigma
    if solution.fix is None or given is None or not len(width):
        return solution
    measured = float(np.median(width))
    doubt = SHAPE_DOUBT * abs(measured - given) / solution.camera.focal_length
    # The measured width includes the averaging over a pixel; the variance due to averaging is subtracted.
    psf_sigma = math.sqrt(max(measured**2 - PIXEL_VARIANCE, 0.0))
    return replace(solution, psf_sigma=psf_sigma).wider(np.diag([doubt**2, doubt**2, 0.0]))


def _in_one_piece(
    solution: FrameSolution, flux: FloatArray, sky: SkyIndex, prior: AttitudePrior | None
) -> FrameSolution:
    """Return the solution; the attitude is refused or less certain if a part of the rows is displaced.

    See `torn_frames`. The argument `flux` contains the flux (n,) of each point. Stars at another attitude
    that contradicts the prior do not make the attitude ambiguous. Frames of a rotating camera are not
    examined, because an uneven rotation displaces stars too.
    """
    if solution.fix is None:
        return solution
    seen = _mirrored(solution) if solution.mirrored else solution
    camera, matched = seen.camera, seen.matched
    residual, rows = seen.points[matched] - seen.expected[matched], seen.points[matched, 1]
    # A displacement is searched only if several stars have large residuals.
    squares = 2.0 * np.sum(residual**2, axis=1) / np.trace(seen.covariance[matched], axis1=1, axis2=2)
    step, count, fitted = np.zeros(2), 0, bool(seen.bend.any())
    if np.count_nonzero(squares > _OUTLIER) >= _FEWEST_OUTLIERS:
        step = displacement(seen.points[matched], residual, seen.covariance[matched], camera, fitted)
    rest = np.flatnonzero(seen.star < 0)
    rest = rest[rest < matched[int(_BRIGHT_SHARE * (len(matched) - 1))]]
    if _has_neighbours(rows, seen.points[rest, 1]):
        part = replace(seen, points=seen.points[rest], covariance=seen.covariance[rest])
        stars = star_field(part, flux[rest], (1.0, 1.0))
        known = None if prior is None else (prior.quaternion, prior.sigma)
        count = at_another_attitude(part.points, stars, rows, camera, solution.fix, sky, known, fitted)
    if not count and math.hypot(*step) < _LARGE_STEP_PX:
        about = 2.0 * math.hypot(*step) / max(camera.columns, camera.rows)
        turn = np.array([step[1] / camera.focal_length, -step[0] / camera.focal_length, 0.0])
        doubt = np.outer(turn, turn) + np.diag([0.0, 0.0, about**2])
        return replace(solution.wider(doubt), torn=bool(step.any()))
    reason = "the stars of other rows are displaced"
    if count:
        reason = f"{count} stars in other rows show another attitude"
    unsolved = FrameSolution(
        SolveStatus.AMBIGUOUS,
        f"{len(matched)} stars show one attitude, but {reason}: a part of the image is displaced or from "
        "another exposure",
        solution.kind,
        camera,
        solution.points,
        solution.covariance,
    )
    return replace(unsolved, motion=solution.motion, torn=True)


def _has_neighbours(rows: FloatArray, others: FloatArray) -> bool:
    """Return whether several unmatched points are next to each other in the order of the rows.

    The arguments are the rows of the matched points (n,) and of the unmatched points (m,).
    """
    owner = np.repeat([0, 1], [len(rows), len(others)])[np.argsort(np.append(rows, others), kind="stable")]
    sums = np.cumsum(np.append(np.zeros(_NEIGHBOURS, dtype=np.int64), owner))
    return bool(np.any(sums[_NEIGHBOURS:] - sums[:-_NEIGHBOURS] == _NEIGHBOURS))


def _identify(
    seen: FrameSolution,
    flux: FloatArray | None,
    scale: tuple[float, float],
    sky: SkyIndex,
    settings: SolveSettings,
    prior: AttitudePrior | None,
) -> FrameSolution:
    """Return the solution with stars identified near the prior or, if that fails, in the whole sky."""
    stars = star_field(seen, flux, scale)
    if prior is not None:
        near = track(stars, sky, prior.quaternion, prior.sigma)
        if near.status is MatchStatus.IDENTIFIED:
            solution = _with_attitude(replace(seen, tracked=True), near, sky, settings)
            if _agrees(solution, prior):
                return solution
    if settings.method is not None:
        return _with_attitude(seen, settings.method(stars, sky), sky, settings)
    options = settings.identification
    if seen.kind is FrameKind.STREAKS:
        # Streaks are not matched with the mirrored sky, because the rate from a mirrored image is wrong.
        options = replace(options, mirror=False)
    found = identify(stars, sky, options)
    if found.status is MatchStatus.NO_MATCH and settings.uncalibrated_lens and scale[0] != scale[1]:
        found = identify(star_field(seen, flux, scale, _UNCALIBRATED_SIGMA_PX), sky, options)
    if found.mirrored:
        # The attitude is fitted to the mirrored positions, and the original positions are reported.
        return _mirrored(replace(_with_attitude(_mirrored(seen), found, sky, settings), mirrored=True))
    return _with_attitude(seen, found, sky, settings)


def _mirrored(seen: FrameSolution) -> FrameSolution:
    """Return the solution `seen` with its star positions mirrored about the optical axis (left to right)."""
    axis = np.array([2.0 * seen.camera.centre[0], 0.0])
    turned = np.array([-1.0, 1.0])
    return replace(
        seen,
        points=axis + turned * seen.points,
        expected=axis + turned * seen.expected if len(seen.expected) else seen.expected,
        covariance=seen.covariance * np.outer(turned, turned),
        late=turned * seen.late,
    )


def star_field(
    seen: FrameSolution, flux: FloatArray | None, scale: tuple[float, float], least: float = _LEAST_SIGMA_PX
) -> StarField:
    """Return the points of a frame as a `StarField`; their standard deviations are at least `least` px."""
    camera = seen.camera
    direction = camera.unit_vectors(seen.points)
    pixels = np.sqrt(0.5 * (seen.covariance[:, 0, 0] + seen.covariance[:, 1, 1]) + least**2)
    # At an angle a from the boresight, a pixel subtends a radial angle that is proportional to cos^2 a.
    # The tangential angle is proportional to cos a.
    sigma = pixels / camera.focal_length * direction[:, 2] ** 1.5
    half_width = 0.5 * camera.columns / camera.focal_length, 0.5 * camera.rows / camera.focal_length
    magnitude = None if flux is None else -2.5 * np.log10(flux)
    return StarField(direction, sigma, half_width, scale, magnitude)


def _with_attitude(
    seen: FrameSolution, found: StarMatch, sky: SkyIndex, settings: SolveSettings
) -> FrameSolution:
    """Return the solution with the identified stars and the attitude fitted to their image positions."""
    if found.status is not MatchStatus.IDENTIFIED or found.fix is None:
        return replace(seen, status=SolveStatus(found.status.value), reason=_reason(found.status, seen))
    free_scale = found.scale_sigma > 0.0
    free_lens = free_scale and settings.uncalibrated_lens
    camera = _camera_found(seen.camera, found)
    chosen = np.flatnonzero(found.star >= 0)
    reference = sky.stars.direction[found.star[chosen]]
    if settings.velocity is not None:
        reference = apparent(reference, settings.velocity)
    # The array `known` is the prior information about lens errors; it is empty if they are not fitted.
    known = np.zeros(0)
    if free_lens:
        known = usual_bend(camera)
    elif not free_scale and settings.lens is not None:
        known = known_bend(camera, settings.lens)
    least = _COLOUR_PX if settings.lens is not None and not len(known) else _LEAST_SIGMA_PX
    covariance = seen.covariance[chosen] + least**2 * np.eye(2)
    places, late = seen.points[chosen], seen.late[chosen] if len(seen.late) else seen.late
    unknowns = Unknowns(free_scale, known, late, seen.kind is FrameKind.STREAKS)
    try:
        fit = fit_in_image(places, covariance, reference, camera, found.fix.quaternion, unknowns)
        fix = fit.fix
        if settings.attitude is not None:
            fix = attitude_by(settings.attitude, places, covariance, reference, camera, fit, late)
    except AttitudeError as error:
        return replace(seen, status=SolveStatus.AMBIGUOUS, reason=str(error))
    if problem := _contradiction(seen, chosen, fit):
        return replace(seen, status=SolveStatus.AMBIGUOUS, reason=problem)
    camera = camera.rescaled(1.0 / fit.scale)
    if found.from_lens is not None:
        fix = replace(fix, covariance=fix.covariance + found.from_lens)
    if free_lens:
        # An uncalibrated lens adds the attitude error `_UNCALIBRATED_LENS_PX` to the covariance.
        across, about = 1.0 / camera.focal_length, 2.0 / max(camera.columns, camera.rows)
        floor = np.diag((_UNCALIBRATED_LENS_PX * np.array([across, across, about])) ** 2)
        fix = replace(fix, covariance=fix.covariance + floor)
    fix = replace(fix, covariance=fix.covariance + _split_doubt(seen, chosen))
    expected = np.full_like(seen.points, np.nan)
    expected[chosen] = SkyMap(camera, fix.quaternion, fit.bend).pixels(reference)
    if len(late):
        expected[chosen] += fit.delay * late
    return replace(
        seen,
        status=SolveStatus.SOLVED,
        reason="",
        camera=camera,
        star=found.star,
        expected=expected,
        fix=fix,
        scale_sigma=fit.scale_sigma,
        bend=fit.bend,
        log10_false_alarm=found.log10_false_alarm,
    )


def _contradiction(seen: FrameSolution, chosen: IntArray, fit: ImageFit) -> str:
    """Return the reason to reject an attitude whose points have too large residuals, or an empty string.

    If the positions are wrong, for example because a defocused lens images stars as rings, only points that
    are within the gate by chance match. If fewer than half of the points match, the matching points are
    possibly only those that lie near stars by chance. The residuals of such chance matches do not show that
    the positions are wrong. Only points down to the median brightness of the matching points are counted,
    because faint points may be noise or stars that are not in the catalogue. The array `chosen` contains the
    indices of the fitted points.
    """
    agreeing = chosen[fit.agree]
    if seen.kind is not FrameKind.POINTS or fit.excess < _CONTRADICTED or not len(agreeing):
        return ""
    bright = int(np.sort(agreeing)[(len(agreeing) - 1) // 2]) + 1
    missed = bright - int(np.count_nonzero(agreeing < bright))
    if 2 * missed <= bright:
        return ""
    return (
        f"{missed} of the {bright} brightest points match no star, and the others are "
        f"{math.sqrt(fit.excess):.1f} times their uncertainty away from stars: check the focus"
    )


def _split_doubt(seen: FrameSolution, chosen: IntArray) -> FloatArray:
    """Return the attitude covariance (3, 3), rad^2, due to star images that consist of several points.

    A star in a defocused or shaken image appears as several points, of which one matches the star. If the
    matched point is in the same part of every star's image, all star positions have a common error, which the
    residuals do not show. The common position error is about half of the distance between the points of one
    star. The array `chosen` contains the indices of the matched points.
    """
    doubt = np.zeros((3, 3))
    if seen.kind is not FrameKind.POINTS:
        return doubt
    rest = np.ones(len(seen.points), dtype=np.bool_)
    rest[chosen] = False
    apart = seen.points[rest] - seen.points[chosen, None]
    parts = apart[apart[..., 0] ** 2 + apart[..., 1] ** 2 < _SPLIT_PX**2]
    chance = apart[..., 0].size * math.pi * _SPLIT_PX**2 / (seen.camera.columns * seen.camera.rows)
    if len(parts) > chance + _SPLIT_SIGMAS * math.sqrt(chance) + _SPLIT_SHARE * len(chosen):
        half = np.einsum("ni,nj->ij", parts, parts) / (4.0 * len(parts) * seen.camera.focal_length**2)
        # A shift of the image along x is a rotation about y, and a shift along y is a rotation about -x.
        doubt[:2, :2] = ((half[1, 1], -half[0, 1]), (-half[0, 1], half[0, 0]))
    return doubt


def _camera_found(camera: CameraModel, found: StarMatch) -> CameraModel:
    """Return the camera with the fitted focal length and, if it is a pinhole, with the fitted distortion."""
    camera = camera.rescaled(1.0 / found.scale)
    if found.distortion == 0.0 or not isinstance(camera, Pinhole):
        return camera
    # Unlike k1, the coefficient `distortion` applies to tangents divided by the image corner's tangent.
    corner = 0.5 * math.hypot(camera.columns, camera.rows) / camera.focal_length
    try:
        k1 = found.distortion / corner**2
        return Lens(camera.columns, camera.rows, camera.focal_length, camera.centre, k1)
    except LensError:
        return camera


def _reason(status: MatchStatus, seen: FrameSolution) -> str:
    count = len(seen.points)
    return {
        MatchStatus.TOO_FEW_STARS: f"{count} stars are too few for an identification",
        MatchStatus.AMBIGUOUS: f"the {count} brightest points match several parts of the sky",
    }.get(status, f"the {count} brightest points match no part of the sky beyond chance")
