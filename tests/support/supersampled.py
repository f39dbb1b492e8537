"""Independent renderer of frames of streaks, for any point spread, lens and motion.

The estimator's model and `sim_hal.star_camera` use one Gaussian point spread and analytic streaks. This
renderer uses neither a Gaussian point spread nor analytic streaks. The renderer adds points along each star's
path to a grid of three by three cells per pixel, convolves the grid with a sampled point spread, and sums the
cells of each pixel.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import fft

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import attitude_matrix
from knightcube.vision.camera.lens import Pinhole

Cells = npt.NDArray[np.floating[Any]]
"""Signal (rows, columns) on a grid of cells that are finer than pixels."""

CELLS = 3
"""Number of cells along a pixel's side."""

Spread = Callable[[FloatArray, FloatArray], FloatArray]
"""Density of the signal at (dx, dy) px from its point; it need not be normalised."""

_FINER = 5
_APART = 0.15
"""Largest distance (px) between points on a path."""
_STARS_AT_ONCE = 64


def gaussian(sigma: float, ratio: float = 1.0, angle: float = 0.0) -> Spread:
    """Return an elliptical Gaussian.

    The semi-axes are sigma sqrt(ratio), at the angle `angle` (rad), and sigma / sqrt(ratio), px.
    """
    cosine, sine = np.cos(angle), np.sin(angle)

    def density(dx: FloatArray, dy: FloatArray) -> FloatArray:
        a, b = cosine * dx + sine * dy, cosine * dy - sine * dx
        return np.asarray(np.exp(-0.5 * (a * a / ratio + b * b * ratio) / sigma**2))

    return density


def moffat(sigma: float, beta: float) -> Spread:
    """Return a Moffat profile with the half-width of a Gaussian of `sigma` px."""
    alpha = np.sqrt(2.0 * np.log(2.0)) * sigma / np.sqrt(2.0 ** (1.0 / beta) - 1.0)
    return lambda dx, dy: np.asarray((1.0 + (dx * dx + dy * dy) / alpha**2) ** -beta)


def disc(diameter: float) -> Spread:
    """Return a defocused point: a uniform disc of `diameter` px with a blur of 0.4 px."""

    def density(dx: FloatArray, dy: FloatArray) -> FloatArray:
        return np.asarray(1.0 / (1.0 + np.exp((np.hypot(dx, dy) - 0.5 * diameter) / 0.15)))

    return density


def ring(diameter: float, hole: float) -> Spread:
    """Return the defocused point of a telescope with central obstruction: a disc with a hole (px)."""
    whole, dark = disc(diameter), disc(hole)

    def density(dx: FloatArray, dy: FloatArray) -> FloatArray:
        return np.asarray(whole(dx, dy) - dark(dx, dy))

    return density


def halo(sigma: float, share: float, width: float) -> Spread:
    """Return a Gaussian core, plus a Gaussian of `width` px with the fraction `share` of the signal."""

    def density(dx: FloatArray, dy: FloatArray) -> FloatArray:
        square = dx * dx + dy * dy
        core = (1.0 - share) / sigma**2 * np.exp(-0.5 * square / sigma**2)
        return np.asarray(core + share / width**2 * np.exp(-0.5 * square / width**2))

    return density


def coma(sigma: float, length: float, angle: float) -> Spread:
    """Return a point with a tail of fainter and wider Gaussians, at `angle` (rad), up to `length` px long."""

    def density(dx: FloatArray, dy: FloatArray) -> FloatArray:
        total = np.zeros(np.broadcast_shapes(dx.shape, dy.shape))
        for step in np.linspace(0.0, 1.0, 7):
            x, y = dx - length * step * np.cos(angle), dy - length * step * np.sin(angle)
            width = sigma * (1.0 + 0.6 * step)
            total += (1.0 - 0.8 * step) / width**2 * np.exp(-0.5 * (x * x + y * y) / width**2)
        return total

    return density


@dataclass(frozen=True, slots=True, eq=False)
class Optics:
    """Optics of a camera.

    Attributes:
        spreads: point spreads from the field's centre to its corner; between them the signal is interpolated.
        radius: distance (px) beyond which a point has no signal.
        distortion: relative outward displacement of the corner; it increases with the cube of the radius.
        offset: distance (px) of the optical axis from the centre of the detector.
        scintillation: relative rms variation of each star's brightness between segments of its path.
    """

    spreads: tuple[Spread, ...] = (gaussian(1.0),)
    radius: float = 7.0
    distortion: float = 0.0
    offset: tuple[float, float] = (0.0, 0.0)
    scintillation: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Sky:
    """Stars with directions (n, 3), and the electrons (n,) of each star over the exposure."""

    directions: FloatArray
    electrons: FloatArray


Attitudes = Callable[[FloatArray], FloatArray]
"""Function from times (m,), in exposures since mid-exposure, to attitudes (m, 4), sky to camera."""


def light(
    pinhole: Pinhole,
    optics: Optics,
    sky: Sky,
    attitudes: Attitudes,
    length: float,
    delay: float,
    rng: np.random.Generator,
) -> FloatArray:
    """Return the expected electrons (rows, columns) of a sky.

    Paths may be at most `length` px long. `delay` is the time between rows of a rolling shutter, in units of
    the exposure.
    """
    layers, edge = len(optics.spreads), _reach(optics.radius)
    size = CELLS * pinhole.rows + 2 * edge, CELLS * pinhole.columns + 2 * edge
    grid: Cells = np.zeros((layers, *size), dtype=np.float32)
    room = 0.5 + 0.5 * abs(delay) * pinhole.rows
    count = int(np.ceil(2.0 * room * length / _APART)) + 16
    times = (np.arange(count) + 0.5) / count * 2.0 * room - room
    matrices = attitude_matrix(attitudes(times))
    laid: list[tuple[FloatArray, FloatArray]] = []
    for first in range(0, len(sky.electrons), _STARS_AT_ONCE):
        some = slice(first, first + _STARS_AT_ONCE)
        camera = np.einsum("tij,nj->nti", matrices, sky.directions[some])
        place = through_lens(pinhole, optics, camera)
        weight = np.full(place.shape[:2], 1.0) * sky.electrons[some, None] * (2.0 * room / count)
        if delay:
            late = times - delay * (place[..., 1] - 0.5 * (pinhole.rows - 1))
            # The first and the last point of a path are weighted by the fraction of their interval within the
            # exposure. Without these weights, all stars of some rows would be displaced by part of the
            # distance between points.
            weight *= np.clip((0.5 - np.abs(late)) * count / (2.0 * room) + 0.5, 0.0, 1.0)
        if optics.scintillation:
            knots = rng.normal(1.0, optics.scintillation, (len(place), 24)).clip(0.0)
            share = np.linspace(0.0, 23.0, count)
            weight *= np.array([np.interp(share, np.arange(24.0), knot) for knot in knots])
        seen = (weight > 0.0) & pinhole.contains(place, optics.radius)
        laid.append((place[seen], weight[seen]))
    _lay(grid, pinhole, edge, np.concatenate([p for p, _ in laid]), np.concatenate([w for _, w in laid]))
    cells = np.zeros((CELLS * pinhole.rows, CELLS * pinhole.columns))
    for layer, spread in zip(grid, optics.spreads, strict=True):
        cells += _spread(layer, spread, optics.radius)
    shape = pinhole.rows, CELLS, pinhole.columns, CELLS
    return np.asarray(cells.reshape(shape).sum(axis=(1, 3)).clip(0.0))


def through_lens(pinhole: Pinhole, optics: Optics, vectors: FloatArray) -> FloatArray:
    """Return the pixels (..., 2) of `vectors` (..., 3), or NaN for vectors behind the camera."""
    z = np.where(vectors[..., 2] > 0.2, vectors[..., 2], np.nan)
    tangent = vectors[..., :2] / z[..., None]
    corner = np.tan(pinhole.half_diagonal)
    square = np.sum(tangent**2, axis=-1, keepdims=True) / corner**2
    place = pinhole.focal_length * tangent * (1.0 + optics.distortion * square)
    return np.asarray(place + np.array(pinhole.centre) + np.array(optics.offset))


def _reach(radius: float) -> int:
    """Return the number of cells that a point spread of `radius` px extends from its centre."""
    return int(np.ceil(radius * CELLS))


def _lay(grid: Cells, pinhole: Pinhole, edge: int, place: FloatArray, weight: FloatArray) -> None:
    """Add points of light to a grid that extends `edge` cells beyond the detector.

    Each point is distributed over the four nearest cells, and over the two layers nearest in radius.
    """
    cell = CELLS * (place + 0.5) - 0.5 + edge
    corner = np.floor(cell).astype(np.int64)
    inside = ((corner >= 0) & (corner < np.array(grid.shape[:0:-1]) - 1)).all(axis=1)
    place, weight, cell, corner = place[inside], weight[inside], cell[inside], corner[inside]
    part = cell - corner
    layers, rows, columns = grid.shape
    radius = np.hypot(*(place - np.array(pinhole.centre)).T) / np.hypot(*pinhole.centre)
    at = np.clip(radius * (layers - 1), 0.0, max(layers - 1 - 1e-9, 0.0))
    for layer in range(layers):
        share = weight * np.clip(1.0 - np.abs(at - layer), 0.0, 1.0)
        for right, down in ((0, 0), (1, 0), (0, 1), (1, 1)):
            x, y = (part[:, 0] if right else 1.0 - part[:, 0]), (part[:, 1] if down else 1.0 - part[:, 1])
            index = (corner[:, 1] + down) * columns + corner[:, 0] + right
            grid[layer] += np.bincount(index, share * x * y, rows * columns).reshape(rows, columns)


def _spread(layer: Cells, spread: Spread, radius: float) -> Cells:
    """Convolve a layer with a point spread, and return the detector's cells (rows, columns).

    The layer extends beyond the detector by the `radius` (px) of the point spread, so that the periodic
    convolution reaches no cell of the detector from the opposite side. Neighbouring cells share the light of
    a point, which convolves the layer with a triangle along each axis; the function removes this blur.
    """
    half = _reach(radius)
    fine = (np.arange((2 * half + 1) * _FINER) + 0.5) / (_FINER * CELLS) - (half + 0.5) / CELLS
    density = spread(fine[None, :], fine[:, None])
    kernel = density.reshape(2 * half + 1, _FINER, 2 * half + 1, _FINER).sum(axis=(1, 3))
    shape = [fft.next_fast_len(size, real=True) for size in layer.shape]
    product = fft.rfft2(layer, shape) * fft.rfft2((kernel / kernel.sum()).astype(np.float32), shape)
    down, across = np.sinc(fft.fftfreq(shape[0])) ** 2, np.sinc(fft.rfftfreq(shape[1])) ** 2
    product /= np.outer(down, across).astype(np.float32)
    whole = fft.irfft2(product, shape)
    return np.asarray(whole[2 * half : layer.shape[0], 2 * half : layer.shape[1]])
