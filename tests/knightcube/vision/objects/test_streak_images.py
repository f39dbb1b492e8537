"""Tests of paths during an exposure, and of the images of streaks."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr

from knightcube.astro.arrays import FloatArray
from knightcube.vision.objects.streak_images import (
    _area,
    _bell,
    _path_among_stars,
    _paths_on_circles,
    fitted_line,
    line_image,
    path_among_stars,
    pixels_near,
    solved,
    spread_over,
    spread_with_slopes,
    star_paths,
    straight_path,
    streak_at,
    streak_images,
)
from tests.support.compiled_forms import assert_forms_agree
from tests.support.streak_frames import rate_at, rotate, star_camera

_CAMERA = star_camera(512)
_ROTATION = rate_at(np.deg2rad(90.0), 50.0 / _CAMERA.pinhole.focal_length)


def test_slopes_of_light_are_those_of_small_moves() -> None:
    path = straight_path(np.array([[10.3, 8.1], [27.8, 14.6]]))
    share = np.linspace(0.0, 1.0, len(path))
    light, across, down = spread_with_slopes(path, share[None], 40, 24, 1.0)
    np.testing.assert_allclose(light, spread_over(path, 40, 24, 1.0), atol=1e-12)
    assert abs(float(light.sum()) - 1.0) < 1e-5
    step = 1e-4 * share[:, None]
    for slope, axis in ((across, [1.0, 0.0]), (down, [0.0, 1.0])):
        moved = [spread_over(path + sign * step * axis, 40, 24, 1.0) for sign in (1.0, -1.0)]
        # The tolerance is the light beyond 5 sigma from the path, which the model omits, divided by the step
        # of the difference.
        np.testing.assert_allclose(slope, (moved[0] - moved[1]) / 2e-4, atol=1e-5)


@pytest.mark.parametrize("length", [3.0, 20.0, 150.0])
@pytest.mark.parametrize("bend", [0.0, 0.03, 0.6])
def test_the_image_of_a_streak_is_that_of_its_points(length: float, bend: float) -> None:
    path = straight_path(np.array([[30.2, 90.4], [30.2 + 0.8 * length, 90.4 + 0.6 * length]]))
    path = path + np.outer(np.linspace(-1.0, 1.0, len(path)) ** 2 * bend * length, [-0.6, 0.8])
    image = spread_over(path, 240, 300, 1.0)
    row, column = np.divmod(np.arange(image.size), 240)
    found = streak_at(np.stack([column, row], axis=-1), path, 1.0).reshape(image.shape)
    np.testing.assert_allclose(found, image, atol=0.02 * image.max())


def test_the_slopes_of_a_line_are_those_of_its_points() -> None:
    ends = np.array([[15.3, 22.1], [66.8, 40.6]])
    path = straight_path(ends)
    share = (np.arange(len(path)) + 0.5) / len(path)
    images = spread_with_slopes(path, np.stack([1.0 - share, share]), 90, 60, 1.0)
    pixels, line, axes = line_image(ends, 90, 60, 1.0)
    for end in range(2):
        slopes = np.stack([image.reshape(-1)[pixels] for image in images[1 + 2 * end : 3 + 2 * end]])
        found = line[1 + 2 * end : 3 + 2 * end]
        np.testing.assert_allclose(found, axes @ slopes, atol=0.06 * np.abs(slopes).max())


def test_paths_of_stars_rotate_with_the_sky() -> None:
    directions = _CAMERA.pinhole.unit_vectors(np.array([[240.0, 238.0], [300.0, 120.0]]))
    paths = star_paths(directions, _ROTATION, np.array([0.0, 0.25]), _CAMERA.pinhole)
    for path, direction, start in zip(paths, directions, (0.0, 0.25), strict=True):
        parts = (np.arange(len(path)) + 0.5) / len(path) - start
        seen = np.array([rotate(direction[None], part * _ROTATION)[0] for part in parts])
        np.testing.assert_allclose(path, _CAMERA.pinhole.project(seen), atol=1e-6)


def _arcs(length: float, count: int, draw: np.random.Generator) -> FloatArray:
    """Return paths (4, count, 2), px, with the same chord length and increasing curvature."""
    along = draw.normal(size=2)
    along /= np.linalg.norm(along)
    part = np.linspace(-0.5, 0.5, count)[:, None]
    bent = [bend * part**2 * np.array([-along[1], along[0]]) for bend in (0.0, 0.1, 0.5, 2.0)]
    return draw.uniform(20.0, 40.0, 2) + length * np.stack([part * along + each for each in bent])


@pytest.mark.parametrize(("length", "bend"), [(3.0, 0.0), (20.0, 0.0), (60.0, 0.1)])
def test_slopes_of_a_streak_are_those_of_small_moves(length: float, bend: float) -> None:
    path = straight_path(np.array([[20.2, 20.4], [20.2 + 0.8 * length, 20.4 + 0.6 * length]]))
    path = path + np.outer(np.linspace(-1.0, 1.0, len(path)) ** 2 * bend * length, [-0.6, 0.8])
    pixels = pixels_near(path, 7.0, 90, 100)
    image = streak_images(pixels, path[None], 1.0, True)[0]
    np.testing.assert_array_equal(image[0], streak_at(pixels, path, 1.0))
    for slope, axis in ((image[1], [1.0, 0.0]), (image[2], [0.0, 1.0])):
        moved = [streak_at(pixels, path + step * np.array(axis), 1.0) for step in (1e-4, -1e-4)]
        expected = (moved[0] - moved[1]) / 2e-4
        np.testing.assert_allclose(slope, expected, atol=0.1 * np.abs(expected).max())


def test_all_forms_return_the_same_paths_of_stars() -> None:
    draw = np.random.default_rng(1)
    for angle in (0.0, 0.01, 0.2):
        directions = draw.normal(0.0, 0.2, (4, 3)) + np.array([0.0, 0.0, 1.0])
        directions[0] = np.array([0.0, 1.0, -0.1])
        rotation = angle * draw.normal(size=3)
        starts, view = draw.uniform(0.0, 1.0, 4), (900.0, 511.5, 300.0)
        assert_forms_agree(_paths_on_circles, directions, rotation, starts, view)


@pytest.mark.parametrize("backward", [False, True])
def test_all_forms_return_the_same_path_among_the_stars(backward: bool) -> None:
    """All implementations return the same path relative to the stars.

    The path begins at the first end, even if the slower motion begins at the second end.
    """
    ends = np.array([[200.0, 250.0], [290.0, 262.0]])[:: -1 if backward else 1]
    view = float(_CAMERA.pinhole.focal_length), *_CAMERA.pinhole.centre
    for rotation in (0.0 * _ROTATION, _ROTATION, -_ROTATION):
        assert_forms_agree(_path_among_stars, ends, rotation, np.linspace(-0.2, 1.2, 9), view)
        for parts in (None, np.array([0.0, 1.0])):
            path = path_among_stars(ends, rotation, _CAMERA.pinhole, parts)
            np.testing.assert_allclose(path[[0, -1]], ends, atol=1e-9 if parts is not None else 1.0)


def test_all_forms_find_the_same_pixels_near_points() -> None:
    draw = np.random.default_rng(2)
    for reach in (0.0, 2.5, 5.2):
        points = draw.uniform(-30.0, 80.0, (40, 2))
        points[3] = np.nan
        assert_forms_agree(pixels_near, points, reach, 50, 40)
    assert_forms_agree(pixels_near, points - 200.0, 3.0, 50, 40)


@pytest.mark.parametrize("slopes", [True, False])
def test_all_forms_return_the_same_images_of_streaks(slopes: bool) -> None:
    draw = np.random.default_rng(3)
    for length, count, sigma in ((0.0, 1, 1.0), (3.0, 5, 0.7), (40.0, 40, 2.0)):
        paths = _arcs(length, count, draw)
        pixels = pixels_near(paths.reshape(-1, 2), 6.0, 60, 70)
        assert_forms_agree(streak_images, pixels, paths, sigma, slopes)


def test_all_forms_fit_the_same_line() -> None:
    draw = np.random.default_rng(4)
    for ends in ([[5.0, 8.0], [30.0, 20.0]], [[-4.0, 9.0], [45.0, 9.0]], [[60.0, 60.0], [70.0, 80.0]]):
        pixels, images, _ = line_image(np.array(ends), 40, 30, 1.0)
        light = draw.normal(0.0, 10.0, 1200)
        light[pixels] += 3e4 * images[0]
        weight = 1.0 / np.sqrt(100.0 + np.maximum(light, 0.0))
        guess = np.array(ends) + draw.normal(0.0, 1.0, (2, 2))
        assert_forms_agree(
            fitted_line, light.reshape(30, 40), weight.reshape(30, 40), guess, 1.0, relative=1e-6
        )


def test_all_forms_solve_regularised_normal_equations() -> None:
    images = np.random.default_rng(4).normal(size=(3, 20))
    images = np.concatenate([images, images[:1], np.zeros((1, 20))])
    sums = np.vstack([images @ images.T, images @ np.arange(20.0)])
    assert_forms_agree(solved, sums, relative=1e-6)
    np.testing.assert_allclose(solved(sums)[[1, 4]], [solved(sums[[0, 1, 2, 5]][:, :3])[1], 0.0], rtol=1e-4)


def test_the_tabulated_normal_density_and_its_integral_are_accurate() -> None:
    points = np.concatenate([np.linspace(-10.0, 10.0, 801) + 0.0013, [-9.0, 9.0, 0.0]])
    bells = [_bell(float(x)) for x in points]
    areas = [_area(float(x)) for x in points]
    assert bells == pytest.approx(np.exp(-0.5 * points**2) / np.sqrt(2.0 * np.pi), abs=1e-12)
    assert areas == pytest.approx(ndtr(points), abs=1e-12)


@pytest.mark.parametrize("points", [3, 40])
def test_a_path_that_is_undefined_has_no_light(points: int) -> None:
    """A path that leaves the half-space ahead of the camera has points without a place in the image."""
    pixels = pixels_near(np.array([[20.0, 20.0]]), 6.0, 50, 50)
    paths = np.full((1, points, 2), np.nan)
    for form in (streak_images.numpy_form, streak_images.loop_form):
        assert np.all(form(pixels, paths, 1.0, True) == 0.0)
