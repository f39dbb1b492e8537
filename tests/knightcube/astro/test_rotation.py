"""Tests that the quaternion algebra for tuples of floats equals the algebra for arrays."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from knightcube.astro import quaternion
from knightcube.astro.quaternion import Quaternion, Vector

component = st.floats(-1.0, 1.0)
vectors = st.tuples(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0), st.floats(-3.0, 3.0))
quaternions = st.tuples(component, component, component, component).filter(
    lambda q: sum(c * c for c in q) > 1e-3
)


def unit(q: Quaternion) -> Quaternion:
    a, b, c, d = quaternion.normalise(np.array(q)).tolist()
    return a, b, c, d


@given(quaternions, quaternions)
def test_composition_and_inverse_equal_those_of_the_array_form(p: Quaternion, q: Quaternion) -> None:
    p, q = unit(p), unit(q)
    expected = quaternion.multiply(np.array(p), quaternion.conjugate(np.array(q)))
    np.testing.assert_allclose(quaternion.compose(p, quaternion.inverse(q)), expected, atol=1e-15)


@given(vectors)
def test_the_exponential_equals_that_of_the_array_form_and_the_logarithm_inverts_it(v: Vector) -> None:
    q = quaternion.exponential(*v)
    np.testing.assert_allclose(q, quaternion.from_rotation_vector(np.array(v)), atol=1e-15)
    np.testing.assert_allclose(
        quaternion.logarithm(q), quaternion.to_rotation_vector(np.array(q)), atol=1e-14
    )


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-6, 9.9e-5, 2.1e-4, 1e-2])
def test_small_turns_lose_no_digits(angle: float) -> None:
    v = (0.6 * angle, 0.0, -0.8 * angle)
    assert quaternion.exponential(*v)[0] == pytest.approx(0.6 * math.sin(0.5 * angle), rel=1e-14, abs=1e-300)
    np.testing.assert_allclose(quaternion.logarithm(quaternion.exponential(*v)), v, rtol=1e-12, atol=1e-300)


@given(quaternions, vectors)
def test_the_matrix_rotates_vectors_like_that_of_the_array_form(q: Quaternion, v: Vector) -> None:
    q = unit(q)
    expected = quaternion.attitude_matrix(np.array(q)) @ np.array(v)
    np.testing.assert_allclose(quaternion.times(quaternion.matrix(q), v), expected, atol=1e-14)


@given(vectors, vectors)
def test_the_skew_matrix_is_the_cross_product(a: Vector, b: Vector) -> None:
    np.testing.assert_allclose(quaternion.cross(a, b), np.cross(a, b), atol=1e-14)
    np.testing.assert_allclose(quaternion.times(quaternion.skew(a), b), np.cross(a, b), atol=1e-14)


@given(quaternions, st.floats(-3.1, 3.1))
def test_the_twist_equals_that_of_the_array_form(q: Quaternion, angle: float) -> None:
    q = unit(q)
    if math.hypot(q[1], q[3]) > 0.1:
        expected = quaternion.angle_about_axis_y(np.array(q))
        assert math.remainder(quaternion.twist(q) - expected, 2.0 * math.pi) == pytest.approx(0.0, abs=1e-13)
    assert quaternion.twist(quaternion.exponential(0.0, angle, 0.0)) == pytest.approx(angle, abs=1e-14)


def test_the_rows_of_an_array_are_tuples_of_floats_in_order() -> None:
    assert quaternion.rows_of(np.arange(9.0).reshape(3, 3)) == (
        (0.0, 1.0, 2.0),
        (3.0, 4.0, 5.0),
        (6.0, 7.0, 8.0),
    )


@given(vectors, vectors)
def test_a_sum_of_vectors_adds_each_component(a: Vector, b: Vector) -> None:
    assert quaternion.added(a, b) == (a[0] + b[0], a[1] + b[1], a[2] + b[2])


@given(st.floats(-3.1, 3.1))
def test_the_twist_is_the_angle_of_a_rotation_about_y(angle: float) -> None:
    assert quaternion.twist(quaternion.exponential(0.0, angle, 0.0)) == pytest.approx(angle, abs=1e-12)
