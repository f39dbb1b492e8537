"""Tests of the subtraction of stars from a region, and of the measurement of the remaining light."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from knightcube.astro.arrays import FloatArray
from knightcube.vision.objects import star_subtraction
from knightcube.vision.objects.settings import EndpointSettings
from knightcube.vision.objects.star_light import region_along
from knightcube.vision.objects.star_subtraction import (
    Patch,
    _brightest_path,
    _convolved,
    _fit_line,
    _smoothed,
    brightest_left,
    cut_patch,
    fit_stars,
)
from knightcube.vision.objects.streak_ends import segment_frame
from knightcube.vision.objects.streak_images import straight_path
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


def test_the_excess_of_a_patch_is_that_of_chi_square_over_its_expectation() -> None:
    patch = _patch([], 0.0, None, 9)
    left = np.full(patch.signal.shape, 20.0)
    patch.mask[:, 10:] = False
    variance = _NOISE**2 + np.maximum(patch.signal, 0.0)
    expected = np.sum(((400.0 - variance) * patch.weight**2)[:, :10])
    assert patch.excess(left) == pytest.approx(expected)
    assert_forms_agree(star_subtraction._excess, left, patch.signal, patch.weight, patch.mask, _NOISE, 2.0)
    # The noise of the smoothed image is that of a pixel times the root of the kernel's sum of squares.
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
    segmented = segment_frame(np.rint(image).astype(np.uint16), EndpointSettings())
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
    # The region along a line is the region to which most of its pixels belong.
    labels = segmented.regions.label[order]
    assert region_along(segmented, np.array([[40.0, 30.0], [80.0, 60.0]])) == labels[0]
    assert region_along(segmented, np.array([[70.0, 52.0], [130.0, 26.0]])) in labels
    assert region_along(segmented, np.array([[20.0, 100.0], [60.0, 100.0]])) == 0
