"""Model of the counts of streaks and spots on the pixels, with derivatives with respect to all parameters.

A long streak is fitted on strips of pixels that consist of parallel lines of pixels across the star's path.
Sixteen neighbouring lines of pixels form a block, within which the derivatives with respect to the motion are
linear along the path. The pixels near the paths are selected once (`cut_strips`), and during the fit only
their distances from the path are updated.

Near a pixel, the path is approximated by an arc on which the star has the speed v, and s and n are
coordinates along and across the arc. The following equation gives the counts m of a pixel from a star of unit
flux.

    m = (1/v) g(n) [Phi((s - s0)/w) - Phi((s - s1)/w)] / sqrt(1 - k n),

In this equation, g is a Gaussian of standard deviation w, Phi the cumulative normal distribution, k the
curvature of the arc, and s0 and s1 the coordinates along the arc at the start and end of the exposure. With a
rolling shutter, s0 and s1 depend on the pixel's row. The integration over the square pixel is included in the
width w by w^2 = sigma^2 + 1/12, where sigma is the width of the point spread function (PSF). The fourth
cumulant of a uniform distribution over the pixel, -1/120 along each axis, corrects the profile across the
path. The following equation gives the change dm of the counts if a parameter displaces the path at time t by
c(t).

    dm = c_n (n/w^2) m + c_s(t1) e1 - c_s(t0) e0 - (dc_s/ds) m,

In this equation, c_n and c_s are the components of c across and along the path, and e0 and e1 are the counts
per px at the two streak ends. All derivatives of the counts are combinations of seven basis images, with
coefficients for each block of pixels. One basis image is (n/w^2) m multiplied by the distance along the path
from the centre of the block, with a correction at the streak ends. This image describes a linear change of
c_n within a block of pixels.

An angular acceleration displaces the path by c(t) that is quadratic in t. If the acceleration is fitted, two
further images describe a linear change of dc_s/ds and a quadratic change of c_n within a block. Without these
images, the derivative with respect to the acceleration is wrong for streaks that are shorter than two blocks
of pixels (by 20 % for streaks of 30 px), and the fit of such streaks diverges.

A spot is a short streak or the slow part of a longer streak. The model of a spot is a sum of Gaussians at
instants of the exposure (Gauss-Legendre quadrature), each integrated over every pixel. The quadrature is also
exact for a star at rest.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from knightcube.astro.arrays import Float32Array, FloatArray, IntArray
from knightcube.compiled import compiled_form_of, loop_helper
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks.camera_motion import CameraMotion
from knightcube.vision.streaks.fit_windows import LINES, Patches, Strips, path_distances
from knightcube.vision.streaks.geometry import (
    PointsAtLines,
    Shutter,
    exposure_bounds,
    paths,
    positions,
    sensitivities,
    sensitivities_and_velocity,
)

# Lower limit (px per exposure) of a star's speed, which avoids divisions by zero.
_SLOWEST = 1e-3

# Gauss-Legendre quadrature of a path segment; one node per point-spread width is accurate to 1e-4.
_NODE, _WEIGHT = np.polynomial.legendre.leggauss(10)
# Length of a path segment for the quadrature, in point-spread widths.
_PIECE_WIDTHS = 8.0
# Distance from a patch (point-spread widths) beyond which starlight does not reach the pixels of the patch.
_BEYOND = 5.5
# Number of instants at which a path with a changing rate is evaluated to divide it into segments.
_SPOT_SAMPLES = 33
_BELL = 1.0 / math.sqrt(2.0 * math.pi)
_ROOT_HALF = math.sqrt(0.5)
_OCTAVE = math.log(2.0)
_PER_OCTAVE = 1.0 / math.log(2.0)


def spot_derivatives(
    pinhole: Pinhole,
    motion: CameraMotion,
    shutter: Shutter,
    stars: FloatArray,
    sigma: float,
    patches: Patches,
) -> tuple[FloatArray, FloatArray]:
    """Return images (n, p, p) of n stars of unit flux on their patches, and the derivatives (n, 9, p, p).

    The derivatives are with respect to rate (3), acceleration (3), x, y, and point-spread width `sigma` (px).
    """
    count = len(stars)
    if not count:
        return np.empty(patches.index.shape), np.empty((0, 9, *patches.index.shape[1:]))
    edges = exposure_bounds(pinhole, motion, shutter, stars)
    if not motion.constant:
        edges = _pieces(pinhole, motion, stars, edges, sigma, patches)
    middle, half = 0.5 * (edges[:, 1:] + edges[:, :-1]), 0.5 * np.diff(edges)
    time = (middle[..., None] + half[..., None] * _NODE).reshape(count, -1)
    weight = (half[..., None] * _WEIGHT).reshape(count, -1)
    instants = time.shape[1]
    repeated = np.repeat(stars, instants, axis=0)
    place = positions(pinhole, motion, repeated, time.reshape(-1)).reshape(count, instants, 2)
    change = sensitivities(pinhole, motion, repeated, time.reshape(-1)).reshape(count, instants, 2, 8)
    x, dx, sx = profile(patches.column, place[..., 0], sigma)
    y, dy, sy = profile(patches.row, place[..., 1], sigma)
    y, dy, sy = (weight[..., None] * part for part in (y, dy, sy))
    down = y.swapaxes(1, 2)
    light = down @ x
    out = np.empty((count, 9, *light.shape[1:]))
    for k in range(8):
        by_x, by_y = change[:, :, 0, k, None], change[:, :, 1, k, None]
        out[:, k] = down @ (by_x * dx) + (by_y * dy).swapaxes(1, 2) @ x
    out[:, 8] = down @ sx + sy.swapaxes(1, 2) @ x
    return light, out


def _pieces(
    pinhole: Pinhole,
    motion: CameraMotion,
    stars: FloatArray,
    times: FloatArray,
    sigma: float,
    patches: Patches,
) -> FloatArray:
    """Return the times (n, p + 1) that divide each path near its patch into p segments of equal length."""
    n = len(stars)
    sampled = times[:, :1] + np.diff(times) * np.linspace(0.0, 1.0, _SPOT_SAMPLES)
    there = positions(pinhole, motion, np.repeat(stars, _SPOT_SAMPLES, axis=0), sampled.reshape(-1))
    there = there.reshape(n, _SPOT_SAMPLES, 2)
    room = _BEYOND * sigma
    low = np.stack([patches.column[:, 0], patches.row[:, 0]], axis=-1)[:, None] - room
    high = np.stack([patches.column[:, -1], patches.row[:, -1]], axis=-1)[:, None] + room
    near = np.all((there >= low) & (there <= high), axis=2)
    # The part near the patch is extended by one sample on each side. A path that is never near is divided as
    # a whole.
    near |= np.pad(near, ((0, 0), (1, 0)))[:, :-1] | np.pad(near, ((0, 0), (0, 1)))[:, 1:]
    near |= ~near.any(axis=1, keepdims=True)
    step = np.hypot(*np.moveaxis(np.diff(there, axis=1), 2, 0)) * (near[:, 1:] & near[:, :-1])
    way = np.concatenate([np.zeros((n, 1)), np.cumsum(step, axis=1)], axis=1)
    count = max(1, math.ceil(float(way[:, -1].max()) / (_PIECE_WIDTHS * sigma)))
    first, last = near.argmax(axis=1), _SPOT_SAMPLES - 1 - near[:, ::-1].argmax(axis=1)
    share = np.linspace(0.0, 1.0, count + 1)
    out = np.empty((n, count + 1))
    for star in range(n):
        part = slice(first[star], last[star] + 1)
        # The small linear term makes the path length strictly increasing even for a star at rest.
        run = way[star, part] + 1e-6 * np.arange(last[star] + 1 - first[star])
        out[star] = np.interp(run[0] + share * (run[-1] - run[0]), run, sampled[star, part])
    return out


def profile(pixels: IntArray, place: FloatArray, sigma: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the fractions (n, m, p) of the flux on p columns or rows of pixels, and two derivatives.

    Each of m Gaussians of standard deviation `sigma` (px) is centred on its `place` (n, m), in px along one
    axis. The fractions are differentiated with respect to the centre of the Gaussian (`place`) and its width
    (`sigma`).
    """
    right = (pixels[:, None, :] + 0.5 - place[..., None]) / sigma
    left = right - 1.0 / sigma
    bell_right = _BELL * np.exp(-0.5 * right**2)
    bell_left = _BELL * np.exp(-0.5 * left**2)
    share = ndtr(right) - ndtr(left)
    return share, (bell_left - bell_right) / sigma, (left * bell_left - right * bell_right) / sigma


IMAGES = 7
"""Number of images that are combined into the counts and derivatives of a block of pixels."""
QUADRATIC_IMAGES = 2
"""Number of images for displacements that are quadratic along the path, stored after the other images."""

# Number of blocks computed in one step, small enough for their pixels to fit into the processor's cache.
_AT_ONCE = 256
# Distance from a streak end, in point-spread widths, beyond which the end does not affect the intensity.
_ENDS = 5.5
# Largest distance along a path (point-spread widths) between a pixel and the crossing of its line of pixels.
_OBLIQUE = 7.0
# Time step of numerical derivatives, in units of the exposure time.
_STEP = 1e-4
# Fourth cumulant (px^4) of a uniform distribution over a pixel.
_KURTOSIS = -1.0 / 120.0


def images(
    pinhole: Pinhole,
    motion: CameraMotion,
    shutter: Shutter,
    stars: FloatArray,
    width: float,
    strips: Strips,
    count: int = IMAGES + 1,
) -> Float32Array:
    """Return images (b, count, LINES, k) whose combinations model `stars` (n, 2), px, of unit flux.

    The argument `width` is the width w of the PSF, px. If `count` is 1, only the counts of the stars are
    computed. Otherwise, the last image of each block is not initialised; the calling function sets it. With
    IMAGES + 1 images, displacements are linear along the path within a block; with QUADRATIC_IMAGES more
    images, they are quadratic.
    """
    shape = strips.time.shape
    path = paths(pinhole, motion, np.repeat(stars[strips.star], LINES, axis=0), strips.time.reshape(-1))
    out = np.empty((len(strips.star), count, *strips.index.shape[1:]), dtype=np.float32)
    delay = float(shutter.delay_per_row), float(shutter.middle)
    _draw(out, (strips.corner, strips.step, strips.time), path.at_lines(shape), width, delay)
    return out


_BlockLines = tuple[IntArray, IntArray, FloatArray]
"""Attributes `corner`, `step` and `time` of `Strips`."""


def _draw_numpy(
    out: Float32Array, lines: _BlockLines, points: PointsAtLines, width: float, delay: tuple[float, float]
) -> None:
    """Compute the basis images `out` (b, .., LINES, k) from the points at which paths cross lines of pixels.

    The argument `points` is the result of `StarPaths.at_lines`. The argument `delay` contains two values: the
    exposure delay from row to row, and the row without delay.
    """
    (corner, step, time), (position, velocity, acceleration) = lines, points
    speed = np.maximum(np.hypot(velocity[0], velocity[1]), _SLOWEST)
    tangent = velocity / speed
    # The variable `gained` is the star's acceleration along its path, px per exposure^2.
    gained = np.sum(acceleration * tangent, axis=0)
    bend = (acceleration[1] * tangent[0] - acceleration[0] * tangent[1]) / speed**2
    centre = time[:, LINES // 2 - 1 : LINES // 2 + 1].mean(axis=1, keepdims=True)
    there, way = position.transpose(1, 2, 0), tangent.transpose(1, 2, 0)
    crossings = _Crossings(corner, step, there, way, time, centre, speed, gained, bend)
    for first in range(0, len(out), _AT_ONCE):
        part = slice(first, first + _AT_ONCE)
        drawn = np.empty((len(out[part]), max(IMAGES, out.shape[1] - 1), *out.shape[2:]), dtype=np.float32)
        _draw_part(drawn, _Crossings._make(each[part] for each in crossings), width, Shutter(*delay))
        out[part, : drawn.shape[1]] = drawn[:, : out.shape[1]]


class _Crossings(NamedTuple):
    """Points at which paths cross the lines of b blocks of pixels (b, LINES).

    The first pixels (`corner`) and the steps (`step`) of the lines are described in `Strips`. Position and
    unit tangent have the shape (b, LINES, 2), and the time at the centre of each block (b, 1). The
    acceleration along the path is `gained`, and the curvature `bend`.
    """

    corner: IntArray
    step: IntArray
    position: FloatArray
    tangent: FloatArray
    time: FloatArray
    centre: FloatArray
    speed: FloatArray
    gained: FloatArray
    bend: FloatArray


def _draw_part(out: Float32Array, lines: _Crossings, width: float, shutter: Shutter) -> None:
    """Compute the basis images `out` of a group of blocks of pixels."""
    light, aside, s = _endless(lines, out.shape[3], width)
    s += ((lines.time - lines.centre) * lines.speed).astype(np.float32)
    out[:, 0] = light.transpose(1, 2, 0)
    across, along = (np.ascontiguousarray(each.transpose(1, 2, 0)) for each in (aside, s))
    _ends(out, along, lines, shutter, width)
    light = out[:, 0]
    u = across * across
    u *= np.float32(1.0 / width**3)
    u -= np.float32(1.0 / width)
    u *= light
    out[:, 5] += u
    across *= np.float32(1.0 / width**2)
    np.multiply(across, light, out=out[:, 1])
    if out.shape[1] > IMAGES:
        # The image `out[:, 7]` is the first moment of the counts along the path, between the streak ends.
        out[:, 7] = along * light + np.float32(width**2) * (out[:, 3] - out[:, 4])
        out[:, 8] *= across * np.float32(width**2)
        out[:, 8] += (along * along + np.float32(width**2)) * out[:, 1]
    # The image `out[:, 2]` is the first moment of `out[:, 1]` along the path, between the streak ends.
    along *= out[:, 1]
    across *= np.float32(width**2)
    across *= out[:, 3] - out[:, 4]
    np.add(along, across, out=out[:, 2])
    out[:, 6] = 1.0


def _endless(lines: _Crossings, count: int, width: float) -> tuple[Float32Array, Float32Array, Float32Array]:
    """Return the counts of an infinitely long streak, and each pixel's distance (px) across and along it.

    All returned arrays have the shape (count, b, LINES) for b blocks with `count` pixels per line.
    """
    speed, gained, bend = lines.speed, lines.gained, lines.bend
    tx, ty = lines.tangent[..., 0], lines.tangent[..., 1]
    aside, ahead = path_distances(lines.corner, lines.step, lines.position, lines.tangent, count)
    squeeze = bend.astype(np.float32) * aside
    np.clip(squeeze, np.float32(-0.5), np.float32(0.5), out=squeeze)
    s = ahead / (np.float32(1.0) - squeeze)
    ahead *= (0.5 * bend).astype(np.float32)
    ahead *= s
    aside -= ahead
    u = aside * aside
    u *= np.float32(1.0 / width**2)
    light = np.multiply(u, np.float32(-0.5), out=ahead)
    np.exp(light, out=light)
    # The intensity is inversely proportional to the speed, and larger on the inner side of a curved path.
    light *= np.float32(1.0) + squeeze * (np.float32(0.5) + np.float32(0.375) * squeeze)
    light *= np.float32(1.0) - s * (gained / speed**2).astype(np.float32)
    scale = _BELL / (width * speed)
    # For a path with the unit tangent (tx, ty), 1 - 2 tx^2 ty^2 is the sum of the fourth powers of tx and ty.
    square = scale * (_KURTOSIS / (24.0 * width**4)) * (1.0 - 2.0 * np.square(tx * ty))
    u = (u - np.float32(6.0)) * u
    u *= square.astype(np.float32)
    u += (scale + 3.0 * square).astype(np.float32)
    light *= u
    return light, aside, s


def _ends(out: Float32Array, along: Float32Array, lines: _Crossings, shutter: Shutter, width: float) -> None:
    """Remove from the image of an infinite streak, `out[:, 0]`, the counts beyond the streak ends.

    The images of the streak ends, `out[:, 3:5]`, and the effect of the ends on the derivative `out[:, 5]`
    with respect to the width are computed as well. The argument `along` (b, LINES, k), px, is the distance
    along the path of each pixel from the centre of its block.
    """
    out[:, 3:6] = out[:, IMAGES:] = 0.0
    crossing, centre, speed, gained = lines.time, lines.centre, lines.speed, lines.gained
    rolling = shutter.delay_per_row != 0.0
    delay = np.zeros((len(along), 1, 1), dtype=np.float32)
    if rolling:
        rows = lines.corner[:, :, 1, None] + np.arange(along.shape[2]) * lines.step[:, 1, None, None]
        delay = shutter.delay(rows.astype(np.float32))
    for end, image in ((-0.5, 3), (0.5, 4)):
        sign = -1.0 if end > 0.0 else 1.0
        closest = sign * (crossing - end) - np.max(sign * delay[..., [0, -1]], axis=-1)
        near = np.flatnonzero((closest * speed < (_ENDS + _OBLIQUE) * width).any(axis=1))
        if not near.size:
            continue
        u = along[near]
        before_end = crossing[near] - end
        u += _wide((centre[near] - end) * speed[near] - 0.5 * gained[near] * before_end**2)
        if rolling:
            # With a rolling shutter, the end of the exposure depends on the row of the pixel.
            u -= delay[near] * _wide(speed[near])
        # The sum of the distances of a pixel and of the streak end from the centre of the block.
        both = np.float32(2.0) * along[near] - u
        u *= np.float32(sign / width)
        bell = u * u
        bell *= np.float32(-0.5)
        np.exp(bell, out=bell)
        bell *= np.float32(_BELL / width)
        before = out[near, 0]
        bell *= before
        out[near, image] = bell
        out[near, IMAGES + 1 :] += (np.float32(sign) * both * bell)[:, None]
        out[near, 0] = before * ndtr(u)
        # If the speed changes, the intensities at a streak's end and at the centre of the block differ.
        thinning = gained[near] / speed[near] ** 2
        out[near, 0] -= _wide(sign * width**2 * thinning) * bell
        bell *= u
        out[near, 5] -= bell


@compiled_form_of(_draw_numpy)
def _draw(
    out: Float32Array, lines: _BlockLines, points: PointsAtLines, width: float, delay: tuple[float, float]
) -> None:
    (corner, step, time), (position, velocity, acceleration) = lines, points
    blocks, images_count, line_count, count = out.shape
    size, light_only = line_count * count, images_count == 1
    drawn = np.empty((IMAGES, size), dtype=np.float32)
    values = np.zeros((_VALUES, line_count, count), dtype=np.float32)
    pixels = values.reshape(_VALUES, size)
    power = np.zeros(pixels.shape[1], dtype=np.int32)
    exponential, of_lines = power.view(np.float32), np.empty((line_count, 5))
    narrow = 1.0 / width**2
    for b in range(blocks):
        if not light_only:
            drawn = out[b].reshape(images_count, size)
        centre = 0.5 * (time[b, line_count // 2 - 1] + time[b, line_count // 2])
        by_x, by_y = step[b, 0], step[b, 1]
        for i in range(line_count):
            speed = max(math.sqrt(velocity[0, b, i] ** 2 + velocity[1, b, i] ** 2), _SLOWEST)
            tx, ty = velocity[0, b, i] / speed, velocity[1, b, i] / speed
            bent_x, bent_y = acceleration[0, b, i], acceleration[1, b, i]
            dx, dy = corner[b, i, 0] - position[0, b, i], corner[b, i, 1] - position[1, b, i]
            gained, shift = bent_x * tx + bent_y * ty, (time[b, i] - centre) * speed
            scale = _BELL / (width * speed)
            square = scale * _KURTOSIS / 24.0 * narrow * narrow * (1.0 - 2.0 * (tx * ty) ** 2)
            first = dy * tx - dx * ty, dx * tx + dy * ty
            each = by_y * tx - by_x * ty, by_x * tx + by_y * ty
            bend, thinning = (bent_y * tx - bent_x * ty) / speed**2, gained / speed**2
            shared = bend, thinning, shift, scale + 3.0 * square, square
            _set_line(values, i, first, each, shared)
            of_lines[i, 0], of_lines[i, 1], of_lines[i, 2] = speed, gained, time[b, i]
            of_lines[i, 3], of_lines[i, 4] = centre, (corner[b, i, 1] - delay[1]) * delay[0]
        _endless_block(pixels, narrow)
        _exponential(pixels[_EXPONENT], power, exponential)
        _fill(drawn, pixels, exponential)
        for sign in (1.0, -1.0):
            if _reaches_end(of_lines, width, sign, by_y * delay[0] * (count - 1)):
                _from_end(values, of_lines, width, sign, by_y * delay[0])
                _exponential(pixels[_EXPONENT], power, exponential)
                _draw_end(drawn, pixels, exponential, width, sign)
        if light_only:
            for line in range(line_count):
                for k in range(count):
                    out[b, 0, line, k] = drawn[0, line * count + k]
        else:
            _draw_moments(drawn, pixels, width)


# Rows of `values` in `_draw`: distances (px) of a pixel across the path and ahead of the crossing, curvature
# of the path, acceleration along the path divided by the squared speed, and distance (px) of the crossing
# from the centre of the block.
_ACROSS, _AHEAD, _BEND, _THINNING, _SHIFT = range(5)
_Five = tuple[float, float, float, float, float]
# Further rows: constant and quadratic coefficients of the profile's factor, distance (px) along the path,
# exponent and factor of the profile, and distance (point-spread widths) from a streak end.
_CONSTANT, _QUADRATIC, _ALONG, _EXPONENT, _FACTOR, _DISTANCE = range(5, 11)
_VALUES = 11


@loop_helper
def _set_line(
    pixels: Float32Array, i: int, first: tuple[float, float], each: tuple[float, float], shared: _Five
) -> None:
    """Set the distances of the pixels of the line `i`, and the values that all pixels of the line share.

    The pair `first` (px) contains the distances of the first pixel from the crossing, across and along the
    path, and `each` their increments from pixel to pixel.
    """
    across, ahead = np.float32(first[0]), np.float32(first[1])
    by_across, by_ahead = np.float32(each[0]), np.float32(each[1])
    bend, thinning, shift = np.float32(shared[0]), np.float32(shared[1]), np.float32(shared[2])
    constant, quadratic = np.float32(shared[3]), np.float32(shared[4])
    for k in range(pixels.shape[2]):
        offset = np.float32(np.int32(k))
        pixels[_ACROSS, i, k], pixels[_AHEAD, i, k] = across + offset * by_across, ahead + offset * by_ahead
        pixels[_BEND, i, k], pixels[_THINNING, i, k], pixels[_SHIFT, i, k] = bend, thinning, shift
        pixels[_CONSTANT, i, k], pixels[_QUADRATIC, i, k] = constant, quadratic


@loop_helper
def _endless_block(pixels: Float32Array, narrow: float) -> None:
    """Compute exponent and factor of an infinite streak's profile from the values of `_set_line`.

    The distance across the path is corrected for the path's curvature. The distance along the curved path
    from the centre of the block is also computed. The argument `narrow` is the inverse squared width.
    """
    half, one, cubic = np.float32(0.5), np.float32(1.0), np.float32(0.375)
    six, inverse = np.float32(6.0), np.float32(narrow)
    for k in range(pixels.shape[1]):
        squeeze = min(max(pixels[_BEND, k] * pixels[_ACROSS, k], -half), half)
        pixels[_ALONG, k] = pixels[_AHEAD, k] / (one - squeeze)
    for k in range(pixels.shape[1]):
        squeeze = min(max(pixels[_BEND, k] * pixels[_ACROSS, k], -half), half)
        thinned = one - pixels[_ALONG, k] * pixels[_THINNING, k]
        pixels[_FACTOR, k] = (one + squeeze * (half + cubic * squeeze)) * thinned
    for k in range(pixels.shape[1]):
        pixels[_ACROSS, k] -= half * pixels[_BEND, k] * pixels[_AHEAD, k] * pixels[_ALONG, k]
    for k in range(pixels.shape[1]):
        u = inverse * pixels[_ACROSS, k] * pixels[_ACROSS, k]
        pixels[_EXPONENT, k] = -half * u
        pixels[_FACTOR, k] *= (u - six) * u * pixels[_QUADRATIC, k] + pixels[_CONSTANT, k]
    for k in range(pixels.shape[1]):
        pixels[_ALONG, k] += pixels[_SHIFT, k]


@loop_helper
def _exponential(exponents: Float32Array, power: npt.NDArray[np.int32], out: Float32Array) -> None:
    """Compute the exponential `out` (k,) of non-positive exponents (k,), which are overwritten.

    The power of two is written as the exponent bits (`power`) of `out`, which shares its memory with `power`.
    Exponents below -80 are replaced by -80.
    """
    lowest, half, one = np.float32(-80.0), np.float32(0.5), np.float32(1.0)
    per_octave, octave = np.float32(_PER_OCTAVE), np.float32(_OCTAVE)
    third, quarter, fifth = np.float32(1 / 3), np.float32(1 / 4), np.float32(1 / 5)
    sixth, seventh = np.float32(1 / 6), np.float32(1 / 7)
    for k in range(len(power)):
        exponent = max(exponents[k], lowest)
        whole = np.int32(exponent * per_octave - half)
        exponents[k] = exponent - np.float32(whole) * octave
        power[k] = (whole + np.int32(127)) << np.int32(23)
    for k in range(len(power)):
        x = exponents[k]
        series = one + x * quarter * (one + x * fifth * (one + x * sixth * (one + x * seventh)))
        out[k] *= one + x * (one + x * half * (one + x * third * series))


@loop_helper
def _fill(out: Float32Array, pixels: Float32Array, exponential: Float32Array) -> None:
    """Set `out[0]` to the counts of an infinitely long streak, and initialise `out[3:7]` and `out[8:]`."""
    for k in range(out.shape[1]):
        out[0, k] = exponential[k] * pixels[_FACTOR, k]
    out[3:6] = out[IMAGES + 1 :] = 0.0
    out[6] = 1.0


@loop_helper
def _reaches_end(of_lines: FloatArray, width: float, sign: float, later: float) -> bool:
    """Return whether a streak end is so near to a line of a block that it may affect the counts.

    The `sign` is 1 for the start and -1 for the stop of the exposure. The rows of `of_lines` contain the
    speed of the star at a line, its acceleration along the path, the time at which it crosses the line, the
    time at the centre of the block, and the exposure delay of the first pixel. The delay of the last pixel is
    larger by `later`.
    """
    for i in range(len(of_lines)):
        speed, time, late = of_lines[i, 0], of_lines[i, 2], of_lines[i, 4]
        edge = max(late, late + later) if sign > 0.0 else min(late, late + later)
        if 0.5 + sign * (time - edge) < (_ENDS + _OBLIQUE) * width / speed:
            return True
    return False


@loop_helper
def _from_end(pixels: Float32Array, of_lines: FloatArray, width: float, sign: float, later: float) -> None:
    """Compute the distance (point-spread widths) of each pixel from one streak end, and Gaussian exponents.

    The arguments are described in `_reaches_end`, except that the delay increases by `later` from pixel to
    pixel.
    """
    scale, half = np.float32(sign / width), np.float32(-0.5)
    for i in range(len(of_lines)):
        speed, time, centre, late = of_lines[i, 0], of_lines[i, 2], of_lines[i, 3], of_lines[i, 4]
        from_end = time + 0.5 * sign
        shift = np.float32((centre + 0.5 * sign - late) * speed - 0.5 * of_lines[i, 1] * from_end**2)
        slope = np.float32(later * speed)
        for k in range(pixels.shape[2]):
            u = (pixels[_ALONG, i, k] + shift - np.float32(np.int32(k)) * slope) * scale
            pixels[_DISTANCE, i, k], pixels[_EXPONENT, i, k] = u, half * u * u


@loop_helper
def _draw_end(
    out: Float32Array, pixels: Float32Array, exponential: Float32Array, width: float, sign: float
) -> None:
    """Remove the counts beyond one streak end from a block of pixels, see `_ends`.

    The cumulative normal distribution is the approximation 26.2.17 of Abramowitz and Stegun, Handbook of
    Mathematical Functions (1964), with an error below 1e-7.
    """
    image, scale, thinned = 3 if sign > 0.0 else 4, np.float32(_BELL / width), np.float32(sign * width**2)
    zero, one, bell_one, p = np.float32(0.0), np.float32(1.0), np.float32(_BELL), np.float32(0.2316419)
    b1, b2, b3 = np.float32(0.319381530), np.float32(-0.356563782), np.float32(1.781477937)
    b4, b5 = np.float32(-1.821255978), np.float32(1.330274429)
    for k in range(out.shape[1]):
        u = pixels[_DISTANCE, k]
        t = one / (one + p * abs(u))
        tail = bell_one * exponential[k] * t * (b1 + t * (b2 + t * (b3 + t * (b4 + t * b5))))
        pixels[_FACTOR, k] = one - tail if u > zero else tail
    for k in range(out.shape[1]):
        out[image, k] = exponential[k] * scale * out[0, k]
    if len(out) > IMAGES + 1:
        two, reach = np.float32(2.0 * sign), np.float32(width)
        for k in range(out.shape[1]):
            both = two * pixels[_ALONG, k] - reach * pixels[_DISTANCE, k]
            out[IMAGES + 1, k] += both * out[image, k]
    for k in range(out.shape[1]):
        out[5, k] -= out[image, k] * pixels[_DISTANCE, k]
    for k in range(out.shape[1]):
        out[0, k] = out[0, k] * pixels[_FACTOR, k] - thinned * pixels[_THINNING, k] * out[image, k]


@loop_helper
def _draw_moments(out: Float32Array, pixels: Float32Array, width: float) -> None:
    """Compute the images of a block of pixels that depend on the counts within the exposure."""
    narrow, cubed = np.float32(1.0 / width**2), np.float32(1.0 / width**3)
    inverse = np.float32(1.0 / width)
    for k in range(out.shape[1]):
        out[1, k] = pixels[_ACROSS, k] * narrow * out[0, k]
    for k in range(out.shape[1]):
        out[2, k] = pixels[_ALONG, k] * out[1, k] + pixels[_ACROSS, k] * (out[3, k] - out[4, k])
    for k in range(out.shape[1]):
        across = pixels[_ACROSS, k]
        out[5, k] += (across * across * cubed - inverse) * out[0, k]
    if len(out) > IMAGES + 1:
        square = np.float32(width**2)
        for k in range(out.shape[1]):
            out[7, k] = pixels[_ALONG, k] * out[0, k] + square * (out[3, k] - out[4, k])
        for k in range(out.shape[1]):
            moment = (pixels[_ALONG, k] * pixels[_ALONG, k] + square) * out[1, k]
            out[8, k] = moment + pixels[_ACROSS, k] * out[8, k]


def _wide(line: FloatArray) -> Float32Array:
    """Return values of lines of pixels (b, l) as float32, with a new axis for the pixels of a line."""
    return line[..., None].astype(np.float32)


def coefficients(
    pinhole: Pinhole,
    motion: CameraMotion,
    shutter: Shutter,
    stars: FloatArray,
    strips: Strips,
    growing: bool = True,
    quadratic: bool = False,
) -> FloatArray:
    """Return coefficients (b, IMAGES, 8) that combine images into a star's derivatives on b pixel blocks.

    The eight derivatives are with respect to rate (3), acceleration (3), and the star's position x and y. The
    derivatives with respect to the acceleration are zero unless the rate changes (`growing`). Within a block,
    displacements are linear along the path. If `quadratic` is True, displacements are quadratic along the
    path, and the result also contains the coefficients of QUADRATIC_IMAGES additional images.
    """
    centre = 0.5 * (strips.time[:, LINES // 2 - 1] + strips.time[:, LINES // 2])
    of_block = stars[strips.star]
    # With a rolling shutter, the time of a streak's end depends on the row of the block of pixels.
    delay = np.zeros(len(stars))
    ending, spread = stars, strips.star
    if shutter.delay_per_row != 0.0:
        last = strips.index.shape[2] - 1
        rows = strips.corner[:, LINES // 2, 1] + 0.5 * last * strips.step[:, 1]
        delay, ending, spread = np.asarray(shutter.delay(rows)), of_block, np.arange(len(centre))
    times = np.concatenate([centre - _STEP, centre + _STEP, delay - 0.5, delay + 0.5])
    points = np.concatenate([of_block, of_block, ending, ending])
    if quadratic:
        times, points = np.concatenate([times, centre]), np.concatenate([points, of_block])
    change, velocity = sensitivities_and_velocity(pinhole, motion, points, times, growing)
    return _mixtures(np.ascontiguousarray(change), np.ascontiguousarray(velocity), spread, quadratic)


def _mixtures_numpy(
    change: FloatArray, velocity: FloatArray, spread: IntArray, quadratic: bool
) -> FloatArray:
    """Return the result of `coefficients`, computed from the derivatives of star positions.

    The derivatives `change` (m, 2, 8) and the velocities (m, 2) are given at four groups of instants: shortly
    before and shortly after the star crosses the centre of each block, and at the starts and the stops of
    exposures. If `quadratic` is True, the crossings of the centres are a fifth group. The array `spread` (b,)
    contains the index of each block's start among the starts, which is also that of its stop among the stops.
    """
    speed = np.maximum(np.hypot(velocity[:, 0], velocity[:, 1]), _SLOWEST)
    tx, ty = (velocity / speed[:, None]).T[:, :, None]
    shift = (change[:, 0] * tx + change[:, 1] * ty) / speed[:, None]
    side = change[:, 1] * tx - change[:, 0] * ty
    blocks = len(spread)
    ends = (len(change) - (3 if quadratic else 2) * blocks) // 2
    cuts = [blocks, 2 * blocks, 2 * blocks + ends, 2 * blocks + 2 * ends]
    shift_a, shift_b, shift_first, shift_last, shift_centre = np.split(shift, cuts)
    side_a, side_b, _, _, side_centre = np.split(side, cuts)
    _, fast, fast_first, fast_last, _ = np.split(speed, cuts)
    out = np.zeros((blocks, IMAGES + (QUADRATIC_IMAGES if quadratic else 0), 8))
    out[:, 0] = (shift_a - shift_b) / (2.0 * _STEP)
    out[:, 1] = 0.5 * (side_a + side_b)
    out[:, 2] = (side_b - side_a) / (2.0 * _STEP * fast[:, None])
    out[:, 3] = -(shift_first * fast_first[:, None])[spread]
    out[:, 4] = (shift_last * fast_last[:, None])[spread]
    if quadratic:
        out[:, 7] = (2.0 * shift_centre - shift_a - shift_b) / (_STEP**2 * fast[:, None])
        out[:, 8] = 0.5 * (side_a + side_b - 2.0 * side_centre) / (_STEP * fast[:, None]) ** 2
    return out


@compiled_form_of(_mixtures_numpy)
def _mixtures(change: FloatArray, velocity: FloatArray, spread: IntArray, quadratic: bool) -> FloatArray:
    blocks = len(spread)
    ends = (len(change) - (3 if quadratic else 2) * blocks) // 2
    out = np.zeros((blocks, IMAGES + (QUADRATIC_IMAGES if quadratic else 0), 8))
    for b in range(blocks):
        first, middle = 2 * blocks + spread[b], 2 * blocks + 2 * ends + b
        tx, ty, speed = _tangent(velocity[b])
        ux, uy, fast = _tangent(velocity[blocks + b])
        vx, vy, _ = _tangent(velocity[first])
        wx, wy, _ = _tangent(velocity[first + ends])
        for k in range(8):
            before, after = change[b, :, k], change[blocks + b, :, k]
            shift = (before[0] * tx + before[1] * ty) / speed - (after[0] * ux + after[1] * uy) / fast
            side, later = before[1] * tx - before[0] * ty, after[1] * ux - after[0] * uy
            out[b, 0, k], out[b, 1, k] = shift / (2.0 * _STEP), 0.5 * (side + later)
            out[b, 2, k] = (later - side) / (2.0 * _STEP * fast)
            out[b, 3, k] = -(change[first, 0, k] * vx + change[first, 1, k] * vy)
            out[b, 4, k] = change[first + ends, 0, k] * wx + change[first + ends, 1, k] * wy
            if quadratic:
                mx, my, pace = _tangent(velocity[middle])
                at = change[middle, :, k]
                ahead = (before[0] * tx + before[1] * ty) / speed + (after[0] * ux + after[1] * uy) / fast
                out[b, 7, k] = (2.0 * (at[0] * mx + at[1] * my) / pace - ahead) / (_STEP**2 * fast)
                aside = side + later - 2.0 * (at[1] * mx - at[0] * my)
                out[b, 8, k] = 0.5 * aside / (_STEP * fast) ** 2
    return out


@loop_helper
def _tangent(velocity: FloatArray) -> tuple[float, float, float]:
    """Return the direction (x, y) of a velocity (2,), and its magnitude."""
    speed = max(math.sqrt(velocity[0] ** 2 + velocity[1] ** 2), _SLOWEST)
    return velocity[0] / speed, velocity[1] / speed, speed
