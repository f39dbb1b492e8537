"""Edges along scan lines to a fraction of a pixel, and the same edges as directions.

Lines are read, normalised, made binary and filtered as in Meller 3.1, in both directions. Every change is
then refined: the signal's slope, smoothed by a Gaussian, has its peak where the limb's brightness falls
fastest. The scale is doubled as long as the edge is wider (Lindeberg 1998, Int. J. Comput. Vision 30, 117),
so that a limb of one pixel and a limb of a hundred pixels are both located at their steepest point.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import lru_cache

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.vision.camera.lens import CameraModel, Lens
from knightcube.vision.frame import PixelAccess
from knightcube.vision.horizon.settings import EdgeSettings, light_of

RUN = 5
"""Window of the majority filter (px): shorter fluctuations are removed."""


def run_filtered(binary: BoolArray, run: int = RUN) -> BoolArray:
    """Return binary lines (n, m) with runs shorter than half of `run` px, odd, filtered out (step 2 of 3.1).

    A pixel becomes what most of the `run` pixels about it are; beyond a line's ends stands its last pixel.
    """
    half = run // 2
    size = binary.shape[1]
    padded = np.empty((len(binary), size + 2 * half), dtype=np.int16)
    padded[:, half : half + size] = binary
    padded[:, :half], padded[:, half + size :] = binary[:, :1], binary[:, -1:]
    total = padded[:, :size].copy()
    for place in range(1, run):
        total += padded[:, place : place + size]
    return np.asarray(total > half)


_SCALES = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
"""Standard deviations of the Gaussian (px)."""
_REACH = 3.0
"""Largest distance, in scales, of the steepest point from the change of the binary line."""
_TAIL = 3.5
"""Distance, in scales, at which the Gaussian is truncated."""
_OUTGROWN = 1.4
"""Gain above which a doubled scale still does not cover the edge: its spread is 1.4 scales."""
_MARGIN = 4.0
"""Distance from the border (px) within which edges are ignored; some detectors have a black frame."""
_FLOOR, _SHARE = 0.1, 0.05
"""Prior error of an edge position: a constant (px) and a share of the scale."""
_SAMPLES = 2048
_STEP_TO_SIGMA = 1.4826 / 2.0**0.5
"""Ratio of the standard deviation of one pixel to the median absolute difference of two, normal noise."""
_STANDS_OUT = 6.0
"""Threshold of lit pixels, in standard deviations of dark pixels."""
_LEAST_LIT = 16
"""Least number of lit samples: fewer are a hot pixel or a star."""
_PROFILE: IntArray = np.arange(-9, 6)
"""Positions of the samples that are kept, px from the edge towards the bright side."""


@dataclass(frozen=True, slots=True, eq=False)
class ScanLines:
    """The lines that were read: light along columns and rows.

    Attributes:
        columns, rows: the indices of the lines.
        column_bright, row_bright: (n, m) the lines made binary and filtered.
        space: px between them.
        levels: average light of the dark and of the bright, and the dark's noise.
    """

    columns: IntArray
    rows: IntArray
    column_bright: BoolArray
    row_bright: BoolArray
    space: float
    levels: tuple[float, float, float]

    @property
    def pixels(self) -> int:
        """The number of pixels read."""
        return self.column_bright.size + self.row_bright.size


@dataclass(frozen=True, slots=True, eq=False)
class Nearby:
    """A part of the picture to be read more closely: its `box` (2, 2) px, least and greatest x, y.

    `levels` are those of the whole picture, see `ScanLines`.
    """

    box: FloatArray
    levels: tuple[float, float, float]


@dataclass(frozen=True, slots=True, eq=False)
class ScanEdges:
    """Places where a scan line changes from dark to bright.

    Attributes:
        points: (n, 2) px.
        towards: (n, 2) unit steps along the line to the bright side.
        scale: (n,) px, the Gaussian's that found it.
        contrast: (n,) the step's height over high - low.
        sigma: (n,) px along the line, before a fit.
        background: (n,) light on the dark side: next to the limb and the terminator there is none, next to a
            coast or a cloud there is.
        profile: (n, m) light along the line from dark to bright, about the pixel nearest to the point; NaN
            beyond the picture.
    """

    points: FloatArray
    towards: FloatArray
    scale: FloatArray
    contrast: FloatArray
    sigma: FloatArray
    background: FloatArray
    profile: FloatArray

    @property
    def profile_steps(self) -> FloatArray:
        """Where the profile's samples lie (n, m), px from the point towards the bright side."""
        # A line's place times the direction: its rounding is the pixel nearest to the edge.
        place = np.sum(self.points * self.towards, axis=1)
        return np.asarray((np.rint(place) - place)[:, None] + _PROFILE)

    def __len__(self) -> int:
        return len(self.points)

    def chosen(self, which: BoolArray | IntArray) -> ScanEdges:
        """Return the edges `which`, flags (n,) or indices."""
        return ScanEdges(*(getattr(self, each.name)[which] for each in fields(self)))


def find_edges(
    access: PixelAccess, settings: EdgeSettings, near: Nearby | None = None
) -> tuple[ScanEdges, ScanLines]:
    """Return the edges on evenly spaced columns and rows, and these lines; no other pixel is read.

    `near` restricts the lines to those that cross a part of the picture.
    """
    columns, rows = _places(access.columns, settings.lines), _places(access.rows, settings.lines)
    if near is not None:
        columns, rows = (_within(x, near.box[:, axis]) for axis, x in enumerate((columns, rows)))
    space = max(1.0, max(access.columns, access.rows) / settings.lines)
    light = [
        light_of(access.read_columns(columns), settings.response),
        light_of(access.read_rows(rows), settings.response),
    ]
    low, high, noise = near.levels if near is not None else _levels(light)
    level = low + max(settings.threshold * (high - low), _STANDS_OUT * noise)
    bright = [run_filtered(lines > level, settings.run) for lines in light]
    lines = ScanLines(columns, rows, bright[0], bright[1], space, (low, high, noise))
    if not high > low or not len(columns) + len(rows):
        return _NOTHING, lines
    edges = _line_edges(light, bright, (columns, rows), high - low, settings.contrast)
    most = settings.most * settings.lines
    if len(edges) > most:
        edges = edges.chosen(np.argsort(edges.background, kind="stable")[:most])
    return edges, lines


def _within(places: IntArray, ends: FloatArray) -> IntArray:
    return np.asarray(places[(places >= ends[0]) & (places <= ends[1])])


def _places(size: int, lines: int) -> IntArray:
    """Return the indices of `lines` evenly spaced lines of `size`, half a space from the border."""
    lines = min(lines, size)
    return np.asarray((np.arange(lines) + 0.5) * size / lines, dtype=int)


def _levels(light: list[FloatArray]) -> tuple[float, float, float]:
    """Return the average light of the dark and of the bright, and the dark's noise; equal where all is dark.

    Pixels above the dark's noise are bright; their median excludes the Sun's disc and hot pixels.
    """
    samples, steps = (np.concatenate(each) for each in zip(*map(_samples, light), strict=True))
    order = np.sort(samples)
    least, most = float(order[len(order) // 50]), float(order[-1 - len(order) // 200])
    dark = np.abs(steps[samples <= least + 0.1 * (most - least)])
    middle = len(dark) // 2
    noise = float(np.partition(dark, middle)[middle]) * _STEP_TO_SIGMA
    # The least of fifty lies two deviations low.
    low = least + 2.0 * noise
    lit = order[np.searchsorted(order, low + max(_STANDS_OUT * noise, 0.05 * (most - low)), "right") :]
    if len(lit) < _LEAST_LIT or most <= low:
        return low, low, noise
    return low, float(lit[len(lit) // 2]), noise


def _samples(lines: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return some of the lines' pixels, and their differences from the next pixel on the line."""
    pace = max(1, lines.size // _SAMPLES)
    here = lines[:, :-1].ravel()[::pace]
    return here, lines[:, 1:].ravel()[::pace] - here


_NONE: FloatArray = np.zeros(0)
_NOTHING = ScanEdges(
    np.zeros((0, 2)), np.zeros((0, 2)), _NONE, _NONE, _NONE, _NONE, np.zeros((0, len(_PROFILE)))
)


@dataclass(frozen=True, slots=True, eq=False)
class _BinaryChanges:
    """Where binary lines change, columns and rows as one row of pixels after another.

    Attributes:
        light: (s,) of all lines.
        first: (k,) index of the pixel with which the change's line begins.
        length: (k,) px of that line.
        start: (k,) px along it, the change's pixel on the bright side.
        step: (k,) 1 or -1, to the bright side.
    """

    light: FloatArray
    first: IntArray
    length: IntArray
    start: IntArray
    step: IntArray

    def along(self, which: IntArray | slice, index: IntArray) -> FloatArray:
        """Return the light (k, m) of the lines of those changes at places (k, m) along them."""
        last = self.length[which, None] - 1
        return np.asarray(self.light[self.first[which, None] + np.minimum(np.maximum(index, 0), last)])


def _line_edges(
    light: list[FloatArray],
    bright: list[BoolArray],
    places: tuple[IntArray, IntArray],
    span: float,
    least: float,
) -> ScanEdges:
    """Return the edges of columns and rows (n, m) each, that lie at `places` (n,)."""
    parts, read = [], 0
    for direction, binary in enumerate(bright):
        line, before = np.nonzero(binary[:, 1:] != binary[:, :-1])
        size, same = binary.shape[1], np.ones(len(line), dtype=int)
        numbers = read + line * size, size * same, before, binary[line, before + 1], places[direction][line]
        parts.append((*numbers, direction * same))
        read += binary.size
    begin, length, at, rising, other, axis = (np.concatenate(each) for each in zip(*parts, strict=True))
    step = np.where(rising, 1, -1)
    changes = _BinaryChanges(
        np.concatenate([each.ravel() for each in light]), begin, length, at + rising, step
    )
    offset, scale, height = _refined(changes, least * span)
    place = changes.start + step * offset
    margin = np.maximum(_MARGIN, 0.5 * scale)
    kept = np.flatnonzero((height > least * span) & (place > margin) & (place < length - 1 - margin))
    place, scale, height = place[kept], scale[kept], height[kept] / span
    step, other, axis, last = step[kept], other[kept], axis[kept], length[kept] - 1
    count = np.arange(len(kept))
    points, towards = np.empty((len(kept), 2)), np.zeros((len(kept), 2))
    # On a column, axis 0, the place is y.
    points[count, axis], points[count, 1 - axis], towards[count, 1 - axis] = other, place, step
    index = np.rint(place).astype(int)[:, None] + step[:, None] * _PROFILE
    profile = changes.along(kept, index)
    profile[(index < 0) | (index > last[:, None])] = np.nan
    behind: IntArray = np.rint(place - step * (_REACH * scale + 4.0)).astype(int)
    background = changes.along(kept, behind[:, None])[:, 0]
    return ScanEdges(points, towards, scale, height, _FLOOR + _SHARE * scale, background, profile)


def _refined(changes: _BinaryChanges, weak: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return offsets (k,) px from each start towards the bright, scales (k,), heights of the steps (k,).

    A step lower than `weak` is not an edge.
    """
    count = len(changes.start)
    offset, height = np.zeros(count), np.zeros(count)
    scale = np.ones(count)
    open_ = np.arange(count)
    largest = changes.length / (4.0 * (_REACH + _TAIL))
    for size in _SCALES:
        if size > 1.0:
            open_ = open_[largest[open_] >= size]
        if not len(open_):
            break
        place, peak = _steepest(changes, open_, size)
        # Noise steeper than a wide edge is at a small scale must not end the search there.
        before = height[open_]
        gains = (peak > _OUTGROWN * before) | ((before < weak) & (peak > before))
        open_ = open_[gains]
        offset[open_], height[open_], scale[open_] = place[gains], peak[gains], size
    return offset, scale, height


def _steepest(changes: _BinaryChanges, which: IntArray, size: float) -> tuple[FloatArray, FloatArray]:
    """Return where (k,) each line is steepest near its start, and the height of a sharp step as steep."""
    window, slope, reach = _slope(size)
    index = changes.start[which, None] + changes.step[which, None] * window
    slopes = changes.along(which, index) @ slope
    best = np.minimum(np.maximum(np.argmax(slopes, axis=1), 1), slopes.shape[1] - 2)
    k = np.arange(len(which))
    left, middle, right = slopes[k, best - 1], slopes[k, best], slopes[k, best + 1]
    bend = np.minimum(left - 2.0 * middle + right, -1e-300)
    shift = np.minimum(np.maximum(0.5 * (left - right) / bend, -1.0), 1.0)
    return best - reach + shift, middle


@lru_cache(maxsize=16)
def _slope(size: float) -> tuple[IntArray, FloatArray, int]:
    """Return offsets (w,) px, the matrix (w, p) from light there to slopes at places about 0, their reach.

    A sharp unit step has the slope 1 at every scale.
    """
    half, reach = int(np.ceil(_TAIL * size)), int(np.ceil(_REACH * size)) + 1
    x: FloatArray = np.arange(-half, half + 1, dtype=float)
    kernel = x * np.exp(-0.5 * (x / size) ** 2)
    # A step between two pixels: the sum over one side.
    kernel = kernel / np.sum(kernel[x > 0])
    window = np.arange(-reach - half, reach + half + 1)
    matrix = np.zeros((len(window), 2 * reach + 1))
    for place in range(2 * reach + 1):
        matrix[place : place + len(kernel), place] = kernel
    return window, matrix, reach


_RIGHT: FloatArray = np.array([1.0, 0.0])
_DOWN: FloatArray = np.array([0.0, 1.0])
_SAMPLE = 32
"""Distance between samples along a line (px)."""


@dataclass(frozen=True, slots=True, eq=False)
class EdgeRays:
    """Edges as directions.

    Attributes:
        rays: (n, 3) unit, camera axes.
        brighter: (n, 3) the ray's change over one pixel towards the bright side along the scan line.
        pixel: (n,) rad, the size of a pixel there.
    """

    rays: FloatArray
    brighter: FloatArray
    pixel: FloatArray

    def __len__(self) -> int:
        return len(self.rays)

    def chosen(self, which: BoolArray | IntArray) -> EdgeRays:
        """Return the edges `which`, flags (n,) or indices."""
        return EdgeRays(self.rays[which], self.brighter[which], self.pixel[which])


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Pixels on the lines that were read: directions (m, 3), and whether they are bright (m,)."""

    rays: FloatArray
    bright: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """Edges and samples as seen from the camera.

    Attributes:
        space: px between the lines that were read.
        edges: in pixels.
        rays: the same as directions.
        across, down: (n, 3) the ray's change over a pixel to the right, and downwards.
        samples: where it is bright.
    """

    space: float
    edges: ScanEdges
    rays: EdgeRays
    across: FloatArray
    down: FloatArray
    samples: Samples


def observe(
    edges: ScanEdges, lines: ScanLines, camera: CameraModel, samples: Samples | None = None
) -> Observation:
    """Return edges and samples as directions; edges outside the lens's image are excluded.

    `samples` replace those of the lines.
    """
    count = len(edges)
    rays = camera.unit_vectors(np.concatenate([edges.points, edges.points + _RIGHT, edges.points + _DOWN]))
    here = rays[:count]
    across, down = rays[count : 2 * count] - here, rays[2 * count :] - here
    seen = np.isfinite(here[:, 0]) & np.isfinite(across[:, 0]) & np.isfinite(down[:, 0])
    if not seen.all():
        edges, here, across, down = edges.chosen(seen), here[seen], across[seen], down[seen]
    brighter = edges.towards[:, :1] * across + edges.towards[:, 1:] * down
    return Observation(
        lines.space,
        edges,
        EdgeRays(here, brighter, np.sqrt(np.einsum("ij,ij->i", brighter, brighter))),
        across,
        down,
        _samples_of_lines(lines, camera) if samples is None else samples,
    )


def _samples_of_lines(lines: ScanLines, camera: CameraModel) -> Samples:
    bright = []
    for binary in (lines.column_bright, lines.row_bright):
        bright.append(binary[:, _along(binary.shape[1])].ravel())
    rays, imaged = _sample_rays(Lens.of(camera), tuple(lines.columns.tolist()), tuple(lines.rows.tolist()))
    return Samples(rays, np.concatenate(bright)[imaged])


def _along(size: int) -> IntArray:
    """Return the places of the samples along a line of `size` px."""
    return np.arange(_SAMPLE // 2, size, _SAMPLE * max(1, size // 512))


@lru_cache(maxsize=8)
def _sample_rays(
    camera: Lens, columns: tuple[int, ...], rows: tuple[int, ...]
) -> tuple[FloatArray, BoolArray]:
    """Return directions (m, 3) of the samples on those lines, and which of all of them the lens images.

    They are the same in frame after frame.
    """
    x, y = np.meshgrid(columns, _along(camera.rows), indexing="ij")
    other_y, other_x = np.meshgrid(rows, _along(camera.columns), indexing="ij")
    points = np.concatenate(
        [np.stack([x.ravel(), y.ravel()], axis=1), np.stack([other_x.ravel(), other_y.ravel()], axis=1)]
    )
    rays = camera.unit_vectors(points.astype(float))
    imaged = np.isfinite(rays[:, 0])
    return rays[imaged], imaged
