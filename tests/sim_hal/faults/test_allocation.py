"""Tests that the currents for a torque keep its direction, with a lost coil and at the current limits."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from knightcube.astro.arrays import FloatArray
from knightcube.errors import KnightCubeError
from knightcube.gnc.control.coil_map import allocate

DIPOLE = 0.648
COILS = DIPOLE * np.eye(3)
LIMITS = np.full(3, 0.148)
vectors = st.tuples(*[st.floats(-1.0, 1.0)] * 3).map(np.array).filter(lambda v: np.linalg.norm(v) > 0.2)


def torque_of(currents: FloatArray, field: FloatArray) -> FloatArray:
    """Return m x B, independently of the code under test."""
    made: FloatArray = np.cross(DIPOLE * currents, field)
    return made


@given(vectors, vectors)
def test_with_three_coils_a_torque_across_the_field_is_made_by_the_least_dipole(
    field: FloatArray, wish: FloatArray
) -> None:
    field = field * 4e-5
    torque = np.cross(field, wish)
    if np.linalg.norm(torque) < 1e-6:
        return
    torque *= 1e-7 / np.linalg.norm(torque)
    made = allocate(torque, field, COILS, LIMITS)
    assert torque_of(made.currents, field) == pytest.approx(torque, rel=1e-9, abs=1e-16)
    assert made.currents * DIPOLE == pytest.approx(np.cross(field, torque) / (field @ field), rel=1e-6)
    assert made.share == pytest.approx(1.0)


@given(vectors, vectors, st.integers(0, 2))
def test_without_one_coil_the_torque_is_still_made_unless_that_coil_lies_across_the_field(
    field: FloatArray, wish: FloatArray, lost: int
) -> None:
    field = field / np.linalg.norm(field) * 4e-5
    torque = np.cross(field, wish)
    if abs(field[lost]) < 0.5 * 4e-5 or np.linalg.norm(torque) < 1e-6:
        return
    torque *= 1e-7 / np.linalg.norm(torque)
    available = np.arange(3) != lost
    made = allocate(torque, field, COILS, LIMITS, available)
    assert made.currents[lost] == 0.0
    assert torque_of(made.currents, field) == pytest.approx(torque, rel=1e-6, abs=1e-13)


@given(vectors, vectors)
def test_beyond_the_limits_the_whole_vector_is_shortened(field: FloatArray, wish: FloatArray) -> None:
    field = field * 4e-5
    torque = np.cross(field, wish)
    if np.linalg.norm(torque) < 1e-6:
        return
    torque *= 1e-3 / np.linalg.norm(torque)
    made = allocate(torque, field, COILS, LIMITS)
    assert np.abs(made.currents).max() == pytest.approx(0.148)
    across = np.cross(made.torque, torque) / np.linalg.norm(torque)
    assert np.linalg.norm(across) < 1e-9 * np.linalg.norm(made.torque) + 1e-18
    assert 0.0 < made.share < 1.0


def test_on_the_thread_the_coil_on_z_takes_over_for_the_one_on_x() -> None:
    """For a body on its suspension thread, coil z replaces coil x.

    The torque of coil z about y is n A B I sin(theta) (Sease 5.4).
    """
    theta = 0.5
    field = 4.5e-4 * np.array([np.sin(theta), 0.0, -np.cos(theta)])
    torque = np.array([0.0, 1.0e-5, 0.0])
    about_thread = np.array([0.0, 1.0, 0.0])
    available = np.array([False, True, True])
    made = allocate(torque, field, COILS, LIMITS, available, about_thread)
    assert made.currents[2] == pytest.approx(1.0e-5 / (DIPOLE * 4.5e-4 * np.sin(theta)))
    assert made.currents[:2] == pytest.approx(0.0, abs=1e-15)


def test_a_torque_along_the_field_cannot_be_made_and_nothing_is_tried() -> None:
    field = np.array([0.0, 0.0, 4e-5])
    made = allocate(np.array([0.0, 0.0, 1e-6]), field, COILS, LIMITS)
    assert made.currents == pytest.approx(0.0, abs=1e-12)
    assert made.share == pytest.approx(0.0, abs=1e-9)


def test_no_torque_and_no_coil_ask_for_no_current() -> None:
    field = np.array([1e-5, 2e-5, 3e-5])
    assert not allocate(np.zeros(3), field, COILS, LIMITS).currents.any()
    nothing = allocate(np.array([1e-6, 0, 0]), field, COILS, LIMITS, np.zeros(3, dtype=bool))
    assert not nothing.currents.any()


def test_values_that_are_not_finite_are_refused() -> None:
    with pytest.raises(KnightCubeError, match="not finite"):
        allocate(np.array([np.nan, 0, 0]), np.ones(3), COILS, LIMITS)
