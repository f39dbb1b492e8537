"""Tests that rendered images of the Earth camera equal the recorded images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.vision.camera.lens import Lens
from sim_hal.earth_camera import (
    EarthCameraModel,
    EarthScene,
    darkening,
    expected_radiance,
    look,
    nadir,
    radiance,
    render,
    scatter_centre,
    towards_sun,
    transmission,
    visible_share,
)
from sim_hal.earth_light import Atmosphere, albedo, map_noise
from tests.sim_hal.earth_camera.scenes import limb_scene
from tests.support.recorded_results import check
from tests.support.sun_frames import CAMERAS


def small(name: str) -> EarthCameraModel:
    """Return a camera with 96 x 80 px."""
    lens = Lens(96, 80, 75.0, (47.5, 39.5), -0.1)
    return replace(CAMERAS[name][0], lens=lens, columns=96, rows=80)


@pytest.fixture(scope="module")
def scene() -> EarthScene:
    return limb_scene(zenith=np.array([1.0, 0.2, 1.0]), sun=np.array([1.0, 0.6, 0.5]), texture=3)


@pytest.mark.parametrize("name", ["logarithmic", "linear", "overexposed"])
def test_an_image_of_the_limb_is_as_recorded(scene: EarthScene, name: str) -> None:
    check(__file__, f"image {name}", render(small(name), scene, np.random.default_rng(4)), 1e-4)


def test_an_image_with_the_sun_is_as_recorded() -> None:
    towards = np.array([0.2, 0.1, 1.0])
    facing = limb_scene(zenith=np.array([1.0, 0.2, 0.1]), sun=towards, dip=-0.2)
    model = small("linear")
    found = [render(model, facing, np.random.default_rng(4)), expected_radiance(model, facing)]
    check(__file__, "sun", [*found, scatter_centre(model), visible_share(facing)], 1e-4)


def rays() -> FloatArray:
    """Return rays (80, 3) in the field of view of the small camera."""
    model = small("linear")
    x, y = np.meshgrid(np.linspace(3.0, 92.0, 10), np.linspace(3.0, 76.0, 8))
    return model.lens.unit_vectors(np.stack([x.ravel(), y.ravel()], axis=1))


def test_the_light_along_rays_is_as_recorded(scene: EarthScene) -> None:
    along = rays() @ scene.camera_matrix
    sight = look(scene, along)
    found = [
        sight,
        radiance(scene, along.T.astype(np.float32))[0],
        transmission(scene, along),
        nadir(scene),
        towards_sun(scene),
    ]
    check(__file__, "rays", found, 1e-4)


def test_the_air_is_as_recorded() -> None:
    air = Atmosphere()
    heights = np.linspace(0.0, 60e3, 9, dtype=np.float32)
    cosines = np.linspace(-1.0, 1.0, 9, dtype=np.float32)
    found = [
        air.tangent_depth(heights),
        air.slant_depth(np.abs(cosines)),
        air.phase(cosines),
        air.scattered(heights / 30e3, 0.3 + 0.0 * heights, np.abs(cosines)),
        air.limb_depth,
        air.apparent_limb_height,
        darkening(np.linspace(0.0, 1.0, 7)),
    ]
    check(__file__, "air", found, 1e-4)


def test_the_albedo_of_the_ground_is_as_recorded() -> None:
    rng = np.random.default_rng(8)
    directions = rng.normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    below = directions.T.astype(np.float32)
    check(__file__, "albedo", [albedo(below, map_noise(seed)) for seed in (0, 3)], 1e-4)
