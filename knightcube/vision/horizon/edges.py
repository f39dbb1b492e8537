"""Sub-pixel edges along scan lines of an image, as pixel positions and as directions.

Selected columns and rows of the image are normalised, thresholded and filtered as in Meller et al., section
3.1. Each change from dark to bright is located at the point of maximum slope of the brightness, smoothed by a
Gaussian. The width of the smoothing Gaussian is doubled as long as the edge is wider than the Gaussian
(Lindeberg 1998, International Journal of Computer Vision 30, 117). Sharp edges and edges a hundred pixels
wide are therefore both located at the steepest point of the brightness.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, Image, IntArray, select
from knightcube.vision.camera.lens import CameraModel, Lens
from knightcube.vision.horizon.settings import EdgeSettings, light_of

RUN = 5
"""Window (px) of the majority filter that removes short runs of dark or bright pixels."""


def run_filtered(binary: BoolArray, run: int = RUN) -> BoolArray:
    """Return scan lines (n, m) of dark and bright pixels after a majority filter of `run` px, an odd number.

    Each scan line is extended by repeating its end pixels. Source: Meller et al., section 3.1, step 2.
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
"""Standard deviations (px) of the Gaussians that smooth the brightness along a scan line, ascending."""
_REACH = 3.0
"""Half-width of the search for an edge around a change of brightness, in standard deviations of the Gaussian.
"""
_TAIL = 3.5
"""Distance from the centre at which the Gaussian is truncated, in standard deviations."""
_OUTGROWN = 1.4
"""Minimum step height for the use of a wider Gaussian, relative to the step height with a narrower one."""
_MARGIN = 4.0
"""Distance from the image border (px) within which edges are ignored. Some detectors have a black border."""
_FLOOR, _SHARE = 0.1, 0.05
"""Prior error of an edge's position: a constant (px), and a fraction of the Gaussian's standard deviation."""
_SAMPLES = 2048
"""Number of pixels from which the brightness levels of dark and bright pixels are determined."""
_STEP_TO_SIGMA = 1.4826 / 2.0**0.5
"""Ratio of the standard deviation of Gaussian noise to the median absolute difference of two pixels."""
_STANDS_OUT = 6.0
"""Threshold above which a pixel counts as bright, in standard deviations of the dark pixels."""
_LEAST_LIT = 16
"""Minimum number of bright pixels of an image; fewer bright pixels may be hot pixels or stars."""
_WINDOW = 9
"""Minimum distance (px) along a scan line between an edge and a pixel that shows the spacecraft."""
_PROFILE: IntArray = np.arange(-_WINDOW, 6)
"""Positions of the samples of a stored brightness profile, in px from the edge towards the bright side."""


@dataclass(frozen=True, slots=True)
class Levels:
    """Brightness levels of an image: mean and noise of dark pixels, and median of bright pixels."""

    dark: float
    bright: float
    noise: float


@dataclass(frozen=True, slots=True, eq=False)
class ScanLines:
    """The columns and rows of an image that the edge search reads.

    Attributes:
        columns, rows: indices of the columns and of the rows.
        bright: masks (n, m) of the pixels of columns and rows that are bright after the majority filter.
        light: brightness of the pixels of the columns and of the rows (n, m).
        space: distance between neighbouring columns, and between neighbouring rows, px.
        levels: brightness levels of dark and bright pixels.
        hidden: mask of the image's pixels that show the spacecraft's own structure (rows, columns), or None.
    """

    columns: IntArray
    rows: IntArray
    bright: list[BoolArray]
    light: list[FloatArray]
    space: float
    levels: Levels
    hidden: BoolArray | None = None

    @property
    def pixels(self) -> int:
        """The number of pixels that the edge search reads."""
        return sum(each.size for each in self.bright)


@dataclass(frozen=True, slots=True, eq=False)
class ImagePart:
    """A rectangle of an image in which a second search finds edges on more scan lines.

    The rows of `box` (2, 2) are the lowest and the highest (x, y), px. The brightness levels are those of the
    whole image.
    """

    box: FloatArray
    levels: Levels


@dataclass(frozen=True, slots=True, eq=False)
class ScanEdges:
    """Edges at which a scan line changes from dark to bright.

    Attributes:
        points: positions of the edges (n, 2), px.
        towards: unit vectors along the scan line towards the bright side (n, 2).
        scale: standard deviation of the smoothing Gaussian with which each edge was found (n,), px.
        sigma: prior standard deviation of each edge's position along the scan line (n,), px.
        background: brightness of the dark side (n,), low at limb and terminator, higher at coasts and clouds.
        profile: brightness samples along the scan line, from dark to bright (n, m); NaN outside the image.
    """

    points: FloatArray
    towards: FloatArray
    scale: FloatArray
    sigma: FloatArray
    background: FloatArray
    profile: FloatArray

    @property
    def profile_steps(self) -> FloatArray:
        """The positions of the profile samples (n, m), in px from the edge towards the bright side."""
        # The brightness profile is centred on the pixel nearest to the edge, not on the edge.
        place = np.sum(self.points * self.towards, axis=1)
        return np.asarray((np.rint(place) - place)[:, None] + _PROFILE)

    def __len__(self) -> int:
        return len(self.points)


def find_edges(
    image: Image, settings: EdgeSettings, part: ImagePart | None = None, hidden: BoolArray | None = None
) -> tuple[ScanEdges, ScanLines]:
    """Return edges on evenly spaced columns and rows of an image (rows, columns), and the lines searched.

    If a `part` of the image is given, only scan lines that cross this part are searched. Pixels in the mask
    `hidden` (rows, columns) are not evaluated, and edges next to them are dropped.
    """
    places = []
    for axis, size in enumerate((image.shape[1], image.shape[0])):
        lines = min(settings.lines, size)
        place = np.asarray((np.arange(lines) + 0.5) * size / lines, dtype=int)
        if part is not None:
            place = place[(place >= part.box[0, axis]) & (place <= part.box[1, axis])]
        places.append(place)
    columns, rows = places
    space = max(1.0, max(image.shape) / settings.lines)
    light = [light_of(each, settings.response) for each in (image[:, columns].T, image[rows])]
    masked = None if hidden is None else [hidden[:, columns].T, hidden[rows]]
    levels = part.levels if part is not None else _levels(light, masked)
    span = levels.bright - levels.dark
    threshold = levels.dark + max(settings.threshold * span, _STANDS_OUT * levels.noise)
    bright = [run_filtered(each > threshold, settings.run) for each in light]
    read = ScanLines(columns, rows, bright, light, space, levels, hidden)
    if not levels.bright > levels.dark or not len(columns) + len(rows):
        none = np.zeros(0)
        empty = np.zeros((0, 2))
        return ScanEdges(empty, empty, none, none, none, np.zeros((0, len(_PROFILE)))), read
    edges = _line_edges(light, bright, (columns, rows), settings.contrast * span)
    if hidden is not None:
        # Hidden pixels within the distance `reach` would affect the position of an edge.
        reach = np.maximum(_WINDOW, (_REACH + _TAIL) * edges.scale)
        steps = np.linspace(-1.0, 1.0, 2 * _WINDOW + 1)
        points = edges.points[:, None] + edges.towards[:, None] * (reach[:, None] * steps)[..., None]
        edges = select(edges, np.asarray(~_at(hidden, points).any(axis=1)))
    most = settings.most * settings.lines
    if len(edges) > most:
        edges = select(edges, np.argsort(edges.background, kind="stable")[:most])
    return edges, read


def _at(mask: BoolArray, points: FloatArray) -> BoolArray:
    """Return the values of a mask (rows, columns) at the nearest pixels to points (..., 2), px."""
    rows, columns = mask.shape
    x = np.clip(np.rint(points[..., 0]), 0, columns - 1).astype(int)
    y = np.clip(np.rint(points[..., 1]), 0, rows - 1).astype(int)
    return np.asarray(mask[y, x])


def _levels(light: list[FloatArray], masked: list[BoolArray] | None = None) -> Levels:
    """Return the brightness levels of scan lines; both levels are equal if too few pixels are bright.

    The bright level is the median of all pixels that exceed the noise of the dark pixels, so that the Sun's
    disc and hot pixels have no effect. Pixels in the masks `masked` of the scan lines are not used.
    """
    samples, steps = [], []
    for number, lines in enumerate(light):
        here, after = lines[:, :-1].ravel(), lines[:, 1:].ravel()
        if masked is not None:
            used = ~(masked[number][:, :-1] | masked[number][:, 1:]).ravel()
            here, after = here[used], after[used]
        pace = max(1, lines.size // _SAMPLES)
        samples.append(here[::pace])
        steps.append(after[::pace] - samples[-1])
    values = np.concatenate(samples)
    if len(values) < _LEAST_LIT:
        return Levels(0.0, 0.0, 0.0)
    order = np.sort(values)
    least, most = float(order[len(order) // 50]), float(order[-1 - len(order) // 200])
    dark = np.abs(np.concatenate(steps)[values <= least + 0.1 * (most - least)])
    middle = len(dark) // 2
    noise = float(np.partition(dark, middle)[middle]) * _STEP_TO_SIGMA
    # The second percentile of all pixels is about two standard deviations below the mean dark pixel.
    low = least + 2.0 * noise
    lit = order[np.searchsorted(order, low + max(_STANDS_OUT * noise, 0.05 * (most - low)), "right") :]
    if len(lit) < _LEAST_LIT or most <= low:
        return Levels(low, low, noise)
    return Levels(low, float(lit[len(lit) // 2]), noise)


@dataclass(frozen=True, slots=True, eq=False)
class _BinaryChanges:
    """Changes between dark and bright on scan lines, whose pixels are concatenated in a flat array.

    Attributes:
        light: brightness of the pixels of all scan lines (s,).
        first: index in `light` of the first pixel of the scan line on which each change lies (k,).
        length: length of the scan line on which each change lies (k,), px.
        start: position along the scan line of the first bright pixel of each change (k,), px.
        step: direction along the scan line towards the bright side of each change, 1 or -1 (k,).
    """

    light: FloatArray
    first: IntArray
    length: IntArray
    start: IntArray
    step: IntArray

    def along(self, which: IntArray, index: IntArray) -> FloatArray:
        """Return the brightness (k, m) at m positions `index` (k, m) along the scan lines of k changes."""
        last = self.length[which, None] - 1
        return np.asarray(self.light[self.first[which, None] + np.minimum(np.maximum(index, 0), last)])


def _line_edges(
    light: list[FloatArray], bright: list[BoolArray], places: tuple[IntArray, IntArray], contrast: float
) -> ScanEdges:
    """Return the edges on columns and rows whose step height exceeds `contrast`.

    Each other argument has two elements, one for the n columns and one for the n rows: their brightness
    `light` (n, m), masks `bright` of bright pixels (n, m) and indices in the image, `places` (n,).
    """
    parts, read = [], 0
    for direction, binary in enumerate(bright):
        line, before = np.nonzero(binary[:, 1:] != binary[:, :-1])
        size, same = binary.shape[1], np.ones(len(line), dtype=int)
        numbers = read + line * size, size * same, before, binary[line, before + 1], places[direction][line]
        parts.append((*numbers, direction * same))
        read += binary.size
    begin, length, at, rising, other, axis = (np.concatenate(each) for each in zip(*parts, strict=True))
    step = np.where(rising, 1, -1)
    flat = np.concatenate([each.ravel() for each in light])
    changes = _BinaryChanges(flat, begin, length, at + rising, step)
    offset, scale, height = _steepest_points(changes, contrast)
    place = changes.start + step * offset
    margin = np.maximum(_MARGIN, 0.5 * scale)
    kept = np.flatnonzero((height > contrast) & (place > margin) & (place < length - 1 - margin))
    place, scale = place[kept], scale[kept]
    step, other, axis, last = step[kept], other[kept], axis[kept], length[kept] - 1
    count = np.arange(len(kept))
    points, towards = np.empty((len(kept), 2)), np.zeros((len(kept), 2))
    # On a column (axis 0), the position along the scan line is the image coordinate y.
    points[count, axis], points[count, 1 - axis], towards[count, 1 - axis] = other, place, step
    index = np.rint(place).astype(int)[:, None] + step[:, None] * _PROFILE
    profile = changes.along(kept, index)
    profile[(index < 0) | (index > last[:, None])] = np.nan
    behind: IntArray = np.rint(place - step * (_REACH * scale + 4.0)).astype(int)
    background = changes.along(kept, behind[:, None])[:, 0]
    return ScanEdges(points, towards, scale, _FLOOR + _SHARE * scale, background, profile)


def _steepest_points(changes: _BinaryChanges, weak: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the steepest point of the brightness near each of k changes between dark and bright.

    The three returned arrays (k,) are the distance of the point from the start of the change, px, the
    standard deviation of the Gaussian that found the point, px, and the step height. The step height is the
    height of an unblurred step that has the same slope after the smoothing. A point with a step height below
    `weak` is not an edge.
    """
    count = len(changes.start)
    offset, height, scale = np.zeros(count), np.zeros(count), np.ones(count)
    open_ = np.arange(count)
    largest = changes.length / (4.0 * (_REACH + _TAIL))
    for size in _SCALES:
        if size > 1.0:
            open_ = open_[largest[open_] >= size]
        if not len(open_):
            break
        window, slope, reach = _slope_matrix(size)
        index = changes.start[open_, None] + changes.step[open_, None] * window
        slopes = changes.along(open_, index) @ slope
        best = np.minimum(np.maximum(np.argmax(slopes, axis=1), 1), slopes.shape[1] - 2)
        k = np.arange(len(open_))
        left, peak, right = slopes[k, best - 1], slopes[k, best], slopes[k, best + 1]
        bend = np.minimum(left - 2.0 * peak + right, -1e-300)
        place = best - reach + np.minimum(np.maximum(0.5 * (left - right) / bend, -1.0), 1.0)
        # A step lower than the threshold `weak` is noise, so the search continues with wider Gaussians.
        before = height[open_]
        gains = (peak > _OUTGROWN * before) | ((before < weak) & (peak > before))
        open_ = open_[gains]
        offset[open_], height[open_], scale[open_] = place[gains], peak[gains], size
    return offset, scale, height


@lru_cache(maxsize=16)
def _slope_matrix(size: float) -> tuple[IntArray, FloatArray, int]:
    """Return the matrix that computes the smoothed slope at p positions from the brightness of w pixels.

    The three returned values are the offsets (w,) of the pixels from the centre, px, the matrix (w, p), and
    the largest offset of the p positions, px. The smoothing Gaussian has the standard deviation `size`, px.
    The matrix is scaled so that a sharp unit step has the slope 1 for every `size`.
    """
    half, reach = int(np.ceil(_TAIL * size)), int(np.ceil(_REACH * size)) + 1
    x: FloatArray = np.arange(-half, half + 1, dtype=float)
    kernel = x * np.exp(-0.5 * (x / size) ** 2)
    # The response to a step between two pixels is the sum of the positive half of the derivative kernel.
    kernel = kernel / np.sum(kernel[x > 0])
    window = np.arange(-reach - half, reach + half + 1)
    matrix = np.zeros((len(window), 2 * reach + 1))
    for place in range(2 * reach + 1):
        matrix[place : place + len(kernel), place] = kernel
    return window, matrix, reach


_SAMPLE = 32
"""Distance between samples along a scan line (px)."""
_AVERAGED = 15
"""Number of pixels along a scan line over which the brightness of a sample is averaged."""


@dataclass(frozen=True, slots=True, eq=False)
class EdgeRays:
    """Edges as directions.

    Attributes:
        rays: unit vectors to the edges (n, 3), camera axes.
        brighter: derivative of the unit vector to each edge (n, 3) with respect to the position along the
            scan line, per pixel towards the bright side.
        pixel: angular size of a pixel at each edge (n,), rad.
    """

    rays: FloatArray
    brighter: FloatArray
    pixel: FloatArray

    def __len__(self) -> int:
        return len(self.rays)


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Sampled pixels of the scan lines.

    Attributes:
        rays: unit vectors to the sampled pixels (m, 3), camera axes.
        bright: whether each sampled pixel is bright (m,).
        level: mean brightness around each sampled pixel (m,), 0 at the dark level and 1 at the bright level.
        mottle: texture of the image at each sampled pixel (m,), measured by the second difference of `level`
            along the scan line. The second difference is divided by 6^0.5, so that white noise has the same
            standard deviation in `mottle` and in `level`.
        noise: standard deviation of `level` due to the noise of dark pixels.
        floor: dark level of the image divided by the bright level.
    """

    rays: FloatArray
    bright: BoolArray
    level: FloatArray
    mottle: FloatArray
    noise: float
    floor: float


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """Edges and sampled pixels of an image as directions in camera axes.

    Attributes:
        space: distance between the scan lines, px.
        edges: detected edges as pixel positions.
        rays: detected edges as directions.
        across, down: derivatives of the unit vectors to the edges (n, 3), per pixel to the right and down.
        samples: directions and brightness of sampled pixels on the scan lines.
        hidden: mask of the pixels that show the spacecraft's own structure (rows, columns), or None.
    """

    space: float
    edges: ScanEdges
    rays: EdgeRays
    across: FloatArray
    down: FloatArray
    samples: Samples
    hidden: BoolArray | None = None

    def visible(self, points: FloatArray) -> BoolArray:
        """Return which points (n, 2), px, are far enough from hidden pixels for edges to be found there."""
        if self.hidden is None:
            return np.ones(len(points), dtype=bool)
        around = np.stack(np.meshgrid(*(_WINDOW * np.arange(-1.0, 2.0),) * 2), axis=-1).reshape(-1, 2)
        finite = np.asarray(np.isfinite(points).all(axis=1))
        covered = _at(self.hidden, np.where(finite[:, None], points, 0.0)[:, None] + around).any(axis=1)
        return np.asarray(finite & ~covered)


def observe(
    edges: ScanEdges, lines: ScanLines, camera: CameraModel, samples: Samples | None = None
) -> Observation:
    """Return edges and sampled pixels as directions, except edges at pixels that the lens does not image.

    If `samples` is given, these samples are used instead of samples of the scan lines.
    """
    count = len(edges)
    right, below = edges.points + np.array([1.0, 0.0]), edges.points + np.array([0.0, 1.0])
    rays = camera.unit_vectors(np.concatenate([edges.points, right, below]))
    here = rays[:count]
    across, down = rays[count : 2 * count] - here, rays[2 * count :] - here
    seen = np.isfinite(here[:, 0]) & np.isfinite(across[:, 0]) & np.isfinite(down[:, 0])
    if not seen.all():
        edges, here, across, down = select(edges, seen), here[seen], across[seen], down[seen]
    brighter = edges.towards[:, :1] * across + edges.towards[:, 1:] * down
    if samples is None:
        sampled, imaged = _sample_rays(
            Lens.of(camera), tuple(lines.columns.tolist()), tuple(lines.rows.tolist())
        )
        bright = np.concatenate([each[:, _sample_places(each.shape[1])].ravel() for each in lines.bright])
        level, mottle = np.concatenate([_sample_levels(each, lines.levels) for each in lines.light], axis=1)
        if lines.hidden is not None:
            masked = lines.hidden[:, lines.columns].T, lines.hidden[lines.rows]
            seen = ~np.concatenate([_hidden_samples(each) for each in masked])
            sampled, imaged = sampled[seen[imaged]], imaged & seen
        noise = lines.levels.noise / (_span(lines.levels) * _AVERAGED**0.5)
        floor = lines.levels.dark / lines.levels.bright if lines.levels.bright > 0.0 else 0.0
        samples = Samples(sampled, bright[imaged], level[imaged], mottle[imaged], noise, floor)
    pixel = np.sqrt(np.einsum("ij,ij->i", brighter, brighter))
    rays_of_edges = EdgeRays(here, brighter, pixel)
    return Observation(lines.space, edges, rays_of_edges, across, down, samples, lines.hidden)


def _sample_places(size: int) -> IntArray:
    """Return the positions (px) of the sampled pixels along a scan line of `size` px."""
    return np.arange(_SAMPLE // 2, size, _SAMPLE * max(1, size // 512))


def _span(levels: Levels) -> float:
    """Return the difference between bright and dark level of an image; infinite if no pixel is bright."""
    return levels.bright - levels.dark if levels.bright > levels.dark else float("inf")


def _sample_levels(light: FloatArray, levels: Levels) -> FloatArray:
    """Return `Samples.level` and `Samples.mottle` of k samples of scan lines (n, m), as an array (2, k)."""
    size, half = light.shape[1], _AVERAGED + _AVERAGED // 2
    index = _sample_places(size)[:, None] + np.arange(-half, half + 1)
    around = light.take(np.minimum(np.maximum(index, 0), size - 1), axis=1)
    means = around.reshape(*around.shape[:2], 3, _AVERAGED).mean(axis=3)
    before, here, after = means.reshape(-1, 3).T
    mottle = (before - 2.0 * here + after) / 6.0**0.5
    return np.stack([here - levels.dark, mottle]) / _span(levels)


def _hidden_samples(masked: BoolArray) -> BoolArray:
    """Return which samples of scan lines include hidden pixels, given the mask (n, m) of hidden pixels."""
    size, half = masked.shape[1], _AVERAGED + _AVERAGED // 2
    index = _sample_places(size)[:, None] + np.arange(-half, half + 1)
    return np.asarray(masked[:, np.clip(index, 0, size - 1)].any(axis=2).ravel())


@lru_cache(maxsize=8)
def _sample_rays(
    camera: Lens, columns: tuple[int, ...], rows: tuple[int, ...]
) -> tuple[FloatArray, BoolArray]:
    """Return unit vectors (m, 3) to the sampled pixels in the field of the lens, and their mask (k,)."""
    x, y = np.meshgrid(columns, _sample_places(camera.rows), indexing="ij")
    other_y, other_x = np.meshgrid(rows, _sample_places(camera.columns), indexing="ij")
    points = np.stack(
        [np.concatenate([x.ravel(), other_x.ravel()]), np.concatenate([y.ravel(), other_y.ravel()])], axis=1
    )
    rays = camera.unit_vectors(points.astype(float))
    imaged = np.isfinite(rays[:, 0])
    return rays[imaged], imaged
