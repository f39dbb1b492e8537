"""The light of point sources, gathered along their paths on the detector with a global or a rolling shutter.

Sease renders a still image for each of many short steps of the exposure and adds the images. Here each path
is cut into spans of a few pixels. In a span the light is integrated over time by Gauss-Legendre quadrature,
whose samples cost little because the point spread function is separable: the light of all samples on a small
patch of pixels is one product of two thin matrices, (down, samples) by (samples, across).

Under a rolling shutter, row r exposes r line times later than row 0: light on row r at time t counts when u
= t - start - r * line_time lies within the exposure. A source is followed in u along its own path: at u it
is at row y, at the time start + u + y * line_time. The neighbouring rows are exposed a few line times
earlier or later, when the source was at another point of its path, so the image of the source is sheared and
stretched. The quadrature is as smooth as for a global shutter, because no sample lies at a shutter's edge.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from hal.interfaces.errors import OutOfRange
from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.vision.camera.lens import Pinhole
from sim_hal.star_camera.model import DEVICE

Float32Array = npt.NDArray[np.float32]

STEPS = 256
"""Table entries a pixel; between two of them the profile is interpolated (error below 1e-5 of its peak)."""


@dataclass(frozen=True, slots=True)
class PointSpread:
    """A separable point spread function.

    Attributes:
        profile: fraction of the light on a pixel by the distance of its centre from the point, px.
        reach: whole pixels from the pixel the point is on, beyond which no light falls.
        patch: px of a path that are gathered at once.
        quadrature: number of samples for a path by its length in px.
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
        """Return the light (..., size) on pixels 0 .. size - 1, each of its own point of `positions`."""
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
    """Return the thesis's: shared among the nearest pixels (2.5, 2.6), blurred by a sampled kernel (2.9)."""
    taps = np.exp(-0.5 * (np.array([-1.0, 0.0, 1.0]) / sigma) ** 2)
    taps /= taps.sum()

    def profile(offset: FloatArray) -> FloatArray:
        distance = np.abs(np.asarray(offset)[..., None] - np.array([-1.0, 0.0, 1.0]))
        return np.asarray(np.clip(1.0 - distance, 0.0, None) @ taps)

    def quadrature(length: float) -> int:
        # The profile has corners: no order of quadrature helps, only samples much closer than a pixel.
        return 1 if length < 1e-3 else math.ceil(2.0 + 8.0 * length)

    return PointSpread(profile, 2, 8.0, quadrature)


def _entries(positions: FloatArray) -> tuple[IntArray, Float32Array]:
    """Return the table's entry before each of `positions`, and how far beyond it that lies, 0 .. 1."""
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
    """A short stretch of the exposure and its samples (m,).

    Attributes:
        starts: s, where the piece of smooth motion begins that the sample stands for a part of.
        ends: s, where that piece ends.
        nodes: the sample's place in the piece, 0 .. 1.
        weights: the part of the piece that it stands for; of each piece they add up to 1.
    """

    starts: FloatArray
    ends: FloatArray
    nodes: FloatArray
    weights: FloatArray

    @property
    def times(self) -> FloatArray:
        """The times (m,) of the samples, s."""
        return self.starts + self.nodes * (self.ends - self.starts)

    @property
    def durations(self) -> FloatArray:
        """The time that each sample (m,) represents, s."""
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

    `electrons` (n,) is what each source gives over the whole exposure, `knots[0]` to `knots[-1]`.
    """
    rate = electrons / (knots[-1] - knots[0])
    for span in spans(knots, path_lengths(camera, spread, vectors(knots)), spread):
        points = camera.project(vectors(span.times))
        _deposit(image, spread, points, span.durations[:, None] * rate)


def spans(knots: FloatArray, lengths: FloatArray, spread: PointSpread) -> Iterator[Span]:
    """Cut the exposure into spans in which no path is longer than a patch.

    `lengths` (j - 1,) px is the longest path between consecutive `knots` (j,). Long stretches are divided,
    short ones taken together; no sample ever stands for both sides of a knot.
    """
    pieces: list[tuple[float, float, FloatArray, FloatArray]] = []
    covered = 0.0
    for start, end, length in zip(knots[:-1].tolist(), knots[1:].tolist(), lengths.tolist(), strict=True):
        count = max(1, math.ceil(length / spread.patch))
        step, advance = (end - start) / count, length / count
        nodes, weights = _gauss_legendre(spread.quadrature(advance))
        for number in range(count):
            if pieces and covered + advance > spread.patch:
                yield _span(pieces)
                pieces, covered = [], 0.0
            pieces.append((start + number * step, start + (number + 1) * step, nodes, weights))
            covered += advance
    yield _span(pieces)


def _span(pieces: list[tuple[float, float, FloatArray, FloatArray]]) -> Span:
    starts, ends, nodes, weights = zip(*pieces, strict=True)
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
    """Return the longest path (j - 1,) px between knots, of the sources that are then on the detector."""
    points = camera.project(vectors)
    start, end = points[:-1], points[1:]
    low, high = np.minimum(start, end), np.maximum(start, end)
    on = touches(low, high, camera.columns, camera.rows, spread.reach + 2)
    length = np.hypot(end[..., 0] - start[..., 0], end[..., 1] - start[..., 1])
    return np.asarray(np.max(np.where(on, length, 0.0), axis=1, initial=0.0))


def touches(low: FloatArray, high: FloatArray, columns: int, rows: int, margin: float) -> BoolArray:
    """Return which boxes, corners (..., 2), come within `margin` px of the detector; one at NaN does not."""
    x = (high[..., 0] >= -margin) & (low[..., 0] <= columns - 1 + margin)
    y = (high[..., 1] >= -margin) & (low[..., 1] <= rows - 1 + margin)
    return np.asarray(x & y)


def _deposit(image: Float32Array, spread: PointSpread, points: FloatArray, electrons: FloatArray) -> None:
    """Add `electrons` (m, n) at `points` (m, n, 2), each source's points close together."""
    rows, columns = image.shape
    low = np.floor(points.min(axis=0) + 0.5)
    high = np.floor(points.max(axis=0) + 0.5)
    seen = np.flatnonzero(touches(low, high, columns, rows, spread.reach))
    if not seen.size:
        return
    corner = low[seen] - spread.reach
    size = int(np.max(high[seen] - low[seen])) + 2 * spread.reach + 1
    whole = np.all((corner >= 0.0) & (corner <= (columns - size, rows - size)), axis=1)
    order = np.argsort(~whole, kind="stable")  # those that the edge cuts come last
    seen, corner = seen[order], corner[order]
    across = spread.shares(points[:, seen, 0].T - corner[:, :1], size)
    down = spread.shares(points[:, seen, 1].T - corner[:, 1:], size)
    down *= electrons[:, seen].T[..., None].astype(np.float32)
    patches = np.matmul(down.transpose(0, 2, 1), across)
    origin = corner.astype(np.intp)
    split = int(np.count_nonzero(whole))
    _add_whole(image, patches[:split], origin[:split])
    _add_cut(image, patches[split:], origin[split:])


def add_patches(image: Float32Array, patches: Float32Array, corner: FloatArray) -> None:
    """Add square `patches` (n, size, size), their top-left pixels at `corner` (n, 2) as x, y, to `image`."""
    rows, columns = image.shape
    size = patches.shape[1]
    whole = np.all((corner >= 0.0) & (corner <= (columns - size, rows - size)), axis=1)
    origin = corner.astype(np.intp)
    _add_whole(image, patches[whole], origin[whole])
    _add_cut(image, patches[~whole], origin[~whole])


def _add_whole(image: Float32Array, patches: Float32Array, origin: IntArray) -> None:
    """Add square `patches` (n, size, size) to `image`, their top-left pixels at `origin` (n, 2) as x, y."""
    columns, size = image.shape[1], patches.shape[1]
    pixel = (np.arange(size)[:, None] * columns + np.arange(size)).reshape(-1)
    index = (origin[:, 1] * columns + origin[:, 0])[:, None] + pixel
    np.add.at(image.reshape(-1), index.reshape(-1), patches.reshape(-1))


def _add_cut(image: Float32Array, patches: Float32Array, origin: IntArray) -> None:
    """Add the part of `patches` on `image`; arguments as for `_add_whole`."""
    rows, columns = image.shape
    size = patches.shape[1]
    for patch, (left, top) in zip(patches, origin.tolist(), strict=True):
        right, bottom = min(left + size, columns), min(top + size, rows)
        skip_x, skip_y = max(0, -left), max(0, -top)
        part = patch[skip_y : bottom - top, skip_x : right - left]
        image[top + skip_y : bottom, left + skip_x : right] += part


OwnTimes = Callable[[FloatArray, IntArray], FloatArray]
"""Directions (m, k, 3) of sources number (k,) in the camera frame, at times (m, k) or for all (m, 1)."""

FASTEST = 0.25
"""px a line time: a source that keeps pace with the shutter is on no row, or on all of them, at once."""
SETTLED = 1e-4
"""Line times."""


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

    `electrons` (n,) is what each gives over the exposure. Raises OutOfRange when one on the detector crosses
    more than a quarter of a pixel in a line time.
    """
    everyone = np.arange(len(electrons))
    lengths = path_lengths(camera, spread, vectors(knots[:, None], everyone))
    fastest = float(np.max(lengths / np.diff(knots))) * shutter.line_time
    if fastest > FASTEST:
        raise OutOfRange(DEVICE, "a source's way in a line time", fastest, 0.0, FASTEST, "px")
    # The stretched image reaches further by 1 / (1 - speed).
    reach = math.ceil(spread.reach / (1.0 - fastest))
    # A source just above the first row or below the last lights them, but follows rows that are not there.
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
            # u passes more slowly than t while the source runs down after the shutter.
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
    """Return when (n,) the row that each source is on is `phase` s into its exposure."""
    outside = reach + 1.0
    times = np.full(len(sources), shutter.start + phase + 0.5 * camera.rows * shutter.line_time)
    # Each round leaves a quarter of the error or less, of those that are on the detector.
    for _ in range(math.ceil(math.log(SETTLED / camera.rows) / math.log(FASTEST)) + 1):
        row = camera.project(vectors(times[None], sources))[0, :, 1]
        row = np.clip(np.nan_to_num(row, nan=-outside), -outside, camera.rows + outside)
        before, times = times, shutter.start + phase + row * shutter.line_time
        if np.max(np.abs(times - before), initial=0.0) <= SETTLED * shutter.line_time:
            break
    return times


def _near(camera: Pinhole, margin: float, vectors: OwnTimes, sources: IntArray, span: Span) -> IntArray:
    """Return the sources that come within `margin` px of the detector at an end of `span`."""
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
    # How many lines later than the source's own row each row of the patch is exposed: (m, k, size).
    later = np.arange(size) - place[..., 1:]
    across = spread.shares(np.clip(place[..., :1] + later * shift[..., :1], 0.0, size), size)
    down = spread.own_shares(np.clip(place[..., 1:] + later * shift[..., 1:], 0.0, size))
    down *= electrons[:, seen, None].astype(np.float32)
    patches = np.einsum("mkr,mkrc->krc", down, across)
    add_patches(image, patches, corner)
