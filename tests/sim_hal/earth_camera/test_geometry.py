"""Where limb, ground and nadir fall, against spheres, tangent cones and the ellipsoid's own equation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from hal.interfaces.errors import OutOfRange
from knightcube.astro import quaternion
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.figure import SEMI_MAJOR_AXIS, SEMI_MINOR_AXIS, semi_axes
from sim_hal.earth_camera import APPARENT_LIMB_HEIGHT, EarthCameraModel, EarthScene, limb_truth, nadir
from sim_hal.earth_camera.image import expected_radiance
from sim_hal.earth_camera.model import pixel_rays
from sim_hal.earth_camera.radiance import look
from sim_hal.earth_camera.truth import limb_directions
from tests.sim_hal.earth_camera.scenes import limb_scene, random_direction, random_scene

SUN = np.array([1.496e11, 0.0, 0.0])
QUIET = EarthCameraModel.fuga15d(scatter=0.0, blur=0.0)


def _angles_from_nadir(scene: EarthScene, directions: FloatArray) -> FloatArray:
    return np.arccos(directions @ nadir(scene))


def test_over_the_pole_the_limb_is_a_circle_whose_angle_is_that_of_the_meridian_ellipse() -> None:
    """A line from height z on the axis touches x^2/a^2 + y^2/b^2 = 1 at slope a^2/(z^2 - b^2) = tan^2."""
    distance = SEMI_MINOR_AXIS + 600e3
    scene = EarthScene(np.array([0.0, 0.0, distance]), quaternion.IDENTITY, SUN)
    directions, _ = limb_directions(scene)
    expected = np.arctan(SEMI_MAJOR_AXIS / np.sqrt(distance**2 - SEMI_MINOR_AXIS**2))
    assert _angles_from_nadir(scene, directions) == pytest.approx(expected, abs=1e-12)


def test_over_the_equator_the_limb_is_nearer_to_nadir_towards_the_poles() -> None:
    """Along the equator asin(a/r), as of a sphere; towards the poles atan(b/sqrt(r^2 - a^2))."""
    distance = SEMI_MAJOR_AXIS + 500e3
    scene = EarthScene(np.array([distance, 0.0, 0.0]), quaternion.IDENTITY, SUN)
    directions, _ = limb_directions(scene, 4)
    angles = np.sort(_angles_from_nadir(scene, directions))
    assert angles[2:] == pytest.approx(np.arcsin(SEMI_MAJOR_AXIS / distance), abs=1e-12)
    towards_poles = np.arctan(SEMI_MINOR_AXIS / np.sqrt(distance**2 - SEMI_MAJOR_AXIS**2))
    assert angles[:2] == pytest.approx(towards_poles, abs=1e-12)
    # The error of a sphere is three times a nadir sensor's required accuracy.
    assert np.degrees(angles[3] - angles[0]) > 0.06


@pytest.mark.parametrize("height", [0.0, APPARENT_LIMB_HEIGHT])
def test_every_limb_direction_lies_on_the_tangent_cone(height: float) -> None:
    """(d' M p)^2 = (d' M d)(p' M p - 1) with M = diag(1/a^2, 1/a^2, 1/b^2), whatever the attitude."""
    generator = np.random.default_rng(1)
    for _ in range(5):
        scene = random_scene(generator, QUIET)
        directions, _ = limb_directions(scene, 100, height)
        inertial = directions @ scene.camera_matrix
        form = np.diag(semi_axes(height) ** -2)
        p = scene.position
        left = (inertial @ form @ p) ** 2
        right = np.einsum("ij,jk,ik->i", inertial, form, inertial) * (p @ form @ p - 1.0)
        assert left == pytest.approx(right, rel=1e-9)


def test_lines_just_inside_the_limb_hit_the_ellipsoid_and_lines_just_outside_pass_at_their_height() -> None:
    generator = np.random.default_rng(2)
    scene = random_scene(generator, QUIET)
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


def test_where_a_line_hits_lies_on_the_ellipsoid_and_on_the_line() -> None:
    generator = np.random.default_rng(3)
    scene = random_scene(generator, QUIET)
    rays = nadir(scene) + 0.1 * np.array([random_direction(generator) for _ in range(50)])
    sight = look(scene, rays)
    places = sight.places * semi_axes() @ scene.earth_matrix
    form = semi_axes() ** -2
    assert np.sum(places**2 * form, axis=1) == pytest.approx(1.0, abs=1e-9)
    towards = (places - scene.position) @ scene.camera_matrix.T
    crossed = np.cross(towards, rays) / np.linalg.norm(towards, axis=1, keepdims=True)
    assert np.abs(crossed).max() < 1e-9
    # The first of the two meetings, on the camera's side.
    assert np.all(places @ scene.position > 0.0)


def test_the_sunlit_limb_has_half_its_brightness_at_the_published_height() -> None:
    """Down a column, light reaches half of what it has where the line of sight touches the ground."""
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
        assert crossing == pytest.approx(row, abs=0.4)  # 0.3 km


def test_distortion_moves_the_limb_as_the_lens_says() -> None:
    scene = limb_scene(zenith=np.array([1.0, 0.1, 0.1]), sun=np.array([1.0, 0.0, 0.0]), dip=0.2)
    bent = EarthCameraModel.fuga15d(k1=-0.15, scatter=0.0, blur=0.0)
    directions = limb_truth(scene, QUIET).directions
    straight, moved = QUIET.lens.project(directions), bent.lens.project(directions)
    inner = QUIET.lens.contains(straight, -2.0) & bent.lens.contains(moved, -2.0)
    straight, moved = straight[inner], moved[inner]
    assert np.linalg.norm(moved - straight, axis=1).max() > 10.0
    seen, expected = (
        map_coordinates(expected_radiance(model, scene), points.T[::-1], order=1)
        for model, points in ((bent, moved), (QUIET, straight))
    )
    # The apparent limb's light changes by a tenth of its value over a tenth of a pixel.
    assert seen == pytest.approx(expected, rel=0.1)


def test_a_tilted_pole_carries_the_flattening_with_it() -> None:
    """A pole towards the camera makes the limb round; the default one does not."""
    position = np.array([SEMI_MAJOR_AXIS + 400e3, 0.0, 0.0])
    upright = EarthScene(position, quaternion.IDENTITY, SUN)
    lying = replace(upright, pole=np.array([1.0, 0.0, 0.0]), rotation=0.7)
    assert np.ptp(_angles_from_nadir(upright, limb_directions(upright)[0])) > 1e-3
    assert np.ptp(_angles_from_nadir(lying, limb_directions(lying)[0])) < 1e-9
    assert lying.earth_matrix @ lying.earth_matrix.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(lying.earth_matrix) == pytest.approx(1.0)


def test_a_camera_inside_the_earth_and_numbers_that_are_none_are_refused() -> None:
    with pytest.raises(OutOfRange, match="Earth radii"):
        EarthScene(np.array([6e6, 0.0, 0.0]), quaternion.IDENTITY, SUN)
    with pytest.raises(ValueError, match="finite"):
        EarthScene(np.array([7e6, np.nan, 0.0]), quaternion.IDENTITY, SUN)
    with pytest.raises(OutOfRange, match="length of attitude"):
        EarthScene(np.array([7e6, 0.0, 0.0]), np.ones(4), SUN)
    with pytest.raises(ValueError, match="lens"):
        EarthCameraModel(lens=QUIET.lens, rows=100)
    with pytest.raises(OutOfRange, match="decades"):
        EarthCameraModel.fuga15d(decades=0.0)
