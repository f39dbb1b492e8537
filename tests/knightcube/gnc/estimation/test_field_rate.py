"""Tests of the rate from the magnetometer alone: accuracy and covariance in a tumble, and restarts."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import attitude_matrix, derivative, from_rotation_vector
from knightcube.errors import ArgumentError
from knightcube.gnc.estimation.field_rate import INERTIA as INERTIA_ERROR
from knightcube.gnc.estimation.field_rate import RATE, FieldNoise, FieldRate, FieldRateSettings, _stepped
from tests.support.compiled_forms import assert_forms_agree

INERTIA = np.diag([0.0066, 0.0333, 0.0333])
FIELD, TURN = np.array([1e-5, 2e-5, 3e-5]), np.array([0.0, 1.5e-3, -1.5e-3])
NOISE = 1e-7
DIPOLE = np.array([0.05, -0.1, 0.02])


def settings(inertia: FloatArray = INERTIA) -> FieldRateSettings:
    return FieldRateSettings(inertia=inertia, field_sigma=NOISE, torque_walk=1e-5)


def tumbling(rate: FloatArray, inertia: FloatArray, times: FloatArray, dipole: FloatArray) -> FloatArray:
    """Return rate and field (n, 6) in body axes, from an integrator that is independent of the filter."""

    def flow(time: float, state: FloatArray) -> FloatArray:
        w = state[4:]
        field = attitude_matrix(state[:4]) @ attitude_matrix(from_rotation_vector(TURN * time)).T @ FIELD
        torque = np.cross(dipole, field) - np.cross(w, inertia @ w)
        return np.concatenate([derivative(state[:4], w), np.linalg.solve(inertia, torque)])

    start = np.concatenate([[0.0, 0.0, 0.0, 1.0], rate])
    found = solve_ivp(flow, (0.0, times[-1]), start, t_eval=times, rtol=1e-9, atol=1e-12).y.T
    rows = []
    for time, state in zip(times, found, strict=True):
        inertial = attitude_matrix(from_rotation_vector(TURN * time)).T @ FIELD
        rows.append(np.concatenate([state[4:], attitude_matrix(state[:4]) @ inertial]))
    return np.array(rows)


def follow(
    rate: FloatArray, truth: FloatArray, seconds: float, seed: int = 1
) -> tuple[FieldRate, FloatArray]:
    """Give a filter a sample every 0.2 s; return the filter and the last true state."""
    times = np.arange(0.0, seconds, 0.2)
    states = tumbling(rate, truth, times, DIPOLE)
    rng, found = np.random.default_rng(seed), FieldRate(settings())
    for state in states:
        found.advance(DIPOLE, 0.2)
        found.measure(state[3:] + NOISE * rng.standard_normal(3))
    return found, states[-1]


@pytest.mark.parametrize("degrees", [(6.0, -5.0, 6.0), (-50.0, 3.0, 10.0)])
def test_all_three_components_of_the_rate_are_found_and_the_claim_is_honest(degrees: FloatArray) -> None:
    found, last = follow(np.radians(degrees), INERTIA, 60.0)
    error = found.rate - last[:3]
    # Limit that is exceeded in one of a thousand cases.
    assert float(error @ np.linalg.solve(found.covariance[RATE, RATE], error)) < 16.3
    assert np.linalg.norm(error) < 0.04 * np.linalg.norm(last[:3])
    assert found.restarts == 0


@pytest.mark.parametrize("seed", [8, 10, 22])
def test_the_wrong_one_of_two_spins_about_the_field_is_not_claimed(seed: int) -> None:
    """In each of these tumbles, a single filter converges to a wrong rate that predicts the field well."""
    rng = np.random.default_rng(seed)
    rate = rng.standard_normal(3)
    times = np.arange(0.0, 40.0, 0.2)
    states = tumbling(0.2 * rate / np.linalg.norm(rate), INERTIA, times, np.zeros(3))
    found = FieldRate(settings())
    for state in states:
        found.advance(np.zeros(3), 0.2)
        found.measure(state[3:] + NOISE * rng.standard_normal(3))
        error = found.rate - state[:3]
        square = float(error @ np.linalg.solve(found.covariance[RATE, RATE], error)) if found.started else 0.0
        assert square < 36.0
    assert found.restarts == 0


@pytest.mark.parametrize("seed", range(3))
def test_an_inertia_off_by_several_per_cent_is_found_from_the_tumble(seed: int) -> None:
    turned = attitude_matrix(from_rotation_vector(np.array([0.0, 0.03, -0.02])))
    inertia = turned.T @ (INERTIA @ np.diag([1.08, 0.94, 1.03])) @ turned
    found, last = follow(np.radians([8.0, 4.0, -5.0]), inertia, 100.0, seed)
    error = found.rate - last[:3]
    assert found.restarts == 0
    assert np.linalg.norm(error) < 0.03 * np.linalg.norm(last[:3])
    assert float(error @ np.linalg.solve(found.covariance[RATE, RATE], error)) < 16.3
    estimated = np.linalg.inv(found.inverse)
    ratios = np.abs(estimated / np.trace(estimated) - inertia / np.trace(inertia))
    assert ratios.max() < 0.3 * np.abs(INERTIA / np.trace(INERTIA) - inertia / np.trace(inertia)).max()
    scale = np.concatenate([np.diag(INERTIA), np.zeros(3)]) / np.linalg.norm(INERTIA)
    assert np.sqrt(scale @ found.covariance[INERTIA_ERROR, INERTIA_ERROR] @ scale) > 0.01


def test_a_spin_along_the_field_shows_no_rate_but_claims_no_knowledge_of_it() -> None:
    """A spin along a field that does not rotate is not observable, so its variance stays large."""
    found, rng = FieldRate(settings(inertia=1e-3 * np.eye(3))), np.random.default_rng(3)
    for _ in range(50):
        found.advance(np.zeros(3), 0.2)
        found.measure(FIELD + NOISE * rng.standard_normal(3))
    along, across = FIELD / np.linalg.norm(FIELD), np.array([0.0, 3.0, -2.0]) / np.sqrt(13.0)
    spread = found.covariance[RATE, RATE]
    assert along @ spread @ along > 100.0 * (across @ spread @ across)


def test_the_estimate_from_a_false_gyro_is_discarded_when_the_gyro_measures_correctly() -> None:
    """The estimate of a false gyro is discarded when the gyro measures correctly again.

    The body is at rest in a constant field, so only the gyro measures a rotation about the field.
    """
    found, rng = FieldRate(settings(inertia=1e-3 * np.eye(3))), np.random.default_rng(3)
    false = 0.05 * FIELD / np.linalg.norm(FIELD)

    def feed(gyro: FloatArray, samples: int) -> None:
        for _ in range(samples):
            found.advance(np.zeros(3), 0.2)
            found.measure(FIELD + NOISE * rng.standard_normal(3))
            found.measure_rate(gyro)

    def missed() -> float:
        return float(found.rate @ np.linalg.solve(found.covariance[RATE, RATE], found.rate))

    feed(false, 30)
    assert missed() > 100.0, "the field can not contradict it"
    feed(np.zeros(3), 30)
    assert found.restarts == 1
    assert missed() < 16.3


def test_one_outlier_is_refused_and_repeated_contradictions_restart_the_filter() -> None:
    found, last = follow(np.radians([3.0, -4.0, 5.0]), INERTIA, 30.0)
    before = found.rate
    assert not found.measure(found.field + 1e-5)
    assert not found.measure(np.array([np.nan, 0.0, 0.0]))
    np.testing.assert_array_equal(found.rate, before)
    for _ in range(settings().refusals):
        found.advance(np.zeros(3), 0.2)
        found.measure(-last[3:])
    assert found.restarts == 1
    assert not found.started


@pytest.mark.parametrize("factor", [1.0, 2.0, 4.0])
def test_the_noise_of_the_magnetometer_is_estimated_despite_outliers(factor: float) -> None:
    noise, rng = FieldNoise(NOISE, longest_gap=0.2), np.random.default_rng(6)
    sigmas = []
    for _ in range(600):
        noise.advance(0.1)
        outlier = 1e-5 if rng.uniform() < 0.02 else 0.0
        noise.add(5e-5 + factor * NOISE * rng.standard_normal() + outlier)
        sigmas.append(noise.sigma)
    assert np.mean(sigmas[200:]) == pytest.approx(factor * NOISE, rel=0.2)


def test_samples_far_apart_do_not_show_the_noise() -> None:
    noise = FieldNoise(NOISE, longest_gap=0.2)
    for strength in (5e-5, 4e-5, 3e-5, 5e-5) * 20:
        noise.advance(0.3)
        noise.add(strength)
    assert noise.sigma == NOISE


def test_a_magnetometer_noisier_than_configured_gives_an_honest_rate() -> None:
    times = np.arange(0.0, 100.0, 0.2)
    rng, found = np.random.default_rng(2), FieldRate(settings())
    states = tumbling(np.radians([8.0, 4.0, -5.0]), INERTIA, times, np.zeros(3))
    for state in states:
        found.advance(np.zeros(3), 0.2)
        found.measure(state[3:] + 4.0 * NOISE * rng.standard_normal(3))
    assert 1 <= found.restarts <= 2, "one restart for each doubling of the estimated noise"
    error = found.rate - states[-1][:3]
    assert float(error @ np.linalg.solve(found.covariance[RATE, RATE], error)) < 16.3


@pytest.mark.parametrize(
    ("working", "bias"),
    [
        ((1.0, 0.0, 1.0), (0.0, 0.0, 0.0)),
        ((1.0, -1.0, 1.0), (0.0, 0.0, 0.0)),
        ((1.0, 1.0, 1.0), (2.5e-6, -2e-6, 2.4e-6)),
    ],
    ids=["dead coil", "reversed coil", "biased magnetometer"],
)
def test_the_rate_is_honest_despite_an_unknown_coil_fault_or_bias(
    working: tuple[float, float, float], bias: tuple[float, float, float]
) -> None:
    """The coils are driven as in detumbling, and the fault is estimated."""
    times = np.arange(0.0, 200.0, 0.2)
    states = tumbling(np.radians([8.0, 4.0, -5.0]), INERTIA, times, np.array(working) * DIPOLE)
    rng, found = np.random.default_rng(2), FieldRate(settings())
    for state in states:
        found.advance(DIPOLE, 0.2)
        found.measure(state[3:] + bias + NOISE * rng.standard_normal(3))
        if found.started:
            error = found.rate - state[:3]
            assert float(error @ np.linalg.solve(found.covariance[RATE, RATE], error)) < 36.0
    assert found.restarts == 0
    assert np.linalg.norm(error) < 0.03 * np.linalg.norm(state[:3])
    np.testing.assert_allclose(found.bias, bias, atol=1.5e-7)
    # The dipole and the inertia have a common scale that is not observable.
    np.testing.assert_allclose(found.coil_matrix @ DIPOLE, np.array(working) * DIPOLE, atol=0.03)
    found.renew_coils()
    np.testing.assert_array_equal(found.coil_matrix, np.eye(3))


def test_two_samples_too_far_apart_start_nothing() -> None:
    found = FieldRate(settings())
    for _ in range(4):
        found.advance(np.zeros(3), 1.0)
        found.measure(FIELD)
    assert not found.started


def test_a_sensor_that_measures_zero_starts_nothing_until_it_measures_a_field() -> None:
    found = FieldRate(settings())
    for field in (np.zeros(3), FIELD):
        assert not found.started
        for _ in range(5):
            found.advance(np.zeros(3), 0.2)
            assert found.measure(field)
    assert found.started


def test_the_compiled_step_equals_the_plain_step() -> None:
    inertia = ((1.1e-3, 1e-5, 0.0), (1e-5, 1.05e-3, 2e-5), (0.0, 2e-5, 0.99e-3))
    inverse = ((910.0, -9.0, 0.2), (-9.0, 950.0, -19.0), (0.2, -19.0, 1010.0))
    state = (0.1, 0.12, -0.05), (1e-5, 2e-5, -3e-5), (1e-8, -2e-8, 1e-8), (0.1, -0.5, 0.1, 0.73**0.5)
    assert_forms_agree(_stepped, *state, (0.01, -0.02, 0.03), inertia, inverse, 0.025, relative=1e-14)


@pytest.mark.parametrize(
    ("name", "dipole", "seconds"),
    [("dipole", [np.nan, 0.0, 0.0], 0.2), ("dipole", [0.0, 0.0], 0.2), ("seconds", [0.0] * 3, -0.2)],
)
def test_a_propagation_that_would_make_the_estimate_wrong_is_refused(
    name: str, dipole: list[float], seconds: float
) -> None:
    found, _ = follow(np.radians([3.0, -4.0, 5.0]), INERTIA, 5.0)
    before = found.rate
    with pytest.raises(ArgumentError, match=name):
        found.advance(np.array(dipole), seconds)
    np.testing.assert_array_equal(found.rate, before)


def test_a_rate_is_not_propagated_over_a_long_gap() -> None:
    """Without this limit, a wrong time stamp of a day would take minutes of computing time."""
    found, _ = follow(np.radians([3.0, -4.0, 5.0]), INERTIA, 5.0)
    found.advance(np.zeros(3), 86_400.0)
    assert not found.started
    assert found.restarts == 1


def test_a_field_of_another_shape_or_with_an_impossible_age_is_refused() -> None:
    found, _ = follow(np.radians([3.0, -4.0, 5.0]), INERTIA, 5.0)
    for field, age in ((np.zeros(2), 0.0), (np.ones((3, 3)), 0.0), (FIELD, np.nan), (FIELD, -1.0)):
        with pytest.raises(ArgumentError, match="field"):
            found.measure(field, age)
    with pytest.raises(ArgumentError, match="rate"):
        found.measure_rate(np.zeros(2))
