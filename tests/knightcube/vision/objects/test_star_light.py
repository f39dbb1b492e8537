"""Tests of the subtraction of stars from a region, and of the measurement of the remaining light."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage
from scipy.optimize import nnls

from knightcube.astro.arrays import FloatArray
from knightcube.errors import FlightError
from knightcube.vision.objects import star_light
from knightcube.vision.objects.settings import EndpointSettings
from knightcube.vision.objects.star_light import (
    Patch,
    StarLight,
    _brightest_path,
    _brightnesses,
    _convolved,
    _counts_at,
    _fit_line,
    _smoothed,
    brightest_left,
    cut_patch,
    fit_stars,
    light_on_path,
    region_along,
)
from knightcube.vision.objects.streak_ends import Segmented, segment_frame
from knightcube.vision.objects.streak_images import pixels_near, star_path, straight_path, streak_at
from tests.support.compiled_forms import assert_forms_agree
from tests.support.streak_frames import deposit, rate_at, rotate, star_camera

_CAMERA = star_camera(512)
_ROTATION = rate_at(np.deg2rad(90.0), 50.0 / _CAMERA.pinhole.focal_length)
_NOISE = 12.0
_CORNER = np.array([200.0, 220.0])


def _patch(middles: list[tuple[float, float]], flux: float, extra: FloatArray | None, seed: int) -> Patch:
    """Return a patch of 90 x 40 px with stars of `flux` counts each.

    If `extra` (n, 2), px in the frame, is given, an object adds 40,000 counts along this path.
    """
    image = np.zeros((40, 90))
    for middle in middles:
        direction = _CAMERA.pinhole.unit_vectors(np.array([middle]))[0]
        parts = np.linspace(-0.5, 0.5, 1001)
        seen = np.array([rotate(direction[None], part * _ROTATION)[0] for part in parts])
        deposit(image, _CAMERA.pinhole.project(seen) - _CORNER, flux, 1.0)
    if extra is not None:
        deposit(image, extra - _CORNER, 40_000.0, 1.0)
    signal = image + np.random.default_rng(seed).normal(0.0, np.sqrt(_NOISE**2 + image))
    light = np.maximum(signal, 0.0)
    weight = 1.0 / np.sqrt(_NOISE**2 + light + (0.1 * light) ** 2)
    mask = np.ones(signal.shape, dtype=np.bool_)
    return Patch(signal, weight, _NOISE, _CORNER, mask, np.zeros(4), 1.0)


def test_overlapping_stars_leave_an_empty_residual() -> None:
    middles = [(240.3, 238.7), (252.0, 241.2)]
    patch = _patch(middles, 60_000.0, None, 1)
    paths, left = fit_stars(patch, _ROTATION, _CAMERA.pinhole)
    assert len(paths) >= 2
    # Each true star has a fitted path that is accurate to a tenth of a pixel.
    for middle in middles:
        assert min(np.linalg.norm(path.mean(axis=0) - middle) for path in paths) < 0.1
    assert brightest_left(patch, left) is None


def test_a_point_on_a_star_remains_and_is_measured() -> None:
    place = np.array([[245.4, 240.1]])
    patch = _patch([(240.3, 238.7)], 60_000.0, place, 2)
    _, left = fit_stars(patch, _ROTATION, _CAMERA.pinhole)
    found = brightest_left(patch, left)
    assert found is not None
    np.testing.assert_allclose(found, np.tile(place, (2, 1)), atol=0.1)


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


@pytest.mark.parametrize("start", [(0.0, 0.0, 0.0, 0.0), (2.5, -1.5, -2.0, 1.0), (-3.0, 0.5, 3.5, -1.0)])
def test_the_fit_of_a_line_converges_from_a_guess_that_is_px_off(start: tuple[float, ...]) -> None:
    ends = np.array([[230.2, 226.4], [255.7, 253.1]])
    line = ends[0] + np.linspace(0, 1, 801)[:, None] * np.diff(ends, axis=0)
    patch = _patch([], 0.0, line, 5)
    found = _fit_line(patch, patch.signal, ends + np.reshape(start, (2, 2)))
    np.testing.assert_allclose(found, ends, atol=0.25)


def test_the_fit_of_a_point_converges_from_a_guess_that_is_px_off() -> None:
    place = np.array([[245.4, 240.1]])
    patch = _patch([], 0.0, place, 6)
    found = _fit_line(patch, patch.signal, np.tile(place + np.array([1.5, -1.2]), (2, 1)))
    np.testing.assert_allclose(found, np.tile(place, (2, 1)), atol=0.05)


def test_pure_noise_contains_neither_star_nor_object() -> None:
    patch = _patch([], 0.0, None, 4)
    paths, left = fit_stars(patch, _ROTATION, _CAMERA.pinhole)
    assert paths == []
    np.testing.assert_array_equal(left, patch.signal)
    assert brightest_left(patch, left) is None


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
    """The fitted ends of a streak follow its light if the assumed end is `beyond` px too far.

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


@pytest.mark.parametrize("beyond", [0.0, np.inf])
def test_all_forms_find_the_same_brightest_path(beyond: float) -> None:
    draw = np.random.default_rng(4)
    for threshold in (0.1, 1.5, 9.0):
        seen = draw.normal(1.0, 1.0, (16, 20))
        steps = np.rint(np.linspace(-0.5, 0.5, 9)[:, None] * draw.normal(0.0, 12.0, 2)).astype(np.int64)
        factor = np.array([2.0, *np.ones(7), 2.0])
        given = seen, steps, factor, np.array([beyond, 0.0, 0.0, beyond]), threshold
        assert_forms_agree(_brightest_path, *given)
    assert _brightest_path(*given) == (-np.inf, -1, -1)


@pytest.mark.parametrize("shape", [(1, 1), (3, 2), (20, 30)])
def test_all_forms_smooth_alike_and_as_scipy_does(shape: tuple[int, int]) -> None:
    light = np.random.default_rng(5).normal(size=shape)
    assert_forms_agree(_convolved, light, np.array([0.5, 0.2, 0.05]))
    expected = ndimage.gaussian_filter(light, 1.3, mode="constant")
    np.testing.assert_allclose(_smoothed(light, 1.3), expected, atol=1e-12)


@pytest.mark.parametrize("saturation", [60.0, np.inf])
def test_all_forms_return_the_same_counts_and_weights(saturation: float) -> None:
    draw = np.random.default_rng(6)
    image = draw.normal(20.0, 30.0, (12, 15)).astype(np.float32)
    pixels = np.stack([draw.integers(0, 15, 40), draw.integers(0, 12, 40)], axis=1)
    assert_forms_agree(_counts_at, image, pixels, 5.0, 4.0, 2.0, saturation)
    assert _counts_at(image, pixels[:0], 5.0, 4.0, 2.0, saturation)[2] == 0.0
    assert np.isfinite(saturation) == bool(
        np.any(_counts_at(image, pixels, 5.0, 4.0, 2.0, saturation)[1] == 0.0)
    )


def test_equations_that_are_not_positive_definite_are_refused() -> None:
    normal = np.array([[1.0, 2.0], [2.0, 1.0]])
    with pytest.raises(FlightError, match="not positive definite"):
        _brightnesses(normal, np.ones(2), 2.0)


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
    """The likelihood of an end grows with half of the gains up to it."""
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


def test_pixels_are_weighted_by_noise_photons_and_the_error_of_the_model() -> None:
    """The variance of 300 counts at 2 electrons per count is 12^2 + 150 + (10 % of 300)^2."""
    signal = np.array([300.0, -50.0, 449.0, 451.0])
    weight = star_light._pixel_weights(signal, 500.0, 12.0, 2.0, 1000.0)
    assert weight[0] == pytest.approx(1.0 / np.sqrt(144.0 + 150.0 + 900.0))
    assert weight[1] == pytest.approx(1.0 / 12.0)
    assert weight[2] > 0.0
    assert weight[3] == 0.0
    image = signal.reshape(2, 2).astype(np.float32)
    pixels = np.array([[0, 0], [1, 0], [1, 1]])
    found, weights, expected = _counts_at(image, pixels, 500.0, 12.0, 2.0, 1000.0)
    assert found.tolist() == [300.0, -50.0, 451.0]
    assert weights == pytest.approx(weight[[0, 1, 3]])
    # Only the noise of the background and of the photons is expected in chi-square.
    assert expected == pytest.approx((144.0 + 150.0) / (144.0 + 150.0 + 900.0) + 1.0)


def test_brightnesses_are_those_of_non_negative_least_squares() -> None:
    draw = np.random.default_rng(3)
    images = draw.uniform(0.0, 1.0, (4, 50)) * np.array([1.0, 30.0, 0.1, 5.0])[:, None]
    data = np.array([40.0, 2.0, 0.0, 3.0]) @ images - 30.0 * images[2] + draw.normal(size=50)
    found, chi_square = _brightnesses(images @ images.T, images @ data, float(data @ data))
    expected, residual = nnls(images.T, data)
    assert found == pytest.approx(expected, rel=1e-5, abs=1e-6)
    assert chi_square == pytest.approx(residual**2, rel=1e-6)
    assert np.any(found == 0.0)


def test_trial_paths_of_stars_begin_and_end_at_the_corners() -> None:
    """Of each corner, one path begins and one ends there; the other paths pass the middle of the region."""
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
    # The middles are evenly spread over the extent of the region, and the first path is the last in time.
    assert np.ptp(middles) == pytest.approx(extent, rel=0.03)
    assert np.abs(spacing) == pytest.approx(np.full(len(spacing), extent / len(spacing)), rel=0.05)
    far = star_light._star_paths(np.array([[10.0, 220.0], [500.0, 232.0]]), _ROTATION, _CAMERA.pinhole, 4)
    assert len(far) == 4 + round(4 * star_light._LONGEST_CHAIN) + 1
    point = star_light._star_paths(np.array([[200.0, 220.0], [201.0, 220.0]]), _ROTATION, _CAMERA.pinhole, 4)
    assert len(point) == 4 + 4 + 1


def test_the_excess_of_a_patch_is_that_of_chi_square_over_its_expectation() -> None:
    patch = _patch([], 0.0, None, 9)
    left = np.full(patch.signal.shape, 20.0)
    patch.mask[:, 10:] = False
    variance = _NOISE**2 + np.maximum(patch.signal, 0.0)
    expected = np.sum(((400.0 - variance) * patch.weight**2)[:, :10])
    assert patch.excess(left) == pytest.approx(expected)
    # The noise of the smoothed image is that of white noise, summed with the squares of the kernel.
    point = np.zeros((31, 31))
    point[15, 15] = 1.0
    kernel = _smoothed(point, 1.0)
    assert patch.smoothed_noise == pytest.approx(_NOISE * np.sqrt(np.sum(kernel**2)), rel=0.01)
    assert patch.smoothed(patch.signal) is patch.seen
    assert patch.smoothed(left)[20, 45] == pytest.approx(20.0, rel=1e-3)


def test_a_patch_is_cut_with_a_margin_around_its_region() -> None:
    """The patch extends 8 px beyond the region. Streaks may continue beyond the border of the frame."""
    image = np.random.default_rng(1).normal(500.0, 5.0, (120, 140))
    deposit(image, straight_path(np.array([[40.0, 30.0], [80.0, 60.0]])), 30_000.0, 1.0)
    deposit(image, straight_path(np.array([[100.0, 3.0], [136.0, 30.0]])), 25_000.0, 1.0)
    segmented = _segmented(image)
    order = np.argsort(segmented.regions.boxes[:, 2])
    inner = cut_patch(segmented, int(order[0]), 1.0, 2.0, 65_535.0)
    top, bottom, left, right = segmented.regions.boxes[order[0]]
    assert inner.corner.tolist() == [left - 8, top - 8]
    assert inner.signal.shape == (bottom - top + 16, right - left + 16)
    assert inner.signal == pytest.approx(segmented.signal[top - 8 : bottom + 8, left - 8 : right + 8])
    assert inner.mask[30 - top + 8, 40 - left + 8]
    assert inner.mask.sum() == np.count_nonzero(segmented.regions.labels == segmented.regions.label[order[0]])
    assert inner.beyond.tolist() == [0.0] * 4
    assert (inner.gain, inner.psf_sigma) == (2.0, 1.0)
    assert inner.noise == pytest.approx(5.0, rel=0.1)
    edge = cut_patch(segmented, int(order[-1]), 1.0, 2.0, 65_535.0)
    assert edge.beyond.tolist() == [np.inf, 0.0, 0.0, np.inf]
    assert edge.corner[1] == 0.0
    dark = cut_patch(segmented, int(order[0]), 1.0, 2.0, 600.0)
    assert np.array_equal(dark.weight == 0.0, dark.signal + segmented.background.typical_level >= 570.0)
    # The region along a line is that of most of its pixels.
    labels = segmented.regions.label[order]
    assert region_along(segmented, np.array([[40.0, 30.0], [80.0, 60.0]])) == labels[0]
    assert region_along(segmented, np.array([[70.0, 52.0], [130.0, 26.0]])) in labels
    assert region_along(segmented, np.array([[20.0, 100.0], [60.0, 100.0]])) == 0


def test_stars_and_an_object_are_compared_by_chi_square() -> None:
    """An object decreases chi-square to about the number of pixels, and has its flux.

    Ends without light do not decrease chi-square.
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
