"""Paths of stars and objects in an image during an exposure, and the images of their streaks.

A streak is the image of a point source that moves along its path at a constant rate. The camera's point
spread function (PSF) is a Gaussian. The image of a nearly straight streak is the product of its profiles
across and along the path. The image of any other streak is the sum of the images of the points of its path.
The functions that the search for objects calls most have a numpy form and a compiled form
(`knightcube.compiled`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector
from knightcube.compiled import compiled_form_of, loop_helper
from knightcube.vision.camera.lens import DistortedPinhole, Pinhole

# Spacing (px) of the Gaussians that model a streak; the ripple is 0.2 % for a PSF of 0.6 px.
_STEP_PX = 1.0
# Number of points of a star's path from which the length of the path is computed.
_SAMPLES = 17
# Distance at which the Gaussian PSF is truncated, in standard deviations.
_FARTHEST = 5.0
_BELL = 1.0 / math.sqrt(2.0 * math.pi)


_View = tuple[float, float, float]
"""Focal length and image centre (x, y) of a camera, px."""


def star_path(middle: FloatArray, rotation: FloatArray, pinhole: Pinhole) -> FloatArray:
    """Return points (m, 2), px, along the path of a star that is at `middle` (2,), px, at mid-exposure."""
    directions = pinhole.unit_vectors(middle[None])
    return np.asarray(star_paths(directions, rotation, np.array([0.5]), pinhole)[0])


def star_paths(
    directions: FloatArray, rotation: FloatArray, starts: FloatArray, pinhole: Pinhole
) -> FloatArray:
    """Return points (n, m, 2), px, along the paths of n stars during the exposure.

    The array `directions` (n, 3), camera axes, contains the direction of each star when it has covered the
    fraction `starts` (n,) of its path. All paths have the number of points that the longest path requires.
    """
    paths = _paths_on_circles(directions, rotation, starts, (pinhole.focal_length, *pinhole.centre))
    return pinhole.distorted(paths) if isinstance(pinhole, DistortedPinhole) else paths


def _paths_on_circles_numpy(
    directions: FloatArray, rotation: FloatArray, starts: FloatArray, view: _View
) -> FloatArray:
    focal, *centre = view

    def projected(parts: FloatArray) -> FloatArray:
        vectors = _rotated(directions, rotation, parts - starts[:, None])
        ahead = np.where(vectors[..., 2:] > 0.0, vectors[..., 2:], np.nan)
        return np.asarray(focal * vectors[..., :2] / ahead + np.array(centre))

    steps = np.diff(projected(np.linspace(0.0, 1.0, _SAMPLES)), axis=1)
    lengths = np.hypot(steps[..., 0], steps[..., 1]).sum(axis=1)
    count = _steps(float(np.max(lengths[np.isfinite(lengths)], initial=0.0)))
    return projected((np.arange(count) + 0.5) / count)


@compiled_form_of(_paths_on_circles_numpy)
def _paths_on_circles(
    directions: FloatArray, rotation: FloatArray, starts: FloatArray, view: _View
) -> FloatArray:
    focal, centre_x, centre_y = view
    stars, longest = len(starts), 0.0
    sampled = np.empty((_SAMPLES, 2))
    for star in range(stars):
        _set_circle(directions[star], rotation, -starts[star], 1.0 / (_SAMPLES - 1), focal, sampled)
        length = 0.0
        for k in range(_SAMPLES - 1):
            length += math.hypot(sampled[k + 1, 0] - sampled[k, 0], sampled[k + 1, 1] - sampled[k, 1])
        if math.isfinite(length) and length > longest:
            longest = length
    count = max(1, math.ceil(longest / _STEP_PX))
    points = np.empty((stars, count, 2))
    for star in range(stars):
        _set_circle(directions[star], rotation, 0.5 / count - starts[star], 1.0 / count, focal, points[star])
        for k in range(count):
            points[star, k, 0] += centre_x
            points[star, k, 1] += centre_y
    return points


@loop_helper
def _set_circle(
    star: FloatArray, rotation: FloatArray, first: float, step: float, focal: float, points: FloatArray
) -> None:
    """Set `points` (m, 2) to the image points, px from the centre, of a star after equal rotation steps."""
    angle = math.sqrt(rotation[0] ** 2 + rotation[1] ** 2 + rotation[2] ** 2)
    scale = 1.0 / angle if angle > 0.0 else 1.0
    a, b, c = rotation[0] * scale, rotation[1] * scale, rotation[2] * scale
    x, y, z = star[0], star[1], star[2]
    share = x * a + y * b + z * c
    u, v, w = share * a, share * b, share * c
    cosine, sine = math.cos(first * angle), math.sin(first * angle)
    next_cosine, next_sine = math.cos(step * angle), math.sin(step * angle)
    for k in range(len(points)):
        ahead = cosine * (z - w) + sine * (x * b - y * a) + w
        if ahead > 0.0:
            points[k, 0] = focal * (cosine * (x - u) + sine * (y * c - z * b) + u) / ahead
            points[k, 1] = focal * (cosine * (y - v) + sine * (z * a - x * c) + v) / ahead
        else:
            points[k, 0] = points[k, 1] = math.nan
        # Sine and cosine of the next step follow from the angle-addition formulas.
        before = cosine
        cosine, sine = before * next_cosine - sine * next_sine, sine * next_cosine + before * next_sine


def straight_path(ends: FloatArray, parts: FloatArray | None = None) -> FloatArray:
    """Return points (m, 2), px, on the straight line between two ends (2, 2), px.

    The points lie at the fractions `parts` (m,) of the line, or are evenly spaced if `parts` is None.
    """
    parts = _even_parts(ends) if parts is None else parts
    return np.asarray(ends[0] + parts[:, None] * (ends[1] - ends[0]))


def path_among_stars(
    ends: FloatArray, rotation: FloatArray, pinhole: Pinhole, parts: FloatArray | None = None
) -> FloatArray:
    """Return points (m, 2), px, of a uniform motion relative to the stars between two ends (2, 2), px.

    The motion may begin at either of the two ends. The slower of the two possible motions relative to the
    stars is assumed. The array `parts` (m,) contains the position of each point as a fraction of the motion,
    counted from the first of the `ends`. If `parts` is None, the points are evenly spaced.
    """
    parts = _even_parts(ends) if parts is None else parts
    view = (float(pinhole.focal_length), *pinhole.centre)
    if not isinstance(pinhole, DistortedPinhole):
        return _path_among_stars(ends, rotation, parts, view)
    return pinhole.distorted(_path_among_stars(pinhole.undistorted(ends), rotation, parts, view))


def _path_among_stars_numpy(
    ends: FloatArray, rotation: FloatArray, parts: FloatArray, view: _View
) -> FloatArray:
    focal, centre = view[0], np.array(view[1:])
    vectors = np.concatenate([(ends - centre) / focal, np.ones((2, 1))], axis=1)
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    # Each end is rotated to mid-exposure, both from the start and from the end of the exposure.
    middle = _rotated(vectors, rotation, np.array([[0.5, -0.5], [0.5, -0.5]]))
    apart = middle[1, 1] - middle[0, 0], middle[0, 1] - middle[1, 0]
    slower = int(apart[1] @ apart[1] < apart[0] @ apart[0])
    first, last = middle[slower, 0], middle[1 - slower, 1]
    parts = 1.0 - parts if slower else parts
    at = first + parts[:, None] * (last - first)
    at = _rotated(at, rotation, (parts - 0.5)[:, None])[:, 0]
    points = focal * at[:, :2] / np.where(at[:, 2:] > 0.0, at[:, 2:], np.nan) + centre
    return np.asarray(points)


@compiled_form_of(_path_among_stars_numpy)
def _path_among_stars(ends: FloatArray, rotation: FloatArray, parts: FloatArray, view: _View) -> FloatArray:
    focal, centre_x, centre_y = view
    angle = math.sqrt(rotation[0] ** 2 + rotation[1] ** 2 + rotation[2] ** 2)
    axis = rotation / (angle if angle > 0.0 else 1.0)
    middle, apart = np.empty((2, 2, 3)), np.zeros(2)
    for end in range(2):
        x, y = (ends[end, 0] - centre_x) / focal, (ends[end, 1] - centre_y) / focal
        size = math.sqrt(x * x + y * y + 1.0)
        for time in range(2):
            middle[end, time] = _turned(x / size, y / size, 1.0 / size, axis, (0.5 - time) * angle)
    for k in range(3):
        apart[0] += (middle[1, 1, k] - middle[0, 0, k]) ** 2
        apart[1] += (middle[0, 1, k] - middle[1, 0, k]) ** 2
    slower = int(apart[1] < apart[0])
    first, step = middle[slower, 0], middle[1 - slower, 1] - middle[slower, 0]
    points = np.empty((len(parts), 2))
    for k in range(len(parts)):
        part = 1.0 - parts[k] if slower else parts[k]
        x, y, z = first[0] + part * step[0], first[1] + part * step[1], first[2] + part * step[2]
        x, y, z = _turned(x, y, z, axis, (part - 0.5) * angle)
        points[k, 0] = centre_x + focal * x / z if z > 0.0 else math.nan
        points[k, 1] = centre_y + focal * y / z if z > 0.0 else math.nan
    return points


@loop_helper
def _turned(x: float, y: float, z: float, axis: FloatArray, angle: float) -> tuple[float, float, float]:
    """Return a direction after the rotation of the camera by `angle` (rad) about `axis` (3,)."""
    cosine, sine = math.cos(angle), math.sin(angle)
    a, b, c = axis[0], axis[1], axis[2]
    share = (x * a + y * b + z * c) * (1.0 - cosine)
    return (
        cosine * x + sine * (y * c - z * b) + share * a,
        cosine * y + sine * (z * a - x * c) + share * b,
        cosine * z + sine * (x * b - y * a) + share * c,
    )


def at_mid_exposure(vectors: FloatArray, rotation: FloatArray) -> FloatArray:
    """Return the directions (2, 3) of two stars at mid-exposure, in camera axes.

    The rows of `vectors` (2, 3) are the first star's direction at the start of the exposure, and the second
    star's direction at the end of the exposure.
    """
    turns = attitude_matrix(from_rotation_vector(np.array([[0.5], [-0.5]]) * rotation))
    return np.asarray(np.einsum("mij,mj->mi", turns, vectors))


def _rotated(directions: FloatArray, rotation: FloatArray, parts: FloatArray) -> FloatArray:
    """Return the directions (n, m, 3) of n stars after fractions `parts` (n, m) of the camera's rotation."""
    angle = float(np.linalg.norm(rotation))
    axis = rotation / angle if angle > 0.0 else rotation
    along = (directions @ axis)[:, None] * axis
    turned = (parts * angle)[..., None]
    x, y, z = directions.T
    a, b, c = axis
    crossed = np.stack([y * c - z * b, z * a - x * c, x * b - y * a], axis=-1)
    out = np.cos(turned) * (directions - along)[:, None]
    out += np.sin(turned) * crossed[:, None]
    out += along[:, None]
    return np.asarray(out)


def _even_parts(ends: FloatArray) -> FloatArray:
    """Return the positions (m,) of evenly spaced points between two ends (2, 2), px, as fractions."""
    steps = _steps(float(np.linalg.norm(ends[1] - ends[0])))
    return np.asarray((np.arange(steps) + 0.5) / steps)


def _steps(length: float) -> int:
    return max(1, int(np.ceil(length / _STEP_PX)))


def _pixels_near_numpy(points: FloatArray, reach: float, rows: int, columns: int) -> IntArray:
    points = np.rint(points)
    r = int(np.ceil(reach))
    inside = np.all((points >= -r) & (points < (columns + r, rows + r)), axis=-1)
    points = points[inside].astype(np.int64)
    first = points.min(axis=0, initial=columns + rows) - r
    width, height = np.maximum(points.max(axis=0, initial=0) + r + 1 - first, 1)
    # The points are widened along rows to the widths of a disc, then shifted along columns and combined.
    lit = np.zeros((height, width), dtype=np.bool_)
    lit[points[:, 1] - first[1], points[:, 0] - first[0]] = True
    marked = np.zeros_like(lit)
    wide = [lit]
    for right in range(1, r + 1):
        wide.append(wide[-1].copy())
        for step in (-right, right):
            wide[-1][:, _shifted(width, step)] |= lit[:, _shifted(width, -step)]
    for down in range(-r, r + 1):
        if abs(down) <= reach:
            half = math.floor(math.sqrt(reach**2 - down**2))
            marked[_shifted(height, down)] |= wide[half][_shifted(height, -down)]
    row, column = np.nonzero(marked)
    near = np.stack([column, row], axis=-1) + first
    return np.ascontiguousarray(near[np.all((near >= 0) & (near < (columns, rows)), axis=-1)])


def _shifted(count: int, step: int) -> slice:
    """Return the slice of an axis of `count` pixels that remains if an array is shifted by `step` pixels."""
    return slice(max(step, 0), count + min(step, 0))


@compiled_form_of(_pixels_near_numpy)
def pixels_near(points: FloatArray, reach: float, rows: int, columns: int) -> IntArray:
    """Return the pixels (p, 2), (x, y), within about `reach` px of any of the points (m, 2), row by row."""
    r = math.ceil(reach)
    centres = np.empty(points.shape, dtype=np.int64)
    count, low_x, low_y, high_x, high_y = 0, columns + r, rows + r, -r, -r
    for k in range(len(points)):
        x, y = np.rint(points[k, 0]), np.rint(points[k, 1])
        if -r <= x < columns + r and -r <= y < rows + r:
            column, row = int(x), int(y)
            centres[count, 0], centres[count, 1] = column, row
            count += 1
            low_x, high_x = min(low_x, column), max(high_x, column)
            low_y, high_y = min(low_y, row), max(high_y, row)
    if count == 0:
        return np.empty((0, 2), dtype=np.int64)
    half = np.empty(2 * r + 1, dtype=np.int64)
    for k in range(2 * r + 1):
        rest = reach**2 - (k - r) ** 2
        half[k] = math.floor(math.sqrt(rest)) if rest >= 0.0 else -1
    low_x, high_x = max(low_x - r, 0), min(high_x + r, columns - 1)
    low_y, high_y = max(low_y - r, 0), min(high_y + r, rows - 1)
    marked = np.zeros((high_y - low_y + 1, high_x - low_x + 1), dtype=np.bool_)
    spans = np.empty((len(marked), 2), dtype=np.int64)
    total = _mark_discs(centres[:count], half, low_x, low_y, marked, spans)
    near = np.empty((total, 2), dtype=np.int64)
    place = 0
    for row in range(len(marked)):
        for column in range(spans[row, 0], spans[row, 1] + 1):
            if marked[row, column]:
                near[place, 0], near[place, 1] = column + low_x, row + low_y
                place += 1
    return near


@loop_helper
def _mark_discs(
    centres: IntArray, half: IntArray, low_x: int, low_y: int, marked: BoolArray, spans: IntArray
) -> int:
    """Mark discs around `centres` (m, 2), set the span of each row, and return the number of marked pixels.

    The array `half` (2 r + 1,) contains the half-width of the disc in each row.
    """
    rows, columns = marked.shape
    r, total = len(half) // 2, 0
    spans[:, 0], spans[:, 1] = columns, -1
    # A disc is drawn only once at each pixel, because neighbouring paths have many points on the same pixels.
    drawn = np.zeros((rows + 2 * r, columns + 2 * r), dtype=np.bool_)
    for k in range(len(centres)):
        x, y = centres[k, 0] - low_x, centres[k, 1] - low_y
        if drawn[y + r, x + r]:
            continue
        drawn[y + r, x + r] = True
        for row in range(max(y - r, 0), min(y + r + 1, rows)):
            width = half[row - y + r]
            first, last = max(x - width, 0), min(x + width, columns - 1)
            for column in range(first, last + 1):
                if not marked[row, column]:
                    marked[row, column] = True
                    total += 1
            if first <= last:
                spans[row, 0], spans[row, 1] = min(spans[row, 0], first), max(spans[row, 1], last)
    return total


# Maximum number of nodes on a path. Between two nodes, the path is approximately straight.
_NODES = 33
# Minimum cosine between a nearly straight path and its chord.
_LEAST_AHEAD = 0.85
# Distance from a path, in standard deviations, beyond which the compiled form omits the light.
_DARK = 7.0
# Number of points of a path below which the streak's image is the sum of the images of the points.
_LEAST_POINTS = 4


def streak_at(pixels: IntArray, path: FloatArray, sigma: float) -> FloatArray:
    """Return the image (p,) on `pixels` (p, 2) of one streak along `path` (m, 2), px, see `streak_images`."""
    return np.asarray(streak_images(pixels, path[None], sigma, False)[0, 0])


def _streak_images_numpy(pixels: IntArray, paths: FloatArray, sigma: float, slopes: bool) -> FloatArray:
    images = np.zeros((len(paths), 3 if slopes else 1, len(pixels)))
    for path, image in zip(paths, images, strict=True):
        chord = path[-1] - path[0]
        length = float(np.linalg.norm(chord))
        steps = np.diff(path, axis=0)
        ahead = steps @ chord - _LEAST_AHEAD * length * np.hypot(steps[:, 0], steps[:, 1])
        if len(path) < _LEAST_POINTS or length == 0.0 or not ahead.min() >= 0.0:
            _add_points_numpy(image, pixels, path, sigma)
        else:
            _add_streak_numpy(image, pixels, path, sigma)
    return images


def _add_points_numpy(image: FloatArray, pixels: IntArray, points: FloatArray, sigma: float) -> None:
    """Add one count, divided equally among `points` (m, 2), to `image` (1, p), or (3, p) with derivatives."""
    columns, rows = np.ascontiguousarray(pixels.T)
    reach = _FARTHEST * sigma + 1.0
    for point in points:
        near = np.flatnonzero((np.abs(columns - point[0]) < reach) & (np.abs(rows - point[1]) < reach))
        edges = ((pixels[near] - point)[:, :, None] + np.array([-0.5, 0.5])) / sigma
        x, y = np.diff(ndtr(edges), axis=2)[..., 0].T / np.sqrt(len(points))
        image[0, near] += x * y
        if len(image) == 3:
            bells = np.exp(-0.5 * edges**2) / (np.sqrt(2.0 * np.pi * len(points)) * sigma)
            dx, dy = -np.diff(bells, axis=2)[..., 0].T
            image[1, near] += dx * y
            image[2, near] += x * dy


def _add_streak_numpy(image: FloatArray, pixels: IntArray, path: FloatArray, sigma: float) -> None:
    """Add one count along a nearly straight `path` (m, 2) to `image` (1, p), or (3, p) with derivatives."""
    chord = path[-1] - path[0]
    length = float(np.linalg.norm(chord))
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
    # Slope and spacing of the path's points are interpolated between the midpoints of adjacent segments.
    middles, slope, spacing = along[:-1] + 0.5 * gaps[0], gaps[1] / gaps[0], steps / np.diff(place)
    away = pixels - path[0]
    u, v = away @ tangent, away @ normal
    room = _FARTHEST * width
    near = (u > -room - 1.0) & (u < length + room + 1.0)
    near &= (v > across.min() - room - 1.0) & (v < across.max() + room + 1.0)
    chosen = np.flatnonzero(near)
    u, v = u[chosen], v[chosen]
    # The curve of the path is tabulated at every pixel along the chord.
    first = -math.ceil(room) - 1
    grid = np.arange(first, math.ceil(length + room) + 3, dtype=float)
    beyond = grid - np.clip(grid, along[0], along[-1])
    bends, paces = np.interp(grid, middles, slope), np.interp(grid, middles, spacing)
    centres = np.interp(grid, along, across) + beyond * bends
    arcs = np.interp(grid, along, arc) + beyond * np.sqrt(1.0 + bends**2)
    k = np.floor(u).astype(np.int64) - first
    part = u - grid[k]
    off = v - centres[k] - part * (centres[k + 1] - centres[k])
    bend, pace = 0.5 * (bends[k] + bends[k + 1]), 0.5 * (paces[k] + paces[k + 1])
    cosine = 1.0 / np.sqrt(1.0 + bend**2)
    n = off * cosine
    s = arcs[k] + part * (arcs[k + 1] - arcs[k]) + off * bend * cosine
    light = np.exp(-0.5 * (n / width) ** 2) / (np.sqrt(2.0 * np.pi) * width * pace * len(path))
    covered, sloping = _between_ends(s + 0.5 * spacing[0], arc[-1] + 0.5 * spacing[-1] - s, width)
    image[0, chosen] += light * covered
    if len(image) == 3:
        across_x, across_y = (cosine * (normal[k] - bend * tangent[k]) for k in (0, 1))
        along_x, along_y = (cosine * (tangent[k] + bend * normal[k]) for k in (0, 1))
        aside = covered * n / width**2
        image[1, chosen] += light * (aside * across_x - sloping * along_x)
        image[2, chosen] += light * (aside * across_y - sloping * along_y)


def _between_ends(start: FloatArray, stop: FloatArray, width: float) -> tuple[FloatArray, FloatArray]:
    """Return the brightness (n,) near the ends of a streak, relative to its middle, and the derivatives.

    The derivatives (n,), 1/px, are along the streak. The distances `start` and `stop` (n,) from the ends, px,
    are positive within the streak.
    """
    covered, sloping = np.ones(len(start)), np.zeros(len(start))
    for sign, distance in ((1.0, start), (-1.0, stop)):
        # An end affects only nearby pixels.
        ending = np.flatnonzero(distance < _FARTHEST * width)
        part = distance[ending] / width
        bell = np.exp(-0.5 * part**2) / (np.sqrt(2.0 * np.pi) * width)
        sloping[ending] = sloping[ending] * ndtr(part) + sign * covered[ending] * bell
        covered[ending] *= ndtr(part)
    return covered, sloping


@compiled_form_of(_streak_images_numpy)
def streak_images(pixels: IntArray, paths: FloatArray, sigma: float, slopes: bool) -> FloatArray:
    """Return the images (k, 1, p), on p pixels, of k streaks with a total flux of one count each.

    The count is distributed evenly over the points of the path. The image is the product of the profiles
    across and along the path, which are blurred by a Gaussian with the standard deviation `sigma`, px, and by
    the pixel. The error of the image is at most 2 % of its largest value. The image of a strongly curved path
    is the sum of the images of its points.

    The `pixels` (p, 2) must be sorted by row. The points of the `paths` (k, m, 2) are in px. If `slopes` is
    true, the result has the shape (k, 3, p): the image of each streak is followed by its derivatives, 1/px,
    with respect to displacements of the whole path along x and along y.
    """
    images = np.zeros((len(paths), 3 if slopes else 1, len(pixels)))
    for k in range(len(paths)):
        if _goes_ahead(paths[k]):
            _add_streak(images[k], pixels, paths[k], sigma)
        else:
            _add_points(images[k], pixels, paths[k], sigma)
    return images


@loop_helper
def _goes_ahead(path: FloatArray) -> bool:
    """Return whether a path (m, 2) is nearly straight."""
    m = len(path)
    x, y = path[m - 1, 0] - path[0, 0], path[m - 1, 1] - path[0, 1]
    length = math.hypot(x, y)
    if m < _LEAST_POINTS or length == 0.0:
        return False
    for k in range(m - 1):
        dx, dy = path[k + 1, 0] - path[k, 0], path[k + 1, 1] - path[k, 1]
        if not dx * x + dy * y >= _LEAST_AHEAD * length * math.hypot(dx, dy):
            return False
    return True


# Tables of the normal density and its integral: number of nodes per unit, and largest argument.
_FINE, _LARGEST = 64, 9.0
_ARGUMENTS = np.arange(-_LARGEST, _LARGEST + 0.5 / _FINE, 1.0 / _FINE)
_BELLS, _AREAS = _BELL * np.exp(-0.5 * _ARGUMENTS**2), ndtr(_ARGUMENTS)


@loop_helper
def _area(x: float) -> float:
    """Return the integral of the normal density from minus infinity to `x`, with an error below 1e-12."""
    if not abs(x) < _LARGEST:
        return 0.0 if x < 0.0 else 1.0
    k = int((x + _LARGEST) * _FINE + 0.5)
    node = k / _FINE - _LARGEST
    d = x - node
    # The Taylor series at the nearest node of the table takes less time than the error function.
    series = 1.0 - 0.5 * d * (node + d / 3.0 * (1.0 - node * node + 0.25 * d * node * (node * node - 3.0)))
    return float(_AREAS[k] + _BELLS[k] * d * series)


@loop_helper
def _bell(x: float) -> float:
    """Return the normal density at `x`, with an error below 1e-12."""
    if not abs(x) < _LARGEST:
        return 0.0
    k = int((x + _LARGEST) * _FINE + 0.5)
    node = k / _FINE - _LARGEST
    t = 0.5 * (node - x) * (node + x)
    return float(_BELLS[k] * (1.0 + t * (1.0 + 0.5 * t * (1.0 + t / 3.0 * (1.0 + 0.25 * t)))))


@loop_helper
def _add_points(image: FloatArray, pixels: IntArray, points: FloatArray, sigma: float) -> None:
    reach, share = _FARTHEST * sigma + 1.0, 1.0 / len(points)
    for k in range(len(points)):
        for p in range(len(pixels)):
            x, y = pixels[p, 0] - points[k, 0], pixels[p, 1] - points[k, 1]
            if not max(abs(x), abs(y)) < reach:
                continue
            left, right = (x - 0.5) / sigma, (x + 0.5) / sigma
            top, bottom = (y - 0.5) / sigma, (y + 0.5) / sigma
            across, down = _area(right) - _area(left), _area(bottom) - _area(top)
            image[0, p] += share * across * down
            if len(image) == 3:
                image[1, p] -= share * (_bell(right) - _bell(left)) / sigma * down
                image[2, p] -= share * (_bell(bottom) - _bell(top)) / sigma * across


@loop_helper
def _nodes_of(path: FloatArray, x: float, y: float) -> FloatArray:
    """Return coordinates (6, c) of c nodes of a path (m, 2), px, whose chord has the unit vector (`x`, `y`).

    The first three rows are the coordinates along and across the chord and the arc length. The next three
    rows are the middle of each of the c - 1 intervals between nodes, its slope and the spacing of its points.
    """
    m = len(path)
    count = min(_NODES, m)
    nodes = np.zeros((6, count))
    before = 0
    for k in range(count):
        place = k * (m - 1) // (count - 1)
        dx, dy = path[place, 0] - path[0, 0], path[place, 1] - path[0, 1]
        nodes[0, k], nodes[1, k] = dx * x + dy * y, dy * x - dx * y
        if k > 0:
            along, across = nodes[0, k] - nodes[0, k - 1], nodes[1, k] - nodes[1, k - 1]
            step = math.hypot(along, across)
            nodes[2, k] = nodes[2, k - 1] + step
            nodes[3, k - 1] = nodes[0, k - 1] + 0.5 * along
            nodes[4, k - 1], nodes[5, k - 1] = across / along, step / (place - before)
        before = place
    return nodes


@loop_helper
def _curve_of(nodes: FloatArray, first: int, count: int) -> FloatArray:
    """Return a table (4, count) of a path, one column for each pixel of the coordinate along its chord.

    The coordinate begins at `first`, px. The rows are the coordinate across the chord, the arc length, the
    slope, and the spacing of the points of the path. The array `nodes` (6, c) is that of `_nodes_of`.
    """
    last = nodes.shape[1] - 1
    along, middles, table = nodes[0], nodes[3, :last], np.empty((4, count))
    k, j = 0, 0
    for i in range(count):
        inside = min(max(float(first + i), 0.0), along[last])
        centred = min(max(float(first + i), middles[0]), middles[last - 1])
        while k < last - 1 and inside >= along[k + 1]:
            k += 1
        while j < last - 2 and centred >= middles[j + 1]:
            j += 1
        share = (centred - middles[j]) / (middles[j + 1] - middles[j])
        for row in range(2):
            table[2 + row, i] = nodes[4 + row, j] + share * (nodes[4 + row, j + 1] - nodes[4 + row, j])
        share, beyond, bend = (inside - along[k]) / (along[k + 1] - along[k]), first + i - inside, table[2, i]
        table[0, i] = nodes[1, k] + share * (nodes[1, k + 1] - nodes[1, k]) + beyond * bend
        table[1, i] = nodes[2, k] + share * (nodes[2, k + 1] - nodes[2, k])
        table[1, i] += beyond * math.sqrt(1.0 + bend * bend)
    return table


@loop_helper
def _first_from(pixels: IntArray, row: float) -> int:
    """Return the index of the first of the `pixels` (p, 2), sorted by row, that lies in `row` or after it."""
    low, high = 0, len(pixels)
    while low < high:
        middle = (low + high) // 2
        if pixels[middle, 1] < row:
            low = middle + 1
        else:
            high = middle
    return low


@loop_helper
def _add_streak(image: FloatArray, pixels: IntArray, path: FloatArray, sigma: float) -> None:
    m, width = len(path), math.sqrt(sigma**2 + 1.0 / 12.0)
    room, narrow = _FARTHEST * width, 1.0 / width
    x0, y0, light = path[0, 0], path[0, 1], image[0]
    x, y = path[m - 1, 0] - x0, path[m - 1, 1] - y0
    length = math.hypot(x, y)
    x, y, first = x / length, y / length, -math.ceil(room) - 1
    nodes = _nodes_of(path, x, y)
    last = nodes.shape[1] - 1
    curve = _curve_of(nodes, first, math.ceil(length + room) + 3 - first)
    centres, arcs, steps = curve[0], curve[1], curve[:, 1:] - curve[:, :-1]
    # Slope, cosine of its angle, and brightness change little within 1 px.
    bends, paces = curve[2:, :-1] + 0.5 * steps[2:]
    cosines = 1.0 / np.sqrt(1.0 + bends * bends)
    brightness = narrow / (m * paces)
    low, high = nodes[1].min() - room - 1.0, nodes[1].max() + room + 1.0
    begin, end = 0.5 * nodes[5, 0], nodes[2, last] + 0.5 * nodes[5, last - 1]
    top, bottom = path[:, 1].min() - room - 2.0, path[:, 1].max() + room + 2.0
    for p in range(_first_from(pixels, top), _first_from(pixels, bottom)):
        dx, dy = pixels[p, 0] - x0, pixels[p, 1] - y0
        u, v = dx * x + dy * y, dy * x - dx * y
        if u <= -room - 1.0 or u >= length + room + 1.0 or v <= low or v >= high:
            continue
        k = int(u - first)
        part, bend, cosine = u - first - k, bends[k], cosines[k]
        n = (v - centres[k] - part * steps[0, k]) * cosine
        if abs(n) > _DARK * width:
            continue
        s = arcs[k] + part * steps[1, k] + n * bend
        whole = _bell(n * narrow) * brightness[k]
        covered, sloping = 1.0, 0.0
        if s + begin < room:
            covered, sloping = _area((s + begin) * narrow), _bell((s + begin) * narrow) * narrow
        if end - s < room:
            part = _area((end - s) * narrow)
            sloping = sloping * part - covered * _bell((end - s) * narrow) * narrow
            covered *= part
        light[p] += whole * covered
        if len(image) == 3:
            aside = covered * n / width**2
            image[1, p] -= whole * cosine * (aside * (y + bend * x) + sloping * (x - bend * y))
            image[2, p] += whole * cosine * (aside * (x - bend * y) - sloping * (y + bend * x))


def line_image(
    ends: FloatArray, columns: int, rows: int, sigma: float
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return the image of a straight streak with a flux of one count between different `ends` (2, 2), px.

    The returned arrays are the flat indices of p pixels nearby (p,), five images on these pixels (5, p), and
    the unit vectors along and across the streak (2, 2). The five images are the counts, and the derivatives
    of the counts, 1/px, with respect to displacements of the first end along and across the streak, and of
    the second end along and across the streak.
    """
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
    # The second end moves each point by the point's position along the streak, as a fraction of the length.
    second = profile * (s * covered + width * (bell_a - bell_b)) / length
    aside = n / width**2
    first_along = whole / length - profile * bell_a / width
    last_along = profile * bell_b / width - whole / length
    images = np.stack([whole, first_along, aside * (whole - second), last_along, aside * second])
    return y[row] * columns + x[column], images, axes


# Largest step (px) in the fit of a line, step (px) below which the fit ends, and maximum number of steps.
_LARGEST_STEP, _CONVERGED, _FITS = 1.0, 0.02, 8
# Distance (standard deviations) from the end of a line beyond which the light does not depend on the end.
_COVERED = 8.5
# Regularisation of a fit to pixels: number added to the unit diagonal of the normal equations.
_RIDGE = 1e-6


def least_squares(images: FloatArray, target: FloatArray) -> FloatArray:
    """Return the least-squares coefficients (k,) of `images` (k, p), slightly regularised."""
    return solved(np.vstack([images @ images.T, images @ target]))


def _solved_numpy(sums: FloatArray) -> FloatArray:
    normal, right = sums[:-1], sums[-1]
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    normal = normal / np.outer(scale, scale) + _RIDGE * np.eye(len(scale))
    return np.asarray(np.linalg.solve(normal, right / scale) / scale)


@compiled_form_of(_solved_numpy)
def solved(sums: FloatArray) -> FloatArray:
    """Return the solution (k,) of k normal equations, which are regularised by `_RIDGE`.

    The array `sums` (k + 1, k) contains the matrix of the equations and, in its last row, their right-hand
    side.
    """
    return _solved(sums)


def _fitted_line_numpy(light: FloatArray, weight: FloatArray, ends: FloatArray, sigma: float) -> FloatArray:
    rows, columns = light.shape
    weights, lights = weight.reshape(-1), light.reshape(-1)
    for _ in range(_FITS):
        pixels, images, axes = line_image(ends, columns, rows, sigma)
        share = weights[pixels]
        solution = least_squares(images * share, lights[pixels] * share)
        if solution[0] <= 0.0:
            break
        steps = np.clip(solution[1:] / solution[0], -_LARGEST_STEP, _LARGEST_STEP).reshape(2, 2)
        ends = ends + steps @ axes
        if np.abs(steps).max() < _CONVERGED or np.all(ends[0] == ends[1]):
            break
    return ends


@compiled_form_of(_fitted_line_numpy)
def fitted_line(light: FloatArray, weight: FloatArray, ends: FloatArray, sigma: float) -> FloatArray:
    """Return the ends (2, 2), px, of the line that Gauss-Newton fits to the counts `light` (rows, columns).

    The reciprocal standard deviations of the pixels are `weight` (rows, columns), 1/counts. The two `ends`
    (2, 2), px, are an initial guess, and must differ.
    """
    ends = ends.copy()
    sums = np.empty((6, 5))
    for _ in range(_FITS):
        length = math.hypot(ends[1, 0] - ends[0, 0], ends[1, 1] - ends[0, 1])
        x, y = (ends[1, 0] - ends[0, 0]) / length, (ends[1, 1] - ends[0, 1]) / length
        _sum_line(light, weight, ends, sigma, sums)
        solution = _solved(sums)
        if solution[0] <= 0.0:
            break
        largest = 0.0
        for end in range(2):
            along = min(max(solution[2 * end + 1] / solution[0], -_LARGEST_STEP), _LARGEST_STEP)
            across = min(max(solution[2 * end + 2] / solution[0], -_LARGEST_STEP), _LARGEST_STEP)
            ends[end, 0] += along * x - across * y
            ends[end, 1] += along * y + across * x
            largest = max(largest, abs(along), abs(across))
        if largest < _CONVERGED or (ends[0, 0] == ends[1, 0] and ends[0, 1] == ends[1, 1]):
            break
    return ends


@loop_helper
def _sum_line(
    light: FloatArray, weight: FloatArray, ends: FloatArray, sigma: float, sums: FloatArray
) -> None:
    """Set `sums` (6, 5) to the normal equations of the five images of `line_image`, for use by `_solved`."""
    rows, columns = light.shape
    width = math.sqrt(sigma**2 + 1.0 / 12.0)
    reach = 4.0 * width
    length = math.hypot(ends[1, 0] - ends[0, 0], ends[1, 1] - ends[0, 1])
    x, y = (ends[1, 0] - ends[0, 0]) / length, (ends[1, 1] - ends[0, 1]) / length
    left = min(max(math.floor(min(ends[0, 0], ends[1, 0]) - reach), 0), columns)
    right = min(max(math.ceil(max(ends[0, 0], ends[1, 0]) + reach) + 1, 0), columns)
    top = min(max(math.floor(min(ends[0, 1], ends[1, 1]) - reach), 0), rows)
    bottom = min(max(math.ceil(max(ends[0, 1], ends[1, 1]) + reach) + 1, 0), rows)
    sums[:] = 0.0
    image = np.empty(5)
    for row in range(top, bottom):
        first, last = left, right
        if abs(y) > 1e-3:
            middle, half = ends[0, 0] + (row - ends[0, 1]) * x / y, reach / abs(y) + 1.0
            first = max(first, int(min(max(middle - half, left), right)))
            last = min(last, int(min(max(middle + half, left), right)) + 1)
        for column in range(first, last):
            dx, dy = column - ends[0, 0], row - ends[0, 1]
            n = dy * x - dx * y
            if abs(n) < reach:
                _set_pixel_of_line(dx * x + dy * y, n, width, length, image)
                share = weight[row, column] ** 2
                for k in range(5):
                    for other in range(k + 1):
                        sums[k, other] += share * image[k] * image[other]
                    sums[5, k] += share * image[k] * light[row, column]


@loop_helper
def _set_pixel_of_line(s: float, n: float, width: float, length: float, image: FloatArray) -> None:
    """Set `image` (5,) to the values of `line_image` at one pixel, s px along and n px across the line."""
    profile = _bell(n / width) / (width * length)
    a, b = s / width, (s - length) / width
    covered, bell_a, bell_b = 1.0, 0.0, 0.0
    if a < _COVERED or b > -_COVERED:
        covered, bell_a, bell_b = _area(a) - _area(b), _bell(a), _bell(b)
    whole = profile * covered
    second = profile * (s * covered + width * (bell_a - bell_b)) / length
    aside = n / width**2
    image[0] = whole
    image[1] = whole / length - profile * bell_a / width
    image[2] = aside * (whole - second)
    image[3] = profile * bell_b / width - whole / length
    image[4] = aside * second


@loop_helper
def _solved(sums: FloatArray) -> FloatArray:
    """Return the solution (k,) of k normal equations, which are regularised by `_RIDGE`.

    The array `sums` (k + 1, k) contains the matrix of the equations and, in its last row, their right-hand
    side. Only the lower triangle of the matrix is read. The method is the Cholesky decomposition.
    """
    size = sums.shape[1]
    scale, solution, lower = np.empty(size), np.empty(size), np.empty((size, size))
    for k in range(size):
        scale[k] = math.sqrt(max(sums[k, k], 1e-300))
    for k in range(size):
        for other in range(k + 1):
            value = sums[k, other] / (scale[k] * scale[other])
            value += _RIDGE if k == other else 0.0
            for j in range(other):
                value -= lower[k, j] * lower[other, j]
            lower[k, other] = math.sqrt(value) if k == other else value / lower[other, other]
        value = sums[size, k] / scale[k]
        for j in range(k):
            value -= lower[k, j] * solution[j]
        solution[k] = value / lower[k, k]
    for k in range(size - 1, -1, -1):
        for j in range(k + 1, size):
            solution[k] -= lower[j, k] * solution[j]
        solution[k] /= lower[k, k]
    return solution / scale


def spread_over(path: FloatArray, columns: int, rows: int, sigma: float) -> FloatArray:
    """Return the image (rows, columns) of a streak with a flux of one count along `path` (m, 2), px.

    The count is distributed evenly over the points of the path, and each point is blurred by a Gaussian with
    the standard deviation `sigma`, px.
    """
    x, y = _within_pixels(columns, path[:, 0], sigma), _within_pixels(rows, path[:, 1], sigma)
    return _added(x, y, x.values, y.values) / len(path)


def spread_with_slopes(
    path: FloatArray, shares: FloatArray, columns: int, rows: int, sigma: float
) -> list[FloatArray]:
    """Return the image of a streak with a flux of one count, and the derivatives of this image, 1/px.

    Each row of `shares` (k, m) gives two derivatives, for a displacement along x and for one along y. A
    displacement of 1 px moves each of the m points of the path by its share of 1 px.
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

    The pixel `first` (m,) of each profile may be outside the range of the axis. The `values` (m, w) are the
    integrals of the point spread function over the pixels.
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
    """Return the sum (rows, columns) of the images of m points, each the product of two profiles.

    The arrays `across` (m, w) and `down` (m, w) contain the profiles of each point along x and along y. The
    arguments `x` and `y` contain the first pixel of each profile.
    """
    width = across.shape[1]
    columns = x.count + 2 * width
    corner = (np.clip(y.first, -width, y.count) + width) * columns + np.clip(x.first, -width, x.count) + width
    step = (np.arange(width)[:, None] * columns + np.arange(width)).reshape(-1)
    light = (down[:, :, None] * across[:, None, :]).reshape(-1)
    rows = y.count + 2 * width
    image = np.bincount((corner[:, None] + step).reshape(-1), light, rows * columns).reshape(rows, columns)
    return np.asarray(image[width:-width, width:-width])
