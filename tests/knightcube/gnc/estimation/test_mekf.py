"""Tests of the filter's derivatives against finite differences, and of its noise by Monte Carlo runs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import (
    compose,
    exponential,
    inverse,
    logarithm,
    skew,
)
from knightcube.gnc.estimation.estimate import (
    LATENCY,
    SIZE,
    AttitudeMeasurement,
    FilterState,
    MeanRateMeasurement,
    Parameters,
    RateMeasurement,
)
from knightcube.gnc.estimation.mekf import (
    _corrected,
    _corrected_about_thread,
    correct,
    correct_about_thread,
    innovation,
    keep_attitude,
    release_attitude,
)
from knightcube.gnc.estimation.rigid_body import ProcessNoise, RateChange, RigidBody, Torquing, propagate
from tests.knightcube.gnc.estimation.filter_states import STATE, moved
from tests.knightcube.gnc.estimation.flights import FREE, RATE_COVARIANCE, SUSPENDED, TURN_COVARIANCE
from tests.support.compiled_forms import assert_forms_agree

STILL = ProcessNoise(0.0, np.zeros((3, 3)), np.zeros(SIZE))
TORQUING = FREE.torquing(np.array([0.1, -0.08, 0.05]))
HUNG = FilterState(
    exponential(0.0, 0.4, 0.0), (0.0, -0.3, 0.0), (0.0, 1e-3, 0.0), (0.0, 0.02, 0.0), Parameters(0.01, 2e-3)
)
ABOUT_THREAD = [1, 4, 7, 10, 12, 13, 14]


def walks_of(bias: float, disturbance: float) -> FloatArray:
    """Return the random-walk densities (19,) of the error states."""
    return np.repeat([0.0, bias, disturbance, 0.0], [6, 3, 3, SIZE - 12])


def difference(a: FilterState, b: FilterState) -> FloatArray:
    """Return the error vector (19,) of b relative to a."""
    turn = logarithm(compose(a.quaternion, inverse(b.quaternion)))
    mine, theirs = (
        np.array([*s.rate, *s.bias, *s.disturbance, *s.parameters, s.latency, *s.field_bias]) for s in (a, b)
    )
    return np.concatenate([turn, mine - theirs])


def test_the_transition_of_the_errors_equals_central_differences() -> None:
    """The transition of the errors agrees with central differences over one cycle.

    The remainder is of third order in the step.
    """
    for body, state, free in ((FREE, STATE, [*range(12), 14]), (SUSPENDED, HUNG, ABOUT_THREAD)):
        step = 1e-5
        for column in free:
            bump = step * np.eye(SIZE)[column]
            up, _ = propagate(body, STILL, moved(state, bump), np.eye(SIZE), TORQUING, 0.025)
            down, _ = propagate(body, STILL, moved(state, -bump), np.eye(SIZE), TORQUING, 0.025)
            covariance = np.outer(bump, bump) / step**2
            _, carried = propagate(body, STILL, state, covariance, TORQUING, 0.025)
            # Outer products are compared, because a covariance of rank one is the outer product of a column
            # with itself.
            grown = difference(up, down) / (2.0 * step)
            np.testing.assert_allclose(carried, np.outer(grown, grown), atol=3e-5)


def test_a_step_is_the_product_of_the_whole_matrices() -> None:
    """A step equals dense products (22, 22) of transition, noise and a cloned attitude, up to rounding."""
    rng = np.random.default_rng(4)
    rate_noise = np.diag(rng.uniform(0.0, 1e-8, 3))
    noise = ProcessNoise(1e-7, rate_noise, rng.uniform(0.0, 1e-9, SIZE), unknown_current=0.1)
    exposure = MeanRateMeasurement(0, 10, np.zeros(3), RATE_COVARIANCE)
    root = rng.normal(0.0, 0.1, (SIZE, SIZE))
    for body, begun in ((FREE, STATE), (SUSPENDED, HUNG)):
        for torquing in (TORQUING, TORQUING._replace(known=False), body.torquing(np.zeros(3))):
            state, before = keep_attitude(begun, root @ root.T, exposure)
            _, carried = propagate(body, noise, state, before, torquing, 0.025)
            transition, added = dense_step(body, noise, state, torquing, 0.025)
            expected = transition @ before @ transition.T + added
            np.testing.assert_allclose(carried, expected, rtol=1e-12, atol=1e-15)


def dense_step(
    body: RigidBody, noise: ProcessNoise, state: FilterState, torquing: Torquing, dt: float
) -> tuple[FloatArray, FloatArray]:
    """Return transition and added noise (22, 22) of one step with one cloned attitude."""
    middle = compose(exponential(*(0.5 * dt * w for w in state.rate)), state.quaternion)
    model = body.linearise(middle, state.rate, state.parameters, torquing, 0.5 * dt)
    flow, added = np.zeros((22, 22)), np.zeros((22, 22))
    flow[0:3, 0:3], flow[0:3, 3:6] = -np.array(skew(state.rate)), np.eye(3)
    flow[3:6, 0:3], flow[3:6, 3:6] = model.by_attitude, model.by_rate
    flow[3:6, 9:12], flow[3:6, 12:15] = np.eye(3), model.by_parameters
    known = noise.current * np.diag(torquing.driven)
    unknown = (0.0 if torquing.known else 0.3 * noise.unknown_current**2) * np.eye(3)
    density = noise.rate + model.by_current @ (known + unknown) @ model.by_current.T
    added[0:6, 0:6] = np.kron([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]], density)
    added[:SIZE, :SIZE] += np.diag(dt * noise.walks)
    return np.eye(22) + flow * dt + 0.5 * (flow * dt) @ (flow * dt), added


def test_the_process_noise_is_what_random_currents_and_walks_make() -> None:
    """The process noise agrees within 10 % with 4000 random sequences of 20 cycles.

    The random noise is constant within each cycle. The diagonals of the covariances are compared.
    """
    rng = np.random.default_rng(3)
    draws, cycles, dt = 4000, 20, 0.025
    sigma, walk, bias_walk = 2e-3, 5e-4, 1e-5
    noise = ProcessNoise(sigma**2 * dt, np.zeros((3, 3)), walks_of(bias_walk**2, walk**2))
    still = FilterState((0.0, 0.0, 0.0, 1.0), (0.0,) * 3, (0.0,) * 3, (0.0,) * 3, Parameters())
    torquing = FREE.torquing(np.full(3, 1e-9))
    _, covariance = propagate(FREE, noise, still, np.zeros((SIZE, SIZE)), torquing, cycles * dt)
    per_ampere = FREE.linearise(still.quaternion, still.rate, Parameters(), torquing, 0.0).by_current
    turn, rate, push = (np.zeros((draws, 3)) for _ in range(3))
    for _ in range(cycles):
        acceleration = rng.normal(0.0, sigma, (draws, 3)) @ per_ampere.T + push
        turn += dt * rate + 0.5 * dt * dt * acceleration
        rate += dt * acceleration
        push += rng.normal(0.0, walk * np.sqrt(dt), (draws, 3))
    diagonal = np.diag(covariance)
    for drawn, first in ((turn, 0), (rate, 3), (push, 9)):
        np.testing.assert_allclose(diagonal[first : first + 3], drawn.var(axis=0), rtol=0.1)
    np.testing.assert_allclose(diagonal[6:9], bias_walk**2 * cycles * dt, rtol=1e-9)


def test_the_rows_of_each_measurement_are_its_derivatives() -> None:
    exposure = MeanRateMeasurement(0, 10**9, np.array([0.2, -0.28, 0.12]), RATE_COVARIANCE)
    earlier = compose(exponential(-0.25, 0.35, -0.15), STATE.quaternion)
    state = STATE._replace(kept=((exposure, earlier),))
    attitude = AttitudeMeasurement(10**9, np.array(STATE.quaternion), TURN_COVARIANCE)
    rate = RateMeasurement(10**9, np.zeros(3), RATE_COVARIANCE)
    aged = (replace(attitude, latency=state.latency), replace(rate, latency=state.latency))
    aging = RateChange((0.02, -0.04, 0.03), np.zeros((3, 3)))
    for measurement in (attitude, rate, exposure, *aged):
        rows = innovation(state, measurement, False, aging).rows
        step = 1e-6
        for column in range(SIZE + 3):
            values = []
            for bump in (step * np.eye(SIZE + 3)[column], -step * np.eye(SIZE + 3)[column]):
                x, y, z = bump[SIZE:].tolist()
                kept = ((exposure, compose(exponential(x, y, z), earlier)),)
                there = moved(state, bump[:SIZE])._replace(kept=kept)
                values.append(np.array(innovation(there, measurement, False, aging).value))
            slope = (values[0] - values[1]) / (2.0 * step)
            np.testing.assert_allclose(rows[:, column], -slope, atol=1e-8)


def test_an_attitude_that_is_kept_is_forgotten_again_without_a_trace() -> None:
    covariance = np.diag(np.arange(1.0, SIZE + 1.0)) + 0.1
    first = MeanRateMeasurement(0, 10, np.zeros(3), RATE_COVARIANCE)
    second = MeanRateMeasurement(5, 10, np.zeros(3), RATE_COVARIANCE)
    state, wide = keep_attitude(STATE, covariance, first)
    state, wide = keep_attitude(state, wide, second)
    assert wide.shape == (SIZE + 6, SIZE + 6)
    state, wide = release_attitude(state, wide, first)
    assert state.kept == ((second, STATE.quaternion),)
    state, wide = release_attitude(state, wide, second)
    assert state == STATE
    np.testing.assert_array_equal(wide, covariance)


def test_correcting_by_an_exact_attitude_gives_that_attitude() -> None:
    target = compose(exponential(0.02, -0.03, 0.01), STATE.quaternion)
    exact = AttitudeMeasurement(0, np.array(target), 1e-20 * np.eye(3))
    found = innovation(STATE, exact, False)
    covariance = 1e-2 * np.eye(SIZE)
    state, covariance = correct(STATE, covariance, found)[:2]
    np.testing.assert_allclose(difference(state, STATE)[:3], (0.02, -0.03, 0.01), atol=1e-12)
    assert np.all(np.diag(covariance)[:3] < 1e-19)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_the_covariance_stays_symmetric_and_positive(seed: int) -> None:
    """After accurate and inaccurate measurements in any order, the covariance is symmetric and positive.

    The sigmas of the measurements are from a microradian to a radian.
    """
    rng = np.random.default_rng(seed)
    noise = ProcessNoise(1e-7, np.zeros((3, 3)), walks_of(1e-9, 1e-9))
    state, covariance = STATE, np.diag(10.0 ** rng.uniform(-8.0, 0.0, SIZE))
    for _ in range(20):
        size = 10.0 ** rng.uniform(-12.0, 0.0)
        # Each measurement equals its prediction, so only the covariance changes.
        if rng.random() < 0.5:
            seen = AttitudeMeasurement(0, np.array(state.quaternion), size * np.eye(3))
            found = innovation(state, seen, False)
        else:
            measured = np.array(state.rate) + np.array(state.bias)
            found = innovation(state, RateMeasurement(0, measured, size * np.eye(3)), False)
        state, covariance = correct(state, covariance, found)[:2]
        state, covariance = propagate(FREE, noise, state, covariance, TORQUING, 0.025)
        np.testing.assert_allclose(covariance, covariance.T, rtol=1e-9, atol=1e-12 * covariance.max())
        scale = np.sqrt(np.diag(covariance))
        assert np.linalg.eigvalsh(covariance / np.outer(scale, scale))[0] > -1e-9


@pytest.mark.parametrize("components", [1, 2, 3])
def test_a_correction_computed_with_loops_equals_the_correction_computed_with_numpy(components: int) -> None:
    """All states, all states but the age, only the rate, or no states are corrected."""
    rng = np.random.default_rng(62)
    root = rng.normal(0.0, 0.1, (SIZE + 6, SIZE + 6))
    value, noise = rng.normal(0.0, 0.1, components), 0.1 * np.eye(components) + 0.01
    for size in (SIZE, SIZE + 3, SIZE + 6):
        covariance, rows = (root @ root.T)[:size, :size].copy(), rng.normal(0.0, 1.0, (components, size))
        seen = covariance, value, rows, noise
        for gate, rate_gate, considers_age, first in (
            (np.inf, np.inf, False, 0),
            (np.inf, np.inf, True, 0),
            (np.inf, 0.0, False, 3),
            (0.0, np.inf, False, None),
        ):
            used, _, error, _, _ = _corrected.numpy_form(*seen, gate, rate_gate, considers_age)
            changed = np.flatnonzero(error).tolist()
            assert changed[:1] == ([] if first is None else [first])
            assert used is (first is not None)
            assert (LATENCY in changed) is (used and not considers_age and not first)
            assert_forms_agree(_corrected, *seen, gate, rate_gate, considers_age, relative=1e-12)


@pytest.mark.parametrize("kept", [0, 1])
def test_a_correction_about_the_thread_equals_that_by_the_innovation(kept: int) -> None:
    """The age is known or estimated, and all states, all states but the age, or only the rate change."""
    rng = np.random.default_rng(63)
    exposure = MeanRateMeasurement(0, 10, np.zeros(3), RATE_COVARIANCE)
    state = STATE._replace(kept=((exposure, STATE.quaternion),) * kept)
    root = rng.normal(0.0, 0.1, (SIZE + 3 * kept, SIZE + 3 * kept))
    covariance = root @ root.T
    spread = rng.normal(0.0, 0.1, (3, 3))
    aging = RateChange((0.02, -0.04, 0.03), spread @ spread.T)
    attitude = AttitudeMeasurement(10**9, np.array((0.1, 0.2, 0.3, 0.9)), 0.1 * np.eye(3) + 0.01)
    rate = RateMeasurement(10**9, rng.normal(0.0, 1.0, 3), 0.1 * np.eye(3) + 0.01)
    for measurement, change in (
        (attitude, None),
        (rate, None),
        (replace(attitude, latency=0.04), None),
        (replace(rate, latency=0.04), aging),
    ):
        found = innovation(state, measurement, True, change)
        for gate, rate_gate in ((np.inf, np.inf), (np.inf, 0.0), (0.0, np.inf)):
            expected = correct(state, covariance, found, gate, rate_gate, considers_age=change is not None)
            done, value = correct_about_thread(state, covariance, measurement, change, gate, rate_gate)
            assert value == pytest.approx(found.value[0], rel=1e-12)
            assert done.used is expected.used is (gate > 0.0)
            assert done.square == pytest.approx(expected.square, rel=1e-12)
            assert done.spread == pytest.approx(expected.spread, rel=1e-12)
            np.testing.assert_allclose(
                difference(done.state, state), difference(expected.state, state), atol=1e-12
            )
            np.testing.assert_allclose(done.covariance, expected.covariance, atol=1e-12)
            for (_, stored), (_, other) in zip(done.state.kept, expected.state.kept, strict=True):
                assert stored == pytest.approx(other, abs=1e-12)


@pytest.mark.parametrize("is_rate", [True, False])
def test_a_correction_about_the_thread_with_loops_equals_that_with_numpy(is_rate: bool) -> None:
    rng = np.random.default_rng(64)
    root = rng.normal(0.0, 0.1, (SIZE + 3, SIZE + 3))
    for size in (SIZE, SIZE + 3):
        covariance = (root @ root.T)[:size, :size].copy()
        for gate, rate_gate, considers_age in (
            (np.inf, np.inf, True),
            (np.inf, 0.0, False),
            (0.0, 1.0, True),
        ):
            seen = covariance, is_rate, 0.05, -0.3, 0.02, gate, rate_gate, considers_age
            assert_forms_agree(_corrected_about_thread, *seen, relative=1e-12)
