"""Threshold, regions, hot pixels."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from knightcube.vision.frame import box_sum, less_boxes, repair_hot_pixels
from knightcube.vision.streaks.corners.segmentation import find_regions, threshold_local, threshold_mean
from tests.knightcube.vision.streaks.frames import rate_at, star_camera, star_frame


def test_the_box_sum_is_nine_times_the_uniform_filter() -> None:
    image = np.random.default_rng(1).normal(size=(20, 31))
    np.testing.assert_allclose(box_sum(image)[1:-1, 1:-1], 9.0 * ndimage.uniform_filter(image, 3)[1:-1, 1:-1])


def test_diagonal_neighbours_are_one_region_and_small_regions_are_dropped() -> None:
    mask = np.zeros((30, 40), dtype=np.bool_)
    mask[np.arange(5, 25), np.arange(10, 30)] = True
    mask[2, 35] = True
    regions = find_regions(mask, mask.astype(np.float32), least_area=2)
    assert len(regions) == 1
    np.testing.assert_array_equal(regions.boxes, [[5, 25, 10, 30]])
    assert regions.area[0] == 20


def test_a_lines_length_comes_from_its_moments_whatever_its_width() -> None:
    signal = np.zeros((60, 120), dtype=np.float32)
    signal[20:25, 10:91] = 3.0
    regions = find_regions(signal > 0, signal, least_area=2)
    # Rows and columns of whole pixels: (81^2 - 1 - (5^2 - 1))/12 is the difference of the moments.
    assert regions.length[0] == pytest.approx(np.sqrt(81.0**2 - 5.0**2))
    assert regions.flux[0] == pytest.approx(3.0 * 5 * 81)


def test_an_empty_mask_has_no_regions() -> None:
    empty = np.zeros((16, 16), dtype=np.bool_)
    assert len(find_regions(empty, empty.astype(np.float32), 1)) == 0


def test_the_local_threshold_passes_normal_noise_at_its_own_rate() -> None:
    signal = np.random.default_rng(4).normal(0.0, 5.0, (700, 700)).astype(np.float32)
    passed = threshold_local(signal, np.full_like(signal, 5.0), 2.0).mean()
    # 2.275 % of a normal variable; neighbouring sums are correlated, so about 54,000 are independent.
    assert passed == pytest.approx(0.02275, abs=5.0 * np.sqrt(0.02275 / 54_000))


def test_the_thesiss_threshold_passes_half_of_a_noise_frame() -> None:
    noise = np.random.default_rng(5).normal(100.0, 10.0, (200, 200))
    assert threshold_mean(noise).mean() == pytest.approx(0.5, abs=0.02)


def test_hot_pixels_are_repaired_and_stars_are_left() -> None:
    camera = star_camera(512, psf_sigma=0.7)
    pixels = star_frame(camera, rate_at(0.5 * np.pi, 0.0), 1.0, seed=6)
    signal = pixels.astype(np.float32) - 150.0
    noise = np.full_like(signal, np.sqrt(150.0))
    clean = signal.copy()
    assert repair_hot_pixels(clean, noise) == 0
    np.testing.assert_array_equal(clean, signal)
    places = np.random.default_rng(7).integers(1, 511, (40, 2))
    places = places[clean[places[:, 0], places[:, 1]] < 60.0]
    for row, column in places:
        signal[row, column] = 3000.0
    assert repair_hot_pixels(signal, noise) == len(np.unique(places, axis=0))
    assert signal[places[:, 0], places[:, 1]].max() < 300.0


def test_light_taken_from_some_pixels_leaves_the_sums_of_what_is_left() -> None:
    """At the frame's corners and edges too."""
    generator = np.random.default_rng(9)
    image = generator.integers(0, 1000, (40, 50)).astype(np.float32)
    pixels = np.unique(np.append(generator.integers(0, image.size, 300), [0, 49, 50, image.size - 1]))
    taken = generator.integers(0, 500, len(pixels)).astype(np.float32)
    left = image.copy().reshape(-1)
    left[pixels] -= taken
    found = less_boxes(box_sum(image).reshape(-1), (40, 50), pixels, taken)
    np.testing.assert_array_equal(found.reshape(40, 50), box_sum(left.reshape(40, 50)))
