"""A robust circle through rim points: centre, radius and their covariance.

A start by consensus among triples of points; then geometric least squares by Gauss and Newton, each point
weighted by Tukey's biweight of its distance from the circle (Huber 1981, Robust Statistics, chapter 7), which
excludes a cloud beside the disc or a hot pixel on its rim.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray

LEAST_POINTS = 6

_STEPS = 10
_LAST_STEP = 1e-2
"""Of a point's error: convergence is fast, further steps gain nothing."""
_MOST_ALIKE = 0.9
"""Largest correlation of neighbours' errors that is assumed."""
_TUKEY = 4.685
"""Times the scale: 95 % efficient on Gaussian errors."""
_NEARLY_AS_MANY = 0.75
"""Of the best consensus: a smaller circle with this share is preferred, as stray light enlarges the disc."""


@dataclass(frozen=True, slots=True, eq=False)
class Circle:
    """A circle in a plane; lengths in the unit of the points.

    Attributes:
        centre: (2,).
        radius: greater than 0.
        used: which of the points (n,) it was fitted to.
        residual: rms of their distances from it.
        shape: (2, 2), the centre's covariance for unit variance of each point; with the
            measured correlation of neighbours' errors.
    """

    centre: FloatArray
    radius: float
    used: BoolArray
    residual: float
    shape: FloatArray


def fit_circle(points: FloatArray, scale: float) -> Circle | None:
    """Return the circle of `points` (n, 2), in order round it, or None without one.

    `scale` is the error of a good point.
    """
    start = _consensus(points, 2.5 * scale) if len(points) >= LEAST_POINTS else None
    if start is None:
        return None
    solution = start
    gate = _TUKEY * scale
    for _ in range(_STEPS):
        distance, slopes = _distances(points, solution)
        weight = np.maximum(1.0 - (distance / gate) ** 2, 0.0) ** 2
        used = weight > 0.0
        if np.count_nonzero(used) < LEAST_POINTS:
            return None
        weighted = slopes * weight[:, None]
        try:
            step = np.linalg.solve(weighted.T @ slopes, weighted.T @ distance)
        except np.linalg.LinAlgError:
            return None
        solution = solution - step
        if np.abs(step).max() < _LAST_STEP * scale:
            break
    distance, slopes = _distances(points, solution)
    left, slopes = distance[used], slopes[used]
    square = float(np.mean(left**2))
    if not (solution[2] > 0.0 and 0.0 < square < np.inf):
        return None
    # Correlated errors average out less: by (1 + r)/(1 - r) for a first-order process.
    alike = min(max(float(np.mean(left * np.roll(left, 1))) / square, 0.0), _MOST_ALIKE)
    shape = np.linalg.inv(slopes.T @ slopes)[:2, :2] * ((1.0 + alike) / (1.0 - alike))
    return Circle(solution[:2], float(solution[2]), used, float(np.sqrt(square)), np.asarray(shape))


def _distances(points: FloatArray, solution: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return how far (n,) the points lie outside the circle (x, y, radius), and the slopes (n, 3) of that."""
    offset = points - solution[:2]
    length = np.maximum(np.hypot(offset[:, 0], offset[:, 1]), 1e-12)
    slopes = np.concatenate([-offset / length[:, None], np.full((len(points), 1), -1.0)], axis=1)
    return length - solution[2], slopes


def _consensus(points: FloatArray, gate: float) -> FloatArray | None:
    """Return the circle (x, y, radius) through three of the points that most others lie on, within `gate`.

    Triples are evenly spaced along the rim, as wide as a third of it and as narrow as an eighth.
    """
    count = len(points)
    place = np.arange(0, count, 3)
    triples = [
        np.stack([place, (place + apart) % count, (place + 2 * apart) % count], axis=1)
        for apart in sorted({max(count // part, 1) for part in (3, 4, 6, 8)})
    ]
    first, second, third = np.moveaxis(points[np.concatenate(triples)], 1, 0)
    # Twice the circumcentre from the first point: of the bisectors of two chords.
    b, c = second - first, third - first
    cross = 2.0 * (b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0])
    sound = np.abs(cross) > 1e-9 * np.sum(b * b + c * c, axis=1)
    if not sound.any():
        return None
    first, b, c, cross = first[sound], b[sound], c[sound], cross[sound]
    bb, cc = np.sum(b * b, axis=1), np.sum(c * c, axis=1)
    aside = np.stack([c[:, 1] * bb - b[:, 1] * cc, b[:, 0] * cc - c[:, 0] * bb], axis=1) / cross[:, None]
    centre, radius = first + aside, np.hypot(aside[:, 0], aside[:, 1])
    away = np.hypot(points[:, 0] - centre[:, :1], points[:, 1] - centre[:, 1:])
    agreeing = np.count_nonzero(np.abs(away - radius[:, None]) < gate, axis=1)
    good = np.flatnonzero(agreeing >= _NEARLY_AS_MANY * agreeing.max())
    best = good[np.argmin(radius[good])]
    return np.array([*centre[best], radius[best]])
