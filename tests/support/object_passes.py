"""Passes of an object near a satellite on integrated orbits, and the sightings by a camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray, tangent_basis
from knightcube.gnc.tracker import FrameSightings

EARTH = 3.986004418e14
PIXEL = np.radians(20.0) / 1024


@dataclass(frozen=True)
class Pass:
    """Positions (n, 3), m, of observer and object at times (n,), s, and their relative velocities."""

    times: FloatArray
    observer: FloatArray
    relative: FloatArray
    relative_velocity: FloatArray

    @property
    def directions(self) -> FloatArray:
        """True lines of sight (n, 3) from the observer to the object."""
        return np.asarray(self.relative / np.linalg.norm(self.relative, axis=1, keepdims=True))

    @property
    def rates(self) -> FloatArray:
        """Rates of change (n, 3), rad/s, of the true lines of sight."""
        u = self.directions
        v = self.relative_velocity
        across = v - np.sum(v * u, axis=1, keepdims=True) * u
        return np.asarray(across / np.linalg.norm(self.relative, axis=1, keepdims=True))


def a_pass(rng: np.random.Generator, rate: float, times: FloatArray, before: float) -> Pass:
    """Return a pass; its closest approach, at `rate` (rad/s), is `before` s after its start."""
    radius = 6.878e6
    place = np.array([radius, 0.0, 0.0])
    velocity = np.array([0.0, np.sqrt(EARTH / radius), 0.0])
    speed = rng.uniform(500.0, 4000.0)
    towards = rng.normal(size=3)
    towards /= np.linalg.norm(towards)
    across = tangent_basis(towards)[0] * speed / rate
    near = np.hstack([place, velocity])
    other = near + np.hstack([across, speed * towards])
    states = np.array([[_at(state, t - before) for t in times] for state in (near, other)])
    difference = states[1] - states[0]
    return Pass(times, states[0, :, :3], difference[:, :3], difference[:, 3:])


def _at(state: FloatArray, time: float) -> FloatArray:
    """Return the state (6,) after `time` s, by a Runge-Kutta integration with steps of at most 10 s."""
    steps = max(int(np.ceil(abs(time) / 10.0)), 1)
    h = time / steps

    def slope(s: FloatArray) -> FloatArray:
        return np.hstack([s[3:], -EARTH * s[:3] / np.linalg.norm(s[:3]) ** 3])

    for _ in range(steps):
        a = slope(state)
        b = slope(state + 0.5 * h * a)
        c = slope(state + 0.5 * h * b)
        d = slope(state + h * c)
        state = state + h / 6.0 * (a + 2.0 * b + 2.0 * c + d)
    return state


def sightings(
    rng: np.random.Generator,
    time: float,
    directions: FloatArray,
    sigma: float,
    attitude_sigma: float,
    magnitudes: FloatArray | None = None,
) -> FrameSightings:
    """Return the sightings of objects in a frame, with independent errors and a common rotation error."""
    turn = rng.normal(scale=attitude_sigma, size=3)
    seen = directions + np.cross(turn, directions) + rng.normal(scale=sigma, size=directions.shape)
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    count = len(directions)
    known = np.full(count, 4.0) if magnitudes is None else magnitudes
    spread = np.tile(sigma**2 * np.eye(3), (count, 1, 1))
    return FrameSightings(round(time * 1e9), seen, spread, known, attitude_sigma**2 * np.eye(3))
