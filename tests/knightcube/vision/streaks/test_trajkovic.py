"""Trajkovic and Hedley's cornerness: patches by hand, and the least over all directions by brute force."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.vision.streaks.corners.trajkovic import (
    interpixel_response,
    simple_response,
    trajkovic_response,
)

# Names of the ring around the centre c: rows are y, columns x.
#   f b g        b is at (x, y - 1), a at (x + 1, y)
#   e c a
#   h d i


def _patch(rows: list[list[float]]) -> FloatArray:
    return np.array(rows, dtype=float)


def _by_the_corrected_equations(patch: FloatArray) -> float:
    """Return 3.9-3.13 corrected at the middle of a 3 x 3 patch, in the thesis's own symbols."""
    centre, right, left, below, above = patch[1, 1], patch[1, 2], patch[1, 0], patch[2, 1], patch[0, 1]
    r_a = (right - centre) ** 2 + (left - centre) ** 2
    r_b = (below - centre) ** 2 + (above - centre) ** 2
    b1 = (below - right) * (right - centre) + (above - left) * (left - centre)
    b2 = (below - left) * (left - centre) + (above - right) * (right - centre)
    b = min(b1, b2)
    a = r_b - r_a - 2.0 * b
    if b < 0.0 and a + b > 0.0:
        return float(r_a - b**2 / a)
    return float(min(r_a, r_b))


def _by_brute_force(patch: FloatArray, neighbours: int) -> float:
    """Return the least squared change over 4001 diameters, the ring's intensities interpolated linearly."""
    ring = [(1, 2), (2, 2), (2, 1), (2, 0), (1, 0), (0, 0), (0, 1), (0, 2)]
    chosen = ring if neighbours == 8 else ring[::2]
    values = np.array([patch[place] for place in chosen]) - patch[1, 1]
    at = np.linspace(0.0, 0.5 * len(chosen), 4001)
    around = np.append(values, values[0])
    ahead = np.interp(at, np.arange(len(around)), around)
    opposite = np.roll(values, -len(values) // 2)
    behind = np.interp(at, np.arange(len(around)), np.append(opposite, opposite[0]))
    return float(np.min(ahead**2 + behind**2))


def test_a_patch_computed_by_hand() -> None:
    """Centre 5; right 1, left 3, below 8, above 6: r_A = 16 + 4, r_B = 9 + 1.

    B1 = (8-1)(1-5) + (6-3)(3-5) = -34, B2 = (8-3)(3-5) + (6-1)(1-5) = -30; B = -34, C = 20,
    A = 10 - 20 + 68 = 58, A + B = 24 > 0: R = 20 - 34^2/58 = 2/29.
    """
    patch = _patch([[0, 6, 0], [3, 5, 1], [0, 8, 0]])
    assert simple_response(patch, 4)[1, 1] == 10.0
    assert interpixel_response(patch, 4)[1, 1] == pytest.approx(2.0 / 29.0, rel=1e-12)


def test_where_no_direction_between_is_lower_the_simple_response_stands() -> None:
    """Right 1, left 3, below 1, above 1 about 5: B1 = B2 = (-2)(-2) = 4, not negative."""
    patch = _patch([[0, 1, 0], [3, 5, 1], [0, 1, 0]])
    assert interpixel_response(patch, 4)[1, 1] == 20.0


def test_eight_neighbours_by_hand() -> None:
    """All of the ring 0 but the corner pair f = i = 5 about 5: along that diagonal nothing changes."""
    patch = _patch([[5, 0, 0], [0, 5, 0], [0, 0, 5]])
    assert simple_response(patch, 4)[1, 1] == 50.0
    assert simple_response(patch, 8)[1, 1] == 0.0
    assert interpixel_response(patch, 8)[1, 1] == 0.0


def test_with_four_neighbours_it_is_the_corrected_equations() -> None:
    rng = np.random.default_rng(61)
    for patch in rng.normal(size=(300, 3, 3)):
        expected = _by_the_corrected_equations(patch)
        assert interpixel_response(patch, 4)[1, 1] == pytest.approx(expected, rel=1e-9, abs=1e-12)


def test_the_printed_b1_would_not_be_the_least_change() -> None:
    """3.12 as printed mixes two diameters; the corrected one is what brute force finds."""
    patch = _patch([[0, 6, 0], [3, 5, 1], [0, 8, 0]])
    printed = (8 - 1) * (1 - 5) + (6 - 1) * (3 - 5)
    assert printed != -34
    assert _by_brute_force(patch, 4) == pytest.approx(2.0 / 29.0, abs=1e-4)


@pytest.mark.parametrize("neighbours", [4, 8])
def test_it_is_the_least_over_all_directions(neighbours: int) -> None:
    rng = np.random.default_rng(62)
    for patch in rng.normal(size=(100, 3, 3)):
        found = interpixel_response(patch, neighbours)[1, 1]
        assert found == pytest.approx(_by_brute_force(patch, neighbours), abs=5e-3)
        assert found <= simple_response(patch, neighbours)[1, 1] + 1e-12


@pytest.mark.parametrize("neighbours", [4, 8])
def test_edges_and_flat_parts_answer_nothing_and_corners_do(neighbours: int) -> None:
    image = np.zeros((40, 40))
    image[20:, 20:] = 1.0
    response = trajkovic_response(image, neighbours, 0.05, 0.05)
    assert response[20, 35] == 0.0
    assert response[5, 5] == 0.0
    # By hand: r_A = r_B = 1, B = B2 = -1, A = 2 with four; with eight the diagonal below left adds nothing
    # lower.
    assert response[20, 20] == pytest.approx(0.5 if neighbours == 4 else 1.0)


def test_a_threshold_hides_weak_corners_and_lets_strong_ones_through() -> None:
    image = np.zeros((40, 40))
    image[10:16, 10:16], image[25:31, 25:31] = 1.0, 0.3
    both = trajkovic_response(image, 8, 0.02, 0.02)
    strong = trajkovic_response(image, 8, 0.3, 0.3)
    assert both[25, 25] > 0.0
    assert strong[25, 25] == 0.0
    assert strong[10, 10] == both[10, 10] > 0.0


def test_odd_sizes_keep_their_shape() -> None:
    image = np.random.default_rng(63).normal(size=(13, 8))
    assert trajkovic_response(image, 4, 0.1, 0.1).shape == (13, 8)
