"""Orbits against published states, Kepler's solution, invariants and the analytic secular rates of J2."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

from hal.interfaces.errors import OutOfRange
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.figure import EARTH_RADIUS, GRAVITATIONAL_PARAMETER, J2
from sim_hal.worlds.orbit import KeplerianElements, Orbit, propagate

VALLADO = KeplerianElements(
    semi_major_axis=11_067_790.0 / (1.0 - 0.83285**2),
    eccentricity=0.83285,
    inclination=np.radians(87.87),
    ascending_node=np.radians(227.89),
    argument_of_perigee=np.radians(53.38),
    true_anomaly=np.radians(92.335),
)
LOW = KeplerianElements(
    semi_major_axis=7078e3,
    eccentricity=0.01,
    inclination=np.radians(50.0),
    ascending_node=0.4,
    argument_of_perigee=0.9,
    true_anomaly=2.0,
)


def test_elements_give_the_published_state() -> None:
    """Vallado, Fundamentals of Astrodynamics, Example 2-6 (its GM differs by 4e-10)."""
    position, velocity = VALLADO.state()
    assert position == pytest.approx([6_525_368.12, 6_861_531.83, 6_449_118.61], abs=0.01)
    assert velocity == pytest.approx([4902.2786, 5533.1396, -1975.7101], abs=1e-4)


def _by_kepler(elements: KeplerianElements, time: float) -> FloatArray:
    """Return the position `time` s later, by Kepler's equation and its own geometry."""
    e, a = elements.eccentricity, elements.semi_major_axis
    eccentric = 2.0 * np.arctan(np.sqrt((1.0 - e) / (1.0 + e)) * np.tan(0.5 * elements.true_anomaly))
    mean = eccentric - e * np.sin(eccentric) + np.sqrt(GRAVITATIONAL_PARAMETER / a**3) * time
    late = brentq(lambda x: x - e * np.sin(x) - mean, mean - 2.0, mean + 2.0, xtol=1e-14)
    anomaly = 2.0 * np.arctan(np.sqrt((1.0 + e) / (1.0 - e)) * np.tan(0.5 * late))
    return replace(elements, true_anomaly=float(anomaly)).state()[0]


@pytest.mark.parametrize("elements", [LOW, replace(LOW, eccentricity=0.0), VALLADO])
def test_two_bodies_keep_keplers_laws(elements: KeplerianElements) -> None:
    """Over ten of the thesis's orbits, to a centimetre of at most 66,000 km."""
    orbit = propagate(elements, 55_000.0, j2=0.0)
    for time in (0.0, 17.3, 5000.0, 31_234.5, 55_000.0):
        assert orbit.positions_at(np.array([time]))[0] == pytest.approx(_by_kepler(elements, time), abs=0.01)


def _potential(position: FloatArray) -> float:
    distance = np.linalg.norm(position)
    oblate = 0.5 * J2 * (EARTH_RADIUS / distance) ** 2 * (3.0 * (position[2] / distance) ** 2 - 1.0)
    return float(-GRAVITATIONAL_PARAMETER / distance * (1.0 - oblate))


@given(st.floats(0.0, 6.28), st.floats(0.05, 3.1), st.floats(6.5e6, 4.3e7))
@settings(max_examples=20, deadline=None)
def test_the_acceleration_is_the_gradient_of_the_potential(
    anomaly: float, tilt: float, radius: float
) -> None:
    """2.14 as printed: second differences of the path against first differences of J2's potential."""
    elements = KeplerianElements(semi_major_axis=radius, inclination=tilt, true_anomaly=anomaly)
    step = 2.0
    orbit = propagate(elements, 2.0 * step)
    states = orbit.states_at(np.array([0.0, step, 2.0 * step]))
    acceleration = (states[2, 3:] - states[0, 3:]) / (2.0 * step)
    gradient = [
        (_potential(states[1, :3] + shift) - _potential(states[1, :3] - shift)) / 2000.0
        for shift in 1000.0 * np.eye(3)
    ]
    assert acceleration == pytest.approx(-np.array(gradient), abs=3e-6 * float(np.linalg.norm(gradient)))


def test_energy_and_the_polar_angular_momentum_are_kept() -> None:
    states = propagate(LOW, 60_000.0).states_at(np.linspace(0.0, 60_000.0, 500))
    energy = 0.5 * np.sum(states[:, 3:] ** 2, axis=1) + [_potential(r) for r in states[:, :3]]
    assert np.ptp(energy) < 1e-10 * abs(energy[0])
    momentum = states[:, 0] * states[:, 4] - states[:, 1] * states[:, 3]
    assert np.ptp(momentum) < 1e-10 * abs(momentum[0])


def _nodes(orbit: Orbit, times: FloatArray) -> FloatArray:
    states = orbit.states_at(times)
    momentum = np.cross(states[:, :3], states[:, 3:])
    return np.unwrap(np.arctan2(momentum[:, 0], -momentum[:, 1]))


def _secular_rate(times: FloatArray, angles: FloatArray) -> float:
    return float(np.polyfit(times, angles, 1)[0])


@pytest.mark.parametrize("inclination", [28.5, 50.0, 89.0, 98.2])
def test_the_node_regresses_at_the_secular_rate(inclination: float) -> None:
    """-3/2 J2 (R/p)^2 n cos i (Vallado, section 9.6), to the first order in J2: 0.2 %."""
    elements = KeplerianElements(semi_major_axis=7078e3, inclination=np.radians(inclination))
    times = np.linspace(0.0, 30.0 * elements.period, 3001)
    mean_motion = 2.0 * np.pi / elements.period
    expected = -1.5 * J2 * (EARTH_RADIUS / 7078e3) ** 2 * mean_motion * np.cos(np.radians(inclination))
    rate = _secular_rate(times, _nodes(propagate(elements, float(times[-1])), times))
    assert rate == pytest.approx(expected, abs=4e-3 * abs(expected) + 1e-10)


def test_a_sun_synchronous_orbit_follows_the_sun() -> None:
    """Published: 98.6 deg at 800 km; the node turns once a tropical year, 0.9856 deg a day."""
    elements = KeplerianElements(semi_major_axis=EARTH_RADIUS + 800e3, inclination=np.radians(98.6))
    times = np.linspace(0.0, 2.0 * 86_400.0, 4001)
    rate = _secular_rate(times, _nodes(propagate(elements, float(times[-1])), times))
    assert np.degrees(rate) * 86_400.0 == pytest.approx(0.9856, abs=0.006)


@pytest.mark.parametrize("inclination", [30.0, 63.4349, 85.0])
def test_the_perigee_turns_at_the_secular_rate(inclination: float) -> None:
    """3/4 J2 (R/p)^2 n (5 cos^2 i - 1), and not at all at the critical inclination of 63.43 deg."""
    elements = KeplerianElements(
        semi_major_axis=26_000e3,
        eccentricity=0.7,
        inclination=np.radians(inclination),
        argument_of_perigee=1.0,
        true_anomaly=np.pi,
    )
    times = np.linspace(0.0, 6.0 * elements.period, 12_001)
    states = propagate(elements, float(times[-1])).states_at(times)
    position, velocity = states[:, :3], states[:, 3:]
    momentum = np.cross(position, velocity)
    to_perigee = np.cross(velocity, momentum) / GRAVITATIONAL_PARAMETER
    to_perigee -= position / np.linalg.norm(position, axis=1, keepdims=True)
    node = np.cross([0.0, 0.0, 1.0], momentum)
    node /= np.linalg.norm(node, axis=1, keepdims=True)
    ahead = np.cross(momentum / np.linalg.norm(momentum, axis=1, keepdims=True), node)
    argument = np.unwrap(np.arctan2(np.sum(to_perigee * ahead, axis=1), np.sum(to_perigee * node, axis=1)))
    # From apogee to apogee, where the short-periodic part is the same.
    moved = (argument[-1] - argument[0]) / times[-1]
    parameter = 26_000e3 * (1.0 - 0.49)
    scale = 0.75 * J2 * (EARTH_RADIUS / parameter) ** 2 * 2.0 * np.pi / elements.period
    expected = scale * (5.0 * np.cos(np.radians(inclination)) ** 2 - 1.0)
    assert moved == pytest.approx(expected, abs=0.02 * 4.0 * scale)


def test_what_lies_between_the_steps_is_as_good_as_the_steps() -> None:
    orbit = propagate(LOW, 6000.0)
    steps = orbit.solution.ts
    middle = 0.5 * (steps[:-1] + steps[1:])
    for time in middle[::20]:
        short = propagate(LOW, float(time)).positions_at(np.array([time]))
        assert orbit.positions_at(np.array([time])) == pytest.approx(short, abs=0.01)


def test_many_times_in_any_order_are_read_at_once() -> None:
    orbit = propagate(LOW, 6000.0)
    times = np.random.default_rng(1).uniform(0.0, 6000.0, 1000)
    together = orbit.states_at(times)
    assert together.shape == (1000, 6)
    for index in (0, 17, 999):
        assert together[index] == pytest.approx(orbit.states_at(times[index : index + 1])[0], rel=1e-12)
    assert orbit.positions_at(np.zeros(0)).shape == (0, 3)


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(OutOfRange, match="eccentricity"):
        replace(LOW, eccentricity=1.0)
    with pytest.raises(OutOfRange, match="semi_major_axis"):
        replace(LOW, semi_major_axis=-7e6)
    with pytest.raises(OutOfRange, match="inclination"):
        replace(LOW, inclination=float("nan"))
    with pytest.raises(OutOfRange, match="duration"):
        propagate(LOW, 0.0)
    orbit = propagate(LOW, 100.0)
    for time in (-0.1, 100.1, float("nan")):
        with pytest.raises(OutOfRange, match="time"):
            orbit.positions_at(np.array([50.0, time]))
