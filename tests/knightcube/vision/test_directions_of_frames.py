"""Tests of the attitude from horizon and Sun in rendered frames of four cameras, and of its covariance."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray, Image
from knightcube.astro.attitude.solvers import VectorObservation, weighted_fit
from knightcube.astro.attitude.wahba import AttitudeFix
from knightcube.astro.earth.figure import EARTH_RADIUS
from knightcube.astro.earth.sun import ASTRONOMICAL_UNIT
from knightcube.astro.quaternion import conjugate, from_matrix, from_rotation_vector, multiply
from knightcube.astro.quaternion import to_rotation_vector as rotation_vector
from knightcube.vision.horizon.nadir import find_nadir
from knightcube.vision.horizon.settings import HorizonKnowledge
from knightcube.vision.sun import SunSettings, find_sun
from sim_hal.earth_camera import EarthCameraModel, EarthScene, render
from tests.support.limb_frames import camera_model, finder_settings
from tests.support.orbit_geometry import local_frame, suite
from tests.support.sensor_suite import WideCamera

UW = suite("uw")
POSITION: FloatArray = (EARTH_RADIUS + 380e3) * np.array([[0.6, -0.64, 0.48]])
VELOCITY: FloatArray = 7.67e3 * np.array([[0.8, 0.48, -0.36]])
MODEL: EarthCameraModel = camera_model()


def attitude() -> FloatArray:
    """Return an attitude that differs from the local vertical by 5 deg."""
    level = from_matrix(local_frame(POSITION, VELOCITY)[0])
    return multiply(from_rotation_vector(np.radians([3.0, -3.5, 10.0])), level)


def sun() -> FloatArray:
    """Return a Sun direction 24 deg from the zenith, in the field of view of the top camera.

    The limb is sunlit.
    """
    zenith = POSITION[0] / np.linalg.norm(POSITION[0])
    towards = zenith + 0.45 * np.array([0.0, 0.6, 0.8])
    return np.asarray(towards / np.linalg.norm(towards))


def frame_of(camera: WideCamera, seed: int) -> Image:
    """Return the frame of one of the four cameras."""
    looking = multiply(np.array(camera.mounting), attitude())
    scene = EarthScene(POSITION[0], looking / np.linalg.norm(looking), ASTRONOMICAL_UNIT * sun())
    return render(MODEL, scene, np.random.default_rng(seed))


def observation_of(
    camera: WideCamera, direction: FloatArray, covariance: FloatArray, reference: FloatArray
) -> VectorObservation:
    """Return a camera's direction (3,) and covariance (3, 3) rad^2 in body axes."""
    to_camera = camera.to_camera
    return VectorObservation(to_camera.T @ direction, reference, to_camera.T @ covariance @ to_camera)


@pytest.fixture(scope="module")
def sights() -> dict[str, VectorObservation]:
    """Return the measured directions of three horizons and a Sun, in body axes."""
    found = {}
    knowledge = HorizonKnowledge(position=POSITION[0], sun=sun())
    down = -POSITION[0] / np.linalg.norm(POSITION[0])
    for number in range(3):
        camera = UW.cameras[number]
        nadir = find_nadir(frame_of(camera, number), MODEL.lens, knowledge, finder_settings(MODEL)).nadir
        assert nadir is not None
        found[camera.name] = observation_of(camera, nadir.direction, nadir.covariance, down)
    top = UW.cameras[3]
    seen = find_sun(frame_of(top, 3), MODEL.lens, SunSettings()).sun
    assert seen is not None
    found["sun"] = observation_of(top, seen.direction, seen.covariance, sun())
    return found


def attitude_error(fix: AttitudeFix) -> FloatArray:
    """Return the attitude error (3,) as a rotation vector (rad)."""
    return rotation_vector(multiply(attitude(), conjugate(fix.quaternion)))


def test_one_exposure_of_four_cameras_fixes_the_attitude(sights: dict[str, VectorObservation]) -> None:
    """One exposure of four cameras determines the attitude.

    The Sun is 24 deg off the vertical, so the rotation about the vertical is 2.5 times less accurate, as
    stated.
    """
    fix = weighted_fit(list(sights.values()))
    error = attitude_error(fix)
    assert np.max(np.abs(np.degrees(error))) < 0.15
    # 99.9 % quantile of a chi-square with 3 degrees of freedom.
    assert error @ np.linalg.solve(fix.covariance, error) < 16.3
