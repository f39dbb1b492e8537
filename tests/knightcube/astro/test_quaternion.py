"""Tests of quaternion algebra against matrices, finite differences and scipy's Rotation."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from knightcube.astro import quaternion
from knightcube.astro.arrays import FloatArray

ANGLES = st.floats(-3.14, 3.14)


@st.composite
def _unit(draw: st.DrawFn, size: int) -> FloatArray:
    vector = draw(arrays(np.float64, size, elements=st.floats(-1.0, 1.0)))
    length = float(np.linalg.norm(vector))
    assume(length > 1e-3)
    return np.asarray(vector / length)


UNIT_QUATERNIONS = _unit(4)
VECTORS = arrays(np.float64, 3, elements=st.floats(-10.0, 10.0))


def _close(a: FloatArray, b: FloatArray, tolerance: float = 1e-12) -> bool:
    return bool(np.allclose(a, b, rtol=0.0, atol=tolerance))


def _cross(vector: FloatArray) -> FloatArray:
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


@given(UNIT_QUATERNIONS)
def test_attitude_matrix_is_a_proper_rotation(q: FloatArray) -> None:
    a = quaternion.attitude_matrix(q)
    assert _close(a @ a.T, np.eye(3))
    assert np.linalg.det(a) == pytest.approx(1.0, abs=1e-12)


@given(UNIT_QUATERNIONS)
def test_attitude_matrix_is_the_transpose_of_scipys(q: FloatArray) -> None:
    """Scipy rotates vectors and A(q) rotates frames, so the same quaternion gives the transposed matrix."""
    assert _close(quaternion.attitude_matrix(q), Rotation.from_quat(q).as_matrix().T)


@given(_unit(3), ANGLES)
def test_attitude_matrix_is_eulers_formula(axis: FloatArray, angle: float) -> None:
    """Wertz 12-7: A = cos I + (1 - cos) e e^T - sin [e x]."""
    q = quaternion.from_rotation_vector(angle * axis)
    expected = (
        np.cos(angle) * np.eye(3)
        + (1.0 - np.cos(angle)) * np.outer(axis, axis)
        - np.sin(angle) * _cross(axis)
    )
    assert _close(quaternion.attitude_matrix(q), expected)


def test_a_positive_rotation_about_z_moves_the_x_axis_of_the_body_to_y() -> None:
    """A rotation of +90 deg about z moves the body's x axis to the reference's y axis.

    After the rotation, the reference's y axis is (1, 0, 0) in body axes.
    """
    q = quaternion.from_rotation_vector(np.array([0.0, 0.0, 0.5 * np.pi]))
    assert _close(quaternion.attitude_matrix(q) @ [0.0, 1.0, 0.0], np.array([1.0, 0.0, 0.0]))


@given(UNIT_QUATERNIONS, UNIT_QUATERNIONS)
def test_composition_follows_the_matrices(p: FloatArray, q: FloatArray) -> None:
    product = quaternion.attitude_matrix(quaternion.multiply(p, q))
    assert _close(product, quaternion.attitude_matrix(p) @ quaternion.attitude_matrix(q))


@given(UNIT_QUATERNIONS, UNIT_QUATERNIONS, UNIT_QUATERNIONS)
def test_composition_is_associative_and_keeps_length(p: FloatArray, q: FloatArray, r: FloatArray) -> None:
    left = quaternion.multiply(quaternion.multiply(p, q), r)
    assert _close(left, quaternion.multiply(p, quaternion.multiply(q, r)))
    assert np.linalg.norm(left) == pytest.approx(1.0, abs=1e-12)


@given(UNIT_QUATERNIONS)
def test_the_conjugate_is_the_inverse(q: FloatArray) -> None:
    assert _close(quaternion.multiply(q, quaternion.conjugate(q)), quaternion.IDENTITY)
    assert _close(quaternion.attitude_matrix(quaternion.conjugate(q)), quaternion.attitude_matrix(q).T)


@given(UNIT_QUATERNIONS)
def test_matrix_round_trip(q: FloatArray) -> None:
    back = quaternion.from_matrix(quaternion.attitude_matrix(q))
    assert back[3] >= 0.0
    assert quaternion.angle_between(back, q) < 1e-7
    assert _close(quaternion.attitude_matrix(back), quaternion.attitude_matrix(q), 1e-12)


@pytest.mark.parametrize("axis", np.eye(3))
def test_matrix_of_a_half_turn_has_no_singularity(axis: FloatArray) -> None:
    """At a rotation by pi the scalar part is 0.

    The conversion from a matrix must not divide by the scalar part.
    """
    q = np.append(axis, 0.0)
    assert _close(np.abs(quaternion.from_matrix(quaternion.attitude_matrix(q))), np.abs(q))


def test_matrices_are_converted_together_as_one_by_one() -> None:
    q = quaternion.normalise(np.random.default_rng(5).normal(size=(60, 4)))
    q = np.concatenate([q, np.eye(4)])
    matrices = quaternion.attitude_matrix(q)
    alone = np.array([quaternion.from_matrix(each) for each in matrices])
    assert _close(quaternion.from_matrix(matrices.reshape(16, 4, 3, 3)), alone.reshape(16, 4, 4))


@given(_unit(3), st.floats(0.0, 3.14))
def test_rotation_vector_round_trip(axis: FloatArray, angle: float) -> None:
    vector = angle * axis
    assert _close(quaternion.to_rotation_vector(quaternion.from_rotation_vector(vector)), vector, 1e-11)


@given(UNIT_QUATERNIONS)
def test_rotation_vector_agrees_with_scipy(q: FloatArray) -> None:
    """The rotation vector agrees with scipy, although the attitude matrix is the transpose of scipy's.

    At a rotation by pi, both signs of the rotation vector are correct.
    """
    vector = quaternion.to_rotation_vector(q)
    assume(np.linalg.norm(vector) < np.pi - 1e-6)
    assert _close(vector, Rotation.from_quat(q).as_rotvec(), 1e-9)


@pytest.mark.parametrize("size", [0.0, 1e-300, 1e-12, 1e-9, 1e-6])
def test_small_rotation_vectors_keep_their_digits(size: float) -> None:
    vector = np.array([size, -2.0 * size, 0.5 * size])
    back = quaternion.to_rotation_vector(quaternion.from_rotation_vector(vector))
    assert np.allclose(back, vector, rtol=1e-12, atol=0.0)


@given(VECTORS, _unit(4), st.floats(-2.0, 2.0))
def test_constant_rate_turns_the_attitude_from_the_left(
    rate: FloatArray, start: FloatArray, t: float
) -> None:
    """At a constant rate, A(t) = expm(-[w x] t) A(0), which solves dA/dt = -[w x] A (Wertz 16-1)."""
    q = quaternion.multiply(quaternion.from_rotation_vector(rate * t), start)
    expected = expm(-_cross(rate) * t) @ quaternion.attitude_matrix(start)
    assert _close(quaternion.attitude_matrix(q), expected, 1e-10)


@given(_unit(4), VECTORS)
def test_derivative_is_the_limit_of_small_turns(q: FloatArray, rate: FloatArray) -> None:
    h = 1e-5
    after = quaternion.multiply(quaternion.from_rotation_vector(rate * h), q)
    before = quaternion.multiply(quaternion.from_rotation_vector(-rate * h), q)
    assert _close(quaternion.derivative(q, rate), (after - before) / (2.0 * h), 1e-6)


@given(_unit(4), VECTORS, _unit(3))
def test_a_fixed_star_moves_with_minus_omega_cross_v(
    q: FloatArray, rate: FloatArray, star: FloatArray
) -> None:
    """The direction of a fixed star changes by -omega x v.

    The derivative of the direction determines the sign of the rate.
    """
    h = 1e-6
    ahead = quaternion.normalise(q + h * quaternion.derivative(q, rate))
    behind = quaternion.normalise(q - h * quaternion.derivative(q, rate))
    motion = (quaternion.attitude_matrix(ahead) - quaternion.attitude_matrix(behind)) @ star / (2.0 * h)
    assert _close(motion, -np.cross(rate, quaternion.attitude_matrix(q) @ star), 1e-7)


@given(_unit(4), _unit(3), st.floats(0.0, 3.14))
def test_angle_between_is_the_angle_turned(q: FloatArray, axis: FloatArray, angle: float) -> None:
    turned = quaternion.multiply(quaternion.from_rotation_vector(angle * axis), q)
    assert quaternion.angle_between(turned, q) == pytest.approx(angle, abs=1e-8)
    assert quaternion.angle_between(-turned, q) == pytest.approx(angle, abs=1e-8)


@given(st.floats(1e-12, 1e-6))
def test_angle_between_is_accurate_near_zero(angle: float) -> None:
    """Angles below 1e-8 are accurate. The arc cosine of a dot product would not resolve angles below 1e-8."""
    q = quaternion.about_axis_y(angle)
    assert quaternion.angle_between(q, quaternion.IDENTITY) == pytest.approx(angle, rel=1e-9)


@given(ANGLES)
def test_turns_about_axis_y_round_trip(angle: float) -> None:
    q = quaternion.about_axis_y(angle)
    assert quaternion.angle_about_axis_y(q) == pytest.approx(angle, abs=1e-12)
    assert quaternion.angle_about_axis_y(-q) == pytest.approx(angle, abs=1e-12)
    assert _close(quaternion.multiply(q, q), quaternion.about_axis_y(2.0 * angle))


@given(ANGLES, st.floats(0.0, 6.28), st.floats(0.0, 1.5))
def test_the_twist_about_y_leaves_out_a_tilt(angle: float, azimuth: float, tilt: float) -> None:
    """The twist about y is unaffected by a tilt of the suspension thread about a horizontal axis."""
    swing = quaternion.from_rotation_vector(tilt * np.array([np.cos(azimuth), 0.0, np.sin(azimuth)]))
    q = quaternion.multiply(swing, quaternion.about_axis_y(angle))
    assert quaternion.angle_about_axis_y(q) == pytest.approx(angle, abs=1e-9)


@given(st.floats(-20.0, 20.0))
def test_the_twist_lies_between_minus_pi_and_pi(angle: float) -> None:
    twist = quaternion.angle_about_axis_y(quaternion.about_axis_y(angle))
    assert -np.pi <= twist < np.pi
    assert np.cos(twist - angle) == pytest.approx(1.0, abs=1e-12)


@given(arrays(np.float64, (5, 4), elements=st.floats(0.1, 1.0)))
def test_arrays_of_quaternions_are_treated_one_by_one(many: FloatArray) -> None:
    q = quaternion.normalise(many)
    singly = np.stack([quaternion.attitude_matrix(each) for each in q])
    assert _close(quaternion.attitude_matrix(q), singly)
    products = np.stack([quaternion.multiply(each, q[0]) for each in q])
    assert _close(quaternion.multiply(q, q[0]), products)
    vectors = np.stack([quaternion.to_rotation_vector(each) for each in q])
    assert _close(quaternion.to_rotation_vector(q), vectors)
    assert _close(quaternion.from_rotation_vector(vectors), q)
