"""The axis and the order of endpoints in time."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.vision.streaks.corners.grouping import centre_of_rotation, rotation_angles, rotation_axis
from tests.knightcube.vision.streaks.frames import rate_at, rotate, star_camera

_PINHOLE = star_camera().pinhole


def _streaks(theta: float, angle: float, n: int, seed: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return starts, ends (n, 3) with 0.1 px of error, and the unit axis."""
    rng = np.random.default_rng(seed)
    axis = rate_at(theta, 1.0, rng.uniform(0.0, 2.0 * np.pi))
    starts = _PINHOLE.unit_vectors(rng.uniform(50.0, 970.0, (n, 2)))
    ends = rotate(starts, angle * axis)
    noisy = [
        _PINHOLE.unit_vectors(_PINHOLE.project(v) + rng.normal(0.0, 0.1, (n, 2))) for v in (starts, ends)
    ]
    return noisy[0], noisy[1], axis


@pytest.mark.parametrize("theta_deg", [90.0, 60.0, 30.0, 5.0, 0.0])
@pytest.mark.parametrize("seed", range(4))
def test_ends_are_grouped_for_an_axis_normal_to_and_along_the_boresight(theta_deg: float, seed: int) -> None:
    theta = np.deg2rad(theta_deg)
    starts, ends, true_axis = _streaks(theta, 0.02 if theta_deg > 20 else 0.2, 30, seed)
    swap = np.random.default_rng(seed + 100).uniform(size=30) < 0.5
    first = np.where(swap[:, None], ends, starts)
    second = np.where(swap[:, None], starts, ends)
    # Three streaks of something else.
    second[[4, 11, 20]] = np.roll(second[[4, 11, 20]], 1, axis=0)
    star = np.ones(30, dtype=np.bool_)
    star[[4, 11, 20]] = False
    length = np.linalg.norm(second - first, axis=-1)
    axis, agree = rotation_axis(first, second, 1.0 / _PINHOLE.focal_length / length)
    assert np.count_nonzero(agree & star) >= 25
    order = rotation_angles(first, second, axis)[star] < 0.0
    # All or none are reversed: which, one frame cannot tell.
    reversed_order = order ^ swap[star]
    assert reversed_order.all() or not reversed_order.any()
    assert abs(axis @ true_axis) > np.cos(np.deg2rad(6.0))


def test_the_angle_turned_is_the_rotations() -> None:
    axis = rate_at(0.7, 1.0, 1.1)
    v = _PINHOLE.unit_vectors(np.array([[100.0, 900.0], [500.0, 30.0]]))
    # v' = -omega x v: about +axis the stars turn backwards.
    np.testing.assert_allclose(rotation_angles(v, rotate(v, 0.3 * axis), axis), -0.3)


def test_the_centre_of_rotation_is_the_axis_projected() -> None:
    centre = np.array([700.0, 200.0])
    angle = np.array([0.1, 1.0, 2.3, 4.0])
    radius = np.array([[100.0], [200.0], [300.0], [50.0]])
    first = centre + radius * np.stack([np.cos(angle), np.sin(angle)], -1)
    second = centre + radius * np.stack([np.cos(angle + 0.4), np.sin(angle + 0.4)], -1)
    np.testing.assert_allclose(centre_of_rotation(np.stack([first, second], axis=1)), centre)


def test_parallel_streaks_have_no_centre_of_rotation() -> None:
    streaks = np.array([[[0.0, 0.0], [10.0, 0.0]], [[50.0, 40.0], [70.0, 40.0]]])
    assert np.isnan(centre_of_rotation(streaks)).all()


def test_one_streak_has_no_axis() -> None:
    v = np.array([[0.0, 0.0, 1.0]])
    with pytest.raises(ValueError, match="two streaks"):
        rotation_axis(v, v, np.ones(1))
