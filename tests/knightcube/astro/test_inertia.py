"""Tests of inertia tensors: principal axes near the body axes, and tensors that no body can have."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.astro.inertia import box_inertia, inertia_problem, principal_axes
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector


@pytest.mark.parametrize("moments", [(3.0, 4.0, 5.0), (5.0, 3.0, 4.0), (4.0, 5.0, 3.0), (4.0, 4.0, 4.5)])
def test_the_principal_axes_are_found_next_to_the_body_axes(moments: tuple[float, ...]) -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        vector = rng.standard_normal(3)
        vector *= rng.uniform(0.01, 0.6) / np.linalg.norm(vector)
        rotation = attitude_matrix(from_rotation_vector(vector))
        inertia = rotation.T @ np.diag(moments) @ rotation
        found, axes = principal_axes(inertia)
        np.testing.assert_allclose(axes.T @ np.diag(found) @ axes, inertia, atol=1e-12)
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(axes) > 0.0
        if len(set(moments)) == 3:
            np.testing.assert_allclose(found, moments, atol=1e-12)
            np.testing.assert_allclose(axes, rotation, atol=1e-7)


def test_a_large_rotation_still_gives_a_rotation() -> None:
    rng = np.random.default_rng(4)
    for _ in range(200):
        rotation = attitude_matrix(from_rotation_vector(rng.uniform(-3.0, 3.0, 3)))
        inertia = rotation.T @ np.diag([3.0, 4.0, 5.0]) @ rotation
        found, axes = principal_axes(inertia)
        np.testing.assert_allclose(axes.T @ np.diag(found) @ axes, inertia, atol=1e-12)
        assert np.linalg.det(axes) > 0.0


def test_a_diagonal_tensor_keeps_its_moments_exactly() -> None:
    moments, axes = principal_axes(np.diag([1.10e-3, 1.05e-3, 0.99e-3]))
    assert moments.tolist() == [1.10e-3, 1.05e-3, 0.99e-3]
    assert axes.tolist() == np.eye(3).tolist()


@pytest.mark.parametrize(
    ("inertia", "words"),
    [
        (np.diag([1.0, 1.0, 2.0]), ""),  # moments of a thin disc, the limit of possible moments
        (np.diag([1.0, 1.0, 2.001]), "largest must not exceed the sum of the other two (2)"),
        (np.diag([1.0, 1.0, -0.5]), "moments -0.5, 1, 1: all must be positive"),
        (np.diag([1.0, 1.0, 0.0]), "all must be positive"),
        (np.array([[2.0, 0.1, 0.0], [0.1, 2.0, 0.0], [0.0, 0.0, 2.0]]), ""),
        (
            np.array([[2.0, 0.1, 0.0], [-0.1, 2.0, 0.0], [0.0, 0.0, 2.0]]),
            "row 1, column 2 is 0.1, and row 2, column 1 is -0.1",
        ),
        (np.array([[2.0, 3.0, 0.0], [3.0, 2.0, 0.0], [0.0, 0.0, 2.0]]), "all must be positive"),
        # The diagonal elements satisfy the triangle inequality, but the principal moments 0.2, 2 and 3.8 do
        # not.
        (np.array([[2.0, 1.8, 0.0], [1.8, 2.0, 0.0], [0.0, 0.0, 2.0]]), "moments 0.2, 2, 3.8: the largest"),
    ],
)
def test_an_impossible_tensor_has_a_problem_with_values_and_cure(inertia: FloatArray, words: str) -> None:
    problem = inertia_problem(inertia)
    assert (problem == "") == (words == "")
    assert words in problem


def test_the_inertia_of_a_box_is_that_of_its_volume() -> None:
    rng = np.random.default_rng(1)
    size, mass = (0.1, 0.2, 0.34), 6.0
    points = rng.uniform(-0.5, 0.5, (400_000, 3)) * np.array(size)
    squares = (points**2).mean(axis=0)
    expected = mass * (squares.sum() - squares)
    np.testing.assert_allclose(np.diag(box_inertia(mass, size)), expected, rtol=5e-3)
    assert inertia_problem(box_inertia(mass, (1e-3, 1.0, 1.0))) == ""
