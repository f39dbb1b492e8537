"""The surroundings along an orbit: splines against the models, and what is random in them."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.astro.earth.figure import EARTH_RADIUS
from knightcube.astro.earth.sun import ASTRONOMICAL_UNIT, DAY, sunlit_share
from sim_hal.settings import Disturbances, OrbitSection
from sim_hal.worlds import magnetic_field
from sim_hal.worlds.orbit import (
    RING_CURRENT,
    Environment,
    air_flow,
    elements,
    julian_date,
    log_density,
    propagate,
    sun_position,
)

DATE = julian_date("2026-03-20T12:00:00Z")
ORBIT = OrbitSection(local_time=12.0)


def make(seed: int = 1, ring_current: float = 0.0) -> Environment:
    multiples = Disturbances(ring_current=ring_current)
    return Environment(elements(ORBIT, DATE), DATE, np.random.default_rng(seed), multiples)


def test_between_knots_position_velocity_field_and_sun_are_the_models() -> None:
    environment = make()
    times = np.random.default_rng(5).uniform(20.0, 2980.0, 40)
    times.sort()
    states = propagate(elements(ORBIT, DATE), 3000.0).states_at(times)
    fields = magnetic_field.field(DATE + times / DAY, states[:, :3])
    suns = sun_position(DATE + times / DAY) - states[:, :3]
    for time, state, field, away in zip(times, states, fields, suns, strict=True):
        around = environment.at(float(time))
        np.testing.assert_allclose(around.position, state[:3], atol=0.01)
        np.testing.assert_allclose(around.velocity, state[3:], atol=2e-3)
        np.testing.assert_allclose(around.field, field, atol=2e-12)
        distance = float(np.linalg.norm(away))
        np.testing.assert_allclose(around.sun, away / distance, atol=1e-9)
        expected = float(sunlit_share(state[:3], state[:3] + away))
        assert around.sunlit == pytest.approx(expected, abs=0.01)
        assert around.light == pytest.approx(around.sunlit * (ASTRONOMICAL_UNIT / distance) ** 2)
        assert environment.position_and_field(float(time)) == (around.position, around.field)


def test_an_orbit_over_noon_has_a_third_of_its_time_in_shadow() -> None:
    environment = make()
    seen = np.array([environment.at(float(time)).sunlit for time in np.arange(0.0, 5677.0, 5.0)])
    half = np.arcsin(EARTH_RADIUS / (EARTH_RADIUS + ORBIT.altitude)) / np.pi
    assert np.mean(seen == 0.0) == pytest.approx(half, abs=0.01)
    assert np.mean((seen > 0.0) & (seen < 1.0)) < 0.02


def test_the_local_time_of_the_node_places_the_sun_over_it() -> None:
    position, _ = elements(ORBIT, DATE).state()
    away = sun_position(DATE)
    cosine = position @ away / np.linalg.norm(position) / np.linalg.norm(away)
    assert np.degrees(np.arccos(cosine)) < 1.0  # at the equinox the Sun stands over the equator


def test_the_ring_current_is_slow_never_reversed_and_as_large_as_asked_for() -> None:
    with_storm, without = make(ring_current=1.0), make()
    sizes = []
    for time in range(0, 24_000, 500):
        more = np.array(with_storm.position_and_field(float(time))[1])
        sizes.append(float(np.linalg.norm(more - without.position_and_field(float(time))[1])))
    assert 0.3 * RING_CURRENT < np.mean(sizes) < 1.7 * RING_CURRENT
    assert max(sizes) <= 2.0 * RING_CURRENT
    assert max(np.abs(np.diff(sizes))) < 0.2 * RING_CURRENT


def test_the_air_is_denser_by_day_and_falls_off_with_height() -> None:
    sun_there = np.array([[ASTRONOMICAL_UNIT, 0.0, 0.0]] * 3)
    radius = EARTH_RADIUS + 500e3
    lag = np.radians(30.0)
    apex = radius * np.array([np.cos(lag), np.sin(lag), 0.0])
    density = np.exp(log_density(np.array([apex, -apex, apex * (radius + 100e3) / radius]), sun_there))
    assert density[0] / density[1] == pytest.approx(4.0)
    assert density[0] / density[2] == pytest.approx(6.967e-13 / 1.454e-13)


def test_without_bulge_and_walks_the_air_is_the_same_on_all_sides_and_the_dipole_stays() -> None:
    still = Environment(
        elements(ORBIT, DATE), DATE, np.random.default_rng(2), Disturbances(day_bulge=0.0, walks=0.0)
    )
    found = [still.at(time) for time in range(0, 5_700, 300)]
    heights = [np.linalg.norm(one.position) for one in found]
    densities = [one.density for one in found]
    assert np.corrcoef(heights, np.log(densities))[0, 1] < -0.999
    assert all(one.walk == (0.0, 0.0, 0.0) for one in found)


def test_the_air_turns_with_the_earth() -> None:
    """At the equator of an eastward orbit the flow is slower by 0.4929 km/s at 6,760 km."""
    environment = Environment(
        elements(OrbitSection(inclination_deg=0.0), DATE), DATE, np.random.default_rng(1)
    )
    around = environment.at(100.0)
    speed = np.linalg.norm(around.velocity) - np.linalg.norm(air_flow(around))
    assert speed == pytest.approx(7.292115e-5 * np.linalg.norm(around.position), rel=1e-6)


def test_what_is_random_depends_on_the_seed_alone() -> None:
    asked_often, asked_once, other = make(), make(), make(seed=2)
    for time in range(0, 1500, 7):
        asked_often.at(float(time))
    assert asked_often.at(1499.0) == asked_once.at(1499.0)
    assert asked_once.at(1499.0).walk != other.at(1499.0).walk
