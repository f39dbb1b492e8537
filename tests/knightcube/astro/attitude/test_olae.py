"""Tests of the Optimal Linear Attitude Estimator against exact rotations and the SVD solution."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from knightcube.astro.arrays import FloatArray
from knightcube.astro.attitude.olae import gain, rotation_between
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, to_rotation_vector
from tests.support.streak_frames import rotate, star_camera

_PINHOLE = star_camera().pinhole


def _directions(n: int, seed: int) -> FloatArray:
    return _PINHOLE.unit_vectors(np.random.default_rng(seed).uniform(0.0, 1023.0, (n, 2)))


@given(st.tuples(*[st.floats(-1.0, 1.0)] * 3), st.integers(0, 1000))
def test_noise_free_data_give_the_rotation_exactly(vector: tuple[float, float, float], seed: int) -> None:
    rotation = np.array(vector)
    starts = _directions(5, seed)
    solution = rotation_between(starts, rotate(starts, rotation), np.ones(5))
    np.testing.assert_allclose(solution.rotation_vector, rotation, atol=1e-9)
    np.testing.assert_allclose(solution.residuals, 0.0, atol=1e-9)


def test_the_quaternion_turns_starts_into_ends() -> None:
    starts = _directions(6, 1)
    ends = rotate(starts, np.array([0.02, -0.5, 0.3]))
    matrix = attitude_matrix(rotation_between(starts, ends, np.ones(6)).quaternion)
    np.testing.assert_allclose(starts @ matrix.T, ends, atol=1e-12)


def _wahba(starts: FloatArray, ends: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the rotation matrix that minimises Wahba's loss, by SVD (Markley 1988)."""
    u, _, vt = np.linalg.svd(np.einsum("n,ni,nj->ij", weights, ends, starts))
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt)]) @ vt)


def test_it_agrees_with_an_svd_solution_of_wahbas_problem_far_below_the_noise() -> None:
    rng = np.random.default_rng(2)
    sigma = 0.2 / _PINHOLE.focal_length
    starts = _directions(25, 3)
    ends = rotate(starts, np.array([0.003, 0.02, -0.001]))
    ends = ends + sigma * rng.normal(size=ends.shape)
    ends = ends / np.linalg.norm(ends, axis=-1, keepdims=True)
    weights = rng.uniform(0.2, 1.0, 25)
    found = attitude_matrix(rotation_between(starts, ends, weights).quaternion)
    difference = found @ _wahba(starts, ends, weights).T
    # The losses of both solvers differ in second order, by the noise times the rotation of 0.02 rad.
    skew = 0.5 * np.array([difference[2, 1], difference[0, 2], difference[1, 0]])
    assert np.linalg.norm(skew) < 0.05 * sigma


def test_the_gain_is_the_derivative_of_the_rotation_vector() -> None:
    starts = _directions(7, 4)
    rotation = np.array([0.1, 0.4, -0.2])
    ends = rotate(starts, rotation)
    weights = np.linspace(0.5, 1.5, 7)
    solution = rotation_between(starts, ends, weights)
    # Opposite errors of b and r change the difference d = b - r, but not the sum.
    error = 1e-6 * np.array([0.3, -0.5, 0.2])
    moved_starts, moved_ends = starts.copy(), ends.copy()
    moved_starts[2] -= 0.5 * error
    moved_ends[2] += 0.5 * error
    change = rotation_between(moved_starts, moved_ends, weights).rotation_vector - solution.rotation_vector
    np.testing.assert_allclose(change, gain(solution, weights)[2] @ error, atol=1e-11)


def test_parallel_directions_fix_no_rotation() -> None:
    v = np.tile([0.0, 0.0, 1.0], (4, 1))
    with pytest.raises(np.linalg.LinAlgError):
        rotation_between(v, v, np.ones(4))


def test_the_sign_is_that_of_stars_moving_with_minus_omega_cross_v() -> None:
    omega = np.array([0.0, 0.01, 0.0])
    v = np.array([[0.0, 0.0, 1.0], [0.1, 0.0, 0.995]])
    v = v / np.linalg.norm(v, axis=-1, keepdims=True)
    solution = rotation_between(v, v - np.cross(omega, v), np.ones(2))
    np.testing.assert_allclose(solution.rotation_vector, omega, atol=1e-5)
    np.testing.assert_allclose(to_rotation_vector(from_rotation_vector(omega)), omega)
