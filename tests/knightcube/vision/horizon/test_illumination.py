"""Pictures that a known attitude denies, and sound ones that it never does."""

from __future__ import annotations

import math

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray, Image
from knightcube.astro.quaternion import attitude_matrix, normalise
from knightcube.vision.camera.lens import MountedCamera, Pinhole
from knightcube.vision.horizon.illumination import image_brightness, why_false
from knightcube.vision.horizon.limb import MEAN_RADIUS
from knightcube.vision.horizon_camera_job import SUNLIT_COUNTS
from sim_hal.earth_camera import EarthScene, render
from sim_hal.earth_camera.image import EarthCameraModel
from sim_hal.emulators.camera import SPOILT

PINHOLE = Pinhole.from_field_of_view(128, 128, math.radians(80.0))
CAMERA = MountedCamera(PINHOLE, np.array([0.0, 0.0, 0.0, 1.0]))
AWAY = 1.496e11
ERROR = math.radians(0.3)
"""rad an axis, of the attitude that judges."""


def view(seed: int) -> tuple[Image, FloatArray, float, FloatArray]:
    """Return a picture from a random place and attitude, with believed nadir, altitude and Sun."""
    draw = np.random.default_rng(seed)
    attitude = normalise(draw.normal(size=4))
    up, sun = (vector / np.linalg.norm(vector) for vector in draw.normal(size=(2, 3)))
    altitude = float(draw.uniform(350e3, 900e3))
    model = EarthCameraModel(lens=PINHOLE, rows=128, columns=128, seed=seed)
    scene = EarthScene(
        (MEAN_RADIUS + altitude) * up, attitude, AWAY * sun, rotation=float(draw.uniform(0.0, 2.0 * np.pi))
    )
    turn = attitude_matrix(normalise(np.append(0.5 * ERROR * draw.normal(size=3), 1.0)))
    believed = turn @ attitude_matrix(attitude)
    return render(model, scene, draw), believed @ -up, altitude, believed @ sun


def judged(picture: Image, nadir: FloatArray, altitude: float, sun: FloatArray) -> str:
    return why_false(image_brightness(picture, CAMERA, SUNLIT_COUNTS), nadir, altitude, sun)


def test_no_sound_picture_is_false() -> None:
    assert [seed for seed in range(60) if judged(*view(seed))] == []


@pytest.mark.parametrize(
    ("fault", "least"), [("black", 6), ("saturated", 30), ("blinded", 30), ("garbage", 30)]
)
def test_pictures_of_a_broken_camera_are_false(fault: str, least: int) -> None:
    """Of 60 views, many of them of the night or beside the Sun."""
    views = [view(seed) for seed in range(60)]
    false = [bool(judged(np.asarray(SPOILT[fault](one[0], 1)), *one[1:])) for one in views]
    assert sum(false) >= least


def test_what_is_under_the_camera_decides() -> None:
    """A nadir camera at noon sees ground, on its night side none."""
    down, overhead, beside = np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -1.0]), np.array([1.0, 0.0, 0.0])
    dark, lit = np.zeros((128, 128), np.uint8), np.full((128, 128), 200, np.uint8)
    assert "dark" in judged(dark, down, 500e3, overhead)
    assert judged(lit, down, 500e3, overhead) == ""
    assert judged(dark, down, 500e3, down) == "", "the Sun is beneath the ground"
    assert judged(dark, overhead, 500e3, beside) == "", "the camera sees the sky"
    assert "bright" in judged(lit, overhead, 500e3, beside)
