"""Other centroids than the plain centre of mass, from the same windows: three ways to weigh the pixels.

`weighted`: each pixel weighs as its light times itself (Michalski's [22] and most CubeSat trackers name it).
`iterative`: under a Gaussian as wide as the point spread that follows its own centre (Stone 1989, Astron. J.
97, 1227; the windowed positions of Bertin's SExtractor). `gaussian`: the logarithm of a Gaussian is a
parabola, fitted by least squares to the pixels that stand out of the noise.

Each is given the light that the border's sky was taken off, and returns how every pixel moves the result: the
variance follows from the pixels' noise.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray

Centroid = tuple[FloatArray, FloatArray]
"""Places (n, 2) px from the middle, and their slopes (n, 2, m, m) px a count of each pixel."""

_ROUNDS = 12
_STANDS_OUT = 3.0
"""Standard deviations; fainter pixels have no logarithm worth fitting."""
_LEAST = 6
"""Pixels for a parabola of four unknowns."""
_INSIDE = 1.5
"""px from the centre of mass: a parabola's top farther away is no star's."""


def weighted(clean: FloatArray, _: FloatArray, start: Centroid, __: float) -> Centroid:
    """Return the centres of the squared light (n, m, m)."""
    light = np.maximum(clean, 0.0)
    total = np.maximum(np.sum(light * light, axis=(1, 2)), 1e-30)
    places, slopes = [], []
    for step in _steps(clean):
        place = np.sum(light * light * step, axis=(1, 2)) / total
        places.append(place)
        slopes.append(2.0 * light * (step - place[:, None, None]) / total[:, None, None])
    return np.stack(places, axis=1), np.stack(slopes, axis=1)


def iterative(clean: FloatArray, _: FloatArray, start: Centroid, psf_sigma: float) -> Centroid:
    """Return the centres under a Gaussian window that follows them, started at the centre of mass."""
    steps = np.stack([np.broadcast_to(step, clean.shape[1:]) for step in _steps(clean)])
    place, reach = start[0].copy(), (clean.shape[1] - 1) / 2.0
    for _round in range(_ROUNDS + 1):
        off = steps - place[:, :, None, None]
        window = np.exp(-0.5 * np.sum(off * off, axis=1) / psf_sigma**2)
        seen = (window * clean)[:, None]
        # How fast the sum of window, light and distance falls as the window moves: by half the light seen.
        gain = np.sum(seen * (1.0 - off * off / psf_sigma**2), axis=(2, 3))
        half = 0.5 * np.sum(seen, axis=(2, 3))
        gain = np.maximum(gain, np.maximum(0.5 * half, 1e-30))
        if _round == _ROUNDS:
            break
        place = np.clip(place + np.sum(seen * off, axis=(2, 3)) / gain, -reach, reach)
    return place, window[:, None] * off / gain[:, :, None, None]


def gaussian(clean: FloatArray, variance: FloatArray, start: Centroid, _: float) -> Centroid:
    """Return the tops of parabolas through the light's logarithm; the start where few pixels stand out."""
    x, y = (np.broadcast_to(step, clean.shape) for step in _steps(clean))
    used: BoolArray = clean > _STANDS_OUT * np.sqrt(variance)
    light = np.where(used, clean, 1.0)
    weight = np.where(used, light * light / variance, 0.0)
    columns = np.stack([np.ones_like(x), x, y, -(x * x + y * y)], axis=1).reshape(len(clean), 4, -1)
    weighed = columns * weight.reshape(len(clean), 1, -1)
    normal = weighed @ columns.transpose(0, 2, 1) + 1e-12 * np.eye(4)
    # Of the four unknowns, how each pixel's logarithm moves them.
    moved = np.linalg.solve(normal, weighed)
    found = np.sum(moved * np.log(light).reshape(len(clean), 1, -1), axis=2)
    bend = np.where(found[:, 3] > 0.0, found[:, 3], np.inf)
    place = found[:, 1:3] / (2.0 * bend[:, None])
    by_log = (moved[:, 1:3] - 2.0 * place[:, :, None] * moved[:, 3:]) / (2.0 * bend[:, None, None])
    slopes = by_log.reshape(len(clean), 2, *clean.shape[1:]) / light[:, None]
    sound = (np.count_nonzero(used, axis=(1, 2)) >= _LEAST) & np.isfinite(bend)
    sound &= np.all(np.abs(place - start[0]) < _INSIDE, axis=1)
    return (
        np.where(sound[:, None], place, start[0]),
        np.where(sound[:, None, None, None], slopes, start[1]),
    )


METHODS: dict[str, Callable[[FloatArray, FloatArray, Centroid, float], Centroid]] = {
    "weighted": weighted,
    "gaussian": gaussian,
    "iterative": iterative,
}


def _steps(clean: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the pixels' places along x (1, m) and y (m, 1), from the middle."""
    half = clean.shape[1] // 2
    step = np.arange(-half, half + 1, dtype=float)
    return step[None, :], step[:, None]
