"""Tests of cubic Hermite interpolation against scipy and against cubic functions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.disturbance import Pressures, shapes
from knightcube.astro.quaternion import attitude_matrix, normalise
from knightcube.gnc.guidance.slew_model import (
    HermiteCubic,
    SlewCraft,
    SlewDynamics,
    SlewEnvironment,
    heat_matrix,
    mean_squares,
    shown,
)


def test_slopes_and_curvature_are_those_of_central_differences() -> None:
    rng = np.random.default_rng(1)
    inertia = np.diag([0.0066, 0.0333, 0.0333]) + 1e-3
    residual, sizes = 1e-3 * rng.normal(size=3), 1e-7 * rng.normal(size=9)
    craft = SlewCraft(inertia, np.full(3, 0.2), np.ones(3), residual).facing(sizes)
    point, pull = rng.normal(size=(4, 10)), rng.normal(size=(4, 7))
    pressures = Pressures(rng.normal(size=(4, 3)), rng.normal(size=(4, 3)))
    around = SlewEnvironment(3e-5 * rng.normal(size=(4, 3)), 4e6 * rng.normal(size=(4, 3)), pressures)
    motion = SlewDynamics(craft, 300.0, 0.2, around)

    def flow(z: np.ndarray) -> np.ndarray:
        return motion.flow(z[:, :7], z[:, 7:])

    def slopes(z: np.ndarray) -> np.ndarray:
        return motion.slopes(z[:, :7], z[:, 7:])

    curvature = motion.curvature(point[:, :7], point[:, 7:], pull)
    for k in range(10):
        shift = 1e-5 * np.eye(10)[k]
        rise = (flow(point + shift) - flow(point - shift)) / 2e-5
        np.testing.assert_allclose(slopes(point)[:, :, k], rise, rtol=1e-6, atol=1e-7)
        bend = np.einsum("ni,nij->nj", pull, slopes(point + shift) - slopes(point - shift)) / 2e-5
        np.testing.assert_allclose(curvature[:, :, k], bend, rtol=1e-6, atol=1e-6)


def test_torques_of_air_and_light_are_those_that_the_filter_estimates() -> None:
    rng = np.random.default_rng(3)
    q, sizes = normalise(rng.normal(size=(5, 4))), 1e-7 * rng.normal(size=9)
    inertia = np.diag([0.0066, 0.0333, 0.04])
    craft = SlewCraft(inertia, np.full(3, 0.2), np.ones(3))
    pressures = Pressures(rng.normal(size=(5, 3)), rng.normal(size=(5, 3)))
    around = SlewEnvironment(3e-5 * rng.normal(size=(5, 3)), 7e6 * rng.normal(size=(5, 3)), pressures)
    still, nothing = np.concatenate([q, np.zeros((5, 3))], axis=1), np.zeros((5, 3))
    pushed = SlewDynamics(craft.facing(sizes), 1.0, 0.2, around).flow(still, nothing)
    pushed = pushed - SlewDynamics(craft, 1.0, 0.2, around).flow(still, nothing)
    expected = shapes(pressures, attitude_matrix(q)) @ sizes
    np.testing.assert_allclose(pushed[:, 4:] @ inertia, expected, rtol=1e-9, atol=1e-18)


def test_a_quadratic_form_shows_vectors_as_the_attitude_matrix_does() -> None:
    rng = np.random.default_rng(2)
    q, vector = normalise(rng.normal(size=(5, 4))), rng.normal(size=(5, 3))
    expected = np.einsum("nij,nj->ni", attitude_matrix(q), vector)
    np.testing.assert_allclose(shown(q, vector), expected, atol=1e-12)


def test_values_and_slopes_agree_with_scipy_inside_and_outside() -> None:
    rng = np.random.default_rng(1)
    times = np.sort(rng.uniform(0.0, 9.0, 12))
    values, slopes = rng.normal(size=(2, 12, 3))
    at = np.linspace(-1.0, 10.0, 333)
    scipys, ours = CubicHermiteSpline(times, values, slopes), HermiteCubic(times, values, slopes)
    np.testing.assert_allclose(ours(at), scipys(at), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(ours.derivative(at), scipys(at, 1), rtol=1e-12, atol=1e-12)


def test_a_cubic_is_exact() -> None:
    times = np.array([0.0, 0.5, 2.0])
    at = np.array([0.1, 0.5, 1.3, 2.0])
    curve = HermiteCubic(times, (times**3)[:, None], (3.0 * times**2)[:, None])
    np.testing.assert_allclose(curve(at)[:, 0], at**3, rtol=1e-13)
    np.testing.assert_allclose(curve.derivative(at)[:, 0], 3.0 * at**2, rtol=1e-13)


@pytest.mark.parametrize("weights", [np.array([2.0, 3.0, 5.0]), np.eye(3) + 0.3])
def test_the_mean_heat_of_linear_dipoles_is_that_of_many_samples(weights: FloatArray) -> None:
    dipoles, matrix = np.random.default_rng(3).normal(size=(5, 3)), heat_matrix(weights)
    share = (np.arange(2000) + 0.5)[:, None] / 2000
    for k, mean in enumerate(mean_squares(dipoles, matrix)):
        between = dipoles[k] + share * (dipoles[k + 1] - dipoles[k])
        assert mean == pytest.approx(np.einsum("ni,ij,nj->n", between, matrix, between).mean(), rel=1e-6)
