"""Tests of the subtraction of stars from a region, and of the measurement of the remaining light."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from knightcube.astro.arrays import FloatArray
from knightcube.errors import FlightError
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
)
from knightcube.vision.objects.streak_ends import segment_frame
from knightcube.vision.objects.streak_images import star_path
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
