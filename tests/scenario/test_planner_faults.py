"""Tests that an invalid plan is not used. The last valid plan continues, and then its end point is held.

`test_strategies` flies the same configurations with a valid planner, and expects none of these alarms.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flight.bodies.testbed import body as testbed
from flight.link.telemetry.packets import to_text
from flight.schema import reader as configuration
from flight.schema.bodies import Step
from knightcube.errors import PlanningError
from knightcube.gnc.guidance import vmc as plan_job
from knightcube.gnc.guidance.plant import PolynomialPath
from knightcube.gnc.guidance.vmc import PlanJob, StepPlan
from knightcube.gnc.guidance.vmc import plan as make_plan
from tests.scenario.mode_flights import released
from tests.support.flights import demo_config, event_names, fly, thesis_config

DURATION = 16.0
GOOD_PLANS = 2
"""Number of valid plans; the second plan is made at 5 s and ends at 15 s."""

Spoil = Callable[[PlanJob, StepPlan], StepPlan]


def use_planner(monkeypatch: pytest.MonkeyPatch, plan: Callable[[PlanJob], StepPlan]) -> None:
    """Replace the testbed's planner by the function `plan`."""
    monkeypatch.setattr(testbed, "TESTBED", replace(testbed.TESTBED, plan=plan))


def fail(job: PlanJob, plan: StepPlan) -> StepPlan:
    raise PlanningError("none today")


def break_down(job: PlanJob, plan: StepPlan) -> StepPlan:
    raise ZeroDivisionError("a defect of the planner")


def turn_to_nan(job: PlanJob, plan: StepPlan) -> StepPlan:
    return replace(plan, path=PolynomialPath.through(np.full(24, np.nan), plan.horizon))


def go_beyond_the_limit(job: PlanJob, plan: StepPlan) -> StepPlan:
    return replace(plan, path=PolynomialPath.through(plan.node_q2, 0.02 * plan.horizon))


def start_elsewhere(job: PlanJob, plan: StepPlan) -> StepPlan:
    return make_plan(job.plant, job.start_q2 + 0.1, 0.0, job.end_q2, 0.0, 10.0)


@pytest.mark.parametrize(
    ("spoil", "event"),
    [
        (fail, "planner-failed"),
        (break_down, "planner-failed"),
        (turn_to_nan, "plan-refused"),
        (go_beyond_the_limit, "plan-refused"),
        (start_elsewhere, "plan-refused"),
    ],
    ids=lambda value: getattr(value, "__name__", value),
)
def test_invalid_plans_are_refused_and_the_last_valid_path_is_flown_and_held(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, spoil: Spoil, event: str
) -> None:
    use_planner(
        monkeypatch,
        lambda job: plan_job.run(job) if job.number <= GOOD_PLANS else spoil(job, plan_job.run(job)),
    )
    run = fly(thesis_config(DURATION), tmp_path)
    names = event_names(run)
    assert names.index(event) < names.index("holding")
    plans = run["plan"]
    assert plans["accepted"].tolist() == [1] * GOOD_PLANS + [0] * (len(plans) - GOOD_PLANS)
    control = run["control"]
    time = control["time_ns"] * 1e-9
    assert (control["plan"][time > 5.2] == GOOD_PLANS).all()
    assert (control["state"][(time > 5.2) & (time < 15.0)] == 1).all(), "the last good path is flown"
    assert (control["state"][time > 15.2] == 2).all(), "its end is held"
    final = 2 * np.arcsin(run["truth"]["quaternion"][-1, 1]) - 2 * np.arcsin(-0.3)
    assert abs(final) < np.radians(4.5)


@pytest.mark.parametrize("spoil", [fail, turn_to_nan])
def test_on_a_goal_horizon_one_good_plan_is_enough_to_arrive(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, spoil: Spoil
) -> None:
    """With a goal horizon, one valid plan is sufficient to reach the target.

    The first path ends at the target, so holding its end point is correct and gives no alarm.
    """
    use_planner(
        monkeypatch, lambda job: plan_job.run(job) if job.number == 1 else spoil(job, plan_job.run(job))
    )
    run = fly(demo_config(DURATION, camera=False), tmp_path)
    assert "holding" not in event_names(run)
    accepted = run["plan"]["accepted"]
    assert accepted[0] == 1
    assert not accepted[1:].any()
    final = 2 * np.arcsin(run["truth"]["quaternion"][-1, 1]) - 2 * np.arcsin(-0.3)
    assert abs(final) < np.radians(0.1)


def test_a_new_target_without_a_plan_for_it_is_reported_while_the_old_attitude_is_held(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_planner(
        monkeypatch, lambda job: plan_job.run(job) if job.end_q2 < -0.25 else fail(job, plan_job.run(job))
    )
    steps = (Step(at=0.0, q2=-0.3), Step(at=15.0, q2=-0.2))
    run = fly(configuration.replace(demo_config(20.0, camera=False), steps=steps), tmp_path)
    names = event_names(run)
    assert names.count("holding") == 1
    assert names.index("planner-failed") < names.index("holding")


def test_late_plans_are_refused_and_without_any_path_the_coils_stay_off(tmp_path: Path) -> None:
    run = fly(demo_config(7.0, camera=False), tmp_path, planner_latency=1.5)
    assert len(run["plan"]) >= 2
    assert not run["plan"]["accepted"].any()
    assert to_text(run["plan"]["status"][0]).startswith("the plan is late")
    assert not run["truth"]["current"].any()


def test_plans_that_arrive_just_in_time_are_flown(tmp_path: Path) -> None:
    run = fly(demo_config(7.0, camera=False), tmp_path, planner_latency=0.9)
    assert len(run["plan"]) >= 2
    assert run["plan"]["accepted"].all()


def test_an_infeasible_step_is_stretched_reported_and_flown(tmp_path: Path) -> None:
    """An infeasible step is reported, and flown with a longer duration.

    A slew from q2 = +0.3 to rest at -0.3 needs more than 10 s with at most 0.148 A.
    """
    steps = (Step(at=0.0, q2=0.3), Step(at=3.0, q2=-0.3))
    config = configuration.replace(demo_config(20.0, camera=False), steps=steps)
    run = fly(config, tmp_path, section=released(0.3, 0.0))
    assert "plan-stretched" in event_names(run)
    stretched = run["plan"][run["plan"]["status"] == b"stretched"]
    assert (stretched["horizon"] > 10.0).all()
    assert (stretched["peak_current"] <= 1.001 * 0.148).all()
    final = 2 * np.arcsin(run["truth"]["quaternion"][-1, 1]) - 2 * np.arcsin(-0.3)
    assert abs(final) < np.radians(4.5)
