"""Passes of objects near a satellite, integrated with J2, for tests of orbit determination."""

from __future__ import annotations

import numpy as np
from scipy.integrate import solve_ivp

from knightcube.astro.arrays import FloatArray

EARTH, FLATTENING, EQUATOR, LIGHT = 3.986004418e14, 1.0826359e-3, 6_378_136.6, 299_792_458.0
"""SI values: gravitational parameter of the Earth, J2 and its radius, speed of light."""


def circular(rng: np.random.Generator, place: FloatArray, radius: float, speed: float) -> FloatArray:
    """Return a state at `radius` over `place` that moves horizontally at `speed` times the circular speed."""
    up = place / np.linalg.norm(place)
    ahead = np.cross(up, rng.normal(size=3))
    ahead /= np.linalg.norm(ahead)
    return np.concatenate([radius * up, np.sqrt(EARTH / radius) * speed * ahead])


def passing_object(rng: np.random.Generator, own: FloatArray) -> tuple[FloatArray, float, FloatArray]:
    """Return a random object 100 to 3,020 km away from an observer with state `own` (6,), m and m/s.

    Returns the unit vector (3,) to the object, its distance (m) and its state (6,). The orbit of the object
    is nearly circular, and its altitude is not limited.
    """
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    away = 10.0 ** rng.uniform(5.0, 6.48)
    place = own[:3] + away * direction
    radius = float(np.linalg.norm(place))
    return direction, away, circular(rng, place, radius, float(rng.uniform(0.985, 1.02)))


def flown_states(state: FloatArray, times: FloatArray, middle: int) -> FloatArray:
    """Return the states (n, 6) of a free fall at `times`; `state` is the state at `times[middle]`."""
    parts = []
    for sense in (times[middle::-1], times[middle:]):
        found = solve_ivp(
            flow, (sense[0], sense[-1]), state, t_eval=sense, method="DOP853", rtol=1e-12, atol=1e-6
        )
        parts.append(found.y.T)
    return np.concatenate([parts[0][:0:-1], parts[1]])


def flow(_: float, state: FloatArray) -> FloatArray:
    x, y, z = state[:3]
    square = x * x + y * y + z * z
    flat = 1.5 * FLATTENING * EQUATOR**2 / square
    share = np.array([1.0, 1.0, 3.0]) - 5.0 * z * z / square
    return np.concatenate([state[3:], -EARTH / square**1.5 * state[:3] * (1.0 + flat * share)])
