"""The Sun's disc and glare in the simulated frame, against its radius, flux and projection."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.figure import SEMI_MAJOR_AXIS
from knightcube.astro.earth.sun import ASTRONOMICAL_UNIT, SUN_RADIUS
from sim_hal.earth_camera import EarthCameraModel, EarthScene, render, sun_direction, sun_point
from sim_hal.earth_camera.image import expected_radiance
from sim_hal.earth_camera.model import pixel_rays
from sim_hal.earth_camera.radiance import add_disc, scatter_centre, visible_share
from tests.sim_hal.earth_camera.scenes import pointing, random_sun_scene

CLEAN = EarthCameraModel.fuga15d(scatter=0.0)
BENT = EarthCameraModel.fuga15d(scatter=0.0, k1=-0.12, k2=0.01)


def _centroid(light: FloatArray) -> FloatArray:
    y, x = np.nonzero(light > 100.0)
    weight = light[y, x]
    return np.asarray(np.array([x @ weight, y @ weight]) / weight.sum())


def _deep_space(sun: FloatArray, boresight: FloatArray) -> EarthScene:
    """Return a scene that looks away from the Earth."""
    position = (SEMI_MAJOR_AXIS + 600e3) * np.array([0.0, 0.0, 1.0])
    return EarthScene(position, pointing(boresight, np.array([1.0, 0.0, 0.0])), position + sun)


@pytest.mark.parametrize("model", [CLEAN, BENT])
def test_the_disc_is_centred_where_the_lens_projects_the_suns_direction(model: EarthCameraModel) -> None:
    generator = np.random.default_rng(7)
    for _ in range(12):
        scene = random_sun_scene(generator, model, margin=8.0)
        image = np.zeros((model.rows, model.columns), dtype=np.float32)
        add_disc(scene, model, image)
        centroid = _centroid(image.astype(float))
        assert centroid == pytest.approx(sun_point(scene, model), abs=0.02)


def test_all_the_suns_light_arrives_pi_in_these_units() -> None:
    """The irradiance of a matt white surface's radiance one is pi, whatever the disc's size in pixels."""
    sun = ASTRONOMICAL_UNIT * np.array([0.1, 0.05, 1.0]) / np.linalg.norm([0.1, 0.05, 1.0])
    scene = _deep_space(sun, np.array([0.0, 0.0, 1.0]))
    for model in (CLEAN, EarthCameraModel.fuga15d(scatter=0.0, field_of_view=np.radians(20.0))):
        light = expected_radiance(model, scene)
        cosine = pixel_rays(model.lens)[:, 2].reshape(light.shape)
        irradiance = np.sum(light * cosine**3) / model.lens.focal_length**2
        assert irradiance == pytest.approx(np.pi, rel=0.01)


def test_the_discs_radius_is_the_suns() -> None:
    """In a narrow camera the rim is where light falls through half of its neighbours'."""
    model = EarthCameraModel.fuga15d(scatter=0.0, field_of_view=np.radians(5.0))
    scene = _deep_space(ASTRONOMICAL_UNIT * np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 1.0]))
    across = expected_radiance(model, scene)[255]
    rim = np.flatnonzero(across > 0.5 * across[255 - 20])
    expected = 2.0 * model.lens.focal_length * np.tan(np.arcsin(SUN_RADIUS / ASTRONOMICAL_UNIT))
    assert rim[-1] - rim[0] + 1 == pytest.approx(expected, rel=0.04)
    assert across[255] > 1.5 * across[rim[1] + 1]


def test_glare_holds_its_share_of_the_light_and_stays_when_the_sun_leaves_the_field() -> None:
    model = EarthCameraModel.fuga15d(scatter=0.03, field_of_view=np.radians(130.0), blur=0.0)
    ahead = np.array([0.0, 0.0, 1.0])
    light = expected_radiance(model, _deep_space(ASTRONOMICAL_UNIT * ahead, ahead))
    rays = pixel_rays(model.lens)
    solid = (rays[:, 2].reshape(light.shape)) ** 3 / model.lens.focal_length**2
    chords = np.linalg.norm(rays - ahead, axis=1).reshape(light.shape)
    # Of the law's logarithmic integral what lies between 3 deg and the inscribed circle of 60 deg.
    ring = (chords > np.radians(3.0)) & (chords < 1.0)
    square = model.scatter_angle**2
    part = np.log((1.0 + 1.0 / square) / (1.0 + np.radians(3.0) ** 2 / square)) / np.log(1.0 + 2.0 / square)
    assert np.sum((light * solid)[ring]) == pytest.approx(np.pi * 0.03 * part, rel=0.01)
    aside = np.array([0.0, 0.8, 0.6])
    outside = expected_radiance(CLEAN, _deep_space(ASTRONOMICAL_UNIT * aside, ahead))
    assert outside.max() == 0.0
    glare = expected_radiance(replace(CLEAN, scatter=0.01), _deep_space(ASTRONOMICAL_UNIT * aside, ahead))
    assert 0.0 < glare.max() < scatter_centre(replace(CLEAN, scatter=0.01))
    behind = expected_radiance(CLEAN, _deep_space(-ASTRONOMICAL_UNIT * ahead, ahead))
    assert behind.max() == 0.0


def test_the_earth_hides_the_sun_and_its_air_dims_it() -> None:
    """From full Sun to none within the 0.53 deg of the disc and the air above the limb, never growing."""
    distance = SEMI_MAJOR_AXIS + 600e3
    edge = np.arcsin(SEMI_MAJOR_AXIS / distance)
    shares = []
    for beyond in np.radians([3.0, 1.0, 0.5, 0.25, 0.0, -0.25, -0.3]):
        angle = edge + beyond
        sun = np.array([-np.cos(angle), np.sin(angle), 0.0])
        position = np.array([distance, 0.0, 0.0])
        scene = EarthScene(
            position, pointing(sun, np.array([-1.0, 0.0, 0.0])), position + ASTRONOMICAL_UNIT * sun
        )
        shares.append(visible_share(scene))
        assert sun_direction(scene) == pytest.approx([0.0, 0.0, 1.0], abs=1e-9)
    assert shares[0] == pytest.approx(1.0, abs=1e-6)
    assert shares[-1] == 0.0
    assert np.all(np.diff(shares) <= 0.0)
    assert 0.0 < shares[4] < 0.5


def test_a_sun_behind_the_earth_leaves_no_trace() -> None:
    position = np.array([SEMI_MAJOR_AXIS + 600e3, 0.0, 0.0])
    scene = EarthScene(
        position, pointing(np.array([-1.0, 0, 0]), np.array([0, 0, 1.0])), np.array([-1.5e11, 0, 0])
    )
    assert np.isfinite(sun_point(scene, CLEAN)).all()
    assert expected_radiance(replace(CLEAN, scatter=0.01), scene).max() < 1e-3


def test_part_of_a_disc_on_the_edge_is_part_of_the_disc_in_the_field() -> None:
    """The same Sun, half over the edge: the pixels that both have are the same."""
    wide = EarthCameraModel.fuga15d(scatter=0.0)
    narrow = EarthCameraModel(
        lens=replace(wide.lens.ideal, columns=256, focal_length=wide.lens.focal_length),
        columns=256,
        scatter=0.0,
    )
    # The narrow camera's last column is the wide one's middle; its axis lies 128 px further to the left.
    ahead = np.array([0.0, 0.0, 1.0])
    f = wide.lens.focal_length
    turned = np.array([128.0 / f, 0.0, 1.0])
    assert narrow.lens.project(turned[None])[0, 0] == pytest.approx(255.5)
    scene = _deep_space(ASTRONOMICAL_UNIT * ahead, ahead)
    camera = scene.camera_matrix
    inertial = camera.T @ (turned / np.linalg.norm(turned))
    light = expected_radiance(narrow, replace(scene, sun=scene.position + ASTRONOMICAL_UNIT * inertial))
    assert light[:, -1].max() > 1e4
    whole = expected_radiance(wide, replace(scene, sun=scene.position + ASTRONOMICAL_UNIT * inertial))
    assert light.sum() < 0.75 * whole.sum()


def test_logarithmic_and_linear_frames_saturate_in_the_core_and_nowhere_in_the_dark() -> None:
    generator = np.random.default_rng(8)
    for response in ("logarithmic", "linear"):
        model = EarthCameraModel.fuga15d(response=response, hot_pixels=0)
        scene = random_sun_scene(generator, model, margin=20.0)
        frame = render(model, scene, generator)
        x, y = np.rint(sun_point(scene, model)).astype(int)
        assert frame[y, x] >= model.highest_count - 5
        assert np.median(frame) < 150


@pytest.mark.parametrize("aside", [1e-3, 1e-6, 1e-9])
def test_a_sun_at_a_right_angle_to_the_boresight_leaves_no_disc(aside: float) -> None:
    """Its image through a lens that never folds lies farther away than any integer counts."""
    model = EarthCameraModel.fuga15d(scatter=0.0, k1=-0.05, k2=0.01)
    boresight = np.array([0.0, 1.0, 0.0])
    # The rim of 0.27 deg crosses the plane beyond which the lens sees nothing.
    for number in range(48):
        angle = number * (np.pi / 24.0)
        sun = np.array([np.sin(angle), aside, np.cos(angle)])
        image = np.zeros((model.rows, model.columns), dtype=np.float32)
        add_disc(_deep_space(ASTRONOMICAL_UNIT * sun, boresight), model, image)
        assert not image.any()
