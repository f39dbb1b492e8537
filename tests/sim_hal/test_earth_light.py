"""Tests of the light along many lines of sight: compiled form, tables of the air, and interpolated rays."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.figure import semi_axes
from sim_hal import earth_camera, earth_light
from sim_hal.earth_camera import EarthCameraModel, EarthScene, pixel_rays
from sim_hal.earth_light import TOP, Atmosphere, air_tables, light, map_noise
from tests.sim_hal.earth_camera.scenes import limb_scene, random_scene
from tests.support import compiled_forms

CAMERA = EarthCameraModel.fuga15d(np.radians(92.0))
AIR = Atmosphere()


def _arguments(scene: EarthScene, rays: FloatArray, air: Atmosphere = AIR) -> tuple[Any, ...]:
    """Return the arguments of `light` for rays (n, 3)."""
    sun = scene.in_earth(scene.sun / np.linalg.norm(scene.sun))
    place = scene.on_unit_sphere()
    coarse = np.ascontiguousarray(rays.T, dtype=np.float32)
    return coarse, *place, semi_axes(), sun, 1.02, 0.28, *air_tables(air), map_noise(3)


def _some_rays(generator: np.random.Generator, count: int) -> FloatArray:
    rays = pixel_rays(CAMERA.lens)
    return rays[np.sort(generator.choice(len(rays), count, replace=False))]


def test_the_loop_form_returns_the_light_of_the_numpy_form() -> None:
    """The forms agree within 1e-3 of the radiance, which is 0.02 counts of the logarithmic camera.

    Up to 0.2 % of the rays may differ by up to 3 %, because rounding errors move points near the limb along
    the line of sight, to ground of another albedo. A radiance of 1e-3 times the dark current counts as zero.
    """
    forms = [(light.loop_form, 1500)]
    if compiled_forms.compiles:
        pytest.importorskip("numba", reason="numba is not installed: pip install knightcube[fast]")
        forms.append((light.compiled_form(), 60_000))
    for form, count in forms:
        generator = np.random.default_rng(3)
        for view in ("sunlit", "terminator", "sunlit"):
            scene = random_scene(generator, CAMERA, view)
            arguments = _arguments(scene, _some_rays(generator, count))
            (expected, above), (found, above_too) = light.numpy_form(*arguments), form(*arguments)
            assert np.mean(expected > 0.0) > 0.1
            np.testing.assert_allclose(found, expected, rtol=0.03, atol=1e-3 * CAMERA.darkest)
            assert np.mean(np.abs(found - expected) > 1e-3 * (expected + CAMERA.darkest)) < 2e-3
            assert np.mean(above != above_too) < 2e-3


def test_the_radiance_of_faint_air_at_the_centre_of_a_pixel_is_accurate(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Averaging faint air within pixels, too, changes a frame by less than 5e-5."""
    monkeypatch.setattr(earth_camera, "light", light.numpy_form)
    generator = np.random.default_rng(1)
    for scene in (
        random_scene(generator, CAMERA, "sunlit", (450e3, 550e3)),
        random_scene(generator, CAMERA, "terminator", (450e3, 550e3)),
    ):
        found = earth_camera._earth(CAMERA, scene)
        with monkeypatch.context() as exact:
            exact.setattr(earth_light, "FAINTEST", 0.0)
            expected = earth_camera._earth(CAMERA, scene)
        assert 0.0 < np.abs(found - expected).max() < 5e-5


def test_rays_that_are_not_numbers_are_dark_in_both_forms() -> None:
    rays = _some_rays(np.random.default_rng(4), 40)
    rays[::3] = np.nan
    scene = limb_scene(zenith=np.array([1.0, 0.2, 0.1]), sun=np.array([1.0, 0.0, 0.3]), dip=0.6)
    for form in (light.numpy_form, light.loop_form):
        radiance, above = form(*_arguments(scene, rays))
        assert np.count_nonzero(radiance) > 20
        assert not radiance[::3].any()
        assert not above[::3].any()


@pytest.mark.parametrize("view", ["dark side", "deep space", "no rays"])
def test_both_forms_are_dark_where_no_light_is(view: str) -> None:
    zenith = np.array([1.0, 0.2, 0.1])
    scene = limb_scene(zenith=zenith, sun=-zenith if view == "dark side" else zenith + 0.1, dip=0.6)
    rays = _some_rays(np.random.default_rng(4), 0 if view == "no rays" else 300)
    if view == "deep space":
        rays = zenith @ scene.camera_matrix.T + 0.1 * rays
    for form in (light.numpy_form, light.loop_form):
        radiance, above = form(*_arguments(scene, rays))
        assert radiance.shape == above.shape == (len(rays),)
        assert not radiance.any()
        assert not above.any()


@pytest.mark.parametrize("air", [AIR, Atmosphere(8000.0, 0.3, 1.0), Atmosphere(20e3, 0.05, 2.0)])
def test_the_tables_of_the_air_have_the_stated_error(air: Atmosphere) -> None:
    """Linear interpolation has a relative error below 2e-4 for scale heights from 8 km."""
    generator = np.random.default_rng(5)
    tables, steps = air_tables(air), earth_light._STEPS
    cosines, heights = generator.uniform(0.0, 1.0, 20_000), generator.uniform(0.0, TOP, 20_000)
    bottom = np.exp(-heights / air.scale_height)
    places = np.concatenate([cosines * steps, steps + 1 + heights * (steps / TOP)])
    depth = np.concatenate([air.slant_depth(cosines), air.tangent_depth(heights)])
    sight = np.stack([np.concatenate([np.ones_like(cosines), bottom]), depth, -np.expm1(-depth)])
    found = earth_light._interpolated(tables.sight, places.astype(np.float32))
    np.testing.assert_allclose(found, sight, rtol=2e-4)
    solar = generator.uniform(-0.2, 1.0, 20_000)
    towards, direct = earth_light._interpolated(tables.sun, ((solar + 0.2) * 5120.0).astype(np.float32))
    np.testing.assert_allclose(towards, air.slant_depth(solar), rtol=2e-4)
    np.testing.assert_allclose(direct, np.maximum(solar, 0.0) * np.exp(-air.slant_depth(solar)), atol=2e-5)
    share = generator.uniform(1e-6, 1.0, 20_000)
    x = 1.0 / share - 1.0
    found = earth_light._interpolated(tables.share, (share * steps).astype(np.float32))
    np.testing.assert_allclose(found[0], -np.expm1(-x) / x, rtol=2e-4)
