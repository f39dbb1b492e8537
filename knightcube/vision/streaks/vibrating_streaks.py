"""Model of the counts of the streaks of a vibrating camera, with derivatives.

If the camera vibrates, the path of a star bends and its speed changes within a few px, which the arcs of
`streak_model` do not describe. In this module, a streak is modelled like a spot in `streak_model`: as a sum
of Gaussians at instants of the exposure, each integrated over every pixel. The instants for a block of pixels
are the nodes of a Gauss-Legendre quadrature over the time during which the star is near the block.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from knightcube.astro.arrays import Float32Array, FloatArray, IntArray
from knightcube.compiled import compiled_form_of, loop_helper
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks.camera_motion import CameraMotion
from knightcube.vision.streaks.fit_windows import LINES, SLOWEST, Strips
from knightcube.vision.streaks.geometry import (
    Shutter,
    image_flow,
    paths,
    positions,
    sensitivities_and_velocity,
    without_pixel,
)
from knightcube.vision.streaks.streak_model import IMAGES, profile

# Number of images for displacements along the path, stored after the images of `streak_model`.
_ALONG_IMAGES = 2
# Distance (point-spread widths) beyond which the light of a Gaussian is neglected.
_BEYOND = 5.0
# Number of quadrature nodes per point-spread width of the path, for an error of about 1e-4 of the counts.
_DENSITY = 1.2
# Time step of numerical derivatives, in units of the exposure time.
_STEP = 1e-4
# Distance (standard deviations) from a line of pixels beyond which a Gaussian is neglected.
_FARTHEST = 6.0
_BELL = 1.0 / math.sqrt(2.0 * math.pi)
_ROOT_HALF = math.sqrt(0.5)
# Number of blocks computed in one step, small enough for their arrays to fit into the processor's cache.
_AT_ONCE = 32


Rotations = Callable[[FloatArray], FloatArray]
"""Function of m times since mid-exposure, in exposure times. It returns p rotation vectors (p, 3, m), rad."""


class _Instants(NamedTuple):
    """Instants at which the star of each of b blocks of pixels is near its block: i nodes of a quadrature.

    The instants have the `time` (b, i), in exposure times since mid-exposure, and the `weight` (b, i) in the
    integral over the exposure. The positions `place` of the stars include the vibration, the unit tangents
    `tangent` do not; both have the shape (b, i, 2). The array `flow` (b, i, 2, 3), px/rad, is the result of
    `image_flow`. The distances `along` (b, i), px, are along the path from the centre of the block.
    """

    time: FloatArray
    weight: FloatArray
    place: FloatArray
    tangent: FloatArray
    flow: FloatArray
    along: FloatArray


def images(
    pinhole: Pinhole, motion: CameraMotion, shutter: Shutter, stars: FloatArray, width: float, strips: Strips
) -> Float32Array:
    """Return images (b, IMAGES + 3, LINES, k) whose combinations model `stars` (n, 2), px, of unit flux.

    The first IMAGES images have the same meaning as in `streak_model`. The next two are the derivatives of
    the counts with respect to a constant displacement along the path, and to a displacement proportional to
    the distance along the path from the centre of the block. The last image of each block is not initialised.
    """
    shape = strips.index.shape
    out = np.empty((shape[0], IMAGES + _ALONG_IMAGES + 1, *shape[1:]), dtype=np.float32)
    sigma = without_pixel(width)
    seen, ends, speed = _instants(pinhole, motion, shutter, stars, width, strips)
    normal = np.stack([-seen.tangent[..., 1], seen.tangent[..., 0]], axis=-1)
    along = seen.along[..., None]
    moved = np.stack([normal, along * normal, seen.tangent, along * seen.tangent], axis=1)
    sums = _sums(strips.corner, strips.step, shape[2], seen.place, seen.weight, moved, sigma)
    out[:, 0], out[:, 5], out[:, 6] = sums[:, 0], sums[:, 1] * (width / sigma), 1.0
    out[:, 1:3], out[:, IMAGES : IMAGES + _ALONG_IMAGES] = sums[:, 2:4], sums[:, 4:]
    nothing = np.empty((shape[0], 0, 1, 2))
    for end in range(2):
        at_end = ends[:, end, None], 1.0 / speed[:, end, None]
        out[:, 3 + end] = _sums(strips.corner, strips.step, shape[2], *at_end, nothing, sigma)[:, 0]
    return out


def coefficients(
    pinhole: Pinhole,
    motion: CameraMotion,
    shutter: Shutter,
    stars: FloatArray,
    strips: Strips,
    growing: bool = True,
) -> FloatArray:
    """Return coefficients (b, IMAGES + 2, 8) that combine images into a star's derivatives on b blocks.

    The derivatives are those of `streak_model.coefficients`. The `shutter` has no effect, because the images
    of displacements along the path include the ends of the streaks.
    """
    centre, of_block = _centres(strips), stars[strips.star]
    out = np.zeros((len(centre), IMAGES + _ALONG_IMAGES, 8))
    sides, aheads, speed = [], [], np.ones(len(centre))
    for time in (centre - _STEP, centre + _STEP):
        change, velocity = sensitivities_and_velocity(pinhole, motion.smooth, of_block, time, growing)
        speed = np.maximum(np.hypot(velocity[:, 0], velocity[:, 1]), SLOWEST)
        tx, ty = (velocity / speed[:, None]).T[:, :, None]
        sides.append(change[:, 1] * tx - change[:, 0] * ty)
        aheads.append(change[:, 0] * tx + change[:, 1] * ty)
    distance = 2.0 * _STEP * speed[:, None]
    for first, (before, after) in ((1, sides), (IMAGES, aheads)):
        out[:, first], out[:, first + 1] = 0.5 * (before + after), (after - before) / distance
    return out


def derivatives(
    pinhole: Pinhole,
    motion: CameraMotion,
    shutter: Shutter,
    stars: FloatArray,
    width: float,
    strips: Strips,
    rotations: Rotations,
) -> FloatArray:
    """Return derivatives (b, p + 2, LINES, k) of the counts of stars of unit flux.

    The derivatives are with respect to the coefficients of p `rotations` that are added to the motion, and
    with respect to the position x, y (px) of the star.
    """
    seen, _, _ = _instants(pinhole, motion, shutter, stars, width, strips)
    blocks, instants = seen.time.shape
    turned = rotations(seen.time.reshape(-1)).reshape(-1, 3, blocks, instants)
    moved = np.einsum("pcbi,biuc->bpiu", turned, seen.flow)
    shifted = np.broadcast_to(np.eye(2)[:, None], (blocks, 2, instants, 2))
    moved = np.concatenate([moved, shifted], axis=1)
    count, sigma = strips.index.shape[2], without_pixel(width)
    return _sums(strips.corner, strips.step, count, seen.place, seen.weight, moved, sigma)[:, 2:]


def _centres(strips: Strips) -> FloatArray:
    """Return the times (b,) at which the stars pass the centres of their blocks."""
    return np.asarray(strips.time[:, LINES // 2 - 1 : LINES // 2 + 1].mean(axis=1))


def _instants(
    pinhole: Pinhole, motion: CameraMotion, shutter: Shutter, stars: FloatArray, width: float, strips: Strips
) -> tuple[_Instants, FloatArray, FloatArray]:
    """Return the instants for b blocks, the streaks' ends (b, 2, 2), and the speeds (b, 2) at the ends.

    The ends, px, are the positions of the star at the start and the stop of the exposure. The speeds, px per
    exposure, do not include the vibration.
    """
    vibration, smooth = motion.vibration, motion.smooth
    count, middle, of_block = strips.index.shape[2], _centres(strips), stars[strips.star]
    velocity = paths(pinhole, smooth, of_block, middle).velocity
    speed = np.maximum(np.hypot(velocity[:, 0], velocity[:, 1]), SLOWEST)
    oblique = np.abs(np.sum(velocity * strips.step, axis=1)) / speed
    amplitude = pinhole.focal_length * vibration.amplitude
    reach = (_BEYOND * width + amplitude.sum() + 0.5 * count * oblique) / speed
    late = np.asarray(shutter.delay(strips.corner[:, LINES // 2, 1] + 0.5 * count * strips.step[:, 1]))
    bounds = late[:, None] + np.array([-0.5, 0.5])
    first = np.clip(strips.time.min(axis=1) - reach, *bounds.T)
    last = np.clip(strips.time.max(axis=1) + reach, *bounds.T)
    faster = float(amplitude @ (2.0 * np.pi * vibration.frequency))
    length = float(np.max((last - first) * (speed + faster), initial=0.0))
    nodes, weights = _gauss_legendre(2 + math.ceil(_DENSITY * length / width))
    half = 0.5 * (last - first)[:, None]
    time = np.concatenate([0.5 * (first + last)[:, None] + half * nodes, bounds], axis=1)
    shape, instants = time.shape, time.reshape(-1)
    repeated = np.repeat(of_block, shape[1], axis=0)
    path, place = paths(pinhole, smooth, repeated, instants), positions(pinhole, motion, repeated, instants)
    flow = image_flow(pinhole, place)
    pace = np.maximum(np.hypot(path.velocity[:, 0], path.velocity[:, 1]), SLOWEST)
    tangent = (path.velocity / pace[:, None]).reshape(*shape, 2)
    place, flow, pace = place.reshape(*shape, 2), flow.reshape(*shape, 2, 3), pace.reshape(shape)
    along = (time[:, :-2] - middle[:, None]) * speed[:, None]
    seen = _Instants(time[:, :-2], half * weights, place[:, :-2], tangent[:, :-2], flow[:, :-2], along)
    return seen, place[:, -2:], pace[:, -2:]


@functools.lru_cache(maxsize=256)
def _gauss_legendre(count: int) -> tuple[FloatArray, FloatArray]:
    """Return nodes and weights of the Gauss-Legendre quadrature with `count` nodes from -1 to 1."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return nodes, weights


def _sums_numpy(
    corner: IntArray,
    step: IntArray,
    count: int,
    place: FloatArray,
    weight: FloatArray,
    moved: FloatArray,
    sigma: float,
) -> FloatArray:
    """Return weighted sums (b, d + 2, LINES, k) of Gaussians of unit flux, integrated over every pixel.

    The Gaussians with the standard deviation `sigma` (px) are at i positions `place` (b, i, 2), with a
    `weight` (b, i). The d + 2 sums are the counts of the k = `count` pixels of each line, their derivative
    with respect to `sigma`, and their derivatives with respect to d displacements `moved` (b, d, i, 2). The
    attributes `corner` and `step` of the blocks are described in `Strips`. A Gaussian is the product of a
    function of the coordinate along the lines of pixels and a function of the coordinate across the lines.
    """
    out = np.empty((len(corner), moved.shape[1] + 2, LINES, count))
    for first in range(0, len(corner), _AT_ONCE):
        part = slice(first, first + _AT_ONCE)
        swapped = step[part, 0] == 0
        at = np.where(swapped[:, None, None], corner[part, :, ::-1], corner[part])
        x, y = np.moveaxis(np.where(swapped[:, None, None], place[part, :, ::-1], place[part]), 2, 0)
        pixel = at[..., 0] - at[..., 0].min(axis=1, keepdims=True)
        columns = at[..., 0].min(axis=1, keepdims=True) + np.arange(count + pixel.max())
        (gx, dx, sx), (gy, dy, sy) = profile(columns, x, sigma), profile(at[..., 1], y, sigma)
        by = np.where(swapped[:, None, None, None], moved[part, ..., ::-1], moved[part])
        at_once = weight[part, None, :, None]
        of_counts, of_width = at_once * gy[:, None], at_once * sy[:, None]
        across, along = by[..., 1:] * at_once * dy[:, None], by[..., :1] * of_counts
        whole = np.concatenate([of_counts, of_width, across], axis=1).swapaxes(2, 3) @ gx[:, None]
        whole[:, 1] += of_counts[:, 0].swapaxes(1, 2) @ sx
        whole[:, 2:] += along.swapaxes(2, 3) @ dx[:, None]
        out[part] = np.take_along_axis(whole, (pixel[..., None] + np.arange(count))[:, None], axis=3)
    return out


@compiled_form_of(_sums_numpy)
def _sums(
    corner: IntArray,
    step: IntArray,
    count: int,
    place: FloatArray,
    weight: FloatArray,
    moved: FloatArray,
    sigma: float,
) -> FloatArray:
    blocks, displacements, instants, _ = moved.shape
    lines = corner.shape[1]
    out = np.zeros((blocks, displacements + 2, lines, count))
    for b in range(blocks):
        axis = 0 if step[b, 0] > 0 else 1
        begin = corner[b, :, axis].min()
        size = corner[b, :, axis].max() - begin + count
        x = np.empty((3, instants, size))
        for i in range(instants):
            _profile_of(x[:, i], place[b, i, axis] - begin, sigma)
        y, at_line = np.empty((3, 1)), np.empty((3, count))
        for line in range(lines):
            first = corner[b, line, axis] - begin
            for i in range(instants):
                apart = place[b, i, 1 - axis] - corner[b, line, 1 - axis]
                if abs(apart) > _FARTHEST * sigma + 0.5:
                    continue
                _profile_of(y, apart, sigma)
                for row in range(3):
                    for k in range(count):
                        at_line[row, k] = x[row, i, first + k]
                share = weight[b, i] * y[0, 0]
                _add(out[b, 0, line], at_line[0], share)
                _add(out[b, 1, line], at_line[2], share)
                _add(out[b, 1, line], at_line[0], weight[b, i] * y[2, 0])
                for d in range(displacements):
                    _add(out[b, 2 + d, line], at_line[1], moved[b, d, i, axis] * share)
                    across = moved[b, d, i, 1 - axis] * weight[b, i] * y[1, 0]
                    _add(out[b, 2 + d, line], at_line[0], across)
    return out


@loop_helper
def _add(out: FloatArray, values: FloatArray, factor: float) -> None:
    for k in range(len(out)):
        out[k] += factor * values[k]


@loop_helper
def _profile_of(out: FloatArray, place: float, sigma: float) -> None:
    """Compute the fractions `out[0]` (p,) of the flux on p pixels, and their derivatives `out[1:]` (2, p).

    The derivatives are with respect to the `place` of the Gaussian, px from the first pixel, and its width
    `sigma`, px.
    """
    scale = 1.0 / sigma
    left = (-0.5 - place) * scale
    bell_left, below = _BELL * math.exp(-0.5 * left * left), math.erf(left * _ROOT_HALF)
    for p in range(out.shape[1]):
        right = left + scale
        bell, above = _BELL * math.exp(-0.5 * right * right), math.erf(right * _ROOT_HALF)
        out[0, p] = 0.5 * (above - below)
        out[1, p], out[2, p] = (bell_left - bell) * scale, (left * bell_left - right * bell) * scale
        left, bell_left, below = right, bell, above
