"""Tests of the polar grid about the rotation axis, and of running sums along its circles."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.vision.streaks.camera_motion import CameraMotion
from knightcube.vision.streaks.polar_grid import ACROSS, cumulative_sums, polar_grid, running_sums
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


def test_a_polar_grid_consists_of_circles_about_the_rotation_axis() -> None:
    pinhole = CAMERA.pinhole
    rotation = turn_of(np.radians(40.0), 90.0, 0.7)
    angle, every = float(np.linalg.norm(rotation)), 2
    axis = rotation / angle
    for sign in (1.0, -1.0):
        grid = polar_grid(pinhole, CameraMotion.steady(sign * rotation), every)
        assert grid.frame @ grid.frame.T == pytest.approx(np.eye(3), abs=1e-12)
        assert np.linalg.det(grid.frame) == pytest.approx(1.0)
        assert grid.frame[2] == pytest.approx(axis)  # in the direction of the image
        assert grid.angle == pytest.approx(angle)
        assert grid.length * (grid.azimuth[1] - grid.azimuth[0]) == pytest.approx(angle)
        assert (grid.polar[1] - grid.polar[0]) * pinhole.focal_length == pytest.approx(every * ACROSS)
        row, column = np.array([3.0, 40.5, 100.0]), np.array([20.0, 33.25, 60.0])
        seen = pinhole.unit_vectors(grid.pixels(pinhole, row, column))
        polar = np.arccos(seen @ axis)
        assert polar == pytest.approx(np.interp(row, np.arange(len(grid.polar)), grid.polar))
        assert grid.speed == pytest.approx(np.sin(grid.polar) * pinhole.focal_length)
        # At the next sample of its circle, a star has rotated by the angle between two samples.
        turned = pinhole.unit_vectors(grid.pixels(pinhole, row, column + 1.0))
        step = grid.azimuth[1] - grid.azimuth[0]
        normal = seen - (seen @ axis)[:, None] * axis
        expected = seen + np.sin(step) * np.cross(axis, seen) - (1.0 - np.cos(step)) * normal
        assert turned == pytest.approx(expected, abs=1e-9)
        assert not grid.full
    centre = polar_grid(pinhole, CameraMotion.steady(np.array([0.0, 0.0, 0.3])))
    assert centre.full
    assert centre.frame[2] == pytest.approx([0.0, 0.0, 1.0])
