"""Directions of possible objects in an image whose attitude is determined from the stars.

If the stars are streaks, `detect` finds objects by their motion and their pixels. If the stars are points, an
object is also a point or a short streak. Possible objects are then areas of light that are significantly
above the noise and away from all catalogue stars, and light beside a star that is not part of the star's
image. A tracker over several images determines which possible objects move relative to the stars.

The pixels of each object are fitted together with the known stars nearby. An object is modelled as a short
trail of constant brightness, blurred by the camera's point spread function (PSF). A Gauss-Newton iteration
fits the position, extent and brightness of the object, the sky level and the brightness of each star,
weighted by the noise of the modelled light. Saturated pixels are excluded, because they would displace the
fitted centroid of an object by 0.03 px. The covariance of a fit is increased if the residuals exceed the
noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from knightcube.astro import catalogue
from knightcube.astro.arrays import BoolArray, FloatArray, Image
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, multiply
from knightcube.vision.camera.lens import CameraModel, streak_camera
from knightcube.vision.objects.detect import detect
from knightcube.vision.objects.settings import (
    FLOOR_PX,
    EndpointSettings,
    FieldPoints,
    MeasuredObjects,
    ObjectMeasurementSettings,
)
from knightcube.vision.objects.streak_images import spread_over, spread_with_slopes
from knightcube.vision.startracker.sky_map import SkyMap
from knightcube.vision.startracker.solve import FrameSolution
from knightcube.vision.startracker.survey import DetectionSettings, FrameKind, Survey, survey
from knightcube.vision.streaks.streak_result import FrameMotion, MotionResult, StreakStatus

_REACH = 5.0
"""Margin of the fitted patch of pixels beyond the ends of an object, in standard deviations of the PSF."""
_STEP_PX = 0.7
"""Distance (px) between the points that model a trail."""
_ROUNDS, _CONVERGED = 12, 1e-4
"""Maximum number of Gauss-Newton steps of the fit, and step (px) below which the iteration ends."""
_EXTENT = 2.0
"""Prior standard deviation (px) of an object's half extent around its initial guess."""
STAR_SIGMA = 0.3
"""Relative error of a star's catalogue brightness, due to the different passband of the camera."""


@dataclass(frozen=True, slots=True, eq=False)
class Trails:
    """The n straight trails of stars in an image, with the flux of each star (n,), counts.

    The half extents (n, 2), px, are the vectors from the midpoint (n, 2), px, of each trail to its end.
    """

    middle: FloatArray
    half: FloatArray
    flux: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class ObjectPatch:
    """A rectangle of the image around a possible object; its first pixel is at `corner` (x, y), px.

    The pixels `light` (rows, columns) are in counts above the sky level, and saturate at `ceiling` counts.
    The standard deviations of a background pixel (counts) and of the PSF (px) are `noise` and `psf`. The gain
    is in electrons per count. The mask `usable` selects the pixels that are not saturated.
    """

    light: FloatArray
    corner: FloatArray
    noise: float
    gain: float
    usable: BoolArray
    psf: float
    ceiling: float

    def image(self, middle: FloatArray, half: FloatArray) -> FloatArray:
        """Return the image (rows, columns), whose sum is 1, of a trail with midpoint and half extent (2,)."""
        rows, columns = self.light.shape
        return spread_over(_trail(middle - self.corner, half)[0], columns, rows, self.psf)


@dataclass(frozen=True, slots=True, eq=False)
class FittedObject:
    """An object fitted to its pixels: midpoint of its trail (2,), px, with covariance (2, 2), px^2, and flux.

    The flux and its standard deviation are in counts. The misfit is chi-square per degree of freedom.
    """

    middle: FloatArray
    covariance: FloatArray
    flux: float
    flux_sigma: float
    misfit: float


def _trail(middle: FloatArray, half: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return points (m, 2), px, along a trail, and their positions (m,) from -1 (start) to 1 (end)."""
    count = max(4, int(np.ceil(2.0 * float(np.linalg.norm(half)) / _STEP_PX)))
    share = (np.arange(count) + 0.5) * 2.0 / count - 1.0
    return middle + share[:, None] * half, share


def _patch_reach(half: FloatArray, psf: float) -> float:
    """Return the half-width (px) of the patch for an object with half extent `half` (2,), px."""
    return float(np.abs(half).max()) + _REACH * psf


def _fit_object(
    patch: ObjectPatch, middle: FloatArray, half: FloatArray, flux: float, stars: Trails
) -> FittedObject | None:
    """Return the object fitted to a patch of pixels together with known stars, or None if the fit fails.

    The initial guess is given by midpoint `middle` (2,), px, half extent `half` (2,), px, and `flux`, counts.
    """
    images = [patch.image(star, extent) for star, extent in zip(stars.middle, stars.half, strict=True)]
    given = np.maximum(stars.flux, 1e-9)
    # Each prior is a tuple of the index of an unknown, its prior value and its standard deviation.
    prior = [(2 + k, float(half[k]), _EXTENT) for k in range(2)]
    prior += [(6 + k, float(light), STAR_SIGMA * float(light)) for k, light in enumerate(given)]
    unknowns = np.concatenate([middle, half, [flux, 0.0], given])
    rows, columns = patch.light.shape
    for _ in range(_ROUNDS):
        # The modelled image, and its derivatives (k, pixels) with respect to the k unknowns.
        path, share = _trail(unknowns[:2] - patch.corner, unknowns[2:4])
        both = np.stack([np.ones(len(share)), share])
        shape, *slopes = spread_with_slopes(path, both, columns, rows, patch.psf)
        light = unknowns[4] * shape + unknowns[5]
        for of_star, image in zip(unknowns[6:], images, strict=True):
            light = light + of_star * image
        change = [*(unknowns[4] * slope for slope in slopes), shape, np.ones(shape.shape), *images]
        by_unknown = np.array([part.ravel() for part in change])
        usable = patch.usable & (light < patch.ceiling)
        spare = int(np.count_nonzero(usable)) - len(unknowns)
        if spare < 2:
            return None
        weight = (usable / (patch.noise**2 + np.maximum(light, 0.0) / patch.gain)).ravel()
        off = (patch.light - light).ravel()
        normal, right = (by_unknown * weight) @ by_unknown.T, (by_unknown * weight) @ off
        for place, value, sigma in prior:
            normal[place, place] += sigma**-2
            right[place] += (value - unknowns[place]) / sigma**2
        step = np.linalg.solve(normal, right)
        step[:4] = np.clip(step[:4], -0.5, 0.5)
        unknowns = unknowns + step
        misfit = float(np.sum(weight * off**2)) / spare
        if np.abs(step[:2]).max() < _CONVERGED:
            break
    # The covariance of the fit is increased only if chi-square exceeds its mean by three standard deviations.
    excess = misfit if misfit > 1.0 + 3.0 * (2.0 / spare) ** 0.5 else 1.0
    covariance = np.asarray(np.linalg.inv(normal), dtype=np.float64) * excess
    away = np.abs(unknowns[:2] - middle).max()
    if not np.isfinite(unknowns).all() or unknowns[4] <= 0.0 or away > _patch_reach(half, patch.psf):
        return None
    deviation = float(np.sqrt(covariance[4, 4]))
    return FittedObject(unknowns[:2], covariance[:2, :2], float(unknowns[4]), deviation, misfit)


_BRIGHTEST = 1.0 + 3.0 * STAR_SIGMA
"""Largest ratio of the fitted flux of a star to the flux predicted from the catalogue."""
_LEAST_SHARE = 0.15
"""Minimum ratio of an object's flux to that of adjacent stars, whose modelled images have errors of 10 %."""
_APART = 1.0
"""Minimum distance (px) of an object from the nearest star; closer light may be the second star of a pair."""
_STEP_TO_SIGMA = 1.4826 / np.sqrt(2.0)
"""Ratio of the noise of a pixel to the median absolute difference between neighbouring pixels."""
_MISFIT = 3.0
"""Largest chi-square per degree of freedom for the fit of an object beside a star."""


@dataclass(frozen=True, slots=True, eq=False)
class CatalogueTrails:
    """Trails of n catalogue stars as in `Trails`, with the V magnitudes (n,) of the stars."""

    middle: FloatArray
    half: FloatArray
    magnitude: FloatArray


def _stars_in(sky: SkyMap, epoch: float, shape: tuple[int, ...], rotation: FloatArray) -> CatalogueTrails:
    """Return the trails of catalogue stars in and around an image of the given shape (rows, columns).

    The camera rotates by `rotation` (3,), rad, camera axes, during the exposure; `epoch` is a Julian year.
    """
    known = catalogue.load()
    directions = known.directions_at(epoch)
    centre = np.array([[(shape[1] - 1) / 2.0, (shape[0] - 1) / 2.0]])
    corner = sky.directions(np.vstack([centre, [[0.0, 0.0]]]))
    near = directions @ corner[0] > float(corner[0] @ corner[1]) - 0.01
    directions = directions[near]
    middle = sky.pixels(directions)
    half = np.zeros(middle.shape)
    if rotation.any():
        turns = (multiply(from_rotation_vector(s * rotation), sky.quaternion) for s in (-0.5, 0.5))
        begin, end = (replace(sky, quaternion=turn).pixels(directions) for turn in turns)
        half = 0.5 * (end - begin)
    seen = np.isfinite(middle).all(axis=1) & np.isfinite(half).all(axis=1)
    return CatalogueTrails(middle[seen], half[seen], known.magnitude[near][seen])


class FramePatches:
    """An image in which possible objects are fitted together with the catalogue stars nearby.

    A star with a flux of one count has the magnitude `zero`. The standard deviation of the PSF is `psf`, px.
    """

    def __init__(self, seen: Survey, stars: CatalogueTrails, zero: float, psf: float) -> None:
        self._light, self._sky = seen.pixels, seen.sky
        # The noise is computed from differences of neighbouring pixels, which faint stars hardly affect.
        steps = np.abs(np.diff(seen.pixels[::4].astype(np.float64), axis=1))
        self._noise = max(float(np.median(steps)) * _STEP_TO_SIGMA, 1e-3)
        self._gain, self._ceiling, self._psf = seen.settings.gain or 1.0, seen.areas.ceiling, psf
        self._trails = Trails(stars.middle, stars.half, 10.0 ** (0.4 * (zero - stars.magnitude)))

    def measured(self, point: FloatArray, half: FloatArray, flux: float) -> FittedObject | None:
        """Return the object fitted near `point` (2,), px, or None if the fit fails.

        The initial guess is given by half extent `half` (2,), px, and `flux`, counts.
        """
        patch = self._patch(point, _patch_reach(half, self._psf))
        return None if patch is None else _fit_object(patch, point, half, flux, self._near(point, patch))

    def beside(self, point: FloatArray, length: float, significance: float) -> FittedObject | None:
        """Return an object whose light is merged with the light of known stars, or None if there is none.

        The fit of the object starts at the pixel that is brightest after subtraction of the stars. The area
        of light has its centre at `point` (2,), px, and the given `length`, px. The flux of the object is at
        least `significance` times its standard deviation.
        """
        patch = self._patch(point, 0.5 * length + _patch_reach(np.zeros(2), self._psf))
        if patch is None:
            return None
        stars = self._near(point, patch)
        left = patch.light.copy()
        for middle, half, flux in zip(stars.middle, stars.half, stars.flux, strict=True):
            image = patch.image(middle, half)
            share = patch.usable * image / (patch.noise**2 + flux * image / patch.gain)
            # The flux of a star is limited, so that it does not include the light of the object.
            light = float(np.sum(share * left)) / max(float(np.sum(share * image)), 1e-300)
            left -= np.clip(light, 0.0, _BRIGHTEST * flux) * image
        top = np.where(patch.usable, left, -np.inf)[1:-1, 1:-1]
        row, column = np.unravel_index(int(np.argmax(top)), top.shape)
        start = patch.corner + np.array([column + 1, row + 1])
        flux = float(top[row, column]) * 2.0 * np.pi * self._psf**2
        faint = flux < significance * patch.noise * np.sqrt(4.0 * np.pi) * self._psf
        found = None if faint else self.measured(start, np.array([0.3, 0.3]), flux)
        if found is None or found.flux < significance * found.flux_sigma or found.misfit > _MISFIT:
            return None
        away = np.linalg.norm(stars.middle - found.middle, axis=1)
        beside = stars.flux[away < _patch_reach(np.zeros(2), self._psf)]
        distinct = len(away) and away.min() > _APART and found.flux > _LEAST_SHARE * beside.max(initial=0.0)
        return found if distinct else None

    def _near(self, point: FloatArray, patch: ObjectPatch) -> Trails:
        """Return the stars in or near a patch of pixels with a flux above three sigma of the noise."""
        trails, reach = self._trails, 0.5 * max(patch.light.shape) + 3.0 * self._psf
        near = np.all(np.abs(trails.middle - point) - np.abs(trails.half) < reach, axis=1)
        near &= trails.flux > 3.0 * patch.noise
        return Trails(trails.middle[near], trails.half[near], trails.flux[near])

    def _patch(self, point: FloatArray, reach: float) -> ObjectPatch | None:
        """Return the patch of pixels within `reach` px of a point (2,), or None at the image border."""
        rows, columns = self._light.shape
        x, y = np.rint(point).astype(int)
        size = int(np.ceil(reach))
        left, top, right, bottom = x - size, y - size, x + size + 1, y + size + 1
        if left < 0 or top < 0 or right > columns or bottom > rows:
            return None
        counts = self._light[top:bottom, left:right].astype(np.float64)
        row, column = np.mgrid[top:bottom, left:right]
        light = counts - self._sky.level.at(column.ravel(), row.ravel()).reshape(counts.shape)
        ceiling = self._ceiling - float(np.median(counts - light))
        usable = counts < self._ceiling
        return ObjectPatch(light, np.array([left, top]), self._noise, self._gain, usable, self._psf, ceiling)


_OFF_PLACE, _TOO_BRIGHT = 0.25, 0.2
"""Differences of a star from its catalogue entry (px and magnitudes) above which an object is suspected."""
_SAME = 1.0
"""Distance (px) between two fitted positions below which they count as the same object."""


def measure_objects(
    pixels: Image,
    solution: FrameSolution,
    exposure: float,
    epoch: float,
    velocity: FloatArray | None,
    detection: DetectionSettings,
    settings: ObjectMeasurementSettings,
) -> MeasuredObjects | None:
    """Return the possible objects in an image, or None if the attitude of the image is unknown.

    The argument `solution` is the star tracker's solution of the image `pixels` (rows, columns). The `epoch`
    is the Julian year of the positions of the stars. The `velocity` of the camera (3,), m/s, corrects
    aberration; None for no correction. The settings `detection` are used to detect the bright areas in the
    image.
    """
    sky = solution.sky_map(velocity)
    if sky is None or solution.fix is None:
        return None
    motion = solution.motion
    rotation = np.zeros(3) if motion is None or motion.rate is None else motion.rate * exposure
    seen, stars = survey(pixels, detection), _stars_in(sky, epoch, pixels.shape, rotation)
    if solution.kind is FrameKind.STREAKS and motion is not None:
        fits = _among_streaks(seen, stars, solution, motion, rotation, exposure, settings)
    else:
        fits = _among_points(seen, stars, settings)
    # If the fits of two areas converge to the same object, only the first fit is kept.
    middles = np.array([fit.middle for fit, _ in fits]).reshape(-1, 2)
    away = np.linalg.norm(middles[:, None] - middles, axis=2)
    again = np.any(np.tril(away < _SAME, -1), axis=1)
    fits = [fit for fit, repeated in zip(fits, again, strict=True) if not repeated]
    magnitudes = np.array([zero - _faintness(np.array(fit.flux)) for fit, zero in fits])
    brightest = np.argsort(np.nan_to_num(magnitudes, nan=np.inf), kind="stable")[: settings.most]
    points = middles[~again][brightest]
    covariance = np.zeros((len(points), 3, 3))
    for number, (point, of_fits) in enumerate(zip(points, brightest, strict=True)):
        about = sky.directions(point + 0.5 * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]]))
        slope = np.stack([about[0] - about[1], about[2] - about[3]], axis=1)
        square = fits[of_fits][0].covariance + settings.floor**2 * np.eye(2)
        covariance[number] = slope @ square @ slope.T
    to_sky = attitude_matrix(solution.fix.quaternion).T
    attitude = to_sky @ solution.fix.covariance @ to_sky.T
    directions = sky.directions(points) if len(points) else np.zeros((0, 3))
    return MeasuredObjects(points, directions, covariance, magnitudes[brightest], attitude)


def _among_streaks(
    seen: Survey,
    stars: CatalogueTrails,
    solution: FrameSolution,
    motion: MotionResult,
    rotation: FloatArray,
    exposure: float,
    settings: ObjectMeasurementSettings,
) -> list[tuple[FittedObject, float]]:
    """Return the objects in an image of streaked stars, each with the magnitude of a star of one count."""
    detection, search = seen.settings, settings.search
    if motion.rate is None:
        return []
    streaks = EndpointSettings(gain=detection.gain or 1.0, saturation=detection.saturation)
    report = detect(seen.pixels, streak_camera(solution.camera), rotation, exposure, streaks, search)
    if report is None or not report.objects:
        return []
    # The magnitude of a star of one count is computed from identified streaks, or NaN if there are none.
    zero = float("nan")
    known = (solution.star >= 0) & (motion.flux > 0.0) if len(motion.flux) == len(solution.star) else None
    if known is not None and np.any(known):
        from knightcube.vision.startracker.index.build import default_index  # noqa: PLC0415 - memory-mapped

        magnitude = default_index().stars.magnitude[solution.star[known]]
        zero = float(np.median(magnitude + _faintness(motion.flux[known])))
    patches = FramePatches(seen, stars, zero, detection.psf_sigma or search.psf_sigma)
    fits = []
    for found in report.objects:
        middle, half = found.endpoints.mean(axis=0), 0.5 * (found.endpoints[1] - found.endpoints[0])
        fit = patches.measured(middle, half, found.flux) if np.isfinite(zero) else None
        rough = FittedObject(middle, found.middle_sigma**2 * np.eye(2), found.flux, 0.0, 1.0)
        fits.append((fit or rough, zero))
    return fits


def _among_points(
    seen: Survey, stars: CatalogueTrails, settings: ObjectMeasurementSettings
) -> list[tuple[FittedObject, float]]:
    """Return the objects in an image of point stars, each with the magnitude of a star of one count."""
    areas, ratio = seen.areas, _significances(seen)
    strong = np.flatnonzero(ratio >= settings.significance)
    if not len(strong) or not len(stars.magnitude):
        return []
    away = np.linalg.norm(areas.centre[strong, None] - stars.middle[None], axis=2)
    nearest = away.argmin(axis=1)
    distance = away[np.arange(len(strong)), nearest]
    is_star = distance < settings.clearance + 0.5 * areas.length[strong]
    # The magnitude of one count is a median, because bright stars are saturated and faint stars may be pairs.
    own = is_star & (distance < 1.0)
    if not np.any(own):
        return []
    faintness = _faintness(areas.flux[strong])
    zero = float(np.median(stars.magnitude[nearest[own]] + faintness[own]))
    rows, columns = areas.shape
    x, y = areas.centre[strong].T
    margin = 3.0 + 0.5 * areas.length[strong]
    inside = (x > margin) & (x < columns - 1 - margin) & (y > margin) & (y < rows - 1 - margin)
    patches = FramePatches(seen, stars, zero, seen.settings.psf_sigma or settings.search.psf_sigma)
    fits = []
    for number in np.flatnonzero(~is_star & (zero - faintness <= settings.faintest) & inside):
        area = int(strong[number])
        direction = float(areas.direction[area])
        half = 0.5 * max(float(areas.length[area]), 0.6) * np.array([np.cos(direction), np.sin(direction)])
        fit = patches.measured(areas.centre[area], half, float(areas.flux[area]))
        if fit is None:
            sigma = float(np.sqrt(1.0 + areas.length[area] ** 2 / 12.0)) / max(float(ratio[area]), 1.0)
            square = np.hypot(settings.centre_sigma, sigma) ** 2 * np.eye(2)
            fit = FittedObject(areas.centre[area], square, float(areas.flux[area]), 0.0, 1.0)
        fits.append(fit)
    odd = (distance > _OFF_PLACE) | (zero - faintness < stars.magnitude[nearest] - _TOO_BRIGHT)
    for area in strong[is_star & odd & inside].tolist():
        fit = patches.beside(areas.centre[area], float(areas.length[area]), settings.significance)
        if fit is not None and zero - _faintness(np.array(fit.flux)) <= settings.faintest:
            fits.append(fit)
    return [(fit, zero) for fit in fits]


def _significances(seen: Survey) -> FloatArray:
    """Return the flux (n,) of each bright area of an image, in standard deviations of its noise."""
    noise = float(np.median(seen.sky.noise.values))
    return np.asarray(seen.areas.flux / (noise * np.sqrt(np.maximum(seen.areas.pixels, 1))))


def _faintness(flux: FloatArray) -> FloatArray:
    """Return by how many magnitudes (n,) a `flux` (n,), counts, is brighter than a flux of one count."""
    return np.asarray(2.5 * np.log10(np.maximum(flux, 1e-9)))


MOST_POINTS = 80
"""Maximum number of measured points of light in a frame; the brightest are measured."""
_FIELD_SIGMAS = 12.0
"""Minimum flux (standard deviations) of a point of light in a frame without identified stars."""
STREAK_PX = 20.0
"""Minimum median length of the streaks (px) for which `detect` searches a single frame."""


def measure_points(
    pixels: Image,
    camera: CameraModel,
    exposure: float,
    motion: FrameMotion,
    settings: ObjectMeasurementSettings,
    detection: DetectionSettings,
) -> FieldPoints:
    """Return the points of light in a frame, with moving objects marked if the stars are streaks.

    The `motion` of the camera over the `exposure`, s, was estimated from the streaks of the frame. The
    settings `detection` are used to detect the bright areas in the frame (rows, columns).
    """
    moves = motion.status is StreakStatus.RATE and motion.rate is not None and motion.length >= STREAK_PX
    if moves and isinstance(motion, MotionResult) and motion.rate is not None:
        ends = EndpointSettings(gain=detection.gain or 1.0, saturation=detection.saturation)
        report = detect(
            pixels, streak_camera(camera), motion.rate * exposure, exposure, ends, settings.search
        )
        found = () if report is None else report.objects
        middles = np.array([item.endpoints.mean(axis=0) for item in found]).reshape(-1, 2)
        points = np.vstack([motion.stars[motion.used], middles])
        spread = motion.star_covariance[motion.used]
        sigma = np.sqrt(0.5 * np.trace(spread, axis1=1, axis2=2))
        sigma = np.concatenate([sigma, [item.middle_sigma for item in found]])
        flux = np.concatenate([motion.flux[motion.used], [item.flux for item in found]])
        moving = np.arange(len(points)) >= len(points) - len(middles)
    else:
        seen = survey(pixels, detection)
        areas, ratio = seen.areas, _significances(seen)
        margin = (3.0 + 0.5 * areas.length)[:, None]
        last = np.array(areas.shape[::-1]) - 1
        inside = np.all((areas.centre > margin) & (areas.centre < last - margin), axis=1)
        chosen = np.flatnonzero((ratio >= _FIELD_SIGMAS) & inside)
        points, flux = areas.centre[chosen], areas.flux[chosen]
        sigma = np.sqrt(1.0 + areas.length[chosen] ** 2 / 12.0) / ratio[chosen]
        moving = np.zeros(len(chosen), dtype=np.bool_)
    first = np.argsort(-np.where(moving, np.inf, flux), kind="stable")[:MOST_POINTS]
    directions = camera.unit_vectors(points[first]) if len(first) else np.zeros((0, 3))
    angles = np.hypot(sigma[first], FLOOR_PX) / camera.focal_length
    return FieldPoints(points[first], directions, angles, flux[first], moving[first])
