"""Subtraction of stars from the pixels around a region, and measurement of the light that remains.

A star's streak has the same brightness from end to end. The brightness of a star is therefore at most the
minimum brightness of the image along the star's path. An erosion of the image, with the path as structuring
element, gives the minimum brightness along the path for every position of the star. Objects that cross the
streaks of stars, and points on these streaks, nearly vanish in the eroded image. The stars of a region are
subtracted one by one, the brightest first. The positions and brightnesses of all stars found are fitted
together. The joint fit of the stars excludes pixels that are brighter than the model of the stars. The
brightest light that remains after the subtraction of the stars is fitted as a point or a line.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy import ndimage

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.compiled import compiled_form_of, loop_helper
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.frame import label_pixels, line_of
from knightcube.vision.objects.brightness import SHAPE_ERROR, equations, pixel_weights
from knightcube.vision.objects.streak_ends import Segmented
from knightcube.vision.objects.streak_images import (
    fitted_line,
    least_squares,
    pixels_near,
    solved,
    spread_with_slopes,
    star_path,
    star_paths,
    straight_path,
    streak_images,
)

# Margin (px) between a region and the border of its patch of pixels; the margin is wider than the PSF.
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
        corner: position (x, y) of the first pixel in the frame (2,), px.
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
        return _excess(left, self.signal, self.weight, self.mask, float(self.noise), float(self.gain))

    def smoothed(self, light: FloatArray) -> FloatArray:
        """Return `light` (rows, columns) convolved with the PSF, which is the matched filter of a point."""
        return self.seen if light is self.signal else _smoothed(light, self.psf_sigma)

    @property
    def smoothed_noise(self) -> float:
        """The standard deviation of a background pixel after convolution with the PSF, counts."""
        return self.noise / (2.0 * float(np.sqrt(np.pi)) * self.psf_sigma)


def _excess_numpy(
    left: FloatArray, signal: FloatArray, weight: FloatArray, mask: BoolArray, noise: float, gain: float
) -> float:
    variance = noise**2 + np.maximum(signal[mask], 0.0) / gain
    return float(np.sum((left[mask] ** 2 - variance) * weight[mask] ** 2))


@compiled_form_of(_excess_numpy)
def _excess(
    left: FloatArray, signal: FloatArray, weight: FloatArray, mask: BoolArray, noise: float, gain: float
) -> float:
    total = 0.0
    for row in range(left.shape[0]):
        for column in range(left.shape[1]):
            if mask[row, column]:
                variance = noise * noise + max(signal[row, column], 0.0) / gain
                total += (left[row, column] ** 2 - variance) * weight[row, column] ** 2
    return total


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
    levels = float(background.typical_level), float(background.typical_noise)
    weight = pixel_weights(signal, *levels, float(gain), float(saturation))
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

    The array `profile` (k,) contains one half of the profile, from the middle outwards.
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
    """Return the pixels (k, 2) at which a star's path is tested, and factors (k,) for the image there.

    The pixels and the points `offsets` (m, 2), px, of the path are (x, y) relative to the path's middle.
    """
    every = max(1, round(2.0 * psf_sigma))
    steps = np.rint(offsets[np.unique(np.append(np.arange(0, len(offsets), every), len(offsets) - 1))])
    # At the end of a streak, the smoothed brightness is half the brightness along the streak.
    factor = np.ones(len(steps))
    factor[[0, -1]] = 2.0
    # The middle and a few other points of the path come first, because they exclude most positions.
    first = np.unique(np.linspace(0, len(steps) - 1, _FIRST_OFFSETS).astype(int))
    order = np.concatenate([first[len(first) // 2 :], first[: len(first) // 2]])
    order = np.concatenate([order, np.setdiff1d(np.arange(len(steps)), order)])
    return steps[order].astype(np.int64), factor[order]


def _brightest_star(patch: Patch, left: FloatArray, steps: IntArray, factor: FloatArray) -> FloatArray | None:
    """Return the position (x, y) of the brightest possible star in a patch, or None if there is none.

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
    """Return the largest minimum of an image along a path, over all positions of the path, and the position.

    The three results are the minimum, and the column and row of the path's middle. They are minus infinity,
    -1 and -1 if the minimum is below the threshold at all positions.

    The path consists of the pixels `steps` (k, 2), (x, y) relative to its middle. The image (rows, columns)
    is multiplied by `factor` (k,) at these pixels. The values above, below, left and right of the image are
    `beyond` (4,).
    """
    rows, columns = seen.shape
    best, best_column, best_row = -np.inf, -1, -1
    # Positions are skipped if the path crosses the border on a dark side, where it is below the threshold.
    # To the left and right of the image, all rows have the value of that side.
    dark = factor.max() * beyond < threshold
    aside = dark[2] and dark[3]
    top = max(0, -steps[:, 1].min()) if aside and dark[0] else 0
    bottom = min(rows, rows - steps[:, 1].max()) if aside and dark[1] else rows
    left = max(0, -steps[:, 0].min()) if dark[2] else 0
    right = min(columns, columns - steps[:, 0].max()) if dark[3] else columns
    for row in range(top, bottom):
        for column in range(left, right):
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
    """Return midpoints (n, 2) and paths (n, m, 2), px, of stars fitted together, and the remaining counts.

    The remaining counts are those after subtraction of these stars. The argument `middles` (n, 2), px, is the
    initial guess of the midpoints.
    """
    rows, columns = patch.signal.shape
    paths = _paths_through(middles, rotation, pinhole)
    points = (paths - patch.corner).reshape(-1, 2)
    pixels = pixels_near(points, _WIDE_REACH * patch.psf_sigma, rows, columns)
    flat = pixels[:, 1] * columns + pixels[:, 0]
    weight = patch.weight.reshape(-1)[flat]
    signal = patch.signal.reshape(-1)[flat]
    target, theirs = signal * weight, weight
    for _ in range(2):
        # The array `images` (n, 3, p) contains the images of the stars and their derivatives.
        images = streak_images(pixels, paths - patch.corner, patch.psf_sigma, True)
        solution = solved(equations(images.reshape(-1, len(flat)) * theirs, target)).reshape(-1, 3)
        flux = np.maximum(solution[:, 0], 1e-9)
        middles = middles + np.clip(solution[:, 1:] / flux[:, None], -_LARGEST_STEP, _LARGEST_STEP)
        paths = _paths_through(middles, rotation, pinhole)
        theirs = np.where((signal - flux @ images[:, 0]) * weight < _NOT_THEIRS, weight, 0.0)
    lights = streak_images(pixels, paths - patch.corner, patch.psf_sigma, False)[:, 0]
    flux = np.maximum(solved(equations(lights * theirs, target)), 0.0)
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
    # The 80th percentile is computed here, because `np.percentile` takes ten times as long.
    place = 0.8 * (len(weight) - 1)
    below, above = int(place), min(int(place) + 1, len(weight) - 1)
    ordered = np.partition(weight, (below, above))
    bright = ordered[below] + (place - below) * (ordered[above] - ordered[below])
    points = points[weight >= 0.5 * bright]
    middle = points.mean(axis=0)
    spread = (points - middle).T @ (points - middle) / len(points) if len(points) > 1 else np.eye(2)
    guess = line_of(middle, spread, LEAST_LINE_PX)
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
