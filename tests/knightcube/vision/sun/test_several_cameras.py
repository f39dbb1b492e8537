"""The Sun of several cameras: the strings choose the camera to read, and stand in where none finds it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray, Image
from knightcube.astro.quaternion import from_matrix, from_rotation_vector
from knightcube.vision.camera.lens import MountedCamera
from knightcube.vision.horizon.initial_guess import shortest_turn
from knightcube.vision.sun.direction import SunSettings, SunStatus
from knightcube.vision.sun.several_cameras import sun_of_cameras
from knightcube.vision.sun.solar_cells import CoarseSun, CoarseSunStatus, SolarStrings, coarse_sun
from sim_hal.earth_camera import EarthCameraModel, EarthScene, render, sun_direction
from tests.sim_hal.earth_camera.scenes import random_sun_scene

MODEL = EarthCameraModel.fuga15d(seed=1)
SETTINGS = SunSettings()
DARK = np.full((512, 512), 8, dtype=np.uint8)
TURNS = np.array([[0.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, -2.0, 0.0]])
"""Mountings of three cameras, body into camera, as rotation vectors."""
CAMERAS = [MountedCamera(MODEL.lens, from_rotation_vector(turn)) for turn in TURNS]


@pytest.fixture(scope="module")
def seen() -> tuple[EarthScene, Image]:
    """Return the Sun in a picture: that of camera 1."""
    generator = np.random.default_rng(3)
    scene = random_sun_scene(generator, MODEL, margin=40.0)
    return scene, render(MODEL, scene, generator)


def _in_body(scene: EarthScene, number: int = 1) -> FloatArray:
    """Return the true Sun (3,), body axes, of a scene as one camera sees it."""
    return CAMERAS[number].in_body(sun_direction(scene))


def _strings(sun: FloatArray) -> CoarseSun:
    strings = SolarStrings()
    return coarse_sun(np.maximum(strings.normals @ sun, 0.0), strings)


def test_only_the_camera_that_the_strings_choose_is_read(seen: tuple[EarthScene, Image]) -> None:
    scene, frame = seen
    sun = _in_body(scene)
    found = sun_of_cameras({0: DARK, 1: frame, 2: DARK}, CAMERAS, _strings(sun), SETTINGS)
    assert found.camera == 1
    assert list(found.each) == [1]
    assert found.direction is not None
    assert found.covariance is not None
    assert np.degrees(np.arccos(min(1.0, float(found.direction @ sun)))) < 0.02
    assert np.degrees(np.sqrt(0.5 * np.trace(found.covariance))) < 0.02


def test_the_strings_stand_in_where_the_cameras_algorithm_fails(seen: tuple[EarthScene, Image]) -> None:
    sun = _in_body(seen[0])
    found = sun_of_cameras({0: DARK, 1: DARK, 2: DARK}, CAMERAS, _strings(sun), SETTINGS)
    assert found.camera is None
    assert found.direction is not None
    assert found.covariance is not None
    off = np.arccos(min(1.0, float(found.direction @ sun)))
    sigma = float(np.sqrt(0.5 * np.trace(found.covariance)))
    assert np.radians(0.5) < sigma < np.radians(6.0)
    assert off < 4.0 * sigma
    assert "camera 1: nothing reaches 200 counts" in found.reason


def test_a_reflection_far_from_the_strings_sun_is_not_the_sun(seen: tuple[EarthScene, Image]) -> None:
    """The picture that has the Sun comes from a camera whose field the strings' Sun only brushes."""
    scene, frame = seen
    true = CAMERAS[0].in_body(np.array([0.0, np.sin(0.5), np.cos(0.5)]))
    assert float(true @ _in_body(scene, 0)) < np.cos(0.3)
    found = sun_of_cameras({0: frame}, CAMERAS, _strings(true), SETTINGS)
    assert found.camera is None
    assert found.reason == "camera 0: a Sun where the strings have none"
    assert found.direction is not None
    assert float(found.direction @ true) > np.cos(0.1)


def test_a_sun_cut_by_the_frames_edge_claims_less(seen: tuple[EarthScene, Image]) -> None:
    """Its error is the same in frame after frame: up to 0.03 deg where 0.007 was claimed."""
    scene, _ = seen
    turn = shortest_turn(sun_direction(scene), MODEL.lens.unit_vectors(np.array([[510.7, 300.0]]))[0])
    cut = replace(scene, attitude=from_matrix(turn @ scene.camera_matrix))
    sun, frame = _in_body(cut), render(MODEL, cut, np.random.default_rng(4))
    found = sun_of_cameras({1: frame}, CAMERAS, _strings(sun), SETTINGS)
    assert found.camera == 1
    assert found.each[1].status is SunStatus.PARTIAL
    assert found.direction is not None
    assert found.covariance is not None
    sigma = float(np.sqrt(0.5 * np.trace(found.covariance)))
    assert np.radians(0.05) < sigma < np.radians(0.07)
    assert float(np.linalg.norm(np.cross(found.direction, sun))) < 2.0 * sigma


def test_doubtful_strings_leave_all_cameras_to_be_read_and_eclipse_none(
    seen: tuple[EarthScene, Image],
) -> None:
    _, frame = seen
    doubt = CoarseSun(CoarseSunStatus.UNCERTAIN, reason="unclear")
    found = sun_of_cameras({0: DARK, 1: frame}, CAMERAS, doubt, SETTINGS)
    assert list(found.each) == [0, 1]
    assert found.camera == 1
    night = sun_of_cameras({1: frame}, CAMERAS, CoarseSun(CoarseSunStatus.DARK, reason="eclipse"), SETTINGS)
    assert not night.each
    assert night.direction is None
    assert night.reason == "no light: eclipse"
