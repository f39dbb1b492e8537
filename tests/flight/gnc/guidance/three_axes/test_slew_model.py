"""The derivatives of a satellite's motion."""

from __future__ import annotations

import numpy as np

from flight.gnc.guidance.three_axes.slew_model import Around, Motion, SlewCraft, shown
from flight.gnc.math.quaternion import attitude_matrix, normalise


def test_slopes_and_curvature_are_those_of_central_differences() -> None:
    rng = np.random.default_rng(1)
    inertia = np.diag([0.0066, 0.0333, 0.0333]) + 1e-3
    craft = SlewCraft(
        inertia, np.full(3, 0.2), np.ones(3), 1e-3 * rng.normal(size=3), 1e-8 * rng.normal(size=3)
    )
    point, pull = rng.normal(size=(4, 10)), rng.normal(size=(4, 7))
    around = Around(3e-5 * rng.normal(size=(4, 3)), 4e6 * rng.normal(size=(4, 3)))
    motion = Motion(craft, 300.0, 0.2, around)

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


def test_a_quadratic_form_shows_vectors_as_the_attitude_matrix_does() -> None:
    rng = np.random.default_rng(2)
    q, vector = normalise(rng.normal(size=(5, 4))), rng.normal(size=(5, 3))
    expected = np.einsum("nij,nj->ni", attitude_matrix(q), vector)
    np.testing.assert_allclose(shown(q, vector), expected, atol=1e-12)
