"""Whether stars explain the light of a region, or it takes an object's streak.

Both are sums of streaks of constant brightness with the camera's point spread: stars along the paths that the
rotation gives them, an object from one end straight to the other, straight either in the image or among the
stars, which a turn about the boresight bends. Brightnesses by non-negative least squares; the sum of squares
decides. Streaks of two stars that overlap, lie side by side or follow each other, and the pieces of a faint
star's streak are the light of stars; what no star path covers, or what ends where a star would go on, is not.

A region without the stars that run through it.

A star's streak is evenly bright from its one end to its other: it cannot be brighter than its faintest piece.
So the erosion of the region by the path of a star bounds what a star may have lit, from above; objects that
cross the streaks, and points on them, all but vanish in it. Stars are removed one by one, brightest first,
their places and brightnesses fitted together, pixels that are too bright for them left out. The brightest
thing left is then fitted as a point or a line.
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

# Star paths along a region are tried at every eighth of a path; a longer chain of stars is a rarity.
_PATHS_PER_LENGTH = 8
_LONGEST_CHAIN = 5.0
# A streak is a row of Gaussians this far apart: its ripple is 0.2 % at a point spread of 0.6 px.
_STEP_PX = 1.0
# Light farther than this from all paths is ignored: in sigmas of the point spread.
_REACH = 3.0
# A point's light ends here, in sigmas: 6e-7 of it lies beyond.
_FARTHEST = 5.0
# The shape of a bright streak is known to this part of its brightness: ends, point spread, evenness.
SHAPE_ERROR = 0.1


@dataclass(frozen=True, slots=True)
class Explanation:
    """How well an object among the stars explains the pixels.

    Attributes:
        chi_square: of the best sum of star streaks and the object's.
        misfit, misfit_of_stars: chi-square per pixel along the object's streak, with it and without.
        flux: counts of the object's streak.
    """

    chi_square: float
    misfit: float
    misfit_of_stars: float
    flux: float


class StarLight:
    """The pixels about one region, and the stars that may have lit them.

    Attributes:
        chi_square: of the best sum of star streaks.
        pixels: how many there are.
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
        """Take the pixels along all star paths and all lines between the `corners` (k, 2) px, k at least 2.

        Stars may start or stop at each corner and pass the corners' middle anywhere on their path. Pixels
        within 5 % of `saturation` counts weigh nothing; `gain` is in e-/count. Stars on `known` paths (m, 2)
        px may have lit them as well. Raises FlightError when the brightnesses cannot be solved for.
        """
        stars = _star_paths(corners, rotation, pinhole)
        lines = [
            straight_path(corners[list(pair)]) for pair in itertools.combinations(range(len(corners)), 2)
        ]
        rows, columns = segmented.signal.shape
        self._psf_sigma, self._rotation, self._pinhole = psf_sigma, rotation, pinhole
        self._near = _pixels_near([*stars, *lines], _REACH * psf_sigma, rows, columns)
        signal = segmented.signal[self._near[:, 1], self._near[:, 0]].astype(np.float64)
        self._weight = pixel_weights(signal, segmented.background, gain, saturation)
        self._target = signal * self._weight
        self._stars = np.stack([self._weighted_image(path) for path in (*stars, *known)], axis=1)
        self.pixels = len(self._near)
        self._brightness, self.chi_square = _brightnesses(self._stars, self._target)

    def explain(self, ends: FloatArray) -> Explanation:
        """Return how well an object between `ends` (2, 2) does among the stars, by its better path."""
        paths = straight_path(ends), path_among_stars(ends, self._rotation, self._pinhole)
        return min((self._explain_path(path) for path in paths), key=lambda found: found.chi_square)

    def _explain_path(self, path: FloatArray) -> Explanation:
        line = self._weighted_image(path)
        images = np.column_stack([self._stars, line])
        found, chi_square = _brightnesses(images, self._target)
        along = line > 0.05 * line.max()
        if not along.any():
            return Explanation(chi_square, np.inf, np.inf, 0.0)
        missed = (self._target - images @ found)[along]
        by_stars = (self._target - self._stars @ self._brightness)[along]
        return Explanation(
            chi_square,
            float(missed @ missed) / len(missed),
            float(by_stars @ by_stars) / len(missed),
            float(found[-1]),
        )

    def _weighted_image(self, path: FloatArray) -> FloatArray:
        """Return the light (p,) over its error that one count along `path` (m, 2) gives to the pixels."""
        (left, top), (right, bottom) = self._near.min(axis=0), self._near.max(axis=0)
        light = spread_over(path - (left, top), right - left + 1, bottom - top + 1, self._psf_sigma)
        return np.asarray(light[self._near[:, 1] - top, self._near[:, 0] - left] * self._weight)


def pixel_weights(signal: FloatArray, background: Background, gain: float, saturation: float) -> FloatArray:
    """Return 1/error of pixels with `signal` counts above `background`; 0 within 5 % of `saturation` counts.

    The error holds the noise, the photons (`gain` in e-/count) and the badly known shape of bright streaks.
    """
    light = np.maximum(signal, 0.0)
    clipped = signal + background.typical_level >= 0.95 * saturation
    error = np.sqrt(background.typical_noise**2 + light / gain + (SHAPE_ERROR * light) ** 2)
    return np.where(clipped, 0.0, 1.0 / error)


def _brightnesses(images: FloatArray, target: FloatArray) -> tuple[FloatArray, float]:
    """Return the non-negative brightness (k,) of each column of `images` (p, k), and the chi-square.

    Raises FlightError when the solver gives up.
    """
    try:
        brightness, residual = nnls(images, target, maxiter=30 * images.shape[1])
    except RuntimeError as error:
        raise FlightError(f"brightnesses of {images.shape[1]} streaks: {error}") from error
    return brightness, float(residual**2)


def star_path(direction: FloatArray, rotation: FloatArray, start: float, pinhole: Pinhole) -> FloatArray:
    """Return the pixels (m, 2) of a star that is at `direction` (3,) after the part `start` of its path."""
    whole = pinhole.project(_turned(direction, rotation, np.linspace(-start, 1.0 - start, 17)))
    length = float(np.sum(np.linalg.norm(np.diff(whole, axis=0), axis=-1)))
    steps = _steps(length)
    parts = (np.arange(steps) + 0.5) / steps - start
    return pinhole.project(_turned(direction, rotation, parts))


def straight_path(ends: FloatArray) -> FloatArray:
    """Return pixels (m, 2) evenly along the line in the image between two ends (2, 2)."""
    steps = _steps(float(np.linalg.norm(ends[1] - ends[0])))
    parts = (np.arange(steps)[:, None] + 0.5) / steps
    return np.asarray(ends[0] + parts * (ends[1] - ends[0]))


def path_among_stars(ends: FloatArray, rotation: FloatArray, pinhole: Pinhole) -> FloatArray:
    """Return pixels (m, 2) between two ends (2, 2) of what moves straight and evenly among the stars.

    In the order of time that needs the slower motion.
    """
    vectors = pinhole.unit_vectors(ends)
    both = [carried_to_middle(pair, rotation) for pair in (vectors, vectors[::-1])]
    first, last = min(both, key=lambda pair: float(np.linalg.norm(pair[1] - pair[0])))
    steps = _steps(float(np.linalg.norm(ends[1] - ends[0])))
    parts = (np.arange(steps) + 0.5) / steps
    at = first + parts[:, None] * (last - first)
    turns = attitude_matrix(from_rotation_vector((parts - 0.5)[:, None] * rotation))
    return pinhole.project(np.einsum("mij,mj->mi", turns, at))


def carried_to_middle(vectors: FloatArray, rotation: FloatArray) -> FloatArray:
    """Return where stars seen at `vectors` (2, 3) at the start and at the end are at mid-exposure (2, 3)."""
    turns = attitude_matrix(from_rotation_vector(np.array([[0.5], [-0.5]]) * rotation))
    return np.asarray(np.einsum("mij,mj->mi", turns, vectors))


def _star_paths(corners: FloatArray, rotation: FloatArray, pinhole: Pinhole) -> list[FloatArray]:
    """Return the star paths worth trying: from and to each corner, and all along the region."""
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


def _turned(direction: FloatArray, rotation: FloatArray, parts: FloatArray) -> FloatArray:
    """Return where a fixed star goes (m, 3) after parts (m,) of the camera's rotation."""
    return np.asarray(attitude_matrix(from_rotation_vector(parts[:, None] * rotation)) @ direction)


def _steps(length: float) -> int:
    return max(1, int(np.ceil(length / _STEP_PX)))


def _pixels_near(paths: list[FloatArray], reach: float, rows: int, columns: int) -> IntArray:
    """Return the pixels (p, 2), (x, y), within about `reach` px of any of the paths."""
    points = np.rint(np.concatenate(paths))
    r = int(np.ceil(reach))
    inside = np.all((points >= -r) & (points < (columns + r, rows + r)), axis=-1)
    x, y = np.meshgrid(np.arange(-r, r + 1), np.arange(-r, r + 1))
    disc = np.stack([x[x**2 + y**2 <= reach**2], y[x**2 + y**2 <= reach**2]], axis=-1)
    points = points[inside].astype(np.int64)
    # On a map of the frame's part, with room beyond the frame: no sorting.
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
    """Return one count spread evenly over `path` (m, 2) px and by a Gaussian, as (rows, columns) get it."""
    x, y = _within_pixels(columns, path[:, 0], sigma), _within_pixels(rows, path[:, 1], sigma)
    return np.asarray(y.T @ x / len(path))


def spread_with_slopes(
    path: FloatArray, shares: FloatArray, columns: int, rows: int, sigma: float
) -> list[FloatArray]:
    """Return what `spread_over` does, and its change with x and with y, 1/px, of what moves the path.

    Each row of `shares` (k, m) is one thing that moves, and by how much of it each point does; two slopes of
    each follow the light.
    """
    x, y = _within_pixels(columns, path[:, 0], sigma), _within_pixels(rows, path[:, 1], sigma)
    dx, dy = _slopes_within(columns, path[:, 0], sigma), _slopes_within(rows, path[:, 1], sigma)
    images = [y.T @ x]
    for share in shares:
        images += [y.T @ (share[:, None] * dx), dy.T @ (share[:, None] * x)]
    return [image / len(path) for image in images]


def _within_pixels(count: int, centres: FloatArray, sigma: float) -> FloatArray:
    """Return the parts (m, count) of normal densities about `centres` (m,) that fall on each pixel."""
    first, edges = _edges(centres, sigma)
    return _placed(np.diff(ndtr(edges), axis=1), first, count)


def _slopes_within(count: int, centres: FloatArray, sigma: float) -> FloatArray:
    """Return how `_within_pixels` changes with the centres, 1/px."""
    first, edges = _edges(centres, sigma)
    density = np.exp(-0.5 * edges**2) / (np.sqrt(2.0 * np.pi) * sigma)
    return _placed(-np.diff(density, axis=1), first, count)


def _edges(centres: FloatArray, sigma: float) -> tuple[IntArray, FloatArray]:
    """Return the first pixel (m,) near each centre, and the edges (m, k) of the pixels there, in sigmas."""
    reach = int(np.ceil(_FARTHEST * sigma))
    first = np.rint(centres).astype(np.int64) - reach
    edges = first[:, None] + np.arange(2 * reach + 2) - 0.5
    return first, (edges - centres[:, None]) / sigma


def _placed(values: FloatArray, first: IntArray, count: int) -> FloatArray:
    """Return `values` (m, k) of the pixels from `first` (m,) on as (m, count), those on the frame."""
    number, width = values.shape
    start = np.clip(first, -width, count) + width
    placed = np.zeros((number, count + 2 * width))
    placed[np.arange(number)[:, None], start[:, None] + np.arange(width)] = values
    return placed[:, width : width + count]


# Room about a region, px: more than the point spread reaches.
_ROOM = 8
_MOST_STARS = 12
# Of the noise of the smoothed image.
_STAR_SIGMAS = 4.0
_LEFT_SIGMAS = 6.0
# A pixel so much brighter than the stars is not theirs, sigmas.
_NOT_THEIRS = 4.0
# px; the farthest that a fit moves in one step, and the step at which it has settled.
_FARTHEST_STEP = 1.0
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
    if at[first] > -_FARTHEST_STEP and at[last] < length + _FARTHEST_STEP:
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
        steps = np.clip(solution[1:] / solution[0], -_FARTHEST_STEP, _FARTHEST_STEP).reshape(-1, 2)
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
            middle + np.clip(step / part, -_FARTHEST_STEP, _FARTHEST_STEP)
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
