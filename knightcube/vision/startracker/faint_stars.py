"""Identification of a frame in which too few stars are detected, from the light of faint stars.

If only two to four of the detected points are stars, their positions alone do not distinguish the true
attitude from a chance match. Two points that are stars determine a candidate attitude and an image scale for
each pair of guide stars that has the same distance and brightness ratio as the points. If a candidate is
correct, the image is brighter at the predicted positions of other guide stars than elsewhere, even where no
star is detected.

The significance is a likelihood ratio: the probability of the light at the predicted positions if there are
stars of the predicted brightness, divided by its probability if the positions are random. The distribution of
the light at random positions is that of all pixels of the frame, so that other points of light, such as hot
pixels and stars that are not in the catalogue, are included. At random positions, the likelihood ratio
exceeds r with a probability of at most 1/r (Markov's inequality). The expected number of chance matches is
the sum of these probabilities over the candidates. A candidate gets a larger share of the accepted number of
chance matches if few stars in the frame are brighter than its two guide stars, or if its points are bright.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from knightcube.astro.arrays import FloatArray, Image, IntArray
from knightcube.compiled import compiled_form_of, loop_helper
from knightcube.vision.background import estimate_background
from knightcube.vision.camera.lens import CameraModel, Pinhole
from knightcube.vision.startracker.attitude_fit import StarField
from knightcube.vision.startracker.index import SkyIndex
from knightcube.vision.startracker.survey import Surface
from knightcube.vision.startracker.verification import expected_stars, log10_choice

# Mean number, per field of view, of the brightest guide stars, from which the pairs are formed.
_PER_FIELD = 20.0
# Largest expected number of pairs of guide stars. A field of 4 x 3 deg has about this number of pairs.
# A narrow strip of the sky would have several times as many pairs, and their search would take a minute.
_MOST_PAIRS = 4e6
# Number of the brightest points, from which pairs are formed.
# Minimum distance between the points of a pair, as a fraction of the frame's diagonal.
_BRIGHTEST, _LEAST_APART = 5, 0.1
# Largest difference (mag) between the magnitude difference of two points and that of two guide stars.
_MOST_UNLIKE = 1.5
# Tolerance (px) of the distance of two points, because of their errors and of a distortion of the lens.
_APART_TOLERANCE = 1.0
# Largest ratio of the highest to the lowest image scale for which a search is made.
# Largest number of candidates of a frame; the search ends before this number would be exceeded.
_WIDEST_SCALE, _MOST_CANDIDATES = 1.15, 600_000
# Number of candidates in one batch, and number of further iterations that determine their image scales.
_TOGETHER, _SCALE_STEPS = 20_000, 3
# Number of the brightest neighbours of a guide star that are predicted for every candidate.
# Number of stars that are predicted for the `_FINALISTS` candidates with the highest likelihood ratios.
_NEIGHBOURS, _PREDICTED_STARS, _FINALISTS = 48, 60, 40
# Standard deviation (px) of the Gaussian that smooths the frame.
# Factor on the pixel values before smoothing, which makes the assumed rounding noise negligible.
_SMOOTHING, _FINER = 1.0, 100.0
# Lowest and highest signal of a pixel, in standard deviations of the noise.
# Signals outside this range are set to its nearer limit.
# Number of bins in this range.
_LEAST_LIGHT, _MOST_LIGHT, _LEVELS = -3.0, 13.0, 240
# Logarithms of the tabulated signal-to-noise ratios; stars below the lowest of them are omitted.
_LN_PREDICTED = np.linspace(math.log(0.5), math.log(20.0), 38)
_LN_STEP = float(_LN_PREDICTED[1] - _LN_PREDICTED[0])
# Trial attenuations, in steps of `_LN_STEP`, of all stars relative to the prediction from the two points.
# Stars are attenuated, for instance, if the camera does not respond linearly.
# All attenuations are equally likely.
_DIMMER = np.array([0, 4, 8, 12])
# Relative error of the predicted brightness of a star, because of its colour.
# Fraction of the stars that are not visible.
_BRIGHTNESS_ERROR, _UNSEEN = 0.35, 0.1
# Distances (px) from the frame's edge, and from the points of the pair, within which a star is omitted.
# Distance (px) within which the same pixels are possibly counted for two predicted stars.
_EDGE, _BESIDE, _OVERLAPPING = 4, 10, 5.0
# Standard deviation (px) of a predicted position.
# Side (px) of the square around a position, of which the highest signal is used.
_PLACE_SIGMA, _SQUARE = 0.5, 3


@dataclass(frozen=True, slots=True, eq=False)
class FrameLight:
    """The light of a frame at single positions, and its likelihood ratios for a star at these positions.

    Attributes:
        camera: ideal camera of `columns` x `rows` pixels in whose image the positions are given.
        signal: smoothed frame above the background, in standard deviations of its noise (rows, columns).
        level: index of the bin of the highest signal in the 3 x 3 pixels around each pixel (rows, columns),
            uint8. Pixels near the frame's edge, and pixels of the ideal image that the frame does not cover,
            have the value `_LEVELS` and are not used.
        log_ratio: logarithm of the likelihood ratio of a star to no star (r, `_LEVELS` + 1). Row k is for a
            star whose predicted signal-to-noise ratio has the logarithm `_LN_PREDICTED[k]`, and each column
            is for a bin.
    """

    camera: Pinhole
    signal: FloatArray
    level: npt.NDArray[np.uint8]
    log_ratio: FloatArray

    @classmethod
    def of(cls, pixels: Image, camera: CameraModel) -> FrameLight:
        """Return the light of a frame (rows, columns)."""
        from scipy.ndimage import gaussian_filter, maximum_filter  # noqa: PLC0415 - only in the vision worker

        smooth = gaussian_filter(_FINER * pixels.astype(np.float32), _SMOOTHING)
        found = estimate_background(smooth)
        factors = (Surface(values, found.shape).factors() for values in (found.level, found.noise))
        middle, noise = (down @ across for down, across in factors)
        signal = (smooth - middle) / noise
        step = _LEVELS / (_MOST_LIGHT - _LEAST_LIGHT)
        highest = maximum_filter(signal, _SQUARE)
        level = np.full(pixels.shape, _LEVELS, dtype=np.uint8)
        inner = slice(_EDGE, -_EDGE), slice(_EDGE, -_EDGE)
        level[inner] = np.clip((highest[inner] - _LEAST_LIGHT) * step, 0, _LEVELS - 1)
        # One is added to the count of each bin, so that the likelihood ratio of a unique signal is finite.
        count = np.bincount(level[inner].ravel(), minlength=_LEVELS) + 1.0
        ideal = camera.ideal
        if not isinstance(camera, Pinhole):
            grid = np.stack(np.meshgrid(np.arange(ideal.columns), np.arange(ideal.rows)), axis=-1)
            place = camera.project(ideal.unit_vectors(grid.reshape(-1, 2).astype(np.float64)))
            there = camera.contains(place)
            column, row = np.rint(np.where(there[:, None], place, 0.0)).astype(np.int64).T
            level = np.where(there, level[row, column], _LEVELS).astype(np.uint8).reshape(pixels.shape)
            signal = signal[row, column].reshape(pixels.shape)
        return cls(ideal, signal, level, _log_ratios(count / count.sum()))

    def without(self, points: FloatArray) -> npt.NDArray[np.uint8]:
        """Return `level` (rows, columns) with the pixels around points (n, 2), px, marked as not used."""
        level = self.level.copy()
        for x, y in np.rint(points).astype(np.int64).tolist():
            level[max(y - _BESIDE, 0) : y + _BESIDE + 1, max(x - _BESIDE, 0) : x + _BESIDE + 1] = _LEVELS
        return level


def _log_ratios(share: FloatArray) -> FloatArray:
    """Return the table `FrameLight.log_ratio` for the share of the pixels in each bin (`_LEVELS`,).

    Without a star, the light has the distribution of the whole frame. With a star, the mean increases towards
    the predicted signal-to-noise ratio. Some stars are not visible, for instance because they are behind a
    cloud.
    """
    from scipy.special import ndtr  # noqa: PLC0415

    edges = np.linspace(_LEAST_LIGHT, _MOST_LIGHT, _LEVELS + 1)
    half, lower = edges[1:][np.searchsorted(np.cumsum(share), (0.5, 0.16))].tolist()
    predicted = np.exp(_LN_PREDICTED)
    mean = (predicted**4 + max(half, 0.0) ** 4) ** 0.25
    spread = np.hypot(half - lower, _BRIGHTNESS_ERROR * predicted)
    limits = np.concatenate([[-np.inf], edges[1:-1], [np.inf]])
    with_star = np.diff(ndtr((limits - mean[:, None]) / spread[:, None]), axis=1)
    ratio = np.log((1.0 - _UNSEEN) * with_star / share + _UNSEEN)
    return np.pad(ratio, ((0, 0), (0, 1)))


@dataclass(frozen=True, slots=True, eq=False)
class LightMatch:
    """An attitude at which the light of faint stars is significant.

    Attributes:
        matrix: attitude matrix (3, 3), ICRS to camera axes.
        scale: factor by which the observed tangents x/z and y/z must be multiplied, because the true focal
            length differs from the assumed focal length.
        log10_chance: log10 of an upper bound on the expected number of chance matches.
    """

    matrix: FloatArray
    scale: float
    log10_chance: float


@dataclass(frozen=True, slots=True, eq=False)
class _GuidePairs:
    """Pairs of bright guide stars.

    Attributes:
        chord: chords (p,) between the stars of a pair, ascending.
        stars: indices (p, 2) of the two stars.
        neighbours: indices (n, `_NEIGHBOURS`) of the brightest stars that form a pair with each star, the
            brightest first; -1 for none.
    """

    chord: npt.NDArray[np.float32]
    stars: npt.NDArray[np.int32]
    neighbours: npt.NDArray[np.int32]


@lru_cache(maxsize=1)
def _guide_pairs(sky: SkyIndex, count: int, longest: float) -> _GuidePairs:
    """Return all pairs of the `count` brightest guide stars that are at most `longest`, rad, apart."""
    from scipy.spatial import cKDTree  # noqa: PLC0415

    direction = sky.stars.direction[:count]
    pairs = cKDTree(direction).query_pairs(2.0 * math.sin(0.5 * longest), output_type="ndarray")
    chord = _chord(direction[pairs])
    order = np.argsort(chord)
    pairs = pairs[order].astype(np.int32)
    star, near = np.concatenate([pairs, pairs[:, ::-1]]).T
    by_star = np.lexsort((near, star))
    star, near = star[by_star], near[by_star]
    place = np.arange(len(star)) - np.searchsorted(star, star)
    neighbours = np.full((count, _NEIGHBOURS), -1, dtype=np.int32)
    kept = place < _NEIGHBOURS
    neighbours[star[kept], place[kept]] = near[kept]
    return _GuidePairs(chord[order].astype(np.float32), pairs, neighbours)


def match_by_light(field: StarField, sky: SkyIndex, light: FrameLight, limit: float) -> LightMatch | None:
    """Return the attitude at which the light of faint stars is significant, or None.

    The points of the `field` are those of the frame, the brightest first. An attitude is accepted if the
    logarithm (base 10) of the expected number of chance matches is below `limit`.
    """
    lowest, highest = field.scale
    if len(field) < 2 or highest > _WIDEST_SCALE * lowest:
        return None
    search = _Search(field, sky, light)
    for order, (pair, stars) in enumerate(search.pairs()):
        found = search.best(pair, stars)
        if found is not None:
            chance = found.log10_chance + log10_choice(order)
            if chance < limit:
                return LightMatch(found.matrix, found.scale, chance)
    return None


class _Search:
    """The search for the attitude of one frame.

    Attributes:
        field: observed points of the frame.
        sky: index of the guide stars.
        light: light of the frame.
        points: positions (n, 2), px, of the points in the image of the ideal camera.
        guide: pairs of guide stars.
    """

    def __init__(self, field: StarField, sky: SkyIndex, light: FrameLight) -> None:
        self.field, self.sky, self.light = field, sky, light
        self.points = light.camera.project(field.direction)
        across, down = (width * field.scale[1] for width in field.half_width)
        area = 4.0 * math.atan(across) * math.atan(down)
        longest = 2.0 * math.atan(math.hypot(across, down))
        # Of all pairs of directions, the fraction (1 - cos(longest)) / 2 is at most `longest` apart.
        most = 2.0 * math.sqrt(_MOST_PAIRS / (1.0 - math.cos(longest)))
        count = min(int(_PER_FIELD * 4.0 * math.pi / area), int(most), len(sky.stars))
        self.guide = _guide_pairs(sky, count, longest)

    def pairs(self) -> Iterator[tuple[IntArray, IntArray]]:
        """Yield pairs of points (2,), the brightest first, and the similar pairs of guide stars (c, 2)."""
        total, diagonal = 0, math.hypot(self.light.camera.columns, self.light.camera.rows)
        inside = self.light.camera.contains(self.points, -1.0)
        magnitude, seen = self.sky.stars.magnitude, self.field.magnitude
        for other in range(1, min(_BRIGHTEST, len(self.points))):
            for one in range(other):
                apart = math.dist(self.points[one], self.points[other])
                if not (inside[one] and inside[other] and apart > _LEAST_APART * diagonal):
                    continue
                pair: IntArray = np.array([one, other])
                limits = _chord(_stretched(self.field.direction[pair], np.array(self.field.scale)))
                slack = 1.0 + _APART_TOLERANCE / apart
                chords = np.array([limits.min() / slack, limits.max() * slack])
                first, last = np.searchsorted(self.guide.chord, chords).tolist()
                stars: IntArray = self.guide.stars[first:last].astype(np.int64)
                stars = np.concatenate([stars, stars[:, ::-1]])
                if seen is not None:
                    ratio = magnitude[stars[:, 0]] - magnitude[stars[:, 1]] - (seen[one] - seen[other])
                    stars = stars[np.abs(ratio) < _MOST_UNLIKE]
                total += len(stars)
                if total > _MOST_CANDIDATES:
                    return
                yield pair, stars

    def best(self, pair: IntArray, stars: IntArray) -> LightMatch | None:
        """Return the most significant candidate for a pair of points, among c pairs of guide stars (c, 2)."""
        guide, magnitude = self.sky.stars.direction, self.sky.stars.magnitude
        column, row = np.rint(self.points[pair]).astype(np.int64).T
        bright = float(2.5 * np.log10(np.maximum(self.light.signal[row, column], 1.0)).mean())
        level = self.light.without(self.points[pair])
        given = (self.field.direction[pair], *self.field.scale, guide, magnitude)
        ratio, brighter = _evidence(
            *given,
            stars,
            self.guide.neighbours,
            bright,
            self.light.camera.focal_length,
            level,
            self.light.log_ratio,
        )
        promising = np.flatnonzero(ratio > 0.0)
        if not len(promising):
            return None
        # Each number of brighter stars, 0, 1, 2, ..., has a fixed share of the accepted chance matches.
        ranks, count = brighter[promising], np.bincount(brighter)
        chance = np.log10(count[ranks]) + np.array([log10_choice(rank) for rank in ranks.tolist()])
        first = np.argsort(chance - ratio[promising] / math.log(10.0), kind="stable")[:_FINALISTS]
        chosen = stars[promising[first]]
        matrices, scales = _attitudes(given[0], guide[chosen], *self.field.scale)
        best: LightMatch | None = None
        for k, (matrix, scale) in enumerate(zip(matrices, scales.tolist(), strict=True)):
            evidence = self._whole_evidence(matrix, scale, chosen[k], bright, level)
            value = float(chance[first[k]]) - evidence / math.log(10.0)
            if best is None or value < best.log10_chance:
                best = LightMatch(matrix, scale, value)
        return best

    def _whole_evidence(
        self, matrix: FloatArray, scale: float, two: IntArray, bright: float, level: npt.NDArray[np.uint8]
    ) -> float:
        """Return the logarithm of the likelihood ratio of one candidate from all stars in the frame."""
        across, down = (width * scale for width in self.field.half_width)
        stars = expected_stars(self.sky, matrix, (across, down), _PREDICTED_STARS)
        stars = stars[~np.isin(stars, two)]
        magnitude = self.sky.stars.magnitude
        place = _places(matrix, scale, self.sky.stars.direction[stars], self.light.camera.focal_length, level)
        faintest = float(magnitude[two].mean()) + bright
        ratio = _star_ratios(faintest - magnitude[stars], place, level, self.light.log_ratio)
        # A star is not used if the same pixels may be counted for a brighter star.
        close = np.linalg.norm(place[:, None] - place, axis=-1) < _OVERLAPPING
        ratio[np.any(close & np.tri(len(stars), k=-1, dtype=bool), axis=1)] = 0.0
        # For a detected point, the likelihood ratio also depends on its distance from the prediction.
        off = self.points - place[:, None]
        off = off[np.arange(len(stars)), np.argmin(np.linalg.norm(off, axis=-1), axis=1)]
        detected = np.all(np.abs(off) < 0.5 * _SQUARE, axis=1) & ratio.any(axis=1)
        density = _SQUARE**2 / (2.0 * math.pi * _PLACE_SIGMA**2)
        nearer = math.log(density) - 0.5 * np.sum(off**2, axis=1) / _PLACE_SIGMA**2
        return float(_mean_ratio(ratio + np.where(detected, nearer, 0.0)[:, None]))


def _evidence_numpy(
    seen: FloatArray,
    lowest: float,
    highest: float,
    guide: FloatArray,
    magnitude: FloatArray,
    stars: IntArray,
    neighbours: npt.NDArray[np.int32],
    bright: float,
    focal_length: float,
    level: npt.NDArray[np.uint8],
    log_ratio: FloatArray,
) -> tuple[FloatArray, IntArray]:
    """Return the logarithms of the likelihood ratios (c,) of candidates, and numbers of brighter stars (c,).

    A candidate assigns two guide stars to the two points with the directions `seen` (2, 3). All guide stars
    have the directions `guide` (n, 3), and those of the candidates have the indices `stars` (c, 2). The image
    scale is between `lowest` and `highest`. Only the `neighbours` (n, k) of the first guide star are
    predicted. On average, the two points are brighter by `bright` mag than a point with a signal-to-noise
    ratio of one. The brighter stars are the predicted stars in the frame that are brighter than the fainter
    of the two guide stars.
    """
    ratios, brighter = np.zeros(len(stars)), np.zeros(len(stars), dtype=np.int64)
    for begin in range(0, len(stars), _TOGETHER):
        part = slice(begin, begin + _TOGETHER)
        two = stars[part]
        matrix, scale = _attitudes(seen, guide[two], lowest, highest)
        near = neighbours[two[:, 0]]
        place = _places(matrix, scale[:, None, None], guide[near], focal_length, level)
        place[(near < 0) | (near == two[:, 1:])] = np.nan
        column, row = _pixels(place)
        fainter = magnitude[two].max(axis=1)[:, None]
        inside = level[row, column] < _LEVELS
        brighter[part] = np.count_nonzero(inside & (magnitude[near] < fainter), axis=1)
        above = magnitude[two].mean(axis=1)[:, None] + bright - magnitude[near]
        ratios[part] = _mean_ratio(_star_ratios(above, place, level, log_ratio))
    return ratios, brighter


@compiled_form_of(_evidence_numpy)
def _evidence(
    seen: FloatArray,
    lowest: float,
    highest: float,
    guide: FloatArray,
    magnitude: FloatArray,
    stars: IntArray,
    neighbours: npt.NDArray[np.int32],
    bright: float,
    focal_length: float,
    level: npt.NDArray[np.uint8],
    log_ratio: FloatArray,
) -> tuple[FloatArray, IntArray]:
    """See `_evidence_numpy`."""
    ratios, brighter = np.zeros(len(stars)), np.zeros(len(stars), dtype=np.int64)
    pair, wanted, matrix, total = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty(len(_DIMMER))
    for c in range(len(stars)):
        one, other = np.int64(stars[c, 0]), np.int64(stars[c, 1])
        for axis in range(3):
            wanted[axis, 0], wanted[axis, 1] = guide[one, axis], guide[other, axis]
        scale = _pair_attitude(seen, lowest, highest, pair, wanted, matrix)
        fainter = max(magnitude[one], magnitude[other])
        faintest = 0.5 * (magnitude[one] + magnitude[other]) + bright
        total[:] = 0.0
        for k in range(neighbours.shape[1]):
            star = np.int64(neighbours[one, k])
            if star < 0:
                break
            found = _LEVELS
            if star != other:
                found = _level_at(guide[star], matrix, focal_length / scale, level)
            if found == _LEVELS:
                continue
            brighter[c] += int(magnitude[star] < fainter)
            index = round((0.4 * math.log(10.0) * (faintest - magnitude[star]) - _LN_PREDICTED[0]) / _LN_STEP)
            for d in range(len(_DIMMER) if index >= 0 else 0):
                dimmed = min(max(index - _DIMMER[d], 0), len(_LN_PREDICTED) - 1)
                total[d] += log_ratio[dimmed, found]
        highest_total, mean = total.max(), 0.0
        for d in range(len(_DIMMER)):
            mean += math.exp(total[d] - highest_total) / len(_DIMMER)
        ratios[c] = highest_total + math.log(mean)
    return ratios, brighter


@loop_helper
def _pair_attitude(
    seen: FloatArray, lowest: float, highest: float, pair: FloatArray, wanted: FloatArray, matrix: FloatArray
) -> float:
    """Write the attitude matrix of a candidate to `matrix` (3, 3), and return its image scale.

    The attitude rotates the two guide stars, the first two columns of `wanted` (3, 3), to the directions
    `seen` (2, 3) of the points. The matrices `pair` and `wanted` are overwritten.
    """
    scale, chord = 1.0, 0.0
    for axis in range(3):
        chord += (wanted[axis, 0] - wanted[axis, 1]) ** 2
    for _ in range(_SCALE_STEPS + 1):
        scale = min(max(scale * math.sqrt(chord) / _stretch_pair(seen, scale, pair), lowest), highest)
    _stretch_pair(seen, scale, pair)
    _into_axes(pair)
    _into_axes(wanted)
    for i in range(3):
        for j in range(3):
            matrix[i, j] = pair[i, 0] * wanted[j, 0] + pair[i, 1] * wanted[j, 1] + pair[i, 2] * wanted[j, 2]
    return scale


@loop_helper
def _level_at(star: FloatArray, matrix: FloatArray, focal_length: float, level: npt.NDArray[np.uint8]) -> int:
    """Return the level at the predicted position of a star, or `_LEVELS` if it is outside the image."""
    rows, columns = level.shape
    along = matrix[2, 0] * star[0] + matrix[2, 1] * star[1] + matrix[2, 2] * star[2]
    if along <= 0.0:
        return _LEVELS
    right = focal_length * (matrix[0, 0] * star[0] + matrix[0, 1] * star[1] + matrix[0, 2] * star[2]) / along
    below = focal_length * (matrix[1, 0] * star[0] + matrix[1, 1] * star[1] + matrix[1, 2] * star[2]) / along
    column, row = round(right + 0.5 * (columns - 1)), round(below + 0.5 * (rows - 1))
    if column < 0 or row < 0 or column >= columns or row >= rows:
        return _LEVELS
    return int(level[row, column])


@loop_helper
def _stretch_pair(seen: FloatArray, scale: float, pair: FloatArray) -> float:
    """Write two unit vectors, with x/z and y/z multiplied by `scale`, to `pair`, and return their chord."""
    for k in range(2):
        x, y, z = seen[k, 0] * scale, seen[k, 1] * scale, seen[k, 2]
        norm = math.sqrt(x * x + y * y + z * z)
        pair[0, k], pair[1, k], pair[2, k] = x / norm, y / norm, z / norm
    dx, dy, dz = pair[0, 0] - pair[0, 1], pair[1, 0] - pair[1, 1], pair[2, 0] - pair[2, 1]
    return math.sqrt(dx * dx + dy * dy + dz * dz)


@loop_helper
def _into_axes(pair: FloatArray) -> None:
    """Replace the columns of a matrix by the axes that `_axes` returns for its first two columns."""
    for k in range(3):
        middle, across = pair[k, 0] + pair[k, 1], pair[k, 0] - pair[k, 1]
        pair[k, 0], pair[k, 1] = middle, across
    for k in range(2):
        norm = math.sqrt(pair[0, k] ** 2 + pair[1, k] ** 2 + pair[2, k] ** 2)
        for axis in range(3):
            pair[axis, k] /= norm
    for axis in range(3):
        after, last = (axis + 1) % 3, (axis + 2) % 3
        pair[axis, 2] = pair[after, 0] * pair[last, 1] - pair[last, 0] * pair[after, 1]


def _attitudes(
    seen: FloatArray, guide: FloatArray, lowest: float, highest: float
) -> tuple[FloatArray, FloatArray]:
    """Return attitude matrices (c, 3, 3) and image scales (c,) of candidates.

    The two points have the directions `seen` (2, 3), and the guide stars the directions `guide` (c, 2, 3).
    """
    wanted, scale = _chord(guide), np.ones(len(guide))
    for _ in range(_SCALE_STEPS + 1):
        scale = np.clip(scale * wanted / _chord(_stretched(seen, scale)), lowest, highest)
    return _axes(_stretched(seen, scale)) @ _axes(guide).swapaxes(1, 2), scale


def _places(
    matrix: FloatArray,
    scale: float | FloatArray,
    guide: FloatArray,
    focal_length: float,
    level: npt.NDArray[np.uint8],
) -> FloatArray:
    """Return the predicted positions (..., n, 2), px, of guide stars (..., n, 3); NaN outside the image."""
    toward = guide @ matrix.swapaxes(-1, -2)
    along = np.where(toward[..., 2:] > 0.0, toward[..., 2:], np.nan)
    size = np.array(level.shape[::-1])
    place = focal_length / scale * toward[..., :2] / along + 0.5 * (size - 1)
    rounded = np.rint(place)
    inside = np.all((rounded >= 0) & (rounded < size), axis=-1)
    return np.where(inside[..., None], place, np.nan)


def _pixels(place: FloatArray) -> tuple[IntArray, IntArray]:
    """Return the columns and rows (...) of positions (..., 2), px; NaN gives column 0 and row 0."""
    column, row = np.moveaxis(np.rint(np.where(np.isnan(place), 0.0, place)).astype(np.int64), -1, 0)
    return column, row


def _star_ratios(
    above: FloatArray, place: FloatArray, level: npt.NDArray[np.uint8], log_ratio: FloatArray
) -> FloatArray:
    """Return the logarithms of the likelihood ratios (..., d) of stars, for d attenuations `_DIMMER`.

    The stars (...) are brighter by `above` mag than a star with a signal-to-noise ratio of one. The
    logarithms are zero for stars that are too faint.
    """
    step = np.rint((0.4 * math.log(10.0) * above - _LN_PREDICTED[0]) / _LN_STEP).astype(np.int64)
    column, row = _pixels(place)
    dimmed = np.clip(step[..., None] - _DIMMER, 0, len(_LN_PREDICTED) - 1)
    ratio = log_ratio[dimmed, level[row, column][..., None]]
    return np.where((step >= 0)[..., None], ratio, 0.0)


def _mean_ratio(ratio: FloatArray) -> FloatArray:
    """Return the logarithm of the mean likelihood ratio over d attenuations, from logarithms (..., n, d)."""
    return np.asarray(np.logaddexp.reduce(ratio.sum(axis=-2), axis=-1) - math.log(len(_DIMMER)))


def _stretched(seen: FloatArray, scale: FloatArray) -> FloatArray:
    """Return two unit vectors (2, 3) with x/z and y/z multiplied by the scales (c,), as (c, 2, 3)."""
    longer = seen * np.stack([scale, scale, np.ones_like(scale)], axis=-1)[:, None]
    return np.asarray(longer / np.linalg.norm(longer, axis=-1, keepdims=True))


def _chord(pair: FloatArray) -> FloatArray:
    """Return the chords (c,) between pairs of unit vectors (c, 2, 3)."""
    return np.asarray(np.linalg.norm(pair[:, 0] - pair[:, 1], axis=-1))


def _axes(pair: FloatArray) -> FloatArray:
    """Return matrices (c, 3, 3) of three orthonormal axes (columns) that rotate with a pair of unit vectors.

    The pairs are (c, 2, 3). The first axis lies midway between the two vectors, and the second is parallel to
    their difference.
    """
    middle, across = pair[:, 0] + pair[:, 1], pair[:, 0] - pair[:, 1]
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    return np.stack([middle, across, np.cross(middle, across)], axis=-1)
