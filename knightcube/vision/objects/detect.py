"""Three indicators that a streak is no star: centre, displacement, OLAE residual (Sease 4.11-4.15 corrected).

Every star turns about one axis by one angle. A streak that misses the common centre of rotation, that turned
by another angle about it, or that leaves a residual in OLAE belongs to something else. When the axis is
nearly normal to the boresight the centre runs to infinity; the slope takes its place and the length that of
the angle.

The pinhole's projection bends slopes and lengths across a wide field by far more than their errors, so each
indicator is compared with a star in the same place, and the difference is expressed in
expected errors of an endpoint. All three are then one scale, fair to bright and faint streaks, and without an
RSO their
spread is a constant of the detector: `python -m tests.studies.bench.rso_spread` measures it, for the lower
bounds
    that
the strict 2.5 sigma rule lacks (text at Table 4.4).

Resident space objects among the streaks of one frame (Sease chapter 4).

`rso_indicators` finds the streaks that do not move as the stars do. Such a streak is not yet an object: two
stars whose streaks overlap, or a piece of a faint star's streak, deviate as well (Table 4.4: "overlapping
streak"). `Judge` therefore tests whether stars explain the pixels (`star_light`). Regions with more than two
corners, which the thesis discards, may be stars or an object that crosses a star. Bright points in a frame
whose stars are streaks are tracked objects (Figure 4.5). Regions that are saturated or otherwise deviate, or
in which objects and stars are merged, are searched once their stars are removed (`merged`). The search needs
only the rotation of the camera. The maximum-likelihood estimate of that rotation succeeds in more frames than
the corners' estimate and is more accurate.
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
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.frame import MAD_TO_SIGMA, line_of, positions
from knightcube.vision.objects.settings import EndpointSettings, ObjectSettings
from knightcube.vision.objects.star_light import (
    Explanation,
    StarLight,
    brightest_left,
    carried_to_middle,
    cut_patch,
    fit_stars,
)
from knightcube.vision.objects.streak_ends import (
    Regions,
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


@dataclass(frozen=True, slots=True)
class Indicators:
    """The three indicators of n streaks, in the order of `INDICATORS`.

    Attributes:
        endpoints: (n, 2, 2) px, in the order of time in which a star would have gone.
        deviations: (n, 3) standard deviations from a star in the same place.
        fired: (n, 3) which exceed their thresholds.
        centre: (2,) px, of rotation, by least squares; worthless when `degenerate`.
        degenerate: whether slope and length stand in for centre and angle.
    """

    endpoints: FloatArray
    deviations: FloatArray
    fired: BoolArray
    centre: FloatArray
    degenerate: bool


def centre_residuals(endpoints: FloatArray, centre: FloatArray) -> FloatArray:
    """Return by how far (n,) px the bisector of each chord misses the centre (2,): 4.11-4.13 corrected."""
    chord = endpoints[:, 1] - endpoints[:, 0]
    length = np.linalg.norm(chord, axis=-1)
    missed = np.sum(chord * (centre - endpoints.mean(axis=1)), axis=-1)
    return np.asarray(missed / np.maximum(length, np.finfo(float).tiny))


def slopes(endpoints: FloatArray) -> FloatArray:
    """Return the direction (n,) of each chord in the image, rad: the slope m without its infinity."""
    chord = endpoints[:, 1] - endpoints[:, 0]
    return np.asarray(np.arctan2(chord[:, 1], chord[:, 0]))


def angular_displacements(endpoints: FloatArray, centre: FloatArray) -> FloatArray:
    """Return the angle (n,) rad that each streak (n, 2, 2) subtends at the centre (2,): 4.14."""
    first, second = endpoints[:, 0] - centre, endpoints[:, 1] - centre
    cross = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    # Not by the arc cosine, which is blind to small angles.
    return np.asarray(np.arctan2(np.abs(cross), np.sum(first * second, axis=-1)))


def lengths(endpoints: FloatArray) -> FloatArray:
    """Return the distance (n,) px between the ends: 4.15."""
    return np.asarray(np.linalg.norm(endpoints[:, 1] - endpoints[:, 0], axis=-1))


def olae_residuals(vectors: FloatArray, rotation: FloatArray) -> FloatArray:
    """Return the lengths (n,) of the OLAE residuals of directions (n, 2, 3), first to second (4.7)."""
    angle = float(np.linalg.norm(rotation))
    scale = np.tan(0.5 * angle) / angle if angle > 0.0 else 0.5
    sums, differences = vectors[:, 0] + vectors[:, 1], vectors[:, 1] - vectors[:, 0]
    return np.asarray(np.linalg.norm(np.cross(sums, scale * rotation) - differences, axis=-1))


def star_ends(vectors: FloatArray, rotation: FloatArray) -> FloatArray:
    """Return the first and last directions (n, 2, 3) of the stars whose chords have the middles of `vectors`.

    A chord's middle lies inside the circle: the part of it normal to the axis is too short by the cosine of
    half the angle turned.
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


def evaluate(
    endpoints: FloatArray,
    sigma: FloatArray,
    rotation: FloatArray,
    pinhole: Pinhole,
    bounds: tuple[float, float, float],
    strict: float = 2.5,
    farthest_centre: float = 3.0,
) -> Indicators:
    """Return the indicators of streaks under the rotation that the stars share.

    Args:
        endpoints: (n, 2, 2) px, without bias, in any order.
        sigma: (n,) px, expected errors of an endpoint.
        rotation: (3,) rad, camera frame, over the exposure.
        pinhole: the camera.
        bounds: least deviations at which each indicator fires, from their measured spread without an RSO.
        strict: robust standard deviations within the frame that must be exceeded too, the thesis's rule.
        farthest_centre: focal lengths from the image's middle, beyond which the centre is degenerate; taken
            of the axis, for the least squares' own centre, the thesis's trigger, falls short the more the
            farther it should be: errors and projection turn parallel chords enough to let them meet anywhere.
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
    normal_to_boresight = float(np.hypot(rotation[0], rotation[1])) > farthest_centre * abs(rotation[2])
    degenerate = normal_to_boresight or not np.all(np.isfinite(centre))
    if degenerate:
        centred, displaced = _slope_and_length(endpoints, expected)
    else:
        centred, displaced = _centre_and_angle(endpoints, expected, centre)
    deviations = np.stack([centred / error, displaced / error, residual], axis=-1)
    return Indicators(endpoints, deviations, _fired(deviations, bounds, strict), centre, degenerate)


def _centre_and_angle(
    endpoints: FloatArray, expected: FloatArray, centre: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return both indicators less a star's, in px across and along the streak at one end."""
    radius = np.linalg.norm(endpoints.mean(axis=1) - centre, axis=-1)
    missed = centre_residuals(endpoints, centre) - centre_residuals(expected, centre)
    turned = angular_displacements(endpoints, centre) - angular_displacements(expected, centre)
    return missed * lengths(endpoints) / np.maximum(radius, 1.0), turned * radius


def _slope_and_length(endpoints: FloatArray, expected: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the stand-ins for a centre at infinity less a star's, in px across and along the streak."""
    length = lengths(endpoints)
    return np.sin(slopes(endpoints) - slopes(expected)) * length, length - lengths(expected)


def _fired(deviations: FloatArray, bounds: tuple[float, float, float], strict: float) -> BoolArray:
    """Return which deviations (n, 3) exceed both the bound and `strict` times the frame's own spread.

    The spread is the median absolute deviation: an RSO would widen the standard deviation that is to find it,
    of ten streaks so far that none could exceed 2.85 of it.
    """
    if not len(deviations):
        return np.zeros((0, 3), dtype=np.bool_)
    spread = MAD_TO_SIGMA * np.median(np.abs(deviations), axis=0)
    return np.asarray(np.abs(deviations) > np.maximum(bounds, strict * spread))


# Bright parts shorter than this are points.
_LEAST_LINE_PX = 4.0


def short_regions(
    segmented: Segmented,
    rotation: FloatArray,
    pinhole: Pinhole,
    settings: EndpointSettings,
    objects: ObjectSettings,
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Return ends (n, 2, 2), errors (n,) px and labels (n,) of bright regions too short for corners.

    Only where stars would not be short. The ends are those of the uniform line with the region's moments; a
    point's two ends coincide.
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
    ends = np.array([_line_of(segmented, short, index) for index in range(len(short))]).reshape(-1, 2, 2)
    sigma = np.hypot(1.0, expected_sigma(short, segmented.background, settings))
    expected = pinhole.project(star_ends(pinhole.unit_vectors(ends), rotation))
    # Near the axis stars are points too.
    streaked: BoolArray = np.linalg.norm(expected[:, 1] - expected[:, 0], axis=-1) >= settings.least_length
    return ends[streaked], sigma[streaked], short.label[streaked]


def _line_of(segmented: Segmented, regions: Regions, index: int) -> FloatArray:
    """Return the ends (2, 2) px of the uniform line with the moments of a region's bright part.

    Bright is above half of the brightest pixel, so that a faint star's streak under a point does not lengthen
    it.
    """
    top, bottom, left, right = regions.boxes[index]
    row, column = positions(regions.labels[top:bottom, left:right] == regions.label[index])
    weight = segmented.signal[row + top, column + left].astype(float)
    bright = weight >= 0.5 * weight.max()
    points = np.stack([column + left, row + top], axis=-1)[bright].astype(float)
    weight = weight[bright] / weight[bright].sum()
    centre = weight @ points
    offset = points - centre
    # Shorter than the point spread the moments measure noise, not length.
    return line_of(centre, (offset * weight[:, None]).T @ offset, _LEAST_LINE_PX)


class Verdict(Enum):
    """The verdict on a streak: a star by its indicators, stars by its pixels, an object, or neither."""

    STAR = "star"
    STARS = "stars"
    OBJECT = "object"
    UNCLEAR = "unclear"


@dataclass(frozen=True, slots=True)
class SpaceObject:
    """A streak or point that does not move as the stars do.

    Attributes:
        endpoints: (2, 2) px, in the order of time for which the motion among the stars is the slower.
        fired: names of the indicators that singled it out; none when it was found by its pixels alone.
        flux: counts.
        improvement: of chi-square over stars.
        relative_rate: rad/s, its motion among the stars.
        direction: (2,) unit vector in the image (x, y), of that motion at mid-exposure.
        other_relative_rate: rad/s, for the other order of the endpoints, which one frame cannot exclude.
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
    """The streaks examined and the objects found.

    Attributes:
        indicators: of all streaks with two ends, then of the short regions.
        verdicts: one for each of them.
        crowded: verdicts of the regions with more than two corners.
        objects: brightest first.
        rotation: (3,) rad, camera frame, as used.
    """

    indicators: Indicators
    verdicts: tuple[Verdict, ...]
    crowded: tuple[Verdict, ...]
    objects: tuple[SpaceObject, ...]
    rotation: FloatArray


# Corners nearer to one another are one corner found twice.
_LEAST_CROSSING_PX = 10.0
# A star's ends, fitted to its pixels, are nearer than this to where the rotation puts them, px.
_FITTED_PX = 1.0
# A region this far from the frame's border ends inside the frame.
_BORDER_PX = 2


@dataclass(frozen=True, slots=True)
class Judge:
    """Distinguishes objects from stars by their pixels; the camera turns by `rotation` (3,) rad."""

    segmented: Segmented
    rotation: FloatArray
    pinhole: Pinhole
    exposure: float
    settings: EndpointSettings
    objects: ObjectSettings

    def streak(self, ends: FloatArray, fired: tuple[str, ...]) -> tuple[Verdict, SpaceObject | None]:
        """Return the verdict on a streak or point for which the indicators of these names fired."""
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
        """Return the verdict on a region with more than two corners (k, 2): stars, or an object."""
        if len(corners) > self.objects.most_corners:
            return Verdict.UNCLEAR, None
        pairs = np.array([corners[list(pair)] for pair in itertools.combinations(range(len(corners)), 2)])
        pairs = pairs[np.linalg.norm(pairs[:, 1] - pairs[:, 0], axis=-1) >= _LEAST_CROSSING_PX]
        lines = extend(pairs, chord_outward(pairs), self.settings.endpoint_bias) if len(pairs) else pairs
        try:
            light = self._light(corners)
            # Adding a line cannot explain more light than is left above the noise.
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
        """Return the objects in the regions whose labels are not `settled`; the `strange` come first."""
        regions = self.segmented.regions
        noise = self.segmented.background.typical_noise
        chosen = (
            ~np.isin(regions.label, settled)
            & (regions.flux >= self.objects.point_significance * noise * np.sqrt(regions.area))
            & ~near_border(regions, self.segmented.signal.shape, _BORDER_PX)
        )
        indices = np.flatnonzero(chosen)
        order = np.lexsort((-regions.flux[indices], ~np.isin(regions.label[indices], strange)))
        tried = [self._merged(int(index)) for index in indices[order[: self.objects.most_merged]]]
        return [found for found in tried if found is not None]

    def _merged(self, index: int) -> SpaceObject | None:
        """Return the object among the stars of region number `index`, None when there is none."""
        patch = cut_patch(
            self.segmented,
            self.segmented.regions,
            index,
            self.objects.psf_sigma,
            self.settings.gain,
            self.settings.saturation or np.inf,
        )
        alone = self._left_as_object(brightest_left(patch, patch.signal), ())
        if alone is not None:
            return alone
        stars, left = fit_stars(patch, self.rotation, self.pinhole)
        beside = self._left_as_object(brightest_left(patch, left), stars)
        enough = self.objects.least_share * float(self.segmented.regions.flux[index])
        return beside if beside is not None and beside.flux >= enough else None

    def _left_as_object(self, ends: FloatArray | None, stars: Sequence[FloatArray]) -> SpaceObject | None:
        """Return the object between `ends` (2, 2) px, beside stars on known paths, or None."""
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
        """Return whether the object explains enough, most of the light stars left along it, and fits."""
        enough = light.chi_square - found.chi_square >= improvement
        most = found.misfit <= 0.5 * found.misfit_of_stars
        # A saturated point's place is known to a tenth of a pixel, its wings not to their noise.
        fits = found.misfit <= max(self.objects.worst_fit, 0.1 * found.misfit_of_stars)
        return enough and most and fits

    def _stars_or_unclear(self, light: StarLight) -> Verdict:
        return Verdict.STARS if light.chi_square <= self.objects.worst_fit * light.pixels else Verdict.UNCLEAR

    def _moves_like_a_star(self, ends: FloatArray, within: float = 2.0) -> bool:
        """Return whether the ends (2, 2) lie `within` this many px of a star's."""
        star = self.pinhole.project(star_ends(self.pinhole.unit_vectors(ends[None]), self.rotation))[0]
        missed = min(np.abs(star - ends).max(), np.abs(star[::-1] - ends).max())
        return bool(missed < within)

    def _candidate(
        self, ends: FloatArray, fired: tuple[str, ...], light: StarLight, found: Explanation
    ) -> SpaceObject:
        rate, direction = self._among_stars(ends)
        other, other_direction = self._among_stars(ends[::-1])
        if other < rate:
            ends, rate, other, direction = ends[::-1], other, rate, other_direction
        improvement = light.chi_square - found.chi_square
        return SpaceObject(ends, fired, found.flux, improvement, rate, direction, other)

    def _among_stars(self, ends: FloatArray) -> tuple[float, FloatArray]:
        """Return rate in rad/s and direction (2,) in the image of a motion from the first end to the second.

        Both ends are carried to mid-exposure as a star would be: the difference left is the object's own
        motion.
        """
        carried = carried_to_middle(self.pinhole.unit_vectors(ends), self.rotation)
        angle = np.arctan2(np.linalg.norm(np.cross(carried[0], carried[1])), carried[0] @ carried[1])
        step = np.diff(self.pinhole.project(carried), axis=0)[0]
        return float(angle) / self.exposure, np.asarray(step / max(float(np.linalg.norm(step)), 1e-9))


# A streak with an indicator beyond this many standard deviations is judged by its pixels, though none fired.
_STRANGE = 5.0


def detect(
    pixels: Image,
    pinhole: Pinhole,
    rotation: FloatArray,
    exposure: float,
    settings: EndpointSettings,
    objects: ObjectSettings,
) -> ObjectReport | None:
    """Return the objects of a frame (rows, columns), None when it has too few streaks.

    The camera turns by `rotation` (3,) rad in `exposure` s. Where the sign of the rotation is unknown, all
    directions of motion are known up to one common reversal.
    """
    segmented = segment_frame(pixels, replace(settings, most_streaks=objects.most_streaks))
    streaks = measure_streaks(segmented, settings)
    if len(streaks) < settings.least_streaks:
        return None
    return examine(segmented, streaks, rotation, pinhole, exposure, settings, objects)


def examine(
    segmented: Segmented,
    streaks: Streaks,
    rotation: FloatArray,
    pinhole: Pinhole,
    exposure: float,
    settings: EndpointSettings,
    objects: ObjectSettings,
) -> ObjectReport:
    """Return the objects among segmented regions; the camera turns by `rotation` (3,) rad in `exposure` s."""
    judge = Judge(segmented, rotation, pinhole, exposure, settings, objects)
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
    return _judged(judge, indicators, labels, streaks)


def _judged(judge: Judge, indicators: Indicators, labels: IntArray, streaks: Streaks) -> ObjectReport:
    """Return the verdict on each streak of `indicators`, of regions `labels`, and on the crowded regions."""
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
