"""Tests that filter states after short artificial runs equal the recorded states to five digits."""

from __future__ import annotations

from typing import Any

import numpy as np

from knightcube.astro.earth.disturbance import Pressures
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, multiply
from knightcube.gnc.estimation.estimate import AttitudeMeasurement, MeanRateMeasurement
from knightcube.gnc.estimation.field_rate import FieldRate, FieldRateSettings
from knightcube.gnc.estimation.free_filter import MAGNET, FilterEnvironment, FreeFilter, FreeFilterSettings
from tests.knightcube.gnc.estimation.flights import begin, fly, follow
from tests.support.consistency_worlds import CYCLE_NS
from tests.support.recorded_results import check

INERTIA = np.diag([0.0066, 0.0333, 0.0333])
FIELD_RATE = FieldRateSettings(inertia=INERTIA, field_sigma=3e-7, torque_walk=3e-4)
DIPOLE = np.array([0.02, -0.01, 0.015])


def around(second: float) -> FilterEnvironment:
    """Return the environment at a time (s): a rotating field, air drag and sunlight."""
    turned = attitude_matrix(from_rotation_vector(np.array([0.0, 2.2e-3 * second, 0.0])))
    pressed = Pressures(np.array([[0.6, 0.0, 0.8]]), np.array([[0.0, 1.0, 0.0]]))
    position = 6.9e6 * np.array([np.cos(1e-3 * second), 0.1, np.sin(1e-3 * second)])
    return FilterEnvironment(turned.T @ np.array([1e-5, 2e-5, 3e-5]), position, pressed, 1.0)


def test_the_states_of_a_free_satellite_are_as_recorded() -> None:
    rng, found = np.random.default_rng(41), FreeFilter(INERTIA, FreeFilterSettings())
    q = from_rotation_vector(np.array([0.1, 0.2, -0.3]))
    w = np.array([1e-3, -5e-4, 8e-4])
    found.start(q, 1e-8 * np.eye(3), w)
    kept: list[Any] = []
    for second in range(1, 41):
        here = around(float(second))
        q = multiply(from_rotation_vector(w), q)
        found.advance(1.0, DIPOLE * np.sin(0.3 * second), here)
        kept.append(found.gyro(w + 1e-4 * rng.standard_normal(3), 1e-8 * np.eye(3)))
        field = attitude_matrix(q) @ here.field
        if second % 5 == 0:
            kept.append(found.field(field + 1e-7 * rng.standard_normal(3), here.field, 1e-13 * np.eye(3)))
        if second % 8 == 0:
            error = from_rotation_vector(1e-4 * rng.standard_normal(3))
            kept.append(found.attitude(multiply(error, q), 1e-8 * np.eye(3), 0.4))
        if second % 9 == 0:
            up = here.position / np.linalg.norm(here.position)
            seen = attitude_matrix(q) @ up + 1e-3 * rng.standard_normal(3)
            kept.append(found.direction(seen / np.linalg.norm(seen), up, 1e-6 * np.eye(3)))
        if second % 11 == 0:
            kept.append(found.mean_rate(w, 1e-9 * np.eye(3), 1e-5 * np.ones(3)))
    kept.append(found.gyro(w + 0.5, 1e-8 * np.eye(3)))
    states = [found.quaternion, found.rate, found.covariance, found.gyro_bias, found._constants[MAGNET]]
    learned = [
        found.torque_sizes,
        found.description(),
        found.residual_dipole(1.0),
        found.residual_dipole(0.0),
    ]
    counts = [found.refused, found.knowledge, found.worst_sigma, found.slow]
    noise = found.rate_noise(DIPOLE, around(41.0), 0.2)
    check(__file__, "free filter", [kept, states, learned, counts, noise])


def test_the_states_of_a_suspended_body_are_as_recorded() -> None:
    flight = fly(42, 160, suspended=True)
    found = begin(flight, suspended=True)
    follow(found, flight)
    end = 160 * CYCLE_NS
    past, rates = found.past(end - 20 * CYCLE_NS), found.rates(end - 30 * CYCLE_NS, end - 10 * CYCLE_NS)
    check(__file__, "suspended", [found.at(end), past, rates, found.latency, found.doubts_commands])


def test_the_states_of_a_free_body_with_late_measurements_are_as_recorded() -> None:
    flight = fly(43, 120, suspended=False)
    found = begin(flight, suspended=False)
    follow(found, flight, 1, 80)
    at = 60 * CYCLE_NS
    fix = AttitudeMeasurement(at, flight.attitudes[60], 1e-8 * np.eye(3))
    mean = MeanRateMeasurement(at - 8 * CYCLE_NS, at, flight.rates[56], 1e-8 * np.eye(3))
    accepted: list[Any] = []
    found.measure_late([mean, fix], accepted.append)
    found.catch_up(5)
    follow(found, flight, 80, 100)
    found.mark_unknown(98 * CYCLE_NS)
    found.catch_up()
    follow(found, flight, 100)
    check(__file__, "late", [found.at(121 * CYCLE_NS), accepted, found.measured_ns])


def test_the_rate_from_the_field_is_as_recorded() -> None:
    rng, found = np.random.default_rng(44), FieldRate(FIELD_RATE)
    q, w = from_rotation_vector(np.array([0.3, 0.1, -0.2])), np.array([0.05, -0.03, 0.04])
    kept: list[Any] = []
    for step in range(60):
        q = multiply(from_rotation_vector(0.5 * w), q)
        found.advance(DIPOLE * np.cos(0.2 * step), 0.5)
        field = attitude_matrix(q) @ np.array([2e-5, 1e-5, 3e-5]) + 1e-7 * rng.standard_normal(3)
        kept.append(found.measure(field if step != 40 else -field, 0.05))
        if step % 7 == 6:
            found.measure_rate(w + 1e-3 * rng.standard_normal(3))
        if step % 20 == 19:
            kept.append([found.rate, found.field, found.change, found.momentum, found.covariance])
    check(__file__, "field rate", kept)
