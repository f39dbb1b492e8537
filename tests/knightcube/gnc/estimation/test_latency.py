"""Tests that the age of delayed samples is estimated, so that the estimate does not lag behind the body."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from knightcube.astro.quaternion import angle_about_axis_y, exponential
from knightcube.gnc.estimation.attitude_filter import AttitudeFilter, AttitudeFilterSettings
from knightcube.gnc.estimation.estimate import LATENCY, Estimate, FilterState, Parameters, RateMeasurement
from knightcube.gnc.estimation.mekf import LONGEST_LATENCY
from knightcube.gnc.estimation.rigid_body import rate_change
from tests.knightcube.gnc.estimation.flights import RATE_COVARIANCE, SETTINGS, SUSPENDED, Flight, fly
from tests.support.consistency_worlds import CYCLE_NS

SWING = 0.14
"""Current (A) of a slew, near the coils' limit. Only motion makes the age of the samples observable."""
ESTIMATING = replace(SETTINGS, latency_start=0.05)


def follow_late(
    flight: Flight, late: int, settings: AttitudeFilterSettings
) -> tuple[AttitudeFilter, Estimate]:
    """Give a filter samples whose time stamps are `late` cycles late; return filter and last estimate."""
    filter_ = AttitudeFilter(SUSPENDED, settings)
    for cycle in range(late, len(flight.samples)):
        age = filter_.latency if settings.latency_start else None
        stamped = cycle * CYCLE_NS - round(1e9 * (age or 0.0))
        attitude, rate = flight.samples[cycle - late]
        attitude = replace(attitude, time_ns=stamped, latency=age)
        rate = replace(rate, time_ns=stamped, latency=age)
        if filter_.started:
            filter_.measure(attitude)
            filter_.measure(rate)
        else:
            filter_.start(attitude, rate)
        filter_.command(cycle * CYCLE_NS, flight.commands[cycle])
    return filter_, filter_.at((len(flight.samples) - 1) * CYCLE_NS)


def sigmas(flight: Flight, last: Estimate) -> float:
    """Return the error of the estimated rotation in units of its stated sigma."""
    error = angle_about_axis_y(flight.attitudes[-1]) - angle_about_axis_y(last.quaternion)
    return float(abs(error) / np.sqrt(last.covariance[1, 1]))


@pytest.mark.parametrize("late", [0, 2, 3])
def test_the_age_of_samples_is_estimated_and_corrected(late: int) -> None:
    """After 20 s, the age of the samples is known to 12 ms and within three sigma.

    Without a correction, an age of two cycles causes errors of more than ten sigma.
    """
    flight = fly(32, 800, True, SWING)
    filter_, last = follow_late(flight, late, ESTIMATING)
    sigma = float(np.sqrt(last.covariance[LATENCY, LATENCY]))
    assert sigma < 12e-3
    assert abs(last.latency - 0.025 * late) < 3.0 * sigma
    assert sigmas(flight, last) < 3.0
    assert filter_.refused == 0
    if late:
        assert sigmas(flight, follow_late(flight, late, SETTINGS)[1]) > 10.0


def test_the_error_of_the_age_agrees_with_its_variance() -> None:
    """The sum of the squared normalised errors of the age in ten flights agrees with chi-square (99.9 %)."""
    squares = []
    for seed in range(20, 30):
        _, last = follow_late(fly(seed, 300, True, SWING), 1, ESTIMATING)
        squares.append((last.latency - 0.025) ** 2 / last.covariance[LATENCY, LATENCY])
    assert 1.265 < sum(squares) < 31.42


def test_a_rate_alone_does_not_show_the_age() -> None:
    flight = fly(12, 400, True, SWING)
    filter_, _ = follow_late(flight, 1, ESTIMATING)
    now_ns, age = 400 * CYCLE_NS, filter_.latency
    before = filter_.at(now_ns)
    fast = before.rate + before.bias + np.array([0.0, 4e-4, 0.0])
    assert filter_.measure(RateMeasurement(now_ns - round(1e9 * age), fast, RATE_COVARIANCE, age))
    after = filter_.at(now_ns)
    assert after.rate[1] > before.rate[1] + 1e-5
    assert after.latency == before.latency
    assert after.covariance[LATENCY, LATENCY] == pytest.approx(before.covariance[LATENCY, LATENCY], rel=1e-12)


def test_the_estimated_age_is_between_zero_and_the_longest_latency() -> None:
    """The estimated age is between zero and the longest latency, and zero before the start of the filter."""
    filter_ = AttitudeFilter(SUSPENDED, ESTIMATING)
    assert filter_.latency == 0.0
    flight = fly(13, 400, True)
    early, _ = follow_late(flight, 0, ESTIMATING)
    assert 0.0 <= early.latency <= LONGEST_LATENCY


def test_a_current_that_changes_within_the_uncertainty_of_the_age_adds_noise() -> None:
    """If a current changes within the uncertainty of the age, the change adds noise to the acceleration.

    Its standard deviation is half the step of the acceleration times the sigma of the age, and zero without a
    step.
    """
    none = (0.0, 0.0, 0.0)
    now = FilterState(exponential(0.0, 0.4, 0.0), none, none, none, Parameters())
    off, on = (SUSPENDED.torquing(currents) for currents in (np.zeros(3), np.array([0.1, 0.0, 0.0])))
    step = SUSPENDED.accelerate(now.quaternion, now.rate, now.parameters, on).acceleration[1]
    covariance = np.zeros((16, 16))
    covariance[LATENCY, LATENCY] = 0.01**2
    found = rate_change(SUSPENDED, now, covariance, off, on)
    assert found.acceleration[1] == pytest.approx(0.5 * step)
    assert found.uncertainty[1, 1] == pytest.approx((0.01 * 0.5 * step) ** 2)
    assert not rate_change(SUSPENDED, now, covariance, on, on).uncertainty.any()
