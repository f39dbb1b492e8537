"""Tests of windows around stars, and of the noise model, on drawn pixels with known noise."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.special import ndtr

from knightcube.astro.arrays import FloatArray
from knightcube.vision.startracker import psf_fit
from knightcube.vision.startracker.psf_fit import (
    NoiseModel,
    StarTargets,
    StarWindows,
    _noise_terms,
    _solve,
    cut,
    fit,
    light,
    measure_noise,
    neighbour_light,
    neighbours,
    path,
    profile,
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


def test_the_profile_is_the_integral_of_a_gaussian_over_each_pixel() -> None:
    offset, sigma, half = np.array([0.3, -1.2]), np.array([0.8, 1.4]), 6
    share, by_offset, by_sigma = profile(offset, sigma, half)
    pixel = np.arange(-6, 7)
    for star in (0, 1):
        upper, lower = ((pixel + side - offset[star]) / sigma[star] for side in (0.5, -0.5))
        assert share[star] == pytest.approx(ndtr(upper) - ndtr(lower))
    step = 1e-6
    ahead, behind = (profile(offset + way * step, sigma, half)[0] for way in (1.0, -1.0))
    assert by_offset == pytest.approx((ahead - behind) / (2.0 * step), abs=1e-8)
    ahead, behind = (profile(offset, sigma + way * step, half)[0] for way in (1.0, -1.0))
    assert by_sigma == pytest.approx((ahead - behind) / (2.0 * step), abs=1e-8)


def test_a_path_is_sampled_with_the_moments_of_uniform_motion() -> None:
    """The nodes have the moments of a uniform line: mean 0, variance L^2/12, fourth moment L^4/80."""
    trail = np.array([[3.0, -1.0], [0.0, 2.0]])
    shift, share = (np.array(each) for each in zip(*path(trail), strict=True))
    assert share.sum() == pytest.approx(1.0)
    assert np.tensordot(share, shift, 1) == pytest.approx(np.zeros((2, 2)), abs=1e-12)
    assert np.tensordot(share, shift**2, 1) == pytest.approx(trail**2 / 12.0)
    assert np.tensordot(share, shift**4, 1) == pytest.approx(trail**4 / 80.0)
    # A path that is much shorter than a pixel is a point.
    for short in (np.array([[0.9 * psf_fit._SHORTEST, 0.0]]), np.zeros((0, 2))):
        ((only, whole),) = path(short)
        assert whole == 1.0
        assert only.shape == short.shape
        assert not only.any()
    assert len(path(np.array([[-1.1 * psf_fit._SHORTEST, 0.0]]))) > 1


def test_the_image_of_a_moving_star_has_its_moments() -> None:
    offset, sigma, trail = np.array([[0.4, -0.7]]), np.array([0.9]), np.array([[3.0, 1.0]])
    image = light(offset, sigma, 9, trail)[0]
    row, column = np.mgrid[-9:10, -9:10]
    assert image.sum() == pytest.approx(1.0)
    assert (np.sum(image * column), np.sum(image * row)) == pytest.approx((0.4, -0.7))
    square = 0.9**2 + 1.0 / 12.0
    assert np.sum(image * (column - 0.4) ** 2) == pytest.approx(square + 9.0 / 12.0, rel=1e-3)
    assert np.sum(image * (row + 0.7) ** 2) == pytest.approx(square + 1.0 / 12.0, rel=1e-3)
    assert np.sum(image * (row + 0.7) * (column - 0.4)) == pytest.approx(3.0 / 12.0, rel=1e-3)


def test_targets_have_windows_around_their_own_or_other_pixels() -> None:
    pixels = np.arange(400.0).reshape(20, 20)
    trail = np.array([[0.0, 0.0], [2.0, 1.0]])
    targets = StarTargets(
        pixels,
        np.array([[5, 6], [12, 9]]),
        np.array([10.0, 20.0]),
        np.ones(2),
        300.0,
        np.zeros(2),
        trail,
        1.1,
    )
    own, other = targets.windows(1), targets.windows(1, np.array([[3, 4], [7, 8]]))
    assert own.light[1].tolist() == (pixels[8:11, 11:14] - 20.0).tolist()
    assert other.light[0].tolist() == (pixels[3:6, 2:5] - 10.0).tolist()
    assert other.middle.tolist() == [[3, 4], [7, 8]]
    assert own.trail.tolist() == trail.tolist()
    second = targets.select(np.array([False, True]))
    assert len(targets) == 2
    assert len(second) == 1
    assert (second.level.tolist(), second.ceiling, second.correlation) == ([20.0], 300.0, 1.1)


_NOISE = NoiseModel(photon=0.5, mismatch=0.02)
_TRUE = np.array([[0.4, -0.3, 3000.0, 5.0, 1.1], [-0.2, 0.6, 800.0, -3.0, 1.4]])


def _counts(values: FloatArray, trail: FloatArray, half: int = 5) -> FloatArray:
    return np.asarray(light(values[:, :2], values[:, 4], half, trail) * values[:, 2, None, None])


@pytest.mark.parametrize("free_width", [False, True])
@pytest.mark.parametrize("length", [0.0, 2.5])
def test_stars_without_noise_are_fitted_exactly(free_width: bool, length: float) -> None:
    """The fit finds position, flux, sky and width, and the covariance of a linear fit at the solution.

    The residuals of the fit are zero, and the leverages of all pixels add up to the number of parameters.
    """
    trail = np.array([[length, -0.5 * length]] * 2)
    model = _counts(_TRUE, trail)
    good = np.random.default_rng(4).random((2, 11, 11)) < 0.9
    noise = np.array([6.0, 8.0])
    windows = StarWindows(np.zeros((2, 2), np.int64), 5, model + _TRUE[:, 3, None, None], good, noise, trail)
    width = _TRUE[:, 4] + (0.2 if free_width else 0.0)
    found = fit(windows, _TRUE[:, :2] + [0.3, -0.4], 0.8 * _TRUE[:, 2], width, _NOISE, free_width, 12)
    assert found.offset == pytest.approx(_TRUE[:, :2], abs=1e-6)
    assert found.flux == pytest.approx(_TRUE[:, 2], rel=1e-6)
    assert found.sky == pytest.approx(_TRUE[:, 3], abs=1e-4)
    assert found.width == pytest.approx(_TRUE[:, 4], abs=1e-6)
    assert found.chi2 == pytest.approx([0.0, 0.0], abs=1e-6)
    assert found.used.tolist() == np.count_nonzero(good, axis=(1, 2)).tolist()
    assert found.model == pytest.approx(model, abs=1e-3)
    assert found.residual == pytest.approx(np.zeros((2, 11, 11)), abs=1e-3)
    variance = noise[:, None, None] ** 2 + 0.5 * model + (0.02 * model) ** 2
    assert found.variance[good] == pytest.approx(variance[good], rel=1e-5)
    assert np.all(np.isinf(found.variance[~good]))
    assert not found.leverage[~good].any()
    count = 5 if free_width else 4
    assert found.leverage.sum(axis=(1, 2)) == pytest.approx([count] * 2, rel=1e-5)
    for star in (0, 1):
        rows = []
        for place, step in enumerate((1e-5, 1e-5, 1e-2, 1e-4, 1e-5)[:count]):
            moved = [_TRUE.copy(), _TRUE.copy()]
            moved[0][star, place] += step
            moved[1][star, place] -= step
            ahead, behind = (_counts(each, trail)[star] + each[star, 3] for each in moved)
            rows.append(((ahead - behind) / (2.0 * step))[good[star]])
        change = np.array(rows)
        covariance = np.linalg.inv((change / variance[star][good[star]]) @ change.T)
        assert found.covariance[star] == pytest.approx(
            covariance, rel=1e-3, abs=1e-4 * np.abs(covariance).max()
        )


def test_a_hot_pixel_is_excluded_from_the_fit() -> None:
    trail = np.zeros((2, 2))
    counts = _counts(_TRUE, trail) + _TRUE[:, 3, None, None]
    counts[0, 2, 8] += 400.0
    windows = StarWindows(
        np.zeros((2, 2), np.int64), 5, counts, np.ones((2, 11, 11), dtype=np.bool_), np.full(2, 6.0), trail
    )
    found = fit(windows, _TRUE[:, :2], _TRUE[:, 2], _TRUE[:, 4], _NOISE, False, 6)
    assert found.used.tolist() == [120, 121]
    assert np.isinf(found.variance[0, 2, 8])
    assert found.offset == pytest.approx(_TRUE[:, :2], abs=0.01)
    part = found.select(np.array([1]))
    assert part.flux.tolist() == [found.flux[1]]
    both = found.replaced(np.array([0]), part)
    assert both.flux.tolist() == [found.flux[1]] * 2
    assert found.flux[0] == pytest.approx(3000.0, rel=0.01)
    assert found.used.tolist() == [120, 121]


def test_steps_of_the_fit_are_limited() -> None:
    values = np.array([[0.0, 0.5, 100.0, 1.0, 1.2], [4.8, -4.9, 50.0, 0.0, 0.3]])
    step = np.array([[3.0, -2.0, 900.0, -40.0, 2.0], [0.6, -0.6, 10.0, 5.0, -0.2]])
    psf_fit._advance(values, step, 5)
    longest, widest = psf_fit._LONGEST_STEP, psf_fit._WIDEST_STEP
    assert values[0] == pytest.approx([longest, 0.5 - longest, 1000.0, -39.0, 1.2 + widest])
    assert values[1] == pytest.approx([5.0, -5.0, 60.0, 5.0, psf_fit.NARROWEST])
    fixed = np.array([[0.0, 0.0, 100.0, 1.0, 9.0]])
    psf_fit._advance(fixed, np.array([[0.1, 0.2, 1.0, 1.0]]), 3)
    assert fixed[0] == pytest.approx([0.1, 0.2, 101.0, 2.0, 3.0])


def test_normal_matrices_of_different_units_are_inverted() -> None:
    root = np.random.default_rng(3).normal(size=(4, 5, 9)) * np.array([1e3, 1e2, 1.0, 1e-3, 10.0])[:, None]
    normal = root @ root.swapaxes(1, 2)
    out = np.empty((5, 5))
    for one, found in zip(normal, psf_fit._inverse(normal), strict=True):
        assert found == pytest.approx(np.linalg.inv(one), rel=1e-5)
        psf_fit._invert(np.tril(one), np.empty((6, 5)), out)
        assert out == pytest.approx(found, rel=1e-4)
    assert psf_fit._inverse(np.zeros((1, 4, 4)))[0].shape == (4, 4)


def test_the_terms_of_the_noise_are_not_negative() -> None:
    """A least-squares fit with a negative coefficient is replaced by the better fit of a single term."""
    light = np.array([1.0, 2.0, 5.0, 9.0])
    of_light, of_both, of_square = (float(np.sum(light**power)) for power in (2, 3, 4))

    def fitted(excess: FloatArray) -> tuple[float, float]:
        along, across = float(excess @ light), float(excess @ light**2)
        return psf_fit._non_negative(of_light, of_both, of_square, along, across)

    assert fitted(3.0 * light + 0.5 * light**2) == pytest.approx((3.0, 0.5))
    linear, bent = 3.0 * light - 0.1 * light**2, 2.0 * light**2 - 1.0 * light
    assert fitted(linear) == pytest.approx((float(linear @ light) / of_light, 0.0))
    assert fitted(bent) == pytest.approx((0.0, float(bent @ light**2) / of_square))
    assert fitted(-light) == (0.0, 0.0)
    same = np.full(4, 2.0)
    first, second, third = (float(np.sum(same**power)) for power in (2, 3, 4))
    assert psf_fit._non_negative(first, second, third, 16.0, 32.0) == pytest.approx((1.0, 0.0))


def test_the_mismatch_of_the_psf_is_the_median_over_the_stars() -> None:
    """Most stars determine the mismatch, so a star with the light of a neighbour does not change it."""
    rng = np.random.default_rng(7)
    light, noise = rng.uniform(100.0, 900.0, (9, 5, 5)), np.full(9, 3.0)
    variance = 9.0 + 0.25 * light + (0.04 * light) ** 2
    residual = np.sqrt(0.8 * variance)
    residual[2] *= 30.0
    found = measure_noise(residual, variance, np.full(light.shape, 0.2), light, noise, 4.0)
    assert found.photon == pytest.approx(0.25)
    assert found.mismatch == pytest.approx(0.04, rel=1e-6)
    # Pixels with little light, with infinite variance, or with a high leverage are not counted.
    for spoilt in ("light", "variance", "leverage"):
        values = {"light": light.copy(), "variance": variance.copy(), "leverage": np.full(light.shape, 0.2)}
        off = residual.copy()
        off[:, 2] = 1e4
        values[spoilt][:, 2] = {"light": 1.4, "variance": np.inf, "leverage": 0.81}[spoilt]
        again = measure_noise(off, values["variance"], values["leverage"], values["light"], noise, 4.0)
        assert again.mismatch == pytest.approx(0.04, rel=1e-6)


def test_stars_in_reach_of_a_window_are_neighbours() -> None:
    """A neighbour is nearer than the half-width of the window plus three standard deviations of the PSF."""
    points = np.array([[10.0, 10.0], [17.9, 10.0], [10.0, 18.1], [11.5, 12.0], [9.0, 9.0]])
    flux = np.array([5.0, 4.0, 3.0, 2.0, 0.0])
    pairs = neighbours(points, flux, 1.0, 5)
    of_first = sorted(zip(pairs.first.tolist(), pairs.second.tolist(), strict=True))
    assert [pair for pair in of_first if pair[0] == 0] == [(0, 1), (0, 3)]
    assert [pair for pair in of_first if pair[0] == 4] == [(4, 0), (4, 3)]
    assert not any(second == 4 for _, second in of_first)
    assert pairs.overlap[0] == pytest.approx(np.exp(-(1.5**2 + 2.0**2) / 4.0))
    assert pairs.overlap[1] == 0.0
    assert pairs.overlap[4] == pytest.approx(np.exp(-2.0 / 4.0))
    close = neighbours(points + np.array([[0.0], [0.0], [0.0], [-1.4], [0.0]]), flux, 1.0, 5)
    assert close.overlap[0] == pytest.approx(psf_fit._MOST_OVERLAP)


def test_the_light_of_neighbours_is_drawn_in_the_window_of_a_star() -> None:
    middle, offset = np.array([[20, 30], [23, 28], [60, 60]]), np.array([[0.2, -0.3], [0.4, 0.1], [0.0, 0.0]])
    flux, width = np.array([900.0, 400.0, 100.0]), np.array([1.0, 1.3, 1.0])
    trail = np.array([[0.0, 0.0], [2.0, 1.0], [0.0, 0.0]])
    pairs = neighbours(middle + offset, flux, 1.0, 4)
    blank = np.zeros((3, 9, 9))
    windows = StarWindows(middle, 4, blank, blank > 1.0, np.ones(3), trail)
    found = neighbour_light(pairs, windows, middle, offset, flux, width)
    place = np.array([[3.0 + 0.4, -2.0 + 0.1]])
    assert found[0] == pytest.approx(400.0 * light(place, width[1:2], 4, trail[1:2])[0])
    back = np.array([[-3.0 + 0.2, 2.0 - 0.3]])
    # If any star moves, the paths of all stars are sampled.
    assert found[1] == pytest.approx(900.0 * light(back, width[:1], 4)[0])
    assert not found[2].any()


@pytest.mark.parametrize("sigma", [0.25, 1.1, 6.0])
def test_the_series_of_the_profile_equals_the_normal_distribution(sigma: float) -> None:
    for offset in np.linspace(-4.5, 4.5, 19):
        found = np.empty((3, 10))
        psf_fit._profile(offset, sigma, found)
        for one, other in zip(found, profile(np.array([offset]), np.array([sigma]), 4), strict=True):
            assert one[:-1] == pytest.approx(other[0], abs=1e-12)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_the_compiled_windows_equal_those_in_numpy(dtype: type[np.number[Any]]) -> None:
    draw = np.random.default_rng(6)
    pixels = draw.integers(0, 200, (30, 24)).astype(dtype)
    middle = np.concatenate([draw.integers(0, 24, (8, 2)), [[0, 0], [23, 29]]])
    assert_forms_agree(psf_fit._cut, pixels, middle, 4, draw.uniform(0.0, 9.0, 10), 180.0)


def test_the_compiled_light_of_neighbours_equals_that_in_numpy() -> None:
    draw = np.random.default_rng(7)
    place, width = draw.uniform(-6.0, 6.0, (9, 2)), draw.uniform(0.5, 2.0, 9)
    shift, share = draw.normal(size=(4, 9, 2)), np.array([0.1, 0.4, 0.4, 0.1])
    own = draw.integers(0, 3, 9)
    assert_forms_agree(psf_fit._summed_light, own, place, np.arange(9.0), width, shift, share, 3, 4)


def test_the_compiled_search_of_neighbours_equals_that_in_numpy() -> None:
    draw = np.random.default_rng(8)
    points, flux = draw.uniform(0.0, 60.0, (40, 2)), draw.normal(1.0, 1.0, 40)
    assert len(psf_fit._pairs.numpy_form(points, flux, 1.0, 7.0)[0]) > 32
    assert_forms_agree(psf_fit._pairs, points, flux, 1.0, 7.0)
