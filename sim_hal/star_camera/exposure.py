"""The light of point sources gathered along their paths on the detector.

Sease renders a still image for each of many short steps of the exposure and adds them up. Here each path is
cut into spans of a few pixels; in a span the light is integrated over time by Gauss-Legendre quadrature,
whose samples cost little because the point spread is a product: the light of all samples on a small patch of
pixels is one product of two thin matrices, (down, samples) by (samples, across).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.vision.camera.lens import Pinhole
from sim_hal.star_camera.point_spread import Float32Array, PointSpread

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
