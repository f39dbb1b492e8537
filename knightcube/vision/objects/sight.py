"""Directions of what may be objects in a frame whose attitude the stars gave.

Where the stars are streaks, `detect` finds objects by indicators and pixels. Where they are points, an object
is a point or a short streak too: every area of light that stands well above the noise and is at the place of
no catalogue star may be one, and light beside a star's that the star does not have. All the pixels then give
the place (`object_fit`). One frame cannot say which of them moves; tracks over frames do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, Image, IntArray
from knightcube.astro.quaternion import attitude_matrix
from knightcube.vision.objects.detect import detect
from knightcube.vision.objects.object_fit import Fitted
from knightcube.vision.objects.scene import Scene, Stars, stars_in
from knightcube.vision.objects.sighted import Sighted, SightSettings
from knightcube.vision.startracker.detection import DetectionSettings, FrameKind, survey
from knightcube.vision.startracker.detection.survey import Areas, Survey
from knightcube.vision.startracker.sky_map import SkyMap
from knightcube.vision.startracker.solution import FrameSolution
from knightcube.vision.streaks.corners.settings import StreakSettings
from knightcube.vision.streaks.maximum_likelihood.result import MotionResult

_OFF_PLACE, _TOO_BRIGHT = 0.25, 0.2
"""px and magnitudes by which a star's light is off the catalogue where something else may be in it."""
_SAME = 1.0
"""px between two fits that are of the same light."""


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """What may be objects: places (n, 2) px, their covariance (n, 2, 2) px^2, magnitudes (n,)."""

    points: FloatArray
    covariance: FloatArray
    magnitudes: FloatArray


_NOTHING = Found(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0))


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
    motion = solution.motion
    rotation = np.zeros(3) if motion is None or motion.rate is None else motion.rate * exposure
    seen, stars = survey(pixels, detection), stars_in(sky, epoch, pixels.shape, rotation)
    if solution.kind is FrameKind.STREAKS and motion is not None:
        found = _among_streaks(seen, stars, solution, motion, rotation, exposure, settings)
    else:
        found = _among_points(seen, stars, settings)
    brightest = np.argsort(np.nan_to_num(found.magnitudes, nan=np.inf), kind="stable")[: settings.most]
    points = found.points[brightest]
    to_sky = attitude_matrix(solution.fix.quaternion).T
    return Sighted(
        points,
        sky.directions(points) if len(points) else np.zeros((0, 3)),
        _on_sky(sky, points, found.covariance[brightest]),
        found.magnitudes[brightest],
        to_sky @ solution.fix.covariance @ to_sky.T,
    )


def _on_sky(sky: SkyMap, points: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return covariances (n, 3, 3) of the directions of points (n, 2) of `covariance` (n, 2, 2) px^2."""
    spread = np.zeros((len(points), 3, 3))
    for number, (point, square) in enumerate(zip(points, covariance, strict=True)):
        about = sky.directions(point + 0.5 * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]]))
        slope = np.stack([about[0] - about[1], about[2] - about[3]], axis=1)
        spread[number] = slope @ square @ slope.T
    return spread


def _found(fits: list[tuple[Fitted, float]], settings: SightSettings) -> Found:
    """Return fitted objects, each with the magnitude of a count.

    Fits of two areas may lead to one place, where one object's light is the brighter: it is one sighting.
    """
    if not fits:
        return _NOTHING
    middles = np.array([fit.middle for fit, _ in fits])
    away = np.linalg.norm(middles[:, None] - middles, axis=2)
    again = np.any(np.tril(away < _SAME, -1), axis=1)
    fits = [fit for fit, repeated in zip(fits, again, strict=True) if not repeated]
    floor = settings.floor**2 * np.eye(2)
    return Found(
        np.array([fit.middle for fit, _ in fits]),
        np.array([fit.covariance + floor for fit, _ in fits]),
        np.array([zero - _faintness(np.array(fit.flux)) for fit, zero in fits]),
    )


def _among_streaks(
    seen: Survey,
    stars: Stars,
    solution: FrameSolution,
    motion: MotionResult,
    rotation: FloatArray,
    exposure: float,
    settings: SightSettings,
) -> Found:
    """Return the objects among streaks."""
    detection = seen.settings
    if motion.rate is None:
        return _NOTHING
    streaks = StreakSettings(gain=detection.gain or 1.0, saturation=detection.saturation)
    report = detect(seen.pixels, solution.camera.ideal, rotation, exposure, streaks, settings.search)
    if report is None or not report.objects:
        return _NOTHING
    zero = _zero_point(solution, motion)
    scene = Scene(seen, stars, zero, detection.psf_sigma or settings.search.psf_sigma)
    fits = []
    for found in report.objects:
        half = 0.5 * (found.endpoints[1] - found.endpoints[0])
        fit = scene.measured(found.endpoints.mean(axis=0), half, found.flux) if np.isfinite(zero) else None
        rough = Fitted(
            found.endpoints.mean(axis=0), settings.streak_sigma**2 * np.eye(2), found.flux, 0.0, 1.0
        )
        fits.append((fit or rough, zero))
    return _found(fits, settings)


def _zero_point(solution: FrameSolution, motion: MotionResult) -> float:
    """Return the magnitude of a star of one count by the frame's identified streaks; NaN without any."""
    if len(motion.flux) != len(solution.star):
        return float("nan")
    known = (solution.star >= 0) & (motion.flux > 0.0)
    if not np.any(known):
        return float("nan")
    from knightcube.vision.startracker.index.build import default_index  # noqa: PLC0415 - memory-mapped

    magnitude = default_index().stars.magnitude[solution.star[known]]
    return float(np.median(magnitude + _faintness(motion.flux[known])))


def _among_points(seen: Survey, stars: Stars, settings: SightSettings) -> Found:
    """Return the areas of light that are no star, and what shines beside a star."""
    areas, noise = seen.areas, float(np.median(seen.sky.noise.values))
    ratio = areas.flux / (noise * np.sqrt(np.maximum(areas.pixels, 1)))
    strong = np.flatnonzero(ratio >= settings.significance)
    if not len(strong) or not len(stars.magnitude):
        return _NOTHING
    away = np.linalg.norm(areas.centre[strong, None] - stars.middle[None], axis=2)
    nearest = away.argmin(axis=1)
    distance = away[np.arange(len(strong)), nearest]
    is_star = distance < settings.clearance + 0.5 * areas.length[strong]
    # The brightest star is saturated, the faintest are pairs: the median of the others.
    own = is_star & (distance < 1.0)
    if not np.any(own):
        return _NOTHING
    faintness = _faintness(areas.flux[strong])
    zero = float(np.median(stars.magnitude[nearest[own]] + faintness[own]))
    inside = _inside(areas, strong)
    scene = Scene(seen, stars, zero, seen.settings.psf_sigma or settings.search.psf_sigma)
    fits = []
    for number in np.flatnonzero(~is_star & (zero - faintness <= settings.faintest) & inside):
        area = int(strong[number])
        half = 0.5 * max(float(areas.length[area]), 0.6) * _along(float(areas.direction[area]))
        fit = scene.measured(areas.centre[area], half, float(areas.flux[area]))
        fits.append(fit if fit is not None else _centre(areas, area, float(ratio[area]), settings))
    odd = (distance > _OFF_PLACE) | (zero - faintness < stars.magnitude[nearest] - _TOO_BRIGHT)
    for area in strong[is_star & odd & inside].tolist():
        fit = scene.beside(areas.centre[area], float(areas.length[area]), settings.significance)
        if fit is not None and zero - _faintness(np.array(fit.flux)) <= settings.faintest:
            fits.append(fit)
    return _found([(fit, zero) for fit in fits], settings)


def _along(direction: float) -> FloatArray:
    """Return the unit vector (2,) of a direction, rad from the rows."""
    return np.array([np.cos(direction), np.sin(direction)])


def _inside(areas: Areas, chosen: IntArray) -> BoolArray:
    """Return which areas end within the frame."""
    rows, columns = areas.shape
    x, y = areas.centre[chosen].T
    margin = 3.0 + 0.5 * areas.length[chosen]
    return np.asarray(
        (x > margin) & (x < columns - 1 - margin) & (y > margin) & (y < rows - 1 - margin), dtype=bool
    )


def _centre(areas: Areas, area: int, ratio: float, settings: SightSettings) -> Fitted:
    """Return an area that no fit explains, by its centre of light."""
    sigma = float(np.sqrt(1.0 + areas.length[area] ** 2 / 12.0)) / max(ratio, 1.0)
    error = np.hypot(settings.centre_sigma, sigma)
    return Fitted(areas.centre[area], error**2 * np.eye(2), float(areas.flux[area]), 0.0, 1.0)


def _faintness(flux: FloatArray) -> FloatArray:
    """Return 2.5 log10 of counts (n,)."""
    return np.asarray(2.5 * np.log10(np.maximum(flux, 1e-9)))
