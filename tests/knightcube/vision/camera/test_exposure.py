"""Exposures follow the rate, so that streaks have a length of use."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.vision.camera.exposure import Exposures

CAMERA = Exposures(usual=0.2, least=0.1, most=1.0, scale=512 / np.radians(20.0))


@pytest.mark.parametrize("rate_deg", [0.2, 0.3, 0.5, 1.0, 2.0])
def test_streaks_of_a_slew_are_5_to_100_px_long(rate_deg: float) -> None:
    rate = np.radians(rate_deg)
    assert 5.0 <= rate * CAMERA.scale * CAMERA.at(rate) <= 100.0


def test_points_are_exposed_as_usual_and_the_slowest_streaks_longest() -> None:
    assert CAMERA.at(0.0) == CAMERA.usual
    assert CAMERA.at(np.radians(0.15)) == CAMERA.usual
    assert CAMERA.at(np.radians(0.2)) == CAMERA.most
    assert CAMERA.at(np.radians(90.0)) == CAMERA.least
