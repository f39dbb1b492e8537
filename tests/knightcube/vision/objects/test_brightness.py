"""Tests of the weights of pixels, and of the non-negative fit of brightnesses."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import nnls

from knightcube.errors import KnightCubeError
from knightcube.vision.objects import brightness
from knightcube.vision.objects.brightness import (
    brightnesses,
    counts_at,
    equations,
    equations_with,
    pixel_weights,
)
from tests.support.compiled_forms import assert_forms_agree


def test_pixels_are_weighted_by_noise_photons_and_the_error_of_the_model() -> None:
    """The variance of 300 counts at 2 electrons per count is 12^2 + 150 + (10 % of 300)^2."""
    signal = np.array([300.0, -50.0, 449.0, 451.0])
    weight = pixel_weights(signal[None], 500.0, 12.0, 2.0, 1000.0)[0]
    assert weight[0] == pytest.approx(1.0 / np.sqrt(144.0 + 150.0 + 900.0))
    assert weight[1] == pytest.approx(1.0 / 12.0)
    assert weight[2] > 0.0
    assert weight[3] == 0.0
    image = signal.reshape(2, 2).astype(np.float32)
    pixels = np.array([[0, 0], [1, 0], [1, 1]])
    found, weights, expected = counts_at(image, pixels, 500.0, 12.0, 2.0, 1000.0)
    assert found.tolist() == [300.0, -50.0, 451.0]
    assert weights == pytest.approx(weight[[0, 1, 3]])
    # Only the noise of the background and of the photons is expected in chi-square.
    assert expected == pytest.approx((144.0 + 150.0) / (144.0 + 150.0 + 900.0) + 1.0)


@pytest.mark.parametrize("saturation", [60.0, np.inf])
def test_all_forms_return_the_same_counts_and_weights(saturation: float) -> None:
    draw = np.random.default_rng(6)
    image = draw.normal(20.0, 30.0, (12, 15)).astype(np.float32)
    pixels = np.stack([draw.integers(0, 15, 40), draw.integers(0, 12, 40)], axis=1)
    assert_forms_agree(counts_at, image, pixels, 5.0, 4.0, 2.0, saturation)
    assert counts_at(image, pixels[:0], 5.0, 4.0, 2.0, saturation)[2] == 0.0
    assert np.isfinite(saturation) == bool(
        np.any(counts_at(image, pixels, 5.0, 4.0, 2.0, saturation)[1] == 0.0)
    )


def test_equations_that_are_not_positive_definite_are_refused() -> None:
    normal = np.array([[1.0, 2.0], [2.0, 1.0]])
    with pytest.raises(KnightCubeError, match="not positive definite"):
        brightnesses(normal, np.ones(2), 2.0)
    assert brightness._non_negative.loop_form(normal, np.ones(2))[-1] == brightness._NOT_DEFINITE


def test_brightnesses_are_those_of_non_negative_least_squares() -> None:
    draw = np.random.default_rng(3)
    images = draw.uniform(0.0, 1.0, (4, 50)) * np.array([1.0, 30.0, 0.1, 5.0])[:, None]
    data = np.array([40.0, 2.0, 0.0, 3.0]) @ images - 30.0 * images[2] + draw.normal(size=50)
    found, chi_square = brightnesses(images @ images.T, images @ data, float(data @ data))
    expected, residual = nnls(images.T, data)
    assert found == pytest.approx(expected, rel=1e-5, abs=1e-6)
    assert chi_square == pytest.approx(residual**2, rel=1e-6)
    assert np.any(found == 0.0)


@pytest.mark.parametrize("size", [1, 2, 5, 12, 30])
def test_all_forms_fit_the_same_brightnesses(size: int) -> None:
    draw = np.random.default_rng(size)
    for number in range(6):
        images = np.maximum(draw.normal(0.3, 1.0, (size, 80)), 0.0)
        data = draw.normal(0.1 * number, 1.0, 80) + 0.5 * images[0]
        sums = equations(images, data)
        assert_forms_agree(brightness._non_negative, sums[:-1], sums[-1], compiled=number == 0)
    dark = equations(images, -np.abs(data))
    for solve in (brightness._non_negative.numpy_form, brightness._non_negative.loop_form):
        found, decrease, failure = solve(dark[:-1], dark[-1])
        assert np.all(found == 0.0)
        assert decrease == pytest.approx(0.0, abs=1e-9)
        assert failure == 0


def test_equal_and_empty_images_have_finite_brightnesses() -> None:
    """Equal images may share the brightness in any way, but the chi-square is that of a single image."""
    draw = np.random.default_rng(5)
    image = draw.uniform(0.0, 1.0, 40)
    data = 7.0 * image + draw.normal(size=40)
    sums = equations(np.array([image, np.zeros(40), image, image]), data)
    alone = equations(image[None], data)
    expected = brightnesses(alone[:-1], alone[-1], float(data @ data))
    for solve in (brightness._non_negative.numpy_form, brightness._non_negative.loop_form):
        found, decrease, failure = solve(sums[:-1], sums[-1])
        assert failure == 0
        assert np.all(found >= 0.0)
        assert found[[0, 2, 3]].sum() == pytest.approx(expected[0][0], rel=1e-6)
        assert float(data @ data) - decrease == pytest.approx(expected[1], rel=1e-6)


def test_all_forms_return_the_same_equations_and_weights() -> None:
    draw = np.random.default_rng(7)
    images = draw.normal(size=(4, 30))
    images[0, :9], images[1, 12:], images[2] = 0.0, 0.0, 0.0
    images[3, :20] = 0.0
    target = draw.normal(size=30)
    assert_forms_agree(equations, images, target)
    whole = equations(images, target)
    # One more image adds a row and a column to the equations.
    given = images[:3], target, equations(images[:3], target), images[3]
    assert_forms_agree(equations_with, *given)
    assert equations_with(*given) == pytest.approx(whole)
    for saturation in (60.0, np.inf):
        assert_forms_agree(pixel_weights, draw.normal(20.0, 30.0, (6, 9)), 5.0, 4.0, 2.0, saturation)


def test_a_fit_that_does_not_converge_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(brightness, "_ITERATIONS", 0)
    normal, right = np.eye(2), np.ones(2)
    assert brightness._non_negative.loop_form(normal, right)[-1] == brightness._NOT_CONVERGED

    def give_up(*_: object, **__: object) -> None:
        raise RuntimeError("Maximum number of iterations reached.")

    monkeypatch.setattr(brightness, "nnls", give_up)
    monkeypatch.setattr(brightness, "_non_negative", brightness._non_negative.numpy_form)
    with pytest.raises(KnightCubeError, match="does not converge"):
        brightnesses(normal, right, 2.0)
