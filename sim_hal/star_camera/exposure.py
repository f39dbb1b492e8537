"""The light of point sources, integrated along their paths with a global or a rolling shutter.

Sease renders a still image for each of many short steps of the exposure and adds the images. Here each path
is divided into spans of a few pixels. In a span the light is integrated over time by Gauss-Legendre
quadrature. The samples are cheap because the point spread function is separable: the light of all samples on
a small patch of pixels is one product of two thin matrices, (down, samples) by (samples, across).

With a rolling shutter, row r exposes r line times later than row 0: light on row r at time t counts if u = t
- start - r * line_time is within the exposure. A source is followed in u along its own path: at u it is at
row y, at the time start + u + y * line_time. The neighbouring rows are exposed a few line times earlier or
later, when the source was at another point of its path, so the image of the source is sheared and stretched.
The quadrature is as smooth as for a global shutter, because no sample is at the edge of the shutter.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.special import ndtr

from hal.interfaces.errors import OutOfRange
from knightcube.astro.arrays import BoolArray, Float32Array, FloatArray, IntArray
from knightcube.vision.camera.lens import Pinhole

DEVICE = "star camera model"

STEPS = 256
"""Table entries per pixel; interpolation between entries errs by less than 1e-5 of the peak."""


@dataclass(frozen=True, slots=True)
class PointSpread:
    """A separable point spread function.

    Attributes:
        profile: fraction of the light on a pixel, by the distance (px) of its centre from the point.
        reach: distance (whole px) from the point's pixel beyond which no light falls.
        patch: length (px) of a path that is integrated at once.
        quadrature: number of samples for a path, by its length (px).
    """

    profile: Callable[[FloatArray], FloatArray]
    reach: int
    patch: float
    quadrature: Callable[[float], int]

    def shares(self, positions: FloatArray, size: int) -> Float32Array:
        """Return the light (..., size) on pixels 0 .. size - 1 in a line, of points at `positions` (...)."""
        table, rise = _table(self, size)
        entry, beyond = _entries(positions)
        shares = table.take(entry, axis=0)
        shares += beyond[..., None] * rise.take(entry, axis=0)
        return np.asarray(shares)

    def own_shares(self, positions: FloatArray) -> Float32Array:
        """Return the light (..., size) on pixels 0 .. size - 1, each from its own point of `positions`."""
        pixel = np.arange(positions.shape[-1])
        table, rise = _table(self, len(pixel))
        entry, beyond = _entries(positions)
        return np.asarray(table[entry, pixel] + beyond * rise[entry, pixel])


@lru_cache(maxsize=8)
def integrated_gaussian(sigma: float) -> PointSpread:
    """Return a Gaussian of `sigma` px integrated over each pixel."""

    def profile(offset: FloatArray) -> FloatArray:
        return np.asarray(ndtr((offset + 0.5) / sigma) - ndtr((offset - 0.5) / sigma))

    def quadrature(length: float) -> int:
        # Gauss-Legendre converges at about one sample a sigma; this many leave 1e-4 of the streak's peak.
        return 1 if length < 0.02 * sigma else math.ceil(1.5 + 0.95 * length / sigma)

    return PointSpread(profile, math.ceil(4.0 * sigma), max(4.0, 8.0 * sigma), quadrature)


@lru_cache(maxsize=8)
def bilinear_gaussian(sigma: float) -> PointSpread:
    """Return the spread of the thesis: light on the nearest pixels (2.5, 2.6), blurred by a kernel (2.9)."""
    taps = np.exp(-0.5 * (np.array([-1.0, 0.0, 1.0]) / sigma) ** 2)
    taps /= taps.sum()

    def profile(offset: FloatArray) -> FloatArray:
        distance = np.abs(np.asarray(offset)[..., None] - np.array([-1.0, 0.0, 1.0]))
        return np.asarray(np.clip(1.0 - distance, 0.0, None) @ taps)

    def quadrature(length: float) -> int:
        # The profile has corners, so samples much closer than a pixel are needed.
        return 1 if length < 1e-3 else math.ceil(2.0 + 8.0 * length)

    return PointSpread(profile, 2, 8.0, quadrature)


def _entries(positions: FloatArray) -> tuple[IntArray, Float32Array]:
    """Return the table entry before each of `positions`, and the fraction (0 .. 1) to the next entry."""
    scaled = positions * STEPS
    entry = scaled.astype(np.intp)
    return entry, (scaled - entry).astype(np.float32)


@lru_cache(maxsize=32)
def _table(spread: PointSpread, size: int) -> tuple[Float32Array, Float32Array]:
    """Return the shares (size * STEPS + 1, size) of points 1/STEPS px apart, and their rises to the next."""
    positions = np.arange(size * STEPS + 2) / STEPS
    table = spread.profile(np.arange(size) - positions[:, None])
    # Normalised, so that the light beyond the reach is not lost.
    shares = np.asarray(table / table.sum(axis=1, keepdims=True), dtype=np.float32)
    return shares[:-1], np.diff(shares, axis=0)


Vectors = Callable[[FloatArray], FloatArray]
"""Directions (m, n, 3) of n sources in the camera frame at times (m,)."""


@dataclass(frozen=True, slots=True)
class Span:
    """A short part of the exposure and its samples (m,); it consists of segments of smooth motion.

    Attributes:
        starts: s, start of the segment of each sample.
        ends: s, end of the segment of each sample.
        nodes: position of each sample in its segment, 0 .. 1.
        weights: quadrature weight of each sample; those of a segment add up to 1.
    """

    starts: FloatArray
    ends: FloatArray
    nodes: FloatArray
    weights: FloatArray

    @property
    def times(self) -> FloatArray:
        """Times (m,) of the samples (s)."""
        return self.starts + self.nodes * (self.ends - self.starts)

    @property
    def durations(self) -> FloatArray:
        """Time (m,) that each sample represents (s)."""
        return self.weights * (self.ends - self.starts)


def expose(
    image: Float32Array,
    camera: Pinhole,
    spread: PointSpread,
    vectors: Vectors,
    electrons: FloatArray,
    knots: FloatArray,
) -> None:
    """Add to `image` (rows, columns) the e- of sources that move smoothly between `knots` (j,) s.

    `electrons` (n,) is the light of each source over the whole exposure, `knots[0]` to `knots[-1]`.
    """
    rate = electrons / (knots[-1] - knots[0])
    for span in spans(knots, path_lengths(camera, spread, vectors(knots)), spread):
        points = camera.project(vectors(span.times))
        _deposit(image, spread, points, span.durations[:, None] * rate)


def spans(knots: FloatArray, lengths: FloatArray, spread: PointSpread) -> Iterator[Span]:
    """Divide the exposure into spans in which no path is longer than a patch.

    `lengths` (j - 1,) px is the longest path between consecutive `knots` (j,) s. Long intervals are divided
    and short ones combined; a segment never crosses a knot.
    """
    segments: list[tuple[float, float, FloatArray, FloatArray]] = []
    covered = 0.0
    for start, end, length in zip(knots[:-1].tolist(), knots[1:].tolist(), lengths.tolist(), strict=True):
        count = max(1, math.ceil(length / spread.patch))
        step, advance = (end - start) / count, length / count
        nodes, weights = _gauss_legendre(spread.quadrature(advance))
        for number in range(count):
            if segments and covered + advance > spread.patch:
                yield _span(segments)
                segments, covered = [], 0.0
            segments.append((start + number * step, start + (number + 1) * step, nodes, weights))
            covered += advance
    yield _span(segments)


def _span(segments: list[tuple[float, float, FloatArray, FloatArray]]) -> Span:
    starts, ends, nodes, weights = zip(*segments, strict=True)
    counts = [len(part) for part in nodes]
    return Span(
        np.repeat(starts, counts), np.repeat(ends, counts), np.concatenate(nodes), np.concatenate(weights)
    )


@lru_cache(maxsize=128)
def _gauss_legendre(count: int) -> tuple[FloatArray, FloatArray]:
    """Return nodes (count,) on 0 .. 1 and weights that add up to 1."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return 0.5 * (nodes + 1.0), 0.5 * weights


def path_lengths(camera: Pinhole, spread: PointSpread, vectors: FloatArray) -> FloatArray:
    """Return the longest path (j - 1,) px between knots of any source on the detector."""
    points = camera.project(vectors)
    start, end = points[:-1], points[1:]
    low, high = np.minimum(start, end), np.maximum(start, end)
    on = touches(low, high, camera.columns, camera.rows, spread.reach + 2)
    length = np.hypot(end[..., 0] - start[..., 0], end[..., 1] - start[..., 1])
    return np.asarray(np.max(np.where(on, length, 0.0), axis=1, initial=0.0))


def touches(low: FloatArray, high: FloatArray, columns: int, rows: int, margin: float) -> BoolArray:
    """Return which boxes with corners (..., 2) are within `margin` px of the detector; NaN is outside."""
    x = (high[..., 0] >= -margin) & (low[..., 0] <= columns - 1 + margin)
    y = (high[..., 1] >= -margin) & (low[..., 1] <= rows - 1 + margin)
    return np.asarray(x & y)


def _deposit(image: Float32Array, spread: PointSpread, points: FloatArray, electrons: FloatArray) -> None:
    """Add `electrons` (m, n) at `points` (m, n, 2); the points of each source are close together."""
    rows, columns = image.shape
    low = np.floor(points.min(axis=0) + 0.5)
    high = np.floor(points.max(axis=0) + 0.5)
    seen = np.flatnonzero(touches(low, high, columns, rows, spread.reach))
    if not seen.size:
        return
    corner = low[seen] - spread.reach
    size = int(np.max(high[seen] - low[seen])) + 2 * spread.reach + 1
    across = spread.shares(points[:, seen, 0].T - corner[:, :1], size)
    down = spread.shares(points[:, seen, 1].T - corner[:, 1:], size)
    down *= electrons[:, seen].T[..., None].astype(np.float32)
    patches = np.matmul(down.transpose(0, 2, 1), across)
    add_patches(image, patches, corner)


def add_patches(image: Float32Array, patches: Float32Array, corner: FloatArray) -> None:
    """Add square `patches` (n, size, size), their top-left pixels at `corner` (n, 2) as x, y, to `image`."""
    rows, columns = image.shape
    size = patches.shape[1]
    whole = np.all((corner >= 0.0) & (corner <= (columns - size, rows - size)), axis=1)
    origin = corner.astype(np.intp)
    pixel = (np.arange(size)[:, None] * columns + np.arange(size)).reshape(-1)
    index = (origin[whole, 1] * columns + origin[whole, 0])[:, None] + pixel
    np.add.at(image.reshape(-1), index.reshape(-1), patches[whole].reshape(-1))
    for patch, (left, top) in zip(patches[~whole], origin[~whole].tolist(), strict=True):
        right, bottom = min(left + size, columns), min(top + size, rows)
        skip_x, skip_y = max(0, -left), max(0, -top)
        part = patch[skip_y : bottom - top, skip_x : right - left]
        image[top + skip_y : bottom, left + skip_x : right] += part


OwnTimes = Callable[[FloatArray, IntArray], FloatArray]
"""Directions (m, k, 3) of sources number (k,) in the camera frame, at times (m, k) or for all (m, 1)."""

FASTEST = 0.25
"""Largest speed of a source (px per line time); at 1 it would keep pace with the shutter."""
SETTLED = 1e-4
"""Convergence limit of the row passages (line times)."""


@dataclass(frozen=True, slots=True)
class RollingShutter:
    """Row r exposes from `start` + r `line_time` for `exposure` s."""

    start: float
    exposure: float
    line_time: float


def expose_rolling(
    image: Float32Array,
    camera: Pinhole,
    spread: PointSpread,
    vectors: OwnTimes,
    electrons: FloatArray,
    knots: FloatArray,
    shutter: RollingShutter,
) -> None:
    """Add to `image` (rows, columns) the e- of sources that move smoothly between `knots` (j,) s.

    `electrons` (n,) is the light of each source over the exposure. Raises OutOfRange for a source on the
    detector that moves more than a quarter of a pixel in a line time.
    """
    everyone = np.arange(len(electrons))
    lengths = path_lengths(camera, spread, vectors(knots[:, None], everyone))
    fastest = float(np.max(lengths / np.diff(knots))) * shutter.line_time
    if fastest > FASTEST:
        raise OutOfRange(DEVICE, "motion of a source in a line time", fastest, 0.0, FASTEST, "px")
    # The stretched image is longer by the factor 1 / (1 - speed).
    reach = math.ceil(spread.reach / (1.0 - fastest))
    # A source just above the first row or below the last row lights them but is itself on no row.
    knots = knots.copy()
    knots[[0, -1]] += np.array([-1.0, 1.0]) * (reach + 1) * shutter.line_time
    first, last = (
        _passes(camera, reach, vectors, everyone, shutter, phase) for phase in (0.0, shutter.exposure)
    )
    for span in spans(knots, lengths, spread):
        near = _near(camera, reach + spread.patch, vectors, everyone, span)
        near = near[(last[near] > span.starts[0]) & (first[near] < span.ends[-1])]
        if near.size:
            starts = np.clip(span.starts[:, None], first[near], last[near])
            ends = np.clip(span.ends[:, None], first[near], last[near])
            times = starts + span.nodes[:, None] * (ends - starts)
            points = camera.project(vectors(times, near))
            shift = camera.project(vectors(times + shutter.line_time, near)) - points
            # u grows more slowly than t while the source moves down, like the shutter.
            light = span.weights[:, None] * (ends - starts) * (1.0 - shift[..., 1]) / shutter.exposure
            _deposit_rows(image, spread, reach, points, shift, light * electrons[near])


def _passes(
    camera: Pinhole,
    reach: int,
    vectors: OwnTimes,
    sources: IntArray,
    shutter: RollingShutter,
    phase: float,
) -> FloatArray:
    """Return the times (n,) s at which the row of each source is `phase` s into its exposure."""
    outside = reach + 1.0
    times = np.full(len(sources), shutter.start + phase + 0.5 * camera.rows * shutter.line_time)
    # Each iteration reduces the error of sources on the detector to a quarter or less.
    for _ in range(math.ceil(math.log(SETTLED / camera.rows) / math.log(FASTEST)) + 1):
        row = camera.project(vectors(times[None], sources))[0, :, 1]
        row = np.clip(np.nan_to_num(row, nan=-outside), -outside, camera.rows + outside)
        before, times = times, shutter.start + phase + row * shutter.line_time
        if np.max(np.abs(times - before), initial=0.0) <= SETTLED * shutter.line_time:
            break
    return times


def _near(camera: Pinhole, margin: float, vectors: OwnTimes, sources: IntArray, span: Span) -> IntArray:
    """Return the sources within `margin` px of the detector at an end of `span`."""
    ends = camera.project(vectors(np.array([span.starts[:1], span.ends[-1:]]), sources))
    return np.flatnonzero(touches(ends.min(axis=0), ends.max(axis=0), camera.columns, camera.rows, margin))


def _deposit_rows(
    image: Float32Array,
    spread: PointSpread,
    reach: int,
    points: FloatArray,
    shift: FloatArray,
    electrons: FloatArray,
) -> None:
    """Add `electrons` (m, k) at `points` (m, k, 2), shifted by `shift` (m, k, 2) px with every row."""
    low = np.floor(points.min(axis=0) + 0.5)
    high = np.floor(points.max(axis=0) + 0.5)
    seen = np.flatnonzero(touches(low, high, image.shape[1], image.shape[0], reach))
    if not seen.size:
        return
    shift = shift[:, seen]
    corner = low[seen] - reach
    size = int(np.max(high[seen] - low[seen])) + 2 * reach + 1
    place = points[:, seen] - corner
    # Line times by which each row of the patch is exposed later than the source's row: (m, k, size).
    later = np.arange(size) - place[..., 1:]
    across = spread.shares(np.clip(place[..., :1] + later * shift[..., :1], 0.0, size), size)
    down = spread.own_shares(np.clip(place[..., 1:] + later * shift[..., 1:], 0.0, size))
    down *= electrons[:, seen, None].astype(np.float32)
    patches = np.einsum("mkr,mkrc->krc", down, across)
    add_patches(image, patches, corner)
