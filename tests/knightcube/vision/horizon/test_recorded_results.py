"""Tests that nadir directions from small rendered frames equal the recorded directions to five digits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from knightcube.astro.arrays import Image
from knightcube.astro.quaternion import from_rotation_vector, multiply
from knightcube.vision.horizon.edges import find_edges
from knightcube.vision.horizon.illumination import coarse_nadir, image_brightness
from knightcube.vision.horizon.nadir import find_nadir, nadir_of_cameras
from knightcube.vision.horizon.settings import HorizonKnowledge, RoughAttitude, SensedDirection
from sim_hal.earth_camera import EarthScene, render
from tests.knightcube.vision.horizon.instants import UW, Instant, instant
from tests.sim_hal.earth_camera.scenes import limb_scene
from tests.support.limb_frames import camera_model, finder_settings
from tests.support.recorded_results import check

MODEL = camera_model()
SETTINGS = finder_settings(MODEL)


def scene(sun: tuple[float, float, float], texture: int) -> tuple[EarthScene, Image]:
    """Return a scene with the limb across the image centre and the Sun in a given direction."""
    found = limb_scene(zenith=np.array([1.0, 0.2, 1.0]), sun=np.array(sun), texture=texture)
    return found, render(MODEL, found, np.random.default_rng(texture))


@pytest.fixture(scope="module")
def day() -> tuple[EarthScene, Image]:
    return scene((1.0, 0.6, 0.5), 3)


@pytest.fixture(scope="module")
def dusk() -> tuple[EarthScene, Image]:
    return scene((-0.1, 1.0, 0.2), 5)


def known(one: EarthScene) -> HorizonKnowledge:
    """Return the prior information of a satellite with a GPS receiver."""
    return HorizonKnowledge(position=one.position, sun=one.sun, pole=one.pole)


def test_the_edges_are_as_recorded(day: tuple[EarthScene, Image]) -> None:
    check(__file__, "edges", find_edges(day[1], SETTINGS.edges))


def test_the_nadir_without_any_knowledge_is_as_recorded(day: tuple[EarthScene, Image]) -> None:
    check(__file__, "unknown", find_nadir(day[1], MODEL.lens, settings=SETTINGS))


def test_the_nadir_with_the_position_is_as_recorded(day: tuple[EarthScene, Image]) -> None:
    check(__file__, "position", find_nadir(day[1], MODEL.lens, known(day[0]), SETTINGS))


def test_the_nadir_at_a_known_altitude_is_as_recorded(day: tuple[EarthScene, Image]) -> None:
    check(__file__, "altitude", find_nadir(day[1], MODEL.lens, HorizonKnowledge(altitude=600e3), SETTINGS))


def test_the_nadir_with_a_rough_attitude_is_as_recorded(day: tuple[EarthScene, Image]) -> None:
    one, frame = day
    tilted = multiply(from_rotation_vector(np.array([0.02, -0.01, 0.015])), one.attitude)
    help_ = replace(known(one), attitude=RoughAttitude(tilted, 0.03))
    check(__file__, "rough attitude", find_nadir(frame, MODEL.lens, help_, SETTINGS))


def test_the_nadir_with_a_sensed_direction_is_as_recorded(day: tuple[EarthScene, Image]) -> None:
    one, frame = day
    sun = SensedDirection(one.camera_matrix @ one.sun, one.sun, 0.1)
    check(__file__, "sensed", find_nadir(frame, MODEL.lens, replace(known(one), sensed=(sun,)), SETTINGS))


def test_the_nadir_near_the_terminator_is_as_recorded(dusk: tuple[EarthScene, Image]) -> None:
    check(__file__, "dusk", find_nadir(dusk[1], MODEL.lens, known(dusk[0]), SETTINGS))


def test_a_frame_of_noise_is_as_recorded() -> None:
    noise = np.random.default_rng(4).normal(40.0, 6.0, (512, 512)).clip(0, 255).astype(np.uint8)
    check(__file__, "noise", find_nadir(noise, MODEL.lens, settings=SETTINGS))


@pytest.fixture(scope="module")
def level() -> Instant:
    """Return a level satellite by day, with two cameras on the limb."""
    return instant(UW[:2], np.array([0.02, -0.03, 1.0]), np.array([0.8, 0.5, 0.3]), 11)


def test_the_joint_nadir_of_two_cameras_is_as_recorded(level: Instant) -> None:
    check(__file__, "joint", nadir_of_cameras(level.frames, UW[:2], level.knowledge(), SETTINGS))


def test_the_coarse_nadir_from_the_brightness_is_as_recorded(level: Instant) -> None:
    pairs = zip(level.frames.values(), UW[:2], strict=True)
    looks = [image_brightness(frame, camera, 30.0) for frame, camera in pairs]
    found = [coarse_nadir(looks, 500e3), coarse_nadir(looks, 500e3, level.sun_in_body)]
    check(__file__, "coarse", [looks, found])
