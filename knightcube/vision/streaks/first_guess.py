"""Initial guesses of the camera's motion from the bright regions of a frame.

A streak at the pixel p is parallel to B(p) u, where u is the rotation vector of the camera and B(p) the
image-flow matrix, which gives the motion of stars at p. The unit normal n of the streak in the image
therefore gives the linear equation n.B(p) u = 0, which holds for either direction of motion along the streak.
Pairs of bright regions propose rotation axes, the other regions vote for the proposed axes, and least squares
refines the axis with most votes. All streaks subtend the same rotation angle, so that the length of each
bright region is a vote for an angle. A bright region that the border of the frame truncates gives only a
lower limit of the rotation angle. Fragments of one streak lie on one circle about the rotation axis. The
angle from the start of one fragment to the end of the next is therefore also a vote.

If few streaks lie completely in the frame, a scan finds the rotation angle. Along a circle about the rotation
axis, the intensity of a star's streak is a box function whose length is the rotation angle. For each trial
length, the pixel samples around the brightest regions are summed over intervals (boxes) of this length, and
each box is moved along its circle to the position of its largest sum. A box of the correct length contains
all samples of a star's streak and no samples beyond the ends of the streak. Boxes that are too long or too
short by a factor of two explain only half of the chi-square. The scan therefore finds the rotation angle
without a good initial guess, whereas a fit of the pixels converges only from within a few point-spread
widths.

If the brightest regions do not determine the rotation angle, for example because streaks are faint and
fragmented, or because the border truncates all streaks, all circles of a polar grid are searched. The mean of
the pixels in a box along a circle is compared with the mean of the pixels on both sides of the box. The box
length with the largest sum of squared significances is the length of the streaks.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import BoolArray, Float32Array, FloatArray, IntArray, cross_product, median
from knightcube.compiled import compiled_form_of
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks.camera_motion import CameraMotion
from knightcube.vision.streaks.frame import BrightRegions, ReducedFrame
from knightcube.vision.streaks.geometry import image_flow, path_lengths, positions
from knightcube.vision.streaks.polar_grid import SAMPLE_NOISE, cumulative_sums, polar_grid

SCANNED_STARS = 14
"""Number of the brightest regions that are used in the scan for the rotation angle."""

# Spacing (px) of the samples along the circle on which stars move fastest.
_STEP = 2.0
# Ratio of consecutive trial lengths of streaks in the scan for the rotation angle.
_FACTOR = 1.04
# Smallest trial length (samples) of streaks in the scan for the rotation angle.
_SHORTEST = 6
# Number of the most likely rotation angles that are sorted by their difference from the prior angle.
_WEIGHED = 3
# Upper limit of a sample, as a multiple of its region's median, which limits the effect of crossing stars.
_CAP = 2.0
# Upper limit of the significance (standard deviations) of a star in the scan for the rotation angle.
_ENOUGH = 60.0
# Minimum significance (standard deviations) of a star from the scan that is used in the fit.
_CERTAIN = 8.0
# Minimum fraction of a streak within the frame for its star to be used in the fit.
_LEAST_SEEN = 0.25


@dataclass(frozen=True, slots=True, eq=False)
class Circles:
    """Circles about the rotation axis, each through the centroid of one of the n brightest regions.

    The rows of the matrix `frame` (3, 3) are two unit vectors normal to the rotation axis, and the axis. The
    `height` (n,) is the cosine of the angle between each circle and the axis, and `azimuth` (n,), rad, is the
    azimuth of the centroid of each region.
    """

    frame: FloatArray
    height: FloatArray
    azimuth: FloatArray


ScannedAngle = tuple[float, FloatArray, FloatArray]
"""Rotation angle, rad, with positions (n, 2), px, and fluxes (n,), counts, of the stars found with it."""


def scan_angles(
    frame: ReducedFrame, pinhole: Pinhole, circles: Circles, most: int, near: float | None = None
) -> Iterator[ScannedAngle]:
    """Yield at most `most` likely rotation angles, sorted by distance from `near` (rad) if it is given.

    Yields nothing if all circles are so close to the rotation axis that they have too few samples.
    """
    boxes = _boxes(frame, pinhole, circles)
    longest = boxes.total.shape[1] - 2
    if longest < _SHORTEST:
        return
    count = int(np.log(longest / _SHORTEST) / np.log(_FACTOR)) + 1
    widths = np.unique(np.rint(_SHORTEST * _FACTOR ** np.arange(count)).astype(np.int64))
    gain = boxes.best(widths)[0]
    # The weight of a bright star is limited, because it may be a blend of two stars.
    scale = np.minimum(_ENOUGH**2 / np.maximum(gain.max(axis=0), 1.0), 1.0)
    score = gain @ scale
    # If the border truncates all streaks, the smallest of the equally likely rotation angles is chosen.
    before, after = np.append(0.0, score[:-1]), np.append(score[1:], 0.0)
    peak = np.flatnonzero((score > before) & (score >= after))
    peak = peak[np.argsort(-score[peak], kind="stable")]
    if near is not None:
        peak = peak[:_WEIGHED]
        peak = peak[np.argsort(np.abs(widths[peak] * boxes.step - near), kind="stable")]
    for index in peak[:most]:
        yield _refined_angle(boxes, pinhole, circles, scale, int(widths[index]))


_Best = tuple[FloatArray, IntArray, FloatArray, FloatArray]
"""Best boxes for each of w box lengths and each of n regions: four arrays (w, n).

A box is an interval of samples on the circle of a region. The arrays are the explained chi-square, the index
of the first sample, the sum of the samples, and the number of samples within the frame.
"""


@dataclass(frozen=True, slots=True, eq=False)
class _Boxes:
    """Cumulative sums (n, c + 1) along n circles of c samples.

    The sums are those of the sample values (`total`) and of the numbers of samples in the frame (`exist`).
    The noise variance of a sample is `variance` (n,), and the index of the sample at the centroid of each
    region is `middle` (n,). The azimuth of the first sample is `begin` (rad), and the spacing of the samples
    is `step` (rad).
    """

    total: FloatArray
    exist: FloatArray
    variance: FloatArray
    middle: IntArray
    begin: float
    step: float

    def best(self, widths: IntArray) -> _Best:
        """Return the boxes that explain the most chi-square, for each of `widths` (w,) and each region."""
        return _best_boxes(self.total, self.exist, self.variance, self.middle, widths)


def _best_boxes_numpy(
    total: FloatArray, exist: FloatArray, variance: FloatArray, middle: IntArray, widths: IntArray
) -> _Best:
    """Return the best boxes of the lengths `widths` (w,); the other arguments are attributes of `_Boxes`."""
    last = total.shape[1] - 1
    each = np.arange(len(middle))[:, None]
    shape = len(widths), len(middle)
    most, place, light, seen = np.empty(shape), np.empty(shape, np.int64), np.empty(shape), np.empty(shape)
    for w, width in enumerate(widths.tolist()):
        first = middle[:, None] - np.arange(width + 1)
        start, stop = np.clip(first, 0, last), np.clip(first + width, 0, last)
        counts, number = total[each, stop] - total[each, start], exist[each, stop] - exist[each, start]
        gain = np.maximum(counts, 0.0) ** 2 / (np.maximum(number, 1.0) * variance[:, None])
        pick = each[:, 0], np.argmax(gain, axis=1)
        most[w], place[w], light[w], seen[w] = gain[pick], first[pick], counts[pick], number[pick]
    return most, place, light, seen


@compiled_form_of(_best_boxes_numpy)
def _best_boxes(
    total: FloatArray, exist: FloatArray, variance: FloatArray, middle: IntArray, widths: IntArray
) -> _Best:
    last = total.shape[1] - 1
    shape = len(widths), len(middle)
    most, place, light, seen = np.empty(shape), np.empty(shape, np.int64), np.empty(shape), np.empty(shape)
    for w in range(len(widths)):
        width = widths[w]
        for n in range(len(middle)):
            most[w, n] = -1.0
            for first in range(middle[n], middle[n] - width - 1, -1):
                start, stop = min(max(first, 0), last), min(max(first + width, 0), last)
                counts, number = total[n, stop] - total[n, start], exist[n, stop] - exist[n, start]
                gain = max(counts, 0.0) ** 2 / (max(number, 1.0) * variance[n])
                if gain > most[w, n]:
                    most[w, n], place[w, n], light[w, n], seen[w, n] = gain, first, counts, number
    return most, place, light, seen


def _boxes(frame: ReducedFrame, pinhole: Pinhole, circles: Circles) -> _Boxes:
    """Return cumulative sums of samples along `circles`, each limited to `_CAP` times a median.

    The median is that of the samples around the centroid of the region.
    """
    sine = np.sqrt(np.maximum(1.0 - circles.height**2, 1e-12))
    step = _STEP / (pinhole.focal_length * float(sine.max()))
    inside_field = float(np.arccos(np.clip(abs(circles.frame[2, 2]), 0.0, 1.0)))
    half = pinhole.ideal.half_diagonal
    wide = np.pi if inside_field <= half else float(np.arcsin(np.sin(half) / np.sin(inside_field)))
    count = max(int(2.0 * wide / step), 1)
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
    noise = 9.0 * frame.usual_noise**2
    own = np.maximum(own, np.sqrt(noise))
    light = np.minimum(light, _CAP * own[:, None])
    start = np.zeros((len(middle), 1))
    total, number = (np.concatenate([start, np.cumsum(each, axis=1)], axis=1) for each in (light, exist))
    return _Boxes(total, number, noise + 3.0 * own / frame.gain, middle, -wide, step)


def _refined_angle(
    boxes: _Boxes, pinhole: Pinhole, circles: Circles, scale: FloatArray, width: int
) -> ScannedAngle:
    """Return the best rotation angle near the streak length `width` (samples), and its stars."""
    room = max(2, round(_FACTOR * width) - width + 1)
    widths = np.arange(max(width - room, 2), width + room + 1)
    held = boxes.best(widths)
    best = int(np.argmax(held[0] @ scale))
    across, first, light, seen = int(widths[best]), held[1][best], held[2][best], held[3][best]
    certain = (held[0][best] > _CERTAIN**2) & (seen > _LEAST_SEEN * across)
    # The position of a star along its path is determined only if at least one streak end is in the frame.
    bounded = np.zeros(len(certain), dtype=np.bool_)
    for sample in (first, first + across):
        here = np.clip(sample, 0, boxes.exist.shape[1] - 2)
        each = np.arange(len(here))
        bounded |= (here == sample) & (boxes.exist[each, here + 1] > boxes.exist[each, here])
    certain &= bounded
    azimuth = boxes.begin + (first[certain] + 0.5 * across - 0.5) * boxes.step
    height = circles.height[certain]
    sine = np.sqrt(np.maximum(1.0 - height**2, 0.0))
    local = np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), height])
    pixel = pinhole.ideal.project((circles.frame.T @ local).T)
    spacing = boxes.step * pinhole.focal_length * sine
    # A sample of 3 x 3 pixels contains 83 % of the flux of a streak segment of 3 px.
    light = light[certain] * spacing / (3.0 * 0.83) * across / np.maximum(seen[certain], 1.0)
    good = np.isfinite(pixel).all(axis=1)
    order = np.flatnonzero(good)[np.argsort(-light[good], kind="stable")]
    near = np.linalg.norm(pixel[order, None] - pixel[order], axis=2) < 4.0 * _STEP
    order = order[~np.triu(near, k=1).any(axis=0)]
    return across * boxes.step, pixel[order], light[order]


# Number of bright regions whose pairs propose rotation axes.
_PROPOSERS = 16
# Sine of the angle between the equation vectors of two regions below which they propose no rotation axis.
_PARALLEL = 1e-9
# Standard error of a region's orientation multiplied by the region's length (rad px).
_SIDE_ERROR = 1.2
# Minimum standard error (rad) of a region's orientation.
_LEAST_ERROR = 0.012
# Minimum length (px) of a region whose orientation is used.
_LEAST_LENGTH = 3.5
# Constant part (px) of the standard error of a region's length.
_LENGTH_ERROR = 1.0
# Proportional part of the standard error of a region's length, as a fraction of the length.
_LENGTH_SHARE = 0.015
# Maximum number of rotation angles from each of two rankings: by votes minus contradictions, and by votes.
_MOST_HYPOTHESES = 3
# Largest distance (px) between the circles on which two fragments of one streak lie.
_SAME_CIRCLE = 2.0
# Largest relative difference between a region's length and the expected streak length.
_LIKELY_LENGTH = 0.2
# Number of instants of the exposure at which a known motion is sampled.
_INSTANTS = 65
# Minimum number of complete regions for an estimate of the angular acceleration.
_LEAST_GROWING = 3
# Minimum relative change of the rate for which an initial guess includes an angular acceleration.
_LEAST_GROWTH = 0.4


@dataclass(frozen=True, slots=True, eq=False)
class MotionGuess:
    """Initial guess of motion and stars: centres `stars` (n, 2), px, and fluxes `light` (n,), counts.

    The attribute `contradicted` is the fraction of the flux in regions too long for the rotation angle.
    """

    motion: CameraMotion
    stars: FloatArray
    light: FloatArray
    contradicted: float


def guess_axis(regions: BrightRegions, pinhole: Pinhole) -> tuple[FloatArray, BoolArray] | None:
    """Return the rotation axis (3,) with which most bright regions agree, and a mask (n,) of these regions.

    The sign of the returned axis is arbitrary. Returns None if fewer than two regions agree.
    """
    long = np.flatnonzero(regions.length >= _LEAST_LENGTH)
    if len(long) < 2:
        return None
    flow = image_flow(pinhole, regions.centre)
    equation = np.einsum("ni,nij->nj", regions.normal, flow)
    tolerance = np.maximum(_SIDE_ERROR / np.maximum(regions.length, 1.0), _LEAST_ERROR)
    # The weight of long and bright regions is large, because blends of stars are rarely long and bright.
    worth = np.sqrt(regions.flux) * np.minimum(regions.length, 100.0)
    leaders = long[np.argsort(-worth[long], kind="stable")[:_PROPOSERS]]
    weight = np.log1p(regions.flux[long] / median(regions.flux[long]))
    axis = _likeliest_axis(equation[leaders], equation[long], flow[long], tolerance[long], weight)
    if not axis.any():
        return None
    for _ in range(3):
        off = np.abs(_misalignment(axis[None], equation, flow)[0]) / tolerance
        agree = (off <= 3.0) & (regions.length >= _LEAST_LENGTH)
        if np.count_nonzero(agree) < 2:
            return None
        speed = np.linalg.norm(flow[agree] @ axis, axis=-1)
        rows = equation[agree] / np.maximum(speed * tolerance[agree], 1e-9)[:, None]
        axis = np.linalg.svd(rows, full_matrices=False)[2][-1]
    return axis, agree


def _likeliest_axis_numpy(
    leaders: FloatArray, equation: FloatArray, flow: FloatArray, tolerance: FloatArray, weight: FloatArray
) -> FloatArray:
    """Return the best rotation axis (3,) proposed by a pair of `leaders`, or zeros if all pairs are parallel.

    The `leaders` (k, 3) are equation vectors. The equation vectors `equation` (n, 3), image-flow matrices
    `flow` (n, 2, 3), standard errors `tolerance` (n,), rad, and the `weight` (n,) belong to the regions that
    vote for the axes.
    """
    i, j = np.triu_indices(len(leaders), k=1)
    proposal, length = np.cross(leaders[i], leaders[j]), np.linalg.norm(leaders, axis=-1)
    size = np.linalg.norm(proposal, axis=-1)
    usable = size > _PARALLEL * length[i] * length[j]
    if not usable.any():
        return np.zeros(3)
    proposal = proposal[usable] / size[usable, None]
    missed = (_misalignment(proposal, equation, flow) / tolerance) ** 2
    return np.asarray(proposal[np.argmin((np.minimum(missed, 9.0) * weight).sum(axis=1))])


@compiled_form_of(_likeliest_axis_numpy)
def _likeliest_axis(
    leaders: FloatArray, equation: FloatArray, flow: FloatArray, tolerance: FloatArray, weight: FloatArray
) -> FloatArray:
    """See `_likeliest_axis_numpy`."""
    best, axis = np.inf, np.zeros(3)
    for i in range(len(leaders)):
        one = leaders[i]
        for j in range(i + 1, len(leaders)):
            other = leaders[j]
            x = one[1] * other[2] - one[2] * other[1]
            y = one[2] * other[0] - one[0] * other[2]
            z = one[0] * other[1] - one[1] * other[0]
            size = math.sqrt(x * x + y * y + z * z)
            if size <= _PARALLEL * math.sqrt(np.sum(one * one) * np.sum(other * other)):
                continue
            x, y, z, missed = x / size, y / size, z / size, 0.0
            for n in range(len(equation)):
                across = flow[n, 0, 0] * x + flow[n, 0, 1] * y + flow[n, 0, 2] * z
                down = flow[n, 1, 0] * x + flow[n, 1, 1] * y + flow[n, 1, 2] * z
                off = equation[n, 0] * x + equation[n, 1] * y + equation[n, 2] * z
                off /= max(math.sqrt(across * across + down * down), 1e-9) * tolerance[n]
                missed += min(off * off, 9.0) * weight[n]
            if missed < best:
                best = missed
                axis[0], axis[1], axis[2] = x, y, z
    return axis


def _misalignment(axes: FloatArray, equation: FloatArray, flow: FloatArray) -> FloatArray:
    """Return the sines (k, n) of the angles between n regions and the image flow about k `axes` (k, 3)."""
    speed = np.hypot(axes @ flow[:, 0].T, axes @ flow[:, 1].T)
    return np.asarray(axes @ equation.T / np.maximum(speed, 1e-9))


@dataclass(frozen=True, slots=True, eq=False)
class AxisGuess:
    """A rotation axis with which bright regions agree, and the n regions as arcs about this axis.

    Attributes:
        agree: whether each bright region agrees with the rotation axis (n,).
        frame: matrix (3, 3) whose rows are two unit vectors normal to the rotation axis, and the axis.
        height: cosine of the angle between each region and the rotation axis (n,).
        middle: azimuth about the rotation axis of the centroid of each region (n,), rad.
        first: lowest azimuth about the rotation axis in each region (n,), rad.
        last: highest azimuth about the rotation axis in each region (n,), rad.
        width: arc length of each region from the second moment of its brightness (n,), rad.
        speed: image displacement per radian of rotation at each region (n,), px/rad.
        cut_first, cut_last: whether the border of the frame truncates each region at the end with the lowest
            and with the highest azimuth (n,).
    """

    agree: BoolArray
    frame: FloatArray
    height: FloatArray
    middle: FloatArray
    first: FloatArray
    last: FloatArray
    width: FloatArray
    speed: FloatArray
    cut_first: BoolArray
    cut_last: BoolArray


def find_axis(regions: BrightRegions, pinhole: Pinhole) -> AxisGuess | None:
    """Return the rotation axis and the bright regions as arcs about it, or None if too few regions agree."""
    found = guess_axis(regions, pinhole)
    if found is None:
        return None
    axis, agree = found
    middle = np.array([0.0, 0.0, 1.0])
    # Azimuth zero is the direction to the image centre, or arbitrary if the axis passes through the centre.
    first = middle - (middle @ axis) * axis
    if np.linalg.norm(first) < 1e-3:
        first = np.eye(3)[int(np.argmin(np.abs(axis)))]
        first = first - (first @ axis) * axis
    first = first / np.linalg.norm(first)
    frame = np.stack([first, cross_product(axis, first), axis])
    centre = np.einsum("ij,nj->ni", frame, pinhole.ideal.unit_vectors(regions.centre))
    reference = np.arctan2(centre[:, 1], centre[:, 0])
    view = (float(pinhole.focal_length), *pinhole.centre)
    pixels = regions.column, regions.row, regions.light, regions.owner
    (mean, square, height), (low, high), bounds = _arcs(pixels, frame, reference, view)
    speed = np.linalg.norm(image_flow(pinhole, regions.centre) @ axis, axis=-1)
    # The second moment of brightness along a uniform arc is length^2 / 12 plus the variance of the PSF.
    width = np.sqrt(np.maximum(12.0 * (square - 1.1 / np.maximum(speed, 1.0) ** 2), 0.0))
    arcs = height, mean + reference, bounds[0] + reference, bounds[1] + reference, width
    at_border = _at_border(regions, pinhole, low), _at_border(regions, pinhole, high)
    return AxisGuess(agree, frame, *arcs, np.maximum(speed, 1.0), *at_border)


def motions_by_length(
    guess: AxisGuess, regions: BrightRegions, pinhole: Pinhole, most: int, growth: float = 0.0
) -> Iterator[MotionGuess]:
    """Yield initial guesses of the rotation from the lengths of bright regions, the most likely first.

    Each guess contains at most `most` stars. The argument `growth` is the relative change of the rate over
    the exposure, see `measured_rate_change`.
    """
    for wide, contradicted in _angles(guess, regions):
        # A changing rate slightly increases the second moment of a streak.
        angle = wide / np.sqrt(1.0 + growth**2 / 60.0)
        stars, light = _stars_of_angle(guess, regions, pinhole, angle, most, growth)
        if len(light):
            turn = guess.frame[2] * angle
            yield MotionGuess(CameraMotion(turn, growth * turn), stars, light, contradicted)


def motion_by_course(
    course: CameraMotion, regions: BrightRegions, pinhole: Pinhole, most: int
) -> MotionGuess:
    """Return an initial guess with the known motion `course` and the brightest regions of matching length."""
    time = np.linspace(-0.5, 0.5, _INSTANTS)
    progress = course.progress(time)
    # The second moment of a region equals the variance of the star's position over the exposure.
    wide = np.sqrt(12.0 * np.var(progress))
    length = path_lengths(pinhole, course, regions.centre) * wide
    likely = np.abs(regions.length - length) < _LENGTH_ERROR + _LIKELY_LENGTH * length
    chosen = np.flatnonzero(likely & ~regions.cut)[:most]
    lag = course.rotation * float(np.mean(progress)) - course.halfway
    back = positions(pinhole, CameraMotion.steady(lag), regions.centre[chosen], np.full(len(chosen), -1.0))
    return MotionGuess(course, back, regions.flux[chosen], 0.0)


def measured_rate_change(guess: AxisGuess, regions: BrightRegions) -> float:
    """Return the relative change of the rate over the exposure, estimated from the asymmetry of the regions.

    If the rate increases linearly from zero, the distance between the centroid and the midpoint of a streak
    is a sixth of the streak's length. The relative change is positive if the rate increases in magnitude
    during the exposure. If the change of the rate is too small to be significant, the result is 0.
    """
    whole = guess.agree & ~regions.cut & (guess.width * guess.speed > _LEAST_LENGTH)
    if np.count_nonzero(whole) < _LEAST_GROWING:
        return 0.0
    off = (guess.middle - 0.5 * (guess.first + guess.last))[whole] / guess.width[whole]
    growth = 12.0 * float(np.median(off))
    return float(np.clip(growth, -2.0, 2.0)) if abs(growth) > _LEAST_GROWTH else 0.0


def motions_by_scan(
    guess: AxisGuess, frame: ReducedFrame, pinhole: Pinhole, most: int, near: float | None
) -> Iterator[MotionGuess]:
    """Yield initial guesses of motion and stars from a scan for the rotation angle, see `scan_angles`."""
    chosen = np.flatnonzero(guess.agree)[:SCANNED_STARS]
    circles = Circles(guess.frame, guess.height[chosen], guess.middle[chosen])
    for angle, stars, light in scan_angles(frame, pinhole, circles, _MOST_HYPOTHESES, near):
        if len(light):
            motion = CameraMotion.steady(guess.frame[2] * angle)
            yield MotionGuess(motion, stars[:most], light[:most], 0.0)


_Arcs = tuple[FloatArray, IntArray, FloatArray]
_RegionPixels = tuple[IntArray, IntArray, FloatArray, IntArray]
"""Attributes `column`, `row`, `light` and `owner` of `BrightRegions`."""


def _arcs_numpy(
    pixels: _RegionPixels, frame: FloatArray, reference: FloatArray, view: tuple[float, float, float]
) -> _Arcs:
    """Return moments (3, n), end pixels (2, n) and azimuths of the end pixels (2, n) of n regions.

    The moments are the mean and the variance of the azimuth about the axis, relative to the azimuths
    `reference` (n,), and the mean cosine of the angle from the axis. The matrix `frame` (3, 3) is described
    in `Circles`. The tuple `view` contains the focal length and the image centre (x, y) of the camera, px.
    """
    n, (focal, centre_x, centre_y), (column, row, light, owner) = len(reference), view, pixels
    v = np.stack([(column - centre_x) / focal, (row - centre_y) / focal, np.ones(len(row))])
    x, y, z = frame @ (v / np.sqrt(np.sum(v * v, axis=0)))
    azimuth = np.arctan2(y, x) - reference[owner]
    azimuth = np.remainder(azimuth + np.pi, 2.0 * np.pi) - np.pi
    flux = np.bincount(owner, light, n)
    mean = np.bincount(owner, light * azimuth, n) / flux
    square = np.bincount(owner, light * azimuth**2, n) / flux - mean**2
    order = np.argsort(owner.astype(np.int16), kind="stable")
    theirs, whose = azimuth[order], owner[order]
    start, found = np.searchsorted(whose, np.arange(n)), []
    for extreme in (np.minimum.reduceat(theirs, start), np.maximum.reduceat(theirs, start)):
        pixel = np.flatnonzero(theirs == extreme[whose])
        found.append(order[pixel[np.searchsorted(whose[pixel], np.arange(n))]])
    outermost = np.stack(found)
    moments = np.stack([mean, square, np.bincount(owner, light * z, n) / flux])
    return moments, outermost, azimuth[outermost]


@compiled_form_of(_arcs_numpy)
def _arcs(
    pixels: _RegionPixels, frame: FloatArray, reference: FloatArray, view: tuple[float, float, float]
) -> _Arcs:
    n, (focal, centre_x, centre_y), (column, row, light, owner) = len(reference), view, pixels
    moments, outermost, bounds = np.zeros((3, n)), np.zeros((2, n), np.int64), np.empty((2, n))
    flux = np.zeros(n)
    bounds[0], bounds[1] = np.inf, -np.inf
    for p in range(len(owner)):
        region, weight = owner[p], light[p]
        u, v = (column[p] - centre_x) / focal, (row[p] - centre_y) / focal
        x = frame[0, 0] * u + frame[0, 1] * v + frame[0, 2]
        y = frame[1, 0] * u + frame[1, 1] * v + frame[1, 2]
        z = (frame[2, 0] * u + frame[2, 1] * v + frame[2, 2]) / math.sqrt(u * u + v * v + 1.0)
        azimuth = math.atan2(y, x) - reference[region]
        if abs(azimuth) > math.pi:
            azimuth -= math.copysign(2.0 * math.pi, azimuth)
        flux[region] += weight
        moments[0, region] += weight * azimuth
        moments[1, region] += weight * azimuth * azimuth
        moments[2, region] += weight * z
        if azimuth < bounds[0, region]:
            bounds[0, region], outermost[0, region] = azimuth, p
        if azimuth > bounds[1, region]:
            bounds[1, region], outermost[1, region] = azimuth, p
    for region in range(n):
        for k in range(3):
            moments[k, region] /= flux[region]
        moments[1, region] -= moments[0, region] ** 2
    return moments, outermost, bounds


def _at_border(regions: BrightRegions, pinhole: Pinhole, pixel: IntArray) -> BoolArray:
    """Return whether each of the pixels `pixel` (n,) lies at the border of the frame."""
    x, y, margin = regions.column[pixel], regions.row[pixel], 4
    inside_x = (x >= margin) & (x < pinhole.columns - margin)
    inside_y = (y >= margin) & (y < pinhole.rows - margin)
    return np.asarray(~(inside_x & inside_y))


def _angles(guess: AxisGuess, regions: BrightRegions) -> list[tuple[float, float]]:
    """Return likely rotation angles (rad), and the fractions of flux in regions longer than each angle."""
    whole = guess.agree & ~regions.cut & (guess.width > 0.0)
    candidates, weight = guess.width[whole], np.sqrt(regions.flux[whole])
    spread = _LENGTH_ERROR / guess.speed[whole] + _LENGTH_SHARE * candidates
    joined = _joined(guess, regions)
    candidates = np.append(candidates, joined[:, 0])
    spread, weight = np.append(spread, joined[:, 1]), np.append(weight, joined[:, 2])
    cut = guess.agree & regions.cut
    reach = np.abs(guess.last - guess.first)
    if not len(candidates):
        return [(float(np.max(reach[cut])), 0.0)] if cut.any() else []
    nearness = np.exp(-0.5 * ((candidates[:, None] - candidates) / np.hypot(spread[:, None], spread)) ** 2)
    votes = nearness @ weight
    # A region whose arc is longer than the rotation angle contradicts this angle, or is a blend of two stars.
    long = guess.agree & (guess.speed * reach > 20.0)
    longer = (reach - 10.0 / guess.speed)[long] > candidates[:, None] + 3.0 * spread[:, None]
    doubted = votes - longer @ np.sqrt(regions.flux[long])
    against = longer @ regions.flux[long] / max(float(regions.flux[guess.agree].sum()), 1e-9)
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


def _joined(guess: AxisGuess, regions: BrightRegions) -> FloatArray:
    """Return rotation angle, standard error and weight (k, 3) from k pairs of fragments on one circle."""
    part = np.flatnonzero(guess.agree & ~regions.cut)
    sine = np.sqrt(np.maximum(1.0 - guess.height[part] ** 2, 1e-12))
    # The factor `scale` converts a difference of `height` into the distance (px) between two circles.
    scale = guess.speed[part] / sine**2
    near = np.abs(guess.height[part, None] - guess.height[part]) * scale < _SAME_CIRCLE
    gap = guess.first[part][None, :] - guess.last[part][:, None]
    extent = guess.last[part][None, :] - guess.first[part][:, None]
    i, j = np.nonzero(near & (gap > 0.0) & (gap < 0.5 * extent))
    angle = extent[i, j] - 4.0 / guess.speed[part[i]]
    weight = 0.5 * np.sqrt(np.minimum(regions.flux[part[i]], regions.flux[part[j]]))
    spread = 2.0 / guess.speed[part[i]] + _LENGTH_SHARE * np.abs(angle)
    return np.stack([angle, spread, weight], axis=-1)[angle > 0.0]


def _stars_of_angle(
    guess: AxisGuess, regions: BrightRegions, pinhole: Pinhole, angle: float, most: int, growth: float
) -> tuple[FloatArray, FloatArray]:
    """Return centres (n, 2), px, and fluxes (n,) of the brightest streaks that fit the rotation angle."""
    spread = _LENGTH_ERROR / guess.speed + _LENGTH_SHARE * angle
    whole = guess.agree & ~regions.cut & (np.abs(guess.width - angle) < 4.0 * spread)
    reach = np.abs(guess.last - guess.first)
    one = guess.cut_first ^ guess.cut_last
    cut = guess.agree & regions.cut & one & (reach < angle + 6.0 * spread) & (reach > 0.25 * angle)
    # The centre of a truncated streak is computed from its end in the frame. Its region extends 2 px farther.
    past = 2.0 / guess.speed
    middle = np.where(guess.cut_first, guess.last - past - 0.5 * angle, guess.first + past + 0.5 * angle)
    middle = np.where(whole, guess.middle - growth / 12.0 * angle, middle)
    part = np.where(whole, 1.0, np.clip(reach / angle, 0.1, 1.0))
    chosen = np.flatnonzero(whole | cut)[:most]
    sine = np.sqrt(np.maximum(1.0 - guess.height[chosen] ** 2, 0.0))
    local = np.stack([sine * np.cos(middle[chosen]), sine * np.sin(middle[chosen]), guess.height[chosen]])
    pixel = pinhole.ideal.project((guess.frame.T @ local).T)
    seen = np.isfinite(pixel).all(axis=1)
    return pixel[seen], (regions.flux / part)[chosen][seen]


# Ratio of consecutive trial lengths of streaks in the search on all circles.
_FRAME_FACTOR = 1.1
# Smallest trial length (samples) of streaks in the search on all circles.
_FRAME_SHORTEST = 5
# Factor by which the search for the rotation angle reduces the number of circles.
_SPARSE = 2
# Minimum significance (standard deviations) of a possible streak above the samples on both sides of it.
_LEAST_SIGMAS = 5.0
# Upper limit of the significance (standard deviations) of one possible streak in the sum over all streaks.
_FRAME_ENOUGH = 40.0
# Upper limit of a sample in the second search on all circles, in standard deviations. Without the limit,
# variations of the samples along a bright streak, which may cross several circles, would look like streaks.
FRAME_CAP = 8.0


def frame_angles(
    frame: ReducedFrame, pinhole: Pinhole, rotation: FloatArray, most: int, cap: float
) -> list[float]:
    """Return at most `most` rotation angles (rad) about the axis of `rotation` (3,), most likely first.

    Samples are limited to `cap` standard deviations.
    """
    # The sampling of the grid is that for a rotation of one radian.
    grid = polar_grid(pinhole, CameraMotion.steady(rotation / np.linalg.norm(rotation)), _SPARSE)
    step, noise = grid.angle / grid.length, np.float32(SAMPLE_NOISE * frame.usual_noise)
    most_counts = np.float32(cap) * noise
    held = cumulative_sums(np.clip(frame.sums, -most_counts, most_counts), pinhole, grid)
    held *= np.float32(1.0) / noise
    longest = min(len(grid.azimuth) // 2, int(np.pi / step))
    if longest < 2 * _FRAME_SHORTEST:
        return []
    count = int(np.log(longest / _FRAME_SHORTEST) / np.log(_FRAME_FACTOR)) + 1
    widths = np.unique(np.rint(_FRAME_SHORTEST * _FRAME_FACTOR ** np.arange(count)).astype(np.int64))
    room = int(sharper_widths(int(widths[-1]), longest)[-1]) // 2
    # The azimuth is the first array axis, so that memory is read contiguously.
    padded = np.pad(np.ascontiguousarray(held.T), ((room, room), (0, 0)), mode="edge")
    score = np.array([_box_significance(padded, room, int(width)) for width in widths])
    before, after = np.append(0.0, score[:-1]), np.append(score[1:], 0.0)
    peak = np.flatnonzero((score > before) & (score >= after))
    peak = peak[np.argsort(-score[peak], kind="stable")][:most]
    angles = []
    for index in peak:
        near = sharper_widths(int(widths[index]), longest)
        refined = [_box_significance(padded, room, int(width)) for width in near]
        angles.append(int(near[int(np.argmax(refined))]) * step)
    return angles


def _box_significance(padded: Float32Array, room: int, width: int) -> float:
    """Return the sum of the squared significances of the most significant streaks of `width` samples.

    The array `padded` (c, r) contains the cumulative sums along the azimuth on r circles, with a margin of
    `room` samples at both ends.
    """
    stretches = (len(padded) - 2 * room - width) // width
    outer, inner, behind, beyond = (
        padded[room + offset : room + offset + stretches * width]
        for offset in (-(width // 2), 0, width, width + width // 2)
    )
    light = behind - inner
    light *= np.float32(2.0)
    light -= beyond
    light += outer
    # The most significant streak in each interval of one streak length along a circle is a candidate.
    # A candidate counts if no adjacent interval on the same or a neighbouring circle has a better candidate.
    best = light.reshape(stretches, width, -1).max(axis=1)
    best *= np.float32(1.0 / np.sqrt(2.0 * width))
    around = np.pad(best, 1)
    highest = best >= _LEAST_SIGMAS
    for down in (0, 1, 2):
        for beside in (0, 1, 2):
            highest &= best >= around[down : down + stretches, beside : beside + best.shape[1]]
    return float(np.sum(np.minimum(best[highest], _FRAME_ENOUGH) ** 2))


def sharper_widths(width: int, longest: int) -> IntArray:
    """Return the integer streak lengths (samples) within half a search step of `width`, up to `longest`."""
    room = max(1, round(0.6 * (_FRAME_FACTOR - 1.0) * width))
    return np.arange(max(width - room, 2), min(width + room, longest) + 1)
