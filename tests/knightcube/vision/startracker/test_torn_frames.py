"""Tests of frames of which a part of the rows is displaced or from another exposure."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.astro import catalogue
from knightcube.astro.arrays import FloatArray, Image
from knightcube.astro.quaternion import (
    conjugate,
    from_rotation_vector,
    multiply,
    normalise,
    to_rotation_vector,
)
from knightcube.vision.star_tracker import StarSolution, StarTracker
from knightcube.vision.startracker.torn_frames import displacement, separated
from sim_hal.star_camera import render
from tests.knightcube.vision.startracker.frames import EPOCH, NARROW

_ATTITUDE = normalise(np.array([0.3, -0.5, 0.2, 0.8]))
_PIXEL = 1.0 / NARROW.pinhole.focal_length
_CHI_SQUARE_3_DOF_1E_5 = 25.9


def _frame(attitude: FloatArray, seed: int = 0) -> Image:
    stars, times = catalogue.load(), np.linspace(0.0, 0.1, 3)
    rng, attitudes = np.random.default_rng(seed), np.tile(attitude, (3, 1))
    return np.asarray(
        render(NARROW, stars.directions_at(EPOCH), stars.magnitude, times, attitudes, rng), dtype=np.uint16
    )


def _moved(pixels: float, angle: float) -> FloatArray:
    """Return the attitude of a camera that was rotated by some pixels, in a direction of the image."""
    turn = pixels * _PIXEL * np.array([np.cos(angle), np.sin(angle), 0.1])
    return multiply(from_rotation_vector(turn), _ATTITUDE)


def _torn(first: Image, second: Image, row: int) -> Image:
    return np.concatenate([first[:row], second[row:]])


def _mismatch(found: StarSolution, attitude: FloatArray = _ATTITUDE) -> float:
    error = to_rotation_vector(multiply(found.quaternion, conjugate(attitude)))
    return float(error @ np.linalg.solve(found.covariance, error))


@pytest.mark.parametrize("share", [0.3, 0.5, 0.7])
@pytest.mark.parametrize("moved_px", [12.0, 90.0, 140.0])
def test_rows_of_another_exposure_make_the_attitude_ambiguous(share: float, moved_px: float) -> None:
    image = _torn(_frame(_ATTITUDE), _frame(_moved(moved_px, 1.0), 1), int(share * NARROW.rows))
    found = StarTracker(camera=NARROW.pinhole).solve(image)
    assert found.status == "ambiguous"
    assert "a part of the image is displaced or from another exposure" in found.reason


@pytest.mark.parametrize("moved_px", [3.0, 12.0])
@pytest.mark.parametrize("share", [0.4, 0.6])
def test_a_displacement_is_not_mistaken_for_errors_of_an_uncalibrated_lens(
    moved_px: float, share: float
) -> None:
    image = _torn(_frame(_ATTITUDE), _frame(_moved(moved_px, 1.0), 1), int(share * NARROW.rows))
    assert StarTracker(fov_deg=12.0).solve(image).status == "ambiguous"


def test_a_prior_attitude_tells_the_exposures_apart() -> None:
    other = _moved(300.0, 2.0)
    image = _torn(_frame(_ATTITUDE), _frame(other, 1), NARROW.rows // 2)
    tracker = StarTracker(camera=NARROW.pinhole)
    assert not tracker.solve(image)
    for attitude in (_ATTITUDE, other):
        found = tracker.solve(image, attitude=attitude, attitude_sigma=5.0 * _PIXEL)
        assert found
        assert _mismatch(found, attitude) < _CHI_SQUARE_3_DOF_1E_5


@pytest.mark.parametrize("lost", [1, 2, 8, 40])
@pytest.mark.parametrize("share", [0.25, 0.5, 0.75])
def test_lost_pixels_do_not_give_an_attitude_that_is_wrong_by_more_than_its_covariance(
    lost: int, share: float
) -> None:
    image = _frame(_ATTITUDE)
    first = int(share * image.size)
    torn = np.append(np.delete(image, slice(first, first + lost)), np.zeros(lost, np.uint16))
    found = StarTracker(camera=NARROW.pinhole).solve(torn.reshape(image.shape))
    if lost == 40:
        assert found.status == "ambiguous"
    assert not found or _mismatch(found) < 9.0


def test_whole_frames_and_double_exposures_keep_their_attitude_and_covariance() -> None:
    tracker, one = StarTracker(camera=NARROW.pinhole), _frame(_ATTITUDE)
    whole, double = tracker.solve(one), tracker.solve(one + _frame(_moved(40.0, 1.0), 1) // 4)
    for found in (whole, double):
        assert found
        assert not found.frame.torn
        assert _mismatch(found) < _CHI_SQUARE_3_DOF_1E_5
        assert np.sqrt(found.covariance[0, 0]) < 0.05 * _PIXEL


def test_rows_are_separated_only_if_they_do_not_alternate() -> None:
    assert separated(np.arange(20.0), np.arange(30.0, 35.0))
    assert separated(np.append(np.arange(10.0), np.arange(30.0, 40.0)), np.arange(15.0, 20.0))
    assert not separated(np.arange(20.0), np.arange(0.5, 20.0, 4.0))
    assert not separated(np.arange(20.0), np.arange(30.0, 33.0))
    rng = np.random.default_rng(3)
    mixed = [separated(rng.uniform(size=30), rng.uniform(size=8)) for _ in range(1_000)]
    assert np.count_nonzero(mixed) < 10


@pytest.mark.parametrize("step", [(0.0, 0.0), (0.6, 0.0), (0.3, -1.0), (0.0, 3.0)])
def test_a_step_of_the_residuals_is_measured_and_a_smooth_function_is_not_a_step(
    step: tuple[float, float],
) -> None:
    rng, camera = np.random.default_rng(4), NARROW.pinhole
    points = rng.uniform([0.0, 0.0], [camera.columns, camera.rows], (40, 2))
    noise, covariance = rng.normal(0.0, 0.1, (40, 2)), np.tile(0.01 * np.eye(2), (40, 1, 1))
    below = points[:, 1] > 0.6 * camera.rows
    found = displacement(points, noise + below[:, None] * np.array(step), covariance, camera, False)
    np.testing.assert_allclose(found, step, atol=0.2)
    place = points[:, 1] / camera.rows - 0.5
    bent = noise + 8.0 * place[:, None] ** 3 * np.array([1.0, 0.5]) + place[:, None] ** 2
    assert not displacement(points, bent, covariance, camera, False).any()
