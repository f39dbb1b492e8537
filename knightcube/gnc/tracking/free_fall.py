"""Many orbits at once under a spherical Earth and J2, and the orbit that fits measured states."""

from __future__ import annotations

import itertools
import math

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.figure import EARTH_RADIUS, GRAVITATIONAL_PARAMETER, J2

_LONGEST_STEP = 10.0
_ROUNDS = 3
_STEPS = np.repeat([1.0, 1e-3], 3)
"""Of differences: m, m/s."""


def smoothed(
    times: FloatArray, states: FloatArray, sigma: FloatArray, middle: int
) -> tuple[FloatArray, FloatArray]:
    """Return the orbit nearest to measured places: states (n, 6), and the covariance (6, 6) at one of them.

    `sigma` (n,) m of an axis of each place. The velocities only begin the search.
    """
    state = states[middle]
    covariance = np.eye(6)
    weights = np.repeat(1.0 / sigma, 3)
    for _ in range(_ROUNDS):
        shifts = np.concatenate([np.zeros((1, 6)), np.diag(_STEPS), -np.diag(_STEPS)])
        flown = around(state + shifts, times, middle)[..., :3]
        off = (flown[:, 0] - states[:, :3]).ravel() * weights
        slope = (flown[:, 1:7] - flown[:, 7:]) / (2.0 * _STEPS[:, None])
        jacobian = np.swapaxes(slope, 1, 2).reshape(-1, 6) * weights[:, None]
        scaled = jacobian / np.linalg.norm(jacobian, axis=0)
        size = np.linalg.norm(jacobian, axis=0)
        covariance = np.linalg.inv(scaled.T @ scaled) / np.outer(size, size)
        state = state - covariance @ (jacobian.T @ off)
    return around(state[None], times, middle)[:, 0], covariance


def around(start: FloatArray, times: FloatArray, middle: int) -> FloatArray:
    """Return states (n, k, 6) at rising times (n,) s of those (k, 6) at `times[middle]`."""
    ahead, behind = trajectories(start, times[middle:]), trajectories(start, times[middle::-1])
    return np.concatenate([behind[:0:-1], ahead])


def trajectories(start: FloatArray, times: FloatArray) -> FloatArray:
    """Return states (n, k, 6) at times (n,) s, rising or falling, of those (k, 6) at the first."""
    found = [start]
    for before, after in itertools.pairwise(times):
        steps = max(1, math.ceil(abs(after - before) / _LONGEST_STEP))
        state, step = found[-1], (after - before) / steps
        for _ in range(steps):
            a = _flow(state)
            b = _flow(state + 0.5 * step * a)
            c = _flow(state + 0.5 * step * b)
            d = _flow(state + step * c)
            state = state + step / 6.0 * (a + 2.0 * (b + c) + d)
        found.append(state)
    return np.array(found)


def _flow(state: FloatArray) -> FloatArray:
    """Return velocity and acceleration (k, 6)."""
    place = state[:, :3]
    # No orbit is deep in the Earth: a hypothesis that is must not be flung out.
    square = np.maximum(np.sum(place**2, axis=1, keepdims=True), (0.5 * EARTH_RADIUS) ** 2)
    flat = 1.5 * J2 * EARTH_RADIUS**2 / square
    tilt = 5.0 * place[:, 2:] ** 2 / square
    scale = 1.0 + flat * (np.array([1.0, 1.0, 3.0]) - tilt)
    return np.hstack([state[:, 3:], -GRAVITATIONAL_PARAMETER / square**1.5 * scale * place])
