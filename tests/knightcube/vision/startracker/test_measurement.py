"""Tests of the alternative centroids: noiseless star positions, and the effect of each pixel."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.vision.startracker.measurement import (
    METHODS,
    _crowded,
    _flux_errors,
    _spread_evenly,
    _starts,
    single_pixels,
)
from knightcube.vision.startracker.psf_fit import cut, light
from tests.support.compiled_forms import assert_forms_agree

PLACES = np.array([[0.0, 0.0], [0.3, -0.2], [-0.45, 0.4]])
WIDTH = 0.9
SKY = 4.0
"""Variance (counts^2) of each pixel."""


def _stars(flux: float) -> FloatArray:
    return flux * light(PLACES, np.full(len(PLACES), WIDTH), 3)


def _start(clean: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the centres of mass, and zeros instead of their derivatives, which must have no effect."""
    step = np.arange(-3.0, 4.0)
    total = clean.sum(axis=(1, 2))
    x, y = clean.sum(axis=1) @ step / total, clean.sum(axis=2) @ step / total
    return np.stack([x, y], axis=1), np.zeros((len(clean), 2, 7, 7))


@pytest.mark.parametrize(("method", "limit"), [("weighted", 0.02), ("gaussian", 0.01), ("iterative", 0.01)])
def test_a_star_without_noise_is_found_where_it_is(method: str, limit: float) -> None:
    clean = _stars(5e4)
    places, _ = METHODS[method](clean, clean + SKY, _start(clean), WIDTH)
    assert np.abs(places - PLACES).max() < limit


@pytest.mark.parametrize("method", sorted(METHODS))
def test_the_slopes_are_those_of_finite_differences(method: str) -> None:
    clean = _stars(5e4)
    variance, start = clean + SKY, _start(clean)
    _, slopes = METHODS[method](clean, variance, start, WIDTH)
    step = 0.5
    for row, column in ((3, 3), (2, 4), (4, 2), (3, 5)):
        moved = []
        for sign in (1.0, -1.0):
            changed = clean.copy()
            changed[:, row, column] += sign * step
            moved.append(METHODS[method](changed, variance, start, WIDTH)[0])
        numeric = (moved[0] - moved[1]) / (2.0 * step)
        # The derivatives assume constant weights of the parabola. The weights depend on the pixels only in
        # second order.
        assert slopes[:, :, row, column] == pytest.approx(numeric, rel=0.15, abs=2e-8)


def test_a_star_too_faint_for_a_parabola_keeps_its_centre_of_mass() -> None:
    clean = _stars(20.0)
    start = _start(clean)
    places, slopes = METHODS["gaussian"](clean, np.full_like(clean, 100.0), start, WIDTH)
    assert np.array_equal(places, start[0])
    assert np.array_equal(slopes, start[1])


@pytest.mark.parametrize("noise", [0.3, 1.0, 8.0])
def test_only_sharp_pixels_well_above_the_noise_are_hot(noise: float) -> None:
    star = np.array([[3.0, 12, 3], [12, 50, 12], [3, 12, 3]])
    cores = [np.zeros((3, 3)) for _ in range(4)]
    cores[0][1, 1], cores[1][1, 1], cores[2][1, 1:] = 11.0, 9.0, (50.0, 40.0)
    cores[3] = star
    pixels = np.zeros((9, 9 * len(cores)))
    for k, core in enumerate(cores):
        pixels[3:6, 9 * k + 3 : 9 * k + 6] = noise * core
    middle = np.array([[9 * k + 4, 4] for k in range(len(cores))])
    windows = cut(pixels, middle, 4, np.zeros(len(cores)), np.full(len(cores), noise), np.inf)
    assert single_pixels(windows).tolist() == [True, False, True, False]


def test_the_compiled_measurements_of_windows_equal_those_in_numpy() -> None:
    draw = np.random.default_rng(1)
    model = draw.uniform(-1.0, 30.0, (6, 7, 7))
    model[2] *= -1.0
    flux, noise = model.sum(axis=(1, 2)), draw.uniform(1.0, 4.0, 6)
    assert_forms_agree(_starts, model - 10.0, noise)
    assert_forms_agree(_flux_errors, model, draw.random(model.shape) < 0.9, flux, noise, 0.5)


def test_the_compiled_choice_of_stars_equals_that_in_numpy() -> None:
    draw = np.random.default_rng(2)
    middle = draw.integers(0, 120, (60, 2))
    assert 10 < np.count_nonzero(_crowded.numpy_form(middle)) < 60
    assert_forms_agree(_crowded, middle)
    chosen = np.flatnonzero(draw.random(60) < 0.9)
    assert len(_spread_evenly.numpy_form(middle, chosen)[0]) < len(chosen)
    assert_forms_agree(_spread_evenly, middle, chosen)
