"""Tests that the filter applies late measurements at their time, rejects outliers and estimates biases."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from flight.bodies.testbed.control import about_thread
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import about_axis_y, angle_between, conjugate, from_rotation_vector, multiply
from knightcube.astro.quaternion import to_rotation_vector as rotation_vector
from knightcube.errors import ArgumentError
from knightcube.gnc.estimation.attitude_filter import AttitudeFilter, slow_prior
from knightcube.gnc.estimation.estimate import (
    ATTITUDE,
    BIAS,
    PARAMETERS,
    RATE,
    AttitudeMeasurement,
    DirectionMeasurement,
    Estimate,
    MeanRateMeasurement,
    Parameters,
    RateMeasurement,
)
from tests.knightcube.gnc.estimation.flights import (
    FREE,
    RATE_COVARIANCE,
    RATE_SIGMA,
    SETTINGS,
    SUSPENDED,
    TURN_COVARIANCE,
    Flight,
    begin,
    fly,
    follow,
)
from tests.pace import ordinary_seconds
from tests.support.consistency_worlds import CYCLE_NS

BOTH = pytest.mark.parametrize("suspended", [True, False], ids=["suspended", "free"])
SECOND = 1_000_000_000


def exposure(flight: Flight, first: int, last: int, covariance: FloatArray) -> MeanRateMeasurement:
    """Return the true mean rate between two cycles."""
    turn = multiply(flight.attitudes[last], conjugate(flight.attitudes[first]))
    rate = rotation_vector(turn) / ((last - first) * CYCLE_NS * 1e-9)
    return MeanRateMeasurement(first * CYCLE_NS, last * CYCLE_NS, rate, covariance)


def assert_same(a: Estimate, b: Estimate) -> None:
    assert float(angle_between(a.quaternion, b.quaternion)) < 1e-11
    np.testing.assert_allclose(a.rate, b.rate, atol=1e-12)
    np.testing.assert_allclose(a.bias, b.bias, atol=1e-12)
    np.testing.assert_allclose(a.disturbance, b.disturbance, atol=1e-12)
    np.testing.assert_allclose(a.covariance, b.covariance, rtol=1e-6, atol=1e-15)


@BOTH
def test_late_measurements_give_what_they_would_have_given_in_time(suspended: bool) -> None:
    """Late measurements, in any order, give the same estimate as measurements that arrive in time.

    The measurements are a mean rate and a star attitude at the middle of the exposure.
    """
    flight = fly(1, 100, suspended)
    mean = exposure(flight, 40, 60, 1e-10 * np.eye(3))
    off = multiply(from_rotation_vector(np.full(3, 1e-5)), flight.attitudes[50])
    star = AttitudeMeasurement(50 * CYCLE_NS, off, 1e-10 * np.eye(3))
    in_time = begin(flight, suspended)
    follow(in_time, flight, 1, 51)
    assert in_time.measure(star)
    follow(in_time, flight, 51, 61)
    assert in_time.measure(mean)
    follow(in_time, flight, 61)
    for order in ((mean, star), (star, mean)):
        late = begin(flight, suspended)
        follow(late, flight)
        assert all([late.measure(measurement) for measurement in order])
        assert_same(late.at(100 * CYCLE_NS), in_time.at(100 * CYCLE_NS))


@BOTH
def test_exposures_may_overlap(suspended: bool) -> None:
    flight = fly(2, 100, suspended)
    first = exposure(flight, 30, 60, 1e-9 * np.eye(3))
    second = exposure(flight, 50, 80, 1e-9 * np.eye(3))
    estimates = []
    for order in ((first, second), (second, first)):
        filter_ = begin(flight, suspended)
        follow(filter_, flight)
        assert all([filter_.measure(measurement) for measurement in order])
        estimates.append(filter_.at(100 * CYCLE_NS))
    assert_same(*estimates)
    plain = begin(flight, suspended)
    follow(plain, flight)
    assert estimates[0].covariance[4, 4] < plain.at(100 * CYCLE_NS).covariance[4, 4]


@BOTH
def test_the_gyros_bias_is_found_within_three_sigma(suspended: bool) -> None:
    """From 20 s of attitudes and rates, a bias of 1 mrad/s is estimated to 2 % and within three sigma."""
    flight = fly(3, 800, suspended)
    filter_ = begin(flight, suspended)
    follow(filter_, flight)
    last = filter_.at(799 * CYCLE_NS)
    axes = [1] if suspended else [0, 1, 2]
    sigma = np.sqrt(np.diag(last.covariance)[BIAS])[axes]
    assert np.all(sigma < 2e-5)
    assert np.all(np.abs(last.bias - flight.bias)[axes] < 3.0 * sigma)


def test_thread_and_coil_are_found_and_distinguished_from_a_steady_torque() -> None:
    """After 30 s, torsion, damping and gain are within three sigma, and not confused with a steady torque.

    The sigmas of torsion and gain have decreased to less than a tenth.
    """
    flight = fly(4, 1200, True)
    filter_ = begin(flight, True)
    follow(filter_, flight)
    last = filter_.at(1199 * CYCLE_NS)
    sigma = np.sqrt(np.diag(last.covariance)[PARAMETERS])
    assert sigma[0] < 0.1 * SETTINGS.torsion_start
    assert sigma[1] < SETTINGS.damping_start
    assert sigma[2] < 0.1 * SETTINGS.gain_start
    assert np.all(np.abs(np.array(last.parameters) - flight.parameters) < 3.0 * sigma)


def test_the_current_that_holds_the_body_does_not_depend_on_the_assumed_plant() -> None:
    """Due to the estimated disturbance, the current that holds the body is the same for any assumed plant."""
    flight = fly(5, 400, True)
    filter_ = begin(flight, True)
    follow(filter_, flight)
    last = filter_.at(400 * CYCLE_NS)
    true = last.parameters
    pull = true.torsion * about_thread(last).angle + true.damping * last.rate[1] - last.disturbance[1]
    for believed in (Parameters(), Parameters(0.01, 2e-3, 1.2), true):
        there = about_thread(last, believed)
        against = believed.torsion * there.angle + believed.damping * there.rate - there.disturbance
        assert against / believed.gain == pytest.approx(pull / true.gain, abs=1e-15)
        assert np.linalg.eigvalsh(there.covariance)[0] > 0.0
    assert about_thread(last).q2 == pytest.approx(abs(last.quaternion[1]) * np.sign(about_thread(last).angle))
    own = about_thread(last, last.parameters)
    assert own.rate == last.rate[1]
    assert own.covariance[1, 1] == last.covariance[4, 4]


def test_the_filter_of_a_suspended_body_ignores_motion_about_other_axes() -> None:
    """The filter of a suspended body ignores the measured motion about the other axes, such as a swing."""
    flight = fly(6, 60, True)
    filter_ = begin(flight, True)
    follow(filter_, flight)
    filter_.measure(exposure(flight, 10, 50, 1e-8 * (np.eye(3) + 0.5)))
    last = filter_.at(60 * CYCLE_NS)
    others = [0, 2, 3, 5, 6, 8, 9, 11]
    assert last.quaternion[[0, 2]].tolist() == [0.0, 0.0]
    assert not last.rate[[0, 2]].any()
    assert not last.bias[[0, 2]].any()
    assert not last.covariance[others].any()


@BOTH
def test_a_drop_out_widens_the_covariance_and_is_recovered_from(suspended: bool) -> None:
    """In three seconds without samples, sigma increases and the error stays within four sigma.

    Sigma and error decrease again when samples arrive.
    """
    flight = fly(7, 500, suspended)
    filter_ = begin(flight, suspended)
    follow(filter_, flight, 1, 200)
    before = filter_.at(199 * CYCLE_NS)
    for cycle in range(200, 320):
        filter_.command(cycle * CYCLE_NS, flight.commands[cycle], flight.fields[cycle])
    sigmas = []
    for cycle in (200, 240, 280, 319):
        estimate = filter_.at(cycle * CYCLE_NS)
        error = rotation_vector(multiply(flight.attitudes[cycle], conjugate(estimate.quaternion)))
        sigma = np.sqrt(np.diag(estimate.covariance)[ATTITUDE])
        assert np.all(np.abs(error) <= 4.0 * sigma + 1e-15)
        assert estimate.measured_ns == 199 * CYCLE_NS
        sigmas.append(sigma[1])
    assert np.all(np.diff(sigmas) > 0.0)
    follow(filter_, flight, 320)
    assert filter_.refused == 0
    assert filter_.at(499 * CYCLE_NS).covariance[1, 1] < 1.1 * before.covariance[1, 1]


@BOTH
def test_an_outlier_is_refused_and_the_next_good_one_is_not(suspended: bool) -> None:
    flight = fly(8, 100, suspended)
    filter_ = begin(flight, suspended)
    follow(filter_, flight, 1, 80)
    attitude, rate = flight.samples[80]
    turned = multiply(from_rotation_vector(np.array([0.0, 0.02, 0.0])), attitude.quaternion)
    assert not filter_.measure(replace(attitude, quaternion=turned))
    assert filter_.nis > 25.0
    assert not filter_.measure(replace(rate, rate=rate.rate + 3e-3))
    assert not filter_.measure(replace(rate, rate=np.full(3, math.nan)))
    assert filter_.refused == 3
    follow(filter_, flight, 80)
    assert (filter_.refused, filter_.restarts) == (3, 0)


def test_the_gate_knows_its_degrees_of_freedom() -> None:
    """A gate of 2 sigma refuses 4.55 % of Gaussian measurements, for a suspended and for a free body."""
    for suspended in (True, False):
        flight = fly(9, 1000, suspended)
        filter_ = begin(flight, suspended, replace(SETTINGS, gate_sigma=2.0))
        follow(filter_, flight)
        # The bounds are for 2000 measurements. Refusals reduce the spread of the accepted measurements.
        assert 60 < filter_.refused < 125
        assert filter_.restarts == 0


def test_when_attitudes_disagree_for_a_second_the_filter_restarts() -> None:
    """The filter restarts if attitudes are refused for a second, although the rates are accepted.

    Refusals of attitudes and of rates are counted separately.
    """
    flight = fly(10, 100, False)
    filter_ = begin(flight, False)
    follow(filter_, flight, 1, 50)
    for cycle in range(50, 90):
        assert filter_.started
        attitude, rate = flight.samples[cycle]
        turned = multiply(from_rotation_vector(np.array([0.5, 0.0, 0.0])), attitude.quaternion)
        filter_.measure(replace(attitude, quaternion=turned))
        if filter_.started:
            assert filter_.measure(rate)
    assert not filter_.started
    assert filter_.restarts == 1
    assert not filter_.measure(flight.samples[90][0])
    filter_.start(*flight.samples[90])
    follow(filter_, flight, 91)
    assert filter_.refused == 40


@pytest.mark.parametrize(("good", "needed"), [(0, 3), (2, 3), (3, 3), (5, 5), (11, 11), (39, 39), (45, 40)])
def test_as_many_rejections_as_earlier_attitudes_restart_the_filter_but_3_to_40(
    good: int, needed: int
) -> None:
    flight = fly(10, 100, False)
    filter_ = begin(flight, False)
    for cycle in range(1, 1 + good):
        assert filter_.measure(flight.samples[cycle][0])
    for cycle in range(1 + good, 1 + good + needed):
        assert filter_.started
        attitude, rate = flight.samples[cycle]
        assert filter_.measure(rate)
        turned = multiply(from_rotation_vector(np.array([2.0, 0.0, 0.0])), attitude.quaternion)
        assert not filter_.measure(replace(attitude, quaternion=turned))
    assert (filter_.started, filter_.restarts, filter_.refused) == (False, 1, needed)


def test_a_start_on_a_sample_from_before_the_release_is_given_up_at_once() -> None:
    """Three contradicting rates restart a filter that has started with a delayed sample of the held body."""
    flight = fly(16, 40, True)
    thrown = RateMeasurement(0, np.array([0.0, 0.3, 0.0]), RATE_COVARIANCE)
    filter_ = AttitudeFilter(SUSPENDED, SETTINGS)
    filter_.start(flight.samples[0][0], thrown)
    for cycle in range(1, 5):
        attitude, rate = flight.samples[cycle]
        if filter_.started:
            filter_.measure(attitude)
            filter_.measure(rate)
        else:
            filter_.start(attitude, rate)
    assert filter_.restarts == 1
    follow(filter_, flight, 5)
    last = filter_.at(39 * CYCLE_NS)
    assert abs(last.rate[1] - flight.rates[39][1]) < 4.0 * np.sqrt(last.covariance[RATE, RATE][1, 1])


def test_a_camera_that_is_wrong_for_ever_restarts_nothing() -> None:
    flight = fly(11, 200, False)
    filter_ = begin(flight, False)
    follow(filter_, flight, 1, 20)
    for cycle in range(20, 200, 3):
        follow(filter_, flight, cycle, cycle + 3)
        wrong = exposure(flight, cycle - 2, cycle, 1e-10 * np.eye(3))
        assert not filter_.measure(replace(wrong, rate=wrong.rate + 0.1))
    assert (filter_.refused, filter_.restarts) == (60, 0)


def test_a_measurement_older_than_the_history_is_late_and_not_an_outlier() -> None:
    flight = fly(12, 20, False)
    filter_ = AttitudeFilter(FREE, SETTINGS)
    filter_.start(*flight.samples[10])
    for _ in range(50):
        assert not filter_.measure(flight.samples[9][0])
        assert not filter_.measure(exposure(flight, 5, 15, RATE_COVARIANCE))
    assert (filter_.late, filter_.refused, filter_.restarts) == (100, 0, 0)
    assert math.isnan(filter_.nis)
    assert filter_.started


def test_at_the_start_the_rate_is_only_as_good_as_the_gyros_bias() -> None:
    filter_ = AttitudeFilter(FREE, SETTINGS)
    filter_.start(
        AttitudeMeasurement(0, about_axis_y(0.3), TURN_COVARIANCE),
        RateMeasurement(0, np.array([0.1, 0.2, 0.3]), RATE_COVARIANCE),
    )
    covariance = filter_.at(0).covariance
    total = covariance[RATE, RATE] + 2.0 * covariance[RATE, BIAS] + covariance[BIAS, BIAS]
    np.testing.assert_allclose(total, RATE_COVARIANCE, atol=1e-20)
    assert covariance[3, 3] == pytest.approx(SETTINGS.bias_start**2 + RATE_SIGMA**2)


def test_past_estimates_are_stored_and_earlier_ones_are_unknown() -> None:
    flight = fly(13, 60, False)
    filter_, half_way = begin(flight, False), begin(flight, False)
    follow(filter_, flight)
    follow(half_way, flight, 1, 31)
    past = filter_.past(30 * CYCLE_NS)
    assert past is not None
    assert_same(past, half_way.at(30 * CYCLE_NS))
    assert filter_.past(-1) is None


def test_memory_stays_bounded_over_a_long_flight() -> None:
    filter_ = AttitudeFilter(SUSPENDED, replace(SETTINGS, history_ns=SECOND))
    attitude = AttitudeMeasurement(0, about_axis_y(0.0), TURN_COVARIANCE)
    filter_.start(attitude, RateMeasurement(0, np.zeros(3), RATE_COVARIANCE))
    for cycle in range(1, 1000):
        filter_.measure(replace(attitude, time_ns=cycle * CYCLE_NS))
        filter_.command(cycle * CYCLE_NS, np.array([1e-6 * cycle, 0.0, 0.0]))
    assert len(filter_._history) < 100
    assert len(filter_._commands._times) < 120


def test_an_attitude_that_wraps_round_is_a_small_innovation() -> None:
    filter_ = AttitudeFilter(SUSPENDED, SETTINGS)
    attitude = AttitudeMeasurement(0, about_axis_y(math.pi - 0.001), TURN_COVARIANCE)
    filter_.start(attitude, RateMeasurement(0, np.zeros(3), RATE_COVARIANCE))
    round_ = AttitudeMeasurement(CYCLE_NS, about_axis_y(-math.pi + 0.001), TURN_COVARIANCE)
    assert filter_.measure(round_)
    assert filter_.nis < 1.0


@BOTH
def test_a_cycle_and_a_replay_fit_into_the_40_hz_loop(suspended: bool) -> None:
    """A cycle takes less than 1 ms of processor time, and a replay of 1.6 s less than 40 ms.

    The expected averages, 0.5 ms and 20 ms, are half of the tested bounds.
    """
    flight = fly(14, 400, suspended)
    filter_ = begin(flight, suspended)

    def cycles() -> None:
        for cycle in range(1, 400):
            follow(filter_, flight, cycle, cycle + 1)
            filter_.at(cycle * CYCLE_NS + 2_000_000)

    assert ordinary_seconds(cycles, 1) / 399 < 1e-3
    mean = exposure(flight, 336, 376, 1e-9 * np.eye(3))
    accepted = []
    assert ordinary_seconds(lambda: accepted.append(filter_.measure(mean)), 1) < 40e-3
    assert accepted == [True]


@pytest.mark.parametrize("wrong", [{"torsion": 0.06}, {"gain": -0.3}])
def test_a_learned_plant_that_the_motion_contradicts_is_replaced_by_the_configured_one(
    wrong: dict[str, float],
) -> None:
    flight = fly(1, 900, suspended=True)
    learned = flight.parameters._replace(
        **{name: getattr(flight.parameters, name) + off for name, off in wrong.items()}
    )
    prior, sure = slow_prior(SUSPENDED, SETTINGS), 1e-8 * np.eye(3)
    prior = replace(prior, parameters=learned, parameters_covariance=sure)
    found = AttitudeFilter(SUSPENDED, SETTINGS, prior)
    for cycle, samples in enumerate(flight.samples):
        if found.started:
            follow(found, flight, cycle, cycle + 1)
        else:
            found.start(*samples)
    estimate = found.at((len(flight.samples) - 1) * CYCLE_NS)
    sigma = np.sqrt(estimate.covariance[PARAMETERS, PARAMETERS].diagonal())
    assert found.restarts == 1
    assert (np.abs(np.subtract(estimate.parameters, flight.parameters)) < 4.0 * sigma).all()


def test_an_attitude_older_than_the_gyro_sample_is_rotated_to_its_time() -> None:
    """At 0.3 rad/s and a difference of 0.5 s, the attitude changes by 0.15 rad."""
    spin, bias = np.array([0.3, 0.0, 0.0]), np.array([0.0, 2e-3, 0.0])
    estimate = AttitudeFilter(FREE, SETTINGS)
    old = AttitudeMeasurement(0, np.array([0.0, 0.0, 0.0, 1.0]), 1e-8 * np.eye(3))
    estimate.start(old, RateMeasurement(SECOND // 2, spin + bias, 1e-8 * np.eye(3)))
    found = estimate.at(SECOND // 2)
    error = rotation_vector(multiply(found.quaternion, conjugate(from_rotation_vector(0.5 * spin))))
    np.testing.assert_allclose(error, 0.5 * bias, atol=1e-4)
    # The unknown gyro bias also causes an attitude error.
    expected = 1e-8 + 0.25 * (1e-8 + SETTINGS.bias_start**2)
    np.testing.assert_allclose(found.covariance[ATTITUDE, ATTITUDE], expected * np.eye(3), atol=1e-12)
    np.testing.assert_allclose(
        found.covariance[ATTITUDE, BIAS], -0.5 * SETTINGS.bias_start**2 * np.eye(3), atol=1e-12
    )


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_a_start_from_values_that_are_not_finite_is_refused(wrong: float) -> None:
    level = AttitudeMeasurement(0, np.array([0.0, 0.0, 0.0, 1.0]), 1e-8 * np.eye(3))
    still = RateMeasurement(0, np.zeros(3), 1e-8 * np.eye(3))
    for attitude, rate in (
        (replace(level, covariance=np.full((3, 3), wrong)), still),
        (level, replace(still, rate=np.array([0.0, wrong, 0.0]))),
    ):
        estimate = AttitudeFilter(FREE, SETTINGS)
        with pytest.raises(ArgumentError, match="finite"):
            estimate.start(attitude, rate)
        assert not estimate.started


def test_an_estimate_before_the_start_or_after_a_day_is_refused() -> None:
    estimate = AttitudeFilter(FREE, SETTINGS)
    with pytest.raises(ArgumentError, match="has not started"):
        estimate.at(0)
    estimate = begin(fly(3, 3, False), False)
    day = 86_400 * SECOND
    with pytest.raises(ArgumentError, match="more than an hour"):
        estimate.at(day)
    # A wrong time stamp neither costs minutes of propagation nor moves the filter to another time.
    assert not estimate.measure(RateMeasurement(day, np.zeros(3), 1e-8 * np.eye(3)))
    assert estimate.refused == 1
    assert estimate.measured_ns < day


@pytest.mark.parametrize("kind", [AttitudeMeasurement, RateMeasurement])
@pytest.mark.parametrize("covariance", [1e-8, 1e-8 * np.ones(3)])
def test_a_covariance_that_is_not_a_matrix_is_refused(kind: type, covariance: FloatArray | float) -> None:
    """Without the check, numpy would broadcast a scalar or a row, as if the errors were correlated."""
    value = np.array([0.0, 0.0, 0.0, 1.0])[: 4 if kind is AttitudeMeasurement else 3]
    with pytest.raises(ArgumentError, match="covariance: an array of shape"):
        kind(0, value, covariance)
    assert kind(0, value.tolist(), (1e-8 * np.eye(3)).tolist()).covariance.shape == (3, 3)


def test_a_quaternion_of_length_zero_and_an_exposure_without_duration_are_refused() -> None:
    with pytest.raises(ArgumentError, match="quaternion of length 1"):
        AttitudeMeasurement(0, np.zeros(4), np.eye(3))
    with pytest.raises(ArgumentError, match="must begin before its end"):
        MeanRateMeasurement(SECOND, SECOND, np.zeros(3), np.eye(3))


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("current_noise", -1e-3, "give a finite number of 0 or more"),
        ("control_period", 0.0, "give a finite number above zero"),
        ("gate_sigma", math.nan, "nan: give a finite number"),
        ("history_ns", 1.5, "give a whole number"),
    ],
)
def test_settings_out_of_their_range_are_refused_by_name(name: str, value: float, words: str) -> None:
    with pytest.raises(ArgumentError, match=f"{name}: .*{words}|{name}: {words}"):
        replace(SETTINGS, **{name: value})  # type: ignore[arg-type]


def test_a_direction_of_length_zero_is_refused() -> None:
    down = np.array([0.0, 0.0, 1.0])
    for observed, reference in ((np.zeros(3), down), (down, np.zeros(3))):
        with pytest.raises(ArgumentError, match="vector of length 1"):
            DirectionMeasurement(0, observed, reference, np.eye(3))


def test_measured_quaternions_and_directions_are_normalised_unless_only_rounded() -> None:
    covariance, rounded = np.eye(3), np.array([0.5, 0.5, 0.5, 0.5 + 1e-7])
    attitude = AttitudeMeasurement(0, 1.05 * rounded, covariance)
    assert math.hypot(*attitude.quaternion) == pytest.approx(1.0, abs=1e-12)
    assert AttitudeMeasurement(0, rounded, covariance).quaternion is rounded
    down = np.array([0.0, 0.0, 1.0])
    direction = DirectionMeasurement(0, 0.95 * down, 1.05 * down, covariance)
    np.testing.assert_array_equal([direction.observed, direction.reference], [down, down])


def test_times_that_are_not_numbers_are_refused_instead_of_searched_for_without_end() -> None:
    filter_ = begin(fly(1, 2, False), False)
    with pytest.raises(ArgumentError, match="since_ns"):
        filter_.mark_unknown(math.nan)  # type: ignore[arg-type]  # wrong on purpose
    with pytest.raises(ArgumentError, match="time_ns"):
        filter_.at(math.nan)  # type: ignore[arg-type]  # wrong on purpose
    late = RateMeasurement(math.nan, np.zeros(3), RATE_COVARIANCE)  # type: ignore[arg-type]  # the same
    assert not filter_.measure(late)


@BOTH
def test_the_start_names_the_value_that_is_not_finite(suspended: bool) -> None:
    body = SUSPENDED if suspended else FREE
    attitude = AttitudeMeasurement(0, np.array([0.0, 0.0, 0.0, 1.0]), TURN_COVARIANCE)
    rate = RateMeasurement(0, np.zeros(3), RATE_COVARIANCE)
    nothing = np.full((3, 3), np.nan)
    for name, wrong in (
        ("quaternion", (replace(attitude, quaternion=np.full(4, np.nan)), rate)),
        ("attitude_covariance", (replace(attitude, covariance=nothing), rate)),
        ("rate", (attitude, replace(rate, rate=np.full(3, np.nan)))),
        ("rate_covariance", (attitude, replace(rate, covariance=nothing))),
    ):
        with pytest.raises(ArgumentError, match=f"^{name}: "):
            AttitudeFilter(body, SETTINGS).start(*wrong)
