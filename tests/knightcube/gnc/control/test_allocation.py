"""Tests of currents for a torque: cross products, the Moore-Penrose conditions, and simple cases."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.errors import FlightError
from knightcube.gnc.control.allocation import allocate

PER_AMPERE = 2.0
COILS = PER_AMPERE * np.eye(3)
FIELD = np.array([2e-5, -1e-5, 3e-5])
AMPLE = np.full(3, 100.0)


def test_three_coils_make_the_torque_across_the_field_with_the_least_dipole() -> None:
    """The dipole is B x T / B^2, and its torque m x B."""
    torque = np.cross([1e-6, 2e-6, -1e-6], FIELD / np.linalg.norm(FIELD))
    found = allocate(torque, FIELD, COILS, AMPLE)
    assert PER_AMPERE * found.currents == pytest.approx(np.cross(FIELD, torque) / (FIELD @ FIELD))
    assert found.torque == pytest.approx(torque)
    assert np.cross(PER_AMPERE * found.currents, FIELD) == pytest.approx(found.torque)
    assert found.share == pytest.approx(1.0)


def test_of_a_torque_along_the_field_nothing_is_made() -> None:
    found = allocate(1e-2 * FIELD, FIELD, COILS, AMPLE)
    assert found.torque == pytest.approx(np.zeros(3), abs=1e-18)
    assert found.share == pytest.approx(0.0, abs=1e-9)
    # The normal component of a torque at 45 deg to the field has half of the squared magnitude of the torque.
    across = np.cross(FIELD, [0.0, 0.0, 1.0])
    mixed = FIELD / np.linalg.norm(FIELD) + across / np.linalg.norm(across)
    assert allocate(1e-6 * mixed, FIELD, COILS, AMPLE).share == pytest.approx(0.5)


def test_a_current_beyond_its_limit_scales_all_of_them() -> None:
    torque = 1e-6 * np.cross([1.0, 2.0, -1.0], FIELD / np.linalg.norm(FIELD))
    full = allocate(torque, FIELD, COILS, AMPLE).currents
    limits = np.abs(full) * np.array([0.5, 0.25, 2.0])
    found = allocate(torque, FIELD, COILS, limits)
    assert found.currents == pytest.approx(0.25 * full)
    assert found.share == pytest.approx(0.25)
    assert found.torque == pytest.approx(0.25 * torque)
    assert allocate(torque, FIELD, COILS, np.abs(full) * 1.01).currents == pytest.approx(full)


def test_two_coils_make_the_same_torque_unless_the_failed_axis_is_normal_to_the_field() -> None:
    torque = 1e-6 * np.cross([1.0, 2.0, -1.0], FIELD / np.linalg.norm(FIELD))
    two = np.array([True, False, True])
    found = allocate(torque, FIELD, COILS, AMPLE, available=two)
    assert found.currents[1] == 0.0
    assert found.torque == pytest.approx(torque)
    flat = np.array([3e-5, 0.0, 4e-5])
    lost = allocate(np.cross([0.0, 1e-6, 0.0], flat / np.linalg.norm(flat)), flat, COILS, AMPLE, two)
    assert lost.torque == pytest.approx(np.zeros(3), abs=1e-15)


@pytest.mark.parametrize(("sine", "kept"), [(0.14, False), (0.17, True)])
def test_a_torque_that_would_take_all_the_current_is_discarded(sine: float, kept: bool) -> None:
    """Without the coil on y, a field at this sine from the x-z plane permits only a small torque."""
    field = 3e-5 * np.array([np.sqrt(1.0 - sine**2), sine, 0.0])
    weak = np.array([0.0, 0.0, 1e-8])
    found = allocate(weak, field, COILS, AMPLE, available=np.array([True, False, True]))
    assert (found.share == pytest.approx(1.0)) is kept
    assert (float(np.abs(found.currents).max()) > 0.0) is kept


def test_only_the_free_axis_is_turned() -> None:
    free = np.array([False, True, False])
    found = allocate(np.array([1e-6, 2e-6, -5e-6]), FIELD, COILS, AMPLE, free=free)
    assert found.torque == pytest.approx([0.0, 2e-6, 0.0], abs=1e-18)
    assert found.share == pytest.approx(1.0)
    assert allocate(np.array([1e-6, 0.0, 0.0]), FIELD, COILS, AMPLE, free=free).share == 1.0


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_a_torque_or_a_field_that_is_not_finite_is_refused(wrong: float) -> None:
    with pytest.raises(FlightError, match="not finite"):
        allocate(np.array([wrong, 0.0, 0.0]), FIELD, COILS, AMPLE)
    with pytest.raises(FlightError, match="not finite"):
        allocate(np.zeros(3), np.array([0.0, wrong, 0.0]), COILS, AMPLE)


def test_redundant_coils_make_a_torque_with_the_least_heat() -> None:
    """Two parallel coils share a current in inverse proportion to their resistances."""
    dipoles = np.column_stack([0.6 * np.eye(3), [0.0, 0.0, 0.6]])
    ohms = np.array([20.0, 20.0, 20.0, 60.0])
    torque = np.cross([0.01, 0.02, 0.03], FIELD)
    found = allocate(torque, FIELD, dipoles, np.full(4, 1e3), resistance=ohms)
    assert found.torque == pytest.approx(torque, rel=1e-9)
    assert found.currents[2] == pytest.approx(3.0 * found.currents[3])
    rng = np.random.default_rng(2)
    effect = np.cross(dipoles.T, FIELD).T
    idle = np.eye(4) - np.linalg.pinv(effect) @ effect  # projects onto currents that cause no torque
    for change in rng.normal(scale=1e-3, size=(20, 4)) @ idle:
        assert ohms @ (found.currents + change) ** 2 > ohms @ found.currents**2
