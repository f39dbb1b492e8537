"""Tests that rates from streak corners equal the recorded rates for each detector."""

from __future__ import annotations

import pytest

from knightcube.astro.arrays import Image
from knightcube.reference.corner_streaks.rate import estimate_rate
from knightcube.reference.corner_streaks.settings import DETECTOR_NAMES, DetectorName, StreakSettings
from tests.support.recorded_results import check
from tests.support.streak_frames import rate_at, star_camera, star_frame

CAMERA = star_camera(400)
RATE = rate_at(1.2, 0.04, 0.7)


@pytest.fixture(scope="module")
def pixels() -> Image:
    return star_frame(CAMERA, RATE, 1.0, 4, faintest=6.0)


@pytest.mark.parametrize("name", DETECTOR_NAMES)
def test_the_rate_by_a_detector_is_as_recorded(pixels: Image, name: DetectorName) -> None:
    settings = StreakSettings.of(name)
    check(__file__, f"rate {name}", estimate_rate(pixels, CAMERA.pinhole, 1.0, settings, RATE, 1e-3))


def test_the_rate_without_a_prior_is_as_recorded(
    pixels: Image,
) -> None:
    check(__file__, "no prior", estimate_rate(pixels, CAMERA.pinhole, 1.0, StreakSettings()))


def test_the_rate_about_the_boresight_is_as_recorded() -> None:
    rate = rate_at(0.1, 0.25, 1.0)
    frame = star_frame(CAMERA, rate, 1.0, 6, faintest=6.0)
    check(__file__, "boresight", estimate_rate(frame, CAMERA.pinhole, 1.0, StreakSettings(), rate, 1e-3))
