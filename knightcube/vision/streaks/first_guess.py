"""A motion to start the fit from, without endpoints.

A streak at pixel p runs along B(p) u, u being the turn: its orientation gives one linear equation
n.B(p) u = 0, free of sign and of order of ends, alike for every angle of the axis to the boresight. Pairs of
streaks propose axes, the rest vote, least squares refines. About the axis every star turns by one angle: the
angles by which the regions extend vote for it, those that the frame's border cuts only for a lower bound.
Fragments of one star lie on one circle about the axis, and vote joined.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks.frame import Blobs, ExposedFrame
from knightcube.vision.streaks.geometry import Motion, image_flow, path_lengths, positions

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


_PROPOSERS = 16
_PARALLEL = 1e-9
# Error of a region's orientation: this many px over its length, at least this many rad.
_SIDE_ERROR = 1.2
_LEAST_ERROR = 0.012
# Regions shorter than this, px, have no orientation to trust.
_LEAST_LENGTH = 3.5
# Error of a region's length: px, and part of it.
_LENGTH_ERROR = 1.0
_LENGTH_SHARE = 0.015
_MOST_HYPOTHESES = 3
"""Of each ranking."""
_SAME_CIRCLE = 2.0
# A region is of a star under a known motion if its length differs by this part of it, and the error above.
_LIKELY_LENGTH = 0.2
_INSTANTS = 65
# So many whole regions must show it, and so much of itself must the rate change, to be fitted from the start.
_LEAST_GROWING = 3
_LEAST_GROWTH = 0.4


@dataclass(frozen=True, slots=True, eq=False)
class Guess:
    """Where a fit may start.

    Attributes:
        motion: of the camera.
        stars: (n, 2) px, middles of the streaks; light: (n,) counts.
        contradicted: share of the regions' light that lies in regions longer than the turn allows.
    """

    motion: Motion
    stars: FloatArray
    light: FloatArray
    contradicted: float


def guess_axis(blobs: Blobs, pinhole: Pinhole) -> tuple[FloatArray, BoolArray] | None:
    """Return the axis (3,), sign arbitrary, and which regions (n,) run along it; None without two that do."""
    long = np.flatnonzero(blobs.length >= _LEAST_LENGTH)
    if len(long) < 2:
        return None
    flow = image_flow(pinhole, blobs.centre)
    equation = np.einsum("ni,nij->nj", blobs.normal, flow)
    tolerance = np.maximum(_SIDE_ERROR / np.maximum(blobs.length, 1.0), _LEAST_ERROR)
    # Long and bright regions are rarely blends.
    worth = np.sqrt(blobs.flux) * np.minimum(blobs.length, 100.0)
    leaders = long[np.argsort(-worth[long], kind="stable")[:_PROPOSERS]]
    i, j = (leaders[index] for index in np.triu_indices(len(leaders), k=1))
    proposal = np.cross(equation[i], equation[j])
    size = np.linalg.norm(proposal, axis=-1)
    usable = size > _PARALLEL * np.linalg.norm(equation[i], axis=-1) * np.linalg.norm(equation[j], axis=-1)
    if not usable.any():
        return None
    proposal = proposal[usable] / size[usable, None]
    weight = np.log1p(blobs.flux[long] / np.median(blobs.flux[long]))
    missed = (_turning(proposal, equation[long], flow[long]) / tolerance[long]) ** 2
    axis = proposal[np.argmin((np.minimum(missed, 9.0) * weight).sum(axis=1))]
    for _ in range(3):
        off = np.abs(_turning(axis[None], equation, flow)[0]) / tolerance
        agree = (off <= 3.0) & (blobs.length >= _LEAST_LENGTH)
        if np.count_nonzero(agree) < 2:
            return None
        speed = np.linalg.norm(flow[agree] @ axis, axis=-1)
        rows = equation[agree] / np.maximum(speed * tolerance[agree], 1e-9)[:, None]
        axis = np.linalg.svd(rows)[2][-1]
    return axis, agree


def _turning(axes: FloatArray, equation: FloatArray, flow: FloatArray) -> FloatArray:
    """Return the sines (k, n) between regions' orientations and the flow about `axes` (k, 3)."""
    speed = np.linalg.norm(np.einsum("nij,kj->kni", flow, axes), axis=-1)
    return np.asarray(axes @ equation.T / np.maximum(speed, 1e-9))


@dataclass(frozen=True, slots=True, eq=False)
class Turning:
    """An axis (3,), which regions (n,) run along it, and they as arcs about it."""

    axis: FloatArray
    agree: BoolArray
    arcs: _Arcs


def find_turning(blobs: Blobs, pinhole: Pinhole) -> Turning | None:
    """Return the axis that the regions agree on, None without one."""
    found = guess_axis(blobs, pinhole)
    return None if found is None else Turning(*found, _arcs(blobs, pinhole, found[0]))


def voted_motions(
    turning: Turning, blobs: Blobs, pinhole: Pinhole, most: int, growth: float = 0.0
) -> list[Guess]:
    """Return guesses by the regions' lengths, the likeliest first, each of at most `most` stars.

    `growth` as by `seen_growth`.
    """
    guesses = []
    for wide, contradicted in _angles(turning.arcs, blobs, turning.agree):
        # The second moment of a path that is slow at one end is a little larger.
        angle = wide / np.sqrt(1.0 + growth**2 / 60.0)
        stars, light = _stars(turning.arcs, blobs, turning.agree, pinhole, angle, most, growth)
        if len(light):
            turn = turning.axis * angle
            guesses.append(Guess(Motion(turn, growth * turn), stars, light, contradicted))
    return guesses


def course_motion(course: Motion, blobs: Blobs, pinhole: Pinhole, most: int) -> Guess:
    """Return a guess of a known motion: the brightest whole regions that are as long as it draws streaks."""
    time = np.linspace(-0.5, 0.5, _INSTANTS)
    progress = course.progress(time)
    # A region's centre is that of light, and its second moment that of time.
    wide = np.sqrt(12.0 * np.var(progress))
    length = path_lengths(pinhole, course, blobs.centre) * wide
    likely = np.abs(blobs.length - length) < _LENGTH_ERROR + _LIKELY_LENGTH * length
    chosen = np.flatnonzero(likely & ~blobs.cut)[:most]
    lag = course.whole * float(np.mean(progress)) - course.middle
    back = positions(pinhole, Motion.steady(lag), blobs.centre[chosen], np.full(len(chosen), -1.0))
    return Guess(course, back, blobs.flux[chosen], 0.0)


def seen_growth(turning: Turning, blobs: Blobs) -> float:
    """Return the change of the rate in parts of it, by how the light lies within the regions; 0 if unseen.

    Where the rate doubles from nothing, the centre of the light is a sixth of the length behind the middle.
    Positive is a growth along the axis for a turn along the axis, or against both.
    """
    arcs = turning.arcs
    whole = turning.agree & ~blobs.cut & (arcs.width * arcs.speed > _LEAST_LENGTH)
    if np.count_nonzero(whole) < _LEAST_GROWING:
        return 0.0
    off = (arcs.middle - 0.5 * (arcs.first + arcs.last))[whole] / arcs.width[whole]
    growth = 12.0 * float(np.median(off))
    return float(np.clip(growth, -2.0, 2.0)) if abs(growth) > _LEAST_GROWTH else 0.0


def scanned_motions(
    turning: Turning, frame: ExposedFrame, pinhole: Pinhole, most: int, near: float | None
) -> Iterator[Guess]:
    """Yield guesses by the light along the circles about the axis, those `near` an angle (rad) first."""
    arcs = turning.arcs
    chosen = np.flatnonzero(turning.agree)[:SCANNED_STARS]
    circles = Circles(arcs.frame, arcs.height[chosen], arcs.middle[chosen])
    for turned in scan_angles(frame, pinhole, circles, _MOST_HYPOTHESES, near):
        if len(turned.light):
            motion = Motion.steady(turning.axis * turned.angle)
            yield Guess(motion, turned.stars[:most], turned.light[:most], 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class _Arcs:
    """Regions as arcs about the axis; (n,) each, rad, but `speed` in px per rad.

    `frame` (3, 3) has two axes across and the axis as rows; `height` is the cosine from the axis.
    """

    frame: FloatArray
    height: FloatArray
    middle: FloatArray
    first: FloatArray
    last: FloatArray
    width: FloatArray
    speed: FloatArray
    cut_first: BoolArray
    cut_last: BoolArray


def _arcs(blobs: Blobs, pinhole: Pinhole, axis: FloatArray) -> _Arcs:
    n, owner, light = len(blobs), blobs.owner, blobs.light
    middle = pinhole.unit_vectors(np.array([pinhole.centre]))[0]
    # The zero of azimuth points to the field's middle, or anywhere when that is the axis.
    first = middle - (middle @ axis) * axis
    if np.linalg.norm(first) < 1e-3:
        first = np.eye(3)[int(np.argmin(np.abs(axis)))]
        first = first - (first @ axis) * axis
    first = first / np.linalg.norm(first)
    frame = np.stack([first, np.cross(axis, first), axis])
    points = np.stack([blobs.column, blobs.row], axis=-1).astype(float)
    x, y, z = frame @ pinhole.unit_vectors(points).T
    centre = np.einsum("ij,nj->ni", frame, pinhole.unit_vectors(blobs.centre))
    reference = np.arctan2(centre[:, 1], centre[:, 0])
    azimuth = np.arctan2(y, x) - reference[owner]
    azimuth = np.remainder(azimuth + np.pi, 2.0 * np.pi) - np.pi
    flux = np.bincount(owner, light, n)
    mean = np.bincount(owner, light * azimuth, n) / flux
    square = np.bincount(owner, light * azimuth**2, n) / flux - mean**2
    height = np.bincount(owner, light * z, n) / flux
    speed = np.linalg.norm(image_flow(pinhole, blobs.centre) @ axis, axis=-1)
    low, high = _outermost(azimuth, owner, n)
    # A uniform arc has its length squared over twelve, and the point spread's own variance.
    width = np.sqrt(np.maximum(12.0 * (square - 1.1 / np.maximum(speed, 1.0) ** 2), 0.0))
    return _Arcs(
        frame,
        height,
        mean + reference,
        azimuth[low] + reference,
        azimuth[high] + reference,
        width,
        np.maximum(speed, 1.0),
        _at_border(blobs, pinhole, low),
        _at_border(blobs, pinhole, high),
    )


def _outermost(azimuth: FloatArray, owner: IntArray, n: int) -> tuple[IntArray, IntArray]:
    """Return which pixel of each of `n` regions has the lowest azimuth, and which the highest."""
    order = np.argsort(owner.astype(np.int16), kind="stable")
    theirs, whose = azimuth[order], owner[order]
    start = np.searchsorted(whose, np.arange(n))
    found = []
    for extreme in (np.minimum.reduceat(theirs, start), np.maximum.reduceat(theirs, start)):
        pixel = np.flatnonzero(theirs == extreme[whose])
        found.append(order[pixel[np.searchsorted(whose[pixel], np.arange(n))]])
    return found[0], found[1]


def _at_border(blobs: Blobs, pinhole: Pinhole, pixel: IntArray) -> BoolArray:
    x, y, margin = blobs.column[pixel], blobs.row[pixel], 4
    inside_x = (x >= margin) & (x < pinhole.columns - margin)
    inside_y = (y >= margin) & (y < pinhole.rows - margin)
    return np.asarray(~(inside_x & inside_y))


def _angles(arcs: _Arcs, blobs: Blobs, agree: BoolArray) -> list[tuple[float, float]]:
    """Return angles turned, those voted for without contradiction first, and how far each is contradicted."""
    whole = agree & ~blobs.cut & (arcs.width > 0.0)
    candidates, spread, weight = arcs.width[whole], _spread(arcs, whole), np.sqrt(blobs.flux[whole])
    joined = _joined(arcs, blobs, agree)
    candidates = np.append(candidates, joined[:, 0])
    spread, weight = np.append(spread, joined[:, 1]), np.append(weight, joined[:, 2])
    cut = agree & blobs.cut
    reach = np.abs(arcs.last - arcs.first)
    if not len(candidates):
        return [(float(np.max(reach[cut])), 0.0)] if cut.any() else []
    nearness = np.exp(-0.5 * ((candidates[:, None] - candidates) / np.hypot(spread[:, None], spread)) ** 2)
    votes = nearness @ weight
    # No star is seen to turn further than all do: what is longer is evidence against, or two stars in one.
    long = agree & (arcs.speed * reach > 20.0)
    longer = (reach - 10.0 / arcs.speed)[long] > candidates[:, None] + 3.0 * spread[:, None]
    doubted = votes - longer @ np.sqrt(blobs.flux[long])
    against = longer @ blobs.flux[long] / max(float(blobs.flux[agree].sum()), 1e-9)
    each = weight / spread**2
    angle = (nearness @ (each * candidates)) / (nearness @ each)
    chosen: list[tuple[float, float]] = []
    for ranking in (doubted, votes):
        taken = 0
        for index in np.argsort(-ranking, kind="stable"):
            if all(abs(angle[index] - other) > 3.0 * spread[index] for other, _ in chosen):
                chosen.append((float(angle[index]), float(against[index])))
                taken += 1
            if taken == _MOST_HYPOTHESES:
                break
    return chosen


def _spread(arcs: _Arcs, which: BoolArray) -> FloatArray:
    return np.asarray(_LENGTH_ERROR / arcs.speed[which] + _LENGTH_SHARE * arcs.width[which])


def _joined(arcs: _Arcs, blobs: Blobs, agree: BoolArray) -> FloatArray:
    """Return angle, its spread and weight (k, 3) of fragments joined: neighbours on one circle."""
    part = np.flatnonzero(agree & ~blobs.cut)
    sine = np.sqrt(np.maximum(1.0 - arcs.height[part] ** 2, 1e-12))
    # Distance across, px: d(cos) = -sin d(angle); the speed is the px per rad of azimuth, sin of it per rad.
    scale = arcs.speed[part] / sine**2
    near = np.abs(arcs.height[part, None] - arcs.height[part]) * scale < _SAME_CIRCLE
    gap = arcs.first[part][None, :] - arcs.last[part][:, None]
    extent = arcs.last[part][None, :] - arcs.first[part][:, None]
    i, j = np.nonzero(near & (gap > 0.0) & (gap < 0.5 * extent))
    angle = extent[i, j] - 4.0 / arcs.speed[part[i]]
    weight = 0.5 * np.sqrt(np.minimum(blobs.flux[part[i]], blobs.flux[part[j]]))
    spread = 2.0 / arcs.speed[part[i]] + _LENGTH_SHARE * np.abs(angle)
    return np.stack([angle, spread, weight], axis=-1)[angle > 0.0]


def _stars(
    arcs: _Arcs,
    blobs: Blobs,
    agree: BoolArray,
    pinhole: Pinhole,
    angle: float,
    most: int,
    growth: float,
) -> tuple[FloatArray, FloatArray]:
    """Return the streaks' middles, px, and the light of the brightest regions that fit the angle."""
    spread = _LENGTH_ERROR / arcs.speed + _LENGTH_SHARE * angle
    whole = agree & ~blobs.cut & (np.abs(arcs.width - angle) < 4.0 * spread)
    reach = np.abs(arcs.last - arcs.first)
    one = arcs.cut_first ^ arcs.cut_last
    cut = agree & blobs.cut & one & (reach < angle + 6.0 * spread) & (reach > 0.25 * angle)
    # Where the border cuts, the other end decides; a region reaches about 2 px beyond it.
    past = 2.0 / arcs.speed
    middle = np.where(arcs.cut_first, arcs.last - past - 0.5 * angle, arcs.first + past + 0.5 * angle)
    middle = np.where(whole, arcs.middle - growth / 12.0 * angle, middle)
    part = np.where(whole, 1.0, np.clip(reach / angle, 0.1, 1.0))
    chosen = np.flatnonzero(whole | cut)[:most]
    sine = np.sqrt(np.maximum(1.0 - arcs.height[chosen] ** 2, 0.0))
    local = np.stack([sine * np.cos(middle[chosen]), sine * np.sin(middle[chosen]), arcs.height[chosen]])
    pixel = pinhole.project((arcs.frame.T @ local).T)
    seen = np.isfinite(pixel).all(axis=1)
    return pixel[seen], (blobs.flux / part)[chosen][seen]
