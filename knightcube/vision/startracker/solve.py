"""The steps from stars in a frame to its attitude; `knightcube.vision.frame_job` chooses among them.

Points are measured by `detection`; of streaks, the places of their stars at mid-exposure serve as points.
Identification searches near a prior attitude first, where there is one, then the whole sky. The attitude is
that of mid-exposure.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from knightcube.astro.arrays import FloatArray, Image
from knightcube.astro.attitude.wahba import AttitudeError, Solver
from knightcube.astro.quaternion import attitude_matrix, conjugate, multiply, to_rotation_vector
from knightcube.vision.camera.knowledge import CameraKnowledge
from knightcube.vision.camera.lens import CameraModel, Lens, LensError
from knightcube.vision.camera.pinhole import Pinhole
from knightcube.vision.startracker.detection import (
    Detections,
    DetectionSettings,
    FrameKind,
    measure_near,
)
from knightcube.vision.startracker.identification.lost_in_space import IdentificationSettings, identify
from knightcube.vision.startracker.identification.star_field import Identification, StarField, Status
from knightcube.vision.startracker.identification.tracking import track
from knightcube.vision.startracker.identification.verification import expected_stars
from knightcube.vision.startracker.image_fit import Unknowns, attitude_by, fit_in_image
from knightcube.vision.startracker.index.sky_index import SkyIndex
from knightcube.vision.startracker.sky_map import ShortTrails, SkyMap, apparent, known_bend, usual_bend
from knightcube.vision.startracker.solution import FrameSolution, SolveStatus, timing_covariance
from knightcube.vision.streaks.maximum_likelihood.course import Course
from knightcube.vision.streaks.maximum_likelihood.result import MotionResult
from knightcube.vision.streaks.maximum_likelihood.settings import LikelihoodSettings

# px: error of a place from unknown distortion of the lens or the star's colour.
_LEAST_SIGMA_PX = 0.005
# px: the same of a lens that is stated to be exact.
_COLOUR_PX = 0.002
# Of what the stars are wider than described: how far the middle of all may be off (campaign `resting`).
_SHAPE_DOUBT = 0.05
# px: the same of a lens that is not calibrated, for identification. Tried second: most pictures need only
# the room of their places' errors, in which fewer stars agree by chance.
_UNTOLD_SIGMA_PX = 0.3
# px, across the boresight and at the edge about it: what such a lens and the air leave beyond the fit of the
# lens. Photographs differ from other solvers' attitudes by this (bench `untold_lens`).
_UNTOLD_LENS_PX = 0.25
# Standard deviations of light; fainter stars of a motion are not identified.
_LEAST_SIGNIFICANCE = 5.0
# px, standard deviation from which a star has no place: both ends of its streak may lie outside of the frame.
_PLACELESS_PX = 5.0
# Chi-square of 3, exceeded by chance once in 100,000: an attitude farther from the prior is another's.
_NEAR = 25.9
# Tracking looks for this number of stars, within PRIOR_SIGMAS of the prior.
_LOOKED_FOR = 30
PRIOR_SIGMAS = 4.0
# Above the larger radius a search of the whole frame is cheaper.
_LEAST_RADIUS_PX, _MOST_RADIUS_PX = 3.0, 15.0


@dataclass(frozen=True, slots=True)
class SolveSettings:
    """How a frame is solved.

    Attributes:
        detection: settings for points.
        likelihood: settings for the streaks of a picture; a flight's job names its own estimator.
        identification: settings of the default method.
        method: another method of identification.
        attitude: a solver of directions for the attitude; None takes it from the fit in the image.
        velocity: (3,) m/s of the camera about the Sun, for aberration; None: no correction.
        lens: how well a lens of certain focal length is known; None: exactly.
        untold_lens: whether a lens of uncertain focal length may have its axis off the middle and distort;
            else the focal length is all that is uncertain.
    """

    detection: DetectionSettings = field(default_factory=DetectionSettings)
    likelihood: LikelihoodSettings = field(default_factory=LikelihoodSettings)
    identification: IdentificationSettings = field(default_factory=IdentificationSettings)
    method: Callable[[StarField, SkyIndex], Identification] | None = None
    attitude: Solver | None = None
    velocity: FloatArray | None = None
    lens: CameraKnowledge | None = None
    untold_lens: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class AttitudePrior:
    """Predicted attitude (4,), ICRS to camera, and its standard deviation about each axis, rad."""

    quaternion: FloatArray
    sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class RatePrior:
    """Predicted rate (3,), rad/s in the camera's axes, and the standard deviation of each component.

    `course`: how the camera turned over the exposure, where that is known.
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
    placed = np.trace(motion.star_covariance, axis1=1, axis2=2) < 2.0 * _PLACELESS_PX**2
    chosen = np.flatnonzero(placed & (motion.significance > _LEAST_SIGNIFICANCE))
    chosen = chosen[np.argsort(-motion.flux[chosen], kind="stable")]
    if not len(chosen):
        return seen
    seen = replace(
        seen,
        points=motion.stars[chosen],
        covariance=motion.star_covariance[chosen],
        late=motion.late(chosen, camera.centre[1]),
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
    """Return the stars found near the predicted places of the brightest; none for too uncertain a prior.

    `trails`: how they move over the exposure, where that is known and a few px.
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
    """Return the attitude from stars near their predicted places alone; None if they do not agree.

    `trails`: as of `points_near`.
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
    if near.status is not Status.IDENTIFIED:
        return None
    solution = _shape_unknown(_with_attitude(seen, near, sky, settings), found, settings)
    return solution if _agrees(solution, prior) else None


def _agrees(solution: FrameSolution, prior: AttitudePrior) -> bool:
    """Return whether an attitude found near the prior is near it: it was tested against chance only there."""
    if solution.fix is None:
        return True
    off = to_rotation_vector(multiply(solution.fix.quaternion, conjugate(prior.quaternion)))
    known = solution.fix.covariance + prior.sigma**2 * np.eye(3)
    return bool(off @ np.linalg.solve(known, off) < _NEAR)


def _shape_unknown(solution: FrameSolution, found: Detections, settings: SolveSettings) -> FrameSolution:
    """Return a solution that claims no more than the shape of the stars allows.

    Where they are wider than described, by a tail of the lens or light astray, their middle is a matter of
    which light is weighed: all places are off alike.
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
    """Return `seen` with its stars identified, near the prior first, then in the whole sky."""
    stars = star_field(seen, flux, scale)
    if prior is not None:
        near = track(stars, sky, prior.quaternion, prior.sigma)
        if near.status is Status.IDENTIFIED:
            solution = _with_attitude(replace(seen, tracked=True), near, sky, settings)
            if _agrees(solution, prior):
                return solution
    if settings.method is not None:
        return _with_attitude(seen, settings.method(stars, sky), sky, settings)
    options = settings.identification
    if seen.kind is FrameKind.STREAKS:
        # A mirrored turn is another turn: the rate of a mirrored picture would be wrong.
        options = replace(options, mirror=False)
    found = identify(stars, sky, options)
    if found.status is Status.NO_MATCH and settings.untold_lens and scale[0] != scale[1]:
        found = identify(star_field(seen, flux, scale, _UNTOLD_SIGMA_PX), sky, options)
    if found.mirrored:
        # Fitted as it should be, reported as it came.
        return _mirrored(replace(_with_attitude(_mirrored(seen), found, sky, settings), mirrored=True))
    return _with_attitude(seen, found, sky, settings)


def _mirrored(seen: FrameSolution) -> FrameSolution:
    """Return `seen` with left and right of its places exchanged about the optical axis."""
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
    """Return the directions of the points of `seen`, with their errors of `least` px or more, to identify."""
    camera = seen.camera
    direction = camera.unit_vectors(seen.points)
    pixels = np.sqrt(0.5 * np.trace(seen.covariance, axis1=1, axis2=2) + least**2)
    # A pixel off the boresight is seen shorter: by cos^2 along the radius and cos across it.
    sigma = pixels / camera.focal_length * direction[:, 2] ** 1.5
    half_width = 0.5 * camera.columns / camera.focal_length, 0.5 * camera.rows / camera.focal_length
    magnitude = None if flux is None else -2.5 * np.log10(flux)
    return StarField(direction, sigma, half_width, scale, magnitude)


def _with_attitude(
    seen: FrameSolution, found: Identification, sky: SkyIndex, settings: SolveSettings
) -> FrameSolution:
    """Return `seen` with the identified stars and the attitude fitted to their places in the image."""
    if found.status is not Status.IDENTIFIED or found.fix is None:
        return replace(seen, status=SolveStatus(found.status.value), reason=_reason(found.status, seen))
    free_scale = found.scale_sigma > 0.0
    free_lens = free_scale and settings.untold_lens
    camera = _camera_found(seen.camera, found)
    chosen = np.flatnonzero(found.star >= 0)
    reference = sky.stars.direction[found.star[chosen]]
    if settings.velocity is not None:
        reference = apparent(reference, settings.velocity)
    known = _known_bend(camera, settings, free_scale, free_lens)
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
        fix = replace(fix, covariance=fix.covariance + lens_floor(camera))
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


def _known_bend(
    camera: CameraModel, settings: SolveSettings, free_scale: bool, free_lens: bool
) -> FloatArray:
    """Return the information (6,) about the lens's bend before the stars are seen, (0,) where it has none."""
    if free_lens:
        return usual_bend(camera)
    return np.zeros(0) if free_scale or settings.lens is None else known_bend(camera, settings.lens)


def _camera_found(camera: CameraModel, found: Identification) -> CameraModel:
    """Return the camera with the focal length, and the distortion of a pinhole, that were found."""
    camera = camera.rescaled(1.0 / found.scale)
    if found.distortion == 0.0 or not isinstance(camera, Pinhole):
        return camera
    # Of the tangent's square, where `distortion` is of the corner's.
    corner = 0.5 * math.hypot(camera.columns, camera.rows) / camera.focal_length
    try:
        return replace(Lens.of(camera), k1=found.distortion / corner**2)
    except LensError:
        return camera


def lens_floor(camera: CameraModel) -> FloatArray:
    """Return the covariance (3, 3) rad^2 that a lens which is not calibrated adds to an attitude."""
    across, about = 1.0 / camera.focal_length, 2.0 / max(camera.columns, camera.rows)
    return np.diag((_UNTOLD_LENS_PX * np.array([across, across, about])) ** 2)


def _reason(status: Status, seen: FrameSolution) -> str:
    count = len(seen.points)
    return {
        Status.TOO_FEW_STARS: f"{count} stars are too few to identify",
        Status.AMBIGUOUS: f"the {count} brightest points match the sky in more than one place",
    }.get(status, f"the {count} brightest points match no part of the sky beyond chance")
