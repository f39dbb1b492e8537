"""From a frame to an attitude: the one way into the star tracker, for points and for streaks.

A frame of points is measured by `detection`; one of streaks by the joint fit of `flight.gnc.vision.streaks`,
whose stars' places at mid-exposure then serve as points. Identification asks the whole sky, or where a prior
attitude
tells where to look, only there, and the whole sky if that fails. The attitude is that of mid-exposure.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from flight.gnc.attitude.wahba import AttitudeError
from flight.gnc.camera.lens import CameraModel
from flight.gnc.math.arrays import FloatArray, Image
from flight.gnc.math.quaternion import attitude_matrix
from flight.gnc.vision.startracker.aberration import apparent
from flight.gnc.vision.startracker.detection import (
    Detections,
    DetectionSettings,
    FrameKind,
    measure_areas,
    measure_near,
    survey,
)
from flight.gnc.vision.startracker.identification.field import StarField
from flight.gnc.vision.startracker.identification.identification import Identification, Status
from flight.gnc.vision.startracker.identification.lost_in_space import IdentificationSettings, identify
from flight.gnc.vision.startracker.identification.tracking import track
from flight.gnc.vision.startracker.identification.verification import expected_stars
from flight.gnc.vision.startracker.image_fit import fit_in_image
from flight.gnc.vision.startracker.index.sky_index import SkyIndex
from flight.gnc.vision.startracker.mid_exposure import lateness
from flight.gnc.vision.startracker.solution import FrameSolution, SolveStatus
from flight.gnc.vision.streaks.maximum_likelihood.result import MotionResult
from flight.gnc.vision.streaks.maximum_likelihood.settings import LikelihoodSettings

# px: what a lens's distortion that is not known, or a star's colour, adds to the error of a place.
_LEAST_SIGMA_PX = 0.005
# Of the motion's stars those so far below their noise are none.
_LEAST_SIGNIFICANCE = 5.0
# The motion is fitted anew where the focal length was wrong by more.
_SCALE_TOLERANCE = 0.01
# Tracking looks for so many stars, within so many sigmas of the prior; in wider circles it would not pay.
_LOOKED_FOR = 30
_PRIOR_SIGMAS = 4.0
_LEAST_RADIUS_PX, _MOST_RADIUS_PX = 3.0, 15.0
# A star that moves by less over the exposure is a point.
_POINT_PX = 1.0


@dataclass(frozen=True, slots=True)
class SolveSettings:
    """How a frame is solved.

    Attributes:
        detection: of points.
        likelihood: of streaks.
        identification: of both.
        method: of identification, in place of the default one.
        velocity: (3,) m/s of the camera about the Sun, for aberration; None leaves it out.
    """

    detection: DetectionSettings = field(default_factory=DetectionSettings)
    likelihood: LikelihoodSettings = field(default_factory=LikelihoodSettings)
    identification: IdentificationSettings = field(default_factory=IdentificationSettings)
    method: Callable[[StarField, SkyIndex], Identification] | None = None
    velocity: FloatArray | None = None


@dataclass(frozen=True, slots=True, eq=False)
class AttitudePrior:
    """Where the camera is believed to look: (4,) ICRS to camera, and rad of uncertainty about each axis."""

    quaternion: FloatArray
    sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class RatePrior:
    """How it is believed to turn: (3,) rad/s in the camera's axes, and its standard deviation."""

    rate: FloatArray
    sigma: float


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
    """Return the attitude of a frame (rows, columns), and its rate if it streaks.

    Args:
        pixels: counts.
        camera: as believed, of the frame's shape.
        scale: (lowest, highest) factor of the tangents: (1, 1) for a calibrated camera.
        exposure: s.
        sky: the guide stars.
        settings: of the steps.
        attitude_prior: where to look first.
        rate_prior: tells the direction of time, which one frame does not.
    """
    if attitude_prior is not None and _at_rest(rate_prior, camera, exposure):
        near = solve_near(pixels, camera, scale, sky, settings, attitude_prior)
        if near is not None:
            return near
    seen = survey(pixels, settings.detection)
    if seen.shape.kind is not FrameKind.STREAKS:
        found = measure_areas(seen).stars()
        return solve_points(found, camera, scale, sky, settings, attitude_prior)
    motion = _motion(pixels, camera, exposure, settings, rate_prior)
    solution = solve_motion(motion, camera, scale, sky, settings, attitude_prior)
    if solution.status is SolveStatus.SOLVED and _far(solution.camera, camera):
        motion = _motion(pixels, solution.camera, exposure, settings, rate_prior)
        solution = solve_motion(motion, solution.camera, (1.0, 1.0), sky, settings, attitude_prior)
    return solution


def solve_points(
    found: Detections,
    camera: CameraModel,
    scale: tuple[float, float],
    sky: SkyIndex,
    settings: SolveSettings,
    prior: AttitudePrior | None = None,
) -> FrameSolution:
    """Return the attitude of a frame of points, as detected."""
    return solve_places(
        found.points, found.covariance, FrameKind.POINTS, camera, scale, sky, settings, prior, found.flux
    )


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
    """Return the attitude from places (n, 2) px of stars, brightest first, and covariances (n, 2, 2)."""
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
    """Return the attitude at mid-exposure of a frame of streaks, from its motion and the stars it placed."""
    seen = FrameSolution(
        SolveStatus.NO_STARS,
        f"the streaks give no motion: {motion.status.value}",
        FrameKind.STREAKS,
        camera,
        motion=motion,
    )
    chosen = np.flatnonzero(motion.significance > _LEAST_SIGNIFICANCE)
    chosen = chosen[np.argsort(-motion.flux[chosen], kind="stable")]
    if not len(chosen):
        return seen
    seen = replace(seen, points=motion.stars[chosen], covariance=motion.star_covariance[chosen])
    solution = _identify(seen, motion.flux[chosen], scale, sky, settings, prior)
    if solution.fix is None:
        return solution
    covariance = solution.fix.covariance + lateness(motion)
    return replace(solution, fix=replace(solution.fix, covariance=covariance))


def points_near(
    pixels: Image, camera: CameraModel, sky: SkyIndex, settings: SolveSettings, prior: AttitudePrior
) -> Detections:
    """Return the stars found where a prior attitude expects the brightest, if it is sure enough to say."""
    radius = _PRIOR_SIGMAS * prior.sigma * camera.focal_length + _LEAST_RADIUS_PX
    if radius > _MOST_RADIUS_PX:
        return Detections.none()
    matrix = attitude_matrix(prior.quaternion)
    half_width = 0.5 * camera.columns / camera.focal_length, 0.5 * camera.rows / camera.focal_length
    expected = expected_stars(sky, matrix, half_width, _LOOKED_FOR)
    places = camera.project(sky.stars.direction[expected] @ matrix.T)
    return measure_near(pixels, places, replace(settings.detection, search_radius=radius)).stars()


def solve_near(
    pixels: Image,
    camera: CameraModel,
    scale: tuple[float, float],
    sky: SkyIndex,
    settings: SolveSettings,
    prior: AttitudePrior,
) -> FrameSolution | None:
    """Return the attitude from stars about their predicted places alone, None where they do not agree."""
    found = points_near(pixels, camera, sky, settings, prior)
    if not len(found):
        return None
    seen = FrameSolution(
        SolveStatus.NO_STARS, "", FrameKind.POINTS, camera, found.points, found.covariance, tracked=True
    )
    near = track(star_field(seen, found.flux, scale), sky, prior.quaternion, prior.sigma)
    return _told(seen, near, sky, settings) if near.status is Status.IDENTIFIED else None


def _at_rest(prior: RatePrior | None, camera: CameraModel, exposure: float) -> bool:
    """Tell whether stars are expected to be points."""
    if prior is None:
        return True
    most = float(np.linalg.norm(prior.rate)) + _PRIOR_SIGMAS * prior.sigma
    return most * exposure * camera.focal_length < _POINT_PX


def _motion(
    pixels: Image, camera: CameraModel, exposure: float, settings: SolveSettings, prior: RatePrior | None
) -> MotionResult:
    # Not where settings and results are only named.
    from flight.gnc.vision.streaks.maximum_likelihood.estimate import estimate_motion  # noqa: PLC0415

    rate, sigma = (prior.rate, prior.sigma) if prior is not None else (None, 0.0)
    return estimate_motion(pixels, camera.ideal, exposure, settings.likelihood, rate, sigma)


def _far(found: CameraModel, believed: CameraModel) -> bool:
    return abs(found.focal_length / believed.focal_length - 1.0) > _SCALE_TOLERANCE


def _identify(
    seen: FrameSolution,
    flux: FloatArray | None,
    scale: tuple[float, float],
    sky: SkyIndex,
    settings: SolveSettings,
    prior: AttitudePrior | None,
) -> FrameSolution:
    """Return `seen` with its stars identified, near the prior first, else anywhere."""
    stars = star_field(seen, flux, scale)
    if prior is not None:
        near = track(stars, sky, prior.quaternion, prior.sigma)
        if near.status is Status.IDENTIFIED:
            return _told(replace(seen, tracked=True), near, sky, settings)
    if settings.method is not None:
        return _told(seen, settings.method(stars, sky), sky, settings)
    return _told(seen, identify(stars, sky, settings.identification), sky, settings)


def star_field(seen: FrameSolution, flux: FloatArray | None, scale: tuple[float, float]) -> StarField:
    """Return the directions of the points of `seen`, with their errors, for identification."""
    camera = seen.camera
    direction = camera.unit_vectors(seen.points)
    pixels = np.sqrt(0.5 * np.trace(seen.covariance, axis1=1, axis2=2) + _LEAST_SIGMA_PX**2)
    # A pixel off the boresight is seen shorter: by cos^2 along the radius and cos across it.
    sigma = pixels / camera.focal_length * direction[:, 2] ** 1.5
    half_width = 0.5 * camera.columns / camera.focal_length, 0.5 * camera.rows / camera.focal_length
    magnitude = None if flux is None else -2.5 * np.log10(flux)
    return StarField(direction, sigma, half_width, scale, magnitude)


def _told(
    seen: FrameSolution, found: Identification, sky: SkyIndex, settings: SolveSettings
) -> FrameSolution:
    """Return `seen` with what the identification found, its attitude fitted to the places in the image."""
    if found.status is not Status.IDENTIFIED or found.fix is None:
        return replace(seen, status=SolveStatus(found.status.value), reason=_reason(found.status, seen))
    free_scale = found.scale_sigma > 0.0
    camera = seen.camera.rescaled(1.0 / found.scale)
    chosen = np.flatnonzero(found.star >= 0)
    reference = sky.stars.direction[found.star[chosen]]
    if settings.velocity is not None:
        reference = apparent(reference, settings.velocity)
    covariance = seen.covariance[chosen] + _LEAST_SIGMA_PX**2 * np.eye(2)
    try:
        fit = fit_in_image(
            seen.points[chosen], covariance, reference, camera, found.fix.quaternion, free_scale
        )
    except AttitudeError as error:
        return replace(seen, status=SolveStatus.AMBIGUOUS, reason=str(error))
    camera = camera.rescaled(1.0 / fit.scale)
    expected = np.full_like(seen.points, np.nan)
    expected[chosen] = camera.project(reference @ attitude_matrix(fit.fix.quaternion).T)
    return replace(
        seen,
        status=SolveStatus.SOLVED,
        reason="",
        camera=camera,
        star=found.star,
        expected=expected,
        fix=fit.fix,
        scale_sigma=fit.scale_sigma,
        log10_false_alarm=found.log10_false_alarm,
    )


def _reason(status: Status, seen: FrameSolution) -> str:
    count = len(seen.points)
    return {
        Status.TOO_FEW_STARS: f"{count} stars are too few to identify",
        Status.AMBIGUOUS: f"the {count} brightest points match the sky in more than one place",
    }.get(status, f"the {count} brightest points match no part of the sky beyond chance")
