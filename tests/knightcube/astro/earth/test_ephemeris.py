"""Tests of the interpolation of an ephemeris, and of the field predicted over an hour."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from knightcube.astro.earth.ephemeris import Ephemeris, FieldAhead, dipole_field_ahead, predict
from knightcube.astro.earth.geomagnetism import field
from knightcube.astro.earth.orbit_knowledge import OrbitError, OrbitState
from knightcube.astro.earth.sun import ASTRONOMICAL_UNIT, DAY
from knightcube.errors import ArgumentError

STATE = OrbitState(2_461_120.0, np.array([6.878e6, 0.0, 0.0]), np.array([0.0, -988.0, 7548.0]), 10.0)


def cubic() -> Ephemeris:
    """Return an ephemeris at 5, 15, 25 and 35 s whose position is a cubic function of time."""
    times = np.array([5.0, 15.0, 25.0, 35.0])
    position = np.stack([times**3, 2.0 * times**2, 7.0 - times], axis=1)
    velocity = np.stack([3.0 * times**2, 4.0 * times, np.full(4, -1.0)], axis=1)
    line = np.stack([times, -times, 2.0 * times], axis=1)
    sun = np.tile([ASTRONOMICAL_UNIT, 0.0, 0.0], (4, 1))
    return Ephemeris(2_461_120.0, times, position, velocity, line, sun, np.array([0.0, 0.2, 0.6, 1.0]))


def test_cubic_positions_and_linear_fields_are_interpolated_exactly() -> None:
    at = np.array([5.0, 7.5, 15.0, 33.0, 35.0])
    found = cubic()
    np.testing.assert_allclose(found.position_at(at), np.stack([at**3, 2.0 * at**2, 7.0 - at], axis=1))
    np.testing.assert_allclose(
        found.velocity_at(at), np.stack([3.0 * at**2, 4.0 * at, 0.0 * at - 1.0], axis=1)
    )
    np.testing.assert_allclose(found.field_at(at), np.stack([at, -at, 2.0 * at], axis=1))
    np.testing.assert_allclose(found.sunlit_at(np.array([10.0, 20.0, 30.0])), [0.1, 0.4, 0.8])
    np.testing.assert_allclose(found.sun_at(at), np.tile([1.0, 0.0, 0.0], (5, 1)), atol=1e-6)


@pytest.mark.parametrize("wrong", [4.99, 35.01])
def test_times_outside_the_prediction_are_refused_with_its_limits(wrong: float) -> None:
    with pytest.raises(OrbitError, match=r"the orbit is predicted for 5 to 35 s"):
        cubic().position_at(np.array([20.0, wrong]) if wrong > 5.0 else np.array([wrong, 20.0]))


def test_a_prediction_covers_its_duration_and_keeps_the_energy_of_the_orbit() -> None:
    found = predict(STATE, 95.0)
    assert found.times[-1] >= 95.0 + 10.0
    assert found.julian_date == STATE.julian_date
    np.testing.assert_array_equal(found.position[0], STATE.position)
    np.testing.assert_array_equal(found.velocity[0], STATE.velocity)
    mu, radius, flat = 3.986004418e14, 6_378_136.6, 1.08263e-3
    distance = np.linalg.norm(found.position, axis=1)
    sine = found.position[:, 2] / distance
    bulge = mu * flat * radius**2 / (2.0 * distance**3) * (3.0 * sine**2 - 1.0)
    energy = 0.5 * np.sum(found.velocity**2, axis=1) - mu / distance + bulge
    np.testing.assert_allclose(energy, energy[0], rtol=1e-8)
    for k in (0, 5):
        date = STATE.julian_date + found.times[k] / DAY
        np.testing.assert_allclose(found.field[k], field(date, found.position[k]), atol=1e-12)
    assert np.linalg.norm(found.sun[0]) == pytest.approx(ASTRONOMICAL_UNIT, rel=0.01)
    # The Sun's direction moves by 0.99 deg in a day.
    turned = np.linalg.norm(np.cross(found.sun[0], found.sun[-1])) / np.linalg.norm(found.sun[0]) ** 2
    assert turned == pytest.approx(np.radians(0.99) * found.times[-1] / DAY, rel=0.05)


def test_the_dipole_field_is_scaled_to_the_measured_field_for_some_minutes() -> None:
    """If the measured field is twice the model, the prediction begins there and returns to the model."""
    times = np.array([0.0, 400.0, 40_000.0])
    plain = dipole_field_ahead(STATE, predict(STATE, 20.0).field[0], times)
    strong = dipole_field_ahead(STATE, 2.0 * plain[0], times)
    np.testing.assert_allclose(strong[0], 2.0 * plain[0], rtol=1e-9)
    np.testing.assert_allclose(strong[2], plain[2], rtol=1e-6)
    ratio = np.linalg.norm(strong[1]) / np.linalg.norm(plain[1])
    assert 1.2 < ratio < 1.6, "the correction has decayed to a third"


def test_the_field_ahead_gains_nodes_with_each_call_and_follows_the_satellite() -> None:
    ahead, times = FieldAhead(), np.arange(0.0, 1_200.0, 100.0)
    exact = predict(STATE, 1_400.0)
    whole = exact.field_at(times)
    off = []
    for _ in range(5):
        found = ahead.along(STATE, times)
        off.append(np.linalg.norm(found - whole, axis=1) / np.linalg.norm(whole, axis=1))
    assert off[0][:3].max() < 0.01, "five nodes of one minute"
    assert off[0][6:].max() > 0.02
    assert off[-1].max() < 0.01
    later = OrbitState(
        STATE.julian_date + 130.0 / DAY, exact.position_at(np.array([130.0]))[0],
        exact.velocity_at(np.array([130.0]))[0], 10.0,
    )  # fmt: skip
    found = ahead.along(later, times)
    np.testing.assert_allclose(found[:9], exact.field_at(130.0 + times[:9]), atol=3e-7)
    moved = OrbitState(later.julian_date, -later.position, -later.velocity, 10.0)
    jumped = ahead.along(moved, times)
    np.testing.assert_allclose(jumped[0], field(later.julian_date, moved.position), atol=1e-12)


@pytest.mark.parametrize(
    ("name", "change", "duration", "step"),
    [
        ("state.position", {"position": np.full(3, np.nan)}, 10.0, 10.0),
        ("state.position", {"position": np.array([7000.0, 0.0, 0.0])}, 10.0, 10.0),
        ("state.velocity", {"velocity": np.zeros(2)}, 10.0, 10.0),
        ("state.julian_date", {"julian_date": math.nan}, 10.0, 10.0),
        ("duration", {}, math.nan, 10.0),
        ("duration", {}, 1e300, 10.0),
        ("step", {}, 10.0, 0.0),
        ("step", {}, 10.0, 1e-300),
        ("duration", {}, 10.0, 1e300),
    ],
)
def test_a_prediction_without_a_result_is_refused_instead_of_computed_without_end(
    name: str, change: dict[str, Any], duration: float, step: float
) -> None:
    with pytest.raises(ArgumentError, match=f"^{name}: "):
        predict(replace(STATE, **change), duration, step)
