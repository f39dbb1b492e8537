"""Attitudes relative to the local vertical, and visibility of limb and Sun to cameras in orbit.

The Earth is a sphere with the equatorial radius. The orbit of the paper is that of a Shuttle deployment at
380 km (Meller et al., sections 1 and 4.1). The inclination of the orbit is assumed to be 51.6 deg, as of
Shuttle flights to the Station.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray
from knightcube.astro.earth.figure import EARTH_RADIUS
from sim_hal.worlds.orbit import KeplerianElements, propagate
from tests.support import sensor_suite
from tests.support.sensor_suite import SensorSuite, WideCamera

ALTITUDE = 380e3
INCLINATION = np.radians(51.6)
LIMB_POINTS = 720
SUITES = ("vt", "uw", "usu")


@cache
def suite(name: str) -> SensorSuite:
    """Return one of the three sensor suites of the paper."""
    return sensor_suite.load(Path(__file__).parents[2] / "config" / "sensors" / f"{name}.yaml")


@dataclass(frozen=True, slots=True, eq=False)
class Pass:
    """One revolution: times (n,), s, positions and velocities (n, 3), and Julian date UTC at time zero."""

    julian_date: float
    times: FloatArray
    positions: FloatArray
    velocities: FloatArray


def revolution(
    julian_date: float, node: float, step: float, begin: float = 0.0, latitude: float = 0.0
) -> Pass:
    """Return one revolution from `begin` (s) in steps of `step` s.

    `latitude` (rad) is the argument of latitude at time 0.
    """
    elements = KeplerianElements(
        semi_major_axis=EARTH_RADIUS + ALTITUDE,
        inclination=float(INCLINATION),
        ascending_node=node,
        true_anomaly=latitude,
    )
    times = begin + np.arange(0.0, elements.period, step)
    states = propagate(elements, float(times[-1]) + 1.0).states_at(times)
    return Pass(julian_date, times, states[:, :3], states[:, 3:])


def local_frame(positions: FloatArray, velocities: FloatArray) -> FloatArray:
    """Return the matrices (n, 3, 3) from ICRS axes to forward, right and down axes."""
    down = -positions / np.linalg.norm(positions, axis=-1, keepdims=True)
    right = np.cross(velocities, positions)
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    return np.stack([np.cross(right, down), right, down], axis=-2)


def limb(positions: FloatArray) -> FloatArray:
    """Return directions (n, LIMB_POINTS, 3) of the Earth's limb in forward, right and down axes."""
    edge = np.arcsin(EARTH_RADIUS / np.linalg.norm(positions, axis=-1))[:, None]
    around = np.linspace(0.0, 2.0 * np.pi, LIMB_POINTS, endpoint=False)
    across = np.sin(edge)
    return np.stack(
        [
            across * np.cos(around),
            across * np.sin(around),
            np.broadcast_to(np.cos(edge), (len(edge), LIMB_POINTS)),
        ],
        axis=-1,
    )


def limb_in_daylight(positions: FloatArray, directions: FloatArray, sun: FloatArray) -> BoolArray:
    """Return which limb points (n, points) are sunlit; all vectors are in forward, right and down axes."""
    radius = np.linalg.norm(positions, axis=-1)
    reach = np.sqrt(radius**2 - EARTH_RADIUS**2)
    ground = reach[:, None, None] * directions
    ground = ground - np.array([0.0, 0.0, 1.0]) * radius[:, None, None]
    return np.asarray(np.einsum("npi,ni->np", ground, sun) > 0.0)


def in_field(camera: WideCamera, directions: FloatArray) -> BoolArray:
    """Return which body directions (..., 3) are on the detector of the camera."""
    x, y, z = np.moveaxis(directions @ camera.to_camera.T, -1, 0)
    half = np.tan(np.radians(0.5 * camera.field_of_view_deg))
    return np.asarray(
        (z > 0.0) & (np.abs(x) < half * z) & (np.abs(y) < half * z * camera.rows / camera.columns)
    )


def in_cone(camera: WideCamera, directions: FloatArray) -> BoolArray:
    """Return which body directions (..., 3) are within half the field of view of the boresight (paper)."""
    cosine = directions @ camera.to_camera[2]
    return np.asarray(cosine > np.cos(np.radians(0.5 * camera.field_of_view_deg)))
