"""Tests of the relations of the single-axis plant against each other and against physics."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from knightcube.errors import UsageError
from knightcube.gnc.guidance.plant import (
    PolynomialPath,
    SingleAxisPlant,
    acceleration_of,
    angle_of,
    current_and_slopes,
    q2_of,
    q2_rate_of,
    rate_of,
)
from tests.support.step_problems import KNIGHTCUBE

THREAD = SingleAxisPlant(1.05e-3, 2.916e-4, 23.0, 0.148, 1e-5, 2e-6)
ANGLE, RATE = st.floats(-1.4, 1.4), st.floats(-0.2, 0.2)


@given(ANGLE, RATE, st.floats(-0.05, 0.05))
def test_current_and_acceleration_are_inverse(angle: float, rate: float, acceleration: float) -> None:
    current = THREAD.current(angle, rate, acceleration)
    assert THREAD.acceleration(angle, rate, current) == pytest.approx(acceleration, abs=1e-14)
    arrays = [np.array([value]) for value in (angle, rate, acceleration)]
    assert THREAD.currents(*arrays)[0] == pytest.approx(current, rel=1e-12, abs=1e-15)


def test_full_current_accelerates_the_knightcube_by_torque_divided_by_inertia() -> None:
    """The full current accelerates a KnightCube by 4.3157e-5 N m / 1.05e-3 kg m^2 = 0.041102 rad/s^2.

    The torque is 80 x 0.0081 m^2 x 4.5e-4 T x 0.148 A.
    """
    assert KNIGHTCUBE.acceleration(0.0, 0.0, 0.148) == pytest.approx(0.041102, rel=1e-4)
    assert KNIGHTCUBE.acceleration(math.pi / 3, 0.0, 0.148) == pytest.approx(0.020551, rel=1e-4)


def test_the_thread_pulls_back_and_damps() -> None:
    assert THREAD.acceleration(0.5, 0.0, 0.0) < 0.0 < THREAD.acceleration(-0.5, 0.0, 0.0)
    assert THREAD.acceleration(0.0, 0.1, 0.0) < 0.0


@given(ANGLE, RATE)
def test_q2_and_angle_are_two_names_of_one_motion(angle: float, rate: float) -> None:
    q2 = q2_of(angle)
    assert angle_of(q2) == pytest.approx(angle, abs=1e-14)
    assert rate_of(q2, q2_rate_of(q2, rate)) == pytest.approx(rate, abs=1e-14)


def test_the_acceleration_of_q2_is_the_derivative_of_the_rate() -> None:
    """The acceleration of q2 (5.9) agrees with central differences along q2 = 0.5 sin(0.3 t)."""
    step = 1e-5

    def rate_at(time: float) -> float:
        return rate_of(0.5 * math.sin(0.3 * time), 0.15 * math.cos(0.3 * time))

    for time in (0.3, 2.0, 4.7, 9.1):
        sine, cosine = math.sin(0.3 * time), math.cos(0.3 * time)
        exact = acceleration_of(0.5 * sine, 0.15 * cosine, -0.045 * sine)
        assert exact == pytest.approx((rate_at(time + step) - rate_at(time - step)) / (2 * step), abs=1e-9)


def test_the_slopes_of_the_current_are_its_derivatives() -> None:
    rng = np.random.default_rng(1)
    arguments = [rng.uniform(-0.65, 0.65, 50), rng.normal(0, 0.1, 50), rng.normal(0, 0.02, 50)]
    current, *slopes = current_and_slopes(THREAD, *arguments)
    assert np.isfinite(current).all()
    for position, slope in enumerate(slopes):
        step = np.zeros(3)
        step[position] = 1e-6
        above, *_ = current_and_slopes(THREAD, *(a + s for a, s in zip(arguments, step, strict=True)))
        below, *_ = current_and_slopes(THREAD, *(a - s for a, s in zip(arguments, step, strict=True)))
        np.testing.assert_allclose(slope, (above - below) / 2e-6, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("name", ["inertia", "torque_constant", "resistance", "current_limit", "stiffness"])
@pytest.mark.parametrize("value", [float("nan"), -1.0, float("inf")])
def test_impossible_constants_are_refused_by_name(name: str, value: float) -> None:
    numbers = {
        "inertia": 1e-3,
        "torque_constant": 3e-4,
        "resistance": 23.0,
        "current_limit": 0.1,
        name: value,
    }
    with pytest.raises(UsageError, match=name):
        SingleAxisPlant(**numbers)


def test_a_path_gives_the_same_motion_one_by_one_and_all_at_once() -> None:
    path = PolynomialPath.through(np.array([0.1, 0.12, 0.2, 0.3, 0.28, 0.25, 0.2, 0.21]), 9.0, 5_000)
    times = np.linspace(0.0, 12.0, 49)
    together = np.array(path.motion(times))
    for time, column in zip(times.tolist(), together.T, strict=True):
        sample = path.sample(5_000 + round(time * 1e9))
        np.testing.assert_allclose([sample.angle, sample.rate, sample.acceleration], column, atol=1e-8)


def test_a_path_holds_its_start_before_and_its_end_at_rest_after() -> None:
    path = PolynomialPath.through(np.linspace(0.0, 0.3, 8), 4.0, 1_000_000_000)
    assert path.sample(0) == path.sample(1_000_000_000)
    assert path.sample(0).rate > 0.0
    after = path.sample(6_000_000_000)
    assert (after.angle, after.rate, after.acceleration) == (angle_of(0.3), 0.0, 0.0)
    assert path.has_ended(5_000_000_000)
    assert not path.has_ended(4_999_999_999)
    held = PolynomialPath.holding(0.7, 3).sample(10)
    assert (held.angle, held.rate, held.acceleration) == (0.7, 0.0, 0.0)
