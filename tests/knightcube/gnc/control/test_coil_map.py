"""The map from dipole moments to the currents of coils with any axes and strengths."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from knightcube.errors import UsageError
from knightcube.gnc.control.coil_map import CoilMap, limited

TILTED = np.array([[0.8, 0.2, 0.0], [0.1, 0.5, 0.3], [0.0, 0.0, 0.2]])
LIMITS = np.array([0.1, 0.2, 0.3])
OHMS = np.array([10.0, 20.0, 30.0])


def test_currents_make_the_wanted_dipole_and_cost_the_stated_heat() -> None:
    coils = CoilMap(TILTED, LIMITS, OHMS)
    wanted = np.array([0.01, -0.02, 0.03])
    currents = coils.currents(wanted)
    np.testing.assert_allclose(TILTED @ currents, wanted)
    np.testing.assert_allclose(coils.dipole(currents), wanted)
    assert wanted @ coils.heat @ wanted == pytest.approx(float(OHMS @ currents**2))
    np.testing.assert_allclose(coils.per_dipole(TILTED), np.eye(3), atol=1e-12)


def test_equal_coils_along_the_body_axes_are_scaled_exactly() -> None:
    coils = CoilMap.equal(0.648, 0.148, 23.0)
    wanted = np.array([0.01, -0.02, 0.03])
    assert coils.currents(wanted).tolist() == (wanted / 0.648).tolist()
    assert coils.limits.tolist() == [0.648 * 0.148] * 3
    np.testing.assert_allclose(coils.heat, 23.0 / 0.648**2 * np.eye(3))


@given(st.integers(0, 10_000), st.integers(3, 6))
def test_every_dipole_within_the_limits_can_be_made_and_no_limit_is_small_for_nothing(
    seed: int, count: int
) -> None:
    generator = np.random.default_rng(seed)
    dipoles = generator.standard_normal((3, count))
    if np.linalg.svd(dipoles / np.linalg.norm(dipoles, axis=0), compute_uv=False)[-1] < 0.1:
        return
    limits = generator.uniform(0.1, 1.0, count)
    coils = CoilMap(dipoles, limits, np.ones(count))
    corners = np.array(list(itertools.product([-1.0, 1.0], repeat=3))) * coils.limits
    used = np.array([np.abs(coils.currents(corner)) / limits for corner in corners])
    assert used.max() == pytest.approx(1.0)
    # No box that is longer along one axis, and shorter along another by the same factor, is possible.
    for grow, shrink in itertools.permutations(range(3), 2):
        factor = np.ones(3)
        factor[grow], factor[shrink] = 1.05, 1.0 / 1.05
        other = max(np.abs(coils.currents(corner * factor) / limits).max() for corner in corners)
        assert other > 0.999


def test_coils_in_a_plane_are_refused() -> None:
    flat = np.array([[1.0, 0.0, 1.0], [0.0, 1.0, 1.0], [0.0, 0.0, 0.0]])
    with pytest.raises(UsageError, match="lie in one plane"):
        CoilMap(flat, LIMITS, OHMS)


def test_a_dipole_beyond_a_limit_keeps_its_direction() -> None:
    limits = np.array([0.1, 0.2, 0.4])
    inside = np.array([0.1, -0.2, 0.3])
    assert limited(inside, limits) is inside
    np.testing.assert_allclose(limited(np.array([0.2, -0.8, 0.4]), limits), [0.05, -0.2, 0.1])


def test_the_covariance_of_coils_along_the_body_axes_is_that_of_gain_and_misalignment() -> None:
    coils = CoilMap(np.diag([0.6, 2.0, 0.1]), LIMITS, OHMS)
    assert coils.aligned
    assert not CoilMap(TILTED, LIMITS, OHMS).aligned
    expected = np.where(np.eye(3, dtype=bool), 0.2**2, 0.05**2).ravel() / 3.0
    np.testing.assert_allclose(coils.error_covariance(0.2, 0.05), np.diag(expected), atol=1e-15)
