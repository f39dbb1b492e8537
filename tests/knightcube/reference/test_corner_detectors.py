"""Tests of Trajkovic and Hedley's cornerness, against patches computed by hand and an exhaustive search."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.reference.corner_streak_rate import (
    cornerness,
    interpixel_response,
    minimum_eigenvalue,
    simple_response,
    trajkovic_response,
)
from knightcube.reference.corner_streaks import DETECTOR_NAMES, DetectorName, StreakSettings
from knightcube.vision.objects.streak_ends import chord_outward, extend, find_corners, structure_tensor
from tests.support.streak_frames import expose, star_camera, true_endpoints

# Names of the pixels around the centre pixel c: rows are y, columns are x.
#   f b g        b is at (x, y - 1), a at (x + 1, y)
#   e c a
#   h d i


def _patch(rows: list[list[float]]) -> FloatArray:
    return np.array(rows, dtype=float)


def _by_the_corrected_equations(patch: FloatArray) -> float:
    """Return the corrected equations 3.9-3.13 at the centre of a 3 x 3 patch, in the thesis's symbols."""
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
    """Return the smallest squared change over 4001 diameters, with linear interpolation along the ring."""
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
    """The response of a patch equals 2/29, as computed by hand.

    The centre is 5, with 1 right, 3 left, 8 below and 6 above, so r_A = 16 + 4 and r_B = 9 + 1. B1 =
    (8-1)(1-5) + (6-3)(3-5) = -34 and B2 = (8-3)(3-5) + (6-1)(1-5) = -30, so B = -34. With C = 20 and A = 10 -
    20 + 68 = 58, A + B = 24 > 0, and R = 20 - 34^2/58 = 2/29.
    """
    patch = _patch([[0, 6, 0], [3, 5, 1], [0, 8, 0]])
    assert simple_response(patch, 4)[1, 1] == 10.0
    assert interpixel_response(patch, 4)[1, 1] == pytest.approx(2.0 / 29.0, rel=1e-12)


def test_the_simple_response_is_used_if_no_intermediate_direction_is_lower() -> None:
    """If no direction between the neighbours gives a lower value, the response is that of the neighbours.

    The pixels 1 (right), 3 (left), 1 (below) and 1 (above) around 5 give B1 = B2 = 4, which is not negative.
    """
    patch = _patch([[0, 1, 0], [3, 5, 1], [0, 1, 0]])
    assert interpixel_response(patch, 4)[1, 1] == 20.0


def test_eight_neighbours_by_hand() -> None:
    """With eight neighbours, the response is zero if the intensity does not change along one diagonal.

    The ring around 5 is 0, except f = i = 5.
    """
    patch = _patch([[5, 0, 0], [0, 5, 0], [0, 0, 5]])
    assert simple_response(patch, 4)[1, 1] == 50.0
    assert simple_response(patch, 8)[1, 1] == 0.0
    assert interpixel_response(patch, 8)[1, 1] == 0.0


def test_the_response_with_four_neighbours_follows_the_corrected_equations() -> None:
    rng = np.random.default_rng(61)
    for patch in rng.normal(size=(300, 3, 3)):
        expected = _by_the_corrected_equations(patch)
        assert interpixel_response(patch, 4)[1, 1] == pytest.approx(expected, rel=1e-9, abs=1e-12)


def test_the_printed_b1_would_not_be_the_least_change() -> None:
    """Equation 3.12 as printed mixes two diameters, so it does not give the smallest change.

    The corrected equation agrees with an exhaustive search over all diameters.
    """
    patch = _patch([[0, 6, 0], [3, 5, 1], [0, 8, 0]])
    printed = (8 - 1) * (1 - 5) + (6 - 1) * (3 - 5)
    assert printed != -34
    assert _by_brute_force(patch, 4) == pytest.approx(2.0 / 29.0, abs=1e-4)


@pytest.mark.parametrize("neighbours", [4, 8])
def test_the_response_is_the_minimum_over_all_directions(neighbours: int) -> None:
    rng = np.random.default_rng(62)
    for patch in rng.normal(size=(100, 3, 3)):
        found = interpixel_response(patch, neighbours)[1, 1]
        assert found == pytest.approx(_by_brute_force(patch, neighbours), abs=5e-3)
        assert found <= simple_response(patch, neighbours)[1, 1] + 1e-12


@pytest.mark.parametrize("neighbours", [4, 8])
def test_edges_and_flat_parts_have_no_response_and_corners_have_one(neighbours: int) -> None:
    image = np.zeros((40, 40))
    image[20:, 20:] = 1.0
    response = trajkovic_response(image, neighbours, 0.05, 0.05)
    assert response[20, 35] == 0.0
    assert response[5, 5] == 0.0
    # With four neighbours, r_A = r_B = 1, B = B2 = -1 and A = 2. With eight neighbours, the lower left
    # diagonal gives no smaller value.
    assert response[20, 20] == pytest.approx(0.5 if neighbours == 4 else 1.0)


def test_a_threshold_removes_weak_corners_and_keeps_strong_ones() -> None:
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


def test_the_smaller_eigenvalue_is_numpys_of_the_summed_tensor() -> None:
    image = np.random.default_rng(4).normal(size=(20, 20))
    tensor = structure_tensor(image, 1.0, 1.5)
    matrices = np.stack([np.stack([tensor.xx, tensor.xy], -1), np.stack([tensor.xy, tensor.yy], -1)], -2)
    np.testing.assert_allclose(minimum_eigenvalue(tensor), np.linalg.eigvalsh(matrices)[..., 0], rtol=1e-9)


def test_the_smaller_eigenvalue_vanishes_on_an_edge_and_in_the_flat() -> None:
    image = np.zeros((40, 40))
    image[20:] = 1.0
    response = minimum_eigenvalue(structure_tensor(image, 1.0, 1.5))
    np.testing.assert_allclose(response, 0.0, atol=1e-15)
    image[:, :20] = 0.0
    corner = minimum_eigenvalue(structure_tensor(image, 1.0, 1.5))
    assert corner[20, 20] > 1e-3
    assert corner[20, 20] > 10.0 * corner[20, 35]


def _corners(image: FloatArray, settings: StreakSettings) -> FloatArray:
    response = cornerness(image, settings)
    intensity = response if settings.centre_of == "response" else image
    return find_corners(
        response, image > 1.0, settings.peak_relative, settings.intensity_half_width, intensity
    )


def _streak(roll: float, length: float = 40.0) -> tuple[FloatArray, FloatArray]:
    """Return the noiseless image of one streak and its true ends (2, 2)."""
    camera = star_camera(128)
    rotation = length / camera.pinhole.focal_length * np.array([np.sin(roll), np.cos(roll), 0.0])
    star = camera.pinhole.unit_vectors(np.array([[63.2, 64.6]]))
    image = expose(camera, star, np.array([3.0]), rotation, 1.0)
    return image, true_endpoints(camera, star, rotation)[0]


# The response of Trajkovic's detectors depends on the direction of a streak, so a constant correction leaves
# an error.
_TOLERANCE: dict[DetectorName, float] = {
    "harris": 0.1,
    "minimum-eigenvalue": 0.1,
    "trajkovic-4": 0.7,
    "trajkovic-8": 0.3,
}


_ROLLS = [0.0, 0.4, 0.8, 1.6, 2.5]


# With four neighbours, a streak near a diagonal looks like a row of corners, and is refused.
_TOO_SLANTED = [0.8, 2.5]


@pytest.mark.parametrize(
    ("detector", "roll"),
    [
        (detector, roll)
        for detector in DETECTOR_NAMES
        for roll in _ROLLS
        if detector != "trajkovic-4" or roll not in _TOO_SLANTED
    ],
)
def test_a_noiseless_streaks_ends_are_found_in_every_direction(detector: DetectorName, roll: float) -> None:
    settings = StreakSettings.of(detector)
    image, truth = _streak(roll)
    ends = _corners(image, settings)
    moved = extend(ends[None], chord_outward(ends[None]), settings.endpoint_bias)[0]
    error = min(np.abs(moved - truth).max(), np.abs(moved[::-1] - truth).max())
    assert error < _TOLERANCE[detector]


@pytest.mark.parametrize("detector", DETECTOR_NAMES)
def test_without_its_constant_each_detector_is_biased_inward_by_it(detector: DetectorName) -> None:
    settings = StreakSettings.of(detector)
    image, truth = _streak(0.0)
    found = np.linalg.norm(np.diff(_corners(image, settings), axis=0))
    shorter = float(np.linalg.norm(truth[1] - truth[0]) - found)
    assert shorter == pytest.approx(2.0 * settings.endpoint_bias, abs=2.0 * _TOLERANCE[detector])
    if detector != "harris":
        assert shorter > 0.5


@pytest.mark.parametrize("detector", DETECTOR_NAMES)
def test_a_crossing_of_two_streaks_has_not_two_corners(detector: DetectorName) -> None:
    """Two crossing streaks do not give exactly two corners, because they have four ends.

    Trajkovic-4 finds only the crossing, because its response increases with brightness.
    """
    crossing = _streak(0.0)[0] + _streak(0.5 * np.pi)[0]
    assert len(_corners(crossing, StreakSettings.of(detector))) != 2


@pytest.mark.parametrize("roll", _TOO_SLANTED)
def test_trajkovic_4_refuses_a_streak_near_a_diagonal(roll: float) -> None:
    assert len(_corners(_streak(roll)[0], StreakSettings.of("trajkovic-4"))) > 2


def test_the_centre_of_intensity_of_the_image_lies_far_inside_the_streak() -> None:
    """The thesis localises corners by the intensity of the image, which gives ends far inside the streak.

    For 7 x 7 pixels, streaks.md states an error of 2.2 px.
    """
    image, truth = _streak(0.0)
    found = np.linalg.norm(np.diff(_corners(image, StreakSettings(centre_of="image")), axis=0))
    assert 1.5 < 0.5 * (np.linalg.norm(truth[1] - truth[0]) - found) < 2.5
