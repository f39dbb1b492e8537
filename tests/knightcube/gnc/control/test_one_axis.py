"""Tests of the single-axis control laws on artificial motions, and of the integrated excitation."""

from __future__ import annotations

import math

import numpy as np
import pytest

from knightcube.errors import UsageError
from knightcube.gnc.control.one_axis import (
    CurrentCommand,
    ExcitationController,
    ExcitationSettings,
    LqTracker,
    lq_gains,
    manoeuvres,
)
from knightcube.gnc.guidance.plant import PathSample, SingleAxisPlant, angle_of

PLANT = SingleAxisPlant(1.05e-3, 2.916e-4, 23.0, 0.148)
STRENGTH = 2.916e-4 * 0.148 / 1.05e-3
PERIOD = 0.025


def torque_current(angle: float, acceleration: float) -> float:
    """Return the current (A) whose torque accelerates the body by w': I = J w' / (k cos theta)."""
    return 1.05e-3 * acceleration / (2.916e-4 * math.cos(angle))


def test_the_gains_solve_the_riccati_equation_of_the_double_integrator() -> None:
    weight, cost = 7.0, 2.0
    rate_gain, error_gain = lq_gains(weight, cost)
    # The state is (e', e). P solves A' P + P A - P B R^-1 B' P + Q = 0 with Q = weight I, and K = R^-1 B' P.
    matrix, entry = np.array([[0.0, 0.0], [1.0, 0.0]]), np.array([[1.0], [0.0]])
    other = rate_gain * error_gain * cost
    solution = np.array([[rate_gain * cost, error_gain * cost], [error_gain * cost, other]])
    rest = matrix.T @ solution + solution @ matrix - solution @ entry @ entry.T @ solution / cost
    assert rest == pytest.approx(-weight * np.eye(2), abs=1e-9)


def test_a_command_is_limited_to_the_coil() -> None:
    inside = CurrentCommand.within(0.1, 0.09, 0.2)
    assert (inside.current, inside.saturated, inside.held, inside.authority) == (0.09, False, False, True)
    assert CurrentCommand.within(0.1, 0.11, 0.2, True) == CurrentCommand(0.1, 0.11, True, True, 0.2, True)
    assert CurrentCommand.within(0.1, -0.11, 0.2).current == -0.1
    none = CurrentCommand.without_authority(0.3)
    assert (none.current, none.demanded, none.authority, none.held, none.error) == (
        0.0,
        0.0,
        False,
        False,
        0.3,
    )


def test_the_thesis_law_makes_the_sine_of_the_error_a_damped_oscillator() -> None:
    """The thesis's law makes e = sin(theta_p - theta) a damped oscillator, e'' = -K_e' e' - K_e e.

    By the plant model, e'' = cos * (w_p' - w') - sin * (w_p - w)^2.
    """
    tracker = LqTracker(PLANT, 20.0, 1.0, as_in_thesis=True)
    wanted, angle, rate = PathSample(0.30, 0.02, 0.004), 0.27, 0.035
    current = tracker.command(wanted, angle, rate).demanded
    acceleration = PLANT.acceleration(angle, rate, current)
    error, lag = wanted.angle - angle, wanted.rate - rate
    second = math.cos(error) * (wanted.acceleration - acceleration) - math.sin(error) * lag**2
    expected = -tracker.rate_gain * math.cos(error) * lag - tracker.error_gain * math.sin(error)
    assert second == pytest.approx(expected, rel=1e-9)


def test_near_the_path_the_law_is_that_of_the_thesis_with_the_disturbance_subtracted() -> None:
    wanted = PathSample(0.3, 0.01, 0.002)
    thesis = LqTracker(PLANT, 20.0, 1.0, as_in_thesis=True).command(wanted, 0.299, 0.011)
    plain = LqTracker(PLANT, 20.0, 1.0).command(wanted, 0.299, 0.011)
    pushed = LqTracker(PLANT, 20.0, 1.0).command(wanted, 0.299, 0.011, 0.005)
    assert plain.demanded == pytest.approx(thesis.demanded, rel=1e-9)
    assert pushed.demanded - plain.demanded == pytest.approx(torque_current(0.299, -0.005), rel=1e-9)
    assert not plain.held


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_large_error_is_approached_no_faster_than_the_coil_brakes(sign: float) -> None:
    """A large error e is reduced at most at the rate sqrt(2 a e - r^2), at which no torque is demanded.

    The acceleration a is 0.8 of the acceleration by the available torque, and r = a K_e' / K_e.
    """
    tracker = LqTracker(PLANT, 20.0, 1.0)
    error = 0.5
    braking = 0.8 * STRENGTH * math.cos(error)
    reach = braking * tracker.rate_gain / tracker.error_gain
    rate = math.sqrt(2.0 * braking * math.sin(error) - reach**2) / math.cos(error)
    wanted = PathSample(sign * error, 0.0, 0.0)
    demanded = tracker.command(wanted, 0.0, sign * rate).demanded
    # The demanded torque is only that of the curvature of the sine.
    curvature = -sign * math.sin(error) * rate**2 / math.cos(error)
    assert demanded == pytest.approx(torque_current(0.0, curvature), rel=1e-6)


def test_a_disturbance_reduces_the_braking_down_to_a_twentieth_of_the_torque() -> None:
    """A larger disturbance slows the approach to the target, down to a minimum rate.

    The minimum is the rate at which a twentieth of the torque can stop the body.
    """
    tracker, wanted = LqTracker(PLANT, 20.0, 1.0), PathSample(0.5, 0.0, 0.0)

    def wish(disturbance: float) -> float:
        """Return the demanded acceleration without the compensation of the disturbance."""
        current = tracker.command(wanted, 0.0, 0.0, disturbance).demanded
        return PLANT.acceleration(0.0, 0.0, current) + disturbance

    assert wish(0.0) > wish(0.3 * STRENGTH) > wish(0.6 * STRENGTH) > wish(0.66 * STRENGTH)
    assert wish(0.75 * STRENGTH) == pytest.approx(wish(0.9 * STRENGTH))
    least = 0.05 * STRENGTH
    reach = least * tracker.rate_gain / tracker.error_gain
    slowest = math.sqrt(2.0 * least * math.sin(0.5) - reach**2)
    assert wish(0.9 * STRENGTH) == pytest.approx(tracker.rate_gain * slowest / math.cos(0.5))


@pytest.mark.parametrize(
    ("angle", "authority"), [(1.519, True), (1.522, False), (-1.519, True), (-1.522, False)]
)
def test_beyond_87_degrees_no_current_turns_the_body(angle: float, authority: bool) -> None:
    """Beyond 87 deg no current is commanded, because the torque falls below 0.05 of its maximum.

    The angle of 87 deg is 1.5208 rad, and its cosine is 0.05.
    """
    command = LqTracker(PLANT, 20.0, 1.0).command(PathSample(0.0, 0.0, 0.0), angle, 0.0)
    assert command.authority is authority
    assert (command.current != 0.0) is authority


@pytest.mark.parametrize(("error", "is_held"), [(0.99, False), (1.01, True), (2.5, True), (-2.5, True)])
def test_an_error_beyond_one_radian_is_treated_as_one_radian(error: float, is_held: bool) -> None:
    tracker = LqTracker(PLANT, 20.0, 1.0, as_in_thesis=True)
    command = tracker.command(PathSample(error, 0.0, 0.0), 0.0, 0.0)
    assert command.held is is_held
    assert command.error == pytest.approx(error)
    if is_held:
        edge = math.copysign(tracker.error_gain * math.tan(1.0), error)
        assert command.demanded == pytest.approx(torque_current(0.0, edge))


@pytest.mark.parametrize("strength", [0.02, 0.4])
def test_each_manoeuvre_ends_at_rest_and_turns_the_body_by_no_more_than_its_reach(strength: float) -> None:
    """Each manoeuvre ends at rest and stays within its stated reach. The motion is integrated exactly."""
    made = manoeuvres(strength, 0.2, 3.0)
    assert len(made) == 4
    extremes = []
    for manoeuvre in made:
        angle = rate = 0.0
        angles = [0.0]
        for pulse in manoeuvre:
            acceleration, half = pulse.share * strength, 0.5 * pulse.duration
            for _ in range(2):
                angle += rate * half + 0.5 * acceleration * half**2
                rate += acceleration * half
                angles.append(angle)
        assert rate == pytest.approx(0.0, abs=1e-9)
        assert max(np.abs(angles)) < 0.2 + 1e-9
        extremes.append((min(angles), max(angles), angle))
    # A free swing begins at its largest angle, and a double pulse returns to its start.
    assert extremes[1][2] == pytest.approx(0.2)
    assert extremes[3][2] == pytest.approx(-0.2)
    assert extremes[0][2] == pytest.approx(0.0, abs=1e-9)
    assert extremes[0][1] == pytest.approx(0.75**2 * 0.2)
    assert made[1][2].duration == made[3][2].duration == 3.0
    assert made[1][2].share == 0.0
    # The opposite pulse lasts at most one second.
    short = made[0][3].duration
    assert short == pytest.approx(min(1.0, 0.5 * math.sqrt(0.2 / strength)))
    assert made[2][0].share == -made[0][0].share


SETTINGS = ExcitationSettings(current_share=0.5, largest_q2=0.2, swing=2.0)
REST = PathSample(0.0, 0.0, 0.0)


def cycles(controller: ExcitationController, count: int, angle: float, rate: float) -> list[CurrentCommand]:
    return [controller.command(REST, angle, rate) for _ in range(count)]


@pytest.mark.parametrize(
    ("angle", "rate", "moves"),
    [
        (0.029, 0.0, True),
        (0.031, 0.0, False),
        (0.0, 3.9e-3, True),
        (0.0, -4.1e-3, False),
        (-0.031, 0.0, False),
    ],
)
def test_a_manoeuvre_begins_after_a_second_at_rest(angle: float, rate: float, moves: bool) -> None:
    controller = ExcitationController(PLANT, PERIOD, SETTINGS)
    cycles(controller, 41, angle, rate)
    # A pulse demands half of the current limit. Without a pulse, the tracker commands the current.
    pulses = {round(abs(one.demanded), 9) for one in cycles(controller, 20, angle, rate)}
    assert (pulses == {0.074}) is moves


def test_a_body_that_does_not_come_to_rest_is_given_up_after_a_minute() -> None:
    controller = ExcitationController(PLANT, PERIOD, SETTINGS)
    states = []
    for count in (2395, 10):
        cycles(controller, count, 0.0, 0.05)
        states.append(controller.gave_up)
    assert states == [False, True]
    command = controller.command(REST, 0.1, 0.0)
    assert (command.current, command.authority) == (0.0, False)


def test_a_pulse_ends_where_the_body_could_not_be_stopped_within_the_bound() -> None:
    """A pulse ends if the stopping distance w^2 / (2 a), with 0.7 of the torque, would exceed the bound."""
    bound = angle_of(0.2)
    braking = 0.7 * 0.5 * STRENGTH * math.cos(0.3)
    limit = math.sqrt(2.0 * braking * (bound - 0.3))
    for rate, allowed in ((0.98 * limit, True), (1.02 * limit, False), (-3.0 * limit, True)):
        for side in (1.0, -1.0):
            controller = ExcitationController(PLANT, PERIOD, SETTINGS)
            cycles(controller, 42, 0.0, 0.0)
            command = controller.command(REST, side * 0.3, side * rate)
            assert (abs(command.current) == pytest.approx(0.074) and command.demanded == 0.074) is allowed


def test_a_reset_skips_the_manoeuvre_that_was_under_way() -> None:
    controller = ExcitationController(PLANT, PERIOD, SETTINGS)
    assert cycles(controller, 45, 0.0, 0.0)[-1].current == pytest.approx(0.074)
    controller.reset()
    assert controller.command(REST, 0.0, 0.0).current == pytest.approx(0.0)
    # The second manoeuvre consists of a pulse, an opposite pulse and a free swing.
    swing = [one.current for one in cycles(controller, 1000, 0.0, 0.0)]
    zeros = sum(1 for one in swing[41:] if one == 0.0)
    assert zeros >= round(2.0 / PERIOD)


@pytest.mark.parametrize(
    ("period", "share", "largest", "message"),
    [
        (0.0, 0.5, 0.2, "period is 0"),
        (math.inf, 0.5, 0.2, "period is inf"),
        (PERIOD, 0.0, 0.2, "current_share"),
        (PERIOD, 1.01, 0.2, "current_share"),
        (PERIOD, 0.5, 0.0, "largest_q2"),
        (PERIOD, 0.5, 0.51, "largest_q2"),
    ],
)
def test_an_impossible_excitation_is_refused(
    period: float, share: float, largest: float, message: str
) -> None:
    with pytest.raises(UsageError, match=message):
        ExcitationController(PLANT, period, ExcitationSettings(share, largest, 2.0))
    ExcitationController(PLANT, PERIOD, ExcitationSettings(1.0, 0.5, 2.0))


@pytest.mark.parametrize(
    "wrong", [{"largest_error": 1.58}, {"largest_error": 0.0}, {"minimum_authority": 1.0}]
)
def test_an_impossible_tracker_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(UsageError, match=next(iter(wrong))):
        LqTracker(PLANT, 20.0, 1.0, **wrong)  # type: ignore[arg-type]  # floats only
    for weights in ((0.0, 1.0), (1.0, math.inf)):
        with pytest.raises(UsageError, match="finite and positive"):
            LqTracker(PLANT, *weights)
