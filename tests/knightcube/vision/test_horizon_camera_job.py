"""Tests of the job of the horizon cameras, with the Sun from the solar strings if no camera shows it."""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import from_matrix
from knightcube.vision.camera.lens import MountedCamera, Pinhole
from knightcube.vision.horizon.settings import HorizonKnowledge, RoughAttitude
from knightcube.vision.horizon_camera_job import EARTHLIGHT_SIGMA, HorizonCameraJob, run
from knightcube.vision.solar_cells import SolarStringModel

SUN, NADIR = np.array([-0.59, 0.13, 0.80]), np.array([0.66, -0.62, -0.42])
SHARES = np.array([0.14, 0.14, 0.83, 0.61, 0.15, 0.11])
"""Currents relative to peak currents, with the Earth opposite to the Sun, so that it illuminates +x and
-y."""
CAMERA = MountedCamera(Pinhole.from_field_of_view(64, 64, 1.0), np.array([0.0, 0.0, 0.0, 1.0]))
POSITION, SUNWARD = np.array([-4e6, 4e6, -3.9e6]), np.array([0.2, 0.3, 0.9])


def attitude() -> FloatArray:
    """Return the attitude (4,) in which the nadir is NADIR."""

    def frame(first: FloatArray, second: FloatArray) -> FloatArray:
        x, z = first / np.linalg.norm(first), np.cross(first, second)
        z = z / np.linalg.norm(z)
        return np.stack([x, np.cross(z, x), z])

    return from_matrix(frame(NADIR, SUN).T @ frame(-POSITION, SUNWARD))


def off_deg(sigma: float) -> float:
    """Return the error (deg) of the solar strings' Sun direction, with an attitude known to `sigma` rad."""
    knowledge = HorizonKnowledge(position=POSITION, attitude=RoughAttitude(attitude(), sigma))
    dark = np.zeros((64, 64), dtype=np.uint8)
    found = run(HorizonCameraJob({0: dark}, (CAMERA,), knowledge, (SolarStringModel(), SHARES))).sun
    assert found is not None
    assert not found.cameras
    return float(np.degrees(np.arccos(found.direction @ SUN / np.linalg.norm(SUN))))


def test_a_rough_attitude_predicts_which_strings_the_earth_illuminates() -> None:
    assert off_deg(0.5 * EARTHLIGHT_SIGMA) < 3.0
    assert off_deg(2.0 * EARTHLIGHT_SIGMA) > 8.0
