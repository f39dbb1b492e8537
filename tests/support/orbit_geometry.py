"""Sensor suites of Meller et al., and attitudes relative to the local vertical."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np

from knightcube.astro.arrays import FloatArray
from tests.support import sensor_suite
from tests.support.sensor_suite import SensorSuite

SUITES = ("vt", "uw", "usu")


@cache
def suite(name: str) -> SensorSuite:
    """Return one of the three sensor suites of the paper."""
    return sensor_suite.load(Path(__file__).parents[2] / "config" / "sensors" / f"{name}.yaml")


def local_frame(positions: FloatArray, velocities: FloatArray) -> FloatArray:
    """Return the matrices (n, 3, 3) from ICRS axes to forward, right and down axes."""
    down = -positions / np.linalg.norm(positions, axis=-1, keepdims=True)
    right = np.cross(velocities, positions)
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    return np.stack([np.cross(right, down), right, down], axis=-2)
