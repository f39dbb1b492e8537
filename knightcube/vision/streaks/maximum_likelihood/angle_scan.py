"""By what angle all stars turn about a known axis, when few streaks are seen whole.

Along its circle about the axis a star's light is a box of the length turned. The samples about the brightest
regions are summed in boxes of every length, each laid where it holds most: the right one holds all of a star
and nothing else, be the star cut by the border or crossed by others. A box twice too long or too short holds
half the chi-square, so that the ends are found from as far as the field is wide, where a fit of the pixels
sees them from a few widths of the point spread.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks.maximum_likelihood.exposed_frame import ExposedFrame

SCANNED_STARS = 14
"""This many of the brightest regions are used for the angle."""

# Spacing of the samples on the fastest circle, px; lengths tried, in samples, differ by this factor.
_STEP = 2.0
_FACTOR = 1.04
_SHORTEST = 6
# This many of the likeliest angles are weighed against a given one.
_WEIGHED = 3
# A crossing star adds at most this many times the region's own light to a sample.
_CAP = 2.0
# No star counts more than this many sigmas.
_ENOUGH = 60.0
# A star is used from this many sigmas; the border takes at most this part of it.
_CERTAIN = 8.0
_LEAST_SEEN = 0.25


@dataclass(frozen=True, slots=True, eq=False)
class Circles:
    """Circles (n,) about an axis through the brightest regions.

    Attributes:
        frame: (3, 3) two axes across, and the axis, as rows.
        height: (n,) cosine from the axis; azimuth: (n,) rad, of each region's light.
    """

    frame: FloatArray
    height: FloatArray
    azimuth: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Turned:
    """An angle and the stars it gives.

    Attributes:
        angle: rad; score: chi-square that it explains.
        stars: (n, 2) px at mid-exposure; light: (n,) counts.
    """

    angle: float
    score: float
    stars: FloatArray
    light: FloatArray


def scan_angles(
    frame: ExposedFrame, pinhole: Pinhole, circles: Circles, most: int, near: float | None = None
) -> Iterator[Turned]:
    """Yield the `most` likeliest angles, those nearest to `near` rad first when it is given."""
    boxes = _boxes(frame, pinhole, circles)
    longest = boxes.total.shape[1] - 2
    count = int(np.log(longest / _SHORTEST) / np.log(_FACTOR)) + 1
    widths = np.unique(np.rint(_SHORTEST * _FACTOR ** np.arange(count)).astype(np.int64))
    gain = np.array([boxes.held(int(width)).gain for width in widths])
    # A bright star weighs much more than others, but may be two.
    scale = _weights(gain)
    score = gain @ scale
    # Where the border cuts all useful ones, longer turns explain no more: the shortest stands for them.
    before, after = np.append(0.0, score[:-1]), np.append(score[1:], 0.0)
    peak = np.flatnonzero((score > before) & (score >= after))
    peak = peak[np.argsort(-score[peak], kind="stable")]
    if near is not None:
        peak = peak[:_WEIGHED]
        peak = peak[np.argsort(np.abs(widths[peak] * boxes.step - near), kind="stable")]
    for index in peak[:most]:
        yield _sharpened(boxes, pinhole, circles, scale, int(widths[index]))


def _weights(gain: FloatArray) -> FloatArray:
    """Return what the gains (w, n) of each star are multiplied by for none to exceed `_ENOUGH` sigmas."""
    highest = np.maximum(gain.max(axis=0), 1.0)
    return np.asarray(np.minimum(_ENOUGH**2 / highest, 1.0))


@dataclass(frozen=True, slots=True, eq=False)
class _Held:
    """The best boxes (n,): their chi-square, first sample, light, and how many of their samples exist."""

    gain: FloatArray
    first: IntArray
    light: FloatArray
    seen: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Boxes:
    """Running totals (n, c + 1) of light and of existing samples, from the azimuth `begin` in `step` rad."""

    total: FloatArray
    exist: FloatArray
    variance: FloatArray
    middle: IntArray
    begin: float
    step: float

    def held(self, width: int) -> _Held:
        """Return the best boxes of `width` samples about the regions' middles."""
        last = self.total.shape[1] - 1
        first = self.middle[:, None] - np.arange(width + 1)
        start, stop = np.clip(first, 0, last), np.clip(first + width, 0, last)
        each = np.arange(len(self.middle))[:, None]
        light = self.total[each, stop] - self.total[each, start]
        seen = self.exist[each, stop] - self.exist[each, start]
        gain = np.maximum(light, 0.0) ** 2 / (np.maximum(seen, 1.0) * self.variance[:, None])
        best = np.argmax(gain, axis=1)
        pick = each[:, 0], best
        return _Held(gain[pick], first[pick], light[pick], seen[pick])


def _boxes(frame: ExposedFrame, pinhole: Pinhole, circles: Circles) -> _Boxes:
    """Return the light on the circles, a crossing star's at most `_CAP` times the region's own."""
    sine = np.sqrt(np.maximum(1.0 - circles.height**2, 1e-12))
    step = _STEP / (pinhole.focal_length * float(sine.max()))
    inside_field = float(np.arccos(np.clip(abs(circles.frame[2, 2]), 0.0, 1.0)))
    half = pinhole.half_diagonal
    wide = np.pi if inside_field <= half else float(np.arcsin(np.sin(half) / np.sin(inside_field)))
    count = int(2.0 * wide / step)
    azimuth = -wide + step * np.arange(count)
    around = circles.frame[:2].T @ np.stack([np.cos(azimuth), np.sin(azimuth)])
    x, y, z = (sine[:, None] * around[k] + circles.frame[2, k] * circles.height[:, None] for k in range(3))
    depth = pinhole.focal_length / np.maximum(z, 1e-3)
    column, row = np.rint(x * depth + pinhole.centre[0]), np.rint(y * depth + pinhole.centre[1])
    exist = (column > 0) & (column < pinhole.columns - 1) & (row > 0) & (row < pinhole.rows - 1) & (z > 0.0)
    index = np.where(exist, row * pinhole.columns + column, 0.0).astype(np.int64)
    light = np.where(exist, frame.sums[index], np.float32(0.0)).astype(np.float64)
    middle = np.clip(np.rint((circles.azimuth + wide) / step).astype(np.int64), 0, count - 1)
    about = np.clip(middle[:, None] + np.arange(-4, 5), 0, count - 1)
    own = np.median(np.take_along_axis(light, about, axis=1), axis=1)
    noise = 9.0 * float(np.median(frame.floor[::97]))
    own = np.maximum(own, np.sqrt(noise))
    light = np.minimum(light, _CAP * own[:, None])
    start = np.zeros((len(middle), 1))
    return _Boxes(
        np.concatenate([start, np.cumsum(light, axis=1)], axis=1),
        np.concatenate([start, np.cumsum(exist, axis=1)], axis=1),
        noise + 3.0 * own / frame.gain,
        middle,
        -wide,
        step,
    )


def _sharpened(boxes: _Boxes, pinhole: Pinhole, circles: Circles, scale: FloatArray, width: int) -> Turned:
    """Return the best angle near `width` samples, and the stars that it gives."""
    room = max(2, round(_FACTOR * width) - width + 1)
    widths = np.arange(max(width - room, 2), width + room + 1)
    held = [boxes.held(int(each)) for each in widths]
    score = np.array([each.gain @ scale for each in held])
    best = int(np.argmax(score))
    chosen, across = held[best], int(widths[best])
    certain = (chosen.gain > _CERTAIN**2) & (chosen.seen > _LEAST_SEEN * across)
    # A star whose ends are both outside has no place along its path.
    certain &= _bounded(boxes, chosen.first) | _bounded(boxes, chosen.first + across)
    azimuth = boxes.begin + (chosen.first[certain] + 0.5 * across - 0.5) * boxes.step
    height = circles.height[certain]
    sine = np.sqrt(np.maximum(1.0 - height**2, 0.0))
    local = np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), height])
    pixel = pinhole.project((circles.frame.T @ local).T)
    spacing = boxes.step * pinhole.focal_length * sine
    # A sample is the light of three px of path, 0.83 of it.
    light = chosen.light[certain] * spacing / (3.0 * 0.83) * across / np.maximum(chosen.seen[certain], 1.0)
    good = np.isfinite(pixel).all(axis=1)
    order = np.flatnonzero(good)[np.argsort(-light[good], kind="stable")]
    order = order[_distinct(pixel[order])]
    return Turned(across * boxes.step, float(score[best]), pixel[order], light[order])


def _bounded(boxes: _Boxes, sample: IntArray) -> BoolArray:
    """Return whether the sample (n,) at an end of a box exists."""
    here = np.clip(sample, 0, boxes.exist.shape[1] - 2)
    each = np.arange(len(here))
    return np.asarray((here == sample) & (boxes.exist[each, here + 1] > boxes.exist[each, here]))


def _distinct(pixel: FloatArray) -> BoolArray:
    """Return which places (n, 2), brightest first, are not taken already."""
    near = np.linalg.norm(pixel[:, None] - pixel, axis=2) < 4.0 * _STEP
    return np.asarray(~np.triu(near, k=1).any(axis=0))
