"""Tests that fragments of long streaks do not give a rate if they agree only by chance."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.reference.corner_streaks.rate import estimate_rate
from knightcube.reference.corner_streaks.settings import DetectorName, StreakSettings
from knightcube.vision.streaks.streak_result import StreakStatus
from sim_hal.star_camera import StarCameraModel
from tests.support.scenes import FIELD, slew

EXPOSURE = 0.2


@pytest.mark.parametrize(
    ("theta", "percent", "run", "detector"),
    [
        (90, 50, 0, "minimum-eigenvalue"),
        (90, 50, 0, "trajkovic-8"),
        (30, 30, 2, "minimum-eigenvalue"),
    ],
)
def test_no_rate_comes_of_it(theta: int, percent: int, run: int, detector: DetectorName) -> None:
    camera = StarCameraModel(field_of_view=FIELD)
    generator = np.random.default_rng((99, theta, percent, run))
    scene = slew(generator, float(np.deg2rad(theta)), percent / 100.0, EXPOSURE, model=camera)
    settings = StreakSettings.of(detector, saturation=float(camera.highest_count))
    found = estimate_rate(scene.pixels, camera.pinhole, EXPOSURE, settings, scene.rate, 0.0)
    assert found.status is StreakStatus.FAILED
    assert found.rate is None
