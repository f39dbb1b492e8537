"""The light of a long streak on the pixels about it, and how it changes with every parameter.

About a pixel the path is an arc: s along it, n across it, speed v. The light, per unit of the star's, is

    m = (1/v) g(n) [Phi((s - s0)/w) - Phi((s - s1)/w)] / sqrt(1 - k n),

with g a Gaussian of width w, k the arc's curvature, s0 and s1 where the exposure begins and ends, which a
rolling shutter makes a matter of the pixel's row. The pixel's own square is in w, w^2 = sigma^2 + 1/12, and
its fourth cumulant, -1/120 along each axis, in a correction of the profile across. When a parameter
moves the path by c(t), the light changes by

    dm = c_n n/w^2 m + c_s(t1) e1 - c_s(t0) e0 - (dc_s/ds) m,

where e0 and e1 are the light per px of path at the two ends: seven images serve all parameters, each block of
pixels with its own coefficients. Where c_n changes along the path, the first moment of m about the block
serves.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.special import ndtr

from knightcube.astro.arrays import FloatArray
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks.maximum_likelihood.exposed_frame import Float32Array
from knightcube.vision.streaks.maximum_likelihood.motion import Motion, moving, paths
from knightcube.vision.streaks.maximum_likelihood.shutter import Shutter
from knightcube.vision.streaks.maximum_likelihood.strips import LINES, Strips, beside

IMAGES = 7
"""m, (n/w^2) m, its first moment along the path, e0, e1, dm/dw, 1."""

# Blocks are drawn in groups of this many, so that their pixels stay in the processor's cache.
_AT_ONCE = 256
_ENDS = 5.5
"""Widths from an end beyond which its profile is 0 or 1."""
_OBLIQUE = 7.0
"""Widths by which a pixel may lie ahead of where its line crosses the path."""
_STEP = 1e-4
_SLOWEST = 1e-3
_BELL = 1.0 / math.sqrt(2.0 * math.pi)
_KURTOSIS = -1.0 / 120.0


def images(
    pinhole: Pinhole,
    motion: Motion,
    shutter: Shutter,
    stars: FloatArray,
    width: float,
    strips: Strips,
    more: int = 0,
) -> Float32Array:
    """Return the images (b, IMAGES + more, LINES, k) of stars (n, 2), each of light 1, on their strips.

    `width` is w in px; this many `more` images are left for others to fill in.
    """
    shape = strips.time.shape
    path = paths(pinhole, motion, np.repeat(stars[strips.star], LINES, axis=0), strips.time.reshape(-1))
    velocity = path.velocity.reshape(*shape, 2)
    speed = np.maximum(np.hypot(velocity[..., 0], velocity[..., 1]), _SLOWEST)
    position, acceleration = path.position.reshape(*shape, 2), path.acceleration.reshape(*shape, 2)
    lines = position, velocity / speed[..., None], speed, acceleration
    out = np.empty((len(strips.star), IMAGES + more, *strips.index.shape[1:]), dtype=np.float32)
    for first in range(0, len(out), _AT_ONCE):
        part = slice(first, first + _AT_ONCE)
        _draw(out[part], strips, part, tuple(line[part] for line in lines), shutter, width)
    return out


def _draw(
    out: Float32Array,
    strips: Strips,
    part: slice,
    path: tuple[FloatArray, ...],
    shutter: Shutter,
    width: float,
) -> None:
    """Fill in the images of some blocks; `path`: position, tangent, speed and acceleration on their lines."""
    speed, time = path[2], strips.time[part]
    # By how much the speed along the path grows, px per exposure squared.
    gained = np.sum(path[3] * path[1], axis=-1)
    light, aside, s = _endless(strips, part, (*path, gained), out.shape[3], width)
    centre = time[:, LINES // 2 - 1 : LINES // 2 + 1].mean(axis=1, keepdims=True)
    s += ((time - centre) * speed).astype(np.float32)
    out[:, 0] = light.transpose(1, 2, 0)
    across, along = (np.ascontiguousarray(each.transpose(1, 2, 0)) for each in (aside, s))
    _ends(out, along, (time, centre, speed, gained), shutter, strips, part, width)
    light = out[:, 0]
    u = across * across
    u *= np.float32(1.0 / width**3)
    u -= np.float32(1.0 / width)
    u *= light
    out[:, 5] += u
    across *= np.float32(1.0 / width**2)
    np.multiply(across, light, out=out[:, 1])
    # The first moment of the light along the path, and the part that its ends cut off.
    along *= out[:, 1]
    across *= np.float32(width**2)
    across *= out[:, 3] - out[:, 4]
    np.add(along, across, out=out[:, 2])
    out[:, 6] = 1.0


def _endless(
    strips: Strips, part: slice, path: tuple[FloatArray, ...], count: int, width: float
) -> tuple[Float32Array, Float32Array, Float32Array]:
    """Return light of a path without ends, px beside it and px ahead on it, of some blocks' pixels.

    All are (count, b, LINES), `count` pixels a line.
    """
    position, tangent, speed, acceleration, gained = path
    tx, ty = tangent[..., 0], tangent[..., 1]
    bend = (acceleration[..., 1] * tx - acceleration[..., 0] * ty) / speed**2
    aside, ahead = beside(strips.corner[part], strips.step[part], position, tangent, count)
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
    # Slower stretches are brighter; inside a bend light is denser.
    light *= np.float32(1.0) + squeeze * (np.float32(0.5) + np.float32(0.375) * squeeze)
    light *= np.float32(1.0) - s * (gained / speed**2).astype(np.float32)
    scale = _BELL / (width * speed)
    # The fourth powers of the tangent's components, whose squares add up to one.
    square = scale * (_KURTOSIS / (24.0 * width**4)) * (1.0 - 2.0 * np.square(tx * ty))
    u = (u - np.float32(6.0)) * u
    u *= square.astype(np.float32)
    u += (scale + 3.0 * square).astype(np.float32)
    light *= u
    return light, aside, s


def _ends(
    out: Float32Array,
    along: Float32Array,
    lines: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    shutter: Shutter,
    strips: Strips,
    part: slice,
    width: float,
) -> None:
    """Cut the light in `out[:, 0]` at both ends of the exposure, and fill in what changes with them.

    `along` (b, LINES, k) px from where the path is at the blocks' middle; `lines`: when it crosses each line
    (b, LINES), when at the middle (b, 1), its speed on each, and by how much that grows.
    """
    out[:, 3:6] = 0.0
    crossing, centre, speed, gained = lines
    rolling = shutter.delay_per_row != 0.0
    delay = shutter.delay(strips.rows(part)[..., [0, -1]]) if rolling else np.zeros(2)
    for end, image in ((-0.5, 3), (0.5, 4)):
        sign = -1.0 if end > 0.0 else 1.0
        closest = sign * (crossing - end) - np.max(sign * delay, axis=-1)
        near = np.flatnonzero((closest * speed < (_ENDS + _OBLIQUE) * width).any(axis=1))
        if not near.size:
            continue
        u = along[near]
        before_end = crossing[near] - end
        u += _wide((centre[near] - end) * speed[near] - 0.5 * gained[near] * before_end**2)
        if rolling:
            # A row-dependent end is a slanted cut of the path: the pixel's window is exact, row by row.
            u -= shutter.delay(strips.rows(near + part.start)) * _wide(speed[near])
        u *= np.float32(sign / width)
        bell = u * u
        bell *= np.float32(-0.5)
        np.exp(bell, out=bell)
        bell *= np.float32(_BELL / width)
        before = out[near, 0]
        bell *= before
        out[near, image] = bell
        out[near, 0] = before * ndtr(u)
        # Light is denser where the star is slower: the end cuts off more of it, or less.
        thinning = gained[near] / speed[near] ** 2
        out[near, 0] -= _wide(sign * width**2 * thinning) * bell
        bell *= u
        out[near, 5] -= bell


def _wide(line: FloatArray) -> Float32Array:
    """Return a number of each line (b, l) for all its pixels."""
    return line[..., None].astype(np.float32)


def coefficients(
    pinhole: Pinhole,
    motion: Motion,
    shutter: Shutter,
    stars: FloatArray,
    strips: Strips,
    growing: bool = True,
) -> FloatArray:
    """Return (b, IMAGES, 8) which makes the images d(light)/d(turn, growth, x, y) of a star of light 1.

    The columns of the growth are zero unless `growing`.
    """
    centre = strips.time[:, LINES // 2 - 1 : LINES // 2 + 1].mean(axis=1)
    of_block = stars[strips.star]
    # Each star has its two ends, or each block, where the shutter's delay differs from row to row.
    delay = np.zeros(len(stars))
    ending, spread = stars, strips.star
    if shutter.delay_per_row != 0.0:
        rows = strips.rows(slice(None))[:, LINES // 2].mean(axis=1).astype(np.float64)
        delay, ending, spread = np.asarray(shutter.delay(rows)), of_block, np.arange(len(centre))
    times = (centre - _STEP, centre + _STEP, delay - 0.5, delay + 0.5)
    shift, side, speed = _moved(
        pinhole,
        motion,
        np.concatenate([of_block, of_block, ending, ending]),
        np.concatenate(times),
        growing,
    )
    cuts = np.cumsum([len(part) for part in times])[:-1]
    shift_a, shift_b, shift_first, shift_last = np.split(shift, cuts)
    side_a, side_b, _, _ = np.split(side, cuts)
    _, fast, fast_first, fast_last = np.split(speed, cuts)
    out = np.zeros((len(centre), IMAGES, 8))
    out[:, 0] = (shift_a - shift_b) / (2.0 * _STEP)
    out[:, 1] = 0.5 * (side_a + side_b)
    out[:, 2] = (side_b - side_a) / (2.0 * _STEP * fast[:, None])
    out[:, 3] = -(shift_first * fast_first[:, None])[spread]
    out[:, 4] = (shift_last * fast_last[:, None])[spread]
    return out


def _moved(
    pinhole: Pinhole, motion: Motion, stars: FloatArray, time: FloatArray, growing: bool
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return how each parameter moves points along the path, in exposures, and across, px; and the speed."""
    change, velocity = moving(pinhole, motion, stars, time, growing)
    speed = np.maximum(np.hypot(velocity[:, 0], velocity[:, 1]), _SLOWEST)
    tx, ty = (velocity / speed[:, None]).T[:, :, None]
    along = change[:, 0] * tx + change[:, 1] * ty
    return along / speed[:, None], change[:, 1] * tx - change[:, 0] * ty, speed
