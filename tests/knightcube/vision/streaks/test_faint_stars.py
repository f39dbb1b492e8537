"""Tests that running sums on circles about the rotation axis include all samples on the detector."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.vision.streaks.faint_stars import cumulative_sums, polar_grid, running_sums
from knightcube.vision.streaks.geometry import CameraMotion
from tests.knightcube.vision.streaks.scenes import CAMERA, turn_of

_CASES = [(90.0, 100.0), (30.0, 60.0), (12.0, 60.0), (6.0, 150.0), (0.0, 40.0)]


@pytest.mark.parametrize(("theta", "length"), _CASES)
def test_running_sums_are_those_of_every_sample_of_every_circle(theta: float, length: float) -> None:
    pinhole = CAMERA.pinhole
    grid = polar_grid(pinhole, CameraMotion.steady(turn_of(np.radians(theta), length, 0.7)), 3)
    rows, columns = np.indices((len(grid.polar), len(grid.azimuth)))
    row, column = (each.reshape(-1).astype(float) for each in (rows, columns))
    place = np.rint(grid.pixels(pinhole, row, column)).reshape(*rows.shape, 2)
    last = np.array([pinhole.columns - 1, pinhole.rows - 1])
    exist = np.asarray(((place > 0) & (place < last)).all(axis=2))
    light = np.zeros((pinhole.rows, pinhole.columns), dtype=np.float32)
    light[1:-1, 1:-1] = np.random.default_rng(5).integers(0, 50, (pinhole.rows - 2, pinhole.columns - 2))
    x, y = np.where(exist, np.nan_to_num(place).transpose(2, 0, 1), 0.0).astype(int)
    samples = np.where(exist, light[y, x], 0.0)
    width = round(grid.length)
    reach = np.arange(width) - width // 2
    there = columns[0, :, None] + reach
    on_grid = np.logical_or((there >= 0) & (there < columns.shape[1]), grid.full)
    wrapped = there % columns.shape[1]
    held = running_sums(light.reshape(-1), pinhole, grid, 1.0)
    count = (exist[:, wrapped] & on_grid).sum(axis=2)
    # Samples at the border between two pixels may be rounded differently in single precision.
    assert np.mean(held.count != count) < 2e-3
    assert np.max(np.abs(held.count - count)) <= 2
    expected = (samples[:, wrapped] * on_grid).sum(axis=2)
    assert np.corrcoef(held.light.reshape(-1), expected.reshape(-1))[0, 1] > 0.9999
    whole = cumulative_sums(light.reshape(-1), pinhole, grid)[:, -1]
    np.testing.assert_allclose(whole, samples.sum(axis=1), rtol=0.02, atol=100.0)
