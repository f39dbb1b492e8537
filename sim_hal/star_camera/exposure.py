"""Integrates the charge from point sources along their paths, for a global or a rolling shutter.

Sease renders a still image for each of many short steps of the exposure and adds the images. This module
divides each path into spans of a few pixels and integrates the charge of a span over time by Gauss-Legendre
quadrature. Because the point spread function is separable, the charge of all samples on a small patch of
pixels is the product of two matrices, (rows, samples) and (samples, columns), so that many samples take
little computing time.

With a rolling shutter, the exposure of row r begins r line times after the exposure of row 0. Light that
reaches row r at time t is collected if the row time u = t - start - r * line_time is within the exposure. The
integration over a source's path uses u as its variable: the source is on row y at the time start + u + y *
line_time. Neighbouring rows are exposed to the source a few line times earlier or later, at another point of
its path, so the image of the source is sheared and stretched. The quadrature converges as fast as for a
global shutter, because the integrand has no discontinuity inside the integration interval.
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
"""Table entries per pixel; the error of linear interpolation is less than 1e-5 of the peak."""


@dataclass(frozen=True, slots=True)
class PointSpread:
    """A separable point spread function.

    Attributes:
        profile: function from the distance (px) between a pixel's centre and the source to the fraction of
            the source's charge on that pixel.
        reach: largest distance (whole px) from the source's pixel at which charge is deposited.
        patch: longest path (px) that is integrated as one span.
        quadrature: function from the length (px) of a path to the number of quadrature samples.
    """

    profile: Callable[[FloatArray], FloatArray]
    reach: int
    patch: float
    quadrature: Callable[[float], int]

    def shares(self, positions: FloatArray, size: int) -> Float32Array:
        """Return the charge fractions (..., size) of sources at `positions` (...) on a row or column."""
        table, rise = _table(self, size)
        entry, beyond = _entries(positions)
        shares = table.take(entry, axis=0)
        shares += beyond[..., None] * rise.take(entry, axis=0)
        return np.asarray(shares)

    def own_shares(self, positions: FloatArray) -> Float32Array:
        """Return the charge fraction on each pixel of a row or column, with one source position per pixel."""
        pixel = np.arange(positions.shape[-1])
        table, rise = _table(self, len(pixel))
        entry, beyond = _entries(positions)
        return np.asarray(table[entry, pixel] + beyond * rise[entry, pixel])


@lru_cache(maxsize=8)
def integrated_gaussian(sigma: float) -> PointSpread:
    """Return a Gaussian point spread function of `sigma` px, integrated over each pixel."""

    def profile(offset: FloatArray) -> FloatArray:
        return np.asarray(ndtr((offset + 0.5) / sigma) - ndtr((offset - 0.5) / sigma))

    def quadrature(length: float) -> int:
        # About one Gauss-Legendre sample per sigma is needed; 0.95 per sigma gives errors of 1e-4 of the
        # peak.
        return 1 if length < 0.02 * sigma else math.ceil(1.5 + 0.95 * length / sigma)

    return PointSpread(profile, math.ceil(4.0 * sigma), max(4.0, 8.0 * sigma), quadrature)


@lru_cache(maxsize=8)
def bilinear_gaussian(sigma: float) -> PointSpread:
    """Return the point spread function of the thesis.

    The point spread function places the charge on the four nearest pixels (Sease, eqs. 2.5 and 2.6) and blurs
    it by a 3 x 3 kernel (Sease, eq. 2.9).
    """
    taps = np.exp(-0.5 * (np.array([-1.0, 0.0, 1.0]) / sigma) ** 2)
    taps /= taps.sum()

    def profile(offset: FloatArray) -> FloatArray:
        distance = np.abs(np.asarray(offset)[..., None] - np.array([-1.0, 0.0, 1.0]))
        return np.asarray(np.clip(1.0 - distance, 0.0, None) @ taps)

    def quadrature(length: float) -> int:
        # The slope of the profile is discontinuous, so the distance of samples must be far less than a pixel.
        return 1 if length < 1e-3 else math.ceil(2.0 + 8.0 * length)

    return PointSpread(profile, 2, 8.0, quadrature)


def _entries(positions: FloatArray) -> tuple[IntArray, Float32Array]:
    """Return the table index before each position, and the fraction (0 to 1) to the next table entry."""
    scaled = positions * STEPS
    entry = scaled.astype(np.intp)
    return entry, (scaled - entry).astype(np.float32)


@lru_cache(maxsize=32)
def _table(spread: PointSpread, size: int) -> tuple[Float32Array, Float32Array]:
    """Return the table (size * STEPS + 1, size) of charge fractions, and the differences between its rows.

    Neighbouring table rows are for source positions that differ by 1/STEPS px.
    """
    positions = np.arange(size * STEPS + 2) / STEPS
    table = spread.profile(np.arange(size) - positions[:, None])
    # Each row is normalised, so that charge beyond the reach of the point spread function is not lost.
    shares = np.asarray(table / table.sum(axis=1, keepdims=True), dtype=np.float32)
    return shares[:-1], np.diff(shares, axis=0)


Vectors = Callable[[FloatArray], FloatArray]
"""Function that returns the directions (m, n, 3) of n sources in the camera frame at times (m,)."""


@dataclass(frozen=True, slots=True)
class Span:
    """Quadrature samples (m,) of a short interval of the exposure, in segments of smooth motion.

    Attributes:
        starts: start time of each sample's segment, s.
        ends: end time of each sample's segment, s.
        nodes: position of each sample in its segment, from 0 to 1.
        weights: quadrature weight of each sample; the weights of a segment add up to 1.
    """

    starts: FloatArray
    ends: FloatArray
    nodes: FloatArray
    weights: FloatArray

    @property
    def times(self) -> FloatArray:
        """Times (m,) of the quadrature samples (s)."""
        return self.starts + self.nodes * (self.ends - self.starts)

    @property
    def durations(self) -> FloatArray:
        """Durations (m,) that the samples represent (s)."""
        return self.weights * (self.ends - self.starts)


def expose(
    image: Float32Array,
    camera: Pinhole,
    spread: PointSpread,
    vectors: Vectors,
    electrons: FloatArray,
    knots: FloatArray,
) -> None:
    """Add the charge (e-) of sources that move smoothly between `knots` (j,), s, to `image` (rows, columns).

    `electrons` (n,) is the charge from each source over the whole exposure, from `knots[0]` to `knots[-1]`.
    """
    rate = electrons / (knots[-1] - knots[0])
    for span in spans(knots, path_lengths(camera, spread, vectors(knots)), spread):
        points = camera.project(vectors(span.times))
        _deposit(image, spread, points, span.durations[:, None] * rate)


def spans(knots: FloatArray, lengths: FloatArray, spread: PointSpread) -> Iterator[Span]:
    """Divide the exposure into spans in which no path is longer than a patch.

    `lengths` (j - 1,) px is the longest path between consecutive `knots` (j,) s. Long intervals are divided
    and short intervals are combined, but no segment crosses a knot.
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
    """Return the Gauss-Legendre nodes (count,) between 0 and 1 and the weights, which add up to 1."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return 0.5 * (nodes + 1.0), 0.5 * weights


def path_lengths(camera: Pinhole, spread: PointSpread, vectors: FloatArray) -> FloatArray:
    """Return the longest path (j - 1,), px, of any source on the detector between consecutive knots."""
    points = camera.project(vectors)
    start, end = points[:-1], points[1:]
    low, high = np.minimum(start, end), np.maximum(start, end)
    on = touches(low, high, camera.columns, camera.rows, spread.reach + 2)
    length = np.hypot(end[..., 0] - start[..., 0], end[..., 1] - start[..., 1])
    return np.asarray(np.max(np.where(on, length, 0.0), axis=1, initial=0.0))


def touches(low: FloatArray, high: FloatArray, columns: int, rows: int, margin: float) -> BoolArray:
    """Return whether boxes with corners `low` and `high` (..., 2) are within `margin` px of the detector.

    A box with a NaN corner counts as outside the detector.
    """
    x = (high[..., 0] >= -margin) & (low[..., 0] <= columns - 1 + margin)
    y = (high[..., 1] >= -margin) & (low[..., 1] <= rows - 1 + margin)
    return np.asarray(x & y)


def _deposit(image: Float32Array, spread: PointSpread, points: FloatArray, electrons: FloatArray) -> None:
    """Add `electrons` (m, n) at `points` (m, n, 2), px, where the m points of a source are close together."""
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
    """Add `patches` (n, size, size) to `image` with their top-left pixels at `corner` (n, 2), x and y."""
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
"""Function from times (m, k) or (m, 1) and source indices (k,) to camera-frame directions (m, k, 3)."""

FASTEST = 0.25
"""Largest speed (px per line time) of a source; a speed of 1 is that of the rolling shutter."""
SETTLED = 1e-4
"""Tolerance (line times) of the iterated time at which the row of a source is exposed."""


@dataclass(frozen=True, slots=True)
class RollingShutter:
    """A rolling shutter, which exposes row r from `start` + r * `line_time` for `exposure` s."""

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
    """Add the charge (e-) of sources that move smoothly between `knots` (j,), s, to `image` (rows, columns).

    `electrons` (n,) is the charge from each source over the exposure. Raises OutOfRange for a source on the
    detector that moves more than a quarter of a pixel in a line time.
    """
    everyone = np.arange(len(electrons))
    lengths = path_lengths(camera, spread, vectors(knots[:, None], everyone))
    fastest = float(np.max(lengths / np.diff(knots))) * shutter.line_time
    if fastest > FASTEST:
        raise OutOfRange(DEVICE, "motion of a source in a line time", fastest, 0.0, FASTEST, "px")
    # The image of a source that moves by v rows per line time is stretched by the factor 1 / (1 - v).
    reach = math.ceil(spread.reach / (1.0 - fastest))
    # A source just outside the first or last row still adds charge to that row.
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
            # The factor 1 - v conserves the charge of a source that moves down by v rows per line time.
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
    """Return the times (n,), s, at which the row of each source has been exposed for `phase` s."""
    outside = reach + 1.0
    times = np.full(len(sources), shutter.start + phase + 0.5 * camera.rows * shutter.line_time)
    # For sources on the detector, each iteration reduces the error to a quarter or less.
    for _ in range(math.ceil(math.log(SETTLED / camera.rows) / math.log(FASTEST)) + 1):
        row = camera.project(vectors(times[None], sources))[0, :, 1]
        row = np.clip(np.nan_to_num(row, nan=-outside), -outside, camera.rows + outside)
        before, times = times, shutter.start + phase + row * shutter.line_time
        if np.max(np.abs(times - before), initial=0.0) <= SETTLED * shutter.line_time:
            break
    return times


def _near(camera: Pinhole, margin: float, vectors: OwnTimes, sources: IntArray, span: Span) -> IntArray:
    """Return the indices of sources whose path during `span` comes within `margin` px of the detector."""
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
    """Add `electrons` (m, k) at `points` (m, k, 2), px, of sources that move by `shift` px per line time."""
    low = np.floor(points.min(axis=0) + 0.5)
    high = np.floor(points.max(axis=0) + 0.5)
    seen = np.flatnonzero(touches(low, high, image.shape[1], image.shape[0], reach))
    if not seen.size:
        return
    shift = shift[:, seen]
    corner = low[seen] - reach
    size = int(np.max(high[seen] - low[seen])) + 2 * reach + 1
    place = points[:, seen] - corner
    # `later` (m, k, size): line times by which each row of a patch is exposed after the row of the source.
    later = np.arange(size) - place[..., 1:]
    across = spread.shares(np.clip(place[..., :1] + later * shift[..., :1], 0.0, size), size)
    down = spread.own_shares(np.clip(place[..., 1:] + later * shift[..., 1:], 0.0, size))
    down *= electrons[:, seen, None].astype(np.float32)
    patches = np.einsum("mkr,mkrc->krc", down, across)
    add_patches(image, patches, corner)
