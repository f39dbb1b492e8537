"""Satellites above a latitude of 53 deg north, with rendered frames of their horizon cameras."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray, Image
from knightcube.astro.earth.sun import ASTRONOMICAL_UNIT
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, multiply, normalise
from knightcube.vision.camera.lens import MountedCamera
from knightcube.vision.horizon.settings import HorizonKnowledge, RoughAttitude
from sim_hal.earth_camera import EarthScene, render
from tests.support.limb_frames import camera_model
from tests.support.orbit_geometry import suite

WIDE_MODEL = camera_model()
UW = [MountedCamera(WIDE_MODEL.lens, np.array(one.mounting)) for one in suite("uw").cameras]
VT = [MountedCamera(WIDE_MODEL.lens, np.array(one.mounting)) for one in suite("vt").cameras]
ALTITUDE = 500e3


@dataclass(frozen=True, eq=False)
class Instant:
    """A satellite with the images of its cameras and its prior knowledge."""

    attitude: FloatArray
    position: FloatArray
    sun: FloatArray
    scenes: list[EarthScene]
    frames: dict[int, Image]

    @property
    def nadir(self) -> FloatArray:
        """True nadir direction (3,) in body axes."""
        return np.asarray(attitude_matrix(self.attitude) @ (-self.position / np.linalg.norm(self.position)))

    @property
    def sun_in_body(self) -> FloatArray:
        """True direction (3,) of the Sun."""
        return np.asarray(attitude_matrix(self.attitude) @ self.sun)

    def knowledge(self, sigma: float = 0.05) -> HorizonKnowledge:
        """Return the prior information of the horizon search: position, Sun direction and a rough attitude.

        The rough attitude has the standard deviation `sigma`, rad.
        """
        rough = multiply(from_rotation_vector(np.array([0.6, -0.5, 0.6]) * sigma), self.attitude)
        return HorizonKnowledge(position=self.position, sun=self.sun, attitude=RoughAttitude(rough, sigma))


def instant(cameras: list[MountedCamera], nadir: FloatArray, sun: FloatArray, seed: int) -> Instant:
    """Return a satellite above 53 deg north, with nadir (3,) in body axes and Sun (3,) in inertial axes."""
    down = np.array([-0.6, 0.0, -0.8])
    position = -(6_378_137.0 + ALTITUDE) * down
    middle = nadir / np.linalg.norm(nadir) + down
    attitude = normalise(np.array([*middle, 0.0]))
    generator = np.random.default_rng(seed)
    scenes = [
        EarthScene(position, multiply(one.mounting, attitude), ASTRONOMICAL_UNIT * sun) for one in cameras
    ]
    frames = {number: render(WIDE_MODEL, scene, generator) for number, scene in enumerate(scenes)}
    return Instant(attitude, position, sun / np.linalg.norm(sun), scenes, frames)
