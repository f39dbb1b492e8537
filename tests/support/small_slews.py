"""A slew of a small satellite without symmetry, in a magnetic field that rotates during the slew."""

from __future__ import annotations

from typing import Any

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import from_rotation_vector, multiply, normalise
from knightcube.gnc.guidance.slew_model import AttitudeEnd, SlewCraft, SlewEnvironment, SlewTask

_RADIUS, _MOTION = 6.8e6, 1.126e-3
INERTIA: FloatArray = np.array([[1.1e-3, 3e-5, -2e-5], [3e-5, 1.4e-3, 4e-5], [-2e-5, 4e-5, 0.9e-3]])
LIMIT: FloatArray = np.array([0.08, 0.10, 0.12])
HEAT: FloatArray = np.array([50.0, 65.0, 40.0])
START: FloatArray = normalise(np.array([0.3, -0.5, 0.2, 0.7]))
TARGET: FloatArray = multiply(from_rotation_vector(np.array([0.8, -0.5, 0.6])), START)
START_RATE: FloatArray = np.array([1.5e-3, -0.8e-3, 0.6e-3])
END_RATE: FloatArray = np.array([-0.5e-3, 0.9e-3, 1.1e-3])


def environment(times: FloatArray) -> SlewEnvironment:
    """Return the field of a dipole tilted to the orbit, and the position on a circular orbit."""
    angle = _MOTION * np.asarray(times) + 0.4
    position = _RADIUS * np.stack([np.cos(angle), 0.6 * np.sin(angle), 0.8 * np.sin(angle)], axis=1)
    axis, up = normalise(np.array([0.2, -0.3, 0.93])), position / _RADIUS
    return SlewEnvironment(3e-5 * (axis - 3.0 * (up @ axis)[:, None] * up), position)


def small_slew(**changes: Any) -> SlewTask:
    """Return the task of a slew of about 65 deg in 240 s; both ends have body rates."""
    values: dict[str, Any] = {
        "craft": SlewCraft(INERTIA, LIMIT, HEAT),
        "along": environment,
        "quaternion": START,
        "rate": START_RATE,
        "end": lambda _: AttitudeEnd(TARGET, END_RATE),
        "horizon": 240.0,
        "longest": 720.0,
        "nodes": 10,
    }
    return SlewTask(**{**values, **changes})
