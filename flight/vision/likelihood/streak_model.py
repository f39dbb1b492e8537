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
import numpy.typing as npt
from scipy.special import ndtr

from flight.arrays import FloatArray
from flight.pinhole import Pinhole
from flight.vision.likelihood.motion import Motion, paths, sensitivities
from flight.vision.likelihood.shutter import Shutter
from flight.vision.likelihood.strips import LINES, Strips

Float32Array = npt.NDArray[np.float32]

IMAGES = 7
"""m, (n/w^2) m, its first moment along the path, e0, e1, dm/dw, 1."""

_ENDS = 5.5
"""Widths from an end beyond which its profile is 0 or 1."""
_OBLIQUE = 7.0
"""Widths by which a pixel may lie ahead of where its line crosses the path."""
_STEP = 1e-4
_SLOWEST = 1e-3
_BELL = 1.0 / math.sqrt(2.0 * math.pi)
_KURTOSIS = -1.0 / 120.0


def images(
    pinhole: Pinhole, motion: Motion, shutter: Shutter, stars: FloatArray, width: float, strips: Strips
) -> Float32Array:
    """Return the images (b, IMAGES, LINES, k) of stars (n, 2), each of light 1, on their strips.

    `width` is w in px.
    """
    shape = strips.time.shape
    path = paths(pinhole, motion, np.repeat(stars[strips.star], LINES, axis=0), strips.time.reshape(-1))
    velocity = path.velocity.reshape(*shape, 2)
    speed = np.maximum(np.hypot(velocity[..., 0], velocity[..., 1]), _SLOWEST)
    tx, ty = velocity[..., 0] / speed, velocity[..., 1] / speed
    acceleration = path.acceleration.reshape(*shape, 2)
    gained = acceleration[..., 0] * tx + acceleration[..., 1] * ty
    bend = (acceleration[..., 1] * tx - acceleration[..., 0] * ty) / speed**2
    place = path.position.reshape(*shape, 2)

    def wide(line: FloatArray) -> Float32Array:
        return line[..., None].astype(np.float32)

    dx = strips.column - wide(place[..., 0])
    dy = strips.row - wide(place[..., 1])
    curvature = wide(bend)
    ahead = dx * wide(tx) + dy * wide(ty)
    aside = dy * wide(tx) - dx * wide(ty)
    squeeze = curvature * aside
    np.clip(squeeze, -0.5, 0.5, out=squeeze)
    s = ahead / (1.0 - squeeze)
    n = aside - 0.5 * curvature * ahead * s
    time = s * wide(1.0 / speed)
    out = np.empty((len(strips.star), IMAGES, *strips.index.shape[1:]), dtype=np.float32)
    light = np.empty(strips.index.shape, dtype=np.float32)
    u = n * n
    u *= np.float32(1.0 / width**2)
    np.exp(np.float32(-0.5) * u, out=light)
    # Slower stretches are brighter; inside a bend light is denser.
    light *= (1.0 + 0.5 * squeeze + 0.375 * squeeze * squeeze) * (1.0 - time * wide(gained / speed))
    light *= wide(_BELL / (width * speed))
    square = _KURTOSIS * (tx**4 + ty**4) / (24.0 * width**4)
    light *= 1.0 + wide(square) * ((u - 6.0) * u + 3.0)
    time += wide(strips.time)
    out[:, 0] = light
    _ends(out, time, speed, shutter, strips, width)
    light = out[:, 0]
    across = n * np.float32(1.0 / width**2)
    np.multiply(across, light, out=out[:, 1])
    centre = strips.time[:, LINES // 2 - 1 : LINES // 2 + 1].mean(axis=1)
    from_centre = (time - centre[:, None, None].astype(np.float32)) * wide(speed)
    from_centre *= light
    from_centre += np.float32(width**2) * (out[:, 3] - out[:, 4])
    np.multiply(from_centre, across, out=out[:, 2])
    out[:, 5] += (u - 1.0) * np.float32(1.0 / width) * light
    out[:, 6] = 1.0
    return out


def _ends(
    out: Float32Array,
    time: Float32Array,
    speed: FloatArray,
    shutter: Shutter,
    strips: Strips,
    width: float,
) -> None:
    """Cut the light in `out[:, 0]` at both ends of the exposure, and fill in what changes with them."""
    out[:, 3:6] = 0.0
    rows = strips.row
    outer = shutter.delay(rows[..., [0, -1]])
    for end, image in ((-0.5, 3), (0.5, 4)):
        sign = -1.0 if end > 0.0 else 1.0
        closest = sign * (strips.time - end) + np.min(-sign * outer, axis=-1)
        near = np.flatnonzero(np.min(closest * speed, axis=1) < (_ENDS + _OBLIQUE) * width)
        if not near.size:
            continue
        # A row-dependent end is a slanted cut of the path: the pixel's window is exact, row by row.
        edge = np.float32(end) + shutter.delay(rows[near])
        u = (time[near] - edge) * (sign * speed[near] / width)[..., None]
        bell = _BELL * np.exp(-0.5 * u * u)
        before = out[near, 0]
        out[near, image] = before * bell / width
        out[near, 0] = before * ndtr(u)
        out[near, 5] -= before * u * bell / width


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
        rows = strips.row[:, LINES // 2].mean(axis=1).astype(np.float64)
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
    change = sensitivities(pinhole, motion, stars, time, growing)
    velocity = paths(pinhole, motion, stars, time).velocity
    speed = np.maximum(np.hypot(velocity[:, 0], velocity[:, 1]), _SLOWEST)
    tx, ty = (velocity / speed[:, None]).T[:, :, None]
    along = change[:, 0] * tx + change[:, 1] * ty
    return along / speed[:, None], change[:, 1] * tx - change[:, 0] * ty, speed
