"""Test whether stars explain the light of a region, and search for objects after the stars are subtracted.

The test compares two hypotheses by chi-square: that the light of the region comes from stars only, or from
stars and one object. Stars and object are modelled as streaks of constant brightness with the camera's point
spread function (PSF). The rotation of the camera determines the paths of the stars. The object moves
uniformly from one end of its streak to the other, on a line that is straight either in the image or relative
to the stars. A line that is straight in the image is curved relative to the stars if the camera rotates about
the boresight. The brightnesses of stars and object are fitted by non-negative least squares. The hypothesis
without an object also explains two stars whose streaks overlap or touch, and a segment of a faint streak.
Stars do not explain light that is not on the path of a star, or light that ends within such a path.

A star's streak has the same brightness from end to end. The brightness of a star is therefore at most the
minimum brightness of the image along the star's path. An erosion of the image, with the path as structuring
element, gives the minimum brightness along the path for every position of the star. Objects that cross the
streaks of stars, and points on these streaks, nearly vanish in the eroded image. The stars of a region are
subtracted one by one, the brightest first. The positions and brightnesses of all stars found are fitted
together. The joint fit of the stars excludes pixels that are brighter than the model of the stars. The
brightest light that remains after the subtraction of the stars is fitted as a point or a line.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import ndimage
from scipy.linalg import lapack
from scipy.optimize import nnls

from knightcube.astro.arrays import BoolArray, FloatArray, Image, IntArray
from knightcube.compiled import compiled_form_of, loop_helper
from knightcube.errors import FlightError
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.frame import label_pixels, line_of
from knightcube.vision.objects.streak_ends import Segmented
from knightcube.vision.objects.streak_images import (
    fitted_line,
    least_squares,
    path_among_stars,
    pixels_near,
    spread_with_slopes,
    star_path,
    star_paths,
    straight_path,
    streak_at,
    streak_images,
)

PATHS_PER_LENGTH = 8
"""Density of trial star paths along a bright region: the number of paths in one path length."""
# Maximum length of a chain of successive star streaks in a bright region, in path lengths.
_LONGEST_CHAIN = 5.0
# Largest distance (px) between two paths that count as the same path.
_SAME_PATH = 0.15
# Maximum number of iterations, each of which follows the light of an object's streak and fits its ends.
_ROUNDS = 8
# Minimum distance (px) to which light is followed beyond each end, in the first and in later iterations.
_BEYOND_FIRST, _BEYOND_LATER = 60.0, 25.0
# Difference (px) between assumed and measured end of the light above which the fit uses the measured end.
_FOLLOWED = 1.5
# Maximum number of Gauss-Newton steps of a fit of the ends, and step (px) below which it has converged.
_END_FITS, _END_CONVERGED = 3, 0.05
# Change (px) of the ends in one iteration below which the iterations stop.
_LOCATED = 0.3
# Ratio of local to median brightness on a path above which the local light belongs to another source.
_BRIGHTER = 2.0
# Error of subtracted starlight, as a fraction of the streak's brightness, above which light is ignored.
_HIDDEN = 0.25
# Minimum length (px) of a streak whose ends are located.
_LEAST_LOCATED = 12.0
# Distance from all star and object paths beyond which pixels are ignored, in standard deviations of the PSF.
_REACH = 3.0
# Regularisation of the fit of brightnesses: number added to the unit diagonal of the normal equations.
_RIDGE = 1e-10
# Error of a bright streak's modelled counts, as a fraction, due to errors of ends, PSF and uniformity.
SHAPE_ERROR = 0.1


@dataclass(frozen=True, slots=True)
class Explanation:
    """Quality of the hypothesis that the pixels of a region show stars and one object of `flux` counts.

    The attribute `chi_square` belongs to the best-fitting sum of star streaks and the object's streak. The
    attributes `misfit` and `misfit_of_stars` are the chi-squares per pixel along the object's streak, with
    the object and with stars only.
    """

    chi_square: float
    misfit: float
    misfit_of_stars: float
    flux: float


@dataclass(frozen=True, slots=True, eq=False)
class LocatedEnds:
    """The ends (2, 2), px, of an object's streak, located by means of the light along the whole streak.

    The standard deviation of each end (2,), px, is that along the axis of the larger error. The misfit is the
    chi-square per pixel along the streak.
    """

    ends: FloatArray
    sigma: FloatArray
    misfit: float


class StarLight:
    """The pixels around one bright region, and the star streaks that best explain these pixels.

    Only pixels near a trial star path, or near a line between two corners of the region, are used. The
    corners of a region are the peaks of the corner detector. A trial star path begins or ends at a corner of
    the region, or passes the midpoint of all its corners.

    Args:
        segmented: frame with its bright regions.
        corners: corners of the region (k, 2), px, with k of 2 or more.
        rotation: rotation of the camera during the exposure (3,), rad, camera axes.
        pinhole: camera that took the frame.
        psf_sigma: standard deviation of the PSF, px.
        gain: electrons per count.
        saturation: counts at which a pixel saturates; pixels within 5 % of this value have no weight.
        known: paths (m, 2), px, of known stars whose light also falls on the pixels.
        per_length: density of trial star paths along the region, as the number of paths in one path length.

    Attributes:
        chi_square: chi-square of the best-fitting sum of star streaks.
        pixels: number of pixels used.
        expected: expected chi-square of a correct model. In bright regions, `expected` is less than `pixels`,
            because the weights of bright pixels also allow for model errors.

    Raises FlightError if the least-squares solution of the brightnesses does not converge.
    """

    def __init__(
        self,
        segmented: Segmented,
        corners: FloatArray,
        rotation: FloatArray,
        pinhole: Pinhole,
        psf_sigma: float,
        gain: float,
        saturation: float,
        known: Sequence[FloatArray] = (),
        per_length: int = PATHS_PER_LENGTH,
    ) -> None:
        stars = _star_paths(corners, rotation, pinhole, per_length)
        lines = [straight_path(np.array(pair)) for pair in itertools.combinations(corners, 2)]
        rows, columns = segmented.signal.shape
        self._psf_sigma, self._rotation, self._pinhole = psf_sigma, rotation, pinhole
        self._segmented, self._gain, self._saturation = segmented, gain, saturation
        self._known = tuple(known)
        points = np.concatenate([stars.reshape(-1, 2), *lines])
        self._near = pixels_near(points, _REACH * psf_sigma, rows, columns)
        signal, self._weight, self.expected = self._counts(self._near)
        self._target = signal * self._weight
        images = streak_images(self._near, stars, psf_sigma, False)[:, 0]
        images *= self._weight
        others = [self._weighted_image(path)[None] for path in known]
        self._stars = np.concatenate([images, *others]).T if others else images.T
        self._normal, self._right = self._stars.T @ self._stars, self._stars.T @ self._target
        self._power = float(self._target @ self._target)
        self.pixels = len(self._near)
        self._brightness, self.chi_square = _brightnesses(self._normal, self._right, self._power)

    def chi_square_with(self, ends: FloatArray) -> float:
        """Return the chi-square of stars and an object between `ends` (2, 2), px (see `explain`)."""
        return min(self._with_line(line)[1] for line in self._object_images(ends))

    def explain(self, ends: FloatArray) -> Explanation:
        """Return the quality of the hypothesis of stars and one object between `ends` (2, 2), px.

        The object's path is straight in the image or relative to the stars, whichever gives the smaller
        chi-square.
        """
        lines = self._object_images(ends)
        fits = [self._with_line(line) for line in lines]
        best = int(np.argmin([fit[1] for fit in fits]))
        line, (brightness, chi_square) = lines[best], fits[best]
        along = np.flatnonzero(line > 0.05 * line.max())
        if not len(along):
            return Explanation(chi_square, np.inf, np.inf, 0.0)
        target, stars = self._target[along], self._stars.T[:, along]
        missed = target - brightness[:-1] @ stars - line[along] * brightness[-1]
        by_stars = target - self._brightness @ stars
        misfit, of_stars = (float(each @ each) / len(each) for each in (missed, by_stars))
        return Explanation(chi_square, misfit, of_stars, float(brightness[-1]))

    def _object_images(self, ends: FloatArray) -> list[FloatArray]:
        """Return the weighted images (p,) of objects with paths straight in the image and among stars."""
        paths = straight_path(ends), path_among_stars(ends, self._rotation, self._pinhole)
        first = int(np.abs(paths[1] - paths[0]).max() < _SAME_PATH)
        return [self._weighted_image(path) for path in paths[first:]]

    def _counts(self, pixels: IntArray) -> tuple[FloatArray, FloatArray, float]:
        """Return counts (p,), weights (p,) and expected chi-square of pixels (p, 2), see `_counts_at`."""
        background = self._segmented.background
        levels = background.typical_level, background.typical_noise
        return _counts_at(self._segmented.signal, pixels, *levels, float(self._gain), float(self._saturation))

    def located(self, ends: FloatArray, among_stars: bool) -> LocatedEnds | None:
        """Return the most likely ends of the light of an object's streak, or None if no streak is found.

        The light is followed along the path of the streak beyond both `ends` (2, 2), px, but not into other
        regions. The path is straight relative to the stars if `among_stars` is true, otherwise straight in
        the image. The initial ends are the ends of the most likely interval of uniform brightness without
        light outside. Ends and brightness are then fitted to the pixels, from which known stars are
        subtracted.
        """
        beyond = max(_BEYOND_FIRST, float(np.linalg.norm(ends[1] - ends[0])))
        label = region_along(self._segmented, ends)
        found = None
        for _ in range(_ROUNDS):
            length = float(np.linalg.norm(ends[1] - ends[0]))
            if length < _LEAST_LOCATED:
                return None
            parts = np.arange(-beyond, length + beyond + 1.0) / length
            curve = self._path(ends, among_stars, parts)
            rows, columns = self._segmented.signal.shape
            inside = np.all((curve >= 0.0) & (curve <= (columns - 1, rows - 1)), axis=1)
            kept = _around(inside, len(parts) // 2)
            if len(kept) < _LEAST_LOCATED:
                return None
            lit = self._lit(curve[kept], parts[kept], ends, among_stars, label)
            if lit is None:
                return None
            bounds, vague, pixels, target, weight = lit
            followed = self._path(ends, among_stars, bounds)
            moved = np.linalg.norm(followed - ends, axis=1)
            start = np.where(moved[:, None] > _FOLLOWED, followed, ends)
            if np.linalg.norm(start[1] - start[0]) < _LEAST_LOCATED:
                return None
            fitted = self._fitted_ends(pixels, target, weight, start, among_stars)
            if fitted is None:
                return None
            found = LocatedEnds(fitted.ends, np.hypot(fitted.sigma, vague), fitted.misfit)
            change = float(np.linalg.norm(found.ends - ends, axis=1).max())
            ends = found.ends
            if change < _LOCATED:
                break
            # The range stays long while the light may continue beyond its end.
            ended = moved.max() < _BEYOND_LATER - 2.0 * _FOLLOWED
            beyond = _BEYOND_LATER if ended else max(_BEYOND_FIRST, float(np.linalg.norm(ends[1] - ends[0])))
        return found

    def _path(self, ends: FloatArray, among_stars: bool, parts: FloatArray | None = None) -> FloatArray:
        """Return points (m, 2), px, of the path of an object between `ends` (2, 2), px."""
        if among_stars:
            return path_among_stars(ends, self._rotation, self._pinhole, parts)
        return straight_path(ends, parts)

    def _lit(
        self, curve: FloatArray, parts: FloatArray, ends: FloatArray, among_stars: bool, label: int
    ) -> tuple[FloatArray, FloatArray, IntArray, FloatArray, FloatArray] | None:
        """Return the bright interval of a curve and the pixels near the curve, or None if the curve is dark.

        The results are the fractions of the path at which its light begins and ends (2,), their standard
        deviations (2,), px, the pixels (p, 2), their counts without known stars (p,), and their weights (p,).
        The points of the `curve` (m, 2), px, are 1 px apart, at the fractions `parts` (m,) of the path.
        """
        rows, columns = self._segmented.signal.shape
        pixels = pixels_near(curve, _REACH * self._psf_sigma, rows, columns)
        signal, weight, _ = self._counts(pixels)
        regions = self._segmented.regions
        own = regions.labels[pixels[:, 1], pixels[:, 0]]
        weight[(own != label) & np.isin(own, regions.label)] = 0.0
        target = signal
        if len(self._known):
            paths = [*self._known, self._path(ends, among_stars)]
            images = [streak_at(pixels, path, self._psf_sigma) for path in paths]
            shapes = np.array(images) * weight
            flux, _ = _brightnesses(shapes @ shapes.T, shapes @ (signal * weight), 0.0)
            target = signal - flux[:-1] @ np.array(images[:-1])
        light, share = _light_along(pixels, target, weight, curve, self._psf_sigma)
        inner = (parts > 0.05) & (parts < 0.95) & (share > 0.0)
        usual = float(np.median(light[inner])) if inner.any() else 0.0
        if usual <= 0.0:
            return None
        # Twice the log-likelihood ratio, at each point, of light with the median brightness to no light.
        gain = share * usual * (2.0 * light - usual)
        gain[light > _BRIGHTER * usual + 3.0 / np.sqrt(np.maximum(share, 1e-300))] = 0.0
        if len(self._known):
            # Errors of subtracted stars do not average out, because they are common to all pixels of a star.
            hidden, _ = _light_along(pixels, signal - target, weight, curve, self._psf_sigma)
            gain[SHAPE_ERROR * hidden > _HIDDEN * usual] = 0.0
        middle = int(np.argmin(np.abs(parts - 0.5)))
        step = parts[1] - parts[0]
        first, first_sigma = _end_of_light(gain[middle::-1])
        last, last_sigma = _end_of_light(gain[middle:])
        bounds = parts[middle] + np.array([-first - 0.5, last + 0.5]) * step
        return bounds, np.array([first_sigma, last_sigma]), pixels, target, weight

    def _fitted_ends(
        self, pixels: IntArray, target: FloatArray, weight: FloatArray, ends: FloatArray, among_stars: bool
    ) -> LocatedEnds | None:
        """Return the ends fitted to the counts `target` (p,) of pixels (p, 2), or None if the fit fails."""
        size = 0.0
        for _ in range(_END_FITS):
            chord = ends[1] - ends[0]
            size = float(np.linalg.norm(chord))
            if size < _LEAST_LOCATED:
                return None
            path = self._path(ends, among_stars)
            along = (pixels - ends[0]) @ chord / size**2
            beyond = _WIDE_REACH / size
            near = np.flatnonzero((along > -beyond) & (along < 1.0 + beyond) & (weight > 0))
            if len(near) < _LEAST_LOCATED:
                return None
            images = streak_images(pixels[near], path[None], self._psf_sigma, True)[0]
            second = np.clip(along[near], 0.0, 1.0)
            # A displacement of an end along the streak also changes the brightness of the streak.
            thinned = images[0] * (chord / size**2)[:, None]
            first_end, last_end = images[1:] * (1.0 - second) + thinned, images[1:] * second - thinned
            design = np.concatenate([images[:1], first_end, last_end])
            design *= weight[near]
            scale = np.sqrt(np.maximum(np.sum(design**2, axis=1), 1e-300))
            normal = (design @ design.T) / np.outer(scale, scale) + _RIDGE * np.eye(5)
            inverse = np.linalg.inv(normal) / np.outer(scale, scale)
            solution = inverse @ (design @ (target[near] * weight[near]))
            if solution[0] <= 0.0:
                return None
            steps = np.clip(solution[1:] / solution[0], -_LARGEST_STEP, _LARGEST_STEP).reshape(2, 2)
            ends = ends + steps
            if np.abs(steps).max() < _END_CONVERGED:
                break
        missed = target[near] * weight[near] - solution[0] * design[0]
        misfit = float(missed @ missed) / len(near)
        covariance = inverse[1:, 1:] / solution[0] ** 2 * max(misfit, 1.0)
        sigma = np.sqrt([np.linalg.eigvalsh(covariance[k : k + 2, k : k + 2])[1] for k in (0, 2)])
        return LocatedEnds(ends, sigma, misfit)

    def excess(self, region: IntArray) -> float:
        """Return chi-square of stars alone minus its expected value, on pixels near paths and in a region.

        The pixels of the `region` (m, 2), px, are in ascending order of rows and columns. The model of the
        stars is zero on those pixels of the region that are not near any trial path.
        """
        columns = self._segmented.signal.shape[1]
        near, own = (each[:, 1] * columns + each[:, 0] for each in (self._near, region))
        place = np.minimum(np.searchsorted(near, own), len(near) - 1)
        beside = region[near[place] != own] if len(near) else region
        signal, weight, expected = self._counts(np.ascontiguousarray(beside))
        outside = float(np.sum((signal * weight) ** 2)) - expected
        return self.chi_square - self.expected + outside

    def _with_line(self, line: FloatArray) -> tuple[FloatArray, float]:
        """Return brightnesses (k + 1,) of k stars and an object of image `line` (p,), and chi-square."""
        stars = len(self._normal)
        normal = np.empty((stars + 1, stars + 1))
        normal[:stars, :stars], normal[stars, stars] = self._normal, line @ line
        normal[stars, :stars] = normal[:stars, stars] = self._stars.T @ line
        right = np.append(self._right, line @ self._target)
        brightness, chi_square = _brightnesses(normal, right, self._power)
        # Without rounding errors, chi-square would never be larger than without the object.
        return brightness, min(chi_square, self.chi_square)

    def _weighted_image(self, path: FloatArray) -> FloatArray:
        """Return the weighted image (p,) of a streak with a flux of one count along `path` (m, 2), px."""
        return streak_at(self._near, path, self._psf_sigma) * self._weight


def region_along(segmented: Segmented, ends: FloatArray) -> int:
    """Return the label of the region that contains most of the line between two ends (2, 2), px, or 0."""
    labels = segmented.regions.labels
    column, row = np.clip(np.rint(straight_path(ends)), 0, np.array(labels.shape[::-1]) - 1).T.astype(int)
    shares = np.bincount(labels[row, column])
    shares[0] = 0
    return int(np.argmax(shares))


def light_on_path(segmented: Segmented, path: FloatArray, psf_sigma: float) -> FloatArray:
    """Return the brightness (m,), counts/px, along a path (m, 2), px, whose points are 1 px apart.

    The brightness includes light of other sources on the path, and is zero outside the frame.
    """
    rows, columns = segmented.signal.shape
    pixels = pixels_near(path, _REACH * psf_sigma, rows, columns)
    signal = segmented.signal[pixels[:, 1], pixels[:, 0]].astype(np.float64)
    return _light_along(pixels, signal, np.ones(len(pixels)), path, psf_sigma)[0]


def _around(inside: BoolArray, middle: int) -> IntArray:
    """Return the indices of the contiguous true values around the index `middle`.

    The result is empty if the value at `middle` is false.
    """
    if not inside[middle]:
        return np.arange(0)
    outside = np.flatnonzero(~inside)
    place = int(np.searchsorted(outside, middle))
    first = int(outside[place - 1]) + 1 if place > 0 else 0
    last = int(outside[place]) if place < len(outside) else len(inside)
    return np.arange(first, last)


def _end_of_light(gain: FloatArray) -> tuple[float, float]:
    """Return the expected value of the last index with light, and its standard deviation.

    The array `gain` (n,) contains, for each index, twice the logarithm of the likelihood ratio of light to no
    light.
    """
    total = np.cumsum(gain)
    likelihood = np.exp(0.5 * (total - total.max()))
    likelihood /= likelihood.sum()
    place = np.arange(len(gain))
    last = float(likelihood @ place)
    return last, float(np.sqrt(likelihood @ (place - last) ** 2))


def _light_along_numpy(
    pixels: IntArray, target: FloatArray, weight: FloatArray, curve: FloatArray, psf_sigma: float
) -> tuple[FloatArray, FloatArray]:
    width = float(np.sqrt(psf_sigma**2 + 1.0 / 12.0))
    chord = curve[-1] - curve[0]
    along = np.maximum.accumulate((curve - curve[0]) @ chord)
    place = np.interp((pixels - curve[0]) @ chord, along, np.arange(len(curve)))
    tangent = np.gradient(curve, axis=0)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1), 1e-300)[:, None]
    near = np.rint(place).astype(np.int64)
    # The nearest point of a curve that is not straight is found in a second step.
    ahead = np.sum((pixels - curve[near]) * tangent[near], axis=1)
    near = np.clip(near + np.rint(ahead).astype(np.int64), 0, len(curve) - 1)
    away = pixels - curve[near]
    across = away[:, 1] * tangent[near, 0] - away[:, 0] * tangent[near, 1]
    profile = np.exp(-0.5 * (across / width) ** 2) / (np.sqrt(2.0 * np.pi) * width)
    profile[np.abs(np.sum(away * tangent[near], axis=1)) > 1.0] = 0.0
    share = np.bincount(near, (weight * profile) ** 2, len(curve))
    light = np.bincount(near, weight**2 * profile * target, len(curve))
    return np.asarray(light / np.maximum(share, 1e-300)), np.asarray(share, dtype=float)


@compiled_form_of(_light_along_numpy)
def _light_along(
    pixels: IntArray, target: FloatArray, weight: FloatArray, curve: FloatArray, psf_sigma: float
) -> tuple[FloatArray, FloatArray]:
    """Return the brightness (m,), counts/px, along a curve (m, 2), px, and the inverse variances (m,).

    The pixels (p, 2) have the counts `target` (p,) and the reciprocal standard deviations `weight` (p,).
    """
    m, width = len(curve), math.sqrt(psf_sigma**2 + 1.0 / 12.0)
    x0, y0 = curve[0, 0], curve[0, 1]
    chord_x, chord_y = curve[m - 1, 0] - x0, curve[m - 1, 1] - y0
    along, tangent = np.empty(m), np.empty((m, 2))
    for k in range(m):
        along[k] = (curve[k, 0] - x0) * chord_x + (curve[k, 1] - y0) * chord_y
        along[k] = max(along[k], along[max(k - 1, 0)])
        before, after = max(k - 1, 0), min(k + 1, m - 1)
        x, y = curve[after, 0] - curve[before, 0], curve[after, 1] - curve[before, 1]
        size = max(math.hypot(x, y), 1e-300)
        tangent[k, 0], tangent[k, 1] = x / size, y / size
    share, light = np.zeros(m), np.zeros(m)
    places = np.interp((pixels[:, 0] - x0) * chord_x + (pixels[:, 1] - y0) * chord_y, along, np.arange(m))
    for p in range(len(pixels)):
        k = min(max(int(np.rint(places[p])), 0), m - 1)
        ahead = (pixels[p, 0] - curve[k, 0]) * tangent[k, 0] + (pixels[p, 1] - curve[k, 1]) * tangent[k, 1]
        # The nearest point of a curve that is not straight is found in a second step.
        k = min(max(k + int(np.rint(ahead)), 0), m - 1)
        x, y = pixels[p, 0] - curve[k, 0], pixels[p, 1] - curve[k, 1]
        if abs(x * tangent[k, 0] + y * tangent[k, 1]) <= 1.0:
            across = (y * tangent[k, 0] - x * tangent[k, 1]) / width
            profile = math.exp(-0.5 * across * across) / (math.sqrt(2.0 * math.pi) * width)
            share[k] += (weight[p] * profile) ** 2
            light[k] += weight[p] ** 2 * profile * target[p]
    return light / np.maximum(share, 1e-300), share


def _pixel_weights(
    signal: FloatArray, level: float, noise: float, gain: float, saturation: float
) -> FloatArray:
    """Return the reciprocal standard deviations of pixels with `signal` counts above the background `level`.

    The standard deviation includes the noise of the background (`noise`, counts), photon noise (`gain` in
    electrons per count) and the model error of bright streaks. Pixels above 95 % of the `saturation` counts
    have the weight 0.
    """
    light = np.maximum(signal, 0.0)
    clipped = signal + level >= 0.95 * saturation
    error = np.sqrt(noise**2 + light / gain + (SHAPE_ERROR * light) ** 2)
    return np.where(clipped, 0.0, 1.0 / error)


def _counts_at_numpy(
    image: Image, pixels: IntArray, level: float, noise: float, gain: float, saturation: float
) -> tuple[FloatArray, FloatArray, float]:
    """Return the counts (p,) above the background and the weights (p,) of pixels, and expected chi-square.

    Each pixel contributes to the expected chi-square the fraction of its variance that is due to background
    noise and photon noise. The image (rows, columns) contains the counts above the background, and the pixels
    (p, 2) are given as (x, y). The other arguments are those of `_pixel_weights`.
    """
    signal = image[pixels[:, 1], pixels[:, 0]].astype(np.float64)
    weight = _pixel_weights(signal, level, noise, gain, saturation)
    return signal, weight, float(np.sum((noise**2 + np.maximum(signal, 0.0) / gain) * weight**2))


@compiled_form_of(_counts_at_numpy)
def _counts_at(
    image: Image, pixels: IntArray, level: float, noise: float, gain: float, saturation: float
) -> tuple[FloatArray, FloatArray, float]:
    signal, weight, expected = np.empty(len(pixels)), np.zeros(len(pixels)), 0.0
    for p in range(len(pixels)):
        counts = float(image[pixels[p, 1], pixels[p, 0]])
        light = max(counts, 0.0)
        random = noise * noise + light / gain
        variance = random + (SHAPE_ERROR * light) ** 2
        signal[p] = counts
        if counts + level < 0.95 * saturation:
            weight[p] = 1.0 / math.sqrt(variance)
            expected += random / variance
    return signal, weight, expected


def _brightnesses(normal: FloatArray, right: FloatArray, power: float) -> tuple[FloatArray, float]:
    """Return the non-negative least-squares coefficients (k,) of k images, and the chi-square.

    The argument `normal` (k, k) contains the scalar products of the weighted images with one another, and
    `right` (k,) their scalar products with the weighted pixels of the frame. The argument `power` is the sum
    of the squares of the weighted pixels. Raises FlightError if the equations are not positive definite, or
    if the solver does not converge.
    """
    scale = np.sqrt(np.maximum(normal.diagonal(), 1e-300))
    scaled = normal / scale / scale[:, None]
    # The regularisation keeps the equations invertible if images are equal or empty.
    scaled.reshape(-1)[:: len(scale) + 1] += _RIDGE
    # LAPACK is called directly, because the argument checks of numpy take longer than the routines.
    factor, failed = lapack.dpotrf(scaled, lower=1)
    if failed:
        raise FlightError(f"brightnesses of {len(scale)} streaks: the equations are not positive definite")
    # The triangular system of k rows has the same least-squares solution as the system of all pixels.
    reduced, _ = lapack.dtrtrs(factor, right / scale, lower=1)
    try:
        brightness, residual = nnls(factor.T, reduced, maxiter=30 * len(scale))
    except RuntimeError as error:
        raise FlightError(f"brightnesses of {len(scale)} streaks: {error}") from error
    return brightness / scale, float(residual**2) + max(power - float(reduced @ reduced), 0.0)


def _star_paths(corners: FloatArray, rotation: FloatArray, pinhole: Pinhole, per_length: int) -> FloatArray:
    """Return trial star paths (n, m, 2), px, that begin or end at a corner or are spread over the region."""
    middle = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
    extent = float(np.hypot(*(corners.max(axis=0) - corners.min(axis=0))))
    directions = pinhole.unit_vectors(np.concatenate([corners, middle[None]]))
    # The number of points of a path is its length in px, because the points are 1 px apart.
    length = star_paths(directions[-1:], rotation, np.array([0.5]), pinhole).shape[1]
    chain = min(max(extent / length, 1.0), _LONGEST_CHAIN)
    number = round(per_length * chain) + 1
    starts = 0.5 + chain * (np.arange(number) / (number - 1) - 0.5)
    anchors = np.concatenate([np.repeat(np.arange(len(corners)), 2), np.full(number, len(corners))])
    starts = np.concatenate([np.tile([0.0, 1.0], len(corners)), starts])
    paths = star_paths(directions[anchors], rotation, starts, pinhole)
    return np.asarray(paths[np.isfinite(paths).all(axis=(1, 2))])


# Margin (px) of a patch of pixels around a region, which is wider than the PSF.
_ROOM = 8
_MOST_STARS = 12
# Detection thresholds of stars and of remaining light, in standard deviations of the smoothed noise.
_STAR_SIGMAS, _LEFT_SIGMAS = 4.0, 6.0
# Excess of a pixel over the modelled stars (standard deviations) above which the fit excludes the pixel.
_NOT_THEIRS = 4.0
# Distance from the path of a star beyond which its light is neglected, in standard deviations of the PSF.
_WIDE_REACH = 5.0
# Largest step (px) of a fit, step (px) below which the fit has converged, and maximum number of steps.
_LARGEST_STEP, _CONVERGED, _FITS = 1.0, 0.02, 8
LEAST_LINE_PX = 4.0
"""Minimum length (px) of an object's line of light; a shorter line is treated as a point."""
# Distance at which the Gaussian that smooths an image is truncated, in standard deviations.
_FARTHEST = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class Patch:
    """A rectangle of the frame around a region.

    Attributes:
        signal: counts above the background (rows, columns), including the light of other regions.
        weight: reciprocal standard deviations of the pixels (rows, columns), 1/counts; 0 if saturated.
        noise: standard deviation of a background pixel, counts.
        corner: position (x, y) in the frame of the first pixel (2,), px.
        mask: mask of the pixels that belong to the region (rows, columns).
        beyond: counts assumed above, below, left and right of the rectangle (4,); infinite outside the frame,
            because streaks may continue there.
        psf_sigma: standard deviation of the PSF, px.
        gain: electrons per count.
        seen: signal convolved with the PSF (rows, columns).
    """

    signal: FloatArray
    weight: FloatArray
    noise: float
    corner: FloatArray
    mask: BoolArray
    beyond: FloatArray
    psf_sigma: float
    gain: float = 1.0
    seen: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        """Compute the smoothed signal, which the search for stars and the search for objects use."""
        object.__setattr__(self, "seen", _smoothed(self.signal, self.psf_sigma))

    def excess(self, left: FloatArray) -> float:
        """Return the excess of chi-square of the counts `left` in the region over its expected value.

        The array `left` (rows, columns) contains the counts that remain after a model is subtracted. The
        returned value is approximately the largest decrease of chi-square that additional sources can cause.
        """
        weight = self.weight[self.mask]
        variance = self.noise**2 + np.maximum(self.signal[self.mask], 0.0) / self.gain
        return float(np.sum((left[self.mask] ** 2 - variance) * weight**2))

    def smoothed(self, light: FloatArray) -> FloatArray:
        """Return `light` (rows, columns) convolved with the PSF, which is the matched filter of a point."""
        return self.seen if light is self.signal else _smoothed(light, self.psf_sigma)

    @property
    def smoothed_noise(self) -> float:
        """The standard deviation of a background pixel after convolution with the PSF, counts."""
        return self.noise / (2.0 * float(np.sqrt(np.pi)) * self.psf_sigma)


def cut_patch(segmented: Segmented, index: int, psf_sigma: float, gain: float, saturation: float) -> Patch:
    """Return the patch of the frame around region `index`.

    Pixels above 95 % of the `saturation` counts have the weight 0.
    """
    regions, (rows, columns) = segmented.regions, segmented.signal.shape
    top, bottom, left, right = (int(edge) for edge in regions.boxes[index])
    top, left = max(top - _ROOM, 0), max(left - _ROOM, 0)
    bottom, right = min(bottom + _ROOM, rows), min(right + _ROOM, columns)
    signal = segmented.signal[top:bottom, left:right].astype(np.float64)
    background = segmented.background
    weight = _pixel_weights(signal, background.typical_level, background.typical_noise, gain, saturation)
    mask = regions.labels[top:bottom, left:right] == regions.label[index]
    corner = np.array([left, top], dtype=float)
    at_edge = top == 0, bottom == rows, left == 0, right == columns
    beyond = np.where(at_edge, np.inf, 0.0)
    return Patch(signal, weight, background.typical_noise, corner, mask, beyond, psf_sigma, gain)


def _smoothed(light: FloatArray, psf_sigma: float) -> FloatArray:
    radius = int(_FARTHEST * psf_sigma + 0.5)
    profile = np.exp(-0.5 * (np.arange(radius + 1) / psf_sigma) ** 2)
    return _convolved(light, profile / (2.0 * profile.sum() - 1.0))


def _convolved_numpy(light: FloatArray, profile: FloatArray) -> FloatArray:
    whole = np.concatenate([profile[:0:-1], profile])
    down = ndimage.correlate1d(light, whole, axis=0, mode="constant")
    return np.asarray(ndimage.correlate1d(down, whole, axis=1, mode="constant"))


@compiled_form_of(_convolved_numpy)
def _convolved(light: FloatArray, profile: FloatArray) -> FloatArray:
    """Return an image convolved along both axes with a symmetric profile, with zeros beyond its border.

    The array `profile` (k,) begins with the middle of the profile.
    """
    rows, columns = light.shape
    out, line = np.zeros((rows, columns)), np.empty(columns)
    for row in range(rows):
        line[:] = 0.0
        for k in range(1 - len(profile), len(profile)):
            if 0 <= row + k < rows:
                _add_scaled(light[row + k], profile[abs(k)], line)
        for k in range(min(len(profile), columns)):
            _add_scaled(line[: columns - k], profile[k], out[row, k:])
            if k > 0:
                _add_scaled(line[k:], profile[k], out[row, : columns - k])
    return out


@loop_helper
def _add_scaled(values: FloatArray, factor: float, total: FloatArray) -> None:
    for k in range(len(total)):
        total[k] += factor * values[k]


def fit_stars(
    patch: Patch, rotation: FloatArray, pinhole: Pinhole, enough: float = -np.inf
) -> tuple[list[FloatArray], FloatArray]:
    """Return the paths (m, 2), px, of the stars in a patch, and the counts (rows, columns) without stars.

    No more stars are fitted if the excess of chi-square in the region (`Patch.excess`) is below `enough`.
    """
    rows, columns = patch.signal.shape
    middles, paths, left = np.empty((0, 2)), np.empty((0, 1, 2)), patch.signal
    centre = patch.corner + 0.5 * np.array([columns - 1, rows - 1])
    steps, factor = _steps_along(star_path(centre, rotation, pinhole) - centre, patch.psf_sigma)
    while len(middles) < _MOST_STARS and patch.excess(left) >= enough:
        middle = _brightest_star(patch, left, steps, factor)
        if middle is None:
            break
        middles = np.concatenate([middles, patch.corner + middle[None]])
        middles, paths, left = _fit_together(patch, middles, rotation, pinhole)
    return list(paths), left


# Number of points of a star's path that are tested first, for each pixel that may be the middle of the path.
_FIRST_OFFSETS = 9


def _steps_along(offsets: FloatArray, psf_sigma: float) -> tuple[IntArray, FloatArray]:
    """Return the pixels (x, y) at which a star's path is tested (k, 2), and factors of the image there (k,).

    The pixels are relative to the middle of the path, as are the points `offsets` (m, 2), px, of the path.
    """
    every = max(1, round(2.0 * psf_sigma))
    steps = np.rint(offsets[np.unique(np.append(np.arange(0, len(offsets), every), len(offsets) - 1))])
    # At the end of a streak, the smoothed brightness is half the brightness along the streak.
    factor = np.ones(len(steps))
    factor[[0, -1]] = 2.0
    # Most pixels are excluded by the tests at the middle of the path and at a few points along the path.
    first = np.unique(np.linspace(0, len(steps) - 1, _FIRST_OFFSETS).astype(int))
    order = np.concatenate([first[len(first) // 2 :], first[: len(first) // 2]])
    order = np.concatenate([order, np.setdiff1d(np.arange(len(steps)), order)])
    return steps[order].astype(np.int64), factor[order]


def _brightest_star(patch: Patch, left: FloatArray, steps: IntArray, factor: FloatArray) -> FloatArray | None:
    """Return the position (x, y) in the patch of the brightest possible star, or None if there is none.

    The brightness of a star centred on a pixel is at most the minimum of the smoothed image `left` (rows,
    columns) along the star's path (see `_steps_along`).
    """
    threshold = _STAR_SIGMAS * patch.smoothed_noise
    found = _brightest_path(patch.smoothed(left), steps, factor, patch.beyond, threshold)
    return np.array(found[1:], dtype=float) if found[0] >= threshold else None


def _brightest_path_numpy(
    seen: FloatArray, steps: IntArray, factor: FloatArray, beyond: FloatArray, threshold: float
) -> tuple[float, int, int]:
    rows, columns = seen.shape
    # The image is padded with the values `beyond`, so that all pixels of a path lie in the array.
    x, y = np.abs(steps).max(axis=0)
    framed = np.empty((rows + 2 * y, columns + 2 * x))
    framed[:y], framed[y + rows :] = beyond[0], beyond[1]
    framed[:, :x], framed[:, x + columns :] = beyond[2], beyond[3]
    framed[y : y + rows, x : x + columns] = seen
    flat, step = framed.reshape(-1), (steps[:, 1] + y) * framed.shape[1] + steps[:, 0] + x
    pixel = (np.arange(rows)[:, None] * framed.shape[1] + np.arange(columns)).reshape(-1)
    least = np.full(len(pixel), np.inf)
    for number in range(len(steps)):
        least = np.minimum(least, factor[number] * flat.take(pixel + step[number]))
        kept = np.flatnonzero(least >= threshold)
        if len(kept) < len(pixel):
            pixel, least = pixel[kept], least[kept]
    if not len(least):
        return -np.inf, -1, -1
    best = int(np.argmax(least))
    row, column = divmod(int(pixel[best]), framed.shape[1])
    return float(least[best]), column, row


@compiled_form_of(_brightest_path_numpy)
def _brightest_path(
    seen: FloatArray, steps: IntArray, factor: FloatArray, beyond: FloatArray, threshold: float
) -> tuple[float, int, int]:
    """Return the largest minimum of an image along a shifted path, and column and row of the path's middle.

    Returns minus infinity, -1 and -1 if the minimum along the path is below the threshold at all positions of
    the path.

    The image (rows, columns) is multiplied by `factor` (k,) at the pixels (x, y) of the path, which are given
    relative to its middle by `steps` (k, 2). The values above, below, left and right of the image are
    `beyond` (4,).
    """
    rows, columns = seen.shape
    best, best_column, best_row = -np.inf, -1, -1
    for row in range(rows):
        for column in range(columns):
            least = np.inf
            for number in range(len(steps)):
                x, y = column + steps[number, 0], row + steps[number, 1]
                if x < 0:
                    light = beyond[2]
                elif x >= columns:
                    light = beyond[3]
                elif y < 0:
                    light = beyond[0]
                elif y >= rows:
                    light = beyond[1]
                else:
                    light = seen[y, x]
                least = min(least, factor[number] * light)
                if least < threshold or least <= best:
                    break
            if least >= threshold and least > best:
                best, best_column, best_row = least, column, row
    return best, best_column, best_row


def _fit_together(
    patch: Patch, middles: FloatArray, rotation: FloatArray, pinhole: Pinhole
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return midpoints (n, 2) and paths (n, m, 2), px, of stars fitted together, and the counts without them.

    The argument `middles` (n, 2), px, is the initial guess of the midpoints.
    """
    rows, columns = patch.signal.shape
    paths = _paths_through(middles, rotation, pinhole)
    points = (paths - patch.corner).reshape(-1, 2)
    pixels = pixels_near(points, _WIDE_REACH * patch.psf_sigma, rows, columns)
    flat = pixels[:, 1] * columns + pixels[:, 0]
    weight = patch.weight.reshape(-1)[flat]
    target = patch.signal.reshape(-1)[flat] * weight
    theirs = np.ones(len(flat), dtype=np.bool_)
    for _ in range(2):
        # The array `images` (n, 3, p) contains the images of the stars and their derivatives.
        images = streak_images(pixels, paths - patch.corner, patch.psf_sigma, True)
        images *= weight
        solution = least_squares(images.reshape(-1, len(flat)) * theirs, target).reshape(-1, 3)
        flux = np.maximum(solution[:, 0], 1e-9)
        middles = middles + np.clip(solution[:, 1:] / flux[:, None], -_LARGEST_STEP, _LARGEST_STEP)
        paths = _paths_through(middles, rotation, pinhole)
        theirs = target - flux @ images[:, 0] < _NOT_THEIRS
    lights = streak_images(pixels, paths - patch.corner, patch.psf_sigma, False)[:, 0]
    flux = np.maximum(least_squares(lights * (weight * theirs), target), 0.0)
    left = patch.signal.copy()
    left.reshape(-1)[flat] -= flux @ lights
    return middles, paths, left


def _paths_through(middles: FloatArray, rotation: FloatArray, pinhole: Pinhole) -> FloatArray:
    """Return the paths (n, m, 2), px, of stars that are at `middles` (n, 2), px, at mid-exposure."""
    return star_paths(pinhole.unit_vectors(middles), rotation, np.full(len(middles), 0.5), pinhole)


def brightest_left(patch: Patch, left: FloatArray) -> FloatArray | None:
    """Return the ends (2, 2), px, of the brightest significant light that is not from stars, or None.

    The array `left` (rows, columns) contains the counts of the patch after its stars are subtracted. For a
    point, the two ends are equal. Residuals below the model error of a bright star are not significant.
    """
    seen = patch.smoothed(left)
    pixel = np.flatnonzero(seen > _LEFT_SIGMAS * patch.smoothed_noise)
    light, whole = seen.reshape(-1)[pixel], np.maximum(patch.seen.reshape(-1)[pixel], 0.0)
    pixel = pixel[light > _LEFT_SIGMAS * np.hypot(patch.smoothed_noise, SHAPE_ERROR * whole)]
    owner, count = label_pixels(pixel, seen.shape[1])
    inside = patch.mask.reshape(-1)[pixel] * np.maximum(left.reshape(-1)[pixel], 0.0)
    flux = np.bincount(owner, inside, count)
    if flux.max(initial=0.0) <= 0.0:
        return None
    y, x = np.divmod(pixel[owner == int(np.argmax(flux))], seen.shape[1])
    # The initial guess of the ends is the uniform line with the same moments as the bright pixels.
    points, weight = np.stack([x, y], axis=-1).astype(float), seen[y, x]
    points = points[weight >= 0.5 * np.percentile(weight, 80.0)]
    spread = np.cov(points.T, bias=True) if len(points) > 1 else np.eye(2)
    guess = line_of(points.mean(axis=0), spread, LEAST_LINE_PX)
    return _fit_line(patch, left, guess + patch.corner)


def _fit_line(patch: Patch, left: FloatArray, ends: FloatArray) -> FloatArray:
    """Return the ends (2, 2), px, of a line fitted by Gauss-Newton to the counts `left` without stars."""
    if np.any(ends[0] != ends[1]):
        return fitted_line(left, patch.weight, ends - patch.corner, patch.psf_sigma) + patch.corner
    size, reach = np.array(left.shape[::-1]), int(np.ceil(_WIDE_REACH * patch.psf_sigma))
    for _ in range(_FITS):
        # The fit of a point uses only the pixels near the point.
        middle = np.floor(ends[0] - patch.corner).astype(int)
        low, high = np.clip([middle - reach, middle + reach + 1], 0, size)
        near = slice(low[1], high[1]), slice(low[0], high[0])
        columns, rows = high - low
        path = straight_path(ends) - patch.corner - low
        images = spread_with_slopes(path, np.ones((1, 1)), columns, rows, patch.psf_sigma)
        weight = patch.weight[near] * (images[0] > 1e-3 * images[0].max(initial=0.0))
        shape = np.stack([(image * weight).reshape(-1) for image in images])
        solution = least_squares(shape, (left[near] * weight).reshape(-1))
        if solution[0] <= 0.0:
            break
        step = np.clip(solution[1:] / solution[0], -_LARGEST_STEP, _LARGEST_STEP)
        ends = ends + step
        if np.abs(step).max() < _CONVERGED:
            break
    return ends
