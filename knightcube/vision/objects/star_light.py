"""Test whether stars explain the light of a region, and search for objects after the stars are subtracted.

The test compares two hypotheses by chi-square: that the light of the region comes from stars only, or from
stars and one object. Stars and object are modelled as streaks of constant brightness with the camera's point
spread function (PSF). Stars follow the paths that are determined by the camera's rotation. The object moves
uniformly from one end of its streak to the other, on a line that is straight either in the image or relative
to the stars. The straight line in the image and that relative to the stars differ if the camera rotates about
the boresight. The brightnesses of stars and object are fitted by non-negative least squares. Two stars whose
streaks overlap or touch, and a segment of a faint star's streak, are explained by stars. Light that is not on
the path of any star, or that ends where a star would continue, is not explained by stars.

A star's streak has the same brightness from end to end. The brightness of a star is therefore at most the
minimum brightness of the image along the star's path. An erosion of the image, with the path as structuring
element, gives the minimum brightness along the path for every position of the star. Objects that cross the
streaks of stars, and points on these streaks, nearly vanish in the eroded image. The stars of a region are
subtracted one by one, the brightest first. The positions and brightnesses of all stars found are fitted
together, without pixels that are brighter than these stars. The brightest light that remains after the
subtraction of the stars is then fitted as a point or a line.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.optimize import nnls
from scipy.special import ndtr

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector
from knightcube.errors import FlightError
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.frame import Background, label_pixels, line_of
from knightcube.vision.objects.streak_ends import Regions, Segmented

# Number of trial star paths along a bright region, per length of a star path.
# Maximum length of a chain of successive star streaks in a bright region, in path lengths.
_PATHS_PER_LENGTH, _LONGEST_CHAIN = 8, 5.0
# Spacing (px) of the Gaussians whose sum models a streak.
# The sum of Gaussians has a ripple of 0.2 % for a PSF of 0.6 px.
_STEP_PX = 1.0
# Distance from all star and object paths beyond which pixels are ignored, in standard deviations of the PSF.
_REACH = 3.0
# Distance at which the Gaussian PSF is truncated, in standard deviations.
_FARTHEST = 5.0
# Relative error of the modelled image of a bright streak, due to errors of its ends, PSF and uniformity.
SHAPE_ERROR = 0.1


@dataclass(frozen=True, slots=True)
class Explanation:
    """Quality of the hypothesis that the pixels of a region show stars and one object.

    Attributes:
        chi_square: chi-square of the best sum of star streaks and the object's streak.
        misfit, misfit_of_stars: chi-square per pixel along the object's streak, for stars with the object and
            for stars only.
        flux: flux of the object, counts.
    """

    chi_square: float
    misfit: float
    misfit_of_stars: float
    flux: float


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

    Attributes:
        chi_square: chi-square of the best sum of star streaks.
        pixels: number of pixels near the trial star paths and the lines between corners.

    Raises:
        FlightError: if the least-squares solution of the brightnesses does not converge.
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
    ) -> None:
        stars = _star_paths(corners, rotation, pinhole)
        lines = [
            straight_path(corners[list(pair)]) for pair in itertools.combinations(range(len(corners)), 2)
        ]
        rows, columns = segmented.signal.shape
        self._psf_sigma, self._rotation, self._pinhole = psf_sigma, rotation, pinhole
        self._near = _pixels_near([*stars, *lines], _REACH * psf_sigma, rows, columns)
        signal = segmented.signal[self._near[:, 1], self._near[:, 0]].astype(np.float64)
        self._weight = _pixel_weights(signal, segmented.background, gain, saturation)
        self._target = signal * self._weight
        self._stars = np.stack([self._weighted_image(path) for path in (*stars, *known)], axis=1)
        self.pixels = len(self._near)
        self._brightness, self.chi_square = _brightnesses(self._stars, self._target)

    def explain(self, ends: FloatArray) -> Explanation:
        """Return how well stars and an object between `ends` (2, 2), px, explain the pixels.

        The object's path is straight in the image or relative to the stars, whichever gives the smaller
        chi-square.
        """
        found = []
        for path in (straight_path(ends), _path_among_stars(ends, self._rotation, self._pinhole)):
            line = self._weighted_image(path)
            images = np.column_stack([self._stars, line])
            brightness, chi_square = _brightnesses(images, self._target)
            along = line > 0.05 * line.max()
            if not along.any():
                found.append(Explanation(chi_square, np.inf, np.inf, 0.0))
                continue
            missed = (self._target - images @ brightness)[along]
            by_stars = (self._target - self._stars @ self._brightness)[along]
            misfit, of_stars = (float(each @ each) / len(each) for each in (missed, by_stars))
            found.append(Explanation(chi_square, misfit, of_stars, float(brightness[-1])))
        return min(found, key=lambda one: one.chi_square)

    def _weighted_image(self, path: FloatArray) -> FloatArray:
        """Return the weighted image of a streak of one count along `path` (m, 2), px, on p pixels, (p,)."""
        (left, top), (right, bottom) = self._near.min(axis=0), self._near.max(axis=0)
        light = spread_over(path - (left, top), right - left + 1, bottom - top + 1, self._psf_sigma)
        return np.asarray(light[self._near[:, 1] - top, self._near[:, 0] - left] * self._weight)


def _pixel_weights(signal: FloatArray, background: Background, gain: float, saturation: float) -> FloatArray:
    """Return the reciprocal standard deviations of pixels with `signal` counts above `background`.

    The standard deviation includes the noise of the background, photon noise (`gain` in electrons per count)
    and the uncertain shape of bright streaks. Pixels above 95 % of the `saturation` counts have the weight 0.
    """
    light = np.maximum(signal, 0.0)
    clipped = signal + background.typical_level >= 0.95 * saturation
    error = np.sqrt(background.typical_noise**2 + light / gain + (SHAPE_ERROR * light) ** 2)
    return np.where(clipped, 0.0, 1.0 / error)


def _brightnesses(images: FloatArray, target: FloatArray) -> tuple[FloatArray, float]:
    """Return non-negative least-squares coefficients (k,) of the k `images` (p, k), and the chi-square.

    Raises FlightError if the solver does not converge.
    """
    try:
        brightness, residual = nnls(images, target, maxiter=30 * images.shape[1])
    except RuntimeError as error:
        raise FlightError(f"brightnesses of {images.shape[1]} streaks: {error}") from error
    return brightness, float(residual**2)


def star_path(direction: FloatArray, rotation: FloatArray, start: float, pinhole: Pinhole) -> FloatArray:
    """Return points (m, 2), px, along the path of a star during the exposure.

    The star is at `direction` (3,), camera axes, when it has covered the fraction `start` of the path.
    """
    whole = pinhole.project(_rotated(direction, rotation, np.linspace(-start, 1.0 - start, 17)))
    steps = _steps(float(np.sum(np.linalg.norm(np.diff(whole, axis=0), axis=-1))))
    parts = (np.arange(steps) + 0.5) / steps - start
    return pinhole.project(_rotated(direction, rotation, parts))


def straight_path(ends: FloatArray) -> FloatArray:
    """Return evenly spaced points (m, 2), px, on the straight line between two ends (2, 2), px."""
    steps = _steps(float(np.linalg.norm(ends[1] - ends[0])))
    parts = (np.arange(steps)[:, None] + 0.5) / steps
    return np.asarray(ends[0] + parts * (ends[1] - ends[0]))


def _path_among_stars(ends: FloatArray, rotation: FloatArray, pinhole: Pinhole) -> FloatArray:
    """Return points (m, 2), px, of a uniform motion relative to the stars between two ends (2, 2), px.

    The ends are passed in the order in time that gives the slower motion relative to the stars.
    """
    vectors = pinhole.unit_vectors(ends)
    both = [at_mid_exposure(pair, rotation) for pair in (vectors, vectors[::-1])]
    first, last = min(both, key=lambda pair: float(np.linalg.norm(pair[1] - pair[0])))
    steps = _steps(float(np.linalg.norm(ends[1] - ends[0])))
    parts = (np.arange(steps) + 0.5) / steps
    at = first + parts[:, None] * (last - first)
    turns = attitude_matrix(from_rotation_vector((parts - 0.5)[:, None] * rotation))
    return pinhole.project(np.einsum("mij,mj->mi", turns, at))


def at_mid_exposure(vectors: FloatArray, rotation: FloatArray) -> FloatArray:
    """Return the mid-exposure directions (2, 3) of two stars from their directions `vectors` at other times.

    The rows of `vectors` (2, 3) are the first star's direction at the start of the exposure, and the second
    star's direction at the end of the exposure.
    """
    turns = attitude_matrix(from_rotation_vector(np.array([[0.5], [-0.5]]) * rotation))
    return np.asarray(np.einsum("mij,mj->mi", turns, vectors))


def _star_paths(corners: FloatArray, rotation: FloatArray, pinhole: Pinhole) -> list[FloatArray]:
    """Return trial star paths: paths that begin or end at a corner, and paths along the whole region."""
    middle = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
    extent = float(np.linalg.norm(np.ptp(corners, axis=0)))
    one = star_path(pinhole.unit_vectors(middle[None])[0], rotation, 0.5, pinhole)
    chain = np.clip(extent / max(len(one) * _STEP_PX, 1.0), 1.0, _LONGEST_CHAIN)
    starts = 0.5 + 0.5 * np.linspace(-chain, chain, round(_PATHS_PER_LENGTH * chain) + 1)
    anchors = [(corner, start) for corner in corners for start in (0.0, 1.0)]
    anchors += [(middle, float(start)) for start in starts]
    points = pinhole.unit_vectors(np.array([anchor for anchor, _ in anchors]))
    paths = [
        star_path(point, rotation, start, pinhole) for point, (_, start) in zip(points, anchors, strict=True)
    ]
    return [path for path in paths if np.all(np.isfinite(path))]


def _rotated(direction: FloatArray, rotation: FloatArray, parts: FloatArray) -> FloatArray:
    """Return the directions (m, 3) of a star after fractions `parts` (m,) of the camera's rotation."""
    return np.asarray(attitude_matrix(from_rotation_vector(parts[:, None] * rotation)) @ direction)


def _steps(length: float) -> int:
    return max(1, int(np.ceil(length / _STEP_PX)))


def _pixels_near(paths: list[FloatArray], reach: float, rows: int, columns: int) -> IntArray:
    """Return the pixels (x, y) within about `reach` px of any of the paths, as (p, 2)."""
    points = np.rint(np.concatenate(paths))
    r = int(np.ceil(reach))
    inside = np.all((points >= -r) & (points < (columns + r, rows + r)), axis=-1)
    x, y = np.meshgrid(np.arange(-r, r + 1), np.arange(-r, r + 1))
    disc = np.stack([x[x**2 + y**2 <= reach**2], y[x**2 + y**2 <= reach**2]], axis=-1)
    points = points[inside].astype(np.int64)
    # Marking the pixels in a Boolean map is faster than sorting and removing duplicates.
    first = points.min(axis=0, initial=columns + rows) - r
    width, height = np.maximum(points.max(axis=0, initial=0) + r + 1 - first, 1)
    marked = np.zeros((height, width), dtype=np.bool_)
    for step in disc:
        column, row = (points + step - first).T
        marked[row, column] = True
    row, column = np.nonzero(marked)
    near = np.stack([column, row], axis=-1) + first
    return np.asarray(near[np.all((near >= 0) & (near < (columns, rows)), axis=-1)])


def spread_over(path: FloatArray, columns: int, rows: int, sigma: float) -> FloatArray:
    """Return the image (rows, columns) of a streak of one count along `path` (m, 2), px.

    The count is distributed evenly over the points of the path, and each point is blurred by a Gaussian with
    the standard deviation `sigma`, px.
    """
    x, y = _within_pixels(columns, path[:, 0], sigma), _within_pixels(rows, path[:, 1], sigma)
    return np.asarray(y.T @ x / len(path))


def spread_with_slopes(
    path: FloatArray, shares: FloatArray, columns: int, rows: int, sigma: float
) -> list[FloatArray]:
    """Return the image of a streak of one count, and its derivatives, 1/px, by displacements of the path.

    Each of the k displacements moves each of the m points of the path by the given fraction `shares` (k, m)
    of a displacement. For each displacement of the path, the derivatives for a displacement along x and along
    y are returned.
    """
    x, y = _within_pixels(columns, path[:, 0], sigma), _within_pixels(rows, path[:, 1], sigma)
    dx, dy = _within_pixels(columns, path[:, 0], sigma, True), _within_pixels(rows, path[:, 1], sigma, True)
    images = [y.T @ x]
    for share in shares:
        images += [y.T @ (share[:, None] * dx), dy.T @ (share[:, None] * x)]
    return [image / len(path) for image in images]


def _within_pixels(count: int, centres: FloatArray, sigma: float, slope: bool = False) -> FloatArray:
    """Return integrals of normal densities centred on `centres` (m,), px, over `count` pixels, as (m, count).

    If `slope` is true, the derivatives of the integrals with respect to the centres, 1/px, are returned
    instead.
    """
    reach = int(np.ceil(_FARTHEST * sigma))
    first = np.rint(centres).astype(np.int64) - reach
    edges = (first[:, None] + np.arange(2 * reach + 2) - 0.5 - centres[:, None]) / sigma
    if slope:
        values = -np.diff(np.exp(-0.5 * edges**2) / (np.sqrt(2.0 * np.pi) * sigma), axis=1)
    else:
        values = np.diff(ndtr(edges), axis=1)
    number, width = values.shape
    start = np.clip(first, -width, count) + width
    placed = np.zeros((number, count + 2 * width))
    placed[np.arange(number)[:, None], start[:, None] + np.arange(width)] = values
    return placed[:, width : width + count]


# Margin (px) of a patch of pixels around a region, which is wider than the PSF.
_ROOM = 8
_MOST_STARS = 12
# Detection thresholds of a star and of the remaining light, in standard deviations of the smoothed image.
_STAR_SIGMAS, _LEFT_SIGMAS = 4.0, 6.0
# Excess of a pixel over the modelled stars (standard deviations) above which the fit ignores the pixel.
_NOT_THEIRS = 4.0
# Largest step (px) of a fit, step (px) at which the fit has converged, and maximum number of steps.
_LARGEST_STEP, _CONVERGED, _FITS = 1.0, 0.02, 8
# Minimum length (px) of an object's line of light; a shorter remainder of light counts as a point.
_LEAST_LINE_PX = 4.0
# Widest gap (px) in an object's line of light that the subtraction of a crossing star may leave.
_WIDEST_GAP_PX = 12


@dataclass(frozen=True, slots=True, eq=False)
class Patch:
    """A rectangle of the frame around a region.

    Attributes:
        signal: counts above the background (rows, columns), including the light of other regions.
        weight: reciprocal standard deviations of the pixels (rows, columns), 1/counts; 0 if saturated.
        noise: standard deviation of a background pixel, counts.
        corner: position (x, y) in the frame of the first pixel of the rectangle (2,), px.
        mask: which pixels belong to the region (rows, columns).
        beyond: counts assumed beyond the rectangle, as ((above, below), (left, right)); infinite outside the
            frame, because streaks may continue there.
        psf_sigma: standard deviation of the PSF, px.
    """

    signal: FloatArray
    weight: FloatArray
    noise: float
    corner: FloatArray
    mask: BoolArray
    beyond: tuple[tuple[float, float], tuple[float, float]]
    psf_sigma: float

    def image_and_slopes(self, path: FloatArray, shares: FloatArray) -> list[FloatArray]:
        """Return image and derivatives of a streak along `path` (m, 2), px, in the frame, on the patch."""
        rows, columns = self.signal.shape
        return spread_with_slopes(path - self.corner, shares, columns, rows, self.psf_sigma)

    def smoothed(self, light: FloatArray) -> FloatArray:
        """Return `light` convolved with the PSF, which is the matched filter of a point."""
        return np.asarray(ndimage.gaussian_filter(light, self.psf_sigma, mode="constant"))

    @property
    def smoothed_noise(self) -> float:
        """The standard deviation of a background pixel after convolution with the PSF, counts."""
        return self.noise / (2.0 * float(np.sqrt(np.pi)) * self.psf_sigma)


def cut_patch(
    segmented: Segmented, regions: Regions, index: int, psf_sigma: float, gain: float, saturation: float
) -> Patch:
    """Return the patch of the frame around region `index`.

    Pixels above 95 % of the `saturation` counts have the weight 0.
    """
    rows, columns = segmented.signal.shape
    top, bottom, left, right = (int(edge) for edge in regions.boxes[index])
    top, left = max(top - _ROOM, 0), max(left - _ROOM, 0)
    bottom, right = min(bottom + _ROOM, rows), min(right + _ROOM, columns)
    signal = segmented.signal[top:bottom, left:right].astype(np.float64)
    weight = _pixel_weights(signal, segmented.background, gain, saturation)
    mask = regions.labels[top:bottom, left:right] == regions.label[index]
    corner = np.array([left, top], dtype=float)
    above, below, before, after = (
        np.inf if off else 0.0 for off in (top == 0, bottom == rows, left == 0, right == columns)
    )
    beyond = ((above, below), (before, after))
    return Patch(signal, weight, segmented.background.typical_noise, corner, mask, beyond, psf_sigma)


def fit_stars(patch: Patch, rotation: FloatArray, pinhole: Pinhole) -> tuple[list[FloatArray], FloatArray]:
    """Return the paths (m, 2), px, of the stars in a patch, and the counts (rows, columns) without stars."""
    middles: list[FloatArray] = []
    left = patch.signal
    rows, columns = patch.signal.shape
    centre = patch.corner + 0.5 * np.array([columns - 1, rows - 1])
    path = _path_of(centre, rotation, pinhole)
    # The offsets are points of a star's path relative to the midpoint of the path, and include both ends.
    every = max(1, round(2.0 * patch.psf_sigma))
    offsets = path[np.unique(np.append(np.arange(0, len(path), every), len(path) - 1))] - centre
    while len(middles) < _MOST_STARS:
        eroded = _eroded(patch, left, offsets)
        row, column = np.unravel_index(int(np.argmax(eroded)), eroded.shape)
        if eroded[row, column] < _STAR_SIGMAS * patch.smoothed_noise:
            break
        middles.append(patch.corner + np.array([column, row], dtype=float))
        middles, left = _fit_together(patch, middles, rotation, pinhole)
    return [_path_of(middle, rotation, pinhole) for middle in middles], left


def _path_of(middle: FloatArray, rotation: FloatArray, pinhole: Pinhole) -> FloatArray:
    return star_path(pinhole.unit_vectors(middle[None])[0], rotation, 0.5, pinhole)


def _eroded(patch: Patch, left: FloatArray, offsets: FloatArray) -> FloatArray:
    """Return the largest possible brightness of a star centred on each pixel of the smoothed image."""
    seen = patch.smoothed(left)
    rows, columns = seen.shape
    reach = int(np.ceil(np.abs(offsets).max())) + 1
    wide = np.pad(seen, reach, constant_values=patch.beyond)
    least = np.full(seen.shape, np.inf)
    for number, (x, y) in enumerate(np.rint(offsets).astype(int)):
        part = wide[reach + y : reach + y + rows, reach + x : reach + x + columns]
        # At the end of a streak, the smoothed brightness is half the brightness along the streak.
        np.minimum(least, 2.0 * part if number in (0, len(offsets) - 1) else part, out=least)
    return least


def _fit_together(
    patch: Patch, middles: list[FloatArray], rotation: FloatArray, pinhole: Pinhole
) -> tuple[list[FloatArray], FloatArray]:
    """Return the path midpoints (2,), px, of stars fitted together, and the counts without these stars."""

    def images(middle: FloatArray) -> list[FloatArray]:
        path = _path_of(middle, rotation, pinhole)
        return patch.image_and_slopes(path, np.ones((1, len(path))))

    theirs = np.ones(patch.signal.shape, dtype=np.bool_)
    for _ in range(3):
        columns = [image for middle in middles for image in images(middle)]
        weight = np.where(theirs, patch.weight, 0.0).ravel()
        weighted = np.stack([column.ravel() * weight for column in columns], axis=1)
        solution = _solve(weighted, patch.signal.ravel() * weight).reshape(-1, 3)
        flux = np.maximum(solution[:, 0], 1e-9)
        middles = [
            middle + np.clip(step / part, -_LARGEST_STEP, _LARGEST_STEP)
            for middle, step, part in zip(middles, solution[:, 1:], flux, strict=True)
        ]
        stars = np.tensordot(flux, np.stack(columns[::3]), axes=1)
        theirs = (patch.signal - stars) * patch.weight < _NOT_THEIRS
    lights = [images(middle)[0] for middle in middles]
    weight = np.where(theirs, patch.weight, 0.0).ravel()
    weighted = np.stack([light.ravel() * weight for light in lights], axis=1)
    flux = np.maximum(_solve(weighted, patch.signal.ravel() * weight), 0.0)
    return middles, patch.signal - np.tensordot(flux, np.stack(lights), axes=1)


def brightest_left(patch: Patch, left: FloatArray) -> FloatArray | None:
    """Return the ends (2, 2), px, of the brightest significant light left in a region, or None.

    For a point, the two ends are equal. Residuals below the model error of a bright star are not significant.

    Args:
        patch: rectangle of the frame around the examined region.
        left: counts of the rectangle after its stars are subtracted (rows, columns).
    """
    lit = np.maximum(patch.signal, 0.0)
    error = np.hypot(patch.smoothed_noise, SHAPE_ERROR * patch.smoothed(lit))
    seen = patch.smoothed(left)
    pixel = np.flatnonzero(seen > _LEFT_SIGMAS * error)
    owner, count = label_pixels(pixel, seen.shape[1])
    inside = np.where(patch.mask, np.maximum(left, 0.0), 0.0)
    flux = np.bincount(owner, inside.reshape(-1)[pixel], count)
    if flux.max(initial=0.0) <= 0.0:
        return None
    y, x = np.divmod(pixel[owner == int(np.argmax(flux))], seen.shape[1])
    # The initial guess of the ends is the uniform line with the same moments as the bright pixels.
    points, weight = np.stack([x, y], axis=-1).astype(float), seen[y, x]
    points = points[weight >= 0.5 * np.percentile(weight, 80.0)]
    spread = np.cov(points.T, bias=True) if len(points) > 1 else np.eye(2)
    guess = line_of(points.mean(axis=0), spread, _LEAST_LINE_PX)
    ends = _fit_line(patch, left, guess + patch.corner)
    longer = _continued(patch, seen, ends)
    return ends if longer is None else _fit_line(patch, left, longer)


def _continued(patch: Patch, seen: FloatArray, ends: FloatArray) -> FloatArray | None:
    """Return the ends (2, 2), px, of a line of light extended across gaps, or None if no light continues.

    A star that crosses the object's line leaves a gap, because the star is subtracted together with the
    line's light.
    """

    def last_before_gap(lit: BoolArray) -> int:
        places = np.flatnonzero(lit)
        if not len(places):
            return 0
        gaps = np.flatnonzero(np.diff(places) > _WIDEST_GAP_PX)
        return int(places[gaps[0]] if len(gaps) else places[-1])

    length = float(np.linalg.norm(ends[1] - ends[0]))
    if length < 2.0 * _LEAST_LINE_PX:
        return None
    along = (ends[1] - ends[0]) / length
    reach = int(np.hypot(*patch.signal.shape))
    at = np.arange(-reach, int(length) + reach + 1)
    points = ends[0] - patch.corner + at[:, None] * along
    profile = ndimage.map_coordinates(seen, points.T[::-1], order=1, mode="constant")
    middle = int(np.argmin(np.abs(at - 0.5 * length)))
    lit = profile > 0.5 * np.median(profile[(at >= 0) & (at <= length)])
    first = middle - last_before_gap(lit[middle::-1])
    last = middle + last_before_gap(lit[middle:])
    if at[first] > -_LARGEST_STEP and at[last] < length + _LARGEST_STEP:
        return None
    return np.asarray(ends[0] + np.array([[min(at[first], 0)], [max(at[last], length)]]) * along)


def _fit_line(patch: Patch, left: FloatArray, ends: FloatArray) -> FloatArray:
    """Return the ends (2, 2), px, of a line fitted by Gauss-Newton to the light `left` by the stars."""
    is_point = bool(np.all(ends[0] == ends[1]))
    for _ in range(_FITS):
        path = straight_path(ends)
        at = (np.arange(len(path)) + 0.5) / len(path)
        columns = patch.image_and_slopes(
            path, np.ones((1, len(path))) if is_point else np.stack([1.0 - at, at])
        )
        near = columns[0] > 1e-3 * columns[0].max()
        weight = patch.weight[near]
        solution = _solve(np.stack([c[near] * weight for c in columns], axis=1), left[near] * weight)
        if solution[0] <= 0.0:
            break
        steps = np.clip(solution[1:] / solution[0], -_LARGEST_STEP, _LARGEST_STEP).reshape(-1, 2)
        ends = ends + steps
        if np.abs(steps).max() < _CONVERGED:
            break
    return ends


def _solve(images: FloatArray, target: FloatArray) -> FloatArray:
    """Return the least-squares coefficients (k,) of `images` (p, k), slightly regularised."""
    normal = images.T @ images
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    normal = normal / np.outer(scale, scale) + 1e-6 * np.eye(len(scale))
    return np.asarray(np.linalg.solve(normal, (images.T @ target) / scale) / scale)
