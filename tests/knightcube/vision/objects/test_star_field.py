"""Tests that stars are matched between frames without a catalogue, and that moving objects are detected."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import (
    attitude_matrix,
    conjugate,
    from_rotation_vector,
    multiply,
    to_rotation_vector,
)
from knightcube.vision.objects.settings import FieldPoints
from knightcube.vision.objects.star_field import LocatedFrame, StarField

PIXEL = np.radians(20.0) / 512
SIGMA = 0.1 * PIXEL


def sky(rng: np.random.Generator, density: int = 900) -> FloatArray:
    """Return `density` stars in the whole sky; 900 stars are about 7 in a field of 20 deg."""
    stars = rng.standard_normal((density, 3))
    return np.asarray(stars / np.linalg.norm(stars, axis=1, keepdims=True))


def measured_points(stars: FloatArray, attitude: FloatArray, rng: np.random.Generator) -> FieldPoints:
    """Return the star positions in a frame, with errors."""
    directions = stars @ attitude_matrix(attitude).T
    directions = directions[(directions[:, 2] > 0.8) & (np.abs(directions[:, :2]).max(axis=1) < 0.17)]
    noisy = directions + SIGMA * rng.standard_normal(directions.shape)
    count = len(noisy)
    noisy /= np.linalg.norm(noisy, axis=1, keepdims=True)
    empty = np.zeros(count, dtype=np.bool_)
    return FieldPoints(np.zeros((count, 2)), noisy, np.full(count, SIGMA), np.ones(count), empty)


def flown(rate: FloatArray, error: float, frames: int) -> list[tuple[FloatArray, LocatedFrame, FieldPoints]]:
    """Return true attitudes, results and points of frames at intervals of a second.

    The last point of each frame is the object.
    """
    rng = np.random.default_rng(4)
    stars, field, rows = sky(rng, 4000), StarField(), []
    start = from_rotation_vector(np.array([0.3, -0.2, 0.9]))
    track = attitude_matrix(start).T @ np.array([0.03, -0.02, 1.0])
    for number in range(frames):
        truth = multiply(from_rotation_vector(number * rate), start)
        path = from_rotation_vector(np.array([0.0, 0.0, 5e-3 * number]))
        moved = attitude_matrix(path) @ track
        points = measured_points(np.vstack([stars, moved / np.linalg.norm(moved)]), truth, rng)
        predicted = multiply(from_rotation_vector(error * rng.standard_normal(3)), truth)
        rows.append((truth, field.locate(points, predicted, error), points))
    return rows


@pytest.mark.parametrize("rate_deg", [(0.0, 0.0, 0.0), (0.2, 0.5, -0.3)], ids=["rest", "slew"])
def test_the_field_corrects_the_prediction_and_only_the_object_is_left_after_a_few_frames(
    rate_deg: tuple[float, float, float],
) -> None:
    rows = flown(np.radians(rate_deg), 3.0 * PIXEL, 12)
    assert rows[0][1].begun
    assert not any(found.begun for _, found, _ in rows[1:])
    first = rows[0][1].quaternion
    offset = multiply(conjugate(rows[0][0]), first)
    for truth, found, _ in rows[3:]:
        off = to_rotation_vector(multiply(found.quaternion, conjugate(multiply(truth, offset))))
        assert np.linalg.norm(off[:2]) < 0.3 * PIXEL, "a tenth of the error of the prediction"
        assert off @ np.linalg.solve(found.covariance + (0.3 * SIGMA) ** 2 * np.eye(3), off) < 25.0
        assert not found.is_star[-1], "the object moves by 9 px from frame to frame"
        if not any(rate_deg):
            assert found.is_star[:-1].all()
        else:
            assert np.mean(found.is_star[:-1]) > 0.7, "new stars enter the field"


def test_three_frames_without_common_stars_begin_the_field_again() -> None:
    rng = np.random.default_rng(8)
    stars, field = sky(rng, 4000), StarField()
    start = from_rotation_vector(np.array([0.1, 0.2, 0.3]))
    assert field.locate(measured_points(stars, start, rng), start, PIXEL).begun
    assert not field.locate(measured_points(stars, start, rng), start, PIXEL).begun
    away = multiply(from_rotation_vector(np.array([0.0, 1.5, 0.0])), start)
    black, there = measured_points(stars[:0], start, rng), measured_points(stars, away, rng)
    assert not field.locate(black, start, PIXEL).begun
    other = field.locate(there, away, PIXEL)
    assert not other.begun
    assert other.is_star.all(), "nothing is reported in a frame that is compared with no other"
    assert not field.locate(measured_points(stars, start, rng), start, PIXEL).begun, (
        "the stars are found again"
    )
    begun = [field.locate(one, away, PIXEL).begun for one in (black, there, there, there)]
    assert begun == [False, False, True, False]
