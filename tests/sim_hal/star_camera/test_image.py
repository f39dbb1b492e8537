"""Tests of star images: noise, saturation, counts, positions of stars at rest, and the limits of settings."""

from __future__ import annotations

import math
import subprocess
import sys
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import ndtr
from scipy.stats import kstest

from hal.interfaces.errors import OutOfRange
from knightcube.astro import catalogue, quaternion
from knightcube.astro.arrays import FloatArray, Image
from sim_hal.star_camera import StarCameraModel, expected_electrons, render, scatter_hot_pixels
from sim_hal.star_camera.image import counts, standard_normal
from tests.sim_hal.star_camera.scenes import (
    POINTING,
    at_pixels,
    centroid,
    integrated_by_brute_force,
    still,
    turning,
)

DEEP = StarCameraModel(columns=96, rows=96, field_of_view=np.radians(2.0), bits=16, full_well=60_000.0)
NO_STARS = np.zeros((0, 3))


def _frames(model: StarCameraModel, light: FloatArray, number: int, exposure: float = 1.0) -> Image:
    rng = np.random.default_rng(77)
    narrow = light.astype(np.float32)
    return np.stack([counts(model, narrow, exposure, rng) for _ in range(number)]).astype(float)


def _check_moments(frames: Image, mean: FloatArray, variance: FloatArray) -> None:
    """Assert that mean and variance of each pixel, and their averages, agree within sampling errors."""
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
    """Mean and variance of a pixel are right above and below the limit for faint light.

    The variance is 150 e-^2 of the background, up to 37.5 of faint light, and 1/12 of rounding.
    """
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
    """The moments are right without read noise.

    Without other noise, the steps of the Poisson distribution are visible.
    """
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


def test_the_drawn_noise_is_normal_and_not_correlated_between_pixels() -> None:
    """A Kolmogorov-Smirnov test of some rows of each frame refuses one frame in a hundred by chance."""
    frames = [standard_normal((512, 512), np.random.default_rng(seed)) for seed in range(20)]
    passed = [kstest(frame[::51].ravel(), "norm").pvalue > 0.01 for frame in frames]
    assert sum(passed) >= 18
    noise = np.concatenate(frames)
    assert noise.std() == pytest.approx(1.0, rel=2e-3)
    assert 4.6 < np.abs(noise).max() < 5.9
    beside = [np.mean(noise[1:] * noise[:-1]), np.mean(noise[:, 1:] * noise[:, :-1])]
    assert np.abs(beside).max() < 2e-3


def test_the_background_has_gaussian_tails() -> None:
    """The noise of the background has Gaussian tails, which are not truncated.

    The numbers of 4 million pixels beyond 3, 4 and 4.4 sigma are as expected.
    """
    model = replace(DEEP, dark_current=0.0, read_noise=100.0, pedestal=1000.0, columns=1000, rows=1000)
    z = (_frames(model, np.zeros((1000, 1000)), 4) - 1000.0) / 100.0
    for limit in (3.0, 4.0, 4.4):
        beyond = np.count_nonzero(np.abs(z) > limit + 0.001)
        expected = (
            2.0 * z.size * ndtr(-limit - 0.005)
        )  # a count is 0.01 sigma, so rounding shifts the bound by half a count, which is 0.005 sigma
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
    """A star saturates at the full well: 20,000 e- at 2 e-/count plus a pedestal of 100 are 10,100 counts.

    The read noise is 5 counts.
    """
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
    """The noise of the thesis (2.11), sqrt(signal) U + sqrt(RN^2 + DC T) U, is uniform and never negative.

    U is uniform between 0 and 1. The tested terms are sqrt(400) U and sqrt(150) U.
    """
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
    """Stray light increases across the frame, and has its own noise.

    The stray light is zero in the darkest corner. At 2 e-/count its variance is half its mean.
    """
    model = replace(DEEP, background_gradient=slopes, gain=2.0)
    across, down = slopes
    stray = across * np.arange(96) + down * np.arange(96)[:, None]
    stray -= stray.min()
    _check_moments(
        _frames(model, np.zeros((96, 96)), 200),
        100.0 + 25.0 + stray,
        150.0 / 4.0 + stray / 2.0 + 1.0 / 12.0,
    )


def test_an_impossible_gradient_is_refused() -> None:
    with pytest.raises(OutOfRange, match="background_gradient"):
        replace(DEEP, background_gradient=(0.0, float("nan")))


SMALL = StarCameraModel(columns=64, rows=48, field_of_view=np.radians(4.0))


def test_a_star_of_magnitude_zero_gives_liebes_flux() -> None:
    """A star of magnitude zero gives 1.8653e6 e- in 0.2 s, by Liebe's flux.

    The flux is 19,000 e-/s per mm^2, and the aperture is 25 mm.
    """
    image = expected_electrons(SMALL, at_pixels(SMALL, [30.2, 20.7]), [0.0], *still(0.2))
    assert image.sum() == pytest.approx(19_000 * math.pi * 12.5**2 * 0.2, rel=1e-5)


@pytest.mark.parametrize("psf", ["integrated", "bilinear"])
@pytest.mark.parametrize("point", [(30.0, 20.0), (30.5, 20.5), (31.27, 22.93)])
def test_no_light_is_lost_whatever_the_place_in_the_pixel(psf: str, point: tuple[float, float]) -> None:
    model = StarCameraModel(columns=64, rows=48, field_of_view=0.07, psf=psf)  # type: ignore[arg-type] # a str to mypy
    image = expected_electrons(model, at_pixels(model, point), [5.0], *still())
    assert image.sum() == pytest.approx(float(model.electrons(5.0, 1.0)), rel=1e-5)


def test_five_magnitudes_are_a_factor_of_a_hundred() -> None:
    """Five magnitudes are a factor of 100, because the scale is Pogson's (errata to 2.8).

    The factor 2.5 per magnitude would give 97.7.
    """
    star, history = at_pixels(SMALL, [30.2, 20.7]), still()
    bright, faint = (expected_electrons(SMALL, star, [v], *history).sum() for v in (1.0, 6.0))
    assert bright / faint == pytest.approx(100.0, rel=1e-5)


def test_light_grows_with_exposure_and_with_the_square_of_the_aperture() -> None:
    star = at_pixels(SMALL, [30.2, 20.7])
    wide = StarCameraModel(columns=64, rows=48, field_of_view=SMALL.field_of_view, aperture=0.05)
    once = expected_electrons(SMALL, star, [4.0], *still(0.5)).sum()
    assert expected_electrons(SMALL, star, [4.0], *still(1.0)).sum() == pytest.approx(2.0 * once, rel=1e-5)
    assert expected_electrons(wide, star, [4.0], *still(0.5)).sum() == pytest.approx(4.0 * once, rel=1e-5)


@settings(max_examples=40, deadline=None)
@given(st.floats(12.0, 50.0), st.floats(12.0, 35.0), st.sampled_from([0.6, 1.0, 1.7]))
def test_the_centroid_is_the_projection(x: float, y: float, sigma: float) -> None:
    """The centroid of a star is its projection.

    In an undersampled image, for example with sigma 0.3 px, the pixels would bias the centroid.
    """
    model = StarCameraModel(columns=64, rows=48, field_of_view=0.07, psf_sigma=sigma)
    image = expected_electrons(model, at_pixels(model, [x, y]), [-5.0], *still())
    assert centroid(image) == pytest.approx([x, y], abs=1e-3)


@pytest.mark.parametrize("sigma", [0.25, 0.5, 1.0, 2.5])
def test_the_image_is_the_gaussian_integrated_over_each_pixel(sigma: float) -> None:
    model = StarCameraModel(columns=64, rows=48, field_of_view=0.07, psf_sigma=sigma)
    point = np.array([[31.31, 22.84]])
    image = expected_electrons(model, at_pixels(model, point), [3.0], *still())
    expected = integrated_by_brute_force((48, 64), point, float(model.electrons(3.0, 1.0)), sigma)
    assert np.abs(image - expected).max() < 2e-4 * expected.max()


def test_the_thesis_kernel_appears_around_a_star_in_the_middle_of_a_pixel() -> None:
    """The image of a star in the middle of a pixel is the kernel of Sease 2.9, printed to four digits."""
    model = StarCameraModel(columns=64, rows=48, field_of_view=0.07, psf="bilinear")
    image = expected_electrons(model, at_pixels(model, [30.0, 20.0]), [3.0], *still()) / model.electrons(
        3.0, 1.0
    )
    printed = [[0.0751, 0.1238, 0.0751], [0.1238, 0.2041, 0.1238], [0.0751, 0.1238, 0.0751]]
    assert image[19:22, 29:32] == pytest.approx(np.array(printed), abs=1.1e-4)
    assert np.count_nonzero(image > 1e-6) == 9


def test_the_thesis_placement_shares_a_star_among_four_pixels() -> None:
    """The thesis's placement divides a star at (30.25, 20.4) among four pixels, by equations (2.5) and (2.6).

    The kernel is so narrow (sigma 0.2) that only 3.7e-6 of the light leaves a pixel.
    """
    model = StarCameraModel(columns=64, rows=48, field_of_view=0.07, psf="bilinear", psf_sigma=0.2)
    image = expected_electrons(model, at_pixels(model, [30.25, 20.4]), [3.0], *still()) / model.electrons(
        3.0, 1.0
    )
    assert image[20:22, 30:32] == pytest.approx(np.array([[0.45, 0.15], [0.30, 0.10]]), abs=1e-5)


def test_the_thesis_placement_and_kernel_together() -> None:
    """The thesis's placement of a star at (30.5, 20) and its kernel are combined.

    Along a row, the weights are g1/2, (g1 + g0)/2, (g1 + g0)/2, g1/2. Along a column, the weights are g1, g0,
    g1, with g0 = 0.4519 and g1 = 0.2741.
    """
    model = StarCameraModel(columns=64, rows=48, field_of_view=0.07, psf="bilinear")
    image = expected_electrons(model, at_pixels(model, [30.5, 20.0]), [3.0], *still()) / model.electrons(
        3.0, 1.0
    )
    across, down = np.array([0.13703, 0.36297, 0.36297, 0.13703]), np.array([0.27407, 0.45186, 0.27407])
    assert image[19:22, 29:33] == pytest.approx(np.outer(down, across), abs=2e-5)


def test_a_star_behind_the_camera_gives_no_light() -> None:
    """A star behind the camera gives no light.

    By the collinearity equations alone, a star behind the camera would appear at the same pixel as a star in
    the opposite direction (errata to 2.1).
    """
    star = at_pixels(SMALL, [30.2, 20.7])
    assert expected_electrons(SMALL, -star, [0.0], *still()).max() == 0.0
    assert expected_electrons(SMALL, star, [0.0], *still()).max() > 0.0


def test_a_star_on_the_detectors_edge_gives_half_its_light() -> None:
    image = expected_electrons(SMALL, at_pixels(SMALL, [-0.5, 20.0]), [3.0], *still())
    assert image.sum() == pytest.approx(0.5 * float(SMALL.electrons(3.0, 1.0)), rel=1e-3)
    corner = expected_electrons(SMALL, at_pixels(SMALL, [63.5, 47.5]), [3.0], *still())
    assert corner.sum() == pytest.approx(0.25 * float(SMALL.electrons(3.0, 1.0)), rel=1e-3)


def test_images_of_several_stars_add_up() -> None:
    points, magnitudes = [[20.3, 20.0], [24.1, 21.6], [50.0, 40.0]], [3.0, 4.0, 2.0]
    together = expected_electrons(SMALL, at_pixels(SMALL, points), magnitudes, *still())
    singly = [
        expected_electrons(SMALL, at_pixels(SMALL, point), [magnitude], *still())
        for point, magnitude in zip(points, magnitudes, strict=True)
    ]
    assert together == pytest.approx(sum(singly), abs=1e-6 * together.max())


def test_the_real_sky_puts_each_bright_star_where_the_pinhole_does() -> None:
    """Each star of Orion's belt in the real sky is centred on its pinhole projection."""
    stars = catalogue.load()
    belt = [int(np.flatnonzero(stars.hip == hip)[0]) for hip in (25930, 26311, 26727)]
    directions = stars.directions_at(2000.0)
    z = directions[belt[1]]
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    attitude = quaternion.from_matrix(np.stack([x, np.cross(z, x), z]))
    model = StarCameraModel(columns=512, rows=512)
    image = expected_electrons(
        model, directions, stars.magnitude, np.array([0.0, 0.2]), np.stack([attitude] * 2)
    )
    pixels = model.pinhole.project(directions[belt] @ quaternion.attitude_matrix(attitude).T)
    assert pixels[1] == pytest.approx([255.5, 255.5], abs=1e-6)
    for pixel in pixels:
        column, row = np.rint(pixel).astype(int)
        window = image[row - 5 : row + 6, column - 5 : column + 6]
        assert centroid(window) + np.array([column - 5, row - 5]) == pytest.approx(pixel, abs=0.02)


@pytest.mark.parametrize(
    ("name", "value"),
    [("columns", 0), ("field_of_view", 3.2), ("gain", 0.0), ("read_noise", float("nan")), ("bits", 17)],
)
def test_an_impossible_camera_is_refused(name: str, value: float) -> None:
    with pytest.raises(OutOfRange, match=name):
        StarCameraModel(**{name: value})  # type: ignore[arg-type] # wrong on purpose


def test_unknown_options_and_hot_pixels_off_the_detector_are_refused() -> None:
    with pytest.raises(ValueError, match="integrated or bilinear"):
        StarCameraModel(psf="airy")  # type: ignore[arg-type] # wrong on purpose
    with pytest.raises(OutOfRange, match="hot pixel's column"):
        StarCameraModel(hot_pixels=((1024, 0, 10.0),))


def test_impossible_stars_and_attitudes_are_refused() -> None:
    star, (times, attitudes) = at_pixels(SMALL, [30.0, 20.0]), still()
    with pytest.raises(ValueError, match="finite"):
        expected_electrons(SMALL, star * np.nan, [3.0], times, attitudes)
    with pytest.raises(ValueError, match=r"\(n, 3\) and \(n,\)"):
        expected_electrons(SMALL, star, [3.0, 4.0], times, attitudes)
    with pytest.raises(ValueError, match="k of 2 or more"):
        expected_electrons(SMALL, star, [3.0], times[:1], attitudes[:1])
    with pytest.raises(OutOfRange, match="time between"):
        expected_electrons(SMALL, star, [3.0], times[::-1], attitudes)
    with pytest.raises(OutOfRange, match="norm of an attitude"):
        expected_electrons(SMALL, star, [3.0], times, attitudes * np.nan)
    with pytest.raises(OutOfRange, match="norm of an attitude"):
        expected_electrons(SMALL, star, [3.0], times, 1.01 * attitudes)
    flipped = quaternion.multiply(quaternion.from_rotation_vector(np.array([3.0, 0.0, 0.0])), POINTING)
    with pytest.raises(OutOfRange, match="rotation between"):
        expected_electrons(SMALL, star, [3.0], times, np.stack([POINTING, flipped]))


def test_no_plotting_library_is_imported() -> None:
    code = (
        "import sys, sim_hal.star_camera, knightcube.astro.catalogue; sys.exit('matplotlib' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


DEFAULTS = {
    "columns": 1024, "rows": 1024, "field_of_view": math.radians(20.0), "aperture": 0.025,
    "zero_magnitude_flux": 1.9e10, "read_noise": 10.0, "dark_current": 50.0, "gain": 1.0, "pedestal": 100.0,
    "bits": 12, "full_well": 20_000.0, "psf_sigma": 1.0, "psf": "integrated", "noise": "poisson",
    "hot_pixels": (), "line_time": 0.0, "background_gradient": (0.0, 0.0), "lens": None,
}  # fmt: skip
RANGES = {
    "columns": (1, 16_384), "rows": (1, 16_384), "field_of_view": (1e-4, 2.8), "aperture": (1e-4, 10.0),
    "zero_magnitude_flux": (1.0, 1e13), "read_noise": (0.0, 1e5), "dark_current": (0.0, 1e8),
    "gain": (1e-3, 1e5), "pedestal": (0.0, 65_535.0), "bits": (1, 16), "full_well": (1.0, 1e9),
    "psf_sigma": (0.2, 20.0), "line_time": (0.0, 0.01),
}  # fmt: skip


def made(**changes: Any) -> StarCameraModel:
    """Return a star camera model."""
    return StarCameraModel(**changes)


def test_the_defaults_are_those_of_a_cubesats_camera() -> None:
    model = StarCameraModel()
    assert {field.name: getattr(model, field.name) for field in fields(model)} == DEFAULTS


@pytest.mark.parametrize("name", RANGES)
def test_a_value_may_lie_at_both_ends_of_its_range_and_not_beyond(name: str) -> None:
    low, high = RANGES[name]
    step = 1 if isinstance(low, int) else 1e-9
    for value, beyond in ((low, low - step), (high, high + step * max(1, high))):
        assert getattr(made(**{name: value}), name) == value
        with pytest.raises(OutOfRange):
            made(**{name: beyond})


@pytest.mark.parametrize(
    ("pixel", "possible"),
    [
        ((0, 0, 0.0), True), ((1023, 1023, 1e8), True), ((-1, 0, 1.0), False), ((1024, 0, 1.0), False),
        ((0, -1, 1.0), False), ((0, 1024, 1.0), False), ((0, 0, -1.0), False), ((0, 0, 1.01e8), False),
    ],
)  # fmt: skip
def test_a_hot_pixel_lies_on_the_sensor(pixel: tuple[int, int, float], possible: bool) -> None:
    if possible:
        assert made(hot_pixels=(pixel,)).hot_pixels == (pixel,)
        return
    with pytest.raises(OutOfRange):
        made(hot_pixels=(pixel,))


def test_stray_light_and_choices_are_checked() -> None:
    assert made(background_gradient=(-100.0, 100.0)).background_gradient == (-100.0, 100.0)
    for slope in (-100.1, 100.1):
        with pytest.raises(OutOfRange):
            made(background_gradient=(0.0, slope))
    for name in ("psf", "noise"):
        with pytest.raises(ValueError, match=name):
            made(**{name: "other"})


def test_counts_electrons_and_exposures_follow_from_the_model() -> None:
    assert (made(bits=8).highest_count, made(bits=12).highest_count) == (255, 4095)
    assert [made(bits=bits).count_type.__name__ for bits in (8, 9, 16)] == ["uint8", "uint16", "uint16"]
    area = math.pi * 0.0125**2
    assert made().electrons(0.0, 2.0) == pytest.approx(1.9e10 * area * 2.0)
    assert made().electrons([5.0], 1.0)[0] == pytest.approx(1.9e8 * area)
    rolling = made(rows=100, line_time=1e-3)
    assert rolling.exposure_within(0.3) == pytest.approx(0.2)
    with pytest.raises(OutOfRange):
        rolling.exposure_within(0.1)
