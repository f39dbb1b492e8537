"""Faint streaks, once the motion is known: all stars turn by one angle about one axis.

The frame's 3 x 3 sums are sampled on circles about the axis; there every streak is straight and equally long,
and a running sum of that length is its matched filter. The response to a star is a triangle along its circle:
from the strongest peak on, each is believed only as far as it exceeds what those before it put there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from flight.arrays import BoolArray, FloatArray, IntArray
from flight.pinhole import Pinhole
from flight.vision.likelihood.chains import apart, circles
from flight.vision.likelihood.exposed_frame import ExposedFrame, Float32Array
from flight.vision.likelihood.motion import Motion, paths
from flight.vision.segmentation import box_sum, positions

# Spacing of the circles, px, and of the samples along them.
_ACROSS = 1.25
_ALONG = 2.5
# A streak needs this part of itself on the detector.
_LEAST_SEEN = 0.35
# Width of the point spread and the pixel together that the filter supposes, px.
_WIDTH = 1.05
_PASSES = 2
_RIDGE = 0.05
# Shorter streaks, px, are no lines that a filter could follow.
_LEAST_LENGTH = 6.0
# Circles so far apart share no light.
_FARTHEST = 5
# The part of a streak's light that falls in the three pixels across.
_CAPTURED = 0.83
# Noise of a sum of samples over a pixel's and the root of their number: nine pixels each, which overlap.
_SAMPLE_NOISE = 3.5
# A peak under another's shoulder must hold so much of what is there on its own.
_OWN_SHARE = 0.45
_MOST_PEAKS = 1500


@dataclass(frozen=True, slots=True, eq=False)
class FaintStars:
    """Streaks found: stars (n, 2) px at mid-exposure, light and significance (n,)."""

    stars: FloatArray
    light: FloatArray
    significance: FloatArray


def find_faint(
    frame: ExposedFrame, modelled: Float32Array, pinhole: Pinhole, motion: Motion, sigmas: float, most: int
) -> FaintStars:
    """Return the `most` strongest streaks along `motion` in the frame less `modelled` (rows * columns)."""
    middle = paths(pinhole, motion, np.array([pinhole.centre]), np.zeros(1)).velocity
    reach = float(np.linalg.norm(motion.turn)) * float(np.sin(pinhole.half_diagonal)) * pinhole.focal_length
    if max(float(np.hypot(*middle[0])), reach) < _LEAST_LENGTH:
        return FaintStars(np.empty((0, 2)), np.empty(0), np.empty(0))
    variance = frame.floor + np.maximum(modelled, 0.0) * np.float32(1.0 / frame.gain)
    difference = frame.signal - modelled
    difference[frame.bad] = 0.0
    # Where a bright star was taken out, what is left is mostly its own noise.
    difference *= frame.floor / variance
    grid = _circles(pinhole, motion)
    sums = box_sum(difference.reshape(frame.shape))
    samples = np.where(grid.inside, sums.reshape(-1)[grid.index], np.float32(0.0))
    response, count = _running(samples, grid)
    noise = _SAMPLE_NOISE * float(np.sqrt(np.median(frame.floor[::97]))) * np.sqrt(np.maximum(count, 1.0))
    noise[count < _LEAST_SEEN * grid.length] = np.inf
    row, column, height = _cleaned(response, noise, grid, sigmas, most)
    own = noise[np.rint(row).astype(int), np.rint(column).astype(int) % noise.shape[1]]
    order = np.argsort(-height / own, kind="stable")
    row, column, height, own = row[order], column[order], height[order], own[order]
    stars = _pixels(pinhole, grid, row, column - _off_centre(grid))
    seen = np.isfinite(stars).all(axis=1)
    travelled = grid.angle * np.interp(row, np.arange(len(grid.speed)), grid.speed)
    light = height / (3.0 * _CAPTURED * grid.length) * travelled
    return FaintStars(stars[seen], light[seen], (height / own)[seen])


def close_by(
    pinhole: Pinhole, motion: Motion, stars: FloatArray, others: FloatArray, distance: float
) -> BoolArray:
    """Tell which of `stars` (n, 2) draw streaks within `distance` px of a streak of `others` (m, 2)."""
    polar, azimuth = circles(pinhole, motion, stars)
    other_polar, other_azimuth = circles(pinhole, motion, others)
    beside = np.abs(polar[:, None] - other_polar) * pinhole.focal_length < distance
    room = distance / (pinhole.focal_length * np.maximum(np.sin(other_polar), 1e-3))
    angle = float(np.linalg.norm(motion.turn))
    return np.asarray((beside & (apart(azimuth, other_azimuth) < angle + room)).any(axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class _Circles:
    """Samples (r, c) on circles about the axis.

    `frame` (3, 3) has two axes across and the axis as rows; `polar` (r,) and `azimuth` (c,) rad; `index` and
    `inside` say where in the flat frame; `length` samples make a streak; `speed` (r,) px per rad.
    """

    frame: FloatArray
    polar: FloatArray
    azimuth: FloatArray
    index: IntArray
    inside: BoolArray
    length: float
    angle: float
    speed: FloatArray


def _circles(pinhole: Pinhole, motion: Motion) -> _Circles:
    angle = float(np.linalg.norm(motion.turn))
    axis = motion.turn / angle
    middle = np.array([0.0, 0.0, 1.0])
    if axis @ middle < 0.0:
        axis = -axis
    first = middle - (middle @ axis) * axis
    inside_field = float(np.arccos(np.clip(axis[2], -1.0, 1.0)))
    if np.linalg.norm(first) < 1e-6:
        first = np.array([1.0, 0.0, 0.0])
    first = first / np.linalg.norm(first)
    frame = np.stack([first, np.cross(axis, first), axis])
    half = pinhole.half_diagonal
    polar = np.arange(max(inside_field - half, 0.003), inside_field + half, _ACROSS / pinhole.focal_length)
    fastest = float(np.max(np.sin(polar))) * pinhole.focal_length
    step = min(_ALONG / fastest, angle / 6.0)
    widest = (
        np.pi if inside_field <= half else float(np.arcsin(min(np.sin(half) / np.sin(inside_field), 1.0)))
    )
    widest = min(widest + 0.5 * angle, np.pi)
    azimuth = np.arange(-widest, widest, step)
    cosine, sine = np.cos(polar)[:, None], np.sin(polar)[:, None]
    local = (sine * np.cos(azimuth), sine * np.sin(azimuth), cosine)
    x, y, z = (frame[0, k] * local[0] + frame[1, k] * local[1] + frame[2, k] * local[2] for k in range(3))
    scale = pinhole.focal_length / np.where(z > 0.1, z, np.inf)
    column = np.rint(scale * x + pinhole.centre[0]).astype(np.int64)
    row = np.rint(scale * y + pinhole.centre[1]).astype(np.int64)
    inside = (
        (z > 0.1) & (column >= 1) & (column < pinhole.columns - 1) & (row >= 1) & (row < pinhole.rows - 1)
    )
    index = np.where(inside, row * pinhole.columns + column, 0)
    return _Circles(
        frame, polar, azimuth, index, inside, angle / step, angle, np.sin(polar) * pinhole.focal_length
    )


def _running(samples: Float32Array, circles: _Circles) -> tuple[FloatArray, FloatArray]:
    """Return the sums (r, c) of samples within half a streak of each, and how many of them exist."""
    width = max(round(circles.length), 1)
    full = abs(float(circles.azimuth[-1] - circles.azimuth[0])) > 2.0 * np.pi - 0.05

    def summed(values: npt.NDArray[np.float32]) -> FloatArray:
        before, after = width // 2, width - width // 2
        mode = "wrap" if full else "constant"
        padded = np.pad(values, ((0, 0), (before + 1, after)), mode=mode)  # type: ignore[call-overload]  # str
        total = np.cumsum(padded, axis=1, dtype=np.float64)
        return np.asarray(total[:, width : width + values.shape[1]] - total[:, : values.shape[1]])

    return summed(samples), summed(circles.inside.astype(np.float32))


def _off_centre(circles: _Circles) -> float:
    """Return by how much an even number of samples is not about its middle one."""
    return 0.0 if round(circles.length) % 2 else 0.5


def _cleaned(
    response: FloatArray, noise: FloatArray, circles: _Circles, sigmas: float, most: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return rows, columns (between samples) and heights of the stars whose responses add up to `response`.

    Passes find the peaks that rise above what is left, solve the heights of all found together (their
    responses overlap), and take them out.
    """
    row, column, height = (np.empty(0) for _ in range(3))
    left = response
    for last in (False,) * (_PASSES - 1) + (True,):
        new_row, new_column = _peaks(left / noise, circles, sigmas)
        room = most - len(row)
        if not len(new_row) or room <= 0:
            break
        row, column = np.append(row, new_row[:room]), np.append(column, new_column[:room])
        height = _heights(response, row, column, circles)
        kept = height > sigmas * noise[np.rint(row).astype(int), np.rint(column).astype(int) % noise.shape[1]]
        row, column, height = row[kept], column[kept], height[kept]
        if last:
            break
        left = response.copy()
        for r, c, h in zip(row, column, height, strict=True):
            _take_out(left, circles, float(r), float(c), float(h))
    return row, column, height


def _heights(response: FloatArray, row: FloatArray, column: FloatArray, circles: _Circles) -> FloatArray:
    """Return the heights (k,) whose overlapping responses best give `response` at the stars' places."""
    beside = np.abs(column[:, None] - column)
    overlap = np.maximum(1.0 - beside / circles.length, 0.0)
    touching = np.nonzero((overlap > 0.0) & (np.abs(row[:, None] - row) < _FARTHEST))
    across = np.zeros_like(overlap)
    across[touching] = _profile((row[touching[0]] - row[touching[1]]) * _ACROSS)
    overlap *= across
    # A ridge, for stars that almost coincide; the scale it takes from all others is given back.
    overlap[np.diag_indices(len(row))] += _RIDGE
    seen = response[np.rint(row).astype(int), np.rint(column).astype(int) % response.shape[1]]
    return np.asarray(np.linalg.solve(overlap, (1.0 + _RIDGE) * seen))


def _profile(distance: FloatArray) -> FloatArray:
    """Return the response of circles `distance` px beside a star's own, 1 at the star."""
    edge = 1.5 / _WIDTH
    share = ndtr(distance / _WIDTH + edge) - ndtr(distance / _WIDTH - edge)
    return np.asarray(share / (2.0 * ndtr(edge) - 1.0))


def _take_out(left: FloatArray, circles: _Circles, row: float, column: float, height: float) -> None:
    rows, columns = left.shape
    r = np.arange(max(int(row) - 4, 0), min(int(row) + 6, rows))
    c = np.arange(max(int(column - circles.length), 0), min(int(column + circles.length) + 2, columns))
    triangle = np.maximum(1.0 - np.abs(c - column) / circles.length, 0.0)
    left[r[0] : r[-1] + 1, c[0] : c[-1] + 1] -= height * _profile((r - row) * _ACROSS)[:, None] * triangle


def _peaks(significance: FloatArray, circles: _Circles, sigmas: float) -> tuple[FloatArray, FloatArray]:
    """Return rows and columns, between samples, of the peaks, strongest first, that stand on their own."""
    row, column = positions(significance > sigmas)
    value = significance[row, column]
    summit = np.ones(len(row), dtype=np.bool_)
    for down in (-1, 0, 1):
        for beside in (-2, -1, 0, 1, 2):
            r = np.clip(row + down, 0, significance.shape[0] - 1)
            c = np.clip(column + beside, 0, significance.shape[1] - 1)
            summit &= significance[r, c] <= value
    row, column, value = row[summit], column[summit], value[summit]
    order = np.argsort(-value, kind="stable")[:_MOST_PEAKS]
    row, column, value = row[order], column[order], value[order]
    own = value.copy()
    kept = np.zeros(len(row), dtype=np.bool_)
    for k in range(len(row)):
        if own[k] < sigmas or own[k] < _OWN_SHARE * value[k]:
            continue
        kept[k] = True
        later = k + 1 + np.flatnonzero(np.abs(row[k + 1 :] - row[k]) < _FARTHEST)
        triangle = np.maximum(1.0 - np.abs(column[later] - column[k]) / circles.length, 0.0)
        own[later] -= own[k] * triangle * _profile((row[later] - row[k]) * _ACROSS)
    row, column = row[kept], column[kept]
    return _refined(significance, row, column, 0), _refined(significance, row, column, 1)


def _refined(significance: FloatArray, row: IntArray, column: IntArray, axis: int) -> FloatArray:
    """Return the peaks' places along `axis`, between samples: the vertex of a parabola."""
    place = (row, column)[axis]
    size = significance.shape[axis]
    before, after = np.maximum(place - 1, 0), np.minimum(place + 1, size - 1)
    left = significance[before, column] if axis == 0 else significance[row, before]
    right = significance[after, column] if axis == 0 else significance[row, after]
    bend = left + right - 2.0 * significance[row, column]
    offset = np.where(bend < 0.0, 0.5 * (left - right) / np.where(bend < 0.0, bend, -1.0), 0.0)
    return np.asarray(place + np.clip(offset, -0.5, 0.5))


def _pixels(pinhole: Pinhole, circles: _Circles, row: FloatArray, column: FloatArray) -> FloatArray:
    polar = circles.polar[0] + row * (circles.polar[1] - circles.polar[0])
    azimuth = circles.azimuth[0] + column * (circles.azimuth[1] - circles.azimuth[0])
    local = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)])
    return pinhole.project((circles.frame.T @ local).T)
