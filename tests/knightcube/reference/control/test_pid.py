"""The PID controller: its poles, its bumpless start, its integral under saturation."""

from __future__ import annotations

import math

import numpy as np
import pytest

from knightcube.errors import UsageError
from knightcube.gnc.guidance.one_axis.path import PathSample
from knightcube.reference.control import PidController, PidSettings
from tests.knightcube.gnc.control.closed_loop import BELIEVED, PERIOD, fly, held


def placed(bandwidth: float) -> PidController:
    """Return a controller with three poles at -`bandwidth` and b = 0."""
    return PidController(BELIEVED, PERIOD, PidSettings.placed(bandwidth), 0.0)


def test_a_small_step_is_the_response_of_three_equal_poles() -> None:
    """With b = 0 the target enters by the integral alone: theta = 1 - (1 + wt + (wt)^2/2) exp(-wt)."""
    w, size = 0.8, 0.02
    rows = fly(placed(w), BELIEVED, held(size), 15.0, noise=0.0)
    x = w * rows[:, 0]
    expected = size * (1.0 - (1.0 + x + 0.5 * x * x) * np.exp(-x))
    np.testing.assert_allclose(rows[:, 1], expected, atol=0.03 * size)


def test_taking_over_at_rest_asks_for_no_current() -> None:
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
def test_impossible_settings_are_refused_by_name(arguments: tuple[float, float, float], name: str) -> None:
    period, bandwidth, weight = arguments
    with pytest.raises(UsageError, match=name):
        PidController(BELIEVED, period, PidSettings.placed(bandwidth), weight)


def test_an_input_that_is_not_finite_is_refused() -> None:
    with pytest.raises(UsageError, match="not finite"):
        placed(1.0).command(PathSample(0.1, 0.0, 0.0), math.nan, 0.0)
