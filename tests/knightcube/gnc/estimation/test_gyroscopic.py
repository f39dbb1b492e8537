"""Tests of the quadratic form of Euler's equations, and of its dependence on inertia and gyro errors."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from knightcube.astro.arrays import FloatArray
from knightcube.gnc.estimation.rigid_body import (
    BodyErrors,
    coefficient_modes,
    gyroscopic_coefficients,
    inertia_covariance,
    rate_products,
)

CUBESAT_3U = np.diag([0.0066, 0.0333, 0.0333])
KNIGHTCUBE = np.diag([1.10e-3, 1.05e-3, 0.99e-3])


def _acceleration(inertia: FloatArray, rate: FloatArray) -> FloatArray:
    """Return the torque-free acceleration J^-1 (J w x w) of Euler's equations."""
    return np.asarray(np.linalg.solve(inertia, np.cross(inertia @ rate, rate)))


def test_the_coefficients_give_eulers_acceleration_of_a_full_tensor() -> None:
    rng = np.random.default_rng(1)
    root = rng.normal(size=(3, 3))
    inertia = root @ root.T + 3.0 * np.eye(3)
    rates = rng.normal(size=(20, 3))
    expected = np.array([_acceleration(inertia, rate) for rate in rates])
    assert rate_products(rates) @ gyroscopic_coefficients(inertia).T == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("believed", [CUBESAT_3U, KNIGHTCUBE])
def test_the_modes_span_other_bodies_and_gyros_with_weights_of_about_one(believed: FloatArray) -> None:
    """The modes describe the acceleration errors of other bodies and gyros to a hundredth.

    The modes are corrections of the gyroscopic coefficients for errors of inertia and gyro.
    """
    rng = np.random.default_rng(7)
    modes = coefficient_modes(believed, BodyErrors())
    for _ in range(20):
        moments = np.diag(believed) * (1.0 + rng.uniform(-0.08, 0.08, 3))
        turn = Rotation.from_rotvec(np.radians(4.0) * rng.uniform(-1.0, 1.0, 3)).as_matrix()
        inertia = turn @ np.diag(moments) @ turn.T
        gyro = np.eye(3) + 2e-3 * rng.uniform(-1.0, 1.0, (3, 3))
        rates = rng.normal(size=(60, 3))
        shown = np.array([gyro @ _acceleration(inertia, rate) for rate in rates])
        measured = rates @ gyro.T
        error = shown - rate_products(measured) @ gyroscopic_coefficients(believed).T
        columns = np.einsum("kij,nj->nik", modes, rate_products(measured)).reshape(-1, len(modes))
        weights, *_ = np.linalg.lstsq(columns, error.ravel())
        residual = error.ravel() - columns @ weights
        assert np.sqrt(np.mean(residual**2)) < 1e-2 * np.sqrt(np.mean(error**2))
        assert np.sqrt(np.mean(weights**2)) < 3.0


def test_the_modes_of_a_better_known_body_are_smaller() -> None:
    wide, narrow = (
        np.linalg.norm(coefficient_modes(CUBESAT_3U, BodyErrors(moments=size, axes=size)))
        for size in (0.08, 0.008)
    )
    assert wide == pytest.approx(10.0 * narrow, rel=0.2)


def test_a_flat_body_with_known_moments_has_a_finite_prior() -> None:
    """The largest moment of a flat plate is the sum of the other two."""
    plate = np.diag([1.0e-3, 1.3e-3, 2.3e-3])
    found = inertia_covariance(plate, BodyErrors(moments=0.0))
    assert np.isfinite(found).all()
    assert np.abs(inertia_covariance(plate, BodyErrors(moments=0.0, axes=0.0))).max() < 1e-12
