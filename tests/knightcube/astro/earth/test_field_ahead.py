"""Tests of the incremental prediction of the field against the full model along the orbit."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth import ephemeris, geomagnetism
from knightcube.astro.earth.ephemeris import FieldAhead, predict
from knightcube.astro.earth.orbit_knowledge import OrbitState
from knightcube.astro.earth.sun import DAY

JD = 2461405.5
STATE = OrbitState(JD, np.array([6.9e6, 0.0, 0.0]), np.array([0.0, 1.0e3, 7.5e3]), 10.0)
TIMES = np.arange(0.0, 3000.0, 20.0)
WHOLE = predict(STATE, 3600.0)


def apart(ahead: FloatArray, since: float) -> FloatArray:
    """Return the angles (n,), rad, between the predicted field and the full model's field."""
    true = WHOLE.field_at(since + TIMES)
    across = np.linalg.norm(np.cross(ahead, true), axis=1)
    return np.asarray(np.arctan2(across, np.sum(ahead * true, axis=1)))


def state_after(seconds: float) -> OrbitState:
    at = np.array([seconds])
    return OrbitState(JD + seconds / DAY, WHOLE.position_at(at)[0], WHOLE.velocity_at(at)[0], 10.0)


def test_each_call_extends_the_full_model_and_the_dipole_field_continues_it() -> None:
    ahead = FieldAhead()
    first = apart(ahead.along(STATE, TIMES), 0.0)
    near = ephemeris.NODE_STEP * ephemeris.NODES_PER_CALL
    assert first[near > TIMES].max() < 5e-3
    assert 0.03 < first[near + 600.0 < TIMES].max() < 0.5
    for k in range(1, 12):
        ahead.along(state_after(5.0 * k), TIMES)
    last = ahead.along(state_after(60.0), TIMES)
    assert apart(last, 60.0).max() < 5e-3
    strength = np.linalg.norm(last, axis=1) / np.linalg.norm(WHOLE.field_at(60.0 + TIMES), axis=1)
    np.testing.assert_allclose(strength, 1.0, atol=5e-3)


def test_a_changed_orbit_restarts_the_prediction() -> None:
    ahead, elsewhere = FieldAhead(), state_after(600.0)
    ahead.along(OrbitState(JD, elsewhere.position, elsewhere.velocity, 10.0), TIMES)
    assert apart(ahead.along(STATE, TIMES), 0.0)[0] < 1e-3
    late = ahead.along(state_after(500.0), TIMES[:20])
    assert np.linalg.norm(late[0] - WHOLE.field_at(np.array([500.0]))[0]) < 1e-7


def test_no_call_makes_more_knots_than_the_loop_has_time_for(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[float] = []
    whole = geomagnetism.field

    def counted(date: float, place: FloatArray) -> FloatArray:
        made.append(date)
        return whole(date, place)

    monkeypatch.setattr(ephemeris, "field", counted)
    ahead = FieldAhead()
    for k in range(3):
        made.clear()
        ahead.along(state_after(5.0 * k), TIMES)
        assert 0 < len(made) <= ephemeris.NODES_PER_CALL + 1
