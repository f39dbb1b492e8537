"""The steps from the stars of a frame to its attitude; `knightcube.vision.frame_job` chooses among them.

Points are measured by `detection`; for streaks, the positions of their stars at mid-exposure serve as points.
Identification searches near a prior attitude first, if there is one, then in the whole sky. The result is the
attitude at mid-exposure.

At a constant rate the middle of a streak is the position of the star at mid-exposure. An acceleration a
shifts the mean of a point's light by a T^2 / 24 and the middle of the two ends of a streak by a T^2 / 8. A
fit that includes the acceleration is shifted only by terms beyond the square of time. White angular
acceleration of density q adds the variance q T^3 over 320, 48 and 4743 respectively (the integrals of its
second integral over the same weights).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np

from knightcube.astro.arrays import FloatArray, Image, IntArray
from knightcube.astro.attitude.wahba import AttitudeError, AttitudeFix, Solver
from knightcube.astro.quaternion import attitude_matrix, conjugate, multiply, to_rotation_vector
from knightcube.vision.camera.lens import CameraKnowledge, CameraModel, Lens, LensError, Pinhole
from knightcube.vision.startracker.attitude_fit import MatchStatus, StarField, StarMatch
from knightcube.vision.startracker.detection import (
    Detections,
    DetectionSettings,
    FrameKind,
    measure_near,
)
from knightcube.vision.startracker.image_fit import Unknowns, attitude_by, fit_in_image
from knightcube.vision.startracker.index.sky_index import SkyIndex
from knightcube.vision.startracker.lost_in_space import IdentificationSettings, identify
from knightcube.vision.startracker.sky_map import BENDS, ShortTrails, SkyMap, apparent, known_bend, usual_bend
from knightcube.vision.startracker.verification import PRIOR_SIGMAS, expected_stars, track
from knightcube.vision.streaks.geometry import Course
from knightcube.vision.streaks.settings import LikelihoodSettings
from knightcube.vision.streaks.streak_result import FrameMotion, MotionResult, StreakStatus


class SolveStatus(Enum):
    """The outcome of one frame."""

    SOLVED = "solved"
    NO_STARS = "no-stars"
    TOO_FEW_STARS = "too-few-stars"
    NO_MATCH = "no-match"
    AMBIGUOUS = "ambiguous"


@dataclass(frozen=True, slots=True, eq=False)
class FrameSolution:
    """The attitude of one frame at mid-exposure, and the rate if the stars are streaks.

    Attributes:
        status: the attributes from `star` on are valid for SOLVED only.
        reason: why the frame was not solved, in one sentence; empty if it was.
        kind: whether the frame shows points or streaks.
        camera: the camera, with the focal length fitted to the stars if it was free.
        points: positions of the detected stars at mid-exposure (n, 2), px, the brightest first.
        covariance: covariance of the positions (n, 2, 2), px^2.
        late: displacement of the points (n, 2), px, due to an error of one standard deviation of the
            shutter's line time; (0, 2) if the line time is exact.
        star: indices of the guide stars (n,); -1 for a point without a guide star.
        expected: predicted positions of the guide stars (n, 2), px; NaN for a point without a guide star.
        fix: attitude, ICRS to camera, and its covariance; the scalar part of the quaternion is not negative.
        scale_sigma: relative standard deviation of the focal length; 0 if it was given.
        bend: fitted errors of an inexact lens (6,), see `sky_map`; zeros for an exact lens.
        log10_false_alarm: log10 of the probability that a frame of random points would have been solved.
        tracked: whether the stars were identified near the prior attitude.
        motion: motion from the streaks, camera frame; None for points.
        mirrored: whether the image shows the mirrored sky. `fix` is then the attitude of the image with left
            and right exchanged about the optical axis; `points` and `expected` refer to the original image.
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
    motion: MotionResult | None = None
    mirrored: bool = False

    @property
    def matched(self) -> IntArray:
        """The numbers (m,) of the points that are guide stars."""
        return np.flatnonzero(self.star >= 0)

    def wider(self, by: FloatArray) -> FrameSolution:
        """Return the solution with `by` (3, 3), rad^2, added to the covariance of its attitude, if any."""
        if self.fix is None:
            return self
        return replace(self, fix=replace(self.fix, covariance=self.fix.covariance + by))

    def sky_map(self, velocity: FloatArray | None = None) -> SkyMap | None:
        """Return the conversion between pixels and directions; None if the frame was not solved.

        `velocity` (3,), m/s, is the velocity with which the frame was solved.
        """
        return None if self.fix is None else SkyMap(self.camera, self.fix.quaternion, self.bend, velocity)


NODES = (0.0, 0.25, 0.75, 1.0)
"""Fractions of the exposure at which the rotation since mid-exposure is evaluated."""
MOVED = {StreakStatus.RATE, StreakStatus.AMBIGUOUS}


@dataclass(frozen=True, slots=True)
class Weighting:
    """The weights with which the attitude of a frame averages the attitudes during its exposure.

    Attributes:
        weights: weights of the rotations at `NODES`; the remainder to one is the weight of mid-exposure.
        noise_share: variance due to white angular acceleration, in units of q T^3.
    """

    weights: tuple[float, float, float, float]
    noise_share: float


MEAN = Weighting((1 / 12, 1 / 3, 1 / 3, 1 / 12), 1 / 320)
"""Weighting of points, which show the mean attitude over the exposure, by Simpson's rule."""
ENDS = Weighting((1 / 2, 0.0, 0.0, 1 / 2), 1 / 48)
"""Weighting of streaks that are fitted with a constant rate or measured only at their ends."""
MIDDLE = Weighting((-2 / 35, 8 / 35, 8 / 35, -2 / 35), 1 / 4743)
"""Weighting of streaks that are fitted with an acceleration, by the middle of the best-fitting parabola."""


def weighting_of(motion: FrameMotion) -> Weighting:
    """Return the weighting of a frame with this motion."""
    if motion.status not in MOVED:
        return MEAN
    fitted = isinstance(motion, MotionResult) and motion.rate_model == "accelerating"
    return MIDDLE if fitted else ENDS


def middle_covariance(
    weighting: Weighting, turns: FloatArray, angular_acceleration_psd: FloatArray, exposure: float
) -> FloatArray:
    """Return the covariance (3, 3), rad^2, of the measured attitude relative to that at mid-exposure.

    Args:
        weighting: weighting of the frame.
        turns: estimated rotations from mid-exposure to each of `NODES` (4, 3), rad.
        angular_acceleration_psd: density of unmodelled white angular acceleration (3, 3), rad^2/s^3.
        exposure: exposure time, s.
    """
    known = np.asarray(weighting.weights) @ turns
    return np.outer(known, known) + angular_acceleration_psd * weighting.noise_share * exposure**3


def timing_covariance(motion: MotionResult) -> FloatArray:
    """Return the covariance (3, 3), rad^2, of the rotation error that all stars of a frame share.

    If the rate changes, only the light along a streak determines its position at mid-exposure. An error of
    the acceleration shifts all stars along their paths by the same time, which does not average out over the
    stars. The uncertainty of the most accurate star along its path bounds this error.
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


# Position error (px) due to residual distortion of the lens or to the colour of the star.
_LEAST_SIGMA_PX = 0.005
# Position error (px) due to the colour of the star, for a lens of stated accuracy.
_COLOUR_PX = 0.002
# Common centroid error, as a fraction of the excess PSF width (campaign `resting`).
_SHAPE_DOUBT = 0.05
# Position error (px) of an uncalibrated lens in the second attempt of an identification.
# The first attempt uses only the errors of the positions, within which fewer stars agree by chance.
_UNCALIBRATED_SIGMA_PX = 0.3
# Attitude error of an uncalibrated lens and of refraction that the fit of the lens does not remove.
# It is in px across the boresight, and in px at the image edge for the rotation about it.
# Attitudes of photographs by other solvers differ by this value.
_UNCALIBRATED_LENS_PX = 0.25
# Minimum significance of a streaked star (standard deviations of its light) for identification.
_LEAST_SIGNIFICANCE = 5.0
# Standard deviation (px) above which a position is unusable, for example if the streak ends outside the
# frame.
_PLACELESS_PX = 5.0
# Largest chi-square of the difference from the prior attitude, exceeded by chance once in 100,000 cases.
_NEAR = 25.9
# Number of guide stars that tracking searches in the frame, within PRIOR_SIGMAS of the prior.
_LOOKED_FOR = 30
# Minimum and maximum search radius (px).
# Above the maximum, a search of the whole frame is faster.
_LEAST_RADIUS_PX, _MOST_RADIUS_PX = 3.0, 15.0


@dataclass(frozen=True, slots=True)
class SolveSettings:
    """Settings and methods of the star tracker.

    Attributes:
        detection: settings of the detection of points.
        likelihood: settings of the estimator of streaks in a picture; in flight the job has its own.
        identification: settings of the default identification method.
        method: another identification method; None: the default.
        attitude: a solver of Wahba's problem for the attitude; None: the fit in the image.
        velocity: velocity of the camera relative to the barycentre (3,), m/s, for aberration; None: no
            correction.
        lens: accuracy of a lens of known focal length; None: exact.
        uncalibrated_lens: whether a lens of uncertain focal length may have a displaced axis and distortion.
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
    """A predicted attitude (4,), ICRS to camera, and its standard deviation about each axis, rad."""

    quaternion: FloatArray
    sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class RatePrior:
    """A predicted rate (3,), rad/s, camera axes, and the standard deviation of each component.

    `course` is the rotation of the camera over the exposure, if it is known.
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
    """Return the attitude of a frame of detected points."""
    solution = solve_places(
        found.points, found.covariance, FrameKind.POINTS, camera, scale, sky, settings, prior, found.flux
    )
    return _shape_unknown(solution, found, settings)


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
    """Return the attitude from positions (n, 2), px, of stars, the brightest first, and their covariances."""
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
    """Return the attitude at mid-exposure of a frame of streaks, from the motion and its star positions."""
    seen = FrameSolution(
        SolveStatus.NO_STARS,
        f"the streaks give no motion: {motion.status.value}",
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
    return replace(solution, fix=replace(solution.fix, covariance=covariance))


def points_near(
    pixels: Image,
    camera: CameraModel,
    sky: SkyIndex,
    settings: SolveSettings,
    prior: AttitudePrior,
    trails: ShortTrails | None = None,
) -> Detections:
    """Return the stars near the predicted positions of the brightest guide stars.

    If the prior is too uncertain, no stars are returned. `trails` is the motion of the stars over the
    exposure, if it is known and at most a few pixels.
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
    """Return the attitude from stars near their predicted positions; None if they do not agree.

    `trails` is as in `points_near`.
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
    solution = _shape_unknown(_with_attitude(seen, near, sky, settings), found, settings)
    return solution if _agrees(solution, prior) else None


def _agrees(solution: FrameSolution, prior: AttitudePrior) -> bool:
    """Return whether an attitude agrees with the prior, near which alone its significance is valid."""
    if solution.fix is None:
        return True
    off = to_rotation_vector(multiply(solution.fix.quaternion, conjugate(prior.quaternion)))
    known = solution.fix.covariance + prior.sigma**2 * np.eye(3)
    return bool(off @ np.linalg.solve(known, off) < _NEAR)


def _shape_unknown(solution: FrameSolution, found: Detections, settings: SolveSettings) -> FrameSolution:
    """Return the solution with its covariance increased if the stars are wider than the given PSF.

    If the images of stars have a tail, due to the lens or to stray light, the centroid depends on the weights
    of the pixels, which causes the same error of all positions.
    """
    width, given = found.width[np.isfinite(found.width)], settings.detection.psf_sigma
    if solution.fix is None or given is None or not len(width):
        return solution
    doubt = _SHAPE_DOUBT * abs(float(np.median(width)) - given) / solution.camera.focal_length
    return solution.wider(np.diag([doubt**2, doubt**2, 0.0]))


def _identify(
    seen: FrameSolution,
    flux: FloatArray | None,
    scale: tuple[float, float],
    sky: SkyIndex,
    settings: SolveSettings,
    prior: AttitudePrior | None,
) -> FrameSolution:
    """Return `seen` with its stars identified, first near the prior, then in the whole sky."""
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
        # Streaks are not matched with the mirrored sky, because the rate would be wrong.
        options = replace(options, mirror=False)
    found = identify(stars, sky, options)
    if found.status is MatchStatus.NO_MATCH and settings.uncalibrated_lens and scale[0] != scale[1]:
        found = identify(star_field(seen, flux, scale, _UNCALIBRATED_SIGMA_PX), sky, options)
    if found.mirrored:
        # The mirrored positions are fitted, and the original ones reported.
        return _mirrored(replace(_with_attitude(_mirrored(seen), found, sky, settings), mirrored=True))
    return _with_attitude(seen, found, sky, settings)


def _mirrored(seen: FrameSolution) -> FrameSolution:
    """Return `seen` with left and right of its positions exchanged about the optical axis."""
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
    """Return the points of `seen` as directions for identification, with errors of at least `least` px."""
    camera = seen.camera
    direction = camera.unit_vectors(seen.points)
    pixels = np.sqrt(0.5 * np.trace(seen.covariance, axis1=1, axis2=2) + least**2)
    # Off the boresight a pixel subtends a smaller angle: by cos^2 along the radius and by cos across it.
    sigma = pixels / camera.focal_length * direction[:, 2] ** 1.5
    half_width = 0.5 * camera.columns / camera.focal_length, 0.5 * camera.rows / camera.focal_length
    magnitude = None if flux is None else -2.5 * np.log10(flux)
    return StarField(direction, sigma, half_width, scale, magnitude)


def _with_attitude(
    seen: FrameSolution, found: StarMatch, sky: SkyIndex, settings: SolveSettings
) -> FrameSolution:
    """Return `seen` with the identified stars and the attitude fitted to their positions in the image."""
    if found.status is not MatchStatus.IDENTIFIED or found.fix is None:
        return replace(seen, status=SolveStatus(found.status.value), reason=_reason(found.status, seen))
    free_scale = found.scale_sigma > 0.0
    free_lens = free_scale and settings.uncalibrated_lens
    camera = _camera_found(seen.camera, found)
    chosen = np.flatnonzero(found.star >= 0)
    reference = sky.stars.direction[found.star[chosen]]
    if settings.velocity is not None:
        reference = apparent(reference, settings.velocity)
    # The prior information about the bend of the lens is empty if no bend is fitted.
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
    camera = camera.rescaled(1.0 / fit.scale)
    if found.from_lens is not None:
        fix = replace(fix, covariance=fix.covariance + found.from_lens)
    if free_lens:
        # The covariance that an uncalibrated lens adds.
        across, about = 1.0 / camera.focal_length, 2.0 / max(camera.columns, camera.rows)
        floor = np.diag((_UNCALIBRATED_LENS_PX * np.array([across, across, about])) ** 2)
        fix = replace(fix, covariance=fix.covariance + floor)
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


def _camera_found(camera: CameraModel, found: StarMatch) -> CameraModel:
    """Return the camera with the fitted focal length, and a pinhole with the fitted distortion."""
    camera = camera.rescaled(1.0 / found.scale)
    if found.distortion == 0.0 or not isinstance(camera, Pinhole):
        return camera
    # `distortion` is relative to the square of the corner's tangent, k1 to the square of the tangent.
    corner = 0.5 * math.hypot(camera.columns, camera.rows) / camera.focal_length
    try:
        return replace(Lens.of(camera), k1=found.distortion / corner**2)
    except LensError:
        return camera


def _reason(status: MatchStatus, seen: FrameSolution) -> str:
    count = len(seen.points)
    return {
        MatchStatus.TOO_FEW_STARS: f"{count} stars are too few to identify",
        MatchStatus.AMBIGUOUS: f"the {count} brightest points match the sky in more than one place",
    }.get(status, f"the {count} brightest points match no part of the sky beyond chance")
