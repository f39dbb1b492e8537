"""Tests that the residual dipole is estimated from the rate, within its bound and for any coil currents."""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import FloatArray, cross_product
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector
from knightcube.gnc.control.sun_acquisition import ResidualDipole

INERTIA = np.array([1.10e-3, 1.05e-3, 0.99e-3])
DIPOLE = np.array([6e-4, -5e-4, 7e-4])
STEP = 0.1


def learned(coils: FloatArray, dipole: FloatArray, bound: float) -> FloatArray:
    """Return the dipole estimated in 1,500 s, in which the field rotates once, as in half an orbit."""
    observer, rng = ResidualDipole(np.diag(INERTIA), bound), np.random.default_rng(5)
    rate = np.array([1e-3, -2e-3, 5e-4])
    for k in range(round(1500.0 / STEP)):
        angle = 4e-3 * k * STEP
        field = 3e-5 * np.array([np.cos(angle), np.sin(angle), 0.6])
        acting = coils * np.sin(0.7 * k * STEP)
        # A known coil torque opposes the rate, so that the body stays slow.
        hold = cross_product(field, -2e-5 * rate) / (field @ field)
        torque = cross_product(acting + hold + dipole, field) - cross_product(rate, INERTIA * rate)
        rate = rate + STEP * torque / INERTIA
        observer.follow(STEP, rate + 1e-4 * rng.standard_normal(3), field, acting + hold)
    return observer.dipole


def test_the_dipole_is_learned_beside_coils_that_are_a_hundred_times_stronger() -> None:
    for coils in (np.zeros(3), np.array([0.05, -0.05, 0.02])):
        assert np.linalg.norm(learned(coils, DIPOLE, 5e-3) - DIPOLE) < 0.25 * np.linalg.norm(DIPOLE)


def test_no_dipole_is_estimated_for_a_body_without_one() -> None:
    assert np.linalg.norm(learned(np.zeros(3), np.zeros(3), 5e-3)) < 2e-4


def test_no_estimated_dipole_exceeds_the_bound_and_a_gap_restarts_the_estimate() -> None:
    assert np.abs(learned(np.zeros(3), 20.0 * DIPOLE, 5e-3)).max() <= 5e-3
    observer = ResidualDipole(np.diag(INERTIA), 5e-3)
    field = np.array([0.0, 0.0, 3e-5])
    for seconds in (0.1, 5.0):
        observer.follow(seconds, np.array([seconds, 0.0, 0.0]), field, np.zeros(3))
    np.testing.assert_array_equal(observer.dipole, np.zeros(3))


def test_a_full_tensor_gives_the_same_dipole_in_rotated_body_axes() -> None:
    rng = np.random.default_rng(3)
    turn = attitude_matrix(from_rotation_vector(np.array([0.3, -0.5, 0.4])))
    moments = np.diag([1.1e-3, 3.05e-3, 2.2e-3])
    plain, rotated = ResidualDipole(moments, 1.0), ResidualDipole(turn @ moments @ turn.T, 1.0)
    for _ in range(50):
        rate, field, coils = np.array([[0.01], [3e-5], [1.0]]) * rng.standard_normal((3, 3))
        plain.follow(0.1, rate, field, coils)
        rotated.follow(0.1, turn @ rate, turn @ field, turn @ coils)
    assert np.linalg.norm(plain.dipole) > 1e-4
    np.testing.assert_allclose(rotated.dipole, turn @ plain.dipole, rtol=1e-9)
