"""Tests of the Earth camera's scene: terminator, night, atmosphere, texture, geometry of limb and nadir."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.ndimage import map_coordinates

from hal.interfaces.errors import OutOfRange
from knightcube.astro import quaternion
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.figure import SEMI_MAJOR_AXIS, SEMI_MINOR_AXIS, semi_axes
from knightcube.astro.earth.sun import ASTRONOMICAL_UNIT
from sim_hal.earth_camera import (
    EarthCameraModel,
    EarthScene,
    expected_radiance,
    look,
    nadir,
    pixel_rays,
)
from sim_hal.earth_light import (
    CLOUD,
    CLOUD_SHARE,
    LAND_SHARE,
    OCEAN,
    TOP,
    Atmosphere,
    albedo,
    map_noise,
    near_earth,
)
from tests.sim_hal.earth_camera.scenes import limb_scene, pointing, random_direction, random_scene
from tests.support.earth_truth import APPARENT_LIMB_HEIGHT, limb_directions, limb_truth

QUIET = EarthCameraModel.fuga15d(scatter=0.0)
AIR = Atmosphere()


def _nadir_scene(sun: FloatArray, altitude: float = 800e3) -> EarthScene:
    """Return a camera over latitude 0, longitude 0 that points straight down, with the pole to the right."""
    x = np.array([1.0, 0.0, 0.0])
    attitude = pointing(-x, np.array([0.0, -1.0, 0.0]))
    return EarthScene((SEMI_MAJOR_AXIS + altitude) * x, attitude, ASTRONOMICAL_UNIT * sun)


def _solar_cosines(scene: EarthScene) -> FloatArray:
    """Return the cosine (rows, columns) of the Sun's zenith distance on a spherical Earth, NaN elsewhere."""
    sight = look(scene, pixel_rays(QUIET.lens))
    places = np.where(sight.hits[:, None], sight.places, np.nan)
    places /= np.linalg.norm(places, axis=1, keepdims=True)
    sun = scene.in_earth(scene.sun / np.linalg.norm(scene.sun))
    return np.asarray((places @ sun).reshape(QUIET.rows, QUIET.columns))


@pytest.mark.parametrize("seed", range(4))
def test_intersections_of_coarse_rays_have_the_stated_errors(seed: int) -> None:
    """With 32-bit rays, all heights have errors below 2 m, and 99.9 % of the places below 20 m."""
    scene = random_scene(np.random.default_rng(seed), QUIET)
    rays = pixel_rays(QUIET.lens)
    exact, coarse = look(scene, rays), look(scene, rays.astype(np.float32, order="F"))
    assert coarse.places.dtype == np.float32
    assert np.mean(exact.hits != coarse.hits) < 1e-4
    seen = (exact.heights < TOP) & (coarse.heights < TOP)
    assert np.abs(exact.heights[seen] - coarse.heights[seen]).max() < 2.0
    apart = np.linalg.norm((exact.places - coarse.places)[seen] * semi_axes(), axis=1)
    assert np.quantile(apart, 0.999) < 20.0


def test_the_limb_depth_and_the_zenith_depth_are_integrals_of_exponential_air() -> None:
    """The optical depths at limb and zenith are integrals of an exponential atmosphere.

    The reference is a quadrature along the curved lines of sight.
    """

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
    """The terminator is the line on which the Sun is on the horizon.

    The day side is brighter than a tenth of the sea below the Sun, and the night side is darker than a
    hundredth of it.
    """
    scene = _nadir_scene(np.array([0.0, 1.0, 0.0]), 2000e3)
    light, cosine = expected_radiance(QUIET, scene), _solar_cosines(scene)
    noon = OCEAN * np.exp(-2.0 * AIR.optical_depth)
    assert light[cosine > 0.15].min() > 0.1 * noon
    assert light[cosine < -0.1].max() < 0.01 * noon
    # Across the terminator, the brightness decreases monotonically within the width of twilight.
    rows = [light[np.abs(cosine - c) < 0.01].mean() for c in (0.15, 0.1, 0.05, 0.0, -0.05, -0.1)]
    assert np.all(np.diff(rows) < 0.0)


def test_the_night_side_is_dark_and_its_limb_too() -> None:
    scene = random_scene(np.random.default_rng(5), QUIET, "dark")
    light = expected_radiance(QUIET, scene)
    truth = limb_truth(scene, QUIET)
    x, y = np.rint(truth.points[truth.solar_cosines < -0.25]).astype(int).T
    assert np.all(light[np.clip(y, 0, 511), np.clip(x, 0, 511)] == 0.0)


def test_brightness_under_the_sun_is_that_of_matt_ground_seen_through_air() -> None:
    """Below the Sun, the brightness is between the brightness of sea and of clouds, plus scattered light.

    The atmosphere dims the light of sea and clouds twice.
    """
    light = expected_radiance(QUIET, _nadir_scene(np.array([1.0, 0.0, 0.0])))[206:306, 206:306]
    dimmed = np.exp(-2.0 * AIR.optical_depth)
    haze = 1.5 * 0.375 * (1.0 - np.exp(-AIR.optical_depth))
    # In the image, Sun and camera are up to 9 deg from the zenith.
    assert 0.96 * OCEAN * dimmed + 0.9 * haze < light.min()
    assert light.max() < CLOUD * dimmed + 1.02 * haze


def test_a_farther_sun_lights_less_by_the_square() -> None:
    near = _nadir_scene(np.array([1.0, 0.2, 0.0]))
    far = EarthScene(near.position, near.attitude, 1.1 * near.sun)
    ratio = expected_radiance(QUIET, far)[250, 250] / expected_radiance(QUIET, near)[250, 250]
    assert ratio == pytest.approx(1.1**-2, rel=1e-3)


def test_land_and_cloud_cover_their_shares_and_come_from_the_seed_alone() -> None:
    generator = np.random.default_rng(6)
    directions = generator.standard_normal((200_000, 3)).astype(np.float32)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    covered, sea = [], []
    for seed in range(6):
        ground = albedo(directions.T, map_noise(seed))
        assert ground.min() >= OCEAN - 1e-6
        assert ground.max() <= CLOUD + 1e-6
        covered.append(np.mean(ground > 0.6))
        sea.append(np.mean(ground < OCEAN + 0.01))
    # A globe has few continents, so the fraction of land varies with the seed.
    assert np.mean(covered) == pytest.approx(CLOUD_SHARE, abs=0.12)
    assert np.mean(sea) == pytest.approx((1.0 - CLOUD_SHARE) * (1.0 - LAND_SHARE), abs=0.12)
    few = directions[:100].T
    assert np.array_equal(albedo(few, map_noise(3)), albedo(few, map_noise(3)))
    assert not np.array_equal(albedo(few, map_noise(3)), albedo(few, map_noise(4)))


def test_the_ground_turns_with_the_earth() -> None:
    still = _nadir_scene(np.array([1.0, 0.0, 0.0]))
    turned = EarthScene(still.position, still.attitude, still.sun, rotation=1.0)
    first, second = expected_radiance(QUIET, still), expected_radiance(QUIET, turned)
    assert np.mean(np.abs(first - second) > 0.05) > 0.1


SUN = np.array([1.496e11, 0.0, 0.0])
NOISELESS = EarthCameraModel.fuga15d(scatter=0.0, blur=0.0)


def _angles_from_nadir(scene: EarthScene, directions: FloatArray) -> FloatArray:
    return np.arccos(directions @ nadir(scene))


def test_over_the_pole_the_limb_is_a_circle_whose_angle_is_that_of_the_meridian_ellipse() -> None:
    """Over the pole, the limb is a circle with the angle of the meridian ellipse.

    A line from the height z on the axis touches x^2/a^2 + y^2/b^2 = 1 at the slope a^2/(z^2 - b^2) = tan^2.
    """
    distance = SEMI_MINOR_AXIS + 600e3
    scene = EarthScene(np.array([0.0, 0.0, distance]), quaternion.IDENTITY, SUN)
    directions, _ = limb_directions(scene)
    expected = np.arctan(SEMI_MAJOR_AXIS / np.sqrt(distance**2 - SEMI_MINOR_AXIS**2))
    assert _angles_from_nadir(scene, directions) == pytest.approx(expected, abs=1e-12)


def test_over_the_equator_the_limb_is_nearer_to_nadir_towards_the_poles() -> None:
    """Over the equator, the angle from nadir to the limb is asin(a/r) along the equator.

    Towards the poles the angle is smaller, atan(b/sqrt(r^2 - a^2)).
    """
    distance = SEMI_MAJOR_AXIS + 500e3
    scene = EarthScene(np.array([distance, 0.0, 0.0]), quaternion.IDENTITY, SUN)
    directions, _ = limb_directions(scene, 4)
    angles = np.sort(_angles_from_nadir(scene, directions))
    assert angles[2:] == pytest.approx(np.arcsin(SEMI_MAJOR_AXIS / distance), abs=1e-12)
    towards_poles = np.arctan(SEMI_MINOR_AXIS / np.sqrt(distance**2 - SEMI_MAJOR_AXIS**2))
    assert angles[:2] == pytest.approx(towards_poles, abs=1e-12)
    # A spherical Earth model has an error of more than 0.06 deg, three times the accuracy that a nadir sensor
    # must have.
    assert np.degrees(angles[3] - angles[0]) > 0.06


@pytest.mark.parametrize("height", [0.0, APPARENT_LIMB_HEIGHT])
def test_every_limb_direction_lies_on_the_tangent_cone(height: float) -> None:
    """For any attitude, each limb direction d satisfies (d' M p)^2 = (d' M d)(p' M p - 1).

    The matrix is M = diag(1/a^2, 1/a^2, 1/b^2).
    """
    generator = np.random.default_rng(1)
    for _ in range(5):
        scene = random_scene(generator, NOISELESS)
        directions, _ = limb_directions(scene, 100, height)
        inertial = directions @ scene.camera_matrix
        form = np.diag(semi_axes(height) ** -2)
        p = scene.position
        left = (inertial @ form @ p) ** 2
        right = np.einsum("ij,jk,ik->i", inertial, form, inertial) * (p @ form @ p - 1.0)
        assert left == pytest.approx(right, rel=1e-9, abs=0.0)


def test_lines_just_inside_the_limb_hit_the_ellipsoid_and_lines_just_outside_pass_at_their_height() -> None:
    generator = np.random.default_rng(2)
    scene = random_scene(generator, NOISELESS)
    grazing, _ = limb_directions(scene, 90)
    above, _ = limb_directions(scene, 90, 10_000.0)
    down = nadir(scene)
    inside = look(scene, grazing + 1e-6 * down)
    outside = look(scene, grazing - 1e-6 * down)
    assert np.all(inside.hits)
    assert not np.any(outside.hits)
    assert look(scene, above).heights == pytest.approx(10_000.0, abs=1.0)
    upward = look(scene, -grazing)
    assert not np.any(upward.hits)
    assert np.all(np.isinf(upward.heights))


def test_the_intersection_is_on_the_ellipsoid_and_on_the_line() -> None:
    generator = np.random.default_rng(3)
    scene = random_scene(generator, NOISELESS)
    rays = nadir(scene) + 0.1 * np.array([random_direction(generator) for _ in range(50)])
    sight = look(scene, rays)
    places = sight.places * semi_axes() @ scene.earth_matrix
    form = semi_axes() ** -2
    assert np.sum(places**2 * form, axis=1) == pytest.approx(1.0, abs=1e-9)
    towards = (places - scene.position) @ scene.camera_matrix.T
    crossed = np.cross(towards, rays) / np.linalg.norm(towards, axis=1, keepdims=True)
    assert np.abs(crossed).max() < 1e-9
    # The first of the two intersections is on the side of the camera.
    assert np.all(places @ scene.position > 0.0)


def test_the_sunlit_limb_has_half_its_brightness_at_the_published_height() -> None:
    """At the published height, the sunlit limb has half the brightness of the ground's tangent point.

    The brightness is compared along an image column.
    """
    scene = limb_scene(600e3, zenith=np.array([0.3, 0.2, 0.9]), sun=np.array([0.5, 0.2, 0.8]))
    narrow = EarthCameraModel.fuga15d(scatter=0.0, blur=0.0, field_of_view=np.radians(8.0))
    light = expected_radiance(narrow, scene)
    heights = look(scene, pixel_rays(narrow.lens)).heights.reshape(light.shape)
    points = limb_truth(scene, narrow, count=20_000).points
    for column in (20, 256, 490):
        row = np.interp(column, *points[np.argsort(points[:, 0])].T)
        profile = light[:, column]
        ground = int(np.argmax(heights[:, column] == 0.0))
        above = np.arange(ground - 100, ground)
        crossing = np.interp(0.5 * profile[ground - 1], profile[above], above)
        assert crossing == pytest.approx(row, abs=0.4)  # 0.4 px are 0.3 km


def test_distortion_moves_the_limb_as_the_lens_says() -> None:
    scene = limb_scene(zenith=np.array([1.0, 0.1, 0.1]), sun=np.array([1.0, 0.0, 0.0]), dip=0.2)
    bent = EarthCameraModel.fuga15d(k1=-0.15, scatter=0.0, blur=0.0)
    directions = limb_truth(scene, NOISELESS).directions
    straight, moved = NOISELESS.lens.project(directions), bent.lens.project(directions)
    inner = NOISELESS.lens.contains(straight, -2.0) & bent.lens.contains(moved, -2.0)
    straight, moved = straight[inner], moved[inner]
    assert np.linalg.norm(moved - straight, axis=1).max() > 10.0
    seen, expected = (
        map_coordinates(expected_radiance(model, scene), points.T[::-1], order=1)
        for model, points in ((bent, moved), (NOISELESS, straight))
    )
    # Over a tenth of a pixel, the brightness at the apparent limb changes by a tenth.
    assert seen == pytest.approx(expected, rel=0.1)


def test_a_tilted_pole_carries_the_flattening_with_it() -> None:
    """If the pole is tilted, the flattening is tilted with it.

    With the pole towards the camera, the limb is a circle. With the default pole, the limb is not a circle.
    """
    position = np.array([SEMI_MAJOR_AXIS + 400e3, 0.0, 0.0])
    upright = EarthScene(position, quaternion.IDENTITY, SUN)
    lying = replace(upright, pole=np.array([1.0, 0.0, 0.0]), rotation=0.7)
    assert np.ptp(_angles_from_nadir(upright, limb_directions(upright)[0])) > 1e-3
    assert np.ptp(_angles_from_nadir(lying, limb_directions(lying)[0])) < 1e-9
    assert lying.earth_matrix @ lying.earth_matrix.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(lying.earth_matrix) == pytest.approx(1.0)


def test_a_camera_inside_the_earth_and_values_that_are_not_finite_are_refused() -> None:
    with pytest.raises(OutOfRange, match="Earth radii"):
        EarthScene(np.array([6e6, 0.0, 0.0]), quaternion.IDENTITY, SUN)
    with pytest.raises(ValueError, match="finite"):
        EarthScene(np.array([7e6, np.nan, 0.0]), quaternion.IDENTITY, SUN)
    with pytest.raises(OutOfRange, match="length of attitude"):
        EarthScene(np.array([7e6, 0.0, 0.0]), np.ones(4), SUN)
    with pytest.raises(ValueError, match="lens"):
        EarthCameraModel(lens=NOISELESS.lens, rows=100)
    with pytest.raises(OutOfRange, match="decades"):
        EarthCameraModel.fuga15d(decades=0.0)


@pytest.mark.parametrize("altitude", [1e3, 110e3, 500e3, 36e6])
def test_no_ray_below_the_top_of_the_air_is_left_out(altitude: float) -> None:
    """No ray below the top of the atmosphere is omitted.

    The rays are in all directions, and many are within a tenth of a degree of the top of the atmosphere.
    """
    generator = np.random.default_rng(8)
    for _ in range(5):
        zenith = random_direction(generator)
        attitude = pointing(random_direction(generator), random_direction(generator))
        scene = EarthScene((SEMI_MAJOR_AXIS + altitude) * zenith, attitude, ASTRONOMICAL_UNIT * zenith)
        rays = generator.standard_normal((20_000, 3))
        heights = np.asarray(look(scene, rays).heights)
        edge = rays[np.isfinite(heights)][np.argsort(np.abs(heights[np.isfinite(heights)] - TOP))[:200]]
        rays = np.concatenate(
            [rays, np.repeat(edge, 20, axis=0) + 1e-3 * generator.standard_normal((4000, 3))]
        )
        near = near_earth(rays.T.astype(np.float32), *scene.on_unit_sphere())
        below = np.flatnonzero(look(scene, rays).heights < TOP)
        assert len(below) > 20
        assert np.isin(below, near).all()
        if altitude > 200e3:
            assert len(near) < 1.2 * len(below), "the choice saves no time"
