"""Directions of what may be objects in a frame whose attitude the stars gave.

Where the stars are streaks, `detect` finds objects by indicators and pixels. Where they are points, an object
is a point or a short streak too: every area of light that stands well above the noise and is at the place of
no catalogue star may be one. One frame cannot say which of them moves; tracks over frames do.
"""

from __future__ import annotations

import numpy as np

from flight.gnc import catalogue
from flight.gnc.camera.lens import CameraModel
from flight.gnc.math.arrays import BoolArray, FloatArray, Image, IntArray
from flight.gnc.math.directions import tangent_basis
from flight.gnc.math.quaternion import attitude_matrix
from flight.gnc.vision.objects.detect import detect
from flight.gnc.vision.objects.sighted import Sighted, SightSettings
from flight.gnc.vision.startracker.detection import DetectionSettings, FrameKind, survey
from flight.gnc.vision.startracker.detection.areas import Areas
from flight.gnc.vision.startracker.sky_map import SkyMap
from flight.gnc.vision.startracker.solution import FrameSolution
from flight.gnc.vision.streaks.corners.settings import StreakSettings
from flight.gnc.vision.streaks.maximum_likelihood.result import MotionResult


def sight(
    pixels: Image,
    solution: FrameSolution,
    exposure: float,
    epoch: float,
    velocity: FloatArray | None,
    detection: DetectionSettings,
    settings: SightSettings,
) -> Sighted | None:
    """Return the sightings of a frame (rows, columns), None without an attitude.

    `epoch` is the Julian year of the stars' places, `velocity` (3,) m/s that which the frame was solved with.
    """
    sky = solution.sky_map(velocity)
    if sky is None or solution.fix is None:
        return None
    if solution.kind is FrameKind.STREAKS and solution.motion is not None:
        points, sigma, magnitudes = _among_streaks(
            pixels, solution.camera, solution.motion, solution, exposure, detection, settings
        )
    else:
        points, sigma, magnitudes = _among_points(pixels, sky, epoch, detection, settings)
    brightest = np.argsort(np.nan_to_num(magnitudes, nan=np.inf), kind="stable")[: settings.most]
    points, sigma, magnitudes = points[brightest], sigma[brightest], magnitudes[brightest]
    directions = sky.directions(points) if len(points) else np.zeros((0, 3))
    to_sky = attitude_matrix(solution.fix.quaternion).T
    return Sighted(
        points,
        directions,
        _across(directions, sigma / solution.camera.focal_length),
        magnitudes,
        to_sky @ solution.fix.covariance @ to_sky.T,
    )


def _across(directions: FloatArray, sigma: FloatArray) -> FloatArray:
    """Return covariances (n, 3, 3) of directions with `sigma` (n,) rad along each axis across them."""
    spread = np.zeros((len(directions), 3, 3))
    for number, (direction, error) in enumerate(zip(directions, sigma, strict=True)):
        basis = tangent_basis(direction)
        spread[number] = error**2 * basis.T @ basis
    return spread


def _among_streaks(
    pixels: Image,
    camera: CameraModel,
    motion: MotionResult,
    solution: FrameSolution,
    exposure: float,
    detection: DetectionSettings,
    settings: SightSettings,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return points (n, 2) px, errors (n,) px and magnitudes (n,) of objects among streaks."""
    nothing = np.zeros((0, 2)), np.zeros(0), np.zeros(0)
    if motion.rate is None:
        return nothing
    streaks = StreakSettings(gain=detection.gain or 1.0, saturation=detection.saturation)
    report = detect(pixels, camera.ideal, motion.rate * exposure, exposure, streaks, settings.search)
    if report is None or not report.objects:
        return nothing
    points = np.array([found.endpoints.mean(axis=0) for found in report.objects])
    flux = np.array([found.flux for found in report.objects])
    return (
        points,
        np.full(len(points), settings.streak_sigma),
        _zero_point(solution, motion) - _faintness(flux),
    )


def _zero_point(solution: FrameSolution, motion: MotionResult) -> float:
    """Return the magnitude of a star of one count by the frame's identified streaks; NaN without any."""
    if len(motion.flux) != len(solution.star):
        return float("nan")
    known = (solution.star >= 0) & (motion.flux > 0.0)
    if not np.any(known):
        return float("nan")
    from flight.gnc.vision.startracker.index.build import default_index  # noqa: PLC0415 - memory-mapped

    magnitude = default_index().stars.magnitude[solution.star[known]]
    return float(np.median(magnitude + _faintness(motion.flux[known])))


def _among_points(
    pixels: Image, sky: SkyMap, epoch: float, detection: DetectionSettings, settings: SightSettings
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return points (n, 2) px, errors (n,) px and magnitudes (n,) of areas of light that are no star."""
    seen = survey(pixels, detection)
    areas = seen.areas
    noise = float(np.median(seen.sky.noise.values))
    stars = catalogue.load()
    places, magnitude = _in_frame(sky, stars.directions_at(epoch), stars.magnitude, pixels.shape)
    ratio = areas.flux / (noise * np.sqrt(np.maximum(areas.pixels, 1)))
    strong = np.flatnonzero(ratio >= settings.significance)
    if not len(strong) or not len(places):
        return np.zeros((0, 2)), np.zeros(0), np.zeros(0)
    away = np.linalg.norm(areas.centre[strong, None] - places[None], axis=2)
    nearest = away.argmin(axis=1)
    distance = away[np.arange(len(strong)), nearest]
    is_star = distance < settings.clearance + 0.5 * areas.length[strong]
    # The brightest star is saturated, the faintest are pairs: the median of the others.
    own = is_star & (distance < 1.0)
    if not np.any(own):
        return np.zeros((0, 2)), np.zeros(0), np.zeros(0)
    zero = float(np.median(magnitude[nearest[own]] + _faintness(areas.flux[strong[own]])))
    magnitudes = zero - _faintness(areas.flux[strong])
    chosen = ~is_star & (magnitudes <= settings.faintest) & _inside(areas, strong)
    sigma = _centre_sigma(areas, ratio, settings)
    return areas.centre[strong[chosen]], sigma[strong[chosen]], magnitudes[chosen]


def _in_frame(
    sky: SkyMap, directions: FloatArray, magnitude: FloatArray, shape: tuple[int, ...]
) -> tuple[FloatArray, FloatArray]:
    """Return places (n, 2) px and magnitudes (n,) of the stars in the frame of `shape` and its margin."""
    centre = np.array([[(shape[1] - 1) / 2.0, (shape[0] - 1) / 2.0]])
    corner = sky.directions(np.vstack([centre, [[0.0, 0.0]]]))
    near = directions @ corner[0] > float(corner[0] @ corner[1]) - 0.01
    return sky.pixels(directions[near]), magnitude[near]


def _inside(areas: Areas, chosen: IntArray) -> BoolArray:
    """Return which areas end within the frame."""
    rows, columns = areas.shape
    x, y = areas.centre[chosen].T
    margin = 3.0 + 0.5 * areas.length[chosen]
    return np.asarray(
        (x > margin) & (x < columns - 1 - margin) & (y > margin) & (y < rows - 1 - margin), dtype=bool
    )


def _centre_sigma(areas: Areas, ratio: FloatArray, settings: SightSettings) -> FloatArray:
    """Return the errors (n,) px along an axis of the areas' centres of light."""
    spread = np.sqrt(1.0 + areas.length**2 / 12.0)
    return np.asarray(np.hypot(settings.floor, spread / np.maximum(ratio, 1.0)))


def _faintness(flux: FloatArray) -> FloatArray:
    """Return 2.5 log10 of counts (n,)."""
    return np.asarray(2.5 * np.log10(np.maximum(flux, 1e-9)))
