"""Resident space objects among the streaks of one frame (Sease chapter 4).

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

from knightcube.astro.arrays import FloatArray, Image, IntArray
from knightcube.errors import FlightError
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.objects.merged import brightest_left, cut_patch, fit_stars
from knightcube.vision.objects.rso_indicators import (
    INDICATORS,
    Indicators,
    evaluate,
    short_regions,
    star_ends,
)
from knightcube.vision.objects.settings import ObjectSettings
from knightcube.vision.objects.star_light import Explanation, StarLight, carried_to_middle
from knightcube.vision.streaks.corners.endpoints import chord_outward, extend
from knightcube.vision.streaks.corners.settings import StreakSettings
from knightcube.vision.streaks.corners.streaks import (
    Segmented,
    Streaks,
    measure_streaks,
    near_border,
    segment_frame,
)


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
    settings: StreakSettings
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
    settings: StreakSettings,
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
    settings: StreakSettings,
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
