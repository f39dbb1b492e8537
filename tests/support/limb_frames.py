"""Frames of the Earth's limb, and the prior information of the satellite."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector
from knightcube.vision.horizon.settings import (
    EdgeSettings,
    HorizonKnowledge,
    HorizonSettings,
    LogarithmicResponse,
    SensedDirection,
)
from sim_hal.earth_camera import EarthCameraModel, EarthScene
from sim_hal.earth_light import Atmosphere
from tests.sim_hal.earth_camera.scenes import random_direction

KNOWN_LIMB = 1000.0
"""Standard deviation (m) of the height of the limb if the atmosphere is known."""


SCALE_HEIGHTS, HAZE = (6_500.0, 9_500.0), (0.7, 1.3)
"""Ranges of the scale height (m) and of the optical depth relative to the standard, for unknown atmospheres.
"""


SUN_SIGMA, FIELD_SIGMA = np.radians(5.0), np.radians(2.0)


K1, K2 = -0.05, 0.01


def camera_model() -> EarthCameraModel:
    """Return the camera model of the campaign."""
    return EarthCameraModel.fuga15d(seed=1, k1=K1, k2=K2)


def finder_settings(model: EarthCameraModel, air: str = "unknown") -> HorizonSettings:
    """Return the default limb settings for an atmosphere of `AIRS`, with the response of the camera."""
    response = LogarithmicResponse(model.pedestal, model.counts_per_decade)
    settings = HorizonSettings(edges=EdgeSettings(response=response, psf_sigma=model.blur))
    even = replace(settings, limb_height_sigma=KNOWN_LIMB, uneven_limb_sigma=0.0)
    return even if air == "known" else settings


def random_air(generator: np.random.Generator) -> Atmosphere:
    """Return an atmosphere that differs from the standard.

    The limb of this atmosphere is some 2 km lower or higher.
    """
    standard = Atmosphere()
    return replace(
        standard,
        scale_height=generator.uniform(*SCALE_HEIGHTS),
        optical_depth=standard.optical_depth * generator.uniform(*HAZE),
    )


def coarse_knowledge(scene: EarthScene, generator: np.random.Generator) -> HorizonKnowledge:
    """Return the prior information of a satellite in the scene, with random errors of its coarse sensors."""
    sun, field = scene.sun / np.linalg.norm(scene.sun), random_direction(generator)
    sensed = tuple(
        SensedDirection(misread(scene.camera_matrix @ true, sigma, generator), true, sigma)
        for true, sigma in ((sun, SUN_SIGMA), (field, FIELD_SIGMA))
    )
    return HorizonKnowledge(position=scene.position, sun=sun, pole=scene.pole, sensed=sensed)


def misread(direction: FloatArray, sigma: float, generator: np.random.Generator) -> FloatArray:
    """Return a direction (3,) as a coarse sensor measures it, with an error of `sigma` (rad) per axis."""
    error = from_rotation_vector(sigma * generator.standard_normal(3))
    return np.asarray(attitude_matrix(error) @ direction)
