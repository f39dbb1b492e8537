"""Tests that the filter follows its measurements, without parameter estimates, while currents are unknown."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import angle_about_axis_y
from knightcube.gnc.estimation.attitude_filter import AttitudeFilter, CommandCheck
from knightcube.gnc.estimation.estimate import SIZE, FilterState, Parameters, RateMeasurement
from knightcube.gnc.estimation.mekf import Checkpoint, CommandHistory
from knightcube.gnc.estimation.rigid_body import RigidBody
from tests.knightcube.gnc.estimation.flights import FREE, SETTINGS, SUSPENDED, Flight, begin, fly, follow
from tests.support.consistency_worlds import CYCLE_NS

STUCK, FOUND, FREE_AGAIN, END = 400, 420, 600, 800
"""Cycles at which the chip gets stuck, the fault is detected (0.5 s later), the chip works again, and the
run ends."""
LIMIT = 0.148


@pytest.fixture(scope="module")
def flown() -> Flight:
    """Return a flight in which the PWM chip keeps a large current for five seconds."""

    def keep(cycle: int, wanted: FloatArray) -> FloatArray:
        return np.array([LIMIT, 0.0, 0.0]) if STUCK <= cycle < FREE_AGAIN else wanted

    return fly(5, END, suspended=True, driven=keep)


def filtered(flown: Flight, reported: bool, until: int = END) -> AttitudeFilter:
    """Return the filter after a flight.

    If `reported` is true, the filter is informed at the cycle `FOUND` that the chip does not respond.
    """
    filter_ = begin(flown, True, dataclasses.replace(SETTINGS, unknown_current=LIMIT, gate_sigma=15.0))
    follow(filter_, flown, 1, min(FOUND, until))
    if reported:
        filter_.mark_unknown((STUCK - 4) * CYCLE_NS)
    for cycle in range(FOUND, until):
        filter_.catch_up(16)
        for sample in flown.samples[cycle]:
            filter_.measure(sample)
        known = not reported or cycle >= FREE_AGAIN
        filter_.command(cycle * CYCLE_NS, flown.commands[cycle], flown.fields[cycle], known=known)
    return filter_


def errors(filter_: AttitudeFilter, flown: Flight) -> FloatArray:
    """Return the final errors of angle, rate and gain in units of their sigmas."""
    estimate = filter_.at((END - 1) * CYCLE_NS)
    sigma = np.sqrt(np.diag(estimate.covariance))
    found = np.array([angle_about_axis_y(estimate.quaternion), estimate.rate[1], estimate.parameters.gain])
    true = [angle_about_axis_y(flown.attitudes[-1]), flown.rates[-1, 1], flown.parameters.gain]
    return np.asarray(np.abs(found - true) / sigma[[1, 4, 14]])


@pytest.mark.parametrize("reported", [True, False])
def test_with_unknown_currents_the_filter_refuses_nothing_and_stays_consistent(
    flown: Flight, reported: bool
) -> None:
    filter_ = filtered(flown, reported)
    assert (filter_.refused, filter_.restarts) == (0, 0)
    assert errors(filter_, flown).max() < 4.0


def test_a_chip_that_does_not_obey_is_noticed_within_a_quarter_of_a_second(flown: Flight) -> None:
    assert not filtered(flown, reported=False, until=STUCK).doubts_commands
    assert filtered(flown, reported=False, until=STUCK + 10).doubts_commands


def test_the_commands_are_trusted_again_once_the_body_follows_them(flown: Flight) -> None:
    assert filtered(flown, reported=False, until=FREE_AGAIN).doubts_commands
    assert not filtered(flown, reported=False).doubts_commands


def test_a_gyro_that_jumps_further_than_any_current_pushes_raises_no_doubt(flown: Flight) -> None:
    filter_ = filtered(flown, reported=False, until=STUCK)
    for cycle in range(STUCK, STUCK + 20):
        for sample in flown.samples[cycle]:
            if isinstance(sample, RateMeasurement):
                filter_.measure(dataclasses.replace(sample, rate=sample.rate + 0.1))
            else:
                filter_.measure(sample)
        filter_.command(cycle * CYCLE_NS, flown.commands[cycle], flown.fields[cycle])
    assert filter_.refused > 0
    assert not filter_.doubts_commands


def test_a_jump_of_the_gyro_bias_is_estimated() -> None:
    """A jump as by wrong currents makes the bias unknown; the attitudes then determine the new bias."""
    flown, jump = fly(5, END, suspended=True), np.array([0.0, 2e-3, 0.0])
    filter_ = begin(flown, True, dataclasses.replace(SETTINGS, unknown_current=LIMIT, bias_start=2e-3))
    follow(filter_, flown, 1, STUCK)
    before = filter_.at(STUCK * CYCLE_NS).bias
    for cycle in range(STUCK, END):
        filter_.catch_up(16)
        for sample in flown.samples[cycle]:
            if isinstance(sample, RateMeasurement):
                filter_.measure(dataclasses.replace(sample, rate=sample.rate + jump))
            else:
                filter_.measure(sample)
        filter_.command(cycle * CYCLE_NS, flown.commands[cycle], flown.fields[cycle])
    filter_.catch_up()
    found = filter_.at((END - 1) * CYCLE_NS)
    assert filter_.restarts == 0
    assert found.bias[1] - before[1] == pytest.approx(jump[1], abs=4e-4)
    assert abs(found.rate[1] - flown.rates[-1, 1]) < 5.0 * math.sqrt(found.covariance[4, 4])


def judged(body: RigidBody, departures: list[float]) -> tuple[int, int | None]:
    """Return the number of gyro samples until the alarm, and the first cycle of the mean that raised it.

    `departures` are the innovations about the y axis, in standard deviations. The innovations about the other
    axes are zero.
    """
    settings = dataclasses.replace(SETTINGS, unknown_current=LIMIT)
    model, sigma, axes = AttitudeFilter(body, settings)._model, 1e-4, 1 if body.suspended else 3
    state = FilterState((0.0, 0.0, 0.0, 1.0), (0.0,) * 3, (0.0,) * 3, (0.0,) * 3, Parameters())
    check = CommandCheck(model)
    for cycle, departure in enumerate(departures):
        sample = RateMeasurement(cycle * CYCLE_NS, np.zeros(3), sigma**2 * np.eye(3))
        value = (sigma * departure,) if axes == 1 else (0.0, sigma * departure, 0.0)
        newest = Checkpoint(sample, True, state, np.eye(SIZE), 0.0, value, sigma**2 * np.eye(axes))
        since_ns = check.judge(newest)
        if since_ns is not None:
            assert check.active
            return cycle + 1, (since_ns + 500_000_000) // CYCLE_NS
    assert not check.active
    return len(departures), None


@pytest.mark.parametrize("body", [SUSPENDED, FREE])
def test_a_sample_or_the_mean_of_several_samples_raises_an_alarm(body: RigidBody) -> None:
    """A strong fault raises an alarm in one sample, a weaker fault in the mean of 4 or of 16 samples.

    The currents are unknown from half a second before the first sample of the mean.
    """
    quiet = [0.0] * 20
    assert judged(body, [*quiet, -6.0]) == (21, 20)
    assert judged(body, [*quiet, *[-3.2] * 8]) == (24, 20)
    assert judged(body, [3.2] * 8) == (4, 0)
    number, since = judged(body, [*quiet, *[-2.6] * 16])
    assert 30 < number <= 36
    assert since == number - 16
    assert judged(body, [*quiet, *[3.2, -3.2] * 20]) == (60, None)


def test_a_doubt_reaches_back_to_its_time_and_no_further() -> None:
    history = CommandHistory(SUSPENDED, 6_000_000_000)
    for second in range(5):
        history.record(second * 1_000_000_000, np.array([0.01 * second, 0.0, 0.0]), None)
    history.mark_unknown(2_500_000_000)
    assert [(history.at(t).dipole[0] > 0.0, history.at(t).known) for t in (1_000_000_000, 2_499_999_999)] == [
        (True, True),
        (True, True),
    ]
    assert history.at(2_400_000_000).dipole == history.at(2_600_000_000).dipole
    assert not any(history.at(t).known for t in (2_500_000_000, 3_000_000_000, 9_000_000_000))


def test_before_the_first_command_no_coil_is_driven() -> None:
    second, history = 1_000_000_000, CommandHistory(SUSPENDED, 6_000_000_000)
    history.record(second, np.array([0.01, 0.0, 0.0]), None)
    driven = history.at(second)
    assert history.at(0) == history.idle != driven
    assert list(history.spans(0, 3 * second)) == [(history.idle, second), (driven, 2 * second)]


def test_a_doubt_before_anything_was_noted_or_measured_does_nothing() -> None:
    filter_ = AttitudeFilter(SUSPENDED, SETTINGS)
    filter_.mark_unknown(0)
    assert not filter_.started
