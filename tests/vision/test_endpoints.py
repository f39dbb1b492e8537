"""Sub-maximal suppression and centre of intensity."""

from __future__ import annotations

import numpy as np
import pytest

from flight.vision.endpoints import centre_of_intensity, chord_outward, extend, find_endpoints, local_maxima
from flight.vision.settings import StreakSettings
from flight.vision.streaks import harris_cornerness
from tests.vision.frames import expose, star_camera, true_endpoints


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


@pytest.mark.parametrize("roll", [0.0, 0.4, 0.8, 1.6, 2.5])
def test_a_noiseless_streaks_ends_are_found_to_a_tenth_of_a_pixel_in_every_direction(roll: float) -> None:
    settings = StreakSettings()
    camera = star_camera(128)
    rotation = 40.0 / camera.pinhole.focal_length * np.array([np.sin(roll), np.cos(roll), 0.0])
    star = camera.pinhole.unit_vectors(np.array([[63.2, 64.6]]))
    image = expose(camera, star, np.array([3.0]), rotation, 1.0)
    ends = find_endpoints(harris_cornerness(image, settings), image > 1.0, settings.peak_relative, 3)
    assert ends is not None
    moved = extend(ends[None], chord_outward(ends[None]), settings.endpoint_bias)[0]
    truth = true_endpoints(camera, star, rotation)[0]
    error = min(np.abs(moved - truth).max(), np.abs(moved[::-1] - truth).max())
    assert error < 0.1


def test_a_crossing_of_two_streaks_is_refused() -> None:
    camera = star_camera(128)
    star = camera.pinhole.unit_vectors(np.array([[63.2, 64.6]]))
    turn = 40.0 / camera.pinhole.focal_length
    image = sum(
        (
            expose(camera, star, np.array([3.0]), turn * np.array(axis), 1.0)
            for axis in ((1, 0, 0), (0, 1, 0))
        ),
        start=np.zeros((128, 128)),
    )
    assert find_endpoints(harris_cornerness(image, StreakSettings()), image > 1.0, 0.005, 3) is None
