"""Tests of guidance: slews with a goal time, with a cost of time or to a moving target, and steps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flight.schema import reader as configuration
from flight.schema.bodies import Step, TestbedConfig
from ground.telemetry import Run
from knightcube.astro.arrays import FloatArray
from knightcube.gnc.guidance.plant import angle_of
from tests.scenario.mode_flights import released
from tests.support.flights import Rigged, demo_config, event_names, fly, thesis_config


def configured(duration: float, steps: tuple[Step, ...], **guidance: Any) -> TestbedConfig:
    """Return the demonstration with the given steps and guidance, without a camera."""
    config = configuration.replace(demo_config(duration, camera=False), steps=steps)
    return configuration.replace(config, guidance=configuration.replace(config.guidance, **guidance))


def true_angle(run: Run) -> tuple[FloatArray, FloatArray]:
    """Return mission times (n,), s, and true rotation angles (n,), rad, about the suspension thread."""
    truth = run["truth"]
    return truth["time_ns"] * 1e-9, 2.0 * np.arcsin(truth["quaternion"][:, 1])


def test_towards_a_goal_the_horizon_shrinks_and_then_each_plan_holds_the_target(tmp_path: Path) -> None:
    run = fly(demo_config(17.0, camera=False), tmp_path)
    plans = run["plan"]
    assert plans["horizon"] == pytest.approx([10.0, 5.0, 5.0, 5.0], abs=0.03)
    assert plans["accepted"].all()
    assert plans["cost"][1] < plans["cost"][0]
    np.testing.assert_allclose(plans["start_q2"][2:], -0.3, atol=1e-9)
    assert event_names(run) == ["started", "target", "stopped"]
    time, angle = true_angle(run)
    assert np.degrees(np.abs(angle[time > 12.0] - angle_of(-0.3))).max() < 0.1


def test_as_in_the_thesis_the_horizon_recedes(tmp_path: Path) -> None:
    run = fly(thesis_config(12.0), tmp_path)
    assert run["plan"]["horizon"].tolist() == [10.0] * 3
    assert run["plan"]["accepted"].all()
    assert event_names(run) == ["started", "target", "stopped"]


def test_a_cost_of_time_determines_the_goal_time_which_later_plans_keep(tmp_path: Path) -> None:
    """A cost of time determines the goal time, which later plans keep.

    If the cost is doubled, the duration of the slew decreases by a factor of 2^(1/4). The first plan
    determines the goal time.
    """
    steps = (Step(at=0.0, q2=0.2), Step(at=4.0, q2=0.1))
    horizons = []
    for price in (0.04, 0.08):
        config = configured(12.0, steps, time_price=price, replan_period=2.0)
        plans = fly(config, tmp_path / str(price), section=released(0.2, 0.0))["plan"]
        second = plans[plans["target_q2"] == 0.1]
        begins = second["origin_ns"] * 1e-9
        goals = (begins + second["horizon"])[begins < begins[0] + second["horizon"][0] - 0.5]
        assert len(goals) >= 3
        np.testing.assert_allclose(goals, goals[0], atol=1e-6)
        horizons.append(second["horizon"][0])
    assert horizons[0] / horizons[1] == pytest.approx(2.0**0.25, rel=0.05)


def test_a_moving_target_is_met_at_its_rate_and_followed(tmp_path: Path) -> None:
    run = fly(configured(26.0, (Step(at=0.0, q2=-0.2, rate=0.008),)), tmp_path)
    time, angle = true_angle(run)
    wanted = angle_of(-0.2) + 0.008 * (time - 10.0)
    assert np.degrees(np.abs(angle - wanted)[time > 12.0]).max() < 0.1
    assert "holding" not in event_names(run)


def test_a_body_that_is_pushed_off_its_hold_is_planned_for_again(tmp_path: Path) -> None:
    def push(rigged: Rigged) -> None:
        world = rigged.testbed

        def kick() -> None:
            world.rate += 0.25

        rigged.at(4.0, kick)

    run = fly(demo_config(26.0, camera=False), tmp_path, push, section=released(-0.3, 0.0))
    plans = run["plan"]
    late = plans[plans["origin_ns"] > 4e9]
    assert len(late) >= 1
    assert late["accepted"].any()
    time, angle = true_angle(run)
    assert np.degrees(np.abs(angle - angle_of(-0.3))[time > 4.0].max()) > 5.0
    assert np.degrees(np.abs(angle - angle_of(-0.3))[time > 24.0]).max() < 0.1


@pytest.mark.parametrize(
    "control",
    [
        {"tracker": "lq"},
        {"tracker": "pid", "bandwidth": 0.76},
        {"tracker": "adaptive", "bandwidth": 1.0, "adaptation": 10.0, "reference_bandwidth": 0.55},
    ],
    ids=lambda control: control["tracker"],
)
def test_without_a_path_every_controller_gets_the_target_itself(
    tmp_path: Path, control: dict[str, Any]
) -> None:
    config = configured(32.0, (Step(at=0.0, q2=0.1),), strategy="step")
    config = configuration.replace(config, control=configuration.replace(config.control, **control))
    run = fly(config, tmp_path)
    assert len(run["plan"]) == 0
    assert event_names(run) == ["started", "target", "stopped"]
    time, angle = true_angle(run)
    assert np.degrees(np.abs(angle - angle_of(0.1))[time > 27.0]).max() < 0.2
