"""Whether the pixels of a streak, a point or a crowded region show stars or an object."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray, IntArray
from knightcube.errors import FlightError
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.objects.merged import brightest_left, cut_patch, fit_stars
from knightcube.vision.objects.report import SpaceObject, Verdict
from knightcube.vision.objects.rso_indicators import star_ends
from knightcube.vision.objects.settings import ObjectSettings
from knightcube.vision.objects.star_light import Explanation, StarLight, carried_to_middle
from knightcube.vision.streaks.corners.endpoints import chord_outward, extend
from knightcube.vision.streaks.corners.settings import StreakSettings
from knightcube.vision.streaks.corners.streaks import Segmented, near_border

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
