"""Frames of a wide point spread are read in larger pixels, and the answer is in the frame's own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks.maximum_likelihood.binning import Binning
from knightcube.vision.streaks.maximum_likelihood.estimate import estimate_motion
from knightcube.vision.streaks.maximum_likelihood.result import MotionResult
from knightcube.vision.streaks.maximum_likelihood.settings import LikelihoodSettings
from knightcube.vision.streaks.streak_result import StreakStatus
from tests.knightcube.vision.streaks.maximum_likelihood.scenes import CAMERA, SATURATION, real_sky


@pytest.mark.parametrize(
    ("columns", "rows", "sigma", "size"),
    [(1024, 768, 1.9, 1), (1024, 768, 3.0, 3), (1025, 768, 2.6, 1), (1280, 1024, 4.3, 4)],
)
def test_a_star_is_in_the_same_direction_in_small_and_large_pixels(
    columns: int, rows: int, sigma: float, size: int
) -> None:
    full = Pinhole(columns, rows, 3000.0)
    binning = Binning.suited(full, sigma)
    assert binning.size == size
    small = np.array([[0.0, 0.0], [100.25, 60.5]])
    seen = MotionResult(StreakStatus.FAILED, 0, 1.0, stars=small)
    there = binning.in_pixels(seen).stars
    assert full.unit_vectors(there) == pytest.approx(binning.pinhole.unit_vectors(small), abs=1e-12)


def test_sums_keep_light_and_what_is_saturated() -> None:
    pixels = np.arange(64, dtype=np.uint16).reshape(8, 8) * np.uint16(16)
    sums, top = Binning.suited(Pinhole(8, 8, 10.0), 2.0).frame(pixels, 1000.0)
    assert sums.shape == (4, 4)
    assert sums[0, 0] == 16 * (0 + 1 + 8 + 9)
    # The last sum holds 1008, the one before it at most 976.
    assert top == 4 * 1008
    assert (sums >= top).sum() == 1
    assert np.all(sums % 16 == 0)


def test_a_point_spread_of_three_pixels_gives_a_rate_within_its_covariance() -> None:
    """Without binning such frames were refused. Chi-square of 3: 16.3 is exceeded once in a thousand."""
    camera = replace(CAMERA, psf_sigma=3.0)
    scene = real_sky(2, 1.0, 90.0, 0.5, camera)
    settings = LikelihoodSettings(saturation=SATURATION, psf_sigma=3.0)
    found = estimate_motion(scene.pixels, camera.pinhole, scene.exposure, settings, scene.rate, 0.0)
    assert found.status is StreakStatus.RATE
    assert found.rate is not None
    assert found.covariance is not None
    error = found.rate - scene.rate
    assert error @ np.linalg.solve(found.covariance, error) < 16.3
    assert np.linalg.norm(error) < 0.005 * np.linalg.norm(scene.rate)
    assert found.psf_sigma == pytest.approx(3.0, rel=0.05)
    assert found.length == pytest.approx(90.0, rel=0.3)
    # The stars used are those of the sky, in pixels of the frame.
    apart = np.linalg.norm(found.stars[found.used][:, None] - scene.stars, axis=2).min(axis=1)
    assert np.median(apart) < 0.5


def test_a_summed_row_takes_as_many_times_as_long_to_the_next_whether_it_is_stated_or_not() -> None:
    binning = Binning.suited(Pinhole(1024, 768, 3000.0), 3.0)
    nobody, stated = LikelihoodSettings(), LikelihoodSettings(line_time=1e-5)
    assert binning.settings(nobody).line_time_sigma == pytest.approx(3.0 * nobody.line_time_sigma)
    assert binning.settings(nobody).shutter_unstated
    assert binning.settings(stated).line_time == pytest.approx(3e-5)
    assert binning.settings(stated).line_time_sigma == 0.0
