"""A region without the stars that run through it.

A star's streak is evenly bright from its one end to its other: it cannot be brighter than its faintest piece.
So the erosion of the region by the path of a star bounds what a star may have lit, from above; objects that
cross the streaks, and points on them, all but vanish in it. Stars are removed one by one, brightest first,
their places and brightnesses fitted together, pixels that are too bright for them left out. The brightest
thing left is then fitted as a point or a line.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from knightcube.astro.arrays import BoolArray, FloatArray
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.frame.regions import label_pixels, line_of
from knightcube.vision.objects.star_light import (
    SHAPE_ERROR,
    pixel_weights,
    spread_over,
    spread_with_slopes,
    star_path,
    straight_path,
)
from knightcube.vision.streaks.corners.segmentation import Regions
from knightcube.vision.streaks.corners.streaks import Segmented

# Room about a region, px: more than the point spread reaches.
_ROOM = 8
_MOST_STARS = 12
# Of the noise of the smoothed image.
_STAR_SIGMAS = 4.0
_LEFT_SIGMAS = 6.0
# A pixel so much brighter than the stars is not theirs, sigmas.
_NOT_THEIRS = 4.0
# px; the farthest that a fit moves in one step, and the step at which it has settled.
_FARTHEST = 1.0
_SETTLED_PX = 0.02
_LEAST_LINE_PX = 4.0
_WIDEST_GAP_PX = 12
_FITS = 8


@dataclass(frozen=True, slots=True, eq=False)
class Patch:
    """A region and room around it.

    Attributes:
        signal: (rows, columns) counts above the background, other regions' light included.
        weight: (rows, columns) 1/counts, of an error that grows with the light; 0 where the pixel clips.
        noise: counts, of a pixel without light.
        corner: (2,) px, (x, y) of its first pixel.
        mask: (rows, columns) which pixels are the region's.
        beyond: counts of the pixels above and below, left and right of it: infinite beyond the frame, where
            any star may go on.
        psf_sigma: px.
    """

    signal: FloatArray
    weight: FloatArray
    noise: float
    corner: FloatArray
    mask: BoolArray
    beyond: tuple[tuple[float, float], tuple[float, float]]
    psf_sigma: float

    def image(self, path: FloatArray) -> FloatArray:
        """Return the light (rows, columns) of one count spread evenly over `path` (m, 2) px."""
        rows, columns = self.signal.shape
        return spread_over(path - self.corner, columns, rows, self.psf_sigma)

    def image_and_slopes(self, path: FloatArray, shares: FloatArray) -> list[FloatArray]:
        """Return `image` of a path, and its changes with what moves it: see `spread_with_slopes`."""
        rows, columns = self.signal.shape
        return spread_with_slopes(path - self.corner, shares, columns, rows, self.psf_sigma)

    def smoothed(self, light: FloatArray) -> FloatArray:
        """Return `light` seen through the point spread again: the matched filter of a point."""
        return np.asarray(ndimage.gaussian_filter(light, self.psf_sigma, mode="constant"))

    @property
    def smoothed_noise(self) -> float:
        """The noise of a smoothed pixel without light, counts."""
        return self.noise / (2.0 * float(np.sqrt(np.pi)) * self.psf_sigma)


def cut_patch(
    segmented: Segmented, regions: Regions, index: int, psf_sigma: float, gain: float, saturation: float
) -> Patch:
    """Return region number `index` with room around it; pixels within 5 % of `saturation` weigh nothing."""
    rows, columns = segmented.signal.shape
    top, bottom, left, right = (int(edge) for edge in regions.boxes[index])
    top, left = max(top - _ROOM, 0), max(left - _ROOM, 0)
    bottom, right = min(bottom + _ROOM, rows), min(right + _ROOM, columns)
    signal = segmented.signal[top:bottom, left:right].astype(np.float64)
    weight = pixel_weights(signal, segmented.background, gain, saturation)
    mask = regions.labels[top:bottom, left:right] == regions.label[index]
    corner = np.array([left, top], dtype=float)
    above, below, before, after = (
        np.inf if off else 0.0 for off in (top == 0, bottom == rows, left == 0, right == columns)
    )
    beyond = ((above, below), (before, after))
    return Patch(signal, weight, segmented.background.typical_noise, corner, mask, beyond, psf_sigma)


def fit_stars(patch: Patch, rotation: FloatArray, pinhole: Pinhole) -> tuple[list[FloatArray], FloatArray]:
    """Return the paths (m, 2) px of the stars in a patch, and the rest of it (rows, columns)."""
    middles: list[FloatArray] = []
    left = patch.signal
    offsets = _offsets(patch, rotation, pinhole)
    while len(middles) < _MOST_STARS:
        eroded = _eroded(patch, left, offsets)
        row, column = np.unravel_index(int(np.argmax(eroded)), eroded.shape)
        if eroded[row, column] < _STAR_SIGMAS * patch.smoothed_noise:
            break
        middles.append(patch.corner + np.array([column, row], dtype=float))
        middles, left = _fit_together(patch, middles, rotation, pinhole)
    return [_path(middle, rotation, pinhole) for middle in middles], left


def brightest_left(patch: Patch, left: FloatArray) -> FloatArray | None:
    """Return the ends (2, 2) px of the brightest thing that the stars left in the region, None if nothing.

    A point's ends are one. Residuals of a bright star's badly known shape do not count.
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
    guess = _moment_line(np.stack([x, y], axis=-1).astype(float), seen[y, x])
    ends = _fit_line(patch, left, guess + patch.corner)
    longer = _grown(patch, seen, ends)
    return ends if longer is None else _fit_line(patch, left, longer)


def _moment_line(points: FloatArray, weight: FloatArray) -> FloatArray:
    """Return the ends (2, 2) px of the uniform line with the moments of the bright ones of pixels (n, 2)."""
    points = points[weight >= 0.5 * np.percentile(weight, 80.0)]
    spread = np.cov(points.T, bias=True) if len(points) > 1 else np.eye(2)
    return line_of(points.mean(axis=0), spread, _LEAST_LINE_PX)


def _grown(patch: Patch, seen: FloatArray, ends: FloatArray) -> FloatArray | None:
    """Return the ends (2, 2) px to which a line goes on beyond gaps, None where it does not.

    A star that crosses it, removed with what is below it, leaves a gap.
    """
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
    first = middle - _run(lit[middle::-1])
    last = middle + _run(lit[middle:])
    if at[first] > -_FARTHEST and at[last] < length + _FARTHEST:
        return None
    return np.asarray(ends[0] + np.array([[min(at[first], 0)], [max(at[last], length)]]) * along)


def _run(lit: BoolArray) -> int:
    """Return the index of the last one before a gap that is too wide."""
    places = np.flatnonzero(lit)
    if not len(places):
        return 0
    gaps = np.flatnonzero(np.diff(places) > _WIDEST_GAP_PX)
    return int(places[gaps[0]] if len(gaps) else places[-1])


def _fit_line(patch: Patch, left: FloatArray, ends: FloatArray) -> FloatArray:
    """Return the ends (2, 2) px fitted to the rest, from a guess; Gauss-Newton."""
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
        steps = np.clip(solution[1:] / solution[0], -_FARTHEST, _FARTHEST).reshape(-1, 2)
        ends = ends + steps
        if np.abs(steps).max() < _SETTLED_PX:
            break
    return ends


def _offsets(patch: Patch, rotation: FloatArray, pinhole: Pinhole) -> FloatArray:
    """Return the path (m, 2) px of a star about its middle, were that the patch's; the ends come along."""
    rows, columns = patch.signal.shape
    middle = patch.corner + 0.5 * np.array([columns - 1, rows - 1])
    path = _path(middle, rotation, pinhole)
    every = max(1, round(2.0 * patch.psf_sigma))
    # Steps are a pixel: half of one more reaches the star's true ends.
    chosen = np.unique(np.append(np.arange(0, len(path), every), len(path) - 1))
    return np.asarray(path[chosen] - middle)


def _eroded(patch: Patch, left: FloatArray, offsets: FloatArray) -> FloatArray:
    """Return the greatest brightness, as of the smoothed image, of a star whose middle each pixel is."""
    seen = patch.smoothed(left)
    rows, columns = seen.shape
    reach = int(np.ceil(np.abs(offsets).max())) + 1
    wide = np.pad(seen, reach, constant_values=patch.beyond)
    least = np.full(seen.shape, np.inf)
    for number, (x, y) in enumerate(np.rint(offsets).astype(int)):
        part = wide[reach + y : reach + y + rows, reach + x : reach + x + columns]
        # At its very end a streak is half as bright.
        np.minimum(least, 2.0 * part if number in (0, len(offsets) - 1) else part, out=least)
    return least


def _fit_together(
    patch: Patch, middles: list[FloatArray], rotation: FloatArray, pinhole: Pinhole
) -> tuple[list[FloatArray], FloatArray]:
    """Return the stars' middles (2,) px fitted together, and the rest; the last is new."""
    stars = np.zeros_like(patch.signal)
    theirs = np.ones(patch.signal.shape, dtype=np.bool_)
    for _ in range(3):
        columns, lights = [], []
        for middle in middles:
            path = _path(middle, rotation, pinhole)
            light, *slopes = patch.image_and_slopes(path, np.ones((1, len(path))))
            lights.append(light)
            columns += [light, *slopes]
        weight = np.where(theirs, patch.weight, 0.0).ravel()
        images = np.stack([column.ravel() * weight for column in columns], axis=1)
        solution = _solve(images, patch.signal.ravel() * weight).reshape(-1, 3)
        flux = np.maximum(solution[:, 0], 1e-9)
        moved = [
            middle + np.clip(step / part, -_FARTHEST, _FARTHEST)
            for middle, step, part in zip(middles, solution[:, 1:], flux, strict=True)
        ]
        middles = moved
        stars = np.tensordot(flux, np.stack(lights), axes=1)
        theirs = (patch.signal - stars) * patch.weight < _NOT_THEIRS
    lights = [patch.image(_path(middle, rotation, pinhole)) for middle in middles]
    weight = np.where(theirs, patch.weight, 0.0).ravel()
    images = np.stack([light.ravel() * weight for light in lights], axis=1)
    flux = np.maximum(_solve(images, patch.signal.ravel() * weight), 0.0)
    return middles, patch.signal - np.tensordot(flux, np.stack(lights), axes=1)


def _path(middle: FloatArray, rotation: FloatArray, pinhole: Pinhole) -> FloatArray:
    return star_path(pinhole.unit_vectors(middle[None])[0], rotation, 0.5, pinhole)


def _solve(images: FloatArray, target: FloatArray) -> FloatArray:
    """Return the least-squares coefficients (k,) of `images` (p, k); held a little where they are unknown."""
    normal = images.T @ images
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    normal = normal / np.outer(scale, scale) + 1e-6 * np.eye(len(scale))
    return np.asarray(np.linalg.solve(normal, (images.T @ target) / scale) / scale)
