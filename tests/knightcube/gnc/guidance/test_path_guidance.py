"""Tests of plans that are accepted and of plans that are refused, with an accepted plan for each refusal."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from knightcube.errors import UsageError
from knightcube.gnc.guidance.path_guidance import AcceptanceRules, GuidanceState, PathGuidance
from knightcube.gnc.guidance.plant import PolynomialPath, SingleAxisPlant, angle_of
from knightcube.gnc.guidance.vmc import StepPlan, plan
from tests.support.step_problems import KNIGHTCUBE

SECOND = 1_000_000_000
RULES = AcceptanceRules(late_after=1.0)
START, TARGET = angle_of(0.1), 0.2


@pytest.fixture(scope="module")
def good() -> StepPlan:
    return plan(KNIGHTCUBE, 0.1, 0.0, TARGET, 0.0, 10.0)


@pytest.fixture(scope="module")
def newer() -> StepPlan:
    return plan(KNIGHTCUBE, 0.1, 0.004, TARGET, 0.0, 11.0)


@pytest.fixture
def guidance(good: StepPlan) -> PathGuidance:
    """Return a guidance that follows the plan `good` from 100 s on."""
    guidance = PathGuidance(KNIGHTCUBE, RULES)
    guidance.aim(TARGET)
    assert guidance.offer(good, 100 * SECOND, 100 * SECOND, START, 0.0).accepted
    return guidance


def test_before_the_first_plan_no_path_is_followed(good: StepPlan) -> None:
    guidance = PathGuidance(KNIGHTCUBE, RULES)
    assert guidance.sample(0) is None
    assert guidance.state(0) == GuidanceState.NONE
    assert "no target" in guidance.offer(good, 0, 0, START, 0.0).reason


def test_a_good_plan_is_flown_from_its_origin_and_held_after_its_end(
    guidance: PathGuidance, good: StepPlan
) -> None:
    now = 104 * SECOND
    assert guidance.sample(now) == good.path.sample(4 * SECOND)
    assert guidance.state(now) == GuidanceState.FOLLOWING
    after = guidance.sample(111 * SECOND)
    assert after is not None
    assert after.angle == pytest.approx(angle_of(TARGET))
    assert (after.rate, after.acceleration) == (0.0, 0.0)
    assert guidance.state(111 * SECOND) == GuidanceState.HOLDING


def test_a_newer_plan_replaces_the_older(guidance: PathGuidance, newer: StepPlan) -> None:
    verdict = guidance.offer(newer, 101 * SECOND, 101 * SECOND + SECOND // 5, START, 0.004)
    assert verdict.accepted
    assert verdict.reason == ""
    assert guidance.path == newer.path.starting_at(101 * SECOND)


def spoilt(path: PolynomialPath, row: int, value: float) -> PolynomialPath:
    """Return a path with one changed coefficient of q2."""
    series = list(path.series)
    series[row] = (value, *series[row][1:])
    return replace(path, series=tuple(series))


def refused(
    guidance: PathGuidance, offered: StepPlan, origin: float, now: float, angle: float, rate: float
) -> str:
    """Return the reason why `offered` is refused, and check that the old path is still followed."""
    before = guidance.path
    verdict = guidance.offer(offered, round(origin * SECOND), round(now * SECOND), angle, rate)
    assert not verdict.accepted
    assert guidance.path is before
    return verdict.reason


def test_a_path_with_nan_or_infinity_is_never_flown(guidance: PathGuidance, newer: StepPlan) -> None:
    for value in (math.nan, math.inf):
        bad = replace(newer, path=spoilt(newer.path, 3, value))
        assert "not finite" in refused(guidance, bad, 101, 101, START, 0.004)
    for horizon in (math.nan, 0.0, -1.0, math.inf):
        bad = replace(newer, path=replace(newer.path, horizon=horizon))
        assert "not finite" in refused(guidance, bad, 101, 101, START, 0.004)


def test_a_path_beyond_the_current_limit_is_never_flown(guidance: PathGuidance) -> None:
    strong = SingleAxisPlant(1.05e-3, 2.916e-4, 23.0, 0.3)
    hasty = plan(strong, 0.1, 0.0, TARGET, 0.0, 3.5)
    assert "limit is 0.148 A" in refused(guidance, hasty, 101, 101, START, 0.0)


def test_the_current_is_checked_between_the_nodes_too(guidance: PathGuidance, newer: StepPlan) -> None:
    """A path is refused if its current exceeds the limit between the nodes.

    A ripple of Chebyshev degree 40 is too fine for 24 nodes. The current of the ripple is almost zero at most
    of the nodes, and several amperes between the nodes.
    """
    count = 41
    columns = np.zeros((count, 3))
    columns[-len(newer.path.series) :] = newer.path.series
    columns[0, 2] = 0.02  # a change of q2'' alone, like a planner's error between nodes
    rippled = replace(newer.path, series=tuple((a, b, c) for a, b, c in columns.tolist()))
    assert "limit is 0.148 A" in refused(guidance, replace(newer, path=rippled), 101, 101, START, 0.004)


def test_a_path_beyond_the_attitude_limit_is_never_flown(newer: StepPlan) -> None:
    narrow = PathGuidance(KNIGHTCUBE, replace(RULES, q2_limit=0.2))
    narrow.aim(TARGET)
    swing = plan(KNIGHTCUBE, 0.19, 0.03, TARGET, 0.0, 12.0)
    assert "|q2|" in narrow.offer(swing, 0, 0, angle_of(0.19), 0.03).reason
    assert narrow.path is None
    assert narrow.offer(newer, 0, 0, START, 0.004).accepted


def test_a_late_plan_is_never_flown(guidance: PathGuidance, newer: StepPlan) -> None:
    assert "late" in refused(guidance, newer, 101, 102.001, START, 0.004)
    assert guidance.offer(newer, 101 * SECOND, 102 * SECOND, START, 0.004).accepted


def test_a_plan_from_the_future_or_out_of_order_is_never_flown(
    guidance: PathGuidance, newer: StepPlan
) -> None:
    assert "future" in refused(guidance, newer, 101.5, 101, START, 0.004)
    assert "out of order" in refused(guidance, newer, 100, 100.5, START, 0.004)
    assert "out of order" in refused(guidance, newer, 99.9, 100.5, START, 0.004)


def test_a_plan_that_starts_elsewhere_is_never_flown(guidance: PathGuidance, newer: StepPlan) -> None:
    assert "rad, the body" in refused(guidance, newer, 101, 101, START + 0.051, 0.004)
    assert "rad/s, the body" in refused(guidance, newer, 101, 101, START, 0.025)
    assert "the body" in refused(guidance, newer, 101, 101, math.nan, 0.004)
    assert "the body" in refused(guidance, newer, 101, 101, START, math.nan)
    assert guidance.offer(newer, 101 * SECOND, 101 * SECOND, START + 0.049, 0.023).accepted


def test_a_plan_for_an_old_target_is_never_flown_and_the_old_path_is_flown_on(
    guidance: PathGuidance, good: StepPlan, newer: StepPlan
) -> None:
    guidance.aim(0.3)
    assert "the target is 0.3" in refused(guidance, newer, 101, 101, START, 0.004)
    assert guidance.sample(104 * SECOND) == good.path.sample(4 * SECOND)
    guidance.aim(TARGET)
    assert guidance.offer(newer, 101 * SECOND, 101 * SECOND, START, 0.004).accepted


def test_a_hold_overrules_the_path_and_plans_made_before_it(guidance: PathGuidance, newer: StepPlan) -> None:
    guidance.hold(0.3, 102 * SECOND)
    sample = guidance.sample(103 * SECOND)
    assert sample is not None
    assert (sample.angle, sample.rate) == (0.3, 0.0)
    assert guidance.state(102 * SECOND) == GuidanceState.HOLDING
    assert "out of order" in refused(guidance, newer, 101.9, 102.1, START, 0.004)
    assert guidance.offer(newer, 102 * SECOND, 102 * SECOND, START, 0.004).accepted


@pytest.mark.parametrize("target", [math.nan, 0.69, -math.inf])
def test_an_impossible_target_is_refused(guidance: PathGuidance, target: float) -> None:
    with pytest.raises(UsageError, match="target q2"):
        guidance.aim(target)
    assert guidance.target_q2 == TARGET


def test_an_impossible_hold_or_rule_is_refused(guidance: PathGuidance) -> None:
    with pytest.raises(UsageError, match="hold"):
        guidance.hold(math.nan, 0)
    with pytest.raises(UsageError, match="late_after"):
        AcceptanceRules(late_after=math.nan)


def test_an_end_that_is_the_target_is_held_without_alarm_unless_paths_should_not_end(good: StepPlan) -> None:
    for arrives in (True, False):
        guidance = PathGuidance(KNIGHTCUBE, RULES, arrives=arrives)
        guidance.aim(TARGET)
        assert guidance.offer(good, 0, 0, START, 0.0).accepted
        assert not guidance.is_adrift(9 * SECOND)
        assert guidance.is_adrift(11 * SECOND) is not arrives


def test_a_held_attitude_is_not_adrift_while_the_first_plan_of_a_slew_is_made() -> None:
    guidance = PathGuidance(KNIGHTCUBE, RULES, arrives=False)
    guidance.hold(0.0, 0)
    guidance.aim(0.3, now_ns=5 * SECOND)
    assert not guidance.is_adrift(5 * SECOND)
    assert guidance.is_adrift(7 * SECOND), "the plan is late"


def test_holding_the_old_target_is_adrift_once_a_plan_for_the_new_one_is_late(guidance: PathGuidance) -> None:
    guidance.aim(0.3, 0.0, 120 * SECOND)
    assert not guidance.is_adrift(120 * SECOND + SECOND // 2)
    assert guidance.is_adrift(121 * SECOND + SECOND // 2)


def test_the_remaining_path_begins_now_and_is_none_for_another_target(
    guidance: PathGuidance, good: StepPlan
) -> None:
    assert guidance.remains(103 * SECOND) == good.path.starting_at(-3 * SECOND)
    assert guidance.remains(111 * SECOND) is None
    guidance.aim(0.3)
    assert guidance.remains(103 * SECOND) is None


def test_a_plan_that_ends_at_another_rate_is_never_flown(guidance: PathGuidance) -> None:
    moving = plan(KNIGHTCUBE, 0.1, 0.0, TARGET, 0.01, 10.0)
    assert "the target is" in refused(guidance, moving, 101, 101, START, 0.0)
    guidance.aim(TARGET, 0.01)
    assert guidance.offer(moving, 101 * SECOND, 101 * SECOND, START, 0.0).accepted
    with pytest.raises(UsageError, match="rate"):
        guidance.aim(TARGET, math.nan)


def test_the_limit_is_judged_under_the_disturbance_that_the_plan_allowed_for() -> None:
    """The current limit is checked with the disturbance that the plan assumed.

    With a disturbance of 0.03 rad/s^2, which takes 108 mA to compensate, the path is within the limit.
    """
    pushed = replace(KNIGHTCUBE, disturbance=0.03)
    helped = plan(pushed, 0.1, 0.0, 0.2, 0.0, 5.5)
    guidance = PathGuidance(KNIGHTCUBE, RULES)
    guidance.aim(0.2)
    assert guidance.offer(helped, 0, 0, START, 0.0, disturbance=0.03).accepted
    other = PathGuidance(KNIGHTCUBE, RULES)
    other.aim(0.2)
    assert "limit is" in other.offer(helped, 0, 0, START, 0.0, disturbance=-0.03).reason
