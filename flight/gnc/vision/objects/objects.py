"""Resident space objects among the streaks of one frame (Sease chapter 4), by the three classical indicators.

What an indicator singles out is not yet an object: two stars whose streaks overlap, or a piece of a faint
one, deviate as well (Table 4.4: "overlapping streak"). So the pixels are asked whether stars explain them.
Regions with more than two corners, which the thesis throws away, may be stars or an object that crosses a
star; bright points in a frame whose stars are streaks are tracked objects (Figure 4.5). What is merged with
stars, saturated or odd in any other way is searched once its stars are taken away
(`flight.gnc.vision.objects.merged`). All of it needs only the rotation of the camera, whichever estimator it
is from.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from flight.gnc.camera.pinhole import Pinhole
from flight.gnc.errors import FlightError
from flight.gnc.math.arrays import BoolArray, FloatArray, Image, IntArray
from flight.gnc.vision.frame.regions import line_of, positions
from flight.gnc.vision.objects.merged import brightest_left, cut_patch, fit_stars
from flight.gnc.vision.objects.rso_indicators import INDICATORS, Indicators, evaluate, star_ends
from flight.gnc.vision.objects.star_light import Explanation, StarLight, carried_to_middle
from flight.gnc.vision.streaks.corners.endpoints import chord_outward, extend
from flight.gnc.vision.streaks.corners.rate_fit import fit_rotation
from flight.gnc.vision.streaks.corners.segmentation import Regions
from flight.gnc.vision.streaks.corners.settings import StreakSettings
from flight.gnc.vision.streaks.corners.streaks import (
    Segmented,
    Streaks,
    expected_sigma,
    measure_streaks,
    near_border,
    segment_frame,
)

# Corners nearer to one another are one, seen twice.
_LEAST_CROSSING_PX = 10.0
# Bright parts shorter than this are points.
_LEAST_LINE_PX = 4.0
# A streak with an indicator beyond so many standard deviations is looked at by its pixels, though none fired.
_STRANGE = 5.0
# A star's ends, fitted to its pixels, are nearer than this to where the rotation puts them, px.
_FITTED_PX = 1.0
# A region so far from the frame's border ends within.
_BORDER_PX = 2


class Verdict(Enum):
    """What a streak is: a star by its indicators, stars by its pixels, an object, or neither."""

    STAR = "star"
    STARS = "stars"
    OBJECT = "object"
    UNCLEAR = "unclear"


@dataclass(frozen=True, slots=True)
class ObjectSettings:
    """When something is called an object.

    Attributes:
        bounds: standard deviations of centre, displacement and residual below which none fires, whatever the
            spread within the frame: `python -m tests.studies.bench.rso_spread`.
        strict: the thesis's 2.5 sigma, of the spread within the frame.
        psf_sigma: px, of the camera.
        most_streaks: how many regions are examined; the rate needs fewer.
        most_points: how many short regions are examined.
        most_merged: how many regions are searched for an object among the light of their stars.
        least_share: of a region's light that an object beside stars must have: with an error of the rotation
            of 2 % the end of a bright star's streak sticks out by that much.
        most_corners: regions with more are left unclear.
        point_significance: least counts of a short region over the noise of its area.
        improvement: least gain in chi-square of an object over stars.
        crossing_improvement: the same for an object that crosses stars, of many lines tried the best.
        worst_fit: largest chi-square per pixel of an object that is believed.
    """

    bounds: tuple[float, float, float] = (8.0, 10.0, 10.0)
    strict: float = 2.5
    psf_sigma: float = 1.0
    most_streaks: int = 80
    most_points: int = 20
    most_merged: int = 12
    least_share: float = 0.04
    most_corners: int = 6
    point_significance: float = 20.0
    improvement: float = 300.0
    crossing_improvement: float = 600.0
    worst_fit: float = 2.5


@dataclass(frozen=True, slots=True)
class SpaceObject:
    """A streak or point that moves otherwise than the stars.

    Attributes:
        endpoints: (2, 2) px, in the order of time for which the motion among the stars is the slower.
        fired: names of the indicators that singled it out; none when it was found by its pixels alone.
        flux: counts.
        improvement: of chi-square over stars.
        relative_rate: rad/s, its motion among the stars.
        direction: (2,) unit vector in the image (x, y), of that motion at mid-exposure.
        other_relative_rate: rad/s, were the endpoints in the other order: one frame cannot tell.
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
    """What was examined and what was found.

    Attributes:
        indicators: of all streaks with two ends, then of the short regions.
        verdicts: one for each of them.
        crowded: verdicts of the regions with more than two corners.
        objects: brightest first.
        rotation: (3,) rad, camera frame, the one that was used.
    """

    indicators: Indicators
    verdicts: tuple[Verdict, ...]
    crowded: tuple[Verdict, ...]
    objects: tuple[SpaceObject, ...]
    rotation: FloatArray


def detect(
    pixels: Image,
    pinhole: Pinhole,
    exposure: float,
    settings: StreakSettings,
    objects: ObjectSettings,
    prior: FloatArray | None = None,
) -> ObjectReport | None:
    """Return the objects of a frame (rows, columns), None when its streaks give no rotation.

    The rotation is known up to its sign: `prior` (3,), any vector with a positive projection on the rate,
    decides. Without it all directions of motion are known up to one common reversal.
    """
    segmented = segment_frame(pixels, replace(settings, most_streaks=objects.most_streaks))
    streaks = measure_streaks(segmented, settings)
    strongest = slice(settings.most_streaks)
    if len(streaks) < settings.least_streaks:
        return None
    fit = fit_rotation(streaks.endpoints[strongest], streaks.sigma[strongest], pinhole, settings)
    if fit is None:
        return None
    rotation = fit.rotation_vector
    if prior is not None and rotation @ prior < 0.0:
        rotation = -rotation
    return examine(segmented, streaks, rotation, pinhole, exposure, settings, objects)


def examine(
    segmented: Segmented,
    streaks: Streaks,
    rotation: FloatArray,
    pinhole: Pinhole,
    exposure: float,
    settings: StreakSettings,
    objects: ObjectSettings,
) -> ObjectReport:
    """Return the objects among segmented regions; the camera turns by `rotation` (3,) rad in `exposure` s."""
    judge = _Judge(segmented, rotation, pinhole, exposure, settings, objects)
    ends = extend(streaks.endpoints, chord_outward(streaks.endpoints), settings.endpoint_bias)
    short, short_sigma, short_label = _short_regions(segmented, rotation, pinhole, settings, objects)
    indicators = evaluate(
        np.concatenate([ends, short]),
        np.concatenate([streaks.sigma, short_sigma]),
        rotation,
        pinhole,
        objects.bounds,
        objects.strict,
    )
    labels = np.concatenate([segmented.candidates.label[streaks.candidate], short_label])
    found: list[SpaceObject] = []
    verdicts, crowded, settled, strange = [], [], [], []
    each = zip(labels, indicators.endpoints, indicators.deviations, indicators.fired, strict=True)
    for label, streak, deviation, fired in each:
        names = tuple(name for name, fires in zip(INDICATORS, fired, strict=True) if fires)
        verdict, candidate = judge.streak(streak, names)
        verdicts.append(verdict)
        found += [candidate] if candidate is not None else []
        if verdict is Verdict.OBJECT or np.abs(deviation).max() <= _STRANGE:
            settled.append(label)
        else:
            strange.append(label)
    for index, corners in streaks.crowded:
        verdict, candidate = judge.crowd(corners)
        crowded.append(verdict)
        found += [candidate] if candidate is not None else []
        settled += [segmented.candidates.label[index]] if verdict is Verdict.OBJECT else []
    found += judge.merged(np.array(settled, dtype=np.int64), np.array(strange, dtype=np.int64))
    found.sort(key=lambda candidate: -candidate.flux)
    return ObjectReport(indicators, tuple(verdicts), tuple(crowded), tuple(found), rotation)


@dataclass(frozen=True, slots=True)
class _Judge:
    """Tells objects from stars by their pixels."""

    segmented: Segmented
    rotation: FloatArray
    pinhole: Pinhole
    exposure: float
    settings: StreakSettings
    objects: ObjectSettings

    def streak(self, ends: FloatArray, fired: tuple[str, ...]) -> tuple[Verdict, SpaceObject | None]:
        """Return what a streak or point is for which the indicators of these names fired."""
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
        """Return what a region with more than two corners (k, 2) is: stars, or an object crossing them."""
        if len(corners) > self.objects.most_corners:
            return Verdict.UNCLEAR, None
        pairs = np.array([corners[list(pair)] for pair in itertools.combinations(range(len(corners)), 2)])
        pairs = pairs[np.linalg.norm(pairs[:, 1] - pairs[:, 0], axis=-1) >= _LEAST_CROSSING_PX]
        lines = extend(pairs, chord_outward(pairs), self.settings.endpoint_bias) if len(pairs) else pairs
        try:
            light = self._light(corners)
            # Adding a line cannot take away more than what is left above the noise.
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
        noise = float(np.median(self.segmented.background.noise))
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
        """Return what lies between `ends` (2, 2) px, beside stars on known paths, if it is an object."""
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
        """Return whether the object takes away enough, and most of what stars left along it, and fits."""
        enough = light.chi_square - found.chi_square >= improvement
        most = found.misfit <= 0.5 * found.misfit_of_stars
        # A saturated point's place is known to a tenth of a pixel: its wings are not, to their noise.
        fits = found.misfit <= max(self.objects.worst_fit, 0.1 * found.misfit_of_stars)
        return enough and most and fits

    def _stars_or_unclear(self, light: StarLight) -> Verdict:
        return Verdict.STARS if light.chi_square <= self.objects.worst_fit * light.pixels else Verdict.UNCLEAR

    def _moves_like_a_star(self, ends: FloatArray, within: float = 2.0) -> bool:
        """Return whether the ends (2, 2) lie as a star's would, `within` so many px."""
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

        Both ends are carried to mid-exposure as a star would be: what is left between them is the object's
        own.
        """
        carried = carried_to_middle(self.pinhole.unit_vectors(ends), self.rotation)
        angle = np.arctan2(np.linalg.norm(np.cross(carried[0], carried[1])), carried[0] @ carried[1])
        step = np.diff(self.pinhole.project(carried), axis=0)[0]
        return float(angle) / self.exposure, np.asarray(step / max(float(np.linalg.norm(step)), 1e-9))


def _short_regions(
    segmented: Segmented,
    rotation: FloatArray,
    pinhole: Pinhole,
    settings: StreakSettings,
    objects: ObjectSettings,
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Return ends (n, 2, 2), errors (n,) px and labels (n,) of bright regions too short for corners.

    Only where stars are not short. The ends are those of the uniform line with the region's moments, a
    point's are one.
    """
    regions = segmented.regions
    noise = float(np.median(segmented.background.noise))
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
    # Shorter than the point spread the moments tell noise, not length.
    return line_of(centre, (offset * weight[:, None]).T @ offset, _LEAST_LINE_PX)
