"""Tests of ESOQ2 against the SVD solution of Wahba's problem, scipy, and its own covariance."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from knightcube.astro.arrays import FloatArray
from knightcube.astro.attitude.solvers import SOLVERS
from knightcube.astro.attitude.wahba import AttitudeError, profile_matrix
from knightcube.astro.quaternion import (
    IDENTITY,
    angle_between,
    attitude_matrix,
    conjugate,
    from_matrix,
    from_rotation_vector,
    multiply,
    normalise,
    to_rotation_vector,
)
from tests.knightcube.astro.attitude.sights import unit

_solve = SOLVERS["esoq2"]
_NARROW = 0.17  # half of a 20 deg field of view (rad)


def _reference(rng: np.random.Generator, n: int, half_field: float | None) -> FloatArray:
    drawn = rng.normal(size=(n, 3))
    if half_field is None:
        return unit(drawn)
    return unit(np.array([0.0, 0.0, 1.0]) + half_field * drawn * np.array([1.0, 1.0, 0.0]))


def _observed(
    rng: np.random.Generator, q: FloatArray, reference: FloatArray, sigma: FloatArray
) -> FloatArray:
    noise = sigma[:, None] * rng.normal(size=reference.shape)
    return unit(reference @ attitude_matrix(q).T + noise)


def _by_singular_values(observed: FloatArray, reference: FloatArray, sigma: FloatArray) -> FloatArray:
    """Return the optimal quaternion by Markley's SVD method."""
    u, _, v = np.linalg.svd(profile_matrix(observed, reference, 1.0 / sigma**2))
    return from_matrix(u @ np.diag([1.0, 1.0, np.linalg.det(u) * np.linalg.det(v)]) @ v)


@pytest.mark.parametrize("n", [2, 3, 10, 50])
@pytest.mark.parametrize("half_field", [None, _NARROW])
def test_esoq2_is_the_solution_by_singular_values_to_a_tenth_of_a_nanoradian(
    n: int, half_field: float | None
) -> None:
    rng = np.random.default_rng([41, n])
    for _ in range(40):
        q = normalise(rng.normal(size=4))
        sigma = 1e-4 * rng.uniform(0.3, 3.0, n)
        reference = _reference(rng, n, half_field)
        observed = _observed(rng, q, reference, sigma)
        found = _solve(observed, reference, sigma)
        assert angle_between(found.quaternion, _by_singular_values(observed, reference, sigma)) < 1e-10


def test_directions_that_share_no_attitude_still_give_the_optimum() -> None:
    rng = np.random.default_rng(42)
    for _ in range(40):
        observed, reference = _reference(rng, 5, None), _reference(rng, 5, None)
        sigma = rng.uniform(0.5, 2.0, 5)
        found = _solve(observed, reference, sigma)
        assert angle_between(found.quaternion, _by_singular_values(observed, reference, sigma)) < 1e-10


def test_esoq2_is_the_solution_of_scipy() -> None:
    rng = np.random.default_rng(43)
    for _ in range(20):
        sigma = 1e-4 * rng.uniform(0.3, 3.0, 8)
        reference = _reference(rng, 8, _NARROW)
        observed = _observed(rng, normalise(rng.normal(size=4)), reference, sigma)
        found = _solve(observed, reference, sigma)
        rotation, root_loss = Rotation.align_vectors(observed, reference, weights=1.0 / sigma**2)
        # scipy's quaternion rotates vectors, and this library's quaternion rotates axes, so the conjugate is
        # used.
        assert angle_between(found.quaternion, conjugate(rotation.as_quat())) < 1e-10
        assert found.loss == pytest.approx(0.5 * root_loss**2, rel=1e-6)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 1.0, np.pi - 1e-9, np.pi])
@pytest.mark.parametrize(
    "axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, -1, 1), (0.3, -0.2, 0.9), (-1, 0, 0)]
)
@pytest.mark.parametrize("n", [2, 6])
def test_no_angle_and_no_axis_is_singular(angle: float, axis: tuple[float, float, float], n: int) -> None:
    """The solver has no singular rotation angle or axis, due to the method of sequential rotations.

    Without this method, the axis is undefined at 0 deg, and the scalar part is zero at 180 deg.
    """
    q = from_rotation_vector(angle * unit(np.array(axis)))
    reference = _reference(np.random.default_rng(44), n, _NARROW)
    found = _solve(reference @ attitude_matrix(q).T, reference, np.full(n, 1e-5))
    assert angle_between(found.quaternion, q) < 1e-11
    assert found.quaternion[3] >= 0.0
    assert np.linalg.norm(found.quaternion) == pytest.approx(1.0, abs=1e-14)


def test_a_better_observation_weighs_more() -> None:
    reference = np.eye(3)
    tilted = reference.copy()
    tilted[0] = attitude_matrix(from_rotation_vector(np.array([0.0, 0.0, 1e-3]))) @ reference[0]
    trusting = _solve(tilted, reference, np.array([1e-6, 1e-3, 1e-3]))
    doubting = _solve(tilted, reference, np.array([1e-3, 1e-6, 1e-6]))
    assert angle_between(trusting.quaternion, IDENTITY) == pytest.approx(1e-3, rel=0.01)
    assert angle_between(doubting.quaternion, IDENTITY) < 1e-5


def test_the_covariance_and_the_loss_are_those_of_the_errors() -> None:
    rng = np.random.default_rng(45)
    n, runs = 6, 400
    sigma = 1e-4 * rng.uniform(0.5, 2.0, n)
    q = normalise(rng.normal(size=4))
    reference = _reference(rng, n, _NARROW)
    squared, losses = [], []
    for _ in range(runs):
        found = _solve(_observed(rng, q, reference, sigma), reference, sigma)
        error = to_rotation_vector(multiply(found.quaternion, conjugate(q)))
        squared.append(error @ np.linalg.solve(found.covariance, error))
        losses.append(2.0 * found.loss)
    # The expected means are the means of chi-squares with 3 and with 2n - 3 = 9 degrees of freedom. The
    # tolerance is three standard errors.
    assert np.mean(squared) == pytest.approx(3.0, abs=3.0 * np.sqrt(6.0 / runs))
    assert np.mean(losses) == pytest.approx(9.0, abs=3.0 * np.sqrt(18.0 / runs))


def test_directions_on_one_line_fix_no_attitude() -> None:
    star, other = unit(np.array([0.1, 0.2, 1.0])), unit(np.array([0.3, 0.0, 1.0]))
    apart = np.array([star, other])
    for line in ([star, star], [star, -star], [star]):
        n = len(line)
        with pytest.raises(AttitudeError, match="on one line"):
            _solve(np.array(line), apart[:n], np.full(n, 1e-5))
    with pytest.raises(AttitudeError, match="reference directions on one line"):
        _solve(apart, np.array([star, star]), np.full(2, 1e-5))
    with pytest.raises(AttitudeError, match="0 observed"):
        _solve(np.empty((0, 3)), np.empty((0, 3)), np.empty(0))


def test_invalid_directions_and_errors_are_refused() -> None:
    good, sigma = np.eye(3), np.full(3, 1e-5)
    for observed in (2.0 * good, np.where(good == 1.0, np.nan, good)):
        with pytest.raises(AttitudeError, match="unit length"):
            _solve(observed, good, sigma)
    for bad in (0.0, -1.0, np.inf, np.nan):
        with pytest.raises(AttitudeError, match="finite and positive"):
            _solve(good, good, np.array([1e-5, bad, 1e-5]))
    with pytest.raises(AttitudeError, match=r"\(n, 3\)"):
        _solve(good[:2], good, sigma)
