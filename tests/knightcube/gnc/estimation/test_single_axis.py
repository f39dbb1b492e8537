"""Tests that the single-axis filter is consistent, uses late measurements, and rejects outliers."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.knightcube.gnc.estimation.single_axis import (
    ANGLE,
    RATE,
    Measurement,
    SingleAxisFilter,
)
from tests.knightcube.gnc.estimation.single_axis_flights import (
    ANGLE_SIGMA,
    PERIOD,
    PLANT,
    RATE_SIGMA,
    SETTINGS,
    simulate,
)


def run(filter_: SingleAxisFilter, commands: list[float], measurements: list[Measurement]) -> None:
    filter_.start(measurements[0], measurements[1])
    for cycle, command in enumerate(commands):
        for measurement in measurements[2 * cycle : 2 * cycle + 2]:
            if cycle:
                filter_.measure(measurement)
        filter_.command(cycle * PERIOD, command)


def test_the_errors_agree_with_the_covariance() -> None:
    """The NEES of angle and rate, summed over 40 runs, is in the 99.9 % band of chi-square(80)."""
    rng = np.random.default_rng(7)
    nees = []
    for _ in range(40):
        truth, commands, measurements = simulate(rng, 200)
        filter_ = SingleAxisFilter(PLANT, SETTINGS)
        run(filter_, commands, measurements)
        estimate = filter_.at(199 * PERIOD)
        error = np.array([estimate.angle, estimate.rate]) - truth[-1]
        nees.append(error @ np.linalg.solve(estimate.covariance[:2, :2], error))
    assert 44.8 < sum(nees) < 124.8


def test_the_estimate_is_better_than_its_measurements() -> None:
    rng = np.random.default_rng(8)
    errors = []
    for _ in range(20):
        truth, commands, measurements = simulate(rng, 200)
        filter_ = SingleAxisFilter(PLANT, SETTINGS)
        run(filter_, commands, measurements)
        estimate = filter_.at(199 * PERIOD)
        errors.append([estimate.angle - truth[-1, 0], estimate.rate - truth[-1, 1]])
    angle_rms, rate_rms = np.sqrt(np.mean(np.square(errors), axis=0))
    assert angle_rms < 0.5 * ANGLE_SIGMA
    assert rate_rms < RATE_SIGMA


def test_a_late_measurement_gives_what_it_would_have_given_in_time() -> None:
    _, commands, measurements = simulate(np.random.default_rng(9), 80)
    precise = Measurement(40 * PERIOD + 7_000_000, RATE, measurements[81].value + 2e-4, 1e-10)
    in_time, late = SingleAxisFilter(PLANT, SETTINGS), SingleAxisFilter(PLANT, SETTINGS)
    run(late, commands, measurements)
    late.measure(precise)
    in_time.start(measurements[0], measurements[1])
    for cycle, command in enumerate(commands):
        for measurement in measurements[2 * cycle : 2 * cycle + 2]:
            if cycle:
                in_time.measure(measurement)
        in_time.command(cycle * PERIOD, command)
        if cycle == 40:
            in_time.measure(precise)
    a, b = in_time.at(80 * PERIOD), late.at(80 * PERIOD)
    assert (a.angle, a.rate, a.disturbance) == pytest.approx((b.angle, b.rate, b.disturbance), abs=1e-12)
    np.testing.assert_allclose(a.covariance, b.covariance, rtol=1e-9, atol=1e-16)


def test_mean_rates_over_an_exposure_keep_it_consistent_while_the_body_accelerates() -> None:
    """With mean rates each second, 0.25 s late, the NEES of 40 runs is in the 99.9 % chi-square band."""
    rng = np.random.default_rng(11)
    nees, used, plain_sigma = [], 0, 0.0
    for _ in range(40):
        truth, commands, measurements = simulate(rng, 200)
        filter_, plain = SingleAxisFilter(PLANT, SETTINGS), SingleAxisFilter(PLANT, SETTINGS)
        filter_.start(measurements[0], measurements[1])
        for cycle in range(200):
            for measurement in measurements[2 * cycle : 2 * cycle + 2] if cycle else []:
                filter_.measure(measurement)
            filter_.command(cycle * PERIOD, commands[cycle])
            if cycle % 50 == 49:
                first, last = cycle - 49, cycle - 9
                mean = (truth[last, 0] - truth[first, 0]) / 1.0 + rng.normal(0.0, 3e-5)
                exposure = Measurement(last * PERIOD, RATE, mean, 9e-10, first * PERIOD)
                used += filter_.measure(exposure)
        estimate = filter_.at(199 * PERIOD)
        error = np.array([estimate.angle, estimate.rate]) - truth[-1]
        nees.append(error @ np.linalg.solve(estimate.covariance[:2, :2], error))
        run(plain, commands, measurements)
        plain_sigma = plain.at(199 * PERIOD).covariance[RATE, RATE] ** 0.5
    assert used == 160
    assert 44.8 < sum(nees) < 124.8
    assert estimate.covariance[RATE, RATE] ** 0.5 < plain_sigma


def test_a_late_measurement_inside_an_exposure_does_not_lose_the_exposure() -> None:
    _, commands, measurements = simulate(np.random.default_rng(12), 80)
    mean = Measurement(60 * PERIOD, RATE, 0.0, 1e-4, 20 * PERIOD)
    late = Measurement(40 * PERIOD + 1, RATE, measurements[81].value, 1e-9)
    one, other = SingleAxisFilter(PLANT, SETTINGS), SingleAxisFilter(PLANT, SETTINGS)
    for filter_, order in ((one, (mean, late)), (other, (late, mean))):
        run(filter_, commands, measurements)
        for measurement in order:
            filter_.measure(measurement)
    a, b = one.at(80 * PERIOD), other.at(80 * PERIOD)
    assert (a.angle, a.rate) == pytest.approx((b.angle, b.rate), abs=1e-13)


def test_a_measurement_older_than_the_history_is_not_used() -> None:
    filter_ = SingleAxisFilter(PLANT, SETTINGS)
    filter_.start(Measurement(10**9, ANGLE, 0.1, 1e-6), Measurement(10**9, RATE, 0.0, 1e-8))
    assert not filter_.measure(Measurement(10**9 - 1, RATE, 0.5, 1e-12))
    assert filter_.at(10**9).rate == 0.0


def test_an_outlier_is_refused_and_the_next_good_one_is_not() -> None:
    filter_ = SingleAxisFilter(PLANT, SETTINGS)
    filter_.start(Measurement(0, ANGLE, 0.1, 1e-6), Measurement(0, RATE, 0.0, 1e-8))
    assert not filter_.measure(Measurement(PERIOD, ANGLE, 0.9, 1e-6))
    assert filter_.measure(Measurement(PERIOD, ANGLE, 0.1005, 1e-6))
    assert (filter_.refused, filter_.restarts) == (1, 0)


def test_when_everything_disagrees_the_filter_restarts() -> None:
    filter_ = SingleAxisFilter(PLANT, SETTINGS)
    filter_.start(Measurement(0, ANGLE, 0.1, 1e-6), Measurement(0, RATE, 0.0, 1e-8))
    for cycle in range(1, 21):
        filter_.measure(Measurement(cycle * PERIOD, ANGLE, 0.9, 1e-6))
        filter_.measure(Measurement(cycle * PERIOD, RATE, 0.4, 1e-8))
    assert not filter_.started
    assert filter_.restarts == 1


def test_without_measurements_the_covariance_grows_and_the_age_is_reported() -> None:
    filter_ = SingleAxisFilter(PLANT, SETTINGS)
    filter_.start(Measurement(0, ANGLE, 0.1, 1e-6), Measurement(0, RATE, 0.0, 1e-8))
    near, far = filter_.at(PERIOD), filter_.at(40 * PERIOD)
    assert np.all(np.diag(far.covariance)[:2] > np.diag(near.covariance)[:2])
    assert far.measured_ns == 0


def test_an_angle_that_wraps_round_is_a_small_innovation() -> None:
    filter_ = SingleAxisFilter(PLANT, SETTINGS)
    filter_.start(Measurement(0, ANGLE, math.pi - 0.001, 1e-6), Measurement(0, RATE, 0.0, 1e-8))
    assert filter_.measure(Measurement(PERIOD, ANGLE, -math.pi + 0.001, 1e-6))


def test_past_estimates_are_stored_and_earlier_ones_are_unknown() -> None:
    _, commands, measurements = simulate(np.random.default_rng(10), 60)
    filter_ = SingleAxisFilter(PLANT, SETTINGS)
    run(filter_, commands, measurements)
    half_way = SingleAxisFilter(PLANT, SETTINGS)
    run(half_way, commands[:31], measurements[:62])
    past = filter_.past(30 * PERIOD)
    assert past is not None
    assert past.rate == pytest.approx(half_way.at(30 * PERIOD).rate, abs=1e-15)
    assert filter_.past(-1) is None


def test_memory_stays_bounded_over_a_long_flight() -> None:
    filter_ = SingleAxisFilter(PLANT, SETTINGS)
    filter_.start(Measurement(0, ANGLE, 0.0, 1e-6), Measurement(0, RATE, 0.0, 1e-8))
    for cycle in range(1, 3000):
        filter_.measure(Measurement(cycle * PERIOD, RATE, 0.0, 1e-8))
        filter_.command(cycle * PERIOD, 1e-6 * cycle)
    assert len(filter_._history) < 400
    assert len(filter_._commands) < 400
