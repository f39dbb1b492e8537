"""Tests of stars found in the running sums on circles about the rotation axis."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import uniform_filter
from scipy.special import ndtr

from knightcube.astro.arrays import FloatArray
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.frame import box_sum
from knightcube.vision.streaks import faint_stars
from knightcube.vision.streaks.camera_motion import CameraMotion
from knightcube.vision.streaks.faint_stars import (
    find_faint,
    less_boxes,
    overlap_of,
    profile,
    sharp_peaks,
    standing_peaks,
)
from knightcube.vision.streaks.frame import reduce_frame
from knightcube.vision.streaks.geometry import paths
from knightcube.vision.streaks.polar_grid import ACROSS, PolarGrid, RunningSums
from tests.sim_hal.star_camera.scenes import integrated_by_brute_force
from tests.support.compiled_forms import assert_forms_agree


def _grid(length: float) -> PolarGrid:
    """Return a polar grid of 12 circles and 160 samples with the given streak length in samples."""
    polar, azimuth = 0.5 + 0.002 * np.arange(12.0), -0.8 + 0.01 * np.arange(160.0)
    return PolarGrid(np.eye(3), polar, azimuth, length, 0.01 * length, np.sin(polar) * 900.0)


def test_streaks_overlap_by_their_common_part_on_the_detector() -> None:
    span = np.array([0.0, 100.0])
    assert overlap_of(np.array(10.0), np.array(14.0), span, 8.0) == pytest.approx(0.5)
    assert overlap_of(np.array(14.0), np.array(10.0), span, 8.0) == pytest.approx(0.5)
    assert overlap_of(np.array(10.0), np.array(19.0), span, 8.0) == 0.0
    assert overlap_of(np.array(1.0), np.array(2.0), span, 8.0) == pytest.approx(5.0 / 8.0)
    assert overlap_of(np.array(99.0), np.array(99.0), span, 8.0) == pytest.approx(5.0 / 8.0)
    assert _grid(9.0).off_centre == 0.0
    assert _grid(8.0).off_centre == 0.5


def test_the_response_across_a_streak_is_that_of_three_pixels() -> None:
    """The profile is the fraction of a normal distribution within 1.5 px, relative to that at the centre."""
    distance = np.array([0.0, 0.5, -1.24, 2.0, -4.0])
    within = ndtr((distance + 1.5) / 1.05) - ndtr((distance - 1.5) / 1.05)
    assert profile(distance) == pytest.approx(within / within[0], abs=0.01)
    assert profile(np.zeros(1))[0] == 1.0
    assert profile(np.array([50.0]))[0] < 1e-3


@pytest.mark.parametrize("seed", range(4))
def test_local_maxima_are_the_highest_of_their_neighbours(seed: int) -> None:
    """A local maximum is not lower than its neighbours on three circles, at most two columns away."""
    values = np.random.default_rng(seed).integers(0, 30, (7, 13)).astype(np.float32)
    high = np.arange(values.size) % (1 + seed) == 0
    ring = values.reshape(-1)
    expected = []
    for p in np.flatnonzero(high):
        around = [ring[(p + 13 * down + beside) % 91] for down in (-1, 0, 1) for beside in range(-2, 3)]
        expected += [p] if ring[p] == max(around) else []
    assert faint_stars._summits(ring, high, 13).tolist() == expected
    assert_forms_agree(faint_stars._summits, ring, high, 13, compiled=False)


def test_peaks_are_refined_by_a_parabola() -> None:
    row, column = np.indices((9, 12))
    values = (50.0 - 2.0 * (row - 4.3) ** 2 - 0.5 * (column - 6.8) ** 2).astype(np.float32)
    at = np.array([4]), np.array([7])
    found = faint_stars._refined(values, *at)
    assert found[0] == pytest.approx([4.3], abs=1e-4)
    assert found[1] == pytest.approx([6.8], abs=1e-4)
    # A maximum at the edge of the grid stays there.
    edge = np.array([0]), np.array([11])
    found = faint_stars._refined(values, *edge)
    assert found[0] == pytest.approx([0.0])
    assert found[1][0] <= 11.0
    outside = (50.0 - 2.0 * (row - 9.3) ** 2).astype(np.float32)
    last = np.array([8]), np.array([5])
    assert faint_stars._refined(outside, *last)[0] == pytest.approx([8.0])
    assert_forms_agree(faint_stars._refined, outside, *last, relative=1e-6, compiled=False)
    assert_forms_agree(faint_stars._refined, values, *at, relative=1e-6, compiled=False)
    assert_forms_agree(faint_stars._refined, values, *edge, relative=1e-6, compiled=False)


def test_counts_are_subtracted_from_the_sums_of_pixels() -> None:
    """The 3 x 3 sums are those of the frame after subtraction of the counts, and zero at the border."""
    rng = np.random.default_rng(3)
    image = rng.integers(0, 100, (9, 11)).astype(np.float32)
    pixels = np.array([0, 10, 14, 15, 37, 44, 54, 88, 98, 60])
    taken = rng.integers(1, 40, len(pixels)).astype(np.float32)
    after = image.copy()
    after.reshape(-1)[pixels] -= taken
    expected = 9.0 * uniform_filter(after.astype(float), 3, mode="constant")
    expected[[0, -1]] = 0.0
    expected[:, [0, -1]] = 0.0
    found = less_boxes(box_sum(image).reshape(-1), (9, 11), pixels, taken)
    assert found.reshape(9, 11) == pytest.approx(expected, abs=1e-3)
    assert_forms_agree(less_boxes, box_sum(image).reshape(-1), (9, 11), pixels, taken, compiled=False)


def _responses(grid: PolarGrid, span: FloatArray, stars: list[tuple[float, float, float]]) -> FloatArray:
    """Return the filter responses (r, c) of stars given by fractional row, column and height."""
    i, j = np.indices((len(grid.polar), len(grid.azimuth)))
    out = np.zeros(i.shape)
    for row, column, height in stars:
        low = np.maximum(np.maximum(j, column) - 0.5 * grid.length, span[i, 0])
        high = np.minimum(np.minimum(j, column) + 0.5 * grid.length, span[i, 1])
        distance = (i - row) * ACROSS
        across = ndtr((distance + 1.5) / 1.05) - ndtr((distance - 1.5) / 1.05)
        near = (i > int(row) - 5) & (i < int(row) + 6)
        common = near * np.maximum(high - low, 0.0) / grid.length
        out += height * common * across / (2.0 * ndtr(1.5 / 1.05) - 1.0)
    return out


_SPAN = np.stack([np.linspace(2.5, 8.5, 12), np.linspace(140.5, 150.5, 12)], axis=1)
_STARS = [(5.2, 60.0, 900.0), (6.0, 71.5, 500.0), (4.4, 8.0, 300.0), (5.0, 120.0, 700.0), (9.7, 118.0, 450.0)]


def test_responses_are_truncated_triangles_with_the_profile_across() -> None:
    """The responses of stars are divided by the noise and subtracted where the noise is known."""
    grid = _grid(20.0)
    expected = _responses(grid, _SPAN, _STARS)
    scale = np.random.default_rng(1).choice([0.0, 0.02], expected.shape, p=[0.4, 0.6]).astype(np.float32)
    out = np.zeros_like(scale)
    arguments = scale, _SPAN, grid.length, tuple(np.array(_STARS).T)
    faint_stars._subtract_responses(out, *arguments)
    assert -out == pytest.approx(scale * expected, abs=0.015 * 900.0 * 0.02)
    assert np.all((out < 0.0) == ((expected > 0.0) & (scale > 0.0)))
    assert_forms_agree(
        faint_stars._subtract_responses, np.ones_like(scale), *arguments, relative=1e-5, compiled=False
    )


def test_significant_sums_have_the_reciprocal_of_their_noise() -> None:
    rng = np.random.default_rng(4)
    light = rng.normal(0.0, 40.0, (12, 70)).astype(np.float32)
    count, excess = rng.integers(0, 21, (12, 70)).astype(np.int32), np.linspace(1.0, 2.0, 12)
    noise = np.append(np.full(7, np.inf), np.sqrt(np.arange(7.0, 21.0)))
    deviation = noise[count] * excess[:, None]
    expected = np.where(light > 5.0 * deviation, 1.0 / deviation, 0.0)
    arguments = light, count, noise, excess, 5.0
    assert 50 < np.count_nonzero(expected) < 700
    assert faint_stars._scales(*arguments) == pytest.approx(expected, rel=1e-6)
    assert_forms_agree(faint_stars._scales, *arguments, relative=1e-6, compiled=False)


def test_heights_of_overlapping_stars_are_separated() -> None:
    """The sum of the responses with the solved heights is the measured response."""
    grid = _grid(20.0)
    light = _responses(grid, _SPAN, _STARS).astype(np.float32)
    held = RunningSums(light, np.full(light.shape, 20, np.int32), _SPAN, np.ones(12))
    row, column, height = (np.array(each) for each in zip(*_STARS, strict=True))
    found = faint_stars._heights(held, np.rint(row), np.rint(column), grid)
    sharp = faint_stars._heights(held, row, column, grid)
    assert found == pytest.approx(height, rel=0.25)
    assert np.abs(sharp - height).max() < 0.25 * 900.0
    noise = np.append(np.inf, np.arange(1.0, 30.0))
    held.excess[5] = 2.0
    peaks = np.array([5.0, 9.0]), np.array([60.0, 8.0]), np.array([80.0, 40.0])
    # The second star has only 9.2 of its 20 samples on the detector.
    first = np.interp(9.0, np.arange(12.0), _SPAN[:, 0])
    expected = [80.0 / (20.0 * 2.0), 40.0 * (18.0 - first) / 20.0 / 20.0]
    assert faint_stars._significance(held, noise, grid, peaks) == pytest.approx(expected)


def test_pairs_of_overlapping_stars_are_listed_with_their_overlaps() -> None:
    length, row, column = 20.0, np.array([1.0, 1.5, 4.0, 6.2, 12.0]), np.array([30.0, 38.0, 55.0, 36.0, 30.0])
    spans = np.tile([-0.5, 200.5], (5, 1))
    spans[1, 1] = 40.5
    one, other, overlap = faint_stars._overlaps(row, column, spans, length)
    pairs = [(0, 0), (0, 1), (1, 0), (1, 1), (1, 2), (1, 3), (2, 1), (2, 2), (2, 3), (3, 1), (3, 2), (3, 3)]
    assert sorted(zip(one.tolist(), other.tolist(), strict=True)) == [*pairs, (4, 4)]
    matrix = np.zeros((5, 5))
    matrix[one, other] = overlap
    assert matrix == pytest.approx(matrix.T)
    assert matrix[0, 0] == matrix[4, 4] == pytest.approx(1.01, abs=1e-5)
    assert matrix[1, 1] == pytest.approx(1.01 * 12.5 / 20.0, abs=1e-5)
    # The common part of both streaks is from 28 to the edge at 40, and the circles are 0.9 px apart.
    assert matrix[0, 1] == pytest.approx(12.0 / 20.0 * profile(np.array([0.9]))[0])
    assert_forms_agree(faint_stars._overlaps, row, column, spans, length, compiled=False)


def test_sparse_equations_are_solved() -> None:
    rng = np.random.default_rng(6)
    matrix = np.diag(rng.uniform(2.0, 4.0, 8))
    for i, j in ((0, 1), (1, 5), (2, 7), (3, 4), (0, 6)):
        matrix[i, j] = matrix[j, i] = rng.uniform(-0.9, 0.9)
    one, other = np.nonzero(matrix)
    right = rng.normal(size=8)
    found = faint_stars._solved(one, other, matrix[one, other], right)
    assert found == pytest.approx(np.linalg.solve(matrix, right), abs=1e-3)


def test_peaks_that_stronger_peaks_cause_are_omitted() -> None:
    """A peak counts by the height that remains after the responses of stronger peaks are subtracted.

    The first star has the response 100, of which half remains at a distance of half a streak length.
    """
    length, spans = 20.0, np.tile([-0.5, 200.5], (6, 1))
    row = np.array([5, 5, 5, 5, 7, 5])
    column = np.array([50, 60, 100, 41, 50, 145])
    value = np.array([100.0, 93.0, 80.0, 60.0, 40.0, 8.0])
    # Heights after subtraction: 100, 93 - 50 = 43 (46 %), 80, 60 - 55 - 2 = 3, 40 - 3 = 37, and 8, below 9.
    across = ndtr((2 * ACROSS + 1.5) / 1.05) - ndtr((2 * ACROSS - 1.5) / 1.05)
    assert 40.0 - 100.0 * across > 10.0
    arguments = row, column, value, spans, length, 9.0
    assert faint_stars._unshaded(*arguments).tolist() == [True, True, True, False, True, False]
    assert_forms_agree(faint_stars._unshaded, *arguments, compiled=False)
    # At the edge of the detector, a star's own response is smaller, but not its response at its neighbours.
    spans[:, 0] = 48.0
    value[1] = 100.0
    assert_forms_agree(faint_stars._unshaded, row, column, value, spans, length, 9.0, compiled=False)


def test_peaks_of_two_stars_on_one_circle_are_separated() -> None:
    """The second difference of the response separates bright stars closer than a streak length."""
    grid = _grid(50.0)
    span = np.tile([-0.5, 159.5], (12, 1))
    light = _responses(grid, span, [(5.0, 60.0, 900.0), (5.0, 84.0, 800.0)]).astype(np.float32)
    held = RunningSums(light, np.full(light.shape, 50, np.int32), span, np.ones(12))
    scale = np.where(light > 30.0, np.float32(1.0), np.float32(0.0))
    row, column = sharp_peaks(held, scale, grid)
    assert row == pytest.approx([5.0, 5.0], abs=0.1)
    assert column == pytest.approx([60.0, 84.0], abs=0.1)
    assert len(sharp_peaks(held, np.float32(1e-3) * scale, grid)[0]) == 0
    assert len(sharp_peaks(held, scale, _grid(30.0))[0]) == 0
    arguments = light.reshape(-1), held.count.reshape(-1), scale.reshape(-1), 50.0
    assert_forms_agree(faint_stars._second_differences, *arguments, relative=1e-6, compiled=False)
    # Without the second difference, only the stronger of the two peaks is found in the first pass.
    row, column = standing_peaks(light, span, 50.0, 30.0)
    assert column[0] == pytest.approx(60.0, abs=1.0)
    assert len(column) < 3


_SMALL = Pinhole(150, 110, 700.0)


def _faint_frame(stars: FloatArray, electrons: FloatArray, motion: CameraMotion) -> FloatArray:
    """Return a frame of 150 x 110 px with streaks and a background of 100 +- 3 counts."""
    image = np.random.default_rng(2).normal(100.0, 3.0, (110, 150))
    time = np.linspace(-0.5, 0.5, 300)
    for star, light in zip(stars, electrons, strict=True):
        where = paths(_SMALL, motion, np.tile(star, (300, 1)), time).position
        image += integrated_by_brute_force((110, 150), where, light, 1.0)
    return image


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_faint_stars_are_found_with_position_and_flux(way: float) -> None:
    """Faint streaks are found with their positions at mid-exposure and their fluxes.

    The significance is the flux in 3 x 3 samples along the streak, relative to the noise. A star that is
    already modelled is not found again.
    """
    motion = CameraMotion.steady(way * np.array([0.025, 0.035, 0.1]))
    stars = np.array([[40.3, 30.7], [100.6, 80.2], [75.0, 52.0], [115.4, 25.9]])
    electrons = np.array([900.0, 1500.0, 4000.0, 600.0])
    frame = reduce_frame(np.rint(_faint_frame(stars, electrons, motion)).astype(np.uint16), 60000.0, 1.0)
    nothing = np.zeros(0, np.int64), np.zeros(0, np.float32)
    found = find_faint(frame, nothing, _SMALL, motion, 6.0, 10)
    assert found.light == pytest.approx([4000.0, 1500.0, 900.0, 600.0], rel=0.2)
    assert found.stars == pytest.approx(stars[[2, 1, 0, 3]], abs=1.0)
    assert np.all(np.diff(found.significance) < 0.0)
    length = np.linalg.norm(
        np.diff(paths(_SMALL, motion, stars[[2, 2]], np.array([-0.5, 0.5])).position, axis=0)
    )
    # The streak's flux within three rows, divided by the noise of these rows at 3 counts per pixel.
    expected = 0.83 * 4000.0 / (3.0 * np.sqrt(3.0 * length))
    assert found.significance[0] == pytest.approx(expected, rel=0.25)
    alone = _faint_frame(stars[2:3], electrons[2:3], motion) - np.random.default_rng(2).normal(
        100.0, 3.0, (110, 150)
    )
    pixels = np.flatnonzero(alone > 1.0)
    rest = find_faint(frame, (pixels, alone.reshape(-1)[pixels].astype(np.float32)), _SMALL, motion, 6.0, 10)
    assert rest.light == pytest.approx([1500.0, 900.0, 600.0], rel=0.2)
    assert len(find_faint(frame, nothing, _SMALL, motion, 6.0, 2).light) == 2
    slow = CameraMotion.steady(0.1 * motion.rate)
    assert len(find_faint(frame, nothing, _SMALL, slow, 6.0, 10).light) == 0
