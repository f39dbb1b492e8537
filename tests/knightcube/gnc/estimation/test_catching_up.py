"""Tests that late measurements can be applied in several steps while the estimate is propagated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from knightcube.astro.quaternion import about_axis_y
from knightcube.gnc.estimation.attitude_filter import AttitudeFilter
from knightcube.gnc.estimation.estimate import (
    AttitudeMeasurement,
    MeanRateMeasurement,
    Measurement,
    RateMeasurement,
)
from knightcube.gnc.estimation.rigid_body import RigidBody
from tests.support.consistency_worlds import KNOWN_PLANT

PERIOD_NS = 25_000_000
BODY = RigidBody(np.diag([1.1e-3, 1.05e-3, 0.99e-3]), 0.648, np.array([0.0, 0.0, -4.5e-4]), suspended=True)
SETTINGS = replace(KNOWN_PLANT, current_noise=2e-3, disturbance_walk=5e-5, gain_start=0.15)
RATE = 0.02


def _attitude(time_ns: int, rng: np.random.Generator) -> AttitudeMeasurement:
    angle = RATE * time_ns * 1e-9 + rng.normal(0.0, 2e-3)
    return AttitudeMeasurement(time_ns, about_axis_y(angle), np.eye(3) * 4e-6)


def _samples(first: int, count: int) -> list[Measurement]:
    rng = np.random.default_rng(first)
    found: list[Measurement] = []
    for number in range(first, first + count):
        time_ns = number * PERIOD_NS
        found.append(_attitude(time_ns, rng))
        rate = np.array([0.0, RATE + rng.normal(0.0, 1e-4), 0.0])
        found.append(RateMeasurement(time_ns, rate, np.eye(3) * 1e-8))
    return found


def _begun() -> AttitudeFilter:
    made = AttitudeFilter(BODY, SETTINGS)
    made.command(0, np.zeros(3))
    first, second, *rest = _samples(0, 80)
    assert isinstance(first, AttitudeMeasurement)
    assert isinstance(second, RateMeasurement)
    made.start(first, second)
    for measurement in rest:
        made.measure(measurement)
    return made


def _frame(rate: float = RATE) -> list[Measurement]:
    """Return mean rate and attitude of a frame that is exposed from 0.6 to 1.6 s, and available at 2 s."""
    since, middle, until = (round(t * 1e9) for t in (0.6, 1.1, 1.6))
    return [
        MeanRateMeasurement(since, until, np.array([0.0, rate, 0.0]), np.eye(3) * 1e-10),
        AttitudeMeasurement(middle, about_axis_y(RATE * 1.1), np.eye(3) * 1e-10),
    ]


@pytest.mark.parametrize("at_a_time", [1, 7, 16])
def test_the_estimate_equals_that_of_measurements_applied_at_once(at_a_time: int) -> None:
    at_once, in_turn = _begun(), _begun()
    for measurement in _frame():
        assert at_once.measure(measurement)
    reported: list[list[bool]] = []
    in_turn.measure_late(_frame(), reported.append)
    for measurement in _samples(80, 120):
        at_once.measure(measurement)
        in_turn.measure(measurement)
        in_turn.catch_up(at_a_time + 1)
    assert reported == [[True, True]]
    end_ns = 200 * PERIOD_NS
    one, other = at_once.at(end_ns), in_turn.at(end_ns)
    assert np.allclose(one.quaternion, other.quaternion, rtol=0.0, atol=1e-12)
    assert np.allclose(one.rate, other.rate, rtol=0.0, atol=1e-12)
    assert np.allclose(one.covariance, other.covariance, rtol=1e-9, atol=1e-20)


def test_until_late_measurements_are_applied_the_estimate_is_that_without_them() -> None:
    plain, in_turn = _begun(), _begun()
    in_turn.measure_late(_frame(), lambda used: pytest.fail(f"reported {used} too early"))
    in_turn.catch_up(10)
    now_ns = 80 * PERIOD_NS
    assert np.array_equal(plain.at(now_ns).covariance, in_turn.at(now_ns).covariance)


def test_a_late_outlier_is_refused_and_changes_nothing() -> None:
    plain, in_turn = _begun(), _begun()
    reported: list[list[bool]] = []
    mean_rate, _ = _frame(rate=5.0 * RATE)
    in_turn.measure_late([mean_rate], reported.append)
    in_turn.catch_up()
    assert reported == [[False]]
    assert in_turn.refused == 1
    now_ns = 80 * PERIOD_NS
    assert np.allclose(plain.at(now_ns).rate, in_turn.at(now_ns).rate, rtol=0.0, atol=1e-12)


def test_a_measurement_from_before_the_history_is_refused_at_once() -> None:
    in_turn = AttitudeFilter(BODY, SETTINGS)
    reported: list[list[bool]] = []
    in_turn.measure_late(_frame(), reported.append)
    assert reported == [[False, False]]


def test_a_filter_that_restarts_reports_that_late_measurements_were_not_used() -> None:
    in_turn = _begun()
    reported: list[list[bool]] = []
    in_turn.measure_late(_frame(), reported.append)
    for number in range(80, 200):
        turned = AttitudeMeasurement(number * PERIOD_NS, about_axis_y(1.5), np.eye(3) * 4e-6)
        if in_turn.started:
            in_turn.measure(turned)
    assert in_turn.restarts == 1
    assert reported == [[False, False]]
