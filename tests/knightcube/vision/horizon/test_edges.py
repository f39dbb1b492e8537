"""Tests of edge detection on drawn steps of known position, scale, brightness and noise."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr

from knightcube.astro.arrays import FloatArray, select
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.horizon.edges import ImagePart, find_edges, observe, run_filtered
from knightcube.vision.horizon.settings import EdgeSettings

SIZE = 256
FEW = EdgeSettings(lines=8)
CENTRES = np.arange(16, 256, 32)
"""Centres (px) of eight equal strips of an image of 256 px, each between the pixels 15 and 16 of its strip.
"""


def step(place: float, width: float = 0.5, dark: float = 10.0, bright: float = 110.0) -> FloatArray:
    """Return an image that is bright to the right of `place` px, blurred by a Gaussian of `width` px."""
    line = dark + (bright - dark) * ndtr((np.arange(SIZE) - place) / width)
    return np.tile(line, (SIZE, 1))


def border(place: float) -> FloatArray:
    """Return an image that is bright between the columns `place` px and 60 px."""
    return np.where(np.arange(SIZE) < 60, step(place), 10.0)


def bars(*levels: float) -> FloatArray:
    """Return an image of vertical bars of equal width and given brightness."""
    return np.tile(np.repeat(np.array(levels), SIZE // len(levels)), (SIZE, 1))


def test_a_majority_of_the_window_decides_and_ends_are_continued() -> None:
    line = np.array([[0, 1, 1, 0, 0, 0, 0, 1, 1, 1, 0, 1, 1, 1, 0]], dtype=bool)
    assert run_filtered(line, 3).astype(int).tolist() == [[0, 1, 1, 0, 0, 0, 0, 1, 1, 1, 1, 1, 1, 1, 0]]
    # A majority filter of five pixels removes pairs and keeps groups of three.
    assert run_filtered(line, 5).astype(int).tolist() == [[0, 0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 1, 1, 1, 0]]
    assert run_filtered(line).tolist() == run_filtered(line, 5).tolist()
    assert run_filtered(line, 1).tolist() == line.tolist()


@pytest.mark.parametrize(
    ("width", "scale"), [(0.5, 1), (1.25, 1), (1.7, 2), (2.5, 2), (3.0, 4), (6.0, 8), (10.0, 8)]
)
def test_an_edge_is_placed_at_its_steepest_point_at_the_scale_that_covers_it(
    width: float, scale: float
) -> None:
    """An edge is located at its steepest point, at the smallest sufficient scale.

    The slope of a Gaussian edge of w px at the scale s is (1 + (w/s)^2)^-1/2. The next scale is used if it
    increases the slope by a factor of 1.4. This condition holds if w is at least 1.37 s.
    """
    edges, lines = find_edges(step(130.3, width), FEW)
    assert len(edges) == 8
    assert edges.points[:, 0] == pytest.approx(np.full(8, 130.3), abs=0.02 + 0.01 * width)
    assert edges.points[:, 1].tolist() == CENTRES.tolist() == lines.rows.tolist() == lines.columns.tolist()
    assert edges.towards.tolist() == [[1.0, 0.0]] * 8
    assert edges.scale.tolist() == [scale] * 8
    # The edge is also tested in the vertical direction, with the bright side above.
    upright, _ = find_edges(step(130.3, width).T[::-1], FEW)
    assert upright.points[:, 1] == pytest.approx(np.full(8, SIZE - 1 - 130.3), abs=0.02 + 0.01 * width)
    assert upright.towards.tolist() == [[0.0, -1.0]] * 8


def test_the_profile_and_the_background_are_the_pixels_across_the_edge() -> None:
    image = step(130.3, 2.0)
    edges, _ = find_edges(image, FEW)
    positions = edges.points[:, :1] + edges.profile_steps
    assert positions == pytest.approx(np.rint(positions), abs=1e-9)
    assert edges.profile == pytest.approx(np.interp(positions, np.arange(SIZE), image[0]))
    assert np.all(edges.profile_steps.min(axis=1) < -8.0)
    assert np.all(edges.profile_steps.max(axis=1) > 4.0)
    assert edges.background == pytest.approx(np.full(8, 10.0), abs=0.1)
    # A profile from the right has the same samples in reverse order.
    turned, _ = find_edges(image[:, ::-1], FEW)
    assert turned.profile == pytest.approx(edges.profile)
    assert turned.profile_steps == pytest.approx(edges.profile_steps, abs=1e-9)


def test_samples_outside_the_image_are_missing_from_a_profile() -> None:
    edges, _ = find_edges(border(6.2), FEW)
    edges = select(edges, edges.towards[:, 0] > 0.0)
    assert np.isnan(edges.profile).sum(axis=1).tolist() == [3] * 8
    assert np.isnan(edges.profile[:, :3]).all()
    far, _ = find_edges(border(9.2), FEW)
    assert not np.isnan(far.profile).any()


@pytest.mark.parametrize(("place", "count"), [(3.4, 0), (4.6, 8), (250.4, 8), (251.6, 0)])
def test_edges_within_four_pixels_of_the_border_are_ignored(place: float, count: int) -> None:
    """Edges within four pixels of the border are ignored.

    The image ends at 0 and 255 px, so the tested edges are 3.4, 4.6, 4.6 and 3.4 px from the border.
    """
    line = border(place) if place < 128 else border(255.0 - place)[:, ::-1]
    edges, _ = find_edges(line, FEW)
    assert np.count_nonzero(np.abs(edges.points[:, 0] - place) < 1.0) == count


def test_levels_are_those_of_a_dark_and_a_bright_half_and_the_noise_of_the_dark() -> None:
    noise = np.random.default_rng(1).normal(0.0, 3.0, (SIZE, SIZE))
    _, lines = find_edges(step(128.0) + noise, FEW)
    assert lines.levels.dark == pytest.approx(10.0, abs=1.0)
    assert lines.levels.bright == pytest.approx(110.0, abs=1.0)
    assert lines.levels.noise == pytest.approx(3.0, rel=0.08)
    assert lines.pixels == 16 * SIZE
    assert lines.space == SIZE / 8
    # A small disc of the Sun changes neither the brightness span nor the median.
    sun = step(128.0) + noise
    sun[14:20, 14:20] = 4000.0
    assert find_edges(sun, FEW)[1].levels.bright == pytest.approx(110.0, abs=2.0)


@pytest.mark.parametrize(("lit", "found"), [(7, False), (8, True)])
def test_fewer_than_sixteen_lit_pixels_are_a_star(lit: int, found: bool) -> None:
    """Fewer than sixteen lit samples are treated as a star, not as the Earth.

    Each pixel is sampled twice: in its row and in its column. Seven pixels thus count as 14 samples, and
    eight pixels as 16.
    """
    image = np.random.default_rng(2).normal(10.0, 1.0, (32, 64))
    image[10, 20 : 20 + lit] = 100.0
    levels = find_edges(image, EdgeSettings(lines=64))[1].levels
    assert (levels.bright > levels.dark) is found


@pytest.mark.parametrize(("low", "high", "found"), [(22.0, 38.0, True), (24.0, 36.0, False)])
def test_the_weakest_edge_is_a_seventh_of_the_span(low: float, high: float, found: bool) -> None:
    """The smallest contrast of an edge is 0.15 of the brightness span.

    Each step crosses the brightness threshold of 0.3, with a contrast above or below the limit of 0.15.
    """
    edges, _ = find_edges(bars(0.0, 0.0, low, high, 100.0, 100.0, 100.0, 100.0), FEW)
    at = edges.points[:, 0]
    assert np.count_nonzero(np.abs(at - 95.5) < 1.0) == (8 if found else 0)


@pytest.mark.parametrize(("grey", "place"), [(28.0, 127.5), (32.0, 63.5)])
def test_pixels_above_three_tenths_of_the_span_are_bright(grey: float, place: float) -> None:
    edges, _ = find_edges(bars(0.0, grey, 100.0, 100.0), FEW)
    assert edges.points[:, 0] == pytest.approx(np.full(8, place), abs=0.1)


@pytest.mark.parametrize(("sigmas", "lit"), [(5.5, False), (6.5, True)])
def test_pixels_within_six_sigma_of_the_dark_ones_are_not_bright(sigmas: float, lit: bool) -> None:
    """Pixels within six sigma of the dark pixels are not bright.

    A quarter of the image has a brightness of 100 sigma and determines the brightness span. One per cent of
    this span is below the noise.
    """
    noise = np.random.default_rng(3).normal(0.0, 1.0, (SIZE, SIZE))
    image = bars(0.0, sigmas, 0.0, 100.0) + noise
    low = EdgeSettings(lines=8, threshold=0.01, run=1)
    binary = find_edges(image, low)[1].bright[1][:, 64:128]
    assert (float(np.mean(binary)) > 0.5) is lit


def test_of_too_many_edges_those_with_the_darkest_side_are_kept() -> None:
    """If there are too many edges, the edges with the darkest side are kept.

    Eight bars on a rising background give 4 rising edges in each of 8 rows, of which two are kept.
    """
    image = bars(0.0, 100.0, 4.0, 100.0, 8.0, 100.0, 12.0, 100.0)
    settings = EdgeSettings(lines=8, most=2)
    edges, _ = find_edges(image, settings)
    assert len(edges) == 16
    assert edges.background.max() <= 4.0
    every, _ = find_edges(image, EdgeSettings(lines=8, most=7))
    assert len(every) == 7 * 8


def test_a_part_is_read_on_its_own_lines_with_the_levels_of_the_image() -> None:
    image = step(130.3)
    _, whole = find_edges(image, FEW)
    part = ImagePart(np.array([[100.0, 48.0], [150.0, 144.0]]), whole.levels)
    edges, lines = find_edges(image, FEW, part)
    assert lines.columns.tolist() == [112, 144]
    assert lines.rows.tolist() == [48, 80, 112, 144]
    assert lines.levels is whole.levels
    assert edges.points[:, 1].tolist() == [48, 80, 112, 144]
    nothing, none = find_edges(image, FEW, ImagePart(np.array([[1.0, 1.0], [2.0, 2.0]]), whole.levels))
    assert len(nothing) == none.pixels == 0
    assert {len(nothing.scale), len(nothing.sigma), len(nothing.background), len(nothing.profile)} == {0}


def test_a_bright_and_even_background_leaves_the_span_to_the_step() -> None:
    edges, _ = find_edges(step(130.3, dark=150.0, bright=170.0), FEW)
    assert edges.points[:, 0] == pytest.approx(np.full(8, 130.3), abs=0.03)


def test_small_images_are_read_completely() -> None:
    _, lines = find_edges(step(130.0)[:20, 100:160], EdgeSettings(lines=32))
    assert lines.rows.tolist() == list(range(20))
    assert len(lines.columns) == 32
    assert lines.space == 60 / 32


def test_directions_steps_and_samples_are_those_of_the_lens() -> None:
    camera = Pinhole.from_field_of_view(SIZE, SIZE, np.radians(60.0))
    edges, lines = find_edges(step(130.3), FEW)
    seen = observe(edges, lines, camera)
    here = camera.unit_vectors(edges.points)
    assert seen.rays.rays == pytest.approx(here)
    assert seen.across == pytest.approx(camera.unit_vectors(edges.points + np.array([1.0, 0.0])) - here)
    assert seen.down == pytest.approx(camera.unit_vectors(edges.points + np.array([0.0, 1.0])) - here)
    assert seen.rays.brighter == pytest.approx(seen.across)
    assert seen.rays.pixel == pytest.approx(np.linalg.norm(seen.across, axis=1))
    assert len(seen.rays) == len(edges)
    # The samples are every 32nd pixel of eight columns and eight rows. The right half of the samples is
    # bright.
    places = np.stack(np.meshgrid(CENTRES, CENTRES, indexing="ij"), axis=-1).reshape(-1, 2)
    points = np.concatenate([places, places[:, ::-1]]).astype(float)
    assert seen.samples.rays == pytest.approx(camera.unit_vectors(points))
    assert seen.samples.bright.tolist() == (points[:, 0] > 130.3).tolist()
    again = observe(edges, lines, camera, seen.samples)
    assert again.samples is seen.samples
    assert again.space == lines.space
