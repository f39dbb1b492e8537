"""Tests of the survey of a frame against independent computations, and on frames with defects."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from knightcube.astro.arrays import FloatArray
from knightcube.vision.frame import Background, are_hot
from knightcube.vision.startracker.detect import find_peaks
from knightcube.vision.startracker.measurement import centre_of_mass
from knightcube.vision.startracker.psf_fit import NoiseModel, cut, light, measure_noise, profile
from knightcube.vision.startracker.survey import (
    Surface,
    _smoothed_above,
    _smoothed_at,
    find_areas,
    find_bright,
    measure_sky,
    share_one_rotation,
)
from tests.knightcube.vision.startracker.spoilt_scenes import (
    found_boresight,
    is_right,
    photographed,
    rendered,
    spoilt_scene,
)
from tests.sim_hal.star_camera.scenes import integrated_by_brute_force
from tests.support.compiled_forms import assert_forms_agree
from tests.support.photographs import PHOTOGRAPHS, angle_arcsec


@settings(max_examples=30, deadline=None)
@given(st.floats(-1.5, 1.5), st.floats(0.4, 3.0))
def test_the_derivatives_of_the_point_spread_are_those_of_its_share(place: float, sigma: float) -> None:
    step = 1e-5

    def share(x: float, s: float) -> FloatArray:
        return profile(np.array([x]), np.array([s]), 6)[0]

    _, by_place, by_sigma = profile(np.array([place]), np.array([sigma]), 6)
    numeric = (share(place + step, sigma) - share(place - step, sigma)) / (2.0 * step)
    assert by_place == pytest.approx(numeric, abs=1e-7)
    numeric = (share(place, sigma + step) - share(place, sigma - step)) / (2.0 * step)
    assert by_sigma == pytest.approx(numeric, abs=1e-7)


def test_the_light_is_the_integral_over_each_pixel() -> None:
    expected = integrated_by_brute_force((11, 11), np.array([[5.3, 4.8]]), 1.0, 0.9)
    assert light(np.array([[0.3, -0.2]]), np.array([0.9]), 5)[0] == pytest.approx(expected, abs=1e-12)


def test_the_window_s_centre_is_that_of_the_printed_sums() -> None:
    """The centre of a window agrees with equations 16 to 20, evaluated by loops over a x a pixels."""
    a = 7
    window = np.random.default_rng(1).uniform(0.0, 50.0, (a, a))
    window[3, 3] += 500.0
    border = [window[j, i] for j in range(a) for i in range(a) if j in (0, a - 1) or i in (0, a - 1)]
    assert len(border) == 4 * (a - 1)
    level = sum(border) / (4 * (a - 1))
    inner = [(i, j) for j in range(1, a - 1) for i in range(1, a - 1)]
    b = sum(window[j, i] - level for i, j in inner)
    x = sum(i * (window[j, i] - level) for i, j in inner) / b
    y = sum(j * (window[j, i] - level) for i, j in inner) / b
    windows = cut(window, np.array([[3, 3]]), 3, np.zeros(1), np.ones(1), np.inf)
    found = centre_of_mass(windows, NoiseModel(), 1.0)
    assert found.offset[0] + 3.0 == pytest.approx([x, y], abs=1e-12)
    assert found.flux[0] == pytest.approx(b)
    assert found.sky[0] == pytest.approx(level)


def test_bright_pixels_are_those_of_a_whole_frame_smoothed() -> None:
    rng = np.random.default_rng(2)
    frame = rng.normal(300.0, 8.0, (130, 101)).astype(np.uint16)
    sky = measure_sky(frame)
    kernel = np.outer([1, 2, 1], [1, 2, 1])
    smooth = ndimage.correlate(frame.astype(float), kernel)
    down, across = Surface(sky.smooth_level.values + 2.0 * sky.smooth_noise.values, frame.shape).factors()
    mask = smooth > down.astype(float) @ across.astype(float)
    mask[[0, -1]] = mask[:, [0, -1]] = False
    assert np.array_equal(find_bright(frame, sky, 2.0).index, np.flatnonzero(mask))


def test_areas_are_those_of_dense_labelling() -> None:
    rng = np.random.default_rng(3)
    frame = rng.normal(300.0, 8.0, (150, 170)).astype(np.uint16)
    sky = measure_sky(frame)
    bright = find_bright(frame, sky, 1.5)
    areas = find_areas(frame, sky, bright, None)
    mask = np.zeros(frame.shape, dtype=bool)
    mask.reshape(-1)[bright.index] = True
    labels, count = ndimage.label(mask, structure=np.ones((3, 3)))
    assert len(areas) == count
    pairs = set(zip(labels[areas.row, areas.column].tolist(), areas.owner.tolist(), strict=True))
    assert len(pairs) == count


def test_surfaces_agree_with_the_background_s_own_map() -> None:
    shape = (210, 333)
    grid = np.random.default_rng(4).uniform(0.0, 10.0, (3, 5))
    expected = Background(grid, grid, shape).map(grid)
    row, column = np.indices(shape).reshape(2, -1)
    assert Surface(grid, shape).at(column, row).reshape(shape) == pytest.approx(expected, abs=1e-5)
    down, across = Surface(grid, shape).factors()
    assert down @ across == pytest.approx(expected, abs=1e-4)


def test_a_plateau_counts_as_saturation_and_a_dim_frame_s_last_count_does_not() -> None:
    rng = np.random.default_rng(5)
    dim = rng.poisson(3.0, (200, 200)).astype(np.uint8)
    sky = measure_sky(dim)
    assert find_areas(dim, sky, find_bright(dim, sky, 3.0), None).ceiling == 255.0
    clipped = rng.normal(100.0, 5.0, (200, 200)).astype(np.uint16)
    clipped[50:54, 60:64] = 1023
    sky = measure_sky(clipped)
    areas = find_areas(clipped, sky, find_bright(clipped, sky, 5.0), None)
    assert areas.ceiling == 1023.0
    peaks = find_peaks(areas)
    assert len(peaks) == 1
    assert peaks.core[0] == pytest.approx(np.sqrt(16.0 / np.pi))


def test_the_noise_model_recovers_a_gain_and_a_mismatch() -> None:
    rng = np.random.default_rng(6)
    star = rng.uniform(10.0, 4000.0, (80, 7, 7))
    noise = np.full(80, 8.0)
    true = NoiseModel(0.5, 0.03)
    variance = true.variance(star, noise)
    residual = np.sqrt(variance) * rng.standard_normal(star.shape)
    found = measure_noise(residual, variance, np.zeros_like(star), star, noise, None)
    assert found.photon == pytest.approx(0.5, rel=0.25)
    assert found.mismatch == pytest.approx(0.03, rel=0.1)
    assert measure_noise(residual, variance, np.zeros_like(star), star, noise, 2.0).photon == 0.5


_KINDS = ("bright third", "stripes", "leaves", "hot 1 %")


@pytest.mark.parametrize("kind", _KINDS)
def test_a_frame_with_a_foreground_or_defects_is_solved(kind: str) -> None:
    (scene,) = rendered(1, 0.0)
    spoilt = spoilt_scene(scene, kind, 0)
    found = found_boresight(spoilt)
    assert found is not None
    assert angle_arcsec(found, scene.boresight) < 60.0


@pytest.mark.skipif(not PHOTOGRAPHS.is_dir(), reason="the photographs of ../shared/data/sky are missing")
def test_photographs_with_a_foreground_or_defects_are_solved_and_never_wrongly() -> None:
    """Photographs with a foreground or with defects are solved, and never wrongly.

    With a global noise estimate, and without the repair of hot pixels, only 1 of 8 frames was solved.
    """
    chosen = [s for s in photographed(PHOTOGRAPHS) if s.pixels.size < 800_000][:2]
    kinds = ("bright third", "hot 1 %")
    spoilt = [spoilt_scene(scene, kind, n) for kind in kinds for n, scene in enumerate(chosen)]
    found = [(scene, boresight) for scene in spoilt if (boresight := found_boresight(scene)) is not None]
    assert len(found) >= 3
    assert all(is_right(scene, boresight) for scene, boresight in found)


def test_one_or_two_bright_pixels_are_hot_and_a_sharp_star_is_not() -> None:
    noise = np.ones(3)
    one, two, star = np.zeros(9), np.zeros(9), np.array([3.0, 12, 3, 12, 50, 12, 3, 12, 3])
    one[4], two[[4, 5]] = 50.0, (50.0, 40.0)
    assert are_hot(np.stack([one, two, star], axis=1), noise).tolist() == [True, True, False]


@pytest.mark.parametrize(
    ("shift", "turn"), [((1.0, 0.0), 0.0), ((0.0, 0.0), 1.0), ((0.5, -0.3), 2.0), ((3.0, 2.0), -1.0)]
)
def test_lines_along_the_flow_of_a_rotation_share_it_and_other_lines_do_not(
    shift: tuple[float, float], turn: float
) -> None:
    rng = np.random.default_rng(6)
    centre = rng.uniform(-1.0, 1.0, (30, 2))
    flow = np.array(shift) + turn * np.stack([-centre[:, 1], centre[:, 0]], axis=1)
    direction = np.arctan2(flow[:, 1], flow[:, 0]) + rng.choice([0.0, np.pi], 30)
    pixels = 500.0 + 400.0 * centre
    assert share_one_rotation(pixels, direction + 0.01 * rng.standard_normal(30))
    assert not share_one_rotation(pixels, rng.permutation(direction) + 0.3 * rng.standard_normal(30))
    diverging = np.arctan2(centre[:, 1], centre[:, 0])
    assert not share_one_rotation(pixels, diverging)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("shape", [(16, 16), (70, 131)])
def test_the_compiled_smoothing_equals_that_in_numpy(
    dtype: type[np.number[Any]], shape: tuple[int, int]
) -> None:
    draw = np.random.default_rng(shape)
    pixels = draw.integers(0, 200, shape).astype(dtype)
    limit = Surface(draw.uniform(1_500.0, 1_900.0, (shape[0] // 16, shape[1] // 16)), shape)
    assert_forms_agree(_smoothed_above, pixels, *limit.factors())
    row, column = np.arange(2, shape[0] - 1, 4), np.arange(2, shape[1] - 1, 4)
    assert_forms_agree(_smoothed_at, pixels, row, column)
