"""Tests of the LQ tracker: gains, error equations, derivatives by differences, and the closed loop."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import solve_continuous_are

from knightcube.errors import UsageError
from knightcube.gnc.control.one_axis import LqTracker, lq_gains
from knightcube.gnc.guidance.plant import PathSample, PolynomialPath, SingleAxisPlant
from knightcube.gnc.guidance.vmc import plan

PLANT = SingleAxisPlant(1.05e-3, 2.916e-4, 23.0, 0.148)
THREAD = SingleAxisPlant(1.05e-3, 2.916e-4, 23.0, 0.148, 1e-5, 2e-6)
STRONG = SingleAxisPlant(1.05e-3, 2.916e-4, 23.0, 100.0, 1e-5, 2e-6)
REST = PathSample(0.0, 0.0, 0.0)
WEIGHTS = 20.0, 1.0


@settings(deadline=None)
@given(st.floats(0.01, 1e4), st.floats(0.01, 1e3))
def test_gains_are_those_of_a_general_solver(state_weight: float, input_weight: float) -> None:
    """The gains (5.28-5.32) for the state (e', e) agree with scipy's solution of the Riccati equation."""
    integrators, entry = np.array([[0.0, 0.0], [1.0, 0.0]]), np.array([[1.0], [0.0]])
    riccati = solve_continuous_are(integrators, entry, state_weight * np.eye(2), [[input_weight]])
    expected = (entry.T @ riccati)[0] / input_weight
    assert lq_gains(state_weight, input_weight) == pytest.approx(tuple(expected), rel=1e-6)


def test_the_thesis_gains() -> None:
    tracker = LqTracker(PLANT, *WEIGHTS)
    assert tracker.error_gain == pytest.approx(math.sqrt(20.0))
    assert tracker.rate_gain == pytest.approx(math.sqrt(20.0 + 2.0 * math.sqrt(20.0)))


def fly(
    plant: SingleAxisPlant,
    tracker: LqTracker,
    path: PolynomialPath,
    state: tuple[float, float],
    duration: float,
) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Return rows of (t, theta, omega, current). Each Runge-Kutta stage evaluates the tracker."""
    step, rows = 0.005, []
    x = np.array(state)

    def slope(time: float, at: np.ndarray[tuple[int], np.dtype[np.float64]]) -> tuple[float, float, float]:
        command = tracker.command(path.sample(round(time * 1e9)), float(at[0]), float(at[1]))
        return float(at[1]), plant.acceleration(float(at[0]), float(at[1]), command.current), command.current

    for index in range(round(duration / step)):
        time = index * step
        *k1, current = slope(time, x)
        k2 = slope(time + step / 2, x + step / 2 * np.array(k1))[:2]
        k3 = slope(time + step / 2, x + step / 2 * np.array(k2))[:2]
        k4 = slope(time + step, x + step * np.array(k3))[:2]
        rows.append((time, *x, current))
        x = x + step / 6 * (np.array(k1) + 2 * np.array(k2) + 2 * np.array(k3) + np.array(k4))
    return np.array(rows)


@pytest.fixture(scope="module")
def path() -> PolynomialPath:
    """Return a path that is planned for the body on its suspension thread."""
    return plan(THREAD, 0.3, 0.01, -0.1, 0.0, 10.0).path


def test_the_error_follows_the_linear_system_exactly(path: PolynomialPath) -> None:
    """An initial error e of 0.6 rad obeys e'' = -K (e', e), as long as the coil is strong enough."""
    tracker = LqTracker(STRONG, *WEIGHTS)
    start = path.sample(0)
    run = fly(STRONG, tracker, path, (start.angle - 0.6, start.rate + 0.1), 4.0)
    wanted = np.array([path.sample(round(t * 1e9)).angle for t in run[:, 0]])
    error = np.sin(wanted - run[:, 1])
    slope = math.cos(0.6) * -0.1
    k_rate, k_error = tracker.rate_gain, tracker.error_gain
    roots = np.roots([1.0, k_rate, k_error])
    weights = np.linalg.solve(np.array([[1.0, 1.0], roots]), [error[0], slope])
    expected = np.real(weights[0] * np.exp(roots[0] * run[:, 0]) + weights[1] * np.exp(roots[1] * run[:, 0]))
    np.testing.assert_allclose(error, expected, atol=2e-6)


def test_the_second_derivative_of_the_error_is_exact(path: PolynomialPath) -> None:
    """The second derivative of the error (5.24, 5.25, corrected) agrees with finite differences."""
    step = 1e-3

    def angles(time: float) -> tuple[float, float, float]:
        return 0.4 * math.sin(0.5 * time), 0.2 * math.cos(0.5 * time), -0.1 * math.sin(0.5 * time)

    def error(time: float) -> float:
        return math.sin(path.sample(round(time * 1e9)).angle - angles(time)[0])

    tracker = LqTracker(STRONG, *WEIGHTS)
    for time in (1.0, 3.3, 6.1, 8.7):
        wanted, (angle, rate, acceleration) = path.sample(round(time * 1e9)), angles(time)
        numeric = (error(time + step) - 2 * error(time) + error(time - step)) / step**2
        numeric_rate = (error(time + step) - error(time - step)) / (2 * step)
        d = wanted.angle - angle
        exact = math.cos(d) * (wanted.acceleration - acceleration) - math.sin(d) * (wanted.rate - rate) ** 2
        assert exact == pytest.approx(numeric, abs=1e-6)
        # With the commanded current, the plant model gives the second derivative -K (e', e) of the error.
        command = tracker.command(wanted, angle, rate)
        turned = STRONG.acceleration(angle, rate, command.current)
        made = math.cos(d) * (wanted.acceleration - turned) - math.sin(d) * (wanted.rate - rate) ** 2
        asked = -tracker.rate_gain * numeric_rate - tracker.error_gain * error(time)
        assert made == pytest.approx(asked, abs=1e-6)


def test_on_the_path_the_current_is_the_planned_one(path: PolynomialPath) -> None:
    tracker = LqTracker(THREAD, *WEIGHTS)
    for time in np.linspace(0.0, 9.9, 12).tolist():
        sample = path.sample(round(time * 1e9))
        planned = THREAD.current(sample.angle, sample.rate, sample.acceleration)
        assert tracker.command(sample, sample.angle, sample.rate).demanded == pytest.approx(
            planned, abs=1e-12
        )


@pytest.mark.parametrize(("offset", "rate"), [(0.05, 0.0), (-0.1, 0.02), (0.0, -0.05), (0.3, 0.0)])
def test_the_body_returns_to_the_path_within_the_coils_limit(
    path: PolynomialPath, offset: float, rate: float
) -> None:
    start = path.sample(0)
    run = fly(THREAD, LqTracker(THREAD, *WEIGHTS), path, (start.angle + offset, start.rate + rate), 40.0)
    assert np.abs(run[:, 3]).max() <= THREAD.current_limit
    final = path.sample(40_000_000_000).angle
    assert run[-1, 1] == pytest.approx(final, abs=2e-3)
    assert run[-1, 2] == pytest.approx(0.0, abs=2e-3)


def test_saturation_is_explicit() -> None:
    tracker = LqTracker(PLANT, *WEIGHTS)
    strong = tracker.command(PathSample(0.5, 0.0, 0.0), 0.0, 0.0)
    assert strong.saturated
    assert strong.current == 0.148 < strong.demanded
    weak = tracker.command(PathSample(0.001, 0.0, 0.0), 0.0, 0.0)
    assert not weak.saturated
    assert weak.current == weak.demanded > 0.0


@settings(deadline=None)
@given(st.floats(1.01, math.pi - 0.01), st.sampled_from([-1.0, 1.0]))
def test_beyond_the_largest_error_the_command_stays_constant_and_keeps_its_sign(
    size: float, sign: float
) -> None:
    """For errors beyond 1 rad, the command stays at its value for 1 rad and keeps its sign.

    The sine of the error decreases beyond 90 deg.
    """
    tracker = LqTracker(STRONG, *WEIGHTS)
    command = tracker.command(PathSample(sign * size, 0.0, 0.0), 0.0, 0.0)
    edge = tracker.command(PathSample(sign * 1.0, 0.0, 0.0), 0.0, 0.0)
    assert command.held
    assert not edge.held
    assert command.demanded == pytest.approx(edge.demanded)
    assert math.copysign(1.0, command.demanded) == sign


def test_the_error_is_that_of_the_shorter_rotation() -> None:
    command = LqTracker(STRONG, *WEIGHTS).command(PathSample(3.0, 0.0, 0.0), -3.0, 0.0)
    assert command.error == pytest.approx(6.0 - 2.0 * math.pi)


def test_without_authority_the_coil_is_off_and_the_output_states_it() -> None:
    tracker = LqTracker(PLANT, *WEIGHTS)
    lost = tracker.command(REST, math.pi / 2 - 0.01, 0.0)
    assert not lost.authority
    assert lost.current == 0.0
    assert tracker.command(REST, math.pi / 2 - 0.1, 0.0).authority


@pytest.mark.parametrize("position", range(5))
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_an_input_that_is_not_finite_is_refused(position: int, value: float) -> None:
    numbers = [0.1, 0.0, 0.0, 0.1, 0.0]
    numbers[position] = value
    with pytest.raises(UsageError, match="not finite"):
        LqTracker(PLANT, *WEIGHTS).command(PathSample(*numbers[:3]), *numbers[3:])


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"state_weight": 0.0}, "Q"),
        ({"input_weight": math.nan}, "R"),
        ({"largest_error": 1.6}, "largest_error"),
        ({"minimum_authority": 0.0}, "minimum_authority"),
    ],
)
def test_impossible_settings_are_refused_by_name(options: dict[str, Any], name: str) -> None:
    with pytest.raises(UsageError, match=name):
        LqTracker(PLANT, **({"state_weight": 20.0, "input_weight": 1.0} | options))
