"""Tests of PID and adaptive controller: poles, reference model, start, saturation, refusals."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from knightcube.errors import UsageError
from knightcube.gnc.guidance.plant import PathSample
from knightcube.reference.control import AdaptiveController, AdaptiveSettings, PidController, PidSettings
from tests.support.thread_loop import BELIEVED, PERIOD, fly, held, largest_error

SETTINGS = AdaptiveSettings(bandwidth=1.0, adaptation=10.0, reference_bandwidth=0.5)


def test_with_the_plant_known_the_body_follows_the_reference_model() -> None:
    """With known plant parameters, the angle follows the reference model, 1 - (1 + wt) exp(-wt).

    The reference model is critically damped and of second order.
    """
    rows = fly(AdaptiveController(BELIEVED, PERIOD, SETTINGS), BELIEVED, held(0.1), 20.0, noise=0.0)
    x = 0.5 * rows[:, 0]
    np.testing.assert_allclose(rows[:, 1], 0.1 * (1.0 - (1.0 + x) * np.exp(-x)), atol=3e-3)


def test_an_unknown_torque_is_learnt_and_the_offset_goes() -> None:
    """By adaptation, the offset of an unknown torque disappears.

    With constant parameters, the adaptive controller keeps most of the offset d / (g l) of 0.23 deg.
    """
    pushed = replace(BELIEVED, disturbance=4e-3)
    learning, fixed = (
        fly(AdaptiveController(BELIEVED, PERIOD, settings), pushed, held(0.1), 80.0)
        for settings in (SETTINGS, replace(SETTINGS, adaptation=1e-9))
    )
    assert largest_error(learning, 0.1, 20.0) < 0.12
    assert largest_error(fixed, 0.1, 20.0) == pytest.approx(math.degrees(4e-3), abs=0.05)


def test_no_parameter_is_adapted_while_the_coil_is_at_its_limit_or_by_noise() -> None:
    controller = AdaptiveController(BELIEVED, PERIOD, replace(SETTINGS, reference_bandwidth=None))
    before = controller.parameters.copy()
    assert controller.command(PathSample(1.0, 0.0, 0.0), 0.0, 0.0).saturated
    np.testing.assert_array_equal(controller.parameters, before)
    controller.command(PathSample(5e-4, 0.0, 0.0), 0.0, 0.0)
    np.testing.assert_array_equal(controller.parameters, before)
    controller.command(PathSample(5e-3, 0.0, 0.0), 0.0, 0.0)
    assert np.abs(controller.parameters - before).max() > 0.0


def test_parameters_stay_within_what_a_body_can_have() -> None:
    controller = AdaptiveController(BELIEVED, PERIOD, replace(SETTINGS, adaptation=1e6))
    rng = np.random.default_rng(3)
    for _ in range(2000):
        at, rate = rng.uniform(-0.5, 0.5), rng.uniform(-0.1, 0.1)
        made = controller.command(PathSample(float(rng.uniform(-0.5, 0.5)), 0.0, 0.0), float(at), float(rate))
        assert abs(made.current) <= BELIEVED.current_limit
    inertia = BELIEVED.inertia / BELIEVED.torque_constant
    assert 0.5 * inertia <= controller.parameters[0] <= 1.5 * inertia
    assert (controller.parameters[1:3] >= 0.0).all()


@pytest.mark.parametrize("name", ["bandwidth", "adaptation", "reference_bandwidth", "dead_zone"])
def test_impossible_adaptive_settings_are_refused_by_name(name: str) -> None:
    for value in (0.0, -1.0, math.nan):
        with pytest.raises(UsageError, match=name):
            replace(SETTINGS, **{name: value})
    with pytest.raises(UsageError, match="period"):
        AdaptiveController(BELIEVED, 0.0, SETTINGS)


def placed(bandwidth: float) -> PidController:
    """Return a controller with three poles at -`bandwidth` and b = 0."""
    return PidController(BELIEVED, PERIOD, PidSettings.placed(bandwidth), 0.0)


def test_a_small_step_is_the_response_of_three_equal_poles() -> None:
    """The response to a small step is the response of three equal poles, 1 - (1 + wt + (wt)^2/2) exp(-wt).

    With b = 0, the target acts only through the integral.
    """
    w, size = 0.8, 0.02
    rows = fly(placed(w), BELIEVED, held(size), 15.0, noise=0.0)
    x = w * rows[:, 0]
    expected = size * (1.0 - (1.0 + x + 0.5 * x * x) * np.exp(-x))
    np.testing.assert_allclose(rows[:, 1], expected, atol=0.03 * size)


def test_the_start_of_the_controller_at_rest_commands_no_current() -> None:
    command = placed(0.8).command(PathSample(0.4, 0.0, 0.0), 0.4, 0.0)
    assert command.current == pytest.approx(0.0, abs=1e-12)
    first = placed(0.8).command(PathSample(0.5, 0.0, 0.0), 0.4, 0.0)
    assert 0.0 < first.current < 1e-2, "a step of the target does not kick the coil"


def test_the_integral_waits_while_the_limit_is_in_force_and_goes_on_after() -> None:
    controller = PidController(BELIEVED, PERIOD, PidSettings.placed(2.0), target_weight=1.0)
    pushed = [controller.command(PathSample(1.0, 0.0, 0.0), 0.0, 0.0) for _ in range(400)]
    assert all(command.saturated for command in pushed)
    assert pushed[-1].demanded == pytest.approx(pushed[0].demanded)
    back = controller.command(PathSample(0.0, 0.0, 0.0), 0.0, 0.0)
    assert not back.saturated


def test_a_reset_forgets_the_integral() -> None:
    controller = placed(0.8)
    first = controller.command(PathSample(0.1, 0.0, 0.0), 0.0, 0.0)
    for _ in range(40):
        last = controller.command(PathSample(0.1, 0.0, 0.0), 0.0, 0.0)
    assert last.demanded > 2.0 * first.demanded
    controller.reset()
    assert controller.command(PathSample(0.1, 0.0, 0.0), 0.0, 0.0) == first


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        ((0.0, 1.0, 0.0), "period"),
        ((0.025, math.nan, 0.0), "proportional"),
        ((0.025, 1.0, 1.5), "target_weight"),
    ],
)
def test_impossible_pid_settings_are_refused_by_name(
    arguments: tuple[float, float, float], name: str
) -> None:
    period, bandwidth, weight = arguments
    with pytest.raises(UsageError, match=name):
        PidController(BELIEVED, period, PidSettings.placed(bandwidth), weight)


def test_an_input_that_is_not_finite_is_refused() -> None:
    with pytest.raises(UsageError, match="not finite"):
        placed(1.0).command(PathSample(0.1, 0.0, 0.0), math.nan, 0.0)


@pytest.mark.parametrize(("cosine", "commands"), [(0.06, True), (-0.06, True), (0.04, False), (-0.04, False)])
def test_no_current_is_commanded_where_the_field_gives_no_torque(cosine: float, commands: bool) -> None:
    controller = AdaptiveController(BELIEVED, PERIOD, replace(SETTINGS, reference_bandwidth=None))
    angle = math.acos(cosine)
    made = controller.command(held(angle + 0.1)(0.0), angle, 0.0, 0.0)
    assert (made.current != 0.0) is commands
