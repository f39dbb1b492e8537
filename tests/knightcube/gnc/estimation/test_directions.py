"""Tests that directions and fields add only their own information to the filter, late or in time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.astro.attitude.solvers import VectorObservation, weighted_fit
from knightcube.astro.quaternion import angle_between, attitude_matrix, from_rotation_vector, multiply
from knightcube.gnc.estimation.attitude_filter import AttitudeFilter
from knightcube.gnc.estimation.estimate import (
    ATTITUDE,
    FIELD_BIAS,
    SIZE,
    DirectionMeasurement,
    FieldMeasurement,
    FilterState,
    Measurement,
)
from knightcube.gnc.estimation.free_filter import FreeFilter, FreeFilterSettings
from knightcube.gnc.estimation.mekf import correct, innovation
from tests.knightcube.gnc.estimation.filter_states import STATE, moved
from tests.knightcube.gnc.estimation.flights import FREE, SETTINGS, SUSPENDED, begin, fly, follow
from tests.support.consistency_worlds import CYCLE_NS, INERTIA

SIGMA = 1e-3
REFERENCE: FloatArray = np.array([0.6, -0.48, 0.64])
OTHER: FloatArray = np.array([0.0, 0.8, 0.6])
FIELD: FloatArray = np.array([2e-5, -1e-5, 3e-5])


def direction(
    quaternion: FloatArray, reference: FloatArray = REFERENCE, time_ns: int = 0, off: float = 0.0
) -> DirectionMeasurement:
    """Return a direction measured at the attitude `quaternion`, rotated by `off` rad about body x."""
    turned = multiply(from_rotation_vector(np.array([off, 0.0, 0.0])), quaternion)
    return DirectionMeasurement(time_ns, attitude_matrix(turned) @ reference, reference, SIGMA**2 * np.eye(3))


def as_array(state: FilterState) -> FloatArray:
    return np.array(state.quaternion)


def field(quaternion: FloatArray) -> FieldMeasurement:
    """Return the reading of an unbiased magnetometer."""
    return FieldMeasurement(0, attitude_matrix(quaternion) @ FIELD, FIELD, 1e-16 * np.eye(3))


MEASUREMENTS: list[tuple[str, Callable[[], Measurement]]] = [
    ("direction", lambda: direction(as_array(STATE))),
    (
        "field",
        lambda: FieldMeasurement(0, attitude_matrix(as_array(STATE)) @ FIELD, FIELD, 1e-16 * np.eye(3)),
    ),
]


@pytest.mark.parametrize(("name", "make"), MEASUREMENTS)
def test_the_jacobian_rows_are_the_derivatives_of_the_innovation(
    name: str, make: Callable[[], Measurement]
) -> None:
    """The Jacobian rows equal minus the central differences of the innovation."""
    seen = make()
    rows = innovation(STATE, seen, False).rows
    assert np.abs(rows).max() > (0.5 if name == "direction" else 1e-5)
    step = 1e-6
    for column in range(SIZE):
        bump = step * np.eye(SIZE)[column]
        up, down = (np.array(innovation(moved(STATE, sign * bump), seen, False).value) for sign in (1, -1))
        scale = 1.0 if name == "direction" else 4e-5
        # The tangent plane is normal to the expected direction. A motion of this direction changes the plane
        # only in second order.
        np.testing.assert_allclose((down - up) / (2.0 * step), rows[:, column], atol=2e-6 * scale)


def test_a_direction_has_no_information_about_the_rotation_about_itself() -> None:
    seen = direction(as_array(STATE), off=1e-4)
    found = innovation(STATE, seen, False)
    covariance = np.eye(SIZE)
    state, narrowed = correct(STATE, covariance, found)[:2]
    along = attitude_matrix(as_array(state)) @ REFERENCE
    np.testing.assert_allclose(along, seen.observed, atol=1e-6)
    assert along @ narrowed[ATTITUDE, ATTITUDE] @ along == pytest.approx(1.0, abs=1e-3)
    across = np.trace(narrowed[ATTITUDE, ATTITUDE]) - along @ narrowed[ATTITUDE, ATTITUDE] @ along
    assert across == pytest.approx(2.0 * SIGMA**2, rel=0.01)


def test_a_variance_along_the_direction_has_no_effect() -> None:
    seen = direction(as_array(STATE), off=0.002)
    wide = replace(seen, covariance=seen.covariance + np.outer(seen.observed, seen.observed))
    covariance = 1e-4 * np.eye(SIZE)
    squares = [
        correct(STATE, covariance, innovation(STATE, measurement, False)).square
        for measurement in (seen, wide)
    ]
    assert squares[0] > 0.01
    # The tangent plane is normal to the expected direction, which is wrong by only 2 mrad, so the squared
    # innovation hardly changes.
    assert squares[1] == pytest.approx(squares[0], rel=0.05)


def test_two_directions_give_the_optimal_attitude_of_one_moment() -> None:
    """With a very weak prior, two directions give the attitude of a least-squares fit."""
    rng = np.random.default_rng(4)
    truth = multiply(from_rotation_vector(np.array([0.01, -0.02, 0.015])), as_array(STATE))
    state, covariance = STATE, np.eye(SIZE)
    seen = []
    for reference in (REFERENCE, OTHER):
        exact = direction(truth, reference)
        noisy = exact.observed + SIGMA * rng.standard_normal(3)
        seen.append(replace(exact, observed=noisy / np.linalg.norm(noisy)))
    for _ in range(2):  # the second pass is linearised at the first result, as in an iterated fit
        covariance = np.eye(SIZE)
        for measurement in seen:
            found = innovation(state, measurement, False)
            state, covariance = correct(state, covariance, found)[:2]
    fix = weighted_fit([VectorObservation(m.observed, m.reference, m.covariance) for m in seen])
    assert float(angle_between(as_array(state), fix.quaternion)) < 2e-2 * SIGMA
    np.testing.assert_allclose(covariance[ATTITUDE, ATTITUDE], fix.covariance, atol=0.02 * SIGMA**2)


@pytest.mark.parametrize("suspended", [True, False], ids=["suspended", "free"])
def test_late_directions_and_fields_give_what_they_would_have_given_in_time(suspended: bool) -> None:
    flight = fly(2, 80, suspended)
    settings = replace(SETTINGS, field_bias_start=1e-7, field_bias_walk=1e-9)
    seen = direction(flight.attitudes[40], time_ns=40 * CYCLE_NS, off=0.0)
    there = attitude_matrix(flight.attitudes[50]) @ FIELD
    measured = FieldMeasurement(50 * CYCLE_NS, there, FIELD, 1e-14 * np.eye(3))
    in_time = begin(flight, suspended, settings)
    follow(in_time, flight, 1, 41)
    assert in_time.measure(seen)
    follow(in_time, flight, 41, 51)
    assert in_time.measure(measured)
    follow(in_time, flight, 51)
    late = begin(flight, suspended, settings)
    follow(late, flight)
    assert late.measure(measured)
    assert late.measure(seen)
    one, other = (filter_.at(80 * CYCLE_NS) for filter_ in (in_time, late))
    assert float(angle_between(one.quaternion, other.quaternion)) < 1e-11
    np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-6, atol=1e-15)
    np.testing.assert_allclose(one.field_bias, other.field_bias, atol=1e-15)
    if suspended:
        assert one.quaternion[[0, 2]] == pytest.approx([0.0, 0.0], abs=1e-15)


def test_a_wrong_direction_does_not_pass_the_gate_and_a_right_one_does() -> None:
    flight = fly(3, 40, False)
    filter_ = begin(flight, False)
    follow(filter_, flight)
    before = filter_.at(39 * CYCLE_NS)
    assert not filter_.measure(direction(flight.attitudes[39], time_ns=39 * CYCLE_NS, off=0.1))
    assert not filter_.measure(
        replace(direction(flight.attitudes[39], time_ns=39 * CYCLE_NS), observed=np.full(3, np.nan))
    )
    np.testing.assert_array_equal(filter_.at(39 * CYCLE_NS).quaternion, before.quaternion)
    assert filter_.measure(direction(flight.attitudes[39], time_ns=39 * CYCLE_NS))
    assert filter_.refused == 2


def test_the_bias_of_the_magnetometer_is_found_while_the_attitude_is_known() -> None:
    """From 100 readings with 20 nT of noise, a bias of 300 nT is estimated to the stated 2 nT."""
    rng = np.random.default_rng(6)
    flight = fly(4, 400, False)
    filter_ = AttitudeFilter(FREE, replace(SETTINGS, field_bias_start=5e-7))
    filter_.start(*flight.samples[0])
    bias = np.array([3e-7, -2e-7, 1e-7])
    for cycle in range(1, 400):
        for sample in flight.samples[cycle]:
            filter_.measure(sample)
        if cycle % 4 == 0:
            noise = 2e-8 * rng.standard_normal(3)
            measured = attitude_matrix(flight.attitudes[cycle]) @ FIELD + bias + noise
            filter_.measure(FieldMeasurement(cycle * CYCLE_NS, measured, FIELD, 4e-16 * np.eye(3)))
        filter_.command(cycle * CYCLE_NS, flight.commands[cycle], flight.fields[cycle])
    estimate = filter_.at(399 * CYCLE_NS)
    sigma = np.sqrt(np.diag(estimate.covariance)[FIELD_BIAS])
    assert np.all(sigma < 8e-9)
    error = estimate.field_bias - bias
    # 99.9 % quantile of chi-square.
    assert error @ np.linalg.solve(estimate.covariance[FIELD_BIAS, FIELD_BIAS], error) < 16.3


def test_without_a_bias_of_the_magnetometer_none_is_estimated() -> None:
    flight = fly(5, 20, True)
    filter_ = AttitudeFilter(SUSPENDED, SETTINGS)
    filter_.start(*flight.samples[0])
    measured = attitude_matrix(flight.attitudes[0]) @ FIELD + 1e-9
    assert filter_.measure(FieldMeasurement(0, measured, FIELD, 1e-16 * np.eye(3)))
    estimate = filter_.at(CYCLE_NS)
    np.testing.assert_array_equal(estimate.field_bias, np.zeros(3))
    assert not np.any(estimate.covariance[FIELD_BIAS])


def test_a_direction_opposite_to_the_expected_direction_is_refused() -> None:
    """An opposite direction has no component normal to the expected one; only its angle differs."""
    flight = fly(11, 3, False)
    for off in (0.0, 1e-3, 1.0):
        estimate = begin(flight, False)
        seen = direction(flight.attitudes[0], off=off)
        opposite = replace(seen, observed=-seen.observed)
        assert not estimate.measure(opposite)
        assert estimate.nis > 100.0
    satellite = FreeFilter(INERTIA, FreeFilterSettings())
    satellite.start(flight.attitudes[0], 1e-4 * np.eye(3), np.zeros(3))
    seen = direction(flight.attitudes[0])
    assert not satellite.direction(-seen.observed, seen.reference, seen.covariance)
    assert satellite.direction(seen.observed, seen.reference, seen.covariance)
