"""Tests of the step results of Table 5.3, for signals whose results have a closed form."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq

from ground.report.steps import StepCommand, commanded_steps, flown_steps, is_interrupted, response
from knightcube.astro.arrays import FloatArray
from tests.ground.report.synthetic import second_order

STEP = StepCommand(index=1, time=100.0, start=-0.3, target=-0.2, duration=100.0)
TIME: FloatArray = np.arange(90.0, 210.0, 0.025)


def step_of(command: StepCommand, progress: FloatArray) -> FloatArray:
    return command.start + (command.target - command.start) * progress


@pytest.mark.parametrize("damping", [0.3, 0.5, 0.7])
@pytest.mark.parametrize("frequency", [0.4, 1.0])
def test_a_second_order_step_has_its_textbook_figures(damping: float, frequency: float) -> None:
    """The overshoot of a second-order step is exp(-pi z/sqrt(1 - z^2)).

    Rise time and settling time follow from the exact response.
    """
    since = np.maximum(TIME - STEP.time, 0.0)
    found = response(TIME, step_of(STEP, second_order(since, damping, frequency)), STEP)

    def exact(t: float) -> float:
        return float(second_order(np.array([t]), damping, frequency)[0])

    root = math.sqrt(1.0 - damping**2)
    peak = math.pi / (frequency * root)
    rise = brentq(lambda t: exact(t) - 0.9, 0.0, peak) - brentq(lambda t: exact(t) - 0.1, 0.0, peak)
    fine = np.linspace(0.0, 60.0 / frequency, 2_000_001)
    outside = np.abs(second_order(fine, damping, frequency) - 1.0) > 0.05
    settling = fine[np.flatnonzero(outside)[-1]]

    assert found.overshoot_percent == pytest.approx(100.0 * math.exp(-math.pi * damping / root), abs=0.02)
    assert found.rise_s == pytest.approx(rise, abs=2e-3)
    assert found.settling_s == pytest.approx(settling, abs=2e-3)


def test_a_first_order_rise_is_the_logarithm_of_nine() -> None:
    lag = 3.0
    found = response(TIME, step_of(STEP, 1.0 - np.exp(-np.maximum(TIME - 100.0, 0.0) / lag)), STEP)
    assert found.rise_s == pytest.approx(lag * math.log(9.0), abs=1e-3)
    assert found.settling_s == pytest.approx(lag * math.log(20.0), abs=1e-3)
    assert found.overshoot_percent == 0.0


def test_a_falling_step_is_judged_like_a_rising_one() -> None:
    down = StepCommand(0, 100.0, 0.2, -0.3, 100.0)
    since = np.maximum(TIME - 100.0, 0.0)
    rising, falling = (response(TIME, step_of(c, second_order(since, 0.4, 0.5)), c) for c in (STEP, down))
    assert falling.overshoot_percent == pytest.approx(rising.overshoot_percent, rel=1e-9)
    assert falling.rise_s == pytest.approx(rising.rise_s, rel=1e-9)
    assert falling.settling_s == pytest.approx(rising.settling_s, rel=1e-9)


def test_the_steady_state_is_the_largest_error_of_the_last_30_s_in_degrees_of_theta() -> None:
    theta = math.degrees(2.0 * math.asin(-0.2))
    error = np.where(TIME < 169.9, 9.0, 0.5)  # the last 30 s of the step begin at 170 s
    error[np.searchsorted(TIME, 185.0)] = -1.25
    q2 = np.sin(np.radians(theta + error) / 2.0)
    assert response(TIME, q2, STEP).steady_state_deg == pytest.approx(1.25, abs=1e-9)


def test_motion_after_the_next_command_does_not_count() -> None:
    q2 = np.where(TIME < 200.0, -0.2, 0.5)
    found = response(TIME, q2, STEP)
    assert found.steady_state_deg == 0.0
    assert found.overshoot_percent == 0.0


def test_a_response_that_never_arrives_has_no_rise_and_no_settling_time() -> None:
    found = response(TIME, np.full_like(TIME, -0.25), STEP)
    assert math.isinf(found.rise_s)
    assert math.isinf(found.settling_s)
    assert found.overshoot_percent == 0.0
    stuck = response(TIME, np.full_like(TIME, -0.3), STEP)
    assert math.isinf(stuck.rise_s)


def test_one_excursion_late_in_the_step_is_the_settling_time() -> None:
    progress = np.where(TIME < 100.0, 0.0, 1.0)
    progress[(TIME > 180.0) & (TIME < 181.0)] = 1.06
    assert response(TIME, step_of(STEP, progress), STEP).settling_s == pytest.approx(81.0, abs=0.03)


def test_a_step_of_no_size_has_only_a_steady_state() -> None:
    none = StepCommand(2, 100.0, -0.2, -0.2, 100.0)
    found = response(TIME, np.full_like(TIME, -0.21), none)
    assert math.isnan(found.rise_s)
    assert math.isnan(found.settling_s)
    assert math.isnan(found.overshoot_percent)
    assert found.steady_state_deg == pytest.approx(
        math.degrees(2 * (math.asin(0.21) - math.asin(0.2))), abs=1e-9
    )


def test_steps_run_from_target_to_target_and_the_first_from_the_release() -> None:
    listed = commanded_steps([3, 4], np.array([0.0, 100.0]), np.array([-0.3, -0.2]), 0.2, 180.0)
    assert listed == [StepCommand(3, 0.0, 0.2, -0.3, 100.0), StepCommand(4, 100.0, -0.3, -0.2, 80.0)]


def test_a_step_begins_where_the_body_was_unless_the_body_held_the_target_before() -> None:
    """A step begins at the body's attitude, or at the previous target if the body has held it.

    The second target is commanded when the body is half way to the first target. A mode change ends the third
    step.
    """
    listed = commanded_steps([0, 1, 1], np.array([0.0, 2.0, 60.0]), np.array([0.2, 0.4, -0.2]), 0.0, 100.0)
    time = np.arange(0.0, 100.0, 0.1)
    q2 = np.where(time < 2.0, 0.05 * time, 0.4)
    met = flown_steps(listed, time, q2, np.array([70.0]))
    assert [step.start for step in met] == pytest.approx([0.0, 0.4, 0.4], abs=1e-9)
    assert [step.duration for step in met] == [2.0, 58.0, 10.0]
    assert [step.again for step in met] == [False, False, True]
    assert [step.from_target for step in met] == [False, False, True], "0.2 was never held, 0.4 was"
    assert is_interrupted(met[0], response(time, q2, met[0]))
    assert not is_interrupted(replace(met[0], duration=60.0), response(time, q2, met[0])), "it had its time"
