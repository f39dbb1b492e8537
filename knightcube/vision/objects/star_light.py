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

PATHS_PER_LENGTH = 8
"""Number of trial star paths along a bright region, per length of a star path."""
# Maximum length of a chain of successive star streaks in a bright region, in path lengths.
_LONGEST_CHAIN = 5.0
# Number of segments of equal length into which an object's streak is divided to test its ends.
_SEGMENTS = 12
# Minimum length (px) of an object's streak whose ends are tested.
_LEAST_TESTED = 40.0
# Minimum brightness of the first and last segment of an object's streak, relative to its mean brightness.
_LEAST_END = 0.5
# Standard deviation of the relative brightness of a segment above which the segment is not tested.
_MOST_VAGUE = 0.2
# Spacing (px) of the Gaussians whose sum models a streak.
# The sum of Gaussians has a ripple of 0.2 % for a PSF of 0.6 px.
_STEP_PX = 1.0
# Number of points of a star's path from which the length of the path is computed.
_SAMPLES = 17
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
        per_length: number of trial star paths along the region, per length of a star path.

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
        per_length: int = PATHS_PER_LENGTH,
    ) -> None:
        stars = _star_paths(corners, rotation, pinhole, per_length)
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

    def lit_to_ends(self, ends: FloatArray) -> bool:
        """Return whether the streak of an object between `ends` (2, 2), px, is lit up to both ends.

        The stars and the object are fitted together. The streak is divided into segments, and the brightness
        of its first and last segment is measured where the noise and the light of stars permit.
        """
        length = float(np.linalg.norm(ends[1] - ends[0]))
        if length < _LEAST_TESTED:
            return True
        line = self._weighted_image(straight_path(ends))
        brightness, _ = _brightnesses(np.column_stack([self._stars, line]), self._target)
        left = self._target - self._stars @ brightness[:-1]
        along = (self._near - ends[0]) @ (ends[1] - ends[0]) / length**2
        segment = np.floor(along * _SEGMENTS).astype(np.int64)
        for which in (0, _SEGMENTS - 1):
            here = segment == which
            power = float(line[here] @ line[here])
            if power <= 0.0 or brightness[-1] <= 0.0:
                continue
            vague = 1.0 / (brightness[-1] * np.sqrt(power))
            if vague < _MOST_VAGUE and line[here] @ left[here] < _LEAST_END * brightness[-1] * power:
                return False
        return True

    def _weighted_image(self, path: FloatArray) -> FloatArray:
        """Return the weighted image of a streak of one count along `path` (m, 2), px, on p pixels, (p,)."""
        return streak_at(self._near, path, self._psf_sigma) * self._weight


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
    return np.asarray(star_paths(direction[None], rotation, np.array([start]), pinhole)[0])


def star_paths(
    directions: FloatArray, rotation: FloatArray, starts: FloatArray, pinhole: Pinhole
) -> FloatArray:
    """Return points (n, m, 2), px, along the paths of n stars during the exposure.

    Each star is at its direction `directions` (n, 3), camera axes, when it has covered the fraction `starts`
    (n,) of its path. All paths have as many points as the longest path needs.
    """
    whole = _rotated(directions, rotation, np.linspace(0.0, 1.0, _SAMPLES) - starts[:, None])
    places = pinhole.project(whole.reshape(-1, 3)).reshape(len(starts), _SAMPLES, 2)
    steps = np.diff(places, axis=1)
    lengths = np.hypot(steps[..., 0], steps[..., 1]).sum(axis=1)
    count = _steps(float(np.max(lengths[np.isfinite(lengths)], initial=0.0)))
    points = _rotated(directions, rotation, (np.arange(count) + 0.5) / count - starts[:, None])
    return pinhole.project(points.reshape(-1, 3)).reshape(len(starts), count, 2)


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


def _star_paths(
    corners: FloatArray, rotation: FloatArray, pinhole: Pinhole, per_length: int
) -> list[FloatArray]:
    """Return trial star paths: paths that begin or end at a corner, and paths along the whole region."""
    middle = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
    extent = float(np.linalg.norm(np.ptp(corners, axis=0)))
    one = star_path(pinhole.unit_vectors(middle[None])[0], rotation, 0.5, pinhole)
    chain = np.clip(extent / max(len(one) * _STEP_PX, 1.0), 1.0, _LONGEST_CHAIN)
    starts = 0.5 + 0.5 * np.linspace(-chain, chain, round(per_length * chain) + 1)
    anchors = np.concatenate([np.repeat(corners, 2, axis=0), np.repeat(middle[None], len(starts), axis=0)])
    starts = np.concatenate([np.tile([0.0, 1.0], len(corners)), starts])
    paths = star_paths(pinhole.unit_vectors(anchors), rotation, starts, pinhole)
    return list(paths[np.isfinite(paths).all(axis=(1, 2))])


def _rotated(directions: FloatArray, rotation: FloatArray, parts: FloatArray) -> FloatArray:
    """Return the directions (n, m, 3) of n stars after fractions `parts` (n, m) of the camera's rotation."""
    angle = float(np.linalg.norm(rotation))
    axis = rotation / angle if angle > 0.0 else rotation
    along = (directions @ axis)[:, None] * axis
    turned = (parts * angle)[..., None]
    out = np.cos(turned) * (directions - along)[:, None]
    out += np.sin(turned) * np.cross(directions, axis)[:, None]
    out += along[:, None]
    return np.asarray(out)


def _steps(length: float) -> int:
    return max(1, int(np.ceil(length / _STEP_PX)))


def _pixels_near(paths: list[FloatArray], reach: float, rows: int, columns: int) -> IntArray:
    """Return the pixels (x, y) within about `reach` px of any of the paths, as (p, 2)."""
    points = np.rint(np.concatenate(paths))
    r = int(np.ceil(reach))
    inside = np.all((points >= -r) & (points < (columns + r, rows + r)), axis=-1)
    points = points[inside].astype(np.int64)
    first = points.min(axis=0, initial=columns + rows) - r
    width, height = np.maximum(points.max(axis=0, initial=0) + r + 1 - first, 1)
    # A map of the points is combined with copies of itself that are shifted by all steps within a disc.
    lit = np.zeros((height, width), dtype=np.bool_)
    lit[points[:, 1] - first[1], points[:, 0] - first[0]] = True
    marked = np.zeros_like(lit)
    for down in range(-r, r + 1):
        for right in range(-r, r + 1):
            if down**2 + right**2 <= reach**2:
                onto = _shifted(height, down), _shifted(width, right)
                marked[onto] |= lit[_shifted(height, -down), _shifted(width, -right)]
    row, column = np.nonzero(marked)
    near = np.stack([column, row], axis=-1) + first
    return np.asarray(near[np.all((near >= 0) & (near < (columns, rows)), axis=-1)])


def _shifted(count: int, step: int) -> slice:
    """Return the part of an axis of `count` pixels that a map shifted by `step` pixels covers."""
    return slice(max(step, 0), count + min(step, 0))


# Number of points of a path between which the path is straight enough for the image of a streak.
_NODES = 33
# Minimum cosine between a nearly straight path and its chord.
_LEAST_AHEAD = 0.85
# Number of points of a path below which the image of a streak is the sum of the images of its points.
_LEAST_POINTS = 4


def _points_at(pixels: IntArray, points: FloatArray, sigma: float) -> FloatArray:
    """Return the image on the pixels (p, 2), (p,), of one count that the `points` (m, 2), px, share."""
    image = np.zeros(len(pixels))
    for point in points:
        near = np.flatnonzero(np.abs(pixels - point).max(axis=1) < _FARTHEST * sigma + 1.0)
        edges = (pixels[near] - point)[:, :, None] + np.array([-0.5, 0.5])
        image[near] += np.prod(np.diff(ndtr(edges / sigma), axis=2)[..., 0], axis=1) / len(points)
    return image


def streak_at(pixels: IntArray, path: FloatArray, sigma: float) -> FloatArray:
    """Return the image of a streak of one count along `path` (m, 2), px, on the given pixels (p, 2), (p,).

    The count is distributed evenly over the points of the path. The image is the product of the profiles
    across and along the path, which are blurred by a Gaussian with the standard deviation `sigma`, px, and by
    the pixel. The error is at most 2 % of the largest value. The image of a strongly bent path is the sum of
    the images of its points.
    """
    chord = path[-1] - path[0]
    length = float(np.linalg.norm(chord))
    steps = np.diff(path, axis=0)
    ahead = steps @ chord - _LEAST_AHEAD * length * np.hypot(steps[:, 0], steps[:, 1])
    if len(path) < _LEAST_POINTS or length == 0.0 or ahead.min() < 0.0:
        return _points_at(pixels, path, sigma)
    width = float(np.sqrt(sigma**2 + 1.0 / 12.0))
    tangent = chord / length
    normal = np.array([-tangent[1], tangent[0]])
    # The nodes are given in coordinates along and across the chord, and by their arc length.
    count = min(_NODES, len(path))
    place = np.arange(count) * (len(path) - 1) // (count - 1)
    nodes = path[place] - path[0]
    along, across = nodes @ tangent, nodes @ normal
    gaps = np.diff(along), np.diff(across)
    steps = np.hypot(*gaps)
    arc = np.concatenate([[0.0], np.cumsum(steps)])
    # Slope and spacing of the points are interpolated between the middles of adjacent nodes.
    middles, slope, spacing = along[:-1] + 0.5 * gaps[0], gaps[1] / gaps[0], steps / np.diff(place)
    away = pixels - path[0]
    u, v = away @ tangent, away @ normal
    room = _FARTHEST * width
    near = (u > -room - 1.0) & (u < length + room + 1.0)
    near &= (v > across.min() - room - 1.0) & (v < across.max() + room + 1.0)
    chosen = np.flatnonzero(near)
    u, v = u[chosen], v[chosen]
    bend, pace = np.interp(u, middles, slope), np.interp(u, middles, spacing)
    beyond = u - np.clip(u, along[0], along[-1])
    off = v - np.interp(u, along, across) - beyond * bend
    cosine = 1.0 / np.sqrt(1.0 + bend**2)
    n = off * cosine
    s = np.interp(u, along, arc) + (beyond + off * bend * cosine**2) / cosine
    light = np.exp(-0.5 * (n / width) ** 2) / (np.sqrt(2.0 * np.pi) * width * pace * len(path))
    # Only pixels near the ends of the streak are affected by the ends.
    first, last = s + 0.5 * spacing[0], arc[-1] + 0.5 * spacing[-1] - s
    for distance in (first, last):
        ending = np.flatnonzero(distance < _FARTHEST * width)
        light[ending] *= ndtr(distance[ending] / width)
    image = np.zeros(len(pixels))
    image[chosen] = light
    return image


@dataclass(frozen=True, slots=True, eq=False)
class _LineImage:
    """Image of a straight streak of one count on p pixels, with its derivatives by displacements of the ends.

    Attributes:
        pixels: flat indices of the pixels in the patch (p,).
        images: counts of the pixels, and their derivatives, 1/px, by displacements of the first end along
            and across the streak, and of the second end along and across the streak (5, p).
        axes: unit vectors along and across the streak (2, 2).
    """

    pixels: IntArray
    images: FloatArray
    axes: FloatArray


def _line_image(ends: FloatArray, columns: int, rows: int, sigma: float) -> _LineImage:
    """Return the image of a straight streak between two different `ends` (2, 2), px, near the streak."""
    width = float(np.sqrt(sigma**2 + 1.0 / 12.0))
    length = float(np.linalg.norm(ends[1] - ends[0]))
    tangent = (ends[1] - ends[0]) / length
    axes = np.array([tangent, [-tangent[1], tangent[0]]])
    low = np.clip(np.floor(ends.min(axis=0) - 4.0 * width).astype(int), 0, (columns, rows))
    high = np.clip(np.ceil(ends.max(axis=0) + 4.0 * width).astype(int) + 1, 0, (columns, rows))
    x, y = np.arange(low[0], high[0]), np.arange(low[1], high[1])
    n = (x - ends[0, 0]) * axes[1, 0] + ((y - ends[0, 1]) * axes[1, 1])[:, None]
    row, column = np.nonzero(np.abs(n) < 4.0 * width)
    n = n[row, column]
    s = (x[column] - ends[0, 0]) * axes[0, 0] + (y[row] - ends[0, 1]) * axes[0, 1]
    a, b = s / width, (s - length) / width
    bell_a, bell_b = (np.exp(-0.5 * each**2) / np.sqrt(2.0 * np.pi) for each in (a, b))
    profile = np.exp(-0.5 * (n / width) ** 2) / (np.sqrt(2.0 * np.pi) * width * length)
    covered = ndtr(a) - ndtr(b)
    whole = profile * covered
    # The moment of the image by the relative position along the streak is the share of the second end.
    second = profile * (s * covered + width * (bell_a - bell_b)) / length
    aside = n / width**2
    images = np.stack(
        [
            whole,
            whole / length - profile * bell_a / width,
            aside * (whole - second),
            profile * bell_b / width - whole / length,
            aside * second,
        ]
    )
    return _LineImage((y[row]) * columns + x[column], images, axes)


def spread_over(path: FloatArray, columns: int, rows: int, sigma: float) -> FloatArray:
    """Return the image (rows, columns) of a streak of one count along `path` (m, 2), px.

    The count is distributed evenly over the points of the path, and each point is blurred by a Gaussian with
    the standard deviation `sigma`, px.
    """
    x, y = _within_pixels(columns, path[:, 0], sigma), _within_pixels(rows, path[:, 1], sigma)
    return _added(x, y, x.values, y.values) / len(path)


def spread_with_slopes(
    path: FloatArray, shares: FloatArray, columns: int, rows: int, sigma: float
) -> list[FloatArray]:
    """Return the image of a streak of one count, and its derivatives, 1/px, by displacements of the path.

    Each of the k displacements moves each of the m points of the path by the given fraction `shares` (k, m)
    of a displacement. For each displacement of the path, the derivatives for a displacement along x and along
    y are returned.
    """
    x, y = _within_pixels(columns, path[:, 0], sigma), _within_pixels(rows, path[:, 1], sigma)
    dx, dy = (_slopes_within_pixels(each, path[:, k], sigma) for k, each in enumerate((x, y)))
    images = [_added(x, y, x.values, y.values)]
    for share in shares:
        images += [_added(x, y, share[:, None] * dx, y.values), _added(x, y, share[:, None] * x.values, dy)]
    return [image / len(path) for image in images]


@dataclass(frozen=True, slots=True, eq=False)
class _Profiles:
    """Profiles of m points on w adjacent pixels along one axis of `count` pixels.

    Attributes:
        count: number of pixels along the axis.
        first: index of the first of the w pixels of each point (m,), which may lie beside the axis.
        values: integrals of the point spread over the pixels (m, w).
    """

    count: int
    first: IntArray
    values: FloatArray


def _within_pixels(count: int, centres: FloatArray, sigma: float) -> _Profiles:
    """Return integrals of normal densities centred on `centres` (m,), px, over the nearest pixels."""
    reach = int(np.ceil(_FARTHEST * sigma))
    first = np.rint(centres).astype(np.int64) - reach
    edges = (first[:, None] + np.arange(2 * reach + 2) - 0.5 - centres[:, None]) / sigma
    return _Profiles(count, first, np.diff(ndtr(edges), axis=1))


def _slopes_within_pixels(profiles: _Profiles, centres: FloatArray, sigma: float) -> FloatArray:
    """Return the derivatives (m, w), 1/px, of the values of `profiles` with respect to the centres (m,)."""
    edges = profiles.first[:, None] + np.arange(profiles.values.shape[1] + 1) - 0.5 - centres[:, None]
    return np.asarray(-np.diff(np.exp(-0.5 * (edges / sigma) ** 2), axis=1) / (np.sqrt(2.0 * np.pi) * sigma))


def _added(x: _Profiles, y: _Profiles, across: FloatArray, down: FloatArray) -> FloatArray:
    """Return the image (rows, columns) of points that are each the product of two profiles.

    The values `across` (m, w) and `down` (m, w) belong to the pixels of the profiles `x` and `y`. Only the
    pixels near the points are computed, which matters for long streaks in large images.
    """
    width = across.shape[1]
    columns = x.count + 2 * width
    corner = (np.clip(y.first, -width, y.count) + width) * columns + np.clip(x.first, -width, x.count) + width
    step = (np.arange(width)[:, None] * columns + np.arange(width)).reshape(-1)
    light = (down[:, :, None] * across[:, None, :]).reshape(-1)
    rows = y.count + 2 * width
    image = np.bincount((corner[:, None] + step).reshape(-1), light, rows * columns).reshape(rows, columns)
    return np.asarray(image[width:-width, width:-width])


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
        middle = _brightest_star(patch, left, offsets)
        if middle is None:
            break
        middles.append(patch.corner + middle)
        middles, left = _fit_together(patch, middles, rotation, pinhole)
    return [_path_of(middle, rotation, pinhole) for middle in middles], left


def _path_of(middle: FloatArray, rotation: FloatArray, pinhole: Pinhole) -> FloatArray:
    return star_path(pinhole.unit_vectors(middle[None])[0], rotation, 0.5, pinhole)


# Number of points of a star's path at which all pixels of a patch are first tested for a star.
_FIRST_OFFSETS = 9


def _brightest_star(patch: Patch, left: FloatArray, offsets: FloatArray) -> FloatArray | None:
    """Return the position (x, y) in the patch of the brightest possible star, or None without a star.

    The brightness of a star centred on a pixel is at most the minimum of the smoothed image `left` (rows,
    columns) along the star's path, which is given by `offsets` (k, 2), px, from the pixel.
    """
    seen = patch.smoothed(left)
    rows, columns = seen.shape
    reach = int(np.ceil(np.abs(offsets).max())) + 1
    wide = np.pad(seen, reach, constant_values=patch.beyond)
    steps = np.rint(offsets).astype(int)
    # At the end of a streak, the smoothed brightness is half the brightness along the streak.
    factor = np.ones(len(steps))
    factor[[0, -1]] = 2.0
    threshold = _STAR_SIGMAS * patch.smoothed_noise
    first = np.unique(np.linspace(0, len(steps) - 1, _FIRST_OFFSETS).astype(int))
    possible = np.ones(seen.shape, dtype=np.bool_)
    for number in first:
        x, y = steps[number] + reach
        possible &= factor[number] * wide[y : y + rows, x : x + columns] >= threshold
    # Few pixels remain, on which the complete path is evaluated.
    row, column = np.nonzero(possible)
    least = np.full(len(row), np.inf)
    for (x, y), twice in zip(steps + reach, factor, strict=True):
        np.minimum(least, twice * wide[row + y, column + x], out=least)
    if not len(least) or least.max() < threshold:
        return None
    best = int(np.argmax(least))
    return np.array([column[best], row[best]], dtype=float)


def _fit_together(
    patch: Patch, middles: list[FloatArray], rotation: FloatArray, pinhole: Pinhole
) -> tuple[list[FloatArray], FloatArray]:
    """Return the path midpoints (2,), px, of stars fitted together, and the counts without these stars."""

    def images(middle: FloatArray) -> list[FloatArray]:
        path = _path_of(middle, rotation, pinhole)
        return patch.image_and_slopes(path, np.ones((1, len(path))))

    signal, pixel_weight = patch.signal.ravel(), patch.weight.ravel()
    theirs = np.ones(signal.shape, dtype=np.bool_)
    for _ in range(3):
        columns = np.stack([image.ravel() for middle in middles for image in images(middle)])
        # Pixels without light of the stars do not contribute to the normal equations.
        lit = np.flatnonzero(columns[::3].any(axis=0) & theirs)
        weight = pixel_weight[lit]
        solution = _solve((columns[:, lit] * weight).T, signal[lit] * weight).reshape(-1, 3)
        flux = np.maximum(solution[:, 0], 1e-9)
        middles = [
            middle + np.clip(step / part, -_LARGEST_STEP, _LARGEST_STEP)
            for middle, step, part in zip(middles, solution[:, 1:], flux, strict=True)
        ]
        theirs = (signal - flux @ columns[::3]) * pixel_weight < _NOT_THEIRS
    lights = np.stack([images(middle)[0].ravel() for middle in middles])
    lit = np.flatnonzero(lights.any(axis=0) & theirs)
    weight = pixel_weight[lit]
    flux = np.maximum(_solve((lights[:, lit] * weight).T, signal[lit] * weight), 0.0)
    return middles, (signal - flux @ lights).reshape(patch.signal.shape)


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
    rows, columns = patch.signal.shape
    weights, lights = patch.weight.reshape(-1), left.reshape(-1)
    for _ in range(_FITS):
        if is_point:
            images = patch.image_and_slopes(straight_path(ends), np.ones((1, 1)))
            lit, axes = np.flatnonzero(images[0] > 1e-3 * images[0].max()), np.eye(2)
            shape = np.stack([image.reshape(-1)[lit] for image in images])
        else:
            line = _line_image(ends - patch.corner, columns, rows, patch.psf_sigma)
            lit, shape, axes = line.pixels, line.images, line.axes
        weight = weights[lit]
        solution = _solve((shape * weight).T, lights[lit] * weight)
        if solution[0] <= 0.0:
            break
        steps = np.clip(solution[1:] / solution[0], -_LARGEST_STEP, _LARGEST_STEP).reshape(-1, 2)
        ends = ends + steps @ axes
        if np.abs(steps).max() < _CONVERGED or np.all(ends[0] == ends[1]) != is_point:
            break
    return ends


def _solve(images: FloatArray, target: FloatArray) -> FloatArray:
    """Return the least-squares coefficients (k,) of `images` (p, k), slightly regularised."""
    normal = images.T @ images
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    normal = normal / np.outer(scale, scale) + 1e-6 * np.eye(len(scale))
    return np.asarray(np.linalg.solve(normal, (images.T @ target) / scale) / scale)
