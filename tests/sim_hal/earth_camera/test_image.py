"""Tests of frames of Earth and Sun: detector, noise, defects, the Sun's disc, and the limits of settings."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from hal.interfaces.errors import OutOfRange
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.figure import SEMI_MAJOR_AXIS
from knightcube.astro.earth.sun import ASTRONOMICAL_UNIT, SUN_RADIUS
from knightcube.vision.camera.lens import Pinhole
from sim_hal import earth_camera
from sim_hal.earth_camera import (
    EarthCameraModel,
    EarthScene,
    add_disc,
    counts,
    expected_radiance,
    pixel_rays,
    render,
    scatter_centre,
    spill,
    visible_share,
)
from tests.sim_hal.earth_camera.scenes import limb_scene, pointing, random_sun_scene
from tests.support.compiled_forms import assert_forms_agree
from tests.support.earth_truth import sun_direction, sun_point

LOGARITHMIC = EarthCameraModel.fuga15d(dead_pixels=0, hot_pixels=0, fixed_pattern=0.0)
LINEAR = EarthCameraModel.fuga15d(
    response="linear", dead_pixels=0, hot_pixels=0, fixed_pattern=0.0, response_spread=0.0
)


def _even(model: EarthCameraModel, radiance: float, seed: int = 1) -> np.ndarray:
    light = np.full((model.rows, model.columns), radiance, dtype=np.float32)
    return counts(model, light, np.random.default_rng(seed))


def test_counts_grow_with_the_light_over_six_decades_evenly_by_its_logarithm() -> None:
    light = LOGARITHMIC.darkest * 10.0 ** np.arange(0.0, 6.01, 0.25)
    mean = np.array([_even(LOGARITHMIC, value).mean() for value in light])
    assert np.all(np.diff(mean) > 0.0)
    steps = np.diff(mean[6:-1])  # steps above the knee of the response, which is at the dark current
    assert steps == pytest.approx(0.25 * (255 - 8) / 6.0, abs=0.5)
    assert mean[-1] == pytest.approx(255, abs=1.0)


def test_darkness_reads_the_pedestal_with_the_stated_noise() -> None:
    """A dark frame has the pedestal and the stated noise.

    Rounding adds 1/12 count^2 to the variance, which 262,144 pixels determine to within 0.3 %.
    """
    for model, sigma in ((LOGARITHMIC, 0.7), (LINEAR, 20.0 / 80.0)):
        fine = EarthCameraModel.fuga15d(
            response=model.response,
            bits=12,
            pedestal=200.0,
            noise=0.7 * 16,
            gain=80.0 / 16,
            dead_pixels=0,
            hot_pixels=0,
            fixed_pattern=0.0,
        )
        dark = _even(fine, 0.0)
        assert dark.dtype == np.uint16
        assert dark.mean() == pytest.approx(200.0, abs=0.1)
        assert dark.std() == pytest.approx(np.hypot(16 * sigma, 12**-0.5), rel=0.01)


def test_the_linear_cameras_noise_is_that_of_the_charge() -> None:
    """In a linear camera, the variance (e-^2) is the charge plus the squared read noise, to the full well."""
    model = EarthCameraModel.fuga15d(
        response="linear",
        bits=16,
        gain=1.0,
        dead_pixels=0,
        hot_pixels=0,
        fixed_pattern=0.0,
        response_spread=0.0,
    )
    frame = _even(model, 0.5)
    assert frame.mean() == pytest.approx(8.0 + 8000.0, rel=1e-3)
    assert frame.std() == pytest.approx(np.sqrt(8000.0 + 400.0), rel=0.01)
    full = _even(model, 50.0)
    assert full.mean() == pytest.approx(8.0 + 20_000.0, abs=0.5)
    assert full.std() == pytest.approx(20.0, rel=0.01)


def test_the_fixed_pattern_stays_from_frame_to_frame_and_goes_with_the_seed() -> None:
    model = EarthCameraModel.fuga15d(fixed_pattern=4.0, pedestal=60.0, seed=3)
    frames = [_even(model, 0.0, seed).astype(float) for seed in (1, 2)]
    noise = np.std(frames[0] - frames[1]) / np.sqrt(2.0)
    assert noise == pytest.approx(np.hypot(0.7, 12**-0.5), rel=0.05)
    assert np.corrcoef(frames[0].ravel(), frames[1].ravel())[0, 1] > 0.9
    other = _even(EarthCameraModel.fuga15d(fixed_pattern=4.0, pedestal=60.0, seed=4), 0.0).astype(float)
    assert abs(np.corrcoef(frames[0].ravel(), other.ravel())[0, 1]) < 0.1


def test_dead_pixels_read_zero_and_hot_ones_are_bright_whatever_the_light() -> None:
    model = EarthCameraModel.fuga15d(dead_pixels=25, hot_pixels=40, seed=9)
    dark, bright = _even(model, 0.0), _even(model, 1.0)
    dead, hot = bright == 0, dark >= int(0.3 * 255)
    assert np.sum(dead) == 25
    assert np.sum(hot) == 40
    assert np.all(dark[dead] == 0)
    assert np.all(bright[hot] >= int(0.3 * 255))


def test_blooming_fills_the_column_and_loses_no_charge_inside_it() -> None:
    charge = np.zeros((9, 3), dtype=np.float32)
    charge[4, 1] = 500.0
    charge[3, 1] = 30.0
    spill(charge, 100.0)
    assert charge[:, 1] == pytest.approx([0, 30, 100, 100, 100, 100, 100, 0, 0])
    assert charge[:, 1].sum() == pytest.approx(530.0)
    assert charge.max() <= 100.0
    assert charge[:, [0, 2]].sum() == 0.0
    with_it = EarthCameraModel.fuga15d(response="linear", blooming=True, hot_pixels=0, dead_pixels=0)
    light = np.zeros((512, 512), dtype=np.float32)
    light[200, 100] = 40.0
    assert np.sum(counts(with_it, light, np.random.default_rng(0)) > 200) > 25


def test_the_same_seeds_make_the_same_frame_and_others_another() -> None:
    model = EarthCameraModel.fuga15d(seed=2)
    scene = limb_scene(zenith=np.array([1.0, 0.2, 0.1]), sun=np.array([1.0, 0.0, 0.3]))
    frames = [render(model, scene, np.random.default_rng(seed)) for seed in (5, 5, 6)]
    assert frames[0].dtype == np.uint8
    assert frames[0].shape == (512, 512)
    assert np.array_equal(frames[0], frames[1])
    assert not np.array_equal(frames[0], frames[2])


@pytest.mark.parametrize("shape", [(40, 48), (37, 53), (3, 1)])
@pytest.mark.parametrize("blur", [0.0, 0.6, 2.0])
def test_the_loop_form_of_the_blur_equals_the_numpy_form(shape: tuple[int, int], blur: float) -> None:
    generator = np.random.default_rng(4)
    image = generator.uniform(0.0, 1.0, shape).astype(np.float32)
    bins = generator.uniform(0.0, 1.0, (-(-shape[0] // 8), -(-shape[1] // 8))).astype(np.float32)
    weights = earth_camera._blur_weights(blur)
    assert_forms_agree(earth_camera._spread, image, weights, 0.9, bins, relative=1e-5)
    expected = 0.9 * gaussian_filter(image.astype(float), max(blur, 1e-9), mode="nearest", truncate=4.0)
    found = earth_camera._spread.numpy_form(image, weights, 0.9, np.zeros_like(bins))
    np.testing.assert_allclose(found, expected, atol=1e-6)


@pytest.mark.parametrize(("field_deg", "k1"), [(92.0, 0.0), (67.0, -0.12), (20.0, -0.12)])
def test_rays_within_pixels_have_the_stated_error(field_deg: float, k1: float) -> None:
    model = EarthCameraModel.fuga15d(field_of_view=math.radians(field_deg), k1=k1)
    rays = np.ascontiguousarray(pixel_rays(model.lens).T, dtype=np.float32)
    edges = [0, 511, 512 * 512 - 1, 512 * 300, 512 * 301 - 1]
    pixels = np.concatenate([edges, np.random.default_rng(2).integers(0, 512 * 512, 2000)])
    found = earth_camera._rays_within(rays, pixels, 512)
    centres = np.stack([pixels % 512, pixels // 512], axis=1)
    exact = np.concatenate([model.lens.unit_vectors(centres + offset) for offset in earth_camera._WITHIN])
    apart = np.linalg.norm(found.T - exact, axis=1)
    assert apart.max() < 0.3 / model.lens.focal_length**2 + 2e-7


def test_the_loop_form_of_the_glare_equals_the_numpy_form() -> None:
    rays = np.ascontiguousarray(pixel_rays(Pinhole.from_field_of_view(40, 30, 1.0)).T, dtype=np.float32)
    axis = np.array([0.1, -0.2, 0.97])
    light = np.random.default_rng(5).uniform(0.0, 1.0, 1200).astype(np.float32)
    assert_forms_agree(earth_camera._add_halo, rays, axis, 3.0, 1e4, light, relative=1e-5)


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


def test_the_irradiance_of_the_sun_is_pi_in_these_units() -> None:
    """The irradiance of a matt white surface of radiance one is pi, whatever the size of the disc in px."""
    sun = ASTRONOMICAL_UNIT * np.array([0.1, 0.05, 1.0]) / np.linalg.norm([0.1, 0.05, 1.0])
    scene = _deep_space(sun, np.array([0.0, 0.0, 1.0]))
    for model in (CLEAN, EarthCameraModel.fuga15d(scatter=0.0, field_of_view=np.radians(20.0))):
        light = expected_radiance(model, scene)
        cosine = pixel_rays(model.lens)[:, 2].reshape(light.shape)
        irradiance = np.sum(light * cosine**3) / model.lens.focal_length**2
        assert irradiance == pytest.approx(np.pi, rel=0.01)


def test_the_discs_radius_is_the_suns() -> None:
    """In a narrow camera, the brightness falls to half at the edge of the Sun's disc."""
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
    # Fraction, between 3 deg and the inscribed circle of 60 deg, of the logarithmic integral of the
    # scattering law.
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
    """The Earth hides the Sun, and its atmosphere dims the Sun above the limb.

    The brightness falls to zero within the disc's 0.53 deg and the atmosphere above the limb.
    """
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
    """If half of the Sun is beyond the edge, the common pixels of a narrow and a wide image are equal."""
    wide = EarthCameraModel.fuga15d(scatter=0.0)
    narrow = EarthCameraModel(
        lens=replace(wide.lens.ideal, columns=256, focal_length=wide.lens.focal_length),
        columns=256,
        scatter=0.0,
    )
    # The last column of the narrow camera is the central column of the wide camera, whose optical axis is 128
    # px away.
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
    """A Sun at 90 deg from the boresight gives no disc in the image.

    Without lens distortion, the coordinates of the Sun's image exceed the range of integers.
    """
    model = EarthCameraModel.fuga15d(scatter=0.0, k1=-0.05, k2=0.01)
    boresight = np.array([0.0, 1.0, 0.0])
    # The Sun's disc, with a radius of 0.27 deg, crosses the plane beyond which the lens has no image.
    for number in range(48):
        angle = number * (np.pi / 24.0)
        sun = np.array([np.sin(angle), aside, np.cos(angle)])
        image = np.zeros((model.rows, model.columns), dtype=np.float32)
        add_disc(_deep_space(ASTRONOMICAL_UNIT * sun, boresight), model, image)
        assert not image.any()


DEFAULTS = {
    "rows": 512, "columns": 512, "bits": 8, "response": "logarithmic", "decades": 6.0, "darkest": 0.01,
    "sensitivity": 16_000.0, "full_well": 20_000.0, "gain": 80.0, "read_noise": 20.0, "blooming": False,
    "pedestal": 8.0, "noise": 0.7, "fixed_pattern": 1.0, "response_spread": 0.01, "dead_pixels": 10,
    "hot_pixels": 10, "seed": 0, "blur": 0.6, "scatter": 0.01, "scatter_angle": math.radians(0.5),
}  # fmt: skip
RANGES = {
    "bits": (1, 16), "decades": (0.1, 12.0), "darkest": (1e-6, 1e3), "sensitivity": (1e-3, 1e12),
    "full_well": (1.0, 1e9), "gain": (1e-3, 1e5), "read_noise": (0.0, 1e5),
    "noise": (0.0, 1e4), "fixed_pattern": (0.0, 1e4), "response_spread": (0.0, 1.0),
    "dead_pixels": (0, 1 << 20), "hot_pixels": (0, 1 << 20), "blur": (0.0, 10.0), "scatter": (0.0, 0.5),
    "scatter_angle": (1e-4, 0.5),
}  # fmt: skip


def made(**changes: Any) -> EarthCameraModel:
    """Return a camera model with a pinhole lens whose image size is that of the model."""
    size = changes.get("columns", 512), changes.get("rows", 512)
    return EarthCameraModel(lens=Pinhole.from_field_of_view(*size, 1.0), **changes)


def test_the_defaults_are_those_of_the_design() -> None:
    model = made()
    found = {field.name: getattr(model, field.name) for field in fields(model) if field.name in DEFAULTS}
    assert found == DEFAULTS


@pytest.mark.parametrize("name", RANGES)
def test_a_value_may_lie_at_both_ends_of_its_range_and_not_beyond(name: str) -> None:
    low, high = RANGES[name]
    step = 1 if isinstance(low, int) else 1e-9
    others: dict[str, Any] = {"bits": {"pedestal": 0.0}}.get(name, {})
    if name.endswith("_pixels"):
        others = {"rows": 2048, "columns": 2048}
    for value, beyond in ((low, low - step), (high, high + step * max(1, high))):
        assert getattr(made(**others, **{name: value}), name) == value
        with pytest.raises(OutOfRange):
            made(**others, **{name: beyond})


def test_the_pedestal_leaves_a_count_for_the_light() -> None:
    for pedestal in (0.0, 254.0):
        assert made(pedestal=pedestal).pedestal == pedestal
    for pedestal in (-1e-9, 255.0):
        with pytest.raises(OutOfRange):
            made(pedestal=pedestal)
