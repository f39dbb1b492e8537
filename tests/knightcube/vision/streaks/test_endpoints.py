"""Sub-maximal suppression and centre of intensity."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.vision.streaks.corners.detectors import cornerness
from knightcube.vision.streaks.corners.endpoints import (
    centre_of_intensity,
    chord_outward,
    extend,
    find_corners,
    local_maxima,
)
from knightcube.vision.streaks.corners.settings import DETECTOR_NAMES, DetectorName, StreakSettings
from tests.knightcube.vision.streaks.frames import expose, star_camera, true_endpoints


def test_only_pixels_above_all_eight_neighbours_are_peaks() -> None:
    response = np.zeros((7, 9))
    response[2, 3], response[2, 4], response[5, 7] = 5.0, 4.0, 2.0
    everywhere = np.ones(response.shape, dtype=np.bool_)
    np.testing.assert_array_equal(local_maxima(response, everywhere, 0.1), [[3, 2], [7, 5]])
    np.testing.assert_array_equal(local_maxima(response, everywhere, 0.5), [[3, 2]])
    masked = everywhere.copy()
    masked[2, 3] = False
    np.testing.assert_array_equal(local_maxima(response, masked, 0.1), [[7, 5]])


def test_a_response_without_corners_has_no_peaks() -> None:
    assert len(local_maxima(np.full((6, 6), -1.0), np.ones((6, 6), dtype=np.bool_), 0.1)) == 0


def test_the_centre_of_intensity_carries_the_coordinate() -> None:
    image = np.zeros((9, 9))
    image[4, 4], image[4, 5], image[3, 4] = 2.0, 1.0, 1.0
    np.testing.assert_allclose(centre_of_intensity(image, np.array([4, 4]), 3), [4.25, 3.75])


def test_a_window_cut_by_the_border_stays_centred() -> None:
    np.testing.assert_allclose(centre_of_intensity(np.ones((9, 9)), np.array([1, 4]), 3), [1.0, 4.0])


def test_extension_moves_both_ends_outward() -> None:
    ends = np.array([[[10.0, 10.0], [13.0, 14.0]]])
    moved = extend(ends, chord_outward(ends), 5.0)
    np.testing.assert_allclose(moved, [[[7.0, 6.0], [16.0, 18.0]]])


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


# Trajkovic's neighbours see slanting streaks otherwise than straight ones: no constant takes that away.
_TOLERANCE: dict[DetectorName, float] = {
    "harris": 0.1,
    "minimum-eigenvalue": 0.1,
    "trajkovic-4": 0.7,
    "trajkovic-8": 0.3,
}


_ROLLS = [0.0, 0.4, 0.8, 1.6, 2.5]
# Four neighbours take a streak near the diagonals for a row of corners, and it is refused.
_TOO_SLANTED = [0.8, 2.5]


@pytest.mark.parametrize("roll", _TOO_SLANTED)
def test_trajkovic_4_refuses_a_streak_near_a_diagonal(roll: float) -> None:
    assert len(_corners(_streak(roll)[0], StreakSettings.of("trajkovic-4"))) > 2


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


def test_the_centre_of_intensity_of_the_image_lies_far_inside_the_streak() -> None:
    """The thesis's own localisation: streaks.md has 2.2 px for 7 x 7 pixels."""
    image, truth = _streak(0.0)
    found = np.linalg.norm(np.diff(_corners(image, StreakSettings(centre_of="image")), axis=0))
    assert 1.5 < 0.5 * (np.linalg.norm(truth[1] - truth[0]) - found) < 2.5


@pytest.mark.parametrize("detector", DETECTOR_NAMES)
def test_a_crossing_of_two_streaks_has_not_two_corners(detector: DetectorName) -> None:
    """Four ends, or for Trajkovic-4, whose response grows with brightness, the crossing alone."""
    crossing = _streak(0.0)[0] + _streak(0.5 * np.pi)[0]
    assert len(_corners(crossing, StreakSettings.of(detector))) != 2
