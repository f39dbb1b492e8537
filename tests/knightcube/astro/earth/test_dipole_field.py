"""Tests of the predicted dipole field against the World Magnetic Model along the same orbit."""

from __future__ import annotations

import numpy as np

from knightcube.astro.earth.ephemeris import dipole_field_ahead, predict
from knightcube.astro.earth.orbit_knowledge import OrbitState

STATE = OrbitState(2_461_120.0, np.array([6.878e6, 0.0, 0.0]), np.array([0.0, -988.0, 7548.0]), 10.0)


def test_the_dipole_field_stays_within_thirty_degrees_of_the_model_for_a_quarter_revolution() -> None:
    times = np.arange(0.0, 1_500.0, 100.0)
    ahead = predict(STATE, 1_600.0)
    whole = ahead.field_at(times)
    found = dipole_field_ahead(STATE, ahead.field[0], times)
    np.testing.assert_allclose(found[0], whole[0], rtol=1e-9)
    lengths = np.linalg.norm(found, axis=1), np.linalg.norm(whole, axis=1)
    cosine = np.sum(found * whole, axis=1) / (lengths[0] * lengths[1])
    angle = np.degrees(np.arccos(np.minimum(cosine, 1.0)))
    assert angle.max() < 30.0
    assert np.sqrt(np.mean(angle**2)) < 15.0
    assert np.abs(lengths[0] / lengths[1] - 1.0).max() < 0.35
    still = np.broadcast_to(whole[0], whole.shape)
    cosine = np.sum(still * whole, axis=1) / (lengths[1][0] * lengths[1])
    turned = np.degrees(np.arccos(np.minimum(cosine, 1.0)))
    assert turned.max() > 60.0, "a field that stays would be far off"
