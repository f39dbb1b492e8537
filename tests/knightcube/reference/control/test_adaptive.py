"""The adaptive controller: its reference model, what it learns, and what it must not learn."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from knightcube.errors import UsageError
from knightcube.gnc.guidance.one_axis.path import PathSample
from knightcube.reference.control import AdaptiveController, AdaptiveSettings
from tests.knightcube.gnc.control.closed_loop import BELIEVED, PERIOD, fly, held, largest_error

SETTINGS = AdaptiveSettings(bandwidth=1.0, adaptation=10.0, reference_bandwidth=0.5)


def test_with_the_plant_known_the_body_follows_the_reference_model() -> None:
    """The angle is 1 - (1 + wt) exp(-wt) for a critically damped model of second order."""
    rows = fly(AdaptiveController(BELIEVED, PERIOD, SETTINGS), BELIEVED, held(0.1), 20.0, noise=0.0)
    x = 0.5 * rows[:, 0]
    np.testing.assert_allclose(rows[:, 1], 0.1 * (1.0 - (1.0 + x) * np.exp(-x)), atol=3e-3)


def test_an_unknown_torque_is_learnt_and_the_offset_goes() -> None:
    """The same controller whose parameters stay keeps most of d / (g l), 0.23 deg."""
    pushed = replace(BELIEVED, disturbance=4e-3)
    learning, fixed = (
        fly(AdaptiveController(BELIEVED, PERIOD, settings), pushed, held(0.1), 80.0)
        for settings in (SETTINGS, replace(SETTINGS, adaptation=1e-9))
    )
    assert largest_error(learning, 0.1, 20.0) < 0.12
    assert largest_error(fixed, 0.1, 20.0) == pytest.approx(math.degrees(4e-3), abs=0.05)


def test_nothing_is_learnt_while_the_coil_is_at_its_limit_nor_from_noise() -> None:
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
def test_impossible_settings_are_refused_by_name(name: str) -> None:
    for value in (0.0, -1.0, math.nan):
        with pytest.raises(UsageError, match=name):
            replace(SETTINGS, **{name: value})
    with pytest.raises(UsageError, match="period"):
        AdaptiveController(BELIEVED, 0.0, SETTINGS)
