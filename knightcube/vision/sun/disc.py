"""The disc of the Sun in a frame: bright patches, the rim of a patch, and the circle through the rim.

A few rows are read by random access, and bright patches on them are candidates. The rim of a candidate is
traced along spokes. The circle starts from a consensus among triples of rim points and is refined by
geometric least squares (Gauss-Newton). Tukey's biweight of each point's distance from the circle (Huber 1981,
Robust Statistics, chapter 7) excludes a cloud beside the disc or a hot pixel on its rim.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import find_objects, label

from knightcube.astro.arrays import BoolArray, FloatArray, Image
from knightcube.astro.directions import tangent_basis
from knightcube.vision.camera.lens import CameraModel
from knightcube.vision.camera.pixel_access import PixelAccess

MOST_PATCHES = 4
"""Largest number of patches that are examined, the largest first."""
LEAST_PATCH = 3
"""Least number of pixels of a patch on the rows that are read: a chord of the Sun's disc, not a hot pixel."""


@dataclass(frozen=True, slots=True, eq=False)
class BrightPatch:
    """A bright patch: its `middle` (2,) px, and `half` px of its greater extent."""

    middle: FloatArray
    half: float


def bright_patches(
    pixels: PixelAccess, level: float, stride: int, narrowest: float, widest: float
) -> tuple[list[BrightPatch], bool]:
    """Return the patches above `level` counts on every `stride`th row, largest first.

    Patches narrower than `narrowest` px or wider than `widest` are excluded; the second value is whether
    any wide one was.
    """
    rows = np.arange(stride // 2, pixels.rows, stride)
    bright = pixels.read_rows(rows) >= level
    if not bright.any():
        return [], False
    # Labelling costs per pixel: only the box about all bright pixels is labelled.
    down, across = np.flatnonzero(bright.any(axis=1)), np.flatnonzero(bright.any(axis=0))
    top, left = int(down[0]), int(across[0])
    labels, count = label(bright[top : down[-1] + 1, left : across[-1] + 1])
    sizes = np.bincount(labels.ravel(), minlength=count + 1)[1:]
    boxes = find_objects(labels)
    patches: list[BrightPatch] = []
    wide = False
    for patch in np.argsort(-sizes, kind="stable").tolist():
        if sizes[patch] < LEAST_PATCH or len(patches) == MOST_PATCHES:
            break
        box = boxes[patch]
        extent = max((box[0].stop - box[0].start) * stride, box[1].stop - box[1].start)
        wide = wide or extent > widest
        if not narrowest <= extent <= widest:
            continue
        y, x = np.nonzero(labels[box] == patch + 1)
        y, x = y + box[0].start + top, x + box[1].start + left
        middle = np.array([x.mean(), rows[0] + stride * y.mean()])
        patches.append(BrightPatch(middle, 0.5 * extent))
    return patches, wide


def window(pixels: PixelAccess, middle: FloatArray, reach: float) -> tuple[Image, int]:
    """Return the rows within `reach` px of the point `middle` (2,), and the first one's number."""
    first = max(int(np.floor(middle[1] - reach)), 0)
    last = min(int(np.ceil(middle[1] + reach)), pixels.rows - 1)
    return pixels.read_rows(np.arange(first, last + 1)), first


SPOKES = 48
_STEP = 0.5
"""Distance between samples along a spoke (px)."""


@dataclass(frozen=True, slots=True, eq=False)
class Rim:
    """Rim points about a direction, in its tangent plane.

    Attributes:
        axis: (3,) unit vector in camera axes, where the spokes start.
        basis: (2, 3) axes of the plane.
        points: (n, 2) rad, of arc length from the axis: azimuthal equidistant.
        cut: number of `SPOKES` that left the frame before the rim.
        endless: number that met no rim within reach.
    """

    axis: FloatArray
    basis: FloatArray
    points: FloatArray
    cut: int
    endless: int

    def direction(self, point: FloatArray) -> FloatArray:
        """Return the unit vector (3,) in camera axes of a `point` (2,) rad in the tangent plane."""
        arc = float(np.hypot(*point))
        return np.asarray(np.cos(arc) * self.axis + np.sinc(arc / np.pi) * (point @ self.basis))


def trace(
    strip: Image, first_row: int, camera: CameraModel, axis: FloatArray, level: float, reach: float
) -> Rim:
    """Return the rim about `axis` (3,) within `reach` rad, in `strip`, rows from `first_row` on."""
    basis = tangent_basis(axis)
    angle = np.arange(SPOKES) * (2.0 * np.pi / SPOKES)
    ways = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    step = _STEP / camera.focal_length
    arcs = np.arange(int(reach / step) + 1) * step
    rays = np.cos(arcs)[:, None] * axis + np.sin(arcs)[:, None] * (ways @ basis)[:, None, :]
    counts = sample(strip, first_row, camera.project(rays.reshape(-1, 3))).reshape(SPOKES, -1)
    inner, outer = counts[:, :-1], counts[:, 1:]
    # Outside the frame the counts are NaN, and no comparison holds.
    falls = (inner >= level) & (outer < level)
    crosses = falls.any(axis=1)
    at = falls.argmax(axis=1)[crosses]
    inside, outside = inner[crosses, at], outer[crosses, at]
    arc = step * (at + (inside - level) / (inside - outside))
    leaves = np.isnan(counts).any(axis=1)
    cut, endless = np.count_nonzero(leaves & ~crosses), np.count_nonzero(~leaves & ~crosses)
    return Rim(axis, basis, arc[:, None] * ways[crosses], int(cut), int(endless))


def sample(strip: Image, first_row: int, points: FloatArray) -> FloatArray:
    """Return the counts (n,) at `points` (n, 2), bilinear between pixels; NaN outside the strip."""
    rows, columns = strip.shape
    x, y = points[:, 0], points[:, 1] - first_row
    inside = (x >= 0.0) & (x <= columns - 1.0) & (y >= 0.0) & (y <= rows - 1.0)
    x, y = np.where(inside, x, 0.0), np.where(inside, y, 0.0)
    column = np.minimum(x.astype(int), max(columns - 2, 0))
    row = np.minimum(y.astype(int), max(rows - 2, 0))
    x, y = x - column, y - row
    flat = strip.reshape(-1)
    corner = row * columns + column
    right, down = (1 if columns > 1 else 0), (columns if rows > 1 else 0)
    top = flat[corner] * (1.0 - x) + flat[corner + right] * x
    bottom = flat[corner + down] * (1.0 - x) + flat[corner + down + right] * x
    return np.where(inside, top * (1.0 - y) + bottom * y, np.nan)


LEAST_POINTS = 6

_STEPS = 10
_LAST_STEP = 1e-2
"""Step that ends the iteration, as a fraction of a point's error."""
_MOST_ALIKE = 0.9
"""Largest correlation between neighbours' errors that is assumed."""
_TUKEY = 4.685
"""Cut-off of the biweight, in scales: 95 % efficient for Gaussian errors."""
_NEARLY_AS_MANY = 0.75
"""Share of the best consensus with which a smaller circle is preferred: stray light enlarges the disc."""


@dataclass(frozen=True, slots=True, eq=False)
class Circle:
    """A circle in a plane; lengths in the unit of the points.

    Attributes:
        centre: (2,).
        radius: greater than 0.
        used: which of the points (n,) it was fitted to.
        residual: rms of their distances from it.
        shape: (2, 2), the centre's covariance for unit variance of each point; with the
            measured correlation of neighbours' errors.
    """

    centre: FloatArray
    radius: float
    used: BoolArray
    residual: float
    shape: FloatArray


def fit_circle(points: FloatArray, scale: float) -> Circle | None:
    """Return the circle of `points` (n, 2), in order round it, or None without one.

    `scale` is the error of a good point.
    """
    start = _consensus(points, 2.5 * scale) if len(points) >= LEAST_POINTS else None
    if start is None:
        return None
    solution = start
    gate = _TUKEY * scale
    for _ in range(_STEPS):
        distance, slopes = _distances(points, solution)
        weight = np.maximum(1.0 - (distance / gate) ** 2, 0.0) ** 2
        used = weight > 0.0
        if np.count_nonzero(used) < LEAST_POINTS:
            return None
        weighted = slopes * weight[:, None]
        try:
            step = np.linalg.solve(weighted.T @ slopes, weighted.T @ distance)
        except np.linalg.LinAlgError:
            return None
        solution = solution - step
        if np.abs(step).max() < _LAST_STEP * scale:
            break
    distance, slopes = _distances(points, solution)
    left, slopes = distance[used], slopes[used]
    square = float(np.mean(left**2))
    if not (solution[2] > 0.0 and 0.0 < square < np.inf):
        return None
    # Correlated errors average out less: by (1 + r)/(1 - r) for a first-order process.
    alike = min(max(float(np.mean(left * np.roll(left, 1))) / square, 0.0), _MOST_ALIKE)
    shape = np.linalg.inv(slopes.T @ slopes)[:2, :2] * ((1.0 + alike) / (1.0 - alike))
    return Circle(solution[:2], float(solution[2]), used, float(np.sqrt(square)), np.asarray(shape))


def _distances(points: FloatArray, solution: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return how far (n,) the points lie outside the circle (x, y, radius), and the slopes (n, 3) of that."""
    offset = points - solution[:2]
    length = np.maximum(np.hypot(offset[:, 0], offset[:, 1]), 1e-12)
    slopes = np.concatenate([-offset / length[:, None], np.full((len(points), 1), -1.0)], axis=1)
    return length - solution[2], slopes


def _consensus(points: FloatArray, gate: float) -> FloatArray | None:
    """Return the circle (x, y, radius) through three of the points that most others lie on, within `gate`.

    Triples are evenly spaced along the rim, as wide as a third of it and as narrow as an eighth.
    """
    count = len(points)
    place = np.arange(0, count, 3)
    triples = [
        np.stack([place, (place + apart) % count, (place + 2 * apart) % count], axis=1)
        for apart in sorted({max(count // part, 1) for part in (3, 4, 6, 8)})
    ]
    first, second, third = np.moveaxis(points[np.concatenate(triples)], 1, 0)
    # Twice the circumcentre from the first point: of the bisectors of two chords.
    b, c = second - first, third - first
    cross = 2.0 * (b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0])
    sound = np.abs(cross) > 1e-9 * np.sum(b * b + c * c, axis=1)
    if not sound.any():
        return None
    first, b, c, cross = first[sound], b[sound], c[sound], cross[sound]
    bb, cc = np.sum(b * b, axis=1), np.sum(c * c, axis=1)
    aside = np.stack([c[:, 1] * bb - b[:, 1] * cc, b[:, 0] * cc - c[:, 0] * bb], axis=1) / cross[:, None]
    centre, radius = first + aside, np.hypot(aside[:, 0], aside[:, 1])
    away = np.hypot(points[:, 0] - centre[:, :1], points[:, 1] - centre[:, 1:])
    agreeing = np.count_nonzero(np.abs(away - radius[:, None]) < gate, axis=1)
    good = np.flatnonzero(agreeing >= _NEARLY_AS_MANY * agreeing.max())
    best = good[np.argmin(radius[good])]
    return np.array([*centre[best], radius[best]])
