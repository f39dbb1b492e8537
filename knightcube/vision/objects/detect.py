"""Detection of resident space objects among the star streaks of one image (Sease, chapter 4).

    found = detect_objects(image, camera, rate, exposure)

In camera axes, all stars rotate about the same axis by the same angle. Three indicators show that a streak is
not the image of a star: the perpendicular bisector of its chord misses the common centre of rotation, the
streak subtends a different angle at this centre, or its residual in the Optimal Linear Attitude Estimator
(OLAE) is large (Sease, eq. (4.11) to (4.15), with corrections). If the rotation axis is nearly normal to the
boresight, the centre of rotation is almost at infinity in the image. If the centre of rotation is farther
away than `_FARTHEST_CENTRE`, the slope and the length of the chord are used instead of the centre and the
angle. In a wide field, the pinhole projection changes slopes and lengths by far more than their errors. Each
indicator is therefore compared with the indicator of a star at the same position, in units of the expected
error of an endpoint. An indicator must exceed 2.5 standard deviations over the streaks of the image (Sease,
text at Table 4.4), and also a minimum threshold, which was measured in images without objects.

A streak with a large indicator may also be the overlapping streaks of two stars, or a segment of a faint
star's streak ("overlapping streak" in Sease, Table 4.4). The class `Judge` tests whether stars alone explain
the pixels of a streak with a large indicator or of a region with more than two corners (`star_light`). Sease
discards regions with more than two corners (peaks of the corner detector). A region with more than two
corners may consist of several stars, or of an object that crosses a star. Bright points in an image whose
stars are streaks are objects that the camera tracks (Sease, Figure 4.5). Saturated regions, regions with
large indicators, and regions in which objects and stars may merge are searched again after the stars are
subtracted. Besides the image, the search for objects needs only the rotation of the camera during the
exposure.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from numpy.typing import ArrayLike

from knightcube.astro.arrays import (
    BoolArray,
    FloatArray,
    Image,
    IntArray,
    finite_array,
)
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector
from knightcube.compiled import compiled_form_of
from knightcube.errors import KnightCubeError
from knightcube.vision.background import MAD_TO_SIGMA
from knightcube.vision.camera.lens import CameraModel, Pinhole, image_of_camera, streak_camera
from knightcube.vision.frame import (
    check_detector,
    checked_exposure,
    gain_in_counts,
    line_of,
    positions,
    raw_counts,
    saturation_level,
)
from knightcube.vision.objects.settings import EndpointSettings, ObjectSettings
from knightcube.vision.objects.star_light import (
    PATHS_PER_LENGTH,
    Explanation,
    LocatedEnds,
    StarLight,
    light_on_path,
    region_along,
)
from knightcube.vision.objects.star_subtraction import (
    LEAST_LINE_PX,
    Patch,
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
    flashes_of_objects,
    measure_streaks,
    near_border,
    pixels_of_region,
    segment_frame,
)
from knightcube.vision.objects.streak_images import at_mid_exposure, star_path, star_paths

INDICATORS = ("centre", "displacement", "residual")
"""Names of the three indicators of a non-stellar streak."""


@dataclass(frozen=True, slots=True)
class Indicators:
    """The three indicators of n streaks, in the order of `INDICATORS`.

    Attributes:
        endpoints: start and end of each streak (n, 2, 2), px, in the direction of motion of the stars.
        deviations: differences (n, 3) from a star's indicators at the same position, in standard deviations.
        fired: mask (n, 3) of the indicators of each streak that exceed their thresholds.
        centre: centre of rotation in the image by least squares (2,), px; meaningless if `degenerate`.
        degenerate: whether slopes and lengths of the chords are used instead of centre and angle.
    """

    endpoints: FloatArray
    deviations: FloatArray
    fired: BoolArray
    centre: FloatArray
    degenerate: bool


def centre_residuals(endpoints: FloatArray, centre: FloatArray) -> FloatArray:
    """Return distances (n,), px, of a rotation centre (2,) from the perpendicular bisectors of chords.

    Source: Sease, eq. (4.11) to (4.13).
    """
    chord = endpoints[:, 1] - endpoints[:, 0]
    missed = np.sum(chord * (centre - endpoints.mean(axis=1)), axis=-1)
    return np.asarray(missed / np.maximum(np.linalg.norm(chord, axis=-1), np.finfo(float).tiny))


def slopes(endpoints: FloatArray) -> FloatArray:
    """Return the angles (n,), rad, between the image's x axis and the chords (n, 2, 2), px, of streaks."""
    chord = endpoints[:, 1] - endpoints[:, 0]
    return np.asarray(np.arctan2(chord[:, 1], chord[:, 0]))


def angular_displacements(endpoints: FloatArray, centre: FloatArray) -> FloatArray:
    """Return angles (n,), rad, that streaks (n, 2, 2) subtend at a centre (2,) (Sease, eq. (4.14))."""
    first, second = endpoints[:, 0] - centre, endpoints[:, 1] - centre
    cross = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    # The angles are computed by the arc tangent, because the arc cosine is inaccurate for small angles.
    return np.asarray(np.arctan2(np.abs(cross), np.sum(first * second, axis=-1)))


def lengths(endpoints: FloatArray) -> FloatArray:
    """Return the lengths (n,), px, of the chords (n, 2, 2), px, of streaks (Sease, eq. (4.15))."""
    return np.asarray(np.linalg.norm(endpoints[:, 1] - endpoints[:, 0], axis=-1))


def olae_residuals(vectors: FloatArray, rotation: FloatArray) -> FloatArray:
    """Return the norms (n,) of the OLAE residuals of streaks (Sease, eq. (4.7)).

    The array `vectors` (n, 2, 3) contains the unit vectors to the first and the last end of each streak, and
    `rotation` (3,), rad, is the rotation vector of the camera.
    """
    angle = float(np.linalg.norm(rotation))
    scale = np.tan(0.5 * angle) / angle if angle > 0.0 else 0.5
    sums, differences = vectors[:, 0] + vectors[:, 1], vectors[:, 1] - vectors[:, 0]
    return np.asarray(np.linalg.norm(np.cross(sums, scale * rotation) - differences, axis=-1))


def star_ends(vectors: FloatArray, rotation: FloatArray) -> FloatArray:
    """Return start and end directions (n, 2, 3) of stars whose chords have the same midpoints as `vectors`.

    A star moves on a circle about the rotation axis. The midpoint of the star's chord is nearer to the
    rotation axis than the star, by a factor of the cosine of half the rotation angle.
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


# Largest distance of a useful rotation centre from the boresight, in focal lengths.
# The distance is computed from the rotation axis, because errors make a fitted centre appear too near.
_FARTHEST_CENTRE = 3.0


def evaluate(
    endpoints: FloatArray,
    sigma: FloatArray,
    rotation: FloatArray,
    pinhole: Pinhole,
    bounds: tuple[float, float, float],
    strict: float = 2.5,
) -> Indicators:
    """Return the indicators of non-stellar streaks for a given `rotation` (3,), rad, of the camera.

    The ends of the streaks (n, 2, 2), px, are corrected for bias, and their expected standard deviations are
    `sigma` (n,), px. The thresholds `bounds` and `strict` are those of `ObjectSettings`.
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
    # The differences from a star's streak are displacements (px) of one end across or along the streak.
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
        # The median absolute deviation is used, because an object itself increases the standard deviation.
        # For example, none of ten values can deviate from their mean by more than 2.85 standard deviations.
        spread = MAD_TO_SIGMA * np.median(np.abs(deviations), axis=0)
        fired = np.abs(deviations) > np.maximum(bounds, strict * spread)
    return Indicators(endpoints, deviations, fired, centre, degenerate)


def short_regions(
    segmented: Segmented,
    rotation: FloatArray,
    pinhole: Pinhole,
    settings: EndpointSettings,
    objects: ObjectSettings,
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Return ends (n, 2, 2), px, standard deviations (n,), px, and labels (n,) of short bright regions.

    Short regions are shorter than the streak of a star at the same position. The ends of a region are those
    of the uniform line with the same moments as the region's bright part. For a point, both ends are equal.
    """
    regions = segmented.regions
    bright = regions.is_significant(objects.point_significance, segmented.background)
    outside = near_border(regions, segmented.signal.shape, settings.border)
    other = ~np.isin(regions.label, segmented.candidates.label) & (regions.length < settings.least_length)
    chosen = other & bright & ~outside
    brightest = np.flatnonzero(chosen)[np.argsort(-regions.flux[chosen], kind="stable")]
    short = regions.select(brightest[: objects.most_points])
    lines = []
    for (top, bottom, left, right), label in zip(short.boxes, short.label, strict=True):
        row, column = positions(short.labels[top:bottom, left:right] == label)
        weight = segmented.signal[row + top, column + left].astype(float)
        # Pixels below half the maximum are excluded, because a faint star would lengthen a point.
        bright = weight >= 0.5 * weight.max()
        points = np.stack([column + left, row + top], axis=-1)[bright].astype(float)
        weight = weight[bright] / weight[bright].sum()
        centre = weight @ points
        offset = points - centre
        # A line shorter than the PSF becomes a point, because noise dominates its moments.
        lines.append(line_of(centre, (offset * weight[:, None]).T @ offset, LEAST_LINE_PX))
    ends = np.array(lines).reshape(-1, 2, 2)
    sigma = np.hypot(1.0, expected_sigma(short, segmented.background, settings))
    expected = pinhole.project(star_ends(pinhole.unit_vectors(ends), rotation))
    # Regions near the axis of rotation are excluded, because stars near the axis are also points.
    streaked: BoolArray = np.linalg.norm(expected[:, 1] - expected[:, 0], axis=-1) >= settings.least_length
    return ends[streaked], sigma[streaked], short.label[streaked]


class Verdict(Enum):
    """Classification of a streak or region.

    STAR: the indicators agree with the streak of a star. STARS: stars alone explain the pixels. OBJECT: the
    streak or region contains an object. UNCLEAR: neither stars nor an object explains the pixels.
    """

    STAR = "star"
    STARS = "stars"
    OBJECT = "object"
    UNCLEAR = "unclear"


@dataclass(frozen=True, slots=True)
class SpaceObject:
    """A streak or point whose motion differs from the motion of the stars.

    Attributes:
        endpoints: ends of the object's streak (2, 2), px, in the order in time that gives the slower motion
            relative to the stars.
        sigma: standard deviation of each end (2,), px, along the major axis of its error ellipse.
        fired: names of the indicators that exceed their thresholds; empty if the object was found by its
            pixels only.
        flux: flux of the object, counts.
        improvement: decrease of chi-square when the object is added to a model of stars.
        relative_rate: angular rate of the object relative to the stars, rad/s.
        direction: direction of the motion relative to the stars, a unit vector (x, y) in the image.
        other_relative_rate: angular rate of the object relative to the stars for the reverse order of the
            ends, rad/s. One image does not show the order of the ends in time.
    """

    endpoints: FloatArray
    sigma: FloatArray
    fired: tuple[str, ...]
    flux: float
    improvement: float
    relative_rate: float
    direction: FloatArray
    other_relative_rate: float

    @property
    def middle_sigma(self) -> float:
        """The standard deviation per axis of the midpoint of the streak, px."""
        return 0.5 * float(np.hypot(*self.sigma))


@dataclass(frozen=True, slots=True)
class ObjectReport:
    """Result of the search of an image: the examined streaks, and the objects found, the brightest first.

    The attributes `indicators` and `verdicts` have one entry for each streak with two ends, followed by one
    entry for each short region. The attribute `crowded` contains one verdict for each region with more than
    two corners. The attribute `rotation` (3,), rad, is the assumed rotation of the camera, camera axes.
    """

    indicators: Indicators
    verdicts: tuple[Verdict, ...]
    crowded: tuple[Verdict, ...]
    objects: tuple[SpaceObject, ...]
    rotation: FloatArray


# Distance (px) between two corners of a region below which they count as the same corner.
_LEAST_CROSSING_PX = 10.0
# Largest distance (px) of a line's end from a star's path for which the line is part of the path.
_ON_PATH_PX = 1.5
# Distance (px) from the predicted ends of a star's streak within which a streak counts as a star's streak.
_FITTED_PX = 1.0
# Number of trial star paths per path length in the first test of whether stars explain the pixels.
_FEW_PATHS = 2
# Chi-square per pixel along an object's streak below which the fit is not repeated with fitted stars.
_GOOD_FIT = 1.4
# Upper limit of chi-square per pixel along a uniform streak (three standard deviations for 1000 pixels).
_UNIFORM = 1.15
# Minimum brightness of a star's whole path, relative to a line of light that may be a segment of the path.
_HIDDEN_STAR = 0.6
# Number of parts into which a star's path is divided; every part must be bright enough.
_PARTS = 12
# Largest ratio of the excess of chi-square with an object to the decrease of chi-square due to the object.
# The second value is for a uniform streak that resembles the streak of a star.
_MOST_UNEXPLAINED, _LEAST_UNEXPLAINED = 3.0, 0.25
# Decrease of chi-square, relative to the required decrease, above which light may be a part of a streak.
_PART = 0.6
# Largest ratio of the excess of chi-square to its decrease, as above, at which the ends are still located.
_HOPELESS = 4.0
# Margin (standard deviations of the PSF) beyond the distance at which a star's profile equals the noise.
_DIM_SIGMAS = 2.0
# Minimum distance (px) from the image border at which streak ends and regions count as inside the image.
_BORDER_PX = 2
# Largest standard deviation (px) of the ends of an object's streak.
_VAGUE_PX = 3.0
# Factor on the required decrease of chi-square in regions at the border, where stars may be truncated.
_AT_BORDER = 3.0


@dataclass(frozen=True, slots=True)
class Judgement:
    """Classification of one streak or region.

    The attribute `candidate` is the detected object if the verdict is OBJECT, otherwise None. The attribute
    `light` is the model of the pixels by stars, or None for an object and for an untested streak.
    """

    verdict: Verdict
    candidate: SpaceObject | None = None
    light: StarLight | None = None


def _light_beside_numpy(
    region: IntArray, light: FloatArray, ends: FloatArray, half: FloatArray, reach: float
) -> tuple[int, float]:
    """Return the number of a region's pixels that are not on the path of a star, and the sum of their counts.

    The path of a star is approximated by a parabola over its chord between the `ends` (2, 2), px. The middle
    of the path is displaced by `half` (2,), px, from the middle of the chord. Pixels (m, 2) with the counts
    `light` (m,) do not belong to the path if they are more than `reach` px away.
    """
    chord = ends[1] - ends[0]
    length = max(float(np.linalg.norm(chord)), 1.0)
    along, normal = chord / length, np.array([-chord[1], chord[0]]) / length
    sag = 4.0 * float(half @ normal) / length**2
    place, away = (region - ends[0]) @ along, (region - ends[0]) @ normal
    inside = np.clip(place, 0.0, length)
    beside = np.hypot(away - sag * inside * (length - inside), place - inside) > reach
    return int(beside.sum()), float(light[beside].sum())


@compiled_form_of(_light_beside_numpy)
def _light_beside(
    region: IntArray, light: FloatArray, ends: FloatArray, half: FloatArray, reach: float
) -> tuple[int, float]:
    x, y = ends[1, 0] - ends[0, 0], ends[1, 1] - ends[0, 1]
    length = max(math.sqrt(x * x + y * y), 1.0)
    x, y = x / length, y / length
    sag = 4.0 * (half[1] * x - half[0] * y) / length**2
    count, other = 0, 0.0
    for p in range(len(region)):
        dx, dy = region[p, 0] - ends[0, 0], region[p, 1] - ends[0, 1]
        place = dx * x + dy * y
        inside = min(max(place, 0.0), length)
        if math.hypot(dy * x - dx * y - sag * inside * (length - inside), place - inside) > reach:
            count += 1
            other += light[p]
    return count, other


@dataclass(frozen=True, slots=True)
class Judge:
    """Classifier that decides whether the pixels of a streak or region show stars only or an object.

    The camera rotates by `rotation` (3,), rad, camera axes, during the `exposure`, s.
    """

    segmented: Segmented
    rotation: FloatArray
    pinhole: Pinhole
    exposure: float
    settings: EndpointSettings
    objects: ObjectSettings

    def streak(self, ends: FloatArray, fired: tuple[str, ...]) -> Judgement:
        """Classify a streak or point; `fired` names the indicators that exceed their thresholds."""
        if not fired:
            return Judgement(Verdict.STAR)
        try:
            light = self._light(ends, per_length=_FEW_PATHS)
            if light.chi_square - light.chi_square_with(ends) < self.objects.improvement:
                if self._only_stars(light, self.objects.improvement):
                    return Judgement(Verdict.STARS, light=light)
                return self._stars_or_unclear(self._light(ends))
            light = self._light(ends)
            candidate = self._candidate(ends, fired, light, (), self.objects.improvement)
        except KnightCubeError:
            return Judgement(Verdict.UNCLEAR)
        if candidate is not None:
            return Judgement(Verdict.OBJECT, candidate)
        return self._stars_or_unclear(light)

    def crowd(self, corners: FloatArray) -> Judgement:
        """Classify a region with more than two corners (k, 2), px."""
        if len(corners) > self.objects.most_corners:
            return Judgement(Verdict.UNCLEAR)
        pairs = np.array(list(itertools.combinations(corners, 2)))
        pairs = pairs[np.linalg.norm(pairs[:, 1] - pairs[:, 0], axis=-1) >= _LEAST_CROSSING_PX]
        lines = extend(pairs, chord_outward(pairs), self.settings.endpoint_bias) if len(pairs) else pairs
        enough = self.objects.crossing_improvement
        try:
            light = self._light(corners, per_length=_FEW_PATHS)
            if self._only_stars(light, enough):
                return Judgement(Verdict.STARS, light=light)
            light = self._light(corners)
            hopeless = light.chi_square - light.pixels < enough
            tried = [] if hopeless else [light.chi_square_with(ends) for ends in lines]
        except KnightCubeError:
            return Judgement(Verdict.UNCLEAR)
        if not tried:
            return self._stars_or_unclear(light)
        ends = lines[int(np.argmin(tried))]
        candidate = None if self._moves_like_a_star(ends) else self._candidate(ends, (), light, (), enough)
        if candidate is not None:
            return Judgement(Verdict.OBJECT, candidate)
        return self._stars_or_unclear(light)

    def explained(self, judged: Judgement, label: int) -> bool:
        """Return whether stars explain all light of a region, so that the region contains no object."""
        if judged.light is None:
            return False
        return judged.light.excess(self._pixels_of(label)) < self.objects.crossing_improvement

    def has_other_light(self, ends: FloatArray, label: int) -> bool:
        """Return whether a region has significant light beside the path of the star with the given ends."""
        region = self._pixels_of(label)
        signal = np.maximum(self.segmented.signal[region[:, 1], region[:, 0]], 0.0).astype(np.float64)
        noise = self.segmented.background.typical_noise
        brightness = float(signal.max() / noise)
        reach = self.objects.psf_sigma * (_DIM_SIGMAS + float(np.sqrt(2.0 * np.log(max(brightness, 1.0)))))
        path = star_path(ends.mean(axis=0), self.rotation, self.pinhole)
        half = path[len(path) // 2] - 0.5 * (path[0] + path[-1])
        count, other = _light_beside(region, signal, ends, half, reach)
        return other >= self.objects.point_significance * noise * float(np.sqrt(count + 1.0))

    def _pixels_of(self, label: int) -> IntArray:
        """Return the pixels (m, 2), (x, y), of a region, row by row."""
        regions = self.segmented.regions
        return pixels_of_region(regions.labels, regions.boxes[np.searchsorted(regions.label, label)], label)

    def merged(self, settled: list[int], strange: list[int]) -> list[SpaceObject]:
        """Return the objects in regions in which the images of objects and stars may be merged.

        Stars are fitted to each region. If the fitted stars do not explain all light, they are subtracted,
        and the brightest remaining light of the region is tested. In regions at the border of the image, an
        object must decrease chi-square more than elsewhere, and its ends must be inside the image. Regions
        whose label is in `settled` are not examined. Regions whose label is in `strange` are examined first,
        followed by the largest of the other regions.
        """
        regions = self.segmented.regions
        bright = regions.is_significant(self.objects.point_significance, self.segmented.background)
        outside = near_border(regions, self.segmented.signal.shape, _BORDER_PX)
        indices = np.flatnonzero(~np.isin(regions.label, settled) & bright)
        order = np.lexsort((-regions.area[indices], ~np.isin(regions.label[indices], strange)))
        objects = []
        for index in indices[order[: self.objects.most_merged]].tolist():
            patch = self._patch(index)
            enough = self.objects.crossing_improvement * (_AT_BORDER if outside[index] else 1.0)
            stars, left = fit_stars(patch, self.rotation, self.pinhole, enough)
            if patch.excess(left) < enough:
                continue
            found = self._remaining_object(brightest_left(patch, left), stars)
            least = self.objects.least_share * float(regions.flux[index]) if stars else 0.0
            if found is not None and found.flux >= least and found.improvement >= enough:
                objects.append(found)
        return objects

    def _remaining_object(self, ends: FloatArray | None, stars: Sequence[FloatArray]) -> SpaceObject | None:
        """Return the object between `ends` (2, 2), px, or None if stars explain the pixels.

        The argument `stars` contains the paths (m, 2), px, of known stars nearby.
        """
        if ends is None or self._moves_like_a_star(ends, _FITTED_PX):
            return None
        enough = self.objects.crossing_improvement
        try:
            few = self._light(ends, stars, _FEW_PATHS)
            least = few.chi_square_with(ends)
            gained = few.chi_square - least
            # Fitted stars can hide a part of the object's streak; `ends` are then those of the visible part.
            if gained < enough or least - few.expected > gained:
                longer = few.located(ends, among_stars=True) if gained >= _PART * enough else None
                if longer is None:
                    return None
                ends = longer.ends
                few = self._light(ends, stars, _FEW_PATHS)
                if few.chi_square - few.chi_square_with(ends) < enough:
                    return None
            return self._candidate(ends, (), self._light(ends, stars), stars, enough)
        except KnightCubeError:
            return None

    def _only_stars(self, few: StarLight, enough: float) -> bool:
        """Return whether a few trial stars explain the pixels; then more trial stars need not be tested.

        The trial stars explain the pixels if an additional object cannot decrease chi-square by `enough`. An
        object cannot decrease chi-square below about one per pixel, which is the value of a good fit.
        """
        calm = few.chi_square <= self.objects.worst_fit * few.pixels
        return few.chi_square - few.pixels < enough and calm

    def _light(
        self, corners: FloatArray, known: Sequence[FloatArray] = (), per_length: int = PATHS_PER_LENGTH
    ) -> StarLight:
        camera = self.rotation, self.pinhole, self.objects.psf_sigma, self.settings.gain
        saturation = self.settings.saturation or np.inf
        return StarLight(self.segmented, corners, *camera, saturation, known, per_length)

    def _is_object(self, light: StarLight, found: Explanation, improvement: float, uniform: bool) -> bool:
        """Return whether an object decreases chi-square enough and explains the pixels along its streak.

        If a streak differs from the streak of a star only near its ends, stars without an object fit most of
        its length nearly as well. A `uniform` streak is therefore also accepted if the object explains nearly
        all light that stars do not explain. A line is rejected if it explains only a small part of the light
        that remains after subtraction of the stars. Light in other regions does not count for a `uniform`
        streak, because not all stars of other regions are modelled.
        """
        gained = light.chi_square - found.chi_square
        remains = found.unexplained if uniform else found.chi_square - light.expected
        most = found.misfit <= 0.5 * found.misfit_of_stars and remains <= _MOST_UNEXPLAINED * gained
        most |= uniform and remains <= _LEAST_UNEXPLAINED * gained
        # A saturated point has a position error of 0.1 px, so that residuals in its wings exceed the noise.
        fits = found.misfit <= max(self.objects.worst_fit, 0.1 * found.misfit_of_stars)
        return gained >= improvement and most and fits

    def _stars_or_unclear(self, light: StarLight) -> Judgement:
        stars = light.chi_square <= self.objects.worst_fit * light.pixels
        return Judgement(Verdict.STARS if stars else Verdict.UNCLEAR, light=light)

    def _moves_like_a_star(self, ends: FloatArray, within: float = 2.0) -> bool:
        """Return whether streak ends (2, 2), px, lie within `within` px of the predicted ends of a star."""
        star = self.pinhole.project(star_ends(self.pinhole.unit_vectors(ends[None]), self.rotation))[0]
        missed = min(np.abs(star - ends).max(), np.abs(star[::-1] - ends).max())
        return bool(missed < within)

    def _candidate(
        self,
        ends: FloatArray,
        fired: tuple[str, ...],
        light: StarLight,
        stars: Sequence[FloatArray],
        improvement: float,
    ) -> SpaceObject | None:
        """Return the object between `ends`, or None if stars explain the pixels.

        The order of the ends is the order that gives the slower motion relative to the stars. The ends are
        located from the light along the whole streak. If light in other regions is much stronger than the
        object, only a uniform streak is accepted. If the fit of the object along the streak is poor, the
        stars of the region are fitted and included. Returns None also if the located streak is the streak of
        a star.
        """
        rough = light.explain(ends)
        gained = light.chi_square - rough.chi_square
        if gained < improvement or rough.unexplained > _HOPELESS * gained:
            return None
        only_uniform = rough.chi_square - light.expected > _HOPELESS * gained
        located = self._located(ends, light, stars, improvement)
        if only_uniform and (located is None or located[0].misfit > _UNIFORM):
            return None
        if not stars and (located is None or located[2].misfit > _GOOD_FIT):
            own = np.flatnonzero(self.segmented.regions.label == region_along(self.segmented, ends))
            stars = fit_stars(self._patch(int(own[0])), self.rotation, self.pinhole)[0] if len(own) else []
            again = self._located(ends, self._light(ends, stars), stars, improvement) if stars else located
            if again is None or located is None or again[2].misfit < located[2].misfit:
                located = again
        if located is None:
            return None
        found_ends, light, found = located
        ends, sigma = found_ends.ends, found_ends.sigma
        rate, direction = self._among_stars(ends)
        other, other_direction = self._among_stars(ends[::-1])
        if other < rate:
            ends, rate, other, direction = ends[::-1], other, rate, other_direction
            sigma = sigma[::-1]
        gained = light.chi_square - found.chi_square
        return SpaceObject(ends, sigma, fired, found.flux, gained, rate, direction, other)

    def joined(self, found: list[SpaceObject]) -> list[SpaceObject]:
        """Return the objects `found`, with the flashes of a tumbling object as one object."""
        groups = flashes_of_objects(np.array([one.endpoints for one in found]).reshape(-1, 2, 2))
        return [self._joined([found[k] for k in group]) for group in groups]

    def _joined(self, flashes: list[SpaceObject]) -> SpaceObject:
        """Return one object from its `flashes` along a line. A dark end may be as long as the longest gap."""
        if len(flashes) == 1:
            return flashes[0]
        every = np.array([one.endpoints for one in flashes])
        line = every[-1].mean(axis=0) - every[0].mean(axis=0)
        every = np.where(((every[:, 1] - every[:, 0]) @ line < 0.0)[:, None, None], every[:, ::-1], every)
        gap = float(np.linalg.norm(every[1:, 0] - every[:-1, 1], axis=1).max())
        ends, sigma = np.array([every[0, 0], every[-1, 1]]), np.full(2, gap / math.sqrt(3.0))
        both = [(self._among_stars(way), way) for way in (ends, ends[::-1])]
        (rate, direction), ends = min(both, key=lambda each: each[0][0])
        flux, gained = (sum(each) for each in zip(*((o.flux, o.improvement) for o in flashes), strict=True))
        other = max(each[0][0] for each in both)
        return SpaceObject(ends, sigma, flashes[0].fired, flux, gained, rate, direction, other)

    def _located(
        self, ends: FloatArray, light: StarLight, stars: Sequence[FloatArray], improvement: float
    ) -> tuple[LocatedEnds, StarLight, Explanation] | None:
        """Return the located ends of an object, the model of the stars and the fit with the object, or None.

        Returns None also for uncertain ends and for ends at the border of the image, because such ends do not
        show whether the object moves like a star.
        """
        best = None
        for among_stars in (True, False):
            located = light.located(ends, among_stars)
            if located is not None and (best is None or located.misfit < best.misfit):
                best = located
            if best is not None and best.misfit <= _GOOD_FIT:
                break
        if best is None:
            best = LocatedEnds(ends, np.full(2, np.sqrt(2.0) * self.objects.streak_sigma), np.inf)
        else:
            best = replace(best, sigma=np.hypot(best.sigma, self.objects.end_floor))
            light = self._light(best.ends, stars)
        if best.sigma.max() > _VAGUE_PX or not self.pinhole.contains(best.ends, -_BORDER_PX).all():
            return None
        found = light.explain(best.ends)
        uniform = best.misfit <= _UNIFORM
        if self._moves_like_a_star(best.ends, _FITTED_PX) or self.begins_a_star(best.ends, found.flux):
            return None
        if not self._is_object(light, found, improvement, uniform):
            return None
        return best, light, found

    def begins_a_star(self, ends: FloatArray, flux: float) -> bool:
        """Return whether a line between `ends` (2, 2), px, may be a segment of the streak of one star.

        A star is possible if its path begins or ends at one end of the line, and contains the other end. The
        line of light has a flux of `flux` counts. The other segments of the star's streak may overlap other
        stars, so that the whole path must be at least about as bright as the line.
        """
        length = max(float(np.linalg.norm(ends[1] - ends[0])), 1.0)
        directions = self.pinhole.unit_vectors(ends[[0, 0, 1, 1]])
        paths = star_paths(directions, self.rotation, np.array([0.0, 1.0, 0.0, 1.0]), self.pinhole)
        for path, other in zip(paths, ends[[1, 1, 0, 0]], strict=True):
            on_path = float(np.min(np.linalg.norm(path - other, axis=1))) < _ON_PATH_PX
            if on_path and length < len(path) - _ON_PATH_PX:
                light = light_on_path(self.segmented, path, self.objects.psf_sigma)
                parts = [float(np.median(part)) for part in np.array_split(light, _PARTS)]
                if min(parts) >= _HIDDEN_STAR * flux / length:
                    return True
        return False

    def _patch(self, index: int) -> Patch:
        """Return the patch of the frame around the region `index`."""
        gain, saturation = self.settings.gain, self.settings.saturation or np.inf
        return cut_patch(self.segmented, index, self.objects.psf_sigma, gain, saturation)

    def _among_stars(self, ends: FloatArray) -> tuple[float, FloatArray]:
        """Return the rate, rad/s, and the image direction (2,) of an object's motion relative to the stars.

        The object moves from the first of the `ends` (2, 2), px, to the second. Both ends of the streak are
        rotated to mid-exposure with the rotation of the stars. The difference between the rotated ends is the
        motion of the object relative to the stars.
        """
        middle = at_mid_exposure(self.pinhole.unit_vectors(ends), self.rotation)
        angle = np.arctan2(np.linalg.norm(np.cross(middle[0], middle[1])), middle[0] @ middle[1])
        step = np.diff(self.pinhole.project(middle), axis=0)[0]
        return float(angle) / self.exposure, np.asarray(step / max(float(np.linalg.norm(step)), 1e-9))


# Indicator of a streak (standard deviations) above which its region is searched for merged objects.
_STRANGE = 5.0


def detect(
    pixels: Image,
    pinhole: Pinhole,
    rotation: FloatArray,
    exposure: float,
    settings: EndpointSettings,
    objects: ObjectSettings,
) -> ObjectReport | None:
    """Search an image (rows, columns) for objects and return a report, or None if it has too few streaks.

    The camera rotates by `rotation` (3,), rad, during the `exposure`, s. If the sign of the rotation is
    unknown, the directions of motion of all objects may have the wrong sign.
    """
    settings = replace(settings, saturation=saturation_level(pixels, settings.saturation))
    segmented = segment_frame(pixels, replace(settings, most_streaks=objects.most_streaks))
    streaks = measure_streaks(segmented, settings)
    if len(streaks) < settings.least_streaks:
        return None
    ends = extend(streaks.endpoints, chord_outward(streaks.endpoints), settings.endpoint_bias)
    short, short_sigma, short_label = short_regions(segmented, rotation, pinhole, settings, objects)
    every, sigma = np.concatenate([ends, short]), np.concatenate([streaks.sigma, short_sigma])
    indicators = evaluate(every, sigma, rotation, pinhole, objects.bounds, objects.strict)
    labels = np.concatenate([segmented.candidates.label[streaks.candidate], short_label])
    judge = Judge(segmented, rotation, pinhole, exposure, settings, objects)
    return _judged(judge, indicators, labels, streaks)


def _judged(judge: Judge, indicators: Indicators, labels: IntArray, streaks: Streaks) -> ObjectReport:
    """Return the report on an image after classification of all streaks and crowded regions.

    The argument `labels` (n,) contains the label of the region of each streak in `indicators`.
    """
    judged: list[Judgement] = []
    settled: list[int] = []
    strange: list[int] = []
    every = labels.tolist()
    each = zip(every, indicators.endpoints, indicators.deviations, indicators.fired, strict=True)
    for label, streak, deviation, fired in each:
        names = tuple(name for name, fires in zip(INDICATORS, fired, strict=True) if fires)
        judged.append(judge.streak(streak, names))
        calm = np.abs(deviation).max() <= _STRANGE and not judge.has_other_light(streak, label)
        calm |= judged[-1].verdict is Verdict.OBJECT
        (settled if calm else strange).append(label)
    for index, corners in streaks.crowded:
        judged.append(judge.crowd(corners))
        every.append(int(judge.segmented.candidates.label[index]))
        settled += every[-1:] if judged[-1].verdict is Verdict.OBJECT else []
        strange += every[-1:] if judged[-1].verdict is Verdict.UNCLEAR else []
    settled += [label for label, one in zip(every, judged, strict=True) if judge.explained(one, label)]
    found = [one.candidate for one in judged if one.candidate is not None]
    found += judge.merged(settled, strange)
    found = judge.joined(found)
    verdicts = tuple(one.verdict for one in judged)
    found.sort(key=lambda candidate: -candidate.flux)
    count = len(labels)
    return ObjectReport(indicators, verdicts[:count], verdicts[count:], tuple(found), judge.rotation)


@dataclass(frozen=True, slots=True, eq=False)
class DetectedObjects:
    """The objects in one image; the result is true (`if found:`) if the image shows an object.

    Attributes:
        objects: the n objects, the brightest first.
        directions: unit vectors to the objects at mid-exposure (n, 3), camera axes.
        covariance: covariances of the directions (n, 3, 3), rad^2, with no variance along each direction.
        reason: why the image could not be searched; empty if it was searched.
    """

    objects: tuple[SpaceObject, ...]
    directions: FloatArray
    covariance: FloatArray
    reason: str = ""

    def __bool__(self) -> bool:
        """Return whether the image shows an object."""
        return len(self.objects) > 0

    def __repr__(self) -> str:
        """Return one line of text: the positions of the three brightest objects, or the reason."""
        if self.reason:
            return f"<DetectedObjects: {self.reason}>"
        middles = [item.endpoints.mean(axis=0) for item in self.objects[:3]]
        pixels = ", ".join(f"({x:.1f}, {y:.1f})" for x, y in middles)
        plural = "" if len(self.objects) == 1 else "s"
        return (
            f"<DetectedObjects: {len(self.objects)} object{plural}{' at pixels ' + pixels if pixels else ''}>"
        )


# Median deviation (standard deviations) of the streaks from stars' streaks above which the rate is wrong.
# With the right rate the median is about 1. With a rate wrong by 10 % it is 20 for bright streaks.
_WRONG_RATE = 10.0
# Number of positions along each side of an image that are tested for a star that remains in the image.
_TESTED_STARS = 33


def _keeps_stars(rotation: FloatArray, pinhole: Pinhole) -> bool:
    """Return whether a star can be in the image both at the start and at the end of a rotation (3,), rad."""
    if float(np.linalg.norm(rotation)) >= np.pi:
        return False
    x, y = (np.linspace(-0.5, side - 0.5, _TESTED_STARS) for side in (pinhole.columns, pinhole.rows))
    middles = pinhole.unit_vectors(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
    turns = attitude_matrix(from_rotation_vector(np.array([[-0.5], [0.5]]) * rotation))
    ends = [pinhole.contains(pinhole.project(middles @ turn.T)) for turn in turns]
    return bool(np.any(ends[0] & ends[1]))


def _problem_of_rate(report: ObjectReport) -> str:
    """Return why most streaks contradict the assumed rate, or an empty text if they agree with it.

    With a wrong rate, the streaks of stars would be mistaken for objects.
    """
    each = np.abs(report.indicators.deviations).max(axis=1)
    deviation = float(np.median(each))
    if deviation <= _WRONG_RATE:
        return ""
    agreeing = np.count_nonzero(each <= _WRONG_RATE)
    return (
        f"the streaks deviate from the rate by {deviation:.0f} standard deviations (median; {agreeing} of "
        f"{len(each)} agree): the rate (rad/s, camera axes) or the exposure (s) is wrong, or most streaks "
        "are not stars, for instance cosmic rays or hot columns"
    )


def detect_objects(
    image: Image,
    camera: CameraModel,
    rate: ArrayLike,
    exposure: float,
    settings: ObjectSettings | None = None,
) -> DetectedObjects:
    """Return the objects that move relative to the stars, in an image whose stars are streaks.

    Args:
        image: pixel values (rows, columns) of any integer or floating type, with streaks of 20 px or more.
            Gain and saturation of the settings are in the unit of the pixel values.
        camera: camera model of the image, a `Pinhole` or `Lens` of `knightcube.vision.camera.lens`.
        rate: angular velocity of the camera relative to inertial space (3,), camera axes, rad/s, for instance
            from the streaks of the image. If the sign of the rate is unknown, the directions of motion of all
            objects may have the wrong sign.
        exposure: exposure time, s. If no star remains in the image during the exposure, or if most streaks
            contradict the rate, the result has no objects, and its `reason` contains the cause.
        settings: thresholds, gain and saturation, or None for the defaults.

    Raises:
        ArgumentError: if the image does not have the size of the camera, if its pixels are not finite
            numbers, if the rate is not three finite numbers, or if the exposure is not positive.

    Source: Sease 2013, chapter 4, as corrected in the errata. The test whether stars alone explain the pixels
    is not part of Sease's method.
    """
    settings = ObjectSettings() if settings is None else settings
    check_detector(settings, ObjectSettings)
    exposure = checked_exposure(exposure)
    rotation = finite_array("rate", rate, (3,)) * exposure
    pixels, unit, zero = raw_counts(image_of_camera(image, camera))
    none = DetectedObjects((), np.empty((0, 3)), np.empty((0, 3, 3)))
    model = streak_camera(camera)
    if not _keeps_stars(rotation, model):
        angle = float(np.linalg.norm(rotation))
        reason = f"no star remains in the image during a rotation by {angle:.3g} rad: check rate and exposure"
        return replace(none, reason=reason)
    saturation = None if settings.saturation is None else (settings.saturation - zero) / unit
    settings = replace(settings, gain=gain_in_counts(settings.gain, unit), saturation=saturation)
    ends = EndpointSettings(gain=settings.gain, saturation=settings.saturation)
    report = detect(pixels, model, rotation, exposure, ends, settings)
    if report is None:
        return replace(none, reason=f"fewer than {ends.least_streaks} significant streaks")
    if problem := _problem_of_rate(report):
        return replace(none, reason=problem)
    objects = tuple(replace(each, flux=unit * each.flux) for each in report.objects)
    return DetectedObjects(objects, *_directions(objects, camera))


def _directions(objects: tuple[SpaceObject, ...], camera: CameraModel) -> tuple[FloatArray, FloatArray]:
    """Return unit vectors (n, 3) to n objects at mid-exposure, and their covariances (n, 3, 3), rad^2."""
    middles = np.array([item.endpoints.mean(axis=0) for item in objects]).reshape(-1, 2)
    directions = camera.unit_vectors(middles)
    # A pixel subtends the largest angle on the boresight; that angle is used for all directions.
    sigma = np.array([item.middle_sigma for item in objects]) / camera.focal_length
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    return directions, sigma[:, None, None] ** 2 * across
