"""Resident space objects among the star streaks of one image (Sease chapter 4).

    found = detect_objects(image, camera, rate, exposure)

In camera axes, all stars rotate about the same axis by the same angle. Three indicators show that a streak
belongs to something else: its chord misses the common centre of rotation, it subtends another angle there, or
it leaves a residual in OLAE (Sease 4.11-4.15, corrected). If the axis is nearly normal to the boresight, the
centre recedes to infinity, and slope and length of the chord replace centre and angle. The projection of a
pinhole changes slopes and lengths across a wide field by far more than their errors. Each indicator is
therefore compared with a star at the same position, in units of the expected error of an endpoint. The strict
rule of 2.5 sigma lacks lower bounds (text at Table 4.4); the bounds here are the measured spread without an
object.

A deviating streak is not yet an object: two stars whose streaks overlap, or a segment of a faint star's
streak, deviate as well (Table 4.4: "overlapping streak"). `Judge` therefore tests whether stars explain the
pixels (`star_light`). Regions with more than two corners, which the thesis discards, may be stars or an
object that crosses a star. Bright points in an image whose stars are streaks are tracked objects (Figure
4.5). Regions that are saturated or otherwise deviate, or in which objects and stars are merged, are searched
after their stars are removed. The search needs only the rotation of the camera. The maximum-likelihood
estimate of that rotation succeeds in more images than the corners' estimate and is more accurate.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, Image, IntArray
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector
from knightcube.errors import FlightError
from knightcube.vision.camera.lens import CameraModel, Pinhole, check_image
from knightcube.vision.frame import MAD_TO_SIGMA, line_of, positions
from knightcube.vision.objects.settings import EndpointSettings, ObjectSettings
from knightcube.vision.objects.star_light import (
    Explanation,
    StarLight,
    at_mid_exposure,
    brightest_left,
    cut_patch,
    fit_stars,
)
from knightcube.vision.objects.streak_ends import (
    Segmented,
    Streaks,
    centre_of_rotation,
    chord_outward,
    expected_sigma,
    extend,
    measure_streaks,
    near_border,
    segment_frame,
)

INDICATORS = ("centre", "displacement", "residual")
"""Names of the three indicators."""


@dataclass(frozen=True, slots=True)
class Indicators:
    """The three indicators of n streaks, in the order of `INDICATORS`.

    Attributes:
        endpoints: ends of the streaks (n, 2, 2), px, in the order of time in which a star would have moved.
        deviations: deviations from a star at the same position (n, 3), in standard deviations.
        fired: which deviations exceed their thresholds (n, 3).
        centre: centre of rotation (2,), px, by least squares; meaningless if `degenerate`.
        degenerate: whether slope and length replace centre and angle.
    """

    endpoints: FloatArray
    deviations: FloatArray
    fired: BoolArray
    centre: FloatArray
    degenerate: bool


def centre_residuals(endpoints: FloatArray, centre: FloatArray) -> FloatArray:
    """Return the distances (n,), px, of a centre (2,) from the bisectors of chords, by 4.11-4.13."""
    chord = endpoints[:, 1] - endpoints[:, 0]
    missed = np.sum(chord * (centre - endpoints.mean(axis=1)), axis=-1)
    return np.asarray(missed / np.maximum(np.linalg.norm(chord, axis=-1), np.finfo(float).tiny))


def slopes(endpoints: FloatArray) -> FloatArray:
    """Return the directions (n,), rad, of chords (n, 2, 2) in the image."""
    chord = endpoints[:, 1] - endpoints[:, 0]
    return np.asarray(np.arctan2(chord[:, 1], chord[:, 0]))


def angular_displacements(endpoints: FloatArray, centre: FloatArray) -> FloatArray:
    """Return the angles (n,), rad, that streaks (n, 2, 2) subtend at a centre (2,), by 4.14."""
    first, second = endpoints[:, 0] - centre, endpoints[:, 1] - centre
    cross = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    # The arc cosine would be inaccurate for small angles.
    return np.asarray(np.arctan2(np.abs(cross), np.sum(first * second, axis=-1)))


def lengths(endpoints: FloatArray) -> FloatArray:
    """Return the lengths (n,), px, of chords (n, 2, 2), by 4.15."""
    return np.asarray(np.linalg.norm(endpoints[:, 1] - endpoints[:, 0], axis=-1))


def olae_residuals(vectors: FloatArray, rotation: FloatArray) -> FloatArray:
    """Return the norms (n,) of the OLAE residuals of directions (n, 2, 3), first and second, by 4.7."""
    angle = float(np.linalg.norm(rotation))
    scale = np.tan(0.5 * angle) / angle if angle > 0.0 else 0.5
    sums, differences = vectors[:, 0] + vectors[:, 1], vectors[:, 1] - vectors[:, 0]
    return np.asarray(np.linalg.norm(np.cross(sums, scale * rotation) - differences, axis=-1))


def star_ends(vectors: FloatArray, rotation: FloatArray) -> FloatArray:
    """Return the first and last directions (n, 2, 3) of stars whose chords have the midpoints of `vectors`.

    The midpoint of a chord lies inside of the circle: its component normal to the axis is too short by the
    cosine of half the rotation angle.
    """
    angle = float(np.linalg.norm(rotation))
    middle = vectors.mean(axis=1)
    if angle > 0.0:
        axis = rotation / angle
        along = (middle @ axis)[:, None] * axis
        middle = along + (middle - along) / np.cos(0.5 * angle)
    middle = middle / np.linalg.norm(middle, axis=-1, keepdims=True)
    halves = [attitude_matrix(from_rotation_vector(part * rotation)) for part in (-0.5, 0.5)]
    return np.stack([middle @ half.T for half in halves], axis=1)


# Distance of the centre of rotation from the boresight, in focal lengths, beyond which it is degenerate. The
# axis of the rotation decides, because the centre by least squares is too near: its errors and the projection
# make parallel chords intersect.
_FARTHEST_CENTRE = 3.0


def evaluate(
    endpoints: FloatArray,
    sigma: FloatArray,
    rotation: FloatArray,
    pinhole: Pinhole,
    bounds: tuple[float, float, float],
    strict: float = 2.5,
) -> Indicators:
    """Return the indicators of streaks under the rotation that the stars share.

    Args:
        endpoints: ends of the streaks (n, 2, 2), px, without bias, in any order.
        sigma: expected errors of an endpoint (n,), px.
        rotation: rotation of the camera over the exposure (3,), rad, camera axes.
        pinhole: the camera.
        bounds: least deviations at which each indicator fires.
        strict: robust standard deviations within the image that must be exceeded too, as in the thesis.
    """
    vectors = pinhole.unit_vectors(endpoints)
    stars = star_ends(vectors, rotation)
    backward = np.sum((vectors[:, 1] - vectors[:, 0]) * (stars[:, 1] - stars[:, 0]), axis=-1) < 0.0
    endpoints = np.where(backward[:, None, None], endpoints[:, ::-1], endpoints)
    vectors = np.where(backward[:, None, None], vectors[:, ::-1], vectors)
    error = np.sqrt(2.0) * sigma
    residual = olae_residuals(vectors, rotation) * pinhole.focal_length / error
    expected = pinhole.project(stars)
    quiet = residual <= bounds[2]
    centre = centre_of_rotation(endpoints[quiet]) if np.count_nonzero(quiet) >= 2 else np.full(2, np.nan)
    normal_to_boresight = float(np.hypot(rotation[0], rotation[1])) > _FARTHEST_CENTRE * abs(rotation[2])
    degenerate = normal_to_boresight or not np.all(np.isfinite(centre))
    length = lengths(endpoints)
    # The differences from a star are in px across and along the streak at one end.
    if degenerate:
        across = np.sin(slopes(endpoints) - slopes(expected)) * length
        along = length - lengths(expected)
    else:
        radius = np.linalg.norm(endpoints.mean(axis=1) - centre, axis=-1)
        missed = centre_residuals(endpoints, centre) - centre_residuals(expected, centre)
        turned = angular_displacements(endpoints, centre) - angular_displacements(expected, centre)
        across, along = missed * length / np.maximum(radius, 1.0), turned * radius
    deviations = np.stack([across / error, along / error, residual], axis=-1)
    fired = np.zeros((0, 3), dtype=np.bool_)
    if len(deviations):
        # The median absolute deviation is used, because an object increases the standard deviation.
        # Of ten streaks, none can exceed 2.85 standard deviations.
        spread = MAD_TO_SIGMA * np.median(np.abs(deviations), axis=0)
        fired = np.abs(deviations) > np.maximum(bounds, strict * spread)
    return Indicators(endpoints, deviations, fired, centre, degenerate)


# Length (px) below which a bright part of a region is a point.
_LEAST_LINE_PX = 4.0


def short_regions(
    segmented: Segmented,
    rotation: FloatArray,
    pinhole: Pinhole,
    settings: EndpointSettings,
    objects: ObjectSettings,
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Return the bright regions that are too short for corners, where stars would not be short.

    The result is their ends (n, 2, 2), px, errors (n,), px, and labels (n,). The ends are those of the
    uniform line with the moments of the region's bright part; both ends of a point are equal.
    """
    regions = segmented.regions
    noise = segmented.background.typical_noise
    chosen = (
        ~np.isin(regions.label, segmented.candidates.label)
        & (regions.length < settings.least_length)
        & (regions.flux >= objects.point_significance * noise * np.sqrt(regions.area))
        & ~near_border(regions, segmented.signal.shape, settings.border)
    )
    brightest = np.flatnonzero(chosen)[np.argsort(-regions.flux[chosen], kind="stable")]
    short = regions.select(brightest[: objects.most_points])
    lines = []
    for (top, bottom, left, right), label in zip(short.boxes, short.label, strict=True):
        row, column = positions(short.labels[top:bottom, left:right] == label)
        weight = segmented.signal[row + top, column + left].astype(float)
        # Only pixels above half of the maximum are used, so that a faint streak does not lengthen a point.
        bright = weight >= 0.5 * weight.max()
        points = np.stack([column + left, row + top], axis=-1)[bright].astype(float)
        weight = weight[bright] / weight[bright].sum()
        centre = weight @ points
        offset = points - centre
        # If the region is smaller than the point spread, the moments are dominated by noise.
        lines.append(line_of(centre, (offset * weight[:, None]).T @ offset, _LEAST_LINE_PX))
    ends = np.array(lines).reshape(-1, 2, 2)
    sigma = np.hypot(1.0, expected_sigma(short, segmented.background, settings))
    expected = pinhole.project(star_ends(pinhole.unit_vectors(ends), rotation))
    # Near the axis of rotation, the images of stars are points too.
    streaked: BoolArray = np.linalg.norm(expected[:, 1] - expected[:, 0], axis=-1) >= settings.least_length
    return ends[streaked], sigma[streaked], short.label[streaked]


class Verdict(Enum):
    """The verdict on a streak: a star by its indicators, stars by its pixels, an object, or undecided."""

    STAR = "star"
    STARS = "stars"
    OBJECT = "object"
    UNCLEAR = "unclear"


@dataclass(frozen=True, slots=True)
class SpaceObject:
    """A streak or point that does not move as the stars do.

    Attributes:
        endpoints: ends (2, 2), px, in the order of time for which the motion among the stars is slower.
        fired: names of the indicators that fired; empty if the object was found by its pixels alone.
        flux: light, counts.
        improvement: gain in chi-square over stars alone.
        relative_rate: angular rate of its motion among the stars, rad/s.
        direction: direction of that motion in the image at mid-exposure, unit vector (2,), x and y.
        other_relative_rate: rate for the other order of the endpoints, which one image cannot exclude, rad/s.
    """

    endpoints: FloatArray
    fired: tuple[str, ...]
    flux: float
    improvement: float
    relative_rate: float
    direction: FloatArray
    other_relative_rate: float


@dataclass(frozen=True, slots=True)
class ObjectReport:
    """The examined streaks and the objects among them.

    Attributes:
        indicators: indicators of all streaks with two ends, then of the short regions.
        verdicts: verdict on each streak and each short region.
        crowded: verdicts on the regions with more than two corners.
        objects: the objects, the brightest first.
        rotation: the rotation that was used (3,), rad, camera axes.
    """

    indicators: Indicators
    verdicts: tuple[Verdict, ...]
    crowded: tuple[Verdict, ...]
    objects: tuple[SpaceObject, ...]
    rotation: FloatArray


# Distance (px) below which two corners are one corner that was found twice.
_LEAST_CROSSING_PX = 10.0
# Largest distance (px) of the fitted ends of a star from those that the rotation predicts.
_FITTED_PX = 1.0
# Distance (px) from the border beyond which a region ends inside of the image.
_BORDER_PX = 2


@dataclass(frozen=True, slots=True)
class Judge:
    """Distinguishes objects from stars by their pixels; the camera rotates by `rotation` (3,), rad."""

    segmented: Segmented
    rotation: FloatArray
    pinhole: Pinhole
    exposure: float
    settings: EndpointSettings
    objects: ObjectSettings

    def streak(self, ends: FloatArray, fired: tuple[str, ...]) -> tuple[Verdict, SpaceObject | None]:
        """Return the verdict on a streak or point for which the named indicators fired."""
        if not fired:
            return Verdict.STAR, None
        try:
            light = self._light(ends)
            found = light.explain(ends)
        except FlightError:
            return Verdict.UNCLEAR, None
        if self._is_object(light, found, self.objects.improvement):
            return Verdict.OBJECT, self._candidate(ends, fired, light, found)
        return self._stars_or_unclear(light), None

    def crowd(self, corners: FloatArray) -> tuple[Verdict, SpaceObject | None]:
        """Return the verdict on a region with more than two corners (k, 2), px."""
        if len(corners) > self.objects.most_corners:
            return Verdict.UNCLEAR, None
        pairs = np.array([corners[list(pair)] for pair in itertools.combinations(range(len(corners)), 2)])
        pairs = pairs[np.linalg.norm(pairs[:, 1] - pairs[:, 0], axis=-1) >= _LEAST_CROSSING_PX]
        lines = extend(pairs, chord_outward(pairs), self.settings.endpoint_bias) if len(pairs) else pairs
        try:
            light = self._light(corners)
            # A line cannot improve chi-square by more than its excess over the number of pixels.
            hopeless = light.chi_square - light.pixels < self.objects.improvement
            tried = [] if hopeless else [(ends, light.explain(ends)) for ends in lines]
        except FlightError:
            return Verdict.UNCLEAR, None
        if not tried:
            return self._stars_or_unclear(light), None
        ends, found = min(tried, key=lambda one: one[1].chi_square)
        enough = self.objects.crossing_improvement
        if self._is_object(light, found, enough) and not self._moves_like_a_star(ends):
            return Verdict.OBJECT, self._candidate(ends, (), light, found)
        return self._stars_or_unclear(light), None

    def merged(self, settled: IntArray, strange: IntArray) -> list[SpaceObject]:
        """Return the objects in regions whose labels are not `settled`; `strange` labels are tried first.

        The light of the stars in a region is removed, and the brightest remainder is tested.
        """
        regions = self.segmented.regions
        noise = self.segmented.background.typical_noise
        chosen = (
            ~np.isin(regions.label, settled)
            & (regions.flux >= self.objects.point_significance * noise * np.sqrt(regions.area))
            & ~near_border(regions, self.segmented.signal.shape, _BORDER_PX)
        )
        indices = np.flatnonzero(chosen)
        order = np.lexsort((-regions.flux[indices], ~np.isin(regions.label[indices], strange)))
        objects = []
        for index in indices[order[: self.objects.most_merged]].tolist():
            patch = cut_patch(
                self.segmented,
                regions,
                index,
                self.objects.psf_sigma,
                self.settings.gain,
                self.settings.saturation or np.inf,
            )
            found = self._remaining_object(brightest_left(patch, patch.signal), ())
            if found is None:
                stars, left = fit_stars(patch, self.rotation, self.pinhole)
                found = self._remaining_object(brightest_left(patch, left), stars)
                enough = self.objects.least_share * float(regions.flux[index])
                found = found if found is not None and found.flux >= enough else None
            objects += [found] if found is not None else []
        return objects

    def _remaining_object(self, ends: FloatArray | None, stars: Sequence[FloatArray]) -> SpaceObject | None:
        """Return the object between `ends` (2, 2), px, beside stars on known paths; None if there is none."""
        if ends is None or self._moves_like_a_star(ends, _FITTED_PX):
            return None
        try:
            light = self._light(ends, stars)
            found = light.explain(ends)
        except FlightError:
            return None
        if not self._is_object(light, found, self.objects.crossing_improvement):
            return None
        return self._candidate(ends, (), light, found)

    def _light(self, corners: FloatArray, known: Sequence[FloatArray] = ()) -> StarLight:
        return StarLight(
            self.segmented,
            corners,
            self.rotation,
            self.pinhole,
            self.objects.psf_sigma,
            self.settings.gain,
            self.settings.saturation or np.inf,
            known,
        )

    def _is_object(self, light: StarLight, found: Explanation, improvement: float) -> bool:
        """Return whether an object explains enough, most of the light that stars leave, and fits."""
        enough = light.chi_square - found.chi_square >= improvement
        most = found.misfit <= 0.5 * found.misfit_of_stars
        # A saturated point has a position error of 0.1 px, so that its wings do not fit within their noise.
        fits = found.misfit <= max(self.objects.worst_fit, 0.1 * found.misfit_of_stars)
        return enough and most and fits

    def _stars_or_unclear(self, light: StarLight) -> Verdict:
        return Verdict.STARS if light.chi_square <= self.objects.worst_fit * light.pixels else Verdict.UNCLEAR

    def _moves_like_a_star(self, ends: FloatArray, within: float = 2.0) -> bool:
        """Return whether ends (2, 2), px, lie `within` that many px of the ends of a star."""
        star = self.pinhole.project(star_ends(self.pinhole.unit_vectors(ends[None]), self.rotation))[0]
        missed = min(np.abs(star - ends).max(), np.abs(star[::-1] - ends).max())
        return bool(missed < within)

    def _candidate(
        self, ends: FloatArray, fired: tuple[str, ...], light: StarLight, found: Explanation
    ) -> SpaceObject:
        """Return the object between `ends`, in the order of time with the slower motion among the stars."""
        rate, direction = self._among_stars(ends)
        other, other_direction = self._among_stars(ends[::-1])
        if other < rate:
            ends, rate, other, direction = ends[::-1], other, rate, other_direction
        improvement = light.chi_square - found.chi_square
        return SpaceObject(ends, fired, found.flux, improvement, rate, direction, other)

    def _among_stars(self, ends: FloatArray) -> tuple[float, FloatArray]:
        """Return rate, rad/s, and direction (2,) in the image of a motion from the first end to the second.

        Both ends are propagated to mid-exposure as stars would be. Their remaining difference is the motion
        of the object.
        """
        middle = at_mid_exposure(self.pinhole.unit_vectors(ends), self.rotation)
        angle = np.arctan2(np.linalg.norm(np.cross(middle[0], middle[1])), middle[0] @ middle[1])
        step = np.diff(self.pinhole.project(middle), axis=0)[0]
        return float(angle) / self.exposure, np.asarray(step / max(float(np.linalg.norm(step)), 1e-9))


# Deviation (standard deviations) above which a streak is searched for a merged object.
_STRANGE = 5.0


def detect(
    pixels: Image,
    pinhole: Pinhole,
    rotation: FloatArray,
    exposure: float,
    settings: EndpointSettings,
    objects: ObjectSettings,
) -> ObjectReport | None:
    """Return the report on an image (rows, columns); None if it has too few streaks.

    The camera rotates by `rotation` (3,), rad, in `exposure` s. If the sign of the rotation is unknown, all
    directions of motion are known up to one common reversal.
    """
    segmented = segment_frame(pixels, replace(settings, most_streaks=objects.most_streaks))
    streaks = measure_streaks(segmented, settings)
    if len(streaks) < settings.least_streaks:
        return None
    ends = extend(streaks.endpoints, chord_outward(streaks.endpoints), settings.endpoint_bias)
    short, short_sigma, short_label = short_regions(segmented, rotation, pinhole, settings, objects)
    indicators = evaluate(
        np.concatenate([ends, short]),
        np.concatenate([streaks.sigma, short_sigma]),
        rotation,
        pinhole,
        objects.bounds,
        objects.strict,
    )
    labels = np.concatenate([segmented.candidates.label[streaks.candidate], short_label])
    judge = Judge(segmented, rotation, pinhole, exposure, settings, objects)
    return _judged(judge, indicators, labels, streaks)


def _judged(judge: Judge, indicators: Indicators, labels: IntArray, streaks: Streaks) -> ObjectReport:
    """Return the verdicts on the streaks of `indicators`, in regions `labels` (n,), and on crowds."""
    found: list[SpaceObject] = []
    settled: list[int] = []
    strange: list[int] = []
    verdicts, crowded = [], []
    each = zip(labels, indicators.endpoints, indicators.deviations, indicators.fired, strict=True)
    for label, streak, deviation, fired in each:
        names = tuple(name for name, fires in zip(INDICATORS, fired, strict=True) if fires)
        verdict, candidate = judge.streak(streak, names)
        verdicts.append(verdict)
        found += [candidate] if candidate is not None else []
        calm = verdict is Verdict.OBJECT or np.abs(deviation).max() <= _STRANGE
        (settled if calm else strange).append(int(label))
    for index, corners in streaks.crowded:
        verdict, candidate = judge.crowd(corners)
        crowded.append(verdict)
        found += [candidate] if candidate is not None else []
        settled += [int(judge.segmented.candidates.label[index])] if verdict is Verdict.OBJECT else []
    found += judge.merged(np.array(settled, dtype=np.int64), np.array(strange, dtype=np.int64))
    found.sort(key=lambda candidate: -candidate.flux)
    return ObjectReport(indicators, tuple(verdicts), tuple(crowded), tuple(found), judge.rotation)


@dataclass(frozen=True, slots=True, eq=False)
class DetectedObjects:
    """The objects in one image, the brightest first. The result is true if there is an object.

    Attributes:
        objects: the n objects.
        directions: directions at mid-exposure (n, 3), unit vectors in camera axes.
        covariance: covariance of their errors (n, 3, 3), rad^2, zero along the direction.
        reason: why the image could not be searched; empty if it was searched, with or without a result.
    """

    objects: tuple[SpaceObject, ...]
    directions: FloatArray
    covariance: FloatArray
    reason: str = ""

    def __bool__(self) -> bool:
        """Return whether there is an object."""
        return len(self.objects) > 0


def detect_objects(
    image: Image,
    camera: CameraModel,
    rate: FloatArray,
    exposure: float,
    settings: ObjectSettings | None = None,
) -> DetectedObjects:
    """Return the objects that do not move as the stars do, in an image whose stars are streaks.

    Args:
        image: pixel values (rows, columns) of an unsigned integer type, with streaks of 20 px or more.
        camera: the camera, `Pinhole` or `Lens` of `knightcube.vision.camera.lens`, of the image's size. The
            distortion of a lens is neglected.
        rate: angular velocity of the camera with respect to inertial space (3,), camera axes, rad/s, for
            instance from the streaks of the image. If its sign is unknown, all motions are known up to one
            reversal.
        exposure: exposure time, s.
        settings: thresholds, gain and saturation; None: the defaults.

    Raises:
        ValueError: if the image does not have the size of the camera, or has pixels that are not finite.

    Source: Sease 2013, chapter 4, with the errata; the tests of the pixels are this project's.
    """
    settings = ObjectSettings() if settings is None else settings
    check_image(image, camera)
    ends = EndpointSettings(gain=settings.gain, saturation=settings.saturation)
    rotation = np.asarray(rate, dtype=float) * exposure
    report = detect(image, camera.ideal, rotation, exposure, ends, settings)
    objects = () if report is None else report.objects
    middles = np.array([item.endpoints.mean(axis=0) for item in objects]).reshape(-1, 2)
    directions = camera.unit_vectors(middles)
    # Off the boresight a pixel subtends a smaller angle; the larger one of the boresight is used.
    sigma = settings.streak_sigma / camera.focal_length
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    reason = f"fewer than {ends.least_streaks} streaks stand out of the noise" if report is None else ""
    return DetectedObjects(objects, directions, sigma**2 * across, reason)
