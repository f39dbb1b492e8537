"""Noise, saturation and counts: the first two moments against the model, pixel by pixel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtr

from hal.interfaces.errors import OutOfRange
from knightcube.astro.arrays import FloatArray, Image
from sim_hal.star_camera import StarCameraModel, expected_electrons, render, scatter_hot_pixels
from sim_hal.star_camera.image import counts
from tests.sim_hal.star_camera.scenes import at_pixels, still, turning

DEEP = StarCameraModel(columns=96, rows=96, field_of_view=np.radians(2.0), bits=16, full_well=60_000.0)
NO_STARS = np.zeros((0, 3))


def _frames(model: StarCameraModel, light: FloatArray, number: int, exposure: float = 1.0) -> Image:
    rng = np.random.default_rng(77)
    narrow = light.astype(np.float32)
    return np.stack([counts(model, narrow, exposure, rng) for _ in range(number)]).astype(float)


def _check_moments(frames: Image, mean: FloatArray, variance: FloatArray) -> None:
    """Hold every pixel's mean and variance, and their averages over the frame, to their sampling errors."""
    number = len(frames)
    z = (frames.mean(axis=0) - mean) / np.sqrt(variance / number)
    assert abs(z.mean()) < 5.0 / np.sqrt(z.size)
    assert z.std() == pytest.approx(1.0, abs=5.0 / np.sqrt(2.0 * z.size))
    ratio = frames.var(axis=0, ddof=1) / variance
    spread = np.sqrt(2.0 / (number - 1))
    assert ratio.mean() == pytest.approx(1.0, abs=5.0 * spread / np.sqrt(z.size) + 1e-4)
    assert ratio.std() == pytest.approx(spread, rel=0.2)


@pytest.mark.parametrize("light", [0.0, 3.0, 30.0, 37.4, 37.6, 60.0, 1000.0])
def test_mean_and_variance_are_right_on_both_sides_of_the_faint_limit(light: float) -> None:
    """Variance 150 e-^2 of the background, so faint to 37.5 e- of light; 1/12 is the rounding's."""
    image = np.full((96, 96), light)
    _check_moments(_frames(DEEP, image, 200), image + 150.0, image + 150.0 + 1.0 / 12.0)


def test_moments_are_right_in_every_pixel_of_a_star_field() -> None:
    rng = np.random.default_rng(5)
    stars = at_pixels(DEEP, rng.uniform(0.0, 95.0, (25, 2)))
    history = turning(np.array([20.0, 30.0, 0.0]) / DEEP.pinhole.focal_length)
    light = expected_electrons(DEEP, stars, rng.uniform(4.0, 8.0, 25), *history)
    assert np.count_nonzero(light > 37.5) > 500
    assert np.count_nonzero(light < 1.0) > 500
    frames = _frames(DEEP, light, 300)
    for region in (light < 1.0, (light > 1.0) & (light <= 37.5), light > 37.5):
        mean = light[region] + 150.0
        _check_moments(frames[:, region], mean, mean + 1.0 / 12.0)


def test_moments_are_right_without_read_noise() -> None:
    """Then nothing hides the Poisson steps, and each pixel is drawn as what it is."""
    model = replace(DEEP, read_noise=0.0, dark_current=4.0)
    light = np.full((96, 96), 0.5)
    frames = _frames(model, light, 200)
    _check_moments(frames, light + 104.0, light + 4.0)
    empty = np.exp(-4.5)
    assert np.mean(frames == 100.0) == pytest.approx(empty, abs=5.0 * np.sqrt(empty / frames.size))


def test_moments_scale_with_gain_and_exposure() -> None:
    model = replace(DEEP, gain=4.0, dark_current=400.0)
    image = np.full((96, 96), 200.0)
    mean, variance = 100.0 + (200.0 + 200.0) / 4.0, (200.0 + 200.0 + 100.0) / 16.0 + 1.0 / 12.0
    _check_moments(
        _frames(model, image, 200, exposure=0.5), np.full((96, 96), mean), np.full((96, 96), variance)
    )


def test_the_background_has_gaussian_tails() -> None:
    """Of 4 million pixels, as many lie beyond 3, 4 and 4.4 sigma as should: no table ends there."""
    model = replace(DEEP, dark_current=0.0, read_noise=100.0, pedestal=1000.0, columns=1000, rows=1000)
    z = (_frames(model, np.zeros((1000, 1000)), 4) - 1000.0) / 100.0
    for limit in (3.0, 4.0, 4.4):
        beyond = np.count_nonzero(np.abs(z) > limit + 0.001)
        expected = (
            2.0 * z.size * ndtr(-limit - 0.005)
        )  # a count is 0.01 sigma: beyond it from half a count on
        assert beyond == pytest.approx(expected, abs=5.0 * np.sqrt(expected))
    assert abs(np.count_nonzero(z > 4.0) - np.count_nonzero(z < -4.0)) < 5.0 * np.sqrt(
        2.0 * z.size * ndtr(-4.0)
    )


def test_pixels_and_frames_are_independent() -> None:
    frames = _frames(DEEP, np.zeros((96, 96)), 20) - 150.0
    scale = 150.0 * np.sqrt(frames.size)
    for other in (np.roll(frames, 1, axis=1), np.roll(frames, 1, axis=2), np.roll(frames, 1, axis=0)):
        assert abs(np.sum(frames * other)) < 5.0 * scale


def test_the_same_seed_gives_the_same_frame_and_another_does_not() -> None:
    star, history = at_pixels(DEEP, [40.0, 40.0]), still()
    first, again = (render(DEEP, star, [5.0], *history, np.random.default_rng(9)) for _ in range(2))
    other = render(DEEP, star, [5.0], *history, np.random.default_rng(10))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_a_bright_star_saturates_at_the_converters_top() -> None:
    model = replace(DEEP, bits=12)
    frame = render(model, at_pixels(model, [40.0, 40.0]), [0.0], *still(), np.random.default_rng(1))
    assert frame.max() == 4095
    assert frame[40, 40] == 4095


def test_a_bright_star_saturates_at_the_full_well() -> None:
    """20,000 e- at 2 e- a count and a pedestal of 100: 10,100 counts, and read noise of 5 counts on top."""
    model = replace(DEEP, full_well=20_000.0, gain=2.0)
    frame = render(model, at_pixels(model, [40.0, 40.0]), [-3.0], *still(), np.random.default_rng(1)).astype(
        float
    )
    full = frame[39:42, 39:42]
    assert full.mean() == pytest.approx(10_100.0, abs=5.0 * 5.0 / 3.0)
    assert np.all(np.abs(full - 10_100.0) < 30.0)
    quiet = replace(model, read_noise=0.0)
    frame = render(quiet, at_pixels(model, [40.0, 40.0]), [-3.0], *still(), np.random.default_rng(1))
    assert frame.max() == 10_100


def test_a_small_well_clips_the_background_too() -> None:
    model = replace(DEEP, full_well=40.0, read_noise=0.0)
    assert _frames(model, np.zeros((96, 96)), 2).max() == 140.0


@pytest.mark.parametrize(
    ("bits", "kind", "top"), [(8, np.uint8, 255), (10, np.uint16, 1023), (16, np.uint16, 65_535)]
)
def test_counts_have_the_converters_depth(bits: int, kind: type, top: int) -> None:
    model = replace(DEEP, bits=bits, full_well=1e6)
    frame = render(model, at_pixels(model, [40.0, 40.0]), [-5.0], *still(), np.random.default_rng(1))
    assert frame.dtype == kind
    assert frame.shape == (96, 96)
    assert frame.max() == top


def test_noise_below_a_missing_pedestal_is_cut_at_zero() -> None:
    model = replace(DEEP, pedestal=0.0, dark_current=0.0)
    frame = render(model, NO_STARS, [], *still(), np.random.default_rng(1))
    assert frame.min() == 0
    assert np.mean(frame == 0) == pytest.approx(ndtr(0.5 / 10.0), abs=0.03)


def test_light_is_rounded_to_the_nearest_count() -> None:
    model = replace(DEEP, read_noise=0.0, dark_current=0.0, noise="uniform", gain=10.0)
    frames = counts(model, np.zeros((96, 96), dtype=np.float32), 1.0, np.random.default_rng(1))
    assert np.all(frames == 100)


def test_the_thesis_noise_is_uniform_and_never_negative() -> None:
    """Text at 2.11: sqrt(signal) U + sqrt(RN^2 + DC T) U, U between 0 and 1; sqrt(400) and sqrt(150) here."""
    model = replace(DEEP, noise="uniform")
    image = np.full((96, 96), 400.0)
    frames = _frames(model, image, 200)
    shot, rest = 20.0, np.sqrt(150.0)
    mean, variance = 500.0 + 0.5 * (shot + rest), (shot**2 + rest**2 + 1.0) / 12.0
    _check_moments_of_uniform(frames, mean, variance)
    assert frames.min() >= 500.0
    assert frames.max() <= 500.0 + shot + rest + 0.5
    dark = _frames(model, np.zeros((96, 96)), 50)
    assert dark.min() == 100.0
    assert dark.max() == 112.0


def _check_moments_of_uniform(frames: Image, mean: float, variance: float) -> None:
    assert frames.mean() == pytest.approx(mean, abs=5.0 * np.sqrt(variance / frames.size))
    assert frames.var() == pytest.approx(variance, rel=0.01)


def test_the_thesis_noise_saturates_at_the_full_well() -> None:
    model = replace(DEEP, noise="uniform", full_well=1000.0, read_noise=0.0, dark_current=0.0)
    frame = counts(model, np.full((96, 96), 5000.0, dtype=np.float32), 1.0, np.random.default_rng(1))
    assert frame.max() == 1100


def test_a_hot_pixel_shows_its_own_dark_current_and_no_other() -> None:
    model = replace(DEEP, hot_pixels=((10, 20, 3000.0),))
    frames = _frames(model, np.zeros((96, 96)), 100, exposure=0.5)
    hot = frames[:, 20, 10]
    assert hot.mean() == pytest.approx(100.0 + 25.0 + 1500.0, abs=5.0 * np.sqrt(1625.0 / 100.0))
    frames[:, 20, 10] = 125.0
    assert np.abs(frames.mean(axis=0) - 125.0).max() < 8.0


def test_hot_pixels_are_scattered_reproducibly() -> None:
    model = scatter_hot_pixels(DEEP, 50, 500.0, np.random.default_rng(3))
    assert model == scatter_hot_pixels(DEEP, 50, 500.0, np.random.default_rng(3))
    assert len({(column, row) for column, row, _ in model.hot_pixels}) == 50


def test_a_source_brighter_than_any_number_of_wells_does_not_overflow() -> None:
    frame = render(DEEP, at_pixels(DEEP, [40.0, 40.0]), [-60.0], *still(), np.random.default_rng(1))
    assert int(frame[40, 40]) == pytest.approx(60_100, abs=60)


@pytest.mark.parametrize("slopes", [(2.0, 0.0), (0.0, -1.5), (0.5, 0.25)])
def test_stray_light_grows_across_the_frame_and_brings_its_own_noise(slopes: tuple[float, float]) -> None:
    """In counts a pixel from the darkest corner on; at 2 e- a count its variance is half its mean."""
    model = replace(DEEP, background_gradient=slopes, gain=2.0)
    across, down = slopes
    stray = across * np.arange(96) + down * np.arange(96)[:, None]
    stray -= stray.min()
    _check_moments(
        _frames(model, np.zeros((96, 96)), 200),
        100.0 + 25.0 + stray,
        150.0 / 4.0 + stray / 2.0 + 1.0 / 12.0,
    )


def test_a_gradient_that_cannot_be_is_refused() -> None:
    with pytest.raises(OutOfRange, match="background_gradient"):
        replace(DEEP, background_gradient=(0.0, float("nan")))
