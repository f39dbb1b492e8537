"""Tests of windows around stars, and of the noise model, on drawn pixels with known noise."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.vision.startracker.psf_fit import (
    NoiseModel,
    _noise_terms,
    _solve,
    cut,
    light,
    measure_noise,
    path,
    smoothed,
)
from tests.support.compiled_forms import assert_forms_agree


def test_a_window_holds_the_counts_above_the_sky_and_marks_pixels_that_cannot_be_used() -> None:
    pixels = np.arange(100.0).reshape(10, 10)
    middle, level = np.array([[4, 5], [0, 9]]), np.array([10.0, 20.0])
    windows = cut(pixels, middle, 2, level, np.array([1.0, 2.0]), 57.0)
    assert len(windows) == 2
    assert windows.light.shape == windows.good.shape == (2, 5, 5)
    assert windows.light[0].tolist() == (pixels[3:8, 2:7] - 10.0).tolist()
    # Pixels of 57 or more counts are saturated, but their counts are kept.
    assert windows.good[0].tolist() == (pixels[3:8, 2:7] < 57.0).tolist()
    # Only nine pixels of the second window, in its lower left corner, are within the frame, and all nine are
    # saturated.
    assert windows.light[1, :3, 2:].tolist() == (pixels[7:, :3] - 20.0).tolist()
    assert np.count_nonzero(windows.light[1]) == 9
    assert not windows.good[1].any()
    assert windows.trail.tolist() == [[0.0, 0.0], [0.0, 0.0]]
    assert windows.without(windows.light).light.tolist() == np.zeros((2, 5, 5)).tolist()
    second = windows.select(np.array([1]))
    assert second.noise.tolist() == [2.0]
    assert second.half == 2


def test_smoothing_spreads_a_point_as_one_two_one_on_both_axes() -> None:
    light = np.zeros((1, 7, 7))
    light[0, 3, 2] = 1.0
    expected = np.zeros((7, 7))
    expected[2:5, 1:4] = np.outer([1.0, 2.0, 1.0], [1.0, 2.0, 1.0])
    assert smoothed(light)[0].tolist() == expected.tolist()
    border = smoothed(np.ones((1, 5, 5)))[0]
    assert border[1:-1, 1:-1].tolist() == np.full((3, 3), 16.0).tolist()
    assert float(border.sum()) == 9 * 16.0


@pytest.mark.parametrize(("photon", "mismatch"), [(0.5, 0.0), (0.0, 0.05), (0.5, 0.03), (0.0, 0.0)])
def test_photon_noise_and_mismatch_are_distinguished_by_their_growth_with_light(
    photon: float, mismatch: float
) -> None:
    """Photon noise and PSF mismatch are distinguished by their dependence on the light.

    The residuals have the variance s^2 + p m + q^2 m^2, which the fit has reduced by a fifth.
    """
    draw = np.random.default_rng(1)
    noise = draw.uniform(2.0, 4.0, 300)
    light = draw.uniform(0.0, 1.0, (300, 7, 7)) ** 3 * draw.uniform(50.0, 3000.0, (300, 1, 1))
    floor = np.broadcast_to((noise**2)[:, None, None], light.shape)
    true = floor + photon * light + (mismatch * light) ** 2
    leverage = np.full(light.shape, 0.2)
    residual = draw.normal(size=light.shape) * np.sqrt(true * (1.0 - leverage))
    found = measure_noise(residual, floor, leverage, light, noise, None)
    assert found.photon == pytest.approx(photon, rel=0.1, abs=0.02)
    assert found.mismatch == pytest.approx(mismatch, rel=0.1, abs=0.006)
    # Hot pixels that differ by more than five standard deviations are ignored.
    spoilt = residual.copy()
    spoilt[:, 3, 3] += 40.0 * np.sqrt(true[:, 3, 3])
    other = measure_noise(spoilt, floor, leverage, light, noise, None)
    assert other.photon == pytest.approx(photon, rel=0.3, abs=0.1)
    if photon > 0.0:
        # A known gain determines the photon noise. The mismatch is then the median over the stars.
        known = measure_noise(residual, floor, leverage, light, noise, 1.0 / photon)
        assert known.photon == pytest.approx(photon)
        assert known.mismatch == pytest.approx(mismatch, rel=0.1, abs=0.006)


def test_few_bright_pixels_do_not_determine_the_noise() -> None:
    light, leverage = np.full((1, 2, 2), 100.0), np.full((1, 2, 2), 0.2)
    found = measure_noise(light, light, leverage, light, np.ones(1), None)
    assert (found.photon, found.mismatch) == (0.0, 0.0)
    known = measure_noise(light, light, leverage, light, np.ones(1), 4.0)
    assert (known.photon, known.mismatch) == (0.25, 0.0)


def test_the_variance_of_a_pixel_is_the_sum_of_sky_photons_and_mismatch() -> None:
    """The variance of a pixel with 20 counts is 3^2 (noise) + 0.5 * 20 (photons) + (0.1 * 20)^2 (mismatch).

    Negative counts add no variance.
    """
    light = np.array([[[20.0, -20.0]]])
    variance = NoiseModel(photon=0.5, mismatch=0.1).variance(light, np.array([3.0]))
    assert variance[0, 0] == pytest.approx([23.0, 9.0])


@pytest.mark.parametrize("count", [4, 5])
@pytest.mark.parametrize("length", [0.0, 3.0])
def test_the_compiled_fit_equals_the_fit_in_numpy(count: int, length: float) -> None:
    draw = np.random.default_rng([count, round(length)])
    stars, half = 40, 4
    offset, width = draw.uniform(-0.6, 0.6, (stars, 2)), draw.uniform(0.6, 1.6, stars)
    flux = 10.0 ** draw.uniform(1.5, 5.0, stars)
    trail = np.full((stars, 2), [length, 0.5 * length])
    seen = light(offset, width, half, trail) * flux[:, None, None] + draw.normal(0.0, 10.0, (stars, 9, 9))
    seen[3, 4, 4] += 3_000.0  # a hot pixel
    good = draw.random(seen.shape) < 0.95
    good[5], good[6, :, :5] = False, False  # a star without usable pixels, and a star at the edge
    shift, share = zip(*path(trail), strict=True)
    start = np.column_stack([offset + 0.3, 0.8 * flux, np.zeros(stars), width + 0.2])
    assert_forms_agree(
        _solve,
        seen,
        good,
        np.full(stars, 10.0),
        np.array(shift),
        np.array(share),
        start,
        (0.5, 0.02),
        count,
        4,
        relative=1e-7,
    )


@pytest.mark.parametrize(("photon", "mismatch"), [(0.5, 0.0), (0.0, 0.05), (0.5, 0.03), (0.0, 0.0)])
def test_the_compiled_noise_model_equals_that_in_numpy(photon: float, mismatch: float) -> None:
    draw = np.random.default_rng(2)
    noise, light = draw.uniform(2.0, 4.0, 30), draw.uniform(1.0, 3_000.0, (30, 7, 7))
    true = (noise**2)[:, None, None] + photon * light + (mismatch * light) ** 2
    residual = draw.normal(size=light.shape) * np.sqrt(true)
    residual[:, 3, 3] += 1e4
    assert_forms_agree(
        _noise_terms, residual, np.full(light.shape, 0.2), light, noise, draw.random(light.shape) < 0.8
    )
