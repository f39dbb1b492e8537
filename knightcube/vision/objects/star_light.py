"""Test of whether stars explain the light of a region, and location of the ends of an object's streak.

The test compares two hypotheses by chi-square: that the light of the region comes from stars only, or from
stars and one object. Stars and object are modelled as streaks of constant brightness with the camera's point
spread function (PSF). The rotation of the camera determines the paths of the stars. The object moves
uniformly from one end of its streak to the other, on a line that is straight either in the image or relative
to the stars. A line that is straight in the image is curved relative to the stars if the camera rotates about
the boresight. The brightnesses of stars and object are fitted by non-negative least squares. The hypothesis
without an object also explains two stars whose streaks overlap or touch, and a segment of a faint streak.
Stars do not explain light that is not on the path of a star, or light that ends within such a path.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.compiled import compiled_form_of, loop_helper
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.objects.brightness import (
    SHAPE_ERROR,
    brightnesses,
    counts_at,
    equations,
    equations_with,
)
from knightcube.vision.objects.streak_ends import Segmented
from knightcube.vision.objects.streak_images import (
    path_among_stars,
    pixels_near,
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
# Distance (px) beyond the assumed ends over which light is followed: minimum if an end may be far away, and
# value if both ends are near.
_BEYOND_FIRST, _BEYOND_LATER = 60.0, 25.0
# Distance (px) between assumed and measured end of the light above which the fit starts at the measured end.
_FOLLOWED = 1.5
# Maximum number of Gauss-Newton steps of a fit of the ends, and step (px) below which it has converged.
_END_FITS, _END_CONVERGED = 3, 0.05
# Change (px) of the ends in one iteration below which the iterations stop.
_LOCATED = 0.3
# Ratio of local to median brightness on a path above which the local light belongs to another source.
_BRIGHTER = 2.0
# Error of the starlight subtracted at a point, relative to the streak, above which the point is not used.
_HIDDEN = 0.25
# Minimum length (px) of a streak whose ends are located.
_LEAST_LOCATED = 12.0
# Distance from all star and object paths beyond which pixels are ignored, in standard deviations of the PSF.
_REACH = 3.0
# Distance beyond the ends of a streak up to which pixels are used to fit the ends, px.
_END_REACH = 5.0
# Largest displacement (px) of an end in one step of a fit.
_LARGEST_STEP = 1.0
# Regularisation of the fit of the ends: number added to the unit diagonal of the normal equations.
_RIDGE = 1e-10


@dataclass(frozen=True, slots=True)
class Explanation:
    """Quality of the hypothesis that the pixels of a region show stars and one object of `flux` counts.

    The attribute `chi_square` is that of the best-fitting sum of star streaks and the object's streak. The
    attribute `unexplained` is the excess of chi-square over its expected value, without the pixels of bright
    regions that the object's streak does not touch. The attributes `misfit` and `misfit_of_stars` are the
    chi-squares per pixel along the object's streak, with the object and with stars only.
    """

    chi_square: float
    unexplained: float
    misfit: float
    misfit_of_stars: float
    flux: float


@dataclass(frozen=True, slots=True, eq=False)
class LocatedEnds:
    """The ends (2, 2), px, of an object's streak, located by means of the light along the whole streak.

    The standard deviation `sigma` of each end (2,), px, is along the major axis of its error ellipse. The
    misfit is the chi-square per pixel along the streak.
    """

    ends: FloatArray
    sigma: FloatArray
    misfit: float


class StarLight:
    """The pixels around one bright region, and the star streaks that best explain these pixels.

    Only pixels near a trial star path, or near a line between two corners of the region, are used. The
    corners of a region are the peaks of the corner detector. A trial star path begins or ends at a corner of
    the region, or lies on the arc of a star through the middle of the region.

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

    Raises KnightCubeError if the least-squares solution of the brightnesses does not converge.
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
        rows, columns = segmented.signal.shape
        self._psf_sigma, self._rotation, self._pinhole = psf_sigma, rotation, pinhole
        self._segmented, self._gain, self._saturation = segmented, gain, saturation
        self._known = tuple(known)
        points = np.concatenate([stars.reshape(-1, 2), _lines_between(corners)])
        self._near = pixels_near(points, _REACH * psf_sigma, rows, columns)
        signal, self._weight, self.expected = self._counts(self._near)
        self._target = signal * self._weight
        images = streak_images(self._near, stars, psf_sigma, False)[:, 0]
        others = [streak_images(self._near, path[None], psf_sigma, False)[0] for path in known]
        self._stars = np.concatenate([images, *others]) if others else images
        self._stars *= self._weight
        self._sums = equations(self._stars, self._target)
        self._power = float(self._target @ self._target)
        self.pixels = len(self._near)
        self._brightness, self.chi_square = brightnesses(self._sums[:-1], self._sums[-1], self._power)

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
            return Explanation(chi_square, chi_square - self.expected, np.inf, np.inf, 0.0)
        missed = self._target - brightness[:-1] @ self._stars - line * brightness[-1]
        own = np.ascontiguousarray(~self._in_others(self._near, _labels_along(self._segmented, ends)))
        expected = self._counts(self._near[own])[2]
        unexplained = float(missed[own] @ missed[own]) - expected
        by_stars = self._target[along] - self._brightness @ self._stars[:, along]
        misfit, of_stars = (float(each @ each) / len(each) for each in (missed[along], by_stars))
        return Explanation(chi_square, unexplained, misfit, of_stars, float(brightness[-1]))

    def _in_others(self, pixels: IntArray, labels: IntArray) -> BoolArray:
        """Return which pixels (p, 2) belong to bright regions other than those with the given `labels`."""
        regions = self._segmented.regions
        found = regions.labels[pixels[:, 1], pixels[:, 0]]
        # The largest label of the whole frame would take longer to find than the largest of these labels.
        largest = max(int(each.max(initial=0)) for each in (found, labels, regions.label))
        others = np.zeros(largest + 1, dtype=np.bool_)
        others[regions.label] = True
        others[labels] = False
        return np.asarray(others[found])

    def _object_images(self, ends: FloatArray) -> list[FloatArray]:
        """Return the weighted image (p,) of an object for each different path that it may have."""
        paths = straight_path(ends), path_among_stars(ends, self._rotation, self._pinhole)
        first = int(np.abs(paths[1] - paths[0]).max() < _SAME_PATH)
        return [self._weighted_image(path) for path in paths[first:]]

    def _counts(self, pixels: IntArray) -> tuple[FloatArray, FloatArray, float]:
        """Return counts (p,), weights (p,) and expected chi-square of pixels (p, 2), see `counts_at`."""
        background = self._segmented.background
        levels = background.typical_level, background.typical_noise
        return counts_at(self._segmented.signal, pixels, *levels, float(self._gain), float(self._saturation))

    def located(self, ends: FloatArray, among_stars: bool) -> LocatedEnds | None:
        """Return the most likely ends of the light of an object's streak, or None if no streak is found.

        The light is followed along the path of the streak beyond both `ends` (2, 2), px, but not into other
        regions. The path is straight relative to the stars if `among_stars` is true, otherwise straight in
        the image. The initial ends are those of the most likely interval with uniform brightness inside and
        no light outside. Ends and brightness are then fitted to the pixels, from which known stars are
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
            # The longer distance is kept while the light may continue beyond the shorter distance.
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
        weight[self._in_others(pixels, np.array([label]))] = 0.0
        target = signal
        if len(self._known):
            paths = [*self._known, self._path(ends, among_stars)]
            images = [streak_at(pixels, path, self._psf_sigma) for path in paths]
            shapes = np.array(images) * weight
            flux, _ = brightnesses(shapes @ shapes.T, shapes @ (signal * weight), 0.0)
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
            images = streak_images(pixels, path[None], self._psf_sigma, True)[0]
            sums, power, count = _sums_of_ends(images, pixels, target, weight, ends)
            if count < _LEAST_LOCATED:
                return None
            scale = np.sqrt(np.maximum(sums.diagonal(), 1e-300))
            normal = sums[:5] / np.outer(scale, scale) + _RIDGE * np.eye(5)
            inverse = np.linalg.inv(normal) / np.outer(scale, scale)
            solution = inverse @ sums[5]
            if solution[0] <= 0.0:
                return None
            steps = np.clip(solution[1:] / solution[0], -_LARGEST_STEP, _LARGEST_STEP).reshape(2, 2)
            ends = ends + steps
            if np.abs(steps).max() < _END_CONVERGED:
                break
        misfit = (power + solution[0] * (solution[0] * sums[0, 0] - 2.0 * sums[5, 0])) / count
        covariance = inverse[1:, 1:] / solution[0] ** 2 * max(misfit, 1.0)
        # The larger eigenvalue of a symmetric matrix of two rows has a closed form.
        xx, yy, xy = covariance[[0, 2], [0, 2]], covariance[[1, 3], [1, 3]], covariance[[0, 2], [1, 3]]
        sigma = np.sqrt(0.5 * (xx + yy) + np.hypot(0.5 * (xx - yy), xy))
        return LocatedEnds(ends, sigma, misfit)

    def excess(self, region: IntArray) -> float:
        """Return the excess of chi-square over its expected value, for a model that contains only stars.

        The pixels used are those near the trial paths and those of the `region` (m, 2), px, which are in
        ascending order of rows and columns. Away from all trial paths, the model is zero.
        """
        columns = self._segmented.signal.shape[1]
        near, own = (each[:, 1] * columns + each[:, 0] for each in (self._near, region))
        place = np.minimum(np.searchsorted(near, own), len(near) - 1)
        beside = region[near[place] != own] if len(near) else region
        signal, weight, expected = self._counts(np.ascontiguousarray(beside))
        outside = float(np.sum((signal * weight) ** 2)) - expected
        return self.chi_square - self.expected + outside

    def _with_line(self, line: FloatArray) -> tuple[FloatArray, float]:
        """Return brightnesses (k + 1,) of k stars and an object with image `line` (p,), and chi-square."""
        sums = equations_with(self._stars, self._target, self._sums, line)
        brightness, chi_square = brightnesses(sums[:-1], sums[-1], self._power)
        # Only rounding errors can make chi-square larger than without the object.
        return brightness, min(chi_square, self.chi_square)

    def _weighted_image(self, path: FloatArray) -> FloatArray:
        """Return the weighted image (p,) of a streak with a flux of one count along `path` (m, 2), px."""
        return streak_at(self._near, path, self._psf_sigma) * self._weight


def region_along(segmented: Segmented, ends: FloatArray) -> int:
    """Return the label of the region that contains most of the line between two ends (2, 2), px, or 0."""
    shares = np.bincount(_labels_along(segmented, ends))
    shares[0] = 0
    return int(np.argmax(shares))


def _labels_along(segmented: Segmented, ends: FloatArray) -> IntArray:
    """Return the labels (m,) of the regions, or 0, at points on the line between two ends (2, 2), px."""
    labels = segmented.regions.labels
    column, row = np.clip(np.rint(straight_path(ends)), 0, np.array(labels.shape[::-1]) - 1).T.astype(int)
    return np.asarray(labels[row, column])


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

    Each element of `gain` (n,) is twice the logarithm of the likelihood ratio of light to no light.
    """
    total = np.cumsum(gain)
    likelihood = np.exp(0.5 * (total - total.max()))
    likelihood /= likelihood.sum()
    place = np.arange(len(gain))
    last = float(likelihood @ place)
    return last, float(np.sqrt(likelihood @ (place - last) ** 2))


def _sums_of_ends_numpy(
    images: FloatArray, pixels: IntArray, target: FloatArray, weight: FloatArray, ends: FloatArray
) -> tuple[FloatArray, float, int]:
    chord = ends[1] - ends[0]
    size = float(np.linalg.norm(chord))
    along = (pixels - ends[0]) @ chord / size**2
    beyond = _END_REACH / size
    near = np.flatnonzero((along > -beyond) & (along < 1.0 + beyond) & (weight > 0))
    images, second = images[:, near], np.clip(along[near], 0.0, 1.0)
    # A displacement of an end along the streak also changes the brightness of the streak.
    thinned = images[0] * (chord / size**2)[:, None]
    first_end, last_end = images[1:] * (1.0 - second) + thinned, images[1:] * second - thinned
    counts = target[near] * weight[near]
    design = np.concatenate([images[:1], first_end, last_end]) * weight[near]
    return np.vstack([design @ design.T, design @ counts]), float(counts @ counts), len(near)


@compiled_form_of(_sums_of_ends_numpy)
def _sums_of_ends(
    images: FloatArray, pixels: IntArray, target: FloatArray, weight: FloatArray, ends: FloatArray
) -> tuple[FloatArray, float, int]:
    """Return the normal equations (6, 5) of a fit of the brightness and the ends (2, 2), px, of a streak.

    The first five rows are the matrix of the equations and the last row is their right-hand side. The first
    unknown is the brightness. The other unknowns are the displacements (x, y) of the first and of the last
    end, each multiplied by the brightness. The further results are the sum of the squares of the weighted
    counts, and the number of pixels used.

    The pixels (p, 2) have the counts `target` (p,) and the reciprocal standard deviations `weight` (p,). The
    `images` (3, p) are the image of the streak and its derivatives with respect to a displacement.
    """
    x, y = ends[1, 0] - ends[0, 0], ends[1, 1] - ends[0, 1]
    square = x * x + y * y
    beyond = _END_REACH / math.sqrt(square)
    sums, design, power, count = np.zeros((6, 5)), np.empty(5), 0.0, 0
    for p in range(len(pixels)):
        along = ((pixels[p, 0] - ends[0, 0]) * x + (pixels[p, 1] - ends[0, 1]) * y) / square
        if along <= -beyond or along >= 1.0 + beyond or not weight[p] > 0.0:
            continue
        counts, second = target[p] * weight[p], min(max(along, 0.0), 1.0)
        power += counts * counts
        count += 1
        # A displacement of an end along the streak also changes the brightness of the streak.
        thinned = images[0, p] / square
        design[0] = images[0, p] * weight[p]
        design[1] = (images[1, p] * (1.0 - second) + thinned * x) * weight[p]
        design[2] = (images[2, p] * (1.0 - second) + thinned * y) * weight[p]
        design[3] = (images[1, p] * second - thinned * x) * weight[p]
        design[4] = (images[2, p] * second - thinned * y) * weight[p]
        for k in range(5):
            for other in range(k + 1):
                sums[k, other] += design[k] * design[other]
            sums[5, k] += design[k] * counts
    for k in range(5):
        for other in range(k):
            sums[other, k] = sums[k, other]
    return sums, power, count


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
    # If the curve is not straight, a second step finds the nearest point.
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
        # If the curve is not straight, a second step finds the nearest point.
        k = min(max(k + int(np.rint(ahead)), 0), m - 1)
        x, y = pixels[p, 0] - curve[k, 0], pixels[p, 1] - curve[k, 1]
        if abs(x * tangent[k, 0] + y * tangent[k, 1]) <= 1.0:
            across = (y * tangent[k, 0] - x * tangent[k, 1]) / width
            profile = math.exp(-0.5 * across * across) / (math.sqrt(2.0 * math.pi) * width)
            share[k] += (weight[p] * profile) ** 2
            light[k] += weight[p] ** 2 * profile * target[p]
    return light / np.maximum(share, 1e-300), share


def _star_paths(corners: FloatArray, rotation: FloatArray, pinhole: Pinhole, per_length: int) -> FloatArray:
    """Return trial star paths (n, m, 2), px, that begin or end at a corner or are spread over the region."""
    middle = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
    # The number of points of a path is its length in px, because the points are 1 px apart.
    length = len(star_path(middle, rotation, pinhole))
    anchors, starts = _trial_starts(corners, middle, length, per_length)
    paths = star_paths(pinhole.unit_vectors(anchors), rotation, starts, pinhole)
    finite = np.isfinite(paths.reshape(len(paths), -1)).all(axis=1)
    return paths if finite.all() else np.asarray(paths[finite])


def _trial_starts_numpy(
    corners: FloatArray, middle: FloatArray, length: int, per_length: int
) -> tuple[FloatArray, FloatArray]:
    extent = float(np.hypot(*(corners.max(axis=0) - corners.min(axis=0))))
    chain = min(max(extent / length, 1.0), _LONGEST_CHAIN)
    number = round(per_length * chain) + 1
    starts = 0.5 + chain * (np.arange(number) / (number - 1) - 0.5)
    anchors = np.concatenate([np.repeat(corners, 2, axis=0), np.tile(middle, (number, 1))])
    return anchors, np.concatenate([np.tile([0.0, 1.0], len(corners)), starts])


@compiled_form_of(_trial_starts_numpy)
def _trial_starts(
    corners: FloatArray, middle: FloatArray, length: int, per_length: int
) -> tuple[FloatArray, FloatArray]:
    """Return one point (n, 2), px, on the arc of each trial star path, and its fraction (n,) of the path.

    One path begins and one path ends at each corner (k, 2), px. The other paths lie on the arc of a star
    through the `middle` (2,), px, of the region, and cover the region in equal steps. The fraction is below 0
    or above 1 if a path does not reach the middle. The argument `length` is the length of a path, px.
    """
    size = len(corners)
    wide, high = np.ptp(corners[:, 0]), np.ptp(corners[:, 1])
    chain = min(max(math.hypot(wide, high) / length, 1.0), _LONGEST_CHAIN)
    number = round(per_length * chain) + 1
    anchors, starts = np.empty((2 * size + number, 2)), np.empty(2 * size + number)
    for k in range(size):
        for end in range(2):
            anchors[2 * k + end, 0], anchors[2 * k + end, 1] = corners[k, 0], corners[k, 1]
            starts[2 * k + end] = end
    for k in range(number):
        anchors[2 * size + k, 0], anchors[2 * size + k, 1] = middle[0], middle[1]
        starts[2 * size + k] = 0.5 + chain * (k / (number - 1) - 0.5)
    return anchors, starts


def _lines_between_numpy(corners: FloatArray) -> FloatArray:
    return np.concatenate([straight_path(np.array(pair)) for pair in itertools.combinations(corners, 2)])


@compiled_form_of(_lines_between_numpy)
def _lines_between(corners: FloatArray) -> FloatArray:
    """Return the points (n, 2), px, of the straight lines between all pairs of corners (k, 2), px."""
    total = 0
    for k in range(len(corners)):
        for other in range(k + 1, len(corners)):
            total += _points_between(corners[k], corners[other])
    points, place = np.empty((total, 2)), 0
    for k in range(len(corners)):
        for other in range(k + 1, len(corners)):
            count = _points_between(corners[k], corners[other])
            for step in range(count):
                part = (step + 0.5) / count
                for axis in range(2):
                    start = corners[k, axis]
                    points[place, axis] = start + part * (corners[other, axis] - start)
                place += 1
    return points


@loop_helper
def _points_between(first: FloatArray, last: FloatArray) -> int:
    """Return the number of points of `straight_path` on the line between two points (2,), px."""
    return max(1, math.ceil(math.hypot(last[0] - first[0], last[1] - first[1])))
