"""Tests of the comparison of stars with an object, and of the location of the ends of a streak."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.vision.objects import star_light
from knightcube.vision.objects.settings import EndpointSettings
from knightcube.vision.objects.star_light import (
    StarLight,
    light_on_path,
)
from knightcube.vision.objects.star_subtraction import brightest_left, cut_patch, fit_stars
from knightcube.vision.objects.streak_ends import Segmented, segment_frame
from knightcube.vision.objects.streak_images import (
    pixels_near,
    star_path,
    straight_path,
    streak_at,
    streak_images,
)
from tests.support.compiled_forms import assert_forms_agree
from tests.support.streak_frames import deposit, rate_at, star_camera

_CAMERA = star_camera(512)
_ROTATION = rate_at(np.deg2rad(90.0), 50.0 / _CAMERA.pinhole.focal_length)
_NOISE = 12.0
_CORNER = np.array([200.0, 220.0])


def test_a_line_across_a_star_remains_with_its_ends() -> None:
    """After the subtraction of a star, the streak of an object that crosses the star keeps its ends.

    The star covers the middle of the streak, and the ends are located by all remaining light of the streak.
    """
    ends = np.array([[230.2, 226.4], [255.7, 253.1]])
    image = np.zeros((512, 512))
    path = star_path(np.array([240.3, 238.7]), _ROTATION, _CAMERA.pinhole)
    deposit(image, path, 60_000.0, 1.0)
    deposit(image, ends[0] + np.linspace(0, 1, 801)[:, None] * np.diff(ends, axis=0), 40_000.0, 1.0)
    noisy = 500.0 + image + np.random.default_rng(3).normal(0.0, np.sqrt(_NOISE**2 + image))
    segmented = segment_frame(np.rint(noisy).astype(np.uint16), EndpointSettings())
    patch = cut_patch(segmented, 0, 1.0, 1.0, 65_535.0)
    stars, left = fit_stars(patch, _ROTATION, _CAMERA.pinhole)
    line = brightest_left(patch, left)
    assert line is not None
    light = StarLight(segmented, line, _ROTATION, _CAMERA.pinhole, 1.0, 1.0, 65_535.0, stars)
    found = light.located(line, among_stars=False)
    assert found is not None
    error = min(np.abs(found.ends - truth).max() for truth in (ends, ends[::-1]))
    assert error < 0.5


@pytest.mark.parametrize("crossed", [False, True])
def test_an_object_in_a_region_exceeds_the_expected_chi_square(crossed: bool) -> None:
    """A region with a star and an object exceeds the chi-square that is expected of a star alone.

    The star's streak has 50 px, and the object has 15,000 counts.
    """
    path = star_path(np.array([245.0, 240.0]), _ROTATION, _CAMERA.pinhole)
    ends = np.array([[240.0, 225.0], [252.0, 255.0]])
    image = np.zeros((512, 512))
    deposit(image, path, 40_000.0, 1.0)
    if crossed:
        deposit(image, ends[0] + np.linspace(0.0, 1.0, 501)[:, None] * np.diff(ends, axis=0), 15_000.0, 1.0)
    noisy = 500.0 + image + np.random.default_rng(8).normal(0.0, np.sqrt(_NOISE**2 + image))
    segmented = segment_frame(np.rint(noisy).astype(np.uint16), EndpointSettings())
    light = StarLight(segmented, path[[0, -1]], _ROTATION, _CAMERA.pinhole, 1.0, 1.0, 65_535.0)
    label = segmented.regions.labels[240, 245]
    row, column = np.nonzero(segmented.regions.labels == label)
    patch = cut_patch(segmented, 0, 1.0, 1.0, 65_535.0)
    _, left = fit_stars(patch, _ROTATION, _CAMERA.pinhole)
    for excess in (light.excess(np.stack([column, row], axis=-1)), patch.excess(left)):
        assert (excess > 1000.0) if crossed else (excess < 200.0)


@pytest.mark.parametrize(
    ("beyond", "gap"), [(0.0, 0.0), (12.0, 0.0), (30.0, 0.0), (-40.0, 0.0), (-40.0, 8.0)]
)
def test_the_ends_of_a_streak_follow_its_light(beyond: float, gap: float) -> None:
    """The fitted ends of a streak follow its light, although the assumed end is wrong by `beyond` px.

    The streak has 100 px, and some pixels before its end are saturated.
    """
    ends = np.array([[200.0, 210.0], [280.0, 270.0]])
    image = np.zeros((512, 512))
    deposit(image, ends[0] + np.linspace(0.0, 1.0, 2001)[:, None] * np.diff(ends, axis=0), 60_000.0, 1.0)
    noisy = 500.0 + image + np.random.default_rng(7).normal(0.0, np.sqrt(_NOISE**2 + image))
    segmented = segment_frame(np.rint(noisy).astype(np.uint16), EndpointSettings())
    claimed = ends + np.array([[0.0, 0.0], [0.8, 0.6]]) * beyond
    if gap > 0.0:
        segmented.signal[255:260] = 65_535.0
    light = StarLight(segmented, claimed, _ROTATION, _CAMERA.pinhole, 1.0, 1.0, 65_535.0)
    found = light.located(claimed, among_stars=False)
    assert found is not None
    errors = np.linalg.norm(found.ends - ends, axis=1)
    assert np.all(errors < 3.5 * found.sigma)
    assert np.all(found.sigma < 0.5)


def test_a_hidden_end_has_a_large_claim() -> None:
    """An end in saturated pixels has a large uncertainty.

    The last 20 px of the streak are saturated, so the end cannot be located to 2 px.
    """
    ends = np.array([[200.0, 210.0], [280.0, 270.0]])
    image = np.zeros((512, 512))
    deposit(image, ends[0] + np.linspace(0.0, 1.0, 2001)[:, None] * np.diff(ends, axis=0), 60_000.0, 1.0)
    noisy = 500.0 + image + np.random.default_rng(7).normal(0.0, np.sqrt(_NOISE**2 + image))
    segmented = segment_frame(np.rint(noisy).astype(np.uint16), EndpointSettings())
    segmented.signal[258:282] = 65_535.0
    light = StarLight(segmented, ends, _ROTATION, _CAMERA.pinhole, 1.0, 1.0, 65_535.0)
    found = light.located(ends, among_stars=False)
    assert found is not None
    assert found.sigma[1] > 2.0
    assert np.linalg.norm(found.ends[1] - ends[1]) < 3.0 * found.sigma[1]
    assert np.linalg.norm(found.ends[0] - ends[0]) < 3.5 * found.sigma[0] < 2.0


@pytest.mark.parametrize(
    ("inside", "middle", "expected"),
    [
        ([True] * 5, 2, [0, 1, 2, 3, 4]),
        ([True, False, True, True, False, True], 3, [2, 3]),
        ([False, True, True, False], 1, [1, 2]),
        ([True, True, False, True], 3, [3]),
        ([True, True, False, True], 2, []),
    ],
)
def test_only_the_part_of_a_path_around_its_middle_is_followed(
    inside: list[bool], middle: int, expected: list[int]
) -> None:
    assert star_light._around(np.array(inside), middle).tolist() == expected


def test_the_end_of_light_is_the_mean_over_its_likelihood() -> None:
    """The likelihood of an end is proportional to exp(s/2), where s is the sum of the gains up to it."""
    sure = np.array([60.0, 60.0, 60.0, -60.0, -60.0])
    assert star_light._end_of_light(sure) == pytest.approx((2.0, 0.0), abs=1e-6)
    assert star_light._end_of_light(np.array([9.0, 0.0, 0.0])) == pytest.approx((1.0, np.sqrt(2.0 / 3.0)))
    ratio = np.exp(0.5 * 2.0)
    last, sigma = star_light._end_of_light(np.array([0.0, 2.0]))
    assert last == pytest.approx(ratio / (1.0 + ratio))
    assert sigma == pytest.approx(np.sqrt(ratio) / (1.0 + ratio))


def _curve(bend: float) -> FloatArray:
    """Return points 1 px apart on a straight or bent path of 60 px."""
    part = np.linspace(0.0, 1.0, 2001)[:, None]
    fine = np.array([20.3, 15.8]) + part * [48.0, 36.0] + bend * part * (1.0 - part) * np.array([-0.6, 0.8])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(fine, axis=0), axis=1))])
    at = np.arange(0.0, along[-1], 1.0)
    return np.stack([np.interp(at, along, fine[:, axis]) for axis in (0, 1)], axis=1)


@pytest.mark.parametrize("bend", [0.0, 12.0])
def test_the_brightness_along_a_path_is_its_flux_per_length(bend: float) -> None:
    """The brightness of a uniform streak is its flux divided by its length, and zero beyond its ends."""
    curve = _curve(bend)
    pixels = pixels_near(curve, 5.0, 80, 100)
    lit = curve[15:46]
    counts = streak_at(pixels, lit, 1.0) * 3100.0
    weight = np.random.default_rng(1).uniform(0.5, 2.0, len(pixels))
    light, share = star_light._light_along(pixels, counts, weight, curve, 1.0)
    assert light[18:43] == pytest.approx(np.full(25, 100.0), rel=0.04)
    assert light[:11] == pytest.approx(np.zeros(11), abs=1.0)
    assert light[51:] == pytest.approx(np.zeros(len(curve) - 51), abs=1.0)
    # The information per px is the integral of the squared profile across the path, 1/(2 sqrt(pi) width).
    even = star_light._light_along(pixels, counts, np.full(len(pixels), 3.0), curve, 1.0)[1]
    width = np.sqrt(1.0 + 1.0 / 12.0)
    assert even[3:-3].mean() == pytest.approx(9.0 / (2.0 * np.sqrt(np.pi) * width), rel=0.03)
    assert np.all(share >= 0.0)
    assert_forms_agree(star_light._light_along, pixels, counts, weight, curve, 1.0)


def test_the_light_on_a_path_is_zero_outside_the_frame() -> None:
    curve = _curve(0.0)
    image = np.zeros((40, 100))
    deposit(image, curve, 100.0 * len(curve), 1.0)
    noisy = np.random.default_rng(2).normal(500.0, 1.0, image.shape) + image
    found = light_on_path(_segmented(noisy), curve, 1.0)
    inside = curve[:, 1] < 36.0
    assert found[inside][4:] == pytest.approx(np.full(np.count_nonzero(inside) - 4, 100.0), abs=8.0)
    assert np.all(found[curve[:, 1] > 43.0] == 0.0)


def _segmented(image: FloatArray) -> Segmented:
    return segment_frame(np.rint(image).astype(np.uint16), EndpointSettings())


def test_trial_paths_of_stars_begin_and_end_at_the_corners() -> None:
    """At each corner, one path begins and one path ends; the other paths pass through the region's middle."""
    corners = np.array([[200.0, 220.0], [300.0, 232.0]])
    paths = star_light._star_paths(corners, _ROTATION, _CAMERA.pinhole, 4)
    own = star_path(corners.mean(axis=0), _ROTATION, _CAMERA.pinhole)
    length, extent = len(own), float(np.hypot(100.0, 12.0))
    assert paths.shape == (4 + round(4.0 * extent / length) + 1, length, 2)
    for number, corner in enumerate(corners):
        assert paths[2 * number, 0] == pytest.approx(corner, abs=0.6)
        assert paths[2 * number + 1, -1] == pytest.approx(corner, abs=0.6)
    way = np.sign(own[-1, 0] - own[0, 0])
    middles = paths[4:].mean(axis=1) @ [way, 0.0]
    spacing = np.diff(middles)
    # The middles of these paths are evenly spaced over the extent of the region.
    assert np.ptp(middles) == pytest.approx(extent, rel=0.03)
    assert np.abs(spacing) == pytest.approx(np.full(len(spacing), extent / len(spacing)), rel=0.05)
    far = star_light._star_paths(np.array([[10.0, 220.0], [500.0, 232.0]]), _ROTATION, _CAMERA.pinhole, 4)
    assert len(far) == 4 + round(4 * star_light._LONGEST_CHAIN) + 1
    point = star_light._star_paths(np.array([[200.0, 220.0], [201.0, 220.0]]), _ROTATION, _CAMERA.pinhole, 4)
    assert len(point) == 4 + 4 + 1


def test_stars_and_an_object_are_compared_by_chi_square() -> None:
    """An object decreases chi-square to about the number of pixels, and has its flux.

    An object far from the region has no flux.
    """
    path = star_path(np.array([245.0, 240.0]), _ROTATION, _CAMERA.pinhole)
    ends = np.array([[225.0, 225.0], [262.0, 258.0]])
    image = np.zeros((512, 512))
    deposit(image, path, 20_000.0, 1.0)
    deposit(image, ends[0] + np.linspace(0.0, 1.0, 501)[:, None] * np.diff(ends, axis=0), 12_000.0, 1.0)
    noisy = 500.0 + image + np.random.default_rng(8).normal(0.0, np.sqrt(_NOISE**2 + image))
    corners = np.concatenate([path[[0, -1]], ends])
    light = StarLight(_segmented(noisy), corners, _ROTATION, _CAMERA.pinhole, 1.0, 1.0, 65_535.0)
    found = light.explain(ends)
    assert found.flux == pytest.approx(12_000.0, rel=0.12)
    assert found.chi_square == pytest.approx(light.expected, rel=0.25)
    assert light.chi_square > 1.6 * light.expected
    assert light.chi_square_with(ends) == pytest.approx(found.chi_square)
    assert found.misfit < 1.3
    assert found.misfit_of_stars > 2.5
    assert light.expected < light.pixels
    wrong = light.explain(np.array([[225.0, 258.0], [262.0, 225.0]]))
    assert wrong.chi_square > 1.5 * found.chi_square
    assert wrong.flux < 4_000.0
    outside = light.explain(np.array([[10.0, 10.0], [40.0, 12.0]]))
    assert outside.flux == 0.0
    assert outside.misfit == np.inf
    arguments = _segmented(noisy), corners, _ROTATION, _CAMERA.pinhole, 1.0, 1.0, 65_535.0
    known = StarLight(*arguments, [straight_path(ends)])
    assert known.chi_square == pytest.approx(found.chi_square, rel=0.05)
    assert found.unexplained == pytest.approx(found.chi_square - light.expected)


def test_light_in_other_regions_is_not_unexplained() -> None:
    """The pixels near the trial stars contain a point of light that belongs to another region."""
    ends = np.array([[225.0, 232.0], [262.0, 252.0]])
    image = np.zeros((512, 512))
    deposit(image, straight_path(ends), 12_000.0, 1.0)
    noisy = 500.0 + image + np.random.default_rng(9).normal(0.0, np.sqrt(_NOISE**2 + image))
    deposit(noisy, np.array([[245.0, 230.0]]), 5_000.0, 1.0)
    corners = np.array([[225.0, 232.0], [262.0, 252.0], [245.0, 230.0]])
    light = StarLight(_segmented(noisy), corners, _ROTATION, _CAMERA.pinhole, 1.0, 1.0, 65_535.0)
    found = light.explain(ends)
    assert found.chi_square - light.expected > 600.0
    assert abs(found.unexplained) < 250.0
    # For a line that touches the point, the unexplained light includes that of both regions.
    across = light.explain(np.array([[225.0, 232.0], [245.0, 230.0]]))
    assert across.unexplained == pytest.approx(across.chi_square - light.expected, abs=100.0)


@pytest.mark.parametrize("corners", [2, 4])
def test_all_forms_spread_the_same_trial_paths(corners: int) -> None:
    draw = np.random.default_rng(11)
    points = draw.uniform(0.0, 200.0, (corners, 2))
    middle = points.mean(axis=0)
    assert_forms_agree(star_light._trial_starts, points, middle, 50, 2)
    assert_forms_agree(star_light._lines_between, points)
    assert_forms_agree(star_light._lines_between, np.tile(points[:1], (2, 1)))


def test_all_forms_return_the_same_equations_of_ends() -> None:
    ends = np.array([[20.0, 15.0], [52.0, 39.0]])
    pixels = pixels_near(straight_path(np.array([[4.0, 3.0], [68.0, 51.0]])), 3.0, 80, 100)
    draw = np.random.default_rng(12)
    weight = draw.uniform(0.5, 2.0, len(pixels)) * (draw.uniform(size=len(pixels)) > 0.1)
    target = draw.normal(size=len(pixels))
    images = streak_images(pixels, straight_path(ends)[None], 1.0, True)[0]
    assert_forms_agree(star_light._sums_of_ends, images, pixels, target, weight, ends)
    _, power, count = star_light._sums_of_ends(images, pixels, target, weight, ends)
    assert 0 < count < np.count_nonzero(weight)
    assert 0.0 < power < np.sum((target * weight) ** 2)
