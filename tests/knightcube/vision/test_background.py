"""Tests of the background of a frame: level and noise of blocks of pixels."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import ndimage

from knightcube.vision.background import (
    MAD_TO_SIGMA,
    _among_blocks,
    _clipped_moments,
    _median_of_neighbours,
    _samples,
    _share_uneven,
    _sorted_moments,
    _subtracted,
    estimate_background,
    in_blocks,
    interpolation_weights,
    least_of_neighbours,
    median_of_neighbours,
)
from tests.support.compiled_forms import assert_forms_agree
from tests.support.streak_frames import rate_at, star_camera, star_frame


def test_a_sloping_background_is_followed_within_its_sampling_error() -> None:
    rng = np.random.default_rng(1)
    slope = 100.0 + 0.2 * np.arange(512.0)[None, :] + np.zeros((512, 1))
    pixels = np.rint(slope + rng.normal(0.0, 12.0, slope.shape)).astype(np.uint16)
    background = estimate_background(pixels)
    error = background.map(background.level) - slope
    # With 256 samples per block, the error is 12/16 counts. The largest error of 64 blocks may be six times
    # this error.
    assert np.abs(error[:, 32:-32]).max() < 4.5
    # Within a block of 64 px, the slope changes the counts by 12.8, which would increase the noise to
    # sqrt(12^2 + 12.8^2/12).
    assert background.stray_light
    assert background.noise.mean() == pytest.approx(12.0, rel=0.03)


def test_stray_light_is_followed_to_less_than_its_noise() -> None:
    row, column = np.indices((640, 640)) - 300.0
    light = 100.0 + 800.0 * np.exp(-0.5 * (row**2 + column**2) / 200.0**2)
    noise = np.sqrt(25.0 + light / 5.0)
    pixels = np.rint(light + noise * np.random.default_rng(3).normal(size=light.shape)).astype(np.uint16)
    background = estimate_background(pixels)
    inner = np.s_[16:-16, 16:-16]
    error = (background.map(background.level) - light) / noise
    assert np.sqrt(np.mean(error[inner] ** 2)) < 0.25
    ratio = background.map(background.noise) / noise
    assert np.median(ratio) == pytest.approx(1.0, abs=0.05)
    coarse = estimate_background(pixels, stray_light=False)
    assert np.sqrt(np.mean(((coarse.map(coarse.level) - light) / noise)[inner] ** 2)) > 0.5


def test_a_bright_limb_and_a_flat_sky_are_not_stray_light() -> None:
    rng = np.random.default_rng(4)
    flat = 100.0 + rng.normal(0.0, 10.0, (512, 512))
    row, column = np.indices(flat.shape)
    limb = flat + 3000.0 * (np.hypot(row - 700.0, column - 256.0) < 400.0)
    for scene in (flat, limb):
        assert not estimate_background(np.rint(np.clip(scene, 0.0, None)).astype(np.uint16)).stray_light


def test_streaks_hardly_move_level_and_noise() -> None:
    camera = star_camera(512)
    pixels = star_frame(camera, rate_at(0.5 * np.pi, 0.02), 1.0, seed=2)
    background = estimate_background(pixels)
    # The level is 100 counts plus 50 electrons of dark current, with a noise of sqrt(100 + 50).
    assert np.median(background.level) == pytest.approx(150.0, abs=1.0)
    assert np.median(background.noise) == pytest.approx(np.sqrt(150.0), rel=0.05)


def test_noise_below_the_rounding_is_not_zero() -> None:
    background = estimate_background(np.full((128, 128), 7, dtype=np.uint8))
    np.testing.assert_allclose(background.noise, np.sqrt(1.0 / 12.0))


def test_a_frame_that_blocks_do_not_divide_is_covered() -> None:
    background = estimate_background(np.full((150, 201), 9, dtype=np.uint16))
    level = background.map(background.level)
    assert level.shape == (150, 201)
    np.testing.assert_allclose(level, 9.0, rtol=1e-6)


def test_weights_interpolate_between_block_centres_and_are_constant_beyond() -> None:
    weights = interpolation_weights(8, 2)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0)
    # The centres of two blocks of four pixels are at 1.5 and 5.5.
    np.testing.assert_allclose(weights[:, 1], [0.0, 0.0, 0.125, 0.375, 0.625, 0.875, 1.0, 1.0])


@pytest.mark.parametrize("size", [1, 2, 24, 25, 64, 255])
@pytest.mark.parametrize("sigma", [0.0, 0.4, 3.0, 500.0])
def test_moments_of_blocks_are_those_of_the_values_near_the_median(size: int, sigma: float) -> None:
    """The values within three deviations of the median of a block determine its mean and variance.

    With little noise, many pixels have equal integer counts. Each block contains a bright object.
    """
    draw = np.random.default_rng([size, round(10 * sigma)])
    values = np.round(draw.normal(100.0, sigma, (3, 4, size)))
    values[:, :, size // 2 :] += draw.choice([0.0, 3_000.0], (3, 4, 1))
    level, variance = _clipped_moments(values.astype(np.float32))
    for block, mean, square in zip(values.reshape(12, -1), level.flat, variance.flat, strict=True):
        apart = np.abs(block - np.median(block))
        kept = block[apart <= 3.0 * max(MAD_TO_SIGMA * np.median(apart), 0.5)]
        assert mean == pytest.approx(np.mean(kept), rel=1e-6)
        assert square == pytest.approx(np.var(kept), rel=1e-5, abs=1e-6)


@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (2, 3), (7, 1), (9, 12)])
def test_median_and_minimum_of_neighbours_are_those_of_filters(shape: tuple[int, int]) -> None:
    grid = np.random.default_rng(shape).integers(0, 30, shape).astype(float)
    expected = ndimage.median_filter(grid, size=3, mode="nearest")
    assert median_of_neighbours(grid).tolist() == expected.tolist()
    lowest = ndimage.minimum_filter(grid, size=3, mode="nearest")
    assert least_of_neighbours(grid).tolist() == lowest.tolist()


@pytest.mark.parametrize(("first", "stride"), [(0, 1), (1, 2), (2, 4)])
def test_each_pixel_of_a_block_is_taken_once_in_each_stride(first: int, stride: int) -> None:
    pixels = np.arange(35 * 50).reshape(35, 50)
    blocks = in_blocks(pixels, 2, 3, first, stride)
    for down, across in np.ndindex(2, 3):
        block = pixels[17 * down : 17 * down + 17, 16 * across : 16 * across + 16]
        assert blocks[down, across].tolist() == block[first::stride, first::stride].ravel().tolist()


@pytest.mark.parametrize("blocks", [(1, 1), (3, 4)])
def test_the_compiled_interpolation_between_blocks_equals_that_in_numpy(blocks: tuple[int, int]) -> None:
    draw = np.random.default_rng(blocks)
    row, column = draw.uniform(-20.0, 90.0, (2, 200))
    assert_forms_agree(_among_blocks, draw.normal(size=blocks), 63, 70, column, row)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_the_compiled_samples_of_blocks_equal_those_in_numpy(dtype: type[np.number[Any]]) -> None:
    """The samples are the pixels, from which the level of larger blocks, if given, is subtracted."""
    draw = np.random.default_rng(7)
    pixels, coarse = draw.integers(80, 120, (67, 131)).astype(dtype), draw.uniform(90.0, 110.0, (2, 3))
    assert_forms_agree(_samples, pixels, 4, 8, 2, 4, coarse, relative=1e-6)
    assert_forms_agree(_samples, pixels, 2, 3, 1, 3, coarse[:1, :1], relative=1e-6, compiled=False)
    assert_forms_agree(_samples, pixels, 1, 2, 4, 8, np.zeros((0, 0)), compiled=False)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_the_compiled_subtraction_of_a_background_equals_that_in_numpy(dtype: type[np.generic]) -> None:
    draw = np.random.default_rng(8)
    pixels = np.clip(draw.normal(60.0, 6.0, (43, 70)), 0.0, 255.0).astype(dtype)
    level, variance = draw.uniform(40.0, 80.0, (3, 4)), draw.uniform(30.0, 50.0, (3, 4))
    assert_forms_agree(_subtracted, pixels, level, variance, relative=1e-5)
    assert_forms_agree(_subtracted, pixels, level[:1, :1], variance[:1, :1], relative=1e-5)


@pytest.mark.parametrize("size", [1, 2, 25, 64])
def test_the_compiled_moments_of_blocks_equal_those_in_numpy(size: int) -> None:
    draw = np.random.default_rng(size)
    values = np.round(draw.normal(100.0, 3.0, (3, 4, size))).astype(np.float32)
    values[0, 0, -1] = 5_000.0
    assert_forms_agree(_sorted_moments, np.sort(values, axis=-1), relative=1e-5, compiled=size == 25)


def test_the_compiled_filters_of_block_grids_equal_those_in_numpy() -> None:
    draw = np.random.default_rng(8)
    level = np.add.outer(3.0 * np.arange(7.0), np.arange(9.0)) + draw.normal(0.0, 1.0, (7, 9))
    assert 0.0 < _share_uneven.numpy_form(level, np.ones((7, 9))) < 1.0
    assert_forms_agree(_share_uneven, level, np.ones((7, 9)))
    assert_forms_agree(_median_of_neighbours, level)
    assert_forms_agree(_median_of_neighbours, level[:1, :2].copy(), compiled=False)
