"""Day, terminator, night, air and texture, against what the Sun's direction and the albedos alone say."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.figure import SEMI_MAJOR_AXIS
from knightcube.astro.earth.sun import ASTRONOMICAL_UNIT
from sim_hal.earth_camera import APPARENT_LIMB_HEIGHT, Atmosphere, EarthCameraModel, EarthScene, limb_truth
from sim_hal.earth_camera.image import expected_radiance
from sim_hal.earth_camera.model import pixel_rays
from sim_hal.earth_camera.radiance import CLOUD, CLOUD_SHARE, LAND_SHARE, OCEAN, albedo, look
from tests.sim_hal.earth_camera.scenes import limb_scene, pointing, random_scene

QUIET = EarthCameraModel.fuga15d(scatter=0.0)
AIR = Atmosphere()


def _nadir_scene(sun: FloatArray, altitude: float = 800e3) -> EarthScene:
    """Return a camera over latitude 0, longitude 0 that looks straight down, the pole to its right."""
    x = np.array([1.0, 0.0, 0.0])
    attitude = pointing(-x, np.array([0.0, -1.0, 0.0]))
    return EarthScene((SEMI_MAJOR_AXIS + altitude) * x, attitude, ASTRONOMICAL_UNIT * sun)


def _solar_cosines(scene: EarthScene) -> FloatArray:
    """Return the cosine (rows, columns) of the Sun from the zenith, of a round Earth; NaN off it."""
    sight = look(scene, pixel_rays(QUIET.lens))
    places = np.where(sight.hits[:, None], sight.places, np.nan)
    places /= np.linalg.norm(places, axis=1, keepdims=True)
    sun = scene.in_earth(scene.sun / np.linalg.norm(scene.sun))
    return np.asarray((places @ sun).reshape(QUIET.rows, QUIET.columns))


def test_the_limb_depth_and_the_zenith_depth_are_integrals_of_exponential_air() -> None:
    """By quadrature along the lines themselves, round the Earth's curve."""

    def through(tangent: float) -> float:
        def density(s: float) -> float:
            return float(np.exp(-(np.hypot(tangent, s) - SEMI_MAJOR_AXIS) / AIR.scale_height))

        return 2.0 * float(quad(density, 0.0, 1.5e6, epsabs=1.0)[0]) * AIR.optical_depth / AIR.scale_height

    heights = np.array([0.0, 10e3, 30e3])
    for height in heights:
        depth = AIR.tangent_depth(np.array([height], dtype=np.float32))[0]
        assert depth == pytest.approx(through(SEMI_MAJOR_AXIS + height), rel=5e-3)

    def slant(cosine: float) -> float:
        def density(s: float) -> float:
            r = np.sqrt(SEMI_MAJOR_AXIS**2 + s**2 + 2.0 * SEMI_MAJOR_AXIS * s * cosine)
            return float(np.exp(-(r - SEMI_MAJOR_AXIS) / AIR.scale_height))

        metres = float(quad(density, 0.0, 3e6, points=[1e5, 1e6], epsabs=1.0)[0])
        return metres * AIR.optical_depth / AIR.scale_height

    for cosine, tolerance in ((1.0, 0.01), (0.5, 0.01), (0.1, 0.01), (0.0, 0.01), (-0.05, 0.03)):
        depth = AIR.slant_depth(np.array([cosine], dtype=np.float32))[0]
        assert depth == pytest.approx(slant(cosine), rel=tolerance)


def test_the_published_limb_height_is_where_half_the_light_is_scattered() -> None:
    depth = AIR.tangent_depth(np.array([APPARENT_LIMB_HEIGHT], dtype=np.float32))[0]
    assert np.exp(-depth) == pytest.approx(0.5, abs=1e-6)
    assert pytest.approx(18.4e3, abs=100.0) == APPARENT_LIMB_HEIGHT


def test_light_above_the_limb_falls_by_e_for_each_scale_height() -> None:
    scene = limb_scene(300e3, zenith=np.array([0.9, 0.1, 0.4]), sun=np.array([1.0, 0.0, 0.0]))
    light = expected_radiance(EarthCameraModel.fuga15d(scatter=0.0, blur=0.0), scene)[:, 256]
    heights = look(scene, pixel_rays(QUIET.lens)).heights.reshape(512, 512)[:, 256]
    air = np.flatnonzero((heights > 40e3) & (heights < 80e3))
    slope = np.polyfit(heights[air], np.log(light[air]), 1)[0]
    assert -1.0 / slope == pytest.approx(AIR.scale_height, rel=0.03)


def test_the_terminator_lies_where_the_sun_is_on_the_horizon() -> None:
    """Day brighter than a tenth of the subsolar sea's, night darker than a hundredth, from a known Sun."""
    scene = _nadir_scene(np.array([0.0, 1.0, 0.0]), 2000e3)
    light, cosine = expected_radiance(QUIET, scene), _solar_cosines(scene)
    noon = OCEAN * np.exp(-2.0 * AIR.optical_depth)
    assert light[cosine > 0.15].min() > 0.1 * noon
    assert light[cosine < -0.1].max() < 0.01 * noon
    # And the light across it falls all the way, over the width of twilight.
    rows = [light[np.abs(cosine - c) < 0.01].mean() for c in (0.15, 0.1, 0.05, 0.0, -0.05, -0.1)]
    assert np.all(np.diff(rows) < 0.0)


def test_the_night_side_is_dark_and_its_limb_too() -> None:
    scene = random_scene(np.random.default_rng(5), QUIET, "dark")
    light = expected_radiance(QUIET, scene)
    truth = limb_truth(scene, QUIET)
    x, y = np.rint(truth.points[truth.solar_cosines < -0.25]).astype(int).T
    assert np.all(light[np.clip(y, 0, 511), np.clip(x, 0, 511)] == 0.0)


def test_brightness_under_the_sun_is_that_of_matt_ground_seen_through_air() -> None:
    """Between the sea's and the clouds', each dimmed twice by the air, plus the air's own light."""
    light = expected_radiance(QUIET, _nadir_scene(np.array([1.0, 0.0, 0.0])))[206:306, 206:306]
    dimmed = np.exp(-2.0 * AIR.optical_depth)
    haze = 1.5 * 0.375 * (1.0 - np.exp(-AIR.optical_depth))
    # The camera looks down as far as 9 deg from the zenith; the Sun is as far there.
    assert 0.96 * OCEAN * dimmed + 0.9 * haze < light.min()
    assert light.max() < CLOUD * dimmed + 1.02 * haze


def test_a_farther_sun_lights_less_by_the_square() -> None:
    near = _nadir_scene(np.array([1.0, 0.2, 0.0]))
    far = EarthScene(near.position, near.attitude, 1.1 * near.sun)
    ratio = expected_radiance(QUIET, far)[250, 250] / expected_radiance(QUIET, near)[250, 250]
    assert ratio == pytest.approx(1.1**-2, rel=1e-3)


def test_land_and_cloud_cover_their_shares_and_come_from_the_seed_alone() -> None:
    generator = np.random.default_rng(6)
    directions = generator.standard_normal((200_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    covered, sea = [], []
    for seed in range(6):
        ground = albedo(directions, seed)
        assert ground.min() >= OCEAN - 1e-6
        assert ground.max() <= CLOUD + 1e-6
        covered.append(np.mean(ground > 0.6))
        sea.append(np.mean(ground < OCEAN + 0.01))
    # Few continents a globe: shares scatter from seed to seed.
    assert np.mean(covered) == pytest.approx(CLOUD_SHARE, abs=0.12)
    assert np.mean(sea) == pytest.approx((1.0 - CLOUD_SHARE) * (1.0 - LAND_SHARE), abs=0.12)
    assert np.array_equal(albedo(directions[:100], 3), albedo(directions[:100], 3))
    assert not np.array_equal(albedo(directions[:100], 3), albedo(directions[:100], 4))


def test_the_ground_turns_with_the_earth() -> None:
    still = _nadir_scene(np.array([1.0, 0.0, 0.0]))
    turned = EarthScene(still.position, still.attitude, still.sun, rotation=1.0)
    first, second = expected_radiance(QUIET, still), expected_radiance(QUIET, turned)
    assert np.mean(np.abs(first - second) > 0.05) > 0.1
